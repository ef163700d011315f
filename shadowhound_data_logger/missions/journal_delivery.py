"""One journal of a mission, the agent's or the node's, being sent: what it says so far, and a position for each receiver.

Each receiver has its own place, so that artifacts that cannot be stored hold up no metric. A place moves on after what lies
before it has arrived; whatever is sent again after a crash changes nothing. The places lie beside the journal (``sent.json``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, artifacts_of
from shadowhound_data_logger.missions.batch import MOST_POINTS
from shadowhound_data_logger.missions.folder import MissionFolder, Run
from shadowhound_data_logger.missions.objects import Item, objects_of
from shadowhound_data_logger.missions.story import Point, Story
from shadowhound_data_logger.missions.values import MAX_KEYS

TRIES: Final = 3
"""How often a server must refuse an artifact, and take others meanwhile, before it is skipped."""


@dataclass(slots=True)
class PointBatch:
    """What goes to the run in one request."""

    end: int
    points: list[Point] = field(default_factory=list)
    last: str = ''
    """``start`` or ``end`` where the batch ends with such a record."""
    is_all: bool = False
    """Whether nothing more is in the journal."""


@dataclass(slots=True)
class ObjectBatch:
    """What goes to the store in one commit; the place ``end`` moves on after that."""

    end: int
    items: list[Item] = field(default_factory=list)
    bytes: int = 0
    missing: int = 0
    """Frames and trajectories whose file is gone."""


@dataclass(frozen=True, slots=True)
class _Waiting:
    """An artifact that is to be sent."""

    start: int
    """The place of its record."""
    artifact: Artifact
    tries: int = 0
    taken: int = 0
    """How many others the server had taken when it failed first."""


class JournalDelivery:
    """Reads one journal of a mission, and sends what is new in it.

    Life: New; the rest in turns, each a bounded piece of work. Not thread-safe. Its methods raise OSError.
    """

    def __init__(self, mission: MissionFolder, folder: MissionFolder, read: Callable[[int], Iterator[journal.Line]],
                 leaves_out: Callable[[Point], bool] = lambda _: False) -> None:  # fmt: skip
        """``folder`` has the journal, its files and its places; ``read`` gives its lines from an offset on.

        ``leaves_out`` says which points are not sent, because somebody else tells the same.
        """
        self.story = Story()
        self.sent = folder.sent()
        self.told = 0
        """Up to here the story knows the journal."""
        self._mission = mission
        self._folder = folder
        self._read = read
        self._leaves_out = leaves_out
        self._batch: PointBatch | None = None
        self.attached = self.sent.artifacts
        """Up to here the artifacts of the journal were tried."""
        self._waiting: deque[_Waiting] = deque()
        self._taken = 0

    def recall(self) -> None:
        """After a restart: tell the story what was sent before."""
        if self.told < self.sent.metrics:
            for line in self.lines(self.told, self.sent.metrics):
                self.story.add(line.record)
                self.told = line.end

    def lines(self, offset: int, end: int | None = None) -> Iterator[journal.Line]:
        """The lines between two places, or to the end of the journal."""
        for line in self._read(offset):
            if end is not None and line.end > end:
                return
            yield line

    def points(self, may_end: Callable[[], bool] = lambda: True) -> PointBatch | None:
        """The next points, the same until they are sent; None where there are none. ``may_end`` holds back the last record."""
        if self._batch is None or self._batch.end <= self.sent.metrics:
            self._batch = self._next_points(may_end)
        return self._batch

    def attach(self, lines: Iterable[journal.Line], send: Callable[[Artifact], bool], refuse: Callable[[Exception], None],
               most: int) -> int:  # fmt: skip
        """Send the artifacts of the next lines (from ``attached`` on); returns how many there were.

        ``send`` says whether the server took it. One that fails is tried again after all others, so that it delays none; what the
        server refuses again (``data['of_object']`` of the error) after it took another one is passed to ``refuse`` and skipped.
        """
        done = 0
        try:
            for line in lines:
                found = deque(_Waiting(self.attached, each) for each in artifacts_of(line.record or {}, self._folder, self.story))
                self.attached = line.end
                done += self._send(found, send, refuse)
                if done >= most:
                    break
            else:
                done += self._send(self._waiting, send, refuse)
        finally:
            self.move(artifacts=min([self.attached, *(each.start for each in self._waiting)]))
        return done

    def objects(self, lines: Iterable[journal.Line], start: Mapping[str, Any], run: Run | None, most: int,
                most_bytes: int) -> ObjectBatch:  # fmt: skip
        """The objects of the next lines, of a mission that began so."""
        batch = ObjectBatch(self.sent.objects)
        for line in lines:
            record = line.record or {}
            found = list(objects_of(record, start, self._mission, run, self._folder.files))
            batch.items += found
            batch.missing += not found and record.get('k') in {'frame', 'trajectory'}
            batch.bytes += sum(len(item.content.body) for item in found)
            batch.end = line.end
            if len(batch.items) >= most or batch.bytes >= most_bytes:
                break
        return batch

    def is_closed(self) -> bool:
        """Whether nothing more can come: its writer is gone, or there never was one."""
        try:
            return not journal.is_locked(self._folder.journal)
        except FileNotFoundError:
            return True

    def whole(self) -> int:
        """Where its last whole line ends."""
        end = self.told
        for line in self.lines(self.told):
            end = line.end
        return end

    def move(self, **changes: Any) -> None:
        """Move places, or note what else became of it."""
        moved = replace(self.sent, **changes)
        if moved != self.sent:
            durable = not changes.keys().isdisjoint({'objects', 'held', 'complete'})  # after these, files go
            self._folder.set_sent(moved, durable=durable)
            self.sent = moved

    def _send(self, items: deque[_Waiting], send: Callable[[Artifact], bool], refuse: Callable[[Exception], None]) -> int:
        """Send them until one fails: that one waits, and those behind it."""
        done = 0
        while items:
            item = items.popleft()
            try:
                self._taken += send(item.artifact)
            except Exception as error:
                again = replace(item, tries=item.tries + 1, taken=item.taken if item.tries else self._taken)
                of_object = isinstance(error, TrackingUnavailable) and error.data.get('of_object')
                if of_object and again.tries >= TRIES and again.taken < self._taken:
                    refuse(error)
                else:
                    self._waiting.append(again)
                    if items is not self._waiting:
                        self._waiting.extend(items)
                    raise
            done += 1
        return done

    def _next_points(self, may_end: Callable[[], bool]) -> PointBatch | None:
        batch = PointBatch(self.told)
        for line in self.lines(self.told):
            kind = str((line.record or {}).get('k'))
            if kind == 'end' and not may_end():
                break
            batch.points += [point for point in self.story.add(line.record) if not self._leaves_out(point)]
            self.told = batch.end = line.end
            if kind in {'start', 'end'}:
                batch.last = kind
                break
            if len(batch.points) > MOST_POINTS - MAX_KEYS:
                break
        else:
            batch.is_all = True
        return batch if self.told > self.sent.metrics else None
