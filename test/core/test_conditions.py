"""Conditions of the settings: what is one is read as it was meant, anything else stops the start and says what is allowed."""

from __future__ import annotations

import math

import pytest

from shadowhound_data_logger.core.conditions import Condition, conditions
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import SettingError

LOW = 'low_battery: lowstate:bms_state.soc < 20 for 5'


def test_a_condition_is_read() -> None:
    """Name, topic, field, comparison, threshold and hold time, whatever the blanks."""
    assert conditions([LOW]) == (Condition(LOW, 'low_battery', 'lowstate', ('bms_state', 'soc'), '<', 20.0, 5.0),)
    (other,) = conditions(['hot:/r0/lowstate:motor_state.3.temperature>=-7.5e1  for 0.5 s'])
    assert (other.name, other.topic, other.field) == ('hot', '/r0/lowstate', ('motor_state', '3', 'temperature'))
    assert (other.comparison, other.threshold, other.hold_s) == ('>=', -75.0, 0.5)
    assert conditions(['']) == ()


@pytest.mark.parametrize(('sign', 'holding'), [
    ('<', {1}), ('<=', {1, 2}), ('>', {3}), ('>=', {2, 3}), ('==', {2}), ('!=', {1, 3}),
])  # fmt: skip
def test_each_comparison(sign: str, holding: set[int]) -> None:
    """Holds for the numbers that its sign says."""
    (condition,) = conditions([f'x: t:f {sign} 2'])
    assert {value for value in (1, 2, 3) if condition.holds(value)} == holding


@pytest.mark.parametrize('text', [
    'low_battery', 'lowstate:bms_state.soc < 20', 'x: lowstate < 20', 'x: t:f < ', 'x: t:f < twenty', 'x: t:f = 20',
    'x: t:f < 20 for', 'x: t:f < 20 for -1', 'x: t:f < 20 for 1e6', 'x: t:f < 1e999', 'x: t:f < nan', '../x: t:f < 20',
    f'{"x" * 65}: t:f < 1', 'x: t:3 < 1',
])  # fmt: skip
def test_what_is_none_stops_the_start(text: str) -> None:
    """With the parameter's name, its value and what is allowed."""
    with pytest.raises(SettingError) as refused:
        Settings.load({'events.topics': ['t'], 'events.conditions': [text]}, {})
    assert refused.value.data['name'] == 'events.conditions'
    assert refused.value.data['value'] == text
    assert refused.value.data['allowed']


@pytest.mark.parametrize(('name', 'given'), [
    ('events.conditions', {'events.topics': ['t'], 'events.conditions': [LOW, 'low_battery: imu:temperature > 1']}),
    ('events.conditions', {'events.conditions': [LOW]}),
    ('events.max_s', {'events.post_s': 50.0, 'events.max_s': 49.0}),
    ('events.regex', {'events.regex': '('}),
    ('events.log_event', {'events.log_event': '['}),
    ('events.max_bytes', {'events.max_bytes': 100}),
    ('events.pre_s', {'events.pre_s': math.nan}),
])  # fmt: skip
def test_what_makes_no_sense_stops_the_start(name: str, given: dict[str, object]) -> None:
    """A name twice, conditions without anything to keep, an event shorter than its end, what is not an expression."""
    with pytest.raises(SettingError) as refused:
        Settings.load(given, {})
    assert refused.value.data['name'] == name
