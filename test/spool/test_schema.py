"""Implausible values in an index are found at startup; a home written by a newer program is refused."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from bags.recording import desk
from clocks import Clocks
from spool.conftest import Open
from spool.making import index_of, make, new_spool, put, settle

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.shipping.audit import Deliveries
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.listing import retry
from shadowhound_data_logger.spool.schema import SCHEMA_VERSION


@pytest.fixture
def index(opened: Open, root: Path) -> Path:
    """The index of a closed spool, with objects in every state and the most unusual names and times that are allowed."""
    spool = opened()
    strange = make("thor/a..b/!x_'(1)=+@-.jpg", bucket='Other_Bucket.1', t_start_ns=-1, t_end_ns=2**63 - 1, priority=0)
    items = put(spool, strange, *(make(f'thor/{number}') for number in range(5)), make('thor/h', held='clock'))
    for item, (state, reason) in zip(items, [(State.DELIVERED, None), (State.QUARANTINED, 'access_denied')], strict=False):
        settle(spool, item, state, reason)
    spool.close()
    return root / 'index.db'


def test_valid_values_are_accepted(index: Path) -> None:
    """No value written by the spool itself is reported as impossible, and its totals match its objects."""
    with index_of(index.parent) as whole:
        whole.check()
        assert list(whole.miscounted()) == []


@pytest.mark.parametrize(
    'change',
    [
        "accounts SET last_stored_ns = 'x'", 'accounts SET received = -1', "publishers SET last = x'00'",
        "objects SET metadata = 'x'",
        "objects SET key = '../../etc/passwd' WHERE id = 3", "objects SET key = '/etc/passwd' WHERE id = 3",
        "objects SET reason = '../x' WHERE id = 2", "objects SET bucket = '..' WHERE id = 3", 'objects SET bytes = 1 << 60',
        'sqlite_sequence SET seq = 9223372036854775807', "tally SET bytes = 'x'", "sessions SET ended_ns = 'x'",
    ],
)  # fmt: skip
def test_impossible_values_are_found(index: Path, opened: Open, change: str) -> None:
    """The index is rebuilt from the files, and startup works."""
    with closing(sqlite3.connect(index)) as db:
        db.execute(f'UPDATE {change}')
        db.commit()
    with index_of(index.parent) as damaged, pytest.raises(sqlite3.DatabaseError, match='impossible value'):
        damaged.check()
    assert opened().recovery.counts['damaged index rebuilt'] == 1


def test_mismatching_totals_are_reported(index: Path, opened: Open, caplog: pytest.LogCaptureFixture) -> None:
    """An object that counts for another topic than its total changes no overall total, and is reported anyway."""
    with closing(sqlite3.connect(index)) as db:
        db.execute("UPDATE objects SET topic = '/other' WHERE key = 'thor/3'")
        db.commit()
    with index_of(index.parent) as wrong:
        assert len(list(wrong.miscounted())) == 2
    assert opened().recovery.counts['sums of the ledger that do not balance'] == 2
    assert '/other: pending None, but in the spool (1, 7, 1)' in caplog.text


@pytest.mark.parametrize('killed', [False, True])
def test_a_newer_home_is_left_alone(tmp_path: Path, killed: bool) -> None:
    """Every way to open it raises an error that names both versions, and no byte changes, nor in the log of a killed node."""
    home = tmp_path / 'home'
    clocks = Clocks()
    clocks.set()
    with desk(home, clocks) as it:
        put(it.spool, make('a', b'a'), make('b', b'b', held='clock'))
        left = Path(shutil.copytree(home, tmp_path / 'killed')) if killed else home
    root = left / 'spool'
    db = sqlite3.connect(root / 'index.db', isolation_level=None)
    db.execute('CREATE TABLE newer (id)')
    db.execute(f'PRAGMA user_version = {SCHEMA_VERSION + 1}')
    if killed:  # before a checkpoint: only the log has the changes
        root = Path(shutil.copytree(root, tmp_path / 'newer'))
        assert (root / 'index.db-wal').stat().st_size
    db.close()
    before = contents(root)
    refusals = [
        lambda: new_spool(root).open(), lambda: ledger.read(root, 'thor'), lambda: retry(root),
        lambda: Deliveries(root).open(),
    ]  # fmt: skip
    for opening in refusals:
        with pytest.raises(SpoolError, match=rf'version {SCHEMA_VERSION + 1}.*update shadowhound_data_logger'):
            opening()
        assert contents(root) == before


def contents(root: Path) -> dict[str, bytes]:
    """All files except the (empty) locks and the files that SQLite keeps next to an index for its readers."""
    found = {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.rglob('*')) if path.is_file()}
    return {name: body for name, body in found.items() if body and not name.endswith('-shm')}
