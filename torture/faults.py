"""Bad days between the logger and its store: everything must be delivered effectively exactly once, whatever happens.

Each day has a separate seed, which determines its objects, kills and faults: ``--seed`` is that of the first one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Final

from faults.campaign import live, simulated
from faults.kinds import given_seed
from faults.report import Summary
from shadowhound_tower.embedded import Tower

from torture._command import Check, parser, progress, verdict, workshop

LONG: Final = 1000, 50
SHORT: Final = 100, 5
"""Days in virtual time, days over real sockets."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 1 if anything was lost, duplicated or overwritten on some day."""
    options = parser('faults', 'Bad days between the logger and its store.')
    options.set_defaults(seed=given_seed())
    options.add_argument('--simulated', type=int, metavar='N', help=f'days in virtual time; {LONG[0]}, in short {SHORT[0]}')
    options.add_argument('--live', type=int, metavar='N', help=f'days over real sockets; {LONG[1]}, in short {SHORT[1]}')
    given = options.parse_args(arguments)
    default = SHORT if given.short else LONG
    days = default[0] if given.simulated is None else given.simulated
    live_days = default[1] if given.live is None else given.live
    progress(f'seed {given.seed}')
    began = time.monotonic()
    found = {'in virtual time': simulated(range(given.seed, given.seed + days), progress)}
    if live_days:
        with workshop(given) as shop, Tower(shop.folder) as tower:
            found['over real sockets'] = live(range(given.seed, given.seed + live_days), tower, progress)
            shop.passed = True  # the seed reproduces all its data
    if not given.json:
        for where, summary in found.items():
            print(f'{where}:', *summary.lines(), sep='\n  ')
    figures = {'seed': given.seed, 'took_s': round(time.monotonic() - began, 1)}
    return verdict({**figures, **{where: summary.as_dict() for where, summary in found.items()}},
                   [_bar(where, summary) for where, summary in found.items()], as_json=given.json)  # fmt: skip


def _bar(where: str, summary: Summary) -> Check:
    what = f'all objects of {summary.days} days {where} are delivered effectively exactly once'
    return Check(what, not summary.failures, ', '.join(f'not with seed {seed}' for seed in summary.failures))


if __name__ == '__main__':
    sys.exit(main())
