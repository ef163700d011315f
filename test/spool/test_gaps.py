from __future__ import annotations

import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profiles import examples
from spool.conftest import Open
from spool.making import NOON_NS, FakeClock, abandon, make, new_spool, put

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import Outcome, SpooledObject, State
from shadowhound_data_logger.core.stamps import Times, by_arrival
from shadowhound_data_logger.spool import gap_table, gaps, ledger
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.gaps import Gap, TopicGaps
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.topic_account import BAG
from shadowhound_data_logger.spool.writer import SpoolWriter

MS = SECOND // 1000
LATE_NS = 146 * SECOND
"""The delay between the stamp and the arrival of these messages."""
DAY_NS = 24 * 3600 * SECOND
CAMERA = '/camera'


def journal(root: Path) -> list[Gap]:
    """The whole journal, read over a separate connection."""
    with closing(sqlite3.connect(root / 'index.db')) as db:
        return GapTable(lambda: db).known({})


def short(root: Path) -> list[tuple[str, str, int | None, float | None, float | None]]:
    """(kind, cause, count, from, to) with seconds since noon."""
    return [
        (gap.kind, gap.cause, gap.count, *(None if at is None else (at - NOON_NS) / SECOND for at in (gap.from_ns, gap.to_ns)))
        for gap in journal(root)
    ]


def tell(root: Path) -> None:
    """Mark everything as reported, as a part with all gaps does."""
    with closing(Index(root / 'index.db')) as index:
        index.open()
        index.catalog.clear()


def hear(spool: Spool, *numbers: int, publisher: str = 'p', topic: str = CAMERA, period_ns: int = 100 * MS) -> None:
    """Take the messages with these numbers, sent at noon and then one per period."""
    with spool.accounts.entry(topic) as account:
        for number in numbers:
            times = Times(NOON_NS + number * period_ns, NOON_NS + number * period_ns + LATE_NS)
            account.receive(publisher, number, times)
            account.gaps.newest = times
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns = max(clock.now_ns, NOON_NS + max(numbers) * period_ns)


def test_a_gap_has_the_times_of_its_neighbors(spool: Spool, root: Path) -> None:
    """From the stamp of the last message before it to that of the first one after, of its publisher, in its mission."""
    hear(spool, 1, 2)
    spool.commit()
    spool.accounts.set_mission('patrol-7')
    hear(spool, 6)
    spool.commit()
    (gap,) = journal(root)
    assert gap.as_dict() == {
        'sink': 'objects', 'topic': CAMERA, 'publisher': 'p', 'session': 1, 'kind': 'missed', 'cause': 'transport',
        'from_ns': NOON_NS + 200 * MS, 'to_ns': NOON_NS + 600 * MS, 'received_from_ns': NOON_NS + 200 * MS + LATE_NS,
        'received_to_ns': NOON_NS + 600 * MS + LATE_NS, 'count': 3, 'merged': 1, 'grade': 'exact', 'mission_id': 'patrol-7',
    }  # fmt: skip
    assert (gap.robot, gap.began_ns) == ('thor', NOON_NS)


def test_gaps_merge_within_a_second(spool: Spool, root: Path) -> None:
    """A topic that loses every other message adds one row per second, over any number of commits."""
    for number in range(0, 600, 2):
        hear(spool, number, period_ns=10 * MS)
        if number % 50 == 0:
            spool.commit()
    spool.commit()
    found = journal(root)
    assert len(found) == 6
    assert sum(gap.count or 0 for gap in found) == 299
    assert sum(gap.merged for gap in found) == 299


@pytest.mark.parametrize('commit', [True, False], ids=['committed', 'not yet'])
def test_a_late_number_takes_its_loss_out_of_the_journal(spool: Spool, root: Path, commit: bool) -> None:
    """In the commit that counts it as received; with the last one the row becomes zero."""
    hear(spool, 1, 5)
    if commit:
        spool.commit()
    hear(spool, 3)
    spool.commit()
    assert [(gap.count, gap.merged) for gap in journal(root)] == [(2, 2)]
    hear(spool, 2, 4)
    spool.commit()
    assert journal(root) == []
    assert ledger.read(root, 'thor')['balanced']


