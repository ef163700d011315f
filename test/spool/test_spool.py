"""Commits, keys, outcomes and order of the spool; a hung commit blocks neither readers nor the end."""

from __future__ import annotations

import json
import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from spool.child import started
from spool.conftest import Open
from spool.making import (
    BUCKET,
    KEY,
    NOON_NS,
    FakeClock,
    assert_whole,
    clear_uncataloged,
    files,
    make,
    new_spool,
    put,
    receive,
    rows,
    settle,
)

from shadowhound_data_logger.bags.local import RECORDS
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.keys import MAX_SEGMENT_BYTES
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool import spool as spool_module
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.spool import Outcome, Spool
from shadowhound_data_logger.spool.topic_account import BAG

DAY_NS = 24 * 3600 * SECOND


def test_a_commit_is_on_disk_under_its_final_name(spool: Spool, root: Path) -> None:
    """When commit returns, the complete object is under ready/<bucket>/<key>, with its hash and metadata."""
    (item,) = put(spool, make(metadata={'robot': 'thor'}))
    assert item.path == root / 'ready' / BUCKET / KEY
    assert item.path.read_bytes() == b'content'
    assert item.metadata == {
        'robot': 'thor', 'sensor': 'camera', 'topic': '/camera', 'type': 'sensor_msgs/msg/CompressedImage', 'count': '1',
        't_start_ns': str(NOON_NS), 't_end_ns': str(NOON_NS), 'sha256': item.sha256,
    }  # fmt: skip
    objects = assert_whole(root)['objects']
    assert (objects['spooled'], objects['pending']) == (1, 1)


def test_an_empty_commit_changes_nothing(spool: Spool, root: Path) -> None:
    assert spool.commit() == []
    assert rows(root) == []


def test_pending_returns_the_committed_objects(spool: Spool) -> None:
    """An object read from the index equals the one that commit returned."""
    items = put(spool, make(metadata={'robot': 'thor'}), make('thor/b', b''))
    assert spool.pending(5) == items


def test_a_key_is_given_out_once(spool: Spool, root: Path) -> None:
    """Objects that request the same key get _1, _2, ..., in one commit and over several."""
    items = put(spool, make(body=b'a'), make(body=b'b')) + put(spool, make(body=b'c'))
    assert [Path(item.key).name for item in items] == ['120000_front.jpg', '120000_front_1.jpg', '120000_front_2.jpg']
    assert [item.path.read_bytes() for item in items] == [b'a', b'b', b'c']
    assert_whole(root)


def test_the_same_key_in_two_buckets_is_two_keys(spool: Spool) -> None:
    """A key is unique in its bucket only."""
    assert [item.key for item in put(spool, make(), make(bucket='trajectories'))] == [KEY, KEY]


def test_the_longest_key_can_be_numbered(spool: Spool, root: Path) -> None:
    """A key of maximum length gets its number within the limit."""
    key = 'thor/' + 'x' * (MAX_SEGMENT_BYTES - 4) + '.jpg'
    items = put(spool, make(key), make(key))
    assert {len(item.key) for item in items} == {len(key)}
    assert_whole(root)


def test_a_restart_within_a_second_gives_no_key_twice(opened: Open, root: Path) -> None:
    """Delivered keys are remembered after a restart."""
    spool = opened()
    (item,) = put(spool, make())
    settle(spool, item, State.DELIVERED)
    spool.close()
    assert put(opened(), make())[0].key.endswith('_front_1.jpg')
    assert_whole(root)


def test_delivered_objects_leave_the_disk(spool: Spool, root: Path) -> None:
    """A confirmed delivery removes the file and is counted; so is a duplicate."""
    one, two = put(spool, make(), make())
    spool.commit(outcomes=[Outcome(one, State.DELIVERED), Outcome(two, State.DEDUPLICATED)])
    assert files(root) == {}
    found = assert_whole(root)
    assert (found['objects']['delivered'], found['objects']['deduplicated'], found['objects']['pending']) == (1, 1, 0)
    assert spool.pending(9) == []
    assert spool.pending_count() == 0


def test_an_outcome_counts_once(spool: Spool, root: Path) -> None:
    """The first outcome of an object is final, and reporting it again changes nothing."""
    (item,) = put(spool, make())
    settle(spool, item, State.DELIVERED)
    settle(spool, item, State.DELIVERED)
    settle(spool, item, State.QUARANTINED, 'refused')
    assert assert_whole(root)['objects']['delivered'] == 1


REASONS = [('refused', 'refused'), ('../../etc', '__.._etc'), ('', 'unknown'), (None, 'unknown')]


@pytest.mark.parametrize(('reason', 'folder'), REASONS)
def test_quarantine_moves_the_file(spool: Spool, root: Path, reason: str | None, folder: str) -> None:
    """A quarantined object is kept under its reason, inside the spool for any reason."""
    (item,) = put(spool, make())
    settle(spool, item, State.QUARANTINED, reason)
    assert list(files(root)) == [f'quarantine/{folder}/{BUCKET}/{KEY}']
    assert [row['state'] for row in rows(root)] == ['quarantined']
    assert spool.pending(1) == []


