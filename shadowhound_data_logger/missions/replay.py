"""The process that sends missions: ``python -m shadowhound_data_logger.missions.replay``, started by MissionDataLogger.

One a home works at a time (a lock that dies with it); others wait. It outlives the agent until all is sent, or Tower was
away for ``LINGER_S``: what is left then waits for the next start. Standard input wakes it; its end is that of the agent.

One whose agent is gone makes way for one whose agent lives, because that one may know a better address or password. Whoever
waits holds a second lock, shared, which dies with it as well.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import select
import shutil
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.dating import Dating
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import DataLoggerError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.retry import backoff
from shadowhound_data_logger.missions.dating import give_date
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.drawing import Drawing
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, missions, write_json
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.overview import LOCK, STATE
from shadowhound_data_logger.missions.tracking import MlflowTracking, Tracking
from shadowhound_data_logger.spool import clock_record

LONGEST_PAUSE_S: Final = 60.0


class Gate:
    """Decides when a receiver is tried again.

    Open while it is to be tried; each failure closes it for longer (exponential, full jitter, up to a minute).
    """

    def __init__(self, monotonic: Callable[[], float], rng: random.Random) -> None:
        self._monotonic = monotonic
        self._rng = rng
        self._failures = 0
        self._next_s = float('-inf')
        self.error: Exception | None = None

    @property
    def is_open(self) -> bool:
        return self._monotonic() >= self._next_s

    def failed(self, error: Exception) -> None:
        self._failures += 1
        self.error = error
        self._next_s = self._monotonic() + backoff(self._failures, LONGEST_PAUSE_S, self._rng)

    def worked(self) -> None:
        self._failures, self.error, self._next_s = 0, None, float('-inf')

    def hurry(self) -> None:
        """Try at once: somebody waits for it."""
        self._next_s = float('-inf')


log = logging.getLogger(__name__)

LOOK_EVERY_S: Final = 0.5
"""How often the journals are looked at when nobody wakes it."""
LINGER_S: Final = 600.0
"""How long it tries on after the agent ended and nothing gets through."""
HANG_S: Final = 3.0
"""How long a request that hangs may keep it from making way."""
WAITING: Final = 'replay.waiting'
"""Beside the missions: locked, shared, by those that wait for an agent that lives."""
KEEP_S: Final = 30 * 86_400.0
"""How long a mission that has arrived stays on the robot; looked at when a sender starts."""
SLICE_S: Final = 0.5
TRACKING, ARTIFACTS, OBJECTS, STORE = 'tracking', 'artifacts', 'objects', 'store'


class Replay:
    """Sends all missions of one home. Life: New; step any number; close once. Not thread-safe."""

    def __init__(self, home: Path, tracking: Tracking, spooler: Spooler, drawing: Drawing, *,
                 settle: Callable[[MissionFolder], bool] = lambda _: True, monotonic: Callable[[], float] = time.monotonic,
                 rng: random.Random | None = None) -> None:  # fmt: skip
        """``settle`` says whether the times of a mission are final."""
        self._home = home
        self._tracking = tracking
        self._spooler = spooler
        self._drawing = drawing
        self._monotonic = monotonic
        self._progress = False
        rng = rng or random.Random()
        self.gates = {name: Gate(monotonic, rng) for name in (TRACKING, ARTIFACTS, OBJECTS, STORE)}
        self._deliveries: dict[str, Delivery] = {}
        self._settle = settle
        self._stuck: set[tuple[str, str]] = set()  # (gate, mission) that failed when it was tried last
        self._waiting: set[str] = set()  # without a date yet, or not readable now
        self._settled: set[str] = set()  # complete, or beyond help until the next start
        self._told: dict[str, object] = {}
        self._logged: set[str] = set()

    def step(self) -> bool:
        """Some pieces of work, those of the newest mission first; whether any was done."""
        began_s = self._monotonic()
        self._look()
        self._progress = False
        tried = [gate for gate in self.gates.values() if gate.is_open]
        for delivery in self._newest_first():
            if self._work(delivery):
                self._spooler.hasten()
                self._settled.add(delivery.folder.mission_id)
                del self._deliveries[delivery.folder.mission_id]
            if self._progress and self._monotonic() - began_s > SLICE_S:
                break  # a mission that begins must not wait for old ones
        else:
            if not self._progress:
                self._try(STORE, self._drain)
            for gate in tried:
                if gate.is_open:  # nothing failed
                    gate.worked()
        self._tell()
        return self._progress

    def _work(self, delivery: Delivery) -> bool:
        """One piece for each receiver; whether nothing is left to do for this mission."""
        mission_id = delivery.folder.mission_id
        try:
            self._try(TRACKING, delivery.track, mission_id)
            self._try(ARTIFACTS, delivery.attach, mission_id)
            self._try(OBJECTS, lambda: delivery.spool(hold=self.gates[TRACKING].error is not None), mission_id)
            return delivery.complete()
        except TrackingRefused as error:
            log.error('mission %s is not sent on: %s', mission_id, error)  # noqa: TRY400 - no defect
            said = str(error)
        except Exception as error:  # the supervised catch-all: one rotten journal must not stop the others
            log.error('mission %s cannot be sent', mission_id, exc_info=error)  # noqa: TRY400
            said = f'{type(error).__name__}: {error}'
        with suppress(OSError):  # the log has it as well
            delivery.give_up(said)
        return True

    @property
    def owes(self) -> bool:
        """Whether something could not be sent yet."""
        waits = bool(self._waiting) or any(delivery.awaits_agent for delivery in self._deliveries.values())
        return waits or any(gate.error for gate in self.gates.values()) or self._spooler.owes or self._drawing.busy

    def hurry(self) -> None:
        for gate in self.gates.values():
            gate.hurry()

    def hasten(self) -> None:
        """The agent is gone: write the last rows of the catalog soon, because no more will come."""
        self._spooler.hasten()

    def close(self) -> None:
        self._spooler.close()
        self._drawing.close()
        self._tell(ended=True)

    def _look(self) -> None:
        """Take up missions that are new here."""
        for folder in missions(self._home):
            if folder.mission_id not in self._deliveries and folder.mission_id not in self._settled and folder.journal.exists():
                try:
                    self._take_up(folder)
                except OSError as error:
                    self._waiting.add(folder.mission_id)
                    self._say(folder.mission_id, error)

    def _take_up(self, folder: MissionFolder) -> None:
        if folder.sent().complete:
            self._settled.add(folder.mission_id)
            if folder.age_s() > KEEP_S:
                shutil.rmtree(folder.path, ignore_errors=True)
        elif self._settle(folder):
            self._deliveries[folder.mission_id] = Delivery(folder, self._tracking, self._spooler, self._drawing.of)
            self._waiting.discard(folder.mission_id)
            self.gates[TRACKING].hurry()  # its agent waits for the run's id
        else:
            self._waiting.add(folder.mission_id)

    def _newest_first(self) -> list[Delivery]:
        """Those that something holds up come last: the others would wait for them whenever it is tried again."""
        stuck = {mission_id for _, mission_id in self._stuck}
        found = sorted(self._deliveries.items(), key=lambda item: (item[0] not in stuck, _age(item[0])), reverse=True)
        return [delivery for _, delivery in found]

    def _try(self, name: str, work: Callable[[], bool], mission_id: str = '') -> None:
        gate = self.gates[name]
        if not gate.is_open:
            return
        try:
            worked = work()
        except TrackingRefused:
            raise
        except (DataLoggerError, OSError, sqlite3.Error) as error:
            gate.failed(error)
            self._stuck.add((name, mission_id))
            self._say(name, error)
        else:
            if worked:
                gate.worked()
                self._stuck.discard((name, mission_id))
            self._progress = self._progress or worked

    def _say(self, who: str, error: Exception) -> None:
        """Once."""
        if str(error) not in self._logged:
            self._logged.add(str(error))
            log.warning('%s: %s', who, error)

    def _drain(self) -> bool:
        """True while there is more to deliver."""
        before = self._spooler.pending()
        self._spooler.drain()
        return self._spooler.pending() < before

    def _tell(self, *, ended: bool = False) -> None:
        """The state for whoever asks; written when it changes."""
        errors = {
            name: {'error': str(gate.error), 'remedy': getattr(gate.error, 'remedy', '')}
            for name, gate in self.gates.items() if gate.error is not None
        }  # fmt: skip
        state: dict[str, object] = {'pid': 0 if ended else os.getpid(), 'errors': errors}
        if state != self._told:
            try:
                write_json(self._home / MISSIONS / STATE, state)
            except OSError as error:
                self._say(STATE, error)
            else:
                self._told = state


def _age(mission_id: str) -> list[str]:
    """Greater for a mission that began later."""
    return mission_id.split('_')[-3:-1]


class Parent:
    """The agent: it wakes us by a byte, and its end is the end of our standard input."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pid = os.getppid()
        self.gone = False

    def wait(self, seconds: float) -> bool:
        """Whether it woke us before."""
        if self.gone:
            time.sleep(seconds)
            return False
        ready = select.select([self._descriptor], [], [], seconds)[0]
        said = os.read(self._descriptor, 4096) if ready else b''
        self.gone = bool(ready and not said) or os.getppid() != self._pid
        return bool(said)

    def has_ended(self) -> bool:
        """The same as ``gone``, asked of the system, from any thread."""
        poll = select.poll()
        poll.register(self._descriptor, 0)
        return bool(poll.poll(0)) or os.getppid() != self._pid


