"""The agent's logger: its calls, its failures, its lifecycle, forks and closing."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import re
import threading
from pathlib import Path
from typing import Any

import pytest
from missions.fakes import journal, journalling, journals

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.missions import copies
from shadowhound_data_logger.missions.folder import MISSIONS, missions
from shadowhound_data_logger.missions.mission import Mission

JPEG = b'\xff\xd8 a picture \xff\xd9'


def test_the_guides_calls_are_journaled(tmp_path: Path) -> None:
    """Each call of the integration guide, by its own argument names, is a record when it returns."""
    csv = tmp_path / 't.csv'
    csv.write_text('timestamp,x,y,yaw\n')
    with journalling(tmp_path) as logger:
        mission_id = logger.start_mission(mission_type='patrol', mission_command='go round')
        logger.log_camera_frame(JPEG, frame_id=7)
        logger.log_robot_state(battery_pct=88, temperature_c=41.5, step=3)
        logger.log_trajectory(str(csv))
        csv.unlink()
        logger.end_mission(success=True, distance_m=12.0, duration_s=60.0)
        start, frame, state, trajectory, end = journal(tmp_path)
    assert re.fullmatch(r'patrol_\d{8}_\d{6}_[0-9a-f]{8}', mission_id)
    folder = tmp_path / MISSIONS / mission_id
    assert (start['type'], start['command'], start['robot']) == ('patrol', 'go round', 'thor')
    assert (frame['id'], (folder / 'files' / frame['file']).read_bytes()) == (7, JPEG)
    assert (state['m'], state['s']) == ({'battery_pct': 88.0, 'temperature_c': 41.5}, 3)
    assert (folder / 'files' / trajectory['file']).read_text() == 'timestamp,x,y,yaw\n'
    assert (end['status'], end['success'], end['distance_m'], end['duration_s']) == ('FINISHED', True, 12.0, 60.0)
    times = [record['t'] for record in (start, frame, state, trajectory, end)]
    assert times == sorted(times)


def test_a_failure_is_the_state_of_the_run(tmp_path: Path) -> None:
    """``success=False`` ends it as FAILED."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.end_mission(False, 0.0, 0.0)
    assert journal(tmp_path)[-1]['status'] == 'FAILED'


def test_without_a_mission_calls_warn_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The agent may call at any time; there is one warning for each kind of call."""
    with journalling(tmp_path) as logger:
        for _ in range(3):
            logger.log_camera_frame(JPEG, 0)
            logger.log_robot_state(1, 2, 3)
            logger.log_trajectory('/nowhere')
            logger.log_metric('a', 1)
            logger.log_event('a')
            logger.log_artifact('/nowhere')
            logger.end_mission(True, 1, 1)
    assert len([record for record in caplog.records if 'without an active mission' in record.message]) == 7
    assert journals(tmp_path) == []


def fail(mission: Mission) -> None:
    mission.log_metric('a', 1.5, step=2)
    raise ZeroDivisionError('oh')


def test_an_exception_ends_the_mission_and_propagates(tmp_path: Path) -> None:
    """An exception inside ``with`` is recorded, ends the mission as FAILED, and reaches the agent unchanged."""
    with journalling(tmp_path) as logger:
        with pytest.raises(ZeroDivisionError, match='oh'), logger.mission('explore', 'up') as mission:
            fail(mission)
        logger.log_metric('a', 2.5)
    *_, event, end = journal(tmp_path)
    assert (event['name'], event['data']) == ('exception', {'type': 'ZeroDivisionError', 'text': 'oh'})
    assert (end['status'], end['success'], end['error']) == ('FAILED', False, 'ZeroDivisionError: oh')


def test_a_with_block_that_ends_normally_is_a_success(tmp_path: Path) -> None:
    """Leaving ``with`` ends the mission as FINISHED, unless the agent has ended it."""
    with journalling(tmp_path) as logger:
        with logger.mission('a', ''):
            pass
        with logger.mission('b', '') as mission:
            mission.end(False, 3.0, 4.0)
    first, second = journals(tmp_path)
    assert [record['k'] for record in first] == ['start', 'end']
    assert first[-1]['status'] == 'FINISHED'
    assert [(record['k'], record.get('status')) for record in second] == [('start', None), ('end', 'FAILED')]


def test_a_second_start_ends_the_first(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It ends as KILLED with a warning, and later calls belong to the second."""
    with journalling(tmp_path) as logger:
        first = logger.start_mission('patrol', '1')
        second = logger.start_mission('patrol', '2')
        logger.log_metric('a', 1.0)
        logger.end_mission(True, 1, 1)
    assert first != second
    assert f'{first} is still active' in caplog.text
    found = {records[0]['command']: records for records in journals(tmp_path)}
    assert [record['k'] for record in found['1']] == ['start', 'end']
    assert found['1'][-1]['status'] == 'KILLED'
    assert [record['k'] for record in found['2']] == ['start', 'metrics', 'end']


