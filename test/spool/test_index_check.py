"""A large index is checked while it is in use: startup does not wait, and a damaged index is rebuilt at the next start."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import closing
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import damage_old_rows, fill, index_of, make, put

from shadowhound_data_logger.spool import recovery
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.index_check import IndexCheck


@pytest.fixture
def large(request: pytest.FixtureRequest, used: dict[str, bytes], root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A closed spool with an index that counts as large; the parameter is its number of rows."""
    fill(root, getattr(request, 'param', 2000))
    monkeypatch.setattr(recovery, 'CHECKED_FIRST_BYTES', 0)
    return root


def check(root: Path) -> bool:
    """Whether the check found damage."""
    found = threading.Event()
    checking = IndexCheck(root, found.set)
    checking.open()
    checking._thread.join()
    checking.close()
    return found.is_set()


def test_an_intact_index_is_used_as_it_is(large: Path, opened: Open) -> None:
    spool = opened()
    assert not spool.recovery.is_checked
    assert not spool.recovery.found_anything
    assert not check(large)


def test_a_damaged_index_is_rebuilt_at_the_next_start(large: Path, opened: Open) -> None:
    damage_old_rows(large)
    spool = opened()
    assert put(spool, make('thor/new.jpg'))
    assert check(large)
    spool.close()
    again = opened()
    assert again.recovery.counts['damaged index rebuilt'] == 1
    assert again.recovery.counts['files adopted'] == 8
    again.close()
    assert opened().recovery.is_checked is False


def test_damage_that_a_commit_meets_is_rebuilt_at_the_next_start(large: Path, opened: Open) -> None:
    damage_old_rows(large)
    spool = opened()
    with (
        pytest.raises(sqlite3.DatabaseError, match='malformed'),
        spool._connections.transaction() as index,
    ):
        index._db.execute('UPDATE objects SET reason = NULL')
    spool.close()
    assert opened().recovery.counts['damaged index rebuilt'] == 1


def test_a_damaged_row_in_the_spool_is_found_before_it_is_used(large: Path, opened: Open) -> None:
    with closing(sqlite3.connect(large / 'index.db')) as db, db:
        db.execute("UPDATE objects SET key = '../../etc/passwd' WHERE state = 'pending' AND id = 3")
    assert opened().recovery.counts['damaged index rebuilt'] == 1


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('large', [300_000], indirect=True)
def test_a_stop_does_not_wait_for_the_check(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends a running check, which does not count as damage."""
    running = threading.Event()
    full = Index.check

    def check(index: Index) -> None:
        running.set()
        full(index)

    monkeypatch.setattr(Index, 'check', check)
    found = threading.Event()
    checking = IndexCheck(large, found.set)
    checking.open()
    running.wait()
    checking.close()
    assert not checking._thread.is_alive()
    assert not found.is_set()
    with index_of(large) as index:
        index.check_spool()
