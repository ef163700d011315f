"""Recovery before a spool is used again: makes index and tree agree, in both directions (docs/decisions/0001).

After it every pending, held or quarantined row has its file, every file has its row, and sessions whose process died
are settled: what they had received without an outcome is dropped with the reason ``restart``.

A part without a row, or a file that was about to become one, was never committed, promised to nobody, and is removed; but a
power cut may have given the part of a durable row its first name back. That cannot be said of an index that went back in time:
it is new, or it does not know a session whose file is there, or a session died and left no write-ahead log (SQLite removes
that at a clean stop only). Then a part that is whole by its own description is adopted, as are files that have their
names. Where it had not been committed after all its samples are stored as well as lost at the restart: rather that than the
other way round. A log that is there but damaged does not show; with it, what was being renamed in that instant is lost.

This mends a spool; ``bags/recovery.py`` decides about a bag, ``formats/mcap/recovery.py`` repairs the bytes of a slice.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.durable_files import fingerprint, lock
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, TopicRow
from shadowhound_data_logger.spool.accounts import SINKS
from shadowhound_data_logger.spool.adoption import Adoption, Recovery, recorded_place
from shadowhound_data_logger.spool.ballast import is_disk_full
from shadowhound_data_logger.spool.binding import renew
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.gaps import DROPPED, EXACT, GapRow, TopicGaps
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.ledger import imbalances, of_index
from shadowhound_data_logger.spool.object_table import MISSING, STATES_IN_SPOOL

log = logging.getLogger(__name__)

DAMAGED: Final = 'damaged'
REBUILT: Final = 'damaged index rebuilt'
MICROSECOND: Final = 1000
_DAMAGED: Final = ('malformed', 'disk I/O', 'already exists', 'no such', 'decode', 'unsupported file format')


def open_recovered(tree: Tree, now_ns: int, report: Recovery) -> Index:
    """The index, whole and in agreement with the tree: a damaged one is set aside as ``index.db.damaged-N`` and begun anew.

    The caller holds the recovery lock. Raises OSError or sqlite3.OperationalError when the folder cannot be used, SpoolError
    for an index of a newer version.
    """
    path = tree.root / 'index.db'
    while True:
        path.touch(mode=0o600)
        index = Index(path)
        has_log = bool(Tree.size(Path(f'{path}-wal')))
        try:
            index.open()
            index.check()
            index.check_values()
            _recover(tree, index, now_ns, report, has_log=has_log)
        except (sqlite3.Error, ValueError, TypeError, AttributeError, OverflowError) as error:
            index.close()
            if report.counts[REBUILT] or not _is_damage(path, error):
                raise
            log.exception('the spool index %s is damaged: it is rebuilt from the files', path)
            report.counts[REBUILT] += 1
            _set_aside(path)
        except BaseException:
            index.close()
            raise
        else:
            return index


def _is_damage(path: Path, error: Exception) -> bool:
    """Whether an error says that the index's bytes are wrong, rather than that it cannot be used now.

    A flipped bit can give a record a value of any type: errors that are not SQLite's are such.
    """
    if not isinstance(error, sqlite3.OperationalError):
        return True
    if is_disk_full(error, path.parent):
        return False
    if 'readonly' in str(error):  # a flipped bit of the header says so as well
        return os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return any(word in str(error) for word in _DAMAGED)


def _set_aside(path: Path) -> None:
    number = 1
    while (target := path.with_name(f'{path.name}.damaged-{number}')).exists():
        number += 1
    os.replace(path, target)
    for suffix in ('-wal', '-shm'):
        Path(f'{path}{suffix}').unlink(missing_ok=True)


def _recover(tree: Tree, index: Index, now_ns: int, report: Recovery, *, has_log: bool) -> None:
    """Make index and tree agree and settle dead sessions."""
    _stay_apart(tree, index, now_ns)
    _follow_rows(tree, index, now_ns, report)
    _settle_parts(tree, index, report, adopt=_went_back(tree, index, has_log=has_log))
    Adoption(tree, index, now_ns, report).run()
    for session in index.accounts.sessions(ended=False):
        if _is_dead(tree, session):
            _settle_session(index, session, now_ns, report)
    for session in set(tree.sessions()).difference(index.accounts.sessions(ended=False)):
        if _is_dead(tree, session):
            tree.remove(tree.session(session))
    for session, body in tree.staged():
        if _is_dead(tree, session):
            tree.remove(body)
            report.counts['files not committed'] += 1
    for sentence in imbalances(of_index(index, '')) or index.miscounted():
        log.error('the ledger of %s does not close, its index was damaged: %s', tree.root, sentence)
        report.counts['sums of the ledger that do not close'] += 1
    tree.prune()


def _stay_apart(tree: Tree, index: Index, now_ns: int) -> None:
    """Give out no number that a process has given out which lives with the index before, until it finds that this was lost.

    Numbers begin with the time in microseconds: a recovery adopts more than one file a millisecond, so with milliseconds two
    indexes that were rebuilt shortly after each other could give out the same number.
    """
    known = {*index.accounts.sessions(ended=False), *index.accounts.sessions(ended=True)}
    strangers = set(tree.sessions()).difference(known)
    if strangers:
        with index.transaction():
            index.accounts.begin_after(max(strangers), now_ns // MICROSECOND)


def _follow_rows(tree: Tree, index: Index, now_ns: int, report: Recovery) -> None:
    """Every row's file to where the row says it is. Other processes may deliver meanwhile."""
    missing: list[int] = []
    damaged: list[tuple[sqlite3.Row, Path]] = []
    staged = _Staged(tree)
    for row in index.objects.in_spool():
        state = State(row['state'])
        if state is State.QUARANTINED and row['reason'] == MISSING:
            continue
        json.loads(row['metadata'])  # damage that SQLite does not see; later it would stop all delivery
        if state in {State.PENDING, State.KEPT} and tree.is_in_place(state, row['bucket'], row['key'], row['bytes']):
            continue
        path = where = tree.path(state, row['reason'], row['bucket'], row['key'])
        if state is State.KEPT and tree.size(tree.part(row['id'])) == row['bytes']:  # thinned, and not in its place yet
            report.counts['renames completed'] += tree.place(tree.part(row['id']), path)
        if tree.size(path) is None:
            # Last its own place again: another process may just have moved it there.
            ready, kept = (tree.path(of, None, row['bucket'], row['key']) for of in (State.PENDING, State.KEPT))
            places = (tree.part(row['id']), ready, kept, path)
            found = next((place for place in places if tree.size(place) is not None), None) or staged.pop_content(row)
            if found is None:
                missing.append(row['id'])
                continue
            where = found
            if state is State.QUARANTINED and found == ready and tree.size(found) == row['bytes']:
                # Moved there by hand, to be tried again; or quarantined when the power went, and then a try costs nothing.
                with index.transaction():
                    index.objects.set_found(row['id'])
                report.counts['quarantined files to be tried again'] += 1
            elif found != path and tree.place(found, path):
                where = path
                renew(index, row['id'], path)  # a part may say what it was, or what it was about to become
                report.counts['renames completed'] += 1
        if state is not State.QUARANTINED and tree.size(where) not in {row['bytes'], None}:
            damaged.append((row, where))
    if missing or damaged:
        with index.transaction():
            report.counts['files missing'] += index.objects.set_missing(missing, now_ns)
            index.objects.move([row['id'] for row, _ in damaged], State.QUARANTINED, DAMAGED, now_ns)
    for row, where in damaged:
        tree.place(where, tree.path(State.QUARANTINED, DAMAGED, row['bucket'], row['key']))
        report.counts['files damaged'] += 1


