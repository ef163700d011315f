"""Eight hours without the store: the backlog is delivered while the robot continues, fairly, and at the store's own pace.

The backlog is created directly in a spool, in the proportions and sizes of the default profile: 40,000 objects by default (eight
hours of it are 175,680). A separate process delivers it as the node does, while new objects arrive.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

from shadowhound_tower.embedded import Tower

from bench.drain import bare
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores import open_store
from torture._command import Check, parser, progress, verdict, workshop
from torture._profile import arrivals, make, receive

OBJECTS: Final = 40_000
SHORT_OBJECTS: Final = 2_000
GROUP: Final = 500
BARE_OBJECTS: Final = 2_000
SMALL: Final = ('odom', 'states')
LARGE: Final = ('camera', 'lidar')
FLAT_MB: Final = 16.0
MAX_MB: Final = 200.0
RATE: Final = 0.8
LIVE_S: Final = 10.0
"""An object that is made during the drain must be in the store within this, with few exceptions."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """One object, as confirmed by the store."""

    at_s: float
    sensor: str
    waited_s: float
    live: bool


@dataclass(frozen=True, slots=True)
class Drain:
    """A delivered backlog."""

    ticks: list[dict[str, float]]
    deliveries: list[Delivery]
    ledger: dict[str, Any]

    @property
    def seconds(self) -> float:
        return self.ticks[-1]['s']

    @property
    def rate(self) -> float:
        """Objects per second, old and new."""
        return self.ticks[-1]['delivered'] / self.seconds


def fill(root: Path, count: int) -> None:
    """Create the backlog, without syncs, which are not tested here."""
    spool = Spool(root, SpoolSettings(min_free_bytes=0, max_bytes=1 << 40), SystemClock.of_this_machine(), 'thor')
    with mock.patch('os.fsync'):
        spool.open()
        objects = objects_of_the_profile(count)
        while group := list(itertools.islice(objects, GROUP)):
            for item in group:
                receive(spool, item)
            spool.commit(group)
        spool.close()


def objects_of_the_profile(count: int) -> Iterator[DataObject]:
    """In order of time."""
    names = itertools.islice(arrivals(float(count)), count)
    return (make(sensor, f'{number:06d}') for number, (_, sensor) in enumerate(names))


def warm_up(folder: Path, tower: Tower) -> None:
    """The first put creates the bucket and the server's volumes."""
    spool = Spool(folder, SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    with closing(open_store(tower.store_settings(), UploadSettings())) as store:
        store.put(spool.commit([make('odom', 'warm')])[0])
    spool.close()


def deliver(folder: Path, environ: dict[str, str]) -> Drain:
    """In a separate process, whose memory is measured."""
    log = folder / 'deliveries'
    command = [sys.executable, '-m', 'torture._drainer', str(folder), str(log)]
    ticks = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **environ}) as child:
        assert child.stdout is not None
        for line in child.stdout:
            ticks.append(json.loads(line))
            if len(ticks) % 60 == 0:
                progress(f'{ticks[-1]["delivered"]} delivered in {ticks[-1]["s"]:.0f} s, {ticks[-1]["rss_mb"]} MB')
    if child.returncode:
        raise SystemExit(f'the delivering process ended with {child.returncode}')
    rows = [json.loads(line) for line in log.read_text(encoding='utf-8').splitlines()]
    start_ns = rows[0][0]
    deliveries = [Delivery((at - start_ns) / 1e9, sensor, (at - made) / 1e9, live) for at, sensor, _, made, live, _ in rows]
    return Drain(ticks, deliveries, ledger.read(folder / 'spool', 'thor'))


@contextmanager
def bare_rates(folder: Path, tower: Tower, count: int) -> Iterator[list[float]]:
    """The bare rate of the store, objects per second, before and after."""
    rates: list[float] = []
    for turn in range(2):
        objects = [make(sensor, f'bare-{turn}-{number:06d}') for number, (_, sensor) in enumerate(
            itertools.islice(arrivals(float(count)), count))]  # fmt: skip
        run = bare(folder, tower.store_settings(), UploadSettings().threads, objects)
        rates.append(count / run.seconds)
        if turn == 0:
            yield rates


