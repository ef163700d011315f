"""The status that a running node writes once a second; where none runs, what its spool says.

``read`` waits for nobody and changes nothing. That no node runs, and even that there is no spool, is an answer and no
error. Whether a node runs is decided by the boot clock, because a robot's wall clock may step.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, Clock, iso
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.stamps import describe
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.usage import usage_of

FRESH_NS: Final = 5 * SECOND
"""A node writes once a second: one that is silent for longer hangs, or is no more."""
RUNNING, NOT_ANSWERING, NOT_RUNNING = 'running', 'not_answering', 'not_running'
NOT_RUNNING_TEXT: Final = 'the node is not running'
FINE_STORE: Final = frozenset({'idle', 'shipping', 'not_draining', 'waiting'})
"""States of delivery that are not a finding; ``not_draining``: another process delivers; ``waiting``: a rule says not now."""
NAMED: Final = 3
"""Topics that a finding names; the figures of the others stand in the table."""
_TOPIC: Final[dict[str, Any]] = {
    'sensor': '', 'type': '', 'enabled': True, 'publishers': 0, 'matched': 0, 'may_be_silent': False, 'unavailable': '',
    'rate_hz': 0.0, 'age_s': None, 'received': 0, 'stored': 0,
    'skipped': 0, 'rejected': 0, 'dropped': 0, 'paused': 0, 'missed': None, 'missed_estimated': None, 'open': 0,
    'accounting': None, 'wrong_type': 0, 'other_types': {}, 'missed_by': {}, 'gaps': 0, 'by_arrival': {}, 'corrected': {},
    'stamps': None,
}  # fmt: skip
_SECTIONS: Final[dict[str, dict[str, Any]]] = {
    'queue': {'batches': 0, 'messages': 0, 'bytes': 0, 'finished': 0, 'max_messages': 0, 'max_bytes': 0},
    'spool': {'path': '', 'pending': 0, 'held': 0, 'quarantined': 0, 'evicted': 0, 'bytes': 0, 'max_bytes': None,
              'kept': 0, 'kept_bytes': 0, 'unkept': 0,
              'free_bytes': None, 'oldest_age_s': None, 'min_free_bytes': None, 'remember_days': None},
    'store': {'target': '', 'state': 'idle', 'last_error': '', 'delivered': 0, 'in_flight': 0, 'deferred': 0, 'retries': 0,
              'quarantined': 0, 'blocked_buckets': {}, 'mbps': 0.0, 'max_mbps': 0.0, 'waits_for': {}, 'left_s': None,
              'stuck': {}},
    'requests': {'open': 0, 'bytes': 0, 'mbps': None, 'left_s': None},
    'middleware': {'rmw': '', 'robot': '', 'why': '', 'asked': '', 'network': '', 'receive_bytes': None, 'dropped_datagrams': 0,
                   'unheard': None},
    'clock': {'is_set': True, 'gave_up': False, 'unset_s': 0.0, 'steps': 0, 'last_step_s': None, 'last_step_age_s': None},
}  # fmt: skip
_WORKER: Final[dict[str, Any]] = {
    'alive': True, 'failing': False, 'failures': 0, 'deaths': 0, 'last_error': '', 'busy_s': 0.0, 'patience_s': None,
}  # fmt: skip
_HEAD: Final[dict[str, Any]] = {
    'version': '', 'pid': 0, 'boot_id': '', 'boot_ns': 0, 'time': '', 'uptime_s': 0.0, 'paused': False, 'ended': False,
    'stalls': {}, 'not_logged': {},
}  # fmt: skip


def file(spool: Path, robot: str) -> Path:
    """Where the node of a robot writes its status."""
    return spool / f'status-{robot}.json'


def robots(spool: Path) -> list[str]:
    """The robots whose nodes have written a status here."""
    return sorted(path.stem.removeprefix('status-') for path in spool.glob('status-*.json'))


def targets(spool: Path) -> list[str]:
    """The stores that the nodes of this spool delivered to when they last wrote a status, as a store describes itself."""
    written = (_load(file(spool, robot)) for robot in robots(spool))
    return sorted({one['store']['target'] for one in written if one} - {''})


def not_logged(spool: Path, robot: str) -> dict[str, str]:
    """Topics that the node of a robot found and did not log when it last wrote its status, and why."""
    written = _load(file(spool, robot))
    return written['not_logged'] if written and isinstance(written['not_logged'], dict) else {}


def limits(spool: Path, own: SpoolSettings) -> SpoolSettings:
    """What the nodes of this spool keep to, the widest of it, or ``own`` where none has run.

    Their parameters are unknown to other processes, which would evict, or forget, by their own defaults what a node may keep.
    """
    said = [one['spool'] for one in (_load(file(spool, robot)) for robot in robots(spool)) if one]
    most, least, days = (
        [one[name] for one in said if isinstance(one[name], (int, float))]
        for name in ('max_bytes', 'min_free_bytes', 'remember_days')
    )
    return replace(own, max_bytes=max(most, default=own.max_bytes), min_free_bytes=min(least, default=own.min_free_bytes),
                   remember_days=max(days, default=own.remember_days))  # fmt: skip


def read(spool: Path, robot: str, clock: Clock) -> dict[str, Any]:
    """The status of a robot's node, as ``shadowhound-data status --json`` prints it.

    ``state`` is running, not_answering (its process is there and silent) or not_running, ``age_s`` the time since the node
    wrote its status (None where that is not known), ``session`` the last one as the index has it, ``findings`` one sentence
    for each thing that somebody should look at. What only a running node can know (topics, queue, store, workers, ...) is
    left out where none runs; ``spool`` is always of now, and None where there is none.
    """
    written = _load(file(spool, robot))
    silent_ns = clock.boot_ns() - written['boot_ns'] if written and written['boot_id'] == clock.boot_id else None
    state = _state(written, silent_ns)
    age_s = None if silent_ns is None else round(silent_ns / SECOND, 3)
    found: dict[str, Any] = {'robot': robot, 'state': state, 'running': state == RUNNING, 'age_s': age_s}
    if written and state != NOT_RUNNING:
        found |= {name: value for name, value in written.items() if name not in found}
    if state != RUNNING:
        found |= _of_index(spool, robot, clock.wall_ns(), written)
    found['findings'] = list(_findings(found))
    return found


def _load(path: Path) -> dict[str, Any] | None:
    """The file with every figure in its place; None without one, or where a power cut left half of it."""
    try:
        given = json.loads(path.read_bytes())
        sections = {name: {**rest, **given.get(name, {})} for name, rest in _SECTIONS.items()}
        topics = {name: {**_TOPIC, **row} for name, row in given.get('topics', {}).items()}
        workers = {name: {**_WORKER, **row} for name, row in given.get('workers', {}).items()}
        return {**_HEAD, **given, **sections, 'topics': topics, 'workers': workers}
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def _state(written: Mapping[str, Any] | None, silent_ns: int | None) -> str:
    if written is None or silent_ns is None or written['ended']:
        return NOT_RUNNING
    if silent_ns < FRESH_NS:
        return RUNNING
    return NOT_ANSWERING if _lives(written['pid'], written['boot_ns']) else NOT_RUNNING


def _lives(pid: int, boot_ns: int) -> bool:
    """Whether the process that wrote the status is there: one of its number, begun before (proc(5), stat, field 22)."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text(encoding='utf-8', errors='replace').rpartition(')')[2].split()
    except OSError:
        return False
    return fields[0] not in 'ZX' and int(fields[19]) * SECOND // os.sysconf('SC_CLK_TCK') <= boot_ns


