"""The robot's side of the catalog and of the gap journal: each object in one part, each gap with its watermark."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import orjson
import pytest
from lake.gap_parts import counting
from spool.making import NOON_NS, FakeClock, abandon, assert_whole, make, new_spool, put, rows

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject, State
from shadowhound_data_logger.core.stamps import by_arrival
from shadowhound_data_logger.core.zstd import ZstdDecompressor
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.formats.statistics import FieldStatistics, pack_statistics
from shadowhound_data_logger.lake.gaps import of_rows
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool import gap_table
from shadowhound_data_logger.spool.gaps import FORGOTTEN
from shadowhound_data_logger.spool.listing import resend_gaps, retry
from shadowhound_data_logger.spool.spool import Spool


class Hand:
    """A clock in seconds that the test moves."""

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
    """An open, empty spool."""
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
    """The keys of the rows in a part."""
    assert isinstance(part.body, bytes)
    return [row['key'] for row in lines(part.body)]


def test_every_delivered_object_has_one_row(spool: Spool, root: Path, catalog: CatalogWriter) -> None:
    """Not before delivery and never twice; parts have no rows."""
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
    """Its key has date, time and boot; it is Parquet, protected, and records its number of rows."""
    delivered(spool, 'a', 'b')
    (part,) = catalog.parts()
    assert check_key(part.key) == 'thor/_catalog/date=2025-10-18/thor_20251018T120000_01234567.jsonl.zst'
    assert (part.bucket, part.content_type, part.protected) == ('sensor-data', 'application/zstd', True)
    assert part.metadata == {'robot': 'thor', 'count': '2'}
    assert part.topic is None
    assert (part.t_start_ns, part.t_end_ns) == (NOON_NS, NOON_NS)


def test_parts_are_separate_for_each_robot_and_date(spool: Spool, catalog: CatalogWriter) -> None:
    """When delivering for several robots, or after midnight, there is a part for each; without a name it is this robot's."""
    delivered(spool, 'a', metadata={'robot': 'tachi'})
    delivered(spool, 'b', t_start_ns=NOON_NS + 86_400 * 10**9, metadata={'robot': 'thor'})
    delivered(spool, 'c', metadata={'robot': '../thor'})
    delivered(spool, 'd', t_start_ns=5, t_end_ns=6, metadata={'robot': 'thor', 'boot_start_ns': '5', 'clock': 'unset'})
    found = {part.key.rpartition('/')[0]: keys(part) for part in catalog.parts()}
    assert found == {
        'tachi/_catalog/date=2025-10-18': ['a'], 'thor/_catalog/date=2025-10-19': ['b'],
        'thor/_catalog/date=2025-10-18': ['c'], 'thor/_catalog/date=1970-01-01': ['d'],
    }  # fmt: skip


def test_one_part_is_written_per_period(spool: Spool, clock: FakeClock) -> None:
    """Immediately what an earlier process left; then nothing before the end of the period, and everything after it."""
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
    """After an outage parts of bounded size follow one another without waiting for the next period."""
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


def test_pending_rows_are_not_taken_again(spool: Spool, root: Path, catalog: CatalogWriter) -> None:
    """While a full disk delays a part, the next one has only new rows."""
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


def test_the_memory_of_pending_parts_is_small(spool: Spool, catalog: CatalogWriter) -> None:
    """After an outage they have thousands of rows: memory grows linearly with the rows."""
    delivered(spool, *map(str, range(600)))
    tracemalloc.start()
    made = catalog.parts()
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert [len(part.catalogs) for part in made] == [600]
    assert kept < 1_000_000


def test_two_processes_catalog_one_spool_without_repeats(spool: Spool, root: Path, clock: FakeClock) -> None:
    """A node and an agent, or a killed node and its successor: the part committed first counts."""
    delivered(spool, 'a', 'b')
    ours, theirs = made(spool, clock).parts(), made(spool, clock).parts()
    assert [keys(part) for part in ours] == [keys(part) for part in theirs] == [['a', 'b']]
    assert len(spool.commit(ours)) == 1
    assert spool.commit(theirs) == []
    assert_whole(root)


