"""A robot's invalid part of the catalog or of the gap journal is skipped, named and counted; every command handles the rest."""

from __future__ import annotations

import json
import os
import pickle
import random
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from lake import bad_parts
from lake.gap_parts import lost, mark, tell
from lake.making import NOON_NS, add, add_part, content, fill, folder_store, row

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.cli.lake import lake as lake_command
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import coverage, known, of_rows
from shadowhound_data_logger.stores import open_store

LIMIT_BYTES = 3 << 30
"""Address space: the threads of delta-rs reserve most of it. The commands use 0.2 GB of memory."""
ROWS = [row('camera', NOON_NS + number * 10**9) for number in range(1, 4)]
THEIRS = [row('camera', NOON_NS + number * 10**9, robot='tachi') for number in range(1, 4)]
TEXTS = [each['topic'] for each in ROWS]
BAD: dict[str, Callable[[], bytes]] = {
    'empty': lambda: b'',
    'garbage': lambda: random.Random(1).randbytes(5000),
    'Parquet': lambda: b'PAR1' + b'\0' * 40 + b'PAR1',
    'a text for a number': lambda: bad_parts.lines(ROWS, bytes='many'),
    'a number for a key': lambda: bad_parts.lines(ROWS, key=1),
    'a list for a robot': lambda: bad_parts.lines(ROWS, robot=['thor']),
    'no key': lambda: bad_parts.lines(ROWS, key=None),
    'of tachi': lambda: parts.encode(THEIRS),
    'of nobody': lambda: parts.encode([{**each, 'key': 'x.jpg'} for each in ROWS]),
    'thor with the rows of tachi': lambda: parts.encode([{**each, 'robot': 'tachi'} for each in ROWS]),
    'a bucket that is a path': lambda: parts.encode([{**each, 'bucket': '../../etc'} for each in ROWS]),
    'a year of six digits': lambda: parts.encode([{**each, 't_start': (1 << 62)} for each in ROWS]),
    'a size below nothing': lambda: parts.encode([{**each, 'bytes': -5} for each in ROWS]),
    'a bomb': bad_parts.bomb,
    'a row of another table': lambda: parts.encode([mark(1)], GAPS),
}  # fmt: skip
FEW = ('empty', 'garbage', 'a text for a number')
"""Also tried separately."""


