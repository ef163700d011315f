"""The node's records arrive in the agent's run: once, before the end, and older than the agent's statements."""

from __future__ import annotations

import json
import random
from pathlib import Path

from missions.fakes import FakeSpooler, FakeTracking, journalling

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import TrackingError
from shadowhound_data_logger.missions.active import ActiveMission, MissionFinder, ended
from shadowhound_data_logger.missions.delivery import NODE_CLOSE_TIMEOUT_S, Delivery
from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.node_log import Frame, NodeLog, Reading
from shadowhound_data_logger.missions.odometer import Pose

SECOND = 10**9
JPEG = b'\xff\xd8 of the node \xff\xd9'


def join(home: Path, *, seconds: int = 5, step_ns: int = 1000) -> NodeLog:
    """A node that has observed a robot for a while."""
    mission = MissionFinder(home, 'thor').active()
    assert mission
    node_log = NodeLog(mission, step_ns, 5e9)
    node_log.open()
    for number in range(seconds):
        stamp_ns = mission.start_ns + number * step_ns
        node_log.add(Reading(stamp_ns, 'battery_pct', 90.0 - number))
        node_log.add(Pose(stamp_ns, float(number), 0.0, 0.0))
    node_log.add(Frame(mission.start_ns, JPEG))
    node_log.write(is_final=True)
    return node_log


def leave(node_log: NodeLog) -> None:
    node_log.close(ended(node_log.mission))


def work(delivery: Delivery) -> bool:
    return bool([delivery.track(), delivery.attach(), delivery.spool()]) and delivery.complete()


def deliver(folder: MissionFolder, tracking: FakeTracking, spooler: FakeSpooler, rounds: int = 50) -> bool:
    """Whether everything arrives."""
    delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]
    return any(work(delivery) for _ in range(rounds))


def newest(tracking: FakeTracking) -> dict[str, float]:
    """The values that MLflow shows: those with the highest step."""
    return {point.key: point.value for point in sorted(tracking.points, key=lambda point: (point.step, point.time_ms))}


def flown(home: Path, distance_m: float = 0.0) -> ActiveMission:
    """A mission with an agent that only starts and ends it."""
    with journalling(home) as logger:
        logger.start_mission('patrol', 'go')
        node_log = join(home)
        logger.end_mission(True, distance_m, 0.0)
        logger.flush(0.0)
        leave(node_log)
    return node_log.mission


def test_an_agent_that_only_starts_and_ends_has_a_complete_run(tmp_path: Path) -> None:
    """Battery, distance, pose, trajectory and frames are there, in the run and in the store."""
    mission, tracking, spooler = flown(tmp_path), FakeTracking(), FakeSpooler()
    assert deliver(mission.folder, tracking, spooler)
    last = newest(tracking)
    assert {key: last[key] for key in ('battery_pct', 'pose_x', 'distance_traveled_m', 'distance_m', 'battery_consumed_pct')} == {
        'battery_pct': 86.0, 'pose_x': 4.0, 'distance_traveled_m': 4.0, 'distance_m': 4.0, 'battery_consumed_pct': 4.0,
    }  # fmt: skip
    rows = tracking.artifacts['trajectories/trajectory.csv'].decode().splitlines()
    assert (rows[0], len(rows)) == ('timestamp,x,y,yaw,z', 6)
    assert tracking.artifacts['camera/frame_900000.jpg'] == JPEG
    run_name = mission.id.rpartition('_')[0]
    assert {f'trajectories/thor/{run_name}.csv', 'sensor-data/thor/missions/run0/trajectory.csv',
            'sensor-data/thor/missions/run0/camera/frame_900000.jpg'} <= set(spooler.names())  # fmt: skip
    assert {item.metadata['mission_id'] for item in spooler.objects} == {mission.id}
    assert not mission.folder.node.files.exists()


def test_a_positive_stated_value_wins(tmp_path: Path) -> None:
    """If 0 is stated the measured value is shown; the summary has both."""
    for stated, stands in ((0.0, 4.0), (7.0, 7.0)):
        mission, tracking = flown(tmp_path / str(stated), stated), FakeTracking()
        assert deliver(mission.folder, tracking, FakeSpooler())
        summary = json.loads(tracking.artifacts['summary.json'])
        figures = summary['distance_m'], summary['stated']['distance_m'], summary['measured']['distance_m']
        assert figures == (stands, stated, 4.0)
        assert newest(tracking)['distance_traveled_m'] == stands


