"""The expression language of ``upload.when``, ``keep.when``, ``events.when``, ``events.conditions`` and ``query --when``.

One grammar for all of them (docs/expressions.md); each use evaluates the part that it has facts for, and rejects the rest:

    expression = term { "or" term }                    term = factor { "and" factor }
    factor     = "not" factor | "(" expression ")" | test
    test       = value sign NUMBER [ "for" SECONDS [ "s" ] ]
               | "wifi.ssid" ("==" | "!=") TEXT | "time" HH:MM "-" HH:MM | "mission" [ ("==" | "!=") TEXT ]
    value      = field | FUNCTION "(" field ")"
    field      = TOPIC ":" PATH | SENSOR "." PATH      sign = "<" | "<=" | ">" | ">=" | "==" | "=" | "!=" | "<>"

Keywords are case-insensitive. ``true`` and ``false`` are the numbers 1 and 0.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from shadowhound_data_logger.core.errors import NameRefused, SettingError
from shadowhound_data_logger.core.keys import check_name

MAX_CHARACTERS: Final = 4096
MAX_DEPTH: Final = 32
MAX_TESTS: Final = 64
MAX_HOLD_S: Final = 86_400.0
MAX_SHOWN: Final = 200
"""Maximum characters of an expression in an error."""
FUNCTIONS: Final = ('first', 'last', 'min', 'max', 'mean', 'count', 'nan_count')
"""Statistics of a field in one object (``formats/statistics.py``)."""
COMPARISONS: Final[dict[str, Callable[[Any, Any], Any]]] = {
    '<': operator.lt, '<=': operator.le, '>': operator.gt, '>=': operator.ge, '==': operator.eq, '!=': operator.ne,
}  # fmt: skip
"""Signs and their comparison functions."""
TOPIC, SENSOR, FUNCTION, HOLD, NETWORK, TIME, MISSION, NOT, JOINED = PARTS = (
    'a number of a topic (lowstate:bms_state.soc > 30)', 'a number of a sensor (imu.accelerometer.2 > 15)',
    'a statistic of an object (max(imu.temperature) > 60)',
    "'for' seconds", 'wifi.ssid == "lab"', 'the time of day (time 22:00-06:00)', 'mission, or mission == "patrol"',
    "'not'", "'and', 'or' and parentheses",
)  # fmt: skip
"""The parts of the language, as named in errors."""
MACHINE: Final = frozenset({TOPIC, HOLD, NETWORK, TIME, MISSION, NOT, JOINED})
"""Parts allowed in a rule about the robot and its surroundings."""
MESSAGE: Final = frozenset({TOPIC, HOLD})
"""Parts allowed in an event's condition: one number of a topic's messages."""
STORED: Final = frozenset({SENSOR, FUNCTION, JOINED})
"""Parts allowed in a query of stored objects."""
_SIGNS: Final = {'=': '==', '<>': '!='}
_NUMBER: Final = r'[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_PATH: Final = r'(?:\w+|\*)(?:\.(?:\w+|\*))*'
_TOKEN: Final = re.compile(
    rf"""\s*(?:(?P<text>"[^"]*"|'[^']*')|(?P<span>\d\d?:\d\d\s*-\s*\d\d?:\d\d)(?!\w)|(?P<sign><=|>=|==|!=|<>|<|>|=)
    |(?P<bracket>[()])|(?P<number>{_NUMBER})(?=s?(?![\w:.]))|(?P<field>[A-Za-z/~_][\w/]*:[A-Za-z_]\w*(?:\.\w+)*
    |[A-Za-z_][\w-]*\.{_PATH})|(?P<word>[A-Za-z_]\w*))""",
    re.ASCII | re.VERBOSE,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Comparison:
    """A number of a field against a threshold."""

    text: str
    source: str
    """The topic as written, or the sensor."""
    path: str
    """The field, such as ``bms_state.soc``."""
    sign: str
    value: float
    hold_s: float = 0.0
    """For how many seconds the test must be true."""
    function: str = ''
    """One of ``FUNCTIONS``; empty for the number in each message."""

    def holds(self, values: Any) -> Any:
        """Of a number or an array; False for NaN."""
        return COMPARISONS[self.sign](values, self.value) & (values == values)  # noqa: PLR0124 - false only for NaN


@dataclass(frozen=True, slots=True)
class Network:
    """The name of the WiFi network."""

    text: str
    name: str
    is_it: bool


@dataclass(frozen=True, slots=True)
class TimeOfDay:
    """Local time, from the first minute up to, not including, the last; across midnight if ``last`` is smaller."""

    text: str
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class MissionActive:
    """Whether a mission is active, or a mission of this type."""

    text: str
    type: str | None
    """None for any type."""
    is_it: bool = True


@dataclass(frozen=True, slots=True)
class Not:
    """Negation."""

    part: Expression


@dataclass(frozen=True, slots=True)
class Joined:
    """Expressions that must all be true (``and``), or one of them (``or``)."""

    word: str
    parts: tuple[Expression, ...]


Test = Comparison | Network | TimeOfDay | MissionActive
Expression = Test | Not | Joined


@dataclass(frozen=True, slots=True)
class Condition:
    """A named expression of ``events.conditions``."""

    name: str
    test: Comparison


def parse(text: str, setting: str, allowed: Collection[str]) -> Expression:
    """Parse an expression; ``allowed`` are the parts of the language that the setting can evaluate.

    Raises SettingError with the position of the error and what was expected.
    """
    return _Parser(text, setting, allowed).parse()


def conditions(texts: Iterable[str], setting: str = 'events.conditions') -> tuple[Condition, ...]:
    """Parse texts such as ``low_battery: lowstate:bms_state.soc < 20 for 5``; empty ones are skipped.

    Raises SettingError for an invalid text, or a name that occurs twice.
    """
    found: dict[str, Condition] = {}
    for text in texts:
        if not text:
            continue
        before, colon, expression = text.partition(':')
        if not colon or not before.strip():
            raise SettingError(
                setting, text, "a name and an expression, such as 'low_battery: lowstate:bms_state.soc < 20 for 5'"
            )
        try:
            name = check_name(before.strip(), 'the event')
        except NameRefused as error:
            raise SettingError(setting, text, f'a name that can be part of a key: {error.remedy}') from error
        if name in found:
            raise SettingError(setting, text, f'one condition of each name, and {name} exists already')
        try:
            test = parse(expression.strip(), setting, MESSAGE)
        except SettingError as error:
            raise SettingError(setting, text, error.data['allowed']) from error
        assert isinstance(test, Comparison)
        found[name] = Condition(name, test)
    return tuple(found.values())


def leaves(expression: Expression) -> Iterator[Test]:
    """All tests, from left to right."""
    if isinstance(expression, Not):
        yield from leaves(expression.part)
    elif isinstance(expression, Joined):
        for part in expression.parts:
            yield from leaves(part)
    else:
        yield expression


def topics(expression: Expression) -> list[str]:
    """The topics whose messages the expression needs, as written."""
    return [test.source for test in leaves(expression) if isinstance(test, Comparison)]


def comparisons(expression: Expression) -> list[Comparison]:
    """All comparisons, from left to right."""
    return [test for test in leaves(expression) if isinstance(test, Comparison)]


def text_of(expression: Expression) -> str:
    """A text that ``parse`` reads as this expression."""
    if isinstance(expression, Not):
        return f'not ({text_of(expression.part)})'
    if isinstance(expression, Joined):
        return f' {expression.word} '.join(f'({text_of(part)})' for part in expression.parts)
    return expression.text


class _Parser:
    """Parses one text. New; ``parse`` once."""

    def __init__(self, text: str, setting: str, allowed: Collection[str]) -> None:
        self._text, self._setting, self._allowed = text, setting, allowed
        self._tokens = list(self._split())
        self._place = self._depth = self._tests = 0

    def parse(self) -> Expression:
        found = self._joined('or')
        if self._place < len(self._tokens):
            raise self._wrong("'and' or 'or'" if JOINED in self._allowed else 'nothing more')
        return found

    def _split(self) -> Iterator[tuple[str, str, int]]:
        """Kind, text and position of each token."""
        if len(self._text) > MAX_CHARACTERS:
            raise SettingError(self._setting, f'{self._text[:40]}...', f'at most {MAX_CHARACTERS:,} characters')
        end = 0
        while end < len(self._text.rstrip()):
            match = _TOKEN.match(self._text, end)
            if match is None or match.lastgroup is None:
                raise self._error('a test', len(self._text) - len(self._text[end:].lstrip()))
            yield match.lastgroup, match[match.lastgroup], match.start(match.lastgroup)
            end = match.end()

    def _joined(self, word: str) -> Expression:
        parts = [self._part(word)]
        while self._word(word):
            self._need(JOINED)
            parts.append(self._part(word))
        return parts[0] if len(parts) == 1 else Joined(word, tuple(parts))

    def _part(self, word: str) -> Expression:
        return self._joined('and') if word == 'or' else self._factor()

    def _factor(self) -> Expression:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise SettingError(self._setting, self._text[:MAX_SHOWN], f"'not' and parentheses at most {MAX_DEPTH} deep")
        found: Expression
        if self._word('not'):
            self._need(NOT)
            found = Not(self._factor())
        elif self._take('bracket', '('):
            found = self._joined('or')
            if not self._take('bracket', ')'):
                raise self._wrong("')'")
        else:
            found = self._test()
        self._depth -= 1
        return found

    def _test(self) -> Expression:
        self._tests += 1
        if self._tests > MAX_TESTS:
            raise SettingError(self._setting, self._text[:MAX_SHOWN], f'at most {MAX_TESTS} tests')
        begin = self._place
        if self._take('field', 'wifi.ssid'):
            self._need(NETWORK)
            is_it, name = self._is(), self._string()
            return Network(self._since(begin), name, is_it)
        if self._word('time'):
            self._need(TIME)
            first, last = self._span()
            return TimeOfDay(self._since(begin), first, last)
        if self._word('mission'):
            self._need(MISSION)
            has_type = self._place < len(self._tokens) and self._tokens[self._place][0] == 'sign'
            is_it, of_type = (self._is(), self._string()) if has_type else (True, None)
            return MissionActive(self._since(begin), of_type, is_it)
        return self._comparison(begin)

    def _comparison(self, begin: int) -> Comparison:
        function = next((name for name in FUNCTIONS if self._word(name)), '')
        if function:
            self._need(FUNCTION)
            self._take('bracket', '(') or self._fail("'('")
        field = self._take('field') or self._fail('a test')
        self._need(TOPIC if ':' in field else SENSOR)
        if function:
            self._take('bracket', ')') or self._fail("')'")
        source, _, path = field.partition(':') if ':' in field else field.partition('.')
        sign = self._take('sign') or self._fail('one of < <= > >= == !=')
        value, hold_s = self._number(), 0.0
        if self._word('for'):
            self._need(HOLD)
            hold_s = self._number()
            self._word('s')
        if not 0.0 <= hold_s <= MAX_HOLD_S or not math.isfinite(value):
            allowed = f'a finite number, and 0 to {MAX_HOLD_S:,.0f} seconds'
            raise SettingError(self._setting, self._text[:MAX_SHOWN], allowed)
        return Comparison(self._since(begin), source, path, _SIGNS.get(sign, sign), value, hold_s, function)

    def _take(self, kind: str, text: str | None = None) -> str:
        if self._place < len(self._tokens):
            found = self._tokens[self._place]
            if found[0] == kind and text in {None, found[1]}:
                self._place += 1
                return found[1]
        return ''

    def _word(self, text: str) -> str:
        if self._place < len(self._tokens):
            kind, found, _ = self._tokens[self._place]
            if kind == 'word' and found.lower() == text:
                self._place += 1
                return found
        return ''

    def _is(self) -> bool:
        sign = self._take('sign')
        if _SIGNS.get(sign, sign) not in {'==', '!='}:
            self._place -= bool(sign)
            raise self._wrong("'==' or '!='")
        return _SIGNS.get(sign, sign) == '=='

    def _number(self) -> float:
        for word, value in (('true', 1.0), ('false', 0.0)):
            if self._word(word):
                return value
        return float(self._take('number') or self._fail('a number'))

    def _string(self) -> str:
        return (self._take('text') or self._fail('a name in quotes'))[1:-1]

    def _span(self) -> tuple[int, int]:
        times = re.split(r'\s*-\s*', self._take('span') or self._fail('a time such as 22:00-06:00'))
        minutes = [60 * int(hour) + int(minute) for hour, minute in (time.split(':') for time in times)]
        if max(minutes) > 24 * 60 or any(int(time.split(':')[1]) > 59 for time in times):
            raise SettingError(self._setting, self._text[:MAX_SHOWN], 'times from 00:00 to 24:00')
        return minutes[0], minutes[1]

    def _since(self, begin: int) -> str:
        last = self._tokens[self._place - 1]
        return self._text[self._tokens[begin][2] : last[2] + len(last[1])]

    def _need(self, part: str) -> None:
        """Check that the previous token belongs to a part of the language that is evaluated here."""
        if part not in self._allowed:
            self._place -= 1
            raise self._wrong(f'no use of {part}, which {self._setting} cannot evaluate,')

    def _fail(self, wanted: str) -> str:
        raise self._wrong(wanted)

    def _wrong(self, wanted: str) -> SettingError:
        place = self._tokens[self._place][2] if self._place < len(self._tokens) else len(self._text.rstrip())
        return self._error(wanted, place)

    def _error(self, wanted: str, place: int) -> SettingError:
        found = f'not {self._text[place : place + 20]!r}' if self._text[place:].strip() else 'but the text ends there'
        parts = '; '.join(part for part in PARTS if part in self._allowed)
        return SettingError(
            self._setting, self._text[:MAX_SHOWN], f'{wanted} at character {place + 1}, {found}. Allowed are: {parts}'
        )
