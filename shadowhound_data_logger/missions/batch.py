"""What goes to MLflow's run in one request: the next records of a journal, and how what a server refuses is found in them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from shadowhound_data_logger.errors import TrackingRefused
from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.story import Point, Story
from shadowhound_data_logger.missions.tracking import RUN_GONE, Tracking
from shadowhound_data_logger.missions.values import MAX_KEYS, MAX_TAG

log = logging.getLogger(__name__)

MOST_POINTS: Final = 1000
"""MLflow's limit of a batch."""
Part = tuple[Sequence[Point], Mapping[str, str], Mapping[str, str]]


@dataclass(slots=True)
class PointBatch:
    """What goes to the run in one request."""

    end: int
    points: list[Point] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    is_last: bool = False
    is_all: bool = False
    """Whether nothing more is in the journal."""


class Batches:
    """The agent's journal, told to its story once, in batches. Not thread-safe."""

    def __init__(self, folder: MissionFolder, story: Story) -> None:
        self.told = 0
        """Up to here the story knows the journal."""
        self._folder = folder
        self._story = story
        self._batch: PointBatch | None = None

    def recall(self, sent: int) -> None:
        """After a restart: tell the story what was sent before. Raises OSError."""
        if self.told < sent:
            for line in self._folder.lines(self.told):
                self._story.add(line.record)
                self.told = line.end
                if self.told >= sent:
                    break

    def next(self, sent: int, is_node_over: Callable[[], bool]) -> PointBatch | None:
        """The next records, the same until ``sent`` is beyond them; the end waits for that of the node. Raises OSError."""
        if self._batch is None or self._batch.end <= sent:
            self._batch = self._made(sent, is_node_over)
        return self._batch

    def _made(self, sent: int, is_node_over: Callable[[], bool]) -> PointBatch | None:
        batch, story = PointBatch(self.told), self._story
        for line in self._folder.lines(self.told):
            kind = (line.record or {}).get('k')
            if kind == 'end' and not is_node_over():
                break
            batch.points += story.add(line.record)
            self.told = batch.end = line.end
            if kind == 'start':
                batch.params |= story.params()
                break
            if kind == 'end':
                batch.params |= story.final_params()
                batch.tags |= _last_words(story)
                batch.is_last = True
                break
            if len(batch.points) > MOST_POINTS - MAX_KEYS:
                break
        else:
            batch.is_all = True
        return batch if self.told > sent else None


def send(tracking: Tracking, run_id: str, part: Part, refused: Callable[[Exception], None]) -> None:
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


def _parts(points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> list[Part]:
    """What a batch that was refused is sent as; none for a single thing."""
    if len(points) + len(params) + len(tags) <= 1:
        return []
    half = len(points) // 2
    halves: list[Part] = [(points[:half], {}, {}), (points[half:], {}, {})]
    singles: list[Part] = [([], {name: value}, {}) for name, value in params.items()]
    return [*halves, *singles, *(([], {}, {name: value}) for name, value in tags.items())]


def _last_words(story: Story) -> dict[str, str]:
    error: Any = story.end.get('error')
    return {'shadowhound.error': str(error)[:MAX_TAG]} if error else {}
