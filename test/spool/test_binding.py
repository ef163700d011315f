"""Held objects get their final name completely or not at all, whatever happens in between, and only once."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from typing import Any

import pytest
from spool.child import started
from spool.conftest import Moments, Open
from spool.making import BUCKET, NOON_NS, READY, FakeClock, assert_whole, files, make, new_spool, put, rows, settle

from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.model import Binding, State
from shadowhound_data_logger.spool import recovery
from shadowhound_data_logger.spool.files import Tree, description_of
from shadowhound_data_logger.spool.object_table import ObjectTable
from shadowhound_data_logger.spool.recovery import _follow_rows
from shadowhound_data_logger.spool.spool import Spool

HELD = f'held/clock/{BUCKET}'


def hold(spool: Spool, *names: str, **fields: Any) -> list[Binding]:
    """Spool held objects; returns their final names."""
    put(spool, *(make(f'thor/provisional/{name}', name.encode(), **{'held': 'clock', **fields}) for name in names))
    return [final(item.id, item.key.rpartition('/')[2]) for item in spool.reading.objects.held('clock')]


def final(number: int, name: str) -> Binding:
    return Binding(number, f'thor/final/{name}', {'bound': 'yes'}, NOON_NS + 5, NOON_NS + 6)


def test_held_objects_are_listed_oldest_first(spool: Spool) -> None:
    """Those of one reason, up to the requested number, with everything a binding needs."""
    put(spool, *(make(f'k/{name}', held='clock', metadata={'name': name}) for name in 'cab'))
    put(spool, make('k/other', held='mission-7'), make('k/free'))
    one, two = spool.reading.objects.held('clock', 2)
    assert [one.key, two.key] == ['k/c', 'k/a']
    assert (one.bucket, one.metadata['name'], one.t_start_ns, one.t_end_ns, one.created_ns) == (BUCKET, 'c', *[NOON_NS] * 3)
    assert [item.key for item in spool.reading.objects.held('mission-7')] == ['k/other']


def test_a_bound_object_is_pending_under_its_final_name(spool: Spool, root: Path) -> None:
    """Row, file and description have the final name; content and checksum are unchanged."""
    (binding,) = hold(spool, 'a')
    (item,) = spool.bind([binding])
    assert (item.key, item.path, item.path.read_bytes()) == ('thor/final/a', root / READY / 'thor/final/a', b'a')
    assert item.metadata == {'bound': 'yes', 'sha256': item.sha256}
    assert spool.pending(9) == [item]
    (row,) = rows(root)
    report = description_of(item.path)
    for found in (row, report):
        assert (found['key'], found['t_start_ns'], found['t_end_ns']) == (item.key, NOON_NS + 5, NOON_NS + 6)
    assert (report['held'], report['metadata']) == (None, item.metadata)
    assert spool.reading.objects.held('clock') == []
    assert assert_whole(root)['objects']['pending'] == 1


def test_a_bound_object_counts_as_before(spool: Spool, root: Path) -> None:
    """The ledger balances, and the samples of a bound object are delivered in the end."""
    bindings = hold(spool, 'a', 'b', 'c')
    items = spool.bind(bindings[:2])
    assert assert_whole(root)['topics']['/camera']['stored_in']['held'] == 1
    settle(spool, items[0], State.DELIVERED)
    stored = assert_whole(root)['topics']['/camera']['stored_in']
    assert (stored['held'], stored['pending'], stored['delivered']) == (1, 1, 1)


def test_a_bound_object_keeps_its_topic(spool: Spool, root: Path) -> None:
    """The file with the final name also names the accounts, since a lost index is rebuilt from files."""
    (binding,) = hold(spool, 'a', topic=None, counts={'bag:/imu': 3, 'bag:/odom': 1})
    before = description_of(root / HELD / 'thor/provisional/a')
    (item,) = spool.bind([binding])
    report = description_of(item.path)
    assert report['counts'] == before['counts'] == {'bag:/imu': 3, 'bag:/odom': 1}
    assert report.keys() == before.keys()


def test_final_names_are_unique(spool: Spool) -> None:
    """A name already used, also in the same call, gets a number; an object may keep its current name."""
    put(spool, make('thor/final/a'))
    one, two, three = hold(spool, 'a', 'b', 'c')
    same = Binding(two.id, 'thor/final/a', {}, 1, 2)
    stays = Binding(three.id, 'thor/provisional/c', {}, 1, 2)
    assert [item.key for item in spool.bind([one, same, stays])] == ['thor/final/a_1', 'thor/final/a_2', 'thor/provisional/c']


def test_a_number_for_a_frequent_name_is_found_in_few_queries(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers are consecutive: an agent that numbers none of its frames must not block the index for others."""
    asked: list[str] = []
    row = ObjectTable.row

    def counting(table: ObjectTable, bucket: str, key: str) -> sqlite3.Row | None:
        asked.append(key)
        return row(table, bucket, key)

    monkeypatch.setattr(ObjectTable, 'row', counting)
    keys = [item.key for item in put(spool, *(make('thor/a.jpg', b'%d' % number) for number in range(300)))]
    assert keys == ['thor/a.jpg', *(f'thor/a_{number}.jpg' for number in range(1, 300))]
    assert len(asked) < 300 * 20


