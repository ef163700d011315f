"""The requested objects are in the folder, complete and verified; existing ones are not downloaded again.

A fetch that is killed repeatedly: complete files stay and are not downloaded again, and nothing else is left behind.
"""

from __future__ import annotations

import hashlib
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from lake.making import NOON_NS, add, add_part, folder_store, row

from shadowhound_data_logger.core import retry
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected, LakeError, StoreUnavailable
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetch import FetchRequest, FetchResult, fetch, under
from shadowhound_data_logger.lake.fetched import Fetched, keep_rows
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import Content
from shadowhound_data_logger.stores.directory import DirectoryStore
from shadowhound_data_logger.stores.s3_obstore import ObstoreStore

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower


COUNT = 30
PREFIX = 'thor/camera/20261028/'
OBJECTS = {f'{PREFIX}{number:06d}_front.jpg': os.urandom(500 + number) for number in range(COUNT)}


@pytest.fixture
def settings(tmp_path: Path) -> StoreSettings:
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp')
    return settings


def fill(settings: StoreSettings, folder: Path) -> None:
    with closing(open_store(settings, UploadSettings())) as store:
        for key, body in OBJECTS.items():
            add(store, folder, key, body)
        add(store, folder, 'thor/camera/20261029/000000_front.jpg', b'another day')


class Asked(DirectoryStore):
    """Records the requested contents."""

    def __init__(self, settings: StoreSettings) -> None:
        super().__init__(settings.directory)
        self.settings = settings
        self.asked: list[str] = []

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        self.asked.append(key)
        return super().content(bucket, key, start, version)


class Real(ObstoreStore):
    """The same for a real server."""

    def __init__(self, settings: StoreSettings) -> None:
        super().__init__(settings, UploadSettings())
        self.settings = settings
        self.asked: list[str] = []

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        self.asked.append(key)
        return super().content(bucket, key, start, version)


def run(store: Asked | Real, to: Path, **how: Any) -> FetchResult:
    """Fetch everything under the prefix."""
    requests = how.pop('requests', None) or under(Bucket(store.settings, BUCKET), PREFIX)
    return fetch(requests, to, store, **how)


def whole(to: Path) -> bool:
    return {str(path.relative_to(to)): path.read_bytes() for path in (to / 'thor').rglob('*.jpg')} == OBJECTS


def test_a_prefix_keeps_its_layout_and_a_second_run_moves_nothing(settings: StoreSettings, tmp_path: Path) -> None:
    """Exactly the objects under it, each at DIR/KEY; the second run makes one listing and requests no object."""
    source, to = Asked(settings), tmp_path / 'data'
    assert run(source, to) == FetchResult(moved=COUNT, bytes=sum(map(len, OBJECTS.values())))
    assert whole(to)
    source.asked.clear()
    assert run(source, to) == FetchResult(present=COUNT)
    assert source.asked == []


@pytest.mark.parametrize('prefix', ['thor/camera/2026102', 'thor/camera/20261028', 'thor/cam', 'thor/camera/20261028/00001'])
def test_a_prefix_need_not_end_at_a_folder(settings: StoreSettings, prefix: str) -> None:
    """As in S3."""
    expected = sorted(key for key in [*OBJECTS, 'thor/camera/20261029/000000_front.jpg'] if key.startswith(prefix))
    assert [request.key for request in under(Bucket(settings, BUCKET), prefix)] == expected


def test_locally_changed_files_are_fetched_again(settings: StoreSettings, tmp_path: Path) -> None:
    """Only files that are missing, have another size, or were written since."""
    source, to = Asked(settings), tmp_path / 'data'
    run(source, to)
    gone, short, touched, *_ = OBJECTS
    (to / gone).unlink()
    (to / short).write_bytes(b'short')
    (to / touched).write_bytes(bytes(len(OBJECTS[touched])))
    source.asked.clear()
    assert run(source, to).moved == 3
    assert sorted(source.asked) == sorted([gone, short, touched])
    assert whole(to)


