from __future__ import annotations

import random

import pytest
from ship.fakes import FakeSpool, Time

from shadowhound_data_logger.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.ship.ahead import IMPORTANT, LOOK_EVERY_S, OLDEST
from shadowhound_data_logger.ship.outage import Notice
from shadowhound_data_logger.ship.retry import Verdict
from shadowhound_data_logger.ship.schedule import Schedule
from shadowhound_data_logger.ship.steps import Look, Rest, Ship

AWAY = StoreUnavailable('Tower is away')
CAP_S = 60.0


class Drive:
    """Plays the threads: looks where the schedule says so, and hands out what it would ship."""

    def __init__(self, spool: FakeSpool, clock: Time, threads: int = 2) -> None:
        self.spool = spool
        self.clock = clock
        self.schedule = Schedule(threads, CAP_S, clock, random.Random(3))
        self.schedule.activate(True)
        self.notices: list[Notice] = []

    def look(self, look: Look) -> None:
        pending = self.spool.pending
        self.schedule.found(pending(IMPORTANT, exclude=look.exclude, without=look.without),
                            pending(OLDEST, exclude=look.exclude, without=look.without, oldest=True))  # fmt: skip

    def next(self) -> SpooledObject | None:
        """What is shipped now, None when there is only rest."""
        for _ in range(10):
            step = self.schedule.step()
            if isinstance(step, Ship):
                return step.item
            if not isinstance(step, Look):
                return None
            self.look(step)
        raise AssertionError('it looks again and again')

    def wait(self) -> SpooledObject:
        """What is shipped next, the clock going on as far as it takes."""
        for _ in range(1000):
            if item := self.next():
                return item
            rest = self.schedule.step()
            assert isinstance(rest, Rest)
            self.clock.now += rest.seconds
        raise AssertionError('nothing is shipped any more')

    def deliver(self, item: SpooledObject) -> None:
        self.notices += self.schedule.delivered(item)
        self.spool.items.pop(item.id)
        self.schedule.settled([item.id])

    def fail(self, item: SpooledObject, error: StoreError) -> str | None:
        ruling = self.schedule.failed(item, error)
        self.notices += ruling.notices
        if ruling.quarantine:
            self.spool.items.pop(item.id)
            self.schedule.settled([item.id])
        return ruling.quarantine

    def said(self) -> list[tuple[Verdict, str | None, bool]]:
        """(what, bucket, whether it is over) of each notice."""
        return [(notice.verdict, notice.bucket, notice.lasted_s is not None) for notice in self.notices]


@pytest.fixture
def drive(spool: FakeSpool, clock: Time) -> Drive:
    return Drive(spool, clock)


# -- order -------------------------------------------------------------------------------------------------------------


def test_important_objects_go_first_and_each_fourth_is_the_oldest(drive: Drive) -> None:
    """Neither the backlog nor what is live starves, whatever is larger."""
    old = [item.id for item in drive.spool.add(100, priority=7)]
    new = [item.id for item in drive.spool.add(100, priority=2)]
    order = []
    for _ in range(40):
        item = drive.next()
        assert item is not None
        order.append(item.id)
        drive.deliver(item)
    assert [number for number in order if number in old] == order[3::4] == old[:10]
    assert [number for number in order if number in new] == new[:30]


def test_the_spool_is_asked_for_a_bounded_number_now_and_then(drive: Drive) -> None:
    """What a claim costs does not depend on the backlog: a thousand objects take some 2 x 1000 / 60 queries."""
    drive.spool.add(1000)
    for _ in range(1000):
        item = drive.next()
        assert item is not None
        drive.deliver(item)
    assert drive.next() is None
    assert drive.spool.looks < 60


def test_what_is_urgent_overtakes_what_was_looked_up_before(drive: Drive) -> None:
    """A wake makes the next look happen at once."""
    drive.spool.add(100, priority=7)
    assert drive.next()
    urgent = drive.spool.add(priority=0)[0]
    drive.schedule.wake()
    assert drive.next() == urgent


def test_an_object_is_claimed_once_until_it_is_settled(drive: Drive) -> None:
    """Delivered is not yet durable: until the spool knows, it calls the object pending, and we do not believe it."""
    drive.spool.add()
    item = drive.next()
    assert item is not None
    drive.schedule.wake()
    assert drive.next() is None
    drive.schedule.delivered(item)
    drive.schedule.wake()
    assert drive.next() is None


def test_a_look_that_overlaps_with_a_settlement_does_not_bring_an_object_back(drive: Drive) -> None:
    """What a slow query read before the commit is not shipped after it."""
    first, second = drive.spool.add(2)
    assert drive.next() == first
    assert drive.next() == second
    drive.schedule.wake()
    look = drive.schedule.step()
    assert isinstance(look, Look)
    drive.schedule.delivered(first)
    drive.schedule.settled([first.id])
    drive.schedule.found([first], [first])
    assert isinstance(drive.schedule.step(), Rest)


