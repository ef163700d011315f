"""The messages of a topic between the take and the batch."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import pytest

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, Taken
from shadowhound_data_logger.core.stamps import DAY_NS, NO_TIMES, StampRule, by_arrival
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.intake import sampling
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.intake.stream import Senders, SensorStream, TopicStream
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.gaps import ESTIMATED, EXACT
from shadowhound_data_logger.spool.topic_account import RECEIVED_ONLY, TopicAccount

TOPIC, TYPE = '/talk', 'std_msgs/msg/String'
NOON_NS = 1_760_788_800 * SECOND
UNNUMBERED: dict[str, None] = {'publisher': None, 'number': None}


class Batches(list[Batch]):
    """An unbounded queue to the encoders."""

    def put(self, batch: Batch, _: int) -> list[Batch]:
        self.append(batch)
        return []


class Talk:
    """A stream of Strings sent every 100 ms, and the sampler that receives it."""

    def __init__(self, last_stored_ns: int = 0, **settings: float | str) -> None:
        self.sensor = SensorSettings(name='talk', **{'rate_hz': 0.0, 'batch_s': 3600.0, **settings})  # type: ignore[arg-type]
        self.accounts = Accounts()
        self.batches = Batches()
        self.senders = Senders()
        self.numbers = count(1)
        if last_stored_ns:
            self.accounts.store({TOPIC: (0, by_arrival(last_stored_ns))})
        self.sensors, types, self.stamps = {'talk': self.sensor}, MessageTypes(), StampRule(SystemClock.of_this_machine())
        queue: Any = self.batches
        self.sampler = Sampler(self.sensors, self.accounts, types, queue)
        self.listen(self.sampler)

    def listen(self, *consumers: Consumer) -> None:
        """Start a stream."""
        self.stream = SensorStream(self.sensor, TOPIC, TYPE, self.accounts, MessageTypes(), self.stamps, consumers)

    def messages(self, how_many: int, **fields: object) -> list[Taken]:
        """The next messages, from a known publisher unless ``fields`` override it."""
        taken = [next(self.numbers) for _ in range(how_many)]
        made = [Taken(b'%d' % number, sent_ns := NOON_NS + number * SECOND // 10, 'p', number, sent_ns) for number in taken]
        return [one._replace(**fields) for one in made]  # type: ignore[arg-type]

    def add(self, taken: list[Taken], now_s: float = 0.0, *, paused: bool = False, idle: bool = False) -> None:
        self.sampler.set_idle(idle=idle)
        self.stream.add(taken, self.senders, now_s, paused=paused)

    def update(self, **settings: float) -> None:
        self.sensor = replace(self.sensor, **settings)  # type: ignore[arg-type]
        self.sensors[self.sensor.name] = self.sensor

    def kept(self) -> list[int]:
        """The numbers of the kept messages, including the open batch."""
        self.sampler.flush()
        return [int(sample.cdr) for batch in self.batches for sample in batch.samples]

    @property
    def account(self) -> TopicAccount:
        with self.accounts.entry(TOPIC) as account:
            return account


def test_a_pause_counts_and_drops() -> None:
    """Messages during a pause are received and dropped as paused; those before and after it are kept."""
    talk = Talk()
    for paused in (False, True, False):
        talk.add(talk.messages(3), paused=paused)
    assert talk.kept() == [1, 2, 3, 7, 8, 9]
    assert (talk.account.received, talk.account.dropped, talk.account.missed) == (9, {'paused': 3}, 0)


class Commits(Consumer):
    """Commits after a drain's messages are counted and before its consumers run: shows what a commit then counts as open."""

    def __init__(self, accounts: Accounts) -> None:
        self.accounts = accounts
        self.open: list[int] = []

    def take(self, drained: Drained) -> None:
        self.open.append(self.accounts.totals()[drained.topic].open)


@pytest.mark.parametrize(('given', 'settings', 'still_open'), [
    ({'idle': True}, {}, 0), ({'paused': True}, {}, 0), ({}, {'rate_hz': 1.0}, 4), ({}, {}, 30),
])  # fmt: skip
def test_skipped_messages_are_never_open(given: dict[str, bool], settings: dict[str, float], still_open: int) -> None:
    """With a commit at any moment and a kill right after it, the next start does not count messages to be skipped as lost."""
    talk = Talk(**settings)
    commits = Commits(talk.accounts)
    talk.listen(commits, talk.sampler)
    talk.add(talk.messages(30), **given)
    assert commits.open == [still_open]


