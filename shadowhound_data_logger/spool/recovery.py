"""What happens before a spool is used again: index and tree are made to agree, in both directions (D5).

After it every pending, held or quarantined row has its file, every file has its row, and sessions whose process died
are settled: what they had received without an outcome is dropped with the reason ``restart``.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import sqlite3
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.errors import NameRefused
from shadowhound_data_logger.keys import check_key, check_name
from shadowhound_data_logger.model import DataObject, State
from shadowhound_data_logger.spool.accounts import Snapshot, TopicRow
from shadowhound_data_logger.spool.files import Tree, description_of
from shadowhound_data_logger.spool.index import Index

log = logging.getLogger(__name__)

_IN_SPOOL: Final = "state IN ('pending', 'held', 'quarantined')"


@dataclass(slots=True)
class Recovery:
    """What recovery did, by word; all zero after a clean stop."""

    counts: Counter[str] = field(default_factory=Counter)

    @property
    def found_anything(self) -> bool:
        return bool(+self.counts)

    def describe(self) -> str:
        return ', '.join(f'{count} {what}' for what, count in sorted((+self.counts).items()))


def open_index(path: Path, report: Recovery) -> Index:
    """The index, whole: a damaged one is set aside as ``index.db.damaged-N`` and begun anew."""
    index = Index(path)
    try:
        index.open()
        index.check()
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError) and 'malformed' not in str(error) and 'disk I/O' not in str(error):
            raise OSError(f'the spool index {path} cannot be opened: {error}') from error
        index.close()
        log.error('the spool index %s is damaged (%s): it is rebuilt from the files', path, error)
        report.counts['damaged index rebuilt'] += 1
        _set_aside(path)
        index = Index(path)
        index.open()
    return index


def _set_aside(path: Path) -> None:
    number = 1
    while (target := path.with_name(f'{path.name}.damaged-{number}')).exists():
        number += 1
    os.replace(path, target)
    for suffix in ('-wal', '-shm'):
        Path(f'{path}{suffix}').unlink(missing_ok=True)


def recover(tree: Tree, index: Index, now_ns: int, report: Recovery) -> None:
    """Make index and tree agree and settle dead sessions. The caller holds the recovery lock."""
    _complete_renames(tree, index, now_ns, report)
    _adopt_files(tree, index, now_ns, report)
    for session in index.sessions(ended=False):
        if _is_dead(tree, session):
            _settle_session(index, session, now_ns, report)
            tree.remove(tree.root / 'sessions' / str(session))
    tree.prune()


def _complete_renames(tree: Tree, index: Index, now_ns: int, report: Recovery) -> None:
    """Every row's file to where the row says it is; parts without a row were never committed."""
    missing: list[int] = []
    damaged: list[int] = []
    rows = index.rows(f'{_IN_SPOOL} ORDER BY id')
    for row in rows:
        state = State(row['state'])
        path = tree.path(state, row['reason'], row['bucket'], row['key'])
        if not path.exists():
            elsewhere = (tree.part(row['id']), tree.path(State.PENDING, None, row['bucket'], row['key']))
            if any(tree.place(source, path) for source in elsewhere if source != path):
                report.counts['renames completed'] += 1
            else:
                missing.append(row['id'])
                continue
        if path.stat().st_size != row['bytes'] and state is not State.QUARANTINED:
            damaged.append(row['id'])
            tree.place(path, tree.path(State.QUARANTINED, 'damaged', row['bucket'], row['key']))
    if missing or damaged:
        with index.transaction():
            index.move(missing, State.QUARANTINED, 'missing', now_ns)
            index.move(damaged, State.QUARANTINED, 'damaged', now_ns)
    known_missing = sum(row['state'] == State.QUARANTINED.value and row['reason'] == 'missing' for row in rows)
    report.counts['files missing'] += len(missing) - known_missing
    report.counts['files damaged'] += len(damaged)
    # Inside a transaction: another process that is about to commit a part of its own holds the write lock.
    with index.transaction():
        for number, part in tree.parts():
            if not index.rows(f'id = ? AND {_IN_SPOOL}', (number,)):
                tree.remove(part)
                report.counts['uncommitted parts removed'] += 1


