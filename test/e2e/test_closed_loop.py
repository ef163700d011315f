"""The closed loop: a robot is driven and recorded, a policy is fitted to that, signed, published, and drives the robot."""

from __future__ import annotations

import gc
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

import numpy as np
import pyarrow.parquet as pq
import pytest
from e2e.processes import GENTLE, Process, Processes, until
from e2e.station import Station
from geometry_msgs.msg import Twist
from missions.server import Server, complete
from nav_msgs.msg import Odometry
from policies.models import bucket_of
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.lake.training import digest_of
from shadowhound_data_logger.missions.folder import MissionFolder, missions

ROOT: Final = Path(__file__).parents[2]
MAIN: Final = [sys.executable, '-m', 'shadowhound_data_logger.cli.main']
FORWARD, TURN = 0.4, 0.3
"""The teacher's commands, m/s and rad/s."""
PARAMETERS: Final = {
    'cmd_vel.enabled': True, 'camera.rate_hz': 5.0, 'odom.rate_hz': 0.0, 'lidar.enabled': False, 'mission.capture': 'always',
}  # fmt: skip


def fitted(exported: Path, folder: Path) -> str:
    """A linear fit to the dataset, as ONNX: from the state to the action; and the digest of the dataset."""
    from onnx import TensorProto, helper, numpy_helper

    info = json.loads((exported / 'meta/info.json').read_bytes())
    table = pq.read_table(exported / 'data')
    states = np.array(table['observation.state'].to_pylist(), 'f8')
    actions = np.array(table['action'].to_pylist(), 'f8')
    moving = np.abs(actions).sum(axis=1) > 0
    assert moving.sum() >= 3
    bias = actions[moving].mean(axis=0)
    weights = np.linalg.lstsq(states[moving], actions[moving] - bias, rcond=1e-3)[0]
    nodes = [helper.make_node('MatMul', ['observation.state', 'w'], ['m']), helper.make_node('Add', ['m', 'b'], ['action'])]
    graph = helper.make_graph(
        nodes, 'policy', [helper.make_tensor_value_info('observation.state', TensorProto.FLOAT, [1, states.shape[1]])],
        [helper.make_tensor_value_info('action', TensorProto.FLOAT, [1, 3])],
        [numpy_helper.from_array(weights.astype('f4'), 'w'), numpy_helper.from_array(bias.astype('f4'), 'b')],
    )  # fmt: skip
    folder.mkdir()
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)], ir_version=9)
    (folder / 'model.onnx').write_bytes(model.SerializeToString())
    named = {
        kind: {name: {'names': info['features'][name]['names']}}
        for kind, name in (('input_features', 'observation.state'), ('output_features', 'action'))
    }
    (folder / 'config.json').write_text(json.dumps(named))
    (folder / 'train_config.json').write_text('{}')
    np.savez(folder.with_suffix('.npz'), **{'observation.state': states[:1].astype('f4')})  # type: ignore[arg-type]
    assert np.allclose(bias, [FORWARD, 0.0, TURN], atol=0.05), bias
    return digest_of(exported)


def summary(server: Server, command: str) -> dict[str, Any]:
    """The summary of a mission in MLflow."""
    path = server.client.download_artifacts(server.run(command).info.run_id, 'summary.json')
    found: dict[str, Any] = json.loads(Path(path).read_bytes())
    gc.collect()  # MLflow's client of artifacts keeps a thread until it is collected
    return found


