"""Unset clocks and clock steps are found with the boot clock and logged once; offsets date earlier objects."""

from __future__ import annotations

import logging

import pytest
from clocks import NOON_NS, Clocks

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.clock_watch import ClockWatch, UtcOffsets


@pytest.fixture
def clocks() -> Clocks:
    """Clocks that are not set."""
    return Clocks()


def test_a_clock_before_2024_is_not_set(clocks: Clocks) -> None:
    """Its offset is unknown, and the time since it started is known."""
    watch = ClockWatch(clocks, 600.0)
    clocks.wait(5)
    state = watch.state()
    assert (state.is_set, state.gave_up, state.unset_s, state.steps, watch.offset_ns()) == (False, False, 5.0, 0, None)
    clocks.set(EARLIEST_SANE_NS)
    assert watch.state().is_set
    assert watch.offset_ns() == EARLIEST_SANE_NS - clocks.boot_ns()


def test_setting_the_clock_is_a_step(clocks: Clocks) -> None:
    """It is reported immediately instead of at the next poll, and counted only once."""
    watch = ClockWatch(clocks, 600.0)
    clocks.set()
    assert (watch.is_set, watch.state().unset_s, watch.state().steps) == (True, 0.0, 0)
    assert [watch.poll() for _ in range(3)] == [True, False, False]
    assert watch.state().steps == 1


@pytest.mark.parametrize(('step_s', 'steps'), [(3600.0, 1), (-3600.0, 1), (1.5, 1), (-1.5, 1), (0.9, 0), (-0.9, 0)])
def test_a_step_is_more_than_a_second(clocks: Clocks, step_s: float, steps: int) -> None:
    """In either direction; with its size and time."""
    clocks.set()
    watch = ClockWatch(clocks, 600.0)
    clocks.offset_ns += round(step_s * SECOND)
    assert watch.poll() is bool(steps)
    clocks.wait(7)
    state = watch.state()
    assert (state.steps, state.last_step_s, state.last_step_age_s) == ((1, step_s, 7.0) if steps else (0, None, None))


def test_a_clock_that_is_slewed_does_not_step(clocks: Clocks) -> None:
    """0.5 ms per second, for hours: each poll compares with the previous one."""
    clocks.set()
    watch = ClockWatch(clocks, 600.0)
    for _ in range(4 * 3600):
        clocks.wait(1)
        clocks.offset_ns += 500_000
        assert not watch.poll()


def test_the_clock_is_not_waited_for_indefinitely(clocks: Clocks) -> None:
    """After the configured time, and only while it is not set; setting it later counts as usual."""
    watch = ClockWatch(clocks, 600.0)
    clocks.wait(600)
    assert not watch.state().gave_up
    clocks.wait(1)
    assert watch.state().gave_up
    clocks.set()
    assert not watch.state().gave_up


def test_a_lost_clock_is_waited_for_again(clocks: Clocks) -> None:
    """Back in 1970, the wait starts again."""
    clocks.set()
    watch = ClockWatch(clocks, 600.0)
    clocks.wait(5000)
    clocks.set(0)
    watch.poll()
    clocks.wait(599)
    state = watch.state()
    assert (state.is_set, state.gave_up, state.unset_s) == (False, False, 599.0)


def test_each_change_is_logged_once(clocks: Clocks, caplog: pytest.LogCaptureFixture) -> None:
    """That it is not set, that nothing waits for it any more, that it was set, and each step."""
    caplog.set_level(logging.INFO)
    watch = ClockWatch(clocks, 600.0, steps=4)

    def warnings_after(seconds: float) -> list[str]:
        caplog.clear()
        clocks.wait(seconds)
        for _ in range(3):
            watch.poll()
        return [record.getMessage().split(';')[0].split(':')[0] for record in caplog.records]

    assert warnings_after(0) == ['the clock of this machine is not set']
    assert warnings_after(601) == ['the clock was not set for 601 s']
    clocks.set()
    assert warnings_after(0) == ['the clock was set']
    clocks.offset_ns -= 5 * SECOND
    assert warnings_after(0) == ['the clock stepped by -5.000 s']
    assert warnings_after(10) == []
    assert watch.state().steps == 6


def test_a_clock_watch_is_a_clock(clocks: Clocks) -> None:
    """Its time is that of the machine."""
    clocks.set()
    watch = ClockWatch(clocks, 600.0)
    assert (watch.wall_ns(), watch.boot_ns(), watch.boot_id) == (NOON_NS, 60 * SECOND, 'this-boot')


HOLD_S = 600.0
KNOWN_NS = 1234 * SECOND


@pytest.fixture
def offsets(clocks: Clocks) -> UtcOffsets:
    """It has one earlier boot, and an old record of this one."""
    return UtcOffsets(clocks, HOLD_S, lambda: {'known-boot': KNOWN_NS, 'this-boot': 1})


def test_dating_waits_while_the_clock_is_not_set(clocks: Clocks, offsets: UtcOffsets) -> None:
    """Up to the limit, counted from the start; then objects are sent without a date."""
    began_ns = clocks.boot_ns()
    assert offsets.of('this-boot', began_ns) is None
    clocks.wait(HOLD_S)
    assert offsets.of('this-boot', began_ns) is None
    clocks.wait(0.001)
    assert offsets.of('this-boot', began_ns) == 0
    assert offsets.of('this-boot', clocks.boot_ns()) is None, 'what begins later waits as long'


def test_the_current_clock_dates_objects_of_this_boot(clocks: Clocks, offsets: UtcOffsets) -> None:
    """Whatever was recorded for this boot, and however long they have waited; a correction counts from then on."""
    began_ns = clocks.boot_ns()
    clocks.wait(2 * HOLD_S)
    clocks.set()
    assert offsets.of('this-boot', began_ns) == NOON_NS - clocks.boot_ns()
    clocks.offset_ns += SECOND
    assert offsets.of('this-boot', began_ns) == NOON_NS - clocks.boot_ns() + SECOND


def test_a_clock_that_is_lost_again_dates_nothing(clocks: Clocks, offsets: UtcOffsets) -> None:
    """It was set, and is back in 1970: new objects wait again."""
    clocks.set()
    clocks.wait(2 * HOLD_S)
    clocks.set(5 * SECOND)
    assert offsets.of('this-boot', clocks.boot_ns()) is None


@pytest.mark.parametrize('is_set', [False, True])
def test_objects_of_an_earlier_boot_are_not_waited_for(clocks: Clocks, offsets: UtcOffsets, is_set: bool) -> None:
    """The recorded offset dates them; otherwise their date stays unknown. They do not wait, whatever the clock shows now."""
    if is_set:
        clocks.set()
    assert offsets.of('known-boot', clocks.boot_ns()) == KNOWN_NS
    assert offsets.of('other-boot', clocks.boot_ns()) == 0


def test_nothing_waits_where_waiting_is_off(clocks: Clocks) -> None:
    """With a wait of 0 s the next moment is too late."""
    offsets = UtcOffsets(clocks, 0.0, dict)
    began_ns = clocks.boot_ns()
    clocks.wait(0.001)
    assert offsets.of('this-boot', began_ns) == 0
