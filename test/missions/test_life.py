"""The lifecycle of a logger: its thread and files, forks, and closing."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
from pathlib import Path

import pytest
from missions.fakes import journal, journalling

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.missions.folder import MISSIONS
from shadowhound_data_logger.missions.mission import Mission

JPEG = b'\xff\xd8 a picture \xff\xd9'


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
    """A child that has the mission itself in hand writes none."""
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
    """A logger that is closed in a mission says so; closing twice is the same as once."""
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
    """As the node refuses it: a user without a home, in a container say, has to name the folder."""
    monkeypatch.setenv('SHADOWHOUND_HOME', '~no-such-user/x')
    with pytest.raises(SettingError, match='SHADOWHOUND_HOME'):
        MissionDataLogger(replay=False)


def test_what_was_logged_reaches_the_disk_within_a_quarter_of_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
            if synced[-1] == 'journal' and 'the frame' in synced:  # the one before may be on its way as well
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
