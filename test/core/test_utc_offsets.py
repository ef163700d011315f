"""The one rule by which objects, bags and missions of before the clock was set get their date, or go without one."""

from __future__ import annotations

import pytest
from clocks import NOON_NS, Clocks

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.clock_watch import UtcOffsets

HOLD_S = 600.0
KNOWN_NS = 1234 * SECOND


@pytest.fixture
def clocks() -> Clocks:
    """They are not set."""
    return Clocks()


@pytest.fixture
def offsets(clocks: Clocks) -> UtcOffsets:
    """It knows one earlier boot, and has an old note of this one."""
    return UtcOffsets(clocks, HOLD_S, lambda: {'known-boot': KNOWN_NS, 'this-boot': 1})


def test_it_waits_while_the_clock_is_not_set(clocks: Clocks, offsets: UtcOffsets) -> None:
    """For as long as it may, counted from the beginning; then it goes without a date."""
    began_ns = clocks.boot_ns()
    assert offsets.of('this-boot', began_ns) is None
    clocks.wait(HOLD_S)
    assert offsets.of('this-boot', began_ns) is None
    clocks.wait(0.001)
    assert offsets.of('this-boot', began_ns) == 0
    assert offsets.of('this-boot', clocks.boot_ns()) is None, 'what begins later waits as long'


def test_the_current_clock_dates_objects_of_this_boot(clocks: Clocks, offsets: UtcOffsets) -> None:
    """Whatever was noted of it, and however long it has waited; a correction counts from then on."""
    began_ns = clocks.boot_ns()
    clocks.wait(2 * HOLD_S)
    clocks.set()
    assert offsets.of('this-boot', began_ns) == NOON_NS - clocks.boot_ns()
    clocks.offset_ns += SECOND
    assert offsets.of('this-boot', began_ns) == NOON_NS - clocks.boot_ns() + SECOND


def test_a_clock_that_is_lost_again_dates_nothing(clocks: Clocks, offsets: UtcOffsets) -> None:
    """It was set, and is back in 1970: what is taken now waits anew."""
    clocks.set()
    clocks.wait(2 * HOLD_S)
    clocks.set(5 * SECOND)
    assert offsets.of('this-boot', clocks.boot_ns()) is None


@pytest.mark.parametrize('is_set', [False, True])
def test_an_earlier_boot_is_over(clocks: Clocks, offsets: UtcOffsets, is_set: bool) -> None:
    """What was noted of its clock dates it; else nobody will ever know. It waits for nothing, whatever the clock shows now."""
    if is_set:
        clocks.set()
    assert offsets.of('known-boot', clocks.boot_ns()) == KNOWN_NS
    assert offsets.of('other-boot', clocks.boot_ns()) == 0


def test_nothing_waits_where_nothing_may(clocks: Clocks) -> None:
    """With a wait of 0 s the next moment is too late."""
    offsets = UtcOffsets(clocks, 0.0, dict)
    began_ns = clocks.boot_ns()
    clocks.wait(0.001)
    assert offsets.of('this-boot', began_ns) == 0
