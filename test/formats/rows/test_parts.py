"""Row files: a robot's rows read back, and a reader survives and reports any other content."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.core.zstd import compress
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import COMPLETE, GAP, GAPS, statement

INTS = st.integers(-(1 << 63), (1 << 63) - 1)
TEXT = st.text(st.characters(exclude_categories=['Cs']))
VALUES: dict[str, st.SearchStrategy[Any]] = {
    catalog.STRING: TEXT,
    catalog.INT32: st.integers(-(1 << 31), (1 << 31) - 1),
    catalog.INT64: INTS,
    catalog.DOUBLE: st.floats(allow_nan=False, allow_infinity=False),
    catalog.TIME: st.integers(-62_135_596_800_000_000, 253_402_300_799_999_999),
}
GIVEN = {
    'robot': st.just('thor'),
    'bucket': st.just('sensor-data'),
    'key': st.integers(0).map(lambda number: f'thor/camera/{number}.jpg'),
    'bytes': st.integers(0, (1 << 63) - 1),
}
ROWS = st.lists(
    st.fixed_dictionaries({
        name: (VALUES | GIVEN).get(name, VALUES[kind]) if name in catalog.REQUIRED else st.none() | GIVEN.get(name, VALUES[kind])
        for name, kind in catalog.COLUMNS.items()
    }),
    min_size=1,
    max_size=12,
)  # fmt: skip


def some(count: int) -> list[catalog.Row]:
    """Rows of a camera and of a lidar without a mission."""
    rows = []
    for number in range(count):
        ns = 1_760_788_800_000_000_000 + number * 500_000_000
        fields = {'robot': 'thor', 'sensor': 'camera', 't_start_ns': str(ns), 't_end_ns': str(ns), 'sha256': f'{number:064x}',
                'pose': f'{number}.5 -1.0 0.5 odom', 'run_id': 'r1'}  # fmt: skip
        rows.append(catalog.row_of('sensor-data', f'thor/camera/{number:06d}.jpg', number, 'image/jpeg', fields))
    for row in rows[::3]:
        row.update(run_id=None, x=None, y=None, yaw=None, pose_frame=None, sensor='lidar')
    return rows


def line(**changed: Any) -> bytes:
    """A valid line of kind ``object``, with some values changed; None removes one."""
    fields = {'row': 'object', **some(1)[0], **changed}
    return orjson.dumps({name: value for name, value in fields.items() if value is not None}) + b'\n'


@settings(deadline=None, max_examples=examples(50))
@given(ROWS)
def test_every_value_reads_back(rows: list[catalog.Row]) -> None:
    """Also nulls, the largest numbers, -0.0 and text of any script."""
    found = parts.read_rows(parts.encode(rows), 'thor')
    assert (found.rows, found.findings) == ({'_catalog': rows}, '')
    assert [str(row['x']) for row in found.rows['_catalog']] == [str(row['x']) for row in rows]  # -0.0 equals 0.0


def test_text_that_is_not_unicode_spoils_no_part() -> None:
    """Half a surrogate pair is written as a question mark."""
    found = parts.read_rows(parts.encode([{**some(1)[0], 'pose_frame': 'a\ud800'}]), 'thor')
    assert found.rows['_catalog'][0]['pose_frame'] == 'a?'


def test_each_line_has_the_kind_of_its_row() -> None:
    """A watermark has its own kind, and a file may have rows of several tables."""
    rows = [
        statement('thor', GAP, 'a', 1, sink='objects', topic='/imu', from_ns=1, to_ns=2),
        statement('thor', COMPLETE, 'b', 1, sink='objects', topic='/imu', from_ns=1, to_ns=2),
    ]
    lines = parts.ZstdDecompressor().decompress(parts.encode(rows, GAPS)).splitlines()
    assert [orjson.loads(each)['row'] for each in lines] == ['gap', 'watermark']
    found = parts.read_rows(compress(b'\n'.join([*lines, line()])), 'thor')
    assert found.rows == {'_gaps': rows, '_catalog': some(1)}


BAD: dict[str, tuple[bytes, str]] = {
    'not JSON': (b'{"row": "object"\n', 'not JSON'),
    'a list': (b'[]\n', 'no known kind'),
    'deep': (b'[' * 5000 + b']' * 5000 + b'\n', 'not JSON'),
    'not UTF-8': (line().replace(b'camera', b'\xff\xfe'), 'not JSON'),
    'NaN': (line(x=None).replace(b'{', b'{"x":NaN,', 1), 'not JSON'),
    'no kind': (line(row=None), 'no known kind'),
    'a list as its kind': (line(row=['object']), 'no known kind'),
    'a kind that is unknown': (line(row='table'), 'no known kind'),
    'a text for a number': (line(bytes='many'), 'bytes is invalid'),
    'true for a number': (line(bytes=True), 'bytes is invalid'),
    'a number that is not whole': (line(count=1.5), 'count is invalid'),
    'a number of 65 bits': (line(count=None).replace(b'{', b'{"count":18446744073709551616,', 1), 'count is invalid'),
    'an unsigned number of 64 bits': (line(count=(1 << 64) - 1), 'count is invalid'),
    'a size below zero': (line(bytes=-1), 'bytes is invalid'),
    'no size': (line(bytes=None), 'bytes is missing'),
    'a year of six digits': (line(t_start=1 << 62), 't_start is invalid'),
    'another robot': (line(robot='tachi'), 'names another robot'),
    'the key of another robot': (line(key='tachi/camera/1.jpg'), 'has a key of another robot'),
    'a bucket that is a path': (line(bucket='../etc'), 'bucket is invalid'),
    'a gap of another robot': (
        orjson.dumps({'row': 'gap', 'robot': 'tachi', 'what': 'gap', 'id': 'a', 'revision': 1, 'sink': 's', 'topic': 't',
                      'format_version': 1}) + b'\n', 'names another robot',
    ),
    'a gap that says it is a watermark': (
        orjson.dumps({'row': 'gap', 'robot': 'thor', 'what': 'complete', 'id': 'a', 'revision': 1, 'sink': 's', 'topic': 't',
                      'format_version': 1}) + b'\n', 'what does not suit its kind',
    ),
    'a gap that ends before it starts': (
        orjson.dumps({'row': 'gap', 'robot': 'thor', 'what': 'gap', 'id': 'a', 'revision': 1, 'sink': 's', 'topic': 't',
                      'from_ns': 2, 'to_ns': 1, 'format_version': 1}) + b'\n', 'from_ns is after to_ns',
    ),
    'a line of 128 KB': (line(topic='/' * (1 << 17)), 'longer than'),
    'an empty line': (b'\n', 'not JSON'),
}  # fmt: skip


def test_unknown_columns_are_skipped_and_counted() -> None:
    """Its rows are used."""
    found = parts.read_rows(compress(line(color='red', shape={'a': [1]}) + line()), 'thor')
    assert found.rows == {'_catalog': some(1) * 2}
    assert (found.unknown, found.findings) == (1, '')


@pytest.mark.parametrize('kind', BAD)
def test_a_bad_line_is_rejected_and_the_others_are_used(kind: str) -> None:
    """Its reason and its line number are named."""
    bad, why = BAD[kind]
    found = parts.read_rows(compress(line(count=1) + bad + bad + line(count=2)), 'thor')
    assert [row['count'] for row in found.rows['_catalog']] == [1, 2]
    (rejected,) = found.rejected
    assert (why in rejected.why, rejected.lines, rejected.first, found.ended) == (True, 2, 2, None)
    assert found.findings.startswith('2 rows are rejected: ')


def test_a_truncated_file_gives_the_rows_before_the_cut() -> None:
    """And the finding says that there were more."""
    rows = [{**some(1)[0], 'sha256': os.urandom(32).hex(), 'count': number} for number in range(5000)]
    whole = parts.encode(rows)
    for end in (len(whole) // 2, len(whole) - 1):
        found = parts.read_rows(whole[:end], 'thor')
        read = found.rows['_catalog']
        assert read == rows[: len(read)]
        assert (found.ended, bool(read)) == ('it is truncated', True)
    assert parts.read_rows(b'', 'thor').ended == 'it is empty'
    assert 'cannot be decompressed' in str(parts.read_rows(b'PAR1 is another format', 'thor').ended)
    assert parts.read_rows(compress(line() + line()[:-9]), 'thor').ended == 'its last line is incomplete'


BOMBS: dict[str, Callable[[], bytes]] = {
    'zeros': lambda: compress(bytes(1 << 27), 1),
    'empty lines': lambda: compress(b'\n' * (1 << 26), 1),
    'frames': lambda: b''.join([compress(bytes(1 << 20), 1)] * 100),
    'rows': lambda: compress(line() * 120_000, 1),
    'a window of 128 MB': lambda: b'\x28\xb5\x2f\xfd\x00\x88' + bytes(100),
}


@pytest.mark.parametrize('kind', BOMBS)
def test_a_bomb_takes_bounded_memory_and_time(kind: str) -> None:
    """It is named, whatever size it unpacks to."""
    body = BOMBS[kind]()
    tracemalloc.start()
    started = time.process_time()
    try:
        found = parts.read_rows(body, 'thor')
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found.ended is not None
    assert peak < 400 << 20
    assert time.process_time() - started < 30


@settings(deadline=None, max_examples=examples(100))
@given(st.data())
def test_whatever_is_in_a_file_the_reader_returns(data: st.DataObject) -> None:
    """Damaged files of ours and lines of any JSON; no row that is returned names another robot."""
    json = st.recursive(st.none() | st.booleans() | INTS | st.floats(allow_nan=False, allow_infinity=False) | TEXT,
                        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3))  # fmt: skip
    known = st.dictionaries(st.sampled_from([*catalog.COLUMNS, *GAPS.columns]), json, max_size=9)
    lines = data.draw(st.lists(st.tuples(st.sampled_from([*parts.KINDS]), known), max_size=5))
    body = bytearray(compress(b''.join(orjson.dumps({**row, 'row': kind}) + b'\n' for kind, row in lines) + line()))
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(body) - 1), st.integers(0, 255)), max_size=3)):
        body[place] = value
    found = parts.read_rows(bytes(body), 'thor')
    assert all(row['robot'] in {None, 'thor'} for rows in found.rows.values() for row in rows)
    assert all(row['key'].startswith('thor/') for row in found.rows.get('_catalog', ()))


def test_a_part_belongs_to_one_folder() -> None:
    """Rows of two robots and two days become separate parts, each in the order of time."""
    rows = some(4)
    rows[1] = {**rows[1], 'robot': 'tachi'}
    rows[2] = {**rows[2], 't_start': rows[2]['t_start'] + 86_400_000_000, 't_start_ns': rows[2]['t_start_ns'] + 86_400 * 10**9}
    found = list(parts.by_folder(reversed(list(enumerate(rows)))))
    assert {(robot, date): [number for number, _ in pairs] for robot, date, pairs in found} == {
        ('thor', '2025-10-18'): [0, 3], ('tachi', '2025-10-18'): [1], ('thor', '2025-10-19'): [2],
    }  # fmt: skip
    assert all(row is rows[number] for _, _, pairs in found for number, row in pairs)


def test_a_robot_does_not_need_arrow() -> None:
    """The node's imports for writing row files load none of the lake's libraries."""
    program = (
        'import sys; import shadowhound_data_logger.shipping.catalog_writer;'
        'print([name for name in ("pyarrow", "deltalake", "numpy", "boto3", "rclpy") if name in sys.modules])'
    )
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == '[]'
