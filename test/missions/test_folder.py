"""Missions of a robot that starts in 1970 and gets the time later, or never: all their records have the same, correct date."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from clocks import NOON_NS, Clocks
from missions.fakes import FakePictures, FakeSpooler, FakeTracking, journalling

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.clock_watch import UtcOffsets
from shadowhound_data_logger.missions.active import ActiveMission, MissionFinder, ended
from shadowhound_data_logger.missions.folder import MissionFolder, missions
from shadowhound_data_logger.missions.node_log import NodeLog
from shadowhound_data_logger.missions.odometer import Pose
from shadowhound_data_logger.missions.overview import NO_DATE, overview, report
from shadowhound_data_logger.missions.replay import Replay

MS = 1_000_000
NAME = 'patrol_20251018_115950'
"""The start of a run ten seconds before noon."""


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    """The clocks of this machine."""
    found = Clocks()
    monkeypatch.setattr(SystemClock, 'of_this_machine', lambda: found)
    return found


def fly(home: Path, clocks: Clocks, *, is_set_meanwhile: bool = False) -> MissionFolder:
    """Ten seconds with a point in the middle; the clock may be set right after that."""
    csv = home / 't.csv'
    csv.write_text('timestamp,x,y,yaw\n')
    with journalling(home) as logger:
        logger.start_mission('patrol', '')
        clocks.wait(5)
        logger.log_metric('a', 1.0)
        if is_set_meanwhile:
            clocks.set(NOON_NS - 5 * SECOND)
        logger.log_trajectory(csv)
        clocks.wait(5)
        logger.end_mission(True, 1.0, 0.0)
    return next(missions(home))


@pytest.mark.parametrize('step_s', [-3600, 3600])
def test_a_mission_keeps_its_duration(tmp_path: Path, clocks: Clocks, step_s: int) -> None:
    """A clock that is set back or forward during a mission changes its end time, but not its duration."""
    clocks.set(NOON_NS)
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        clocks.wait(10)
        clocks.set(NOON_NS + step_s * SECOND)
        logger.end_mission(True, 1.0, 0.0)
    found = overview(next(missions(tmp_path)))
    assert found is not None
    assert found.duration_s == 10.0


def sender(home: Path, clocks: Clocks, tracking: FakeTracking, spooler: FakeSpooler, **offsets: int) -> Replay:
    recorded = UtcOffsets(clocks, 600.0, lambda: {name.replace('_', '-'): offset for name, offset in offsets.items()})
    return Replay(
        home, tracking, spooler, FakePictures(), settle=lambda folder: folder.assign_date(recorded), rng=random.Random(1)
    )  # type: ignore[arg-type]


def check(tracking: FakeTracking, spooler: FakeSpooler, folder: MissionFolder) -> None:
    """Everything has the expected date."""
    noon_ms = NOON_NS // MS
    assert tracking.names[folder.mission_id] == f'{NAME} {noon_ms - 10_000}'
    assert tracking.params['timestamp'] == '2025-10-18T11:59:50+00:00'
    assert [point.time_ms for point in tracking.points if point.key == 'a'] == [noon_ms - 5000]
    assert tracking.finished == [('run0', 'FINISHED', noon_ms)]
    assert tracking.params['duration_s'] == '10.000'
    assert f'trajectories/thor/{NAME}.csv' in spooler.names()
    assert all(NOON_NS - 10 * SECOND <= item.t_start_ns <= NOON_NS for item in spooler.objects)


def test_a_mission_waits_for_its_date(tmp_path: Path, clocks: Clocks) -> None:
    """Nothing is sent while the clock is in 1970, and the report states this; then run, points and keys have the correct time."""
    folder, tracking, spooler = fly(tmp_path, clocks), FakeTracking(), FakeSpooler()
    replay = sender(tmp_path, clocks, tracking, spooler)
    assert not replay.step()
    assert replay.has_unsent
    assert (tracking.runs, report(folder).last_error) == ({}, NO_DATE)
    clocks.set(NOON_NS)
    while replay.step():
        pass
    check(tracking, spooler, folder)
    assert not replay.has_unsent
    found = overview(folder)
    assert found
    assert (found.started, found.last_error) == ('2025-10-18T11:59:50.000000Z', '')


def test_a_mission_is_dated_when_the_clock_is_set_during_it(tmp_path: Path, clocks: Clocks) -> None:
    """Records from before and after the setting have consistent times, and the duration is correct."""
    folder, tracking, spooler = fly(tmp_path, clocks, is_set_meanwhile=True), FakeTracking(), FakeSpooler()
    replay = sender(tmp_path, clocks, tracking, spooler)
    while replay.step():
        pass
    check(tracking, spooler, folder)


def test_a_date_is_given_once(tmp_path: Path, clocks: Clocks) -> None:
    """A clock that is corrected later changes no time of a mission that is partially sent: no point is sent twice."""
    fly(tmp_path, clocks)
    clocks.set(NOON_NS)
    away = FakeTracking(fail=lambda name: name == 'finish')
    sender(tmp_path, clocks, away, FakeSpooler()).step()
    clocks.set(NOON_NS + SECOND)
    tracking, spooler = FakeTracking(), FakeSpooler()
    replay = sender(tmp_path, clocks, tracking, spooler)
    while replay.step():
        pass
    assert tracking.finished == [('run0', 'FINISHED', NOON_NS // MS)]


def test_a_mission_of_an_earlier_boot_is_dated_by_its_offset(tmp_path: Path, clocks: Clocks) -> None:
    """If the node recorded the clock of that boot, it dates the mission; otherwise the mission is sent undated."""
    folder = fly(tmp_path, clocks)
    later = Clocks(boot_id='later')
    later.set(NOON_NS + 3600 * SECOND)
    tracking, spooler = FakeTracking(), FakeSpooler()
    replay = sender(tmp_path, later, tracking, spooler, this_boot=NOON_NS - clocks.up_ns)
    while replay.step():
        pass
    check(tracking, spooler, folder)
    (tmp_path / 'other').mkdir()
    fly(tmp_path / 'other', Clocks())
    unknown = FakeTracking()
    replay = sender(tmp_path / 'other', later, unknown, FakeSpooler())
    while replay.step():
        pass
    assert unknown.params['timestamp'].startswith('1970-01-01T00:01')


def test_a_mission_is_sent_without_a_date_when_the_clock_is_never_set(tmp_path: Path, clocks: Clocks) -> None:
    """After ``clock.hold_s`` the mission is sent with its recorded times."""
    fly(tmp_path, clocks)
    tracking = FakeTracking()
    replay = sender(tmp_path, clocks, tracking, FakeSpooler())
    assert not replay.step()
    clocks.wait(601)
    while replay.step():
        pass
    assert tracking.params['timestamp'].startswith('1970-01-01T00:01')
    assert tracking.finished


def test_the_nodes_journal_is_dated_as_well(tmp_path: Path, clocks: Clocks) -> None:
    """Poses from before and after the clock was set are one path, and steps are seconds since the start throughout."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        found = MissionFinder(tmp_path, 'thor').active()
        assert found
        mission = ActiveMission(found.folder, found.mission_type, found.start_ns, clock=clocks)
        node_log = NodeLog(mission, SECOND, 5.0)
        node_log.open()
        for second in range(4):
            if second == 2:
                clocks.set(NOON_NS - 8 * SECOND)
            stamp_ns = clocks.wall_ns() if second >= 2 else clocks.boot_ns()
            assert mission.has(stamp_ns)
            node_log.add(Pose(stamp_ns, float(second), 0.0, 0.0))
            clocks.wait(1)
        node_log.write()
        logger.end_mission(True, 0.0, 0.0)
        logger.flush(0.0)
        node_log.close(ended(mission))
    tracking, spooler = FakeTracking(), FakeSpooler()
    replay = sender(tmp_path, clocks, tracking, spooler)
    while replay.step():
        pass
    points = [(point.time_ms, point.step, point.value) for point in tracking.points if point.key == 'pose_x']
    first_ms = NOON_NS // MS - 10_000
    assert points == [(first_ms + 1000 * second, second, float(second)) for second in range(4)]
    rows = tracking.artifacts['trajectories/trajectory.csv'].decode().splitlines()[1:]
    assert [row.split('.')[0] for row in rows] == [str(NOON_NS // SECOND - 10 + second) for second in range(4)]