def _adopt_files(tree: Tree, index: Index, now_ns: int, report: Recovery) -> None:
    """Rows for files that have none: those of a lost index, and what somebody copied in."""
    adopted: dict[str, TopicRow] = {}
    session = 0
    for state, reason, bucket, key, path in tree.objects():
        row = index.db.execute('SELECT state, sha256 FROM objects WHERE bucket = ? AND key = ?', (bucket, key)).fetchone()
        if row is not None and row[0] in {State.PENDING.value, State.HELD.value, State.QUARANTINED.value}:
            continue
        body = path.read_bytes()
        if row is not None and row[1] == hashlib.sha256(body).hexdigest():
            tree.remove(path)  # delivered, but the process died before it removed the file
            report.counts['delivered files removed'] += 1
            continue
        item = _described(path, bucket, key, body)
        if row is not None or item is None:
            tree.place(path, tree.root / 'foreign' / path.relative_to(tree.root))
            report.counts['foreign files set aside'] += 1
            continue
        with index.transaction():
            session = session or index.begin_session('recovered', '', 0, now_ns)
            index.insert(item, key, hashlib.sha256(body).hexdigest(), state, reason, item.metadata, now_ns)
            if item.topic is not None:
                adopted[item.topic] = _more(adopted.get(item.topic), item)
            index.write(session, Snapshot(tuple(adopted.values()), ()))
            index.end_session(session, now_ns)
        report.counts['files adopted'] += 1


def _described(path: Path, bucket: str, key: str, body: bytes) -> DataObject | None:
    """The object that a file says it is, checked; None when its name cannot be a key or its content is damaged."""
    try:
        check_name(bucket, 'the bucket')
        check_key(key)
    except NameRefused:
        return None
    said: dict[str, Any] = description_of(path)
    if said.get('sha256', '') not in {'', hashlib.sha256(body).hexdigest()}:
        return None
    now_ns = path.stat().st_mtime_ns
    return DataObject(
        bucket=bucket, key=key, body=body, content_type=str(said.get('content_type', 'application/octet-stream')),
        sensor=str(said.get('sensor', 'unknown')), topic=said.get('topic'), type=str(said.get('type', '')),
        samples=int(said.get('samples', 0)), t_start_ns=int(said.get('t_start_ns', now_ns)),
        t_end_ns=int(said.get('t_end_ns', now_ns)), priority=int(said.get('priority', 5)),
        protected=bool(said.get('protected', False)),
        metadata={**said.get('metadata', {}), 'sha256': hashlib.sha256(body).hexdigest()},
    )  # fmt: skip


def _more(row: TopicRow | None, item: DataObject) -> TopicRow:
    """The account of a topic whose only witnesses are its files."""
    count, newest_ns = (row.stored, row.last_kept_ns) if row else (0, 0)
    count += item.samples
    return TopicRow(item.topic or '', item.type, 'received-only', count, 0, count, {}, {}, max(newest_ns, item.t_end_ns))


def _is_dead(tree: Tree, session: int) -> bool:
    """Whether the process of a session is gone: its lock file can be locked."""
    try:
        descriptor = os.open(tree.root / 'sessions' / str(session), os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


def _settle_session(index: Index, session: int, now_ns: int, report: Recovery) -> None:
    """Close the accounts of a process that died: what was open is lost, and the ledger says so."""
    rows = []
    for row in index.topics(session):
        lost = row.open
        if lost:
            dropped = {**row.dropped, 'restart': row.dropped.get('restart', 0) + lost}
            row = TopicRow(row.topic, row.type, row.accounting, row.received, row.skipped, row.stored, row.rejected, dropped, row.last_kept_ns)
            report.counts['messages lost with an open batch'] += lost
        rows.append(row)
    with index.transaction():
        index.write(session, Snapshot(tuple(rows), ()))
        index.end_session(session, now_ns)
