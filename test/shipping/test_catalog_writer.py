"""The robot's side of the catalog: every delivered object in exactly one part, at the time that was asked for."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import orjson
import pytest
from spool.making import NOON_NS, FakeClock, assert_whole, make, new_spool, put, rows

from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject, State
from shadowhound_data_logger.core.zstd import ZstdDecompressor
from shadowhound_data_logger.formats.statistics import FieldStatistics, pack_statistics
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool.spool import Spool


class Hand:
    """A clock that is moved by hand, in seconds."""

    def __init__(self) -> None:
        self.s = 0.0

    def __call__(self) -> float:
        return self.s


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / 'spool'


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock(boot_id='0123456789abcdef')


@pytest.fixture
def spool(root: Path, clock: FakeClock) -> Iterator[Spool]:
    """An open spool, empty."""
    opened = new_spool(root, clock)
    opened.open()
    yield opened
    opened.close()


@pytest.fixture
def catalog(spool: Spool, clock: FakeClock) -> CatalogWriter:
    return made(spool, clock)


def made(spool: Spool, clock: FakeClock, monotonic: Any = lambda: 0.0, **settings: Any) -> CatalogWriter:
    return CatalogWriter(spool.root, CatalogSettings(**settings), 'thor', clock, monotonic)


def deliver(spool: Spool, items: list[SpooledObject]) -> None:
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])


def of(key: str, **fields: Any) -> DataObject:
    return make(key, key.encode(), **{'metadata': {'robot': 'thor'}, **fields})


def delivered(spool: Spool, *keys: str, **fields: Any) -> None:
    deliver(spool, put(spool, *(of(key, **fields) for key in keys)))


def lines(body: bytes) -> list[dict[str, Any]]:
    """The rows in a part."""
    return [orjson.loads(line) for line in ZstdDecompressor().decompress(body).splitlines()]


def keys(part: DataObject) -> list[str]:
    """Of the rows in a part."""
    assert isinstance(part.body, bytes)
    return [row['key'] for row in lines(part.body)]


def test_what_is_delivered_has_a_row_once(spool: Spool, root: Path, catalog: CatalogWriter) -> None:
    """Not before, not again, and the parts have none."""
    items = put(spool, *map(of, 'abc'))
    assert catalog.parts() == []
    deliver(spool, items[:2])
    (part,) = catalog.parts()
    assert keys(part) == ['a', 'b']
    (placed,) = spool.commit([part])
    assert catalog.parts() == []
    deliver(spool, [placed, items[2]])
    (part,) = catalog.parts()
    assert keys(part) == ['c']
    spool.commit([part])
    assert_whole(root)


def test_a_part_is_named_and_kept_like_bookkeeping(spool: Spool, catalog: CatalogWriter) -> None:
    """Its key has date, time and boot; it is Parquet, protected, and says how many rows it has."""
    delivered(spool, 'a', 'b')
    (part,) = catalog.parts()
    assert check_key(part.key) == 'thor/_catalog/date=2025-10-18/thor_20251018T120000_01234567.jsonl.zst'
    assert (part.bucket, part.content_type, part.protected) == ('sensor-data', 'application/zstd', True)
    assert part.metadata == {'robot': 'thor', 'count': '2'}
    assert part.topic is None
    assert (part.t_start_ns, part.t_end_ns) == (NOON_NS, NOON_NS)


def test_a_folder_for_each_robot_and_date(spool: Spool, catalog: CatalogWriter) -> None:
    """Whoever delivers for several robots, or after midnight, writes a part for each; one without a name goes to this robot."""
    delivered(spool, 'a', metadata={'robot': 'tachi'})
    delivered(spool, 'b', t_start_ns=NOON_NS + 86_400 * 10**9, metadata={'robot': 'thor'})
    delivered(spool, 'c', metadata={'robot': '../thor'})
    delivered(spool, 'd', t_start_ns=5, t_end_ns=6, metadata={'robot': 'thor', 'boot_start_ns': '5', 'clock': 'unset'})
    found = {part.key.rpartition('/')[0]: keys(part) for part in catalog.parts()}
    assert found == {
        'tachi/_catalog/date=2025-10-18': ['a'], 'thor/_catalog/date=2025-10-19': ['b'],
        'thor/_catalog/date=2025-10-18': ['c'], 'thor/_catalog/date=1970-01-01': ['d'],
    }  # fmt: skip


def test_a_part_a_period(spool: Spool, clock: FakeClock) -> None:
    """At once what an earlier process left; then nothing before the period is over, and all of it afterwards."""
    hand = Hand()
    catalog = made(spool, clock, hand, period_s=60.0)
    delivered(spool, 'a')
    (part,) = catalog.due()
    spool.commit([part])
    delivered(spool, 'b')
    hand.s = 59.9
    assert catalog.due() == []
    hand.s = 60.0
    (part,) = catalog.due()
    assert keys(part) == ['b']
    spool.commit([part])
    delivered(spool, 'c')
    hand.s = 119.9
    assert catalog.due() == []
    hand.s = 120.0
    assert [keys(part) for part in catalog.due()] == [['c']]


def test_a_backlog_continues_at_the_next_poll(spool: Spool, clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an outage parts of a bounded size follow one another without waiting for the next period."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.catalog_writer.MAX_ROWS', 2)
    hand = Hand()
    catalog = made(spool, clock, hand, period_s=60.0)
    delivered(spool, *'abcde')
    found = []
    for _ in range(4):
        parts = catalog.due()
        spool.commit(parts)
        found.append([keys(part) for part in parts])
    assert found == [[['a', 'b']], [['c', 'd']], [['e']], []]


def test_rows_on_their_way_are_not_handed_out_again(spool: Spool, root: Path, catalog: CatalogWriter) -> None:
    """While a full disk keeps a part back, the next one has what is new only."""
    delivered(spool, 'a')
    first = catalog.parts()
    delivered(spool, 'b')
    second = catalog.parts()
    assert [keys(part) for part in (*first, *second)] == [['a'], ['b']]
    spool.commit([*first, *second])
    assert [row['key'] for row in rows(root) if row['sensor'] == '_catalog'] == [
        'thor/_catalog/date=2025-10-18/thor_20251018T120000_01234567.jsonl.zst',
        'thor/_catalog/date=2025-10-18/thor_20251018T120000_01234567_1.jsonl.zst',
    ]


def test_what_is_remembered_of_parts_on_their_way_is_small(spool: Spool, catalog: CatalogWriter) -> None:
    """After an outage they have thousands of rows: memory grows with the rows, not with their square."""
    delivered(spool, *map(str, range(600)))
    tracemalloc.start()
    made = catalog.parts()
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert [len(part.catalogs) for part in made] == [600]
    assert kept < 1_000_000


def test_two_that_catalog_one_spool(spool: Spool, root: Path, clock: FakeClock) -> None:
    """A node and an agent, or a node that was killed and its successor: whose part is committed first counts."""
    delivered(spool, 'a', 'b')
    ours, theirs = made(spool, clock).parts(), made(spool, clock).parts()
    assert [keys(part) for part in ours] == [keys(part) for part in theirs] == [['a', 'b']]
    assert len(spool.commit(ours)) == 1
    assert spool.commit(theirs) == []
    assert_whole(root)


def test_rows_skipped_by_a_part_are_in_the_next(spool: Spool, root: Path, clock: FakeClock) -> None:
    """A part that came second for some of its rows is none; what nobody else took is handed out again, without a restart."""
    delivered(spool, 'a')
    theirs = made(spool, clock).parts()
    delivered(spool, 'b')
    catalog = made(spool, clock)
    ours = catalog.parts()
    assert [keys(part) for part in (*theirs, *ours)] == [['a'], ['a', 'b']]
    assert len(spool.commit(theirs)) == 1
    assert spool.commit(ours) == []
    assert [keys(part) for part in catalog.parts()] == [['b']]


def test_a_repeat_has_a_separate_row(spool: Spool, root: Path, catalog: CatalogWriter) -> None:
    """Content that was not stored again is found at its own time, under the key that holds it."""
    first, later = (make(f'thor/camera/{second}.jpg', t_start_ns=NOON_NS + second, t_end_ns=NOON_NS + second, dedup=True,
                         metadata={'robot': 'thor'}) for second in (0, 1))  # fmt: skip
    deliver(spool, put(spool, first))
    put(spool, later)
    (part,) = catalog.parts()
    assert keys(part) == [first.key, first.key]
    assert len(set(part.catalogs)) == 2
    assert isinstance(part.body, bytes)
    times = [row['t_start_ns'] for row in lines(part.body)]
    assert times == [NOON_NS, NOON_NS + 1]
    spool.commit([part])
    assert catalog.parts() == []
    assert_whole(root)


def test_without_a_catalog_nothing_piles_up(spool: Spool, clock: FakeClock) -> None:
    """With ``catalog.enabled: false`` there are no parts, and when it is switched on later, only of what comes then."""
    delivered(spool, 'a')
    off, on = made(spool, clock, enabled=False), made(spool, clock)
    assert off.parts() == []
    assert on.parts() == []
    delivered(spool, 'b')
    assert [keys(part) for part in on.parts()] == [['b']]


def test_statistics_go_into_parts_of_their_own_once_the_object_is_delivered(spool: Spool, catalog: CatalogWriter) -> None:
    """A row for each field and one for the object; of what is evicted, and of what has none, nothing."""
    said = {name: FieldStatistics() for name in 'ab'}
    said['a'].add([{'x': 1.5}, {'x': None}])
    said['b'].add([{'x': 9.0}])
    told = {name: pack_statistics(each.result()) for name, each in said.items()}
    first, second, third = put(spool, of('a', statistics=told['a']), of('b', statistics=told['b']), of('c'))
    assert catalog.parts() == []
    spool.commit(outcomes=[Outcome(second, State.EVICTED)])
    deliver(spool, [first, third])
    statistics, rows, gaps = catalog.parts()
    assert keys(rows) == ['a', 'c']
    assert statistics.key.startswith('thor/_stats/date=2025-10-18/')
    assert isinstance(statistics.body, bytes)
    found = lines(statistics.body)
    assert [(row['key'], row['field'], row.get('max'), row['count'], row['nan_count']) for row in found] == [
        ('a', '', None, 2, 0), ('a', 'x', 1.5, 1, 1),
    ]  # fmt: skip
    spool.commit([statistics, rows, gaps])
    assert catalog.parts() == []


def test_statistics_of_many_objects_go_into_several_parts(
    spool: Spool, catalog: CatalogWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each in one part, under names that differ: all of them at once would take more memory than the rows do."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.catalog_writer.OBJECTS_A_PART', 2)
    said = FieldStatistics()
    said.add([{'x': 1.5}])
    deliver(spool, put(spool, *(of(name, statistics=pack_statistics(said.result())) for name in 'abcde')))
    made = [part for part in catalog.parts() if '/_stats/' in part.key]
    found = [lines(part.body) for part in made if isinstance(part.body, bytes)]
    assert [sorted({row['key'] for row in rows}) for rows in found] == [['a', 'b'], ['c', 'd'], ['e']]
    assert len({item.key for item in spool.commit(made)}) == 3
