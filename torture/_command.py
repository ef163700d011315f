"""What the campaigns' command lines share: their options, how a verdict is told, and the exit code."""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Bar:
    """One thing that must hold, and what was found."""

    what: str
    holds: bool
    found: str = ''


def some(lines: Sequence[str]) -> str:
    """How many, and the first of them; nothing where there are none."""
    return f'{len(lines)}: ' + '; '.join(lines[:30]) if lines else ''


@dataclass(slots=True)
class Workshop:
    """Where a campaign works."""

    folder: Path
    passed: bool = False


def parser(module: str, description: str) -> argparse.ArgumentParser:
    """With the options that every campaign has; ``seed`` is a new one each time unless it is given."""
    made = argparse.ArgumentParser(prog=f'python -m torture.{module}', description=description)
    made.add_argument('--seed', type=int, default=random.SystemRandom().randrange(1 << 31), help='of all that is random')
    made.add_argument('--short', action='store_true', help='the same in little, for every day')
    made.add_argument('--json', action='store_true', help='print the figures as one line of JSON')
    made.add_argument('--folder', type=Path, help='where to leave data and logs; else they go, unless something was found')
    return made


def asked_kills(options: argparse.ArgumentParser, argv: Sequence[str] | None, *, usual: int, short: int) -> argparse.Namespace:
    """What the command line of a campaign of kills asks for, told to whoever watches."""
    options.add_argument('--kills', type=int, default=0, help=f'how many, {usual} unless told')
    given = options.parse_args(argv)
    given.kills = given.kills or (short if given.short else usual)
    progress(f'{given.kills} kills, seed {given.seed}')
    return given


@contextmanager
def workshop(given: argparse.Namespace) -> Iterator[Workshop]:
    """A folder for data and logs, which goes when ``passed`` was set and no other place was asked for."""
    shop = Workshop(given.folder or Path(tempfile.mkdtemp(prefix='torture-')))
    shop.folder.mkdir(parents=True, exist_ok=True)
    try:
        yield shop
    finally:
        if given.folder is None and shop.passed:
            shutil.rmtree(shop.folder)
        else:
            progress(f'data and logs are in {shop.folder}')


def progress(text: str) -> None:
    """A line for whoever watches."""
    print(text, file=sys.stderr, flush=True)


def verdict(figures: Mapping[str, Any], bars: Sequence[Bar], *, as_json: bool) -> int:
    """Print bars (and with JSON the figures); the exit code: 0 when every bar holds, else 1."""
    passed = all(bar.holds for bar in bars)
    if as_json:
        said = [{'what': bar.what, 'holds': bar.holds, 'found': bar.found} for bar in bars]
        print(json.dumps({**figures, 'bars': said, 'passed': passed}))
    else:
        for bar in bars:
            print(f'{"ok  " if bar.holds else "FAIL"}  {bar.what}{": " if bar.found else ""}{bar.found}')
        print('passed' if passed else 'FAILED')
    return 0 if passed else 1
