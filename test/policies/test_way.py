"""The way of a policy from Spark to a robot and out again, against a real MLflow server and a real SeaweedFS."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from click.testing import CliRunner
from policies.models import bucket_of, linear, trained
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import active, registry
from shadowhound_data_logger.policies.smoke import ISOLATIONS

pytestmark = [pytest.mark.seaweedfs, pytest.mark.long('an MLflow server, and a process for each smoke run')]


def test_the_way_of_a_policy(tower: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys, pack and publish on Spark; sync, list, show, rollback, use, pin and unpin on Thor; all by the verbs."""
    monkeypatch.setattr(registry, 'PAGE', 1)  # as many answers as there are versions
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
        """The id of what is in the folder then."""
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
    run(spark, 'publish', str(tmp_path / 'packed_1'), '--alias', 'first')  # which is on the last page
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
