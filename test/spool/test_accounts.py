from __future__ import annotations

import copy
import sqlite3
import threading
import tracemalloc
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spool.conftest import Open
from spool.making import receive

from shadowhound_data_logger.core.stamps import by_arrival
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool import span as module
from shadowhound_data_logger.spool.account_rows import PublisherRow
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.gaps import EXACT
from shadowhound_data_logger.spool.span import NumberRun, Ranges, Span
from shadowhound_data_logger.spool.topic_account import (
    FORMER,
    MAX_NODES,
    MAX_OTHER_TYPES,
    MAX_PUBLISHERS,
    MORE_TYPES,
    RECEIVED_ONLY,
    TopicAccount,
)


def run(start: int, stop: int, first_ns: int, last_ns: int) -> NumberRun:
    return NumberRun(start, stop, by_arrival(first_ns), by_arrival(last_ns))


def taken(span: Span, *numbers: int) -> list[bool]:
    """Observe numbers one after the other."""
    return [span.observe(number) for number in numbers]


def figures(span: Span) -> tuple[int, int, dict[str, int]]:
    """(published, received, missed by cause)."""
    return span.published, span.received, dict(+span.missed)


def test_accounting_begins_with_the_first_number_taken() -> None:
    """What a publisher sent before it was matched is not counted as a loss."""
    span = Span()
    assert taken(span, 500, 501) == [True, True]
    assert figures(span) == (2, 2, {})


def test_a_gap_is_missed_by_transport() -> None:
    """Skipped numbers are published and missed."""
    span = Span()
    taken(span, 1, 5)
    assert figures(span) == (5, 2, {'transport': 3})


def test_a_repeat_is_counted_once() -> None:
    """A repeated number is refused, whether it is old or new."""
    span = Span()
    assert taken(span, 7, 8, 8, 7) == [True, True, False, False]
    assert figures(span) == (2, 2, {})


def test_a_late_number_fills_its_hole() -> None:
    """A missed number that arrives late is received, once."""
    span = Span()
    assert taken(span, 1, 4, 3, 3) == [True, True, True, False]
    assert figures(span) == (4, 3, {'transport': 1})


def test_history_before_the_first_number_is_received() -> None:
    """TRANSIENT_LOCAL history that arrives after a live message counts once and makes no gap."""
    span = Span()
    assert taken(span, 10, 8, 9, 8, 11) == [True, True, True, False, True]
    assert figures(span) == (4, 4, {})
    assert span.first == 8


def test_history_taken_before_a_restart_is_not_taken_again() -> None:
    """A durable span begins at the lowest number taken, so that a restarted node refuses the same history."""
    accounts = Accounts()
    with accounts.entry('/map') as account:
        assert [account.receive('p', number) for number in (10, 8, 9)] == [True] * 3
    snapshot = accounts.snapshot({})
    assert snapshot is not None
    with Accounts(snapshot.publishers).entry('/map') as account:
        assert [account.receive('p', number) for number in (8, 9, 10, 11)] == [False, False, False, True]


def test_an_entry_holds_the_lock_as_long_as_it_is_entered() -> None:
    """It is held until an error inside the block, too; changes made during that time are in the next snapshot."""
    accounts = Accounts()
    with pytest.raises(ZeroDivisionError), accounts.entry('/map') as account:
        account.received += 1 // 0
    with accounts.entry('/map') as account:
        account.received += 1
        held = threading.Thread(target=accounts.drop, args=('/map', 'queue_full', 1))
        held.start()
        held.join(0.05)
        assert held.is_alive()
    held.join()
    snapshot = accounts.snapshot({})
    assert snapshot is not None
    (row,) = snapshot.topics
    assert (row.received, row.dropped) == (1, {'queue_full': 1})


def test_the_gap_of_a_restart_has_its_cause() -> None:
    """Numbers between the earlier session's last and this one's first are missed by restart, later gaps by transport."""
    span = Span(first=1, last=100, inherited=True)
    assert taken(span, 100, 111, 113) == [False, True, True]
    assert figures(span) == (13, 2, {'restart': 10, 'transport': 1})


