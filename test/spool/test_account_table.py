"""Objects with messages of several topics, in the accounts of a separate sink, and the open messages of earlier sessions."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import FakeClock, clear_uncataloged, index_of, make, new_spool, receive, settle

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import DataObject, State
from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.span import NumberRun
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.topic_account import BAG

ODOM, IMU = f'{BAG}/odom', f'{BAG}/imu'


def a_slice(number: int, **counts: int) -> DataObject:
    """A slice of a bag, with this many messages of each topic."""
    accounts = {f'{BAG}/{name}': count for name, count in counts.items()}
    return make(f'thor/rosbags/b/b_{number}.mcap', b'%d' % number, sensor='bag', topic=None, samples=sum(counts.values()),
                counts=accounts)  # fmt: skip


def bags(root: Path) -> dict[str, tuple[int, int, dict[str, int], int]]:
    """Topic -> (received, stored, dropped, open), from a ledger that balances and agrees with the files."""
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    with index_of(root) as index:
        assert list(index.miscounted()) == []
    return {topic: (row['received'], row['stored'], row['dropped'], row['open']) for topic, row in found['bags'].items()}


def stored_in(root: Path, topic: str) -> dict[str, int]:
    row = ledger.read(root, 'thor')['bags'][topic]
    return {state: count for state, count in row['stored_in'].items() if count}


def started(root: Path, clock: FakeClock) -> Spool:
    """The next session, with bags."""
    spool = new_spool(root, clock)
    spool.open()
    spool.carry(BAG)
    return spool


def find(spool: Spool, item: DataObject) -> None:
    """Have recovery process a slice that was left behind."""
    spool.accounts.carried.recover(item.counts, runs(item))
    spool.commit([item])


def runs(item: DataObject) -> dict[str, list[NumberRun]]:
    """The numbers of a slice's messages, if it has all messages of the publisher."""
    return {topic: [NumberRun(1, 1 + count, NO_TIMES, NO_TIMES)] for topic, count in item.counts.items()}


def die(spool: Spool, root: Path) -> Path:
    """Return the spool that another process would find after a SIGKILL of this one."""
    copy = root.with_name(f'{root.name}-copy')
    shutil.copytree(root, copy)
    return copy


def killed(spool: Spool, root: Path) -> Path:
    """The state after a session that recorded ten messages and was killed before it spooled a slice."""
    receive(spool, 10, IMU)
    spool.commit()
    return die(spool, root)


def test_a_slice_counts_for_each_of_its_topics(spool: Spool, root: Path) -> None:
    """Its messages are stored in the accounts of the bags, not of the sensors, and follow the object from state to state."""
    receive(spool, 3, IMU)
    receive(spool, 2, ODOM)
    first, second = spool.commit([a_slice(0, imu=2, odom=2), a_slice(1, imu=1)])
    assert bags(root) == {'/imu': (3, 3, {}, 0), '/odom': (2, 2, {}, 0)}
    assert stored_in(root, '/imu') == {'pending': 3}
    settle(spool, first, State.DELIVERED)
    settle(spool, second, State.QUARANTINED, 'refused')
    assert stored_in(root, '/imu') == {'delivered': 2, 'quarantined': 1}
    assert stored_in(root, '/odom') == {'delivered': 2}
    assert ledger.read(root, 'thor')['topics'] == {}


def test_totals_stay_when_slices_are_forgotten(opened: Open, root: Path, clock: FakeClock) -> None:
    """The rows of old delivered slices are removed with their contents, and the totals do not change."""
    spool = opened(remember_days=1.0)
    receive(spool, 3, IMU)
    (item,) = spool.commit([a_slice(0, imu=3)])
    settle(spool, item, State.DELIVERED)
    clear_uncataloged(root)
    clock.now_ns += 3 * 24 * 3600 * 10**9
    spool.commit()
    with sqlite3.connect(root / 'index.db') as db:
        assert db.execute('SELECT (SELECT count(*) FROM objects), (SELECT count(*) FROM contents)').fetchone() == (0, 0)
    assert stored_in(root, '/imu') == {'delivered': 3}
    assert bags(root) == {'/imu': (3, 3, {}, 0)}


def test_a_lost_index_is_rebuilt_with_what_slices_hold(opened: Open, root: Path) -> None:
    spool = opened()
    receive(spool, 3, IMU)
    spool.commit([a_slice(0, imu=3)])
    spool.close()
    for path in root.glob('index.db*'):
        path.unlink()
    opened()
    assert bags(root) == {'/imu': (3, 3, {}, 0)}
    assert stored_in(root, '/imu') == {'pending': 3}


@pytest.mark.parametrize(('recorded', 'expected'), [
    (0, (10, 0, {'restart': 10}, 0)), (7, (10, 7, {'restart': 3}, 0)), (10, (10, 10, {}, 0)), (12, (12, 12, {}, 0)),
])  # fmt: skip
def test_open_messages_of_a_dead_session_are_settled_from_its_files(
    opened: Open, root: Path, clock: FakeClock, recorded: int, expected: tuple[object, ...]
) -> None:
    """Messages found again are stored, others are lost by restart; those missing from the accounts are received as well."""
    left = killed(opened(), root)
    after = started(left, clock)
    assert bags(left) == {'/imu': (10, 0, {}, 10)}
    if recorded:
        find(after, a_slice(0, imu=recorded))
    assert after.accounts.carried.drop_rest('restart') == max(0, 10 - recorded)
    after.close()
    assert bags(left) == {'/imu': expected}


