"""The list of objects that are not in the catalog yet: each leaves it with one catalog part, and only once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from spool.conftest import Moments, Open
from spool.making import (
    FakeClock,
    abandon,
    assert_whole,
    clear_uncataloged,
    make,
    new_spool,
    put,
    rows,
    settle,
    uncataloged,
)

from shadowhound_data_logger.core.model import DataObject, Outcome, State
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.spool import Spool

ALL = 1000


def listed(root: Path) -> list[str]:
    return [item.key for item in uncataloged(root, ALL)]


def part(root: Path, name: str, *keys: str) -> DataObject:
    """A part with rows of everything listed, or of the given objects."""
    ids = tuple(item.id for item in uncataloged(root, ALL) if not keys or item.key in keys)
    return make(f'thor/_catalog/{name}.jsonl.zst', name.encode(), sensor='_catalog', topic=None, protected=True, catalogs=ids)


def delivered(spool: Spool, *keys: str) -> None:
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in put(spool, *(make(key, key.encode()) for key in keys))])


def test_delivered_objects_are_listed(spool: Spool, root: Path) -> None:
    """Delivered objects are listed, oldest first, with their metadata; objects with other outcomes are not."""
    items = put(spool, *(make(name, name.encode()) for name in 'abcd'))
    settle(spool, items[1], State.QUARANTINED, 'refused')
    settle(spool, items[2], State.EVICTED)
    assert listed(root) == []
    settle(spool, items[3], State.DELIVERED)
    settle(spool, items[0], State.DELIVERED)
    assert listed(root) == ['a', 'd']
    (first, _) = uncataloged(root, ALL)
    assert first == (items[0].id, 'sensor-data', 'a', 1, 'image/jpeg', items[0].metadata, b'')
    settle(spool, items[2], State.DELIVERED)  # it was evicted during its upload
    assert listed(root) == ['a', 'c', 'd']
    assert [item.key for item in uncataloged(root, 2)] == ['a', 'c']


def test_a_part_removes_its_rows_from_the_list(spool: Spool, root: Path) -> None:
    """Only the objects it has rows for; the part itself is never listed."""
    delivered(spool, 'a', 'b')
    (item,) = spool.commit([part(root, 'one', 'a')])
    assert listed(root) == ['b']
    settle(spool, item, State.DELIVERED)
    assert listed(root) == ['b']
    assert_whole(root)


def test_a_row_is_in_one_part(spool: Spool, root: Path) -> None:
    """If two parts share a row, the second is skipped completely, in the same commit or later."""
    delivered(spool, 'a', 'b')
    one, two = part(root, 'one'), part(root, 'two', 'a')
    assert [item.key for item in spool.commit([one, two, make('c', topic=None)])] == [one.key, 'c']
    assert spool.commit([two]) == []
    assert [row['key'] for row in rows(root)] == ['a', 'b', one.key, 'c']
    assert_whole(root)


def refuse(_: Tree) -> None:
    raise OSError(28, 'full')


def test_a_failed_commit_removes_nothing_from_the_list(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk the rows stay listed, and the same part is committed when there is room."""
    delivered(spool, 'a')
    made = part(root, 'one')
    with monkeypatch.context() as full:
        full.setattr(Tree, 'sync_incoming', refuse)
        with pytest.raises(OSError, match='full'):
            spool.commit([made])
    assert listed(root) == ['a']
    assert len(spool.commit([made])) == 1
    assert listed(root) == []


@pytest.mark.long('a kill after each step')
def test_a_kill_at_any_moment_of_a_part_loses_no_row(root: Path, moments: Moments) -> None:
    """After a kill every delivered object is either listed or in a part that is pending, never both or neither."""
    spool = new_spool(root)
    spool.open()
    items = put(spool, make('a', b'a'), make('b', b'b'))
    spool.close()

    def work() -> None:
        spool = new_spool(root)
        spool.open()
        spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])
        spool.commit([part(root, 'one')])
        spool.commit([make('c', topic=None)])
        abandon(spool)

    seen = []
    for copy in moments(work):
        spool = new_spool(copy)
        spool.open()
        assert_whole(copy)
        state = {row['key']: row['state'] for row in rows(copy)}
        has_part = state.get('thor/_catalog/one.jsonl.zst') == 'pending'
        expected = ['a', 'b'] if state['a'] == 'delivered' and not has_part else []
        assert listed(copy) == expected
        seen.append((state['a'], has_part))
        spool.close()
    assert set(seen) == {('pending', False), ('delivered', False), ('delivered', True)}
    assert seen == sorted(seen, key=lambda state: (state[0] == 'delivered', state[1]))


def test_listed_objects_are_not_forgotten(opened: Open, root: Path, clock: FakeClock) -> None:
    """However old they are; once their rows are in a part, they are."""
    spool = opened()
    delivered(spool, 'a')
    clock.now_ns += 10**18
    spool.commit()
    assert [row['key'] for row in rows(root)] == listed(root) == ['a']
    clear_uncataloged(root)
    assert listed(root) == []
    clock.now_ns += 10**14
    spool.commit()
    assert rows(root) == []


def test_an_object_has_the_columns_of_its_row(spool: Spool) -> None:
    """Sensor, topic, type, count and times are in the metadata of each, but no times of a clock that is not set."""
    (frame,) = put(spool, make('a', topic=None, type='', samples=0, sensor='missions', metadata={'robot': 'thor'}))
    assert {name: frame.metadata.get(name) for name in ('sensor', 'topic', 'count')} == {
        'sensor': 'missions', 'topic': None, 'count': None,
    }  # fmt: skip
    assert int(frame.metadata['t_start_ns']) == make().t_start_ns
    (early,) = put(spool, replace(make('b'), t_start_ns=5, t_end_ns=6))
    assert not early.metadata.keys() & {'t_start_ns', 't_end_ns'}
    (own,) = put(spool, make('c', metadata={'sensor': 'front', 'count': '9'}))
    assert (own.metadata['sensor'], own.metadata['count']) == ('front', '9')
