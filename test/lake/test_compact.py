"""Compaction makes files fewer and answers no different, at every moment of it, on a folder and on a real server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.parquet as pq
import pytest
from lake.making import NOON_NS, SENSORS, Watched, add_part, fill, folder_store, keys, row, watched

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, StoreUnavailable
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import schema
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.compact import Compacted, compact
from shadowhound_data_logger.lake.live_files import is_compacted
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

TODAY = datetime(2026, 10, 29, 15, tzinfo=timezone.utc)
LATER = datetime.now(timezone.utc) + timedelta(hours=2)
"""Of files that are written now, the grace is over."""
PLACE = {'near': (-6.0, 0.0, 1.0), 'sensor': 'camera'}


class Dead(Exception):
    """The process died here."""


class Mortal(Watched):
    """A source, or a store, of a process that dies at the nth thing that it does."""

    def __init__(self, inner: Any, life: list[int]) -> None:
        super().__init__(inner)
        self.life = life

    def _ask(self, verb: str, key: str) -> None:
        if self.life[0] == 0:
            raise Dead
        self.life[0] -= 1


class MortalStore:
    """Its puts are among the things that are done."""

    def __init__(self, inner: Any, life: list[int]) -> None:
        self.inner, self.life = inner, life

    def put(self, item: Any) -> Any:
        if self.life[0] == 0:
            raise Dead
        self.life[0] -= 1
        return self.inner.put(item)


def run(settings: StoreSettings, **how: Any) -> list[Compacted]:
    with closing(open_store(settings, UploadSettings())) as store:
        return list(compact(Bucket(settings, schema.BUCKET), store, **{'now': lambda: TODAY, 'before': '2026-10-29', **how}))


def files(settings: StoreSettings, date: str = '2026-10-28') -> list[str]:
    return sorted(entry.key for entry in Bucket(settings, schema.BUCKET).list(f'thor/_catalog/date={date}/'))


def answer(settings: StoreSettings, **flags: Any) -> list[str]:
    return sorted(lake.objects(Bucket(settings, schema.BUCKET), **flags)['key'].to_pylist())


@pytest.fixture
def settings(tmp_path: Path) -> Iterator[StoreSettings]:
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', hours=(11,))
    return settings


def test_a_day_that_is_over_becomes_one_file(settings: StoreSettings) -> None:
    """Today is left alone, answers stay; what was merged is deleted an hour later, by another run; then nothing is to do."""
    before, near = answer(settings), answer(settings, **PLACE)
    assert near
    assert [(day.date, day.merged, day.rows, day.kept) for day in run(settings)] == [('2026-10-28', 12, 96, 12)]
    assert len(files(settings)) == 13
    assert (answer(settings), answer(settings, **PLACE)) == (before, near)
    assert [day.deleted for day in run(settings, now=lambda: datetime.now(timezone.utc))] == [0]
    assert [(day.merged, day.deleted, day.kept) for day in run(settings, now=lambda: LATER)] == [(0, 12, 0)]
    assert [is_compacted(key) for key in files(settings)] == [True]
    assert len(files(settings, '2026-10-29')) == 12
    assert (answer(settings), answer(settings, **PLACE)) == (before, near)
    assert run(settings, now=lambda: LATER) == []


def test_what_comes_late_is_merged_with_what_was_merged(settings: StoreSettings, tmp_path: Path) -> None:
    """A robot that was away delivers parts of past days; the second file stands for all of them."""
    run(settings)
    run(settings, now=lambda: LATER)
    late = [row(sensor, NOON_NS + 7 * SECOND) for sensor in SENSORS]
    before = answer(settings)
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, late, 'late', tmp_path / 'tmp')
    assert answer(settings) == sorted([*before, *keys(late)])
    assert [(day.merged, day.rows) for day in run(settings)] == [(2, 98)]
    assert answer(settings) == sorted([*before, *keys(late)])
    run(settings, now=lambda: LATER)
    assert len(files(settings)) == 1
    assert answer(settings) == sorted([*before, *keys(late)])


@pytest.mark.long('a kill')
def test_it_may_die_anywhere(tmp_path: Path) -> None:
    """Killed after each single thing that it does, compaction leaves every answer as it was, and the next run ends it."""
    for number in range(200):
        settings = folder_store(tmp_path / str(number))
        with closing(open_store(settings, UploadSettings())) as store:
            for minute in range(3):
                add_part(store, [row('odom', NOON_NS + minute * 60 * SECOND)], f'part{minute}', tmp_path / 'tmp')
            rows = [row('odom', NOON_NS + minute * 60 * SECOND) for minute in range(3)]
            life = [number]
            mortal = Mortal(Bucket(settings, schema.BUCKET), life)
            try:
                for now in (TODAY, LATER):
                    list(compact(mortal, MortalStore(store, life), before='2026-10-29', now=lambda now=now: now))  # type: ignore[arg-type, misc]
                assert len(files(settings)) == 1
                break
            except Dead:
                found = [path for path in files(settings) if not is_compacted(path)]
                assert len(found) + sum(map(is_compacted, files(settings))) >= 1
            if number % 4 == 0:  # Daft takes its time; all states are in test_live_files
                assert answer(settings) == keys(rows)
    else:
        pytest.fail('it never came to its end')
    assert number > 10


def test_two_at_a_time_write_one_file(settings: StoreSettings) -> None:
    """Both begin from the same list; the second finds its file there."""
    before = answer(settings)
    run(settings)
    made = [key for key in files(settings) if is_compacted(key)]
    source = watched(settings)
    hidden = source.inner.list

    def earlier(*given: Any) -> Any:
        return (entry for entry in hidden(*given) if not is_compacted(entry.key))

    source.list = earlier  # type: ignore[assignment, method-assign]
    with closing(open_store(settings, UploadSettings())) as store:
        list(compact(source, store, before='2026-10-29', now=lambda: TODAY))
    assert [key for key in files(settings) if is_compacted(key)] == made
    assert answer(settings) == before


def test_a_run_that_took_too_long_puts_nothing(settings: StoreSettings) -> None:
    """What it listed may be deleted meanwhile by another run."""
    times = iter(range(0, 10**9, 3600))
    assert run(settings, monotonic=lambda: float(next(times))) == []
    assert len(files(settings)) == 12


def test_without_the_right_to_delete_it_only_takes_room(settings: StoreSettings) -> None:
    """Said once a day; answers are as before; other errors are not taken for that."""
    run(settings)
    source = watched(settings)

    def deny(keys: Any) -> None:
        raise AccessDenied('no', bucket='sensor-data')

    source.delete = deny  # type: ignore[method-assign, assignment]
    with closing(open_store(settings, UploadSettings())) as store:
        found = list(compact(source, store, before='2026-10-29', now=lambda: LATER))
        assert [(day.deleted, day.kept, day.denied) for day in found] == [(0, 12, True)]

        def away(keys: Any) -> None:
            raise StoreUnavailable('away')

        source.delete = away  # type: ignore[method-assign, assignment]
        with pytest.raises(StoreUnavailable):
            list(compact(source, store, before='2026-10-29', now=lambda: LATER))


def test_rows_lie_by_sensor_and_place(settings: StoreSettings) -> None:
    """So that statistics rule row groups out: the rows of a sensor are together, and the file has all columns and statistics."""
    run(settings)
    path = settings.directory / schema.BUCKET / next(key for key in files(settings) if is_compacted(key))
    table = pq.read_table(path)
    sensors = table['sensor'].to_pylist()
    assert sensors == sorted(sensors)
    assert table.schema.names == list(schema.COLUMNS)
    assert pq.ParquetFile(path).metadata.row_group(0).column(table.schema.names.index('x')).statistics.has_min_max


@pytest.mark.seaweedfs
def test_on_a_real_server(seaweed: Tower, tmp_path: Path) -> None:
    """The same through S3: merged, deleted, and answered alike, by Daft's own reader as well."""
    settings = seaweed.store_settings()
    rows = [row(sensor, NOON_NS + second * SECOND, robot='tachi') for second in range(0, 3000, 30) for sensor in SENSORS]
    with closing(open_store(settings, UploadSettings())) as store:
        for start in range(0, len(rows), 20):
            add_part(store, rows[start : start + 20], f'part{start:04d}', tmp_path)
        source = Bucket(settings, schema.BUCKET)
        want = {'robot': 'tachi', 'since': '2026-10-28', 'until': '2026-10-29'}
        assert answer(settings, **want) == keys(rows)
        for now in (TODAY, LATER):
            list(compact(source, store, robot='tachi', before='2026-10-29', now=lambda now=now: now))  # type: ignore[misc]
        assert [is_compacted(entry.key) for entry in source.list('tachi/_catalog/')] == [True]
    assert answer(settings, **want) == keys(rows)
    lake.scan.SMALL_BYTES, small = 0, lake.scan.SMALL_BYTES
    try:
        assert answer(settings, **want, where='battery_pct > 0') == keys(rows)
    finally:
        lake.scan.SMALL_BYTES = small
