"""A mission next to a running node: the robot's values are logged to it, and objects from its time have its id."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from e2e.processes import GENTLE, Node, Processes, until
from e2e.reading import Objects
from e2e.station import NODE, Station
from missions.server import Server, complete
from rclpy.qos import DurabilityPolicy, QoSProfile
from shadowhound_tower.embedded import Tower
from std_msgs.msg import String

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MissionFolder, missions
from shadowhound_data_logger.missions.overview import state_of
from shadowhound_data_logger.stores.s3 import S3Store

ENOUGH = 40
MOMENT_NS = 20 * 10**9
"""The time in which the node notices a mission's start and end on a busy machine."""
PARAMETERS = {'mission.capture': 'mission', 'mission.frame_every_s': 1.0, 'lowstate.batch_s': 1.0}


def total(node: Node, what: str) -> int:
    """The sum over all topics of the ledger."""
    rows = node.ledger()['topics'].values()
    return sum(sum(row[what].values()) if isinstance(row[what], dict) else row[what] for row in rows)


def published_missions(station: Station) -> list[dict[str, Any]]:
    """What ``~/mission`` publishes, for a late subscriber."""
    found: list[str] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = station.node.create_subscription(
        String, f'{NODE}/mission', lambda message: found.append(message.data), latched
    )
    try:
        until(lambda: station._executor.spin_once(timeout_sec=0.1) or found, 'a message on ~/mission')
    finally:
        station.node.destroy_subscription(subscription)
    return [json.loads(text) if text else {} for text in found]


def sees(folder: MissionFolder) -> bool:
    """Whether the node has logged everything expected by now."""
    story = state_of(folder).node
    assert story
    return story.last.get('distance_traveled_m', 0.0) > 0.5 and 'battery_pct' in story.last and story.counts['frame'] >= 2


def test_only_mission_data_is_stored(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects], tmp_path: Path
) -> None:
    """With ``mission.capture: mission`` all objects are from the mission's time and marked; other messages count as skipped."""
    node = processes.node(seaweed.environment(), PARAMETERS)
    processes.sim('duration_s:=60.0', GENTLE)
    station = Station(processes.environ)
    logger = MissionDataLogger(home=node.home, robot=processes.robot, replay=False, start_timeout_s=0.0)
    try:
        until(lambda: node.topic('/imu').get('received', 0) > ENOUGH, "the robot's messages are received")
        assert total(node, 'stored') == 0
        assert published_missions(station) == [{}]
        mission_id = logger.start_mission('patrol', 'go round')
        (folder,) = missions(node.home)
        until(folder.node.journal.exists, 'the node joins in')
        until(lambda: sees(folder), lambda: f'the node logs the robot: {state_of(folder).node}')
        assert published_missions(station)[-1]['mission_id'] == mission_id
        logger.end_mission(True, 0.0, 0.0)
        logger.flush(0.0)
        until(lambda: not journal.is_locked(folder.node.journal), 'the node leaves')
        until(lambda: published_missions(station) == [{}], 'the end of the mission is published')
        node.received('/imu', node.topic('/imu')['received'] + ENOUGH)
        until(lambda: not node.ledger()['objects']['pending'] and not total(node, 'open'), 'all is delivered')
        count = total(node, 'stored')
        node.received('/imu', node.topic('/imu')['received'] + ENOUGH)
        assert total(node, 'stored') == count > 0
    finally:
        logger.close()
        station.close()
    ledger = node.stop()
    assert ledger['balanced']
    assert total(node, 'dropped') == 0
    start_ns, end_ns = int(journal.first(folder.journal)['t']), int(journal.last(folder.journal)['t'])
    objects = stored(processes.robot)
    times = [(int(info.metadata['t_start_ns']), info.metadata.get('mission_id')) for info in objects.infos.values()]
    assert {found for time_ns, found in times if start_ns <= time_ns <= end_ns} == {mission_id}
    assert all(start_ns - MOMENT_NS < time_ns < end_ns + MOMENT_NS for time_ns, _ in times)
    assert {key.split('/')[1] for key in objects.infos} >= {'camera', 'imu', 'lidar', 'lowstate', 'odom', 'states'}


@pytest.mark.slow
@pytest.mark.long('half a minute')
def test_a_run_has_what_the_node_measured(processes: Processes, tower: Tower, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real MLflow server has the complete mission of an agent that only starts and ends it, and the objects name its run."""
    environ = tower.environment()
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    node = processes.node(environ, {**PARAMETERS, 'mission.capture': 'always'})
    processes.sim('duration_s:=60.0', GENTLE)
    logger = MissionDataLogger(home=node.home, robot=processes.robot, experiment='thor_missions', start_timeout_s=30.0)
    until(lambda: node.topic('/imu').get('received', 0) > ENOUGH, "the robot's messages are received")
    run_id = logger.start_mission('patrol', command := f'by the node of {processes.robot}')
    (folder,) = missions(node.home)
    status = node.home / 'spool' / f'status-{processes.robot}.json'
    until(lambda: json.loads(status.read_bytes())['mission'].get('run_id') == run_id, 'the node knows the run')
    node.received('/imu', node.topic('/imu')['received'] + ENOUGH)
    until(lambda: sees(folder), lambda: f'the node logs the robot: {state_of(folder).node}')
    logger.end_mission(True, 0.0, 0.0)
    until(lambda: complete(node.home), lambda: f'all is sent: {logger.flush(0.0)}')
    assert logger.close().complete
    server = Server(tower, None)  # type: ignore[arg-type]  # no wire
    run = server.run(command)
    assert (run.info.run_id, run.info.status) == (run_id, 'FINISHED')
    assert run.data.metrics['distance_m'] == run.data.metrics['distance_traveled_m'] > 0.5
    assert {'battery_pct', 'temperature_c', 'pose_x', 'pose_y', 'pose_yaw', 'camera_frame_900000', 'battery_consumed_pct',
            'success'} <= run.data.metrics.keys()  # fmt: skip
    steps = [point.step for point in server.history(run_id, 'pose_x')]
    assert steps == sorted(set(steps))
    assert {'camera/frame_900000.jpg', 'trajectories/trajectory.csv', 'trajectory.png', 'battery.png', 'camera_summary.jpg',
            'summary.json'} <= server.artifacts(run_id)  # fmt: skip
    node.delivered()
    assert node.stop()['balanced']
    with closing(S3Store(tower.store_settings(), UploadSettings())) as store:
        store.open()
        infos = Objects.of(store, 'sensor-data', processes.robot).infos
    names = {key.partition(f'/missions/{run_id}/')[2] for key in infos}
    assert {'camera/frame_900000.jpg', 'trajectory.csv', 'summary.json'} <= names
    assert run_id in {info.metadata.get('run_id') for key, info in infos.items() if '/imu/' in key}
