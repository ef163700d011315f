from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.clock import EARLIEST_SANE_NS, FUTURE_SLACK_NS, SECOND, SystemClock, is_sane, iso, utc

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