class _Staged:
    """Files of dead processes that were about to become parts: of a committed one a power cut may have undone the rename."""

    def __init__(self, tree: Tree) -> None:
        self._left = [body for session, body in tree.staged() if _is_dead(tree, session)]

    def pop_content(self, row: sqlite3.Row) -> Path | None:
        """One that is, byte for byte, what the row is of; once each."""
        for body in self._left:
            if Tree.size(body) == row['bytes'] and fingerprint(body)[1] == row['sha256']:
                self._left.remove(body)
                return body
        return None


def _went_back(tree: Tree, index: Index, *, has_log: bool) -> bool:
    """Whether commits may have been lost with the index, or with the log beside it."""
    dead = [session for session in index.accounts.sessions(ended=False) if _is_dead(tree, session)]
    known = {*index.accounts.sessions(ended=False), *index.accounts.sessions(ended=True)}
    return not known or not known.issuperset(tree.sessions()) or (bool(dead) and not has_log)


def _settle_parts(tree: Tree, index: Index, report: Recovery, *, adopt: bool) -> None:
    """Parts without a row are removed, or go where they say that they belong."""
    # Inside a transaction: another process that is about to commit a part of its own holds the write lock.
    with index.transaction():
        for number, part in tree.parts():
            if index.objects.state(number) in STATES_IN_SPOOL:
                _remove_unthinned(tree, index, number, part, report)
                continue
            place = recorded_place(tree, part) if adopt else None
            if place is None or not tree.place(part, place):
                tree.remove(part)
                report.counts['uncommitted parts removed'] += 1


def _remove_unthinned(tree: Tree, index: Index, number: int, part: Path, report: Recovery) -> None:
    """Remove a part beside the whole file of a kept object: the smaller content that it did not get."""
    row = index.objects.full_row(number)
    if (
        row is not None
        and row['state'] == State.KEPT.value
        and tree.is_in_place(State.KEPT, row['bucket'], row['key'], row['bytes'])
    ):
        tree.remove(part)
        report.counts['uncommitted parts removed'] += 1


def any_alive(tree: Tree) -> bool:
    """Whether a process has the spool open."""
    return any(not _is_dead(tree, session) for session in tree.sessions())


def _is_dead(tree: Tree, session: int) -> bool:
    """Whether the process of a session is gone: its lock file can be locked."""
    try:
        descriptor = os.open(tree.session(session), os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    try:
        return lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _settle_session(index: Index, session: int, now_ns: int, report: Recovery) -> None:
    """Close the accounts of a process that died: what was open is lost, and the ledger says so."""
    rows: list[TopicRow] = []
    lost: list[GapRow] = []
    for row in index.accounts.topics(session):
        if row.topic.startswith(SINKS):  # what is open there is in files, which the node looks for (Spool.carry)
            continue
        dropped = {**row.dropped, 'restart': row.dropped.get('restart', 0) + row.open}
        rows.append(replace(row, dropped=dropped) if row.open else row)
        report.counts['messages lost with an open batch'] += row.open
        if row.open > 0:
            gaps = TopicGaps()
            gaps.add(DROPPED, 'restart', row.open, row.last_kept if any(row.last_kept) else row.heard, row.heard)
            lost += gaps.settle(row.topic, {(DROPPED, 'restart', EXACT): row.open})[0]
    with index.transaction():
        index.accounts.write(session, AccountSnapshot(tuple(rows), (), gaps=tuple(lost)))
        index.accounts.end_session(session, now_ns)