def _of_index(spool: Path, robot: str, now_ns: int, written: Mapping[str, Any] | None) -> dict[str, Any]:
    """What the spool itself tells: what lies in it, and the node's last session."""
    path = spool / 'index.db'
    if not path.is_file():
        text = f'there is no spool in {spool}: start the node, or name its folder by SHADOWHOUND_HOME'
        return {'spool': None, 'session': None, 'problem': text}
    index = Index(path, read_only=True)
    try:
        index.open()
        known = written['spool'] if written else {'max_bytes': None, 'evicted': 0}
        usage = {'path': str(spool), **asdict(usage_of(index, spool, now_ns)),
                 **{name: known[name] for name in ('max_bytes', 'evicted')}}  # fmt: skip
        return {'spool': usage, 'session': _session(index, robot, written['pid'] if written else 0)}
    except (OSError, sqlite3.Error, SpoolError) as error:
        return {'spool': None, 'session': None, 'problem': f'the spool index {path} cannot be read: {error}'}
    finally:
        index.close()


def _session(index: Index, robot: str, pid: int) -> dict[str, Any] | None:
    """The node's last session: when it began and ended by the wall clock; ``ended`` is None where it was cut off.

    Who sends missions or bags has sessions as well: the node's is that of the process that wrote the status, where one did.
    """
    row = index.accounts.last_session(robot, pid)
    return {'started': iso(row[0]), 'ended': iso(row[1]) if row[1] is not None else None} if row else None


