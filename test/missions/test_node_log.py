"""The node's journal of a mission: in order, within the mission's time, and continued after a restart."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from missions.fakes import journalling

from shadowhound_data_logger.missions import copies, journal
from shadowhound_data_logger.missions.active import ActiveMission, MissionFinder
from shadowhound_data_logger.missions.node_log import FIRST_FRAME, MAX_FLOOR_POINTS, Cloud, FloorPlan, Frame, NodeLog, Reading
from shadowhound_data_logger.missions.odometer import Pose

SECOND = 10**9
JPEG = b'\xff\xd8 picture \xff\xd9'


@pytest.fixture
def mission(tmp_path: Path) -> Iterator[ActiveMission]:
    """An active mission."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        found = MissionFinder(tmp_path, 'thor').active()
        assert found
        yield found


def opened(mission: ActiveMission) -> NodeLog:
    made = NodeLog(mission, SECOND, 5.0)
    made.open()
    return made


def records(mission: ActiveMission) -> list[dict[str, Any]]:
    return [dict(line.record or {}) for line in journal.read(mission.folder.node.journal)]


def walk(mission: ActiveMission, seconds: range) -> list[Pose]:
    """One meter per second."""
    return [Pose(mission.start_ns + second * SECOND, float(second), 0.0, 0.5) for second in seconds]


def distances(mission: ActiveMission) -> list[float]:
    return [record['m']['distance_traveled_m'] for record in records(mission) if 'distance_traveled_m' in record.get('m', {})]


def test_poses_of_several_threads_are_sorted(mission: ActiveMission) -> None:
    """Whichever encoder is faster: no distance is counted twice and none is lost."""
    node_log, poses = opened(mission), walk(mission, range(60))
    rng = random.Random(1)
    for start in range(0, 60, 2):
        for pose in rng.sample(poses[start : start + 2], 2):
            node_log.add(pose)
        node_log.write()
    node_log.close()
    assert distances(mission)[-1] == pytest.approx(59.0)
    written = [pose for record in records(mission) for pose in record.get('p', ())]
    assert written == [[pose.stamp_ns, pose.x, pose.y, pose.yaw, pose.z] for pose in poses]


def test_readings_outside_the_mission_are_skipped(mission: ActiveMission) -> None:
    """Before the start, and at the end after the end."""
    node_log = opened(mission)
    for second in (-1, 1, 9):
        node_log.add(Reading(mission.start_ns + second * SECOND, 'battery_pct', float(second)))
    node_log.close(ActiveMission(mission.folder, 'patrol', mission.start_ns, mission.start_ns + 5 * SECOND))
    assert [(record['m'], record['s']) for record in records(mission)] == [({'battery_pct': 1.0}, 1)]


def test_a_second_node_continues_where_the_first_was_killed(mission: ActiveMission) -> None:
    """Distance and frames continue, and a torn record is the only loss."""
    first = opened(mission)
    for fact in (*walk(mission, range(5)), Frame(mission.start_ns, JPEG)):
        first.add(fact)
    first.close()
    with mission.folder.node.journal.open('ab') as file:
        file.write(b'deadbeef {"k":"metr')
    second = opened(mission)
    for fact in (*walk(mission, range(10, 13)), Frame(mission.start_ns + SECOND, JPEG)):
        second.add(fact)
    second.close()
    assert distances(mission)[-1] == pytest.approx(4.0 + 2.0)
    frames = [record for record in records(mission) if record.get('k') == 'frame']
    found = [(frame['id'] - FIRST_FRAME, (mission.folder.node.files / frame['file']).read_bytes()) for frame in frames]
    assert found == [(0, JPEG), (1, JPEG)]
    assert records(mission).count({}) == 1


def test_two_nodes_do_not_write_one_journal(mission: ActiveMission) -> None:
    """The second is refused while the first has it."""
    first = opened(mission)
    with pytest.raises(BlockingIOError):
        NodeLog(mission, SECOND, 5.0).open()
    first.close()
    opened(mission).close()


def test_the_floor_plan_is_what_the_lidar_saw(mission: ActiveMission) -> None:
    """Neither ground nor ceiling nor points of another frame, and a node that starts later adds to it."""
    cloud = np.array([[1, 2, 0.5], [3, 4, 0.0], [5, 6, 2.0], [np.nan, 1, 1]], np.float32)
    for second in range(2):
        node_log, at_ns = opened(mission), mission.start_ns + second * SECOND
        node_log.add(Pose(at_ns, 0.0, 0.0, 0.0, frame_id='odom'))
        node_log.add(Cloud(at_ns, 'odom', cloud + second))
        node_log.add(Cloud(at_ns, 'radar', cloud + 7))
        node_log.close()
    assert np.load(mission.folder.floor).tolist() == [[1, 2], [4, 5]]


@pytest.mark.long('a second of CPU or more')
def test_the_floor_plan_stays_small() -> None:
    """However long the mission is; the remaining points are from all of it."""
    floor, rng = FloorPlan(), np.random.default_rng(1)
    for second in range(500):
        floor.add(np.column_stack([np.full(20_000, second), rng.random(20_000), np.ones(20_000)]).astype(np.float32))
    kept = np.concatenate(floor._parts)
    assert len(kept) <= MAX_FLOOR_POINTS
    assert set(kept[:, 0].tolist()) == set(map(float, range(500)))


def test_a_full_disk_costs_a_warning(
    mission: ActiveMission, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is logged once, and nothing is raised."""

    def full(*_: object) -> None:
        raise OSError('no space')

    node_log = opened(mission)
    monkeypatch.setattr(journal.Journal, 'append', full)
    for second in range(2):
        node_log.add(Reading(mission.start_ns + second, 'battery_pct', 1.0))
        node_log.write()
    node_log.close()
    assert caplog.text.count('no space') == 1


def test_with_little_space_only_frames_are_skipped(mission: ActiveMission, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records after a lost frame in the same second are still journaled."""
    node_log = opened(mission)
    monkeypatch.setattr(copies, 'MIN_FREE_BYTES', 1 << 60)
    node_log.add(Frame(mission.start_ns + SECOND, JPEG))
    node_log.add(Reading(mission.start_ns + 2 * SECOND, 'battery_pct', 90.0))
    node_log.write()
    node_log.close()
    assert [record['k'] for record in records(mission)] == ['metrics']
