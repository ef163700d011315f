"""What a start finds after a stop, a crash or an operator's hand. It never fails, and the ledger closes after it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import (
    BUCKET,
    NOON_NS,
    READY,
    FakeClock,
    abandon,
    assert_whole,
    files,
    make,
    new_spool,
    receive,
    reopened,
    rows,
    settle,
)

from shadowhound_data_logger.core.model import State


def test_nothing_to_do_after_a_clean_stop(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A clean stop leaves nothing to recover and every file where it was."""
    assert reopened(opened, root) == {}
    assert files(root) == used


@pytest.mark.parametrize('content', [b'', b'x', b'longer than it was'])
def test_a_file_of_another_size(opened: Open, root: Path, used: dict[str, bytes], content: bytes) -> None:
    """A cut file is quarantined as damaged."""
    (root / READY / 'thor/a/2.jpg').write_bytes(content * 3)
    assert reopened(opened, root) == {'files damaged': 1}
    assert (root / f'quarantine/damaged/{BUCKET}/thor/a/2.jpg').read_bytes() == content * 3


def test_a_missing_file(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """An object whose file is gone is quarantined as missing, once."""
    (root / READY / 'thor/a/2.jpg').unlink()
    (root / f'held/clock/{BUCKET}/thor/held.jpg').unlink()
    (root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg').unlink()
    assert reopened(opened, root) == {'files missing': 3}
    assert assert_whole(root)['objects']['quarantined'] == 3


@pytest.mark.parametrize('where', [READY, f'quarantine/missing/{BUCKET}'])
def test_a_missing_file_that_comes_back(opened: Open, root: Path, used: dict[str, bytes], where: str) -> None:
    """A file that was moved away and back is delivered after all; another one in its place is set aside."""
    paths = [root / READY / f'thor/a/{number}.jpg' for number in (2, 3)]
    for path in paths:
        path.unlink()
    opened().close()
    for path, content in zip(paths, (b'2', b'forged'), strict=True):
        back = root / where / path.relative_to(root / READY)
        back.parent.mkdir(parents=True, exist_ok=True)
        back.write_bytes(content)
    assert reopened(opened, root) == {'missing files back': 1, 'foreign files set aside': 1}
    assert [row['key'] for row in rows(root) if row['reason'] == 'missing'] == ['thor/a/3.jpg']
    assert paths[0].read_bytes() == b'2'
    assert b'forged' in files(root).values()


@pytest.mark.parametrize('empty', [True, False])
def test_a_folder_where_a_file_was(opened: Open, root: Path, used: dict[str, bytes], empty: bool) -> None:
    """A folder in an object's place leaves the object missing, and what lies in it is adopted."""
    path = root / READY / 'thor/a/2.jpg'
    path.unlink()
    path.mkdir()
    if not empty:
        (path / 'inner.jpg').write_bytes(b'inner')
    assert reopened(opened, root) == {'files missing': 1} | ({} if empty else {'files adopted': 1})


def test_a_folder_in_the_way_of_a_part(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A part whose place is taken is shipped from where it is."""
    (row,) = (row for row in rows(root) if row['key'] == 'thor/a/2.jpg')
    path = root / READY / 'thor/a/2.jpg'
    os.replace(path, root / 'incoming' / f'{row["id"]}.part')
    path.mkdir()
    (path / 'inner.jpg').write_bytes(b'inner')
    spool = opened()
    (found,) = (item for item in spool.pending(99) if item.key == row['key'])
    assert found.path.read_bytes() == b'2'
    settle(spool, found, State.DELIVERED)
    assert_whole(root)


def test_parts_of_no_row(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A part that was never committed is removed."""
    (root / 'incoming/4711.part').write_bytes(b'x')
    assert reopened(opened, root) == {'uncommitted parts removed': 1}


def test_open_messages_of_a_dead_session(root: Path, opened: Open) -> None:
    """What a session had received without an outcome when it died is dropped by restart, for each topic."""
    dead = new_spool(root, FakeClock())
    dead.open()
    receive(dead, 5)
    dead.commit([make(samples=2)])
    abandon(dead)
    spool = opened()
    assert spool.recovery.describe() == '3 messages lost with an open batch'
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['dropped'], topic['open']) == ({'restart': 3}, 0)


def test_a_clock_that_went_back(opened: Open, root: Path, clock: FakeClock, used: dict[str, bytes]) -> None:
    """A start with a clock before all that is in the spool changes nothing."""
    clock.now_ns = NOON_NS // 100
    assert reopened(opened, root) == {}


def test_empty_folders_go(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Folders of past days that are empty are removed, the spool's own are not."""
    (root / READY / 'thor/camera/20200101').mkdir(parents=True)
    opened().close()
    assert not (root / READY / 'thor/camera').exists()
    assert all((root / name).is_dir() for name in ('ready', 'held', 'quarantine', 'incoming'))


def test_what_is_moved_back_from_quarantine_is_tried_again(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A quarantined file that an operator moves to ready is delivered."""
    source = root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg'
    source.rename(root / f'ready/{BUCKET}/thor/a/1.jpg')
    spool = opened()
    assert spool.recovery.counts['quarantined files to be tried again'] == 1
    assert 'thor/a/1.jpg' in {item.key for item in spool.pending(99)}
    assert_whole(root)
