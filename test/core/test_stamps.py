"""The time of a message, depending on its publisher and on whether the clocks are set."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from itertools import accumulate

import pytest
from clocks import NOON_NS as NOW_NS
from clocks import Clocks

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.stamps import (
    CONFIRMING,
    DAY_NS,
    RECENT,
    SAME_NS,
    Dated,
    StampReport,
    StampRule,
    StampTrack,
    StampTracks,
    describe,
)

WEEK_NS = 7 * DAY_NS


@pytest.mark.parametrize(('header_ns', 'source_ns', 'received_ns', 'dated'), [
    pytest.param(NOW_NS - 5, NOW_NS - 3, NOW_NS, Dated(NOW_NS - 5), id='all clocks are set'),
    pytest.param(0, NOW_NS - 3, NOW_NS, Dated(NOW_NS - 3), id='a message without a stamp'),
    pytest.param(NOW_NS - DAY_NS, NOW_NS, NOW_NS, Dated(NOW_NS - DAY_NS), id='as old as is trusted'),
    pytest.param(NOW_NS - DAY_NS - 1, NOW_NS, NOW_NS, Dated(NOW_NS, 'stamp_too_old'), id='older: a bag that is replayed'),
    pytest.param(NOW_NS + DAY_NS, NOW_NS, NOW_NS, Dated(NOW_NS + DAY_NS), id='as far ahead as is trusted'),
    pytest.param(NOW_NS + DAY_NS + 1, NOW_NS, NOW_NS, Dated(NOW_NS, 'stamp_ahead'), id='further ahead'),
    pytest.param(NOW_NS - WEEK_NS, NOW_NS - WEEK_NS, NOW_NS, Dated(NOW_NS, 'stamp_too_old'), id='a forger sets both'),
    pytest.param(0, NOW_NS - WEEK_NS, NOW_NS, Dated(NOW_NS, 'sent_too_old'), id='a forger of the time of sending'),
    pytest.param(0, NOW_NS + WEEK_NS, NOW_NS, Dated(NOW_NS, 'sent_ahead'), id='the same, ahead'),
    pytest.param(1, NOW_NS, NOW_NS, Dated(NOW_NS, 'stamp_before_2024'), id='sim time, which begins at 0'),
    pytest.param(70 * SECOND, NOW_NS - 3, NOW_NS, Dated(NOW_NS, 'stamp_before_2024'), id='a stamp of the boot clock'),
    pytest.param(-SECOND, NOW_NS, NOW_NS, Dated(NOW_NS, 'stamp_before_2024'), id='a stamp before 1970'),
    pytest.param(NOW_NS - 5, 70 * SECOND, NOW_NS, Dated(NOW_NS - 5), id='a sender in 1970 that passes on a good stamp'),
    pytest.param(0, 70 * SECOND, NOW_NS, Dated(NOW_NS, 'sent_before_2024'), id='another machine in 1970'),
    pytest.param(0, 0, NOW_NS, Dated(NOW_NS, 'sent_before_2024'), id='a middleware that does not say when it was sent'),
    pytest.param(NOW_NS - 5, NOW_NS, 70 * SECOND, Dated(NOW_NS - 5), id='it arrived just before the clock was set'),
    pytest.param(NOW_NS - WEEK_NS, NOW_NS, 70 * SECOND, Dated(NOW_NS, 'stamp_too_old'), id='the same with an old stamp'),
    pytest.param(NOW_NS - WEEK_NS, NOW_NS, 0, Dated(NOW_NS, 'stamp_too_old'), id='a middleware that tells no arrival'),
])  # fmt: skip
def test_a_message_is_dated_by_its_stamp_or_its_arrival(header_ns: int, source_ns: int, received_ns: int, dated: Dated) -> None:
    """A message's stamp counts within the limit on both sides of its arrival; otherwise the arrival does, with the reason."""
    clocks = Clocks()
    clocks.set(NOW_NS)
    assert StampRule(clocks).date(header_ns, source_ns, received_ns) == dated


