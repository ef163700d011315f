"""A store that refuses credentials, a bucket or an object: each delays no more than necessary."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from profiles import examples
from shipping.drive import Drive
from shipping.fakes import FakeSpool, Time

from shadowhound_data_logger.core import errors
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.shipping.failures import DENIALS, Verdict, decide, quarantine_reason
from shadowhound_data_logger.shipping.schedule import Rest, Ship

TABLE = [
    (errors.StoreUnavailable, Verdict.RETRY),
    (errors.CredentialsRejected, Verdict.PAUSE),
    (errors.StoreUntrusted, Verdict.PAUSE),
    (errors.BucketMissing, Verdict.BUCKET),
    (errors.AccessDenied, Verdict.DENIED),
    (errors.ObjectRefused, Verdict.QUARANTINE),
    (errors.ForeignObject, Verdict.QUARANTINE),
    (errors.StoreError, Verdict.RETRY),
]


@pytest.mark.parametrize(('kind', 'verdict'), TABLE, ids=lambda value: getattr(value, '__name__', value))
def test_each_error_of_a_store_has_its_verdict(kind: type[errors.StoreError], verdict: Verdict) -> None:
    """Each class of the tree leads to exactly this, and so do its subclasses."""
    assert decide(kind('x')) is verdict
    assert decide(type('Special', (kind,), {})('x')) is verdict


def test_the_table_names_every_store_error() -> None:
    """A class that is added to the tree without a decision here fails this test."""
    kinds = {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.StoreError)}
    assert kinds == {kind for kind, _ in TABLE}


@pytest.mark.parametrize(('error', 'reason'), [
    (errors.ObjectRefused('x', reason='damaged'), 'damaged'),
    (errors.ObjectRefused('x', reason='KeyTooLongError'), 'KeyTooLongError'),
    (errors.ObjectRefused('x'), 'refused'),
    (errors.ObjectRefused('x', reason='../../etc'), 'refused'),
    (errors.ObjectRefused('x', reason='a' * 65), 'refused'),
    (errors.ObjectRefused('x', reason=7), 'refused'),
    (errors.ForeignObject('x', reason='other'), 'foreign'),
    (errors.AccessDenied('x', reason='AccessDenied'), 'access_denied'),
])  # fmt: skip
def test_a_reason_can_name_a_folder(error: errors.StoreError, reason: str) -> None:
    """Text from a server becomes part of a path only if it is safe there."""
    assert quarantine_reason(error) == reason


AWAY = StoreUnavailable('Tower is away')


def test_rejected_credentials_pause_everything_and_are_logged_immediately(drive: Drive) -> None:
    """No object is deferred, and one probe at a time finds out when the credentials are valid again."""
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


def test_each_cause_of_an_outage_is_logged_once(drive: Drive) -> None:
    """Tower returns with other keys: that is logged, but going up and down after that is not."""
    drive.spool.add(4)
    for error in (AWAY, AWAY, CredentialsRejected('wrong key'), AWAY, CredentialsRejected('wrong key')):
        drive.fail(drive.wait(), error)
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.PAUSE, None, False)]


def test_a_missing_bucket_delays_only_its_own_objects(drive: Drive) -> None:
    """Those of other buckets continue, though hundreds of the missing one are first."""
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


def test_other_buckets_continue_while_a_missing_one_is_probed(drive: Drive) -> None:
    """A probe that hangs delays only its bucket."""
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


def test_a_recovered_bucket_is_drained_before_the_spool_counts_as_drained(drive: Drive) -> None:
    """Its objects were skipped while it was unreachable."""
    drive.spool.add(3)
    drive.fail(drive.wait(), BucketMissing('x'))
    drive.deliver(drive.wait())
    assert isinstance(drive.schedule.drained(), Rest)
    for _ in range(2):
        drive.deliver(drive.wait())
    assert drive.next() is None
    assert drive.schedule.drained() is True


def test_an_answer_about_a_bucket_shows_that_the_store_is_back(drive: Drive) -> None:
    """A response that a bucket is missing shows that the store is reachable."""
    drive.spool.add(3)
    for _ in range(2):
        drive.fail(drive.wait(), AWAY)
    drive.fail(drive.wait(), BucketMissing('x'))
    assert drive.schedule.snapshot().outage is None
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.RETRY, None, True), (Verdict.BUCKET, 'b', False)]


def test_an_object_denied_while_its_bucket_accepts_others_is_quarantined(drive: Drive) -> None:
    """After one denial, deliveries to the bucket and more denials alternate; the object is quarantined within minutes."""
    denied = drive.spool.add(priority=0)[0]
    drive.spool.add(1200)
    reasons = []
    while drive.spool.items:
        item = drive.wait()
        if item == denied:
            reasons.append(drive.fail(item, AccessDenied('no')))
        else:
            drive.clock.now += 0.1
            drive.deliver(item)
    assert reasons == [*[None] * (DENIALS - 1), 'access_denied']
    assert drive.said() == []


@pytest.mark.long('a second of CPU or more')
@pytest.mark.sampled
def test_denials_that_come_and_go_quarantine_nothing(clock: Time, tmp_path: Path) -> None:
    """A store that denies everything for some seconds, repeatedly, gets everything in the end."""
    denied, days = 0, examples(20)
    for seed in range(days):
        rng = random.Random(seed)
        drive = Drive(FakeSpool(tmp_path), clock)
        drive.spool.add(300)
        good_until, bad_until = 0.0, 0.0
        while drive.spool.items:
            item = drive.wait()
            clock.now += 0.2
            if clock.now > bad_until:
                good_until = clock.now + rng.uniform(0.5, 20.0)
                bad_until = good_until + rng.uniform(0.5, 60.0)
            if clock.now < good_until:
                drive.deliver(item)
            else:
                denied += 1
                assert drive.fail(item, AccessDenied('no')) is None, seed
    assert denied > 25 * days


def test_if_all_are_denied_they_wait_for_permission(drive: Drive) -> None:
    """The credentials lack the permission: the bucket waits, which is logged once, and other buckets continue."""
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


def test_a_denied_bucket_is_probed_with_another_object(drive: Drive) -> None:
    """A single denied object in its bucket does not block later ones."""
    denied = drive.spool.add(priority=0)[0]
    for _ in range(3):
        assert drive.wait() == denied
        assert drive.fail(denied, AccessDenied('no')) is None
    for reason in [*[None] * (DENIALS - 2), 'access_denied']:
        later = drive.spool.add(priority=9)[0]
        while drive.wait() != later:
            assert drive.fail(denied, AccessDenied('no')) is None
        drive.deliver(later)
        assert drive.wait() == denied
        assert drive.fail(denied, AccessDenied('no')) == reason


@pytest.mark.parametrize(('error', 'reason'), [
    (ObjectRefused('x', reason='damaged'), 'damaged'),
    (ForeignObject('x'), 'foreign'),
])  # fmt: skip
def test_terminally_refused_objects_are_quarantined_and_stop_nothing(drive: Drive, error: StoreError, reason: str) -> None:
    """Also as the probe of an outage: the next probe follows immediately."""
    drive.spool.add(4)
    assert drive.fail(drive.wait(), error) == reason
    drive.fail(drive.wait(), AWAY)
    assert drive.fail(drive.wait(), error) == reason
    assert drive.next()


def test_a_defect_delays_only_its_object(drive: Drive) -> None:
    """It is deferred, the store stays usable, and the object is retried."""
    first, second = drive.spool.add(2)
    assert drive.next() == first
    drive.schedule.crashed(Ship(first), TypeError('oops'))
    assert drive.schedule.snapshot().last_error == 'TypeError: oops'
    assert drive.next() == second
    drive.deliver(second)
    assert drive.wait() == first
