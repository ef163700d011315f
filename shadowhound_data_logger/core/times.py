"""Times as users write them, on the command line and in the library: one grammar for all.

A date or an ISO 8601 time (UTC if it names no zone), a word such as ``yesterday``, or an age such as ``2h``; within a bag
also seconds since its start or before its end.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from decimal import Decimal
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import SettingError

TIMES: Final = 'now, today, yesterday, an age such as 30min, 2h or 3d, a date or an ISO time (UTC unless it names a zone)'
TIMES_IN_BAG: Final = (
    'a UTC time such as 2025-10-18T12:00:05.5, seconds since the start such as 12.5, or -30 for 30 s before the end'
)
EPOCH_S: Final = 1_000_000_000
"""Within a bag a number from here on is not a duration but seconds since 1970, as printed by ``ros2 bag info``."""
MAX_AGE_S: Final = 10**11
_NUMBER: Final = re.compile(r'[+-]?\d{1,19}(\.\d{1,9})?', re.ASCII)
_ISO: Final = re.compile(
    r'(\d{4})(-?)(\d\d)\2(\d\d)'
    r'(?:[T ](\d\d)(?::?(\d\d)(?::?(\d\d)(\.\d{1,9})?)?)?)?(Z|[+-]\d\d(?::?\d\d)?)?',
    re.ASCII | re.IGNORECASE,
)
_AGE: Final = re.compile(r'(\d{1,12}(?:\.\d{1,9})?)\s*(s|min|h|d|w)', re.ASCII | re.IGNORECASE)
_UNITS: Final = {'s': 1, 'min': 60, 'h': 3600, 'd': 86_400, 'w': 604_800}
_DAYS_AGO: Final = {'today': 0, 'yesterday': 1}
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=timezone.utc)


def moment(name: str, given: str | datetime, now_ns: int) -> int:
    """Unix ns of a time: see ``TIMES``. Raises SettingError with ``name``."""
    if isinstance(given, datetime):
        return _ns(given if given.tzinfo else given.replace(tzinfo=timezone.utc))
    text = given.strip()
    if text.lower() == 'now':
        return now_ns
    if text.lower() in _DAYS_AGO:
        midnight = utc(now_ns).replace(hour=0, minute=0, second=0, microsecond=0)
        return _ns(midnight - timedelta(days=_DAYS_AGO[text.lower()]))
    age_ns = _age_ns(text)
    found = iso_ns(text) if age_ns is None else now_ns - age_ns
    if found is None or not _is_a_date(found):
        raise SettingError(name, given, TIMES)
    return found


def age_in_ns(name: str, text: str) -> int:
    """Nanoseconds of an age such as 30min, 2h or 3d. Raises SettingError with ``name``."""
    found = _age_ns(text.strip())
    if found is None:
        raise SettingError(name, text, 'an age such as 30min, 2h or 3d')
    return found


def _age_ns(text: str) -> int | None:
    age = _AGE.fullmatch(text)
    if age is None:
        return None
    seconds = Decimal(age[1]) * _UNITS[age[2].lower()]
    return int(seconds * SECOND) if seconds < MAX_AGE_S else None


def moment_in_bag(name: str, text: str, t_start_ns: int, t_end_ns: int) -> int:
    """Unix ns of a time within a bag: see ``TIMES_IN_BAG``. Raises SettingError with ``name``."""
    if _NUMBER.fullmatch(text):
        seconds = Decimal(text)
        if seconds >= EPOCH_S:
            return int(seconds * SECOND) if seconds < EPOCH_S * SECOND / 10 else int(seconds)
        return (t_end_ns if text.startswith('-') else t_start_ns) + int(seconds * SECOND)
    found = iso_ns(text)
    if found is None:
        raise SettingError(name, text, TIMES_IN_BAG)
    return found


def iso_ns(text: str) -> int | None:
    """Unix ns of an ISO 8601 time, UTC unless it names a zone, to the nanosecond; None if it is not one."""
    found = _ISO.fullmatch(text)
    if found is None:
        return None
    year, _dash, month, day, hour, minute, second, fraction, zone = found.groups()
    try:
        time = datetime(*(int(part or 0) for part in (year, month, day, hour, minute, second)), tzinfo=timezone.utc)  # type: ignore[misc,arg-type]
    except ValueError:
        return None
    offset_s = 0
    if zone and zone not in 'Zz':
        digits = zone[1:].replace(':', '').ljust(4, '0')
        if digits[:2] > '23' or digits[2:] > '59':
            return None
        offset_s = (int(digits[:2]) * 3600 + int(digits[2:]) * 60) * (-1 if zone[0] == '-' else 1)
    return _ns(time) - offset_s * SECOND + int(Decimal(fraction or 0) * SECOND)


def _is_a_date(stamp_ns: int) -> bool:
    try:
        utc(stamp_ns)
    except (ValueError, OverflowError, OSError):
        return False
    return True


def _ns(time: datetime) -> int:
    since = time - _EPOCH
    return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1000