@pytest.mark.slow
@pytest.mark.long('a robot, a node, a Tower with MLflow, and a dozen commands')
@pytest.mark.timeout(900)
def test_a_policy_trained_on_a_recording_drives_the_robot(  # noqa: PLR0915 - one story
    processes: Processes, tower: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot follows the policy, stops when it is removed, and the mission's run leads to the policy's training data."""
    environ = tower.environment()
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    robot = processes.robot
    policy = f'loop_{uuid4().hex[:8]}'
    bucket_of(tower)
    spark = {**os.environ, **tower.environment('spark'), **tower.tracking('spark'), 'PYTHONPATH': str(ROOT),
             'SHADOWHOUND_HOME': str(tmp_path / 'spark')}  # fmt: skip

    def run(*command: str, **more: str) -> Any:
        ran = subprocess.run([*MAIN, *command], env={**spark, **more}, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.returncode == 0 or command[0] == 'query', ran.stdout[-2000:] + ran.stderr[-3000:]
        return json.loads(ran.stdout) if '--json' in command else ran.stdout

    node = processes.node(environ, PARAMETERS)
    processes.sim('obey:=true', 'image_raw:=false', GENTLE)
    until(lambda: node.topic('/odom').get('received', 0) > 0, "the robot's messages are received")
    station = Station(processes.environ)
    report = station.node.create_publisher(Twist, 'cmd_vel', 1)
    received: list[Odometry] = []
    station.node.create_subscription(Odometry, 'odom', received.append, 10)

    def newest() -> MissionFolder:
        return max(missions(node.home), key=lambda one: one.mission_id)

    def mission(command: str, until_done: Callable[[], object], step: Callable[[], object] = lambda: None) -> str:
        logger = MissionDataLogger(home=node.home, robot=robot, experiment='thor_missions', start_timeout_s=30.0)
        try:
            run_id = logger.start_mission('patrol', command)
            count = len([*missions(node.home)])
            folder = newest()
            until(folder.node.journal.exists, 'the node joins in')

            def done() -> object:
                step()
                station.spin()
                return until_done()

            until(done, f'mission {count} is done')
            logger.end_mission(True, 0.0, 0.0)
            until(lambda: complete(node.home, count), lambda: f'all is sent: {logger.flush(0.0)}')
        finally:
            logger.close()
        return run_id

    # A person drives, and everything is recorded.
    command = Twist()
    command.linear.x, command.angular.z = FORWARD, TURN
    until(lambda: report.get_subscription_count() == 2, 'robot and node listen to the teacher')
    begun = time.monotonic()

    def went() -> bool:
        return time.monotonic() - begun > 8.0 and any(one.pose.pose.position.x > 0.5 for one in received)

    taught = mission(f'taught {robot}', went, lambda: report.publish(command))
    # The mission becomes a dataset, and the dataset a policy.
    asked = ('query', "SELECT count(*) AS rows FROM objects WHERE sensor = 'cmd_vel'", '--mission', taught, '--json')
    until(lambda: sum(row['rows'] for row in run(*asked)), 'the catalog has arrived')
    exported = tmp_path / policy
    (tmp_path / 'export.yaml').write_text('max_stale: 1\ncodec: h264\n')
    text = run('export', 'lerobot', policy, '--robot', robot, '--mission', taught, '--wait', '--allow-gaps',
        '--config', str(tmp_path / 'export.yaml'))  # fmt: skip
    assert (exported / 'meta/info.json').is_file(), text
    digest = fitted(exported, tmp_path / 'trained')
    packed = str(tmp_path / 'packed')
    root = run('policy', 'keys', '--json')['root']
    sample = str(tmp_path / 'trained.npz')
    pack = ('policy', 'pack', str(tmp_path / 'trained'), '--name', policy, '--smoke', sample, '--dataset', digest)
    made = run(*pack, '--fps', '10', '--max-p99-ms', '10000', '--to', packed, '--json')['policy']
    run('policy', 'publish', packed, '--alias', 'canary', '--canary', robot)
    # The canary takes it; the other robot does not.
    thor = (
        tower.environment('thor')
        | tower.tracking('thor')
        | {'SHADOWHOUND_HOME': str(node.home), 'SHADOWHOUND_POLICY': policy, 'SHADOWHOUND_ROBOT': robot}
    )
    run('policy', 'list', '--json', **thor)
    shutil.copy(root, node.home / 'policies')
    assert run('policy', 'sync', '--json', **thor)['active'] == made
    other = {**thor, 'SHADOWHOUND_HOME': str(tmp_path / 'other'), 'SHADOWHOUND_ROBOT': 'other'}
    assert run('policy', 'sync', '--json', **other)['active'] is None
    # It drives, in a mission.
    path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
    of_driver = {**processes.environ, **thor, 'PYTHONPATH': path}
    driver = Process('driver', [str(ROOT / 'examples/policy_node.py')], tmp_path / 'driver.log', of_driver)
    processes.started.append(driver)
    driver.await_log(f'{made} drives')
    before = received[-1].pose.pose.position

    def gone() -> bool:
        now = received[-1].pose.pose.position
        return (now.x - before.x) ** 2 + (now.y - before.y) ** 2 > 0.5**2

    driven = mission(f'driven {robot}', gone)
    driver.kill()
    until(lambda: received[-1].twist.twist.linear.x == 0.0 or station.spin(), 'without its policy the robot stops')
    # The policy that drove, and its training data.
    server = Server(tower, None)  # type: ignore[arg-type]  # no wire
    assert server.run(f'driven {robot}').data.params['policy'] == made
    assert summary(server, f'driven {robot}')['policy'] == made
    shown = run('policy', 'show', made.partition('#')[0], '--json', **thor)
    assert shown['dataset'] == digest
    source = pq.read_table(exported / 'meta/shadowhound_sources.parquet')['key'][0].as_py()
    (found,) = run('export', 'where', source, '--json')
    assert digest in found['digests']
    assert driven != taught
    station.close()