def test_unwanted_messages_are_skipped() -> None:
    """Outside a mission messages are counted as skipped, and during a pause as dropped."""
    talk = Talk()
    for idle in (True, False, True):
        talk.add(talk.messages(3), idle=idle)
    talk.add(talk.messages(2), paused=True, idle=True)
    assert talk.kept() == [4, 5, 6]
    assert (talk.account.received, talk.account.skipped, talk.account.dropped) == (11, 6, {'paused': 2})


def test_a_pause_wins_over_the_rate() -> None:
    """During a pause nothing is skipped, and the first message after it is that of its period."""
    talk = Talk(rate_hz=1.0)
    talk.add(talk.messages(9), paused=True)
    talk.add(talk.messages(5))
    assert (talk.account.dropped, talk.account.skipped) == ({'paused': 9}, 4)
    assert talk.kept() == [10]


def test_a_changed_rate_keeps_the_open_batch() -> None:
    """The rate changes between two messages, and the open batch keeps its messages."""
    talk = Talk(rate_hz=1.0)
    talk.add(talk.messages(15))
    talk.update(rate_hz=0.0)
    talk.add(talk.messages(3))
    assert not talk.batches
    assert talk.kept() == [1, 10, 16, 17, 18]


@pytest.mark.parametrize(('rate_hz', 'kept'), [(5.0, [1, 4, 6, 8]), (0.5, [1]), (1.0, [1])])
def test_another_rate_keeps_nothing_of_a_period_twice(rate_hz: float, kept: list[int]) -> None:
    """A slower or faster rate continues after the last kept message."""
    talk = Talk(rate_hz=1.0)
    talk.add(talk.messages(3))
    talk.update(rate_hz=rate_hz, quality=50)
    talk.add(talk.messages(6))
    assert talk.kept() == kept


def test_messages_kept_before_a_restart_are_not_kept_again() -> None:
    """A stream that restarts within a period (a sensor that is disabled and enabled) waits for the next one."""
    talk = Talk(rate_hz=1.0, last_stored_ns=NOON_NS + 1)
    talk.add(talk.messages(12))
    assert talk.kept() == [10]
    talk.stream.close()
    talk.listen(talk.sampler)
    talk.add(talk.messages(8))
    assert talk.kept() == [10, 20]


def test_changed_settings_do_not_repeat_unchanged_messages() -> None:
    """A sensor that keeps changes remembers the last message across a change of its settings."""
    talk = Talk(on_change=True)
    talk.add(talk.messages(2, cdr=b'0000same'))
    talk.update(priority=1)
    talk.add(talk.messages(2, cdr=b'0000same'))
    assert (talk.account.received, talk.account.skipped) == (4, 3)


# -- without numbers ---------------------------------------------------------------------------------------------------


def spoken(talk: Talk, how_many: int, **fields: object) -> None:
    """The next messages, received as the intake does: in batches, at the end of each interval."""
    for _ in range(how_many):
        taken = talk.messages(1, **fields)
        talk.add(taken, taken[0].source_ns / SECOND)
        talk.stream.poll(taken[0].source_ns / SECOND)


def test_without_numbers_and_rhythm_losses_are_unknown() -> None:
    """Unknown is None, never 0."""
    talk = Talk()
    talk.senders.poll(['a'])
    spoken(talk, 3, **UNNUMBERED)
    account = talk.account
    assert (account.accounting, account.missed, account.missed_estimated, account.unknown) == (RECEIVED_ONLY, None, None, 3)


def test_losses_are_counted_from_the_rhythm() -> None:
    """Once it is known, also for the messages before."""
    talk = Talk()
    talk.senders.poll(['a'])
    for _ in range(3):
        spoken(talk, 100, **UNNUMBERED)
        talk.messages(7)  # which the stream does not receive
    spoken(talk, 1, **UNNUMBERED)
    account = talk.account
    assert (account.accounting, account.missed, account.missed_estimated) == (ESTIMATED, None, 21)
    assert (account.received, account.estimated, account.unknown) == (301, 301, 0)


