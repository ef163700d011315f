"""The status of a robot's node, read from the file that a running node writes once per second, otherwise from its spool.

``read`` does not block and changes nothing. A node that does not run, and even a missing spool, is an answer, not an error.
Whether a node runs is decided by the boot clock, because a robot's wall clock may step.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, Clock, iso
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.dataclass_json import as_plain, parse
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.stamps import describe
from shadowhound_data_logger.core.status import NodeStatus, OtherType, SpoolStatus, TopicStatus, Totals
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, from_strict_json
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.local_robot import robots

FRESH_NS: Final = 5 * SECOND
"""A node writes once per second: one that is silent for longer hangs or has exited."""
RUNNING, NOT_ANSWERING, NOT_RUNNING = 'running', 'not_answering', 'not_running'
NOT_RUNNING_TEXT: Final = 'the node is not running'
FINE_STORE: Final = frozenset({'idle', 'shipping', 'not_draining', 'waiting'})
"""States of delivery that are not a finding; ``not_draining``: another process delivers; ``waiting``: a rule delays uploads."""
STOPPED_STORE: Final = {
    'store_down': 'the store cannot be reached: objects wait on the disk',
    'paused': 'an error stops uploads: objects wait on the disk',
}
"""The findings for the others."""
NAMED: Final = 3
"""Topics that a finding names; the table has the others."""


@dataclass(frozen=True, slots=True)
class NodeSession:
    """The last session of a node, by the wall clock."""

    started: str
    ended: str | None
    """None if it did not end cleanly, or is running."""


@dataclass(frozen=True, slots=True)
class NodeReport:
    """The status of the node of a robot."""

    robot: str
    """Empty if no node has run here."""
    state: str
    """``running``, ``not_answering`` (its process exists but writes no status) or ``not_running``."""
    age_s: float | None
    """Since the node wrote its status; None if unknown."""
    node: NodeStatus
    """As the node wrote it; without figures if it does not run."""
    spool: SpoolStatus | None
    """The current content of the spool; None if there is none."""
    session: NodeSession | None = None
    """None while the node runs."""
    problem: str = ''
    """Why the status file or the index cannot be read."""
    findings: tuple[str, ...] = ()
    """One sentence for each thing that needs attention."""

    @property
    def running(self) -> bool:
        return self.state == RUNNING

    def as_dict(self) -> dict[str, Any]:
        """The report as ``shadowhound-data status --json`` prints it; if no node runs, without the fields that only it knows."""
        node = as_plain(self.node) if self.state != NOT_RUNNING else {}
        found = {'state': self.state, 'running': self.running, 'age_s': self.age_s, 'spool': as_plain(self.spool)}
        if not self.running:
            found['session'] = as_plain(self.session)
        if self.problem:
            found['problem'] = self.problem
        return {'robot': self.robot or None, **node, **found, 'findings': list(self.findings)}


def file(spool: Path, robot: str) -> Path:
    """The status file of the node of a robot."""
    return spool / f'status-{robot}.json'


def targets(spool: Path) -> list[str]:
    """The stores that the nodes of this spool delivered to when they last wrote a status, as a store describes itself."""
    return sorted({written.store.target for written in _all_written(spool)} - {''})


def not_logged(spool: Path, robot: str) -> Mapping[str, str]:
    """Topics that the node of a robot found and did not log when it last wrote its status, and why."""
    return _written(spool, robot)[0].not_logged


def limits(spool: Path, own: SpoolSettings) -> SpoolSettings:
    """The widest limits of the nodes of this spool, or ``own`` if none has run.

    Other processes do not have the nodes' parameters: with their own defaults they would evict or forget objects that a node
    keeps.
    """
    written = [each.spool for each in _all_written(spool)]
    return replace(
        own,
        max_bytes=max((each.max_bytes for each in written if each.max_bytes is not None), default=own.max_bytes),
        min_free_bytes=min((each.min_free_bytes for each in written if each.min_free_bytes is not None),
                           default=own.min_free_bytes),
        remember_days=max((each.remember_days for each in written if each.remember_days is not None),
                          default=own.remember_days),
    )  # fmt: skip


def read(spool: Path, robot: str, clock: Clock) -> NodeReport:
    """The status of the node of a robot."""
    written, problem = _written(spool, robot)
    silent_ns = clock.boot_ns() - written.boot_ns if written.boot_id == clock.boot_id else None
    state = _state(written, silent_ns)
    age_s = None if silent_ns is None else round(silent_ns / SECOND, 3)
    node = written if state != NOT_RUNNING else NodeStatus()
    report = NodeReport(robot, state, age_s, node, node.spool, problem=problem)
    if state != RUNNING:
        report = _with_index(report, spool, written, clock.wall_ns())
    return replace(report, findings=tuple(_findings(report)))


def _all_written(spool: Path) -> list[NodeStatus]:
    return [_written(spool, robot)[0] for robot in robots(spool)]


def _written(spool: Path, robot: str) -> tuple[NodeStatus, str]:
    """The last status of a node, and why it cannot be read; a power cut may damage it. Without figures if there is none."""
    path = file(spool, robot)
    try:
        return parse(NodeStatus, from_strict_json(path.read_bytes(), MAX_DOCUMENT_BYTES)), ''
    except FileNotFoundError:
        return NodeStatus(), ''
    except (OSError, ValueError) as error:
        return NodeStatus(), f'the status {path} cannot be read: {error}'


def _state(written: NodeStatus, silent_ns: int | None) -> str:
    if silent_ns is None or written.ended:
        return NOT_RUNNING
    if silent_ns < FRESH_NS:
        return RUNNING
    return NOT_ANSWERING if _is_running(written.pid, written.boot_ns) else NOT_RUNNING


def _is_running(pid: int, boot_ns: int) -> bool:
    """Whether the process that wrote the status exists: one with its pid that started before (proc(5), stat, field 22)."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text(encoding='utf-8', errors='replace').rpartition(')')[2].split()
    except OSError:
        return False
    return fields[0] not in 'ZX' and int(fields[19]) * SECOND // os.sysconf('SC_CLK_TCK') <= boot_ns


