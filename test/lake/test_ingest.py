"""Rows of robots are added to the tables exactly once, despite concurrent ingesters, kills and merges."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from lake.gap_parts import lost, tell
from lake.making import FAILED, FINISHED, NOON_NS, Watched, add, add_part, fill, folder_store, keys, row, watched

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.zstd import ZstdDecompressor, compress
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake import ingest as library
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import Scope, fresh, ingest, maintain, pending, row_files
from shadowhound_data_logger.lake.tables import INGESTED, MISSION_ROWS, OBJECT_ROWS, TABLES, Tables, answer, engine
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower


@pytest.fixture
def tables(tmp_path: Path) -> Tables:
    """Empty tables in a folder."""
    made = Tables(str(tmp_path / 'tables'))
    made.create()
    return made


def bucket(tmp_path: Path) -> Bucket:
    return Bucket(folder_store(tmp_path), catalog.BUCKET)


def table_keys(tables: Tables) -> list[str]:
    with engine({'objects': tables.open(OBJECT_ROWS)}) as ready:
        return sorted(answer(ready, 'SELECT key FROM objects')['key'].to_pylist())


def test_every_row_is_in_the_table_once(tmp_path: Path, tables: Tables) -> None:
    """Also when the same files are ingested again, and by values: names, types and times are unchanged."""
    rows = fill(folder_store(tmp_path), tmp_path / 'tmp')
    first = ingest(bucket(tmp_path), tables, Findings())
    again = ingest(bucket(tmp_path), tables, Findings())
    assert (first.rows, first.repeated, first.rejected) == (len(rows), 0, 0)
    assert again.files == 0
    assert table_keys(tables) == keys(rows)
    with engine({'objects': tables.open(OBJECT_ROWS)}) as ready:
        found = answer(ready, 'SELECT * FROM objects ORDER BY key').to_pylist()
    by_key = {each['key']: each for each in rows}
    for each in found:
        wrote = by_key[each['key']]
        assert each['date'] == catalog.date_of(wrote)
        assert {name: each[name] for name in catalog.COLUMNS if not name.startswith('t_')} == {
            name: wrote[name] for name in catalog.COLUMNS if not name.startswith('t_')
        }
        assert each['t_start'].timestamp() * 1e6 == wrote['t_start']
        assert each['t_start_ns'] == wrote['t_start_ns']


def test_a_row_in_two_files_is_added_once(tmp_path: Path, tables: Tables) -> None:
    """A robot with a power failure repeats its last rows; reindex adds some that the robot delivers later."""
    rows = [row('camera', NOON_NS + second * SECOND) for second in range(4)]
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        add_part(store, rows[:3], 'a', tmp_path / 'tmp')
        add_part(store, rows[1:], 'b', tmp_path / 'tmp')
        done = ingest(bucket(tmp_path), tables, Findings())
        add_part(store, rows, 'c', tmp_path / 'tmp')
    later = ingest(bucket(tmp_path), tables, Findings())
    assert (done.rows, done.repeated, later.rows, later.repeated) == (4, 2, 0, 4)
    assert table_keys(tables) == keys(rows)


def test_a_row_without_a_time_is_added_once(tmp_path: Path, tables: Tables) -> None:
    """Two rows that both lack a part of their identity are the same row."""
    untimed = {**lost('1', 1, 2), 'from_ns': None, 'to_ns': None, 't_from': None, 't_to': None}
    for name in 'ab':
        tell(folder_store(tmp_path), tmp_path, untimed, untimed, lost('2', 3, 4), name=name)
        ingest(bucket(tmp_path), tables, Findings())
    with engine({'gaps': tables.open(TABLES[GAPS.folder])}) as ready:
        assert sorted(answer(ready, 'SELECT id FROM gaps')['id'].to_pylist()) == ['j/1', 'j/2']


def test_a_row_is_dated_by_its_own_time(tmp_path: Path, tables: Tables) -> None:
    """Whatever folder its file is in: in a file of another date it is still the same row."""
    midnight_ns = NOON_NS + 12 * 3600 * SECOND
    rows = [row('camera', midnight_ns + second * SECOND) for second in (-1, 0, 1)]
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        add_part(store, rows, 'a', tmp_path / 'tmp')
        add_part(store, rows[1:], 'b', tmp_path / 'tmp')
    done = ingest(bucket(tmp_path), tables, Findings())
    assert (done.rows, done.repeated) == (3, 2)
    with engine({'objects': tables.open(OBJECT_ROWS)}) as ready:
        dates = answer(ready, 'SELECT date FROM objects ORDER BY t_start_ns')['date'].to_pylist()
    assert dates == ['2026-10-28', '2026-10-29', '2026-10-29']


def summary_reads(source: Watched) -> list[str]:
    return [key for verb, key in source.asked if verb == 'get' and key.endswith('/summary.json')]


def test_how_a_mission_ended_is_in_the_tables_and_never_changes(tmp_path: Path) -> None:
    """A query reads only the summaries of missions that had not ended; a summary that a robot replaces changes nothing."""
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', days=(0,), hours=(11,))
    source = watched(settings)
    source.inner.delete(f'thor/missions/run-{FAILED}/summary.json')
    assert lake.missions(source, success=True)['mission_id'].to_pylist() == [FINISHED]
    source.inner.delete(f'thor/missions/run-{FINISHED}/summary.json')
    late = {'success': False, 'result': 'FAILED', 'distance_m': 'far', 'start_ns': NOON_NS}
    with closing(open_store(settings, UploadSettings())) as store:
        forged = json.dumps({'success': False}).encode()
        add(store, tmp_path / 'tmp', f'thor/missions/run-{FINISHED}/summary.json', forged)
        add(store, tmp_path / 'tmp', f'thor/missions/run-{FAILED}/summary.json', json.dumps(late).encode())
        source.asked.clear()
        ends = {each['mission_id']: each for each in lake.missions(source).to_pylist()}
        assert {name: (each['success'], each['distance_m']) for name, each in ends.items()} == {
            FAILED: (False, None), FINISHED: (True, 12.5),
        }  # fmt: skip
        assert summary_reads(source) == [f'thor/missions/run-{FAILED}/summary.json'], 'that of a mission that had not ended'
        named = {**row('camera', NOON_NS + 7 * SECOND), 'mission_id': FAILED, 'run_id': f'run-{FAILED}'}
        add_part(store, [named], 'late', tmp_path / 'tmp')
    lake.objects(source)
    source.asked.clear()
    assert sorted(lake.missions(source, success=False)['mission_id'].to_pylist()) == [FAILED]
    assert summary_reads(source) == []
    with engine({'missions': Tables.of(source.inner).open(MISSION_ROWS)}) as ready:
        found = answer(ready, 'SELECT date, robot, run_id, success FROM missions ORDER BY date').to_pylist()
    assert found == [
        {'date': '1970-01-01', 'robot': 'thor', 'run_id': f'run-{FINISHED}', 'success': True},
        {'date': '2026-10-28', 'robot': 'thor', 'run_id': f'run-{FAILED}', 'success': False},
    ]


def test_a_kill_between_the_rows_and_the_record_of_their_file_repeats_nothing(
    tmp_path: Path, tables: Tables, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next run reads the file again and adds only its record."""
    rows = fill(folder_store(tmp_path), tmp_path / 'tmp', days=(0,))
    real = library._add

    def killed(where: Tables, table: Any, found: Any) -> int:
        if table is INGESTED:
            raise KeyboardInterrupt
        return real(where, table, found)

    monkeypatch.setattr(library, '_add', killed)
    with pytest.raises(KeyboardInterrupt):
        ingest(bucket(tmp_path), tables, Findings())
    monkeypatch.undo()
    assert table_keys(tables) == keys(rows)
    assert len(pending(tables.open(INGESTED), row_files(bucket(tmp_path), Findings(), Scope()))) == 24
    assert ingest(bucket(tmp_path), tables, Findings()).repeated == len(rows)
    assert table_keys(tables) == keys(rows)
    assert pending(tables.open(INGESTED), row_files(bucket(tmp_path), Findings(), Scope())) == []


