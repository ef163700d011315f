"""Random bad days: everything is delivered once to effect, nothing is overwritten, the ledger closes.

``SHADOWHOUND_SEED`` names the first seed. ``SHADOWHOUND_TEST_LONG=1`` runs as many days in virtual time as the campaign
(``python -m torture.faults``), and a few over real sockets, of which the campaign runs more.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from faults.campaign import live, simulated
from faults.kinds import given_seed, is_long
from faults.report import Summary
from faults.simulated_day import Day
from shadowhound_tower.embedded import Tower

SIMULATED = 1000 if is_long() else 10
LIVE = 5


def check(summary: Summary, first: int, days: int) -> None:
    """Every day went well; else the seeds and the figures are shown."""
    assert summary.days == days, '\n'.join((f'seeds {first} to {first + days - 1}', *summary.lines()))


@pytest.mark.timeout(1800)
def test_simulated_days() -> None:
    """With the clock, the pauses and the network simulated, and all else real."""
    first = given_seed()
    check(simulated(range(first, first + SIMULATED)), first, SIMULATED)


@pytest.mark.long('days over real sockets')
@pytest.mark.seaweedfs
@pytest.mark.timeout(1800)
def test_live_days(seaweed: Tower) -> None:
    """Over real sockets to a real server."""
    first = given_seed()
    check(live(range(first, first + LIVE), seaweed), first, LIVE)


def test_a_simulated_day_is_the_same_each_time(tmp_path: Path) -> None:
    """To the last request, so that a seed is a bug report."""
    first, second = (Day(7, tmp_path / name).run() for name in ('first', 'second'))
    assert first == second
    assert first.requests
