"""Hostile messages through every encoder, damaged spools and indexes through recovery: no crash, no hang, no damage passes as
good.

With ``--readers``, all readers of robots' data instead (torture/_readers.py): only our own errors, nothing written elsewhere,
at most two gigabytes of memory.

Each round is reproducible from its seed: ``--seed`` is that of the first one.
"""

from __future__ import annotations

import argparse
import logging
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from formats.conftest import GO2_MESSAGES, Ros
from formats.hostile import Fuzzer
from spool import editing, rotting

from torture import _readers
from torture._command import Check, parser, progress, verdict
from torture.rot import SHARED_MEMORY

SECONDS: Final = 600.0
SHORT_SECONDS: Final = 20.0
HANG_S: Final = 30.0
"""A round takes 0.01 s."""
MAX_TOLD: Final = 20
Round = Callable[[int], Mapping[str, int]]


class Hang(BaseException):
    """A round that does not end; our supervised loops do not catch it."""


@dataclass(slots=True)
class Field:
    """The result of one kind of rounds."""

    rounds: int = 0
    found: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        return {'rounds': self.rounds, 'found': dict(self.found.most_common()), 'wrong': self.wrong}


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raises Hang in code that takes longer."""

    def on_alarm(*_: object) -> None:
        raise Hang(f'it did not end within {seconds:g} s')

    before = signal.signal(signal.SIGALRM, on_alarm)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def fuzz(one: Round, seed: int, seconds: float) -> Field:
    """Rounds with increasing seeds until the time is over."""
    result = Field()
    end = time.monotonic() + seconds
    while time.monotonic() < end and len(result.wrong) < MAX_TOLD:
        try:
            with at_most(HANG_S):
                result.found.update(one(seed + result.rounds))
        except (Exception, Hang) as error:  # noqa: BLE001 - whatever it is, it is what this looks for
            result.wrong.append(f'seed {seed + result.rounds}: {type(error).__name__}: {error}')
            progress(result.wrong[-1])
        result.rounds += 1
    return result


def messages(folder: Path) -> Round:
    """Hostile messages."""
    share = folder / 'prefix' / 'share' / 'go2_interfaces'
    share.mkdir(parents=True)
    (share / 'msg').symlink_to(GO2_MESSAGES, target_is_directory=True)
    fuzzer = Fuzzer(Ros(folder / 'prefix'))

    def one(seed: int) -> Mapping[str, int]:
        fuzzer.outcomes.clear()
        fuzzer.round(seed)
        return fuzzer.outcomes

    return one


def spools(folder: Path, *, edited: bool) -> Round:
    """Damage to the files of a spool; or, ``edited``, to the content of its index."""
    base = folder / ('edited' if edited else 'rotted')
    bodies = rotting.new_base(base)
    root = folder / 'damaged'

    def one(seed: int) -> Mapping[str, int]:
        rng = random.Random(seed)
        done: object = None
        try:
            if edited:
                done = editing.edit(base, root, rng)
                return editing.check(root, bodies)
            rotten = rotting.rot(base, root, rng)
            done = rotten.done
            return rotting.check(rotten, bodies)
        except Exception as error:
            raise AssertionError(f'{done}: {type(error).__name__}: {error}') from error
        finally:
            shutil.rmtree(root, ignore_errors=True)

    return one


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('fuzz', __doc__ or '')
    options.add_argument(
        '--seconds', type=float, default=0.0, help=f'how long, {SECONDS:g} by default, {SHORT_SECONDS:g} in short'
    )
    options.add_argument('--readers', action='store_true', help='what reads the data of robots, instead of what makes them')
    given = options.parse_args(argv)
    logging.disable(logging.CRITICAL)
    seconds = given.seconds or (SHORT_SECONDS if given.short else SECONDS)
    progress(f'seed {given.seed}')
    if given.readers:
        return _fuzz_readers(given, seconds)
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None) as name:
        folder = Path(name)
        kinds = {'messages': messages(folder), 'spools': spools(folder, edited=False), 'indexes': spools(folder, edited=True)}
        fields = {what: fuzz(one, given.seed, seconds / len(kinds)) for what, one in kinds.items()}
    if not given.json:
        for what, result in fields.items():
            print(f'{result.rounds} rounds of hostile {what}, seed {given.seed}; what became of them:')
            for outcome, count in result.found.most_common():
                print(f'{count:8}  {outcome}')
    bars = [_bar(what, result) for what, result in fields.items()]
    figures = {'seed': given.seed, 'seconds': seconds, **{what: result.as_dict() for what, result in fields.items()}}
    return verdict(figures, bars, as_json=given.json)


def _fuzz_readers(given: argparse.Namespace, seconds: float) -> int:
    report: dict[str, _readers.Told] = {}
    for kind in _readers.KINDS:
        report[kind] = _readers.fuzz(kind, given.seed, seconds / len(_readers.KINDS))
        progress(f'{kind}: {report[kind].rounds} rounds, {len(report[kind].wrong)} wrong')
    if not given.json:
        for kind, result in report.items():
            found = ', '.join(f'{count} {outcome}' for outcome, count in result.found.most_common(6))
            print(f'{result.rounds} rounds of {kind}, {result.peak_bytes / 1e6:.0f} MB at most: {found}')
            print(*(f'    {wrong}' for wrong in result.wrong), sep='\n', end='\n' if result.wrong else '')
    what = 'no error but ours, nothing written elsewhere, in 2 GB'
    bars = [Check(f'readers of {kind}: {what}', not result.wrong and result.rounds > 0,
                f'{len(result.wrong)} of {result.rounds} rounds' if result.wrong else '')
            for kind, result in report.items()]  # fmt: skip
    return verdict({'seed': given.seed, 'seconds': seconds, **{kind: each.as_dict() for kind, each in report.items()}}, bars,
                   as_json=given.json)  # fmt: skip


def _bar(what: str, result: Field) -> Check:
    found = f'{len(result.wrong)} of {result.rounds} rounds' if result.wrong else ''
    return Check(f'hostile {what}: no crash, no hang, nothing damaged passes as good', not result.wrong, found)


if __name__ == '__main__':
    sys.exit(main())
