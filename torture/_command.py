"""Shared by the campaigns' command lines: options, verdict and exit code."""

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
class Check:
    """One requirement, and what was found."""

    what: str
    holds: bool
    found: str = ''


def some(lines: Sequence[str]) -> str:
    """The number of lines, and the first of them; empty if there are none."""
    return f'{len(lines)}: ' + '; '.join(lines[:30]) if lines else ''


@dataclass(slots=True)
class Workshop:
    """The folder of a campaign."""

    folder: Path
    passed: bool = False


def parser(module: str, description: str) -> argparse.ArgumentParser:
    """With the options of every campaign; ``seed`` is random unless given."""
    made = argparse.ArgumentParser(prog=f'python -m torture.{module}', description=description)
    made.add_argument('--seed', type=int, default=random.SystemRandom().randrange(1 << 31), help='of all that is random')
    made.add_argument('--short', action='store_true', help='a short version, for every day')
    made.add_argument('--json', action='store_true', help='print the figures as one line of JSON')
    made.add_argument(
        '--folder', type=Path, help='where to keep data and logs; otherwise they are deleted, unless a problem was found'
    )
    return made


def parse_kills(options: argparse.ArgumentParser, argv: Sequence[str] | None, *, usual: int, short: int) -> argparse.Namespace:
    """Parse the command line of a campaign of kills, and print it."""
    options.add_argument('--kills', type=int, default=0, help=f'how many (default {usual})')
    given = options.parse_args(argv)
    given.kills = given.kills or (short if given.short else usual)
    progress(f'{given.kills} kills, seed {given.seed}')
    return given


@contextmanager
def workshop(given: argparse.Namespace) -> Iterator[Workshop]:
    """A folder for data and logs, deleted if ``passed`` was set and no folder was given."""
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
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


def verdict(figures: Mapping[str, Any], bars: Sequence[Check], *, as_json: bool) -> int:
    """Print bars (and with JSON the results); returns the exit code: 0 if every bar is met, otherwise 1."""
    passed = all(bar.holds for bar in bars)
    if as_json:
        reported = [{'what': bar.what, 'holds': bar.holds, 'found': bar.found} for bar in bars]
        print(json.dumps({**figures, 'bars': reported, 'passed': passed}))
    else:
        for bar in bars:
            print(f'{"ok  " if bar.holds else "FAIL"}  {bar.what}{": " if bar.found else ""}{bar.found}')
        print('passed' if passed else 'FAILED')
    return 0 if passed else 1
