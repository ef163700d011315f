"""What the index keeps of an object that left the spool: all of it for an hour, then what must be known of its key."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples
from spool.conftest import Open
from spool.making import BUCKET, NOON_NS, FakeClock, assert_whole, make, new_spool, put, rows, short_rows

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import DataObject, Outcome, State
from shadowhound_data_logger.spool.deliveries import Deliveries
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.history_table import COMPACT_STATES
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Spool

HOUR_NS = 3600 * SECOND
DAY_NS = 24 * HOUR_NS
FACTS = {'pose': '3.214 -1.502 0.7854 odom', 'battery_pct': '81.0', 'mission_id': 'patrol_20251018_080000', 'run_id': 'f' * 32}


def frame(second: int, **fields: object) -> DataObject:
    """An object as a node in a mission makes them, of a second of the day."""
    key = f'thor/camera/20251018/{second // 3600:02}{second // 60 % 60:02}{second % 60:02}_front.jpg'
    times = {'t_start_ns': str(NOON_NS + second * SECOND), 't_end_ns': str(NOON_NS + second * SECOND)}
    return make(key, f'frame {second}'.encode(), **{'metadata': {'robot': 'thor', **times, **FACTS}, **fields})


def leave(spool: Spool, *objects: DataObject, state: State = State.DELIVERED) -> None:
    """Spool them, and have them leave; the catalog has their rows."""
    items = put(spool, *objects)
    spool.commit(outcomes=[Outcome(item, state, 'no_room' if state is State.EVICTED else None) for item in items])
    catalog(spool)


def catalog(spool: Spool) -> None:
    with closing(Index(spool.root / 'index.db')) as index:
        index.open()
        index.catalog.clear()


def age(spool: Spool, by_ns: int = 2 * HOUR_NS) -> None:
    """Let time pass, and commit until all rows are short that are due."""
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns += by_ns
    for _ in range(20):
        spool.commit()


def used(root: Path) -> tuple[int, int]:
    """Bytes of the index: in use, of the file."""
    with closing(sqlite3.connect(root / 'index.db')) as db:
        size, count, free = (db.execute(f'PRAGMA {name}').fetchone()[0] for name in ('page_size', 'page_count', 'freelist_count'))
    return (count - free) * size, count * size


@pytest.mark.long('an hour of rows')
def test_what_left_an_hour_ago_takes_a_tenth(spool: Spool, root: Path) -> None:
    """Of the bytes that it took in the index before."""
    empty = used(root)[0]
    leave(spool, *(frame(second) for second in range(2000)))
    full = used(root)[0] - empty
    age(spool)
    assert used(root)[0] - empty <= full / 10
    assert rows(root) == []


@pytest.mark.long('an hour of rows')
def test_pages_are_used_again(spool: Spool, root: Path) -> None:
    """The file does not grow once as much is forgotten as comes."""
    sizes = []
    for day in range(10):
        leave(spool, *(replace(frame(second), key=f'thor/camera/{day}/{second}') for second in range(300)))
        age(spool, DAY_NS)
        sizes.append(used(root)[1])
    assert max(sizes[-3:]) <= 1.02 * max(sizes[3:7])


def test_what_a_key_needs_stays_known(opened: Open, spool: Spool, root: Path) -> None:
    """That it was given out, with which content; what became of it; and the ledger."""
    leave(spool, frame(1), make('thor/rosbags/bag_a/bag_a_0.mcap', b'a slice'))
    leave(spool, make('thor/rosbags/bag_a/bag_a_1.mcap', b'another'), state=State.EVICTED)
    before = assert_whole(root)
    age(spool)
    assert len(short_rows(root)) == 3
    assert assert_whole(root) == before
    key, sha256 = frame(1).key, content_sha256(frame(1).body)
    assert spool.has(BUCKET, key)
    assert not spool.has('trajectories', key)
    assert spool.knows(BUCKET, key, sha256)
    assert not spool.knows(BUCKET, key, '0' * 64)
    assert spool.states(BUCKET, 'thor/rosbags/bag_a/') == {
        'thor/rosbags/bag_a/bag_a_0.mcap': State.DELIVERED, 'thor/rosbags/bag_a/bag_a_1.mcap': State.EVICTED,
    }  # fmt: skip
    (again,) = put(spool, replace(frame(1), body=b'other'))
    assert again.key == key.replace('.jpg', '_1.jpg'), 'a name is given out once'
    spool.commit(outcomes=[Outcome(again, State.DELIVERED)])
    path = root / 'ready' / BUCKET / key
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(frame(1).body if isinstance(frame(1).body, bytes) else b'')
    spool.close()
    assert opened().recovery.counts['delivered files removed'] == 1, 'a file that came back is known by its content'
    assert not os.path.lexists(path)


def test_an_audit_asks_for_both(spool: Spool, root: Path) -> None:
    """Objects with full rows and with short ones, each once, also one that changes meanwhile; not the catalog's parts."""
    part = make('thor/_catalog/a', b'part', sensor='_catalog', topic=None, samples=0)
    leave(spool, *(frame(second) for second in range(5)), part)
    age(spool)
    leave(spool, *(frame(second) for second in range(5, 9)))
    with closing(Deliveries(root)) as deliveries:
        deliveries.open('an audit')
        assert (deliveries.known(), deliveries.forgotten(), deliveries.since_ns()) == (9, 0, NOON_NS)
        pages = deliveries.pages()
        page = next(pages)
        deliveries.set_verified([number for number, _ in page])
        age(spool)
        assert len(short_rows(root)) == 10
        asked = [*page, *(item for more in pages for item in more)]
        assert sorted(info.key for _, info in asked) == sorted(frame(second).key for second in range(9))
        assert {info.sha256 for _, info in asked} == {content_sha256(frame(second).body) for second in range(9)}
    with closing(Deliveries(root)) as deliveries:
        deliveries.open('an audit')
        assert sum(map(len, deliveries.pages())) == 5, 'what is noted is not asked for again'


