"""The values that the page shows: the node's status, the ledger and today's gaps, read from the spool without changing it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, Clock, utc
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.stamps import BY_STAMP, describe
from shadowhound_data_logger.core.status import TopicStatus
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.gaps import OBJECTS
from shadowhound_data_logger.spool.status import read as read_status

_HEAD: Final = (
    'robot',
    'state',
    'age_s',
    'time',
    'uptime_s',
    'version',
    'paused',
    'mission',
    'clock',
    'queue',
    'spool',
    'session',
)
_OF_STORE: Final = ('target', 'state', 'last_error', 'mbps', 'max_mbps', 'in_flight', 'delivered', 'waits_for', 'left_s')
_OF_LEDGER: Final = ('received', 'stored', 'skipped', 'missed', 'missed_estimated', 'accounting')
_OF_STATUS: Final = ('sensor', 'enabled', 'rate_hz', 'size', 'age_s', 'publishers', 'unavailable', 'may_be_silent')
MAX_GAPS: Final = 4000
"""Maximum rows of the timeline; beyond it, neighboring gaps of a topic and cause are merged."""
DAY_NS: Final = 24 * 3600 * SECOND


class SpoolFigures:
    """Reads the spool of one robot. From one thread at a time."""

    def __init__(self, spool: Path, robot: str, clock: Clock) -> None:
        self._spool, self._robot, self._clock = spool, robot, clock
        self._ledger: ledger.Ledger | None = None
        self._problem = ''

    def now(self, *, with_ledger: bool) -> dict[str, Any]:
        """The current values; with ``with_ledger`` also those of the ledger.

        ``topics``: received, stored, missed and so on as in ``ledger --json``, the rest as in ``status --json``.
        """
        report = read_status(self._spool, self._robot, self._clock)
        if with_ledger:
            try:
                self._ledger, self._problem = ledger.read(self._spool, self._robot), ''
            except DataLoggerError as error:
                self._ledger, self._problem = None, str(error)
        found, live = self._ledger, report.node.topics
        status = replace(report, node=replace(report.node, topics={})).as_dict()
        accounts = found['topics'] if found else {}
        return {
            **{name: status.get(name) for name in _HEAD},
            'findings': [*report.findings, *([self._problem] if self._problem else [])],
            'store': {name: status.get('store', {}).get(name) for name in _OF_STORE},
            'bag': _without(status.get('bag'), 'topics'), 'events': _without(status.get('events'), 'topics'),
            **{name: found.get(name) if found else None for name in ('balanced', 'objects', 'bytes')},
            'topics': [_row(topic, accounts.get(topic), live.get(topic)) for topic in sorted({*accounts, *live})],
        }  # fmt: skip

    def gaps(self, since_ns: int | None = None, until_ns: int | None = None, by: str = BY_STAMP) -> dict[str, Any]:
        """All gaps between two times (by default today), and for which times they are known, per topic.

        ``known``: [topic, since, until]; within it no row means no gap, beyond it gaps are unknown. Times are UTC in ms.
        """
        now_ns = self._clock.wall_ns()
        midnight = utc(now_ns).replace(hour=0, minute=0, second=0, microsecond=0)
        since_ns = since_ns if since_ns is not None else int(midnight.timestamp()) * SECOND
        until_ns = until_ns if until_ns is not None else int((midnight + timedelta(days=1)).timestamp()) * SECOND
        is_by_stamp = by == BY_STAMP
        gaps = [
            (gap.sink, gap.topic, gap.kind, gap.cause, *times, gap.count or 0, gap.grade)
            for gap in ledger.journal(self._spool, self._robot)
            if _is_within(times := (gap.from_ns, gap.to_ns) if is_by_stamp else (gap.received_from_ns, gap.received_to_ns),
                          since_ns, until_ns)
        ]  # fmt: skip
        known = [
            (mark.topic, *times) for mark in ledger.watermarks(self._spool)
            if mark.sink == OBJECTS and _is_within(
                times := (mark.since_ns, mark.complete_ns) if is_by_stamp
                else (mark.received_since_ns, mark.received_complete_ns), since_ns, until_ns)
        ]  # fmt: skip
        return gap_rows(sorted(gaps, key=lambda gap: gap[4]), known, since_ns, until_ns, now_ns)


def gap_rows(gaps: Sequence[tuple[Any, ...]], known: Sequence[tuple[Any, ...]], since_ns: int, until_ns: int,
              now_ns: int) -> dict[str, Any]:  # fmt: skip
    """As ``SpoolFigures.gaps``, from gaps sorted by time with its columns, times in ns."""
    grain_ns = (until_ns - since_ns) // MAX_GAPS if len(gaps) > MAX_GAPS else 0
    merged: dict[tuple[str, str, str, str], list[Any]] = {}
    shown: list[list[Any]] = []
    for sink, topic, kind, cause, from_ns, to_ns, count, grade in gaps:
        key = sink, topic, kind, cause
        last = merged.get(key)
        if last is not None and grain_ns and from_ns - last[5] < grain_ns:
            last[5], last[6] = max(last[5], to_ns), last[6] + count
            continue
        merged[key] = [*key, from_ns, to_ns, count, grade]
        shown.append(merged[key])
    for row in shown:
        row[4:6] = row[4] / 1e6, row[5] / 1e6
    return {
        'from': since_ns / 1e6, 'to': until_ns / 1e6, 'now': now_ns / 1e6,
        'columns': ['sink', 'topic', 'kind', 'cause', 'from', 'to', 'count', 'grade'], 'gaps': shown,
        'known': [[topic, from_ns / 1e6, to_ns / 1e6] for topic, from_ns, to_ns in known],
    }  # fmt: skip


def _is_within(times: tuple[int | None, int | None], since_ns: int, until_ns: int) -> bool:
    from_ns, to_ns = times
    return from_ns is not None and to_ns is not None and to_ns >= since_ns and from_ns <= until_ns


def _row(topic: str, account: ledger.TopicFigures | None, live: TopicStatus | None) -> dict[str, Any]:
    return {
        'topic': topic,
        'type': (account and account['type']) or (live.type if live is not None else ''),
        **{name: account.get(name) if account else None for name in _OF_LEDGER},
        'lost': sum(account['rejected'].values()) + sum(account['dropped'].values()) if account else 0,
        'pending': account['stored_in']['pending'] if account else 0,
        'stamps': describe(live.stamps) if live is not None and live.stamps else '',
        **{name: getattr(live, name, None) for name in _OF_STATUS},
    }


def _without(section: Mapping[str, Any] | None, name: str) -> dict[str, Any] | None:
    return None if section is None else {key: value for key, value in section.items() if key != name}
