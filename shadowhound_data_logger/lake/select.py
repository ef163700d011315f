"""What a query selects: objects, by time, position and other conditions; and the dates on which they can be.

The time of an object is its start (``t_start``, UTC), whose date is also the date of its row.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import FUTURE_SLACK_NS, SECOND, utc
from shadowhound_data_logger.core.earth import is_place
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP, CLOCKS
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.formats.rows.catalog import UNDATED

DAY: Final = timedelta(days=1)
MAX_BATCH_NS: Final = 3600 * SECOND
"""A batch that started this long before a time can overlap it (``sensor.batch_s``)."""
RANGES: Final = 'the ranges of `shadowhound-data query --when ... --json`: since_ns and until_ns in ns since 1970, and robot'
MAX_FOLDERS: Final = 400
"""For up to this many dates, the folders are accessed by name; for more, the existing folders are listed."""


class TimeSpan(NamedTuple):
    """A time of one robot, or of all (None), both ends inclusive."""

    robot: str | None
    since_ns: int
    until_ns: int


class Chosen(NamedTuple):
    """Objects that overlap one of these times, or that are named."""

    spans: tuple[TimeSpan, ...]
    """By robot, ordered by time, without overlap."""
    keys: frozenset[tuple[str, str]] = frozenset()
    """(bucket, key)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What a query selects: all given conditions must be true; None means any."""

    robot: str | None = None
    sensor: str | None = None
    topic: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    """Exclusive."""
    near: tuple[float, float, float] | None = None
    """x, y and radius in meters, in the frame of the pose."""
    near_gps: tuple[float, float, float] | None = None
    """Latitude and longitude in degrees (WGS 84), and radius in meters."""
    mission: str | None = None
    """The start of the id of a mission or of its run."""
    mission_type: str | None = None
    success: bool | None = None
    """Whether the mission succeeded, by its ``summary.json``; a mission that has not ended never matches."""
    policy: str | None = None
    """Missions in which this policy was active, by their ``summary.json``: a name, ``NAME@7`` or an id."""
    where: str | None = None
    """SQL, such as ``battery_pct < 30``."""
    label: str | None = None
    """Objects that have this label, or overlap a time that has it."""
    by: str = BY_STAMP
    """Which of the two times of its messages is the time of an object: ``stamp`` or ``received``."""
    chosen: tuple[Chosen, ...] = ()
    """An object must be in each of these."""
    bounds: tuple[tuple[str, Any, Any], ...] = ()
    """Further columns with the minimum and maximum of the wanted values: other row groups are skipped."""

    def has_date(self, date: str) -> bool:
        """Whether a row with this date can match."""
        if self.since_ns is None and self.until_ns is None:
            return True
        if date == UNDATED or self.by == BY_RECEIVED:  # dates are those of stamps
            return date != UNDATED
        first = '' if self.since_ns is None else date_of(self.since_ns)
        return first <= date and (self.until_ns is None or date <= date_of(self.until_ns - 1))

    def dates(self, now_ns: int) -> list[str] | None:
        """The dates in the requested time; None if there are so many that listing the existing ones is faster."""
        if self.since_ns is None:
            return None
        last_ns = now_ns + FUTURE_SLACK_NS if self.until_ns is None else self.until_ns - 1
        first, last = utc(self.since_ns).date(), utc(max(last_ns, self.since_ns)).date()
        count = (last - first).days + 1
        if self.until_ns is not None and self.until_ns <= self.since_ns:
            return []
        return None if count > MAX_FOLDERS else [str(first + DAY * number) for number in range(count)]


def wanted(  # noqa: PLR0913 - the flags of a question
    now_ns: int, *, since: str | datetime | None = None, until: str | datetime | None = None,
    near: tuple[float, float, float] | str | None = None, robot: str | None = None, sensor: str | None = None,
    topic: str | None = None, mission: str | None = None, mission_type: str | None = None, success: bool | None = None,
    where: str | None = None, ranges: Sequence[Mapping[str, Any]] | None = None,
    label: str | None = None, policy: str | None = None, by: str = BY_STAMP,
    near_gps: tuple[float, float, float] | str | None = None,
) -> Wanted:  # fmt: skip
    """The query with these flags. Raises SettingError for an invalid flag.

    ``ranges`` are the result of a query about values or labels: mappings with ``since_ns``, ``until_ns``, optionally ``robot``.
    """
    if by not in CLOCKS:
        raise SettingError('by', by, ' or '.join(CLOCKS))
    asked = Wanted(
        robot=robot, sensor=sensor, topic=topic, mission=mission, mission_type=mission_type, success=success, where=where,
        label=label, policy=policy, since_ns=None if since is None else moment('since', since, now_ns),
        until_ns=None if until is None else moment('until', until, now_ns),
        near=None if near is None else _circle(near), near_gps=None if near_gps is None else _circle_on_earth(near_gps), by=by,
    )  # fmt: skip
    return asked if ranges is None else within(asked, spans_of(ranges))


def spans_of(ranges: Sequence[Mapping[str, Any]]) -> list[TimeSpan]:
    """Convert ranges to time spans. Raises SettingError."""
    found = []
    for each in ranges:
        try:
            robot, since_ns, until_ns = each.get('robot'), each['since_ns'], each['until_ns']
        except (AttributeError, LookupError, TypeError):
            raise SettingError('ranges', str(each)[:200], RANGES) from None
        are_times = all(type(one) is int and 0 <= one < 1 << 63 for one in (since_ns, until_ns))
        if not are_times or not (robot is None or isinstance(robot, str)):
            raise SettingError('ranges', str(each)[:200], RANGES)
        found.append(TimeSpan(robot, since_ns, until_ns))
    return found


def within(asked: Wanted, spans: Iterable[TimeSpan], keys: Iterable[tuple[str, str]] = (), all_ns: Iterable[int] = ()) -> Wanted:
    """Restrict a query to objects that overlap these times or are named; without times and keys, to no objects.

    ``all_ns`` are the times of the named objects.
    """
    joined: list[TimeSpan] = []
    for each in sorted((each for each in spans if each.since_ns <= each.until_ns), key=lambda each: (each.robot or '', each[1:])):
        if joined and joined[-1].robot == each.robot and each.since_ns <= joined[-1].until_ns:
            joined[-1] = joined[-1]._replace(until_ns=max(joined[-1].until_ns, each.until_ns))
        else:
            joined.append(each)
    ends = [*all_ns, *(each.since_ns for each in joined), *(each.until_ns for each in joined)]
    since_ns = max(0, min(ends, default=0) - MAX_BATCH_NS)
    until_ns = max(ends, default=-1) + 1
    return replace(
        asked, chosen=(*asked.chosen, Chosen(tuple(joined), frozenset(keys))), since_ns=max(since_ns, asked.since_ns or 0),
        until_ns=until_ns if asked.until_ns is None else min(until_ns, asked.until_ns),
    )  # fmt: skip


def _circle(given: tuple[float, float, float] | str, name: str = 'near',
            allowed: str = 'x, y and a radius in meters, such as 3.2,1.5,2') -> tuple[float, float, float]:  # fmt: skip
    try:
        x, y, radius = (float(part) for part in (given.split(',') if isinstance(given, str) else given))
    except (ValueError, TypeError):
        raise SettingError(name, given, allowed) from None
    if not all(map(math.isfinite, (x, y, radius))) or radius <= 0:
        raise SettingError(name, given, allowed)
    return x, y, radius


def _circle_on_earth(given: tuple[float, float, float] | str) -> tuple[float, float, float]:
    allowed = 'latitude, longitude and a radius in meters, such as 48.1351,11.5820,50'
    latitude, longitude, radius = _circle(given, 'near_gps', allowed)
    if not is_place(latitude, longitude):
        raise SettingError('near_gps', given, f'{allowed}: at most 90 and 180 degrees')
    return latitude, longitude, radius


def date_of(stamp_ns: int) -> str:
    """The UTC date of a time."""
    return f'{utc(stamp_ns):%Y-%m-%d}'
