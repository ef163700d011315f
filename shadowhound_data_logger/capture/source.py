"""One sensor's way from its topic to closed batches: which topic, and how to listen. Owned by the intake thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.capture.endpoints import Endpoint, Plan, Senders, plans
from shadowhound_data_logger.capture.reader import PolledGroup, Reader, endpoints, unavailable
from shadowhound_data_logger.capture.stream import AnyStream, Shared, Stream
from shadowhound_data_logger.config import IntakeSettings, SensorSettings

log = logging.getLogger(__name__)

MakeStream = Callable[[SensorSettings, str, str, int, Shared], AnyStream]
"""Of a topic and type, and the stamp of the newest message that was kept before."""

FALLBACK_S: Final = 1.0
"""How long the preferred topic must be without a publisher before another one is taken."""
OVERLAP_S: Final = 0.5
"""How long the old subscription lives beside its successor, at least until that is matched."""


@dataclass(frozen=True, slots=True)
class SourceStatus:
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


class Source:
    """A sensor at work. ``refresh`` follows the graph, ``drain`` takes what came, ``flush`` ends the open batch as well."""

    def __init__(self, node: Node, sensor: SensorSettings, settings: IntakeSettings, group: PolledGroup,
                 shared: Shared, make_stream: MakeStream = Stream) -> None:  # fmt: skip
        self.sensor = sensor
        self._node = node
        self._settings = settings
        self._accounts = shared.accounts
        self._types = shared.types
        self._group = group
        self._shared = shared
        self._make_stream = make_stream
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
        self._readers: list[Reader] = []
        self._retiring: dict[Reader, float] = {}
        self._heard: set[Plan] = set()
        self._senders = Senders()
        self._stream: AnyStream | None = None
        self._kept_ns: dict[str, int] = {}
        self._paused = False
        self._idle = False
        self._last_received_s: float | None = None
        self._unavailable = ''
        self._unheard: set[str] = set()

    @property
    def topic(self) -> str:
        """The topic it listens to, or would."""
        return self._chosen

    def status(self) -> SourceStatus:
        """From any thread: each of its figures is replaced as a whole."""
        return SourceStatus(self.sensor.name, self._chosen, self.sensor.enabled, self._publishers, self._last_received_s,
                            self._matched, self.sensor.on_change or self.is_latched, self._unavailable)  # fmt: skip

    def refresh(self, now_s: float) -> None:
        """Look at the graph and subscribe as its publishers ask for it."""
        if not self.sensor.enabled:
            return
        publishers = self._choose(now_s)
        self._publishers = len(publishers)
        self._matched = max((reader.matched() for reader in self._readers), default=0)
        if publishers:
            self.is_latched = all(publisher.transient_local for publisher in publishers)
            self.has_latched = any(publisher.transient_local for publisher in publishers)
        self._senders.look([publisher.gid for publisher in publishers])
        wanted = plans(self._chosen, publishers, self._types_expected.get(self._chosen), self._settings, self._type)
        self._warn_of_types(publishers, wanted)
        if not wanted or not self._is_available(wanted[0].type):
            return
        if wanted[0].type != self._type:
            self._retype(wanted[0].type, now_s)
        present = {reader.plan for reader in self._readers}
        for plan in wanted:
            if plan not in present:
                self._readers.append(Reader(self._node, plan, self._group))
        if publishers and set(wanted) != self._heard:
            self._heard = set(wanted)
            log.info('%s: %s', self.sensor.name, ' and '.join(plan.describe() for plan in wanted))
        self._retire(set(wanted), now_s)

    def drain(self, now_s: float) -> None:
        """Take all that waits; close the batch whose time is over."""
        for reader in self._readers:
            self._take(reader, now_s)
        if self._stream is not None:
            self._stream.close_due(now_s, 2 * self._settings.poll_s)

    def flush(self, now_s: float) -> None:
        """Take all that waits and end the open batch."""
        self.drain(now_s)
        if self._stream is not None:
            self._stream.close_batch()

    def pause(self, now_s: float, *, paused: bool) -> None:
        """While it is paused messages are counted and dropped; whatever came before is treated as before."""
        self.flush(now_s)
        self._paused = paused

    def idle(self, now_s: float, *, idle: bool) -> None:
        """While nobody wants its data messages are counted and skipped; whatever came before is treated as before."""
        self.flush(now_s)
        self._idle = idle

    def update(self, sensor: SensorSettings, now_s: float) -> None:
        """Go on by other settings."""
        before, self.sensor = self.sensor, sensor
        if before.enabled and not sensor.enabled:
            self._abandon(now_s)
            self._publishers = 0
        elif sensor.enabled and not before.enabled:
            self._accounts.rebase(self._chosen)
        elif self._stream is not None:
            self._stream.update(sensor)

    def close(self, now_s: float) -> None:
        """Take what still waits, end the batch and the subscriptions."""
        self._leave(now_s)

    # -- the graph -------------------------------------------------------------------------------------------------

    def _choose(self, now_s: float) -> list[Endpoint]:
        """Publishers of the topic to listen to: the preferred one at once, another after a while without it."""
        found = {topic: endpoints(self._node, topic) for topic in self._topics}
        best = next((topic for topic in self._topics if found[topic]), self._chosen)
        if best == self._chosen or found[self._chosen]:
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

    def _warn_of_types(self, publishers: Sequence[Endpoint], wanted: Sequence[Plan]) -> None:
        """Say once which types of a topic with several are not heard."""
        others = {publisher.type for publisher in publishers} - {plan.type for plan in wanted} - self._unheard
        if others:
            self._unheard |= others
            text = '%s: %s is published with several types; %s is logged, not %s'
            log.warning(text, self.sensor.name, self._chosen, wanted[0].type, ', '.join(sorted(others)))

    def _is_available(self, type_name: str) -> bool:
        """Whether messages of the type can be received here; asked before anything is begun or counted for them."""
        self._unavailable = unavailable(type_name)
        if self._unavailable and type_name not in self._unheard:
            self._unheard.add(type_name)
            log.warning('%s: %s is not logged: %s', self.sensor.name, self._chosen, self._unavailable)
        return not self._unavailable

    def _retype(self, type_name: str, now_s: float) -> None:
        """Begin with a topic that is new, or of another type than before."""
        self._leave(now_s)
        topic = self._chosen
        kept_ns = self._kept_ns.get(topic) or self._accounts.last_kept_ns(topic)
        self._stream = self._make_stream(self.sensor, topic, type_name, kept_ns, self._shared)
        self._type = type_name

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
        self._accounts.rebase(self._chosen)

    def _leave(self, now_s: float) -> None:
        """End all that belongs to the current topic and type, each whatever happens to the others."""
        with ExitStack() as leaving:
            leaving.callback(self._forget)
            for reader in self._readers:
                leaving.callback(reader.close)
                leaving.callback(self._take, reader, now_s)

    def _forget(self) -> None:
        if self._stream is not None:
            self._stream.close_batch()
            self._kept_ns[self._chosen] = self._stream.kept_ns
        self._stream = None
        self._readers.clear()
        self._retiring.clear()
        self._heard = set()
        self._type = ''

    # -- messages --------------------------------------------------------------------------------------------------

    def _take(self, reader: Reader, now_s: float) -> None:
        taken = list(reader.drain())
        if not taken or self._stream is None:
            return
        self._last_received_s = now_s
        lost: int | None = None
        if taken[0].number is None:
            lost = self._lost(reader)
        elif taken[0].publisher is None and not self._senders.gids:
            self._senders.look([publisher.gid for publisher in endpoints(self._node, self._chosen)])
        self._stream.add(taken, self._senders, lost, now_s, paused=self._paused, idle=self._idle)

    def _lost(self, reader: Reader) -> int | None:
        """What the middleware reports to have lost; None where that cannot be known.

        What one of two subscriptions lost the other one may have received. While it is not known yet which one is wanted,
        nobody is asked: the wanted one tells it later.
        """
        if self._heard == {reader.plan}:
            return reader.lost()
        return None if len(self._heard) > 1 else 0
