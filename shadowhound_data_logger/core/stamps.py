"""The two times of a message, and which of them dates it.

A message has a ``stamp`` (when its content was measured: ``header.stamp``, or the time of sending if it has no header) and a time
at which it was ``received``. The stamp is used while it can be trusted, otherwise the time of arrival. Two rules decide, both
listed in docs/formats.md:

- ``StampRule`` has no memory. Any program on the robot's network can publish any stamp, so a stamp counts only within a bound
  around the arrival: no message can add to, or seem to be missing from, a day that ended long ago.
- ``StampTrack`` follows one publisher of a topic. A stamp is trusted while its offset from the arrival is stable for that
  publisher, however large the offset is. Stamps that jump back and forth or that do not advance are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, MAX_AGE_NS, SECOND, Clock, iso

DAY_NS: Final = 24 * 3600 * SECOND
UNSET, TOO_OLD, AHEAD, ERRATIC, STUCK = 'before_2024', 'too_old', 'ahead', 'erratic', 'stuck'
STAMP, SENT = 'stamp_', 'sent_'
"""The time that was not trusted: the stamp in the message's header, or the time of sending from the middleware."""
STABLE, OFFSET = 'stable', 'offset'
"""Further states of a publisher's stamps: within a second of the arrival, or further from it by a stable offset."""
SAME_NS: Final = SECOND
"""Offsets that differ by less belong to the same clock; stamps within this of their arrival are always trusted."""
CONFIRMING: Final = 5
"""Consecutive messages after which a new offset is accepted: a clock that was set, not a stray stamp."""
RECENT: Final = 50
"""The number of messages used to decide whether a publisher's stamps are erratic."""
MAX_DOUBTED, FEW_DOUBTED = RECENT // 5, RECENT // 10
"""Of these: with more that do not fit the offset none is trusted, with at most this few they are trusted again."""
HEARD_NS: Final = 60 * SECOND
"""Publishers that were silent for longer than this before the topic's newest message are not reported."""
MAX_PUBLISHERS: Final = 64
"""Publishers of a topic that are tracked; the oldest is dropped for a new one."""
SMOOTHING: Final = 32
"""Weight of a message in the smoothed offset and spread: 500 ppm of drift at 1 Hz stay within ``SAME_NS``."""
_MASK: Final = (1 << RECENT) - 1


class Times(NamedTuple):
    """The two times of a message, ns since 1970; 0 for one that is unknown."""

    stamp_ns: int = 0
    """The time that dates it: its stamp if that is trusted, otherwise its arrival."""
    received_ns: int = 0
    """When it arrived at the robot's computer."""


NO_TIMES: Final = Times()
BY_STAMP, BY_RECEIVED = 'stamp', 'received'
CLOCKS: Final = (BY_STAMP, BY_RECEIVED)
"""Which of the two times places data on a time axis: in query, coverage, export, MissionDataset and the live page's past."""


def by_arrival(received_ns: int) -> Times:
    """The times of a message that is dated by its arrival."""
    return Times(received_ns, received_ns)


def clocks_differ(one: Times, other: Times) -> bool:
    """Whether the offsets of two messages differ by more than a second; False if an arrival is unknown."""
    if min(one.received_ns, other.received_ns) < EARLIEST_SANE_NS:
        return False
    return abs((one.received_ns - one.stamp_ns) - (other.received_ns - other.stamp_ns)) > SAME_NS


class Dated(NamedTuple):
    """The time of a message."""

    ns: int
    """UTC, or the boot clock's time while the clock of this machine is not set: a time before 2024 is one since boot."""
    refused: str = ''
    """Why the message's own time was not used (``stamp_too_old``, ...); empty if it was used, or if there is none."""


