"""What is kept of a topic: the first decision after the take (D2). Plain Python, owned by the intake thread."""

from __future__ import annotations

from typing import Final, Protocol
from zlib import crc32

from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.config import SensorSettings

STEP_BACK_NS: Final = 10 * SECOND
"""Stamps further back than this are a clock that was set or a bag that was started again, not jitter."""
STAMP_END: Final = 12
"""Where a message's content begins after the CDR encapsulation (4) and the stamp of its header (8)."""


class Gate(Protocol):
    """Decides over one message at a time, in the order of arrival."""

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:
        """Whether this message is stored."""


class EveryMessage:
    """Keeps all."""

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        return True


class FirstOfPeriod:
    """Keeps the first message of each whole period of UTC, so that a key by the period is unique.

    ``last_kept_ns`` is the stamp of the newest durable sample: a restart inside a period keeps nothing of it twice.
    """

    def __init__(self, period_ns: int, last_kept_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._steps_back = max(2, STEP_BACK_NS // period_ns)
        self._last = last_kept_ns // period_ns if last_kept_ns else -1

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        period = stamp_ns // self._period_ns
        if self._last - self._steps_back <= period <= self._last:
            return False
        self._last = period
        return True


class OnChange:
    """Keeps a message whose content, but for the stamp of its header, differs from the last one kept."""

    def __init__(self, *, has_header: bool) -> None:
        self._start = STAMP_END if has_header else 4
        self._last: int | None = None

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        content = crc32(memoryview(cdr)[self._start :])
        changed = content != self._last
        self._last = content
        return changed


def gate_for(sensor: SensorSettings, *, has_header: bool, last_kept_ns: int) -> Gate:
    """The gate of a sensor's settings."""
    if sensor.on_change:
        return OnChange(has_header=has_header)
    if sensor.rate_hz:
        return FirstOfPeriod(round(SECOND / sensor.rate_hz), last_kept_ns)
    return EveryMessage()
