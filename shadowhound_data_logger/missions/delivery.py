"""Sends one mission: metrics and artifacts to its MLflow run, and objects to the store.

A mission has two journals, the agent's and the node's, which are sent independently (journal_delivery.py); the run starts and
ends with the agent's. The agent's values take precedence: the node's points of a metric that the agent has logged are not sent.
The frames of both are kept: the node's have a separate range of numbers (node_log.FIRST_FRAME).
"""

from __future__ import annotations

import csv
import io
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Final

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import TrackingRefused
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, staged_file
from shadowhound_data_logger.missions.folder import MissionFolder, MissionSent, Run, timestamped_name, write_json
from shadowhound_data_logger.missions.journal_delivery import JournalDelivery
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.pictures import MakePictures, no_pictures
from shadowhound_data_logger.missions.state import FRAMES, KILLED, Point, run_request, summary_of
from shadowhound_data_logger.missions.tracking import Tracking, send
from shadowhound_data_logger.missions.values import MAX_TAG

log = logging.getLogger(__name__)

MAX_ARTIFACTS_PER_STEP: Final = 4
MAX_OBJECTS_PER_STEP: Final = 64
MAX_BYTES_PER_STEP: Final = 8 << 20
RUN_CREATION_TIMEOUT_S: Final = 30.0
"""The longest that the agent may take to create the run: its requests have timeouts, but a server may answer byte by byte."""
NODE_CLOSE_TIMEOUT_S: Final = 30.0
"""The longest that the end of a mission waits for the node to close its journal: that takes a second, unless the node hangs."""


