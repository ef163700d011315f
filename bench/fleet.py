"""A fleet's rows in one lake: ingest, merge and queries on an embedded S3 server, by the number of robots.

Run it as ``python bench/fleet.py [--robots 1000] [--rows 20000] [--minutes 30] [--folder F] [--json]``: each robot has this many
objects on one day, their rows in files of this many minutes (robots write one per minute), and a gap for every tenth object. The
tables are in the bucket ``lake``. While one process ingests, merges and expires, another one queries a robot repeatedly, and must
see each of its rows exactly once every time. Kills are tested in ``torture.lake``.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import resource
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from datetime import datetime, timedelta, timezone
from functools import partial
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Final

import boto3
import obstore
import pyarrow as pa
from _report import Bar, Report, main, progress
from obstore.store import S3Store
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows import gaps as journal
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest, maintain
from shadowhound_data_logger.lake.tables import OBJECT_ROWS, Tables

DAY_NS: Final = 1_790_812_800 * SECOND
"""2026-10-01T00:00:00Z."""
ROUNDS: Final = 5
LOW: Final = 'battery_pct < 30'
GAP_EVERY: Final = 10
SENSORS: Final = ('camera', 'lidar', 'odom', 'imu', 'states')


def rows(robot: str, number: int, count: int, of_day: int) -> Iterator[catalog.Row]:
    """``count`` rows from the ``number``-th of the day on, out of ``of_day``: evenly over 24 hours."""
    step_ns = 86_400 * SECOND // of_day
    for place in range(number, number + count):
        stamp_ns = DAY_NS + place * step_ns
        sensor = SENSORS[place % len(SENSORS)]
        micros = stamp_ns // 1000
        yield {
            **dict.fromkeys(catalog.COLUMNS), 'robot': robot, 'sensor': sensor, 'topic': f'/{sensor}', 'bucket': catalog.BUCKET,
            'type': 'sensor_msgs/msg/Imu', 'key': f'{robot}/{sensor}/{utc(stamp_ns):%Y%m%d/%H%M%S}_{place:06d}.json',
            'bytes': 1000 + place % 977, 'sha256': hashlib.sha256(f'{robot} {place}'.encode()).hexdigest(),
            't_start': micros, 't_end': micros, 't_start_ns': stamp_ns,
            't_end_ns': stamp_ns, 'count': 1, 'x': place % 100 / 10, 'y': place % 70 / 10, 'yaw': 0.0, 'pose_frame': 'odom',
            'battery_pct': 100 - place * 80 / of_day, 'clock': 'synced', 'content_type': 'application/json',
            'format_version': catalog.FORMAT_VERSION, 'received_start_ns': stamp_ns, 'received_end_ns': stamp_ns,
        }  # fmt: skip


def deliver(settings: StoreSettings, of_day: int, minutes: int, number: int) -> tuple[int, int, int]:
    """All row files of one robot; returns files, rows, bytes."""
    bare = _bare(settings)
    robot = f'robot{number:04d}'
    per_file = max(1, of_day * minutes // 1440)
    found = [0, 0, 0]

    def put(of: catalog.TableSchema, name: str, body: bytes, count: int) -> None:
        obstore.put(bare, of.part_key(robot, f'{utc(DAY_NS):%Y-%m-%d}', name), body)
        for place, value in enumerate((1, count, len(body))):
            found[place] += value

    for start in range(0, of_day, per_file):
        made = list(rows(robot, start, min(per_file, of_day - start), of_day))
        put(catalog.OBJECTS, f'{robot}_{start:06d}', parts.encode(made), len(made))
        lost = [
            journal.statement(
                robot, journal.GAP, f'{start + place}', 1, sink='objects', topic='/imu', kind='missed', cause='transport',
                from_ns=row['t_start_ns'], to_ns=row['t_start_ns'] + SECOND, count=1, grade='exact',
            )
            for place, row in enumerate(made) if place % GAP_EVERY == 0
        ]  # fmt: skip
        put(GAPS, f'{robot}_{start:06d}', parts.encode(lost, GAPS), len(lost))
    return found[0], found[1], found[2]


def measure(options: argparse.Namespace) -> Report:
    folder: Path = options.folder / 'fleet'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with Tower(folder / 'tower') as tower:
        settings = tower.store_settings()
        with closing(boto3.client(
            's3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
            aws_secret_access_key=settings.secret_access_key, region_name=settings.region,
        )) as client:  # fmt: skip
            for name in (catalog.BUCKET, 'lake'):
                client.create_bucket(Bucket=name)
        report = _measured(settings, options)
    shutil.rmtree(folder, ignore_errors=True)
    return report


def _measured(settings: StoreSettings, options: argparse.Namespace) -> Report:
    began = time.perf_counter()
    done = [0, 0, 0]
    with ProcessPoolExecutor(2) as pool:
        for each in pool.map(partial(deliver, settings, options.rows, options.minutes), range(options.robots)):
            done = [before + more for before, more in zip(done, each, strict=True)]
            progress(f'{done[0]:,} row files, {done[1]:,} rows')
    figures: dict[str, Any] = {
        'robots': options.robots, 'row_files': done[0], 'rows': done[1], 'row_file_bytes': done[2],
        'deliver_s': round(time.perf_counter() - began, 1),
    }  # fmt: skip
    source = Bucket(settings, catalog.BUCKET)
    tables = Tables.for_ingest(source)
    one = f'robot{options.robots // 2:04d}'
    context = multiprocessing.get_context('spawn')
    is_over, heard = context.Event(), context.Queue()
    reader = context.Process(target=_read_on, args=(settings, one, options.rows, is_over, heard))
    reader.start()
    try:
        figures |= _ingested(source, tables)
    finally:
        is_over.set()
        took_s = heard.get()
        reader.join()
    if reader.exitcode:
        raise SystemExit('the reader saw a row twice, or not at all')
    figures['queries_meanwhile'] = len(took_s)
    figures['query_meanwhile_s'] = {'median': statistics.median(took_s), 'max': max(took_s)}
    is_whole = figures['ingested'] == done[1]
    bar = Bar('every row is in the tables once', f'{done[1]:,}', float(figures['ingested']), 'rows', is_whole)
    return Report((bar,), figures | _asked(source, options, one))


def _read_on(settings: StoreSettings, robot: str, count: int, is_over: Event, heard: Queue[list[float]]) -> None:
    """In a separate process; exits with an error if a query does not see each row of the robot exactly once."""
    source, took_s = Bucket(settings, catalog.BUCKET), list[float]()
    try:
        while not took_s or not is_over.is_set():
            seconds, found = _timed(lambda: query.sql(
                'SELECT count(*) AS n, count(DISTINCT key) AS keys FROM objects', source, robot=robot).to_pylist())  # fmt: skip
            if found != [{'n': count, 'keys': count}]:
                raise SystemExit(f'{robot}: {found}, not {count}')
            took_s.append(seconds)
    finally:
        heard.put(took_s)


def _ingested(source: Bucket, tables: Tables) -> dict[str, Any]:
    seconds, found = _timed(lambda: ingest(source, tables, Findings()))
    figures = {'ingest_s': seconds, 'ingest_rows_per_s': round(found.rows / seconds), 'ingested': found.rows}
    figures['ingester_peak_mb'] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000)
    progress(f'ingested {found.rows:,} rows in {seconds} s')
    figures |= _files(tables, 'ingested_')
    figures['merge_s'], tended = _timed(lambda: maintain(source, tables, Findings()))
    figures['merged_files'] = tended.merged
    figures |= _files(tables, 'merged_')
    progress(f'merged {tended.merged:,} files in {figures["merge_s"]} s')
    later = datetime.now(timezone.utc) + timedelta(days=1)
    figures['expire_s'], tended = _timed(lambda: maintain(source, tables, Findings(), now=later))
    figures['expired_row_files'] = tended.expired
    progress(f'{tended.expired:,} row files expired in {figures["expire_s"]} s')
    return figures


def _asked(source: Bucket, options: argparse.Namespace, one: str) -> dict[str, Any]:
    """The seconds of each query, in each round."""
    figures: dict[str, Any] = {}
    day: dict[str, Any] = {'since': utc(DAY_NS), 'until': utc(DAY_NS + 86_400 * SECOND)}
    questions: dict[str, tuple[Callable[[], Any], int]] = {
        'one robot, one day, near a point, battery low': (
            lambda: len(query.objects(source, robot=one, columns=('key',), near=(3.0, 2.0, 1.0), where=LOW, **day)),
            sum(
                (row['x'] - 3) ** 2 + (row['y'] - 2) ** 2 <= 1 and row['battery_pct'] < 30
                for row in rows(one, 0, options.rows, options.rows)
            ),
        ),
        'all robots, one day: objects of each sensor': (
            lambda: sum(query.sql('SELECT sensor, count(*) AS n FROM objects GROUP BY sensor', source, **day)['n'].to_pylist()),
            options.rows * options.robots,
        ),
        'all: bytes of each robot': (
            lambda: len(query.sql('SELECT robot, sum(bytes) AS n FROM objects GROUP BY robot', source)),
            options.robots,
        ),
        'all: gaps of each robot': (
            lambda: len(query.sql('SELECT robot, count(*) AS n FROM gaps GROUP BY robot', source)),
            options.robots,
        ),
    }  # fmt: skip
    for what, (ask, expected) in questions.items():
        rounds = []
        for _ in range(ROUNDS):
            took_s, answer = _timed(ask)
            if answer != expected:
                raise SystemExit(f'{what}: {answer}, not {expected}')
            rounds.append(took_s)
        progress(f'{what}: {statistics.median(rounds):.2f} s')
        figures[what] = rounds
    return figures


def _timed(ask: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    answer = ask()
    return round(time.perf_counter() - began, 3), answer


def _files(tables: Tables, name: str) -> dict[str, Any]:
    found = pa.table(tables.open(OBJECT_ROWS).get_add_actions(flatten=True))
    return {f'{name}files': len(found), f'{name}bytes': sum(found['size_bytes'].to_pylist())}


def _bare(settings: StoreSettings) -> S3Store:
    return S3Store(
        catalog.BUCKET, endpoint=settings.endpoint_url, access_key_id=settings.access_key_id, region=settings.region,
        secret_access_key=settings.secret_access_key, client_options={'allow_http': True},
    )  # fmt: skip


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--robots', type=int, default=1000, metavar='N', help='robots (default 1000)')
    parser.add_argument('--rows', type=int, default=20_000, metavar='N', help='rows of objects of each robot (default 20000)')
    parser.add_argument('--minutes', type=int, default=30, metavar='N', help='of rows in one file (default 30; robots: 1)')


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0.0, more=_more)