def test_what_the_catalog_lacks_keeps_its_row(spool: Spool, root: Path) -> None:
    """Its metadata are what a part of the catalog is made of."""
    (item,) = put(spool, frame(1))
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    age(spool, 30 * DAY_NS)
    assert len(rows(root)) == 1
    catalog(spool)
    age(spool)
    assert rows(root) == []


def test_what_a_full_disk_never_took_in_is_forgotten_too(root: Path) -> None:
    """It has the time at which it came."""
    clock = FakeClock()
    spool = new_spool(root, clock, max_bytes=1)
    spool.open()
    put(spool, frame(1))
    assert [row['state'] for row in rows(root)] == ['evicted']
    age(spool)
    assert [row['state'] for row in short_rows(root)] == [COMPACT_STATES.index(State.EVICTED)]
    age(spool, 30 * DAY_NS)
    assert short_rows(root) == []
    assert assert_whole(root)['objects']['evicted'] == 1
    spool.close()


def test_rows_are_made_short_step_by_step(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each commit does a step, and between the steps every key is found."""
    spool = opened()
    leave(spool, *(frame(second) for second in range(5)))
    spool.close()
    monkeypatch.setattr('shadowhound_data_logger.spool.history_table.COMPACT_STEP', 2)
    spool = opened()
    left = [len(rows(root))]
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns += 2 * HOUR_NS
    for _ in range(3):
        spool.commit()
        left.append(len(rows(root)))
        assert all(spool.has(BUCKET, frame(second).key) for second in range(5))
    assert left == [5, 3, 1, 0]


@pytest.mark.parametrize(
    'damage',
    ['UPDATE compact_objects SET state = 7', "UPDATE compact_objects SET sha256 = 'text'", "UPDATE folders SET path = x'00'",
     "UPDATE gaps_reported SET version = 'x'"],
)  # fmt: skip
def test_a_short_row_that_cannot_be_is_found(opened: Open, root: Path, damage: str) -> None:
    """As one of any other table: the index is made anew."""
    spool = opened()
    leave(spool, frame(1))
    age(spool)
    spool.close()
    with closing(sqlite3.connect(root / 'index.db')) as db:
        db.execute(damage)
        db.commit()
    assert opened().recovery.counts['damaged index rebuilt'] == 1


@pytest.fixture(scope='module')
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Index, Index]]:
    """Two indexes, empty."""
    opened = tuple(Index(tmp_path_factory.mktemp('index') / 'index.db') for _ in range(2))
    for index in opened:
        index.open()
    yield opened  # type: ignore[misc]
    for index in opened:
        index.close()


_NAMES = st.lists(st.text('ab_/.', min_size=1, max_size=6), min_size=1, max_size=12, unique=True)


@given(names=_NAMES, prefix=st.text('ab_/.', max_size=4), states=st.sets(st.sampled_from(COMPACT_STATES)))
@settings(max_examples=examples(150), deadline=None)
def test_keys_that_begin_so_are_the_same_with_short_rows(
    two: tuple[Index, Index], names: list[str], prefix: str, states: set[State]
) -> None:
    """Whatever folder a prefix ends in."""
    found = []
    for index, before_ns in zip(two, (0, NOON_NS + 1), strict=True):
        index._db.executescript('DELETE FROM objects; DELETE FROM compact_objects')
        with index.transaction():
            for place, name in enumerate(names):
                number = index.states.insert(make(name), name, f'{place % 3:064x}', State.PENDING, None, {}, NOON_NS)
                index.states.move([number], COMPACT_STATES[place % 3], None, NOON_NS)
            index._db.execute('DELETE FROM uncataloged')
            index.history.compact(before_ns)
        assert [index.objects.has(BUCKET, name) for name in names] == [True] * len(names)
        found.append((
            [row['key'] for row in index.objects.with_prefix(BUCKET, prefix, states)],
            sorted(row['key'] for row in index.objects.with_content(BUCKET, prefix, f'{1:064x}')),
        ))  # fmt: skip
    assert found[0] == found[1]
