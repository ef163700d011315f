"""One robot's bad part of the catalogue is left out, named and counted; the others are answered by every command."""

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

import pytest
from click.testing import CliRunner, Result
from hostile import bad_parts
from lake.gap_parts import mark
from lake.making import NOON_NS, add, add_part, content, fill, folder_store, row

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.cli.lake import lake as lake_command
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.stores import open_store

LIMIT_BYTES = 3 << 30
"""Of addresses: the threads of delta-rs reserve most of them. The commands use 0.2 GB of memory."""
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
    'thor who says that he is tachi': lambda: parts.encode([{**each, 'robot': 'tachi'} for each in ROWS]),
    'a bucket that is a path': lambda: parts.encode([{**each, 'bucket': '../../etc'} for each in ROWS]),
    'a year of six digits': lambda: parts.encode([{**each, 't_start': (1 << 62)} for each in ROWS]),
    'a size below nothing': lambda: parts.encode([{**each, 'bytes': -5} for each in ROWS]),
    'a bomb': bad_parts.bomb,
    'a row of another table': lambda: parts.encode([mark(1)], GAPS),
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
    return sorted(lake.objects(Bucket(folder_store(home), catalog.BUCKET))['key'].to_pylist())


def run(command: Callable[..., object], home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)  # type: ignore[arg-type]
    assert found.exception is None, found.exception
    return found


ALONE = [pytest.param([kind], marks=pytest.mark.long('alone')) for kind in FEW]


@pytest.mark.parametrize('kinds', [BAD, *ALONE], ids=['all', *FEW])
def test_a_bad_part_affects_no_other_robot(home: Path, kinds: Collection[str]) -> None:
    """``query`` answers with all other rows, names each such part, and its exit code says that there is one."""
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
    """``lake verify``, ``fetch``, ``lake reindex`` and ``lake ingest``: the others are verified, fetched, known and ingested."""
    before = good(home)
    key = bad_parts.put(folder_store(home), BAD[kind]())
    assert run(lake_command, home, 'ingest').return_value == 1, 'it names what it ingests now'
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
    assert run(lake_command, home, 'ingest').return_value == 0
    assert good(home) == before


def test_rows_of_others_are_refused_and_counted_and_the_rest_of_the_part_is_answered(home: Path) -> None:
    """A robot's part may only speak of that robot's keys, in whatever bucket."""
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
    """And has all the rest."""
    source = Bucket(folder_store(home), catalog.BUCKET)
    count = len(lake.MissionDataset(source))
    key = bad_parts.put(folder_store(home), b'')
    frames = lake.MissionDataset(source)
    assert len(frames) == count > 0
    assert [one.key for one in frames.skipped] == [key]
    assert not len(pickle.loads(pickle.dumps(frames)).skipped)  # noqa: S301 - our own


def test_no_robot_speaks_for_another_by_the_name_of_a_folder(home: Path) -> None:
    """Folders that are not dates, and names that are not robots, are not part of the catalogue."""
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
    """``query`` and ``lake ingest`` end normally and name it."""
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