def test_a_declared_rate_needs_no_learning() -> None:
    """Even the first gap counts."""
    talk = Talk(expected_hz=10.0)
    talk.senders.poll(['a'])
    spoken(talk, 2, **UNNUMBERED)
    talk.messages(5)
    spoken(talk, 2, **UNNUMBERED)
    assert (talk.account.accounting, talk.account.missed_estimated) == (ESTIMATED, 5)


def test_a_wrong_expected_rate_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """Messages that arrive more often refute it: their rhythm is learned."""
    talk = Talk(expected_hz=4.0)
    talk.senders.poll(['a'])
    spoken(talk, 500, **UNNUMBERED)
    assert (talk.account.accounting, talk.account.missed_estimated) == (ESTIMATED, 0)
    assert [record.getMessage().partition(':')[0] for record in caplog.records] == [TOPIC]


def test_an_unreadable_counter_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    """Stamps are used instead."""
    talk = Talk(counter='data')
    talk.senders.poll(['a'])
    spoken(talk, 300, **UNNUMBERED)
    assert talk.account.accounting == ESTIMATED
    assert 'talk.counter cannot be used' in caplog.text


def test_messages_of_another_publisher_are_not_lost() -> None:
    """Between one publisher and the next there is no loss; between two runs of the same publisher there is."""
    for successor, lost in (('b', 0), ('a', 50)):
        talk = Talk(expected_hz=10.0)
        talk.senders.poll(['a'])
        spoken(talk, 10, **UNNUMBERED)
        talk.messages(50)
        now_s = talk.messages(1)[0].source_ns / SECOND
        talk.senders.poll([], now_s - 3.0)
        talk.senders.poll([successor], now_s)
        next(talk.numbers)
        spoken(talk, 10, **UNNUMBERED)
        assert talk.account.missed_estimated == lost + bool(lost) * 2


def test_a_second_sender_leaves_the_numbers_of_the_first_alone() -> None:
    """Messages of an unknown sender are received, and leave no gap in the numbers of the one that continues."""
    talk = Talk()
    talk.senders.poll(['a'])
    talk.add(talk.messages(3, publisher=None))
    talk.senders.poll(['a', 'b'])
    talk.add(talk.messages(3, publisher=None))
    assert (talk.account.accounting, talk.account.missed) == (RECEIVED_ONLY, None)
    talk.senders.poll(['a'])
    talk.add(talk.messages(3, publisher=None))
    account = talk.account
    assert (account.accounting, account.received, account.unknown, account.missed) == (EXACT, 9, 3, None)
    assert sum(span.published for span in account.publishers.values()) == 6


def test_messages_delivered_by_two_subscriptions_are_counted_once() -> None:
    """A repeat is recognized by its number, or by time and content if it has none."""
    for fields in ({}, UNNUMBERED):
        talk = Talk()
        taken = talk.messages(3, **fields)
        for part in (taken[:2], taken):
            talk.add(part)
        assert talk.account.received == 3
        assert talk.kept() == [1, 2, 3]


def test_a_history_delivered_again_is_counted_once() -> None:
    """Messages received while only one sender was known are recognized by time and number, even if the sender is now unknown."""
    talk = Talk()
    talk.senders.poll(['a'])
    taken = talk.messages(3, publisher=None)
    talk.add(taken)
    talk.senders.poll(['a', 'b'])
    talk.add([*talk.messages(1, publisher=None), *taken])
    assert talk.account.received == 4
    assert talk.kept() == [1, 2, 3, 4]


