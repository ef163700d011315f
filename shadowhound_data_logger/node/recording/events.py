"""Passes messages to the event ring and the conditions, and writes events to bags.

Messages arrive through the same subscriptions as those of objects and bags.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.events import NOTICE_S, Events
from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.ring import EventAccounts, Ring, RingItem
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.expression import conditions
from shadowhound_data_logger.core.options import EventSettings
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained, TopicChoice
from shadowhound_data_logger.node.recording.bags import Offers
from shadowhound_data_logger.node.recording.triggers import EventWatch, Inbox
from shadowhound_data_logger.ros.endpoints import POLL_S
from shadowhound_data_logger.spool.topic_account import PAUSED


class EventConsumer(Consumer):
    """Passes messages to the ring and the conditions; it counts nothing and copies nothing."""

    def __init__(self, node: Node, settings: EventSettings, ring: Ring, claims: EventAccounts) -> None:
        watched = [(node.resolve_topic_name(each.test.source), each) for each in conditions(settings.conditions)]
        named = [node.resolve_topic_name(topic) for topic in settings.topics if topic]
        self.inbox = Inbox(watched)
        self.wanted_topics = TopicChoice(settings, [*named, *self.inbox.conditions])
        kept = TopicChoice(settings, named).wanted((), self.inbox.conditions)
        self._unkept = frozenset(self.inbox.conditions) - kept
        self._ring = ring
        self._claims = claims
        self._offers = Offers(node)

    def take(self, drained: Drained) -> None:
        """Take messages; repeats are skipped when they are written."""
        topic, messages, now_s = drained.topic, drained.messages, time.monotonic()
        if topic in self.inbox.conditions:
            self.inbox.put(topic, drained.type, messages, now_s)
        if topic in self._unkept:
            return
        qos, latched = self._offers.of(topic, drained.type, messages[-1].publisher)
        batch = MessageBatch(topic, drained.type, qos, messages, latched)
        if not drained.paused:
            if gone := self._ring.put(batch, drained.lost, now_s):
                self._claims.lose(gone)
        elif self._ring.claimed:
            self._claims.lose([RingItem(batch, drained.lost, now_s, 0)], PAUSED)


class EventBuffer:
    """Keeps the newest messages for events: the ring, its consumer, and the recording of events.

    Lifecycle: New; open once; ``close`` after the intake.
    """

    def __init__(self, node: Node, settings: Settings, context: BagContext, recovery: BagRecovery,
                 types: MessageTypes) -> None:  # fmt: skip
        options, home = settings.events, settings.home
        ring = Ring(options.max_bytes, options.pre_s + NOTICE_S)
        self.events = Events(options, settings.bag, context, ring, recovery, POLL_S)
        self.consumer = EventConsumer(node, options, ring, self.events.claims) if options.enabled else None
        self._watch = self._make_watch(options, home, context, types)

    @property
    def consumers(self) -> Sequence[EventConsumer]:
        """The consumers for the intake; empty if nothing is kept."""
        return () if self.consumer is None else (self.consumer,)

    @property
    def workers(self) -> Sequence[Worker]:
        """The workers in use."""
        return *self.events.workers, *([self._watch.worker] if self._watch is not None else [])

    def open(self) -> None:
        self.events.open()
        if self._watch is not None:
            self._watch.open()

    def close(self, deadline_s: float) -> bool:
        """End the current event; False if that took too long."""
        end_s = time.monotonic() + deadline_s
        watched = self._watch is None or self._watch.close(deadline_s)
        return self.events.close(max(0.0, end_s - time.monotonic())) and watched

    def update(self, settings: EventSettings) -> None:
        """Apply the live part of other settings."""
        self.events.update(settings)
        if self._watch is not None:
            self._watch.update(settings.log_event)

    def on_mission(self, mission: MissionOf | None) -> None:
        """The active mission changed."""
        self.events.on_mission(mission)
        if self._watch is not None:
            self._watch.on_mission(mission)

    def _make_watch(self, options: EventSettings, home: Path, context: BagContext, types: MessageTypes) -> EventWatch | None:
        if self.consumer is None:
            return None
        return EventWatch(self.consumer.inbox, types, home, context.clock, options.log_event, self.events.trigger)