def test_rows_skipped_by_a_part_are_in_the_next(spool: Spool, root: Path, clock: FakeClock) -> None:
    """A part whose rows were partly taken is discarded; the rows not taken are listed again, without a restart."""
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
    """Content that was not stored again is found at its time, under the key of the stored object."""
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
    """With ``catalog.enabled: false`` there are no parts; enabled later, parts have only objects from then on."""
    delivered(spool, 'a')
    off, on = made(spool, clock, enabled=False), made(spool, clock)
    assert off.parts() == []
    assert on.parts() == []
    delivered(spool, 'b')
    assert [keys(part) for part in on.parts()] == [['b']]


def test_statistics_are_in_separate_parts_once_the_object_is_delivered(spool: Spool, catalog: CatalogWriter) -> None:
    """One row per field and one for the object; none for evicted objects or those without statistics."""
    values = {name: FieldStatistics() for name in 'ab'}
    values['a'].add([{'x': 1.5}, {'x': None}])
    values['b'].add([{'x': 9.0}])
    fields = {name: pack_statistics(each.result()) for name, each in values.items()}
    first, second, third = put(spool, of('a', statistics=fields['a']), of('b', statistics=fields['b']), of('c'))
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
    """Each in one part, under different names: all at the same time would take more memory than the rows."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.catalog_writer.OBJECTS_A_PART', 2)
    report = FieldStatistics()
    report.add([{'x': 1.5}])
    deliver(spool, put(spool, *(of(name, statistics=pack_statistics(report.result())) for name in 'abcde')))
    made = [part for part in catalog.parts() if '/_stats/' in part.key]
    found = [lines(part.body) for part in made if isinstance(part.body, bytes)]
    assert [sorted({row['key'] for row in rows}) for rows in found] == [['a', 'b'], ['c', 'd'], ['e']]
    assert len({item.key for item in spool.commit(made)}) == 3


CAMERA = '/camera'
DAY_NS = 24 * 3600 * SECOND


def writer(root: Path, clock: FakeClock | None = None, **more: Any) -> CatalogWriter:
    return CatalogWriter(root, CatalogSettings(), 'thor', clock or FakeClock(), **more)


def gap_statements(parts: list[DataObject]) -> list[dict[str, Any]]:
    """The statements in parts of the journal."""
    found: list[dict[str, Any]] = []
    for part in parts:
        if part.key.startswith('thor/_gaps/'):
            assert isinstance(part.body, bytes)
            read = read_rows(part.body, 'thor')
            assert not read.findings
            found += read.rows['_gaps']
    return found


def hear(spool: Spool, *numbers: int, topic: str = CAMERA) -> None:
    """Receive messages with these numbers, 0.1 s apart."""
    with spool.accounts.entry(topic) as account:
        for number in numbers:
            account.receive('p', number, by_arrival(NOON_NS + number * SECOND // 10))
            account.gaps.newest = by_arrival(NOON_NS + number * SECOND // 10)
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns = max(clock.now_ns, NOON_NS + max(numbers) * SECOND // 10)


def store(spool: Spool, name: str, state: State = State.DELIVERED, **fields: Any) -> SpooledObject:
    """An object of one message, delivered or with another outcome."""
    (item,) = spool.commit([make(name, name.encode(), **fields)])
    if state is not State.PENDING:
        spool.commit(outcomes=[Outcome(item, state, 'AccessDenied' if state is State.QUARANTINED else None)])
    return item


def what(rows: list[dict[str, Any]]) -> list[tuple[str, str | None, int | None, float]]:
    return [(row['what'], row['cause'], row['count'], (row['to_ns'] - NOON_NS) / SECOND) for row in rows]


def test_gaps_are_reported_once_before_their_watermark(spool: Spool, root: Path) -> None:
    """A row for the gap, one for the watermark; and no part while nothing changes."""
    hear(spool, 1)
    store(spool, 'a')
    hear(spool, 6)
    store(spool, 'b')
    catalog = writer(root)
    made = catalog.parts()
    assert what(gap_statements(made)) == [('gap', 'transport', 4, 0.6), ('complete', None, None, 0.6)]
    (part,) = [part for part in made if part.key.startswith('thor/_gaps/')]
    assert part.key == 'thor/_gaps/date=2025-10-18/thor_20251018T120000_a-boot.jsonl.zst'
    assert (part.protected, part.sensor, part.metadata['count'], part.metadata['gap_version']) == (True, '_catalog', '2', '1')
    spool.commit(made)
    assert catalog.parts() == []


def test_another_process_continues_after_durable_parts(spool: Spool, root: Path) -> None:
    """What a process listed and did not spool is reported by the next; what it spooled is not reported again."""
    hear(spool, 1, 6)
    spool.commit()
    lost_with_its_process = writer(root).parts()
    assert [row['cause'] for row in gap_statements(lost_with_its_process)] == ['transport']
    again = writer(root).parts()
    assert gap_statements(again) == gap_statements(lost_with_its_process)
    spool.commit(again)
    hear(spool, 11)
    spool.commit()
    assert [row['to_ns'] - NOON_NS for row in gap_statements(writer(root).parts()) if row['what'] == 'gap'] == [11 * SECOND // 10]


def test_a_late_message_withdraws_its_gap(spool: Spool, root: Path) -> None:
    """The same name with a higher revision."""
    catalog = writer(root)
    hear(spool, 1, 3)
    spool.commit()
    (gap,) = gap_statements(catalog.parts())
    hear(spool, 2)
    spool.commit()
    (withdrawn,) = gap_statements(catalog.parts())
    assert (withdrawn['what'], withdrawn['id'], withdrawn['revision'] > gap['revision']) == ('withdrawn', gap['id'], True)


def test_the_watermark_waits_for_what_is_not_delivered(spool: Spool, root: Path) -> None:
    """A pending object may be evicted; a quarantined one is reported, and on a retry the watermark moves back before it."""
    hear(spool, 1)
    store(spool, 'a')
    hear(spool, 20)
    waiting = store(spool, 'b', State.PENDING, t_start_ns=NOON_NS + 2 * SECOND, t_end_ns=NOON_NS + 2 * SECOND)
    hear(spool, 40)
    store(spool, 'c', t_start_ns=NOON_NS + 4 * SECOND, t_end_ns=NOON_NS + 4 * SECOND)
    catalog = writer(root)
    assert what(gap_statements(catalog.parts()))[-1] == ('complete', None, None, 2.0)
    spool.commit(outcomes=[Outcome(waiting, State.QUARANTINED, 'AccessDenied')])
    rows = gap_statements(catalog.parts())
    assert what(rows) == [('gap', 'AccessDenied', 1, 2.0), ('complete', None, None, 4.0)]
    assert retry(root).objects == 1
    again = gap_statements(catalog.parts())
    assert what(again) == [('withdrawn', 'AccessDenied', 0, 2.0), ('complete', None, None, 2.0)]
    known = of_rows('thor', 'objects', CAMERA, NOON_NS + SECOND, NOON_NS + 4 * SECOND, counting([*rows, *again]))
    assert known.complete_ns == NOON_NS + 2 * SECOND


def test_no_watermark_overtakes_its_gaps(spool: Spool, root: Path) -> None:
    """While a part with gaps is pending, or refused, the store must not get a watermark beyond them."""
    catalog = writer(root)
    hear(spool, 1, 6)
    item = store(spool, 'a', State.PENDING, samples=2)
    made = catalog.parts()
    assert [row['what'] for row in gap_statements(made)] == ['gap']
    (part,) = spool.commit(made)
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    assert gap_statements(catalog.parts()) == []
    spool.commit(outcomes=[Outcome(part, State.QUARANTINED, 'AccessDenied')])
    assert gap_statements(catalog.parts()) == []
    assert retry(root).objects == 1
    spool.commit(outcomes=[Outcome(part, State.DELIVERED)])
    assert [row['what'] for row in gap_statements(catalog.parts())] == ['complete']


def test_gaps_of_another_date_are_reported_before_the_watermark(spool: Spool, root: Path) -> None:
    """They are separate parts, which may arrive in any order."""
    catalog = writer(root)
    hear(spool, 1)
    store(spool, 'a')
    store(spool, 'b', State.QUARANTINED, topic='/old', t_start_ns=NOON_NS - DAY_NS, t_end_ns=NOON_NS - DAY_NS)
    hear(spool, 2)
    store(spool, 'c')
    assert [row['what'] for row in gap_statements(catalog.parts())] == ['gap']
    assert [row['what'] for row in gap_statements(catalog.parts())] == ['complete']


def test_gaps_of_a_lost_part_are_reported_again(spool: Spool, root: Path) -> None:
    """Its file was deleted before it was delivered."""
    catalog = writer(root)
    hear(spool, 1, 6)
    spool.commit()
    (part,) = spool.commit(catalog.parts())
    assert catalog.parts() == []
    spool.commit(outcomes=[Outcome(part, State.QUARANTINED, 'missing')])
    assert [row['what'] for row in gap_statements(catalog.parts())] == ['gap']
    assert catalog.parts() == []


def test_a_full_disk_keeps_the_parts(root: Path) -> None:
    """None is evicted or skipped: their statements would not be reported again."""
    spool = new_spool(root, FakeClock(), max_bytes=1)
    spool.open()
    catalog = writer(root)
    hear(spool, 1, 6)
    spool.commit([make('a')])
    (part,) = spool.commit([part for part in catalog.parts() if '/_gaps/' in part.key])
    spool.commit([make('b', priority=0)])
    rows = spool.reading.objects.with_prefix('sensor-data', '')
    assert {row['key']: State(row['state']) for row in rows} == {'a': State.EVICTED, 'b': State.EVICTED, part.key: State.PENDING}
    spool.close()


def test_resending_reports_all_remembered_gaps(spool: Spool, root: Path) -> None:
    """If the store lost its parts: every gap, followed by the watermark."""
    catalog = writer(root)
    hear(spool, 1, 6)
    store(spool, 'a', samples=2)
    before = gap_statements(catalog.parts())
    assert [row['what'] for row in before] == ['gap', 'complete']
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(writer(root).parts())])
    assert catalog.parts() == []
    assert resend_gaps(root) == 1
    again = catalog.parts()
    assert gap_statements(again) == before
    assert catalog.parts() == [], 'once'
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(again)])
    assert [row['what'] for row in gap_statements(writer(root).parts())] == ['complete'], 'a new process does not start again'
    assert resend_gaps(root) == 1
    assert len(gap_statements(writer(root).parts())) == len(before), 'also where no process ran when it was asked'


@pytest.mark.parametrize('is_of_older_version', [False, True])
def test_resent_watermarks_exclude_forgotten_gaps(spool: Spool, root: Path, is_of_older_version: bool) -> None:
    """The store may have lost what the robot forgot: those times would be taken for free of losses."""
    hear(spool, 20)
    store(spool, 'a')
    hear(spool, 26, 27, 28)
    store(spool, 'b', samples=3)
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(writer(root).parts())])
    with spool._connections.writing.transaction():
        assert spool._connections.writing.gaps.forget(NOON_NS + SECOND * 27 // 10, 100)
        if is_of_older_version:
            spool._connections.writing._db.execute('UPDATE gaps SET to_ns = NULL WHERE begin_ns = ?', (FORGOTTEN,))
    (mark,) = gap_statements(writer(root).parts())
    assert (mark['from_ns'], mark['to_ns']) == (NOON_NS + SECOND * 2, NOON_NS + SECOND * 28 // 10), 'it was reported'
    resend_gaps(root)
    (mark,) = gap_statements(writer(root).parts())
    begin_ns = NOON_NS + (SECOND * 2 if is_of_older_version else SECOND * 26 // 10)
    assert (mark['what'], mark['from_ns'], mark['to_ns']) == ('complete', begin_ns, NOON_NS + SECOND * 28 // 10)
    (total,) = [gap for gap in spool._connections.writing.gaps.known({}) if gap.begin_ns == FORGOTTEN]
    assert (total.count, total.from_ns, total.to_ns) == (5, None, None), 'a sum has no time'


def test_no_watermark_covers_unreported_forgotten_gaps(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows beyond the journal's limit are removed, reported or not: the losses there are unknown."""
    hear(spool, 20)
    store(spool, 'a')
    hear(spool, 26, 27, 28)
    store(spool, 'b', samples=3)
    monkeypatch.setattr(gap_table, 'MAX_ROWS', 0)
    with spool._connections.writing.transaction():
        assert spool._connections.writing.gaps.forget(0, 100)
    (mark,) = gap_statements(writer(root).parts())
    assert (mark['what'], mark['from_ns'], mark['to_ns']) == (
        'complete',
        NOON_NS + SECOND * 26 // 10,
        NOON_NS + SECOND * 28 // 10,
    )
    (total,) = spool._connections.writing.gaps.known({})
    assert (total.count, total.from_ns, total.to_ns) == (5, None, None)


