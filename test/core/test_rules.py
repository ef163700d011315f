"""Rules: their results, their topics, and the errors of invalid ones."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.rules import Rule, RuleResult, read_rule


@dataclass
class Known:
    """The values that a test sets as known."""

    numbers: dict[str, float] = field(default_factory=dict)
    ssids: Collection[str] | str = ()
    at: int | str = 12 * 60
    type: str | None = None

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        return self.numbers.get(f'{topic}:{".".join(path)}', f'no message of {topic} was received yet')

    def networks(self) -> Collection[str] | str:
        return self.ssids

    def minute(self) -> int | str:
        return self.at

    def mission(self) -> str | None:
        return self.type


def read(text: str) -> Rule:
    found = read_rule(text, 'upload.when')
    assert found is not None
    return found


def evaluate(text: str, known: Known, now_s: float = 0.0) -> RuleResult:
    return read(text).evaluate(known, now_s)


def test_an_empty_rule_is_no_rule() -> None:
    assert read_rule('', 'upload.when') is None
    assert read_rule('  ', 'upload.when') is None


@pytest.mark.parametrize(('text', 'holds'), [
    ('lowstate:bms_state.soc > 30', True), ('lowstate:bms_state.soc >= 42.5', False), ('dock/at:data == true', True),
    ('not dock/at:data == 1', False), ('wifi.ssid == "lab"', True), ("wifi.ssid != 'lab'", False), ('wifi.ssid == "home"', False),
    ('time 11:00-13:00', True), ('time 13:00-11:00', False), ('time 22:00 - 12:01', True), ('time 00:00-24:00', True),
    ('time 12:01-12:00', False), ('mission', True), ('not mission', False), ('mission == "patrol"', True),
    ('mission != "patrol"', False),
    ('lowstate:bms_state.soc > 30 and wifi.ssid == "lab"', True), ('mission and wifi.ssid == "home" or dock/at:data == 1', True),
    ('mission and (wifi.ssid == "home" or dock/at:data == 0)', False), ('not (mission and wifi.ssid == "home")', True),
    ('lowstate:bms_state.soc > 30 for 0 s', True), ('lowstate:bms_state.soc>30 for 0s and(mission)', True),
])  # fmt: skip
def test_rules_have_their_results(text: str, holds: bool) -> None:
    known = Known({'lowstate:bms_state.soc': 42.0, 'dock/at:data': 1.0}, ['lab'], 12 * 60, 'patrol')
    assert evaluate(text, known).holds is holds


@pytest.mark.parametrize(('text', 'holds'), [
    ('soc:data > 30', None), ('not soc:data > 30', None), ('soc:data > 30 and mission', False),
    ('soc:data > 30 or not mission', True),
    ('soc:data > 30 or mission', None), ('wifi.ssid == "lab"', None), ('wifi.ssid != "lab"', None), ('time 00:00-24:00', None),
])  # fmt: skip
def test_what_is_unknown_is_neither_true_nor_false(text: str, holds: bool | None) -> None:
    known = Known(ssids='the system does not report', at='the clock of this machine is not set')
    found = evaluate(text, known)
    assert found.holds is holds
    assert holds is not None or 'unknown' in found.why


def test_a_number_that_is_not_finite_is_unknown() -> None:
    assert evaluate('soc:data < 30', Known({'soc:data': float('nan')})).holds is None


def test_an_unmet_rule_names_its_reason() -> None:
    known = Known({'lowstate:bms_state.soc': 27.0}, ['cafe'])
    found = evaluate('lowstate:bms_state.soc > 30 and wifi.ssid == "lab" and not mission', known)
    assert found.why == 'lowstate:bms_state.soc > 30: it is 27; wifi.ssid == "lab": it is "cafe"'


def test_a_number_must_hold_for_its_time() -> None:
    rule, known = read('soc:data > 30 for 5'), Known({'soc:data': 31.0})
    assert [bool(rule.evaluate(known, now).holds) for now in (0.0, 4.9, 5.0)] == [False, False, True]
    known.numbers['soc:data'] = 29.0
    assert not rule.evaluate(known, 6.0).holds
    known.numbers['soc:data'] = 31.0
    assert [bool(rule.evaluate(known, now).holds) for now in (7.0, 11.9, 12.0)] == [False, False, True]
    known.numbers.clear()
    assert rule.evaluate(known, 13.0).holds is None


def test_every_part_is_evaluated_even_where_one_decides() -> None:
    """Otherwise the hold time of a number would start when the other part changes."""
    rule, known = read('mission and soc:data > 30 for 5'), Known({'soc:data': 31.0})
    assert not rule.evaluate(known, 0.0).holds
    known.type = 'patrol'
    assert rule.evaluate(known, 5.0).holds


def test_a_rule_lists_its_topics() -> None:
    assert list(read('a:b > 1 and (not /c/d:e.f < 2 or mission)').topics()) == ['a', '/c/d']


@pytest.mark.parametrize(('text', 'place'), [
    ('soc > 30', 'character 1'), ('lowstate:soc', 'character 13'), ('lowstate:soc > ', 'character 15'),
    ('lowstate:soc > low', 'character 16'),
    ('mission or', 'character 11'), ('(mission', 'character 9'), ('mission)', 'character 8'), ('mission mission', 'character 9'),
    ('wifi.ssid > "lab"', 'character 11'), ('wifi.ssid == lab', 'character 14'), ('time 22-6', 'character 6'),
    ('mission & x', 'character 9'), ('not', 'character 4'),
])  # fmt: skip
def test_an_invalid_rule_names_the_position(text: str, place: str) -> None:
    with pytest.raises(SettingError) as caught:
        read_rule(text, 'upload.when')
    assert place in str(caught.value)
    assert caught.value.data['name'] == 'upload.when'


@pytest.mark.parametrize('text', [
    'time 25:00-26:00', 'time 10:60-11:00', 'time 24:30-01:00', 'a:b > 1 for -1', 'a:b > 1e999', 'not ' * 40 + 'mission',
    '(' * 40 + 'mission' + ')' * 40, 'mission or ' * 1000 + 'mission',
])  # fmt: skip
def test_a_rule_out_of_bounds_is_refused(text: str) -> None:
    with pytest.raises(SettingError):
        read_rule(text, 'upload.when')


@given(st.text(alphabet='ab:.<>=!()"\'0-9 ntmisordfwe/', max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        found = read_rule(text, 'upload.when')
    except SettingError:
        return
    if found is not None:
        assert found.evaluate(Known(), 0.0).why