def test_row_files_are_read_in_addition_to_the_tables(tmp_path: Path, tables: Tables) -> None:
    """Rows missing from the tables: all of a new file, none of one with rows that were committed without its record."""
    source = bucket(tmp_path)
    old = [row('camera', NOON_NS + second * SECOND) for second in range(3)]
    new = [row('odom', NOON_NS + second * SECOND) for second in range(3)]
    with closing(open_store(source.settings, UploadSettings())) as store:
        add_part(store, old, 'a', tmp_path / 'tmp')
        ingest(source, tables, Findings())
        ingested, opened = tables.open(INGESTED), tables.open(OBJECT_ROWS)
        add_part(store, new + old, 'b', tmp_path / 'tmp')
    files = pending(ingested, row_files(source, Findings(), Scope()))
    assert keys(fresh(source, files, opened, catalog.OBJECTS, Findings()).to_pylist()) == keys(new)
    ingest(source, tables, Findings())
    assert len(fresh(source, files, tables.open(OBJECT_ROWS), catalog.OBJECTS, Findings())) == 0


def test_an_invalid_row_file_is_named_and_counted(tmp_path: Path, tables: Tables) -> None:
    """It is read once; the rows of other files count."""
    source, findings = bucket(tmp_path), Findings(lambda _: None)
    rows = [row('camera', NOON_NS)]
    with closing(open_store(source.settings, UploadSettings())) as store:
        add_part(store, rows, 'a', tmp_path / 'tmp')
        bad = catalog.OBJECTS.part_key('thor', '2026-10-28', 'bad')
        add(store, tmp_path / 'tmp', bad, b'hello')
    done = ingest(source, tables, findings)
    assert (done.rows, done.rejected) == (1, 1)
    assert [each.key for each in findings] == [bad]
    with engine({'ingested': tables.open(INGESTED)}) as ready:
        known = answer(ready, 'SELECT part, why FROM ingested WHERE rejected > 0').to_pylist()
    assert [each['part'] for each in known] == [bad]
    assert known[0]['why']
    assert ingest(source, tables, findings).files == 0