def test_only_one_thread_looks_at_a_time(drive: Drive) -> None:
    """The others ship what is there, or rest."""
    drive.spool.add(5)
    assert isinstance(drive.schedule.step(), Look)
    drive.schedule.wake()
    assert isinstance(drive.schedule.step(), Rest)


def test_what_another_process_spooled_is_found_without_a_wake(drive: Drive) -> None:
    """An idle drain looks once a second."""
    assert drive.next() is None
    item = drive.spool.add()[0]
    assert drive.next() is None
    drive.clock.now += LOOK_EVERY_S
    assert drive.next() == item


def test_without_the_drain_lock_nothing_is_shipped(drive: Drive) -> None:
    """Another process drains: every step is a rest, until it is ours."""
    drive.spool.add()
    drive.schedule.activate(False)
    assert drive.next() is None
    assert drive.schedule.drained() is False
    drive.schedule.activate(True)
    assert drive.next()


# -- the store is away -------------------------------------------------------------------------------------------------


def test_while_the_store_is_away_there_is_one_probe_at_a_time(drive: Drive) -> None:
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


def test_an_object_that_fails_while_others_do_not_stops_nobody(drive: Drive) -> None:
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
    assert 'delivery goes on after' in end.text(4)


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


def test_a_long_outage_does_not_touch_ever_more_objects(drive: Drive) -> None:
    """The failures that are remembered stay few, however long it lasts."""
    drive.spool.add(2000)
    for _ in range(1500):
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


# -- credentials, buckets, rights --------------------------------------------------------------------------------------


def test_rejected_credentials_pause_everything_and_are_said_at_once(drive: Drive) -> None:
    """No object is to blame: none is deferred, and one probe at a time finds out when it is right again."""
    drive.spool.add(4)
    for _ in range(5):
        drive.fail(drive.wait(), CredentialsRejected('wrong key'))
        assert drive.next() is None
    assert drive.schedule.snapshot().outage is Verdict.PAUSE
    assert drive.schedule.snapshot().deferred == 0
    assert drive.said() == [(Verdict.PAUSE, None, False)]
    while drive.spool.items:
        drive.deliver(drive.wait())
    assert drive.said()[1:] == [(Verdict.PAUSE, None, True)]


def test_an_outage_whose_cause_changes_says_each_cause_once(drive: Drive) -> None:
    """Tower comes back with other keys: that is news, its coming and going afterwards is not."""
    drive.spool.add(4)
    for error in (AWAY, AWAY, CredentialsRejected('wrong key'), AWAY, CredentialsRejected('wrong key')):
        drive.fail(drive.wait(), error)
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.PAUSE, None, False)]


def test_a_missing_bucket_holds_up_its_own_objects_only(drive: Drive) -> None:
    """Those of other buckets go on, though hundreds of the missing one come first."""
    drive.spool.add(300, bucket='missing', priority=0)
    drive.spool.add(100, bucket='there', priority=9)
    failures = 0
    while any(item.bucket == 'there' for item in drive.spool.items.values()):
        item = drive.wait()
        if item.bucket == 'missing':
            failures += 1
            drive.fail(item, BucketMissing('there is no bucket missing'))
        else:
            drive.deliver(item)
    assert failures <= 3
    assert list(drive.schedule.snapshot().blocked) == ['missing']
    assert drive.said() == [(Verdict.BUCKET, 'missing', False)]
    while drive.spool.items:
        drive.deliver(drive.wait())
    assert drive.said()[1:] == [(Verdict.BUCKET, 'missing', True)]


def test_others_go_on_while_a_missing_bucket_is_being_probed(drive: Drive) -> None:
    """A probe that hangs holds up nobody outside its bucket."""
    drive.spool.add(300, bucket='missing', priority=0)
    one, two = drive.spool.add(2, bucket='there', priority=9)
    first = drive.next()
    assert first is not None
    drive.fail(first, BucketMissing('x'))
    assert drive.next() == one
    drive.deliver(one)
    drive.clock.now += 10.0
    probe = drive.next()
    assert probe is not None
    assert probe.bucket == 'missing'
    assert drive.next() == two
    assert drive.next() is None


def test_a_bucket_that_takes_objects_again_is_looked_at_before_all_is_called_drained(drive: Drive) -> None:
    """Its objects were left out while it was away."""
    drive.spool.add(3)
    drive.fail(drive.wait(), BucketMissing('x'))
    drive.deliver(drive.wait())
    assert isinstance(drive.schedule.drained(), Rest)
    for _ in range(2):
        drive.deliver(drive.wait())
    assert drive.next() is None
    assert drive.schedule.drained() is True


def test_an_answer_about_a_bucket_shows_that_the_store_is_back(drive: Drive) -> None:
    """Who says that a bucket is missing is not away."""
    drive.spool.add(3)
    for _ in range(2):
        drive.fail(drive.wait(), AWAY)
    drive.fail(drive.wait(), BucketMissing('x'))
    assert drive.schedule.snapshot().outage is None
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.RETRY, None, True), (Verdict.BUCKET, 'b', False)]


