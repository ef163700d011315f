"""Rejected messages are reported once per minute for each topic, reason and node, with a remedy."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from shadowhound_data_logger.formats.payload import Rejection
from shadowhound_data_logger.node.encoding.rejections import MAX_KNOWN, PERIOD_S, RejectionLog

NODES = {'gid1': '/driver', 'gid2': '/driver', 'gid3': '/other_driver'}


class Minute:
    """A log of rejections whose clock the test sets."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.lookups: list[str] = []
        self.log = RejectionLog(self._node_of, lambda: self.now_s)

    def _node_of(self, topic: str, gid: str) -> str:
        assert topic.startswith('/')
        self.lookups.append(gid)
        return NODES.get(gid, '')

    def reject(self, count: int = 1, reason: str = 'malformed', publisher: str = '', topic: str = '/talk') -> None:
        self.log.add(topic, 'talk', [Rejection(reason, publisher, f'{reason}: it is broken', count)])

    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        self.log.poll()


@pytest.fixture
def minute() -> Minute:
    return Minute()


def test_the_first_rejection_is_logged_immediately_others_each_minute(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """A driver with only rejected messages logs one line per minute, with the number of messages since the last one."""
    for _ in range(180):
        minute.reject(10)
        minute.wait(1.0)
    first, *others = [record.getMessage() for record in caplog.records]
    assert first == '/talk: a message cannot be stored: malformed: it is broken (talk.format: cdr stores such messages unchanged)'
    assert [line.partition(' cannot')[0] for line in others] == [
        '/talk: 599 more messages in 60 s', '/talk: 600 more messages in 60 s', '/talk: 600 more messages in 60 s'
    ]  # fmt: skip


def test_rejections_after_the_last_report_are_reported(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """They are reported at the end of their minute, even if no more arrive; then nothing is logged."""
    minute.reject()
    minute.reject()
    minute.wait(PERIOD_S - 1.0)
    assert len(caplog.records) == 1
    for _ in range(5):
        minute.wait(PERIOD_S)
    assert [record.getMessage().partition(' cannot')[0] for record in caplog.records] == [
        '/talk: a message', '/talk: 1 more message in 119 s'
    ]  # fmt: skip


def test_rejections_are_logged_by_topic_reason_and_node(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """Each pair has a separate minute; two publishers of one node count as one, and a node is looked up once."""
    for publisher in ('gid1', 'gid2', 'gid3', 'gone', '', 'gid1'):
        minute.reject(publisher=publisher)
    minute.reject(reason='size_mismatch', publisher='gid1')
    minute.reject(topic='/cloud', publisher='gid1')
    starts = [record.getMessage().partition(' cannot')[0] for record in caplog.records]
    assert starts == ['/talk: a message of /driver', '/talk: a message of /other_driver', '/talk: a message',
                      '/talk: a message of /driver', '/cloud: a message of /driver']  # fmt: skip
    assert minute.lookups == ['gid1', 'gid2', 'gid3', 'gone', 'gid1']


def test_every_report_has_a_remedy(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """The remedy of the reason, of the rejection, or a general one, with the names that the operator needs."""
    minute.reject(reason='unknown_type')
    minute.reject(reason='something_new')
    minute.log.add('/odom', '', [Rejection('wrong_type', '', 'wrong_type: it is a String', 1, 'stop it')])
    endings = [record.getMessage().rpartition(' (')[2] for record in caplog.records]
    assert endings == ['install and source the package of its type; talk.format: cdr needs no definition)',
                       'talk.format: cdr stores such messages unchanged)', 'stop it)']  # fmt: skip


def test_known_rejections_wait_for_the_next_report(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """A rejection reported elsewhere is not reported again within a minute."""
    minute.log.add('/odom', '', [Rejection('wrong_type', '', 'wrong_type: it is a String', 5)], is_known=True)
    assert not caplog.records
    minute.wait(PERIOD_S)
    assert caplog.records[0].getMessage().startswith('/odom: 5 more messages in 60 s cannot be stored: wrong_type')


def test_an_unbounded_number_of_names_is_summarized(minute: Minute, caplog: pytest.LogCaptureFixture) -> None:
    """Arbitrarily many invented topics and publishers use no more memory than a thousand."""
    caplog.set_level(logging.CRITICAL)
    for number in range(3 * MAX_KNOWN):
        minute.reject(topic=f'/t{number}', publisher=f'gid{number}')
    assert max(len(minute.log._entries), len(minute.log._names)) <= MAX_KNOWN


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.ros
def test_the_node_is_that_of_the_publisher(domain: int, opened: ExitStack, caplog: pytest.LogCaptureFixture) -> None:
    """Of two nodes that publish a topic over real DDS, the one with rejected messages is named."""
    pytest.importorskip('rclpy')
    from node.participants import Participant
    from std_msgs.msg import String

    from shadowhound_data_logger.ros.reader import endpoints, node_of

    listener, good, bad = (Participant(name, domain) for name in ('listener', 'good', 'bad'))
    for one in (listener, good, bad):
        opened.callback(one.end)
    good.create(String, '/talk')
    bad.create(String, '/talk')
    until(lambda: {each.node for each in endpoints(listener.node, '/talk')} == {'/good', '/bad'})
    gid = next(each.gid for each in endpoints(listener.node, '/talk') if each.node == '/bad')
    for publisher in (gid, f'{gid}.3', '00' * 16):
        log = RejectionLog(lambda topic, of: node_of(listener.node, topic, of))
        log.add('/talk', 'talk', [Rejection('malformed', publisher, 'malformed: broken', 1)])
    assert [' of /bad cannot' in record.getMessage() for record in caplog.records] == [True, True, False]


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)