def bars(drain: Drain, bare_rate: float, count: int) -> tuple[dict[str, Any], list[Check]]:
    """The results, and the requirements."""
    old = [delivery for delivery in drain.deliveries if not delivery.live]
    place = {sensor: statistics.median(n for n, each in enumerate(old) if each.sensor == sensor) / len(old) for sensor in
             {each.sensor for each in old}}  # fmt: skip
    half = old[: len(old) // 2]
    oldest_share = sum(each.sensor in LARGE for each in half) / max(sum(each.sensor in LARGE for each in old), 1)
    meanwhile = [each for each in drain.deliveries if each.live]
    in_time = sum(each.waited_s <= LIVE_S for each in meanwhile) / max(len(meanwhile), 1)
    rss = [tick['rss_mb'] for tick in drain.ticks[len(drain.ticks) // 5 :]]
    figures = {
        'objects': count, 'seconds': drain.seconds, 'per_s': round(drain.rate, 1), 'bare_per_s': round(bare_rate, 1),
        'ratio': round(drain.rate / bare_rate, 3), 'rss_mb': [drain.ticks[0]['rss_mb'], rss[0], max(rss), rss[-1]],
        'median_place': {sensor: round(value, 3) for sensor, value in sorted(place.items(), key=lambda pair: pair[1])},
        'large_in_the_first_half': round(oldest_share, 3), 'live': len(meanwhile), 'live_in_time': round(in_time, 3),
        'live_wait_s': {sensor: [round(statistics.median(waits), 2), round(max(waits), 2)] for sensor in sorted(place)
                        if (waits := [each.waited_s for each in meanwhile if each.sensor == sensor])},
    }  # fmt: skip
    objects = drain.ledger['objects']
    return figures, [
        Check('everything is delivered, once', objects['delivered'] == objects['spooled'] == len(drain.deliveries), str(objects)),
        Check('the ledger balances', not ledger.imbalances(drain.ledger)),
        Check('memory is flat', max(rss) - rss[0] <= FLAT_MB and max(rss) <= MAX_MB, str(figures['rss_mb'])),
        Check('small state topics go first', max(place[name] for name in SMALL) < min(place[name] for name in LARGE)),
        Check('the oldest do not starve', oldest_share >= 0.1, f'{oldest_share:.2f} of the large in the first half'),
        Check('what is new does not starve', in_time >= 0.9, f'{in_time:.2f} within {LIVE_S:g} s: {figures["live_wait_s"]}'),
        Check('the pace of the store', drain.rate >= RATE * bare_rate, f'{figures["ratio"]} of the bare rate'),
    ]


def campaign(folder: Path, count: int) -> tuple[dict[str, Any], list[Check]]:
    """Fill, drain, audit."""
    began = time.monotonic()
    fill(folder / 'spool', count)
    progress(f'{count} objects are spooled after {time.monotonic() - began:.0f} s')
    with Tower(folder / 'tower') as tower:
        environ = tower.environment()
        warm_up(folder / 'warm', tower)
        with bare_rates(folder, tower, min(BARE_OBJECTS, count)) as rates:
            drain = deliver(folder, environ)
        return bars(drain, statistics.mean(rates), count)


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('long_outage', __doc__ or '')
    options.add_argument('--objects', type=int, default=0, help=f'how many wait (default {OBJECTS})')
    given = options.parse_args(argv)
    count = given.objects or (SHORT_OBJECTS if given.short else OBJECTS)
    with workshop(given) as shop:
        figures, found = campaign(shop.folder, count)
        shop.passed = all(bar.holds for bar in found)
    if not given.json:
        for name, value in figures.items():
            print(f'{name}: {value}')
    return verdict(figures, found, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
