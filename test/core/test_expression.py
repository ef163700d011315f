"""The expression language: valid expressions are parsed; all others name the position and what is allowed."""

from __future__ import annotations

import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.expression import (
    FUNCTIONS,
    MACHINE,
    PARTS,
    STORED,
    Comparison,
    Condition,
    conditions,
    leaves,
    parse,
    text_of,
)
from shadowhound_data_logger.formats.statistics import NUMBERS

LOW = 'low_battery: lowstate:bms_state.soc < 20 for 5'


def test_a_condition_is_parsed() -> None:
    """Name, topic, field, comparison, threshold and hold time, with any white space."""
    test = Comparison('lowstate:bms_state.soc < 20 for 5', 'lowstate', 'bms_state.soc', '<', 20.0, 5.0)
    assert conditions([LOW]) == (Condition('low_battery', test),)
    (other,) = conditions(['hot:/r0/lowstate:motor_state.3.temperature>=-7.5e1  for 0.5 s'])
    assert (other.name, other.test.source, other.test.path) == ('hot', '/r0/lowstate', 'motor_state.3.temperature')
    assert (other.test.sign, other.test.value, other.test.hold_s) == ('>=', -75.0, 0.5)
    assert conditions(['']) == ()


@pytest.mark.parametrize(('sign', 'holding'), [
    ('<', {1}), ('<=', {1, 2}), ('>', {3}), ('>=', {2, 3}), ('==', {2}), ('!=', {1, 3}),
])  # fmt: skip
def test_each_comparison_holds_as_its_sign_states(sign: str, holding: set[int]) -> None:
    """For each comparison operator."""
    (condition,) = conditions([f'x: t:f {sign} 2'])
    assert {value for value in (1, 2, 3) if condition.test.holds(value)} == holding


@pytest.mark.parametrize('text', [
    'low_battery', 'lowstate:bms_state.soc < 20', 'x: lowstate < 20', 'x: t:f < ', 'x: t:f < twenty', 'x: t:f ~ 20',
    'x: t:f < 20 and t:f > 1', 'x: mission', 'x: max(t.f) > 1',
    'x: t:f < 20 for', 'x: t:f < 20 for -1', 'x: t:f < 20 for 1e6', 'x: t:f < 1e999', 'x: t:f < nan', '../x: t:f < 20',
    f'{"x" * 65}: t:f < 1', 'x: t:3 < 1',
])  # fmt: skip
def test_an_invalid_expression_aborts_startup(text: str) -> None:
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
def test_a_senseless_expression_aborts_startup(name: str, given: dict[str, object]) -> None:
    """A duplicate name, conditions without data to keep, an event shorter than the time after it, an invalid expression."""
    with pytest.raises(SettingError) as refused:
        Settings.load(given, {})
    assert refused.value.data['name'] == name


NAMES = st.sampled_from(['lowstate', 'imu', 'front_scan'])
PATHS = st.sampled_from(['soc', 'bms_state.soc', 'motor_state.3.temperature', 'foot_force.*'])
SIGN = st.sampled_from(['<', '<=', '>', '>=', '==', '!='])


def spelled(draw: st.DrawFn, depth: int) -> str:
    """A random expression using the complete language."""
    kind = draw(st.integers(0, 6 if depth else 4))
    if kind == 0:
        return f'{draw(NAMES)}.{draw(PATHS)} {draw(SIGN)} {draw(st.floats(-1e6, 1e6))!r}'
    if kind == 1:
        return f'/{draw(NAMES)}:bms_state.soc {draw(SIGN)} {draw(st.integers(-9, 9))} for {draw(st.integers(0, 60))} s'
    if kind == 2:
        return f'{draw(st.sampled_from(FUNCTIONS))}({draw(NAMES)}.{draw(PATHS)}) {draw(SIGN)} true'
    if kind == 3:
        return draw(st.sampled_from(['mission', 'mission == "patrol"', 'wifi.ssid != "lab"', 'time 22:00-06:00']))
    if kind == 4:
        return f'NOT {spelled(draw, 0)}'
    word = draw(st.sampled_from(['and', 'or', 'AND']))
    return f'({spelled(draw, depth - 1)}) {word} {spelled(draw, depth - 1)}'


@given(st.data())
def test_an_expression_that_is_spelled_out_is_the_same(data: st.DataObject) -> None:
    """``parse`` reads the output of ``text_of`` as the same tests in the same order."""
    found = parse(spelled(data.draw, 3), 'x', PARTS)
    again = parse(text_of(found), 'x', PARTS)
    assert list(leaves(again)) == list(leaves(found))
    assert text_of(again) == text_of(parse(text_of(again), 'x', PARTS))


@given(st.text(alphabet='abm:.()<>=!"\'09 andortime22:00-wifi.ssid*', max_size=60))
def test_any_text_is_an_expression_or_a_clear_error(text: str) -> None:
    """There is no other error."""
    with suppress(SettingError):
        assert list(leaves(parse(text, 'x', PARTS)))


@pytest.mark.parametrize(('text', 'allowed', 'position'), [
    ('a:b > 1 and', MACHINE, 'character 12'), ('a:b > 1 or max(c.d) > 2', MACHINE, 'character 12'),
    ('mission', STORED, 'character 1'),
    ('a.b > 1 for 5', STORED, 'character 9'), ('not a.b > 1', STORED, 'character 1'), ('a:b >', MACHINE, 'character 6'),
    ('wifi.ssid > "lab"', MACHINE, 'character 11'), ('', MACHINE, 'character 1'), ('objects', STORED, 'character 1'),
])  # fmt: skip
def test_an_error_names_the_position_and_what_is_expected(text: str, allowed: frozenset[str], position: str) -> None:
    """The error also names expressions that one setting allows and another does not."""
    with pytest.raises(SettingError) as refused:
        parse(text, 'upload.when', allowed)
    assert position in refused.value.data['allowed']


@pytest.mark.parametrize('text', ['(' * 33 + 'a:b > 1', 'not ' * 33 + 'a:b > 1', ' and '.join(['a:b > 1'] * 65), 'a' * 4097])
def test_hostile_expressions_are_bounded(text: str) -> None:
    """Depth, length and the number of tests."""
    with pytest.raises(SettingError, match='at most'):
        parse(text, 'x', PARTS)


def test_the_functions_are_those_of_the_statistics() -> None:
    """As in the catalog; the expression language imports nothing from formats."""
    assert FUNCTIONS == NUMBERS
