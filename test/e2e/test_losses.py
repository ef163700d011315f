"""Losses made on purpose, of publishers on Fast DDS and on Cyclone DDS: the ledger says what was sent."""

from __future__ import annotations

import random
from importlib.util import find_spec
from pathlib import Path

import pytest

from torture import losses

pytestmark = pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')  # imported by children


@pytest.mark.slow
@pytest.mark.long('a minute of losses')
def test_the_ledger_says_what_was_lost(tmp_path: Path) -> None:
    """The node stopped, starved, killed and away, a publisher killed and replaced: each figure is that of the numbers sent."""
    found = losses.campaign(tmp_path / 'losses', 1, random.Random(1), losses.SHORT_LEARN_S)
    assert [bar for bar in found.bars() if not bar.holds] == []
    assert found.done == {'stopped': 1, 'starved': 1, 'killed': 1, 'replaced': 1, 'departed': 1}
