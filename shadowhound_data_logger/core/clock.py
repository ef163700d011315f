"""The wall clock and the boot clock. They are injected wherever time matters, so that tests control them."""

from __future__ import annotations

import time
import uuid
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final, Protocol

SECOND: Final = 1_000_000_000
EARLIEST_SANE_NS: Final = 1_704_067_200 * SECOND
"""2024-01-01 UTC: a robot that reports an earlier time has a clock that was never set."""
FUTURE_SLACK_NS: Final = 24 * 3600 * SECOND
"""A stamp further ahead of the clock than this is wrong, not early."""

MAX_AGE_NS: Final = 10 * SECOND
"""No message waits longer for its take; a larger difference is between two clocks."""


class Clock(Protocol):
    """The clocks that this package reads."""

    @property
    def boot_id(self) -> str:
        """Identity of this boot of the machine: boot clocks of different boots cannot be compared."""

    def wall_ns(self) -> int:
        """UTC, nanoseconds since 1970; may step."""

    def boot_ns(self) -> int:
        """Nanoseconds since boot, suspend included; never steps."""


@dataclass(frozen=True, slots=True)
class SystemClock:
    """The clocks of this machine."""

    boot_id: str

    @classmethod
    def of_this_machine(cls) -> SystemClock:
        try:
            return cls(Path('/proc/sys/kernel/random/boot_id').read_text(encoding='ascii').strip())
        except OSError:
            return cls(str(uuid.uuid4()))

    def wall_ns(self) -> int:
        return time.time_ns()

    def boot_ns(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def now_ns(clock: Clock) -> int:
    """UTC, or the time of the boot clock while UTC is unknown."""
    wall_ns = clock.wall_ns()
    return wall_ns if wall_ns >= EARLIEST_SANE_NS else clock.boot_ns()


def utc(stamp_ns: int) -> datetime:
    """The UTC datetime of a stamp, to the microsecond."""
    return datetime.fromtimestamp(stamp_ns // SECOND, timezone.utc).replace(microsecond=stamp_ns % SECOND // 1000)


def iso(stamp_ns: int) -> str:
    """RFC 3339 in UTC to the microsecond, such as ``2025-10-18T12:00:00.250000Z``."""
    return utc(stamp_ns).strftime('%Y-%m-%dT%H:%M:%S.%fZ')
