"""Rules: settings that say while what something is done, such as ``upload.when``. Values only; here they are read and judged.

A rule is a text such as ``lowstate:bms_state.soc > 30 and wifi.ssid == "lab"``: tests (``ALLOWED``) joined by ``and``, ``or``,
``not`` and parentheses. What a test asks for may be unknown; then the logic is that of Kleene, as in SQL, and an unknown rule
does not hold.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

from shadowhound_data_logger.core.conditions import COMPARISONS, MAX_HOLD_S, NUMBER
from shadowhound_data_logger.core.errors import SettingError

ALLOWED: Final = (
    "tests joined by 'and', 'or', 'not' and parentheses: a number of a topic (lowstate:bms_state.soc > 30; with 'for 60' it has "
    'to hold for so many seconds; true and false are 1 and 0), the network (wifi.ssid == "lab"), the time of day on this machine '
    '(time 22:00-06:00), or \'mission\' while one is active, of a type (mission == "patrol")'
)
MAX_CHARACTERS: Final = 4096
MAX_DEPTH: Final = 32
_TOKEN: Final = re.compile(
    rf"""\s*(?:(?P<text>"[^"]*"|'[^']*')|(?P<span>\d\d?:\d\d\s*-\s*\d\d?:\d\d)(?!\w)|(?P<sign><=|>=|==|!=|<|>)|(?P<bracket>[()])
    |(?P<number>{NUMBER})(?=s?(?![\w:.]))|(?P<field>[A-Za-z/~_][\w/]*:[A-Za-z]\w*(?:\.\w+)*)|(?P<word>[A-Za-z]\w*(?:\.\w+)*))""",
    re.ASCII | re.VERBOSE,
)  # fmt: skip


class Facts(Protocol):
    """What rules are judged by, as it is now."""

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        """Of the newest message of a topic; a text says why it is unknown."""

    def networks(self) -> Collection[str] | str:
        """Names of the WiFi networks that this machine is in; a text says why they are unknown."""

    def minute(self) -> int | str:
        """Minutes of the local day that have passed; a text says why that is unknown."""

    def mission(self) -> str | None:
        """The type of the active mission; None while none is active."""


class Judged(NamedTuple):
    """What became of a rule, or of a part of it."""

    holds: bool | None
    """None where that is unknown."""
    why: str
    """The tests that it is so for, with what they found."""


class Rule(Protocol):
    """A rule, or a part of one."""

    def judge(self, facts: Facts, now_s: float) -> Judged: ...

    def topics(self) -> Iterator[str]:
        """That it asks, as they were written."""


@dataclass(slots=True)
class NumberTest:
    """A number of a message against a threshold. It remembers since when it has held."""

    text: str
    topic: str
    path: tuple[str, ...]
    sign: str
    threshold: float
    hold_s: float = 0.0
    _since_s: float | None = field(default=None, init=False)

    def judge(self, facts: Facts, now_s: float) -> Judged:
        found = facts.number(self.topic, self.path)
        if isinstance(found, str) or not math.isfinite(found):
            self._since_s = None
            return Judged(None, f'{self.text} is unknown: {found if isinstance(found, str) else "the number is not finite"}')
        if not COMPARISONS[self.sign](found, self.threshold):
            self._since_s = None
            return Judged(False, f'{self.text}: it is {found:g}')
        self._since_s = now_s if self._since_s is None else self._since_s
        if (held_s := now_s - self._since_s) < self.hold_s:
            return Judged(False, f'{self.text}: it is {found:g}, for {held_s:.0f} s so far')
        return Judged(True, f'{self.text}: it is {found:g}')

    def topics(self) -> Iterator[str]:
        yield self.topic


@dataclass(frozen=True, slots=True)
class NetworkTest:
    """The name of the WiFi network."""

    text: str
    name: str
    is_in: bool

    def judge(self, facts: Facts, now_s: float) -> Judged:  # noqa: ARG002 - it has no memory
        found = facts.networks()
        if isinstance(found, str):
            return Judged(None, f'{self.text} is unknown: {found}')
        names = ' and '.join(f'"{name}"' for name in sorted(found))
        return Judged(
            (self.name in found) is self.is_in, f'{self.text}: it is {names}' if names else f'{self.text}: there is no WiFi'
        )

    def topics(self) -> Iterator[str]:
        yield from ()


@dataclass(frozen=True, slots=True)
class TimeTest:
    """Local time of day, from the first minute up to, not including, the last; over midnight where that is the smaller one."""

    text: str
    first: int
    last: int

    def judge(self, facts: Facts, now_s: float) -> Judged:  # noqa: ARG002 - it has no memory
        found = facts.minute()
        if isinstance(found, str):
            return Judged(None, f'{self.text} is unknown: {found}')
        after, before = found >= self.first, found < self.last
        return Judged((after and before) if self.first < self.last else (after or before),
                      f'{self.text}: it is {found // 60:02}:{found % 60:02}')  # fmt: skip

    def topics(self) -> Iterator[str]:
        yield from ()


@dataclass(frozen=True, slots=True)
class MissionTest:
    """Whether a mission is active, or one of a type."""

    text: str
    type: str | None
    """None for any."""
    is_it: bool = True

    def judge(self, facts: Facts, now_s: float) -> Judged:  # noqa: ARG002 - it has no memory
        found = facts.mission()
        holds = found is not None if self.type is None else (found == self.type) is self.is_it
        return Judged(holds, f'{self.text}: {"no mission is active" if found is None else f"a mission is active ({found})"}')

    def topics(self) -> Iterator[str]:
        yield from ()


@dataclass(frozen=True, slots=True)
class Not:
    """The opposite."""

    part: Rule

    def judge(self, facts: Facts, now_s: float) -> Judged:
        holds, why = self.part.judge(facts, now_s)
        return Judged(None if holds is None else not holds, f'not {why}')

    def topics(self) -> Iterator[str]:
        yield from self.part.topics()


@dataclass(frozen=True, slots=True)
class Compound:
    """Parts joined by ``and``, or by ``or``. Each is judged every time, because some remember."""

    parts: tuple[Rule, ...]
    deciding: bool
    """What one part is enough for: False with ``and``, True with ``or``."""

    def judge(self, facts: Facts, now_s: float) -> Judged:
        judged = [part.judge(facts, now_s) for part in self.parts]
        values = {each.holds for each in judged}
        holds = self.deciding if self.deciding in values else None if None in values else not self.deciding
        return Judged(holds, '; '.join(each.why for each in judged if each.holds is holds))

    def topics(self) -> Iterator[str]:
        for part in self.parts:
            yield from part.topics()


def read_rule(text: str, setting: str) -> Rule | None:
    """Of a setting's text; None for an empty one. Raises SettingError, which names the place of what is wrong."""
    return _Reader(text, setting).read() if text.strip() else None


