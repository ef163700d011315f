"""A few rounds of each kind of ``python -m torture.fuzz --readers``: every reader answers, or says so in our words."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest
from hostile.rounds import KINDS, Shop

ROUNDS = 25


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.long('a campaign in short')
def test_rounds(tmp_path: Path, kind: str) -> None:
    """No other exception, whatever is in the file; and not everything is refused, or nothing."""
    one = KINDS[kind](Shop(tmp_path))
    found: Counter[str] = Counter()
    for seed in range(ROUNDS):
        try:
            found[one(random.Random(seed))] += 1
        except Exception as error:
            raise AssertionError(f'seed {seed}: {type(error).__name__}: {error}') from error
    assert len(found) > 1, found
