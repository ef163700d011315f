"""The output of every benchmark: results, and bars to compare them with."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).resolve().parents[1] / '.cache' / 'bench'
"""Folder of spools and servers, unless another one is given: on the disk of this checkout."""
LEROBOT: Final = Path(os.environ.get('SHADOWHOUND_LEROBOT', '~/.cache/shadowhound/lerobot/bin/python')).expanduser()
"""The interpreter of its separate environment (docs/development.md), which may be missing."""


@dataclass(frozen=True, slots=True)
class Bar:
    """A requirement. ``rounds`` are the single measurements behind ``value``, for their spread."""

    what: str
    bar: str
    """As text, such as ``at most 0.25``."""
    value: float | None
    unit: str
    holds: bool
    rounds: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Report:
    """The results of a benchmark: plain JSON except for the bars."""

    bars: tuple[Bar, ...]
    figures: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> str:
        return json.dumps({'bars': [asdict(bar) for bar in self.bars], 'figures': self.figures})


Measure = Callable[[argparse.Namespace], Report]
More = Callable[[argparse.ArgumentParser], None]
"""Adds the arguments of a benchmark."""


def main(document: str, measure: Measure, *, seconds: float, more: More = lambda _: None) -> None:
    """The command line of a benchmark: ``seconds`` is its default duration."""
    parser = argparse.ArgumentParser(description=document.partition('\n')[0])
    parser.add_argument('--seconds', type=float, default=seconds, metavar='S', help=f'how long to measure (default {seconds:g})')
    parser.add_argument('--folder', type=Path, default=FOLDER, help='where the spool lies meanwhile (default .cache/bench)')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    more(parser)
    options = parser.parse_args()
    report = measure(options)
    if options.json:
        print(report.as_json())
        return
    for bar in report.bars:
        print(f'{"ok    " if bar.holds else "MISSED"} {bar.what}: {show(bar.value)} {bar.unit} ({bar.bar}) {spread(bar.rounds)}')
    print(json.dumps(report.figures, indent=1, default=str))


def progress(text: str) -> None:
    """One line on standard error about the progress."""
    print(f'  {time.strftime("%H:%M:%S")} {text}', file=sys.stderr, flush=True)


def show(value: float | None) -> str:
    """A number with three significant digits."""
    if value is None:
        return 'unknown'
    if value == 0:
        return '0'
    return f'{value:,.0f}' if abs(value) >= 100 else f'{value:.3g}'


def spread(rounds: Sequence[float]) -> str:
    """Minimum and maximum of the rounds."""
    return f'{show(min(rounds))} to {show(max(rounds))}, {len(rounds)} rounds' if len(rounds) > 1 else ''


def ratio(ours: Sequence[float], theirs: Sequence[float]) -> tuple[float, tuple[float, ...]]:
    """Of the sums, and of each round."""
    if not sum(theirs):
        return float('inf'), ()
    return sum(ours) / sum(theirs), tuple(our / their if their else float('inf') for our, their in zip(ours, theirs, strict=True))


def percentile(values: Sequence[float], percent: float) -> float:
    """The value that this percentage does not exceed (nearest rank)."""
    ordered = sorted(values)
    return ordered[max(0, min(len(ordered) - 1, -(-round(percent * len(ordered)) // 100) - 1))]


def slope(times: Sequence[float], values: Sequence[float]) -> float:
    """Slope of the linear regression through the points."""
    return statistics.linear_regression(times, values).slope