class Mute(Exception):
    """An object without text."""

    def __str__(self) -> str:
        raise ZeroDivisionError

    __repr__ = __str__


@pytest.mark.parametrize(
    'value', [math.nan, math.inf, None, 'twelve', '12', [1, 2], object(), 10**400, pytest.param(10**5000, id='huge'), Mute()]
)
def test_a_value_that_is_not_a_number_is_counted(tmp_path: Path, value: Any) -> None:
    """The invalid value is skipped and counted, and the rest of the call is logged."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_robot_state(value, 40.0, 1)
        logger.log_metric('m', value)
        logger.log_robot_state(1.0, 2.0, value)
        logger.log_camera_frame(JPEG, value)
        logger.log_camera_frame(value, 1)
        logger.end_mission(True, value, value)
    kinds = [record['k'] for record in journal(tmp_path)]
    points = [record['m'] for record in journal(tmp_path) if record['k'] == 'metrics']
    assert points[0] == {'temperature_c': 40.0}
    assert kinds.count('refused') >= 4
    assert kinds[-1] == 'end'


@pytest.mark.parametrize('key', ['', 'a' * 251, '../up', 'a//b', '/a', 'a\n', 'a*', None, 3])
def test_a_bad_metric_name_is_counted(tmp_path: Path, key: Any) -> None:
    """Names that MLflow would refuse never reach it."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_metric(key, 1.0)
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'refused', 'end']


@pytest.mark.parametrize('path', ['/nowhere', '', 'a\0b', None, 3.5, '/dev/zero', '/tmp'])  # noqa: S108
def test_a_missing_file_is_counted(tmp_path: Path, path: Any) -> None:
    """No artifact, and no error in the mission."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_artifact(path)
        logger.log_trajectory(path)
        logger.log_artifact(__file__, '../outside')
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'refused', 'refused', 'refused', 'end']


@pytest.mark.parametrize(
    ('given', 'named'),
    [('night patrol', 'night_patrol'), ('../../etc', 'etc'), ('', 'mission'), ('x' * 300, 'x' * 64), ('наблюдение', 'mission'),
     (None, 'None'), ('a..b', 'a_b')],
)  # fmt: skip
def test_a_hostile_type_is_made_safe(tmp_path: Path, given: Any, named: str) -> None:
    """The mission continues: its name is the nearest valid one, and its type is unchanged."""
    with journalling(tmp_path) as logger:
        mission_id = logger.start_mission(given, 'x')
    assert re.fullmatch(re.escape(named) + r'_\d{8}_\d{6}_[0-9a-f]{8}', mission_id)
    assert (tmp_path / MISSIONS / mission_id / 'journal').is_file()
    assert journal(tmp_path)[0]['type'] == str(given)[:128]


def test_events_hold_anything_but_files(tmp_path: Path) -> None:
    """Values that JSON cannot hold become text, whatever their name; those as large as a file are refused."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_event('seen', name='a cat', self=1, where=Path('/x'), how=math.nan, what={1: {2, 3}}, deep=[[[[[[1]]]]]])
        logger.log_event('film', frames=['x' * 6000] * 200)
        logger.end_mission([1, 2], 1.0, 1.0)  # type: ignore[arg-type]
    _, event, refused, end = journal(tmp_path)
    assert event['data'] == {
        'name': 'a cat',
        'self': 1,
        'where': '/x',
        'how': 'nan',
        'what': {'1': '{2, 3}'},
        'deep': [[['[[[1]]]']]],
    }
    assert refused['reason'] == 'too_large'
    assert end['status'] == 'FINISHED'