class Successor:
    """Looks whether a sender of an agent that lives waits for this one, whose agent is gone.

    Life: New; start once; stop once. It owns its thread. A request that hangs does not hold it up: ``HANG_S`` after it saw one,
    it ends the process, which is as safe as any kill of it.
    """

    def __init__(self, waiting: Path, parent: Parent, end: Callable[[int], object] = os._exit) -> None:
        self._waiting = waiting
        self._parent = parent
        self._end = end
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name='successor', daemon=True)
        self.waits = False

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self.waits:
            if self._stopped.wait(LOOK_EVERY_S):
                return
            self.waits = self._parent.has_ended() and self._somebody_waits()
        log.info('a sender of another agent takes over')
        if not self._stopped.wait(HANG_S):
            self._end(0)

    def _somebody_waits(self) -> bool:
        try:
            with flock(self._waiting, wait=False) as free:
                return not free
        except OSError as error:
            log.warning('%s cannot be looked at: %s', self._waiting, error)
            return False


def run(replay: Replay, parent: Parent, stopping: Callable[[], bool]) -> None:
    """Until all is sent and the agent is gone; or for ``LINGER_S`` after the last success."""
    worked_s = time.monotonic()
    woken = False
    while not stopping():
        if woken:
            replay.hurry()
        if replay.step():
            worked_s = time.monotonic()
            woken = parent.wait(0.0)
            continue
        if parent.gone:
            if not replay.owes or time.monotonic() - worked_s > LINGER_S:
                return
            replay.hasten()
        woken = parent.wait(LOOK_EVERY_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Until all is sent, the agent is gone, or SIGTERM; SIGINT at the agent's terminal is none of ours."""
    parser = argparse.ArgumentParser(prog='python -m shadowhound_data_logger.missions.replay', description='Send missions.')
    parser.add_argument('--home', type=Path, required=True)
    parser.add_argument('--experiment', required=True)
    options = parser.parse_args(arguments)
    asked: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    logging.basicConfig(level=logging.INFO, format='%(asctime)s %(levelname)s %(message)s')
    parent = Parent(sys.stdin.fileno())
    folder: Path = options.home / MISSIONS
    with ExitStack() as opened:
        if not _locked(folder, opened, parent, lambda: bool(asked)):
            return 0
        successor = Successor(folder / WAITING, parent)
        successor.start()
        opened.callback(successor.stop)
        settings, clock = Settings.load({}, {**os.environ, 'SHADOWHOUND_HOME': str(options.home)}), SystemClock.of_this_machine()
        tracking = open_tracking(options.home, options.experiment)
        dating = Dating(clock, settings.clock.hold_s, lambda: clock_record.read(settings.spool_path, settings.robot)['offsets'])
        replay = Replay(
            options.home, tracking, Spooler(settings, clock), Drawing(), settle=lambda folder: give_date(folder, dating)
        )
        opened.callback(replay.close)
        run(replay, parent, lambda: bool(asked) or successor.waits)
    return 0


def _locked(folder: Path, opened: ExitStack, parent: Parent, stopping: Callable[[], bool]) -> bool:
    """Wait until no other process sends; whether that came before the agent's end. Raises OSError."""
    with flock(folder / WAITING, shared=True):
        while not opened.enter_context(flock(folder / LOCK, wait=False)):
            opened.close()
            parent.wait(LOOK_EVERY_S)
            if parent.gone or stopping():
                return False
    return True


def open_tracking(home: Path, experiment: str) -> MlflowTracking:
    """The tracking server that the environment names, else a SQLite file in the home."""
    uri = os.environ.get('MLFLOW_TRACKING_URI') or _private_store(home)
    root = home / 'mlartifacts' if uri.startswith('sqlite:') else None
    if root is not None:
        root.mkdir(mode=0o700, exist_ok=True)
    tracking = MlflowTracking(uri, experiment, root)
    try:
        tracking.open()  # now, because it takes seconds that a mission's start should not wait for
    except TrackingUnavailable as error:
        log.warning('%s', error)
    return tracking


def _private_store(home: Path) -> str:
    """The home's own SQLite file, for its owner alone: commands and pictures of a home are nobody else's business."""
    path = home / 'mlflow.db'
    os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    return f'sqlite:///{path}'


if __name__ == '__main__':
    sys.exit(main())
