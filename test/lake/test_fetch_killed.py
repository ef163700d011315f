"""A fetch that is killed again and again: what was whole stays and is not asked for again, and nothing else is left behind."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from lake.making import NOON_NS, add, add_part

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake.fetched import Fetched, keep_rows
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

pytestmark = pytest.mark.seaweedfs
COUNT = 300
SIZE = 2000
ROBOT = 'killed'
KEYS = [f'{ROBOT}/camera/{utc(NOON_NS):%Y%m%d}/{number:06d}_front.jpg' for number in range(COUNT)]


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
            told = {'robot': ROBOT, 'sensor': 'camera', 't_start_ns': stamp, 't_end_ns': stamp}
            add(store, folder, key, body(number), told)
            said = {**told, 'sha256': SUMS[key]}
            rows.append(catalog.row_of(catalog.BUCKET, key, len(body(number)), 'image/jpeg', said))
        add_part(store, rows, 'part', folder)
    return seaweed


@pytest.fixture
def front(filled: Tower) -> Iterator[Counting]:
    with Counting(filled.endpoint_url) as front:
        yield front


def whole(to: Path) -> set[str]:
    """The keys whose files have the right content; every file with a key's name has."""
    found = {str(path.relative_to(to)): path for path in (to / ROBOT / 'camera').rglob('*.jpg')}
    assert all(hashlib.sha256(path.read_bytes()).hexdigest() == SUMS[key] for key, path in found.items())
    return set(found)


def left_over(to: Path) -> list[str]:
    """Files that are neither objects nor their rows nor what a next fetch has to know."""
    found = {str(path.relative_to(to)) for path in to.rglob('*') if path.is_file()} - set(KEYS)
    return sorted(name for name in found if not KEPT.fullmatch(name))


def test_rows_that_were_being_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed at that moment they are not there, and what there was of them goes with the next fetch."""
    said = catalog.row_of('sensor-data', f'{ROBOT}/camera/x.jpg', 1, 'image/jpeg', {'t_start_ns': str(NOON_NS)})

    def die(_: object, __: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(os, 'replace', die)
        with pytest.raises(SystemExit):
            keep_rows(tmp_path, [said])
    assert left_over(tmp_path)
    with Fetched(tmp_path):
        pass
    assert left_over(tmp_path) == []


@pytest.mark.long('kills')
@pytest.mark.parametrize(('kills', 'asked'), [(3, [f'{ROBOT}/camera/']), (1, ['--robot', ROBOT])], ids=['prefix', 'question'])
def test_killed_it_moves_each_object_once(filled: Tower, front: Counting, tmp_path: Path, kills: int, asked: list[str]) -> None:
    """Every file that appears is whole, at any moment; after each kill the next run asks only for what is not there."""
    to = tmp_path / 'data'
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'fetch', *asked, '--to', str(to)]
    environ = {**os.environ, **filled.environment(), 'AWS_ENDPOINT_URL': front.url}
    there: set[str] = set()
    for number in range(kills):
        begun, front.limit = len(front.got), COUNT * (number + 1) // (kills + 1)
        with subprocess.Popen(command, env=environ, stdout=subprocess.DEVNULL) as process:
            end = time.monotonic() + 120
            while len(front.got) < front.limit or not front.is_quiet or len(whole(to)) == len(there):
                assert time.monotonic() < end, 'it fetches nothing'
                assert process.poll() is None
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
        assert not there & set(front.got[begun:])
        there = whole(to)
    begun, front.limit = len(front.got), sys.maxsize
    last = subprocess.run(command, env=environ, check=True, capture_output=True, text=True, timeout=120)
    assert f'{len(there)} were there already' in last.stdout.replace(',', '')
    assert set(front.got[begun:]) == set(KEYS) - there, 'twice is what the killed one asked for in its last instant'
    assert whole(to) == set(KEYS)
    assert left_over(to) == []
