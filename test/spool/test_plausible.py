"""Values in an index that cannot be ours are found at the start, before they end it or lead out of the spool."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import index_of, make, put, settle

from shadowhound_data_logger.core.model import State


@pytest.fixture
def index(opened: Open, root: Path) -> Path:
    """Of a closed spool, with objects in every state and with the strangest names and times that are allowed."""
    spool = opened()
    strange = make("thor/a..b/!x_'(1)=+@-.jpg", bucket='Other_Bucket.1', t_start_ns=-1, t_end_ns=2**63 - 1, priority=0)
    items = put(spool, strange, *(make(f'thor/{number}') for number in range(5)), make('thor/h', held='clock'))
    for item, (state, reason) in zip(items, [(State.DELIVERED, None), (State.QUARANTINED, 'access_denied')], strict=False):
        settle(spool, item, state, reason)
    spool.close()
    return root / 'index.db'


def test_what_is_ours_is_not_doubted(index: Path) -> None:
    """No value that the spool itself wrote is called impossible, and its totals are those of its objects."""
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
def test_what_cannot_be_ours_is_found(index: Path, opened: Open, change: str) -> None:
    """The index is rebuilt from the files then, and the start works."""
    with closing(sqlite3.connect(index)) as db:
        db.execute(f'UPDATE {change}')
        db.commit()
    with index_of(index.parent) as damaged, pytest.raises(sqlite3.DatabaseError, match='impossible value'):
        damaged.check()
    assert opened().recovery.counts['damaged index rebuilt'] == 1


def test_mismatching_totals_are_reported(index: Path, opened: Open, caplog: pytest.LogCaptureFixture) -> None:
    """An object that counts for another topic than its total says shows in no sum of today, and is said all the same."""
    with closing(sqlite3.connect(index)) as db:
        db.execute("UPDATE objects SET topic = '/other' WHERE key = 'thor/3'")
        db.commit()
    with index_of(index.parent) as wrong:
        assert len(list(wrong.miscounted())) == 2
    assert opened().recovery.counts['sums of the ledger that do not balance'] == 2
    assert '/other: pending None, but in the spool (1, 7, 1)' in caplog.text
