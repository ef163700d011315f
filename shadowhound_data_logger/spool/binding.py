"""Makes held objects pending by binding them to their final names, and kept objects by releasing them.

Each call is one transaction of the index. Until it is committed, the files are named ``incoming/<id>.part`` and carry their new
description, so that after a crash recovery finds them: it moves a file back if the transaction was not committed, and to its
final name if it was.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import Binding, SpooledObject, State
from shadowhound_data_logger.spool.files import Tree, describe
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.object_table import spooled

_Row = Mapping[str, Any]
"""As ``ObjectTable.full_row`` returns it."""


def bind(index: Index, tree: Tree, bindings: Sequence[Binding], now_ns: int) -> list[SpooledObject]:
    """Make held objects pending under their final keys. The caller holds the spool's lock.

    Skips objects that are no longer held (evicted, or bound by another process).
    Raises NameRefused for an invalid key, OSError or sqlite3.OperationalError if nothing was bound.
    """
    for binding in bindings:
        check_key(binding.key)
    before: list[_Row] = []
    with index.transaction(undo=lambda: _put_back(tree, before)):
        for binding in bindings:
            row = index.objects.full_row(binding.id)
            if row is not None and row['state'] == State.HELD.value and _to_part(tree, row):
                before.append(row)
                _change(index, row, binding, now_ns)
                renew(index, row['id'], tree.part(row['id']))
        if before:
            tree.sync_incoming()
    return _placed(index, tree, before)


def release(index: Index, tree: Tree, wanted: Sequence[tuple[int, int]]) -> list[SpooledObject]:
    """Make kept objects pending, given as (id, priority); otherwise as ``bind``."""
    before: list[_Row] = []
    with index.transaction(undo=lambda: _put_back(tree, before)):
        for number, priority in wanted:
            row = index.objects.full_row(number)
            if row is not None and row['state'] == State.KEPT.value and _to_part(tree, row):
                before.append(row)
                index.states.release(number, priority)
                renew(index, number, tree.part(number))
        if before:
            tree.sync_incoming()
    return _placed(index, tree, before)


def _placed(index: Index, tree: Tree, before: Sequence[_Row]) -> list[SpooledObject]:
    """After the commit: give the files their final names. Returns the objects that may be shipped."""
    pending = []
    for row in (row for old in before if (row := index.objects.full_row(old['id'])) is not None):
        if row['state'] == State.KEPT.value:
            tree.move(tree.part(row['id']), tree.path(State.KEPT, None, row['bucket'], row['key']))
        elif row['state'] == State.PENDING.value:
            pending.append(spooled(row, tree.place_pending(row['id'], row['bucket'], row['key'])))
    return pending


def renew(index: Index, number: int, path: Path) -> None:
    """Update a file's description from its row; ignores a missing file. Raises OSError if the disk fails."""
    row = index.objects.full_row(number)
    if row is not None:
        _describe(path, row)


def _to_part(tree: Tree, row: _Row) -> bool:
    """Move an object's file to its part; True also if the file is missing, which the uploader will report."""
    path = _own_path(tree, row)
    return tree.move(path, tree.part(row['id'])) or tree.size(path) is None


def _own_path(tree: Tree, row: _Row) -> Path:
    return tree.path(State(row['state']), row['reason'], row['bucket'], row['key'])


def _change(index: Index, row: _Row, binding: Binding, now_ns: int) -> None:
    key = index.objects.free_key(row['bucket'], binding.key, row['key'])
    metadata = {**binding.metadata, meta.SHA256: row['sha256']}
    created_ns = row['created_ns']
    if created_ns < EARLIEST_SANE_NS <= now_ns:  # spooled before the clock was set; the waiting time is computed from this
        created_ns = binding.t_end_ns if EARLIEST_SANE_NS <= binding.t_end_ns <= now_ns else now_ns
    state = State.KEPT if metadata.get(meta.SHIP) == meta.ON_REQUEST else State.PENDING
    index.states.set_bound(row, key, binding, metadata, created_ns, state)


def _put_back(tree: Tree, before: Sequence[_Row]) -> None:
    """After a failure, inside the transaction: move the files back. If that fails too, recovery finds them as parts."""
    for row in before:
        with suppress(OSError):
            _describe(tree.part(row['id']), row)
        tree.move(tree.part(row['id']), _own_path(tree, row))


def _describe(path: Path, row: _Row) -> None:
    description: Mapping[str, object] = {
        'bucket': row['bucket'], 'key': row['key'], 'sha256': row['sha256'], 'content_type': row['content_type'],
        'sensor': row['sensor'], 'topic': row['topic'], 'type': row['type'], 'samples': row['samples'],
        't_start_ns': row['t_start_ns'], 't_end_ns': row['t_end_ns'], 'priority': row['priority'],
        'protected': bool(row['protected']), 'held': row['reason'] if row['state'] == State.HELD.value else None,
        'metadata': json.loads(row['metadata']), **({'counts': row['counts']} if row['counts'] else {}),
    }  # fmt: skip
    with suppress(FileNotFoundError):
        describe(path, description)
