"""Lists what is in a spool, and lets an operator retry quarantined objects or resend the gap journal."""

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

STATES_IN_SPOOL: Final = (State.PENDING, State.HELD, State.QUARANTINED, State.KEPT)
"""States of objects whose files are in the spool."""


@dataclass(frozen=True, slots=True)
class SensorUsage:
    """The objects of a sensor that are in the same state for the same reason."""

    sensor: str
    state: str
    reason: str | None
    objects: int
    bytes: int
    oldest_ns: int
    """When the oldest of them was spooled, by the wall clock at that time."""


@dataclass(frozen=True, slots=True)
class ListedObject:
    """One object in the spool."""

    bucket: str
    key: str
    sensor: str
    state: str
    reason: str | None
    bytes: int
    created_ns: int
    path: str
    """Of its file, relative to the spool's folder; for a moment the file may still be ``incoming/<id>.part``."""


@dataclass(frozen=True, slots=True)
class Retried:
    """What a retry did."""

    objects: int
    bytes: int
    gone: int
    """Requested objects whose files are missing."""


def usage_by_sensor(index: Index) -> list[SensorUsage]:
    """The usage in an open index, by sensor, the most important first. Raises sqlite3.Error."""
    return [SensorUsage(*row) for row in index.overview.by_sensor()]


def objects(index: Index, root: Path, *, state: State | None = None, sensor: str | None = None,
            prefix: str = '') -> Iterator[ListedObject]:  # fmt: skip
    """The objects in an open index, in the order in which they were spooled; ``bucket/key`` starts with ``prefix``.

    Raises sqlite3.Error.
    """
    tree = Tree(root)
    for bucket, key, of_sensor, in_state, reason, size, created_ns in index.overview.objects(state, sensor, prefix):
        path = tree.path(State(in_state), reason, bucket, key).relative_to(root)
        yield ListedObject(bucket, key, of_sensor, in_state, reason, size, created_ns, str(path))


def retry(root: Path, *, reason: str | None = None, names: Collection[str] = ()) -> Retried:
    """Make quarantined objects pending again: all, those with a reason, or those with these names (``bucket/key``).

    A running node finds them within a second. Files are moved before their rows change: after a crash in between, the next
    startup completes the change, as if an operator had moved the file. Raises SpoolError, sqlite3.Error or OSError.
    """
    tree, index = Tree(root), Index(root / 'index.db')
    if not (root / 'index.db').is_file():
        raise SpoolError(f'there is no spool in {root}', remedy='set SHADOWHOUND_HOME to its folder')
    with flock(root / 'recovery.lock'):
        index.open()
        try:
            wanted = [row for row in index.objects.quarantined(reason) if not names or f'{row["bucket"]}/{row["key"]}' in names]
            moved = [row for row in wanted if _moved(tree, row['reason'], row['bucket'], row['key'])]
            with index.transaction():
                for row in moved:
                    index.states.set_found(row['id'])
        finally:
            index.close()
    return Retried(len(moved), sum(row['bytes'] for row in moved), len(wanted) - len(moved))


def resend_gaps(root: Path) -> int:
    """Upload the whole remembered gap journal again, because the store lost parts of it. Returns the number of rows.

    A running node does so within a period of the catalog. Raises SpoolError or sqlite3.Error.
    """
    if not (root / 'index.db').is_file():
        raise SpoolError(f'there is no spool in {root}', remedy='set SHADOWHOUND_HOME to its folder')
    with closing(Index(root / 'index.db')) as index:
        index.open()
        with index.transaction():
            return index.gaps.resend()


def _moved(tree: Tree, reason: str, bucket: str, key: str) -> bool:
    source, target = tree.path(State.QUARANTINED, reason, bucket, key), tree.path(State.PENDING, None, bucket, key)
    return os.path.lexists(target) or tree.move(source, target)