def _with_index(report: NodeReport, folder: Path, written: NodeStatus, now_ns: int) -> NodeReport:
    """The report with the content of the spool and the last session, from the index."""
    path = folder / 'index.db'
    if not path.is_file():
        text = f'there is no spool in {folder}: start the node, or set SHADOWHOUND_HOME to its folder'
        return replace(report, spool=None, problem=report.problem or text)
    index = Index(path, read_only=True)
    last = written.spool
    try:
        index.open()
        spool = replace(index.usage(now_ns), evicted=last.evicted, unkept=last.unkept, max_bytes=last.max_bytes,
                        min_free_bytes=last.min_free_bytes, remember_days=last.remember_days)  # fmt: skip
        return replace(report, spool=spool, session=_session(index, report.robot, written.pid))
    except (OSError, sqlite3.Error, SpoolError) as error:
        return replace(report, spool=None, problem=f'the spool index {path} cannot be read: {error}')
    finally:
        index.close()


def _session(index: Index, robot: str, pid: int) -> NodeSession | None:
    """The last session, preferably of the process that wrote the status: agents and bag uploads have sessions, too."""
    row = index.accounts.last_session(robot, pid)
    return NodeSession(iso(row[0]), iso(row[1]) if row[1] is not None else None) if row else None


def _findings(report: NodeReport) -> Iterator[str]:
    node = report.node
    if report.state == NOT_RUNNING:
        yield NOT_RUNNING_TEXT
    elif report.state == NOT_ANSWERING:
        yield f'the node (process {node.pid}) has written no status for {report.age_s:.0f} s'
    if report.problem:
        yield report.problem
    if report.state != NOT_RUNNING:
        yield from _faults(node)
        yield from _losses(node.topics)
        for topics in (node.topics, node.bag.topics, node.events.topics):
            yield from _other_types(topics)
        yield from _too_many_topics(node)
        yield from _evicted(report.spool or SpoolStatus())
        if node.store.quarantined:
            yield f'quarantined in this session: {node.store.quarantined:,} objects'


def stopped(state: str) -> str:
    """The finding for a state of delivery that is not fine."""
    return STOPPED_STORE.get(state, f'delivery: {state.replace("_", " ")}')


def _faults(node: NodeStatus) -> Iterator[str]:
    """What is failing now."""
    store = node.store
    if node.paused:
        yield 'the node is paused: nothing is logged'
    if not node.clock.is_set:
        what = 'objects go without a date' if node.clock.gave_up else 'objects wait for their date'
        yield f'the clock of this machine is not set: {what}'
    if store.state not in FINE_STORE:
        yield stopped(store.state)
    yield from store.stuck.values()
    yield from (f'bucket {name} takes nothing: {reason}' for name, reason in store.blocked_buckets.items())
    yield from (f'{name} fails: {worker.last_error}' for name, worker in node.workers.items() if worker.failing)
    yield from (f'{name}: {text}' for name, text in node.stalls.items())
    yield from (row.text for row in (node.middleware.undiscovered or {}).values())


