"""The gap journal on its way out: every change in a part, with watermarks behind it, across deaths, retries and new indexes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lake.gap_parts import counting
from spool.making import NOON_NS, FakeClock, abandon, make, new_spool

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject, State
from shadowhound_data_logger.core.stamps import by_arrival
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.lake.gaps import of_rows
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool import gap_table
from shadowhound_data_logger.spool.gaps import FORGOTTEN
from shadowhound_data_logger.spool.listing import resend_gaps, retry
from shadowhound_data_logger.spool.spool import Spool

CAMERA = '/camera'
DAY_NS = 24 * 3600 * SECOND


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / 'spool'


@pytest.fixture
def spool(root: Path) -> Iterator[Spool]:
    opened = new_spool(root, FakeClock())
    opened.open()
    yield opened
    opened.close()


def writer(root: Path, clock: FakeClock | None = None, **more: Any) -> CatalogWriter:
    return CatalogWriter(root, CatalogSettings(), 'thor', clock or FakeClock(), **more)


def told(parts: list[DataObject]) -> list[dict[str, Any]]:
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
    """Messages with these numbers, a tenth of a second apart."""
    with spool.accounts.entry(topic) as account:
        for number in numbers:
            account.receive('p', number, by_arrival(NOON_NS + number * SECOND // 10))
            account.gaps.newest = by_arrival(NOON_NS + number * SECOND // 10)
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns = max(clock.now_ns, NOON_NS + max(numbers) * SECOND // 10)


def store(spool: Spool, name: str, state: State = State.DELIVERED, **fields: Any) -> SpooledObject:
    """An object of one message, delivered or what became of it."""
    (item,) = spool.commit([make(name, name.encode(), **fields)])
    if state is not State.PENDING:
        spool.commit(outcomes=[Outcome(item, state, 'AccessDenied' if state is State.QUARANTINED else None)])
    return item


def what(rows: list[dict[str, Any]]) -> list[tuple[str, str | None, int | None, float]]:
    return [(row['what'], row['cause'], row['count'], (row['to_ns'] - NOON_NS) / SECOND) for row in rows]


def test_gaps_are_reported_once_before_their_watermark(spool: Spool, root: Path) -> None:
    """A row for the gap, one up to where all is known; and no part while nothing changes."""
    hear(spool, 1)
    store(spool, 'a')
    hear(spool, 6)
    store(spool, 'b')
    catalog = writer(root)
    made = catalog.parts()
    assert what(told(made)) == [('gap', 'transport', 4, 0.6), ('complete', None, None, 0.6)]
    (part,) = [part for part in made if part.key.startswith('thor/_gaps/')]
    assert part.key == 'thor/_gaps/date=2025-10-18/thor_20251018T120000_a-boot.jsonl.zst'
    assert (part.protected, part.sensor, part.metadata['count'], part.metadata['gap_version']) == (True, '_catalog', '2', '1')
    spool.commit(made)
    assert catalog.parts() == []


def test_another_process_continues_after_durable_parts(spool: Spool, root: Path) -> None:
    """What a process handed out and did not spool is told by the next; what it spooled is not told again."""
    hear(spool, 1, 6)
    spool.commit()
    lost_with_its_process = writer(root).parts()
    assert [row['cause'] for row in told(lost_with_its_process)] == ['transport']
    again = writer(root).parts()
    assert told(again) == told(lost_with_its_process)
    spool.commit(again)
    hear(spool, 11)
    spool.commit()
    assert [row['to_ns'] - NOON_NS for row in told(writer(root).parts()) if row['what'] == 'gap'] == [11 * SECOND // 10]


def test_a_late_message_withdraws_its_gap(spool: Spool, root: Path) -> None:
    """The same name, a higher revision."""
    catalog = writer(root)
    hear(spool, 1, 3)
    spool.commit()
    (gap,) = told(catalog.parts())
    hear(spool, 2)
    spool.commit()
    (withdrawn,) = told(catalog.parts())
    assert (withdrawn['what'], withdrawn['id'], withdrawn['revision'] > gap['revision']) == ('withdrawn', gap['id'], True)


def test_the_watermark_waits_for_what_is_not_delivered(spool: Spool, root: Path) -> None:
    """While an object waits it may be evicted; quarantined it is told, retried the watermark goes back before it."""
    hear(spool, 1)
    store(spool, 'a')
    hear(spool, 20)
    waiting = store(spool, 'b', State.PENDING, t_start_ns=NOON_NS + 2 * SECOND, t_end_ns=NOON_NS + 2 * SECOND)
    hear(spool, 40)
    store(spool, 'c', t_start_ns=NOON_NS + 4 * SECOND, t_end_ns=NOON_NS + 4 * SECOND)
    catalog = writer(root)
    assert what(told(catalog.parts()))[-1] == ('complete', None, None, 2.0)
    spool.commit(outcomes=[Outcome(waiting, State.QUARANTINED, 'AccessDenied')])
    rows = told(catalog.parts())
    assert what(rows) == [('gap', 'AccessDenied', 1, 2.0), ('complete', None, None, 4.0)]
    assert retry(root).objects == 1
    again = told(catalog.parts())
    assert what(again) == [('withdrawn', 'AccessDenied', 0, 2.0), ('complete', None, None, 2.0)]
    known = of_rows('thor', 'objects', CAMERA, NOON_NS + SECOND, NOON_NS + 4 * SECOND, counting([*rows, *again]))
    assert known.complete_ns == NOON_NS + 2 * SECOND


def test_no_watermark_overtakes_its_gaps(spool: Spool, root: Path) -> None:
    """While a part with gaps is on its way, or refused, the store must not hear that all is known."""
    catalog = writer(root)
    hear(spool, 1, 6)
    item = store(spool, 'a', State.PENDING, samples=2)
    made = catalog.parts()
    assert [row['what'] for row in told(made)] == ['gap']
    (part,) = spool.commit(made)
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    assert told(catalog.parts()) == []
    spool.commit(outcomes=[Outcome(part, State.QUARANTINED, 'AccessDenied')])
    assert told(catalog.parts()) == []
    assert retry(root).objects == 1
    spool.commit(outcomes=[Outcome(part, State.DELIVERED)])
    assert [row['what'] for row in told(catalog.parts())] == ['complete']


def test_gaps_of_another_date_are_reported_before_the_watermark(spool: Spool, root: Path) -> None:
    """They are parts of their own, of which any may come first."""
    catalog = writer(root)
    hear(spool, 1)
    store(spool, 'a')
    store(spool, 'b', State.QUARANTINED, topic='/old', t_start_ns=NOON_NS - DAY_NS, t_end_ns=NOON_NS - DAY_NS)
    hear(spool, 2)
    store(spool, 'c')
    assert [row['what'] for row in told(catalog.parts())] == ['gap']
    assert [row['what'] for row in told(catalog.parts())] == ['complete']


def test_gaps_of_a_lost_part_are_reported_again(spool: Spool, root: Path) -> None:
    """Somebody deleted its file before it was delivered."""
    catalog = writer(root)
    hear(spool, 1, 6)
    spool.commit()
    (part,) = spool.commit(catalog.parts())
    assert catalog.parts() == []
    spool.commit(outcomes=[Outcome(part, State.QUARANTINED, 'missing')])
    assert [row['what'] for row in told(catalog.parts())] == ['gap']
    assert catalog.parts() == []


def test_a_full_disk_keeps_the_parts(root: Path) -> None:
    """None is evicted, nor left out: what they told would not be told again."""
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
    """Where the store lost its parts: every gap, and the watermark behind them."""
    catalog = writer(root)
    hear(spool, 1, 6)
    store(spool, 'a', samples=2)
    before = told(catalog.parts())
    assert [row['what'] for row in before] == ['gap', 'complete']
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(writer(root).parts())])
    assert catalog.parts() == []
    assert resend_gaps(root) == 1
    again = catalog.parts()
    assert told(again) == before
    assert catalog.parts() == [], 'once'
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(again)])
    assert [row['what'] for row in told(writer(root).parts())] == ['complete'], 'a new process does not begin anew'
    assert resend_gaps(root) == 1
    assert len(told(writer(root).parts())) == len(before), 'also where no process ran when it was asked'


@pytest.mark.parametrize('is_of_older_version', [False, True])
def test_resent_watermarks_exclude_forgotten_gaps(spool: Spool, root: Path, is_of_older_version: bool) -> None:
    """The store may have lost what the robot forgot: it would be taken for all that was lost."""
    hear(spool, 20)
    store(spool, 'a')
    hear(spool, 26, 27, 28)
    store(spool, 'b', samples=3)
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in spool.commit(writer(root).parts())])
    with spool._connections.writing.transaction():
        assert spool._connections.writing.gaps.forget(NOON_NS + SECOND * 27 // 10, 100)
        if is_of_older_version:
            spool._connections.writing._db.execute('UPDATE gaps SET to_ns = NULL WHERE begin_ns = ?', (FORGOTTEN,))
    (mark,) = told(writer(root).parts())
    assert (mark['from_ns'], mark['to_ns']) == (NOON_NS + SECOND * 2, NOON_NS + SECOND * 28 // 10), 'it was told'
    resend_gaps(root)
    (mark,) = told(writer(root).parts())
    begin_ns = NOON_NS + (SECOND * 2 if is_of_older_version else SECOND * 26 // 10)
    assert (mark['what'], mark['from_ns'], mark['to_ns']) == ('complete', begin_ns, NOON_NS + SECOND * 28 // 10)
    (total,) = [gap for gap in spool._connections.writing.gaps.known({}) if gap.begin_ns == FORGOTTEN]
    assert (total.count, total.from_ns, total.to_ns) == (5, None, None), 'a sum has no time'


def test_no_watermark_covers_unreported_forgotten_gaps(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows beyond the bound of the journal go, told or not: where they were, nobody knows what was lost."""
    hear(spool, 20)
    store(spool, 'a')
    hear(spool, 26, 27, 28)
    store(spool, 'b', samples=3)
    monkeypatch.setattr(gap_table, 'MAX_ROWS', 0)
    with spool._connections.writing.transaction():
        assert spool._connections.writing.gaps.forget(0, 100)
    (mark,) = told(writer(root).parts())
    assert (mark['what'], mark['from_ns'], mark['to_ns']) == (
        'complete',
        NOON_NS + SECOND * 26 // 10,
        NOON_NS + SECOND * 28 // 10,
    )
    (total,) = spool._connections.writing.gaps.known({})
    assert (total.count, total.from_ns, total.to_ns) == (5, None, None)