def test_history_does_not_hide_the_restart() -> None:
    """A message from before the inherited span does not change the cause of the gap after it."""
    span = Span(first=50, last=100, inherited=True)
    assert taken(span, 40, 103) == [True, True]
    assert figures(span) == (4, 2, {'restart': 2})


def test_a_late_number_of_a_restart_fills_its_hole() -> None:
    """A message that overtook others after a restart does not turn them into repeats."""
    span = Span(first=1, last=10, inherited=True)
    assert taken(span, 13, 12) == [True, True]
    assert figures(span) == (3, 2, {'restart': 1})


def test_messages_of_the_previous_session_are_counted_by_their_numbers() -> None:
    """They arrive again as repeats; numbers missing between and after them are missed by the restart."""
    span = Span(first=1, last=10, inherited=True, last_times=by_arrival(100))
    assert span.recover([run(7, 13, 70, 120), run(15, 18, 150, 170)], 5)
    assert taken(span, 12, 17, 20) == [False, False, True]
    assert figures(span) == (10, 6, {'restart': 4})


def test_a_file_that_begins_with_the_next_number_has_the_same_publisher() -> None:
    """The message before it is not in any file."""
    span = Span(first=1, last=10, inherited=True, last_times=by_arrival(100))
    assert span.recover([run(11, 13, 110, 120)], 2)
    assert taken(span, 13) == [True]
    assert figures(span) == (3, 3, {})


@pytest.mark.parametrize('runs', [
    [run(1, 6, 101, 150)], [run(12, 17, 120, 160)], [run(10, 13, 500, 520)], [run(10, 16, 101, 150)], [],
])  # fmt: skip
def test_numbers_that_may_be_of_another_publisher_are_not_used(runs: list[NumberRun]) -> None:
    """Then only the number of messages is counted, and the next sequence number is treated like any other."""
    span = Span(first=1, last=10, inherited=True, last_times=by_arrival(100))
    assert not span.recover(runs, 5)
    span.add_unnumbered(5)
    assert taken(span, 11, 12, 12, 18) == [True, True, False, True]
    assert figures(span) == (13, 8, {'transport': 5})


def test_a_counted_gap_is_filled_by_messages_in_a_file() -> None:
    """If the next message arrived before the file was read; numbers not in the file stay missed, and may still arrive."""
    span = Span(first=1, last=10, inherited=True, last_times=by_arrival(100))
    assert taken(span, 20) == [True]
    assert span.recover([run(5, 13, 50, 120), run(14, 16, 140, 150)], 4)
    assert taken(span, 12, 13, 14, 17) == [False, True, False, True]
    assert figures(span) == (10, 7, {'restart': 3})


def test_numbers_in_a_file_are_the_low_32_bits() -> None:
    """As in MCAP: the high bits of the publisher's last number are added."""
    span = Span(first=1, last=(1 << 32) - 2, inherited=True, last_times=by_arrival(100))
    assert span.recover([run((1 << 32) - 2, 1 << 32, 100, 110)], 1)
    assert span.recover([run(0, 2, 120, 130)], 2)
    assert taken(span, (1 << 32) + 1, (1 << 32) + 2) == [False, True]
    assert figures(span) == (4, 4, {})


def test_after_a_rebase_the_gap_is_not_missed() -> None:
    """What was published during a pause is not published for the ledger."""
    span = Span()
    taken(span, 1, 2)
    span.rebase()
    assert taken(span, 50, 52) == [True, True]
    assert figures(span) == (5, 4, {'transport': 1})


def test_a_rebase_makes_no_repeat_new() -> None:
    """Numbers counted before a rebase are refused after it (TRANSIENT_LOCAL delivers again)."""
    span = Span()
    taken(span, 1, 2, 3)
    span.rebase()
    assert taken(span, 2, 3, 9, 8, 8) == [False, False, True, True, False]
    assert figures(span) == (5, 5, {})


