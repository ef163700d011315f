"""Three robots and one registry: which robot takes which policy, and rollbacks; with real MLflow, SeaweedFS, DDS and commands.

A policy's path from Spark to a robot and back out, with a real MLflow server and a real SeaweedFS.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import rclpy
from click.testing import CliRunner
from domains import free_domain
from e2e.processes import Process, until
from policies.models import Spark, bucket_of, linear, trained
from rclpy.node import Node
from shadowhound_tower.embedded import Tower
from std_msgs.msg import String

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import active, packing, registry
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import ISOLATIONS
from shadowhound_data_logger.ros.policy_topics import NODE

ROUNDS = 5
"""Timed rollbacks: one may coincide with other load on the machine."""


class Robot:
    """A home, and commands that run on it."""

    def __init__(self, name: str, home: Path, spark: Spark, environ: dict[str, str]) -> None:
        self.environ = {**environ, 'SHADOWHOUND_HOME': str(home), 'SHADOWHOUND_ROBOT': name, 'SHADOWHOUND_POLICY': spark.name}
        self.environ['SHADOWHOUND_POLICY_KEYS'] = str(spark.keys)
        self.folder = PolicyFolder(home)
        spark.trusted_by(self.folder)

    def verb(self, *arguments: str, code: int = 0) -> Any:
        """Its output, parsed if it is JSON."""
        done = CliRunner().invoke(cli, ['policy', *arguments], env=self.environ, standalone_mode=False, catch_exceptions=False)
        assert (done.return_value or 0) == code, done.output
        return json.loads(done.output) if '--json' in arguments else done.output

    def synced(self) -> tuple[str, str]:
        """The result of one check of the registry, as from cron."""
        report = self.verb('sync', '--json')
        return report['done'], report['active']


@pytest.fixture
def speaker() -> Iterator[tuple[int, Callable[[str], object]]]:
    """A domain, and a client of its policy service."""
    with free_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = Node('driver', context=context)
        health = node.create_publisher(String, f'/{NODE}/health', 10)

        def say(text: str) -> None:
            until(health.get_subscription_count, 'the service listens')
            health.publish(String(data=text))

        yield domain, say
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('an MLflow server, a service, and a dozen smoke runs')
def test_a_service_stops_immediately_during_a_download(tower: Tower, tmp_path: Path) -> None:
    """A download of minutes blocks nothing, and continues with the bytes that have arrived."""
    bucket_of(tower)
    spark = Spark(tmp_path / 'spark', f'patrol_{uuid4().hex[:8]}')
    thor = Robot('thor', tmp_path / 'thor', spark, tower.environment('thor') | tower.tracking('thor'))
    of_spark = Robot('spark', tmp_path / 'spark', spark, tower.environment('spark') | tower.tracking('spark'))
    spark.packed(1, linear(extra=5_000_000))
    of_spark.verb('publish', str(spark.folder / 'packed_1'), '--alias', 'champion')
    command = ['-m', 'shadowhound_data_logger.cli.main', 'policy', 'run', '--max-mbps', '1']
    for number in (signal.SIGTERM, signal.SIGINT):
        service = Process('policy run', command, tmp_path / 'run.log', {**os.environ, **thor.environ})
        try:
            incoming = thor.folder.versions.incoming
            before = sum(path.stat().st_size for path in incoming.rglob('*.onnx*'))
            until(
                lambda before=before: (
                    sum(path.stat().st_size for path in thor.folder.versions.incoming.rglob('*.onnx*')) > before
                ),
                lambda service=service: f'it downloads: {service.log}',
            )
            service.signal(number)
            assert service.wait(60.0) == 0, service.log
        finally:
            service.kill()
    assert thor.folder.current() is None


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('an MLflow server, a service, and a dozen smoke runs')
def test_a_canary_updates_first_and_rolls_back_alone(  # noqa: PLR0915 - one story
    tower: Tower, tmp_path: Path, speaker: tuple[int, Callable[[str], object]]
) -> None:
    """A version that misbehaves on the canary is rolled back within a second, and stays so; all robots take the next one."""
    bucket_of(tower)
    domain, say = speaker
    spark = Spark(tmp_path / 'spark', f'patrol_{uuid4().hex[:8]}')
    of_robots = tower.environment('thor') | tower.tracking('thor')
    thor, tachi, uro = (Robot(name, tmp_path / name, spark, of_robots) for name in ('thor', 'tachi', 'uro'))
    others = (thor, uro)
    of_spark = Robot('spark', tmp_path / 'spark', spark, tower.environment('spark') | tower.tracking('spark'))
    ids: dict[int, str] = {}

    def publish(version: int, *arguments: str) -> None:
        """Publish a new version, or another alias for an existing one."""
        if version not in ids:
            ids[version] = spark.packed(version, linear(0.1 * version))[1].id
        of_spark.verb('publish', str(spark.folder / f'packed_{version}'), '--alias', *arguments)

    publish(1, 'champion')
    command = ['-m', 'shadowhound_data_logger.cli.main', 'policy', 'run', '--interval', '0.3']
    environ = {**os.environ, **tachi.environ, 'ROS_DOMAIN_ID': str(domain)}
    service = Process('policy run', command, tmp_path / 'run.log', environ)
    try:
        until(lambda: tachi.folder.current() == ids[1], lambda: f'the canary begins as all do: {service.log}')
        assert {robot.synced() for robot in others} == {('activated', ids[1])}

        publish(2, 'canary', '--canary', 'tachi')
        until(lambda: tachi.folder.current() == ids[2], lambda: f'the canary goes first: {service.log}')
        assert {robot.synced() for robot in others} == {('unchanged', ids[1])}

        took_s = []
        for _ in range(ROUNDS):
            tachi.folder.use(ids[2])
            began = time.monotonic()
            say(json.dumps({'policy': ids[2], 'failures': 4, 'p99_ms': 1.0}))
            until(lambda: tachi.folder.current() == ids[1], lambda: f'it goes back: {service.log}')
            took_s.append(time.monotonic() - began)
        assert statistics.median(took_s) < 1.0, took_s
        service.await_log(f'{ids[2]} was rolled back here: 4 steps failed')  # the registry is unchanged, and is not followed
        assert tachi.folder.current() == ids[1]
        assert {robot.synced() for robot in others} == {('unchanged', ids[1])}
        assert [robot.folder.state.read().bad for robot in others] == [{}, {}]
        assert [*tachi.folder.state.read().bad] == [ids[2]]

        publish(3, 'canary', '--canary', 'tachi')
        until(lambda: tachi.folder.current() == ids[3], lambda: f'the next one: {service.log}')
        say(json.dumps({'policy': ids[3], 'failures': 3, 'p99_ms': 1.0}))
        assert {robot.synced() for robot in others} == {('unchanged', ids[1])}
        publish(3, 'champion')
        assert {robot.synced() for robot in others} == {('activated', ids[3])}
        assert tachi.folder.current() == ids[3]
    finally:
        service.kill()

    publish(1, 'robot-thor')
    assert uro.verb('pin') == f'pinned: {ids[3]}\n'
    publish(1, 'champion')
    assert [robot.synced() for robot in (thor, tachi, uro)] == [
        ('activated', ids[1]),
        ('unchanged', ids[3]),
        ('pinned', ids[3]),
    ]  # by its own alias, as the canary, by its pin
    uro.verb('unpin')
    assert uro.synced() == ('activated', ids[1])
    assert packing.parse_manifest((tachi.folder.path / 'current' / 'manifest.json').read_bytes()).id == ids[3]


@pytest.mark.seaweedfs
@pytest.mark.long('an MLflow server, and a process for each smoke run')
def test_a_policy_is_published_activated_and_rolled_back(tower: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys, pack and publish on Spark; sync, list, show, rollback, use, pin and unpin on Thor; all with the commands."""
    monkeypatch.setattr(registry, 'PAGE', 1)  # as many responses as there are versions
    client = bucket_of(tower)
    name = f'patrol_{uuid4().hex[:8]}'
    spark = tower.environment('spark') | tower.tracking('spark') | {'SHADOWHOUND_HOME': str(tmp_path / 'spark_home')}
    thor = tower.environment('thor') | tower.tracking('thor') | {'SHADOWHOUND_HOME': str(tmp_path / 'thor'),
                                                                'SHADOWHOUND_POLICY': name}  # fmt: skip

    def run(environ: dict[str, str], *arguments: str) -> Any:
        done = CliRunner().invoke(cli, ['policy', *arguments], env=environ, catch_exceptions=False)
        assert done.exit_code == 0 or done.return_value == 0, done.output
        return json.loads(done.output) if '--json' in arguments else done.output

    def packed(folder: str, gain: float, *arguments: str) -> str:
        """The id of the folder's current contents."""
        of_training = trained(tmp_path / f'trained_{folder}', linear(gain))
        made = run(spark, 'pack', str(of_training), '--name', name, '--smoke', f'{of_training}.npz', '--max-p99-ms', '5000',
                   '--to', str(tmp_path / folder), '--json', *arguments)  # fmt: skip
        return str(made['policy'])

    def publish(version: int) -> str:
        made = packed(f'packed_{version}', 0.1 * version)
        run(spark, 'publish', str(tmp_path / f'packed_{version}'), '--alias', 'champion')
        return made

    made = run(spark, 'keys', '--json')
    first = publish(1)
    assert first.startswith(f'{name}@1#')
    run(thor, 'list', '--json')
    shutil.copy(made['root'], tmp_path / 'thor' / 'policies')
    assert run(thor, 'sync', '--json')['done'] == 'activated'
    of_another = {'Bucket': 'lerobot', 'Key': f'policies/go2/{name}_v2/model.onnx'}
    client.put_object(Body=b'of a publication that was cut off', **of_another)
    for version, remedy in (('1', '--version 2'), ('2', 'interrupted')):
        packed(f'other_{version}', 0.7, '--version', version)
        with pytest.raises(PolicyError, match=f'already has a different {name}@{version}') as raised:
            run(spark, 'publish', str(tmp_path / f'other_{version}'))
        assert remedy in raised.value.remedy
    client.delete_object(**of_another)
    with active(tmp_path / 'thor') as policy:
        assert policy.id == first
        assert [spec.names for spec in policy.manifest.inputs] == [('x', 'y', 'yaw')]
    second = publish(2)
    run(spark, 'publish', str(tmp_path / 'packed_1'), '--alias', 'first')  # it is on the last page
    assert run(thor, 'sync', '--json')['active'] == second
    assert run(thor, 'sync', '--json')['done'] == 'unchanged'
    assert first in run(thor, 'rollback')
    assert [(row['policy'], row['active'], bool(row['why_not'])) for row in run(thor, 'list', '--json')['policies']] == [
        (first, True, False), (second, False, True)]  # fmt: skip
    run(thor, 'use', f'{name}@2')
    pinned = run(thor, 'sync', '--json')
    assert pinned.pop('isolation') in ISOLATIONS
    assert pinned == {'wanted': second, 'active': second, 'done': 'pinned', 'p99_ms': None,
                                           'fetched_bytes': 0, 'begun_anew': 0, 'stale': ''}  # fmt: skip
    assert run(thor, 'unpin') == 'follows the registry again\n'
    run(thor, 'pin')
    assert run(thor, 'show', '--json')['policy'] == second
