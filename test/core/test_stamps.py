"""Which time a message gets, by who publishes it and how well the clocks are set."""

from __future__ import annotations

import pytest
from clocks import NOON_NS as NOW_NS
from clocks import Clocks

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.stamps import DAY_NS, Dated, StampRule

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
    """A message's own time counts within the bound on both sides of its arrival; otherwise the arrival does, with the reason."""
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
def test_the_best_time_while_our_clock_is_not_set(header_ns: int, source_ns: int, dated: Dated) -> None:
    """UTC by another machine that knows it; otherwise the boot clock's time, that of the sending where it can be known."""
    clocks = Clocks()
    assert StampRule(clocks).date(header_ns, source_ns, clocks.wall_ns()) == dated


def test_the_bound_can_be_raised() -> None:
    """Whoever replays the bags of a year keeps their stamps, and still trusts none beyond it."""
    rule = StampRule(Clocks(), 365 * DAY_NS)
    assert rule.date(NOW_NS - 364 * DAY_NS, NOW_NS, NOW_NS) == Dated(NOW_NS - 364 * DAY_NS)
    assert rule.date(NOW_NS - 366 * DAY_NS, NOW_NS, NOW_NS) == Dated(NOW_NS, 'stamp_too_old')
