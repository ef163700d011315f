"""Prints the cost of finding the next object to upload with a long backlog, and how a backlog is shared while it drains.

Run it as ``python bench/backlog.py [--long] [--folder F] [--json]``; ``--long`` adds a million rows. Without it, it takes a
minute.

Claims: the real spool and schedule, no network. A claim is all steps until an object is chosen: from a cached list (``drain``),
or with a query of the spool each time, as when new objects keep arriving (``poll``), also while a bucket with almost all
objects rejects uploads (``blocked``). Shares: eight hours of the default profile wait, the profile continues, and a store
accepts ten objects per second; the clock is simulated.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from heapq import merge
from pathlib import Path
from statistics import median, quantiles
from time import thread_time
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import DEFAULT_SENSORS, SensorSettings, SpoolSettings
from shadowhound_data_logger.core.errors import BucketMissing
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject, State
from shadowhound_data_logger.shipping.ahead import IMPORTANT, OLDEST
from shadowhound_data_logger.shipping.schedule import Look, Schedule, Ship
from shadowhound_data_logger.spool.spool import Spool

NOON_NS: Final = 1_760_788_800 * SECOND
ROWS: Final = (1_000, 10_000, 100_000)
LONG_ROWS: Final = (*ROWS, 1_000_000)
CLAIMS: Final = 400
"""Fewer than the shortest backlog has."""
SETTLE_EVERY: Final = 25
WITH_FILES: Final = 800
"""Objects of each priority with files on the disk: more than are ever requested."""
THREADS: Final = 4
OUTAGE_S: Final = 8 * 3600
WATCHED_S: Final = 600.0
STORE_PER_S: Final = 10.0
"""Objects per second; the profile produces 6.1."""
Pending = Callable[..., list[SpooledObject]]


def profile() -> dict[str, tuple[int, float]]:
    """Sensor -> priority and objects per second of the default profile, without sensors that are sent on change."""
    sensors = [SensorSettings(name=name, **values) for name, values in DEFAULT_SENSORS.items()]
    return {
        sensor.name: (sensor.priority, SECOND / sensor.period_ns) for sensor in sensors if sensor.enabled and not sensor.on_change
    }


def arrivals(start_s: float, end_s: float) -> Iterator[tuple[float, str, int]]:
    """(time, sensor, priority) of each new object, in order."""

    def stream(name: str, priority: int, rate: float) -> Iterator[tuple[float, str, int]]:
        return ((number / rate, name, priority) for number in range(round(start_s * rate), round(end_s * rate)))

    return merge(*(stream(name, priority, rate) for name, (priority, rate) in profile().items()))


class Drain:
    """A schedule and its spool; a claimed object counts as delivered immediately, and the caller settles it."""

    def __init__(self, pending: Pending, monotonic: Callable[[], float]) -> None:
        self._pending = pending
        self.schedule = Schedule(THREADS, 60.0, monotonic, random.Random(1))
        self.schedule.activate(True)

    def claim(self) -> SpooledObject | None:
        """The next object, None if there is none."""
        while isinstance(step := self.schedule.step(), Look):
            important = self._pending(IMPORTANT, exclude=step.exclude, without=step.without)
            oldest = self._pending(OLDEST, exclude=step.exclude, oldest=True, without=step.without)
            self.schedule.found(important, oldest)
        return step.item if isinstance(step, Ship) else None


# -- claims ------------------------------------------------------------------------------------------------------------


def filled(root: Path, rows: int, bucket: str) -> Spool:
    """A spool with this many objects of the profile; as many files as are ever read."""
    spool = Spool(root, SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    lying: dict[int, int] = {}
    with spool._connections.transaction() as index:  # without syncing commits, which is not measured here
        for number, (_, sensor, priority) in enumerate(itertools.islice(arrivals(0.0, float(rows)), rows)):
            item = make(number, sensor, priority, bucket)
            index.states.insert(item, item.key, '0' * 64, State.PENDING, None, {'sha256': '0' * 64}, NOON_NS)
            lying[priority] = lying.get(priority, 0) + 1
            if lying[priority] <= WITH_FILES or number < WITH_FILES:
                path = root / 'ready' / item.bucket / item.key
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(item.body)
    return spool


def make(number: int, sensor: str, priority: int, bucket: str = 'sensor-data') -> DataObject:
    return DataObject(
        bucket=bucket, key=f'thor/{sensor}/20251018/{number:07d}.json', body=b'x', content_type='application/json', sensor=sensor,
        topic=None, type='t', samples=1, t_start_ns=NOON_NS, t_end_ns=NOON_NS, priority=priority,
    )  # fmt: skip


def claims(spool: Spool, *, poll: bool) -> list[float]:
    """CPU milliseconds of each of some hundred claims, without settling."""
    now = itertools.count()
    drain = Drain(spool.pending, lambda: next(now) * 1e-6)
    spent: list[float] = []
    done: list[SpooledObject] = []
    for _ in range(CLAIMS):
        if poll:
            drain.schedule.wake()
        began = thread_time()
        item = drain.claim()
        spent.append((thread_time() - began) * 1e3)
        assert item is not None
        drain.schedule.delivered(item)
        done.append(item)
        if len(done) == SETTLE_EVERY:
            settle(spool, drain.schedule, done)
    return spent


def blocked(spool: Spool) -> list[float]:
    """CPU milliseconds of polls while the bucket of the backlog rejects uploads, each for one object of another bucket."""
    now = itertools.count()
    drain = Drain(spool.pending, lambda: next(now) * 1e-6)
    item = drain.claim()
    assert item is not None
    drain.schedule.failed(item, BucketMissing('no such bucket'))
    spent: list[float] = []
    for number in range(50):
        spool.commit([make(number, 'summary', 9, 'trajectories')])
        drain.schedule.wake()
        began = thread_time()
        found = drain.claim()
        spent.append((thread_time() - began) * 1e3)
        assert found is not None
        if found.bucket == 'trajectories':
            drain.schedule.delivered(found)
            settle(spool, drain.schedule, [found])
        else:
            drain.schedule.failed(found, BucketMissing('no such bucket'))
    return spent


def settle(spool: Spool, schedule: Schedule, done: list[SpooledObject]) -> None:
    spool.commit((), [Outcome(item, State.DELIVERED) for item in done])
    schedule.settled([item.id for item in done])
    done.clear()


def measured(rows: int, folder: str | None) -> dict[str, float]:
    """p50 and p99 of each kind of claim, in milliseconds of CPU of this thread: other load does not count."""
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(dir=folder) as place:
        spool = filled(Path(place, 'spool'), rows, 'sensor-data')
        for name, spent in (
            ('look', claims(spool, poll=True)),
            ('drain', claims(spool, poll=False)),
            ('blocked', blocked(spool)),
        ):
            figures[f'{name}_p50_ms'], figures[f'{name}_p99_ms'] = median(spent), quantiles(spent, n=100)[98]
        spool.close()
    return figures


# -- shares ------------------------------------------------------------------------------------------------------------


class Waiting:
    """The waiting objects, in memory: by number, which is the order of time, and by priority."""

    def __init__(self) -> None:
        self.count = 0
        self._all: dict[int, SpooledObject] = {}
        self._by_priority: dict[int, dict[int, SpooledObject]] = {}

    def add(self, priority: int, created_s: float) -> SpooledObject:
        self.count += 1
        item = SpooledObject(self.count, 'b', f'{self.count}', Path(), 0, '', '', {}, priority, round(created_s * SECOND))
        self._all[item.id] = self._by_priority.setdefault(priority, {})[item.id] = item
        return item

    def remove(self, item: SpooledObject) -> None:
        del self._all[item.id], self._by_priority[item.priority][item.id]

    def pending(self, limit: int, *, exclude: Collection[int] = (), oldest: bool = False,
                without: Sequence[str] = ()) -> list[SpooledObject]:  # fmt: skip
        assert not without
        queues = [self._all] if oldest else [self._by_priority[priority] for priority in sorted(self._by_priority)]
        found = (item for queue in queues for item in queue.values() if item.id not in exclude)
        return list(itertools.islice(found, limit))


def shares() -> dict[str, Any]:
    """What is delivered in the first ten minutes after eight hours, and how long new objects wait."""
    waiting, now, sensors = Waiting(), [float(OUTAGE_S)], {}
    for moment, sensor, priority in arrivals(0.0, OUTAGE_S):
        sensors[waiting.add(priority, moment).id] = sensor
    backlog = waiting.count
    drain = Drain(waiting.pending, lambda: now[0])
    live = arrivals(OUTAGE_S, OUTAGE_S + WATCHED_S)
    coming = next(live, None)
    waited: dict[str, list[float]] = {name: [] for name in profile()}
    old = 0
    while now[0] < OUTAGE_S + WATCHED_S:
        while coming and coming[0] <= now[0]:
            item = waiting.add(coming[2], coming[0])
            sensors[item.id] = coming[1]
            drain.schedule.wake([item])
            coming = next(live, None)
        claimed = drain.claim()
        now[0] += 1.0 / STORE_PER_S
        if claimed is None:
            continue
        drain.schedule.delivered(claimed)
        waiting.remove(claimed)
        drain.schedule.settled([claimed.id])
        if claimed.id <= backlog:
            old += 1
        else:
            waited[sensors[claimed.id]].append(now[0] - claimed.created_ns / SECOND)
    new = sum(len(times) for times in waited.values())
    return {
        'backlog': backlog, 'old delivered': old, 'new made': waiting.count - backlog, 'new delivered': new,
        'new of each': {name: len(times) for name, times in waited.items()},
        'their wait p50_s': {name: round(median(times), 1) if times else None for name, times in waited.items()},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--long', action='store_true', help='a million rows as well')
    parser.add_argument('--folder', help='where to make the spools')
    parser.add_argument('--json', action='store_true')
    arguments = parser.parse_args()
    result: dict[int, dict[str, float]] = {}
    for rows in LONG_ROWS if arguments.long else ROWS:
        result[rows] = measured(rows, arguments.folder)
        if not arguments.json:
            ratios = {name: value / result[ROWS[0]][name] for name, value in result[rows].items()}
            print(f'{rows:9,} rows', *(f'{name} {value:.3f} ({ratios[name]:.2f})' for name, value in result[rows].items()),
                  sep='  ', flush=True)  # fmt: skip
    served = shares()
    if arguments.json:
        print(json.dumps({'claims': result, 'shares': served}))
        return
    print('in brackets: the ratio to', f'{ROWS[0]:,}', 'rows')
    print(*(f'{name}: {value}' for name, value in served.items()), sep='\n')


if __name__ == '__main__':
    main()
