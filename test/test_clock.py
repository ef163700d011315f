from __future__ import annotations

import pytest
from clocks import Clocks
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.clock import EARLIEST_SANE_NS, FUTURE_SLACK_NS, SECOND, SystemClock, is_sane, iso, stamp_of, utc

NOW_NS = 1_760_788_800 * SECOND


@pytest.mark.parametrize(('stamp_ns', 'reference_ns', 'sane'), [
    (NOW_NS, NOW_NS, True), (0, NOW_NS, False), (5 * SECOND, 5 * SECOND, False), (EARLIEST_SANE_NS, NOW_NS, True),
    (EARLIEST_SANE_NS - 1, NOW_NS, False), (NOW_NS + FUTURE_SLACK_NS, NOW_NS, True),
    (NOW_NS + FUTURE_SLACK_NS + 1, NOW_NS, False),
    (NOW_NS, 0, False), (-1, NOW_NS, False),
])  # fmt: skip
def test_a_stamp_is_believed_within_bounds(stamp_ns: int, reference_ns: int, sane: bool) -> None:
    """A stamp before 2024 or more than a day ahead of its publisher's clock is not believed."""
    assert is_sane(stamp_ns, reference_ns) is sane


def test_times_are_utc() -> None:
    """Stamps become UTC, to the microsecond, whatever the zone of the machine."""
    assert iso(NOW_NS + 250_000_999) == '2025-10-18T12:00:00.250000Z'


@given(st.integers(0, (1 << 63) - 1))
def test_no_stamp_is_rounded_up(stamp_ns: int) -> None:
    """A stamp's datetime is never later than the stamp, and less than a microsecond earlier."""
    when = utc(stamp_ns)
    whole = round(when.replace(microsecond=0).timestamp()) * SECOND + when.microsecond * 1000
    assert 0 <= stamp_ns - whole < 1000


def test_the_machine_has_a_boot() -> None:
    """The identity of this boot is the same twice, and its clocks go forward."""
    one, two = SystemClock.of_this_machine(), SystemClock.of_this_machine()
    assert one.boot_id == two.boot_id != ''
    assert one.boot_ns() <= two.boot_ns()
    assert two.wall_ns() > NOW_NS


@pytest.mark.parametrize(('header_ns', 'source_ns', 'is_set', 'stamp_ns'), [
    pytest.param(NOW_NS - 5, NOW_NS, True, NOW_NS - 5, id='all clocks are set'),
    pytest.param(0, NOW_NS, True, NOW_NS, id='no header'),
    pytest.param(70 * SECOND, NOW_NS, True, NOW_NS, id='a header of 1970, sent later'),
    pytest.param(NOW_NS - 5, 70 * SECOND, True, NOW_NS - 5, id='a header that our clock confirms, a publisher in 1970'),
    pytest.param(NOW_NS + 2 * FUTURE_SLACK_NS, 70 * SECOND, True, NOW_NS, id='a header that our clock refuses'),
    pytest.param(0, 70 * SECOND, True, NOW_NS, id='another machine in 1970'),
    pytest.param(0, 69 * SECOND, False, 59 * SECOND, id='a driver on this machine, all in 1970'),
    pytest.param(69 * SECOND, 69 * SECOND, False, 59 * SECOND, id='the same with a header'),
    pytest.param(0, 3 * SECOND, False, 60 * SECOND, id='another machine in another 1970'),
    pytest.param(0, 71 * SECOND, False, 60 * SECOND, id='another machine ahead of ours in 1970'),
    pytest.param(NOW_NS, 69 * SECOND, False, 59 * SECOND, id='a header that nobody can confirm'),
    pytest.param(NOW_NS, NOW_NS + 5, False, NOW_NS, id='another machine that knows the time'),
    pytest.param(0, NOW_NS + 5, False, NOW_NS + 5, id='another machine that knows the time, no header'),
])  # fmt: skip
def test_the_best_time_of_a_message(header_ns: int, source_ns: int, stamp_ns: int, *, is_set: bool) -> None:
    """UTC by the best clock that has it; else the boot clock's time, which is that of the sending where that can be known."""
    clocks = Clocks()
    if is_set:
        clocks.set(NOW_NS)
    assert stamp_of(header_ns, source_ns, clocks) == stamp_ns
