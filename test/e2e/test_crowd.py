"""A neighbor with more topics than any robot has: the node's memory stays within bounds, and its accounts hold."""

from __future__ import annotations

import pytest
from e2e.processes import Processes

from torture import crowd

TOPICS = 400
PUBLISHERS = 50
BAR_BYTES = 45 << 20
"""Twice of what it takes; without bounds it was 80 MB, and more with each topic."""


@pytest.mark.long('twenty seconds of a crowd')
def test_a_crowd_of_topics_takes_little_memory(processes: Processes) -> None:
    """All are to be recorded and kept for events: so many are as there is room for, and nothing fails."""
    found = crowd.attack(processes, TOPICS, PUBLISHERS, wait_s=0.0)
    assert found['topics'] >= 200
    assert found['peak'] - found['before'] < BAR_BYTES
    assert (found['imbalances'], found['failures']) == ([], 0)
