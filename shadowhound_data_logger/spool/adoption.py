"""Adopts files that have no row: those of a lost index, files that reappeared, and files that an operator copied into the spool.

A file's description is used only where it is plausible. A file that cannot be an object is moved to ``foreign/``. Only files of
objects that have left the spool are deleted.
"""

from __future__ import annotations

import logging
import os
import sqlite3
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import check_key, check_name
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.core.stamps import NO_TIMES
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, TopicRow
from shadowhound_data_logger.spool.files import Tree, description_of
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.object_table import MISSING
from shadowhound_data_logger.spool.topic_account import RECEIVED_ONLY

log = logging.getLogger(__name__)

GROUP_FILES: Final = 256
"""Files adopted per transaction: one transaction each would take minutes for 100,000 files."""
_IN_SPOOL: Final = frozenset({State.PENDING.value, State.HELD.value, State.QUARANTINED.value, State.KEPT.value})
_MAX_INTEGER: Final = (1 << 63) - 1


@dataclass(slots=True)
class Recovery:
    """What recovery did: description -> count; all zero after a clean shutdown."""

    counts: Counter[str] = field(default_factory=Counter)
    is_checked: bool = False
    """Whether the whole index was checked."""

    @property
    def found_anything(self) -> bool:
        return bool(+self.counts)

    def describe(self) -> str:
        return ', '.join(f'{count} {what}' for what, count in sorted((+self.counts).items()))


class _Found(NamedTuple):
    """A file about to be adopted."""

    state: State
    reason: str | None
    item: DataObject
    sha256: str
    path: Path


class Adoption:
    """Adds missing rows to the index, in one pass over the tree.

    Lifecycle: new; run once. The caller holds the recovery lock.
    """

    def __init__(self, tree: Tree, index: Index, now_ns: int, report: Recovery) -> None:
        self._tree = tree
        self._index = index
        self._now_ns = now_ns
        self._report = report
        self._session = 0
        self._group: list[_Found] = []
        self._topics: dict[str, TopicRow] = {}

    def run(self) -> None:
        for state, reason, bucket, key, path in self._tree.objects(self._index.objects.keys_in_spool()):
            if not _is_valid_name(bucket, key):
                self._foreign(path)
                continue
            row = self._index.objects.row(bucket, key)
            if row is not None and row['state'] in _IN_SPOOL and row['reason'] != MISSING:
                continue
            try:
                size, sha256 = fingerprint(path)
            except FileNotFoundError:
                continue  # delivered by another process in the meantime
            except OSError as error:
                log.warning('cannot read %s: %s', path, error)
                self._report.counts['unreadable files left alone'] += 1
                continue
            if row is not None:
                self._known(row, sha256, path, self._tree.path(State.PENDING, None, bucket, key))
            elif (item := _described(bucket, key, FileBody(path, size, sha256))) is None:
                self._foreign(path)
            else:
                self._group.append(_Found(state, reason, item, sha256, path))
                if len(self._group) >= GROUP_FILES:
                    self._adopt()
        self._adopt()

    def _known(self, row: sqlite3.Row, sha256: str, path: Path, ready: Path) -> None:
        """A file whose object is missing or has left the spool."""
        if row['sha256'] != sha256:
            self._foreign(path)
        elif row['state'] in _IN_SPOOL:
            if path == ready or self._tree.move(path, ready):
                with self._index.transaction():
                    self._index.states.set_found(row['id'])
                self._report.counts['missing files back'] += 1
        else:
            self._tree.remove(path)  # delivered, but the process died before it removed the file
            self._report.counts['delivered files removed'] += 1

    def _foreign(self, path: Path) -> None:
        self._tree.set_aside(path)
        self._report.counts['foreign files set aside'] += 1

    def _adopt(self) -> None:
        """Insert the rows of the group, and add its messages to the accounts of a session of recovered messages."""
        if not self._group:
            return
        with self._index.transaction():
            self._session = self._session or self._index.accounts.begin_session('recovered', '', 0, self._now_ns)
            for found in self._group:
                item = found.item
                if self._index.objects.row(item.bucket, item.key) is not None:
                    self._foreign(found.path)  # the same key was in two folders: the first one counts
                    continue
                self._index.states.insert(item, item.key, found.sha256, found.state, found.reason, item.metadata, self._now_ns)
                for account, count in {item.topic: item.samples}.items() if item.topic is not None else item.counts.items():
                    self._topics[account] = _more(self._topics.get(account), account, count, item)
                self._report.counts['files adopted'] += 1
            self._index.accounts.write(self._session, AccountSnapshot(tuple(self._topics.values()), ()))
            self._index.accounts.end_session(self._session, self._now_ns)
        self._group.clear()


def recorded_place(tree: Tree, part: Path) -> Path | None:
    """Where a part belongs according to its description; None if its content does not match it, or the place is taken."""
    described = description_of(part)
    bucket, key, held = _text(described, 'bucket', ''), _text(described, 'key', ''), _text(described, 'held', '')
    if not _is_valid_name(bucket, key) or fingerprint(part)[1] != described.get('sha256'):
        return None
    metadata = described.get('metadata')
    is_kept = isinstance(metadata, dict) and metadata.get(meta.SHIP) == meta.ON_REQUEST
    place = tree.path(State.HELD if held else State.KEPT if is_kept else State.PENDING, held, bucket, key)
    return None if os.path.lexists(place) else place


def _is_valid_name(bucket: str, key: str) -> bool:
    try:
        check_name(bucket, 'the bucket')
        check_key(key)
    except NameRefused:
        return False
    return True


def _described(bucket: str, key: str, body: FileBody) -> DataObject | None:
    """The object that a file's description describes; None if its content does not match."""
    described, sha256 = description_of(body.path), body.sha256
    if _text(described, 'sha256', sha256) != sha256:
        return None
    changed_ns = body.path.stat().st_mtime_ns
    metadata = described.get('metadata')
    own = metadata.items() if isinstance(metadata, dict) else ()
    return DataObject(
        bucket=bucket, key=key, body=body, content_type=_text(described, 'content_type', 'application/octet-stream'),
        sensor=_text(described, 'sensor', 'unknown'), topic=_text(described, 'topic', '') or None,
        type=_text(described, 'type', ''), samples=_number(described, 'samples', 0),
        t_start_ns=_number(described, 't_start_ns', changed_ns), t_end_ns=_number(described, 't_end_ns', changed_ns),
        priority=min(_number(described, 'priority', 5), 9), protected=described.get('protected') is True,
        metadata={**{name: value for name, value in own if isinstance(value, str)}, meta.SHA256: sha256},
        counts=_counts(described),
    )  # fmt: skip


def _text(described: dict[str, Any], name: str, default: str) -> str:
    value = described.get(name)
    return value if isinstance(value, str) and value.isprintable() else default


def _number(described: dict[str, Any], name: str, default: int) -> int:
    value = described.get(name)
    return value if type(value) is int and 0 <= value <= _MAX_INTEGER else default


def _counts(described: dict[str, Any]) -> dict[str, int]:
    """Messages by account; empty for an object of one topic."""
    found = described.get('counts')
    if not isinstance(found, dict) or _text(described, 'topic', ''):
        return {}
    return {name: _number(found, name, 0) for name in found if name and name.isprintable()}


def _more(row: TopicRow | None, topic: str, samples: int, item: DataObject) -> TopicRow:
    """The account with the samples of another file added."""
    count, newest = (row.stored, row.last_stored) if row else (0, NO_TIMES)
    count += samples
    return TopicRow(topic, item.type, RECEIVED_ONLY, count, 0, count, {}, {}, max(newest, item.last_times), unknown=count)
