"""What is in a spool, object by object or summed up, as its index says; and how to retry what was quarantined."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index

HERE: Final = (State.PENDING, State.HELD, State.QUARANTINED, State.KEPT)
"""States of objects whose bytes lie in the spool."""


@dataclass(frozen=True, slots=True)
class SensorUsage:
    """The objects of a sensor that are in the same state for the same reason."""

    sensor: str
    state: str
    reason: str | None
    objects: int
    bytes: int
    oldest_ns: int
    """When the one that has been here for the longest was spooled, by the wall clock of then."""


@dataclass(frozen=True, slots=True)
class Listed:
    """One object."""

    bucket: str
    key: str
    sensor: str
    state: str
    reason: str | None
    bytes: int
    created_ns: int
    path: str
    """Of its file, within the spool's folder; it may be ``incoming/<id>.part`` for a moment yet. One that is missing has none."""


@dataclass(frozen=True, slots=True)
class Retried:
    """What a retry did."""

    objects: int
    bytes: int
    gone: int
    """Asked for, but their files are not there."""


def usage_by_sensor(index: Index) -> list[SensorUsage]:
    """Of an open index, the most important first. Raises sqlite3.Error."""
    return [SensorUsage(*row) for row in index.overview.by_sensor()]


def objects(index: Index, root: Path, *, state: State | None = None, sensor: str | None = None,
            prefix: str = '') -> Iterator[Listed]:  # fmt: skip
    """Of an open index, as they were spooled; ``prefix`` is how ``bucket/key`` begins. Raises sqlite3.Error."""
    tree = Tree(root)
    for bucket, key, of, now, reason, size, created_ns in index.overview.objects(state, sensor, prefix):
        path = tree.path(State(now), reason, bucket, key).relative_to(root)
        yield Listed(bucket, key, of, now, reason, size, created_ns, str(path))


def retry(root: Path, *, reason: str | None = None, names: Collection[str] = ()) -> Retried:
    """Let quarantined objects wait for delivery again: all, those of a reason, or those of these names (``bucket/key``).

    A node that runs finds them within a second. A file is moved before its row, so that a death in between is what somebody's
    moving it by hand would be: the next start finishes it. Raises SpoolError, sqlite3.Error or OSError.
    """
    tree, index = Tree(root), Index(root / 'index.db')
    if not (root / 'index.db').is_file():
        raise SpoolError(f'there is no spool in {root}', remedy='SHADOWHOUND_HOME names its folder')
    with flock(root / 'recovery.lock'):
        index.open()
        try:
            wanted = [row for row in index.objects.quarantined(reason) if not names or f'{row["bucket"]}/{row["key"]}' in names]
            moved = [row for row in wanted if _moved(tree, row['reason'], row['bucket'], row['key'])]
            with index.transaction():
                for row in moved:
                    index.objects.set_found(row['id'])
        finally:
            index.close()
    return Retried(len(moved), sum(row['bytes'] for row in moved), len(wanted) - len(moved))


def resend_gaps(root: Path) -> int:
    """Have the next part with gaps start again, with all that the journal remembers: the store lost parts. Returns how many rows.

    A node that runs does so within a period of the catalog. Raises SpoolError or sqlite3.Error.
    """
    if not (root / 'index.db').is_file():
        raise SpoolError(f'there is no spool in {root}', remedy='SHADOWHOUND_HOME names its folder')
    with closing(Index(root / 'index.db')) as index:
        index.open()
        with index.transaction():
            return index.gaps.resend()


def _moved(tree: Tree, reason: str, bucket: str, key: str) -> bool:
    source, target = tree.path(State.QUARANTINED, reason, bucket, key), tree.path(State.PENDING, None, bucket, key)
    return os.path.lexists(target) or tree.place(source, target)
