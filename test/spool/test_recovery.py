"""Recovery at startup: after kills at any moment, lost logs and damaged files the ledger balances."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import pytest
from spool.child import started
from spool.conftest import Moments, Open
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
    put,
    receive,
    reopened,
    rows,
    settle,
)

from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.spool.files import ATTRIBUTE
from shadowhound_data_logger.spool.spool import Spool


def test_a_clean_stop_leaves_nothing_to_recover(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Every file is where it was."""
    assert reopened(opened, root) == {}
    assert files(root) == used


@pytest.mark.parametrize('content', [b'', b'x', b'longer than it was'])
def test_a_file_of_another_size_is_quarantined(opened: Open, root: Path, used: dict[str, bytes], content: bytes) -> None:
    """A truncated file is quarantined as damaged."""
    (root / READY / 'thor/a/2.jpg').write_bytes(content * 3)
    assert reopened(opened, root) == {'files damaged': 1}
    assert (root / f'quarantine/damaged/{BUCKET}/thor/a/2.jpg').read_bytes() == content * 3


def test_an_object_without_its_file_is_quarantined(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """An object whose file is gone is quarantined as missing, once."""
    (root / READY / 'thor/a/2.jpg').unlink()
    (root / f'held/clock/{BUCKET}/thor/held.jpg').unlink()
    (root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg').unlink()
    assert reopened(opened, root) == {'files missing': 3}
    assert assert_whole(root)['objects']['quarantined'] == 3


@pytest.mark.parametrize('where', [READY, f'quarantine/missing/{BUCKET}'])
def test_a_missing_file_that_reappears_is_adopted(opened: Open, root: Path, used: dict[str, bytes], where: str) -> None:
    """A file that was moved away and back is delivered; a different file in its place is set aside."""
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
def test_a_folder_in_place_of_a_file_is_set_aside(opened: Open, root: Path, used: dict[str, bytes], empty: bool) -> None:
    """The object is missing, and the contents of the folder are adopted."""
    path = root / READY / 'thor/a/2.jpg'
    path.unlink()
    path.mkdir()
    if not empty:
        (path / 'inner.jpg').write_bytes(b'inner')
    assert reopened(opened, root) == {'files missing': 1} | ({} if empty else {'files adopted': 1})


def test_a_part_is_sent_although_a_folder_is_at_its_path(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A part whose final path is taken is shipped from where it is."""
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


def test_parts_without_a_row_are_removed(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    (root / 'incoming/4711.part').write_bytes(b'x')
    assert reopened(opened, root) == {'uncommitted parts removed': 1}


def test_open_messages_of_a_dead_session_are_dropped(root: Path, opened: Open) -> None:
    """Messages that a session had received without an outcome when it was killed are dropped by restart, for each topic."""
    dead = new_spool(root, FakeClock())
    dead.open()
    receive(dead, 5)
    dead.commit([make(samples=2)])
    abandon(dead)
    spool = opened()
    assert spool.recovery.describe() == '3 messages lost with an open batch'
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['dropped'], topic['open']) == ({'restart': 3}, 0)


def test_a_clock_that_went_back_changes_nothing(opened: Open, root: Path, clock: FakeClock, used: dict[str, bytes]) -> None:
    """Starting with a clock before every time in the spool changes nothing."""
    clock.now_ns = NOON_NS // 100
    assert reopened(opened, root) == {}


def test_empty_folders_are_removed(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Empty folders of past days are removed, the spool's folders are not."""
    (root / READY / 'thor/camera/20200101').mkdir(parents=True)
    opened().close()
    assert not (root / READY / 'thor/camera').exists()
    assert all((root / name).is_dir() for name in ('ready', 'held', 'quarantine', 'incoming'))


def test_files_moved_back_from_quarantine_are_retried(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A quarantined file that an operator moves to ready is delivered."""
    source = root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg'
    source.rename(root / f'ready/{BUCKET}/thor/a/1.jpg')
    spool = opened()
    assert spool.recovery.counts['quarantined files to be tried again'] == 1
    assert 'thor/a/1.jpg' in {item.key for item in spool.pending(99)}
    assert_whole(root)


def died(root: Path, moment: str) -> None:
    with started('die', root, moment) as child:
        assert child.wait(60) < 0
    assert len(list((root / 'incoming').iterdir())) == 2


def lose_log(root: Path) -> None:
    for suffix in ('-wal', '-shm'):
        (root / f'index.db{suffix}').unlink()


@pytest.mark.parametrize('before', ['nothing', 'a session'])
@pytest.mark.parametrize('moment', ['committed', 'checkpointed'])
def test_committed_objects_survive_the_loss_of_the_log(opened: Open, root: Path, before: str, moment: str) -> None:
    """If the process was killed before the files of a commit had their names, they are adopted, whatever the index contains."""
    if before == 'a session':
        spool = opened()
        settle(spool, put(spool, make('thor/before.jpg'))[0], State.DELIVERED)
        spool.close()
    died(root, moment)
    lose_log(root)
    done = reopened(opened, root)
    assert done['files adopted'] == (2 if moment == 'checkpointed' else 3)
    found = {row['key']: (row['state'], row['reason']) for row in rows(root) if row['state'] != 'delivered'}
    assert found == {'thor/whole.jpg': ('pending', None), 'thor/a.jpg': ('pending', None), 'thor/b.jpg': ('held', 'clock')}
    assert not list((root / 'sessions').iterdir())


def test_an_uncommitted_file_is_removed(opened: Open, root: Path) -> None:
    """With its log the index knows every committed file; anything else is lost by the restart, and reported as such."""
    died(root, 'uncommitted')
    done = reopened(opened, root)
    assert done['files not committed'] == 2
    assert [row['key'] for row in rows(root) if row['state'] == 'pending'] == ['thor/whole.jpg']


def test_an_incomplete_part_is_not_adopted(opened: Open, root: Path) -> None:
    """A truncated part is removed, with or without the log, and the other one of its commit is kept."""
    died(root, 'committed')
    part = min((root / 'incoming').iterdir())
    part.write_bytes(part.read_bytes()[:-1])
    lose_log(root)
    done = reopened(opened, root)
    assert (done['files adopted'], done['uncommitted parts removed']) == (2, 1)
    assert_whole(root)


def test_a_part_has_its_first_name_again_after_a_power_cut(opened: Open, root: Path) -> None:
    """The commit is durable, its renames are not: the content is found by its checksum, even without attributes."""
    died(root, 'committed')
    parts = sorted((root / 'incoming').iterdir())
    assert len(parts) == 2
    (session,) = (int(path.name) for path in (root / 'sessions').iterdir())
    for number, part in enumerate(parts):
        os.removexattr(part, ATTRIBUTE)
        part.rename(part.with_name(f'{session}-{number:032x}.body'))
    done = reopened(opened, root)
    assert done == {'renames completed': 2}
    assert {row['key']: row['state'] for row in rows(root) if row['state'] != 'delivered'} == {
        'thor/whole.jpg': 'pending', 'thor/a.jpg': 'pending', 'thor/b.jpg': 'held'}  # fmt: skip
    assert not list((root / 'incoming').iterdir())
    assert_whole(root)


def reopened_spool(root: Path) -> Spool:
    spool = new_spool(root)
    spool.open()
    return spool


def test_a_kill_at_any_moment_of_a_commit_loses_nothing(root: Path, moments: Moments) -> None:
    """Objects, deliveries and accounts are all there (from the transaction on) or not at all, and can be used."""
    spool = reopened_spool(root)
    put(spool, make('old', b'old'), make('refused', b'refused'))
    spool.close()

    def work() -> None:
        spool = reopened_spool(root)
        old, refused = sorted(spool.pending(9), key=lambda item: item.key)
        receive(spool, 4)
        spool.commit([make('new/0', b'new'), make('new/1', b'new'), make('new/held', b'new', held='clock')],
                     [Outcome(old, State.DELIVERED), Outcome(refused, State.QUARANTINED, 'refused')])  # fmt: skip
        spool.close()

    seen: list[tuple[bool, str]] = []
    for copy in moments(work):
        spool = reopened_spool(copy)
        topic = assert_whole(copy)['topics']['/camera']
        state = {row['key']: row['state'] for row in rows(copy)}
        committed = 'new/0' in state
        if committed:
            assert state['old'] == 'delivered'
            assert state['refused'] in {'quarantined', 'pending'}, 'at worst it is tried once more'
            assert (state['new/0'], state['new/1'], state['new/held']) == ('pending', 'pending', 'held')
            assert (topic['received'], topic['stored'], sum(topic['dropped'].values())) == (6, 5, 1)
        else:
            assert state == {'old': 'pending', 'refused': 'pending'}
            assert (topic['received'], topic['stored'], topic['dropped']) == (2, 2, {})
        assert topic['open'] == 0
        seen.append((committed, next(iter(topic['dropped']), '')))
        goes_on(spool, copy, committed=committed)
        spool.close()
    assert [committed for committed, _ in seen] == sorted(committed for committed, _ in seen)
    assert set(seen) == {(False, ''), (True, 'restart'), (True, 'shutdown')}


def goes_on(spool: Spool, root: Path, *, committed: bool) -> None:
    """Pending objects can be delivered, new objects get unique keys, and a gap in the numbers is missed by restart."""
    for item in spool.pending(9):
        assert hashlib.sha256(item.path.read_bytes()).hexdigest() == item.sha256
        settle(spool, item, State.DELIVERED)
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 10)
    assert spool.commit([make('new/0')])[0].key == ('new/0_1' if committed else 'new/0')
    assert assert_whole(root)['topics']['/camera']['missed_by'] == {'restart': 3 if committed else 7}


@pytest.mark.long('a kill after each step')
def test_a_kill_at_any_moment_of_an_eviction_loses_nothing(root: Path, moments: Moments) -> None:
    """Evicted objects are evicted in the ledger and have no file; the new object is there or not."""
    spool = new_spool(root, max_bytes=1 << 20)
    spool.open()
    put(spool, *(make(f'{number}', bytes(200_000)) for number in range(4)))
    spool.close()

    def work() -> None:
        spool = new_spool(root, max_bytes=1 << 20)
        spool.open()
        put(spool, make('more', bytes(500_000)))
        spool.close()

    seen = set()
    for copy in moments(work):
        spool = reopened_spool(copy)
        assert_whole(copy)
        states = {row['key']: row['state'] for row in rows(copy)}
        evicted = sum(state == 'evicted' for state in states.values())
        assert evicted in {0, 2}
        assert 'more' not in states or evicted == 2
        seen.add((evicted, 'more' in states, spool.recovery.counts['delivered files removed']))
        spool.close()
    assert {(0, False, 0), (2, False, 2), (2, False, 1), (2, False, 0), (2, True, 0)} <= seen


def leave_a_mess(root: Path) -> None:
    """Return the spool of a killed process, with everything that startup must repair."""
    spool = reopened_spool(root)
    items = put(spool, *(make(f'a/{number}', b'%d' % number) for number in range(7)))
    settle(spool, items[0], State.DELIVERED)
    settle(spool, items[1], State.QUARANTINED, 'refused')
    receive(spool, 3)
    spool.commit()
    abandon(spool)
    ready = root / 'ready' / BUCKET / 'a'
    (ready / '0').write_bytes(b'0')  # delivered, but not removed
    (root / f'quarantine/refused/{BUCKET}/a/1').rename(ready / '1')  # quarantined by the index, but the file is not moved yet
    (ready / '2').rename(root / f'incoming/{items[2].id}.part')
    (ready / '3').unlink()
    (ready / '4').write_bytes(b'cut')
    (root / 'incoming/99.part').write_bytes(b'never committed')
    (ready / 'a b').write_bytes(b'foreign')
    (ready / 'copied').write_bytes(b'copied')


def settled(root: Path) -> dict[str, Any]:
    """The state of a spool at the end of startup."""
    found = assert_whole(root)
    return {'rows': {(row['key'], row['state'], row['reason'], row['sha256']) for row in rows(root)}, 'files': files(root),
            'topics': found['topics'], 'objects': found['objects']}  # fmt: skip


@pytest.mark.parametrize('index', ['whole', 'lost'])
@pytest.mark.long('a kill after each step')
def test_a_kill_at_any_moment_of_a_start_is_recovered(root: Path, moments: Moments, index: str) -> None:
    """The next start completes an interrupted one with the same result, also if it rebuilt the index."""
    leave_a_mess(root)
    if index == 'lost':
        for name in ('index.db-wal', 'index.db-shm'):
            (root / name).unlink(missing_ok=True)
        (root / 'index.db').write_bytes(b'garbage' * 1000)
    *died, lived = moments(lambda: reopened_spool(root).close())
    reopened_spool(lived).close()
    expected = settled(lived)
    assert {name.split('/')[0] for name in expected['files']} >= {'ready', 'foreign'}
    for copy in died:
        reopened_spool(copy).close()
        assert settled(copy) == expected, copy.name


def test_a_running_session_is_not_settled(opened: Open, root: Path) -> None:
    """A second process that opens the spool does not touch the open messages of the first."""
    one = opened()
    put(one, make())
    with one.accounts.entry('/camera') as account:
        account.receive('p', 2)
    one.commit()
    assert opened().recovery.describe() == ''
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['open'], topic['dropped']) == (1, {})
    assert len(files(root)) == 1