def test_an_object_without_text_is_named_by_its_class(tmp_path: Path) -> None:
    """In an event, as a name, a command, or as the exception that ends a mission, which propagates unchanged."""

    def fly(logger: MissionDataLogger, mute: Any) -> None:
        with logger.mission('patrol', mute) as mission:
            mission.log_event('seen', what=mute, number=10**5000)
            mission.log_metric(mute, 1.0)
            raise mute

    with journalling(tmp_path) as logger, pytest.raises(Mute):
        fly(logger, Mute())
    start, event, refused, exception, end = journal(tmp_path)
    assert (start['command'], event['data'], refused['reason']) == ('<Mute>', {'what': '<Mute>', 'number': '<int>'}, 'bad_name')
    assert (exception['data']['text'], end['error'], end['status']) == ('<Mute>', 'Mute: <Mute>', 'FAILED')


def test_a_full_disk_does_not_reach_the_mission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One warning is logged, and the journal continues when there is free space again."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')

        def full(*_: object) -> int:
            raise OSError(28, 'No space left on device')

        with monkeypatch.context() as patched:
            patched.setattr(os, 'write', full)
            for number in range(3):
                logger.log_metric('a', number)
                logger.log_camera_frame(JPEG, number)
        logger.log_metric('a', 3.0)
    assert len([record for record in caplog.records if 'loses' in record.message]) == 1
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'metrics', 'end']


def test_with_little_space_only_the_journal_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames and artifacts stop before the disk is full, metrics do not."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        monkeypatch.setattr(copies, 'MIN_FREE_BYTES', 1 << 60)
        logger.log_camera_frame(JPEG, 0)
        logger.log_artifact(__file__)
        logger.log_metric('a', 1.0)
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'metrics', 'end']