def test_quarantine_moves_a_file_that_is_being_read(spool: Spool, root: Path) -> None:
    """A half-read query, as a status has on a busy machine, does not hide the outcome."""
    (item,) = put(spool, make())
    half = spool._connections.reading._db.execute('SELECT * FROM tally')
    assert half.fetchone()
    settle(spool, item, State.QUARANTINED, 'foreign')
    assert half.fetchone(), 'the query was not finished'
    half.close()
    assert_whole(root)


def test_held_objects_wait(spool: Spool, root: Path) -> None:
    """An object without a final name is durable, but is not pending."""
    assert put(spool, make(held='clock')) == []
    assert spool.pending(1) == []
    assert list(files(root)) == [f'held/clock/{BUCKET}/{KEY}']
    assert assert_whole(root)['objects']['held'] == 1


def test_pending_objects_are_ordered_by_priority_or_age(spool: Spool) -> None:
    """The most important first, then the oldest; or the oldest first."""
    put(spool, make('a', priority=5), make('b', priority=1), make('c', priority=5), make('d', priority=0))
    assert [item.key for item in spool.pending(9)] == ['d', 'b', 'a', 'c']
    assert [item.key for item in spool.pending(2, oldest=True)] == ['a', 'b']


def test_pending_excludes_objects(spool: Spool) -> None:
    """Objects being delivered and closed buckets do not count toward the limit."""
    items = put(spool, *(make(str(number)) for number in range(6)), make('x', bucket='shut'))
    taken = {item.id for item in items[:4]}
    assert [item.key for item in spool.pending(2, exclude=taken)] == ['4', '5']
    assert [item.key for item in spool.pending(9, exclude=taken, without=['shut', 'other'])] == ['4', '5']


def test_other_users_cannot_read(spool: Spool, root: Path) -> None:
    """The spool's folders have mode 700 and its files 600."""
    put(spool, make(), make(held='clock'))
    mode = {path.relative_to(root).as_posix(): stat.S_IMODE(path.stat().st_mode) for path in [root, *root.rglob('*')]}
    assert {name: oct(bits) for name, bits in mode.items() if (root / name).is_file() and bits != 0o600} == {}
    top = ['.', 'incoming', 'ready', 'held', 'quarantine', 'sessions']
    assert {name: oct(mode[name]) for name in top if mode[name] != 0o700} == {}


def test_old_deliveries_are_forgotten_and_totals_stay(spool: Spool, root: Path, clock: FakeClock) -> None:
    """After remember_days the rows of delivered objects are removed; the ledger does not change."""
    delivered, kept = put(spool, make('a'), make('b'))
    settle(spool, delivered, State.DELIVERED)
    before = assert_whole(root)
    clock.now_ns += 31 * DAY_NS
    spool.commit()
    assert len(rows(root)) == 2, 'the catalog does not have its row yet'
    clear_uncataloged(root)
    clock.now_ns += DAY_NS
    spool.commit()
    assert [row['id'] for row in rows(root)] == [kept.id]
    assert assert_whole(root) == before


def test_forgetting_keeps_up_with_deliveries(spool: Spool, root: Path, clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """While more than one step is due, each commit forgets one, instead of one per hour."""
    monkeypatch.setattr('shadowhound_data_logger.spool.history_table.FORGET_STEP', 2)
    items = put(spool, *(make(str(number)) for number in range(5)))
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])
    clear_uncataloged(root)
    clock.now_ns += 31 * DAY_NS
    left = []
    for _ in range(3):
        spool.commit()
        left.append(len(rows(root)))
    assert left == [3, 1, 0]


def test_accounts_survive_a_stop(opened: Open, root: Path) -> None:
    """Close commits whatever is counted but not committed, and may be called twice."""
    spool = opened()
    receive(spool, 3)
    with spool.accounts.entry('/camera') as account:
        account.skipped += 3
    spool.close()
    spool.close()
    assert assert_whole(root)['topics']['/camera']['skipped'] == 3
    assert not list((root / 'sessions').iterdir())


def test_sequence_numbers_continue_after_a_stop(opened: Open, root: Path) -> None:
    """What a publisher sent between two sessions is missed by restart."""
    spool = opened()
    put(spool, make())
    spool.close()
    spool = opened()
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 5)
    assert spool.accounts.last_stored_ns('/camera') == NOON_NS
    spool.commit([make()])
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['published'], topic['received'], topic['missed_by']) == (5, 2, {'restart': 3})


