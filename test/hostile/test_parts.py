"""One robot's bad part of the catalogue is left out, named and counted; the others are answered by every command."""

from __future__ import annotations

import json
import os
import pickle
import random
import re
import resource
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Collection
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result
from hostile import bad_parts
from hypothesis import given
from hypothesis import strategies as st
from lake.making import NOON_NS, add, add_part, content, fill, folder_store, keys, row

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.cli.lake import lake as lake_command
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import parts, schema
from shadowhound_data_logger.lake import reading
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.stores import open_store

LIMIT_BYTES = 2 << 30
ROWS = [row('camera', NOON_NS + number * 10**9) for number in range(1, 4)]
THEIRS = [row('camera', NOON_NS + number * 10**9, robot='tachi') for number in range(1, 4)]
TEXTS = [each['topic'] for each in ROWS]
BAD: dict[str, Callable[[], bytes]] = {
    'empty': lambda: b'',
    'garbage': lambda: random.Random(1).randbytes(5000),
    'only the magic': lambda: b'PAR1' + b'\0' * 40 + b'PAR1',
    'a footer of 2 GB': lambda: b'PAR1' + b'\0' * 40 + b'\xff\xff\xff\x7fPAR1',
    'a text for a number': lambda: bad_parts.arrow(ROWS, bytes=['many'] * 3),
    'a number for a key': lambda: bad_parts.arrow(ROWS, key=[1, 2, 3]),
    'a list for a robot': lambda: bad_parts.arrow(ROWS, robot=[['thor']] * 3),
    'no key': lambda: bad_parts.written(pa.table({'robot': ['thor']})),
    'of tachi': lambda: parts.encode(THEIRS),
    'of nobody': lambda: parts.encode([{**each, 'key': 'x.jpg'} for each in ROWS]),
    'thor who says that he is tachi': lambda: parts.encode([{**each, 'robot': 'tachi'} for each in ROWS]),
    'a bucket that is a path': lambda: parts.encode([{**each, 'bucket': '../../etc'} for each in ROWS]),
    'a year of six digits': lambda: parts.encode([{**each, 't_start': (1 << 62)} for each in ROWS]),
    'a size below nothing': lambda: parts.encode([{**each, 'bytes': -5} for each in ROWS]),
    'a dictionary bomb': lambda: bad_parts.dictionary_bomb(ROWS[0], 20_000),
    'a histogram of another column': lambda: bad_parts.unfit_histogram(ROWS),
    'size statistics that are a list': lambda: bad_parts.listed_sizes(ROWS),
    'an encrypted column': lambda: bad_parts.encrypted(ROWS),
    'a bomb of zeros': lambda: bad_parts.zeros_bomb(ROWS, 1 << 23),
    'brotli': lambda: bad_parts.written(pa.Table.from_pylist(ROWS, schema=reading.arrow_schema()), compression='brotli'),
    'delta encoding': lambda: bad_parts.written(
        pa.Table.from_pylist(ROWS, schema=reading.arrow_schema()), use_dictionary=False,
        column_encoding={'key': 'DELTA_BYTE_ARRAY'},
    ),
}  # fmt: skip
FEW = ('empty', 'garbage', 'a text for a number')
"""Tried by themselves as well."""