def test_the_newest_holes_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory for holes is bounded: old holes, which are unlikely to be filled, are replaced by new ones."""
    monkeypatch.setattr(module, 'MAX_RANGES', 2)
    span = Span()
    taken(span, 0, 2, 6, 8)  # holes 1, 3..5, then 7
    assert taken(span, 7, 5, 1) == [True, True, False]
    assert figures(span) == (9, 6, {'transport': 3})


@given(st.lists(st.tuples(st.sampled_from('atx'), st.integers(0, 40)), max_size=60))
def test_ranges_are_sets_of_numbers(steps: list[tuple[str, int]]) -> None:
    """For any order of append, add and remove."""
    ranges, numbers = Ranges(), set[int]()
    for what, number in steps:
        if what == 'a':
            start = max(numbers, default=0) + 2
            ranges.append(start, start + number % 5 + 1, '')
            numbers |= set(range(start, start + number % 5 + 1))
        elif what == 't':
            found = ranges.within(number, number + 3)
            assert [each for start, stop, _ in found for each in range(start, stop)] == sorted(
                numbers & set(range(number, number + 3))
            )
            for start, stop, _ in found[:1]:
                ranges.cut(start, stop)
                numbers -= set(range(start, stop))
        elif number not in numbers:
            assert ranges.add(number)
            numbers.add(number)
        assert [number for number in range(300) if number in ranges] == sorted(number for number in numbers if number < 300)


def test_a_publisher_that_leaps_takes_little_memory() -> None:
    """It chooses its numbers, over the network: neither a gap of billions nor many small gaps are remembered one by one."""
    span = Span()
    taken(span, *range(0, 100_000, 2), 1 << 62)
    taken(span, *range(-1, -100_000, -2))
    tracemalloc.start()
    other = copy.deepcopy(span)
    size = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert figures(other) == figures(span)
    assert size < 300_000


def test_invalid_sequence_numbers_stop_no_commit(opened: Open, root: Path) -> None:
    """They come from the network: numbers with sums that SQLite cannot hold, or that startup takes for damage, are ignored."""
    spool = opened()
    for publisher in range(2 * MAX_PUBLISHERS):
        with spool.accounts.entry('/odom') as account:
            for number in (1, 1 << 39, 1 << 53, (1 << 62) - 1, 1 << 62, (1 << 64) - 2):
                account.receive(f'stranger{publisher}', number)
    spool.commit([])
    spool.close()
    assert not opened().recovery.found_anything
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    assert found['topics']['/odom']['received'] == 12 * MAX_PUBLISHERS


def test_publishers_that_come_and_go_are_summed(opened: Open, root: Path) -> None:
    """Only some have separate accounts, in memory and in the index; both identities hold exactly, and no gap is lost."""
    spool = opened()
    for number in range(3000):
        with spool.accounts.entry('/odom') as account:
            assert account.receive(f'stranger{number}', 1)
            assert account.receive(f'stranger{number}', 4)
            if number % 100 == 0:
                assert account.receive('robot', number + 1)
        if number % 500 == 0:
            spool.commit([])
    with spool.accounts.entry('/odom') as account:
        assert len(account.publishers) <= MAX_PUBLISHERS
    spool.close()
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    row = found['topics']['/odom']
    assert (row['accounting'], row['received'], row['missed']) == ('exact', 6030, 6000 + 2900 - 29)
    with closing(sqlite3.connect(root / 'index.db')) as db:
        assert db.execute('SELECT count(*) FROM publishers').fetchone()[0] <= MAX_PUBLISHERS
        assert db.execute('SELECT published FROM publishers WHERE publisher = ?', (FORMER,)).fetchone()[0] > 10_000


def test_a_summed_publisher_that_returns_is_counted_again(opened: Open, root: Path) -> None:
    """What it published in between is missed, what it repeats is a repeat; in the next session it continues where it was."""
    spool = opened()
    receive(spool, 10, '/odom', 'robot')
    spool.close()
    spool = opened()
    with spool.accounts.entry('/odom') as account:
        for number in (11, 12):
            assert account.receive('robot', number)
        for number in range(MAX_PUBLISHERS):
            assert account.receive(f'stranger{number}', 1)
        assert 'robot' not in account.publishers
    spool.commit([])
    spool.close()
    spool = opened()
    with spool.accounts.entry('/odom') as account:
        assert [account.receive('robot', number) for number in (12, 13, 15)] == [False, True, True]
        for number in range(MAX_PUBLISHERS):
            assert account.receive(f'stranger{number}', 2)
        assert 'robot' not in account.publishers
        assert [account.receive('robot', number) for number in (15, 17)] == [False, True]
    spool.close()
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    assert found['topics']['/odom']['missed_by'] == {'transport': 2}


def test_uncommitted_sums_are_tried_again() -> None:
    """Rows that a failed commit should have removed are removed by the next one."""
    accounts = Accounts()
    with accounts.entry('/odom') as account:
        for number in range(MAX_PUBLISHERS + 1):
            account.receive(f'stranger{number}', 1)
    first = accounts.snapshot({})
    accounts.mark_dirty()
    second = accounts.snapshot({})
    assert first is not None
    assert second is not None
    assert first.removed == second.removed
    assert len(first.removed) == MAX_PUBLISHERS // 2


NUMBERS = st.lists(st.integers(0, 60), max_size=80)


@given(NUMBERS, st.sets(st.integers(0, 80)), st.none() | st.tuples(st.integers(0, 30), st.integers(0, 30)))
def test_published_is_received_and_missed(numbers: list[int], rebases: set[int], inherited: tuple[int, int] | None) -> None:
    """For any numbers in any order, published = received + missed, and each number is accepted at most once."""
    span = Span(min(inherited), max(inherited), inherited=True) if inherited else Span()
    accepted: list[int] = []
    for index, number in enumerate(numbers):
        if index in rebases:
            span.rebase()
        if span.observe(number):
            accepted.append(number)
        assert span.published == span.received + sum(span.missed.values())
        assert min(span.missed.values(), default=0) >= 0
    assert len(accepted) == len(set(accepted)) == span.received


@given(NUMBERS)
def test_every_new_number_is_received(numbers: list[int]) -> None:
    """Without an earlier session, received is the number of distinct numbers, and missed the holes above the first one."""
    span = Span()
    for number in numbers:
        span.observe(number)
    distinct = set(numbers)
    assert span.received == len(distinct)
    holes = set(range(numbers[0], max(distinct) + 1)) - distinct if numbers else set()
    assert sum(span.missed.values()) == len(holes)


def test_without_a_number_a_message_is_only_received() -> None:
    """Accounting without sequence numbers is not called exact."""
    account = TopicAccount()
    assert account.receive('p', 1)
    assert account.accounting == EXACT
    assert account.receive('p', None)
    assert account.receive(None, 3)
    assert (account.accounting, account.received, account.unknown, account.missed) == (RECEIVED_ONLY, 3, 2, None)


def test_before_the_first_message_nothing_is_known() -> None:
    """For a topic that was not received, missed is unknown, not 0."""
    assert (TopicAccount().missed, TopicAccount().missed_estimated) == (None, None)


def test_two_publishers_have_separate_numbers() -> None:
    """The same number of two publishers is two messages."""
    account = TopicAccount()
    assert [account.receive('a', 1), account.receive('b', 1), account.receive('b', 1)] == [True, True, False]
    assert account.received == 2


def test_open_is_what_has_no_outcome() -> None:
    accounts = Accounts()
    with accounts.entry('/odom') as account:
        for number in range(10):
            account.receive('p', number)
        account.skipped += 3
    accounts.reject('/odom', {'bad': 1})
    accounts.drop('/odom', 'full', 2)
    accounts.store({'/odom': (3, by_arrival(77))})
    with accounts.entry('/odom') as account:
        assert account.open == 1
    assert accounts.last_stored_ns('/odom') == 77


def test_a_snapshot_holds_what_is_about_to_be_durable() -> None:
    """A snapshot counts the samples in its commit as stored; if nothing changed there is no snapshot."""
    accounts = Accounts()
    with accounts.entry('/odom') as account:
        account.receive('p', 5)
    snapshot = accounts.snapshot({'/odom': (1, by_arrival(9))})
    assert snapshot is not None
    assert (snapshot.topics[0].stored, snapshot.topics[0].open, snapshot.topics[0].last_stored.stamp_ns) == (1, 0, 9)
    assert snapshot.publishers == (PublisherRow('/odom', 'p', 5, 5, 1, 1, {}),)
    accounts.store({'/odom': (1, by_arrival(9))})
    assert accounts.snapshot({}) is None
    accounts.mark_dirty()
    assert accounts.snapshot({}) is not None


def test_samples_of_an_unreceived_topic_are_detected() -> None:
    """An object of a topic without an account makes the topic's account negative immediately instead of being ignored."""
    snapshot = Accounts().snapshot({'/ghost': (2, by_arrival(1))})
    assert snapshot is not None
    assert [(row.topic, row.open) for row in snapshot.topics] == [('/ghost', -2)]