def test_the_end_waits_for_the_node(tmp_path: Path) -> None:
    """The run is ended, and the mission complete, after the node released its journal."""
    tracking, spooler = FakeTracking(), FakeSpooler()
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        node_log = join(tmp_path)
        logger.end_mission(True, 0.0, 0.0)
    assert not deliver(node_log.mission.folder, tracking, spooler)
    assert tracking.finished == []
    leave(node_log)
    assert deliver(node_log.mission.folder, tracking, spooler)
    assert [status for _, status, _ in tracking.finished] == ['FINISHED']


def test_a_hung_node_does_not_delay_the_end(tmp_path: Path) -> None:
    """After a while the run ends without it; what it logs later is sent later."""
    now = [0.0]
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        node_log = join(tmp_path)
        logger.end_mission(True, 0.0, 0.0)
    tracking = FakeTracking()
    delivery = Delivery(node_log.mission.folder, tracking, FakeSpooler(), monotonic=lambda: now[0])  # type: ignore[arg-type]
    assert not any(work(delivery) for _ in range(20))
    now[0] = NODE_CLOSE_TIMEOUT_S + 1
    assert not any(work(delivery) for _ in range(20))
    assert len(tracking.finished) == 1
    node_log.add(Reading(node_log.mission.start_ns + 1, 'late', 1.0))
    leave(node_log)
    assert any(work(delivery) for _ in range(20))
    assert newest(tracking)['late'] == 1.0


def test_the_agents_own_values_win(tmp_path: Path) -> None:
    """If both log a metric the agent's value is the newest; frames of both are kept, with separate numbers."""
    tracking, spooler = FakeTracking(), FakeSpooler()
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_robot_state(55.0, 30.0, 0)
        logger.log_camera_frame(b'\xff\xd8 of the agent \xff\xd9', 0)
        node_log = join(tmp_path)
        logger.end_mission(True, 0.0, 0.0)
        logger.flush(0.0)
        leave(node_log)
    assert deliver(node_log.mission.folder, tracking, spooler)
    assert newest(tracking)['battery_pct'] == 55.0
    frames = {item.key.rpartition('/')[2]: item.body for item in spooler.objects if item.key.endswith('.jpg')}
    assert frames == {'frame_000000.jpg': b'\xff\xd8 of the agent \xff\xd9', 'frame_900000.jpg': JPEG}
    assert tracking.artifacts['camera/frame_900000.jpg'] == JPEG
    assert json.loads(tracking.artifacts['summary.json'])['counts']['camera_frames'] == 2
    assert newest(tracking)['camera_frames'] == 2.0


def test_the_mission_of_a_killed_agent_ends_with_the_nodes_last_record(tmp_path: Path) -> None:
    """It is KILLED at the time of the node's last record."""
    logger = MissionDataLogger(home=tmp_path, replay=False, start_timeout_s=0.0)
    logger.start_mission('patrol', '')
    node_log = join(tmp_path, seconds=4, step_ns=SECOND)
    logger._mission._recorder._journal.close()  # type: ignore[union-attr]  # as a death does
    node_log.close()
    tracking = FakeTracking()
    assert deliver(node_log.mission.folder, tracking, FakeSpooler())
    assert tracking.finished == [('run0', 'KILLED', (node_log.mission.start_ns + 3 * SECOND) // 10**6)]
    logger.close()


def test_failures_change_nothing_of_the_nodes_part(tmp_path: Path) -> None:
    """Requests and responses get lost and the sender is killed in between: each point is there, and each object once."""
    for seed in range(6):
        rng = random.Random(seed)
        home = tmp_path / str(seed)
        mission = flown(home)
        tracking, spooler = FakeTracking(fail=lambda _: rng.random() < 0.3), FakeSpooler()  # noqa: B023 - called in this round
        delivery = None
        for _ in range(2000):
            if delivery is None or rng.random() < 0.2:
                delivery = Delivery(mission.folder, tracking, spooler)  # type: ignore[arg-type]
            try:
                if work(delivery):
                    break
            except TrackingError:
                continue
        assert mission.folder.sent().complete
        assert {point.value for point in tracking.points if point.key == 'pose_x'} == {0.0, 1.0, 2.0, 3.0, 4.0}
        assert len(spooler.names()) == len(set(spooler.names())) == 4
        assert newest(tracking)['distance_traveled_m'] == 4.0