class Drains(Consumer):
    """The number of messages of each drain."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def take(self, drained: Drained) -> None:
        self.sizes.append(len(drained.messages))


class Broken(Consumer):
    """Raises when the test sets it to."""

    def __init__(self, where: str) -> None:
        self._where = where

    def choose(self, drained: Drained, account: TopicAccount) -> None:
        if self._where == 'choose':
            raise ValueError('a defect')

    def take(self, drained: Drained) -> None:
        assert self._where == 'take', 'it takes what it could not choose of'
        raise KeyError(drained.topic)


@pytest.mark.parametrize(('where', 'said'), [('choose', 'ValueError: a defect'), ('take', "KeyError: '/talk'")])
def test_a_failing_consumer_does_not_affect_the_others(where: str, said: str, caplog: pytest.LogCaptureFixture) -> None:
    """Those before and after it get every drain; the failure is counted, and logged by name, but not each time."""
    talk, broken, last = Talk(), Broken(where), Drains()
    talk.listen(broken, talk.sampler, last)
    for _ in range(3):
        talk.add(talk.messages(2))
    assert talk.kept() == [1, 2, 3, 4, 5, 6]
    assert last.sizes == [2, 2, 2]
    assert (broken.failures, broken.last_error) == (3, said)
    assert (talk.sampler.failures, last.failures) == (0, 0)
    (record,) = caplog.records
    assert 'Broken failed to take messages of /talk (1 times so far)' in record.message


def test_messages_of_a_failing_sampler_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """They do not stay open until the node ends, with a journal that is complete beyond them."""
    talk, last = Talk(), Drains()
    talk.listen(talk.sampler, last)
    talk.add(talk.messages(2))
    with monkeypatch.context() as patched:
        patched.setattr(sampling, 'Sample', lambda *_: 1 // 0)
        talk.add(talk.messages(3))
    talk.add(talk.messages(1))
    assert talk.kept() == [1, 2, 6]
    assert (talk.account.dropped, talk.account.open) == ({'sampler_failed': 3}, 3)
    assert (last.sizes, talk.sampler.failures) == ([2, 3, 1], 1)


def test_a_topic_without_a_sensor_reaches_the_other_consumers() -> None:
    """As above, for topics that only these consumers requested."""
    broken, other = Broken('take'), Drains()
    other.topics = frozenset({TOPIC})
    TopicStream(TOPIC, TYPE, MessageTypes(), Talk().stamps, (broken, other)).add(Talk().messages(4), Senders(), 0.0, paused=False)
    assert (other.sizes, broken.failures) == ([4], 1)


def test_the_watermark_ends_before_open_messages() -> None:
    """A kept message may still be lost while it is in the open batch, the queue or an encoder."""
    talk = Talk(batch_s=1.0)
    queue = talk.sampler._queue = BatchQueue(QueueSettings())
    talk.accounts.oldest_open = talk.sampler.oldest_open

    def complete() -> int:
        """The watermark in messages, after two commits: an outcome at the first is durable with the second."""
        for _ in range(2):
            talk.accounts.reject(TOPIC, {})
            taken = talk.accounts.snapshot({})
            assert taken is not None
        return max(0, taken.topics[0].complete_ns - NOON_NS) * 10 // SECOND

    def finish() -> None:
        batch = queue.get(0.0)
        assert batch is not None
        assert complete() in {0, 9}
        talk.accounts.store({TOPIC: (len(batch.samples), NO_TIMES)})
        queue.done(batch)

    talk.add(talk.messages(12))  # a batch of 9 in the queue, another one open
    assert complete() == 0
    finish()
    assert complete() == 9
    talk.sampler.flush()
    finish()
    assert complete() == 12


@pytest.mark.parametrize(('sent_ns', 'dated_ns', 'why'), [
    (NOON_NS - 2 * DAY_NS, NOON_NS, {'sent_too_old': 1}), (NOON_NS + 2 * DAY_NS, NOON_NS, {'sent_ahead': 1}),
    (60 * SECOND, NOON_NS, {'sent_before_2024': 1}), (NOON_NS - DAY_NS // 2, NOON_NS, {'sent_erratic': 1}),
])  # fmt: skip
def test_forged_stamps_do_not_date_losses(sent_ns: int, dated_ns: int, why: dict[str, int]) -> None:
    """A gap before a message with a forged send time is dated by its arrival, and the message is counted by reason."""
    talk = Talk()
    talk.add([Taken(b'1', NOON_NS - SECOND, 'p', 1, NOON_NS - SECOND), Taken(b'5', sent_ns, 'p', 5, NOON_NS)])
    snapshot = talk.accounts.snapshot({})
    assert snapshot is not None
    (gap,) = snapshot.gaps
    assert (gap.from_ns, gap.to_ns, gap.messages) == (*sorted((NOON_NS - SECOND, dated_ns)), 3)
    assert snapshot.topics[0].by_arrival == talk.account.by_arrival == why
    assert talk.accounts.totals()[TOPIC].by_arrival == why
    talk.sampler.flush()
    assert [(sample.stamp_ns, sample.received_ns) for batch in talk.batches for sample in batch.samples] == [
        (NOON_NS - SECOND, NOON_NS - SECOND), (dated_ns, NOON_NS),
    ]  # fmt: skip
