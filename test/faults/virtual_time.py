"""Threads that run one at a time in the order of a clock that is stopped while they run: the same seed, the same run."""

from __future__ import annotations

import heapq
import random
import threading
from collections.abc import Callable
from typing import Final

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.shipping.schedule import Rest, Schedule

STUCK_S: Final = 30.0
"""Real seconds without progress of the only running thread: it waits for something outside the virtual time."""


class Killed(BaseException):
    """Stops a thread of a killed process, wherever it is."""


class Actor:
    """One thread under a VirtualTime; it runs from one ``sleep`` to the next."""

    def __init__(self, time: VirtualTime, name: str, target: Callable[[], None]) -> None:
        self.ended = False
        self.killed = False
        self.error: BaseException | None = None
        self._time = time
        self._target = target
        self._go = threading.Lock()  # both are held except while the other side runs
        self._paused = threading.Lock()
        self._go.acquire()
        self._paused.acquire()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def resume(self) -> None:
        """Let it run until it sleeps or ends; called by the owner of the clock."""
        if self._thread.ident is None:
            self._thread.start()
        self._go.release()
        if not self._paused.acquire(timeout=STUCK_S):
            raise AssertionError(f'{self._thread.name} waits for real')
        if self.ended:
            self._thread.join()
        if self.error:
            raise self.error

    def pause(self) -> None:
        """Let the others run; called by the actor's thread."""
        self._paused.release()
        self._go.acquire()
        if self.killed:
            raise Killed

    def _run(self) -> None:
        self._go.acquire()
        try:
            if not self.killed:
                self._target()
        except Killed:
            pass
        except BaseException as error:  # noqa: BLE001 - raised again in ``resume``
            self.error = error
        finally:
            self.ended = True
            self._paused.release()


class VirtualTime:
    """A monotonic clock (call it), a wall clock, and scheduled events. One thread owns it and calls ``run``."""

    boot_id = 'a-boot'

    def __init__(self, rng: random.Random, wall_ns: int) -> None:
        self.now = 0.0
        self._rng = rng
        self._began_ns = wall_ns
        self._events: list[tuple[float, float, int, Callable[[], None]]] = []
        self._count = 0
        self._current: Actor | None = None
        self._resting: list[tuple[Actor, Schedule, Rest]] = []
        self._actors: list[Actor] = []

    def __call__(self) -> float:
        return self.now

    def wall_ns(self) -> int:
        return self._began_ns + round(self.now * SECOND)

    def boot_ns(self) -> int:
        return round(self.now * SECOND)

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run it then; events at the same time run in random order."""
        self._count += 1
        heapq.heappush(self._events, (self.now + seconds, self._rng.random(), self._count, action))

    def start(self, name: str, target: Callable[[], None]) -> Actor:
        actor = Actor(self, name, target)
        self._actors.append(actor)
        self._wake(actor, 0.0)
        return actor

    def kill(self, actor: Actor) -> None:
        """Cancel it."""
        actor.killed = True
        if not actor.ended:
            actor.resume()

    def end(self) -> None:
        """Kill all remaining actors."""
        for actor in self._actors:
            self.kill(actor)

    def run(self, until: Callable[[], bool], most_s: float) -> bool:
        """Let time pass until the condition is true; False if it is not after this many seconds."""
        end = self.now + most_s
        while not until():
            if not self._events or self._events[0][0] > end:
                self.now = end
                return until()
            self.now, _, _, action = heapq.heappop(self._events)
            action()
            self._notice_changes()
        return True

    # -- called by actors ------------------------------------------------------------------------------------------

    def sleep(self, seconds: float) -> None:
        actor = self._actor()
        self._wake(actor, seconds)
        actor.pause()

    def rest_on(self, schedule: Schedule) -> Callable[[Rest], None]:
        """As ``schedule.rest``, in virtual time."""

        def rest(rest: Rest) -> None:
            if schedule._version != rest.version:
                return
            actor = self._actor()
            entry = (actor, schedule, rest)
            self._resting.append(entry)
            self.after(rest.seconds, lambda: self._over(entry))
            actor.pause()

        return rest

    # -- inside ----------------------------------------------------------------------------------------------------

    def _actor(self) -> Actor:
        assert self._current is not None, 'no actor runs'
        return self._current

    def _wake(self, actor: Actor, seconds: float) -> None:
        self.after(seconds, lambda: self._resume(actor))

    def _resume(self, actor: Actor) -> None:
        if actor.ended:
            return
        self._current = actor
        try:
            actor.resume()
        finally:
            self._current = None

    def _over(self, entry: tuple[Actor, Schedule, Rest]) -> None:
        if entry in self._resting:
            self._resting.remove(entry)
            self._resume(entry[0])

    def _notice_changes(self) -> None:
        """Resume actors that wait for something that has changed."""
        for entry in [entry for entry in self._resting if entry[1]._version != entry[2].version]:
            self._resting.remove(entry)
            self._wake(entry[0], 0.0)


class VirtualLock:
    """A lock whose waiting takes virtual time."""

    def __init__(self, time: VirtualTime) -> None:
        self._time = time
        self._held = False

    def __enter__(self) -> None:
        while self._held:
            self._time.sleep(0.01)
        self._held = True

    def __exit__(self, *_: object) -> None:
        self._held = False
