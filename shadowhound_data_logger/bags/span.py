"""Times as people write them: a date, seconds since a bag's start, or seconds before its end."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from decimal import Decimal
from typing import Final

from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.errors import SettingError

ALLOWED: Final = 'a UTC time such as 2025-10-18T12:00:05.5, seconds since the start such as 12.5, or -30 for 30 s before the end'
_NUMBER: Final = re.compile(r'[+-]?\d{1,19}(\.\d{1,9})?', re.ASCII)
_DATE: Final = re.compile(r'(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d(?::\d\d)?)(\.\d{1,9})?)?(Z|[+-]\d\d:?\d\d)?', re.ASCII)
_AGO: Final = re.compile(r'(\d+(?:\.\d+)?)(min|h|d)', re.ASCII)
_UNITS: Final = {'min': 60, 'h': 3600, 'd': 86400}
EPOCH_S: Final = 1_000_000_000
"""A number from here on is no duration but seconds since 1970, as ``ros2 bag info`` prints them."""


def when(text: str, t_start_ns: int, t_end_ns: int, option: str) -> int:
    """Unix ns of a time within a bag. Raises SettingError naming ``option``."""
    if _NUMBER.fullmatch(text):
        seconds = Decimal(text)
        if seconds >= EPOCH_S:
            return int(seconds * SECOND) if seconds < EPOCH_S * SECOND / 10 else int(seconds)
        return (t_end_ns if text.startswith('-') else t_start_ns) + int(seconds * SECOND)
    return date_ns(text, option, ALLOWED)


def since(text: str, now_ns: int, option: str) -> int:
    """Unix ns of a date, or of so long ago: ``90min``, ``12h``, ``2d``. Raises SettingError."""
    if found := _AGO.fullmatch(text):
        return now_ns - int(Decimal(found[1]) * _UNITS[found[2]] * SECOND)
    return date_ns(text, option, 'a UTC date such as 2025-10-18 or 2025-10-18T12:00, or how long ago: 90min, 12h, 2d')


def date_ns(text: str, option: str, allowed: str) -> int:
    """Unix ns of an ISO 8601 date, UTC where it names no zone. Raises SettingError."""
    found = _DATE.fullmatch(text)
    if found is None:
        raise SettingError(option, text, allowed)
    try:
        day, time, fraction, zone = found.groups()
        moment = datetime.fromisoformat(f'{day}T{time or "00:00"}').replace(tzinfo=timezone.utc)
        if zone and zone != 'Z':
            hours, minutes = int(zone[1:3]), int(zone[-2:])
            moment -= timedelta(hours=hours, minutes=minutes) * (-1 if zone[0] == '-' else 1)
        return int(moment.timestamp()) * SECOND + int(Decimal(fraction or 0) * SECOND)
    except (ValueError, OverflowError):
        raise SettingError(option, text, allowed) from None
