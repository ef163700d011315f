"""A stall is reported with its cause; silence that is allowed or reported elsewhere is not."""

from __future__ import annotations

import logging
from copy import deepcopy
from typing import Any

import pytest

from shadowhound_data_logger.bags import events, recorder
from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.status import NodeStatus
from shadowhound_data_logger.node.reporting.watchdog import Watchdog

REQUEST_S = 35.0
WORKER = {'alive': True, 'failing': False, 'failures': 0, 'deaths': 0, 'last_error': '', 'busy_s': 0.0, 'patience_s': None}
TOPIC = {'enabled': True, 'publishers': 1, 'matched': 1, 'may_be_silent': False, 'unavailable': '', 'received': 0,
         'wrong_type': 0, 'age_s': None}  # fmt: skip
STATUS: dict[str, Any] = {
    'topics': {'/imu': TOPIC}, 'queue': {'batches': 0, 'finished': 0}, 'spool': {'pending': 0},
    'store': {'state': 'idle', 'delivered': 0, 'quarantined': 0, 'mbps': 0.0, 'in_flight': 0, 'deferred': 0, 'last_error': ''},
    'workers': {name: {**WORKER, 'patience_s': patience_s} for name, patience_s in
                {'intake': 5.0, 'encode-0': 60.0, 'spool-writer': 12.0, 'mission': 30.0, 'event-writer': 30.0,
                 'upload-lock': None, 'upload-0': None}.items()},
}  # fmt: skip


class Watch:
    """A watchdog, the status it checks, and the time."""

    def __init__(self) -> None:
        self.status = deepcopy(STATUS)
        self.imu, self.queue, self.store = self.status['topics']['/imu'], self.status['queue'], self.status['store']
        self.workers = self.status['workers']
        self.dog = Watchdog(REQUEST_S)
        self.now_s = 1000.0
        self.heard_s: float | None = None

    def poll(self, seconds: float = 1.0) -> dict[str, str]:
        """Poll after this time."""
        self.now_s += seconds
        self.imu['age_s'] = None if self.heard_s is None else self.now_s - self.heard_s
        return dict(self.dog.poll(parse(NodeStatus, self.status), self.now_s))

    def observe(self, messages: int = 1, times: int = 1, every_s: float = 1.0) -> None:
        """This many messages before each of this many polls."""
        for _ in range(times):
            self.imu['received'] += messages
            self.heard_s = self.now_s + every_s
            assert self.poll(every_s) == {}

    def wait(self, seconds: int) -> dict[str, str]:
        """Poll once per second; nothing may be found before the last poll."""
        for _ in range(seconds - 1):
            assert self.poll() == {}
        return self.poll()


@pytest.fixture
def watch() -> Watch:
    made = Watch()
    assert made.poll() == {}
    return made


@pytest.fixture
def stages(watch: Watch) -> Watch:
    """Without a topic that can stall."""
    watch.imu['publishers'] = 0
    return watch


def test_a_topic_that_stops_while_its_publisher_runs_is_reported(watch: Watch, caplog: pytest.LogCaptureFixture) -> None:
    """After five seconds, with its rate and the cause, once; and again when it resumes."""
    caplog.set_level(logging.INFO)
    watch.observe(100, times=20)
    found = watch.wait(6)
    assert found == {'/imu': 'silent for 6 s after 100 Hz, though its publisher is there; check the program that publishes it'}
    assert '/imu' in watch.poll()
    watch.observe(100)
    assert watch.wait(5) == {}
    assert [record.getMessage() for record in caplog.records] == [f'/imu: {found["/imu"]}', '/imu: working again']


def test_a_slow_topic_is_given_its_time(watch: Watch) -> None:
    """Ten of its periods: one with a message every three seconds may be silent for half a minute."""
    watch.observe(times=12, every_s=3.0)
    assert '/imu' in watch.wait(31)


def test_a_lost_connection_is_a_separate_cause(watch: Watch) -> None:
    """The publisher is in the graph, but the subscription has no match."""
    watch.observe(times=20)
    watch.imu['matched'] = 0
    assert 'check the network' in watch.wait(11)['/imu']


def test_topics_without_a_rhythm_are_never_missed(watch: Watch) -> None:
    """A single latched map, a button, a burst at the start: it is unknown when the next message is due."""
    watch.observe()
    assert watch.wait(600) == {}
    watch.observe(7)
    watch.observe(1, every_s=200.0)
    watch.observe(3, times=8)
    assert watch.wait(600) == {}


def test_topics_that_may_be_silent_are_not_missed(watch: Watch) -> None:
    """Those kept on change and latched ones, whether they were regular before or never arrived."""
    watch.imu['may_be_silent'] = True
    assert watch.wait(100) == {}
    watch.observe(times=30)
    assert watch.wait(100) == {}


def test_a_publisher_that_left_is_not_missed(watch: Watch) -> None:
    """That the topic has no publisher is reported elsewhere; a new publisher starts a new rhythm."""
    watch.observe(times=20)
    watch.imu['publishers'] = watch.imu['matched'] = 0
    assert watch.wait(60) == {}
    watch.imu['publishers'] = watch.imu['matched'] = 1
    assert 'connected for 31 s but no message' in watch.wait(32)['/imu']
    watch.observe()
    assert watch.wait(100) == {}


