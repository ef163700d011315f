"""Evaluates expressions (``expression.py``) about the robot and its surroundings, such as ``upload.when``.

A fact may be unknown; the logic is Kleene's, as in SQL, and an unknown rule is not true.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

from shadowhound_data_logger.core.expression import MACHINE, Comparison, Expression, Joined, MissionActive, Network, Not
from shadowhound_data_logger.core.expression import parse as parse_expression
from shadowhound_data_logger.core.expression import topics as topics_of


class Facts(Protocol):
    """The current values that rules are evaluated with."""

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        """A number of a topic's newest message; a text with the reason if it is unknown."""

    def networks(self) -> Collection[str] | str:
        """Names of the WiFi networks that this machine is connected to; a text with the reason if they are unknown."""

    def minute(self) -> int | str:
        """Minute of the local day; a text with the reason if it is unknown."""

    def mission(self) -> str | None:
        """The type of the active mission; None if none is active."""


class RuleResult(NamedTuple):
    """The result of a rule, or of a part of it."""

    holds: bool | None
    """None if it is unknown."""
    why: str
    """The tests that decided it, with the values found."""


class Rule:
    """An expression that is evaluated repeatedly. It remembers since when each comparison has been true. One thread."""

    def __init__(self, expression: Expression) -> None:
        self._expression = expression
        self._since_s: dict[Comparison, float] = {}

    def topics(self) -> list[str]:
        """The topics whose messages the rule needs, as written."""
        return topics_of(self._expression)

    def evaluate(self, facts: Facts, now_s: float) -> RuleResult:
        """Whether it is true now, by the monotonic clock, and why."""
        return self._evaluate(self._expression, facts, now_s)

    def _evaluate(self, part: Expression, facts: Facts, now_s: float) -> RuleResult:
        if isinstance(part, Joined):
            result = [self._evaluate(each, facts, now_s) for each in part.parts]  # all of them: some have state
            values, deciding = {each.holds for each in result}, part.word == 'or'
            holds = deciding if deciding in values else None if None in values else not deciding
            return RuleResult(holds, '; '.join(each.why for each in result if each.holds is holds))
        if isinstance(part, Not):
            holds, why = self._evaluate(part.part, facts, now_s)
            return RuleResult(None if holds is None else not holds, f'not {why}')
        if isinstance(part, Comparison):
            return self._compare(part, facts, now_s)
        if isinstance(part, Network):
            return _network(part, facts)
        if isinstance(part, MissionActive):
            active = facts.mission()
            is_it = active is not None if part.type is None else (active == part.type) is part.is_it
            return RuleResult(
                is_it, f'{part.text}: {"no mission is active" if active is None else f"a mission is active ({active})"}'
            )
        minute = facts.minute()
        if isinstance(minute, str):
            return RuleResult(None, f'{part.text} is unknown: {minute}')
        after, before = minute >= part.first, minute < part.last
        is_within = (after and before) if part.first < part.last else (after or before)
        return RuleResult(is_within, f'{part.text}: it is {minute // 60:02}:{minute % 60:02}')

    def _compare(self, test: Comparison, facts: Facts, now_s: float) -> RuleResult:
        found = facts.number(test.source, test.path.split('.'))
        if isinstance(found, str) or not math.isfinite(found):
            self._since_s.pop(test, None)
            return RuleResult(None, f'{test.text} is unknown: {found if isinstance(found, str) else "the number is not finite"}')
        if not test.holds(found):
            self._since_s.pop(test, None)
            return RuleResult(False, f'{test.text}: it is {found:g}')
        held_s = now_s - self._since_s.setdefault(test, now_s)
        if held_s < test.hold_s:
            return RuleResult(False, f'{test.text}: it is {found:g}, for {held_s:.0f} s so far')
        return RuleResult(True, f'{test.text}: it is {found:g}')


def _network(test: Network, facts: Facts) -> RuleResult:
    found = facts.networks()
    if isinstance(found, str):
        return RuleResult(None, f'{test.text} is unknown: {found}')
    names = ' and '.join(f'"{name}"' for name in sorted(found))
    return RuleResult(
        (test.name in found) is test.is_it, f'{test.text}: it is {names}' if names else f'{test.text}: there is no WiFi'
    )


def read_rule(text: str, setting: str) -> Rule | None:
    """The rule of a setting; None for an empty text. Raises SettingError with the position of the error."""
    return Rule(parse_expression(text, setting, MACHINE)) if text.strip() else None