def test_a_copy_of_the_journal_sees_every_change(spool: Spool, root: Path) -> None:
    """By version: new rows, changed ones, and those that became zero."""
    hear(spool, 1, 5)
    spool.commit()
    (first,), _ = spool.gaps_after(0, 10, {})
    assert spool.gaps_after(first.version, 10, {})[0] == []
    hear(spool, 2, 3, 4, 25)
    spool.commit()
    changed, _ = spool.gaps_after(first.version, 10, {})
    assert {(gap.begin_ns == first.begin_ns, gap.count) for gap in changed} == {(True, 0), (False, 19)}
    assert [gap.version for gap in changed] == sorted(gap.version for gap in changed)


def test_the_watermark_is_before_open_batches(spool: Spool) -> None:
    """A message without an outcome or not delivered may still be lost; the journal is complete up to the watermark."""
    hear(spool, 1)
    (item,) = spool.commit([make('a')])
    assert spool.gaps_after(0, 10, {})[1] == []
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    hear(spool, 2)
    spool.commit()
    (watermark,) = spool.gaps_after(0, 10, {})[1]
    assert (watermark.robot, watermark.sink, watermark.topic, watermark.received) == ('thor', 'objects', CAMERA, 2)
    assert (watermark.since_ns, watermark.complete_ns) == (NOON_NS + 100 * MS, NOON_NS + 100 * MS)
    (item,) = spool.commit([make('b')])
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    (watermark,) = spool.gaps_after(0, 10, {})[1]
    assert watermark.complete_ns == NOON_NS + 200 * MS


def test_a_recently_received_publisher_holds_the_watermark(spool: Spool) -> None:
    """Messages it sent since may turn out to be missed; after a minute the watermark stops waiting for it."""
    hear(spool, 10, publisher='slow')
    for number, ends_s in ((100, 1), (580, 1), (700, 70)):
        hear(spool, number)
        (item,) = spool.commit([make(f'n{number}', samples=1 if number > 100 else 2)])
        spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
        (watermark,) = spool.gaps_after(0, 10, {})[1] or [None]
        assert (watermark.complete_ns if watermark else NOON_NS + SECOND) == NOON_NS + ends_s * SECOND


def deliver(spool: Spool, *items: SpooledObject) -> None:
    spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])


def watermark(spool: Spool) -> tuple[float, float]:
    """From and to, in seconds since noon."""
    (found,) = spool.gaps_after(0, 10, {})[1]
    return (found.since_ns - NOON_NS) / SECOND, (found.complete_ns - NOON_NS) / SECOND


def test_a_stamp_of_the_future_moves_no_watermark_beyond_now(spool: Spool) -> None:
    """A publisher may use any stamp: it moves no watermark into the future, in this session or later."""
    hear(spool, 1, 2)
    with spool.accounts.entry(CAMERA) as account:
        account.receive('hostile', 1, by_arrival(NOON_NS + 365 * 24 * 3600 * SECOND))
        account.gaps.newest = by_arrival(NOON_NS + 365 * 24 * 3600 * SECOND)
    deliver(spool, *spool.commit([make('a', samples=3)]))
    assert watermark(spool) == (0.2, 0.2)
    hear(spool, 4)
    deliver(spool, *spool.commit([make('b')]))
    assert watermark(spool) == (0.2, 0.4)


def test_a_stamp_of_the_future_is_the_time_of_no_loss() -> None:
    """A stamp more than a day ahead of our clock is ignored: the other end of the gap counts, or nothing."""
    found = TopicGaps(clock=FakeClock())
    later_ns = NOON_NS + 25 * 3600 * SECOND
    assert found.add('missed', 'transport', 2, by_arrival(NOON_NS), by_arrival(later_ns)).begin_ns == NOON_NS
    assert found.add('missed', 'transport', 2, by_arrival(later_ns), by_arrival(later_ns)).begin_ns == gaps.UNTIMED
    assert found.add('missed', 'transport', 2, by_arrival(-5), by_arrival(NOON_NS)).begin_ns == NOON_NS


