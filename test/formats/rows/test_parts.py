"""Parts are Parquet to those who did not write them: pyarrow, Daft and DuckDB."""

from __future__ import annotations

import io
import subprocess
import sys
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.formats.rows import parquet, parts, schema
from shadowhound_data_logger.lake import reading

INTS = st.integers(-(1 << 63), (1 << 63) - 1)
VALUES = {
    parquet.STRING: st.text(st.characters(exclude_categories=['Cs'])),
    parquet.INT32: st.integers(-(1 << 31), (1 << 31) - 1),
    parquet.INT64: INTS,
    parquet.DOUBLE: st.floats(allow_nan=False),
    parquet.TIME: st.integers(-(1 << 55), 1 << 55),
}
ROWS = st.lists(
    st.fixed_dictionaries({
        name: VALUES[kind] if name in schema.REQUIRED else st.none() | VALUES[kind] for name, kind in schema.COLUMNS.items()
    }),
    min_size=1,
    max_size=12,
)  # fmt: skip


def read(body: bytes) -> pyarrow.Table:
    return pyarrow.parquet.read_table(io.BytesIO(body))


def plain(table: pyarrow.Table) -> list[dict[str, Any]]:
    """Its rows with times as whole microseconds."""
    times = [name for name, kind in schema.COLUMNS.items() if kind == parquet.TIME]
    for name in times:
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, table.column(name).cast(pyarrow.int64()))
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def some(count: int) -> list[schema.Row]:
    """Rows of a camera and of a lidar without a mission."""
    rows = []
    for number in range(count):
        ns = 1_760_788_800_000_000_000 + number * 500_000_000
        told = {'robot': 'thor', 'sensor': 'camera', 't_start_ns': str(ns), 't_end_ns': str(ns), 'sha256': f'{number:064x}',
                'pose': f'{number}.5 -1.0 0.5 odom', 'run_id': 'r1'}  # fmt: skip
        rows.append(schema.row_of('sensor-data', f'thor/camera/{number:06d}.jpg', number, 'image/jpeg', told))
    for row in rows[::3]:
        row.update(run_id=None, x=None, y=None, yaw=None, pose_frame=None, sensor='lidar')
    return rows


@settings(deadline=None, max_examples=examples(25))
@given(ROWS)
def test_every_value_reads_back(rows: list[schema.Row]) -> None:
    """Also nulls, the largest numbers, -0.0, infinities and text of any script; in the schema that is promised."""
    table = read(parts.encode(rows))
    assert table.schema.equals(reading.arrow_schema())
    found = plain(table)
    assert found == rows
    assert [str(row['x']) for row in found] == [str(row['x']) for row in rows]  # -0.0 equals 0.0


def test_text_that_is_none_spoils_no_part() -> None:
    """Half a surrogate pair, which a JSON of ours can hold, is written as a question mark."""
    assert plain(read(parts.encode([{**some(1)[0], 'pose_frame': 'a\ud800'}])))[0]['pose_frame'] == 'a?'


def test_readers_can_leave_out_what_they_do_not_look_for() -> None:
    """Each column says its least and greatest value and its nulls."""
    rows = some(9)
    group = pyarrow.parquet.read_metadata(io.BytesIO(parts.encode(rows))).row_group(0)
    told = {group.column(place).path_in_schema: group.column(place).statistics for place in range(group.num_columns)}
    assert (told['x'].min, told['x'].max, told['x'].null_count) == (1.5, 8.5, 3)
    assert (told['key'].min, told['key'].max) == ('thor/camera/000000.jpg', 'thor/camera/000008.jpg')
    assert told['t_end'].max == datetime.fromtimestamp(rows[-1]['t_end'] / 1e6, timezone.utc)
    assert (told['mission_id'].null_count, told['mission_id'].has_min_max) == (9, False)


def test_daft_reads_it(tmp_path: Path) -> None:
    """Values, nulls and times, with a filter that is pushed down."""
    if find_spec('daft') is None:
        pytest.skip('daft is not installed here')
    path = tmp_path / 'part.parquet'
    path.write_bytes(parts.encode(some(30)))
    program = (  # in a process of its own, because it leaves threads
        'import daft, sys; found = daft.read_parquet(sys.argv[1]).where(daft.col("x") > 20).sort("t_start").to_pydict();'
        'print(found["x"], set(found["run_id"]), found["t_start"][0].isoformat())'
    )
    ran = subprocess.run([sys.executable, '-c', program, str(path)], capture_output=True, text=True, check=True, timeout=60)
    values = [20.5, 22.5, 23.5, 25.5, 26.5, 28.5, 29.5]
    assert ran.stdout.strip() == f"{values} {{'r1'}} 2025-10-18T12:00:10+00:00"


def test_duckdb_reads_it(tmp_path: Path) -> None:
    """Several parts of folders by date at once, the date among the columns."""
    duckdb = pytest.importorskip('duckdb')
    for day in (18, 19):
        folder = tmp_path / f'date=2025-10-{day}'
        folder.mkdir()
        (folder / 'part.parquet').write_bytes(parts.encode(some(30)))
    table = duckdb.read_parquet(f'{tmp_path}/*/*.parquet', hive_partitioning=True)
    found = table.aggregate('date, count(*), count(run_id), min(x), max(epoch_us(t_start))').order('date').fetchall()
    assert [(str(date), *rest) for date, *rest in found] == [
        (f'2025-10-{day}', 30, 20, 1.5, some(30)[-1]['t_start']) for day in (18, 19)
    ]


def test_a_part_is_one_folders() -> None:
    """Rows of two robots and two days become parts of their own, each in the order of time."""
    rows = some(4)
    rows[1] = {**rows[1], 'robot': 'tachi'}
    rows[2] = {**rows[2], 't_start': rows[2]['t_start'] + 86_400_000_000, 't_start_ns': rows[2]['t_start_ns'] + 86_400 * 10**9}
    found = list(parts.by_folder(reversed(list(enumerate(rows)))))
    assert {(robot, date): [number for number, _ in pairs] for robot, date, pairs in found} == {
        ('thor', '2025-10-18'): [0, 3], ('tachi', '2025-10-18'): [1], ('thor', '2025-10-19'): [2],
    }  # fmt: skip
    assert all(row is rows[number] for _, _, pairs in found for number, row in pairs)


def test_a_robot_needs_no_arrow() -> None:
    """What the node imports to write parts loads none of the libraries that read them."""
    program = (
        'import sys; import shadowhound_data_logger.shipping.catalog_writer;'
        'print([name for name in ("pyarrow", "daft", "numpy", "boto3", "rclpy") if name in sys.modules])'
    )
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == '[]'