class _Reader:
    """Reads one rule. New; ``read`` once."""

    def __init__(self, text: str, setting: str) -> None:
        self._text = text
        self._setting = setting
        self._tokens = list(self._split())
        self._place = 0
        self._depth = 0

    def read(self) -> Rule:
        found = self._joined('or')
        if self._place < len(self._tokens):
            raise self._wrong("'and' or 'or'")
        return found

    def _split(self) -> Iterator[tuple[str, str, int]]:
        """Kind, text and where it begins."""
        if len(self._text) > MAX_CHARACTERS:
            raise SettingError(self._setting, f'{self._text[:40]}...', f'at most {MAX_CHARACTERS} characters')
        end = 0
        while end < len(self._text.rstrip()):
            match = _TOKEN.match(self._text, end)
            if match is None or match.lastgroup is None:
                raise self._error(
                    'something else', len(self._text[:end]) + len(self._text[end:]) - len(self._text[end:].lstrip())
                )
            yield match.lastgroup, match[match.lastgroup], match.start(match.lastgroup)
            end = match.end()

    def _joined(self, word: str) -> Rule:
        parts = [self._part(word)]
        while self._take('word', word):
            parts.append(self._part(word))
        return parts[0] if len(parts) == 1 else Compound(tuple(parts), deciding=word == 'or')

    def _part(self, word: str) -> Rule:
        return self._joined('and') if word == 'or' else self._one()

    def _one(self) -> Rule:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise SettingError(self._setting, self._text, f"'not' and parentheses at most {MAX_DEPTH} deep")
        if self._take('word', 'not'):
            found: Rule = Not(self._one())
        elif self._take('bracket', '('):
            found = self._joined('or')
            if not self._take('bracket', ')'):
                raise self._wrong("')'")
        else:
            found = self._test()
        self._depth -= 1
        return found

    def _test(self) -> Rule:
        begin = self._place
        if name := self._take('field'):
            topic, _, path = name.partition(':')
            sign, threshold, hold_s = self._sign(), self._number(), 0.0
            if self._take('word', 'for'):
                hold_s = self._number()
                self._take('word', 's')
            if not 0.0 <= hold_s <= MAX_HOLD_S or not math.isfinite(threshold):
                raise SettingError(self._setting, self._text, f'a finite number, and 0 to {MAX_HOLD_S:,.0f} seconds')
            return NumberTest(self._since(begin), topic, tuple(path.split('.')), sign, threshold, hold_s)
        if self._take('word', 'wifi.ssid'):
            is_in, name = self._is(), self._string()
            return NetworkTest(self._since(begin), name, is_in)
        if self._take('word', 'time'):
            first, last = self._span()
            return TimeTest(self._since(begin), first, last)
        if self._take('word', 'mission'):
            is_typed = self._place < len(self._tokens) and self._tokens[self._place][0] == 'sign'
            is_it, of_type = (self._is(), self._string()) if is_typed else (True, None)
            return MissionTest(self._since(begin), of_type, is_it)
        raise self._wrong('a test')

    def _take(self, kind: str, text: str | None = None) -> str:
        if self._place < len(self._tokens):
            found = self._tokens[self._place]
            if found[0] == kind and text in {None, found[1]}:
                self._place += 1
                return found[1]
        return ''

    def _sign(self) -> str:
        return self._take('sign') or self._fail('one of < <= > >= == !=')

    def _is(self) -> bool:
        sign = self._take('sign', '==') or self._take('sign', '!=') or self._fail("'==' or '!='")
        return sign == '=='

    def _number(self) -> float:
        for word, value in (('true', 1.0), ('false', 0.0)):
            if self._take('word', word):
                return value
        return float(self._take('number') or self._fail('a number'))

    def _string(self) -> str:
        return (self._take('text') or self._fail('a name in quotes'))[1:-1]

    def _span(self) -> tuple[int, int]:
        texts = re.split(r'\s*-\s*', self._take('span') or self._fail('a time such as 22:00-06:00'))
        hours, minutes = zip(*(map(int, text.split(':')) for text in texts), strict=True)
        if (
            max(hours) > 24
            or max(minutes) > 59
            or any(hour == 24 and minute for hour, minute in zip(hours, minutes, strict=True))
        ):
            raise SettingError(self._setting, self._text, 'times from 00:00 to 24:00')
        first, last = (60 * hour + minute for hour, minute in zip(hours, minutes, strict=True))
        return first, last

    def _since(self, begin: int) -> str:
        last = self._tokens[self._place - 1]
        return self._text[self._tokens[begin][2] : last[2] + len(last[1])]

    def _fail(self, wanted: str) -> str:
        raise self._wrong(wanted)

    def _wrong(self, wanted: str) -> SettingError:
        place = self._tokens[self._place][2] if self._place < len(self._tokens) else len(self._text.rstrip())
        return self._error(wanted, place)

    def _error(self, wanted: str, place: int) -> SettingError:
        found = f'not {self._text[place : place + 20]!r}' if self._text[place:].strip() else 'but the text ends there'
        return SettingError(self._setting, self._text, f'{wanted} at character {place + 1}, {found}. Allowed are {ALLOWED}')
