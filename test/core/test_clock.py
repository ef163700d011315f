from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.clock import SECOND, SystemClock, iso, utc

NOW_NS = 1_760_788_800 * SECOND


def test_times_are_utc() -> None:
    """Stamps become UTC, to the microsecond, in any time zone of the machine."""
    assert iso(NOW_NS + 250_000_999) == '2025-10-18T12:00:00.250000Z'


@given(st.integers(0, (1 << 63) - 1))
def test_no_stamp_is_rounded_up(stamp_ns: int) -> None:
    """A stamp's datetime is never later than the stamp, and less than a microsecond earlier."""
    when = utc(stamp_ns)
    whole = round(when.replace(microsecond=0).timestamp()) * SECOND + when.microsecond * 1000
    assert 0 <= stamp_ns - whole < 1000


def test_the_machine_has_a_boot() -> None:
    """The boot id is constant, and the clocks advance."""
    one, two = SystemClock.of_this_machine(), SystemClock.of_this_machine()
    assert one.boot_id == two.boot_id != ''
    assert one.boot_ns() <= two.boot_ns()
    assert two.wall_ns() > NOW_NS
