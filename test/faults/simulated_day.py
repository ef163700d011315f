"""One bad day of delivery in virtual time, by a seed: the real Uploader, Schedule, S3Store and Spool over a simulated wire.

Nothing really waits: only the clock, the pauses and the network are simulated. A repeated day is identical down to the last
request, so a seed is a bug report. Forbidden outcomes are raised as AssertionError.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final
from unittest import mock

from faults.kinds import FAULTS, Condition, Fault, Script
from faults.report import Report
from faults.simulated_s3 import LATEST_S, Line, Server
from faults.virtual_time import Actor, VirtualLock, VirtualTime
from spool.making import NOON_NS, assert_whole, put, rows

from shadowhound_data_logger.core.config import SpoolSettings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import DataObject, ObjectInfo, Outcome, State
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores import s3_puts
from shadowhound_data_logger.stores.s3 import S3Store

BUCKETS: Final = ('sensor-data', 'trajectories')
COMMIT_S: Final = 0.25
DAY_S: Final = 86_400.0
PRODUCING_S: Final = 120.0
CALM_S: Final = 900.0
"""The time after the last fault within which everything is delivered: a backoff of a minute, and a second one."""
MAX_THREADS: Final = 4
FOREIGN: Final = b'of another writer'


def _ever(step: Callable[[], None]) -> Callable[[], None]:
    """Run as a Worker that is never stopped; a defect ends the day."""

    def work() -> None:
        while True:
            step()

    return work


class Process:
    """One process of a logger on a spool, from its start to a kill or a stop."""

    def __init__(self, time: VirtualTime, root: Path, line: Line, rng: random.Random) -> None:
        self.spool = Spool(root, SpoolSettings(min_free_bytes=0), time, 'thor')
        self.spool.open()
        self._time = time
        self._line = line
        self._outcomes: list[Outcome] = []
        self._committing = False
        self._settled: set[int] = set()
        self._alive = True
        upload = UploadSettings(threads=rng.randint(1, MAX_THREADS))
        store = S3Store(StoreSettings(endpoint_url='http://simulated'), upload)
        parts: Any = store
        parts._client = parts._s3 = parts._puts._s3 = parts._puts._buckets._s3 = line
        parts._puts._buckets._creating = VirtualLock(time)
        self.uploader = Uploader(self.spool, store, upload, self._settle, monotonic=time, rng=rng)
        parts = self.uploader
        parts._schedule.rest = time.rest_on(parts._schedule)
        parts._schedule.activate(True)
        self._actors: list[Actor] = [time.start(f'upload-{n}', _ever(parts._round)) for n in range(upload.threads)]
        self._schedule = parts._schedule

    def add(self, items: Sequence[DataObject]) -> None:
        """Commit them, and wake the drain."""
        if self._alive:
            self.uploader.wake(put(self.spool, *items))

    def kill(self) -> None:
        """Like ``kill -9``: requests in flight continue, memory is lost, nothing is closed properly."""
        self._end()
        parts: Any = self.spool
        parts._connections.writing.close()
        os.close(parts._session._lock)

    def stop(self) -> None:
        """Stop properly, with everything durable."""
        self._commit()
        self._schedule.stop()
        self._end()
        self.spool.close()

    def _end(self) -> None:
        self._alive = False
        for actor in self._actors:
            self._time.kill(actor)
        assert self.uploader.status().worker_failures == 0, self.uploader.status().last_error

    def _settle(self, outcomes: Sequence[Outcome]) -> None:
        """As the SpoolWriter: durable a little later. No object may be delivered without being stored, or sent again."""
        for outcome in outcomes:
            assert outcome.item.id not in self._settled, f'{outcome.item.key} is settled twice'
            self._settled.add(outcome.item.id)
            if outcome.state is State.DELIVERED:
                assert self._line.server.holds(outcome.item), f'{outcome.item.key} is called delivered and is not there'
        self._outcomes += outcomes
        if not self._committing:
            self._committing = True
            self._time.after(COMMIT_S, self._commit)

    def _commit(self) -> None:
        self._committing = False
        if self._alive and self._outcomes:
            outcomes, self._outcomes = self._outcomes, []
            self.spool.commit((), outcomes)
            self.uploader.settled([outcome.item.id for outcome in outcomes])


class Day:
    """New; run once."""

    def __init__(self, seed: int, folder: Path, kinds: Sequence[Fault] = FAULTS) -> None:
        self._rng = random.Random(seed)
        self._root = folder / 'spool'
        self._time = VirtualTime(self._rng, NOON_NS)
        self._server = Server(self._rng.choice((Condition.HONOURED, *Condition)))
        self._server.buckets = set(BUCKETS[: self._rng.randint(0, 2)])
        if self._server.condition is Condition.OVERWRITES:
            kinds = [kind for kind in kinds if kind is not Fault.DENIED]  # without a check it could not be detected
        self._script = Script.of(self._rng, self._rng.randint(1, 12), kinds)
        self._line = Line(self._time, self._server, self._script, self._rng)
        self._bodies: dict[tuple[str, str], bytes] = {}
        self._theirs: set[tuple[str, str]] = set()
        self._report = Report(seed, self._server.condition)
        self._process = self._begin()
        self._to_come = 0

    def run(self) -> Report:
        with ExitStack() as opened:
            opened.enter_context(mock.patch.object(s3_puts, 'time', SimpleNamespace(monotonic=self._time)))  # for its pauses
            opened.callback(self._time.end)
            self._plan()
            self._drain()
            self._put_back()
            self._check()
        report = self._report
        report.requests, report.repeated = self._line.requests, self._server.repeated.total()
        report.faults, report.lasted_s = self._script.counts, self._time.now
        return report

    # -- what happens ----------------------------------------------------------------------------------------------------

    def _plan(self) -> None:
        """Objects in groups over some minutes, foreign keys, and up to two kills."""
        number = 0
        groups, kills = self._rng.randint(2, 8), self._rng.randint(0, 2)
        self._to_come = groups + kills
        for _ in range(groups):
            group = [self._object(number + index) for index in range(self._rng.randint(1, 8))]
            number += len(group)
            self._time.after(self._rng.choice((0.0, self._rng.uniform(0.0, PRODUCING_S))), partial(self._add, group))
        for where in self._rng.sample(sorted(self._bodies), min(self._rng.randint(0, 2), number)):
            if where[0] in self._server.buckets:
                self._server.objects[where] = FOREIGN, ObjectInfo(*where, len(FOREIGN), None)
                self._theirs.add(where)
        for _ in range(kills):
            self._time.after(self._rng.uniform(0.0, PRODUCING_S), self._kill)
        self._report.objects, self._report.foreign = number, len(self._theirs)

    def _object(self, number: int) -> DataObject:
        bucket = self._rng.choice(BUCKETS)
        body = b'%d ' % number + self._rng.randbytes(self._rng.choice((0, 100, 2_000, 60_000)))
        key = f'thor/odom/20251018/{number:06d}_odom.json'
        self._bodies[bucket, key] = body
        return DataObject(
            bucket=bucket, key=key, body=body, content_type='application/json', sensor='odom', topic='/odom', type='t', samples=1,
            t_start_ns=NOON_NS, t_end_ns=NOON_NS, priority=self._rng.randint(0, 9),
        )  # fmt: skip

    def _begin(self) -> Process:
        return Process(self._time, self._root, self._line, self._rng)

    def _add(self, group: Sequence[DataObject]) -> None:
        self._process.add(group)
        self._to_come -= 1

    def _kill(self) -> None:
        self._process.kill()
        self._process = self._begin()
        self._report.kills += 1
        self._to_come -= 1

    def _drain(self) -> None:
        """Run until no more objects come and none is pending or in flight; soon after the last fault."""
        self._time.run(lambda: not self._to_come and (self._script.is_over or self._is_drained()), DAY_S)
        assert self._time.run(self._is_drained, CALM_S), f'{self._process.spool.pending_count()} objects are not delivered'
        self._process.stop()
        self._time.run(lambda: False, LATEST_S)

    def _is_drained(self) -> bool:
        return self._process.spool.pending_count() == 0

    def _put_back(self) -> None:
        """Do what an operator must do about objects that were denied twice while others were accepted."""
        denied = [row for row in rows(self._root) if row['reason'] == 'access_denied']
        if not denied:
            return
        for row in denied:
            where = row['bucket'], row['key']
            assert self._line.denied[where] > 1
            ready = self._root.joinpath('ready', *where)
            ready.parent.mkdir(parents=True, exist_ok=True)
            self._root.joinpath('quarantine', 'access_denied', *where).rename(ready)
        self._report.put_back = len(denied)
        self._script.end()
        self._process = self._begin()
        self._drain()

    # -- invariants at the end -------------------------------------------------------------------------------------------

    def _check(self) -> None:
        """Everything is there once, under its key, with its content; foreign objects are unchanged; the ledger balances."""
        assert not self._server.overwritten
        held = {where: body for where, (body, _) in self._server.objects.items()}
        assert held == self._bodies | dict.fromkeys(self._theirs, FOREIGN)
        assert self._server.created == Counter(self._bodies.keys() - self._theirs)
        if self._server.condition is Condition.HONOURED and not self._script.counts[Fault.NO_CONDITION]:
            assert not self._server.repeated
        for row in rows(self._root):
            foreign = (row['bucket'], row['key']) in self._theirs
            assert (row['state'], row['reason']) == (('quarantined', 'foreign') if foreign else ('delivered', None))
        counts = assert_whole(self._root)['objects']
        assert counts['spooled'] == len(self._bodies)
        assert counts['delivered'] == len(self._bodies) - len(self._theirs)