@pytest.fixture(scope='module')
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An hour of thor and some parts of tachi, all sound, and what their rows speak of."""
    root = tmp_path_factory.mktemp('sound')
    settings = folder_store(root)
    rows = fill(settings, root / 'tmp', days=(0,), hours=(12,))
    with closing(open_store(settings, UploadSettings())) as store:
        for number, each in enumerate(THEIRS):
            add_part(store, [each], f'part{number}', root / 'tmp')
        for each in (*rows, *THEIRS):
            told = {'sha256': str(each['sha256'])}
            add(store, root / 'tmp', each['key'], content(each['sensor'], each['t_start_ns']), told)
    return root


@pytest.fixture
def home(sound: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(sound, tmp_path / 'home'))


def good(home: Path) -> list[str]:
    """The keys of all rows that count."""
    return sorted(lake.objects(Bucket(folder_store(home), schema.BUCKET))['key'].to_pylist())


def run(command: Callable[..., object], home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)  # type: ignore[arg-type]
    assert found.exception is None, found.exception
    return found


ALONE = [pytest.param([kind], marks=pytest.mark.long('alone')) for kind in FEW]


@pytest.mark.parametrize('kinds', [BAD, *ALONE], ids=['all', *FEW])
def test_a_bad_part_costs_nobody_else_an_answer(home: Path, kinds: Collection[str]) -> None:
    """``query`` answers with all other rows, names each such part, and its exit code says that there is one."""
    before = good(home)
    assert run(query, home).return_value == 0
    keys = [bad_parts.put(folder_store(home), BAD[kind](), f'thor_bad{number}') for number, kind in enumerate(kinds)]
    found = run(query, home, '--format', 'keys')
    assert sorted(line.removeprefix('sensor-data/') for line in found.stdout.splitlines()) == before
    assert found.return_value == 1
    assert [key for key in keys if f'{key} is left out: ' not in found.stderr] == []
    assert f'{len(keys)} of the catalog are left out' in found.stderr
    assert run(query, home, '--robot', 'tachi').return_value == 0


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('kind', [*FEW, 'of tachi', 'a dictionary bomb'])
def test_every_command_goes_on_without_it(home: Path, tmp_path: Path, kind: str) -> None:
    """``lake verify``, ``fetch``, ``lake compact`` and ``lake reindex``: the others are verified, fetched, merged and known."""
    before = good(home)
    key = bad_parts.put(folder_store(home), BAD[kind]())
    verified = run(lake_command, home, 'verify', '--json')
    told = json.loads(verified.stdout)
    assert (verified.return_value, told['sound'], told['findings'], [one['key'] for one in told['left_out']]) == (
        1, len(before), {}, [key],
    )  # fmt: skip
    fetched = run(fetch, home, '--since', '2026-10-28', '--to', str(tmp_path / 'data'), '--json')
    told = json.loads(fetched.stdout)
    assert (fetched.return_value, told['moved'], told['failed'], len(told['left_out'])) == (1, len(before), {}, 1)
    known = json.loads(run(lake_command, home, 'reindex', '--robot', 'thor', '--json').stdout)
    assert known['added'] == 2, 'the two summaries have no rows'
    before = good(home)
    compacted = run(lake_command, home, 'compact', '--before', '2026-10-29')
    assert compacted.return_value == 1
    assert f'{key} is left out: ' in compacted.stderr
    assert good(home) == before
    run(lake_command, home, 'compact', '--before', '2026-10-29', '--grace', '0')
    left = {path.name for path in (home / 'store' / schema.BUCKET / 'thor/_catalog' / f'date={bad_parts.DATE}').iterdir()}
    assert Path(key).name in left, 'what is left out stays as it is'
    assert len(left) == 2
    assert good(home) == before


def test_rows_of_others_are_refused_and_counted_and_the_rest_of_the_part_is_answered(home: Path) -> None:
    """A robot's part may only speak of that robot's keys, in whatever bucket."""
    mine = [{**ROWS[0], 'key': 'thor/rosbags/a/a_0.mcap'}, {**ROWS[0], 'key': 'thor/patrol.csv', 'bucket': 'trajectories'}]
    before = good(home)
    key = bad_parts.put(folder_store(home), parts.encode([*mine, *THEIRS]))
    findings = Findings(lambda _: None)
    source = Bucket(folder_store(home), schema.BUCKET)
    found = lake.objects(source, findings=findings)['key'].to_pylist()
    assert sorted(found) == sorted([*before, *(str(each['key']) for each in mine)])
    assert [(one.key, one.rows) for one in findings] == [(key, 3)]
    assert '3 rows are rejected: of another robot (first in line 3)' in str(next(iter(findings)))


def test_a_data_set_says_what_it_leaves_out(home: Path) -> None:
    """And has all the rest."""
    source = Bucket(folder_store(home), schema.BUCKET)
    count = len(lake.MissionDataset(source))
    key = bad_parts.put(folder_store(home), b'')
    frames = lake.MissionDataset(source)
    assert len(frames) == count > 0
    assert [one.key for one in frames.left_out] == [key]
    assert not len(pickle.loads(pickle.dumps(frames)).left_out)  # noqa: S301 - our own


def test_no_robot_speaks_for_another_by_the_name_of_a_folder(home: Path) -> None:
    """Folders that are not dates, and names that are not robots, are not part of the catalogue."""
    before = good(home)
    root = home / 'store' / schema.BUCKET
    for folder in (
        'thor/_catalog/date=\x1b[31m',
        'thor/_catalog/date=..',
        '\x1b[31m/_catalog/date=2026-10-28',
        '-x/_catalog/date=2026-10-28',
    ):
        (root / folder).mkdir(parents=True)
        (root / folder / f'x{schema.SUFFIX}').write_bytes(parts.encode(ROWS))
    assert good(home) == before
    (root / 'thor/_catalog/date=2026-10-28/\x1b[31m.jsonl.zst').write_bytes(parts.encode(ROWS))
    findings = Findings(lambda _: None)
    lake.objects(Bucket(folder_store(home), schema.BUCKET), findings=findings)
    named = {(one.key.rpartition('/')[2], '\x1b' in str(one)) for one in findings}
    assert named == {('\x1b[31m.jsonl.zst', False), ('x.jsonl.zst', False)}


@pytest.mark.long('commands in little memory')
def test_a_bomb_is_left_out_in_2_gb(home: Path) -> None:
    """With no more memory than that, ``query`` and ``lake compact`` end by themselves and say of each bomb that it is one."""
    bombs = {'thor_bad': bad_parts.dictionary_bomb(ROWS[0]), 'thor_zeros': bad_parts.zeros_bomb(ROWS),
             **dict([bad_parts.source_list_bomb(ROWS)])}  # fmt: skip
    keys = [bad_parts.put(folder_store(home), body, name) for name, body in bombs.items()]
    for arguments in (('query', '--format', 'keys'), ('lake', 'compact', '--before', '2026-10-29')):
        ran = in_2_gb(home, *arguments)
        assert (ran.returncode, 'Traceback' in ran.stderr) == (1, False), ran.stderr
        assert [key for key in keys if f'{key} is left out: ' not in ran.stderr] == []


def in_2_gb(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': ''}
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *arguments]
    return subprocess.run(
        command, env=environ, capture_output=True, text=True, check=False, timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES)),
    )  # fmt: skip


def test_large_parts_are_read_in_pieces_and_ruled_out_by_their_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that is not read whole gives the same rows, and what cannot hold an answer is not asked for."""
    settings = folder_store(tmp_path)
    rows = [row(sensor, NOON_NS + number * 10**9) for sensor in ('camera', 'odom') for number in range(6000)]
    table = pa.Table.from_pylist(rows, schema=reading.arrow_schema())
    bad_parts.put(settings, bad_parts.written(table, write_batch_size=4096), 'thor_large')
    from lake.making import watched

    monkeypatch.setattr(lake.scan, 'SMALL_BYTES', 1000)
    monkeypatch.setattr(lake.reading, 'SMALL_BYTES', 1000)
    source = watched(settings)
    assert sorted(lake.objects(source)['key'].to_pylist()) == keys(rows)
    assert {verb for verb, _ in source.asked} == {'folders', 'list', 'ranges'}


