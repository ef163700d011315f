"""Subscribes to a topic: decides about its type and its subscriptions. Owned by the intake thread.

One type of a topic is logged: the one that the settings name. If they name none it is the first one in the graph, which stays
while it has a publisher. Other types are counted if possible, reported, and never logged.
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
    is_installed,
    node_of,
    other_definition,
    unavailable,
)
from shadowhound_data_logger.ros.type_descriptions import TypeDescriptions
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import MAX_NODES, MAX_OTHER_TYPES, SINKS, WRONG_TYPE

log = logging.getLogger(__name__)

FALLBACK_S: Final = 1.0
"""How long the preferred topic must have no publisher before another one is used."""
PAUSE_S: Final = 0.3
"""After a longer pause the graph is checked before messages without a publisher's gid are counted."""
OVERLAP_S: Final = 0.5
"""How long the old subscription is kept next to its successor, at least until that is matched."""
NAMELESS_S: Final = 2.0
"""The graph shows a publisher slightly before its node."""
MAX_OTHERS: Final = 4
"""Maximum number of topics with a subscription to another type for counting; for further topics the count is unknown."""
OTHER_DEPTH: Final = 10
"""Queue depth for such a type: faster publishers use no more memory, and are not fully counted."""
OTHER_NODE: Final = '_shadowhound_other_types'
OTHER_REMEDY: Final = 'stop that publisher, rename its topic, or name the type to log in the types of the sensor'


@dataclass(frozen=True, slots=True)
class SubscriberStatus:
    """The state of a sensor at one instant."""

    sensor: str
    topic: str
    enabled: bool
    publishers: int
    received_s: float | None
    """When the last message arrived, by the monotonic clock; None before the first."""
    matched: int = 0
    """Publishers that a subscription is matched with."""
    may_be_silent: bool = False
    """Whether silence is normal: kept on change only, or all publishers are latched."""
    unavailable: str = ''
    """Why it cannot be subscribed to here; empty if it can."""
    size: int | None = None
    """Bytes of the last message; None before the first."""


class OtherTypes:
    """Counts messages of other types on sensors' topics, and discards them.

    New; ``follow`` and ``drain`` repeatedly; ``close`` once. A DDS participant has one type per topic, so this uses a separate
    participant, created when first needed. It also has one type per topic: further ones are not counted.
    """

    def __init__(self, main_node: Node, accounts: Accounts) -> None:
        self._main_node = main_node
        self._accounts = accounts
        self._context: Context | None = None
        self._node: Node | None = None
        self._refused = False
        self._readers: dict[str, Reader] = {}
        self._reports = RejectionLog(partial(node_of, main_node))

    def follow(self, topic: str, types: Sequence[str]) -> str:
        """Choose which of these published types to subscribe to; empty if none."""
        reader = self._readers.get(topic)
        if reader is not None and reader.plan.type not in types:
            self._count(topic, reader)
            self._readers.pop(topic).close()
            reader = None
        if reader is None and len(self._readers) < MAX_OTHERS:
            reader = next((made for name in types if not unavailable(name) and (made := self._open_reader(topic, name))), None)
            if reader is not None:
                self._readers[topic] = reader
        return reader.plan.type if reader is not None else ''

    def drain(self) -> None:
        """Take everything that waits, and count it."""
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

    def _open_reader(self, topic: str, type_name: str) -> Reader | None:
        """None if that is impossible; whether it is possible at all is tried once."""
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
                rclpy.init(args=[], context=self._context, domain_id=self._main_node.context.get_domain_id())
                self._node = Node(OTHER_NODE, context=self._context, namespace=self._main_node.get_namespace(),
                                  start_parameter_services=False, enable_rosout=False)  # fmt: skip
            except RuntimeError as error:
                self._refused = True
                log.warning('messages of unexpected types are not counted: %s', error)
        return self._node


