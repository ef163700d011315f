"""The demo's minute: the robot walks, the S3 server is down in the middle, and the spool is read twice per second."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.spool import ledger
from shadowhound_sim.demo_processes import ROBOT, Child
from shadowhound_sim.floor_plan import FloorPlan
from shadowhound_sim.patrol import Patrol

if TYPE_CHECKING:
    from typing_extensions import Self

LOOK_S: Final = 0.5
"""Between two readings of the spool."""
CATCH_UP_S: Final = 30.0
"""Time for the backlog after the robot has stopped; a second or two unless the Tower returned only then."""


@dataclass(frozen=True, slots=True)
class SpoolReading:
    """The state of the spool at one moment."""

    t: float
    """Seconds since the robot's first message."""
    messages: int
    spooled: int
    delivered: int
    pending: int
    bytes: int
    """Of all spooled objects."""
    room: str
    tower: str
    """``up``, ``going``, ``away``, ``coming`` or ``back``."""


@dataclass(frozen=True, slots=True)
class Record:
    """A completed run."""

    published: Mapping[str, int]
    """Messages by topic, as counted by the simulated robot."""
    readings: tuple[SpoolReading, ...]
    outage: tuple[float, float] | None
    """Start and end of the S3 server's outage, seconds since the robot's first message."""
    errors: tuple[str, ...] = ()
    """Errors logged by the node."""

    @property
    def backlog(self) -> int:
        """The maximum number of objects that waited."""
        return max(reading.pending for reading in self.readings)

    @property
    def caught_up_s(self) -> float | None:
        """How long after the outage the backlog was gone (a tenth of it, because new objects keep arriving)."""
        if self.outage is None:
            return None
        after = (reading.t for reading in self.readings if reading.t >= self.outage[1] and reading.pending <= self.backlog / 10)
        return next((t - self.outage[1] for t in after), None)


class Patrolled:
    """The room of the robot, by walking time."""

    def __init__(self) -> None:
        self._plan = FloorPlan.build()
        self._patrol = Patrol.through(self._plan.patrol)

    def room(self, t: float) -> str:
        motion = self._patrol.at(t)
        return self._plan.room_at(motion.x, motion.y)


class StoreOutage:
    """Stops the S3 server for a while, on a separate thread: stopping and starting a server takes a second."""

    def __init__(self, tower: Tower, begin_s: float, length_s: float) -> None:
        self._tower = tower
        self._begin_s = begin_s
        self._length_s = length_s
        self._pool = ThreadPoolExecutor(1, 'outage')
        self._step: Future[None] | None = None
        self.state = 'up'
        self.down_s: float | None = None
        self.back_s: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._pool.shutdown()

    def poll(self, t: float, *, is_last: bool = False) -> None:
        """Do what is due; with ``is_last`` the server is restarted immediately. Raises ServerFailed if that fails."""
        if self._step is not None:
            if not self._step.done():
                return
            self._step.result()
            self._step = None
            if self.state == 'going':
                self.state = 'away'
            else:
                self.state, self.back_s = 'back', t
        if self.state == 'up' and self._length_s and t >= self._begin_s and not is_last:
            self.state, self.down_s = 'going', t
            self._step = self._pool.submit(self._tower.stop_s3)
        elif self.state == 'away' and self.down_s is not None and (t >= self.down_s + self._length_s or is_last):
            self.state = 'coming'
            self._step = self._pool.submit(self._tower.start_s3)

    @property
    def span(self) -> tuple[float, float] | None:
        return (self.down_s, self.back_s) if self.down_s is not None and self.back_s is not None else None


Show = Callable[[SpoolReading], None]


def patrol(folder: Path, node: Child, outage: StoreOutage, environ: Mapping[str, str], duration_s: float, show: Show) -> Record:
    """Let the robot walk and the node log; returns when everything is delivered, or the time is over."""
    arguments = ['--ros-args', '-p', f'duration_s:={duration_s}']
    with Child('shadowhound_sim.sim_go2_node', arguments, environ, folder / 'sim.log') as sim:
        readings = list(_follow(folder / 'home' / 'spool', (node, sim), outage, show))
        try:
            published = json.loads(sim.output.splitlines()[-1])['published']
        except (IndexError, ValueError, KeyError):
            raise sim.failed('did not report what it published') from None
    if not readings:
        raise node.failed('received nothing from the simulated robot')
    return Record(published, tuple(readings), outage.span)


def _follow(spool: Path, processes: tuple[Child, Child], outage: StoreOutage, show: Show) -> Iterable[SpoolReading]:
    """A reading every LOOK_S from the first message on, until the robot has stopped and nothing waits any more."""
    node, sim = processes
    patrolled = Patrolled()
    began: float | None = None
    stopped_s: float | None = None
    look_at = time.monotonic()
    while True:
        for process in processes:
            process.check()
        if not node.is_running:
            raise node.failed('exited too early')
        now = time.monotonic()
        if not sim.is_running and stopped_s is None:
            stopped_s = now
        found = ledger.read(spool, ROBOT)
        messages = sum(row['received'] for row in found['topics'].values())
        if began is None and messages:
            began = now
        if began is not None:
            t = now - began
            outage.poll(t, is_last=stopped_s is not None)
            objects = found['objects']
            reading = SpoolReading(t, messages, objects['spooled'], objects['delivered'], objects['pending'],
                              found['bytes']['spooled'], patrolled.room(t), outage.state)  # fmt: skip
            show(reading)
            yield reading
        if stopped_s is not None:
            settled = found['objects']['pending'] == 0 and outage.state in {'up', 'back'}
            if settled or now > stopped_s + CATCH_UP_S:
                return
        look_at = max(look_at + LOOK_S, now)
        time.sleep(max(look_at - time.monotonic(), 0.05))