def test_the_rows_of_a_newer_robot_are_added_without_the_columns_that_are_unknown(tmp_path: Path, tables: Tables) -> None:
    """They are counted, no query treats them as rejected, and the count excludes another robot's file."""
    source, findings = bucket(tmp_path), Findings(lambda _: None)
    rows = [row('camera', NOON_NS + second * SECOND) for second in range(3)]
    lines = ZstdDecompressor().decompress(parts.encode(rows)).splitlines(keepends=True)
    lines[1] = lines[1].replace(b'{', b'{"lens":{"f":[1.5]},"date":"../x",', 1)
    with closing(open_store(source.settings, UploadSettings())) as store:
        add(store, tmp_path / 'tmp', catalog.OBJECTS.part_key('thor', '2026-10-28', 'newer'), compress(b''.join(lines)))
        add_part(store, [row('odom', NOON_NS)], 'a', tmp_path / 'tmp')
    done = ingest(source, tables, findings)
    assert (done.rows, done.rejected, done.unknown, len(findings)) == (4, 0, 1, 0)
    assert table_keys(tables) == keys([*rows, row('odom', NOON_NS)])
    assert sorted(lake.objects(source, findings=findings)['key'].to_pylist()) == table_keys(tables)
    assert len(findings) == 0
    with engine({'ingested': tables.open(INGESTED)}) as ready:
        assert answer(ready, 'SELECT sum("unknown") AS n FROM ingested').to_pylist() == [{'n': 1}]


INGESTER = """
import sys
from pathlib import Path
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest
from shadowhound_data_logger.lake.tables import Tables
for _ in range(5):
    ingest(Bucket(StoreSettings(directory=Path(sys.argv[2])), 'sensor-data'), Tables(sys.argv[1]), Findings())
"""