def test_the_last_stored_stamp_is_inherited() -> None:
    """A restarted node continues to sample after the newest durable sample of any session."""
    accounts = Accounts(last_stored={'/odom': by_arrival(50)})
    assert accounts.last_stored_ns('/odom') == 50
    accounts.store({'/odom': (1, by_arrival(40))})
    assert accounts.last_stored_ns('/odom') == 50
    assert accounts.last_stored_ns('/imu') == 0


def test_messages_of_another_type_are_received_and_rejected(opened: Open, root: Path) -> None:
    """None is the topic's own or missed; both identities hold, across sessions, and what was not counted is unknown."""
    for counted in (True, False):
        spool = opened()
        receive(spool, 5, '/odom')
        spool.accounts.add_other_type('/odom', 'b/msg/B', ['/x'], counted=True, named=True)
        spool.accounts.add_other_type('/odom', 'c/msg/C', ['', '/y'], counted=counted, named=True)
        spool.accounts.reject_other_type('/odom', 'b/msg/B', 3)
        spool.close()
        found = ledger.read(root, 'thor')
        assert ledger.imbalances(found) == []
    row = found['topics']['/odom']
    assert (row['accounting'], row['published'], row['received'], row['missed']) == ('exact', 16, 16, 0)
    assert row['rejected'] == {'wrong_type': 6}
    assert row['other_types'] == {
        'b/msg/B': {'publishers': ['/x'], 'messages': 6}, 'c/msg/C': {'publishers': ['/y'], 'messages': None},
    }  # fmt: skip


