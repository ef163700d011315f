"""A spool on a real file system that is full or read-only: it waits, reports once, and resumes."""

from __future__ import annotations

import logging
import os
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from shipping.fakes import until
from spool.conftest import Open
from spool.making import FakeClock, assert_whole, files, make, new_spool, put, receive, rows

from shadowhound_data_logger.core import worker
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool import ballast
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter

MEBI = 1 << 20
DISK_BYTES = 32 * MEBI
RESERVE = 4 * MEBI


@pytest.fixture
def root(tmp_path: Path) -> Iterator[Path]:
    """The spool's folder on a separate file system."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={DISK_BYTES}', 'none', str(disk)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip('this user may not mount a file system')
    yield disk / 'spool'
    subprocess.run(['umount', '--lazy', str(disk)], check=True)


@pytest.fixture
def disk(root: Path) -> Path:
    return root.parent


def fill(disk: Path) -> Path:
    """Write until no space is free."""
    path = disk / 'filler'
    with path.open('ab', buffering=0) as file:
        while free(disk):
            file.write(bytes(4096))
    return path


def free(disk: Path) -> int:
    return os.statvfs(disk).f_bavail


def test_the_spool_evicts_on_a_disk_that_another_process_fills(root: Path, disk: Path, opened: Open) -> None:
    """The ballast lets the spool record evictions, so that it keeps the newest objects even when no space was free."""
    spool = opened(min_free_bytes=RESERVE)
    put(spool, make('event', bytes(MEBI), protected=True), *(make(f'{number}', bytes(MEBI)) for number in range(10)))
    filler = fill(disk)
    for number in range(20):
        put(spool, make(f'new/{number}', bytes(400_000)))
    found = assert_whole(root)
    assert found['objects']['evicted'] > 0
    states = {row['key']: row['state'] for row in rows(root)}
    assert (states['event'], states['0'], states['new/19']) == ('pending', 'evicted', 'pending')
    assert not (root / 'ballast').exists()
    filler.unlink()
    put(spool, make('last'))
    assert (root / 'ballast').stat().st_size == ballast.BALLAST_BYTES


def test_the_spool_starts_on_a_full_disk(root: Path, disk: Path, opened: Open) -> None:
    """It uses the ballast; the index is not treated as damaged because SQLite cannot create its log."""
    spool = opened(min_free_bytes=RESERVE)
    put(spool, *(make(f'{number}', bytes(MEBI)) for number in range(12)))
    spool.close()
    fill(disk)
    spool = opened(min_free_bytes=RESERVE)
    assert not spool.recovery.found_anything
    put(spool, make('new'))
    assert assert_whole(root)['objects']['spooled'] == 13


def test_a_start_without_any_space_fails_with_the_reason(root: Path, disk: Path, opened: Open) -> None:
    """Without a ballast the start fails with the reason, and the index is unchanged for the next one."""
    spool = opened(min_free_bytes=RESERVE)
    put(spool, make('old'))
    spool.close()
    (root / 'ballast').unlink()
    filler = fill(disk)
    before = files(root)
    with pytest.raises(SpoolError, match='cannot be used'):
        new_spool(root, min_free_bytes=RESERVE).open()
    filler.unlink()
    spool = opened(min_free_bytes=RESERVE)
    assert not spool.recovery.found_anything
    assert files(root) == before
    assert not list(root.glob('*damaged*'))


def test_no_ballast_where_there_is_little_space(root: Path, disk: Path, opened: Open) -> None:
    """The ballast does not use space that must stay free."""
    spool = opened(min_free_bytes=DISK_BYTES - ballast.BALLAST_BYTES // 2)
    put(spool, make('p', protected=True))
    assert not (root / 'ballast').exists()


@pytest.fixture
def writing(root: Path) -> Iterator[Callable[..., tuple[Spool, SpoolWriter]]]:
    """An open spool with its writer."""
    opened: list[tuple[Spool, SpoolWriter]] = []

    def open_one(**settings: float) -> tuple[Spool, SpoolWriter]:
        spool = new_spool(root, FakeClock(), **settings)
        spool.open()
        writer = SpoolWriter(spool, 0.001)
        writer.open()
        opened.append((spool, writer))
        return opened[-1]

    yield open_one
    for spool, writer in opened:
        assert writer.close(60)
        spool.close()


@pytest.mark.parametrize('trouble', ['full', 'read-only'])
def test_the_writer_loses_nothing_while_the_disk_accepts_nothing(
    root: Path, disk: Path, writing: Callable[..., tuple[Spool, SpoolWriter]], trouble: str,
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """The writer keeps everything it has, reports the start and the end, and loses nothing once the disk accepts writes."""
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(worker, 'FIRST_PAUSE_S', 0.001)
    monkeypatch.setattr(worker, 'LONGEST_PAUSE_S', 0.01)
    monkeypatch.setattr(ballast, 'BALLAST_BYTES', DISK_BYTES)  # no space
    spool, writer = writing()
    connection = spool._connections.writing._db
    receive(spool, 3)
    writer.put(make('0', bytes(MEBI)))
    assert writer.flush(60)
    filler = fill(disk) if trouble == 'full' else None
    if trouble == 'read-only':
        connection.execute('PRAGMA query_only = 1')
    writer.put(make('1', bytes(MEBI)))
    writer.put(make('2', bytes(MEBI)))
    assert not writer.flush(0.2)
    until(lambda: writer.worker.failures > 3)
    assert writer.worker.failing
    assert rows(root)[0]['key'] == '0'
    if filler:
        filler.unlink()
    else:
        connection.execute('PRAGMA query_only = 0')
    assert writer.flush(60)
    assert assert_whole(root)['topics']['/camera']['stored'] == 3
    until(lambda: not writer.worker.failing)  # it is reported after the commit
    reports = [record.getMessage() for record in caplog.records if record.name.endswith('worker')]
    assert len(reports) == 2, reports
    assert 'cannot be written' in reports[0]
    assert 'works again after' in reports[1]
    assert 'Traceback' not in caplog.text


def test_an_io_error_is_a_full_disk_only_if_nothing_is_free(disk: Path) -> None:
    """SQLite's error for a log that cannot be created is a full disk only if no space is free."""
    error = sqlite3.OperationalError('disk I/O error')
    assert not ballast.is_disk_full(error, disk)
    fill(disk)
    assert ballast.is_disk_full(error, disk)