def test_a_session_that_died_ends_where_it_was_heard_last(root: Path) -> None:
    """The watermark does not pass the time in which the node was off, unless numbers tell what was lost in it."""
    first = new_spool(root, FakeClock())
    first.open()
    hear(first, 1, 2)
    store(first, 'a', samples=2)
    abandon(first)
    later = FakeClock(NOON_NS + 100 * SECOND)
    second = new_spool(root, later)
    second.open()
    catalog = writer(root, later)
    assert what(told(catalog.parts())) == [('complete', None, None, 0.2)]
    hear(second, 1000, 1010)
    store(second, 'b', samples=2)
    rows = told(catalog.parts())
    assert [(row['what'], row['cause'], row['count']) for row in rows] == [
        ('gap', 'restart', 997), ('gap', 'transport', 9), ('complete', None, None),
    ]  # fmt: skip
    assert (rows[-1]['from_ns'], rows[-1]['to_ns']) == (NOON_NS + 101 * SECOND, NOON_NS + 101 * SECOND)
    second.close()


def test_revisions_continue_after_the_index_is_rebuilt(root: Path) -> None:
    """Versions begin anew then; what is told by the new index is newer than all that the old one told."""
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
    (gap,) = [row for row in told(writer(root).parts()) if row['cause'] == 'transport']
    assert gap['revision'] > max(row['revision'] for row in told(before))
    spool.close()


