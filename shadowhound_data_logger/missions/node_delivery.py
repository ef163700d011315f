"""What the node logged of a mission, on its way to the run that the agent's journal made: with places of its own.

What the agent logs itself wins: points of a metric that it has logged are not sent for the node. Frames of both are kept: those
of the node have numbers of their own (node_log.FIRST_FRAME).
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.disk import replacing
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, artifacts_of
from shadowhound_data_logger.missions.folder import MissionFolder, Run
from shadowhound_data_logger.missions.objects import Item, objects_of
from shadowhound_data_logger.missions.story import FRAMES, Point, Story
from shadowhound_data_logger.missions.values import MAX_KEYS

NODE_S: Final = 30.0
"""How long the end of a mission waits for a node that does not let go of its journal: it takes a second, unless it hangs."""
Send = Callable[[Run, Sequence[Point], Mapping[str, str], Mapping[str, str]], None]


class NodeDelivery:
    """Life: New; ``track``, ``attach`` and ``shelve`` in turns, each a bounded piece of work that says whether there was any.

    ``story`` is what the node measured, as far as it is sent; ``agent`` is the agent's.
    """

    def __init__(self, mission: MissionFolder, agent: Story, most_points: int,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self.story = Story()
        self.sent = mission.node.sent()
        self._mission = mission
        self._folder = mission.node
        self._agent = agent
        self._most_points = most_points
        self._monotonic = monotonic
        self._told = 0
        self._batch: list[Point] | None = None
        self._asked_s: float | None = None

    def recall(self) -> None:
        """After a restart: tell the story what was sent before."""
        if self._told < self.sent.metrics:
            for line in self._lines(self._told, self.sent.metrics):
                self.story.add(line.record)
                self._told = line.end

    def track(self, run: Run | None, send: Send) -> bool:
        """Send the next points."""
        if run is None:
            return False
        if self._batch is None:
            self._batch = []
            for line in self._lines(self._told):
                points = self.story.add(line.record)
                self._told = line.end
                self._batch += [point for point in points if not self._is_agents(point.key)]
                if len(self._batch) > self._most_points - MAX_KEYS:
                    break
        if self._told > self.sent.metrics:
            send(run, self._batch, {}, {})
            self._move(metrics=self._told)
            self._batch = None
            return True
        self._batch = None
        return False

    def attach(self, run: Run, send: Callable[[Run, Artifact], None], most: int) -> bool:
        """Send the next frames to the run."""
        end, done = self.sent.artifacts, 0
        for line in self._lines(end, self.sent.metrics):
            for artifact in artifacts_of(line.record or {}, self._folder, self.story):
                send(run, artifact)
                done += 1
            end = line.end
            if done >= most:
                break
        return self._moved(artifacts=end)

    def shelve(self, run: Run | None, most: int) -> tuple[list[Item], int]:
        """The next frames for the store, and the place after them; ``shelved`` says that they are there."""
        items: list[Item] = []
        end = self.sent.objects
        for line in self._lines(end, self.sent.metrics if run else 0):
            found = objects_of(line.record or {}, self._agent.start, self._folder, run)
            items += [_of(item, self._mission) for item in found]
            end = line.end
            if len(items) >= most:
                break
        return items, end

    def shelved(self, end: int) -> bool:
        return self._moved(objects=end)

    def is_sent(self) -> bool:
        """Whether all that it logged has arrived, and nothing more can come."""
        return self._is_closed() and self.sent.metrics == self.sent.artifacts == self.sent.objects == self._whole()

    def is_over(self) -> bool:
        """Whether the run has all points, or the node has taken too long to let go: the mission may end."""
        if self._is_closed():
            return self.sent.metrics == self._whole()
        self._asked_s = self._monotonic() if self._asked_s is None else self._asked_s
        return self._monotonic() - self._asked_s > NODE_S

    def write_trajectory(self) -> None:
        """Once: trajectory.csv of all poses, in seconds since 1970, metres and radians. Raises OSError."""
        if not self.story.counts['poses'] or self._mission.trajectory.exists():
            return
        with replacing(self._mission.trajectory) as binary, io.TextIOWrapper(binary, 'ascii', newline='') as file:
            rows = csv.writer(file, lineterminator='\n')
            rows.writerow(('timestamp', 'x', 'y', 'yaw', 'z'))
            for line in self._lines(0):
                if line.record and line.record.get('k') == 'poses':
                    rows.writerows((f'{ns // SECOND}.{ns % SECOND:09d}', *pose) for ns, *pose in line.record['p'])

    # -- within ----------------------------------------------------------------------------------------------------

    def _is_agents(self, key: str) -> bool:
        """Whether the agent logs this metric itself."""
        return key in self._agent.first or (key == FRAMES and bool(self._agent.counts['frame']))

    def _lines(self, offset: int, end: int | None = None) -> Iterator[journal.Line]:
        for line in self._mission.node_lines(offset):
            if end is not None and line.end > end:
                return
            yield line

    def _is_closed(self) -> bool:
        try:
            return not journal.is_locked(self._folder.journal)
        except FileNotFoundError:
            return True

    def _whole(self) -> int:
        """Where the last whole line of the journal ends."""
        end = self._told
        for line in self._lines(self._told):
            end = line.end
        return end

    def _moved(self, **offset: int) -> bool:
        if all(getattr(self.sent, name) == value for name, value in offset.items()):
            return False
        self._move(**offset)
        return True

    def _move(self, **changes: Any) -> None:
        self.sent = replace(self.sent, **changes)
        self._folder.set_sent(self.sent)


def _of(item: Item, mission: MissionFolder) -> Item:
    """An object with the mission's own id."""
    metadata = {**item.content.metadata, words.MISSION_ID: mission.mission_id}
    return Item(replace(item.content, metadata=metadata), item.path, item.is_done_with)