def test_two_ingesters_and_a_compaction_at_a_time_add_every_row_once(tmp_path: Path, tables: Tables) -> None:
    """Processes that repeatedly start from the same versions."""
    source = bucket(tmp_path)
    rows: list[catalog.Row] = []
    with closing(open_store(source.settings, UploadSettings())) as store:
        for number in range(10):
            made = [row('camera', NOON_NS + (number * 10 + second) * SECOND) for second in range(5)]
            add_part(store, made, f'a{number}', tmp_path / 'tmp')
            rows += made
        command = [sys.executable, '-c', INGESTER, tables.root, str(source.settings.directory)]
        others = [subprocess.Popen(command) for _ in range(2)]
        for number in range(10, 20):
            made = [row('odom', NOON_NS + (number * 10 + second) * SECOND) for second in range(5)]
            add_part(store, made, f'b{number}', tmp_path / 'tmp')
            rows += made
            ingest(source, tables, Findings())
            maintain(source, tables, Findings())
        assert [each.wait(60) for each in others] == [0, 0]
    ingest(source, tables, Findings())
    assert Counter(table_keys(tables)) == Counter(keys(rows))
    with engine({'ingested': tables.open(INGESTED)}) as ready:
        assert answer(ready, 'SELECT count(*) AS n, count(DISTINCT part) AS m FROM ingested').to_pylist() == [{'n': 20, 'm': 20}]


def test_upkeep_makes_one_ordered_file_of_a_day_that_has_ended(tmp_path: Path, tables: Tables) -> None:
    """And it changes no row."""
    source = bucket(tmp_path)
    with closing(open_store(source.settings, UploadSettings())) as store:
        for number in (3, 1, 2):
            add_part(store, [row('camera', NOON_NS - 40 * 86400 * SECOND + number * SECOND)], f'a{number}', tmp_path / 'tmp')
            ingest(source, tables, Findings())
    before = table_keys(tables)
    done = maintain(source, tables, Findings())
    assert done.merged >= 3
    assert table_keys(tables) == before
    assert len(tables.open(OBJECT_ROWS).file_uris()) == 1
    assert maintain(source, tables, Findings()).merged == 0
    with engine({'objects': tables.open(OBJECT_ROWS)}) as ready:
        stamps = answer(ready, 'SELECT t_start_ns FROM objects')['t_start_ns'].to_pylist()
    assert stamps == sorted(stamps)


@pytest.mark.seaweedfs
def test_on_a_server_row_files_expire_after_their_commit(tower: Tower, tmp_path: Path) -> None:
    """Not before the grace period ends, and never a file with rows or columns that the tables lack."""
    import boto3

    settings = tower.store_settings()
    client = boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                          aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip
    for name in ('lake', catalog.BUCKET):
        if name not in {each['Name'] for each in client.list_buckets()['Buckets']}:
            client.create_bucket(Bucket=name)
    client.close()
    source, robot = Bucket(settings, catalog.BUCKET), f'r{tmp_path.name.replace("_", "-")}'[:40].rstrip('-')
    tables = Tables(f's3://lake/{robot}', settings)
    tables.create()
    rows = [row('camera', NOON_NS + second * SECOND, robot) for second in range(3)]
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, rows, 'a', tmp_path / 'tmp')
        bad = catalog.OBJECTS.part_key(robot, '2026-10-28', 'bad')
        add(store, tmp_path / 'tmp', bad, b'hello')
        newer = catalog.OBJECTS.part_key(robot, '2026-10-28', 'newer')
        add(store, tmp_path / 'tmp', newer, parts.encode([{**rows[0], 'color': 'red'}]))
    only = Scope(robot=robot)
    assert ingest(source, tables, Findings(lambda _: None), row_files(source, Findings(), only)).rows == 3
    assert maintain(source, tables, Findings()).expired == 0
    assert len(row_files(source, Findings(), only)) == 3
    later = datetime.now(timezone.utc) + timedelta(hours=2)
    assert maintain(source, tables, Findings(), now=later).expired == 1
    assert [file.entry.key for file in row_files(source, Findings(), only)] == [bad, newer]
    assert table_keys(tables) == keys(rows)


def test_every_table_takes_the_rows_of_its_schema() -> None:
    """Each has a date, a robot and an identity among its columns."""
    for table in TABLES.values():
        assert {'date', 'robot', table.time, *table.identity} <= set(table.schema.names)