@pytest.mark.parametrize('how', [
    {}, {'use_dictionary': False}, {'write_statistics': False}, {'write_page_index': True}, {'data_page_version': '2.0'},
    {'compression': 'none'}, {'store_schema': True},
])  # fmt: skip
def test_columns_as_pyarrow_writes_them_are_known_by_a_pattern(how: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """What it finds of a footer is what a walk through all fields finds; and it spares that walk nearly always."""
    rows = pa.table({'number': pa.array([1, None, 3] * 100), 'text': pa.array(['x' * (each % 200) for each in range(300)]),
                     'none': pa.nulls(300, pa.float64()), 'float': pa.array([0.5] * 300)})  # fmt: skip
    sink = pa.BufferOutputStream()
    pq.write_table(rows, sink, row_group_size=50, **how)
    body = sink.getvalue().to_pybytes()
    begin, _ = bad_parts.footer_of(body)
    walked: list[int] = []
    picked = reading._picked
    monkeypatch.setattr(reading, '_picked', lambda *given: walked.append(1) or picked(*given))
    by_pattern = reading._picked(body, begin, reading._FOOTER)
    shorter = len(walked)
    monkeypatch.setattr(reading, '_USUAL', re.compile(b'(?!)'))
    assert _sizes(by_pattern[0]) == _sizes(reading._picked(body, begin, reading._FOOTER)[0])
    assert (shorter < (len(walked) - shorter) / 2) == (not {'write_statistics', 'write_page_index'} & set(how))


def _structs(depth: int) -> st.SearchStrategy[bytes]:
    """In Thrift's compact protocol, with structs in them."""
    number = st.integers(0, (1 << 64) - 1).map(_varint)
    kinds: dict[int, st.SearchStrategy[bytes]] = {
        1: st.just(b''), 2: st.just(b''), 4: number, 5: number, 6: number,
        8: st.binary(max_size=130).map(lambda text: _varint(len(text)) + text), **({12: _structs(depth - 1)} if depth else {}),
    }  # fmt: skip
    field = st.sampled_from(sorted(kinds)).flatmap(
        lambda kind: st.tuples(st.integers(1, 15), kinds[kind]).map(lambda made: bytes((made[0] << 4 | kind,)) + made[1])
    )
    return st.lists(field, max_size=5).map(lambda fields: b''.join(fields) + b'\0')


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


@given(st.one_of(_structs(4), st.binary(max_size=40)), st.binary(max_size=20))
def test_the_pattern_of_a_struct_ends_where_a_walk_ends(data: bytes, after: bytes) -> None:
    """Whatever it is given: it matches no more and no less."""
    found = reading._STRUCT.match(data + after)
    if found is not None:
        assert found.end() == reading._skipped(data + after, 0, 12)


@pytest.mark.parametrize(
    'begin', [b'', b'\x26\x00\x1c\x15\x00\x19\x15\x00\x19\x18\x00\x15\x00\x16\x00\x16\x00\x16\x00\x26\x00\x3c']
)
def test_a_struct_of_a_million_fields_takes_no_memory(begin: bytes) -> None:
    """What a pattern remembers of it is bounded."""
    pattern, data = reading._USUAL if begin else reading._STRUCT, begin + b'\x11' * (1 << 20) + b'\0\0\0'
    tracemalloc.start()
    try:
        assert pattern.match(data) is None
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def _sizes(footer: dict[int, Any]) -> list[Any]:
    """Of each column its type and what its size statistics are about."""
    columns = [column for group in footer[4] for column in group[1]]
    about = [(column[3][1], column[3].get(16, {})) for column in columns]
    return [(kind, sizes.get(2), sizes.get(3), 1 in sizes) for kind, sizes in about] + [set(columns[0])]