@pytest.mark.parametrize(('header_ns', 'source_ns', 'dated'), [
    pytest.param(0, 69 * SECOND, Dated(59 * SECOND), id='a driver on this machine'),
    pytest.param(69 * SECOND, 69 * SECOND, Dated(59 * SECOND), id='the same with a stamp'),
    pytest.param(0, 3 * SECOND, Dated(60 * SECOND), id='another machine in another 1970'),
    pytest.param(0, 71 * SECOND, Dated(60 * SECOND), id='another machine ahead of ours in 1970'),
    pytest.param(NOW_NS, 69 * SECOND, Dated(59 * SECOND), id='a stamp that no clock can confirm'),
    pytest.param(NOW_NS, NOW_NS + 5, Dated(NOW_NS), id='another machine that knows the time'),
    pytest.param(0, NOW_NS + 5, Dated(NOW_NS + 5), id='another machine that knows the time, no stamp'),
    pytest.param(EARLIEST_SANE_NS, NOW_NS, Dated(NOW_NS, 'stamp_too_old'), id='it knows the time, and its stamp is old'),
    pytest.param(NOW_NS + WEEK_NS, NOW_NS, Dated(NOW_NS, 'stamp_ahead'), id='it knows the time, and its stamp is ahead'),
])  # fmt: skip
def test_while_the_clock_is_not_set_the_best_available_time_is_used(header_ns: int, source_ns: int, dated: Dated) -> None:
    """UTC from another machine that has it; otherwise the boot clock's time, of sending if it can be known."""
    clocks = Clocks()
    assert StampRule(clocks).date(header_ns, source_ns, clocks.wall_ns()) == dated


def test_the_maximum_offset_can_be_raised() -> None:
    """Replaying old bags keeps their stamps, and none beyond the offset is trusted."""
    rule = StampRule(Clocks(), 365 * DAY_NS)
    assert rule.date(NOW_NS - 364 * DAY_NS, NOW_NS, NOW_NS) == Dated(NOW_NS - 364 * DAY_NS)
    assert rule.date(NOW_NS - 366 * DAY_NS, NOW_NS, NOW_NS) == Dated(NOW_NS, 'stamp_too_old')


PERIOD_NS = SECOND // 30
MS = 1_000_000
random_ = random.Random(5)


def follow(track: StampTrack, offsets_ns: Iterable[int], period_ns: int = PERIOD_NS, start_ns: int = NOW_NS) -> list[str]:
    """The reason for each rejected stamp, if stamps are this much before their arrival; trusted ones are used."""
    found = []
    for number, offset_ns in enumerate(offsets_ns):
        received_ns = start_ns + number * period_ns
        dated = track.date(received_ns - offset_ns, received_ns - 2 * MS, received_ns)
        assert dated.ns == (received_ns if dated.refused else received_ns - offset_ns)
        found.append(dated.refused)
    return found


def new_track() -> StampTrack:
    clocks = Clocks()
    clocks.set(NOW_NS)
    return StampTrack(StampRule(clocks))


