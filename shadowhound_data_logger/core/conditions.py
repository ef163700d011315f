"""Conditions: settings that say when a number of a message triggers an event. Values only; here they are read.

A condition is a text such as ``low_battery: lowstate:bms_state.soc < 20 for 5``: its name, a topic with a field, a comparison,
and for how many seconds it has to hold.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.core.errors import NameRefused, SettingError
from shadowhound_data_logger.core.keys import check_name

MAX_HOLD_S: Final = 86_400.0
ALLOWED: Final = (
    "a text such as 'low_battery: lowstate:bms_state.soc < 20 for 5': "
    "a name, topic:field, one of < <= > >= == !=, a number and, where it has to hold, 'for' seconds"
)
COMPARISONS: Final[dict[str, Callable[[float, float], bool]]] = {
    '<': operator.lt, '<=': operator.le, '>': operator.gt, '>=': operator.ge, '==': operator.eq, '!=': operator.ne,
}  # fmt: skip
"""Signs and what they compare."""
NUMBER: Final = r'[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?'
_CONDITION: Final = re.compile(
    rf'\s*(?P<name>[^:\s]+)\s*:\s*(?P<topic>[^:\s]+):(?P<field>[A-Za-z]\w*(?:\.\w+)*)\s*(?P<comparison><=|>=|==|!=|<|>)'
    rf'\s*(?P<threshold>{NUMBER})(?:\s+for\s+(?P<hold>{NUMBER})(?:\s*s)?)?\s*', re.ASCII,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition on a field of a topic, as the settings have it."""

    text: str
    name: str
    topic: str
    """As it was written; relative to the node's namespace."""
    field: tuple[str, ...]
    comparison: str
    threshold: float
    hold_s: float

    def holds(self, value: float) -> bool:
        """Whether the number is beyond the threshold."""
        return COMPARISONS[self.comparison](value, self.threshold)


def conditions(texts: Iterable[str], setting: str = 'events.conditions') -> tuple[Condition, ...]:
    """Of a list of texts, empty ones left out. Raises SettingError for an invalid one, or a name that is there twice."""
    found: dict[str, Condition] = {}
    for text in texts:
        if text:
            condition = _parse(text, setting)
            if condition.name in found:
                raise SettingError(setting, text, f'one condition of each name, and {condition.name} is there already')
            found[condition.name] = condition
    return tuple(found.values())


def _parse(text: str, setting: str) -> Condition:
    match = _CONDITION.fullmatch(text)
    if match is None:
        raise SettingError(setting, text, ALLOWED)
    try:
        name = check_name(match['name'], 'the event')
    except NameRefused as error:
        raise SettingError(setting, text, f'a name that can be part of a key: {error.remedy}') from error
    hold_s, threshold = float(match['hold'] or 0.0), float(match['threshold'])
    if not 0.0 <= hold_s <= MAX_HOLD_S or not math.isfinite(threshold):
        raise SettingError(setting, text, f'{ALLOWED}; a finite number, and 0 to {MAX_HOLD_S:,.0f} seconds')
    field = tuple(match['field'].split('.'))
    return Condition(text.strip(), name, match['topic'], field, match['comparison'], threshold, hold_s)
