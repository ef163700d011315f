"""A commit that hangs in the disk: what waits is still told, and the end is reached all the same."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from spool.making import make, put

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool import spool as spool_module
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.spool import Spool


@pytest.fixture
def hanging(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> Iterator[Spool]:
    """One object waits, and the sync of a second one does not return before the test is over."""
    put(spool, make('thor/first.jpg'))
    entered, let_go = threading.Event(), threading.Event()

    def sync(_: Tree) -> None:
        entered.set()
        assert let_go.wait(60)

    monkeypatch.setattr(Tree, 'sync_incoming', sync)
    thread = threading.Thread(target=put, args=(spool, make('thor/second.jpg')))
    thread.start()
    assert entered.wait(60)
    yield spool
    let_go.set()
    thread.join(60)


def test_pending_objects_are_listed_while_a_commit_hangs(hanging: Spool) -> None:
    """The line in the log that says so must not hang, too."""
    assert hanging.pending_count() == 1


def test_closing_does_not_wait_for_a_commit_that_hangs(hanging: Spool, monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    """It says which disk it is, and can be repeated when that answers."""
    monkeypatch.setattr(spool_module, 'CLOSE_S', 0.01)
    with pytest.raises(SpoolError, match=f'{root} cannot be closed: its disk does not answer'):
        hanging.close()
