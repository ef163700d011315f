"""Prints how long a commit blocks other processes from the index: from BEGIN to the end of COMMIT.

Run it as ``python bench/transactions.py [--folder F] [--json]``; F should be on the disk that the spool will be on. It commits
as many objects of the same size as the default profile, as with every message stored, and as the largest possible commit of the
writer. After each commit it syncs a file with as many bytes as the transaction added to the index's log: that is the disk's
share. Finally a client requests very many kept objects, and cancels the request.
"""

from __future__ import annotations

import argparse
import json
import os
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import Any, Final

from _report import percentile
from spool_commits import make, opened

from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.request_table import CANCELLED, RequestRow
from shadowhound_data_logger.spool.spool import MAX_OBJECTS, Spool

PROFILES: Final = {
    'default profile': (3, 40_000, 0.1), 'every message stored': (20, 100_000, 0.1),
    'the largest commit': (MAX_OBJECTS, 130_000, 0.1),
}  # fmt: skip
"""Objects of this many bytes per commit, and the seconds between commits."""
BAR_MS: Final = 50.0
ASKED: Final = 50_000
"""Kept objects in a request."""


class Timed:
    """Wraps the connection of an index and times its transactions, in milliseconds."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._begun = 0.0
        self.held: list[float] = []
        self.committing: list[float] = []
        """The COMMIT part of these: its sync, and sometimes a checkpoint, which blocks no other process."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    def execute(self, statement: str, *values: Any) -> sqlite3.Cursor:
        began = perf_counter()
        done = self._connection.execute(statement, *values)
        if statement == 'BEGIN IMMEDIATE':
            self._begun = perf_counter()
        elif statement == 'COMMIT':
            ended = perf_counter()
            self.held.append((ended - self._begun) * 1e3)
            self.committing.append((ended - began) * 1e3)
        return done


@contextmanager
def timed(index: Index) -> Iterator[Timed]:
    """The index with a timed connection."""
    connection = index._connection
    assert connection is not None
    found = Timed(connection)
    index._connection = found  # type: ignore[assignment]
    try:
        yield found
    finally:
        index._connection = connection


def raw_sync(descriptor: int, size: int) -> float:
    """Milliseconds of the disk for this many bytes."""
    os.pwrite(descriptor, os.urandom(size), 0)
    began = perf_counter()
    os.fdatasync(descriptor)
    return (perf_counter() - began) * 1e3


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, p99 and maximum."""
    return {'median': percentile(values, 50), 'p99': percentile(values, 99), 'max': max(values)}


def measured(root: Path, objects: int, size: int, period_s: float, seconds: float) -> dict[str, object]:
    """How long transactions were, and the disk's share."""
    spool: Spool = opened(root)
    log = root / 'index.db-wal'
    raw: list[float] = []
    number = 0
    descriptor = os.open(root / 'raw', os.O_WRONLY | os.O_CREAT, 0o600)
    os.pwrite(descriptor, bytes(1 << 20), 0)
    os.fsync(descriptor)
    with timed(spool._connections.writing) as found:
        end = perf_counter() + seconds
        while perf_counter() < end:
            began, before = perf_counter(), log.stat().st_size
            spool.commit([make(number + place, size) for place in range(objects)])
            number += objects
            raw.append(raw_sync(descriptor, max(4096, min(1 << 20, log.stat().st_size - before))))
            sleep(max(0.0, began + period_s - perf_counter()))
    os.close(descriptor)
    spool.close()
    share = sum(found.committing) / sum(found.held)
    return {'objects': objects, 'bytes': size, 'transactions': len(found.held), 'held_ms': spread(found.held),
            'committing_ms': spread(found.committing), 'raw_sync_ms': spread(raw), 'share_of_commit': share,
            'rows_ms': spread([held - commit for held, commit in zip(found.held, found.committing, strict=True)]),
            'over_bar': sum(held > BAR_MS for held in found.held)}  # fmt: skip


def asked(root: Path) -> dict[str, object]:
    """Duration of the transactions that accept, end and delete a request for very many objects."""
    spool: Spool = opened(root)
    with spool._connections.writing.transaction():
        spool._connections.writing._db.executemany(
            'INSERT INTO objects (bucket, key, state, priority, protected, waits_for, on_request, event, mission, sensor, topic,'
            " type, samples, bytes, sha256, content_type, metadata, t_start_ns, t_end_ns, created_ns)"
            " VALUES ('sensor-data', ?, 'kept', 5, 0, 'upload.when', 1, 0, '', 'camera',"
            " '/camera', 't', 1, 50000, '0', 'image/jpeg', '{}', 1, 1, 1)",
            ((f'thor/camera/{number:08d}.jpg',) for number in range(ASKED)),
        )  # fmt: skip
    chosen = [(item.id, item.bytes) for item in spool.requests.selectable()]
    row = RequestRow(id='0' * 32, requester='bench', priority=5, made_ns=1, expires_ns=1 << 62, received_ns=1, selection='{}')
    with timed(spool._connections.writing) as found:
        began = perf_counter()
        row = spool.requests.accept(row, chosen)
        accepted_s = perf_counter() - began
        spool.requests.close(row.id, CANCELLED)
        spool.requests.accept(row, [])
    spool.close()
    return {'objects': row.objects, 'accepted_s': accepted_s, 'transactions': len(found.held), 'held_ms': spread(found.held),
            'over_bar': sum(held > BAR_MS for held in found.held)}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--folder', type=Path, help='where to make the spools')
    parser.add_argument('--seconds', type=float, default=15.0, help='of each profile')
    parser.add_argument('--json', action='store_true')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        result = {
            name: measured(Path(folder, str(place)), *profile, arguments.seconds)
            for place, (name, profile) in enumerate(PROFILES.items())
        }
        result[f'a request for {ASKED:,} kept objects'] = asked(Path(folder, 'asked'))
    if arguments.json:
        print(json.dumps(result))
        return
    for name, figures in result.items():
        print(name, json.dumps(figures, indent=1))


if __name__ == '__main__':
    main()
