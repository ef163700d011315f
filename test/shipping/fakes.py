"""A spool that is a dict, and a clock that the test moves."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from shadowhound_data_logger.core.model import Outcome, SpooledObject, State
from shadowhound_data_logger.shipping.uploader import Uploader


class FakeSpool:
    """The part of the spool that Uploader uses, including outcomes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.items: dict[int, SpooledObject] = {}
        self.outcomes: list[Outcome] = []
        self.looks = 0
        self.lock_is_free = True
        self.uploader: Uploader | None = None
        self._lock = threading.Lock()
        self._next = 1

    def add(self, count: int = 1, *, bucket: str = 'b', priority: int = 5, content: bytes = b'content') -> list[SpooledObject]:
        made = []
        for _ in range(count):
            number, self._next = self._next, self._next + 1
            path = self.folder / str(number)
            path.write_bytes(content)
            sha256 = hashlib.sha256(content).hexdigest()
            made.append(SpooledObject(number, bucket, f'k/{number}', path, len(content), sha256, 'text/plain',
                                      {'sha256': sha256}, priority, number))  # fmt: skip
        with self._lock:
            self.items.update((item.id, item) for item in made)
        return made

    def pending(self, limit: int, *, exclude: Collection[int] = (), oldest: bool = False,
                without: Sequence[str] = (), waiting_for: Collection[str] = ()) -> list[SpooledObject]:  # fmt: skip
        with self._lock:
            self.looks += 1
            found = [item for item in self.items.values() if item.id not in exclude and item.bucket not in without]
        found = [item for item in found if item.waits_for not in waiting_for]
        return sorted(found, key=lambda item: item.id if oldest else (item.priority, item.id))[:limit]

    def pending_count(self) -> int:
        return len(self.items)

    @contextmanager
    def drain_lock(self) -> Iterator[bool]:
        yield self.lock_is_free

    def settle(self, outcomes: Sequence[Outcome]) -> None:
        """Durable immediately, as after a group commit."""
        with self._lock:
            self.outcomes += outcomes
            for outcome in outcomes:
                self.items.pop(outcome.item.id, None)
        if self.uploader:
            self.uploader.settled([outcome.item.id for outcome in outcomes])

    def ended_as(self, state: State) -> list[int]:
        with self._lock:
            return sorted(outcome.item.id for outcome in self.outcomes if outcome.state is state)


class Time:
    """A clock in seconds that advances only when the test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait for something that another thread does; a missed deadline is a failure."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, 'it did not happen in time'
        time.sleep(0.005)
