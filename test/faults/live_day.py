"""One bad day of delivery over real sockets: a real spool, its writer, the uploader and the S3 store, a proxy, a real server.

The seed determines the objects, the kills and the faults by order of arrival; which thread's request arrives first depends on
the machine, so a seed repeats the conditions, not each step. Forbidden outcomes are raised as AssertionError.
"""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from faults.front import Front
from faults.kinds import FAULTS, Condition, Fault, Script
from faults.report import Report
from spool.making import NOON_NS, assert_whole, receive, rows
from stores.spooled import Spool as Spooled

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import DataObject, Put
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores.s3 import S3Store

BUCKET: Final = 'bad-days'
FOREIGN: Final = b'of another writer'
UPLOAD: Final = UploadSettings(threads=3, connect_timeout_s=0.5, read_timeout_s=0.3, max_backoff_s=0.05)
COMMIT_S: Final = 0.02
DEADLINE_S: Final = 60.0
SIZES: Final = (0, 100, 700, 2000)
"""At 1 KB/s the largest ones arrive long after the read timeout."""


class Process:
    """One process with the stages behind the encoders, connected as in the node."""

    def __init__(self, root: Path, settings: StoreSettings, seed: int) -> None:
        self.spool = Spool(root, SpoolSettings(min_free_bytes=0), SystemClock('a-boot'), 'thor')
        self.spool.open()
        self.store = S3Store(settings, UPLOAD)
        self.store.open()
        self.writer = SpoolWriter(self.spool, COMMIT_S)
        self.uploader = Uploader(self.spool, self.store, UPLOAD, self.writer.settle, rng=random.Random(seed))
        self.writer.on_commit(spooled=self.uploader.wake, settled=self.uploader.settled)
        self.writer.open()
        self.uploader.open()

    def add(self, items: Sequence[DataObject]) -> None:
        for item in items:
            receive(self.spool, item.samples, item.topic or '')
            self.writer.put(item)

    def close(self) -> None:
        """Stop, whatever is in progress; idempotent."""
        self.uploader.close(0.05)
        assert self.writer.close(60)
        self.store.close()
        self.spool.close()
        assert self.uploader.status().worker_failures == 0, self.uploader.status().last_error


class Day:
    """New; run once. ``settings`` are the server's, ``direct`` a store without the proxy; keys start with a folder's name."""

    def __init__(self, seed: int, folder: Path, settings: StoreSettings, direct: S3Store) -> None:
        self._rng = random.Random(seed)
        self._root = folder / 'spool'
        self._direct = direct
        self._settings = settings
        self._name = folder.name
        condition = self._rng.choice((Condition.HONOURED, *Condition))
        kinds = [kind for kind in FAULTS if kind is not Fault.DENIED or condition is not Condition.OVERWRITES]
        self._script = Script.of(self._rng, self._rng.randint(3, 6), kinds)
        self._front = Front(settings.endpoint_url or '', self._script, secret=settings.secret_access_key or '',
                            condition=condition, seed=seed)  # fmt: skip
        self._bodies: dict[str, bytes] = {}
        self._theirs: set[str] = set()
        self._report = Report(seed, condition)

    def run(self) -> Report:
        began = time.monotonic()
        with self._front, ExitStack() as closing:
            groups = [self._group(number) for number in range(self._rng.randint(3, 5))]
            self._take_keys()
            process = self._begin()
            closing.callback(lambda: process.close())  # noqa: PLW0108
            for group in groups:
                process.add(group)
                if self._rng.random() < 0.3:
                    process.close()
                    process = self._begin()
                    self._report.kills += 1
                time.sleep(self._rng.uniform(0.0, 0.2))
            self._until(lambda: process.writer.flush(1.0) and process.spool.pending_count() == 0)
            process.close()
            if self._put_back():
                process = self._begin()
                self._until(lambda: process.spool.pending_count() == 0)
            self._until(lambda: self._front.is_quiet)
        self._check()
        report = self._report
        report.faults, report.requests = self._script.counts, self._script.counts.total()
        report.lasted_s = time.monotonic() - began
        return report

    # -- what happens ------------------------------------------------------------------------------------------------

    def _begin(self) -> Process:
        return Process(self._root, replace(self._settings, endpoint_url=self._front.url), self._rng.randrange(1 << 30))

    def _group(self, number: int) -> list[DataObject]:
        return [self._object(f'{self._name}/{number}/{index:06d}_odom.json') for index in range(self._rng.randint(2, 8))]

    def _object(self, key: str) -> DataObject:
        self._bodies[key] = key.encode() + self._rng.randbytes(self._rng.choice(SIZES))
        return DataObject(
            bucket=BUCKET, key=key, body=self._bodies[key], content_type='application/json', sensor='odom', topic='/odom',
            type='t', samples=1, t_start_ns=NOON_NS, t_end_ns=NOON_NS, priority=self._rng.randint(0, 9),
        )  # fmt: skip

    def _take_keys(self) -> None:
        """Put foreign objects under some keys."""
        self._theirs = set(self._rng.sample(sorted(self._bodies), self._rng.randint(0, 2)))
        made = Spooled(self._root.parent, BUCKET)
        for key in self._theirs:
            assert self._direct.put(made(key, FOREIGN)) is Put.CREATED
        self._report.objects, self._report.foreign = len(self._bodies), len(self._theirs)

    def _put_back(self) -> int:
        """Do what an operator must do about objects that were denied twice while others were accepted."""
        denied = [row['key'] for row in rows(self._root) if row['reason'] == 'access_denied']
        for key in denied:
            assert self._front.denied[f'/{BUCKET}/{key}'] > 1
            ready = self._root / 'ready' / BUCKET / key
            ready.parent.mkdir(parents=True, exist_ok=True)
            (self._root / 'quarantine' / 'access_denied' / BUCKET / key).rename(ready)
        if denied:
            self._script.end()
        self._report.put_back = len(denied)
        return len(denied)

    def _until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end, f'not within {DEADLINE_S:g} s'
            time.sleep(0.01)

    # -- invariants at the end -------------------------------------------------------------------------------------

    def _check(self) -> None:
        """Everything is there once, under its key, with its content; foreign objects are unchanged; the ledger balances."""
        held = {info.key: self._direct.get(BUCKET, info.key) for info in self._direct.list(BUCKET, f'{self._name}/')}
        wanted = self._bodies | dict.fromkeys(self._theirs, FOREIGN)
        differing = sorted(key for key in held | wanted if held.get(key) != wanted.get(key))
        assert not differing, [(row['key'], row['state'], row['reason']) for row in rows(self._root) if row['key'] in differing]
        for key, body in self._bodies.items():
            taken = self._front.stored.get(f'/{BUCKET}/{key}', [])
            ours = hashlib.sha256(body).hexdigest()
            assert set(taken) == (set() if key in self._theirs else {ours}), f'{key} was written as {taken}'
            self._report.repeated += len(taken[1:])
        if self._report.condition is Condition.HONOURED and not self._script.counts[Fault.NO_CONDITION]:
            assert not self._report.repeated
        for row in rows(self._root):
            ends = ('quarantined', 'foreign') if row['key'] in self._theirs else ('delivered', None)
            assert (row['state'], row['reason']) == ends, row['key']
        counts = assert_whole(self._root)['objects']
        assert counts['spooled'] == len(self._bodies)
        assert counts['delivered'] == len(self._bodies) - len(self._theirs)
