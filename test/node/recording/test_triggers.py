"""Triggers: a condition once for each time that it holds, and recent agent events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.expression import conditions
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.node.recording.mission_observer import BATTERY_STATE, battery_pct, number_at
from shadowhound_data_logger.node.recording.triggers import LATE_NS, ConditionState, JournalTail

NOW_NS = 1_760_788_800 * 10**9
STORE = get_typestore(Stores.ROS2_HUMBLE)


def fired(text: str, values: list[float], period_s: float = 1.0) -> list[int]:
    """The indices of the values, one period apart, at which the condition triggered."""
    (condition,) = conditions([text])
    judge = ConditionState(condition)
    return [place for place, value in enumerate(values) if judge.poll(value, place * period_s)]


@pytest.mark.parametrize(('text', 'values', 'places'), [
    ('x: t:f < 20', [30, 19, 18, 17, 16, 15], [1]),
    ('x: t:f < 20', [19, 18, 30, 30, 30, 19], [0, 5]),
    ('x: t:f < 20 for 2', [19, 19, 30, 19, 19, 19, 19], [5]),
    ('x: t:f < 20 for 2', [19, 19, 19, 30, 19, 19, 19], [2]),
    ('x: t:f < 20 for 2', [19, 19, 19, 30, 30, 30, 19, 19, 19], [2, 8]),
    ('x: t:f == 1', [0, 1, 1, 0, 0, 1], [1, 5]),
], ids=['once', 'again', 'it has to hold', 'a flicker does not arm it', 'armed again', 'equal'])  # fmt: skip
def test_a_condition_triggers_once_for_each_time_that_it_holds(text: str, values: list[float], places: list[int]) -> None:
    """It must hold for its time, then be false for as long, at least a second, before it triggers again."""
    assert fired(text, values) == places


def test_a_noisy_number_triggers_once() -> None:
    """Also without a hold time: it is rearmed only after a second without it."""
    assert fired('x: t:f < 20', [19, 21] * 50, period_s=0.1) == [0]


def test_nan_neither_triggers_nor_rearms() -> None:
    """It means neither that the condition holds nor that it does not."""
    assert fired('x: t:f < 20 for 3', [19, float('nan'), 19, 19]) == [3]


def test_the_charge_of_a_battery_state_is_compared_as_the_message_has_it() -> None:
    """From 0 to 1: only ``battery_pct`` is converted."""
    (condition,) = conditions(['low: battery:percentage < 0.3'])
    judge, kind = ConditionState(condition), STORE.types[BATTERY_STATE]
    stamp, none = STORE.types['builtin_interfaces/msg/Time'](0, 0), np.empty(0, np.float32)
    reports = []
    for share in (0.73, 0.25, float('nan')):
        header = STORE.types['std_msgs/msg/Header'](stamp, '')
        message = kind(header, 28.5, 31.0, -2.0, 10.0, 15.0, 15.0, share, 2, 1, 3, True, none, none, '', '')
        value = number_at(message, condition.test.path.split('.'))
        assert value is not None
        reports.append((judge.poll(value, 10.0 * len(reports)), battery_pct(message, condition.test.path.split('.'))))
    assert reports == [(False, 73.0), (True, 25.0), (False, None)]


def test_an_agent_event_triggers_once(tmp_path: Path) -> None:
    """Only new ones, with age and data; other records, and partially written ones, are not events."""
    journal = Journal(tmp_path / 'journal')
    tail = JournalTail(tmp_path / 'journal')
    assert list(tail.new(NOW_NS)) == []
    journal.create()
    journal.append({'k': 'start', 't': NOW_NS})
    journal.append({'k': 'event', 't': NOW_NS - 10**9, 'name': 'fall', 'data': {'leg': 2}})
    (report,) = tail.new(NOW_NS)
    assert (report.name, report.age_ns, report.data) == ('fall', 10**9, {'leg': 2})
    assert list(tail.new(NOW_NS)) == []
    journal.append({'k': 'event', 't': NOW_NS, 'name': 'second'})
    with (tmp_path / 'journal').open('ab') as file:
        file.write(b'0000')
    assert [report.name for report in tail.new(NOW_NS)] == ['second']
    journal.close()


def test_an_old_agent_event_does_not_trigger(tmp_path: Path) -> None:
    """A node that starts during a mission creates no events from its past."""
    journal = Journal(tmp_path / 'journal')
    journal.create()
    for age_ns in (10 * LATE_NS, LATE_NS // 2):
        journal.append({'k': 'event', 't': NOW_NS - age_ns, 'name': str(age_ns)})
    assert [report.name for report in JournalTail(tmp_path / 'journal').new(NOW_NS)] == [str(LATE_NS // 2)]
    journal.close()
