"""The sender of missions, a process: ``python -m shadowhound_data_logger.missions.replay``, started by MissionDataLogger.

One sender per home works at a time (a lock that ends with the process); others wait. It keeps running after its agent has exited,
until everything is sent or nothing has succeeded for ``LINGER_S``; the next sender sends the rest. A byte on standard input wakes
it, and end of file means that the agent has exited.

A sender whose agent has exited yields to one whose agent is running, because that one may have a newer address or password. A
waiting sender holds a second, shared lock, which also ends with the process.
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
from shadowhound_data_logger.core.clock_watch import UtcOffsets
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import DataLoggerError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.retry import backoff
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, missions, write_json
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.overview import LOCK, STATE
from shadowhound_data_logger.missions.pictures import PictureProcess
from shadowhound_data_logger.missions.tracking import MlflowTracking, Tracking
from shadowhound_data_logger.spool import clock_record

MAX_PAUSE_S: Final = 60.0


class RetryGate:
    """Decides when to retry a receiver. It is open while the receiver may be tried.

    Each failure in a row closes it for longer (exponential backoff with full jitter, up to a minute).
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
        """Close after a failure."""
        self._failures += 1
        self.error = error
        self._next_s = self._monotonic() + backoff(self._failures, MAX_PAUSE_S, self._rng)

    def worked(self) -> None:
        """Open after a success."""
        self._failures, self.error, self._next_s = 0, None, float('-inf')

    def retry_now(self) -> None:
        """Open now, because an agent waits for the receiver."""
        self._next_s = float('-inf')


log = logging.getLogger(__name__)

POLL_S: Final = 0.5
"""How often the sender reads the journals without being woken."""
LINGER_S: Final = 600.0
"""How long the sender keeps trying after its agent has exited, if nothing succeeds."""
HANG_TIMEOUT_S: Final = 3.0
"""How long a hanging request may delay yielding to another sender."""
WAITING: Final = 'replay.waiting'
"""Next to the missions: locked, shared, by waiting senders that have an agent."""
RETENTION_S: Final = 30 * 86_400.0
"""How long a delivered mission is kept on the robot; checked when a sender starts."""
SLICE_S: Final = 0.5
TRACKING, ARTIFACTS, OBJECTS, STORE = 'tracking', 'artifacts', 'objects', 'store'