@pytest.mark.parametrize(('offsets_ns', 'refused', 'state'), [
    pytest.param([5 * MS] * 200, 0, 'stable', id='a synchronized robot'),
    pytest.param([random_.randrange(200 * MS) for _ in range(200)], 0, 'stable', id='with the jitter of a busy machine'),
    pytest.param([-MS] * 200, 0, 'stable', id='a publisher a millisecond ahead'),
    pytest.param([146 * SECOND] * 200, 0, 'offset', id='a driver that stamps late, always as much'),
    pytest.param([-3600 * SECOND] * 200, 0, 'offset', id='a computer an hour ahead'),
    pytest.param([300 * SECOND + number * PERIOD_NS // 2000 for number in range(20_000)], 0, 'offset', id='500 ppm of drift'),
    pytest.param([5 * MS] * 100 + [60 * SECOND] * 100, CONFIRMING - 1, 'offset', id='a clock that is set back'),
    pytest.param([5 * MS] * 100 + [-60 * SECOND] * 100, CONFIRMING - 1, 'offset', id='a clock that is set ahead'),
    pytest.param([60 * SECOND] * 100 + [5 * MS] * 100, 0, 'stable', id='a clock that is set right'),
    pytest.param([67 * SECOND if number % 10 == 9 else 5 * MS for number in range(200)], 20, 'stable', id='a tenth is old'),
    pytest.param([5 * MS] * 100 + [(30 - late) * PERIOD_NS for late in range(30)] + [5 * MS] * 9, 0, 'stable', id='late by 1 s'),
])  # fmt: skip
def test_stamps_are_trusted_while_their_offset_is_stable(offsets_ns: list[int], refused: int, state: str) -> None:
    """However large it is; a new offset counts when several consecutive messages have it, a stray stamp does not."""
    track = new_track()
    assert sum(map(bool, follow(track, offsets_ns))) == refused
    assert track.state == state


@pytest.mark.parametrize('offset', [
    pytest.param(lambda: random_.randrange(-60, 60) * SECOND, id='anything within a minute'),
    pytest.param(lambda: random_.choice((0, 300 * SECOND)), id='two clocks that nobody tells apart'),
])  # fmt: skip
def test_erratic_stamps_are_dated_by_arrival(offset: Callable[[], int]) -> None:
    """All of them, even those that happen to be close to their arrival. They are trusted again once they are stable."""
    track = new_track()
    found = follow(track, [offset() for _ in range(500)])
    assert set(found[2 * RECENT :]) == {'stamp_erratic'}
    assert track.state == 'erratic'
    found = follow(track, [5 * MS] * 100, start_ns=NOW_NS + 500 * PERIOD_NS)
    assert found[0] == 'stamp_erratic'
    assert found[-1] == ''
    assert track.state == 'stable'


def test_messages_delayed_by_a_queue_keep_their_stamps() -> None:
    """Ten seconds without any, then all of them at twice the rate, in order."""
    track = new_track()
    follow(track, [5 * MS] * 60)
    found = follow(track, [10 * SECOND - number * PERIOD_NS // 2 for number in range(500)], PERIOD_NS // 2, NOW_NS + 12 * SECOND)
    assert set(found) == {''}


@pytest.mark.parametrize('usual_ns', [5 * MS, 146 * SECOND])
def test_messages_of_a_draining_queue_keep_their_stamps(usual_ns: int) -> None:
    """Four seconds without any, then all of them within milliseconds, twice; after that the usual offset is recognized again."""
    track = new_track()
    follow(track, [usual_ns] * 60)
    for begin_ns in (NOW_NS + 6 * SECOND, NOW_NS + 12 * SECOND):
        burst = [usual_ns + 4 * SECOND - number * PERIOD_NS for number in range(120)]
        assert set(follow(track, burst, MS // 10, begin_ns)) == {''}
        assert set(follow(track, [usual_ns] * 50, PERIOD_NS, begin_ns + SECOND // 10)) == {''}
        assert track.offset_ns == pytest.approx(usual_ns, abs=SAME_NS)
    found = follow(track, [usual_ns - 60 * SECOND] * 50, PERIOD_NS, NOW_NS + 20 * SECOND)
    assert sum(map(bool, found)) == CONFIRMING - 1, 'a clock that is set ahead has to be confirmed'


@pytest.mark.parametrize('hz', [1, 30, 1000])
def test_stamps_that_do_not_advance_are_stuck(hz: int) -> None:
    """A second after the last one that advanced, at any rate; repeats within a second are normal."""
    track, period_ns = new_track(), SECOND // hz
    follow(track, [MS] * 10, period_ns)
    found = follow(track, accumulate([MS] + [period_ns] * (5 * hz)), period_ns, NOW_NS + 10 * period_ns)
    stuck = [bool(why) for why in found]
    assert set(found) == {'', 'stamp_stuck'}
    assert stuck == sorted(stuck), 'once stuck, it stays so'
    assert stuck.index(True) * period_ns <= SAME_NS + 2 * period_ns
    assert track.state == 'stuck'
    assert follow(track, [MS] * 3, period_ns, NOW_NS + 20 * SECOND) == ['', '', '']
    assert track.state == 'stable'


def test_a_latched_message_keeps_its_stamp() -> None:
    """It was sent long before it was received; the next one, which arrives immediately, keeps its stamp, too."""
    track = new_track()
    assert follow(track, [600 * SECOND, 2 * MS], 60 * SECOND) == ['', '']


def test_the_state_has_its_beginning() -> None:
    """By arrival; with the offset and the deviation of messages from it, and the same for the send time."""
    track = new_track()
    follow(track, [5 * MS] * 10)
    follow(track, [60 * SECOND] * 50, start_ns=NOW_NS + 10 * PERIOD_NS)
    assert track.since_ns == NOW_NS + (10 + CONFIRMING - 1) * PERIOD_NS
    assert track.offset_ns == 60 * SECOND
    assert (track.spread_ns, track.sent_offset_ns) == (0, 2 * MS)


def test_sim_time_is_reported_as_such() -> None:
    """A stamp before 2024 is rejected by the limit, and reported as the state."""
    track = new_track()
    assert track.date(70 * SECOND, NOW_NS, NOW_NS) == Dated(NOW_NS, 'stamp_before_2024')
    assert track.state == 'before_2024'


@pytest.mark.parametrize(('stamp_s', 'sent_s', 'state', 'cause'), [
    pytest.param(146.0, 146.0, 'offset', 'clock', id='another computer'),
    pytest.param(-60.0, -60.0, 'offset', 'clock', id='ahead'),
    pytest.param(146.0, 0.0, 'offset', 'late', id='a driver that stamps late'),
    pytest.param(-60.0, 0.0, 'offset', 'early', id='a driver that predicts'),
    pytest.param(2e7, 0.0, 'too_old', 'replay', id='an old bag'),
    pytest.param(1.7e9, 0.0, 'before_2024', 'sim_time', id='sim time'),
])  # fmt: skip
def test_the_likely_cause_is_reported(stamp_s: float, sent_s: float, state: str, cause: str) -> None:
    """From the send time, which the publisher's clock gives: if it has the same offset, that clock is wrong."""
    clocks = Clocks()
    clocks.set(NOW_NS)
    tracks = StampTracks(StampRule(clocks))
    for number in range(10):
        at_ns = NOW_NS + number * PERIOD_NS
        tracks.of('p').date(at_ns - round(stamp_s * SECOND), at_ns - round(sent_s * SECOND), at_ns)
        tracks.of('q').date(at_ns, at_ns, at_ns)
    report = tracks.report()
    assert report is not None
    assert (report.publisher, report.state, report.cause) == ('p', state, cause)
    assert report.offset_s == (stamp_s if state == 'offset' else None)
    assert report.since_ns == NOW_NS
    assert describe(report).startswith('stamps are ')


def test_stable_and_latched_stamps_are_not_reported() -> None:
    """A message sent an hour ago is no evidence about a clock; nor is a publisher that is silent now."""
    clocks = Clocks()
    clocks.set(NOW_NS)
    tracks = StampTracks(StampRule(clocks))
    tracks.of('latched').date(NOW_NS - 3600 * SECOND, NOW_NS, NOW_NS)
    assert tracks.report() is None
    follow(tracks.of('ended'), [146 * SECOND] * 10)
    assert isinstance(tracks.report(), StampReport)
    follow(tracks.of('now'), [MS] * 10, start_ns=NOW_NS + 120 * SECOND)
    assert tracks.report() is None
