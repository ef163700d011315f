"""The delivery of a mission to a server that fails at any moment: in order, effectively exactly once, and complete."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from missions.fakes import FakeSpooler, FakeTracking, journalling

from shadowhound_data_logger.core.errors import TrackingError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, missions
from shadowhound_data_logger.missions.journal import Journal, read
from shadowhound_data_logger.missions.overview import report
from shadowhound_data_logger.missions.pictures import MakePictures, no_pictures
from shadowhound_data_logger.missions.state import Point

JPEG = b'\xff\xd8 a picture \xff\xd9'


def fly(home: Path, points: int = 3, frames: int = 2, *, command: str = 'go round', end: bool = True) -> MissionFolder:
    """A mission on the disk."""
    csv = home / 't.csv'
    csv.write_text('timestamp,x,y,yaw\n1,2,3,4\n')
    with journalling(home, frame_artifact_every_s=0.0) as logger:
        mission_id = logger.start_mission('patrol', command)
        for number in range(points):
            logger.log_robot_state(90.0 - number, 40.0 + number, number)
        for number in range(frames):
            logger.log_camera_frame(JPEG + bytes([number]), number)
        logger.log_trajectory(csv)
        logger.log_artifact(csv, 'notes')
        logger.log_event('error', text='a wheel fell off')
        if end:
            logger.end_mission(True, 12.0, 60.0)
    return next(folder for folder in missions(home) if folder.mission_id == mission_id)


def work(delivery: Delivery) -> bool:
    """One round; returns whether everything is sent."""
    worked = [delivery.track(), delivery.attach(), delivery.spool()]
    return delivery.complete() or not any(worked)


def deliver(
    folder: MissionFolder, tracking: FakeTracking, spooler: FakeSpooler, pictures: MakePictures = no_pictures
) -> Delivery:
    delivery = Delivery(folder, tracking, spooler, pictures)  # type: ignore[arg-type]
    for _ in range(1000):
        if work(delivery) and (delivery.sent.complete or not delivery.sent.ended):
            break
    return delivery


def names(tracking: FakeTracking) -> list[str]:
    return sorted(tracking.artifacts)


def test_everything_arrives_in_order(tmp_path: Path) -> None:
    """Params, points with their times, artifacts, objects and the end."""
    folder = fly(tmp_path)
    journal = [line.record or {} for line in read(folder.journal)]
    tracking, spooler = FakeTracking(), FakeSpooler()
    deliver(folder, tracking, spooler)
    states = [point for point in tracking.points if point.key == 'battery_pct']
    assert states == [Point('battery_pct', 90.0 - n, journal[n + 1]['t'] // 1_000_000, n) for n in range(3)]
    assert tracking.params == {'mission_type': 'patrol', 'mission_command': 'go round', 'robot': 'thor',
                               'timestamp': tracking.params['timestamp'], 'duration_s': '60.000'}  # fmt: skip
    assert tracking.finished == [('run0', 'FINISHED', journal[-1]['t'] // 1_000_000)]
    last = {point.key: point.value for point in tracking.points}
    assert {key: last[key] for key in ('success', 'distance_m', 'distance_traveled_m', 'duration_s', 'battery_consumed_pct')} == {
        'success': 1.0, 'distance_m': 12.0, 'distance_traveled_m': 12.0, 'duration_s': 60.0, 'battery_consumed_pct': 2.0,
    }  # fmt: skip
    assert (last['camera_frame_0'], last['camera_frame_1'], last['camera_frames']) == (1.0, 1.0, 2.0)
    frames = ['camera/frame_000000.jpg', 'camera/frame_000001.jpg']
    assert names(tracking) == [*frames, 'events.jsonl', 'notes/t.csv', 'summary.json', 'trajectories/trajectory.csv']
    run_name = folder.mission_id.rpartition('_')[0]
    assert spooler.names() == [
        'sensor-data/thor/missions/run0/camera/frame_000000.jpg', 'sensor-data/thor/missions/run0/camera/frame_000001.jpg',
        'sensor-data/thor/missions/run0/trajectory.csv', f'trajectories/thor/{run_name}.csv',
        'sensor-data/thor/missions/run0/summary.json',
    ]  # fmt: skip
    assert [item.protected for item in spooler.objects] == [False, False, True, True, True]
    assert not folder.files.exists()


def test_the_summary_describes_the_mission(tmp_path: Path) -> None:
    """Its times, result, errors, counts and the location of its data; the same in the run and in the store."""
    folder = fly(tmp_path)
    tracking, spooler = FakeTracking(), FakeSpooler()
    deliver(folder, tracking, spooler)
    assert tracking.artifacts['summary.json'] == spooler.objects[-1].body
    summary = json.loads(tracking.artifacts['summary.json'])
    assert (summary['mission_id'], summary['run_id'], summary['result']) == (folder.mission_id, 'run0', 'FINISHED')
    assert summary['errors'][0]['text'] == 'a wheel fell off'
    assert summary['counts'] == {
        'metric_points': 6, 'camera_frames': 2, 'trajectories': 1, 'artifacts': 1, 'events': 1,
    }  # fmt: skip
    assert summary['ledger'] == {
        'metric_points': {'logged': 6, 'in_run': 6, 'refused_by_server': 0},
        'files': {'logged': 3, 'spooled': 3, 'missing': 0}, 'not_logged': {'disk_full': 0}, 'damaged_records': 0,
    }  # fmt: skip
    assert summary['stated'] == {'success': True, 'distance_m': 12.0, 'duration_s': 60.0}
    assert summary['data']['mission'] == 'sensor-data/thor/missions/run0/'
    assert summary['start'] < summary['end']


def test_a_long_command_is_complete_as_an_artifact(tmp_path: Path) -> None:
    """The param is cut where MLflow would cut it."""
    tracking = FakeTracking()
    deliver(fly(tmp_path, command='x' * 7000), tracking, FakeSpooler())
    assert tracking.params['mission_command'] == 'x' * 6000
    assert tracking.artifacts['mission_command.txt'] == b'x' * 7000


def test_batches_are_large_and_never_too_large(tmp_path: Path) -> None:
    """A backlog is sent in batches of nearly a thousand points, but not more."""
    tracking = FakeTracking()
    deliver(fly(tmp_path, points=3000), tracking, FakeSpooler())
    assert max(tracking.batches) <= 1000
    assert len(tracking.batches) <= 10
    assert len([point for point in tracking.points if point.key == 'battery_pct']) == 3000


SOME = 4
MORE = (pytest.param(seed, marks=pytest.mark.long('more of the same')) for seed in range(SOME, 12))


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('seed', [*range(SOME), *MORE])
def test_any_failure_changes_nothing(tmp_path: Path, seed: int) -> None:
    """Requests and responses get lost, the replayer is killed: at the end all has arrived, effectively exactly once."""
    rng = random.Random(seed)
    folder = fly(tmp_path, points=1200, frames=9)
    tracking = FakeTracking(fail=lambda _: rng.random() < 0.3)
    spooler, delivery = FakeSpooler(), None
    for _ in range(2000):
        if delivery is None or rng.random() < 0.2:
            delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]  # as after a kill
        try:
            if delivery.run is None and rng.random() < 0.5:
                delivery.spool(hold=True)
            if work(delivery):
                break
        except TrackingError:
            continue
    assert folder.sent().complete
    assert len(tracking.runs) == 1
    quiet = FakeTracking()
    (tmp_path / 'other').mkdir()
    deliver(fly(tmp_path / 'other', points=1200, frames=9), quiet, FakeSpooler())
    assert sorted({(p.key, p.step, p.value) for p in tracking.points}) == sorted({(p.key, p.step, p.value) for p in quiet.points})
    assert names(tracking) == names(quiet)
    assert len(spooler.names()) == len(set(spooler.names())) == 9 + 3
    assert tracking.finished[-1][1] == 'FINISHED'


def test_the_run_is_looked_up_after_a_lost_answer(tmp_path: Path) -> None:
    """A run that was created although the response got lost is used, and no second one is created."""
    folder, answers = fly(tmp_path), iter([False, True])
    tracking = FakeTracking(fail=lambda _: next(answers, False))
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    with pytest.raises(TrackingUnavailable):
        delivery.track()
    while not work(delivery):
        pass
    assert list(tracking.runs) == [folder.mission_id]


def test_refused_records_are_skipped_and_counted(tmp_path: Path) -> None:
    """One bad point does not keep the others of its batch."""
    folder = fly(tmp_path, points=50)
    tracking = FakeTracking(refuses=lambda point: point.key == 'battery_pct' and point.step == 33)
    deliver(folder, tracking, FakeSpooler())
    assert sorted(point.step for point in tracking.points if point.key == 'battery_pct') == [n for n in range(50) if n != 33]
    assert (folder.sent().refused, folder.sent().complete) == (1, True)
    assert tracking.params['duration_s'] == '60.000'


def test_a_deleted_run_is_not_created_again(tmp_path: Path) -> None:
    """The user who deletes a run does not want it: the mission stops, and reports why."""
    tracking = FakeTracking(gone=True)
    delivery = Delivery(fly(tmp_path), tracking, FakeSpooler())  # type: ignore[arg-type]
    with pytest.raises(TrackingRefused):
        delivery.track()
    assert tracking.points == []


def test_artifacts_that_fail_delay_no_metric(tmp_path: Path) -> None:
    """The run is complete and ended while its artifacts wait, and the mission is not complete."""
    folder = fly(tmp_path)
    tracking = FakeTracking(fail=lambda name: name == 'artifact')
    spooler = FakeSpooler()
    delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]
    while delivery.track():
        pass
    with pytest.raises(TrackingUnavailable):
        delivery.attach()
    while delivery.spool():
        pass
    assert tracking.finished
    assert len(spooler.objects) == 5
    assert not delivery.complete()
    tracking.fail = lambda _: False
    while not work(delivery):
        pass
    assert 'summary.json' in tracking.artifacts


def abandon(home: Path) -> MissionFolder:
    """A mission with an agent that is killed while it writes a record."""
    folder = fly(home, points=5)
    lines = folder.journal.read_bytes().splitlines(keepends=True)
    folder.journal.write_bytes(b''.join(lines[:-1]) + b'0000 {"torn')
    return folder


def test_a_mission_of_a_dead_agent_ends_as_killed(tmp_path: Path) -> None:
    """It ends at its last record, with its last known state, and the torn record is removed."""
    folder = abandon(tmp_path)
    last_ns = [line.record['t'] for line in read(folder.journal) if line.record][-1]
    tracking, spooler = FakeTracking(), FakeSpooler()
    deliver(folder, tracking, spooler)
    assert tracking.finished == [('run0', 'KILLED', last_ns // 1_000_000)]
    last = {point.key: point.value for point in tracking.points}
    assert (last['success'], last['battery_consumed_pct'], last['distance_traveled_m']) == (0.0, 4.0, 0.0)
    summary = json.loads(tracking.artifacts['summary.json'])
    assert (summary['result'], summary['ended_by'], summary['last']['battery_pct']) == ('KILLED', 'replayer', 86.0)
    assert b'torn' not in folder.journal.read_bytes()


def test_a_mission_of_a_running_agent_continues(tmp_path: Path) -> None:
    """The existing records are sent; only the agent writes the end."""
    folder = abandon(tmp_path)
    content = folder.journal.read_bytes().rpartition(b'\n')[0] + b'\n'
    folder.journal.unlink()
    journal = Journal(folder.journal)
    journal.create()
    with folder.journal.open('ab') as file:
        file.write(content)
    tracking = FakeTracking()
    delivery = deliver(folder, tracking, FakeSpooler())
    assert not delivery.complete()
    assert tracking.finished == []
    journal.append({'k': 'end', 't': 10**18, 'status': 'FINISHED', 'success': True, 'distance_m': 1.0, 'duration_s': 2.0})
    journal.close()
    while not work(delivery):
        pass
    assert tracking.finished == [('run0', 'FINISHED', 10**12)]


def test_a_measured_distance_replaces_a_stated_zero(tmp_path: Path) -> None:
    """The agent's failure path states zeros; its positive numbers win."""
    for stated, expected in ((0.0, 7.5), (9.0, 9.0)):
        home = tmp_path / str(stated)
        with journalling(home) as logger:
            logger.start_mission('patrol', '')
            logger.log_metric('distance_traveled_m', 7.5, step=4)
            logger.end_mission(False, stated, 0.0)
        tracking = FakeTracking()
        deliver(next(missions(home)), tracking, FakeSpooler())
        distance = max((point for point in tracking.points if point.key == 'distance_traveled_m'), key=lambda point: point.step)
        assert distance.value == expected
        summary = json.loads(tracking.artifacts['summary.json'])
        assert (summary['distance_m'], summary['stated']['distance_m'], summary['measured']['distance_m']) == (
            expected,
            stated,
            7.5,
        )
        assert summary['duration_s'] > 0