def test_a_killed_session_ends_with_its_last_message(root: Path) -> None:
    """The watermark does not cover the time in which the node was off, unless sequence numbers show its losses."""
    first = new_spool(root, FakeClock())
    first.open()
    hear(first, 1, 2)
    store(first, 'a', samples=2)
    abandon(first)
    later = FakeClock(NOON_NS + 100 * SECOND)
    second = new_spool(root, later)
    second.open()
    catalog = writer(root, later)
    assert what(gap_statements(catalog.parts())) == [('complete', None, None, 0.2)]
    hear(second, 1000, 1010)
    store(second, 'b', samples=2)
    rows = gap_statements(catalog.parts())
    assert [(row['what'], row['cause'], row['count']) for row in rows] == [
        ('gap', 'restart', 997), ('gap', 'transport', 9), ('complete', None, None),
    ]  # fmt: skip
    assert (rows[-1]['from_ns'], rows[-1]['to_ns']) == (NOON_NS + 101 * SECOND, NOON_NS + 101 * SECOND)
    second.close()


def test_revisions_continue_after_the_index_is_rebuilt(root: Path) -> None:
    """Versions restart then; statements from the new index are newer than all those from the old one."""
    spool = new_spool(root, FakeClock())
    spool.open()
    hear(spool, 1, 6, 11, 16)
    store(spool, 'a', samples=4)
    before = writer(root).parts()
    spool.commit(before)
    spool.close()
    (root / 'index.db').unlink()
    spool = new_spool(root, FakeClock(NOON_NS + 10 * SECOND))
    spool.open()
    hear(spool, 1, 6)
    spool.commit()
    (gap,) = [row for row in gap_statements(writer(root).parts()) if row['cause'] == 'transport']
    assert gap['revision'] > max(row['revision'] for row in gap_statements(before))
    spool.close()


