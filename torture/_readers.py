"""``python -m torture.fuzz --readers``: each reader of robots' data in a separate process, limited to two gigabytes.

A process that crashes, or does not end a round, is a finding like an exception; the next one continues with the next seed.
"""

from __future__ import annotations

import json
import logging
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from torture._command import progress
from torture._reader_rounds import KINDS, Shop, watch_writes

LIMIT_BYTES: Final = 2 << 30
HANG_S: Final = 60.0
"""A round takes some milliseconds; a reader that takes a minute hangs."""
MAX_TOLD: Final = 20
TRIES: Final = 20
"""Processes of one kind that may crash before the others have their turn."""


@dataclass(slots=True)
class Told:
    """The result of one kind of readers."""

    rounds: int = 0
    found: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    peak_bytes: int = 0
    """Peak memory of its largest process."""

    def as_dict(self) -> dict[str, Any]:
        return {
            'rounds': self.rounds,
            'found': dict(self.found.most_common()),
            'wrong': self.wrong,
            'peak_bytes': self.peak_bytes,
        }


def fuzz(kind: str, seed: int, seconds: float) -> Told:
    """Rounds of one kind until the time is over, or there are enough findings."""
    report, end = Told(), time.monotonic() + seconds
    for _ in range(TRIES):
        left = end - time.monotonic()
        if left <= 0 or len(report.wrong) >= MAX_TOLD:
            break
        with tempfile.TemporaryDirectory(prefix='readers-') as name:
            _watch(kind, seed + report.rounds, left, Path(name), report)
    return report


def _watch(kind: str, seed: int, seconds: float, folder: Path, report: Told) -> None:
    """One process; it reports each round."""
    command = [sys.executable, '-m', 'torture._readers', kind, str(seed), f'{seconds:.3f}', str(folder)]
    environ = {**os.environ, 'TMPDIR': str(folder / 'tmp'), 'PYTHONFAULTHANDLER': '1'}
    (folder / 'tmp').mkdir()
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=environ, text=True) as child,
    ):
        assert child.stdout is not None
        is_over = False
        for line in child.stdout:
            reported = json.loads(line)
            is_over = 'peak' in reported
            if is_over:
                report.peak_bytes = max(report.peak_bytes, reported['peak'])
            elif 'wrong' in reported:
                report.wrong.append(f'seed {reported["seed"]}: {reported["wrong"]}')
                progress(report.wrong[-1])
            else:
                report.rounds += 1
                report.found[reported['found']] += 1
            report.rounds += 'wrong' in reported
        code = child.wait()
        if not is_over:
            errors.seek(0)
            tail = errors.read()[-2000:].decode(errors='replace')
            report.wrong.append(f'seed {seed + report.rounds}: the process ended with {code}: {tail}')
            progress(report.wrong[-1])
            report.rounds += 1


def main(arguments: Sequence[str]) -> None:
    """The process of one kind."""
    kind, seed, seconds, folder = arguments[0], int(arguments[1]), float(arguments[2]), Path(arguments[3])
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    logging.disable(logging.CRITICAL)
    warnings.simplefilter('ignore')
    one = KINDS[kind](Shop(folder))
    watch_writes()
    end, wrong = time.monotonic() + seconds, 0
    while time.monotonic() < end and wrong < MAX_TOLD:
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + HANG_S), resource.RLIM_INFINITY))
        reported: dict[str, object] = {'seed': seed}
        try:
            reported['found'] = one(random.Random(seed))
        except Exception as error:  # noqa: BLE001 - whatever it is, it is what this looks for
            wrong += 1
            where = traceback.extract_tb(error.__traceback__)[-1]
            reported['wrong'] = f'{type(error).__name__}: {str(error)[:200]} ({where.filename}:{where.lineno})'
        print(json.dumps(reported), flush=True)
        seed += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    print(json.dumps({'peak': peak}), flush=True)


if __name__ == '__main__':
    main(sys.argv[1:])
