"""What the ring and the conditions get from the intake: the same messages, without waiting and without a copy."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy')

from bags.recording import NOON_NS, batch, messages
from clocks import Clocks
from e2e.reading import STRING

from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.ring import Ring, RingItem
from shadowhound_data_logger.core.expression import conditions
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import EventSettings
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.node.intake.consumers import Drained
from shadowhound_data_logger.node.recording.events import EventConsumer
from shadowhound_data_logger.node.recording.triggers import LARGE_BYTES, SEEN, EventWatch, Inbox
from shadowhound_data_logger.spool.topic_account import PAUSED

FLOAT = 'std_msgs/msg/Float64'


class Graph:
    """A node without a middleware: a namespace, and no publishers."""

    asked = 0

    def resolve_topic_name(self, topic: str) -> str:
        return topic if topic.startswith('/') else f'/r0/{topic}'

    def get_publishers_info_by_topic(self, _: str) -> list[Any]:
        self.asked += 1
        return []


class Losses:
    """EventAccounts without an event: records the messages that are unavailable."""

    def __init__(self) -> None:
        self.lost: list[tuple[str, list[int | None]]] = []

    def lose(self, held: Sequence[RingItem], reason: str = 'ring_full') -> None:
        self.lost += [(reason, [message.number for message in each.batch.messages]) for each in held]


class Ear:
    """The events' consumer with a ring, as in the intake."""

    def __init__(self, **settings: Any) -> None:
        self.graph: Any = Graph()
        self.claims: Any = Losses()
        self.ring = Ring(1 << 20, 60.0)
        self.consumer = EventConsumer(self.graph, EventSettings(**settings), self.ring, self.claims)

    def wanted(self, *graph: str) -> frozenset[str]:
        return self.consumer.wanted_topics.wanted((), graph)

    def take(self, topic: str, messages: Sequence[Taken], *, paused: bool = False) -> None:
        self.consumer.take(Drained(topic, STRING, '', messages, None, 0.0, paused))


def test_events_need_topics_of_the_ring_and_of_conditions() -> None:
    """Names as resolved in the node's namespace; a topic used only by a condition is not kept."""
    ear = Ear(topics=('imu',), regex='^/odom', conditions=('low: lowstate:bms_state.soc < 20', 'hot: imu:temperature > 80'))
    assert ear.wanted('/odom', '/other') == {'/r0/imu', '/odom', '/r0/lowstate'}
    for topic in ('/r0/imu', '/odom', '/r0/lowstate'):
        ear.take(topic, messages(range(3)))
    kept = [held.batch.topic for held in iter(lambda: ear.ring.next(float('inf')), None)]
    assert kept == ['/r0/imu', '/odom']
    assert [len(list(ear.consumer.inbox.take(topic))) for topic in ('/r0/imu', '/r0/lowstate')] == [3, 3]


def test_the_graph_is_asked_once_for_each_publisher() -> None:
    """A poll of the intake must not query the graph."""
    ear = Ear(topics=('/talk',))
    for _ in range(5):
        ear.take('/talk', messages(range(3)))
    assert ear.graph.asked == 1
    ear.take('/talk', [messages(range(1))[0]._replace(publisher='another')])
    assert ear.graph.asked == 2


def test_a_pause_keeps_nothing() -> None:
    """Messages during it are lost to an event that requests them, because of the pause; otherwise they are not counted."""
    ear = Ear(topics=('/talk',))
    ear.take('/talk', messages(range(3)), paused=True)
    assert (ear.ring.bytes, ear.claims.lost) == (0, [])
    ear.ring.claim(0.0)
    ear.take('/talk', messages(range(3, 5)), paused=True)
    assert ear.claims.lost == [(PAUSED, [3, 4])]


def test_event_messages_dropped_from_the_ring_are_reported() -> None:
    """Only then: without an event the oldest are removed silently."""
    ear = Ear(topics=('/talk',))
    for number in range(20):
        ear.take('/talk', batch(range(number, number + 1), size=100_000).messages)
    assert ear.claims.lost == []
    ear.ring.claim(0.0)
    ear.take('/talk', batch(range(20, 21), size=100_000).messages)
    assert ear.claims.lost == [('ring_full', [10])]


def seen(inbox: Inbox) -> list[int | None]:
    return [message.number for _, _, message in inbox.take('/x')]


