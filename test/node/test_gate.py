"""Downsampling: which messages of a topic are kept."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.node.intake.sampling import EveryMessage, FirstOfPeriod, OnChange, rule_for

NOON_NS = 1_760_788_800 * SECOND


def kept(gate: FirstOfPeriod, *stamps_ns: int) -> list[int]:
    return [stamp for stamp in stamps_ns if gate.selects(stamp, b'')]


def test_the_first_message_of_each_second_is_kept() -> None:
    """Periods are those of UTC, whenever the messages began."""
    stamps = [NOON_NS + round(number * SECOND / 30) for number in range(-5, 91)]
    firsts = {stamp // SECOND: stamp for stamp in reversed(stamps)}
    assert kept(FirstOfPeriod(SECOND), *stamps) == sorted(firsts.values())


def test_a_restart_keeps_nothing_of_a_period_twice() -> None:
    """What was kept before is known by the stamp of the newest durable sample."""
    gate = FirstOfPeriod(SECOND, NOON_NS + 100)
    assert kept(gate, NOON_NS + 200, NOON_NS + SECOND - 1, NOON_NS + SECOND) == [NOON_NS + SECOND]


def test_messages_out_of_order_are_not_kept_twice() -> None:
    """A late message of a period that had its own is skipped."""
    assert kept(FirstOfPeriod(SECOND), NOON_NS, NOON_NS + SECOND, NOON_NS + 5, NOON_NS + SECOND + 1) == [
        NOON_NS,
        NOON_NS + SECOND,
    ]


def test_a_clock_that_is_set_back_does_not_stop_the_sampling() -> None:
    """Stamps an hour back are a clock that was set: it goes on from there."""
    hour = 3600 * SECOND
    assert kept(FirstOfPeriod(SECOND), NOON_NS, NOON_NS - hour, NOON_NS - hour + SECOND) == [
        NOON_NS,
        NOON_NS - hour,
        NOON_NS - hour + SECOND,
    ]


@pytest.mark.parametrize('has_header', [True, False])
def test_a_message_is_kept_when_its_content_changes(*, has_header: bool) -> None:
    """The stamp of a header is not content; where there is no header those bytes are."""
    gate = OnChange(has_header=has_header)
    cdr = b'\x00\x01\x00\x00' + b'STAMPSTA' + b'content'
    assert gate.selects(0, cdr)
    assert not gate.selects(0, cdr)
    assert gate.selects(0, cdr.replace(b'STAMP', b'stamp')) is not has_header
    assert gate.selects(0, cdr.replace(b'content', b'changed'))
    assert gate.selects(0, cdr), 'what comes back is a change as well'


def test_a_latched_message_is_kept_once() -> None:
    """What is sent again to a node that was restarted has the stamp of the newest durable sample; another content is new."""
    gate = OnChange(has_header=False, last_stored_ns=7 * SECOND)
    assert [gate.selects(stamp * SECOND, content) for stamp, content in ((7, b'0000a'), (8, b'0000a'), (9, b'0000b'))] == [
        False, False, True,
    ]  # fmt: skip
    assert OnChange(has_header=False, last_stored_ns=7 * SECOND).selects(8 * SECOND, b'0000a')


def test_the_settings_choose_the_gate() -> None:
    """0 Hz keeps every message, on_change goes before the rate."""

    def gate(**settings: object) -> object:
        return rule_for(SensorSettings(name='x', **settings), has_header=True, last_stored_ns=0)  # type: ignore[arg-type]

    assert isinstance(gate(rate_hz=0.0), EveryMessage)
    assert isinstance(gate(rate_hz=2.0), FirstOfPeriod)
    assert isinstance(gate(rate_hz=2.0, on_change=True), OnChange)
    assert EveryMessage().selects(0, b'')


def test_the_rate_is_the_period() -> None:
    """At 4 Hz four messages a second are kept."""
    gate = rule_for(SensorSettings(name='x', rate_hz=4.0), has_header=True, last_stored_ns=0)
    assert sum(gate.selects(NOON_NS + number * SECOND // 100, b'') for number in range(300)) == 12


def test_a_clock_that_is_set_does_not_stop_the_sampling() -> None:
    """From seconds since boot to UTC and back, each period has its message and none has two."""
    up = 60 * SECOND
    stamps = [up, up + 1, up + SECOND, NOON_NS, NOON_NS + 1, NOON_NS + SECOND, up + 5 * SECOND, up + 6 * SECOND]
    assert kept(FirstOfPeriod(SECOND, NOON_NS - 3600 * SECOND), *stamps) == [up, up + SECOND, *stamps[3:4], *stamps[5:]]
