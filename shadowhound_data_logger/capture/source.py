"""One sensor's way from its topic to closed batches: which topic, how to listen, what to keep. Owned by the intake thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Final
from zlib import crc32

from rclpy.node import Node

from shadowhound_data_logger.capture.batching import Batcher
from shadowhound_data_logger.capture.endpoints import Endpoint, Plan, Senders, plans
from shadowhound_data_logger.capture.gate import Gate, gate_for
from shadowhound_data_logger.capture.reader import PolledGroup, Reader, Taken, TypeUnavailable, endpoints, message_class
from shadowhound_data_logger.clock import is_sane
from shadowhound_data_logger.config import IntakeSettings, SensorSettings
from shadowhound_data_logger.encode.types import MessageTypes, header_stamp_ns
from shadowhound_data_logger.model import Batch, Sample
from shadowhound_data_logger.spool.accounts import Accounts

log = logging.getLogger(__name__)

FALLBACK_S: Final = 1.0
"""How long the preferred topic must be without a publisher before another one is taken."""
OVERLAP_S: Final = 0.5
"""How long the old subscription lives beside its successor, at least until that is matched."""
MAX_RECENT: Final = 10_000
"""Messages without numbers that are remembered, to know what a second subscription delivers again."""
Offer = Callable[[Batch], None]


class Source:
    """A sensor at work. ``refresh`` follows the graph, ``drain`` takes what came, ``close_batch`` ends the open batch."""

    def __init__(self, node: Node, sensor: SensorSettings, settings: IntakeSettings, accounts: Accounts,
                 types: MessageTypes, group: PolledGroup, offer: Offer) -> None:  # fmt: skip
        self.sensor = sensor
        self._node = node
        self._settings = settings
        self._accounts = accounts
        self._types = types
        self._group = group
        self._offer = offer
        self._topics: list[str] = [node.resolve_topic_name(topic) for topic in sensor.topics]
        self._types_expected = dict(zip(self._topics, sensor.types, strict=False))
        self._chosen = self._topics[0]
        self._absent_since_s: float | None = None
        self._type = ''
        self._readers: list[Reader] = []
        self._retiring: dict[Reader, float] = {}
        self._heard: set[Plan] = set()
        self._senders = Senders()
        self._has_header = False
        self._gate: Gate | None = None
        self._batcher: Batcher | None = None
        self._unavailable: set[str] = set()
        self._unheard: set[str] = set()
        self._recent: dict[tuple[int, int], None] = {}

    @property
    def topic(self) -> str:
        """The topic it listens to, or would."""
        return self._chosen

    def refresh(self, now_s: float) -> None:
        """Look at the graph and subscribe as its publishers ask for it."""
        publishers = self._choose(now_s)
        self._senders.look([publisher.gid for publisher in publishers])
        wanted = plans(self._chosen, publishers, self._types_expected.get(self._chosen), self._settings, self._type)
        self._warn_of_types(publishers, wanted)
        if not wanted or not self._is_available(wanted[0].type):
            return
        if wanted[0].type != self._type:
            self._retype(wanted[0].type)
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
        if self._batcher is not None and self._batcher.is_due(now_s, 2 * self._settings.poll_s):
            self._offer(self._batcher.close())

    def close_batch(self) -> None:
        """End the open batch, if there is one."""
        if self._batcher is not None and len(self._batcher):
            self._offer(self._batcher.close())

    def close(self, now_s: float) -> None:
        """Take what still waits, end the batch and the subscriptions."""
        self.drain(now_s)
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
            self._switch(best, now_s)
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
        if type_name in self._unavailable:
            return False
        try:
            message_class(type_name)
        except TypeUnavailable as error:
            self._unavailable.add(type_name)
            text = '%s: %s is not logged: its message package is not installed here (%s)'
            log.warning(text, self.sensor.name, self._chosen, error)
            return False
        return True

    def _switch(self, topic: str, now_s: float) -> None:
        """Leave the current topic for another one of the sensor's."""
        log.info('%s: taken from %s now instead of %s', self.sensor.name, topic, self._chosen)
        self.drain(now_s)
        self._leave(now_s)
        with self._accounts.entry(self._chosen) as account:
            for span in account.publishers.values():
                span.rebase()
        self._chosen = topic
        self._absent_since_s = None

    def _retype(self, type_name: str) -> None:
        """Gate and batch of a topic that is new, or of another type than before."""
        self._leave(0.0)
        topic = self._chosen
        self._type = type_name
        self._has_header = self._types.has_header(type_name)
        self._gate = gate_for(self.sensor, has_header=self._has_header, last_kept_ns=self._accounts.last_kept_ns(topic))
        self._batcher = Batcher(self.sensor.name, topic, type_name, round(self.sensor.batch_s * 1e9))
        with self._accounts.entry(topic) as account:
            account.type = type_name

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

    def _leave(self, now_s: float) -> None:
        """End all that belongs to the current topic and type."""
        for reader in self._readers:
            self._take(reader, now_s)
            reader.close()
        self.close_batch()
        self._readers.clear()
        self._retiring.clear()
        self._heard = set()
        self._type = ''

    # -- messages --------------------------------------------------------------------------------------------------

    def _take(self, reader: Reader, now_s: float) -> None:
        taken = list(reader.drain())
        if taken and self._batcher is not None:
            if taken[0].publisher is None and not self._senders.gids:
                self._senders.look([publisher.gid for publisher in endpoints(self._node, self._chosen)])
            for sample in self._keep(reader.plan.topic, taken):
                for batch in self._batcher.add(sample, now_s):
                    self._offer(batch)

    def _keep(self, topic: str, taken: Sequence[Taken]) -> list[Sample]:
        """Count the messages, drop repeats and choose those to store."""
        kept: list[Sample] = []
        gate = self._gate
        if gate is None:
            return kept
        with self._accounts.entry(topic) as account:
            for cdr, source_ns, gid, number in taken:
                publisher = gid or self._senders.name(number, source_ns)
                numbered = number is not None and publisher is not None
                if (not numbered and self._is_repeat(source_ns, cdr)) or not account.receive(publisher, number):
                    continue
                stamp_ns = header_stamp_ns(cdr) if self._has_header else 0
                if not is_sane(stamp_ns, source_ns):
                    stamp_ns = source_ns
                if gate.keep(stamp_ns, cdr):
                    kept.append(Sample(stamp_ns, cdr))
                else:
                    account.skipped += 1
        return kept

    def _is_repeat(self, source_ns: int, cdr: bytes) -> bool:
        """Whether a message without a number came by another of our subscriptions already: same time, same content."""
        mark = (source_ns, crc32(cdr))
        if mark in self._recent:
            return True
        self._recent[mark] = None
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return False
