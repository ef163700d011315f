"""Damages complete spools at random, for minutes: startup never fails, uploads a damaged object or loses an intact file."""

from __future__ import annotations

import logging
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from spool import rotting

from torture._command import Check, parser, progress, verdict

MINUTES: Final = 10.0
SHORT_MINUTES: Final = 0.25
SHARED_MEMORY: Final = Path('/dev/shm')  # noqa: S108 - nothing here is about power cuts, and there a sync costs nothing


def campaign(folder: Path, seed: int, seconds: float) -> tuple[int, Counter[str], list[str]]:
    """Rounds, what recovery did in them, and what went wrong."""
    bodies = rotting.new_base(folder / 'base')
    found: Counter[str] = Counter()
    wrong: list[str] = []
    rounds, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        rotten = rotting.rot(folder / 'base', folder / 'rotten', random.Random(seed + rounds))
        try:
            found.update(rotting.check(rotten, bodies).keys())
        except Exception as error:  # noqa: BLE001 - whatever it is, it is what this looks for
            wrong.append(f'seed {seed + rounds}: {rotten.done}: {type(error).__name__}: {error}')
            progress(wrong[-1])
        shutil.rmtree(rotten.root)
        rounds += 1
    return rounds, found, wrong


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('rot', __doc__ or '')
    options.add_argument('--minutes', type=float, default=0.0, help=f'how long, {MINUTES:g} by default')
    given = options.parse_args(argv)
    logging.disable(logging.CRITICAL)
    minutes = given.minutes or (SHORT_MINUTES if given.short else MINUTES)
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None) as folder:
        rounds, found, wrong = campaign(Path(folder), given.seed, 60 * minutes)
    if not given.json:
        print(f'{rounds} damaged spools, seed {given.seed}; in so many of them:')
        for what, count in found.most_common():
            print(f'{count:8}  {what}')
    bar = Check('every damaged spool was started and used', not wrong, f'{len(wrong)} of {rounds} were not' if wrong else '')
    return verdict({'seed': given.seed, 'rounds': rounds, 'found': found, 'wrong': wrong}, [bar], as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
