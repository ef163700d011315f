"""A wall clock and a boot clock that a test sets."""

from __future__ import annotations

from dataclasses import dataclass

from shadowhound_data_logger.core.clock import SECOND

NOON_NS = 1_760_788_800 * SECOND


@dataclass(slots=True)
class Clocks:
    """A machine that was started a minute before 1970-01-01 00:01:10."""

    offset_ns: int = 10 * SECOND
    up_ns: int = 60 * SECOND
    boot_id: str = 'this-boot'

    def wall_ns(self) -> int:
        return self.up_ns + self.offset_ns

    def boot_ns(self) -> int:
        return self.up_ns

    def set(self, wall_ns: int = NOON_NS) -> None:
        self.offset_ns = wall_ns - self.up_ns

    def wait(self, seconds: float) -> None:
        self.up_ns += round(seconds * SECOND)