def _findings(found: Mapping[str, Any]) -> Iterator[str]:
    if found['state'] == NOT_RUNNING:
        yield NOT_RUNNING_TEXT
    elif found['state'] == NOT_ANSWERING:
        yield f'the node (process {found["pid"]}) has written no status for {found["age_s"]:.0f} s'
    if 'problem' in found:
        yield found['problem']
    if 'store' not in found:
        return
    store = found['store']
    if found['paused']:
        yield 'the node is paused: nothing is logged'
    if not found['clock']['is_set']:
        what = 'objects go without a date' if found['clock']['gave_up'] else 'objects wait for their date'
        yield f'the clock of this machine is not set: {what}'
    if store['state'] not in FINE_STORE:
        yield f'delivery: {str(store["state"]).replace("_", " ")}'
    yield from store['stuck'].values()
    yield from (f'bucket {name} takes nothing: {reason}' for name, reason in store['blocked_buckets'].items())
    yield from (f'{name} fails: {row["last_error"]}' for name, row in found['workers'].items() if row['failing'])
    yield from (f'{name}: {text}' for name, text in found['stalls'].items())
    yield from (row['text'] for row in (found['middleware']['unheard'] or {}).values())
    yield from _missed(found['topics'], 'missed', 'missed in this session', '')
    for what in ('dropped', 'rejected'):
        lost = {topic: row[what] for topic, row in found['topics'].items() if row[what]}
        if lost:
            yield f'{what} in this session: {_most(lost)}'
    yield from _missed(found['topics'], 'missed_estimated', 'missed in this session, as estimated', '~')
    yield from _by_arrival(found['topics'])
    yield from stamp_findings(found['topics'])
    yield from _other_types(found)
    yield from _left_out(found)
    yield from _given_up(found['spool'] or {})
    if store['quarantined']:
        yield f'quarantined in this session: {store["quarantined"]:,} objects'


def stamp_findings(topics: Mapping[str, Any]) -> Iterator[str]:
    """A line for all topics whose stamps have the same fault: one computer's clock shows on each of its topics."""
    groups: dict[tuple[str, str, int], list[str]] = {}
    for topic, row in topics.items():
        if report := row.get('stamps'):
            groups.setdefault((report['state'], report['cause'], round(report['offset_s'] or 0.0)), []).append(topic)
    for names in groups.values():
        more = f' and {len(names) - NAMED} more' if len(names) > NAMED else ''
        yield f'{", ".join(names[:NAMED])}{more}: {describe(topics[names[0]]["stamps"])}'


def _by_arrival(topics: Mapping[str, Any]) -> Iterator[str]:
    """A line for each reason: a clock that is wrong, old data that is replayed, or a stranger in the network."""
    for reason in sorted({reason for row in topics.values() for reason in row['by_arrival']}):
        found = {topic: row['by_arrival'][reason] for topic, row in topics.items() if row['by_arrival'].get(reason)}
        yield f'dated by arrival in this session, because of {reason}: {_most(found)}'


def _given_up(spool: Mapping[str, Any]) -> Iterator[str]:
    if evicted := spool.get('evicted', 0):
        yield f'evicted in this session: {evicted:,} objects; disk or spool is full (spool.min_free_bytes, spool.max_bytes)'
    if unkept := spool.get('unkept', 0):
        yield f'not kept in this session: {unkept:,} objects, for what is kept is asked for or protected (keep.max_bytes)'


def _left_out(found: Mapping[str, Any]) -> Iterator[str]:
    for what, name in (('bag', 'recorded'), ('events', 'kept for events')):
        if count := found.get(what, {}).get('left_out', 0):
            yield f'{count:,} topics are not {name}: there are too many that no setting names ({what}.topics, {what}.exclude)'


def _other_types(found: Mapping[str, Any]) -> Iterator[str]:
    """Topics that were published under another type than the one that is logged, of sensors, bags and events."""
    for where in (found['topics'], found.get('bag', {}).get('topics', {}), found.get('events', {}).get('topics', {})):
        others = [(topic, name, other) for topic, row in where.items() for name, other in row.get('other_types', {}).items()]
        yield from (_other_type(topic, where[topic], name, other) for topic, name, other in others[:NAMED])
        if len(others) > NAMED:
            yield f'and {len(others) - NAMED} more types on topics that carry another one'


def _other_type(topic: str, row: Mapping[str, Any], name: str, other: Mapping[str, Any]) -> str:
    by = ', '.join(other['publishers']) or 'a program that is not a ROS node'
    count = other['messages']
    what = 'it was not listened to: the number of messages is not known' if count is None else f'{count:,} messages were refused'
    return f'{topic} was published as {name} too, by {by}, and is logged as {row["type"] or "nothing"} alone; {what}'


def _missed(topics: Mapping[str, Any], what: str, text: str, mark: str) -> Iterator[str]:
    """A line for each cause, so that what a restart cost is told from what the network lost."""
    rows = {topic: row for topic, row in topics.items() if row[what]}
    by_cause = {topic: row['missed_by'] or {'': row[what]} for topic, row in rows.items()}
    for cause in sorted({cause for causes in by_cause.values() for cause in causes}):
        lost = {topic: causes[cause] for topic, causes in by_cause.items() if cause in causes}
        yield f'{text}{cause and f" by {cause}"}: {_most(lost, mark)}'


def _most(counts: Mapping[str, int], mark: str = '') -> str:
    """``/imu 340, /odom 170, /lowstate 68 and 5 more``."""
    first = sorted(counts, key=lambda topic: (-counts[topic], topic))[:NAMED]
    more = f' and {len(counts) - NAMED} more' if len(counts) > NAMED else ''
    return ', '.join(f'{topic} {mark}{counts[topic]:,}' for topic in first) + more
