"""Wall clock, boot clock and how far either can be trusted. Handed in wherever time matters, so that tests own it."""

from __future__ import annotations

import time
import uuid
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final, Protocol

SECOND: Final = 1_000_000_000
EARLIEST_SANE_NS: Final = 1_704_067_200 * SECOND
"""2024-01-01 UTC: a robot that claims an earlier time has a clock that was never set."""
FUTURE_SLACK_NS: Final = 24 * 3600 * SECOND
"""A header further ahead of its publisher's own clock than this is wrong, not early."""

MAX_AGE_NS: Final = 10 * SECOND
"""No message waits longer for its take; a difference beyond it is one between two clocks."""


class Clock(Protocol):
    """What the package asks of time."""

    @property
    def boot_id(self) -> str:
        """Identity of this boot of the machine: boot clocks of different boots cannot be compared."""

    def wall_ns(self) -> int:
        """UTC, nanoseconds since 1970; may step."""

    def boot_ns(self) -> int:
        """Nanoseconds since boot, suspend included; never steps."""


@dataclass(frozen=True, slots=True)
class SystemClock:
    """The machine's own clocks."""

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


def is_sane(stamp_ns: int, reference_ns: int) -> bool:
    """Whether a header stamp can be believed, given the publisher's own time of sending."""
    return EARLIEST_SANE_NS <= stamp_ns <= max(reference_ns, EARLIEST_SANE_NS) + FUTURE_SLACK_NS


def stamp_of(header_ns: int, source_ns: int, clock: Clock) -> int:
    """The time of a message that was just taken: UTC where any clock knows it, else that of the boot clock.

    Either is in ns, and which of them it is shows: a time before 2024 is one since boot. Who may be believed, in this order:

    ======================  ====================================================================================
    the header              if it is neither before 2024 nor a day ahead of the publisher's clock; where that was
                            never set, of our own; where neither was, there is nothing to judge it by
    the publisher's clock   ``source_ns``, when it was sent: if it was set, though ours (on another machine) is not
    our clock, if it is set the time of the take, a tenth of a second late: the publisher's machine has no time
    our boot clock          of the sending where both have the same wall clock (it ran for some seconds at most
                            since then), else of the take. A driver on this machine in 1970 is this case
    ======================  ====================================================================================
    """
    if source_ns >= EARLIEST_SANE_NS:  # of most messages, and no clock is asked
        return header_ns if is_sane(header_ns, source_ns) else source_ns
    wall_ns = clock.wall_ns()
    if wall_ns >= EARLIEST_SANE_NS:
        return header_ns if is_sane(header_ns, wall_ns) else wall_ns
    age_ns = wall_ns - source_ns
    return clock.boot_ns() - (age_ns if 0 <= age_ns <= MAX_AGE_NS else 0)


def utc(stamp_ns: int) -> datetime:
    """The UTC datetime of a stamp, to the microsecond."""
    return datetime.fromtimestamp(stamp_ns // SECOND, timezone.utc).replace(microsecond=stamp_ns % SECOND // 1000)


def iso(stamp_ns: int) -> str:
    """RFC 3339 in UTC to the microsecond, such as ``2025-10-18T12:00:00.250000Z``."""
    return utc(stamp_ns).strftime('%Y-%m-%dT%H:%M:%S.%fZ')