def test_a_loss_is_timed_by_one_clock() -> None:
    """One publisher with UTC and one with a clock that was never set: no gap spans the two clocks."""
    found = TopicGaps(clock=FakeClock(now_ns=50 * SECOND))
    key = found.add('missed', 'transport', 2, by_arrival(NOON_NS), by_arrival(40 * SECOND))
    ((row,), _) = found.settle(CAMERA, {key[:3]: 2})
    assert (row.from_ns, row.to_ns) == (NOON_NS, NOON_NS)


def test_a_restart_with_a_publisher_ahead_is_timed_by_its_clock(root: Path) -> None:
    """An hour ahead: the messages lost by the restart, and the watermark, have stamps in the future."""
    clock = FakeClock()
    spool = new_spool(root, clock)
    spool.open()
    for second in range(4):
        clock.now_ns = NOON_NS + second * SECOND
        times = Times(clock.now_ns + 3600 * SECOND, clock.now_ns)
        with spool.accounts.entry(CAMERA) as account:
            account.receive('p', second, times)
            account.gaps.newest = times
        if second < 2:
            deliver(spool, *put_newest(spool, times, f'n{second}'))
            assert watermark(spool) == (3600, 3600 + second)
    spool.commit()
    abandon(spool)
    spool = new_spool(root, clock)
    spool.open()
    spool.commit()
    spool.close()
    (gap,) = journal(root)
    seconds = [((at or 0) - NOON_NS) / SECOND for at in (gap.from_ns, gap.to_ns, gap.received_from_ns, gap.received_to_ns)]
    assert (gap.kind, gap.cause, gap.count, seconds) == ('dropped', 'restart', 2, [3601, 3603, 1, 3])


def put_newest(spool: Spool, times: Times, key: str) -> list[SpooledObject]:
    received = str(times.received_ns)
    metadata = {'received_start_ns': received, 'received_end_ns': received}
    return spool.commit([make(key, t_start_ns=times.stamp_ns, t_end_ns=times.stamp_ns, metadata=metadata)])


def test_a_loss_of_unknown_publishers_is_not_from_one_clock_to_the_other() -> None:
    """Two publishers with clocks five minutes apart: the loss has its true length, by the clock of the message after it."""
    found = TopicGaps(clock=FakeClock(now_ns=NOON_NS + 10 * SECOND))
    right, behind = Times(NOON_NS, NOON_NS), Times(NOON_NS - 298 * SECOND, NOON_NS + 2 * SECOND)
    found.add('dropped', 'restart', 10, right, behind)
    found.add('missed', 'transport', 3, right, behind, 'p')
    rows, _ = found.settle(CAMERA, {('dropped', 'restart', 'exact'): 10, ('missed', 'transport', 'exact'): 3})
    spans = {row.key.kind: ((row.from_ns or 0) - NOON_NS, (row.to_ns or 0) - NOON_NS) for row in rows}
    assert spans == {'dropped': (-300 * SECOND, -298 * SECOND), 'missed': (-298 * SECOND, 0)}
    assert {(row.received_from_ns, row.received_to_ns) for row in rows} == {(NOON_NS, NOON_NS + 2 * SECOND)}


def test_the_watermark_follows_a_clock_that_is_set_back(spool: Spool) -> None:
    """What was complete by the wrong clock is no evidence about the same time by the correct one."""
    hear(spool, 100)
    deliver(spool, *spool.commit([make('a')]))
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns = NOON_NS
    with spool.accounts.entry(CAMERA) as account:
        account.receive('p', 101, by_arrival(NOON_NS))
        account.gaps.newest = by_arrival(NOON_NS)
    deliver(spool, *spool.commit([make('b')]))
    assert watermark(spool) == (0, 0)


