"""The clock of the intake."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.node.intake.intake import until_poll
from shadowhound_data_logger.ros.endpoints import POLL_S


@pytest.mark.parametrize('wall_s', [0.0, 1764003000.0, 1764003000.05, 1764003000.09, 1764003000.11, 1764003000.1999, 5.15])
def test_polls_are_halfway_between_multiples_of_their_period(wall_s: float) -> None:
    """Whenever a poll was, the next one is at the nearest such time that leaves a quarter of the period between them."""
    pause_s = until_poll(wall_s)
    assert POLL_S / 4 <= pause_s <= 1.25 * POLL_S
    assert (wall_s + pause_s) / POLL_S % 1 == pytest.approx(0.5, abs=1e-5)
