"""Estimates of losses, compared with simulated streams."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.spool.estimator import (
    LEARN,
    RESTART,
    SILENCE,
    TRANSPORT,
    ArrivalContext,
    Expectation,
    LossEstimator,
    TopicEstimate,
    learn_period,
)

POLL_S = 0.2
MS = SECOND // 1000
PERIOD = 20 * MS


@dataclass
class Ear:
    """Drains a stream as the intake does: five times per second, everything sent until then."""

    estimator: LossEstimator = field(default_factory=LossEstimator)
    now_s: float = 0.0
    heard_s: float = 0.0
    looked_s: float = 0.0
    received: int = 0
    covered: int = 0
    missed: Counter[str] = field(default_factory=Counter)

    def hear(self, stamps: Iterable[int], *, asleep_s: float = 0.0, shift: int = 0, **context: object) -> Ear:
        """``asleep_s`` is the time before the first drain; ``shift`` is how far the publisher's clock is ahead of the stamps."""
        waiting = sorted(stamps)
        self.now_s += asleep_s
        while waiting:
            self.now_s += POLL_S
            batch = [stamp for stamp in waiting if stamp <= self.now_s * SECOND]
            if batch:
                del waiting[: len(batch)]
                received = ArrivalContext(self.now_s, max(0.0, self.looked_s - self.heard_s))._replace(**context)  # type: ignore[arg-type]
                found = self.estimator.observe([stamp + shift for stamp in batch], received)
                self.heard_s = self.now_s
                self.received += len(batch)
                self.covered += found.covered
                self.missed.update(found.missed)
                assert 0 <= self.covered <= self.received
                assert min(self.missed.values(), default=0) >= 0
            self.looked_s = self.now_s
        return self

    @property
    def lost(self) -> int:
        return self.missed.total()


def even(count: int, period: float = PERIOD, start: float = 0.0, jitter: float = 0.03, seed: int = 0) -> list[int]:
    """A timer: jitter about an even grid."""
    chance = random.Random(seed)
    return sorted(int(start + (place + chance.gauss(0, jitter)) * period) for place in range(count))


def loop(count: int, period: float, jitter: float, seed: int) -> list[int]:
    """A loop that sleeps: each interval has independent jitter."""
    chance = random.Random(seed)
    return [int(stamp) for stamp in accumulate(max(0.0, chance.gauss(period, jitter * period)) for _ in range(count))]


def without(stamps: Sequence[int], *blocks: tuple[int, int]) -> list[int]:
    return [stamp for place, stamp in enumerate(stamps) if not any(start <= place < end for start, end in blocks)]


STREAMS = st.tuples(
    st.sampled_from([2 * MS, 5 * MS, 20 * MS, 100 * MS]), st.floats(0.0, 0.1), st.booleans(), st.integers(0, 1 << 30),
    st.integers(250, 1200), st.integers(20, 600), st.sampled_from([0.0, 0.02, 0.1]),
)  # fmt: skip


@settings(max_examples=examples(30), deadline=None)
@given(STREAMS)
def test_a_block_of_loss_is_known_to_5_percent(stream: tuple[int, float, bool, int, int, int, float]) -> None:
    """With jitter up to 10 %, of a timer or of a loop, at any rate, and with single losses in addition."""
    period, jitter, is_loop, seed, start, length, rate = stream
    sent = loop(2000, period, jitter, seed) if is_loop else even(2000, period, 0.0, jitter, seed)
    chance = random.Random(seed)
    kept = [stamp for stamp in without(sent, (start, start + length)) if chance.random() >= rate]
    lost = sum(kept[0] <= stamp <= kept[-1] for stamp in sent) - len(kept)
    ear = Ear().hear(kept)
    assert ear.covered == ear.received == len(kept)
    assert abs(ear.lost - lost) <= max(2, 0.05 * lost)


