"""The messages of one topic and type on their way: counted, thinned out, batched. Plain Python, owned by the intake thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple
from zlib import crc32

from shadowhound_data_logger.capture.batching import Batcher
from shadowhound_data_logger.capture.endpoints import Senders
from shadowhound_data_logger.capture.gate import gate_for
from shadowhound_data_logger.clock import Clock, stamp_of
from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.encode.types import MessageTypes, header_stamp_ns
from shadowhound_data_logger.model import Batch, Sample
from shadowhound_data_logger.spool.accounts import EXACT, PAUSED, Accounts

MAX_RECENT: Final = 10_000
"""Messages without a sender's gid that are remembered, to know what a second subscription delivers again."""
Offer = Callable[[Batch], None]


class Taken(NamedTuple):
    """A serialized message with what the middleware knows of it; None where it does not say."""

    cdr: bytes
    source_ns: int
    publisher: str | None
    number: int | None


class Shared(NamedTuple):
    """What all streams work with."""

    accounts: Accounts
    types: MessageTypes
    offer: Offer
    clock: Clock


class Stream:
    """New for each topic and type; ``add`` what was taken, ``close_batch`` at the end."""

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, last_kept_ns: int, shared: Shared) -> None:
        self._clock = shared.clock
        self.kept_ns = last_kept_ns
        """Stamp of the newest message that was kept: no period is stored twice."""
        self._topic = topic
        self._accounts = shared.accounts
        self._offer = shared.offer
        self._sensor = sensor
        self._has_header = shared.types.has_header(type_name)
        self._gate = gate_for(sensor, has_header=self._has_header, last_kept_ns=last_kept_ns)
        self._batcher = Batcher(sensor, topic, type_name)
        self._recent: dict[tuple[int, int], None] = {}
        with shared.accounts.entry(topic) as account:
            account.type = type_name

    def update(self, sensor: SensorSettings) -> None:
        """Go on by other settings; the open batch stays."""
        if sensor.rate_hz != self._sensor.rate_hz and not sensor.on_change:
            self._gate = gate_for(sensor, has_header=self._has_header, last_kept_ns=self.kept_ns)
        self._sensor = sensor

    def add(self, taken: Sequence[Taken], senders: Senders, lost: int | None, now_s: float, *, paused: bool,
            idle: bool = False) -> None:  # fmt: skip
        """Take messages in the order in which they came.

        ``lost`` is what the middleware reports to have lost since the last time, None where it reports nothing.
        While ``paused`` they are counted as dropped, while ``idle`` (nobody asked for them) as skipped.
        """
        for sample in self._keep(taken, senders, lost, paused=paused, idle=idle):
            for batch in self._batcher.add(sample, now_s):
                self._offer(batch)

    def close_due(self, now_s: float, grace_s: float) -> None:
        """End the batch whose time is over, though no message of the next one came."""
        if self._batcher.is_due(now_s, grace_s):
            self._offer(self._batcher.close())

    def close_batch(self) -> None:
        """End the open batch, if there is one."""
        if len(self._batcher):
            self._offer(self._batcher.close())

    def _keep(self, taken: Sequence[Taken], senders: Senders, lost: int | None, *, paused: bool, idle: bool) -> list[Sample]:
        """Count the messages, drop repeats and choose those to store."""
        kept: list[Sample] = []
        keep = self._gate.keep
        with self._accounts.entry(self._topic) as account:
            for cdr, source_ns, gid, number in taken:
                publisher = gid or senders.name(number, source_ns)
                is_named = gid is not None and number is not None and account.accounting == EXACT
                if not is_named and self._is_repeat(source_ns, crc32(cdr) if number is None else number):
                    continue
                if not account.receive(publisher, number, reported=lost is not None):
                    continue
                if paused:
                    account.dropped[PAUSED] += 1
                    continue
                if idle:
                    account.skipped += 1
                    continue
                stamp_ns = stamp_of(header_stamp_ns(cdr) if self._has_header else 0, source_ns, self._clock)
                if keep(stamp_ns, cdr):
                    self.kept_ns = stamp_ns
                    kept.append(Sample(stamp_ns, cdr))
                else:
                    account.skipped += 1
            account.lose(lost)
        return kept

    def _is_repeat(self, source_ns: int, which: int) -> bool:
        """Whether a message came by another of our subscriptions already: sent at the same time, same number or content.

        Asked also while the graph knows one sender, whose name the middleware does not give: a second one may appear.
        """
        mark = (source_ns, which)
        if mark in self._recent:
            return True
        self._recent[mark] = None
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return False
