"""A store that is away: one probe at a time, ever more rarely, said once, and nothing is given up."""

from __future__ import annotations

import pytest
from shipping.drive import CAP_S, Drive
from shipping.fakes import FakeSpool, Time

from shadowhound_data_logger.core.errors import StoreUnavailable
from shadowhound_data_logger.shipping.failures import Verdict

AWAY = StoreUnavailable('Tower is away')


def test_an_unreachable_store_gets_one_probe_at_a_time(drive: Drive) -> None:
    """After a failure nobody goes on before the backoff, and then one thread alone."""
    drive.spool.add(5)
    first = drive.next()
    assert first is not None
    drive.fail(first, AWAY)
    assert drive.next() is None
    drive.wait()
    assert drive.next() is None
    drive.clock.now += 1000.0
    assert drive.next() is None


def test_the_next_probe_is_another_object(drive: Drive) -> None:
    """If it is delivered, the store was never away, and only the first object waits."""
    drive.spool.add(3)
    first = drive.next()
    assert first is not None
    drive.fail(first, AWAY)
    probe = drive.wait()
    assert probe != first
    drive.deliver(probe)
    assert drive.schedule.snapshot().outage is None
    assert drive.schedule.snapshot().deferred == 1
    assert drive.said() == []


def test_one_failing_object_does_not_block_others(drive: Drive) -> None:
    """Its second failure after others' success is its own: no breaker opens any more, and it is tried ever more rarely."""
    bad = drive.spool.add(priority=0)[0]
    drive.spool.add(500)
    tries, opened = 0, 0
    while len(drive.spool.items) > 1:
        item = drive.wait()
        if item == bad:
            tries += 1
            drive.fail(item, AWAY)
            opened += drive.schedule.snapshot().outage is not None
        else:
            drive.clock.now += 0.05
            drive.deliver(item)
    assert 3 <= tries <= 15
    assert opened == 1
    assert drive.said() == []


def test_a_put_that_fails_although_another_one_got_through_meanwhile_is_its_own_fault(drive: Drive) -> None:
    """A put that hung for half a minute says nothing about a store that took others in that time."""
    slow, quick = drive.spool.add(2)
    assert drive.next() == slow
    assert drive.next() == quick
    drive.deliver(quick)
    drive.fail(slow, AWAY)
    assert drive.schedule.snapshot().outage is None


def test_an_outage_is_announced_once_and_its_end_once(drive: Drive) -> None:
    """Its second failure begins it, with the remedy; the first success ends it, with how long it took."""
    drive.spool.add(5)
    began = drive.clock.now
    for _ in range(20):
        drive.fail(drive.wait(), StoreUnavailable('Tower is away', remedy='switch it on'))
    lasted = drive.clock.now - began
    assert lasted > 60.0
    while drive.spool.items:
        drive.deliver(drive.wait())
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.RETRY, None, True)]
    begin, end = drive.notices
    assert begin.text(5) == ('the store is away: Tower is away (switch it on); 5 objects wait in the spool, '
                             'it is tried again until it works')  # fmt: skip
    assert end.lasted_s is not None
    assert end.lasted_s >= lasted
    assert 'delivery continues after' in end.text(4)


def test_puts_that_fail_together_are_one_failure(spool: FakeSpool, clock: Time) -> None:
    """Four threads that lose the store at once do not make the first pause sixteen times as long."""
    drive = Drive(spool, clock, threads=4)
    spool.add(10)
    together = [drive.next() for _ in range(4)]
    for item in together:
        assert item is not None
        drive.fail(item, AWAY)
    before = clock.now
    drive.wait()
    assert clock.now - before <= 0.5
    assert len(drive.notices) == 1


def test_the_pause_grows_to_the_cap_and_no_further(drive: Drive) -> None:
    """It retries for ever, at least once a minute."""
    drive.spool.add(3)
    pauses = []
    for _ in range(200):
        failed = drive.clock.now
        item = drive.wait()
        pauses.append(drive.clock.now - failed)
        drive.fail(item, AWAY)
    assert max(pauses[1:3]) <= 1.1
    assert 50.0 < max(pauses[20:]) <= CAP_S + 0.1


@pytest.mark.long('a second of CPU or more')
def test_a_long_outage_does_not_touch_ever_more_objects(drive: Drive) -> None:
    """The failures that are remembered stay few, however long it lasts."""
    drive.spool.add(1000)
    for _ in range(800):
        drive.fail(drive.wait(), AWAY)
    assert drive.schedule.snapshot().deferred < 200
    while drive.spool.items:
        drive.deliver(drive.wait())


def test_the_only_object_there_is_probes_for_itself(drive: Drive) -> None:
    """One object and a store that was away: it goes as soon as the breaker lets it."""
    item = drive.spool.add()[0]
    for _ in range(3):
        assert drive.wait() == item
        drive.fail(item, AWAY)
    assert drive.wait() == item
    drive.deliver(item)
    assert drive.next() is None
    assert drive.schedule.drained() is True