def test_a_read_only_home_costs_only_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The agent gets an id and continues; the log contains that the mission is not logged."""
    (tmp_path / 'file').write_text('')
    with journalling(tmp_path / 'file') as logger:
        assert logger.start_mission('patrol', '').endswith('_unlogged')
        logger.log_metric('a', 1.0)
        logger.end_mission(True, 1, 1)
        with logger.mission('patrol', '') as mission:
            mission.log_metric('a', 1.0)
    assert 'is not logged' in caplog.text


def test_threads_share_a_logger(tmp_path: Path) -> None:
    """Calls of many threads are all there, each frame with its own content."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')

        def work(me: int) -> None:
            for number in range(50):
                logger.log_metric(f'm{me}', number, step=number)
                logger.log_camera_frame(JPEG + bytes([me, number]), me * 1000 + number)

        threads = [threading.Thread(target=work, args=(me,)) for me in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        found = journal(tmp_path)
        (folder,) = missions(tmp_path)
        for record in found:
            if record['k'] == 'frame':
                content = (folder.files / record['file']).read_bytes()
                assert content == JPEG + bytes(divmod(record['id'], 1000))
    assert sum(record['k'] == 'frame' for record in found) == 200
    for me in range(4):
        assert [record['s'] for record in found if record['k'] == 'metrics' and f'm{me}' in record['m']] == list(range(50))


def test_frames_are_sampled_for_the_run(tmp_path: Path) -> None:
    """The first frame is an artifact of the run, the others of the same moment are not."""
    with journalling(tmp_path, frame_artifact_every_s=3600.0) as logger:
        logger.start_mission('patrol', '')
        for number in range(5):
            logger.log_camera_frame(JPEG, number)
    assert [record['artifact'] for record in journal(tmp_path) if record['k'] == 'frame'] == [True, False, False, False, False]


def _in_a_fork(logger: MissionDataLogger) -> None:
    logger.log_metric('from the child', 1.0)
    logger.close()


@pytest.mark.filterwarnings('ignore:This process .* is multi-threaded')
def test_a_fork_has_no_mission(tmp_path: Path) -> None:
    """A forked child's calls do nothing, and the parent's mission continues."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        child = multiprocessing.get_context('fork').Process(target=_in_a_fork, args=(logger,))
        child.start()
        child.join(60)
        assert child.exitcode == 0
        logger.log_metric('a', 1.0)
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'metrics', 'end']


def _frame_in_a_fork(mission: Mission, path: Path) -> None:
    mission.log_camera_frame(b'of the child', 7)
    mission.log_artifact(path)


@pytest.mark.filterwarnings('ignore:This process .* is multi-threaded')
def test_a_fork_touches_no_file_of_the_mission(tmp_path: Path) -> None:
    """A child that uses the mission object writes none."""
    with journalling(tmp_path) as logger, logger.mission('patrol', '') as mission:
        files = mission.folder.files
        child = multiprocessing.get_context('fork').Process(target=_frame_in_a_fork, args=(mission, Path(__file__)))
        child.start()
        child.join(60)
        assert child.exitcode == 0
        assert list(files.iterdir()) == []
        mission.log_camera_frame(JPEG, 0)
    assert [path.read_bytes() for path in files.iterdir()] == [JPEG]


def test_calls_after_the_end_write_no_file(tmp_path: Path) -> None:
    """It would never be sent."""
    with journalling(tmp_path) as logger:
        with logger.mission('patrol', '') as mission:
            pass
        mission.close()
        mission.log_camera_frame(JPEG, 0)
        mission.log_artifact(__file__)
        assert list(mission.folder.files.iterdir()) == []


def test_closing_ends_the_mission_as_killed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A logger that is closed during a mission records that; closing twice is the same as once."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.close()
        logger.close()
    assert [record.get('status') for record in journal(tmp_path)] == [None, 'KILLED']
    assert logging.WARNING in {record.levelno for record in caplog.records}


def test_a_robot_name_is_checked_immediately(tmp_path: Path) -> None:
    """The constructor refuses a name that cannot be the first part of a key, before any mission."""
    with pytest.raises(SettingError, match='robot'):
        MissionDataLogger(robot='../thor', home=tmp_path, replay=False)


def test_an_invalid_home_is_rejected_immediately(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the node: a user without a home, for example in a container, must name the folder."""
    monkeypatch.setenv('SHADOWHOUND_HOME', '~no-such-user/x')
    with pytest.raises(SettingError, match='SHADOWHOUND_HOME'):
        MissionDataLogger(replay=False)


def test_logged_records_are_synced_within_a_quarter_of_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread syncs the frame, its folder and then the journal, soon after a call and without another one."""
    synced: list[str] = []
    done = threading.Event()
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(JPEG, 0)
        fsync = os.fsync

        def note(descriptor: int) -> None:
            file = Path(f'/proc/self/fd/{descriptor}').readlink()
            synced.append('the frame' if file.is_file() and file.read_bytes() == JPEG + b'1' else file.name)
            fsync(descriptor)
            if synced[-1] == 'journal' and 'the frame' in synced:  # the one before may be in progress as well
                done.set()

        monkeypatch.setattr(os, 'fsync', note)
        logger.log_camera_frame(JPEG + b'1', 1)
        assert done.wait(60.0)
    start = synced.index('the frame')
    assert synced[start : start + 3] == ['the frame', 'files', 'journal']


def test_a_disk_that_is_full_at_the_start_leaves_nothing_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mission continues unlogged, and the journal without a record is closed."""

    def full(*_: object) -> int:
        raise OSError(28, 'No space left on device')

    with journalling(tmp_path) as logger:
        with monkeypatch.context() as patched:
            patched.setattr(os, 'write', full)
            assert logger.start_mission('patrol', '').endswith('_unlogged')
        opened = [path.resolve() for path in Path('/proc/self/fd').iterdir()]
        assert not [path for path in opened if path.is_relative_to(tmp_path / MISSIONS)]