@pytest.fixture(scope='module')
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An hour of thor and some parts of tachi, all valid, and the objects of their rows."""
    root = tmp_path_factory.mktemp('sound')
    settings = folder_store(root)
    rows = fill(settings, root / 'tmp', days=(0,), hours=(12,))
    with closing(open_store(settings, UploadSettings())) as store:
        for number, each in enumerate(THEIRS):
            add_part(store, [each], f'part{number}', root / 'tmp')
        for each in (*rows, *THEIRS):
            fields = {'sha256': str(each['sha256'])}
            add(store, root / 'tmp', each['key'], content(each['sensor'], each['t_start_ns']), fields)
    return root


@pytest.fixture
def home(sound: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(sound, tmp_path / 'home'))


def good(home: Path) -> list[str]:
    """The keys of all valid rows."""
    return sorted(lake.objects(Bucket(folder_store(home), catalog.BUCKET))['key'].to_pylist())


def run(command: Callable[..., object], home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)  # type: ignore[arg-type]
    assert found.exception is None, found.exception
    return found


ALONE = [pytest.param([kind], marks=pytest.mark.long('alone')) for kind in FEW]


@pytest.mark.parametrize('kinds', [BAD, *ALONE], ids=['all', *FEW])
def test_a_bad_part_affects_no_other_robot(home: Path, kinds: Collection[str]) -> None:
    """``query`` returns all other rows, names each such part, and its exit code shows that there is one."""
    before = good(home)
    assert run(query, home).return_value == 0
    keys = [bad_parts.put(folder_store(home), BAD[kind](), f'thor_bad{number}') for number, kind in enumerate(kinds)]
    found = run(query, home, '--format', 'keys')
    assert sorted(line.removeprefix('sensor-data/') for line in found.stdout.splitlines()) == before
    assert found.return_value == 1
    assert [key for key in keys if f'{key} is skipped: ' not in found.stderr] == []
    assert f'{len(keys)} files of the catalog are skipped' in found.stderr
    assert run(query, home, '--robot', 'tachi').return_value == 0


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('kind', [*FEW, 'of tachi', 'a bomb'])
def test_every_command_continues_without_it(home: Path, tmp_path: Path, kind: str) -> None:
    """``lake verify``, ``fetch``, ``lake reindex`` and ``lake ingest``: the others are verified, fetched, listed and ingested."""
    before = good(home)
    key = bad_parts.put(folder_store(home), BAD[kind]())
    assert run(lake_command, home, 'ingest').return_value == 1, 'it names what it ingests now'
    verified = run(lake_command, home, 'verify', '--json')
    data = json.loads(verified.stdout)
    assert (verified.return_value, data['sound'], data['findings'], [one['key'] for one in data['left_out']]) == (
        1, len(before), {}, [key],
    )  # fmt: skip
    fetched = run(fetch, home, '--since', '2026-10-28', '--to', str(tmp_path / 'data'), '--json')
    data = json.loads(fetched.stdout)
    assert (fetched.return_value, data['moved'], data['failed'], len(data['left_out'])) == (1, len(before), {}, 1)
    known = json.loads(run(lake_command, home, 'reindex', '--robot', 'thor', '--json').stdout)
    assert known['added'] == 2, 'the two summaries have no rows'
    before = good(home)
    assert run(lake_command, home, 'ingest').return_value == 0
    assert good(home) == before


def test_rows_of_others_are_refused_and_counted_and_the_rest_of_the_part_is_answered(home: Path) -> None:
    """A robot's part may only have that robot's keys, in any bucket."""
    mine = [{**ROWS[0], 'key': 'thor/rosbags/a/a_0.mcap'}, {**ROWS[0], 'key': 'thor/patrol.csv', 'bucket': 'trajectories'}]
    before = good(home)
    key = bad_parts.put(folder_store(home), parts.encode([*mine, *THEIRS]))
    findings = Findings(lambda _: None)
    source = Bucket(folder_store(home), catalog.BUCKET)
    found = lake.objects(source, findings=findings)['key'].to_pylist()
    assert sorted(found) == sorted([*before, *(str(each['key']) for each in mine)])
    assert [(one.key, one.rows) for one in findings] == [(key, 3)]
    assert '3 rows are rejected: names another robot (first in line 3)' in str(next(iter(findings)))


def test_a_dataset_reports_what_it_skips(home: Path) -> None:
    """And has all other data."""
    source = Bucket(folder_store(home), catalog.BUCKET)
    count = len(lake.MissionDataset(source))
    key = bad_parts.put(folder_store(home), b'')
    frames = lake.MissionDataset(source)
    assert len(frames) == count > 0
    assert [one.key for one in frames.skipped] == [key]
    assert not len(pickle.loads(pickle.dumps(frames)).skipped)  # noqa: S301 - our own


def test_a_folder_name_does_not_let_a_robot_write_rows_of_another(home: Path) -> None:
    """Folders that are not dates, and names that are not robots, are not part of the catalog."""
    before = good(home)
    root = home / 'store' / catalog.BUCKET
    for folder in (
        'thor/_catalog/date=\x1b[31m',
        'thor/_catalog/date=..',
        '\x1b[31m/_catalog/date=2026-10-28',
        '-x/_catalog/date=2026-10-28',
    ):
        (root / folder).mkdir(parents=True)
        (root / folder / f'x{catalog.SUFFIX}').write_bytes(parts.encode(ROWS))
    assert good(home) == before
    (root / 'thor/_catalog/date=2026-10-28/\x1b[31m.jsonl.zst').write_bytes(parts.encode(ROWS))
    findings = Findings(lambda _: None)
    lake.objects(Bucket(folder_store(home), catalog.BUCKET), findings=findings)
    named = {(one.key.rpartition('/')[2], '\x1b' in str(one)) for one in findings}
    assert named == {('\x1b[31m.jsonl.zst', False), ('x.jsonl.zst', False)}


@pytest.mark.long('commands in little memory')
def test_a_decompression_bomb_is_skipped_in_little_memory(home: Path) -> None:
    """``query`` and ``lake ingest`` exit normally and name it."""
    key = bad_parts.put(folder_store(home), bad_parts.bomb())
    for arguments in (('query', '--format', 'keys'), ('lake', 'ingest')):
        ran = in_little_memory(home, *arguments)
        assert (ran.returncode, 'Traceback' in ran.stderr) == (1, False), ran.stderr
        assert f'{key} is skipped: ' in ran.stderr
        shutil.rmtree(home / 'lake')


def in_little_memory(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': ''}
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *arguments]
    return subprocess.run(
        command, env=environ, capture_output=True, text=True, check=False, timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES)),
    )  # fmt: skip


GAP_ROWS = [lost(str(number), number, number + 1) for number in range(3)]
MOST = (1 << 63) - 1
END_NS = NOON_NS + 3600 * SECOND


def with_(**fields: Any) -> bytes:
    return parts.encode([{**row, **fields} for row in GAP_ROWS], GAPS)


BAD_GAPS: dict[str, Callable[[], bytes]] = {
    'empty': lambda: b'',
    'garbage': lambda: random.Random(1).randbytes(5000),
    'a part of the catalogue': lambda: parts.encode([catalog.row_of('sensor-data', 'thor/a', 1, '', {})]),
    'a text for a number': lambda: bad_parts.lines(GAP_ROWS, 'gap', revision='newest'),
    'a number for an id': lambda: bad_parts.lines(GAP_ROWS, 'gap', id=1),
    'no revision': lambda: bad_parts.lines(GAP_ROWS, 'gap', revision=None),
    'of tachi': lambda: with_(robot='tachi'),
    'an unknown kind of statement': lambda: with_(what='forget'),
    'an end before the beginning': lambda: with_(to_ns=0),
    'a year of six digits': lambda: with_(t_to=1 << 62),
    'a revision below nothing': lambda: with_(revision=-1),
    'a bomb': bad_parts.bomb,
}  # fmt: skip


@pytest.fixture
def gaps_home(tmp_path: Path) -> Path:
    tell(folder_store(tmp_path), tmp_path, mark(3600), lost('1', 600, 660))
    return tmp_path


def run_verb(command: Callable[..., object], gaps_home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(gaps_home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)  # type: ignore[arg-type]
    assert found.exception is None, found.exception
    return found


def test_bad_parts_of_the_gap_journal_affect_no_other_robot(gaps_home: Path) -> None:
    """``query``, ``lake coverage`` and ``known`` return the rest, name each bad part, and have an exit code for them."""
    source = Bucket(folder_store(gaps_home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source)
    assert [gap.count for gap in before.gaps] == [5]
    keys = [bad_parts.put(folder_store(gaps_home), bad(), f'thor_bad{number:02}', of=GAPS)
            for number, bad in enumerate(BAD_GAPS.values())]  # fmt: skip
    findings = Findings(lambda _: None)
    assert known('thor', '/imu', NOON_NS, END_NS, source=source, findings=findings) == before
    assert sorted(one.key for one in findings) == keys
    found = run_verb(query, gaps_home, 'SELECT cause FROM gaps', '--json')
    assert (json.loads(found.stdout), found.return_value) == ([{'cause': 'transport'}], 1)
    assert [key for key in keys if f'{key} is skipped: ' not in found.stderr] == []
    times = '--since', '2026-10-28T12:00', '--until', '2026-10-28T13:00'
    found = run_verb(lake_command, gaps_home, 'coverage', *times, '--json')
    assert (json.loads(found.stdout)[0]['hours'][0]['seconds'], found.return_value) == ({'stored': 3540.0, 'transport': 60.0}, 1)


def test_ingest_skips_a_bad_part(gaps_home: Path) -> None:
    """The others are merged; it is not changed."""
    tell(folder_store(gaps_home), gaps_home, lost('2', 700, 701), name='b')
    key = bad_parts.put(folder_store(gaps_home), BAD_GAPS['a text for a number'](), of=GAPS)
    source = Bucket(folder_store(gaps_home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source, findings=Findings(lambda _: None))
    found = run_verb(lake_command, gaps_home, 'ingest', '--delete-after', '0s')
    assert (found.return_value, f'{key} is skipped: ' in found.stderr) == (1, True)
    assert key in [entry.key for entry in source.list('thor/_gaps/')]
    assert known('thor', '/imu', NOON_NS, END_NS, source=source, findings=Findings(lambda _: None)) == before


def test_no_robot_reports_gaps_of_another(gaps_home: Path) -> None:
    """Statements of tachi with the names of thor's do not change those of thor."""
    source = Bucket(folder_store(gaps_home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source)
    theirs = [
        {**lost('1', 600, 660, 99, 'withdrawn'), 'robot': 'tachi'},
        {**mark(3600, 99, grade='received-only'), 'robot': 'tachi'},
    ]
    bad_parts.put(folder_store(gaps_home), parts.encode(theirs, GAPS), 'tachi_x', 'tachi', GAPS)
    assert known('thor', '/imu', NOON_NS, END_NS, source=source) == before
    assert len(known('tachi', '/imu', NOON_NS, END_NS, source=source).gaps) == 0


def test_texts_of_robots_are_shown_harmless(gaps_home: Path, tmp_path: Path) -> None:
    """Names and causes with control characters and formulas, on a terminal and in an image."""
    rows = [
        {**mark(3600), 'topic': '/\x1b[31m$\\frac{$'},
        {**lost('9', 5, 6, cause='\x1b]0;x\x07$_$'), 'topic': '/\x1b[31m$\\frac{$'},
    ]
    bad_parts.put(folder_store(gaps_home), parts.encode(rows, GAPS), of=GAPS)
    times = '--since', '2026-10-28T12:00', '--until', '2026-10-28T13:00'
    found = run_verb(lake_command, gaps_home, 'coverage', *times, '--chart', str(tmp_path / 'coverage.png'))
    assert '\x1b' not in found.stdout
    assert (tmp_path / 'coverage.png').stat().st_size > 1000


NUMBERS = st.none() | st.integers(-(1 << 63), MOST) | st.integers(NOON_NS, END_NS)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.fixed_dictionaries({
    'what': st.sampled_from(['gap', 'complete', 'withdrawn']), 'from_ns': NUMBERS, 'to_ns': NUMBERS, 'count': NUMBERS,
    'skipped': st.none() | st.integers(0, MOST), 'grade': st.none() | st.text(max_size=3) | st.just('exact'),
    'cause': st.none() | st.text(max_size=3), 'kind': st.none(), 'clock': st.none() | st.just('unset'),
}), max_size=6))  # fmt: skip
def test_hostile_rows_partition_time(given_: list[dict[str, Any]]) -> None:
    """Any times and counts give consecutive periods that fill the time."""
    rows = [{**GAP_ROWS[0], **row, 'id': str(number)} for number, row in enumerate(given_)]
    found = of_rows('thor', 'objects', '/imu', NOON_NS, END_NS, rows)
    assert [each.begin_ns for each in found.stretches] == [NOON_NS, *(each.end_ns for each in found.stretches[:-1])]
    assert found.stretches[-1].end_ns == END_NS
    assert all(each.begin_ns < each.end_ns for each in found.stretches)


def test_extremes_that_are_sane_are_answered(tmp_path: Path) -> None:
    """Times at the limits of 64 bits, in an otherwise valid part."""
    rows = [
        {**mark(3600), 'from_ns': -MOST, 'to_ns': MOST},
        {**lost('9', 5, 6), 'from_ns': -MOST, 'to_ns': NOON_NS + 1, 'count': MOST},
    ]
    bad_parts.put(folder_store(tmp_path), parts.encode(rows, GAPS), of=GAPS)
    source = Bucket(folder_store(tmp_path), catalog.BUCKET)
    (found,) = coverage(NOON_NS, END_NS, source=source)
    assert [(each.causes, each.grade) for each in found.known.stretches] == [(('transport',), 'exact'), ((), 'exact')]
    assert len(lake.sql('SELECT * FROM gaps', source).to_pylist()) == 1