def test_an_object_that_is_denied_while_its_bucket_takes_others_is_quarantined(drive: Drive) -> None:
    """One denial is a question, a delivery to the bucket and a second denial are the answer."""
    denied = drive.spool.add(priority=0)[0]
    drive.spool.add(30)
    reasons = []
    while drive.spool.items:
        item = drive.wait()
        if item == denied:
            reasons.append(drive.fail(item, AccessDenied('no')))
        else:
            drive.clock.now += 0.1
            drive.deliver(item)
    assert reasons == [None, 'access_denied']
    assert drive.said() == []


def test_when_all_are_denied_none_is_quarantined_and_all_go_once_the_rights_are_there(drive: Drive) -> None:
    """The credentials lack the right: the bucket waits, said once, and other buckets go on."""
    drive.spool.add(20, bucket='closed', priority=0)
    drive.spool.add(20, bucket='open', priority=9)
    denials = 0
    while denials < 30:
        item = drive.wait()
        if item.bucket == 'closed':
            denials += 1
            assert drive.fail(item, AccessDenied('no')) is None
        else:
            drive.deliver(item)
    assert len(drive.spool.items) == 20
    assert drive.said() == [(Verdict.DENIED, 'closed', False)]
    while drive.spool.items:
        drive.deliver(drive.wait())
    assert drive.said()[1:] == [(Verdict.DENIED, 'closed', True)]


def test_a_denied_bucket_is_probed_with_an_object_that_was_not_denied_yet(drive: Drive) -> None:
    """One denied object alone in its bucket does not block what comes later."""
    denied = drive.spool.add(priority=0)[0]
    for _ in range(3):
        assert drive.wait() == denied
        assert drive.fail(denied, AccessDenied('no')) is None
    later = drive.spool.add(priority=9)[0]
    assert drive.wait() == later
    drive.deliver(later)
    assert drive.wait() == denied
    assert drive.fail(denied, AccessDenied('no')) == 'access_denied'


@pytest.mark.parametrize(('error', 'reason'), [
    (ObjectRefused('x', reason='damaged'), 'damaged'),
    (ForeignObject('x'), 'foreign'),
])  # fmt: skip
def test_what_the_store_will_never_take_is_quarantined_and_stops_nothing(drive: Drive, error: StoreError, reason: str) -> None:
    """Also as the probe of an outage: the next probe goes at once."""
    drive.spool.add(4)
    assert drive.fail(drive.wait(), error) == reason
    drive.fail(drive.wait(), AWAY)
    assert drive.fail(drive.wait(), error) == reason
    assert drive.next()


def test_a_defect_of_ours_holds_up_that_object_only(drive: Drive) -> None:
    """It is deferred, the store is not blamed, and it is tried again."""
    first, second = drive.spool.add(2)
    assert drive.next() == first
    drive.schedule.crashed(first, TypeError('oops'))
    assert drive.schedule.snapshot().last_error == 'TypeError: oops'
    assert drive.next() == second
    drive.deliver(second)
    assert drive.wait() == first


# -- the end -----------------------------------------------------------------------------------------------------------


def test_drained_means_that_nothing_is_pending_and_all_is_durable(drive: Drive) -> None:
    """Not before the spool was asked, and not before every outcome is settled."""
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() is None
    assert drive.schedule.drained() is True
    item = drive.spool.add()[0]
    drive.schedule.wake()
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() == item
    assert isinstance(drive.schedule.drained(), Rest)
    drive.schedule.delivered(item)
    assert isinstance(drive.schedule.drained(), Rest)
    drive.schedule.settled([item.id])
    drive.spool.items.clear()
    assert drive.next() is None
    assert drive.schedule.drained() is True


def test_waiting_for_the_drain_is_no_use_once_the_store_is_known_to_be_away(drive: Drive) -> None:
    """One failure may be a hiccup, the second is an outage."""
    drive.spool.add(3)
    drive.fail(drive.wait(), AWAY)
    assert isinstance(drive.schedule.drained(), Rest)
    drive.fail(drive.wait(), AWAY)
    assert drive.schedule.drained() is False


def test_waiting_is_no_use_when_only_blocked_buckets_are_left(drive: Drive) -> None:
    """What can be delivered is, then the answer is no."""
    drive.spool.add(bucket='missing', priority=0)
    other = drive.spool.add(bucket='there')[0]
    item = drive.next()
    assert item is not None
    drive.fail(item, BucketMissing('x'))
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() == other
    drive.deliver(other)
    assert drive.next() is None
    assert drive.schedule.drained() is False


def test_after_stop_no_step_is_given_but_what_is_in_flight_may_be_reported(drive: Drive) -> None:
    """A shutdown loses no outcome of a put that ends in time."""
    drive.spool.add(2)
    item = drive.next()
    assert item is not None
    drive.schedule.stop()
    assert drive.schedule.step() is None
    drive.deliver(item)
    assert drive.schedule.snapshot().delivered == 1