def test_gaps_of_a_boot_are_reported_once_its_clock_is_known(spool: Spool, root: Path) -> None:
    """First without a date, then with one, under the same name: the newest one is dated."""
    with spool.accounts.entry(CAMERA) as account:
        account.drop('queue_full', 3, by_arrival(5 * SECOND), by_arrival(6 * SECOND))
    spool.commit()
    catalog = writer(root)
    made = catalog.parts()
    (row,) = gap_statements(made)
    assert (row['clock'], row['t_from']) == ('unset', None)
    assert made[0].key.startswith('thor/_gaps/date=1970-01-01/')
    record = {'is_set': True, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'offsets': {'0123456789abcdef': NOON_NS}}
    (root / 'clock-thor.json').write_text(json.dumps(record), encoding='utf-8')
    (dated,) = gap_statements(catalog.parts())
    assert (dated['id'], dated['clock'], dated['from_ns']) == (row['id'], 'set_later', NOON_NS + 5 * SECOND)
    (newest,) = counting([dated, row])
    assert newest['clock'] == 'set_later'
    assert catalog.parts() == []


def test_a_missions_end_is_reported_soon(spool: Spool, root: Path) -> None:
    """Within seconds, not at the end of the period."""
    now = [0.0]
    catalog = writer(root, monotonic=lambda: now[0])
    catalog.due()
    hear(spool, 1, 6)
    spool.commit()
    now[0] = 20.0
    assert catalog.due() == []
    catalog.expedite()
    assert catalog.due() == []
    now[0] = 25.0
    assert len(gap_statements(catalog.due())) == 1


def test_a_backlog_of_rows_is_split_with_the_watermark_last(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No watermark covers rows that are not reported yet."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.catalog_writer.MAX_ROWS', 2)
    for number in range(1, 100, 20):
        hear(spool, number)
        store(spool, f'n{number}')
    catalog = writer(root)
    found = [[row['what'] for row in gap_statements(catalog.due())] for _ in range(4)]
    assert [what for part in found for what in part] == ['gap'] * 4 + ['complete']
    assert max(map(len, found)) <= 3
