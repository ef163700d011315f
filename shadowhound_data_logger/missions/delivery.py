"""What one mission still owes to its receivers: MLflow's run, its artifacts, and the objects of the store.

Each receiver has its own place in the journal, so that artifacts that cannot be stored hold up no metric. A place moves
on after what lies before it has arrived; whatever is sent again after a crash changes nothing.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from shadowhound_data_logger.errors import TrackingRefused
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, artifacts_of, prepared
from shadowhound_data_logger.missions.batch import MOST_POINTS, Batches, send
from shadowhound_data_logger.missions.drawing import Pictures, nothing
from shadowhound_data_logger.missions.folder import MissionFolder, Run, stamped, write_json
from shadowhound_data_logger.missions.node_delivery import NodeDelivery
from shadowhound_data_logger.missions.objects import Item, Shelf, objects_of
from shadowhound_data_logger.missions.story import KILLED, Point, Story, summary_of
from shadowhound_data_logger.missions.tracking import Tracking

log = logging.getLogger(__name__)

ARTIFACTS_A_STEP: Final = 4
OBJECTS_A_STEP: Final = 64
BYTES_A_STEP: Final = 8 << 20


class Delivery:
    """Life: New; ``track``, ``attach`` and ``shelve`` in turns, until ``sent.complete``. Not thread-safe.

    The three do a bounded piece of work and say whether there was any. They raise TrackingError, SpoolError or OSError.
    """

    def __init__(self, folder: MissionFolder, tracking: Tracking, shelf: Shelf, pictures: Pictures = nothing) -> None:
        self.folder = folder
        self.sent = folder.sent()
        self.run: Run | None = folder.run()
        self.story = Story()
        self.node = NodeDelivery(folder, self.story, MOST_POINTS)
        self.story.node = self.node.story
        self._tracking = tracking
        self._shelf = shelf
        self._pictures = pictures
        self._batches = Batches(folder, self.story)

    def track(self) -> bool:
        """Send the next batch of metrics; make the run first, end it after the last."""
        self._recall()
        if self.sent.ended:
            return self.node.track(self.run, self._send)
        batch = self._batches.next(self.sent.metrics, self.node.is_over)
        if batch is None:
            return self.node.track(self.run, self._send) or self._end_abandoned()
        run = self._run_of()
        self._send(run, batch.points, batch.params, batch.tags)
        if batch.is_last:
            self._tracking.finish(
                run.run_id, self.folder.mission_id, self.story.end['status'], int(self.story.end['t']) // 1_000_000
            )
        self._move(metrics=batch.end, ended=batch.is_last)
        if batch.is_all:  # the agent's first: what it logs itself is not sent for the node
            self.node.track(run, self._send)
        return True

    def attach(self) -> bool:
        """Send the next artifacts."""
        self._recall()
        if self.run is None:
            return False
        done, end = 0, self.sent.artifacts
        for line in self._lines(self.sent.artifacts):
            for artifact in artifacts_of(line.record or {}, self.folder, self.story):
                self._attach(self.run, artifact)
                done += 1
            end = line.end
            if done >= ARTIFACTS_A_STEP:
                break
        moved = self._moved(artifacts=end)
        return self.node.attach(self.run, self._attach, ARTIFACTS_A_STEP - done) or moved

    def shelve(self, *, hold: bool = False) -> bool:
        """Hand the next frames, trajectories and the summary to the spool; without a run only with ``hold``, to be held there."""
        self._recall()
        if self.run is not None and self.sent.held:
            if not self._shelf.bind(self.folder.mission_id, self.run.run_id):
                self._move(held=False)
            return True
        if self.run is None and not (hold and self.story.start):
            return False
        items: list[Item] = []
        size, end, missing = 0, self.sent.objects, 0
        for line in self._lines(self.sent.objects) if self.run else self._lines_before_a_run():
            found = list(objects_of(line.record or {}, self.story.start, self.folder, self.run))
            items += found
            missing += not found and (line.record or {}).get('k') in {'frame', 'trajectory'}
            size += sum(len(item.content.body) for item in found)
            end = line.end
            if len(items) >= OBJECTS_A_STEP or size >= BYTES_A_STEP:
                break
        if self.run is None and items and not self.sent.held:
            self._move(held=True)
        more, node_end = self.node.shelve(self.run, OBJECTS_A_STEP - len(items))
        self._shelf.add([item.content for item in (*items, *more)])
        moved = self.node.shelved(node_end)
        moved = self._moved(objects=end, missing=self.sent.missing + missing) or moved
        for item in items:
            if item.is_done_with:
                item.path.unlink(missing_ok=True)
        return moved

    def complete(self) -> bool:
        """Whether everything has arrived; what was kept for sending goes then."""
        if (
            self.sent.ended
            and not self.sent.held
            and not self.sent.complete
            and self.sent.artifacts == self.sent.objects == self.sent.metrics
            and self.node.is_sent()
        ):
            self._move(complete=True)
            for folder in (self.folder, self.folder.node):
                shutil.rmtree(folder.files, ignore_errors=True)
        return self.sent.complete

    def give_up(self, error: str) -> None:
        """Say why nothing more of it can be sent; the next start tries again."""
        self._move(error=error)

    # -- the journal -----------------------------------------------------------------------------------------------

    def _recall(self) -> None:
        """After a restart: tell the story what was sent before."""
        self.node.recall()
        self._batches.recall(self.sent.metrics)

    def _end_abandoned(self) -> bool:
        """Where the agent died in the middle, say so in its place; whether that was so."""
        if not self.story.start or self.story.end or not self.node.is_over():
            return False
        with journal.abandoned(self.folder.journal) as descriptor:
            if descriptor is None or any(True for _ in self.folder.lines(self._batches.told)):
                return descriptor is not None
            error = 'the agent ended without ending its mission'
            last_ns = max(self.story.last_ns, self.node.story.last_ns)
            record = {'k': 'end', 't': last_ns, 'status': KILLED, 'success': False, 'by': 'replayer', 'error': error}
            torn = journal.finish(self.folder.journal, descriptor, self._batches.told, record)
        cut = f', {torn} bytes of a record that was being written are cut off' if torn else ''
        log.warning('mission %s: %s; it is closed as %s%s', self.folder.mission_id, error, KILLED, cut)
        return True

    def _lines(self, offset: int) -> Iterator[journal.Line]:
        """As far as the run has everything, so that the story is known at the end."""
        for line in self.folder.lines(offset):
            if line.end > self.sent.metrics:
                return
            if (line.record or {}).get('k') == 'end' and (self.sent.objects < offset or not self._summarize()):
                return
            offset = line.end
            yield line

    def _lines_before_a_run(self) -> Iterator[journal.Line]:
        """Up to the end, which needs the run for its summary."""
        for line in self.folder.lines(self.sent.objects):
            if (line.record or {}).get('k') == 'end':
                return
            yield line

    # -- the run ---------------------------------------------------------------------------------------------------

    def _run_of(self) -> Run:
        if self.run is None:
            start = self.story.start
            tags = {'mlflow.user': start['robot'], 'mlflow.source.name': 'shadowhound_data_logger'}
            name = stamped(start['type'], int(start['t']))
            run = self._tracking.run_of(self.folder.mission_id, name, int(start['t']) // 1_000_000, tags)
            self.folder.set_run(run)
            self.run = run
        return self.run

    def _send(self, run: Run, points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        send(self._tracking, run.run_id, (points, params, tags), self._refuse)

    def _refuse(self, error: Exception, count: str = 'refused') -> None:
        log.error('mission %s: %s', self.folder.mission_id, error)
        self._move(**{count: getattr(self.sent, count) + 1, 'error': str(error)})

    # -- artifacts -------------------------------------------------------------------------------------------------

    def _attach(self, run: Run, artifact: Artifact) -> None:
        """Send one file; that it is gone, or refused, is counted."""
        try:
            path = prepared(self.folder, artifact)
        except FileNotFoundError as error:
            self._refuse(error, 'unattached')
            return
        try:
            self._tracking.artifact(run, path, artifact.folder)
        except TrackingRefused as error:
            self._refuse(error, 'unattached')

    def _summarize(self) -> bool:
        """Once: artifact and object must be the same. False while the pictures are being made."""
        assert self.run is not None
        if not self.story.counts['trajectory']:
            self.node.write_trajectory()
        if not self.folder.summary.exists():
            made = self._pictures(self.folder, stamped(self.story.start['type'], int(self.story.start['t'])))
            if made is None:
                return False
            content = summary_of(self.story, self.folder.mission_id, self.run, self.sent, made)
            write_json(self.folder.summary, content, durable=True)
        return True

    # -- places ----------------------------------------------------------------------------------------------------

    def _moved(self, **offset: int) -> bool:
        """Move one place; False where it was there."""
        if all(getattr(self.sent, name) == value for name, value in offset.items()):
            return False
        self._move(**offset)
        return True

    def _move(self, **changes: Any) -> None:
        self.sent = replace(self.sent, **changes)
        durable = not changes.keys().isdisjoint({'objects', 'held', 'complete'})  # after these, files go
        self.folder.set_sent(self.sent, durable=durable)