class _Publishers:
    """The publishers in the graph, without those whose node is known to have ended.

    Fast DDS 2.6 ignores Cyclone DDS's notice that a publisher ended (a serialized key of more than 16 bytes,
    MessageReceiver.cpp), and keeps it while the process runs; the node's graph information is reported separately.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._had_node: dict[str, set[str]] = {}

    def of(self, topic: str) -> list[Endpoint]:
        found = endpoints(self._node, topic)
        before = self._had_node.get(topic, set())
        known = self._had_node[topic] = {each.gid for each in found if each.node or each.gid in before}
        return [each for each in found if each.node or each.gid not in known]


class Dependencies(NamedTuple):
    """What subscribers need, the same for all of an intake."""

    node: Node
    group: PolledGroup
    accounts: Accounts
    types: MessageTypes
    stamps: StampRule
    early: EarlyReaders | None = None
    """Subscriptions that exist already."""
    descriptions: TypeDescriptions | None = None
    """Where definitions of unknown types are requested."""


class Subscriber:
    """Subscribes to a topic, of a sensor or not: ``refresh`` follows the graph, ``drain`` takes messages."""

    def __init__(self, shared: Dependencies, sensor: SensorSettings, consumers: Sequence[Consumer],
                 others: OtherTypes | None = None) -> None:  # fmt: skip
        """Messages are passed to ``consumers``.

        Without ``others`` the topic has no sensor: nothing is counted here, and other types are reported in the accounts of
        bags and events.
        """
        self.sensor = sensor
        self._others = others
        self._node, self._group, self._accounts, self._message_types, self._stamps, self._early, self._descriptions = shared
        self._consumers = consumers
        node = self._node
        self._topics: list[str] = [node.resolve_topic_name(topic) for topic in sensor.topics]
        self._types_expected = dict(zip(self._topics, sensor.types, strict=False))
        self._chosen = self._topics[0]
        self._absent_since_s: float | None = None
        self._publishers = self._matched = 0
        self.is_latched = False
        """Whether all publishers are latched; kept while there are none."""
        self.has_latched = False
        """Whether one of them is."""
        self._type = ''
        self._history = HistoryDepth('')
        self._readers: list[Reader] = []
        self._retiring: dict[Reader, float] = {}
        self._received: set[Plan] = set()
        self._senders = Senders()
        self._graph = _Publishers(node)
        self._stream: SensorStream | TopicStream | None = None
        self.paused = False
        """Whether messages are only counted."""
        self._last_taken_s: float | None = None
        self._last_received_s: float | None = None
        self._last_size: int | None = None
        self._unavailable = ''
        self._logged: set[str] = set()
        self._nameless_since_s: float | None = None

    @property
    def topic(self) -> str:
        """The topic that it subscribes to, or would."""
        return self._chosen

    @property
    def is_unused(self) -> bool:
        """Whether its topics have no publisher of its types, and no message of them was received."""
        return not self._publishers and self._last_received_s is None

    @property
    def wanted(self) -> dict[str, str]:
        """Its topics in order of preference, with the type that the settings name for each, or ''."""
        expected = {topic: alternatives(self._types_expected.get(topic, '')) for topic in self._topics}
        return {topic: self._type if self._type in names else names[0] for topic, names in expected.items()}

    def status(self) -> SubscriberStatus:
        """From any thread: each value is replaced atomically."""
        return SubscriberStatus(self.sensor.name, self._chosen, self.sensor.enabled, self._publishers, self._last_received_s,
                            self._matched, self.sensor.on_change or self.is_latched, self._unavailable,
                                self._last_size)  # fmt: skip

    def refresh(self, now_s: float) -> None:
        """Check the graph and subscribe to match its publishers."""
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
        self._account_for_others(type_name, found, now_s)
        if not type_name:
            return
        if not self._is_available(type_name, now_s, is_published=bool(publishers)):
            if self._unavailable and self._readers:
                self.close(now_s)
            return
        if type_name != self._type:
            self._retype(type_name, now_s)
        wanted = plans(self._chosen, type_name, publishers, self._history.depth)
        present = {reader.plan for reader in self._readers}
        for plan in wanted:
            if plan not in present and not self._subscribe(plan):
                return
        if publishers and isinstance(self._stream, SensorStream):
            self._stream.begin()
        if publishers and set(wanted) != self._received:
            self._received = set(wanted)
            log.info('%s: %s', self.sensor.name, ' and '.join(plan.describe() for plan in wanted))
        self._retire(set(wanted), now_s)

    def drain(self, now_s: float) -> None:
        """Take everything that waits."""
        for reader in self._readers:
            self._take(reader, now_s)
        if self._stream is not None:
            self._stream.poll(now_s)

    def update(self, sensor: SensorSettings, now_s: float) -> None:
        """Apply other settings."""
        before, self.sensor = self.sensor, sensor
        if before.enabled and not sensor.enabled:
            self._abandon(now_s)
            self._publishers = 0
        elif sensor.enabled and not before.enabled:
            self._accounts.rebase(self._chosen)

    # -- the graph -------------------------------------------------------------------------------------------------

    def _choose(self, now_s: float) -> list[Endpoint]:
        """Publishers of the chosen topic: the preferred one if published, another after a while without it."""
        found = {topic: self._graph.of(topic) for topic in self._topics}
        named = {topic: alternatives(name) for topic, name in self._types_expected.items() if name}
        present = {topic for topic, publishers in found.items()
                   if any(topic not in named or each.type in named[topic] for each in publishers)}  # fmt: skip
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

    def _account_for_others(self, type_name: str, found: Sequence[Endpoint], now_s: float) -> None:
        """Account for other types of the topic; log each once."""
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
            if name not in self._logged and (any(by) or self._has_waited(now_s)):
                how = 'counted as rejected (wrong_type)' if name == counted else 'not listened to'
                whose = ', '.join(filter(None, by[:MAX_NODES])) or 'a program that is not a ROS node'
                if len(found) > sum(map(len, nodes.values())):
                    text = f'{self._chosen} is published as {name} too, by {whose}; {type_name} is logged, and that is {how}'
                else:
                    text = f'{self._chosen} is published as {name}, by {whose}; only {type_name} is logged, and that is {how}'
                self._log_once(name, text)
        if not nodes:
            self._nameless_since_s = None

    def _has_waited(self, now_s: float) -> bool:
        """Whether the graph has had time to learn the publisher's node."""
        if self._nameless_since_s is None:
            self._nameless_since_s = now_s
        return now_s > self._nameless_since_s + NAMELESS_S

    def _log_once(self, type_name: str, text: str) -> None:
        """Log once for each type."""
        if type_name not in self._logged and len(self._logged) < MAX_OTHER_TYPES:
            self._logged.add(type_name)
            log.warning('%s: %s', self.sensor.name, text)

    def _subscribe(self, plan: Plan) -> bool:
        """Create a subscription; on failure it is tried again at the next check."""
        try:
            self._readers.append(Reader(self._node, plan, self._group))
        except SubscriptionRefused as error:
            self._unavailable = str(error)
            self._log_once(plan.type, f'{self._chosen} is not logged: {self._unavailable}')
            return False
        return True

    def _is_available(self, type_name: str, now_s: float, *, is_published: bool) -> bool:
        """Whether messages of the type can be received here; checked before anything is started or counted for them.

        While the type is not published, an unavailable type is no problem: the default settings name types of other robots. One
        whose package is not installed is subscribed to once it is published: until then its definition cannot be compared.
        """
        if not is_published and not is_installed(type_name):
            self._unavailable = ''
            return bool(self._readers)
        why = unavailable(type_name)
        if why and self._descriptions is not None and self._descriptions.poll(self._chosen, type_name, now_s):
            self._unavailable = ''
            return False
        hint = install_hint(type_name) if why else ''
        self._unavailable = why or other_definition(self._node, self._chosen, type_name)
        if self._unavailable:
            self._log_once(type_name, f'{self._chosen} is not logged: {self._unavailable}{hint}')
        return not self._unavailable

    def _retype(self, type_name: str, now_s: float) -> None:
        """Start with a topic that is new, or has another type than before."""
        self.close(now_s)
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
        """Close obsolete subscriptions once their successors are matched, so that no message is missed."""
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
        """Leave the topic on purpose: later messages do not count as lost."""
        self.close(now_s)
        if self._others is not None:
            self._others.follow(self._chosen, ())
        self._accounts.rebase(self._chosen)

    def close(self, now_s: float) -> None:
        """Take what still waits and close everything for the current topic and type, each even if another fails."""
        with ExitStack() as leaving:
            leaving.callback(self._forget)
            for reader in self._readers:
                leaving.callback(reader.close)
                leaving.callback(self._take, reader, now_s)

    def _forget(self) -> None:
        stream, self._stream = self._stream, None
        self._readers.clear()
        self._retiring.clear()
        self._received = set()
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
        self._history.observe([len(message.cdr) for message in taken], since_s)
        last_s, self._last_taken_s = self._last_taken_s, now_s
        self._last_size = len(taken[-1].cdr)
        self._last_received_s = now_s - _waited_s(taken[-1].received_ns, since_s)
        is_unnamed = taken[0].publisher is None or taken[0].number is None
        if is_unnamed and (not self._senders.gids or last_s is None or now_s - last_s > PAUSE_S):
            gids = [each.gid for each in self._graph.of(self._chosen) if each.type == self._type]
            self._senders.poll(gids, now_s)
        self._stream.add(taken, self._senders, now_s, paused=self.paused)


def _waited_s(received_ns: int, max_s: float) -> float:
    """How long a message waited in the middleware, by the wall clock that stamped it, which may have stepped since."""
    return min(max(0.0, (time.time_ns() - received_ns) / SECOND), max_s) if received_ns else 0.0
