"""The report of an incomplete mission: what it waits for, and the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from missions.fakes import FakeSpooler, FakeTracking, journalling

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, missions, write_json
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.overview import LOCK, STATE, Report, report


@pytest.fixture
def folder(tmp_path: Path) -> MissionFolder:
    """A mission that has ended, with a frame, a point and an artifact."""
    with journalling(tmp_path, frame_artifact_every_s=0.0) as logger:
        logger.start_mission('patrol', '')
        logger.log_metric('a', 1.0)
        logger.log_camera_frame(b'\xff\xd8 a picture', 0)
        logger.log_artifact(__file__)
    return next(missions(tmp_path))


@pytest.fixture
def sender(folder: MissionFolder) -> Iterator[None]:
    """As if a process sent missions."""
    with flock(folder.path.parent / LOCK):
        yield


def new(folder: MissionFolder, **options: object) -> Delivery:
    return Delivery(folder, FakeTracking(), FakeSpooler(), **options)  # type: ignore[arg-type]


def incomplete_report(folder: MissionFolder) -> Report:
    found = report(folder)
    assert not found.complete
    assert found.waiting_for in repr(found)
    return found


def test_a_mission_that_no_process_sends_is_named(folder: MissionFolder) -> None:
    """The command that sends it is named."""
    found = incomplete_report(folder)
    assert found.waiting_for == 'a sender'
    assert 'missions resume' in found.remedy


@pytest.mark.usefixtures('sender')
def test_a_mission_of_which_nothing_was_sent_is_named(folder: MissionFolder) -> None:
    """Records, artifacts and objects are counted."""
    waiting_for = incomplete_report(folder).waiting_for
    assert waiting_for == '5 records to be in its run, 2 artifacts to be in its run, 1 objects to be in the spool'


@pytest.mark.usefixtures('sender')
def test_a_mission_waits_while_its_plots_are_drawn(folder: MissionFolder) -> None:
    """Even if every record is in the run and there is no error."""
    delivery = new(folder, make_pictures=lambda *_: None)
    for _ in range(10):
        delivery.track()
        delivery.attach()
        delivery.spool()
    found = incomplete_report(folder)
    assert (found.unsent, found.last_error) == (0, '')
    assert found.waiting_for == 'its pictures and its summary, which are being created'
    assert 'wait longer' in found.remedy


@pytest.mark.usefixtures('sender')
def test_a_mission_waits_for_its_node(folder: MissionFolder) -> None:
    """Its journal is still being written."""
    folder.node.path.mkdir()
    with ExitStack() as stack:
        node = Journal(folder.node.journal)
        node.create()
        stack.callback(node.close)
        found = incomplete_report(folder)
    assert 'the node' in found.waiting_for
    assert 'check that the node runs' in found.remedy


@pytest.mark.usefixtures('sender')
def test_the_error_that_delays_a_mission_is_shown(folder: MissionFolder) -> None:
    """The error of the server that the sender reports precedes earlier refusals."""
    folder.set_sent(folder.sent().__class__(error='an artifact was refused', unattached=1))
    write_json(
        folder.path.parent / STATE, {'pid': 1, 'errors': {'tracking': {'error': 'Tower is away', 'remedy': 'switch it on'}}}
    )
    found = incomplete_report(folder)
    assert (found.last_error, found.remedy, found.unattached) == ('Tower is away', 'switch it on', 1)
    assert found.waiting_for


def test_an_active_mission_waits_for_its_end(tmp_path: Path) -> None:
    """For a ``flush`` during the mission."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        found = logger.flush(0.0)
        logger.end_mission(True, 1.0, 1.0)
    assert (found.complete, found.waiting_for, found.remedy) == (False, 'its end: the mission is active', '')


def test_a_complete_mission_waits_for_nothing(folder: MissionFolder) -> None:
    """Even with a refused record, which is counted by reason."""
    tracking = FakeTracking(refuses=lambda point: point.key == 'a')
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    while not delivery.complete():
        for work in (delivery.track, delivery.attach, delivery.spool):
            work()
    found = report(folder)
    assert (found.complete, found.waiting_for, found.remedy, found.refused, found.last_error) == (True, '', '', 1, 'no')


def test_a_missing_journal_is_reported(folder: MissionFolder) -> None:
    """The report names it, and nothing is raised."""
    folder.journal.unlink()
    assert 'missing' in incomplete_report(folder).waiting_for
