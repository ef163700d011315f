"""Evaluates the rules that uploads wait for (``upload.when`` and others) from messages, network, time and mission."""

from __future__ import annotations

import array
import fcntl
import logging
import socket
import struct
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import EVENTS_WHEN, UPLOAD_WHEN, Taken
from shadowhound_data_logger.core.options import EventSettings
from shadowhound_data_logger.core.rules import Rule, read_rule
from shadowhound_data_logger.core.status import MissionStatus
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained, TopicChoice
from shadowhound_data_logger.node.recording.bags import profiles_offered
from shadowhound_data_logger.node.recording.mission_observer import number_at

log = logging.getLogger(__name__)

STALE_S: Final = 60.0
"""A value becomes unknown after this long without a message, unless its publisher is latched and present."""
KEEP_WHEN: Final = 'keep.when'
INTERFACES: Final = Path('/sys/class/net')
SSID_BYTES: Final = 32
"""IEEE 802.11-2020, 9.4.2.2."""
_SIOCGIWESSID: Final = 0x8B1B
"""linux/wireless.h: reads the SSID of an interface, without special rights."""


class NewestMessages(Consumer):
    """Keeps the newest message of each topic used in rules. ``take`` by the intake, the rest by any thread."""

    def __init__(self, topics: Collection[str]) -> None:
        """Full names, at least one."""
        self.wanted_topics = TopicChoice(EventSettings(), topics)
        self.newest: dict[str, tuple[str, Taken, float]] = {}
        """Topic -> type, message, and time of the drain by the monotonic clock."""

    def take(self, drained: Drained) -> None:
        self.newest[drained.topic] = drained.type, drained.messages[-1], drained.now_s


class UploadRules:
    """Reports once per second which rules are not true, and why.

    New; ``poll`` on the main thread.
    """

    def __init__(self, node: Node, settings: Settings, types: MessageTypes, clock: ClockWatch,
                 mission: Callable[[], MissionStatus]) -> None:  # fmt: skip
        """``mission`` returns the active mission (``MissionWatch.status``)."""
        texts = {UPLOAD_WHEN: settings.upload.when, EVENTS_WHEN: settings.events.when, KEEP_WHEN: settings.keep.when}
        read = {name: read_rule(text, name) for name, text in texts.items()}
        self._rules: dict[str, Rule] = {name: rule for name, rule in read.items() if rule is not None}
        self._node = node
        self._types = types
        self._clock = clock
        self._mission = mission
        topics = {node.resolve_topic_name(topic) for rule in self._rules.values() for topic in rule.topics()}
        self._messages = NewestMessages(topics) if topics else None
        self._closed: Mapping[str, str] = dict.fromkeys(self._rules, 'it has not been evaluated yet')
        self._unpublished_since_s: dict[str, float] = {}
        self.stuck: Mapping[str, str] = {}
        """Rules that are not true because their topics have had no publisher for a while: what to do. Replaced atomically."""

    @property
    def consumers(self) -> Sequence[Consumer]:
        """The consumers for the intake; empty if no rule uses a topic."""
        return () if self._messages is None else (self._messages,)

    @property
    def closed(self) -> Mapping[str, str]:
        """The rules that are not true: why. Initially all, because nothing is known."""
        return self._closed

    def poll(self) -> Mapping[str, str]:
        """Evaluate the rules; returns ``closed``."""
        now_s, closed = time.monotonic(), {}
        for name, rule in self._rules.items():
            holds, why = rule.evaluate(self, now_s)
            if not holds:
                closed[name] = why
            if holds is (name in self._closed):
                log.info('%s %s: %s', name, 'holds' if holds else 'is not true', why)
        self._closed = closed
        stuck = {name: text for name in closed if (text := self._stuck(name, now_s))}
        for name, text in stuck.items():
            if self.stuck.get(name) != text:
                log.warning('%s', text)
        self.stuck = stuck
        return closed

    def _stuck(self, rule: str, now_s: float) -> str:
        """Why a rule can never become true: its topics had no publisher for ``STALE_S``; empty if it can."""
        topics = sorted(map(self._node.resolve_topic_name, self._rules[rule].topics()))
        for topic in topics:
            if self._node.count_publishers(topic):
                self._unpublished_since_s.pop(topic, None)
        silent = [topic for topic in topics if now_s - self._unpublished_since_s.setdefault(topic, now_s) >= STALE_S]
        if not silent:
            return ''
        return f'{rule} waits for {", ".join(silent)}, which nobody publishes: start what publishes it, or change {rule}'

    # -- the facts of rules ------------------------------------------------------------------------------------------

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        full = self._node.resolve_topic_name(topic)
        found = self._messages.newest.get(full) if self._messages is not None else None
        if found is None:
            return f'no message of {full} was received yet'
        type_name, message, received_s = found
        offered = profiles_offered(self._node, full, type_name)
        age_s = time.monotonic() - received_s
        if not offered:
            return f'{full} is no longer published'
        if age_s > STALE_S and not any(int(each.durability) == int(DurabilityPolicy.TRANSIENT_LOCAL) for each in offered):
            return f'no message of {full} for {age_s:.0f} s'
        try:
            value = number_at(self._types.deserialize(type_name, message.cdr), list(path))
        except Rejected as error:
            return f'{full} cannot be read: {error}'
        return value if value is not None else f'{type_name} has no number {".".join(path)}'

    def networks(self) -> Collection[str] | str:
        return wifi_networks()

    def minute(self) -> int | str:
        if not self._clock.is_set:
            return 'the clock of this machine is not set'
        local = time.localtime(self._clock.wall_ns() // SECOND)
        return 60 * local.tm_hour + local.tm_min

    def mission(self) -> str | None:
        active = self._mission()
        return active.type if active else None


def wifi_networks(interfaces: Path = INTERFACES, ask: Callable[..., Any] = fcntl.ioctl) -> Collection[str] | str:
    """Names of the WiFi networks that this machine is connected to; a text with the reason if they are unknown.

    Uses wireless extensions, which the kernel also offers for cfg80211 (CONFIG_CFG80211_WEXT); no special rights are needed.
    """
    try:
        names = sorted(path.name for path in interfaces.iterdir() if (path / 'wireless').is_dir() or (path / 'phy80211').exists())
    except OSError as error:
        return f'{interfaces} cannot be read: {error.strerror}'
    found, failed = set(), ''
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as asked:
        for name in names:
            essid = array.array('B', bytes(SSID_BYTES + 1))
            request = array.array('B', struct.pack('16sPHH', name.encode()[:15], essid.buffer_info()[0], len(essid), 0))
            try:
                ask(asked.fileno(), _SIOCGIWESSID, request, True)
            except OSError as error:
                failed = f'the system does not report the network of {name}: {error.strerror}'
            else:
                found.add(essid.tobytes()[:SSID_BYTES].rstrip(b'\0').decode('utf-8', 'replace'))
    return failed if failed and not found else found - {''}
