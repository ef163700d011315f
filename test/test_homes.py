"""Homes of every version there was, each left half-way by a kill, open and go on; a newer one is left alone.

``homes/version_N.json`` was written by the program of that version: the index as SQL, all other files as they were.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import sqlite3
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

import pytest
from bags.eventing import until
from bags.recording import desk, manifest, numbers
from clocks import Clocks
from missions.fakes import FakeSpooler, FakeTracking
from spool.making import assert_whole, make, new_spool, put, rows

from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, missions
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.deliveries import Deliveries
from shadowhound_data_logger.spool.files import ATTRIBUTE
from shadowhound_data_logger.spool.listing import retry
from shadowhound_data_logger.spool.schema import SCHEMA_VERSION

HOMES: Final = Path(__file__).with_name('homes')
VERSIONS: Final = (1, 2, 3, 4, 5, 6)
WITH_MISSIONS: Final = VERSIONS[1:]
WITH_BAGS: Final = VERSIONS[2:]
STATES: Final = {
    'thor/camera/0.jpg': 'delivered', 'thor/camera/1.jpg': 'quarantined', 'thor/camera/2.jpg': 'evicted',
    'thor/camera/3.jpg': 'deduplicated', 'thor/camera/4.jpg': 'pending', 'thor/camera/5.jpg': 'pending', 'thor/held.jpg': 'held',
    'thor/book.json': 'pending', 'thor/imu/1.json': 'pending', 'thor/imu/2.json': 'pending',
}  # fmt: skip


def restored(version: int, home: Path) -> dict[str, Any]:
    """The home as that program left it; returns what is known of it besides."""
    said: dict[str, Any] = json.loads((HOMES / f'version_{version}.json').read_bytes())
    for name, file in said['files'].items():
        path = home / name
        if not file:
            path.mkdir(parents=True)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(file['text'].encode() if 'text' in file else base64.b64decode(file['base64']))
        with suppress(OSError):  # not every file system has them
            os.setxattr(path, ATTRIBUTE, file.get('attribute', '').encode())
    with closing(sqlite3.connect(home / 'spool/index.db')) as db:
        db.executescript('\n'.join(said['index']))
        db.execute(f'PRAGMA user_version = {version}')
    return said


def later() -> Clocks:
    """An hour after the kill."""
    clocks = Clocks()
    clocks.set()
    clocks.wait(3600)
    return clocks


@pytest.mark.parametrize('version', VERSIONS)
def test_a_spool_goes_on(tmp_path: Path, version: int) -> None:
    """Each object is where it was, what was in memory is lost by the restart, and the ledger closes before and after."""
    restored(version, tmp_path)
    root = tmp_path / 'spool'
    before = ledger.read(root, 'thor')
    assert before['balanced'], ledger.imbalances(before)
    spool = new_spool(root)
    spool.open()
    with closing(spool):
        done = {'renames completed': 1, 'uncommitted parts removed': 1, 'messages lost with an open batch': 1}
        assert dict(+spool.recovery.counts) == done
        assert {row['key']: row['state'] for row in rows(root) if 'rosbags' not in row['key']} == STATES
        found = assert_whole(root)
        imu = found['topics']['/imu']
        assert (imu['received'], imu['stored'], imu['missed_by']) == (6, 3, {'transport': 2})
        assert (imu['rejected'], imu['dropped']) == ({'truncated': 1}, {'queue_full': 1, 'restart': 1})
        assert found['topics']['/camera']['stored_in'] == before['topics']['/camera']['stored_in']
        put(spool, make('thor/camera/new.jpg', b'new'))
        assert_whole(root)
    with closing(sqlite3.connect(root / 'index.db')) as db:
        assert db.execute('PRAGMA user_version').fetchone() == (SCHEMA_VERSION,)
    again = new_spool(root)
    again.open()
    assert not again.recovery.found_anything
    again.close()


@pytest.mark.parametrize('version', WITH_BAGS)
def test_a_recording_goes_on(tmp_path: Path, version: int) -> None:
    """A bag of two slices, one of them open, is made whole: each message is in it once, and its folder goes."""
    bag = restored(version, tmp_path)['bag']
    with desk(tmp_path, later()) as it:
        until(lambda: not any(it.root.iterdir()), 'its folder is gone')
        row, found = it.row(), {name: path for name, path in it.objects().items() if name.startswith(bag)}
        assert sorted(found) == [f'{bag}/{file}' for file in ('manifest.json', 'metadata.yaml', f'{bag}_0.mcap', f'{bag}_1.mcap')]
        assert [*numbers(found[f'{bag}/{bag}_0.mcap']), *numbers(found[f'{bag}/{bag}_1.mcap'])] == list(range(1, 16))
        assert manifest(found, bag)['state'] == 'recovered'
        assert (row['received'], row['stored'], row['open'], row['dropped']) == (15, 15, 0, {})


@pytest.mark.parametrize('version', WITH_MISSIONS)
def test_missions_go_on(tmp_path: Path, version: int) -> None:
    """One that was half sent gets the rest and nothing twice; one whose agent died is sent whole, and ended as KILLED."""
    restored(version, tmp_path)
    half, dead = sorted(missions(tmp_path), key=lambda folder: folder.run() is None)
    tracking, spooler = sent(half)
    points = Counter(point.key for point in tracking.points)
    assert (points['a'], points['late'], points['success']) == (0, 1, 1)
    assert (tracking.runs, [run[:2] for run in tracking.finished]) == ({}, [('run0', 'FINISHED')])
    assert {name.rpartition('/')[2] for name in spooler.names()} == {'frame_000001.jpg', 'summary.json'}
    assert tracking.artifacts['camera/frame_000001.jpg'] == b'\xff\xd8 frame \xff\xd9'
    tracking, spooler = sent(dead)
    assert [point.value for point in tracking.points if point.key == 'b'] == [0.0, 1.0, 2.0]
    assert [status for _, status, _ in tracking.finished] == ['KILLED']
    for folder in (half, dead):
        assert sent(folder)[0] == FakeTracking(), 'nothing is sent again'


def sent(folder: MissionFolder) -> tuple[FakeTracking, FakeSpooler]:
    """What a sender of today sends of it, to the end."""
    tracking, spooler = FakeTracking(), FakeSpooler()
    delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]
    for _ in range(50):
        if folder.sent().complete or ([delivery.track(), delivery.attach(), delivery.spool()] and delivery.complete()):
            return tracking, spooler
    raise AssertionError(f'{folder.path} is not sent')


@pytest.mark.parametrize('killed', [False, True])
def test_a_newer_home_is_left_alone(tmp_path: Path, killed: bool) -> None:
    """Whoever of an older version opens it says so, and no byte changes: not of the write-ahead log of a node that was killed."""
    home = tmp_path / 'home'
    with desk(home, later()) as it:
        put(it.spool, make('a', b'a'), make('b', b'b', held='clock'))
        left = Path(shutil.copytree(home, tmp_path / 'killed')) if killed else home
    root = left / 'spool'
    db = sqlite3.connect(root / 'index.db', isolation_level=None)
    db.execute('CREATE TABLE of_a_newer_version (id)')
    db.execute(f'PRAGMA user_version = {SCHEMA_VERSION + 1}')
    if killed:  # before a checkpoint: what is new lies in the log alone
        root = Path(shutil.copytree(root, tmp_path / 'newer'))
        assert (root / 'index.db-wal').stat().st_size
    db.close()
    before = contents(root)
    refusals = [
        lambda: new_spool(root).open(), lambda: ledger.read(root, 'thor'), lambda: retry(root),
        lambda: Deliveries(root).open('x'),
    ]  # fmt: skip
    for opening in refusals:
        with pytest.raises(SpoolError, match=rf'version {SCHEMA_VERSION + 1}.*update shadowhound_data_logger'):
            opening()
        assert contents(root) == before


def contents(root: Path) -> dict[str, bytes]:
    """Of all files but locks, which are empty, and what SQLite keeps beside an index for those that read it."""
    found = {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.rglob('*')) if path.is_file()}
    return {name: body for name, body in found.items() if body and not name.endswith('-shm')}
