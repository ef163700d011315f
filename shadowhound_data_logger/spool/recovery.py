"""Recovery before a spool is used again: makes index and tree agree, in both directions (docs/decisions/0001).

Afterwards every pending, held and quarantined row has its file, every file has its row, and sessions of dead processes are
settled: messages that they received without an outcome are dropped with the reason ``restart``.

A part or staged file without a row was never committed and is removed; but a power cut may have undone the rename of a staged
file to the part of a durable row. This is different if the index lost commits: if it is new, lacks a session whose file exists,
or a session died and left no write-ahead log (SQLite removes the log only at a clean shutdown). Then a part that matches its
description is adopted, as are files under their final names. If such a part had not been committed after all, its samples count
as stored and as lost at the restart, which is better than the opposite. A damaged log cannot be detected; with it, files that
were being renamed at that moment are lost.

This module repairs the spool; ``bags/recovery.py`` decides about bags, ``formats/mcap/recovery.py`` repairs the bytes of a slice.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, TopicRow
from shadowhound_data_logger.spool.adoption import Adoption, Recovery, recorded_place
from shadowhound_data_logger.spool.ballast import is_disk_full
from shadowhound_data_logger.spool.binding import renew
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.gaps import DROPPED, EXACT, GapRow, TopicGaps
from shadowhound_data_logger.spool.index import Index, suspicion_of
from shadowhound_data_logger.spool.ledger import imbalances, of_index
from shadowhound_data_logger.spool.object_table import MISSING, STATES_IN_SPOOL
from shadowhound_data_logger.spool.session import SessionFiles
from shadowhound_data_logger.spool.topic_account import SINKS

log = logging.getLogger(__name__)

DAMAGED: Final = 'damaged'
REBUILT: Final = 'damaged index rebuilt'
CHECKED_FIRST_BYTES: Final = 8 << 20
"""An index up to this size is checked before it is used, which takes 0.1 s; a larger one while it is in use (index_check.py)."""
MICROSECOND: Final = 1000
_DAMAGE_MESSAGES: Final = ('malformed', 'disk I/O', 'already exists', 'no such', 'decode', 'unsupported file format')


def open_recovered(tree: Tree, now_ns: int, report: Recovery) -> Index:
    """The index, intact and in agreement with the tree; a damaged one is renamed to ``index.db.damaged-N`` and rebuilt.

    The caller holds the recovery lock. Raises OSError or sqlite3.OperationalError if the folder cannot be used, SpoolError
    for an index with a newer version.
    """
    path = tree.root / 'index.db'
    while True:
        path.touch(mode=0o600)
        index = Index(path)
        has_log = bool(Tree.size(Path(f'{path}-wal')))
        try:
            index.open()
            _check(index, path, report)
            _recover(tree, index, now_ns, report, has_log=has_log)
        except (sqlite3.Error, ValueError, TypeError, AttributeError, OverflowError) as error:
            index.close()
            if report.counts[REBUILT] or not _is_damage(path, error):
                raise
            log.exception('the spool index %s is damaged and will be rebuilt from the files', path)
            report.counts[REBUILT] += 1
            _set_aside(path)
        except BaseException:
            index.close()
            raise
        else:
            return index


def _check(index: Index, path: Path, report: Recovery) -> None:
    """Check all of a small or suspected index, of another one what the recovery uses: the node checks the rest later."""
    suspicion = suspicion_of(path)
    report.is_checked = path.stat().st_size <= CHECKED_FIRST_BYTES or suspicion.exists()
    if report.is_checked:
        index.check()
        suspicion.unlink(missing_ok=True)
    else:
        index.check_spool()


def _is_damage(path: Path, error: Exception) -> bool:
    """Whether an error means that the index is damaged, rather than temporarily unusable.

    A flipped bit can give a record a value of any type, so errors that are not SQLite's mean damage, too.
    """
    if not isinstance(error, sqlite3.OperationalError):
        return True
    if is_disk_full(error, path.parent):
        return False
    if 'readonly' in str(error):  # a flipped bit of the header has the same effect
        return os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return any(text in str(error) for text in _DAMAGE_MESSAGES)


def _set_aside(path: Path) -> None:
    number = 1
    while (target := path.with_name(f'{path.name}.damaged-{number}')).exists():
        number += 1
    os.replace(path, target)
    for suffix in ('-wal', '-shm', '.suspect'):
        Path(f'{path}{suffix}').unlink(missing_ok=True)


def _recover(tree: Tree, index: Index, now_ns: int, report: Recovery, *, has_log: bool) -> None:
    """Make index and tree agree, and settle dead sessions."""
    sessions = SessionFiles(tree.root)
    _skip_used_numbers(sessions, index, now_ns)
    _follow_rows(tree, sessions, index, now_ns, report)
    _settle_parts(tree, index, report, adopt=_lost_commits(sessions, index, has_log=has_log))
    Adoption(tree, index, now_ns, report).run()
    for session in index.accounts.sessions(ended=False):
        if sessions.is_dead(session):
            _settle_session(index, session, now_ns, report)
    for session in sessions.numbers().difference(index.accounts.sessions(ended=False)):
        if sessions.is_dead(session):
            tree.remove(sessions.path(session))
    for session, body in tree.staged():
        if sessions.is_dead(session):
            tree.remove(body)
            report.counts['files not committed'] += 1
    for sentence in imbalances(of_index(index, '')) or index.miscounted():
        log.error('the ledger of %s does not balance because its index was damaged: %s', tree.root, sentence)
        report.counts['sums of the ledger that do not balance'] += 1
    tree.prune()


def _skip_used_numbers(sessions: SessionFiles, index: Index, now_ns: int) -> None:
    """Make the numbers of a rebuilt index differ from those that a running process used with the lost one.

    Numbers start with the time in microseconds: recovery adopts more than one file per millisecond, so with milliseconds two
    indexes that are rebuilt shortly after each other could use the same number.
    """
    known = {*index.accounts.sessions(ended=False), *index.accounts.sessions(ended=True)}
    unknown = sessions.numbers().difference(known)
    if unknown:
        with index.transaction():
            index.accounts.begin_after(max(unknown), now_ns // MICROSECOND)


def _follow_rows(tree: Tree, sessions: SessionFiles, index: Index, now_ns: int, report: Recovery) -> None:
    """Move every row's file to where the row's state requires it. Other processes may deliver at the same time."""
    missing: list[int] = []
    damaged: list[tuple[sqlite3.Row, Path]] = []
    staged = _StagedFiles(tree, sessions)
    for row in index.objects.in_spool():
        state = State(row['state'])
        if state is State.QUARANTINED and row['reason'] == MISSING:
            continue
        json.loads(row['metadata'])  # raises for damage that SQLite does not detect and that would stop all delivery later
        if state in {State.PENDING, State.KEPT} and tree.is_in_place(state, row['bucket'], row['key'], row['bytes']):
            continue
        path = where = tree.path(state, row['reason'], row['bucket'], row['key'])
        if state is State.KEPT and tree.size(tree.part(row['id'])) == row['bytes']:  # thinned, but not renamed yet
            report.counts['renames completed'] += tree.move(tree.part(row['id']), path)
        if tree.size(path) is None:
            # Check its own place again last: another process may have just moved it there.
            ready, kept = (tree.path(of, None, row['bucket'], row['key']) for of in (State.PENDING, State.KEPT))
            places = (tree.part(row['id']), ready, kept, path)
            found = next((place for place in places if tree.size(place) is not None), None) or staged.pop_content(row)
            if found is None:
                missing.append(row['id'])
                continue
            where = found
            if state is State.QUARANTINED and found == ready and tree.size(found) == row['bytes']:
                # An operator moved it there to retry it, or the power failed while it was quarantined: then a retry is harmless.
                with index.transaction():
                    index.states.set_found(row['id'])
                report.counts['quarantined files to be tried again'] += 1
            elif found != path and tree.move(found, path):
                where = path
                renew(index, row['id'], path)  # a part may have the description of its former or its new state
                report.counts['renames completed'] += 1
        if state is not State.QUARANTINED and tree.size(where) not in {row['bytes'], None}:
            damaged.append((row, where))
    if missing or damaged:
        with index.transaction():
            report.counts['files missing'] += index.states.set_missing(missing, now_ns)
            index.states.move([row['id'] for row, _ in damaged], State.QUARANTINED, DAMAGED, now_ns)
    for row, where in damaged:
        tree.move(where, tree.path(State.QUARANTINED, DAMAGED, row['bucket'], row['key']))
        report.counts['files damaged'] += 1


class _StagedFiles:
    """Staged files of dead processes: a power cut may have undone the rename of a committed one to its part."""

    def __init__(self, tree: Tree, sessions: SessionFiles) -> None:
        self._files = [body for session, body in tree.staged() if sessions.is_dead(session)]

    def pop_content(self, row: sqlite3.Row) -> Path | None:
        """A file with the content of the row's object; each file only once."""
        for body in self._files:
            if Tree.size(body) == row['bytes'] and fingerprint(body)[1] == row['sha256']:
                self._files.remove(body)
                return body
        return None