@dataclass(frozen=True, slots=True)
class StampRule:
    """The bound within which a stamp can be trusted. Stateless; use it from any thread."""

    clock: Clock
    max_offset_ns: int = DAY_NS
    """How far a stamp may be from the arrival, before or after it."""

    def date(self, header_ns: int, source_ns: int, received_ns: int) -> Dated:
        """The time of a message that was just taken; all times are Unix ns, 0 if unknown.

        ``header_ns`` is the stamp in the message, ``source_ns`` the time of sending by its publisher's middleware, and
        ``received_ns`` the arrival by the middleware of this machine. A message without a header's stamp is dated by
        ``source_ns``.

        ========================  ==================================================================================
        our clock is set          the message's own time within the bound around the arrival, otherwise the arrival
        it is not, the            the message's own time within the bound around ``source_ns``, otherwise
        publisher's is            ``source_ns``: another machine knows the time
        neither is                our boot clock's time of sending if both run by the same wall clock (sent at most
                                 some seconds ago), otherwise of the take
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


class StampTrack:
    """Judges the stamps of one publisher of one topic.

    Lifecycle: New; ``date`` each of its messages in the order of arrival. Not thread-safe: the intake thread owns it.
    """

    __slots__ = (
        '_advanced_ns', '_agreeing', '_before_ns', '_candidate_ns', '_doubted', '_is_erratic', '_newest_ns', '_rule', 'messages',
        'offset_ns', 'received_ns', 'refused', 'sent_offset_ns', 'since_ns', 'spread_ns',
    )  # fmt: skip

    def __init__(self, rule: StampRule) -> None:
        self._rule = rule
        self.offset_ns: int | None = None
        """Received minus stamp, smoothed: positive where stamps are older than the arrival. None before the first message."""
        self.spread_ns = 0
        """Mean distance of messages from that offset."""
        self.sent_offset_ns: int | None = None
        """Received minus time of sending, which distinguishes late stamps from a wrong clock; None if unknown."""
        self.messages = 0
        """Number of messages judged: a single latched one is no evidence about a clock."""
        self.received_ns = 0
        """When the newest message arrived."""
        self.since_ns = 0
        """When the present state began, by arrival."""
        self.refused = ''
        """Why the newest message was not dated by its stamp; empty if it was."""
        self._newest_ns = self._advanced_ns = 0  # the newest trusted stamp, and when it arrived
        self._candidate_ns = self._agreeing = 0  # a candidate for the new offset, and how many messages had it
        self._before_ns: int | None = (
            None  # the offset before a queue was delayed: offsets fall back to it while the queue drains
        )
        self._doubted = 0  # one bit for each of the recent messages
        self._is_erratic = False

    @property
    def state(self) -> str:
        """``stable``, ``offset``, ``erratic``, ``stuck``, or why the bound rejects the stamps (``before_2024``, ...)."""
        if self._is_erratic:
            return ERRATIC
        if self.refused and not self.refused.endswith(ERRATIC):
            return self.refused.removeprefix(STAMP).removeprefix(SENT)
        return OFFSET if self.is_apart else STABLE

    @property
    def cause(self) -> str:
        """The probable cause of the state: a key of ``CAUSES``; empty if it is stable."""
        if (state := self.state) != OFFSET:
            return {UNSET: 'sim_time', TOO_OLD: 'replay', AHEAD: 'replay', STABLE: ''}.get(state, state)
        assert self.offset_ns is not None
        if self.sent_offset_ns is not None and abs(self.sent_offset_ns - self.offset_ns) <= SAME_NS:
            return 'clock'
        return 'late' if self.offset_ns > 0 else 'early'

    @property
    def is_apart(self) -> bool:
        """Whether the offset is more than a second."""
        return self.offset_ns is not None and abs(self.offset_ns) > SAME_NS

    def date(self, header_ns: int, source_ns: int, received_ns: int) -> Dated:
        """The time of the next message; the arguments as of ``StampRule.date``."""
        dated = self._rule.date(header_ns, source_ns, received_ns)
        if received_ns < EARLIEST_SANE_NS:
            return dated
        self.messages += 1
        self.received_ns = received_ns
        if source_ns >= EARLIEST_SANE_NS:
            sent_ns, before_ns = received_ns - source_ns, self.sent_offset_ns
            self.sent_offset_ns = sent_ns if before_ns is None else before_ns + (sent_ns - before_ns) // SMOOTHING
        if not dated.refused and (why := self._doubt(dated.ns, received_ns)):
            dated = Dated(received_ns, (STAMP if header_ns else SENT) + why)
        if dated.refused != self.refused:
            self.refused, self.since_ns = dated.refused, received_ns
        return dated

    def _doubt(self, stamp_ns: int, received_ns: int) -> str:
        """Why a stamp within the bound is not trusted; empty if it is."""
        if stamp_ns == self._newest_ns and received_ns - self._advanced_ns > SAME_NS:
            return STUCK
        is_trusted = self._fits(stamp_ns, received_ns)
        if is_trusted and stamp_ns > self._newest_ns:
            self._newest_ns, self._advanced_ns = stamp_ns, received_ns
        self._doubted = (self._doubted << 1 | (not is_trusted)) & _MASK
        doubted = self._doubted.bit_count()
        if doubted > MAX_DOUBTED or (self._is_erratic and doubted > FEW_DOUBTED):
            if not self._is_erratic:
                self._is_erratic, self.since_ns = True, received_ns
            return ERRATIC
        self._is_erratic = False
        return '' if is_trusted else ERRATIC

    def _fits(self, stamp_ns: int, received_ns: int) -> bool:
        """Whether a stamp belongs to the clock that the publisher's stamps last followed, or to a new one."""
        offset_ns, known_ns = received_ns - stamp_ns, self.offset_ns
        if known_ns is not None and abs(offset_ns - known_ns) <= SAME_NS:
            self.offset_ns = known_ns + (offset_ns - known_ns) // SMOOTHING
            self.spread_ns += (abs(offset_ns - known_ns) - self.spread_ns) // SMOOTHING
            self._agreeing = 0
            return True
        if abs(offset_ns - self._candidate_ns) <= SAME_NS:
            self._agreeing += 1
        else:
            self._candidate_ns, self._agreeing = offset_ns, 1
        before_ns = known_ns if self._before_ns is None else self._before_ns
        is_late = before_ns is not None and stamp_ns > self._newest_ns and offset_ns > before_ns - SAME_NS
        if known_ns is None or abs(offset_ns) <= SAME_NS or self._agreeing >= CONFIRMING:
            is_back = before_ns is not None and abs(offset_ns - before_ns) <= SAME_NS
            self._before_ns = before_ns if is_late and not is_back else None
            self.offset_ns, self.spread_ns, self.since_ns, self._agreeing = offset_ns, 0, received_ns, 0
            self._newest_ns = 0
            return True
        return is_late  # but in order: a queue that was delayed, or one that drains


