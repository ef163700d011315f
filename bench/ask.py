"""Ten queries about values in the data and about texts, on tables of a million rows.

Run it as ``python bench/ask.py [--objects 1000000] [--missions 100000] [--folder F] [--json]``. The objects are batches of one
second of an IMU; a few of them contain a bump, and only those are in the store, a folder: the others are never opened. The
answers are compared with what was generated. Two of the queries are also run as commands, including the startup of Python.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import sqlite3
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
import orjson
import pyarrow as pa
from _report import Bar, Report, main, progress

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET, FORMAT_VERSION, OBJECTS, TableSchema
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.formats.statistics import FieldStatistics, numbers_of
from shadowhound_data_logger.lake import search, values
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import maintain
from shadowhound_data_logger.lake.select import wanted
from shadowhound_data_logger.lake.tables import TABLES, Tables, arrow_schema
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

FIRST_NS: Final = 1_790_812_800 * SECOND
"""2026-10-01T00:00:00Z."""
DAY: Final = 86_400
EVERY: Final = 20_000
"""One of this many objects contains a bump."""
MESSAGES: Final = 50
FIELDS: Final = ('accelerometer.0', 'accelerometer.1', 'accelerometer.2', 'temperature')
VALUE_S, WORDS_S = 1.0, 0.1
ROUNDS: Final = 3
PLACES: Final = ('kitchen', 'cellar', 'hall', 'garden', 'garage', 'stairs', 'office', 'attic')
THINGS: Final = ('door', 'window', 'handle', 'valve', 'meter', 'shelf', 'box', 'lamp')


def batch(number: int) -> list[dict[str, Any]]:
    """The messages of an object: at rest, or with a bump in the middle."""
    rng = random.Random(number)
    found = []
    for place in range(MESSAGES):
        bump = 20.0 + number % 7 if number % EVERY == EVERY // 2 and 20 <= place < 25 else 0.0
        found.append({'accelerometer': [rng.gauss(0, 0.1), rng.gauss(0, 0.1), 9.8 + rng.gauss(0, 0.1) + bump],
                      'temperature': 30 + number % DAY / DAY * 20})  # fmt: skip
    return found


def fill(settings: StoreSettings, store: ObjectStore, folder: Path, objects: int) -> tuple[int, int]:
    """The tables of all days, one file each; returns the bytes of the objects and of the statistics."""
    source = Bucket(settings, BUCKET)
    tables = Tables.for_ingest(source)
    for start in range(0, objects, DAY):
        numbers = np.arange(start, min(start + DAY, objects))
        rows, report = _rows(numbers), _statistics(store, folder, numbers)
        date = f'{utc(FIRST_NS + start * SECOND):%Y-%m-%d}'
        for of, made in ((OBJECTS, rows), (STATISTICS, report)):
            table = TABLES[of.folder]
            dated = made.add_column(0, 'date', pa.array([date] * len(made))).cast(table.schema)
            tables.append(tables.open(table), table, dated)
        progress(f'{min(start + DAY, objects):,} objects')
    maintain(source, tables, Findings())
    sizes = [pa.table(tables.open(TABLES[of.folder]).get_add_actions(flatten=True))['size_bytes'] for of in (OBJECTS, STATISTICS)]
    return sum(sizes[0].to_pylist()), sum(sizes[1].to_pylist())


def _key(number: int) -> str:
    return f'thor/imu/{utc(FIRST_NS + number * SECOND):%Y%m%d/%H%M%S}_imu.json'


def _body(number: int) -> bytes:
    begin_ns = FIRST_NS + number * SECOND
    return orjson.dumps({'robot': 'thor', 'samples': [{'stamp_ns': begin_ns + place * SECOND // MESSAGES, **message}
                                                      for place, message in enumerate(batch(number))]})  # fmt: skip


def _table(of: TableSchema, length: int, /, **columns: Any) -> pa.Table:
    schema = arrow_schema(of)
    return pa.table([pa.array(columns[field.name], field.type) if field.name in columns else pa.nulls(length, field.type)
                     for field in schema], schema=schema)  # fmt: skip


def _rows(numbers: np.ndarray[Any, Any]) -> pa.Table:
    count, begin = len(numbers), FIRST_NS + numbers * SECOND
    turn = begin / SECOND / 300 * 2 * np.pi
    last = begin + (MESSAGES - 1) * SECOND // MESSAGES
    return _table(
        OBJECTS, count, robot=['thor'] * count, sensor=['imu'] * count, topic=['/imu'] * count, bucket=[BUCKET] * count,
        key=[_key(int(number)) for number in numbers], bytes=np.full(count, 12_000), t_start=begin // 1000, t_end=last // 1000,
        t_start_ns=begin, t_end_ns=last, count=np.full(count, MESSAGES), x=6 * np.cos(turn), y=4 * np.sin(2 * turn),
        battery_pct=100 - numbers % DAY / DAY * 80, format_version=np.full(count, FORMAT_VERSION, np.int32),
        sha256=[hashlib.sha256(_body(int(number))).hexdigest() if number % EVERY == EVERY // 2 else '' for number in numbers],
    )  # fmt: skip


def _statistics(store: ObjectStore, folder: Path, numbers: np.ndarray[Any, Any]) -> pa.Table:
    """As the encoder writes them for the bumps, which are in the store; for the others generated from the same numbers."""
    from shadowhound_data_logger.core.model import SpooledObject  # noqa: PLC0415

    rng = np.random.default_rng(int(numbers[0]))
    count, begin = len(numbers), FIRST_NS + numbers * SECOND
    keys = [_key(int(number)) for number in numbers]
    tables = []
    for field in ('', *FIELDS):
        middle = {'accelerometer.2': 9.8, 'temperature': 0.0}.get(field, 0.0) + (
            30 + numbers % DAY / DAY * 20 if field == 'temperature' else 0
        )
        spread = 0.0 if field == 'temperature' else rng.uniform(0.1, 0.4, count)
        ends = {
            name: middle + sign * spread for name, sign in (('first', 0.2), ('last', -0.3), ('min', -1), ('max', 1), ('mean', 0))
        }
        columns: dict[str, Any] = {name: np.broadcast_to(value, count).copy() for name, value in ends.items()} if field else {}
        counts = np.full(count, MESSAGES)
        for place in np.flatnonzero(numbers % EVERY == EVERY // 2):
            body = _body(int(numbers[place]))
            collected = FieldStatistics()
            collected.add(orjson.loads(body)['samples'])
            if field:
                for name, value in zip(
                    ('first', 'last', 'min', 'max', 'mean'), numbers_of(collected.result()[field]), strict=False
                ):
                    columns[name][place] = value
            else:
                path = folder / 'body'
                path.write_bytes(body)
                digest = hashlib.sha256(body).hexdigest()
                store.put(SpooledObject(0, BUCKET, keys[place], path, len(body), digest, 'application/json', {}, 5, 0))
        columns |= {'field': [field] * count, 'count': counts, 'nan_count': np.zeros(count, np.int64)}
        tables.append(_table(
            STATISTICS, count, robot=['thor'] * count, sensor=['imu'] * count, bucket=[BUCKET] * count, key=keys,
            t_start=begin // 1000, t_start_ns=begin, format_version=np.ones(count, np.int32), **columns,
        ))  # fmt: skip
    return pa.concat_tables(tables)


def words(path: Path, missions: int) -> None:
    """An index of this many missions, each with an event."""
    rng = random.Random(1)
    with search._opened(path, is_new=True) as db, db:
        for number in range(missions):
            thing, place = rng.choice(THINGS), rng.choice(PLACES)
            begin_ns = FIRST_NS + number * 60 * SECOND
            kind, reported = rng.choice(('patrol', 'explore', 'inspect')), f'look at the {thing} number {number % 977}'
            report = {
                'mission_id': f'm{number}', 'mission_type': kind, 'mission_command': f'go to the {place} and {reported}',
                'start_ns': begin_ns, 'end_ns': begin_ns + SECOND, 'success': number % 10 > 0, 'result': 'FINISHED',
                'errors': [{'error': f'lost sight of {number}'}] * (number % 10 == 0),
                'events': [{'name': f'{thing}_seen', 'distance_m': round(rng.uniform(0, 5), 2), 'place': place}],
            }  # fmt: skip
            search.add(db, search.of_mission('thor', f'r{number}', report))


def measure(options: argparse.Namespace) -> Report:
    folder = options.folder / 'ask'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    settings = StoreSettings(directory=folder / 'store')
    with closing(open_store(settings, UploadSettings())) as store:
        catalog_bytes, statistics_bytes = fill(settings, store, folder, options.objects)
    source = Bucket(settings, BUCKET)
    bumps = sum(number % EVERY == EVERY // 2 for number in range(options.objects))
    asked: dict[str, tuple[Callable[[], values.ValueAnswer], int | None]] = {
        'imu.accelerometer.2 > 15': (lambda: values.ranges('imu.accelerometer.2 > 15', source), bumps),
        'max(imu.accelerometer.2) > 15': (lambda: values.ranges('max(imu.accelerometer.2) > 15', source), bumps),
        'imu.accelerometer > 15, one day': (
            lambda: values.ranges('imu.accelerometer > 15', source, since='2026-10-02', until='2026-10-03'), None),
        'imu.accelerometer.2 > 24 or imu.accelerometer.0 < -5': (
            lambda: values.ranges('imu.accelerometer.2 > 35 or imu.accelerometer.0 < -5', source), None),
        'imu.temperature > 49.99': (lambda: values.ranges('imu.temperature > 49.99', source), None),
    }  # fmt: skip
    bars: list[Bar] = []
    figures: dict[str, Any] = {'objects': options.objects, 'catalog_bytes': catalog_bytes,
                               'statistics_bytes': statistics_bytes, 'values': [], 'words': []}  # fmt: skip
    for text, (ask, expected) in asked.items():
        took, answer = _timed(ask)
        if expected is not None and len(answer.ranges) != expected:
            raise SystemExit(f'{text} has {len(answer.ranges)} times, not {expected}')
        share = 100 * answer.opened / max(1, answer.objects)
        what = f'{text}: {answer.opened} of {answer.objects:,} objects opened ({share:.3g} %), {len(answer.ranges)} times'
        bars.append(Bar(what, f'under {VALUE_S:g}', statistics.median(took), 's', statistics.median(took) < VALUE_S, tuple(took)))
        figures['values'].append({'question': text, 's': took, 'opened': answer.opened, 'objects': answer.objects,
                                  'times': len(answer.ranges)})  # fmt: skip
    first = next(iter(asked))
    figures['values'][0]['command_s'] = _command_s(folder, 'query', '--when', first)
    path = folder / 'search.db'
    began = time.perf_counter()
    words(path, options.missions)
    figures |= {
        'missions': options.missions,
        'index_s': round(time.perf_counter() - began, 1),
        'index_bytes': path.stat().st_size,
    }
    for text, flags in (('kitchen door', {}), ('"door number 7"', {}), ('wind* kitchen', {}), ('door', {}),
                        ('lost sight', {'success': False, 'since': '2026-10-03'})):  # fmt: skip
        took, found = _timed(lambda text=text, flags=flags: search.search(path, text, wanted(0, **flags)))
        median = statistics.median(took)
        what = f'search {text}{words_of(flags)}: {len(found)} of {options.missions:,} missions'
        bars.append(Bar(what, f'under {WORDS_S:g}', median, 's', median < WORDS_S, tuple(took)))
        figures['words'].append({'question': f'{text}{words_of(flags)}', 's': took, 'found': len(found)})
    figures['words'][0]['command_s'] = _command_s(folder, 'search', 'kitchen', 'door', '--index', str(path))
    with closing(sqlite3.connect(path)) as db:
        figures['documents'] = db.execute('SELECT count(*) FROM documents').fetchone()[0]
    shutil.rmtree(folder, ignore_errors=True)
    return Report(tuple(bars), json.loads(json.dumps(figures)))


def words_of(flags: Mapping[str, Any]) -> str:
    """As on a command line."""
    return ''.join(' --failed' if name == 'success' else f' --{name} {value}' for name, value in flags.items())


def _command_s(home: Path, *arguments: str) -> list[float]:
    """Seconds from the start of Python to its exit."""
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *arguments, '--json']
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': ''}
    return _timed(lambda: subprocess.run(command, env=environ, check=True, capture_output=True))[0]


def _timed(ask: Callable[[], Any]) -> tuple[list[float], Any]:
    took = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        found = ask()
        took.append(round(time.perf_counter() - began, 3))
    return took, found


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--objects', type=int, default=1_000_000, help='rows of the catalog (default 1000000)')
    parser.add_argument('--missions', type=int, default=100_000, help='of the index of words (default 100000)')


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