def test_the_number_of_other_types_is_limited() -> None:
    """A client that invents types cannot fill memory: above a limit they share one entry, and nothing of it is counted."""
    accounts = Accounts()
    for number in range(1000):
        accounts.add_other_type('/odom', f'b/msg/B{number}', [f'/{number}'], counted=True, named=True)
    for number in range(1000):
        accounts.add_other_type('/odom', 'b/msg/B1', [f'/{number}'], counted=True, named=True)
    found = accounts.totals()['/odom'].other_types
    assert len(found) == MAX_OTHER_TYPES + 1
    assert found[MORE_TYPES].messages is None
    assert len(found['b/msg/B1'].publishers) == len(found[MORE_TYPES].publishers) == MAX_NODES


def test_without_a_configured_type_losses_are_unknown() -> None:
    """If another type is published and not counted, missed is unknown for the topic, not 0."""
    accounts = Accounts()
    with accounts.entry('/odom') as account:
        account.receive('p', 1)
    accounts.add_other_type('/odom', 'b/msg/B', [], counted=True, named=False)
    assert accounts.totals()['/odom'].missed == 0
    accounts.add_other_type('/odom', 'b/msg/B', [], counted=False, named=False)
    assert accounts.totals()['/odom'].missed is None
    accounts.add_other_type('bag:/odom', 'b/msg/B', [], counted=False, named=False, only_known=True)
    assert accounts.totals('bag:') == {}
