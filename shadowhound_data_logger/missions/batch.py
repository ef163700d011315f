"""What one request to MLflow's run contains, and how the value that a server refuses is found in it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from shadowhound_data_logger.core.errors import TrackingRefused
from shadowhound_data_logger.missions.story import Point
from shadowhound_data_logger.missions.tracking import RUN_GONE, Tracking

log = logging.getLogger(__name__)

MOST_POINTS: Final = 1000
"""MLflow's limit of a batch."""
_Share = tuple[Sequence[Point], Mapping[str, str], Mapping[str, str]]


def send(tracking: Tracking, run_id: str, part: _Share, refused: Callable[[Exception], None]) -> None:
    """Send; what the server refuses is found by halving, told to ``refused`` and left out. Raises TrackingError."""
    points, params, tags = part
    if not (points or params or tags):
        return
    try:
        tracking.log(run_id, points, params, tags)
    except TrackingRefused as error:
        if error.data.get('code') == RUN_GONE:
            raise
        parts = _parts(points, params, tags)
        for each in parts:
            send(tracking, run_id, each, refused)
        if not parts:
            refused(error)


def _parts(points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> list[_Share]:
    """What a batch that was refused is sent as; none for a single thing."""
    if len(points) + len(params) + len(tags) <= 1:
        return []
    half = len(points) // 2
    halves: list[_Share] = [(points[:half], {}, {}), (points[half:], {}, {})]
    singles: list[_Share] = [([], {name: value}, {}) for name, value in params.items()]
    return [*halves, *singles, *(([], {}, {name: value}) for name, value in tags.items())]