@settings(max_examples=examples(30), deadline=None)
@given(STREAMS)
def test_nothing_is_called_lost_without_a_loss(stream: tuple[int, float, bool, int, int, int, float]) -> None:
    """Jitter alone counts as a loss in less than one in a hundred streams of loops that drift, and in almost none of a timer."""
    period, jitter, is_loop, seed, *_ = stream
    ear = Ear().hear(loop(2000, period, jitter, seed) if is_loop else even(2000, period, 0.0, jitter, seed))
    assert ear.lost <= (20 if is_loop else 5)


def test_losses_before_the_rhythm_was_known_are_counted() -> None:
    """Nothing is known for 200 intervals, and then all of it."""
    ear = Ear().hear(without(even(LEARN + 20), (50, 90))[: LEARN - 10])
    assert (ear.covered, ear.lost) == (0, 0)
    ear = Ear().hear(without(even(2 * LEARN), (50, 90)))
    assert (ear.covered, ear.lost) == (2 * LEARN - 40, 40)


def test_a_late_message_is_no_loss() -> None:
    """It makes one interval long and the next one short."""
    chance = random.Random(1)
    ear = Ear().hear(stamp + (6 * PERIOD // 10 if chance.random() < 0.05 else 0) for stamp in even(3000, jitter=0.0))
    assert ear.covered == 3000
    assert ear.lost <= 3


def test_a_publisher_that_is_starved_and_catches_up_loses_nothing() -> None:
    """What it sends in a burst, once it runs again, is what it could not send before: a declared rate is not refuted."""
    held = [max(stamp, (stamp // SECOND) * SECOND + 4 * SECOND // 10) for stamp in even(3000, jitter=0.0)]
    ear = Ear(LossEstimator(Expectation(period=PERIOD))).hear(held)
    assert (ear.covered, ear.estimator.refuted) == (3000, False)
    assert ear.lost <= 1


def test_messages_overwritten_during_a_stall_are_lost_by_transport() -> None:
    """What a full history overwrote during the stall is lost by transport."""
    sent = even(1000)
    ear = Ear().hear(sent[:500]).hear(without(sent[500:], (10, 140)), asleep_s=3.0)
    assert ear.missed == {TRANSPORT: 130}


def test_messages_delayed_during_a_stall_are_not_a_clock_step() -> None:
    """They arrive in several drains. The gap may be longer than the time between drains, and is not a clock step."""
    sent = even(1000)
    ear = Ear().hear(sent[:500])
    held, later = sent[500:550], sent[650:]
    ear.now_s += 3.0
    for batch in (held[:20], held[20:], [stamp for stamp in later if stamp <= ear.now_s * SECOND]):
        ear.missed.update(ear.estimator.observe(batch, ArrivalContext(ear.now_s)).missed)
        ear.now_s += 0.01
    assert ear.missed == {TRANSPORT: 100}


@pytest.mark.parametrize('pause_s', [3, 60, 2000])
def test_a_pause_is_marked(pause_s: int) -> None:
    """Whether the publisher paused or the network was down is unknown: the cause records that."""
    sent = even(500)
    ear = Ear().hear([*sent, *(stamp + sent[-1] + pause_s * SECOND for stamp in sent)])
    assert ear.covered == ear.received
    assert set(ear.missed) == {SILENCE}
    assert abs(ear.lost - pause_s * 50) <= 0.05 * pause_s * 50


@pytest.mark.parametrize('factor', [0.5, 0.7, 1.5, 2.0, 4.0])
def test_another_rate_is_no_loss(factor: float) -> None:
    """It is learned again, and losses counted until the change was detected are taken back."""
    first = even(1000)
    ear = Ear().hear([*first, *even(1000, PERIOD / factor, first[-1] + PERIOD / factor)])
    assert ear.covered >= ear.received - 1.5 * LEARN, 'messages during learning are not covered'
    assert ear.lost <= 20
    assert ear.estimator.period == pytest.approx(PERIOD / factor, rel=0.02)


@pytest.mark.parametrize(('size', 'inner_ms', 'outer_ms'), [(4, 1, 50), (5, 1, 50), (5, 1, 2), (10, 0.2, 100), (100, 1, 1000)])
def test_messages_in_groups_have_no_rhythm(size: int, inner_ms: float, outer_ms: float) -> None:
    """The pauses between them are not losses."""
    places = [group * (size * inner_ms + outer_ms) + each * inner_ms for group in range(3000 // size) for each in range(size)]
    ear = Ear().hear(int(place * MS) for place in places)
    assert (ear.covered, ear.lost) == (0, 0)


def test_random_messages_have_no_rhythm() -> None:
    """Intervals of random length."""
    chance = random.Random(3)
    ear = Ear().hear(int(stamp) for stamp in accumulate(chance.expovariate(1 / PERIOD) for _ in range(3000)))
    assert (ear.covered, ear.lost) == (0, 0)


@pytest.mark.parametrize('phase', [0.1, 0.3, 0.45])
def test_two_publishers_have_no_rhythm(phase: float) -> None:
    """Interleaved, they break the existing rhythm, and no new one is learned from them."""
    first = even(2000)
    ear = Ear().hear(first[:500])
    assert ear.covered == 500
    ear.hear([*first[500:], *even(1500, PERIOD, first[500] + phase * PERIOD, seed=1)], is_only=False)
    assert ear.estimator.period == 0
    assert ear.covered < 600
    assert ear.lost <= 5


def test_two_alternating_publishers_are_not_mistaken_for_one() -> None:
    """They look like one of twice the rate; the ROS graph shows that there are two."""
    ear = Ear().hear(even(2000), is_only=False)
    assert (ear.covered, ear.lost) == (0, 0)


@pytest.mark.parametrize('step_s', [-3600, -5, 5, 3600])
def test_a_step_of_a_clock_is_no_loss(step_s: int) -> None:
    """In either direction: no more can be lost than was sent in the elapsed time."""
    first = even(500)
    ear = Ear().hear(first).hear(even(500, start=first[-1] + PERIOD), shift=step_s * SECOND)
    assert ear.covered == ear.received
    assert ear.lost == 0


@pytest.mark.parametrize('drift', [-0.0005, 0.0005])
def test_a_drifting_clock_is_followed(drift: float) -> None:
    """A step is still distinguished from a loss after hours, when the clocks have drifted apart by more than that."""
    estimator = LossEstimator(Expectation(period=10 * SECOND))
    for second in range(0, 15_000, 10):
        estimator.observe([int(second * (1 + drift) * SECOND)], ArrivalContext(second))
    found = estimator.observe([int(15_000 * (1 + drift) * SECOND) + 6 * SECOND], ArrivalContext(15_000))
    assert found.missed == {}


def test_a_small_step_forward_looks_like_loss() -> None:
    """docs/formats.md documents this limit."""
    first = even(500)
    ear = Ear().hear(first).hear(even(500, start=first[-1] + PERIOD), shift=SECOND // 2)
    assert ear.lost == 25


def test_overtaken_messages_fill_their_gap() -> None:
    """A message that arrives late, out of order, was not lost."""
    estimator = LossEstimator(Expectation(period=PERIOD))
    missed: Counter[str] = Counter()
    for places in ([0, 1, 4], [2, 3, 5, 6]):
        missed.update(estimator.observe([place * PERIOD for place in places], ArrivalContext()).missed)
    assert missed.total() == 0


def test_a_declared_rate_detects_even_loss() -> None:
    """Nothing else can detect it: three of four messages are lost from the start."""
    sent = even(2000)
    assert Ear().hear(sent[::4]).lost == 0
    assert Ear(LossEstimator(Expectation(period=PERIOD))).hear(sent[::4]).lost == 1497


def test_a_wrong_declared_rate_is_detected() -> None:
    """When messages arrive more often it is ignored."""
    ear = Ear(LossEstimator(Expectation(period=2.5 * PERIOD))).hear(even(1000))
    assert ear.estimator.refuted
    assert (ear.lost, ear.estimator.period) == (0, pytest.approx(PERIOD, rel=0.02))


@settings(deadline=None)
@given(
    st.integers(0, (1 << 32) - 1), st.integers(1, 5), st.sampled_from([1 << 16, 1 << 32]), st.integers(300, 900),
    st.integers(1, 500),
)  # fmt: skip
def test_a_counter_counts_exactly(first: int, step: int, wrap: int, start: int, length: int) -> None:
    """From any start, and also if its step must be learned."""
    for declared in (float(step), 0.0):
        estimator = LossEstimator(Expectation('counter:tick', declared, wrap))
        values = [(first + place * step) % wrap for place in without(range(1500), (start, start + length))]
        missed: Counter[str] = Counter()
        for place in range(0, len(values), 10):
            missed.update(estimator.observe(values[place : place + 10], ArrivalContext()).missed)
        assert missed.total() == length


def test_a_counter_that_stays_zero_is_not_used() -> None:
    """No loss is reported from it."""
    estimator = LossEstimator(Expectation('counter:tick', 0.0, 1 << 32))
    assert sum(estimator.observe([0] * 10, ArrivalContext()).covered for _ in range(100)) == 0


def test_a_restarted_counter_is_not_a_loss() -> None:
    """A robot that was restarted counts from 0."""
    estimator = LossEstimator(Expectation('counter:tick', 2.0, 1 << 32))
    missed: Counter[str] = Counter()
    for values in (range(1000, 1100, 2), range(0, 100, 2)):
        missed.update(estimator.observe(list(values), ArrivalContext()).missed)
    assert missed.total() == 0


def test_a_gap_before_another_publisher_is_no_loss() -> None:
    """Its predecessor may have left at any time; after one gap it is treated as any other publisher."""
    sent = even(1000)
    ear = Ear().hear(sent[:400]).hear(sent[500:501], has_new=True).hear(without(sent[501:], (100, 130)))
    assert ear.missed == {TRANSPORT: 30}


def test_one_of_many_publishers_is_not_counted() -> None:
    """While several publish, the sender of a message is unknown and nothing is claimed; with one left the rhythm continues."""
    estimate = TopicEstimate()
    sent = even(1000, jitter=0.0)
    alone, crowd = ArrivalContext(gid='a'), ArrivalContext(is_only=False, is_shared=True)
    assert estimate.observe({'': sent[:300]}, alone).covered == 300
    found = estimate.observe({'': sent[300:400]}, crowd)
    assert (found.covered, found.lost, estimate.known) == (0, None, False)
    assert estimate.row('/odom').publisher == ''  # type: ignore[union-attr]
    found = estimate.observe({'': sent[500:600]}, alone)
    assert (found.covered, found.lost, estimate.known) == (100, {}, True)


def test_each_publisher_has_its_own_rate() -> None:
    """Whatever their rates, and whether or not the graph shows several."""
    estimate = TopicEstimate()
    context = ArrivalContext(is_only=False, is_shared=True)
    stamps = {'p': without(even(500), (300, 320)), 'q': even(300, 3 * PERIOD)}
    found = estimate.observe(stamps, context)
    assert (found.covered, found.missed) == (780, {TRANSPORT: 20})


def test_the_next_session_continues() -> None:
    """With the rhythm and the last stamp: what was sent in between was missed by the restart."""
    before = TopicEstimate()
    sent = even(600)
    before.observe({'': sent[:300]}, ArrivalContext(gid='a'))
    after = TopicEstimate(before=before.row('/odom'))
    assert after.observe({'': sent[450:460]}, ArrivalContext(gid='a')).missed == {RESTART: 150}
    another = TopicEstimate(before=before.row('/odom'))
    assert another.observe({'': sent[450:460]}, ArrivalContext(gid='b')).missed == {}


@given(st.lists(st.integers(-(10**9), 10**9), min_size=2, max_size=300))
def test_any_intervals_are_accepted(intervals: list[int]) -> None:
    """For any intervals there is a period or none."""
    assert learn_period(intervals) >= 0.0
