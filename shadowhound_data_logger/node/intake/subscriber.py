"""Listens to a topic: decides under which type and by which subscriptions. Owned by the intake thread.

One type of a topic is logged: the one that the settings name. Where they name none it is the first one in the graph, and it
stays while it has a publisher. Whatever else is published there is counted where that is possible, told, and never logged.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.stamps import StampRule, by_arrival
from shadowhound_data_logger.formats.payload import Rejection
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.rejections import RejectionLog
from shadowhound_data_logger.node.intake.consumers import Consumer
from shadowhound_data_logger.node.intake.early import EarlyReaders
from shadowhound_data_logger.node.intake.stream import Senders, SensorStream, TopicStream
from shadowhound_data_logger.ros.endpoints import POLL_S, Endpoint, HistoryDepth, Plan, alternatives, logged_type, plans
from shadowhound_data_logger.ros.reader import (
    PolledGroup,
    Reader,
    SubscriptionRefused,
    endpoints,
    install_hint,
    node_of,
    unavailable,
)
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import MAX_NODES, MAX_OTHER_TYPES, SINKS, WRONG_TYPE

log = logging.getLogger(__name__)

FALLBACK_S: Final = 1.0
"""How long the preferred topic must be without a publisher before another one is taken."""
PAUSE_S: Final = 0.3
"""After a longer one who publishes now is looked up before messages that do not name their sender are counted."""
OVERLAP_S: Final = 0.5
"""How long the old subscription lives beside its successor, at least until that is matched."""
NAMELESS_S: Final = 2.0
"""The graph shows a publisher a little before it knows its node."""
MAX_OTHERS: Final = 4
"""Topics of which another type is listened to in order to be counted; of further ones the count is unknown."""
OTHER_DEPTH: Final = 10
"""Messages of such a type that are held between two drains: whoever sends more costs no more memory, and is not all counted."""
OTHER_NODE: Final = '_shadowhound_other_types'
OTHER_REMEDY: Final = 'stop that publisher, rename its topic, or name the type to log in the types of the sensor'


@dataclass(frozen=True, slots=True)
class SubscriberStatus:
    """A sensor at one instant."""

    sensor: str
    topic: str
    enabled: bool
    publishers: int
    received_s: float | None
    """When the last message came, by the monotonic clock; None before the first."""
    matched: int = 0
    """Publishers that a subscription is connected with."""
    may_be_silent: bool = False
    """Whether it is published when there is something to say: kept on change only, or latched by all its publishers."""
    unavailable: str = ''
    """Why nobody can listen to it here; empty where that is possible."""


class OtherTypes:
    """Counts what comes on topics of sensors under another type than theirs, and throws it away.

    New; ``follow`` and ``drain`` again and again; ``close`` once. A DDS participant has one type for a topic, so this takes one
    of its own, which is made when it is first needed and stays. There too a topic has one type: any further one is not counted.
    """

    def __init__(self, beside: Node, accounts: Accounts) -> None:
        self._beside = beside
        self._accounts = accounts
        self._context: Context | None = None
        self._node: Node | None = None
        self._refused = False
        self._readers: dict[str, Reader] = {}
        self._reports = RejectionLog(partial(node_of, beside))

    def follow(self, topic: str, types: Sequence[str]) -> str:
        """The one of these types, all published there now, that is listened to from now on; empty for none of them."""
        reader = self._readers.get(topic)
        if reader is not None and reader.plan.type not in types:
            self._count(topic, reader)
            self._readers.pop(topic).close()
            reader = None
        if reader is None and len(self._readers) < MAX_OTHERS:
            reader = next((made for name in types if not unavailable(name) and (made := self._make(topic, name))), None)
            if reader is not None:
                self._readers[topic] = reader
        return reader.plan.type if reader is not None else ''

    def drain(self) -> None:
        """Take all that waits, and count it."""
        for topic, reader in self._readers.items():
            self._count(topic, reader)
        self._reports.poll()

    def close(self) -> None:
        """Idempotent."""
        self.drain()
        for reader in self._readers.values():
            reader.close()
        self._readers.clear()
        if self._node is not None:
            self._node.destroy_node()
            self._node = None
        if self._context is not None:
            rclpy.try_shutdown(context=self._context)
            self._context = None

    def _count(self, topic: str, reader: Reader) -> None:
        refused = reader.drain()
        if refused:
            self._accounts.reject_other_type(topic, reader.plan.type, len(refused), by_arrival(refused[0].received_ns),
                                  by_arrival(refused[-1].received_ns))  # fmt: skip
            by = Counter(message.publisher or '' for message in refused)
            text = f'{WRONG_TYPE}: it is a {reader.plan.type}'
            self._reports.add(topic, '', [Rejection(WRONG_TYPE, gid, text, count, OTHER_REMEDY) for gid, count in by.items()],
                              is_known=True)  # fmt: skip

    def _make(self, topic: str, type_name: str) -> Reader | None:
        """None where that cannot be done; whether it can be done at all is tried once."""
        try:
            node = self._open()
            plan = Plan(topic, type_name, reliable=False, transient_local=False, depth=OTHER_DEPTH)
            return Reader(node, plan, PolledGroup()) if node is not None else None
        except SubscriptionRefused:
            return None

    def _open(self) -> Node | None:
        if self._node is None and not self._refused:
            self._context = Context()
            try:
                rclpy.init(args=[], context=self._context, domain_id=self._beside.context.get_domain_id())
                self._node = Node(OTHER_NODE, context=self._context, namespace=self._beside.get_namespace(),
                                  start_parameter_services=False, enable_rosout=False)  # fmt: skip
            except RuntimeError as error:
                self._refused = True
                log.warning('messages of other types than the expected ones are not counted: %s', error)
        return self._node


class Surroundings(NamedTuple):
    """What all subscribers of an intake work with."""

    node: Node
    group: PolledGroup
    accounts: Accounts
    types: MessageTypes
    stamps: StampRule
    early: EarlyReaders | None = None
    """Subscriptions that exist already."""


class Subscriber:
    """Listens to a topic, of a sensor or of none: ``refresh`` follows the graph, ``drain`` takes what came."""

    def __init__(self, around: Surroundings, sensor: SensorSettings, consumers: Sequence[Consumer],
                 others: OtherTypes | None = None) -> None:  # fmt: skip
        """What is taken goes to ``consumers``.

        Without ``others`` its topic is one that no sensor has: nothing of it is counted here, and its other types are told in the
        accounts of bags and events.
        """
        self.sensor = sensor
        self._others = others
        self._node, self._group, self._accounts, self._message_types, self._stamps, self._early = around
        self._consumers = consumers
        node = self._node
        self._topics: list[str] = [node.resolve_topic_name(topic) for topic in sensor.topics]
        self._types_expected = dict(zip(self._topics, sensor.types, strict=False))
        self._chosen = self._topics[0]
        self._absent_since_s: float | None = None
        self._publishers = self._matched = 0
        self.is_latched = False
        """Whether all publishers send what they sent before to whoever comes; as it was while there were any."""
        self.has_latched = False
        """Whether one of them does."""
        self._type = ''
        self._history = HistoryDepth('')
        self._readers: list[Reader] = []
        self._retiring: dict[Reader, float] = {}
        self._heard: set[Plan] = set()
        self._senders = Senders()
        self._of_nodes: dict[str, set[str]] = {}
        self._stream: SensorStream | TopicStream | None = None
        self.paused = False
        """Whether messages are only counted."""
        self._last_taken_s: float | None = None
        self._last_received_s: float | None = None
        self._unavailable = ''
        self._told: set[str] = set()
        self._nameless_since_s: float | None = None

    @property
    def topic(self) -> str:
        """The topic it listens to, or would."""
        return self._chosen

    @property
    def wanted(self) -> dict[str, str]:
        """Its topics in the order of preference, with the type that the settings name for each, or nothing."""
        expected = {topic: alternatives(self._types_expected.get(topic, '')) for topic in self._topics}
        return {topic: self._type if self._type in names else names[0] for topic, names in expected.items()}

    def status(self) -> SubscriberStatus:
        """From any thread: each of its figures is replaced as a whole."""
        return SubscriberStatus(self.sensor.name, self._chosen, self.sensor.enabled, self._publishers, self._last_received_s,
                            self._matched, self.sensor.on_change or self.is_latched, self._unavailable)  # fmt: skip

    def refresh(self, now_s: float) -> None:
        """Look at the graph and subscribe as its publishers ask for it."""
        if not self.sensor.enabled:
            return
        found = self._choose(now_s)
        type_name = logged_type(found, self._types_expected.get(self._chosen), self._type)
        publishers = [publisher for publisher in found if publisher.type == type_name]
        self._publishers = len(publishers)
        self._matched = max((reader.matched() for reader in self._readers), default=0)
        if publishers:
            self.is_latched = all(publisher.transient_local for publisher in publishers)
            self.has_latched = any(publisher.transient_local for publisher in publishers)
        self._senders.poll([publisher.gid for publisher in publishers], now_s)
        self._look_at_others(type_name, found, now_s)
        if not type_name or not self._is_available(type_name, is_published=bool(publishers)):
            return
        if type_name != self._type:
            self._retype(type_name, now_s)
        wanted = plans(self._chosen, type_name, publishers, self._history.depth)
        present = {reader.plan for reader in self._readers}
        for plan in wanted:
            if plan not in present and not self._subscribe(plan):
                return
        if publishers and set(wanted) != self._heard:
            self._heard = set(wanted)
            log.info('%s: %s', self.sensor.name, ' and '.join(plan.describe() for plan in wanted))
        self._retire(set(wanted), now_s)

    def drain(self, now_s: float) -> None:
        """Take all that waits."""
        for reader in self._readers:
            self._take(reader, now_s)
        if self._stream is not None:
            self._stream.poll(now_s)

    def update(self, sensor: SensorSettings, now_s: float) -> None:
        """Go on by other settings."""
        before, self.sensor = self.sensor, sensor
        if before.enabled and not sensor.enabled:
            self._abandon(now_s)
            self._publishers = 0
        elif sensor.enabled and not before.enabled:
            self._accounts.rebase(self._chosen)

    def close(self, now_s: float) -> None:
        """Take what still waits, and end the subscriptions."""
        self._leave(now_s)

    # -- the graph -------------------------------------------------------------------------------------------------

    def _choose(self, now_s: float) -> list[Endpoint]:
        """Publishers of the topic to listen to: the preferred one at once, another after a while without it."""
        found = {topic: self._publishers_of(topic) for topic in self._topics}
        present = {topic for topic, publishers in found.items() if self._has_own(topic, publishers)}
        best = next((topic for topic in self._topics if topic in present), self._chosen)
        if best == self._chosen or self._chosen in present:
            self._absent_since_s = None
        elif self._absent_since_s is None:
            self._absent_since_s = now_s
        better = self._topics.index(best) < self._topics.index(self._chosen)
        waited = self._absent_since_s is not None and now_s - self._absent_since_s >= FALLBACK_S
        if best != self._chosen and (better or waited):
            log.info('%s: taken from %s now instead of %s', self.sensor.name, best, self._chosen)
            self._abandon(now_s)
            self._chosen = best
            self._absent_since_s = None
        return found[self._chosen]

    def _publishers_of(self, topic: str) -> list[Endpoint]:
        """As the graph knows them, without those that were a node's and are no more: they ended.

        Fast DDS 2.6 does not understand Cyclone DDS when it says that a publisher ended (it ignores a serialized key of more than
        16 bytes, MessageReceiver.cpp), and keeps it while the process lives; what its node has is told by another way.
        """
        found = endpoints(self._node, topic)
        before = self._of_nodes.get(topic, set())
        known = self._of_nodes[topic] = {each.gid for each in found if each.node or each.gid in before}
        return [each for each in found if each.node or each.gid not in known]

    def _has_own(self, topic: str, publishers: Sequence[Endpoint]) -> bool:
        """Whether somebody publishes the topic with the type that is named for it."""
        named = self._types_expected.get(topic)
        return any(not named or publisher.type in alternatives(named) for publisher in publishers)

    def _look_at_others(self, type_name: str, found: Sequence[Endpoint], now_s: float) -> None:
        """Account for the types that the topic is published under besides this one; name each once in the log."""
        nodes: dict[str, list[str]] = {}
        for publisher in found:
            if publisher.type != type_name:
                nodes.setdefault(publisher.type, []).append(publisher.node)
        counted = self._others.follow(self._chosen, list(nodes)) if self._others is not None else ''
        named = bool(self._types_expected.get(self._chosen))
        accounts = [self._chosen] if self._others is not None else [f'{sink}{self._chosen}' for sink in SINKS]
        for name, by in nodes.items():
            for account in accounts:
                self._accounts.add_other_type(account, name, by, counted=name == counted, named=named,
                                              only_known=self._others is None)  # fmt: skip
            if name not in self._told and (any(by) or self._has_waited(now_s)):
                how = 'counted as rejected (wrong_type)' if name == counted else 'not listened to'
                whose = ', '.join(filter(None, by[:MAX_NODES])) or 'a program that is not a ROS node'
                if len(found) > sum(map(len, nodes.values())):
                    text = f'{self._chosen} is published as {name} too, by {whose}; {type_name} is logged, and that is {how}'
                else:
                    text = f'{self._chosen} is published as {name}, by {whose}; only {type_name} is logged, and that is {how}'
                self._tell(name, text)
        if not nodes:
            self._nameless_since_s = None

    def _has_waited(self, now_s: float) -> bool:
        """Whether there was time for the graph to learn whose publisher it is."""
        if self._nameless_since_s is None:
            self._nameless_since_s = now_s
        return now_s > self._nameless_since_s + NAMELESS_S

    def _tell(self, type_name: str, text: str) -> None:
        """In the log, once for each type."""
        if type_name not in self._told and len(self._told) < MAX_OTHER_TYPES:
            self._told.add(type_name)
            log.warning('%s: %s', self.sensor.name, text)

    def _subscribe(self, plan: Plan) -> bool:
        """Whether the middleware made the subscription; tried again at the next look."""
        try:
            self._readers.append(Reader(self._node, plan, self._group))
        except SubscriptionRefused as error:
            self._unavailable = str(error)
            self._tell(plan.type, f'{self._chosen} is not logged: {self._unavailable}')
            return False
        return True

    def _is_available(self, type_name: str, *, is_published: bool) -> bool:
        """Whether messages of the type can be received here; asked before anything is begun or counted for them.

        While they are not published, that they cannot be is no problem: the default settings name types of other robots.
        """
        why = unavailable(type_name)
        self._unavailable = why if is_published else ''
        if self._unavailable:
            self._tell(type_name, f'{self._chosen} is not logged: {why}{install_hint(type_name)}')
        return not why

    def _retype(self, type_name: str, now_s: float) -> None:
        """Begin with a topic that is new, or of another type than before."""
        self._leave(now_s)
        if self._others is None:
            self._stream = TopicStream(self._chosen, type_name, self._message_types, self._stamps, self._consumers)
        else:
            self._stream = SensorStream(
                self.sensor, self._chosen, type_name, self._accounts, self._message_types, self._stamps, self._consumers
            )
        self._type = type_name
        self._history = HistoryDepth(type_name)
        if self._early is not None:
            self._readers += self._early.adopt(self._chosen, type_name)

    def _retire(self, wanted: set[Plan], now_s: float) -> None:
        """Close the subscriptions that are not wanted any more, once their successors are matched; none is missed so."""
        matched = any(reader.matched() for reader in self._readers if reader.plan in wanted)
        for reader in tuple(self._readers):
            if reader.plan in wanted:
                self._retiring.pop(reader, None)
            elif now_s >= self._retiring.setdefault(reader, now_s + OVERLAP_S) and matched:
                self._take(reader, now_s)
                self._readers.remove(reader)
                del self._retiring[reader]
                reader.close()

    def _abandon(self, now_s: float) -> None:
        """Leave the topic on purpose: what is published there from now on is nobody's loss."""
        self._leave(now_s)
        if self._others is not None:
            self._others.follow(self._chosen, ())
        self._accounts.rebase(self._chosen)

    def _leave(self, now_s: float) -> None:
        """End all that belongs to the current topic and type, each whatever happens to the others."""
        with ExitStack() as leaving:
            leaving.callback(self._forget)
            for reader in self._readers:
                leaving.callback(reader.close)
                leaving.callback(self._take, reader, now_s)

    def _forget(self) -> None:
        stream, self._stream = self._stream, None
        self._readers.clear()
        self._retiring.clear()
        self._heard = set()
        self._type = ''
        if stream is not None:
            stream.close()

    # -- messages --------------------------------------------------------------------------------------------------

    def _take(self, reader: Reader, now_s: float) -> None:
        taken = reader.drain()
        before_s, reader.drained_s = reader.drained_s, now_s
        if not taken or self._stream is None:
            return
        since_s = POLL_S if before_s is None else now_s - before_s
        self._history.hear([len(message.cdr) for message in taken], since_s)
        last_s, self._last_taken_s = self._last_taken_s, now_s
        self._last_received_s = now_s - _waited_s(taken[-1].received_ns, since_s)
        is_unnamed = taken[0].publisher is None or taken[0].number is None
        if is_unnamed and (not self._senders.gids or last_s is None or now_s - last_s > PAUSE_S):
            gids = [each.gid for each in self._publishers_of(self._chosen) if each.type == self._type]
            self._senders.poll(gids, now_s)
        self._stream.add(taken, self._senders, now_s, paused=self.paused)


def _waited_s(received_ns: int, most_s: float) -> float:
    """How long a message lay in the middleware, by the wall clock that stamped it there, which may have stepped meanwhile."""
    return min(max(0.0, (time.time_ns() - received_ns) / SECOND), most_s) if received_ns else 0.0