def test_a_missing_frame_is_counted(tmp_path: Path) -> None:
    """In the report, in the summary's ledger, and nowhere as an object; existing frames arrive."""
    folder = fly(tmp_path, frames=3)
    [gone] = (file for file in folder.files.iterdir() if file.read_bytes() == JPEG + bytes([1]))
    gone.unlink()
    tracking, spooler = FakeTracking(), FakeSpooler()
    deliver(folder, tracking, spooler)
    assert report(folder).missing == 1
    assert json.loads(tracking.artifacts['summary.json'])['ledger']['files'] == {'logged': 4, 'spooled': 3, 'missing': 1}
    assert folder.sent().unattached == 1
    assert [key for key in spooler.names() if 'frame' in key] == [
        f'sensor-data/thor/missions/run0/camera/frame_{number:06d}.jpg' for number in (0, 2)
    ]


def test_frames_do_not_wait_for_a_run(tmp_path: Path) -> None:
    """While Tower is unreachable, the spool holds them outside the mission's folder; with the run they get their keys."""
    folder = fly(tmp_path)
    tracking, spooler = FakeTracking(fail=lambda name: name == 'run_of'), FakeSpooler()
    delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]
    with pytest.raises(TrackingUnavailable):
        delivery.track()
    while delivery.spool(hold=True):
        pass
    assert {item.held for item in spooler.objects} == {f'mission-{folder.mission_id}'}
    assert len(spooler.objects) == 4
    tracking.fail = lambda _: False
    deliver(folder, tracking, spooler)
    assert not any(item.held for item in spooler.objects)
    assert len(spooler.objects) == len(set(spooler.names())) == 5
    assert all('/missions/run0/' in key or key.startswith('trajectories/') for key in spooler.names())