def _losses(topics: Mapping[str, TopicStatus]) -> Iterator[str]:
    """What was lost in this session, and which stamps are not trusted."""
    missed = {topic: (row.missed, row.missed_by) for topic, row in topics.items()}
    yield from _missed(missed, 'missed in this session', '')
    for what in ('dropped', 'rejected'):
        lost = {topic: count for topic, row in topics.items() if (count := getattr(row, what))}
        if lost:
            yield f'{what} in this session: {_most(lost)}'
    missed = {topic: (row.missed_estimated, row.missed_by) for topic, row in topics.items()}
    yield from _missed(missed, 'missed in this session, as estimated', '~')
    yield from _by_arrival(topics)
    yield from _untrusted_stamps(topics)


def _untrusted_stamps(topics: Mapping[str, TopicStatus]) -> Iterator[str]:
    """One line for all topics whose stamps have the same fault, because a wrong clock affects all topics of a computer."""
    groups: dict[tuple[str, str, int], list[str]] = {}
    lines: dict[tuple[str, str, int], str] = {}
    for topic, row in topics.items():
        if report := row.stamps:
            fault = report.state, report.cause, round(report.offset_s or 0.0)
            groups.setdefault(fault, []).append(topic)
            lines.setdefault(fault, describe(report))
    for fault, names in groups.items():
        more = f' and {len(names) - NAMED} more' if len(names) > NAMED else ''
        yield f'{", ".join(names[:NAMED])}{more}: {lines[fault]}'


def _by_arrival(topics: Mapping[str, TopicStatus]) -> Iterator[str]:
    """One line per reason: a wrong clock, replayed data, or a stranger in the network."""
    for reason in sorted({reason for row in topics.values() for reason in row.by_arrival}):
        found = {topic: row.by_arrival[reason] for topic, row in topics.items() if row.by_arrival.get(reason)}
        yield f'dated by arrival in this session, because of {reason}: {_most(found)}'


def _evicted(spool: SpoolStatus) -> Iterator[str]:
    if spool.evicted:
        yield f'evicted in this session: {spool.evicted:,} objects; disk or spool is full (spool.min_free_bytes, spool.max_bytes)'
    if spool.unkept:
        yield (
            f'not kept in this session: {spool.unkept:,} objects, because all kept objects are requested or protected '
            '(keep.max_bytes)'
        )


def _too_many_topics(node: NodeStatus) -> Iterator[str]:
    for what, name, count in (('bag', 'recorded', node.bag.left_out), ('events', 'kept for events', node.events.left_out)):
        if count:
            yield f'{count:,} topics are not {name}: there are too many that no setting names ({what}.topics, {what}.exclude)'


def _other_types(topics: Mapping[str, Totals]) -> Iterator[str]:
    """Topics that were also published under a type that is not logged."""
    others = [(topic, row, name, other) for topic, row in topics.items() for name, other in row.other_types.items()]
    yield from (_other_type(*found) for found in others[:NAMED])
    if len(others) > NAMED:
        yield f'and {len(others) - NAMED} more types on topics that carry another one'


def _other_type(topic: str, row: Totals, name: str, other: OtherType) -> str:
    by = ', '.join(other.publishers) or 'a program that is not a ROS node'
    count = other.messages
    what = 'these messages were not received or counted' if count is None else f'{count:,} messages were rejected'
    return f'{topic} was also published as {name}, by {by}, but is only logged as {row.type or "nothing"}; {what}'


def _missed(topics: Mapping[str, tuple[int | None, Mapping[str, int]]], text: str, mark: str) -> Iterator[str]:
    """One line per cause, so that losses by a restart are separate from losses in the network."""
    by_cause = {topic: causes or {'': missed} for topic, (missed, causes) in topics.items() if missed}
    for cause in sorted({cause for causes in by_cause.values() for cause in causes}):
        lost = {topic: causes[cause] for topic, causes in by_cause.items() if cause in causes}
        yield f'{text}{cause and f" by {cause}"}: {_most(lost, mark)}'


def _most(counts: Mapping[str, int], mark: str = '') -> str:
    """``/imu 340, /odom 170, /lowstate 68 and 5 more``."""
    first = sorted(counts, key=lambda topic: (-counts[topic], topic))[:NAMED]
    more = f' and {len(counts) - NAMED} more' if len(counts) > NAMED else ''
    return ', '.join(f'{topic} {mark}{counts[topic]:,}' for topic in first) + more