@pytest.mark.parametrize('may_be_silent', [True, False])
def test_a_publisher_without_a_connection_is_reported(watch: Watch, *, may_be_silent: bool) -> None:
    """Type, QoS or firewall: this is reported for every topic, since no message can arrive."""
    watch.imu |= {'matched': 0, 'may_be_silent': may_be_silent}
    assert 'ros2 topic info -v /imu' in watch.wait(11)['/imu']


def test_a_topic_that_cannot_be_subscribed_to_is_reported(watch: Watch) -> None:
    """Immediately, with the missing package."""
    watch.imu |= {'matched': 0, 'unavailable': 'its message package is not installed here (x)'}
    assert watch.poll() == {'/imu': 'it cannot be subscribed to here: its message package is not installed here (x)'}


def test_a_topic_that_is_off_is_not_missed(watch: Watch) -> None:
    """Nor when it is enabled again: its earlier rhythm does not count."""
    watch.observe(100, times=20)
    watch.imu['enabled'] = False
    assert watch.wait(60) == {}
    watch.imu['enabled'] = True
    assert watch.wait(20) == {}


@pytest.mark.parametrize('trouble', [{'busy_s': 6.0}, {'failing': True}])
def test_an_intake_that_takes_nothing_is_the_one_cause(watch: Watch, trouble: dict[str, Any]) -> None:
    """Then all topics seem silent, and none of them is the cause."""
    watch.observe(100, times=20)
    watch.workers['intake'] |= trouble
    for _ in range(20):
        assert set(watch.poll()) <= {'intake'}


@pytest.mark.parametrize(
    ('name', 'busy_s', 'words'),
    [('intake', 5.1, 'has taken no messages for 5 s'), ('spool-writer', 12.1, 'its disk does not respond'),
     ('encode-0', 61.0, 'one batch has taken 61 s'), ('mission', 31.0, 'missions have not been followed for 31 s'),
     ('event-writer', 31.0, 'nothing more is written to its bag for 31 s')],
)  # fmt: skip
def test_a_hung_thread_is_reported(stages: Watch, name: str, busy_s: float, words: str) -> None:
    """Each thread has a separate timeout; the one that holds the drain lock has none."""
    stages.workers['upload-lock']['busy_s'] = 1e6
    stages.workers[name]['busy_s'] = busy_s - 1.1
    assert stages.poll() == {}
    stages.workers[name]['busy_s'] = busy_s
    found = stages.poll()
    assert list(found) == [name]
    assert words in found[name]


def test_a_pool_that_encodes_nothing_is_reported(stages: Watch) -> None:
    """Batches are queued and none is finished; a full queue that moves is not reported."""
    stages.queue['batches'] = 7
    for number in range(30):
        stages.queue['finished'] = number
        assert stages.poll() == {}
    assert 'no batch was encoded for 11 s and 7 wait: the encoders are busy' in stages.wait(11)['encode']
    stages.workers['encode-0'] |= {'failing': True, 'last_error': 'KeyError: x'}
    assert 'the encoders fail (KeyError: x)' in stages.poll()['encode']
    stages.queue['batches'] = 0
    assert stages.poll() == {}


@pytest.mark.parametrize(
    ('store', 'words'),
    [
        ({'state': 'shipping', 'in_flight': 4}, '4 uploads hang'),
        ({'state': 'shipping', 'deferred': 2, 'last_error': 'broken'}, '2 objects fail repeatedly: broken'),
        ({'state': 'idle'}, 'a bug in this program'),
    ],
)
def test_an_upload_that_stalls_is_reported(stages: Watch, store: dict[str, Any], words: str) -> None:
    """Objects are pending, the store is not known to be unreachable, and no byte is sent for longer than a request may take."""
    stages.store |= store
    stages.status['spool']['pending'] = 9
    assert '9 objects wait and nothing was sent for 66 s: ' in (text := stages.wait(66)['delivery'])
    assert words in text
    stages.workers['upload-0'] |= {'failing': True, 'last_error': 'KeyError: x'}
    assert 'the upload threads fail (KeyError: x)' in stages.poll()['delivery']


@pytest.mark.parametrize(
    'store',
    [{'state': 'store_down'}, {'state': 'paused'}, {'state': 'not_draining'}, {'state': 'shipping', 'mbps': 0.001}],
)  # fmt: skip
def test_an_upload_with_a_reason_to_wait_is_not_reported(stages: Watch, store: dict[str, Any]) -> None:
    """An unreachable store is reported separately, and a slow one has not stalled."""
    stages.store |= store
    stages.status['spool']['pending'] = 9
    assert stages.wait(200) == {}


@pytest.mark.parametrize('trouble', [{'failing': True}, {'busy_s': 100.0}])
def test_a_disk_that_fails_is_the_one_cause(stages: Watch, trouble: dict[str, Any]) -> None:
    """Encoders and delivery wait for the spool writer then; only the writer is reported."""
    stages.queue['batches'] = stages.status['spool']['pending'] = 9
    stages.workers['encode-0']['busy_s'] = 100.0
    stages.workers['spool-writer'] |= trouble
    for _ in range(100):
        assert set(stages.poll()) <= {'spool-writer'}


@pytest.mark.parametrize(('idle_s', 'patience_s'), [(events.IDLE_S, events.PATIENCE_S), (recorder.IDLE_S, recorder.PATIENCE_S)])
def test_a_writer_without_anything_to_write_does_not_seem_to_hang(idle_s: float, patience_s: float) -> None:
    """Its rounds are far shorter than the timeout: on a busy machine it may wake up late."""
    assert idle_s <= patience_s / 2