def test_the_watermark_begins_with_the_first_message_of_the_session(root: Path, opened: Open) -> None:
    """Messages sent before a node subscribed are not counted by any session."""
    spool = opened()
    hear(spool, 10)
    deliver(spool, *spool.commit([make('a')]))
    spool.close()
    spool = opened()
    with spool.accounts.entry(CAMERA):
        pass
    spool.commit()
    hear(spool, 40, publisher='new')
    spool.commit()
    hear(spool, 41, publisher='new')
    deliver(spool, *spool.commit([make('b', samples=2)]))
    found = [mark for mark in spool.gaps_after(0, 10, {})[1] if mark.session == 2]
    assert [mark.since_ns for mark in found] == [NOON_NS + 4 * SECOND]


def test_the_watermark_waits_for_publishers_of_the_session_before(root: Path, opened: Open) -> None:
    """One of two is discovered later: what it sent in between is missed by the restart, which is unknown until then."""
    spool = opened()
    hear(spool, 10)
    hear(spool, 10, publisher='q')
    deliver(spool, *spool.commit([make('a', samples=2)]))
    spool.close()
    spool = opened()
    hear(spool, 20)
    deliver(spool, *spool.commit([make('b')]))
    assert [mark.session for mark in spool.gaps_after(0, 10, {})[1]] == [1]
    hear(spool, 25, publisher='q')
    hear(spool, 26)
    deliver(spool, *spool.commit([make('c', samples=2)]))
    assert [mark.session for mark in spool.gaps_after(0, 10, {})[1]] == [1, 2]


def test_a_batch_does_not_advance_the_watermark_past_an_earlier_one(root: Path, opened: Open) -> None:
    """Two encoders: the later batch is durable, a kill loses the earlier one; its time is not known to be complete."""
    spool = new_spool(root)
    spool.open()
    hear(spool, 1)
    items = spool.commit([make('a', t_start_ns=NOON_NS + 100 * MS, t_end_ns=NOON_NS + 100 * MS)])
    spool.accounts.oldest_open = lambda: {CAMERA: NOON_NS + 200 * MS}
    hear(spool, 2, 3, 4, 5)
    items += spool.commit([make('b', samples=2, t_start_ns=NOON_NS + 400 * MS, t_end_ns=NOON_NS + 500 * MS)])
    deliver(spool, *items)
    abandon(spool)
    spool = opened()
    assert watermark(spool)[1] < 0.2