@pytest.mark.parametrize('ends', [False, True])
def test_sequence_numbers_are_separate_from_bag_record(opened: Open, *, ends: bool) -> None:
    """Messages received by a ``bag record`` that runs next to a node, or did, do not affect the accounts of the node's bags."""

    def took(spool: Spool, *numbers: int) -> None:
        for account in ('/camera', f'{BAG}/camera'):
            with spool.accounts.entry(account) as entry:
                assert all(entry.receive('p', number) for number in numbers)
        spool.commit([make(f'thor/camera/20251018/{numbers[0]}.jpg')])

    node = opened()
    took(node, 1, 2)
    recorder = opened(f'thor {RECORDS}')
    with recorder.accounts.entry(f'{BAG}/camera') as entry:
        assert all(entry.receive('p', number) for number in range(2, 7))
    recorder.commit([])
    if ends:
        recorder.close()
        took(node, 3, 4, 5, 6, 7, 8)
    node.close()
    again = opened()
    took(again, 10)
    missed = {sink: again.accounts.totals(sink)['/camera'].missed for sink in ('', BAG)}
    assert missed == dict.fromkeys(('', BAG), 1 if ends else 7)


def test_one_process_drains(opened: Open) -> None:
    """The drain lock is held once, and can be taken again after its release."""
    one, two = opened(), opened()
    with one.drain_lock() as first, two.drain_lock() as second:
        assert (first, second) == (True, False)
    with two.drain_lock() as again:
        assert again


def test_the_drain_lock_ends_with_its_process(spool: Spool, root: Path) -> None:
    """Another process's drain lock is respected, and free once that process was killed."""
    with started('hold', root) as child:
        assert child.stdout is not None
        assert json.loads(child.stdout.readline()) == {'mine': True}
        with spool.drain_lock() as mine:
            assert not mine
    with spool.drain_lock() as mine:
        assert mine


@pytest.mark.long('two processes')
def test_two_processes_add_concurrently(opened: Open, root: Path) -> None:
    """Both add all of their objects, complete and with unique keys, even if other processes open the spool at the same time."""
    with started('add', root, 'one', 150) as one, started('add', root, 'two', 150) as two:
        for child in (one, two):
            assert child.stdout is not None
            child.stdout.readline()
        openings = 0
        while one.poll() is None or two.poll() is None:
            opener = opened()
            assert opener.recovery.describe() in {'', '1 renames completed', '2 renames completed'}  # at most one of each
            opener.close()
            openings += 1
    assert (one.returncode, two.returncode) == (0, 0)
    assert openings > 0
    found = assert_whole(root)
    assert found['objects']['pending'] == 300
    assert [found['topics'][f'/{name}']['stored_in']['pending'] for name in ('one', 'two')] == [150, 150]
    assert len({row['key'] for row in rows(root)}) == 300


def test_another_process_reads_what_was_added(opened: Open) -> None:
    """The draining process finds what another one committed; and a part not renamed yet is renamed."""
    adder, drainer = opened(), opened()
    (item,) = put(adder, make())
    os.replace(item.path, adder.root / 'incoming' / f'{item.id}.part')
    (found,) = drainer.pending(1)
    assert found.path.read_bytes() == b'content'
    assert found == item


def test_an_unusable_folder_is_an_error(tmp_path: Path) -> None:
    """A spool path that is a file is refused with its name and a remedy."""
    (tmp_path / 'spool').write_text('a file')
    with pytest.raises(SpoolError, match=r'spool cannot be used: .*SHADOWHOUND_HOME'):
        new_spool(tmp_path / 'spool').open()


def test_an_unreadable_folder_stops_nothing(spool: Spool, root: Path) -> None:
    """An object whose folder cannot be created is committed, shipped from where it is, and counted once."""
    put(spool, make('thor/a'))
    (item,) = put(spool, make('thor/a/b', b'below'))
    assert item.path.read_bytes() == b'below'
    assert spool.pending(9)[1] == item
    settle(spool, item, State.DELIVERED)
    assert list(files(root)) == [f'ready/{BUCKET}/thor/a']
    assert_whole(root)


def test_a_spool_that_was_not_opened_refuses_calls() -> None:
    """Using a spool before it is open raises an error."""
    with pytest.raises(SpoolError, match='not open'):
        new_spool(Path('nowhere')).pending(1)


@pytest.fixture
def hanging(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> Iterator[Spool]:
    """One object is pending, and the sync of a second one does not return until the test ends."""
    put(spool, make('thor/first.jpg'))
    entered, let_go = threading.Event(), threading.Event()

    def sync(_: Tree) -> None:
        entered.set()
        assert let_go.wait(60)

    monkeypatch.setattr(Tree, 'sync_incoming', sync)
    thread = threading.Thread(target=put, args=(spool, make('thor/second.jpg')))
    thread.start()
    assert entered.wait(60)
    yield spool
    let_go.set()
    thread.join(60)


def test_pending_objects_are_listed_during_a_hung_commit(hanging: Spool) -> None:
    """The log line about it must not hang either."""
    assert hanging.pending_count() == 1


def test_closing_does_not_wait_for_a_hung_commit(hanging: Spool, monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    """It names the disk, and can be repeated when the disk responds."""
    monkeypatch.setattr(spool_module, 'CLOSE_S', 0.01)
    with pytest.raises(SpoolError, match=f'{root} cannot be closed: its disk does not answer'):
        hanging.close()
