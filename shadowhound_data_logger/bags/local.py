"""Files of bags that are still on the robot: in its spool, or in the folders of current recordings."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.naming import BAGS, BUCKET, prefix_of
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index

RECORDS: Final = 'records'
"""Folder in SHADOWHOUND_HOME for recordings of ``bag record``; the node's recordings are in naming.BAGS."""
SPOOL: Final = 'spool'
QUARANTINE: Final = 'quarantine'
"""Permanently rejected by the store."""
RECORDING: Final = 'recording'


@dataclass(frozen=True, slots=True)
class UnsentFile:
    """A file of a bag that the store does not have yet."""

    bag: str
    name: str
    where: str
    """SPOOL, QUARANTINE or RECORDING."""
    size: int
    metadata: Mapping[str, str] = field(default_factory=dict)
    path: Path | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is still being written."""
        return self.name.endswith(OPEN_SUFFIX)


def local_files(home: Path, robot: str) -> dict[tuple[str, str], UnsentFile]:
    """The files by bag and name; a file in both the spool and the recording folder counts as spooled. Raises SpoolError."""
    found = {(file.bag, file.name): file for folder in (BAGS, RECORDS) for file in _recording(home / folder / robot)}
    try:
        found |= {(file.bag, file.name): file for file in _spooled(home / 'spool', robot)}
    except sqlite3.Error as error:
        raise _unreadable(home, error) from error
    return found


def evicted_files(home: Path, robot: str) -> Counter[str]:
    """Bag -> number of files that the full spool evicted, according to its index. Raises SpoolError."""
    try:
        return Counter(bag for bag, _, _ in _rows(home / 'spool', robot, State.EVICTED))
    except sqlite3.Error as error:
        raise _unreadable(home, error) from error


def _recording(folder: Path) -> Iterator[UnsentFile]:
    for path in sorted(folder.glob('*/*')):
        if path.name.endswith(('.mcap', f'.mcap{OPEN_SUFFIX}')):
            try:
                yield UnsentFile(path.parent.name, path.name, RECORDING, path.stat().st_size, path=path)
            except FileNotFoundError:
                continue  # it was closed or spooled in between


def _spooled(spool: Path, robot: str) -> Iterator[UnsentFile]:
    for bag, name, row in _rows(spool, robot, State.PENDING, State.HELD, State.QUARANTINED, State.KEPT):
        is_refused = row['state'] == 'quarantined'
        path = None if is_refused else Tree(spool).path(State(row['state']), row['reason'], BUCKET, row['key'])
        where = QUARANTINE if is_refused else SPOOL
        yield UnsentFile(bag, name, where, row['bytes'], json.loads(row['metadata']), path)


def _rows(spool: Path, robot: str, *states: State) -> Iterator[tuple[str, str, sqlite3.Row]]:
    """Bag, file and row of each object of a bag in these states."""
    if not (spool / 'index.db').exists():
        return
    prefix = prefix_of(robot)
    index = Index(spool / 'index.db', read_only=True)
    index.open()
    with closing(index):
        rows = index.objects.with_prefix(BUCKET, prefix, states)
    for row in rows:
        bag, _, name = row['key'][len(prefix) :].partition('/')
        yield bag, name or bag, row


def _unreadable(home: Path, error: sqlite3.Error) -> SpoolError:
    return SpoolError(f'the spool {home / "spool"} cannot be read: {error}', remedy='shadowhound-data status')