def test_a_retried_commit_claims_no_later_messages(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has the same objects as before; one that was created since then is only in memory."""
    spool.accounts.oldest_open = dict
    hear(spool, 1)
    items = spool.commit([make('a')])
    hear(spool, 2)
    with monkeypatch.context() as patch:
        patch.setattr(GapTable, 'write', _full)
        with pytest.raises(sqlite3.OperationalError):
            spool.commit()
    deliver(spool, *items)
    assert watermark(spool) == (0.1, 0.1)


def test_objects_waiting_for_a_full_disk_are_not_settled(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Outcomes are committed first, without the objects that do not fit yet."""
    spool.accounts.oldest_open = dict
    hear(spool, 1)
    items = spool.commit([make('a')])
    hear(spool, 2)
    writer = SpoolWriter(spool, 0.0)
    monkeypatch.setattr(spool.room, 'fits', lambda _: False)
    reports = []
    writer.on_commit(settled=lambda _: reports.append(watermark(spool)))
    writer.put(make('b'))
    spool.commit()
    hear(spool, 3)
    writer.settle([Outcome(items[0], State.DELIVERED)])
    writer.open()
    assert writer.close(10)
    assert reports == [(0.1, 0.1)]


def test_the_losses_of_a_kill_are_listed(root: Path, opened: Open) -> None:
    """Open batches: dropped, between what was durable and what was received; after that: missed, until the next message."""
    spool = new_spool(root)
    spool.open()
    hear(spool, 10)
    spool.commit([make('a', t_end_ns=NOON_NS + SECOND)])
    hear(spool, 11, 12, 13)
    spool.commit()
    abandon(spool)
    spool = opened()
    assert short(root) == [('dropped', 'restart', 3, 1.0, 1.3)]
    hear(spool, 20)
    spool.commit()
    assert short(root) == [('dropped', 'restart', 3, 1.0, 1.3), ('missed', 'restart', 6, 1.3, 2.0)]


def test_estimated_losses_of_a_restart_have_times(root: Path) -> None:
    """From the newest message of the previous session; also if there are numbers, but the stamp of the last one is unknown."""
    spool = new_spool(root)
    spool.open()
    hear(spool, 10)
    spool.close()
    spool = new_spool(root)
    spool.open()
    with spool.accounts.entry(CAMERA) as account:
        account.receive(None, None)
        account.add_estimate(1, {'restart': 4}, Times(NOON_NS + 5 * SECOND, NOON_NS + 5 * SECOND + LATE_NS))
    spool.commit()
    found = [gap for gap in journal(root) if gap.grade == 'estimated']
    spool.close()
    assert [(gap.cause, gap.count, gap.from_ns, gap.to_ns) for gap in found] == [
        ('restart', 4, NOON_NS + SECOND, NOON_NS + 5 * SECOND),
    ]  # fmt: skip


def test_messages_of_another_type_have_their_time(spool: Spool, root: Path) -> None:
    """Even if the topic's own type was never received."""
    spool.accounts.reject_other_type(CAMERA, 'x/msg/Y', 3, by_arrival(NOON_NS), by_arrival(NOON_NS + SECOND))
    spool.commit()
    assert short(root) == [('rejected', 'wrong_type', 3, 0.0, 1.0)]


def test_an_object_is_in_the_journal_while_it_is_quarantined(spool: Spool, root: Path) -> None:
    """A retry removes its messages again; an object of several topics adds those of each."""
    with spool.accounts.entry(CAMERA) as account:
        account.receive('p', 1)
    with spool.accounts.entry(f'{BAG}/imu') as account:
        for number in range(3):
            account.receive('p', number)
    one, two = spool.commit([make('a'), make('b', topic=None, samples=0, counts={f'{BAG}/imu': 3})])
    spool.commit(outcomes=[Outcome(each, State.QUARANTINED, 'refused') for each in (one, two)])
    assert [(gap.sink, gap.topic, gap.kind, gap.cause, gap.count) for gap in journal(root)] == [
        ('objects', CAMERA, 'quarantined', 'refused', 1), ('bags', '/imu', 'quarantined', 'refused', 3),
    ]  # fmt: skip
    with closing(sqlite3.connect(root / 'index.db')) as db:
        db.execute("UPDATE objects SET state = 'pending', reason = NULL")
        db.commit()
    assert journal(root) == []


def test_an_object_without_room_is_in_the_journal(root: Path) -> None:
    """With the times of its messages, whether it was evicted from the spool or never added."""
    spool = new_spool(root, max_bytes=20_000)
    spool.open()
    put(spool, make('a', b'1' * 9_000, t_start_ns=NOON_NS + SECOND, t_end_ns=NOON_NS + 3 * SECOND))
    put(spool, make('b', b'2' * 9_000, t_start_ns=NOON_NS + 4 * SECOND, t_end_ns=NOON_NS + 4 * SECOND))
    put(spool, make('c', b'3' * 9_000, priority=9, t_start_ns=NOON_NS + 5 * SECOND, t_end_ns=NOON_NS + 5 * SECOND))
    spool.close()
    found = short(root)
    assert ('evicted', 'no_room', 1, 5.0, 5.0) in found
    assert ledger.read(root, 'thor')['balanced']


def test_forgotten_gaps_stay_in_the_sums(root: Path) -> None:
    """Rows are removed with the keys that expire, and the ledger still balances."""
    clock = FakeClock()
    spool = new_spool(root, clock)
    spool.open()
    hear(spool, 1, 5, 25, 50)
    spool.commit()
    clock.now_ns += 1000 * DAY_NS
    spool.commit()
    assert len(short(root)) == 3, 'not reported yet'
    tell(root)
    clock.now_ns += DAY_NS
    spool.commit()
    assert short(root) == [('missed', 'transport', 46, None, None)]
    hear(spool, 30, 3, 60)
    spool.commit()
    assert sum(gap.count or 0 for gap in journal(root)) == 53
    assert ledger.read(root, 'thor')['balanced']
    spool.close()


@pytest.mark.parametrize('counts', [{}, {CAMERA: 1}], ids=['only one topic', 'of several'])
def test_an_object_evicted_during_its_upload_that_arrived_is_not_a_loss(root: Path, counts: dict[str, int]) -> None:
    """Its row is forgotten early, since its messages are that old; the total is corrected anyway."""
    clock = FakeClock()
    spool = new_spool(root, clock)
    spool.open()
    hear(spool, 1)
    (item,) = spool.commit([make('a', counts=counts, **({'topic': None, 'samples': 0} if counts else {}))])
    clock.now_ns += 1000 * DAY_NS
    spool.commit(outcomes=[Outcome(item, State.EVICTED, 'no_room')])
    tell(root)
    spool._forgot_ns = 0
    spool.commit()
    assert short(root) == [('evicted', 'no_room', 1, None, None)]
    deliver(spool, item)
    assert journal(root) == []
    assert ledger.read(root, 'thor')['balanced']
    spool.close()


class BootedAtNoon(FakeClock):
    """A boot clock unrelated to UTC."""

    def boot_ns(self) -> int:
        return self.now_ns - NOON_NS


def test_rows_of_an_hour_are_bounded(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Publishers that start and stop, with any stamps: further gaps of a cause share a row, and each message is counted."""
    monkeypatch.setattr(gaps, 'MAX_NEW_ROWS', 20)
    clock = BootedAtNoon(NOON_NS + 1800 * SECOND)
    spool = new_spool(root, clock)
    spool.open()
    lost = 0
    for number in range(300):
        with spool.accounts.entry(CAMERA) as account:
            stamp_ns = NOON_NS - number * DAY_NS if number % 3 else 0
            account.receive(f'p{number}', 1, by_arrival(stamp_ns))
            account.receive(f'p{number}', 5, by_arrival(stamp_ns + 10 * SECOND))
            lost += 3
        if number % 10 == 0:
            spool.commit()
    spool.commit()
    rows = journal(root)
    assert len(rows) == 20 + 2
    assert sum(row.count or 0 for row in rows) == lost
    (shared,) = [row for row in rows if row.publisher is None and row.from_ns is not None]
    assert shared.from_ns == NOON_NS - 299 * DAY_NS, 'the row spans the first to the last one'
    assert shared.begin_ns == NOON_NS, 'and belongs to the hour in which they were found'
    with spool.accounts.entry(CAMERA) as account:
        assert account.receive('p299', 3, by_arrival(NOON_NS))
    spool.commit()
    assert sum(row.count or 0 for row in journal(root)) == lost - 1, 'a late message is subtracted from it'
    assert ledger.read(root, 'thor')['balanced']
    clock.now_ns += 3600 * SECOND
    with spool.accounts.entry(CAMERA) as account:
        account.receive('p299', 50, by_arrival(clock.now_ns))
    spool.commit()
    assert 'p299' in {row.publisher for row in journal(root)}, 'the next hour has separate rows again'
    spool.close()


def test_a_gap_is_kept_until_it_is_reported(root: Path) -> None:
    """A robot that was off for longer than rows are kept has a gap with an old start. One that just ended is kept as well."""
    clock = FakeClock()
    spool = new_spool(root, clock)
    spool.open()
    hear(spool, 1)
    spool.commit([make('a')])
    spool.close()
    clock.now_ns += 30 * DAY_NS
    spool = new_spool(root, clock)
    spool.open()
    with spool.accounts.entry(CAMERA) as account:
        account.receive('p', 9, by_arrival(clock.now_ns))
    spool.commit()
    spool.commit()
    assert [(gap.cause, gap.count) for gap in journal(root)] == [('restart', 7)]
    tell(root)
    clock.now_ns += DAY_NS
    spool.commit()
    assert [gap.from_ns for gap in journal(root)] == [NOON_NS + 100 * MS], 'the gap ended a day ago'
    clock.now_ns += 2 * DAY_NS
    spool.commit()
    assert short(root) == [('missed', 'restart', 7, None, None)]
    spool.close()


def test_rows_without_a_time_are_removed_with_their_session(root: Path) -> None:
    """Rows from before the clock was set, without a time, or with a future time: their age is unknown."""
    clock = FakeClock(now_ns=500 * SECOND)
    spool = new_spool(root, clock)
    spool.open()
    for publisher, first_ns in (('boot', 100 * SECOND), ('future', NOON_NS * 3), ('none', 0)):
        with spool.accounts.entry(CAMERA) as account:
            account.receive(publisher, 1, by_arrival(first_ns))
            account.receive(publisher, 4, by_arrival(first_ns + 10 * SECOND if first_ns else 0))
    spool.commit()
    assert {gap.publisher for gap in journal(root)} >= {'boot', 'future'}
    clock.now_ns = NOON_NS
    spool.close()
    tell(root)
    spool = new_spool(root, clock)
    spool.open()
    spool.commit()
    assert len(journal(root)) >= 2
    clock.now_ns += 4 * DAY_NS
    spool.commit()
    assert [gap for gap in journal(root) if gap.begin_ns != gaps.FORGOTTEN] == []
    assert ledger.read(root, 'thor')['balanced']
    spool.close()


def test_the_number_of_rows_is_limited(spool: Spool, root: Path, clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reported or not, also if no clock is ever set: those unchanged for the longest time are merged into a total."""
    monkeypatch.setattr(gap_table, 'MAX_ROWS', 10)
    clock.now_ns = 500 * SECOND
    for number in range(30):
        with spool.accounts.entry(CAMERA) as account:
            account.receive(f'p{number}', 1, by_arrival(400 * SECOND))
            account.receive(f'p{number}', 3, by_arrival(402 * SECOND))
        spool.commit()
    clock.now_ns += 3600 * SECOND
    for _ in range(3):
        spool.commit()
        spool._forgot_ns = 0
    found = journal(root)
    assert len(found) <= 11
    assert sum(gap.count or 0 for gap in found) == 30
    assert {gap.publisher for gap in found} >= {'p29', 'p28'}
    assert ledger.read(root, 'thor')['balanced']


def test_before_the_clock_is_set_losses_have_times_since_boot() -> None:
    """A publisher on this machine stamps with the same wrong clock; an offset that becomes known later dates its messages."""
    clock = FakeClock(now_ns=5 * SECOND)
    found = TopicGaps(clock=clock)
    key = found.add('missed', 'transport', 2, by_arrival(3 * SECOND), by_arrival(4 * SECOND))
    assert key.begin_ns == 3 * SECOND


def test_a_failed_commit_keeps_the_times(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one contains the same data, once."""
    hear(spool, 1, 3)
    spool.commit()
    hear(spool, 6)
    with monkeypatch.context() as patch:
        patch.setattr(GapTable, 'write', _full)
        for _ in range(2):
            with pytest.raises(sqlite3.OperationalError):
                spool.commit()
            hear(spool, 5)
    spool.commit()
    assert short(root) == [('missed', 'transport', 2, 0.1, 0.6)]
    assert ledger.read(root, 'thor')['balanced']


def _full(*_: object) -> None:
    raise sqlite3.OperationalError('database or disk is full')


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just('take'), st.sampled_from('pq'), st.integers(0, 60)),
        st.tuples(st.sampled_from(['commit', 'fail', 'die', 'stop', 'forget', 'rebase', 'find', 'drop', 'reject', 'unnumbered']),
                  st.just(''), st.integers(1, 3)),
        st.tuples(st.sampled_from(['store', 'quarantine', 'retry', 'evict', 'deliver']), st.just(''), st.integers(0, 4)),
    ), max_size=40,
)  # fmt: skip


@settings(max_examples=examples(60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=STEPS, bounds=st.sampled_from([(7200, 500_000), (2, 500_000), (2, 3)]))
def test_the_journal_adds_up_at_every_commit(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, int]], bounds: tuple[int, int]
) -> None:
    """With late messages, failures, kills, evictions, quarantine, retries, forgotten rows, and more gaps than rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gaps, 'MAX_NEW_ROWS', bounds[0])
        patch.setattr(gap_table, 'MAX_ROWS', bounds[1])
        _take_steps(tmp_path_factory.mktemp('any') / 'spool', steps)


def _take_steps(root: Path, steps: list[tuple[str, str, int]]) -> None:
    clock = FakeClock()
    spool = new_spool(root, clock)
    spool.open()
    items: list[SpooledObject] = []
    try:
        for step in steps:
            clock.now_ns += 300 * MS
            spool = _do(spool, root, clock, step, items)
            spool.commit()
            found = ledger.read(root, 'thor')
            assert found['balanced'], ledger.imbalances(found)
            assert all((gap.count or 0) > 0 for gap in journal(root))
    finally:
        spool.close()


def _do(spool: Spool, root: Path, clock: FakeClock, step: tuple[str, str, int], items: list[SpooledObject]) -> Spool:
    what, publisher, number = step
    if what == 'take':
        hear(spool, number, publisher=publisher)
    elif what in {'die', 'stop'}:
        abandon(spool) if what == 'die' else spool.close()
        spool = new_spool(root, clock)
        spool.open()
    elif what == 'forget':
        tell(root)
        clock.now_ns += number * 20 * 24 * 3600 * SECOND
    elif what in {'store', 'quarantine', 'deliver', 'retry', 'evict'}:
        _do_with_objects(spool, root, clock, what, number, items)
    else:
        _count(spool, clock, what, number)
    return spool


def _count(spool: Spool, clock: FakeClock, what: str, number: int) -> None:
    accounts = spool.accounts
    if what == 'fail':
        accounts.reject(CAMERA, {'nothing': 0})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(GapTable, 'write', _full)
            with pytest.raises(sqlite3.OperationalError):
                spool.commit()
    elif what == 'rebase':
        accounts.rebase(CAMERA)
    with accounts.entry(CAMERA) as account:
        count = min(number, account.open)
        if what == 'find':
            account.recover(number)
        elif what == 'unnumbered':
            account.receive(None, None)
            account.add_estimate(1, {'transport': number - 2}, by_arrival(clock.now_ns))
    if what == 'drop':
        accounts.drop(CAMERA, 'queue_full', count, by_arrival(clock.now_ns - SECOND), by_arrival(clock.now_ns))
    elif what == 'reject':
        accounts.reject(CAMERA, {'truncated': count})


def _do_with_objects(spool: Spool, root: Path, clock: FakeClock, what: str, number: int, items: list[SpooledObject]) -> None:
    if what == 'store':
        with spool.accounts.entry(CAMERA) as account:
            is_open = account.open > 0
        if is_open:
            made = make(f'{clock.now_ns}', t_start_ns=clock.now_ns, t_end_ns=clock.now_ns + number * SECOND)
            items += spool.commit([made])
    elif items:
        item = items[number % len(items)]
        if what == 'quarantine':
            spool.commit(outcomes=[Outcome(item, State.QUARANTINED, 'refused')])
        elif what == 'deliver':
            spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
        elif what == 'retry':
            _run(root, "UPDATE objects SET state = 'pending', reason = NULL WHERE id = ? AND state = 'quarantined'", item.id)
        else:
            _run(root, "UPDATE objects SET state = 'evicted', reason = 'no_room' WHERE id = ? AND state = 'pending'", item.id)


def _run(root: Path, query: str, number: int) -> None:
    with closing(sqlite3.connect(root / 'index.db')) as db:
        db.execute(query, (number,))
        db.commit()


def test_a_home_with_losses_reads_in_the_order_of_time(spool: Spool, root: Path) -> None:
    """For all sinks and topics."""
    hear(spool, 20, 30, topic='/b')
    hear(spool, 1, 9, topic=f'{BAG}/a')
    spool.commit()
    assert [(gap.sink, gap.topic) for gap in journal(root)] == [('bags', '/a'), ('objects', '/b')]
    assert Counter(gap.kind for gap in journal(root)) == {'missed': 2}
