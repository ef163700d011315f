"""Objects for the spool, and invariants that every spool must satisfy at any time."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import DataObject, SpooledObject, State
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.catalog_table import UncatalogedObject
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Outcome, Spool

NOON_NS = 1_760_788_800 * SECOND
BUCKET = 'sensor-data'
READY = f'ready/{BUCKET}'
KEY = 'thor/camera/20251018/120000_front.jpg'
IN_SPOOL = {State.PENDING: 'ready', State.HELD: 'held', State.QUARANTINED: 'quarantine', State.KEPT: 'kept'}


@dataclass(slots=True)
class FakeClock:
    """A clock that advances only when the test says so."""

    now_ns: int = NOON_NS
    boot_id: str = 'a-boot'

    def wall_ns(self) -> int:
        return self.now_ns

    def boot_ns(self) -> int:
        return self.now_ns


def new_spool(root: Path, clock: FakeClock | None = None, robot: str = 'thor', **settings: float) -> Spool:
    """A spool that is not open yet, without a minimum of free space."""
    return Spool(root, SpoolSettings(**{'min_free_bytes': 0, **settings}), clock or FakeClock(), robot)


def make(key: str = KEY, body: bytes = b'content', **fields: Any) -> DataObject:
    """One object of one sample of the camera."""
    values: dict[str, Any] = {
        'bucket': BUCKET, 'key': key, 'body': body, 'content_type': 'image/jpeg', 'sensor': 'camera', 'topic': '/camera',
        'type': 'sensor_msgs/msg/CompressedImage', 'samples': 1, 't_start_ns': NOON_NS, 't_end_ns': NOON_NS, **fields,
    }  # fmt: skip
    return DataObject(**values)


def receive(spool: Spool, count: int = 1, topic: str = '/camera', publisher: str = 'p') -> None:
    """Account for this many received messages, with the next sequence numbers."""
    with spool.accounts.entry(topic) as account:
        span = account.publishers.get(publisher)
        first = (span.last or 0) + 1 if span else 1
        for number in range(first, first + count):
            assert account.receive(publisher, number)


def put(spool: Spool, *objects: DataObject) -> list[SpooledObject]:
    """Receive and commit."""
    for item in objects:
        if item.topic:
            receive(spool, item.samples, item.topic)
    return spool.commit(objects)


def settle(spool: Spool, item: SpooledObject, state: State, reason: str | None = None) -> None:
    """Commit one outcome."""
    spool.commit(outcomes=[Outcome(item, state, reason)])


@contextmanager
def index_of(root: Path) -> Iterator[Index]:
    """The index, opened as another process would."""
    with closing(Index(root / 'index.db')) as index:
        index.open()
        yield index


def uncataloged(root: Path, limit: int = 99) -> list[UncatalogedObject]:
    """The oldest objects that are not in any catalog part yet."""
    with index_of(root) as index:
        return index.catalog.uncataloged(limit)


def clear_uncataloged(root: Path) -> None:
    with index_of(root) as index:
        index.catalog.clear()


def rows(root: Path) -> list[dict[str, Any]]:
    """All object rows, read over a separate connection that tolerates invalid UTF-8 in rows of objects that left the spool."""
    connection = sqlite3.connect(root / 'index.db')
    connection.text_factory = lambda text: text.decode(errors='replace')
    connection.row_factory = sqlite3.Row
    try:
        return [dict(row) for row in connection.execute('SELECT * FROM objects ORDER BY id')]
    finally:
        connection.close()


def files(root: Path) -> dict[str, bytes]:
    """Every payload in the spool's tree by its path."""
    folders = ('incoming', 'ready', 'held', 'quarantine', 'kept', 'foreign')
    found = [path for name in folders for path in (root / name).rglob('*') if path.is_file() and not path.is_symlink()]
    return {str(path.relative_to(root)): path.read_bytes() for path in found}


def place_of(row: dict[str, Any]) -> str:
    """The expected path of a row's file."""
    state = State(row['state'])
    reason = '' if state in {State.PENDING, State.KEPT} else f'/{row["reason"] or "unknown"}'
    return f'{IN_SPOOL[state]}{reason}/{row["bucket"]}/{row["key"]}'


def assert_whole(root: Path) -> dict[str, Any]:
    """Every row in the spool has its complete file, every file its row, and the ledger balances; returns the ledger."""
    lying = files(root)
    expected = {}
    for row in rows(root):
        if State(row['state']) in IN_SPOOL and row['reason'] != 'missing':
            expected[place_of(row)] = row
    assert {name for name in lying if not name.startswith('foreign/')} == set(expected)
    for name, row in expected.items():
        if row['reason'] != 'damaged':
            assert hashlib.sha256(lying[name]).hexdigest() == row['sha256'], name
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    assert found['balanced']
    return found


def reopened(opened: Callable[[], Spool], root: Path) -> dict[str, int]:
    """Open, check that the spool is intact and can commit and deliver, close; returns what recovery did."""
    spool = opened()
    assert_whole(root)
    (item,) = put(spool, make('thor/after.jpg'))
    assert item in spool.pending(99)
    settle(spool, item, State.DELIVERED)
    assert_whole(root)
    spool.close()
    again = opened()
    assert not set(again.recovery.counts) - {'unreadable files left alone'}, 'what was repaired stays repaired'
    again.close()
    return dict(+spool.recovery.counts)


def abandon(spool: Spool) -> None:
    """Leave a spool as a killed process does."""
    spool._connections.writing.close()
    assert spool._session is not None
    os.close(spool._session._lock)


_COPIES = """
INSERT INTO objects WITH RECURSIVE series (value) AS (SELECT 1 UNION ALL SELECT value + 1 FROM series WHERE value < ?)
SELECT {} FROM objects, series WHERE id = (SELECT id FROM objects WHERE state = 'delivered' LIMIT 1)"""


def fill(root: Path, count: int) -> None:
    """Add rows of this many delivered objects, without messages, to the index of a closed spool that has one of them."""
    with closing(sqlite3.connect(root / 'index.db')) as db, db:
        columns = [row[1] for row in db.execute('PRAGMA table_info(objects)')]
        values = ', '.join({'id': 'NULL', 'key': "key || '-' || value", 'samples': '0'}.get(name, name) for name in columns)
        db.execute(_COPIES.format(values), (count,))


def damage_old_rows(root: Path) -> None:
    """Make a page unreadable that holds rows of delivered objects and that no commit or upload reads."""
    path = root / 'index.db'
    content = bytearray(path.read_bytes())
    pages = range(len(content) // 4096 // 2 * 4096, len(content), 4096)
    leaf = next(page for page in pages if content[page] == 13 and b'-' in content[page : page + 4096])  # a leaf page of a table
    content[leaf : leaf + 4096] = bytes(4096)
    path.write_bytes(content)