def test_messages_missing_from_a_slice_were_lost_after_its_last_message(opened: Open, root: Path, clock: FakeClock) -> None:
    """On both clocks: bags are dated by arrival, so a slice that is durable alone does not contain the stamps of its messages."""
    spool = opened()

    def at(second: float) -> Times:
        return Times(clock.now_ns + round((second - 146) * SECOND), clock.now_ns + round(second * SECOND))

    with spool.accounts.entry(IMU) as account:
        for second in range(20):
            account.receive('p', second + 1, at(second))
            account.gaps.newest = at(second)
    spool.commit([make('thor/rosbags/b/b_0.mcap', b'0', sensor='bag', topic=None, samples=5, counts={IMU: 5},
                       t_end_ns=clock.now_ns + 4 * SECOND)])  # fmt: skip
    left = die(spool, root)
    for newest, begin_s in (({}, 4), ({IMU: at(16)}, 16)):
        copy = left.with_name(f'from-{begin_s}')
        shutil.copytree(left, copy)
        after = started(copy, clock)
        after.accounts.carried.recover({IMU: 12}, {}, newest)
        after.accounts.carried.drop_rest('restart')
        after.commit()
        after.close()
        (gap,) = [each for each in ledger.journal(copy, 'thor') if each.sink == 'bags']
        assert (gap.from_ns, gap.received_from_ns) == at(begin_s)
        assert (gap.to_ns, gap.received_to_ns) == at(19)


def test_each_process_settles_its_own_bags(opened: Open, root: Path, clock: FakeClock) -> None:
    """A node does not give up what a killed ``bag record`` left open: the next ``bag record`` finds the file."""
    opened().close()
    recording = Spool(root, SpoolSettings(min_free_bytes=0), clock, 'thor records')
    recording.open()
    receive(recording, 10, IMU)
    recording.commit()
    left = die(recording, root)
    node = started(left, clock)
    assert node.accounts.carried.drop_rest('restart') == 0
    node.close()
    again = Spool(left, SpoolSettings(min_free_bytes=0), clock, 'thor records')
    again.open()
    again.carry(BAG)
    find(again, a_slice(0, imu=8))
    assert again.accounts.carried.drop_rest('restart') == 2
    again.close()
    assert bags(left) == {'/imu': (10, 8, {'restart': 2}, 0)}


def test_a_kill_during_settling_costs_nothing(opened: Open, root: Path, clock: FakeClock) -> None:
    """Open messages that one session inherited and did not settle are inherited by the next."""
    first = killed(opened(), root)
    after = started(first, clock)
    find(after, a_slice(0, imu=4))
    second = die(after, first)
    after.close()
    last = started(second, clock)
    find(last, a_slice(1, imu=5))
    assert last.accounts.carried.drop_rest('restart') == 1
    last.close()
    assert bags(second) == {'/imu': (10, 9, {'restart': 1}, 0)}


def test_messages_open_at_a_stop_wait_for_the_next_start(opened: Open, root: Path) -> None:
    """A slice that missed the deadline is not lost; open messages of sensors are dropped, since nothing finds them."""
    spool = opened()
    receive(spool, 5, IMU)
    receive(spool, 2, '/imu')
    spool.close()
    assert bags(root) == {'/imu': (5, 0, {}, 5)}
    assert ledger.read(root, 'thor')['topics']['/imu']['dropped'] == {'shutdown': 2}
    after = opened()
    after.carry(BAG)
    assert after.accounts.carried.drop_rest('restart') == 5


def test_found_messages_are_counted_once_whatever_is_killed_next(opened: Open, root: Path, clock: FakeClock) -> None:
    """A session that found messages and is killed before the next one arrives leaves no gap for them to the following session."""
    first = killed(opened(), root)
    second = started(first, clock)
    find(second, a_slice(0, imu=14))
    left = die(second, first)
    last = started(left, clock)
    with last.accounts.entry(IMU) as account:
        assert account.receive('p', 20)
    last.close()
    row = ledger.read(left, 'thor')['bags']['/imu']
    assert (row['published'], row['missed']) == (20, 5)


@pytest.mark.parametrize('found_first', [True, False])
@pytest.mark.parametrize('is_told', [True, False])
def test_a_recorded_message_is_not_missed_as_well(
    opened: Open, root: Path, clock: FakeClock, found_first: bool, is_told: bool
) -> None:
    """Numbers missing from the killed session's accounts are in its file: the gap before the next number is shorter."""
    left = killed(opened(), root)
    after = started(left, clock)
    item = a_slice(0, imu=14)
    if found_first:
        after.accounts.carried.recover(item.counts, runs(item) if is_told else {})
    with after.accounts.entry(IMU) as account:
        assert account.receive('p', 31)
    if not found_first:
        after.accounts.carried.recover(item.counts, runs(item) if is_told else {})
    after.commit([item])
    after.close()
    found = ledger.read(left, 'thor')
    row = found['bags']['/imu']
    assert (row['published'], row['received'], row['missed_by']) == (31, 15, {'restart': 16})
    assert ledger.imbalances(found) == []