def test_verify_finds_what_has_the_right_size_and_time(settings: StoreSettings, tmp_path: Path) -> None:
    """A bit flipped on this disk."""
    source, to = Asked(settings), tmp_path / 'data'
    run(source, to)
    rotten = to / next(iter(OBJECTS))
    seen = rotten.stat()
    rotten.write_bytes(bytes(seen.st_size))
    os.utime(rotten, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    assert run(source, to) == FetchResult(present=COUNT)
    assert not whole(to)
    assert run(source, to, verify=True).moved == 1
    assert whole(to)


def test_files_of_another_program_are_verified_and_not_fetched(settings: StoreSettings, tmp_path: Path) -> None:
    """For a folder from `aws s3 sync` or without its record: the content is compared, nothing is transferred."""
    source, to = Asked(settings), tmp_path / 'data'
    for key, body in OBJECTS.items():
        (to / key).parent.mkdir(parents=True, exist_ok=True)
        (to / key).write_bytes(body)
    (to / '.fetch').mkdir()
    (to / '.fetch' / 'files.db').write_bytes(b'no database at all' * 100)
    assert run(source, to) == FetchResult(present=COUNT)
    assert source.asked == []


def test_content_damaged_in_transit_is_fetched_again(settings: StoreSettings, tmp_path: Path) -> None:
    """Damage that occurs once is repaired; permanent damage is a failure that names both checksums, and leaves no file."""
    once, always, *_ = OBJECTS
    damaged = {once: 1, always: 99}

    class Damaging(Asked):
        def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
            content = super().content(bucket, key, start, version)
            if damaged.get(key, 0):
                damaged[key] -= 1
                return replace(content, pieces=iter([bytes(content.info.size)]))
            return content

    source, to = Damaging(settings), tmp_path / 'data'
    found = run(source, to)
    assert (found.moved, list(found.failed)) == (COUNT - 1, [f'{BUCKET}/{always}'])
    assert 'SHA-256' in found.failed[f'{BUCKET}/{always}']
    assert not (to / always).exists()
    assert (to / once).read_bytes() == OBJECTS[once]
    assert list((to / '.fetch' / 'parts').iterdir()) == []


def test_the_checksum_of_the_catalog_counts(settings: StoreSettings, tmp_path: Path) -> None:
    """An object that differs from its row is a failure, whatever its metadata says."""
    key = next(iter(OBJECTS))
    found = run(Asked(settings), tmp_path / 'data', requests=[FetchRequest(BUCKET, key, len(OBJECTS[key]), sha256='0' * 64)])
    assert list(found.failed) == [f'{BUCKET}/{key}']


def test_an_object_without_a_checksum_is_compared_by_size(settings: StoreSettings, tmp_path: Path) -> None:
    """It is reported, and checked again next time."""
    key = next(iter(OBJECTS))
    (settings.directory / '.metadata' / BUCKET / f'{key}.json').unlink()
    source = Asked(settings)
    assert run(source, tmp_path / 'data').unverified == 1
    source.asked.clear()
    assert run(source, tmp_path / 'data').moved == 1
    assert source.asked == [key]


@pytest.mark.parametrize('key', ['../outside', '/etc/passwd', 'a//b', 'a/./b', 'a/../../b', '.fetch/files.db', ''])
def test_no_key_leads_out_of_the_folder(settings: StoreSettings, tmp_path: Path, key: str) -> None:
    """A bucket may contain hostile keys."""
    source = Asked(settings)
    found = run(source, tmp_path / 'data', requests=[FetchRequest(BUCKET, key, 3)])
    assert list(found.failed) == [f'{BUCKET}/{key}']
    assert source.asked == []


@pytest.mark.parametrize('robot', ['{tmp}/evil', '../../evil', '..'])
def test_no_row_leads_out_of_the_folder(tmp_path: Path, robot: str) -> None:
    """Also by the robot's name in a row: such a row is skipped, the others are kept."""
    to, named = tmp_path / 'a' / 'data', robot.format(tmp=tmp_path)
    keep_rows(to, [row('camera', NOON_NS), {**row('camera', NOON_NS), 'robot': named}])
    kept = [path for path in tmp_path.rglob('*') if path.is_file()]
    assert [path.parents[2] for path in kept] == [to / 'thor']


def test_an_object_that_cannot_be_fetched_stops_no_other(settings: StoreSettings, tmp_path: Path) -> None:
    """A deleted object, a folder in place of the file, the same key in two buckets: each is reported with its reason."""
    keys = list(OBJECTS)
    to = tmp_path / 'data'
    (to / keys[0]).mkdir(parents=True)
    requests = [*under(Bucket(settings, BUCKET), PREFIX), FetchRequest(BUCKET, 'thor/gone', 3), FetchRequest('other', keys[1], 3)]
    found = run(Asked(settings), to, requests=requests)
    assert found.moved == COUNT - 1
    assert set(found.failed) == {f'{BUCKET}/{keys[0]}', f'{BUCKET}/thor/gone', f'other/{keys[1]}'}
    assert all(found.failed.values())


def test_an_unreachable_store_ends_it(settings: StoreSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not try each of a million objects; an error that concerns all is raised."""
    monkeypatch.setattr(retry, 'BASE_S', 0.001)
    tried = 0

    class Away(Asked):
        def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
            nonlocal tried
            tried += 1
            raise error

    source = Away(settings)
    requests = [FetchRequest(BUCKET, f'thor/{number}', 3) for number in range(2000)]
    error: Exception = StoreUnavailable('away')
    with pytest.raises(StoreUnavailable):
        run(source, tmp_path / 'data', requests=requests, threads=2)
    assert tried < 200
    error = CredentialsRejected('no')
    with pytest.raises(CredentialsRejected):
        run(source, tmp_path / 'data', requests=requests, threads=2)


def test_only_one_process_writes_to_a_folder(settings: StoreSettings, tmp_path: Path) -> None:
    """The second gets an error."""
    with Fetched(tmp_path / 'data'), pytest.raises(LakeError, match='another fetch'):
        run(Asked(settings), tmp_path / 'data')


def test_unsynced_files_are_verified_after_a_power_cut(settings: StoreSettings, tmp_path: Path) -> None:
    """Recorded by a killed run in another boot: the file is hashed, and moved if it is not complete."""
    source, to = Asked(settings), tmp_path / 'data'
    run(source, to)
    with closing(sqlite3.connect(to / '.fetch' / 'files.db')) as db, db:
        db.execute("UPDATE files SET boot = 'another'")
    zeros = to / next(iter(OBJECTS))
    seen = zeros.stat()
    zeros.write_bytes(bytes(seen.st_size))
    os.utime(zeros, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    source.asked.clear()
    assert run(source, to).moved == 1
    assert source.asked == [str(zeros.relative_to(to))]
    assert whole(to)


def test_progress_adds_up(settings: StoreSettings, tmp_path: Path) -> None:
    """The reported bytes and objects, including existing ones, equal those requested."""
    reports = [0, 0]

    def tell(size: int, objects: int) -> None:
        reports[0] += size
        reports[1] += objects

    for _ in range(2):
        reports[:] = [0, 0]
        run(Asked(settings), tmp_path / 'data', tell=tell, threads=1)
        assert reports == [sum(map(len, OBJECTS.values())), COUNT]


@pytest.fixture(scope='module')
def real(seaweed: Tower, tmp_path_factory: pytest.TempPathFactory) -> Tower:
    fill(seaweed.store_settings(), tmp_path_factory.mktemp('real'))
    return seaweed


@pytest.mark.seaweedfs
def test_objects_are_fetched_from_an_s3_server(real: Tower, tmp_path: Path) -> None:
    """The same over S3, with an empty object and one of several pieces; the second run requests no object."""
    with closing(open_store(real.store_settings(), UploadSettings())) as store:
        add(store, tmp_path / 'tmp', 'thor/rosbags/large/0.mcap', os.urandom(5 << 20))
        add(store, tmp_path / 'tmp', 'thor/rosbags/large/empty', b'')
    source, to = Real(real.store_settings()), tmp_path / 'data'
    assert run(source, to).moved == COUNT
    assert whole(to)
    assert run(source, to, requests=under(Bucket(source.settings, BUCKET), 'thor/rosbags/large/')) == FetchResult(
        moved=2, bytes=5 << 20
    )
    source.asked.clear()
    assert run(source, to) == FetchResult(present=COUNT)
    assert source.asked == []
    with pytest.raises(StoreUnavailable):
        run(Real(replace(real.store_settings(), endpoint_url='http://127.0.0.1:9')), to)


KILLED_COUNT = 300
SIZE = 2000
ROBOT = 'killed'
KEYS = [f'{ROBOT}/camera/{utc(NOON_NS):%Y%m%d}/{number:06d}_front.jpg' for number in range(KILLED_COUNT)]


def body(number: int) -> bytes:
    return hashlib.sha256(str(number).encode()).digest() * (SIZE // 32)


KEPT = re.compile(rf'\.fetch/(lock|files\.db)|{ROBOT}/_catalog/date=[\d-]+/{ROBOT}_\d+_backfilled_[0-9a-f]+\.jsonl\.zst')
SUMS = {key: hashlib.sha256(body(number)).hexdigest() for number, key in enumerate(KEYS)}


class Counting(Front):
    """Passes on this many objects and then stops answering; it records the requested ones."""

    def __init__(self, url: str) -> None:
        super().__init__(url, lambda: Fault.HUNG if len(self.got) >= self.limit else Fault.NONE)
        self.limit = 0
        self.got: list[str] = []

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        key = request.target.partition('?')[0].removeprefix(f'/{catalog.BUCKET}/')
        if request.method == 'GET' and key in SUMS:
            self.got.append(key)
        return super().forward(request, slowly=slowly)


@pytest.fixture(scope='module')
def filled(seaweed: Tower, tmp_path_factory: pytest.TempPathFactory) -> Tower:
    """All objects, and one part with their rows."""
    folder = tmp_path_factory.mktemp('bodies')
    rows = []
    with closing(open_store(seaweed.store_settings(), UploadSettings())) as store:
        for number, key in enumerate(KEYS):
            stamp = str(NOON_NS + number * SECOND // 1000)
            fields = {'robot': ROBOT, 'sensor': 'camera', 't_start_ns': stamp, 't_end_ns': stamp}
            add(store, folder, key, body(number), fields)
            values = {**fields, 'sha256': SUMS[key]}
            rows.append(catalog.row_of(catalog.BUCKET, key, len(body(number)), 'image/jpeg', values))
        add_part(store, rows, 'part', folder)
    return seaweed


@pytest.fixture
def front(filled: Tower) -> Iterator[Counting]:
    with Counting(filled.endpoint_url) as front:
        yield front


def complete_files(to: Path) -> set[str]:
    """The keys with intact files; every file with a key's name is intact."""
    found = {str(path.relative_to(to)): path for path in (to / ROBOT / 'camera').rglob('*.jpg')}
    assert all(hashlib.sha256(path.read_bytes()).hexdigest() == SUMS[key] for key, path in found.items())
    return set(found)


def left_over(to: Path) -> list[str]:
    """Files other than objects, their rows and the record for the next fetch."""
    found = {str(path.relative_to(to)) for path in to.rglob('*') if path.is_file()} - set(KEYS)
    return sorted(name for name in found if not KEPT.fullmatch(name))


@pytest.mark.seaweedfs
def test_half_written_rows_are_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed at that moment they do not exist, and the next fetch removes the remains."""
    text = catalog.row_of('sensor-data', f'{ROBOT}/camera/x.jpg', 1, 'image/jpeg', {'t_start_ns': str(NOON_NS)})

    def die(_: object, __: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(os, 'replace', die)
        with pytest.raises(SystemExit):
            keep_rows(tmp_path, [text])
    assert left_over(tmp_path)
    with Fetched(tmp_path):
        pass
    assert left_over(tmp_path) == []


@pytest.mark.seaweedfs
@pytest.mark.long('kills')
@pytest.mark.parametrize(('kills', 'asked'), [(3, [f'{ROBOT}/camera/']), (1, ['--robot', ROBOT])], ids=['prefix', 'question'])
def test_a_killed_fetch_downloads_each_object_once(
    filled: Tower, front: Counting, tmp_path: Path, kills: int, asked: list[str]
) -> None:
    """Every file that appears is complete, at any moment; after each kill the next run requests only missing objects."""
    to = tmp_path / 'data'
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'fetch', *asked, '--to', str(to)]
    environ = {**os.environ, **filled.environment(), 'AWS_ENDPOINT_URL': front.url}
    there: set[str] = set()
    for number in range(kills):
        begun, front.limit = len(front.got), KILLED_COUNT * (number + 1) // (kills + 1)
        with subprocess.Popen(command, env=environ, stdout=subprocess.DEVNULL) as process:
            end = time.monotonic() + 120
            while len(front.got) < front.limit or not front.is_quiet or len(complete_files(to)) == len(there):
                assert time.monotonic() < end, 'it fetches nothing'
                assert process.poll() is None
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
        assert not there & set(front.got[begun:])
        there = complete_files(to)
    begun, front.limit = len(front.got), sys.maxsize
    last = subprocess.run(command, env=environ, check=True, capture_output=True, text=True, timeout=120)
    assert f'{len(there)} were there already' in last.stdout.replace(',', '')
    assert set(front.got[begun:]) == set(KEYS) - there, 'only the last request of a killed run may be repeated'
    assert complete_files(to) == set(KEYS)
    assert left_over(to) == []