@dataclass(frozen=True, slots=True)
class StampReport:
    """What is wrong with or unusual about a publisher's stamps; the field names are those of ``status --json``."""

    publisher: str | None
    state: str
    """As in ``StampTrack.state``; never ``stable``."""
    offset_s: float | None
    """Received minus stamp: positive where stamps are older than the arrival. None if no stamp was within the bound."""
    spread_s: float
    since_ns: int
    """By arrival."""
    cause: str
    """The probable one, a key of ``CAUSES``."""


CAUSES: Final = {
    'clock': 'the clock of the computer that publishes it is not synchronized with this one',
    'late': 'the driver stamps its messages late, or publishes them late',
    'early': 'the driver stamps its messages ahead of the time at which it sends them',
    'erratic': 'the driver mixes clocks, or several publishers share a name that cannot be told apart',
    'stuck': 'the driver repeats a stamp: its source does not advance, or it does not set the stamp',
    'sim_time': 'use_sim_time without a simulation, or a clock that was never set',
    'replay': 'a bag that is replayed, or a clock that is more than a day off',
}


def describe(report: StampReport) -> str:
    """A report as text, to follow the names of the topics: ``... stamps are 146.0 s older than their arrival since ...``."""
    offset_s, since = report.offset_s, iso(report.since_ns)
    if report.state == OFFSET and offset_s is not None:
        what = f'stamps are {abs(offset_s):,.1f} s {"older" if offset_s > 0 else "newer"} than their arrival since {since}'
    else:
        what = {
            ERRATIC: 'stamps jump back and forth', STUCK: 'stamps do not advance', UNSET: 'stamps are before 2024',
            TOO_OLD: 'stamps are too old to be trusted', AHEAD: 'stamps are too far in the future to be trusted',
        }.get(report.state, f'stamps are {report.state}')  # fmt: skip
        what += f' since {since}, messages are dated by their arrival'
    return f'{what}: {CAUSES.get(report.cause, "the cause is unknown")}'


class StampTracks:
    """The publishers of one topic. Lifecycle as ``StampTrack``."""

    def __init__(self, rule: StampRule) -> None:
        self._rule = rule
        self._tracks: dict[str | None, StampTrack] = {}

    def of(self, publisher: str | None) -> StampTrack:
        """The track of a publisher; None is the track of all publishers whose name is unknown."""
        track = self._tracks.get(publisher)
        if track is None:
            while len(self._tracks) >= MAX_PUBLISHERS:
                del self._tracks[next(iter(self._tracks))]
            track = self._tracks[publisher] = StampTrack(self._rule)
        return track

    def report(self) -> StampReport | None:
        """The publisher with the worst stamps among those received in the last minute; None if all are stable."""
        newest_ns = max((track.received_ns for track in self._tracks.values()), default=0)
        found = [
            (track.refused != '', abs(track.offset_ns or 0), publisher or '', track.state, track)
            for publisher, track in self._tracks.items()
            if track.messages >= CONFIRMING and track.state != STABLE and newest_ns - track.received_ns < HEARD_NS
        ]  # fmt: skip
        if not found:
            return None
        *_, publisher, state, track = max(found, key=lambda each: each[:3])
        offset_s = None if track.offset_ns is None else round(track.offset_ns / SECOND, 3)
        return StampReport(publisher or None, state, offset_s, round(track.spread_ns / SECOND, 3), track.since_ns, track.cause)