class Replay:
    """Sends all missions of one home. Lifecycle: New; step any number of times; close once. Not thread-safe."""

    def __init__(self, home: Path, tracking: Tracking, spooler: Spooler, pictures: PictureProcess, *,
                 settle: Callable[[MissionFolder], bool] = lambda _: True, monotonic: Callable[[], float] = time.monotonic,
                 rng: random.Random | None = None) -> None:  # fmt: skip
        """``settle`` returns whether the times of a mission are final."""
        self._home = home
        self._tracking = tracking
        self._spooler = spooler
        self._pictures = pictures
        self._monotonic = monotonic
        self._progress = False
        rng = rng or random.Random()
        self.gates = {name: RetryGate(monotonic, rng) for name in (TRACKING, ARTIFACTS, OBJECTS, STORE)}
        self._deliveries: dict[str, Delivery] = {}
        self._settle = settle
        self._stuck: set[tuple[str, str]] = set()  # (gate, mission) whose last attempt failed
        self._waiting: set[str] = set()  # missions that have no date yet, or that cannot be read now
        self._settled: set[str] = set()  # missions that are complete, or that this sender cannot send
        self._written_state: dict[str, object] = {}
        self._logged: set[str] = set()

    def step(self) -> bool:
        """Do some work, the newest mission first; returns whether any was done."""
        start_s = self._monotonic()
        self._find_missions()
        self._progress = False
        tried = [gate for gate in self.gates.values() if gate.is_open]
        for delivery in self._newest_first():
            if self._work(delivery):
                self._spooler.expedite()
                self._settled.add(delivery.folder.mission_id)
                del self._deliveries[delivery.folder.mission_id]
            if self._progress and self._monotonic() - start_s > SLICE_S:
                break  # a new mission must not wait for old ones
        else:
            if not self._progress:
                self._try(STORE, self._drain)
            for gate in tried:
                if gate.is_open:  # nothing failed
                    gate.worked()
        self._write_state()
        return self._progress

    def _work(self, delivery: Delivery) -> bool:
        """Do one piece of work for each receiver; returns whether this mission is finished."""
        mission_id = delivery.folder.mission_id
        try:
            self._try(TRACKING, delivery.track, mission_id)
            self._try(ARTIFACTS, delivery.attach, mission_id)
            self._try(OBJECTS, lambda: delivery.spool(hold=self.gates[TRACKING].error is not None), mission_id)
            return delivery.complete()
        except TrackingRefused as error:
            log.error('mission %s cannot be sent any further: %s', mission_id, error)  # noqa: TRY400 - no defect
            reason = str(error)
        except Exception as error:  # the supervised catch-all: one corrupt journal must not stop the others
            log.error('mission %s cannot be sent', mission_id, exc_info=error)  # noqa: TRY400
            reason = f'{type(error).__name__}: {error}'
        with suppress(OSError):  # the error is also in the log
            delivery.give_up(reason)
        return True

    @property
    def has_unsent(self) -> bool:
        """Whether anything is still unsent."""
        waits = bool(self._waiting) or any(delivery.awaits_agent for delivery in self._deliveries.values())
        return waits or any(gate.error for gate in self.gates.values()) or self._spooler.has_unsent or self._pictures.busy

    def retry_now(self) -> None:
        """Retry all receivers, because an agent waits for them."""
        for gate in self.gates.values():
            gate.retry_now()

    def expedite(self) -> None:
        """Write the last rows of the catalog soon, because the agent has exited."""
        self._spooler.expedite()

    def close(self) -> None:
        """Close the spool and record that no sender is running."""
        self._spooler.close()
        self._pictures.close()
        self._write_state(ended=True)

    def _find_missions(self) -> None:
        """Start delivering new missions."""
        for folder in missions(self._home):
            if folder.mission_id not in self._deliveries and folder.mission_id not in self._settled and folder.journal.exists():
                try:
                    self._add(folder)
                except OSError as error:
                    self._waiting.add(folder.mission_id)
                    self._log_once(folder.mission_id, error)

    def _add(self, folder: MissionFolder) -> None:
        if folder.sent().complete:
            self._settled.add(folder.mission_id)
            if folder.age_s() > RETENTION_S:
                shutil.rmtree(folder.path, ignore_errors=True)
        elif self._settle(folder):
            self._deliveries[folder.mission_id] = Delivery(folder, self._tracking, self._spooler, self._pictures.make)
            self._waiting.discard(folder.mission_id)
            self.gates[TRACKING].retry_now()  # the agent waits for the run id
        else:
            self._waiting.add(folder.mission_id)

    def _newest_first(self) -> list[Delivery]:
        """Missions whose last attempt failed come last: otherwise their retries would delay the others."""
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
            self._log_once(name, error)
        else:
            if worked:
                gate.worked()
                self._stuck.discard((name, mission_id))
            self._progress = self._progress or worked

    def _log_once(self, who: str, error: Exception) -> None:
        if str(error) not in self._logged:
            self._logged.add(str(error))
            log.warning('%s: %s', who, error)

    def _drain(self) -> bool:
        """Deliver objects; returns whether any was delivered."""
        before = self._spooler.pending()
        self._spooler.drain()
        return self._spooler.pending() < before

    def _write_state(self, *, ended: bool = False) -> None:
        """Write the state for other processes if it has changed."""
        errors = {
            name: {'error': str(gate.error), 'remedy': getattr(gate.error, 'remedy', '')}
            for name, gate in self.gates.items() if gate.error is not None
        }  # fmt: skip
        state: dict[str, object] = {'pid': 0 if ended else os.getpid(), 'errors': errors}
        if state != self._written_state:
            try:
                write_json(self._home / MISSIONS / STATE, state)
            except OSError as error:
                self._log_once(STATE, error)
            else:
                self._written_state = state


def _age(mission_id: str) -> list[str]:
    """The date and time in a mission id: sorts missions by their start."""
    return mission_id.split('_')[-3:-1]