def test_gaps_of_a_boot_are_reported_once_its_clock_is_known(spool: Spool, root: Path) -> None:
    """First without a date, then with one, under the same name: the newest is the dated one."""
    with spool.accounts.entry(CAMERA) as account:
        account.drop('queue_full', 3, by_arrival(5 * SECOND), by_arrival(6 * SECOND))
    spool.commit()
    catalog = writer(root)
    made = catalog.parts()
    (row,) = told(made)
    assert (row['clock'], row['t_from']) == ('unset', None)
    assert made[0].key.startswith('thor/_gaps/date=1970-01-01/')
    record = {'is_set': True, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'offsets': {'a-boot': NOON_NS}}
    (root / 'clock-thor.json').write_text(json.dumps(record), encoding='utf-8')
    (dated,) = told(catalog.parts())
    assert (dated['id'], dated['clock'], dated['from_ns']) == (row['id'], 'set_later', NOON_NS + 5 * SECOND)
    (newest,) = counting([dated, row])
    assert newest['clock'] == 'set_later'
    assert catalog.parts() == []


def test_a_missions_end_is_reported_soon(spool: Spool, root: Path) -> None:
    """Within seconds, not within the period."""
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
    assert len(told(catalog.due())) == 1


def test_a_backlog_of_rows_is_split_with_the_watermark_last(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No watermark stands over rows that are not told yet."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.catalog_writer.MAX_ROWS', 2)
    for number in range(1, 100, 20):
        hear(spool, number)
        store(spool, f'n{number}')
    catalog = writer(root)
    found = [[row['what'] for row in told(catalog.due())] for _ in range(4)]
    assert [what for part in found for what in part] == ['gap'] * 4 + ['complete']
    assert max(map(len, found)) <= 3
