"""Overview of all robots in a store: last contact, last mission, today's losses and how far these are known.

Everything is from the catalog and the gap journal. It needs the extra ``lake``.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.formats.rows.catalog import OBJECTS, UNDATED
from shadowhound_data_logger.formats.rows.gaps import GAP, GAPS
from shadowhound_data_logger.lake import gaps as journal
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import robots
from shadowhound_data_logger.lake.tables import answer
from shadowhound_data_logger.lake.views import dates, views
from shadowhound_data_logger.spool.retention import NO_ROOM

DAY_NS: Final = 24 * 3600 * SECOND
RECENT_DAYS: Final = 7
"""Of robots that were silent for longer, only the day of their last object is known."""
SILENT_NS: Final = DAY_NS
BEHIND_NS: Final = 600 * SECOND
"""A robot whose gap reports are further behind its newest object still has some to send."""
MAX_ROBOTS: Final = 2000
MAX_TEXT: Final = 160
BAD, WATCH, SILENT, GOOD = 'bad', 'watch', 'none', 'good'
ORDER: Final = (BAD, WATCH, GOOD, SILENT)
"""The most important first; a robot that is off is last."""
HARMFUL: Final = frozenset({'dropped', 'rejected', 'quarantined', 'evicted'})
"""Kinds of gaps in which the robot lost messages that it had received; others never reached it."""


@dataclass(slots=True)
class RobotRow:
    """What is known about one robot; times in ns, 0 for unknown."""

    robot: str
    last_ns: int = 0
    """Arrival of its newest message in the store at the robot, otherwise the start of its newest object."""
    last_date: str = ''
    mission: str = ''
    mission_type: str = ''
    mission_ns: int = 0
    known_ns: int = 0
    """Its gaps are known up to here."""
    lost: Counter[str] = field(default_factory=Counter)
    """Cause -> messages since midnight (UTC)."""
    harmful: int = 0
    no_room: int = 0
    """Today's messages that were deleted because the disk or the spool was full."""
    quarantined: int = 0
    """Today's messages in quarantine."""

    def state(self, now_ns: int) -> tuple[str, str]:
        """Its state for the overview, and why."""
        if self.harmful:
            return BAD, 'it lost data that it had received'
        if self.lost:
            return WATCH, 'messages are missing today'
        if not self.last_ns and not self.last_date:
            return SILENT, 'the catalog has no data of it yet'
        if not self.last_ns or now_ns - self.last_ns > SILENT_NS:
            return SILENT, 'nothing arrived for more than a day'
        if self.last_ns - self.known_ns > BEHIND_NS:
            return WATCH, 'it has not reported the gaps of its newest data yet'
        return GOOD, 'nothing is missing today'

    def to_json(self, now_ns: int) -> dict[str, Any]:
        state, why = self.state(now_ns)
        times = {name: round(at_ns / 1e6) if at_ns else None for name, at_ns in
                 (('last', self.last_ns), ('known', self.known_ns), ('mission_at', self.mission_ns))}  # fmt: skip
        return {'robot': self.robot, 'state': state, 'why': why, 'last_date': self.last_date, 'mission': _text(self.mission),
                'mission_type': _text(self.mission_type), 'lost': sum(self.lost.values()),
                'causes': [[_text(cause), count] for cause, count in self.lost.most_common(3)], 'no_room': self.no_room,
                'quarantined': self.quarantined, **times}  # fmt: skip


def overview(source: Bucket, findings: Findings, now_ns: int | None = None) -> list[RobotRow]:
    """Every robot of a store, the most important first. Raises StoreError, LakeError."""
    now_ns = time.time_ns() if now_ns is None else now_ns
    found = {name: RobotRow(name) for name in robots(source)[:MAX_ROBOTS]}
    first = f'{utc(now_ns - RECENT_DAYS * DAY_NS):%Y-%m-%d}'
    with views(source, [OBJECTS, GAPS], findings, has_date=lambda date: date >= first) as ready:
        last = answer(ready, _LAST.format(first))
    for each in last.to_pylist():
        row = found.get(each['robot'])
        if row is None:
            continue
        row.last_ns = max(row.last_ns, each['last_ns'] or 0)
        if each['mission_id'] and (each['mission_ns'] or 0) > row.mission_ns:
            row.mission, row.mission_type = each['mission_id'], each['mission_type'] or ''
            row.mission_ns = each['mission_ns']
    midnight_ns = now_ns - now_ns % DAY_NS
    statements = journal.newest(source, since_ns=midnight_ns - DAY_NS, findings=findings).to_pylist()
    for each in statements:
        _add(found, each, midnight_ns, now_ns)
    for name, row in found.items():
        if not row.last_ns:
            row.last_date = max((date for date in dates(source, name, (OBJECTS,), findings) if date > UNDATED), default='')
    order = {state: index for index, state in enumerate(ORDER)}
    return sorted(found.values(), key=lambda row: (order[row.state(now_ns)[0]], -sum(row.lost.values()), -row.last_ns, row.robot))


def _add(found: Mapping[str, RobotRow], each: Mapping[str, Any], midnight_ns: int, now_ns: int) -> None:
    row = found.get(each['robot'])
    if row is None or each['to_ns'] is None or each['sink'] != journal.OBJECTS or each['clock'] == 'unset':
        return
    if each['what'] != GAP:
        row.known_ns = max(row.known_ns, min(each['to_ns'], now_ns))
    elif each['to_ns'] >= midnight_ns and each['count'] and each['cause'] != journal.OTHER_TYPE:
        row.lost[each['cause'] or each['kind'] or '?'] += each['count']
        row.harmful += each['count'] if each['kind'] in HARMFUL else 0
        row.no_room += each['count'] if each['cause'] == NO_ROOM else 0
        row.quarantined += each['count'] if each['kind'] == 'quarantined' else 0


def _text(text: str) -> str:
    """For a page: bounded, without control characters."""
    return visible(text[:MAX_TEXT])


_LAST: Final = (
    'SELECT robot, mission_id, mission_type, max(coalesce(received_end_ns, t_end_ns, t_start_ns)) AS last_ns,'
    " max(t_start_ns) AS mission_ns FROM all_objects WHERE date >= '{}' GROUP BY robot, mission_id, mission_type"
)