class AgentProcess:
    """The agent, connected to standard input: a byte wakes the sender, and end of file means that the agent has exited."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pid = os.getppid()
        self.gone = False

    def wait(self, seconds: float) -> bool:
        """Wait; returns whether the agent woke the sender within this time."""
        if self.gone:
            time.sleep(seconds)
            return False
        ready = select.select([self._descriptor], [], [], seconds)[0]
        read = os.read(self._descriptor, 4096) if ready else b''
        self.gone = bool(ready and not read) or os.getppid() != self._pid
        return bool(read)

    def has_ended(self) -> bool:
        """Like ``gone``, but up to date, without reading and from any thread."""
        poll = select.poll()
        poll.register(self._descriptor, 0)
        return bool(poll.poll(0)) or os.getppid() != self._pid


class SuccessorWatch:
    """Watches for a waiting sender, to which this one yields once its own agent has exited.

    Lifecycle: New; start once; stop once. It owns its thread. If a hanging request delays the exit, it ends the process after
    ``HANG_TIMEOUT_S``, which is as safe as a kill.
    """

    def __init__(self, waiting: Path, parent: AgentProcess, end: Callable[[int], object] = os._exit) -> None:
        self._waiting = waiting
        self._parent = parent
        self._end = end
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name='successor', daemon=True)
        self.is_waiting = False

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self.is_waiting:
            if self._stopped.wait(POLL_S):
                return
            self.is_waiting = self._parent.has_ended() and self._has_successor()
        log.info('a sender of another agent takes over')
        if not self._stopped.wait(HANG_TIMEOUT_S):
            self._end(0)

    def _has_successor(self) -> bool:
        try:
            with flock(self._waiting, wait=False) as free:
                return not free
        except OSError as error:
            log.warning('%s cannot be locked: %s', self._waiting, error)
            return False


def run(replay: Replay, parent: AgentProcess, stopping: Callable[[], bool]) -> None:
    """Run until the agent has exited and everything is sent, or nothing has succeeded for ``LINGER_S``."""
    worked_s = time.monotonic()
    woken = False
    while not stopping():
        if woken:
            replay.retry_now()
        if replay.step():
            worked_s = time.monotonic()
            woken = parent.wait(0.0)
            continue
        if parent.gone:
            if not replay.has_unsent or time.monotonic() - worked_s > LINGER_S:
                return
            replay.expedite()
        woken = parent.wait(POLL_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sender until it is done or receives SIGTERM; SIGINT, sent by the agent's terminal, is ignored."""
    parser = argparse.ArgumentParser(prog='python -m shadowhound_data_logger.missions.replay', description='Send missions.')
    parser.add_argument('--home', type=Path, required=True)
    parser.add_argument('--experiment', required=True)
    options = parser.parse_args(arguments)
    signals: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    logging.basicConfig(level=logging.INFO, format='%(asctime)s %(levelname)s %(message)s')
    parent = AgentProcess(sys.stdin.fileno())
    folder: Path = options.home / MISSIONS
    with ExitStack() as opened:
        if not _locked(folder, opened, parent, lambda: bool(signals)):
            return 0
        successor = SuccessorWatch(folder / WAITING, parent)
        successor.start()
        opened.callback(successor.stop)
        settings, clock = Settings.load({}, {**os.environ, 'SHADOWHOUND_HOME': str(options.home)}), SystemClock.of_this_machine()
        tracking = open_tracking(options.home, options.experiment)
        offsets = UtcOffsets(clock, settings.clock.hold_s, lambda: clock_record.read(settings.spool_path, settings.robot).offsets)
        replay = Replay(
            options.home, tracking, Spooler(settings, clock), PictureProcess(), settle=lambda folder: folder.assign_date(offsets)
        )
        opened.callback(replay.close)
        run(replay, parent, lambda: bool(signals) or successor.is_waiting)
    return 0


def _locked(folder: Path, opened: ExitStack, parent: AgentProcess, stopping: Callable[[], bool]) -> bool:
    """Wait until no other process sends; False if the agent exits first. Raises OSError."""
    with flock(folder / WAITING, shared=True):
        while not opened.enter_context(flock(folder / LOCK, wait=False)):
            opened.close()
            parent.wait(POLL_S)
            if parent.gone or stopping():
                return False
    return True


def open_tracking(home: Path, experiment: str) -> MlflowTracking:
    """Open the tracking server that the environment names, otherwise a SQLite file in the home."""
    uri = os.environ.get('MLFLOW_TRACKING_URI') or _private_store(home)
    root = home / 'mlartifacts' if uri.startswith('sqlite:') else None
    if root is not None:
        root.mkdir(mode=0o700, exist_ok=True)
    tracking = MlflowTracking(uri, experiment, root)
    try:
        tracking.open()  # takes seconds, for which the start of a mission should not wait
    except TrackingUnavailable as error:
        log.warning('%s', error)
    return tracking


def _private_store(home: Path) -> str:
    """A SQLite file in the home, readable only by its owner, because the commands and pictures of missions are private."""
    path = home / 'mlflow.db'
    os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    return f'sqlite:///{path}'


if __name__ == '__main__':
    sys.exit(main())