def test_conditions_check_a_sample_of_messages() -> None:
    """Ten per drain, evenly, including the newest; one if a condition has a hold time, or messages are large."""
    (now,), (later,) = conditions(['x: /x:data > 1']), conditions(['x: /x:data > 1 for 5'])
    inbox = Inbox([('/x', now)])
    inbox.put('/x', FLOAT, messages(range(100)), 0.0)
    assert seen(inbox) == list(range(9, 100, 10))
    inbox.put('/x', FLOAT, messages(range(3)), 0.0)
    assert seen(inbox) == [0, 1, 2]
    inbox.put('/x', FLOAT, messages(range(3), LARGE_BYTES), 0.0)
    assert seen(inbox) == [2]
    inbox = Inbox([('/x', later)])
    for first in (0, 100):
        inbox.put('/x', FLOAT, messages(range(first, first + 100)), 0.0)
    assert seen(inbox) == [199]


def test_the_inbox_is_bounded() -> None:
    """If it is not drained for a while the newest messages are kept."""
    inbox = Inbox([('/x', conditions(['x: /x:data > 1'])[0])])
    for first in range(0, 1000, 10):
        inbox.put('/x', FLOAT, messages(range(first, first + 10)), 0.0)
    assert seen(inbox) == list(range(1000 - 2 * SEEN, 1000))


class Watched:
    """An event watch and what it triggers."""

    def __init__(self, home: Path, *texts: str, log_event: str = '.*') -> None:
        clock = Clocks()
        clock.set(NOON_NS)
        self.inbox = Inbox([(condition.test.source, condition) for condition in conditions(texts)])
        self.triggered: list[tuple[str, str, str]] = []
        self.watch = EventWatch(self.inbox, MessageTypes(), home, clock, log_event, self._trigger)

    def _trigger(self, name: str, by: str, detail: str | None = None, _: float = 0.0) -> tuple[bool, str]:
        self.triggered.append((name, by, detail or ''))
        return True, ''

    def say(self, cdr: bytes, now_s: float = 0.0, type_name: str = FLOAT) -> None:
        self.inbox.put('/x', type_name, [Taken(cdr, 0, 'p', 1)], now_s)
        self.watch._step()


def float64(value: float) -> bytes:
    return b'\0\1\0\0' + struct.pack('<d', value)


def test_a_condition_triggers(tmp_path: Path) -> None:
    """With its name, and the observed number."""
    watched = Watched(tmp_path, 'low: /x:data < 20')
    for value in (30.0, 19.5, 18.0):
        watched.say(float64(value))
    assert watched.triggered == [('low', 'condition', '/x:data < 20: 19.5')]


@pytest.mark.parametrize(('text', 'cdr', 'said'), [
    ('low: /x:nothing < 20', float64(1.0), 'has no number nothing'),
    ('low: /x:data < 20', b'\0\1\0\0\0', 'cannot be used in conditions'),
])  # fmt: skip
def test_an_unusable_condition_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str, cdr: bytes,
                                         said: str) -> None:  # fmt: skip
    """A missing field, or an invalid message."""
    watched = Watched(tmp_path, text)
    for _ in range(3):
        watched.say(cdr)
    assert watched.triggered == []
    assert [said in record.message for record in caplog.records] == [True]


def test_agent_events_match_the_log_event_setting(tmp_path: Path) -> None:
    """Matching names, from the active mission; also those logged just before it ended."""
    watched = Watched(tmp_path, log_event='^f')
    folder = MissionFolder(tmp_path / 'missions' / 'patrol_1')
    folder.path.mkdir(parents=True)
    journal = Journal(folder.journal)
    journal.create()
    watched.watch.on_mission(MissionOf('patrol', 'patrol_1', None))
    journal.append({'k': 'event', 't': NOON_NS, 'name': 'way_point'})
    journal.append({'k': 'event', 't': NOON_NS, 'name': 'fall', 'data': {'leg': 2}})
    watched.watch._step()
    assert watched.triggered == [('fall', 'log_event', '{"leg": 2}')]
    journal.append({'k': 'event', 't': NOON_NS, 'name': 'failed'})
    watched.watch.on_mission(None)
    watched.watch._step()
    journal.append({'k': 'event', 't': NOON_NS, 'name': 'fifth'})
    watched.watch._step()
    assert [name for name, _, _ in watched.triggered] == ['fall', 'failed']
    watched.watch.update('')
    journal.close()
