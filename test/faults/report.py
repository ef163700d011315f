"""The contents of bad days and their outcomes, for one day and for many."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from faults.kinds import Condition, Fault


@dataclass(slots=True)
class Report:
    """One day."""

    seed: int
    condition: Condition
    objects: int = 0
    foreign: int = 0
    """Objects with a key that a foreign object already had."""
    kills: int = 0
    """Kills of the process during the day."""
    requests: int = 0
    repeated: int = 0
    """Puts that wrote the same content again, on a server that does not support or honor If-None-Match."""
    put_back: int = 0
    """Objects that were denied twice while others were accepted, and that the operator moved back from quarantine."""
    lasted_s: float = 0.0
    faults: Counter[Fault] = field(default_factory=Counter)


@dataclass(slots=True)
class Summary:
    """Many days: totals, and failures by seed."""

    days: int = 0
    totals: Counter[str] = field(default_factory=Counter)
    conditions: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    lasted_s: float = 0.0

    def add(self, report: Report) -> None:
        self.days += 1
        self.conditions[report.condition.value] += 1
        for name in ('objects', 'foreign', 'kills', 'requests', 'repeated', 'put_back'):
            self.totals[name] += getattr(report, name)
        self.faults.update({fault.value: count for fault, count in report.faults.items() if fault is not Fault.NONE})
        self.lasted_s += report.lasted_s

    def as_dict(self) -> dict[str, Any]:
        """As data for JSON."""
        return {
            'days': self.days, **self.totals, 'lasted_s': round(self.lasted_s, 1), 'servers': dict(self.conditions),
            'faults': {fault.value: self.faults[fault.value] for fault in Fault if fault is not Fault.NONE},
            'failures': {str(seed): text for seed, text in self.failures.items()},
        }  # fmt: skip

    def lines(self) -> Iterable[str]:
        """As text."""
        totals = self.totals
        yield (f'{self.days} days, {totals["objects"]} objects, {totals["requests"]} requests, {self.faults.total()} of them '
               f'with a fault, {totals["kills"]} kills in between, {self.lasted_s:.0f} s')  # fmt: skip
        yield 'faults: ' + ', '.join(f'{name} {count}' for name, count in self.as_dict()['faults'].items())
        yield 'If-None-Match: ' + ', '.join(f'{name} on {count} days' for name, count in sorted(self.conditions.items()))
        yield (f'{totals["objects"] - totals["foreign"]} delivered once to effect, {totals["foreign"]} in quarantine because '
               f'their key was taken; {totals["put_back"]} denied twice and moved back by hand, {totals["repeated"]} written '
               'again with the same content')  # fmt: skip
        for seed, text in self.failures.items():
            yield f'FAILED with seed {seed}: {text}'