class Delivery:
    """Sends one mission: points, state and artifacts to MLflow, and objects to the spool.

    Lifecycle: New; ``track``, ``attach`` and ``spool`` in turns, until ``sent.complete``. Not thread-safe.

    Each does a bounded piece of work and returns whether there was any. Raises TrackingError, SpoolError, OSError.
    """

    def __init__(self, folder: MissionFolder, tracking: Tracking, spooler: Spooler, make_pictures: MakePictures = no_pictures,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self.folder = folder
        self.run: Run | None = folder.run()
        self._agent = JournalDelivery(folder, folder, folder.lines)
        self._node = JournalDelivery(folder, folder.node, folder.node_lines, self._agent_logs)
        self._state = self._agent.state
        self._state.node = self._node.state
        self._tracking = tracking
        self._spooler = spooler
        self._make_pictures = make_pictures
        self._monotonic = monotonic
        self._node_wait_start_s: float | None = None
        self._run_deadline_s = monotonic() + RUN_CREATION_TIMEOUT_S
        self.awaits_agent = False
        """Whether nothing was sent because the agent is still creating the run."""

    @property
    def sent(self) -> MissionSent:
        """How far the agent's journal and the whole mission are sent."""
        return self._agent.sent

    def track(self) -> bool:
        """Send the next batch of metrics; create the run before the first and end it after the last."""
        self._catch_up()
        if self.sent.ended:
            return self._track_node()
        if self._agent_creates_run():
            return False
        batch = self._agent.points(self._is_node_done)
        if batch is None:
            return self._track_node() or self._close_abandoned()
        is_last = batch.last == 'end'
        if self.run is None:
            run = self._tracking.run_of(self.folder.mission_id, *run_request(self._state.start))
            self.folder.set_run(run)
            self.run = run
        run = self.run
        params = self._state.params() if batch.last == 'start' else self._state.final_params() if is_last else {}
        error = self._state.end.get('error') if is_last else None
        self._send(run, batch.points, params, {'shadowhound.error': str(error)[:MAX_TAG]} if error else {})
        if is_last:
            end = self._state.end
            self._tracking.finish(run.run_id, self.folder.mission_id, end['status'], int(end['t']) // 1_000_000)
        self._agent.move(metrics=batch.end, ended=is_last)
        if batch.is_all:  # only after the agent's points: the node's points of metrics that the agent logs are not sent
            self._track_node()
        return True

    def attach(self) -> bool:
        """Send the next artifacts."""
        self._catch_up()
        if self.run is None:
            return False
        before = self._agent.attached, self._node.attached
        send, refuse = partial(self._attach, self.run), partial(self._refuse, count='unattached')
        done = self._agent.attach(self._lines(self._agent.attached), send, refuse, MAX_ARTIFACTS_PER_STEP)
        rest = self._node.lines(self._node.attached, self._node.sent.metrics)
        done += self._node.attach(rest, send, refuse, MAX_ARTIFACTS_PER_STEP - done)
        return done > 0 or (self._agent.attached, self._node.attached) != before

    def spool(self, *, hold: bool = False) -> bool:
        """Pass the next frames, trajectories and the summary to the spool. Without a run, only if ``hold``: it holds them."""
        self._catch_up()
        if self.run is not None and self.sent.held:
            if not self._spooler.bind(self.folder.mission_id, self.run.run_id):
                self._agent.move(held=False)
            return True
        if self.run is None and not (hold and self._state.start):
            return False
        before = self._agent.sent, self._node.sent
        lines = self._lines(self.sent.objects) if self.run else self._lines_before_end()
        own = self._agent.objects(lines, self._state.start, self.run, MAX_OBJECTS_PER_STEP, MAX_BYTES_PER_STEP)
        if self.run is None and own.items:
            self._agent.move(held=True)
        rest = self._node.lines(self._node.sent.objects, self._node.sent.metrics if self.run else 0)
        left = MAX_OBJECTS_PER_STEP - len(own.items), MAX_BYTES_PER_STEP - own.bytes
        nodes = self._node.objects(rest, self._state.start, self.run, *left)
        self._spooler.add([item.content for item in (*own.items, *nodes.items)])
        for part, batch in ((self._node, nodes), (self._agent, own)):
            part.move(objects=batch.end, missing=part.sent.missing + batch.missing)
        for item in own.items:
            if item.is_disposable:
                item.path.unlink(missing_ok=True)
        return (self._agent.sent, self._node.sent) != before

    def complete(self) -> bool:
        """Whether everything has arrived; then delete the files that were kept for sending."""
        sent, nodes = self._agent.sent, self._node.sent
        if (
            sent.ended
            and not sent.held
            and not sent.complete
            and sent.artifacts == sent.objects == sent.metrics
            and self._node.is_closed()
            and nodes.artifacts == nodes.objects == nodes.metrics == self._node.complete_bytes()
        ):
            self._agent.move(complete=True)
            for folder in (self.folder, self.folder.node):
                shutil.rmtree(folder.files, ignore_errors=True)
        return self.sent.complete

    def give_up(self, error: str) -> None:
        """Record why the mission cannot be sent any further; the next sender tries again."""
        self._agent.move(error=error)

    # -- the node's journal ----------------------------------------------------------------------------------------

    def _track_node(self) -> bool:
        """Send the node's next points."""
        batch = self._node.points() if self.run else None
        if self.run is None or batch is None:
            return False
        self._send(self.run, batch.points, {}, {})
        self._node.move(metrics=batch.end)
        return True

    def _agent_logs(self, point: Point) -> bool:
        """Whether the agent logs this metric, too: then the node's points are not sent."""
        return point.key in self._state.first or (point.key == FRAMES and bool(self._state.counts['frame']))

    def _is_node_done(self) -> bool:
        """Whether the run has all of the node's points, or the node has taken too long to close its journal."""
        if self._node.is_closed():
            return self._node.sent.metrics == self._node.complete_bytes()
        self._node_wait_start_s = self._monotonic() if self._node_wait_start_s is None else self._node_wait_start_s
        return self._monotonic() - self._node_wait_start_s > NODE_CLOSE_TIMEOUT_S

    def _write_trajectory(self) -> None:
        """Write trajectory.csv once, with all poses: seconds since 1970, meters and radians."""
        if not self._node.state.counts['poses'] or self.folder.trajectory.exists():
            return
        with replacing(self.folder.trajectory) as binary, io.TextIOWrapper(binary, 'ascii', newline='') as file:
            rows = csv.writer(file, lineterminator='\n')
            rows.writerow(('timestamp', 'x', 'y', 'yaw', 'z'))
            for line in self._node.lines(0):
                if line.record and line.record.get('k') == 'poses':
                    rows.writerows((f'{ns // SECOND}.{ns % SECOND:09d}', *pose) for ns, *pose in line.record['p'])

    # -- the agent's journal ---------------------------------------------------------------------------------------

    def _catch_up(self) -> None:
        """After a restart, restore the state by reading the records that were sent before."""
        self._node.catch_up()
        self._agent.catch_up()
        self.run = self.run or self.folder.run()

    def _close_abandoned(self) -> bool:
        """Append the end in place of an agent that was killed; returns whether it was."""
        if not self._state.start or self._state.end or not self._is_node_done():
            return False
        with journal.abandoned(self.folder.journal) as descriptor:
            if descriptor is None or any(True for _ in self.folder.lines(self._agent.read_to)):
                return descriptor is not None
            error = 'the agent exited without ending its mission'
            last_ns = max(self._state.last_ns, self._node.state.last_ns)
            record = {'k': 'end', 't': last_ns, 'status': KILLED, 'success': False, 'by': 'replayer', 'error': error}
            torn = journal.finish(self.folder.journal, descriptor, self._agent.read_to, record)
        cut = f', and {torn} bytes of an incomplete record were removed' if torn else ''
        log.warning('mission %s: %s; it was closed as %s%s', self.folder.mission_id, error, KILLED, cut)
        return True

    def _lines(self, offset: int) -> Iterator[journal.Line]:
        """The lines that are in the run; stops before the end until the summary is written."""
        for line in self.folder.lines(offset):
            if line.end > self.sent.metrics:
                return
            if (line.record or {}).get('k') == 'end' and (self.sent.objects < offset or not self._summarize()):
                return
            offset = line.end
            yield line

    def _lines_before_end(self) -> Iterator[journal.Line]:
        """The lines before the end. Without a run, the end must wait: its summary names the run."""
        for line in self.folder.lines(self.sent.objects):
            if (line.record or {}).get('k') == 'end':
                return
            yield line

    # -- the run ---------------------------------------------------------------------------------------------------

    def _agent_creates_run(self) -> bool:
        """Whether the agent is creating the run at this moment (new_run.py)."""
        self.awaits_agent = False
        if self.run is None and self._monotonic() <= self._run_deadline_s:
            with suppress(OSError):  # a file system that cannot lock folders: there, only this process creates runs
                self.awaits_agent = journal.is_locked(self.folder.path)
        if not self.awaits_agent:
            self.run = self.run or self.folder.run()
        return self.awaits_agent

    def _send(self, run: Run, points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        send(self._tracking, run.run_id, (points, params, tags), self._refuse)

    def _refuse(self, error: Exception, count: str = 'refused') -> None:
        log.error('mission %s: %s', self.folder.mission_id, error)
        self._agent.move(**{count: getattr(self.sent, count) + 1, 'error': str(error)})

    # -- artifacts -------------------------------------------------------------------------------------------------

    def _attach(self, run: Run, artifact: Artifact) -> bool:
        """Send one file, or count it if it was deleted or refused. Returns whether the server accepted it."""
        try:
            self._tracking.artifact(run, staged_file(self.folder, artifact), artifact.folder)
        except (FileNotFoundError, TrackingRefused) as error:
            self._refuse(error, 'unattached')
            return False
        return True

    def _summarize(self) -> bool:
        """Write the summary once, so that artifact and object are identical. False while the pictures are being made."""
        assert self.run is not None
        if not self._state.counts['trajectory']:
            self._write_trajectory()
        if not self.folder.summary.exists():
            made = self._make_pictures(self.folder, timestamped_name(self._state.start['type'], int(self._state.start['t'])))
            if made is None:
                return False
            content = summary_of(self._state, self.folder.mission_id, self.run, self.sent, made)
            write_json(self.folder.summary, content, durable=True)
        return True
