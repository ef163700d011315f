"""Which time a message gets: its own stamp where that can be trusted, otherwise the time at which it arrived.

Anybody in the robot's network can publish, with any stamp. A stamp is trusted only within a bound on both sides of the arrival,
so that no message can add to, or seem to be missing from, a day that is long over.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, MAX_AGE_NS, SECOND, Clock

DAY_NS: Final = 24 * 3600 * SECOND
UNSET, TOO_OLD, AHEAD = 'before_2024', 'too_old', 'ahead'
STAMP, SENT = 'stamp_', 'sent_'
"""What was not trusted: the stamp in the message's header, or the time of sending that the middleware delivers with it."""


class Dated(NamedTuple):
    """The time of a message."""

    ns: int
    """UTC, or the boot clock's time while the clock of this machine is not set: a time before 2024 is one since boot."""
    refused: str = ''
    """Why the message's own time was not used (``stamp_too_old``, ...); empty where it was, or where it has none."""


@dataclass(frozen=True, slots=True)
class StampRule:
    """The rule by which messages get their times. It has no state of its own; use it from any thread."""

    clock: Clock
    max_offset_ns: int = DAY_NS
    """How far a stamp may be from the arrival, before or after it."""

    def date(self, header_ns: int, source_ns: int, received_ns: int) -> Dated:
        """The time of a message that was just taken; all times are Unix ns, 0 where there is none.

        ``header_ns`` is the stamp in the message, ``source_ns`` when its publisher's middleware sent it, and ``received_ns``
        when the middleware of this machine had it. A message without a header's stamp is dated by ``source_ns``.

        ========================  ==================================================================================
        our clock is set          the message's own time within the bound about the arrival, otherwise the arrival
        it is not, the            the message's own time within the bound about ``source_ns``, otherwise
        publisher's is            ``source_ns``: another machine knows the time
        neither is                our boot clock's time of the sending where both run by the same wall clock (it was
                                  sent some seconds ago at most), otherwise of the take
        ========================  ==================================================================================
        """
        arrival_ns = received_ns if received_ns >= EARLIEST_SANE_NS else self.clock.wall_ns()
        if arrival_ns >= EARLIEST_SANE_NS:
            return self._within(header_ns, STAMP, arrival_ns) if header_ns else self._within(source_ns, SENT, arrival_ns)
        if source_ns >= EARLIEST_SANE_NS:
            return self._within(header_ns or source_ns, STAMP, source_ns)
        age_ns = arrival_ns - source_ns
        return Dated(self.clock.boot_ns() - (age_ns if 0 <= age_ns <= MAX_AGE_NS else 0))

    def _within(self, own_ns: int, what: str, reference_ns: int) -> Dated:
        if own_ns < EARLIEST_SANE_NS:
            return Dated(reference_ns, f'{what}{UNSET}')
        if -self.max_offset_ns <= own_ns - reference_ns <= self.max_offset_ns:
            return Dated(own_ns)
        return Dated(reference_ns, f'{what}{TOO_OLD if own_ns < reference_ns else AHEAD}')