def test_objects_no_longer_held_are_skipped(spool: Spool, opened: Open, root: Path) -> None:
    """Binding an object a second time, for example by another process, changes nothing; nor does binding one that has left."""
    bindings = hold(spool, 'a', 'b')
    (done,) = opened().bind(bindings[:1])
    settle(spool, done, State.DELIVERED)
    again = spool.bind([final(bindings[0].id, 'x'), bindings[1], final(99, 'y')])
    assert [item.key for item in again] == ['thor/final/b']
    assert {row['key']: row['state'] for row in rows(root)} == {'thor/final/a': 'delivered', 'thor/final/b': 'pending'}
    assert_whole(root)


def test_an_invalid_name_binds_nothing(spool: Spool, root: Path) -> None:
    """One refused name leaves all objects unchanged."""
    one, two = hold(spool, 'a', 'b')
    before = files(root)
    with pytest.raises(NameRefused):
        spool.bind([one, Binding(two.id, '../b', {}, 1, 2)])
    assert files(root) == before
    assert assert_whole(root)['objects']['held'] == 2


def test_a_failing_disk_binds_nothing(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows, files and descriptions are unchanged, and the next try succeeds."""
    bindings = hold(spool, 'a', 'b')
    before = files(root)

    def fails(_: Tree) -> None:
        raise OSError(5, 'Input/output error')

    with monkeypatch.context() as broken:
        broken.setattr(Tree, 'sync_incoming', fails)
        with pytest.raises(OSError, match='Input/output'):
            spool.bind(bindings)
    assert files(root) == before
    report = description_of(root / HELD / 'thor/provisional/a')
    assert (report['key'], report['held']) == ('thor/provisional/a', 'clock')
    assert_whole(root)
    assert len(spool.bind(bindings)) == 2
    assert_whole(root)


def test_a_missing_file_does_not_block_others(spool: Spool, root: Path) -> None:
    """It is bound like any other, and delivery finds that it is missing."""
    bindings = hold(spool, 'a', 'b')
    (root / HELD / 'thor/provisional/a').unlink()
    assert [item.path.exists() for item in spool.bind(bindings)] == [False, True]
    assert spool.reading.objects.held('clock') == []


def test_waiting_time_starts_once_the_clock_is_set(spool: Spool, root: Path, clock: FakeClock) -> None:
    """The waiting time of an object dated 1970 counts from its true end, once that is known, not from 1970."""
    clock.now_ns = 60
    bindings = hold(spool, 'a')
    clock.now_ns = NOON_NS + 10
    spool.bind(bindings)
    assert rows(root)[0]['created_ns'] == NOON_NS + 6


@pytest.mark.parametrize(('moment', 'state'), [('renamed', 'held'), ('synced', 'held'), ('bound', 'pending')])
@pytest.mark.parametrize('index', ['kept', 'lost'])
def test_a_binding_killed_between_two_steps_is_completed(opened: Open, root: Path, moment: str, state: str, index: str) -> None:
    """Before the commit all are held, after it all are bound: rows, files and descriptions agree after the next start."""
    with started('bind', root, moment) as child:
        assert child.wait(60) == -9
    assert sorted(name.split('/')[0] for name in files(root)) == ['incoming', 'incoming']
    opened().close()
    if index == 'lost':
        for path in root.glob('index.db*'):
            path.unlink()
    spool = opened()
    folder = 'provisional' if state == 'held' else 'final'
    expected = {f'thor/{folder}/{name}' for name in 'ab'}
    assert {row['key'] for row in rows(root)} == expected
    for row in rows(root):
        assert (row['state'], row['reason']) == (state, 'clock' if state == 'held' else None)
        assert row['t_start_ns'] == (NOON_NS if state == 'held' else 5)
        assert ('bound' in row['metadata']) is (state == 'pending')
    assert_whole(root)
    spool.bind([final(item.id, item.key[-1]) for item in spool.reading.objects.held('clock')])
    assert {item.key for item in spool.pending(9)} == {'thor/final/a', 'thor/final/b'}


@pytest.mark.long('a kill after each step')
def test_a_kill_at_any_moment_of_a_binding_loses_nothing(root: Path, moments: Moments) -> None:
    """All objects are bound or none; the rest can be bound and delivered, and the ledger balances."""
    spool = new_spool(root)
    spool.open()
    hold(spool, 'a', 'b', 'c')
    spool.close()

    def work() -> None:
        spool = new_spool(root)
        spool.open()
        spool.bind([final(item.id, item.key[-1]) for item in spool.reading.objects.held('clock')])
        spool.close()

    seen = []
    for copy in moments(work):
        spool = new_spool(copy)
        spool.open()
        assert_whole(copy)
        bound = [row['state'] == 'pending' for row in rows(copy)]
        seen.append(bound[0])
        assert len(set(bound)) == 1
        for row in rows(copy):
            place = f'{READY}/thor/final/{row["key"][-1]}' if bound[0] else f'{HELD}/thor/provisional/{row["key"][-1]}'
            report = description_of(copy / place)
            assert (report['key'], report['t_start_ns'], report['held']) == (row['key'], row['t_start_ns'], row['reason'])
        spool.bind([final(item.id, item.key[-1]) for item in spool.reading.objects.held('clock')])
        for item in spool.pending(9):
            assert item.path.read_bytes() == item.key[-1].encode()
            settle(spool, item, State.DELIVERED)
        assert assert_whole(copy)['objects']['delivered'] == 3
        spool.close()
    assert seen == sorted(seen)
    assert set(seen) == {False, True}


def test_a_start_of_another_process_keeps_out_of_a_binding(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its recovery would undo renames that are not committed yet, and delivery would find no file under the final name."""
    bindings = hold(spool, 'a', 'b')
    other = new_spool(root)
    start, looked = threading.Thread(target=other.open), threading.Event()

    def follows(*arguments: Any) -> None:
        _follow_rows(*arguments)
        looked.set()

    def syncs(tree: Tree) -> None:
        start.start()
        assert not looked.wait(0.5)

    monkeypatch.setattr(recovery, '_follow_rows', follows)
    monkeypatch.setattr(Tree, 'sync_incoming', syncs)
    bound = spool.bind(bindings)
    start.join(60)
    assert looked.is_set()
    assert not other.recovery.found_anything
    other.close()
    assert [item.path.read_bytes() for item in bound] == [b'a', b'b']
    assert_whole(root)


def test_an_interrupted_binding_is_completed(opened: Open, root: Path) -> None:
    """Parts that a failing SQLite left in place are bound by the next try, without a restart in between."""
    spool = opened()
    bindings = hold(spool, 'a', 'b')
    (root / HELD / 'thor/provisional/a').rename(root / f'incoming/{bindings[0].id}.part')
    assert [item.path.read_bytes() for item in spool.bind(bindings)] == [b'a', b'b']
    assert_whole(root)


def test_held_objects_are_found_without_reading_the_rest(spool: Spool) -> None:
    """A hundred thousand delivered objects do not slow it down."""
    asked: list[str] = []
    spool._connections.reading._db.set_trace_callback(asked.append)
    spool.reading.objects.held('clock')
    plan = spool._connections.writing._db.execute(f'EXPLAIN QUERY PLAN {asked[0]}').fetchall()
    assert [row[3] for row in plan] == ['SEARCH objects USING INDEX held (reason=?)']
