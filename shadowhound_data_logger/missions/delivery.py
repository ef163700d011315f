"""Sends one mission: to MLflow's run, to its artifacts, and as objects to the store.

It has two journals, the agent's and the node's, which are sent independently (journal_delivery.py); the run starts and ends with
the agent's. The agent's values win: points of a metric that it has logged are not sent for the node. Frames of both are kept:
those of the node have separate numbers (node_log.FIRST_FRAME).
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
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import TrackingRefused
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.artifacts import Artifact, prepared
from shadowhound_data_logger.missions.folder import MissionFolder, MissionSent, Run, stamped, write_json
from shadowhound_data_logger.missions.journal_delivery import JournalDelivery
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.pictures import Pictures, nothing
from shadowhound_data_logger.missions.state import FRAMES, KILLED, MissionState, Point, run_request, summary_of
from shadowhound_data_logger.missions.tracking import Tracking, send
from shadowhound_data_logger.missions.values import MAX_TAG

log = logging.getLogger(__name__)

ARTIFACTS_A_STEP: Final = 4
OBJECTS_A_STEP: Final = 64
BYTES_A_STEP: Final = 8 << 20
AGENT_S: Final = 30.0
"""How long the agent may take to create the run: its requests have deadlines, but a server may answer byte by byte."""
NODE_S: Final = 30.0
"""How long the end of a mission waits until the node closes its journal: that takes a second, unless the node hangs."""


class Delivery:
    """Sends one mission: points and state to MLflow, artifacts, and objects to the spool.

    Lifecycle: New; ``track``, ``attach`` and ``spool`` in turns, until ``sent.complete``. Not thread-safe.

    Each of the three does a bounded piece of work and returns whether there was any. Raises TrackingError, SpoolError, OSError.
    """

    def __init__(self, folder: MissionFolder, tracking: Tracking, spooler: Spooler, pictures: Pictures = nothing,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self.folder = folder
        self.run: Run | None = folder.run()
        self._agent = JournalDelivery(folder, folder, folder.lines)
        self._node = JournalDelivery(folder, folder.node, folder.node_lines, self._is_agents)
        self._state = self._agent.state
        self._state.node = self._node.state
        self._tracking = tracking
        self._spooler = spooler
        self._pictures = pictures
        self._monotonic = monotonic
        self._asked_s: float | None = None
        self._made_by_s = monotonic() + AGENT_S
        self.awaits_agent = False
        """Whether nothing was sent because the agent is creating the run."""

    @property
    def sent(self) -> MissionSent:
        """How far the agent's part is sent, and the mission as a whole."""
        return self._agent.sent

    def track(self) -> bool:
        """Send the next batch of metrics; create the run before the first and end it after the last."""
        self._recall()
        if self.sent.ended:
            return self._track_node()
        if self._agent_makes_run():
            return False
        batch = self._agent.points(self._is_node_over)
        if batch is None:
            return self._track_node() or self._close_abandoned()
        run, is_last = self._run_of(), batch.last == 'end'
        params = self._state.params() if batch.last == 'start' else self._state.final_params() if is_last else {}
        self._send(run, batch.points, params, _error_tag(self._state) if is_last else {})
        if is_last:
            end = self._state.end
            self._tracking.finish(run.run_id, self.folder.mission_id, end['status'], int(end['t']) // 1_000_000)
        self._agent.move(metrics=batch.end, ended=is_last)
        if batch.is_all:  # after the agent's points: what it logs itself is not sent for the node
            self._track_node()
        return True

    def attach(self) -> bool:
        """Send the next artifacts."""
        self._recall()
        if self.run is None:
            return False
        before = self._agent.attached, self._node.attached
        send, refuse = partial(self._attach, self.run), partial(self._refuse, count='unattached')
        done = self._agent.attach(self._lines(self._agent.attached), send, refuse, ARTIFACTS_A_STEP)
        rest = self._node.lines(self._node.attached, self._node.sent.metrics)
        done += self._node.attach(rest, send, refuse, ARTIFACTS_A_STEP - done)
        return done > 0 or (self._agent.attached, self._node.attached) != before

    def spool(self, *, hold: bool = False) -> bool:
        """Pass the next frames, trajectories and the summary to the spool; without a run only with ``hold``, to be held there."""
        self._recall()
        if self.run is not None and self.sent.held:
            if not self._spooler.bind(self.folder.mission_id, self.run.run_id):
                self._agent.move(held=False)
            return True
        if self.run is None and not (hold and self._state.start):
            return False
        before = self._agent.sent, self._node.sent
        lines = self._lines(self.sent.objects) if self.run else self._lines_before_a_run()
        own = self._agent.objects(lines, self._state.start, self.run, OBJECTS_A_STEP, BYTES_A_STEP)
        if self.run is None and own.items:
            self._agent.move(held=True)
        rest = self._node.lines(self._node.sent.objects, self._node.sent.metrics if self.run else 0)
        left = OBJECTS_A_STEP - len(own.items), BYTES_A_STEP - own.bytes
        nodes = self._node.objects(rest, self._state.start, self.run, *left)
        self._spooler.add([item.content for item in (*own.items, *nodes.items)])
        for part, batch in ((self._node, nodes), (self._agent, own)):
            part.move(objects=batch.end, missing=part.sent.missing + batch.missing)
        for item in own.items:
            if item.is_done_with:
                item.path.unlink(missing_ok=True)
        return (self._agent.sent, self._node.sent) != before

    def complete(self) -> bool:
        """Whether everything has arrived; files that were kept for sending are then deleted."""
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
        """Record why nothing more of it can be sent; the next sender tries again."""
        self._agent.move(error=error)

    # -- the node's part -------------------------------------------------------------------------------------------

    def _track_node(self) -> bool:
        """Send its next points."""
        batch = self._node.points() if self.run else None
        if self.run is None or batch is None:
            return False
        self._send(self.run, batch.points, {}, {})
        self._node.move(metrics=batch.end)
        return True

    def _is_agents(self, point: Point) -> bool:
        """Whether the agent logs this metric itself: then the node's points are not sent. Frames of both are kept."""
        return point.key in self._state.first or (point.key == FRAMES and bool(self._state.counts['frame']))

    def _is_node_over(self) -> bool:
        """Whether the run has all of the node's points, or the node has taken too long to close its journal."""
        if self._node.is_closed():
            return self._node.sent.metrics == self._node.complete_bytes()
        self._asked_s = self._monotonic() if self._asked_s is None else self._asked_s
        return self._monotonic() - self._asked_s > NODE_S

    def _write_trajectory(self) -> None:
        """Once: trajectory.csv of all poses, in seconds since 1970, metres and radians."""
        if not self._node.state.counts['poses'] or self.folder.trajectory.exists():
            return
        with replacing(self.folder.trajectory) as binary, io.TextIOWrapper(binary, 'ascii', newline='') as file:
            rows = csv.writer(file, lineterminator='\n')
            rows.writerow(('timestamp', 'x', 'y', 'yaw', 'z'))
            for line in self._node.lines(0):
                if line.record and line.record.get('k') == 'poses':
                    rows.writerows((f'{ns // SECOND}.{ns % SECOND:09d}', *pose) for ns, *pose in line.record['p'])

    # -- the journal -----------------------------------------------------------------------------------------------

    def _recall(self) -> None:
        """After a restart: read what was sent before."""
        self._node.recall()
        self._agent.recall()
        self.run = self.run or self.folder.run()

    def _close_abandoned(self) -> bool:
        """If the agent was killed, append the end in its place; returns whether it was."""
        if not self._state.start or self._state.end or not self._is_node_over():
            return False
        with journal.abandoned(self.folder.journal) as descriptor:
            if descriptor is None or any(True for _ in self.folder.lines(self._agent.read_to)):
                return descriptor is not None
            error = 'the agent exited without ending its mission'
            last_ns = max(self._state.last_ns, self._node.state.last_ns)
            record = {'k': 'end', 't': last_ns, 'status': KILLED, 'success': False, 'by': 'replayer', 'error': error}
            torn = journal.finish(self.folder.journal, descriptor, self._agent.read_to, record)
        cut = f', {torn} bytes of a record that was being written are cut off' if torn else ''
        log.warning('mission %s: %s; it is closed as %s%s', self.folder.mission_id, error, KILLED, cut)
        return True

    def _lines(self, offset: int) -> Iterator[journal.Line]:
        """The lines that the run has, so that the state is complete at the end."""
        for line in self.folder.lines(offset):
            if line.end > self.sent.metrics:
                return
            if (line.record or {}).get('k') == 'end' and (self.sent.objects < offset or not self._summarize()):
                return
            offset = line.end
            yield line

    def _lines_before_a_run(self) -> Iterator[journal.Line]:
        """The lines before the end, for which the summary needs the run."""
        for line in self.folder.lines(self.sent.objects):
            if (line.record or {}).get('k') == 'end':
                return
            yield line

    # -- the run ---------------------------------------------------------------------------------------------------

    def _run_of(self) -> Run:
        if self.run is None:
            run = self._tracking.run_of(self.folder.mission_id, *run_request(self._state.start))
            self.folder.set_run(run)
            self.run = run
        return self.run

    def _agent_makes_run(self) -> bool:
        """Whether the agent is creating the run at this moment (new_run.py)."""
        self.awaits_agent = False
        if self.run is None and self._monotonic() <= self._made_by_s:
            with suppress(OSError):  # a file system that cannot lock folders: there the agent leaves it to this process
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
        """Send one file; counts one that was deleted or refused. Returns whether the server accepted it."""
        try:
            self._tracking.artifact(run, prepared(self.folder, artifact), artifact.folder)
        except (FileNotFoundError, TrackingRefused) as error:
            self._refuse(error, 'unattached')
            return False
        return True

    def _summarize(self) -> bool:
        """Once: artifact and object must be the same. False while the pictures are being made."""
        assert self.run is not None
        if not self._state.counts['trajectory']:
            self._write_trajectory()
        if not self.folder.summary.exists():
            made = self._pictures(self.folder, stamped(self._state.start['type'], int(self._state.start['t'])))
            if made is None:
                return False
            content = summary_of(self._state, self.folder.mission_id, self.run, self.sent, made)
            write_json(self.folder.summary, content, durable=True)
        return True


def _error_tag(state: MissionState) -> dict[str, str]:
    error: Any = state.end.get('error')
    return {'shadowhound.error': str(error)[:MAX_TAG]} if error else {}
