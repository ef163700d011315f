"""Sends one journal of a mission, the agent's or the node's, and keeps its state and a position for each receiver.

Each receiver has its own position, so that artifacts that cannot be stored do not delay metrics. A position advances when
everything before it has arrived; sending again after a crash is harmless. The positions are next to the journal (``sent.json``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, artifacts_of
from shadowhound_data_logger.missions.folder import MissionFolder, Run
from shadowhound_data_logger.missions.objects import MissionObject, objects_of
from shadowhound_data_logger.missions.state import MissionState, Point
from shadowhound_data_logger.missions.tracking import MAX_POINTS
from shadowhound_data_logger.missions.values import MAX_KEYS

TRIES: Final = 3
"""An artifact is skipped after the server has refused it this often while it accepted others."""


@dataclass(slots=True)
class PointBatch:
    """The points sent to the run in one request."""

    end: int
    points: list[Point] = field(default_factory=list)
    last: str = ''
    """``start`` or ``end`` if the batch ends with such a record."""
    is_all: bool = False
    """Whether the batch reaches the end of the journal."""


@dataclass(slots=True)
class ObjectBatch:
    """The objects spooled in one commit, after which the position moves to ``end``."""

    end: int
    items: list[MissionObject] = field(default_factory=list)
    bytes: int = 0
    missing: int = 0
    """Frames and trajectories whose file was deleted."""


@dataclass(frozen=True, slots=True)
class _Pending:
    """An artifact that must be sent."""

    start: int
    """The position of its record."""
    artifact: Artifact
    tries: int = 0
    accepted_before: int = 0
    """How many other artifacts the server had accepted when this one first failed."""


class JournalDelivery:
    """Reads one journal of a mission and sends its new records.

    Lifecycle: New; the other methods in turns, each a bounded piece of work. Not thread-safe. They raise OSError.
    """

    def __init__(self, mission: MissionFolder, folder: MissionFolder, read: Callable[[int], Iterator[journal.Line]],
                 is_skipped: Callable[[Point], bool] = lambda _: False) -> None:  # fmt: skip
        """``folder`` has the journal, its files and positions; ``read`` returns the lines from an offset.

        Points for which ``is_skipped`` returns True are not sent, because the other journal has this metric.
        """
        self.state = MissionState()
        self.sent = folder.sent()
        self.read_to = 0
        """The state has the records up to here."""
        self._mission = mission
        self._folder = folder
        self._read = read
        self._is_skipped = is_skipped
        self._batch: PointBatch | None = None
        self.attached = self.sent.artifacts
        """The artifacts up to here were tried."""
        self._pending: deque[_Pending] = deque()
        self._accepted = 0

    def catch_up(self) -> None:
        """After a restart, restore the state by reading the records that were sent before."""
        if self.read_to < self.sent.metrics:
            for line in self.lines(self.read_to, self.sent.metrics):
                self.state.add(line.record)
                self.read_to = line.end

    def lines(self, offset: int, end: int | None = None) -> Iterator[journal.Line]:
        """The lines between two positions, by default up to the end of the journal."""
        for line in self._read(offset):
            if end is not None and line.end > end:
                return
            yield line

    def points(self, may_end: Callable[[], bool] = lambda: True) -> PointBatch | None:
        """The next points, the same ones until they are sent; None if there are none. The end waits for ``may_end``."""
        if self._batch is None or self._batch.end <= self.sent.metrics:
            self._batch = self._next_points(may_end)
        return self._batch

    def attach(self, lines: Iterable[journal.Line], send: Callable[[Artifact], bool], refuse: Callable[[Exception], None],
               limit: int) -> int:  # fmt: skip
        """Send the artifacts of the next lines (from ``attached``); returns how many there were.

        ``send`` returns whether the server accepted the artifact. An artifact that fails is retried after all others, so that it
        delays none of them. If the server refuses it repeatedly (``data['of_object']`` of the error) and accepts others, it is
        passed to ``refuse`` and skipped.
        """
        done = 0
        try:
            for line in lines:
                found = deque(_Pending(self.attached, each) for each in artifacts_of(line.record or {}, self._folder, self.state))
                self.attached = line.end
                done += self._send(found, send, refuse)
                if done >= limit:
                    break
            else:
                done += self._send(self._pending, send, refuse)
        finally:
            self.move(artifacts=min([self.attached, *(each.start for each in self._pending)]))
        return done

    def objects(self, lines: Iterable[journal.Line], start: Mapping[str, Any], run: Run | None, limit: int,
                limit_bytes: int) -> ObjectBatch:  # fmt: skip
        """The objects of the next lines; ``start`` is the first record of the mission."""
        batch = ObjectBatch(self.sent.objects)
        for line in lines:
            record = line.record or {}
            found = list(objects_of(record, start, self._mission, run, self._folder.files))
            batch.items += found
            batch.missing += not found and record.get('k') in {'frame', 'trajectory'}
            batch.bytes += sum(len(item.content.body) for item in found)
            batch.end = line.end
            if len(batch.items) >= limit or batch.bytes >= limit_bytes:
                break
        return batch

    def is_closed(self) -> bool:
        """Whether nothing more will be written: the writer has exited, or never existed."""
        try:
            return not journal.is_locked(self._folder.journal)
        except FileNotFoundError:
            return True

    def complete_bytes(self) -> int:
        """The end of the last complete line."""
        end = self.read_to
        for line in self.lines(self.read_to):
            end = line.end
        return end

    def move(self, **changes: Any) -> None:
        """Change positions and other fields of ``sent``."""
        moved = replace(self.sent, **changes)
        if moved != self.sent:
            durable = not changes.keys().isdisjoint({'objects', 'held', 'complete'})  # files are deleted afterwards
            self._folder.set_sent(moved, durable=durable)
            self.sent = moved

    def _send(self, items: deque[_Pending], send: Callable[[Artifact], bool], refuse: Callable[[Exception], None]) -> int:
        """Send artifacts until one fails; that one and those after it stay pending."""
        done = 0
        while items:
            item = items.popleft()
            try:
                self._accepted += send(item.artifact)
            except Exception as error:
                accepted_before = item.accepted_before if item.tries else self._accepted
                retry = replace(item, tries=item.tries + 1, accepted_before=accepted_before)
                of_object = isinstance(error, TrackingUnavailable) and error.data.get('of_object')
                if of_object and retry.tries >= TRIES and accepted_before < self._accepted:
                    refuse(error)
                else:
                    self._pending.append(retry)
                    if items is not self._pending:
                        self._pending.extend(items)
                    raise
            done += 1
        return done

    def _next_points(self, may_end: Callable[[], bool]) -> PointBatch | None:
        batch = PointBatch(self.read_to)
        for line in self.lines(self.read_to):
            kind = str((line.record or {}).get('k'))
            if kind == 'end' and not may_end():
                break
            batch.points += [point for point in self.state.add(line.record) if not self._is_skipped(point)]
            self.read_to = batch.end = line.end
            if kind in {'start', 'end'}:
                batch.last = kind
                break
            if len(batch.points) > MAX_POINTS - MAX_KEYS:
                break
        else:
            batch.is_all = True
        return batch if self.read_to > self.sent.metrics else None
