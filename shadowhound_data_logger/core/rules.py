"""Evaluates expressions (``expression.py``) about the robot and its surroundings, such as ``upload.when``.

A fact may be unknown; then the logic is Kleene's, as in SQL, and an unknown rule is not true.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

from shadowhound_data_logger.core.expression import MACHINE, Comparison, Expression, Joined, MissionActive, Network, Not
from shadowhound_data_logger.core.expression import parse as parse_expression
from shadowhound_data_logger.core.expression import topics as topics_of


class Facts(Protocol):
    """What rules are evaluated with, as it is now."""

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        """Of the newest message of a topic; a text if it is unknown, which states the reason."""

    def networks(self) -> Collection[str] | str:
        """Names of the WiFi networks that this machine is in; a text if they are unknown, which states the reason."""

    def minute(self) -> int | str:
        """Minutes of the local day that have passed; a text if that is unknown, which states the reason."""

    def mission(self) -> str | None:
        """The type of the active mission; None if none is active."""


class Judged(NamedTuple):
    """The result of a rule, or of a part of it."""

    holds: bool | None
    """None if it is unknown."""
    why: str
    """The tests that led to it, with what they found."""


class Rule:
    """An expression that is evaluated again and again. It remembers since when each comparison has been true. One thread."""

    def __init__(self, expression: Expression) -> None:
        self._expression = expression
        self._since_s: dict[Comparison, float] = {}

    def topics(self) -> list[str]:
        """The topics whose messages it needs, as they were written."""
        return topics_of(self._expression)

    def judge(self, facts: Facts, now_s: float) -> Judged:
        """Whether it is true now, by the monotonic clock, and why."""
        return self._judge(self._expression, facts, now_s)

    def _judge(self, part: Expression, facts: Facts, now_s: float) -> Judged:
        if isinstance(part, Joined):
            judged = [self._judge(each, facts, now_s) for each in part.parts]  # all of them: some remember
            values, deciding = {each.holds for each in judged}, part.word == 'or'
            holds = deciding if deciding in values else None if None in values else not deciding
            return Judged(holds, '; '.join(each.why for each in judged if each.holds is holds))
        if isinstance(part, Not):
            holds, why = self._judge(part.part, facts, now_s)
            return Judged(None if holds is None else not holds, f'not {why}')
        if isinstance(part, Comparison):
            return self._compare(part, facts, now_s)
        if isinstance(part, Network):
            return _network(part, facts)
        if isinstance(part, MissionActive):
            active = facts.mission()
            is_it = active is not None if part.type is None else (active == part.type) is part.is_it
            return Judged(
                is_it, f'{part.text}: {"no mission is active" if active is None else f"a mission is active ({active})"}'
            )
        minute = facts.minute()
        if isinstance(minute, str):
            return Judged(None, f'{part.text} is unknown: {minute}')
        after, before = minute >= part.first, minute < part.last
        is_within = (after and before) if part.first < part.last else (after or before)
        return Judged(is_within, f'{part.text}: it is {minute // 60:02}:{minute % 60:02}')

    def _compare(self, test: Comparison, facts: Facts, now_s: float) -> Judged:
        found = facts.number(test.source, test.path.split('.'))
        if isinstance(found, str) or not math.isfinite(found):
            self._since_s.pop(test, None)
            return Judged(None, f'{test.text} is unknown: {found if isinstance(found, str) else "the number is not finite"}')
        if not test.holds(found):
            self._since_s.pop(test, None)
            return Judged(False, f'{test.text}: it is {found:g}')
        held_s = now_s - self._since_s.setdefault(test, now_s)
        if held_s < test.hold_s:
            return Judged(False, f'{test.text}: it is {found:g}, for {held_s:.0f} s so far')
        return Judged(True, f'{test.text}: it is {found:g}')


def _network(test: Network, facts: Facts) -> Judged:
    found = facts.networks()
    if isinstance(found, str):
        return Judged(None, f'{test.text} is unknown: {found}')
    names = ' and '.join(f'"{name}"' for name in sorted(found))
    return Judged(
        (test.name in found) is test.is_it, f'{test.text}: it is {names}' if names else f'{test.text}: there is no WiFi'
    )


def read_rule(text: str, setting: str) -> Rule | None:
    """The rule of a setting; None for an empty text. Raises SettingError, which names the position of what is wrong."""
    return Rule(parse_expression(text, setting, MACHINE)) if text.strip() else None
