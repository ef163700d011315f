"""Topics of the table that are not read otherwise, sampled in turn: rate, mean size and age. Importing this loads rclpy.

There are at most two subscriptions at a time, each for about two seconds: shorter for many or large messages, longer for few.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any, Final

from rclpy.node import Node

from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.live.kinds import LiveItem
from shadowhound_data_logger.ros.endpoints import LARGE_TYPES, Plan
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, SubscriptionRefused, TypeUnavailable, endpoints, unavailable
from shadowhound_data_logger.ros.type_descriptions import TypeDescriptions

AT_ONCE: Final = 2
START_S: Final = 0.5
"""Minimum interval between the starts of two samples."""
AGAIN_S: Final = 5.0
"""Minimum interval between two samples of a topic."""
SAMPLE_S: Final = 2.0
SILENT_S: Final = 3.0
"""Duration without a message: on a busy machine a publisher may match the subscription a second late."""
HEARD_SILENT_S: Final = 6.0
"""The same for a topic with earlier messages: it may match three seconds late, and one at 1 Hz would be shown as silent."""
SLOW_S: Final = 3.5
"""Duration after the first message while fewer than ``FEW`` have arrived: a topic at 0.5 Hz sends two."""
FEW: Final = 3
ENOUGH, ENOUGH_S = 100, 0.5
"""A sample with this many messages ends after this time."""
ENOUGH_BYTES, ENOUGH_LARGE = 4 << 20, 5
"""A sample with this many bytes ends with this many messages."""
DEPTH, LARGE_DEPTH = 128, 8
BURST_S: Final = 0.1
"""How late the last message of a steady stream may be seen."""
MAX_KNOWN: Final = 4000
"""Maximum topics whose newest message is remembered."""


class _Sample:
    """One subscription to a topic, for a short time."""

    def __init__(self, node: Node, topic: str, type_name: str, *, is_first: bool) -> None:
        """The first sample also receives what latched publishers keep. Raises TypeUnavailable or SubscriptionRefused."""
        offered = endpoints(node, topic)
        self.is_latched = bool(offered) and all(each.reliable and each.transient_local for each in offered)
        keeps = self.is_latched and is_first
        self._silent_s = SILENT_S if is_first or self.is_latched else HEARD_SILENT_S
        depth = LARGE_DEPTH if type_name in LARGE_TYPES else DEPTH
        self._began_s, self._began_ns = time.monotonic(), time.time_ns()
        self._reader = Reader(node, Plan(topic, type_name, reliable=keeps, transient_local=keeps, depth=depth), PolledGroup())
        self._arrivals: list[int] = []
        self._sizes: list[int] = []
        self._newest_ns = 0

    def drain(self) -> None:
        for one in self._reader.drain():
            self._sizes.append(len(one.cdr))
            is_kept = self.is_latched and one.source_ns < self._began_ns  # it says nothing about the rate
            if not is_kept:
                self._arrivals.append(one.received_ns)
            self._newest_ns = max(self._newest_ns, one.source_ns if is_kept else one.received_ns)

    def is_complete(self, now_s: float) -> bool:
        took_s, count = now_s - self._began_s, len(self._arrivals)
        if not count:
            return took_s >= self._silent_s
        return (
            (took_s >= SAMPLE_S and (count >= FEW or (time.time_ns() - self._arrivals[0]) / 1e9 >= SLOW_S))
            or (took_s >= ENOUGH_S and count >= ENOUGH)
            or (count >= ENOUGH_LARGE and sum(self._sizes) >= ENOUGH_BYTES)
        )

    @property
    def hz(self) -> float | None:
        """The rate; None with fewer than two messages."""
        count = len(self._arrivals)
        if count < 2:
            return None
        first, last, now_ns = self._arrivals[0], self._arrivals[-1], time.time_ns()
        span_s = (last - first) / 1e9
        if (now_ns - last) / 1e9 > BURST_S + 3 * span_s / (count - 1):
            span_s = (now_ns - first) / 1e9
        return round((count - 1) / max(span_s, 1e-3), 2)

    def figures(self, now_s: float) -> dict[str, Any]:
        return {'seconds': round(now_s - self._began_s, 1), 'messages': len(self._arrivals), 'hz': self.hz,
                'latched': self.is_latched}  # fmt: skip

    def newest(self, now_s: float) -> tuple[int, float] | None:
        """Mean size, and when the newest message arrived (monotonic) or was sent, if it was kept; None without messages."""
        if not self._sizes:
            return None
        return round(sum(self._sizes) / len(self._sizes)), now_s - max(0.0, (time.time_ns() - self._newest_ns) / 1e9)

    def close(self) -> None:
        self._reader.close()


class Sampler:
    """Samples the topics that viewers need. New; ``follow``, ``read`` and ``start`` repeatedly, one at a time; close once."""

    def __init__(self, node: Node, descriptions: TypeDescriptions) -> None:
        self._node, self._descriptions = node, descriptions
        self._wanted: Mapping[str, str] = {}
        self._samples: dict[str, _Sample] = {}
        self._ended_s: dict[str, float] = {}
        self._newest: dict[str, tuple[int, float]] = {}
        self._start_s = 0.0

    def follow(self, wanted: Mapping[str, str]) -> None:
        """The topics to sample, with their types. Ends all other samples."""
        self._wanted = wanted
        for topic in self._samples.keys() - wanted.keys():
            self._samples.pop(topic).close()

    def read(self, now_s: float) -> list[LiveItem]:
        """Read the current samples; returns those that are complete."""
        items = []
        for topic, sample in list(self._samples.items()):
            sample.drain()
            if sample.is_complete(now_s):
                self._samples.pop(topic).close()
                items.append(self._ended(topic, now_s, sample.figures(now_s), sample.newest(now_s)))
        return items

    def is_due(self, now_s: float) -> bool:
        """Whether to start the next sample."""
        return bool(self._wanted) and len(self._samples) < AT_ONCE and now_s >= self._start_s

    def start(self, now_s: float) -> list[LiveItem]:
        """Start the next sample: of the topic whose last sample is the oldest. Returns why it cannot be sampled."""
        self._start_s = now_s + START_S
        ended_s = {topic: self._ended_s.get(topic, -math.inf) for topic in self._wanted if topic not in self._samples}
        topic = min(ended_s, key=ended_s.__getitem__, default='')
        if topic and now_s - ended_s[topic] >= AGAIN_S:
            is_first, type_name = topic not in self._newest, self._wanted[topic]
            try:
                self._samples[topic] = _Sample(self._node, topic, type_name, is_first=is_first)
            except (TypeUnavailable, SubscriptionRefused) as error:
                if not unavailable(type_name) or not self._descriptions.poll(topic, type_name, now_s):
                    return [self._ended(topic, now_s, {'why': visible(str(error))[:300]}, None)]
                # Its publisher may answer until the next start.
        return []

    def _ended(self, topic: str, now_s: float, figures: Mapping[str, Any], newest: tuple[int, float] | None) -> LiveItem:
        for known in (self._ended_s, self._newest):
            if len(known) >= MAX_KNOWN:
                known.clear()
        self._ended_s[topic] = now_s
        if newest is not None:
            self._newest[topic] = newest
        size, newest_s = self._newest.get(topic, (None, None))
        head = {'at': round(now_s * 1e3, 1), 'of': topic, 'bytes': size,
                'age_s': None if newest_s is None else round(now_s - newest_s, 3), **figures}  # fmt: skip
        return LiveItem('', 'sample', head=head)

    def close(self) -> None:
        self.follow({})