def _lost_commits(sessions: SessionFiles, index: Index, *, has_log: bool) -> bool:
    """Whether commits may have been lost with an earlier index or with the write-ahead log."""
    dead = [session for session in index.accounts.sessions(ended=False) if sessions.is_dead(session)]
    known = {*index.accounts.sessions(ended=False), *index.accounts.sessions(ended=True)}
    return not known or not known.issuperset(sessions.numbers()) or (bool(dead) and not has_log)


def _settle_parts(tree: Tree, index: Index, report: Recovery, *, adopt: bool) -> None:
    """Remove parts without a row, or move them where their descriptions say that they belong."""
    # In a transaction, because another process that is about to commit a part holds the write lock.
    with index.transaction():
        for number, part in tree.parts():
            if index.objects.state(number) in STATES_IN_SPOOL:
                _remove_unthinned(tree, index, number, part, report)
                continue
            place = recorded_place(tree, part) if adopt else None
            if place is None or not tree.move(part, place):
                tree.remove(part)
                report.counts['uncommitted parts removed'] += 1


def _remove_unthinned(tree: Tree, index: Index, number: int, part: Path, report: Recovery) -> None:
    """Remove the part of a kept object whose file is complete: the part is the result of a thinning that was not committed."""
    row = index.objects.full_row(number)
    if (
        row is not None
        and row['state'] == State.KEPT.value
        and tree.is_in_place(State.KEPT, row['bucket'], row['key'], row['bytes'])
    ):
        tree.remove(part)
        report.counts['uncommitted parts removed'] += 1


def _settle_session(index: Index, session: int, now_ns: int, report: Recovery) -> None:
    """End the session of a dead process: its open messages are dropped."""
    rows: list[TopicRow] = []
    lost: list[GapRow] = []
    for row in index.accounts.topics(session):
        if row.topic.startswith(SINKS):  # its open messages are in files, which the node reads (Spool.carry)
            continue
        dropped = {**row.dropped, 'restart': row.dropped.get('restart', 0) + row.open}
        rows.append(replace(row, dropped=dropped) if row.open else row)
        report.counts['messages lost with an open batch'] += row.open
        if row.open > 0:
            gaps = TopicGaps()
            gaps.add(DROPPED, 'restart', row.open, row.last_stored if any(row.last_stored) else row.newest, row.newest)
            lost += gaps.settle(row.topic, {(DROPPED, 'restart', EXACT): row.open})[0]
    with index.transaction():
        index.accounts.write(session, AccountSnapshot(tuple(rows), (), gaps=tuple(lost)))
        index.accounts.end_session(session, now_ns)
