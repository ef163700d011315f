"""The active mission, found by its folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from missions.fakes import journalling
from missions.server import until

from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.active import MissionFinder, ended
from shadowhound_data_logger.missions.folder import new_folder


def test_a_mission_is_active_from_start_to_end(tmp_path: Path) -> None:
    """It is found by its journal's lock; the time of its end is the one that the agent recorded."""
    finder = MissionFinder(tmp_path, 'thor')
    assert finder.active() is None
    with journalling(tmp_path) as logger:
        mission_id = logger.start_mission('patrol', 'go')
        found = finder.active()
        assert found is not None
        assert (found.id, found.mission_type, found.has(found.start_ns), found.has(found.start_ns - 1)) == (
            mission_id, 'patrol', True, False,
        )  # fmt: skip
        logger.end_mission(True, 1.0, 1.0)
        until(lambda: finder.active() is None, 'the end of the mission')  # another thread releases the journal
    over = ended(found)
    assert over.end_ns == (journal.last(found.folder.journal))['t']
    assert over.has(over.end_ns or 0)
    assert not over.has((over.end_ns or 0) + 1)


def test_only_missions_of_the_same_robot_are_found(tmp_path: Path) -> None:
    """Several robots may share a home."""
    with journalling(tmp_path, robot='tachi') as logger:
        logger.start_mission('patrol', 'go')
        assert MissionFinder(tmp_path, 'thor').active() is None
        assert MissionFinder(tmp_path, 'tachi').active() is not None


def test_the_newest_of_several_is_active(tmp_path: Path) -> None:
    """When it ends, the previous one is active again."""
    finder = MissionFinder(tmp_path, 'thor')
    with journalling(tmp_path) as first:
        older = first.start_mission('z', '')
        with journalling(tmp_path) as second:
            newer = second.start_mission('a', '')
            found = finder.active()
            assert (found and found.id) == newer
        found = finder.active()
        assert (found and found.id) == older


def test_a_mission_that_is_being_created_is_not_over(tmp_path: Path) -> None:
    """Until the folder has a locked journal with a first record, it is checked again."""
    finder = MissionFinder(tmp_path, 'thor')
    folder = new_folder(tmp_path, 'patrol', 1)
    assert finder.active() is None
    writer = journal.Journal(folder.journal)
    writer.create()
    assert finder.active() is None
    writer.append({'k': 'start', 't': 1, 'type': 'patrol', 'command': '', 'robot': 'thor'})
    found = finder.active()
    assert (found and found.id) == folder.mission_id
    writer.close()
    assert finder.active() is None


def test_an_ended_mission_costs_one_stat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Old missions are not opened again."""
    for _ in range(3):
        with journalling(tmp_path) as logger:
            logger.start_mission('patrol', '')
    finder = MissionFinder(tmp_path, 'thor')
    finder.active()
    finder.active()
    monkeypatch.setattr(os, 'open', lambda *_: pytest.fail('a file was opened'))
    monkeypatch.setattr(os, 'scandir', lambda *_: pytest.fail('the folder was listed'))
    assert finder.active() is None
