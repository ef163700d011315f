from __future__ import annotations

import random

from shadowhound_data_logger.core.retry import BASE_S, backoff


def test_backoff_doubles_up_to_its_cap_with_full_jitter() -> None:
    """The pause is between 0 and twice the last bound, never above the cap, and no attempt number overflows."""
    rng = random.Random(1)
    for attempt, bound in ((1, BASE_S), (2, 2 * BASE_S), (5, 16 * BASE_S), (9, 60.0), (10_000, 60.0)):
        pauses = [backoff(attempt, 60.0, rng) for _ in range(2000)]
        assert 0.0 <= min(pauses) < 0.01 * bound
        assert 0.99 * bound < max(pauses) <= bound
