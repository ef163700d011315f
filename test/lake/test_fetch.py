"""The requested objects are in the folder, complete and verified; existing ones are not downloaded again."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from lake.making import NOON_NS, add, folder_store, row

from shadowhound_data_logger.core import retry
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected, LakeError, StoreUnavailable
from shadowhound_data_logger.core.options import StoreSettings
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
    """The same, of a server."""

    def __init__(self, settings: StoreSettings) -> None:
        super().__init__(settings, UploadSettings())
        self.settings = settings
        self.asked: list[str] = []

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        self.asked.append(key)
        return super().content(bucket, key, start, version)


def run(store: Asked | Real, to: Path, **how: Any) -> FetchResult:
    """Everything under the prefix."""
    requests = how.pop('requests', None) or under(Bucket(store.settings, BUCKET), PREFIX)
    return fetch(requests, to, store, **how)


def whole(to: Path) -> bool:
    return {str(path.relative_to(to)): path.read_bytes() for path in (to / 'thor').rglob('*.jpg')} == OBJECTS


def test_a_prefix_keeps_its_layout_and_a_second_run_moves_nothing(settings: StoreSettings, tmp_path: Path) -> None:
    """Exactly the objects under it, each at DIR/KEY; then one listing and not one object more."""
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


def test_what_was_changed_on_this_side_is_fetched_again(settings: StoreSettings, tmp_path: Path) -> None:
    """A file that is gone, of another size, or written since; only those."""
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
    """A bit that rotted on this disk."""
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


def test_what_another_program_fetched_is_read_and_not_moved(settings: StoreSettings, tmp_path: Path) -> None:
    """A folder that `aws s3 sync` or a lost memory left: the content is compared, nothing is transferred."""
    source, to = Asked(settings), tmp_path / 'data'
    for key, body in OBJECTS.items():
        (to / key).parent.mkdir(parents=True, exist_ok=True)
        (to / key).write_bytes(body)
    (to / '.fetch').mkdir()
    (to / '.fetch' / 'files.db').write_bytes(b'no database at all' * 100)
    assert run(source, to) == FetchResult(present=COUNT)
    assert source.asked == []


def test_damage_on_the_way_is_tried_again_and_never_kept(settings: StoreSettings, tmp_path: Path) -> None:
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


def test_the_word_of_the_catalogue_counts(settings: StoreSettings, tmp_path: Path) -> None:
    """An object that is not what its row says is a failure, whatever it says of itself."""
    key = next(iter(OBJECTS))
    found = run(Asked(settings), tmp_path / 'data', requests=[FetchRequest(BUCKET, key, len(OBJECTS[key]), sha256='0' * 64)])
    assert list(found.failed) == [f'{BUCKET}/{key}']


def test_an_object_without_a_checksum_has_its_size_alone(settings: StoreSettings, tmp_path: Path) -> None:
    """It is reported, and checked again the next time."""
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
    """Nor does what a row calls its robot: such a row is not kept, the others are."""
    to, named = tmp_path / 'a' / 'data', robot.format(tmp=tmp_path)
    keep_rows(to, [row('camera', NOON_NS), {**row('camera', NOON_NS), 'robot': named}])
    kept = [path for path in tmp_path.rglob('*') if path.is_file()]
    assert [path.parents[2] for path in kept] == [to / 'thor']


def test_one_that_cannot_be_fetched_stops_no_other(settings: StoreSettings, tmp_path: Path) -> None:
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
    """Not each of a million objects is tried; what concerns all of them is raised."""
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


def test_two_do_not_write_to_one_folder(settings: StoreSettings, tmp_path: Path) -> None:
    """The second says so."""
    with Fetched(tmp_path / 'data'), pytest.raises(LakeError, match='another fetch'):
        run(Asked(settings), tmp_path / 'data')


def test_what_was_not_synced_is_read_again_after_a_power_cut(settings: StoreSettings, tmp_path: Path) -> None:
    """Noted by a run that was killed, in another boot: the file is hashed, and moved if it is not whole."""
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
    """The reported bytes and objects, including existing ones, are those that were requested."""
    told = [0, 0]

    def tell(size: int, objects: int) -> None:
        told[0] += size
        told[1] += objects

    for _ in range(2):
        told[:] = [0, 0]
        run(Asked(settings), tmp_path / 'data', tell=tell, threads=1)
        assert told == [sum(map(len, OBJECTS.values())), COUNT]


@pytest.fixture(scope='module')
def real(seaweed: Tower, tmp_path_factory: pytest.TempPathFactory) -> Tower:
    fill(seaweed.store_settings(), tmp_path_factory.mktemp('real'))
    return seaweed


@pytest.mark.seaweedfs
def test_from_a_real_server(real: Tower, tmp_path: Path) -> None:
    """The same over S3, with an empty object and one of several pieces; the second run asks for no object."""
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
