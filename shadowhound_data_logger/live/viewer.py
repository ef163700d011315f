"""What is sent to one browser, in which order, and never more than its link can carry.

A frame of the WebSocket has parts of items (``kinds.LiveItem.packed``): complete small ones on lane 0, then at most one part of a
large one. Each is a byte with its lane, a byte of flags (1: an item starts, 2: it ends), two unused bytes, a uint32 with its
length, and that many bytes. Each browser reports how many bytes of frames it has received, as a uint32 that wraps: after 2 KB or
more, once for everything that arrived together. At most a window of bytes is in flight; what waits is small, or the newest of its
topic.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from shadowhound_data_logger.live.kinds import FULL, HALF, SIZES, SMALLEST, LiveItem
from shadowhound_data_logger.live.panels import BULK

MIN_QUEUE, MAX_QUEUE = 12 << 10, 160 << 10
"""Bytes that may be queued on the link, in addition to those in flight."""
QUEUE_S: Final = 0.04
"""Duration of the queue, within these bounds."""
MIN_CHUNK, MAX_CHUNK = 4 << 10, 256 << 10
"""Size of a part of a large item: on a slow link small items wait for a smaller one."""
CHUNK_S: Final = QUEUE_S / 3
SMALL_FRAME: Final = 4 << 10
"""Size of the small items in a frame; the next frame has the rest."""
SMALL_ROOM: Final = 8 << 10
"""Small items may exceed the window by this much: they do not wait for the acknowledgment of a large one."""
MAX_ROWS_WAITING: Final = 12
"""Items of a series, each of some 33 ms; older ones are dropped."""
SMALL_LANE: Final = 0
PART: Final = struct.Struct('<BB2xI')
"""The head of a part: lane, flags, length."""
OWN: Final = frozenset({'', 'figures', 'topics'})
"""Slots of items that every viewer gets."""
ACKNOWLEDGED: Final = 2 << 10
"""Minimum bytes before a browser acknowledges again."""
BEGIN, END = 1, 2
WEIGHTS: Final[Mapping[str, float]] = {
    'figures': 4.0, 'camera': 4.0, 'cloud': 1.0, 'topics': 1.0, 'message': 1.0, **dict.fromkeys(BULK, 1.0)
}  # fmt: skip
"""Weights of bulk topics on a link."""
MIN_MEASURED: Final = 4 << 10
"""Minimum size of an item for measuring the link."""
CAMERA_SHARE, CAMERA_HZ = 0.7, 8.0
CLOUD_SHARE, CLOUD_HZ = 0.2, 2.0
SMALLER: Final = {FULL: 1.0, HALF: 0.25, SMALLEST: 0.07}
"""Approximate relative size of the smaller sizes."""
UP: Final = 1.6
"""How much better than required the link must be before a larger size is sent."""
FIRST_RATE: Final = 500_000.0
"""Assumed rate of a link before it is measured, bytes per second."""
MAX_RATE: Final = 3e6
"""Maximum rate for filling a round trip, bytes per second: more than a robot shows. A link that becomes slower delivers these
first.
"""
MAX_ROUND_S: Final = 0.3

BESIDE_VIDEO: Final = 0.15
"""Share of the link for clouds while video has a separate connection."""


class _Lane:
    """A bulk item being sent."""

    __slots__ = ('at', 'body', 'number')

    def __init__(self, number: int, body: bytes) -> None:
        self.number, self.body, self.at = number, memoryview(body), 0


class Viewer:
    """Decides what one browser is sent, and when. Used by the event loop only.

    ``offer`` new items, ``acknowledge`` the browser's reports, and after either call ``next_frame`` until it is None.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.watched: frozenset[str] = frozenset()
        self.rate = FIRST_RATE
        """Measured rate of the link, bytes per second."""
        self.replaced = 0
        """Bulk items that were replaced by newer ones before they were sent."""
        self.has_video = False
        """Whether it gets its camera as separate video: bulk items are then paced, and do not measure the link."""
        self.round_s = 0.0
        """The round trip with an empty queue; 0 if unknown."""
        self._now = now
        self._rows: dict[str, deque[LiveItem]] = {}
        self._slots: dict[str, LiveItem] = {}
        self._lanes: dict[str, _Lane] = {}
        self._used: dict[str, float] = {}
        self._virtual = 0.0  # start-time fair queueing: Goyal, Vin, Cheng, SIGCOMM 1996
        self._kinds: dict[str, str] = {}
        self._sizes: dict[str, int] = {}
        self._bytes: dict[str, int] = {}
        self._sent = self._acked = 0
        self._measured: deque[tuple[int, int, int, float]] = deque()  # end of an item; at its start: sent, acknowledged, time
        self._bulk_s = 0.0  # when bulk items may be sent again, next to video

    def watch(self, topics: Iterable[str]) -> None:
        """Send only these topics from now on."""
        self.watched = frozenset(topics)
        for waiting in (self._rows, self._slots):
            for topic in [topic for topic in waiting if topic not in OWN and topic not in self.watched]:
                del waiting[topic]

    def size(self, topic: str) -> int:
        """The size of a bulk topic for this browser."""
        return self._sizes.get(topic, FULL)

    def offer(self, item: LiveItem) -> None:
        """Send it when there is room; a newer item of a bulk topic replaces it."""
        if item.kind in WEIGHTS:
            slot = item.topic or item.kind
            self._kinds[slot] = item.kind
            self._bytes[slot] = round(len(item.packed) / SMALLER[item.size])
            self.replaced += slot in self._slots
            self._slots[slot] = item
        else:
            self._rows.setdefault(item.topic, deque(maxlen=MAX_ROWS_WAITING)).append(item)

    @property
    def is_waiting(self) -> bool:
        """Whether something has not been sent yet."""
        return bool(self._rows or self._slots or self._lanes)

    @property
    def window(self) -> int:
        """Bytes that may be sent without acknowledgment: a full round trip, and a short queue."""
        rate = self._share
        queue = min(max(rate * QUEUE_S, MIN_QUEUE), MAX_QUEUE)
        return int(queue + min(rate, MAX_RATE) * min(self.round_s, MAX_ROUND_S))

    @property
    def _share(self) -> float:
        """The share of the link for this connection, bytes per second."""
        return self.rate * (BESIDE_VIDEO if self.has_video else 1.0)

    def next_frame(self) -> bytes | None:
        """The next frame; None if nothing waits or may be sent."""
        under_way, window = self._sent - self._acked, self.window
        if under_way >= window + SMALL_ROOM:
            return None
        parts = self._small()
        is_videos_turn = self.has_video and self._now() < self._bulk_s
        if under_way < window and not is_videos_turn:
            parts += self._bulk(sum(map(len, parts)))
        if not parts:
            return None
        frame = b''.join(parts)
        self._sent += len(frame)
        return frame

    def acknowledge(self, received: int) -> None:
        """The browser has received this many bytes, modulo 2^32. Impossible numbers are ignored."""
        received = self._sent - ((self._sent - received) & 0xFFFF_FFFF)
        if self._acked < received <= self._sent:
            self._acked = received
            while self._measured and self._measured[0][0] <= received:
                _, begin, before, since_s = self._measured.popleft()
                # The link carries at least what was acknowledged in that time, and at least what was sent in that time minus the
                # round trip: the latter is more if it had been idle. The mean is over times, not rates: one item that a buffer
                # accepted immediately means little.
                took_s = max(self._now() - since_s, 1e-4)
                pace = min(took_s / (received - before), max(took_s - self.round_s, 1e-4) / (received - begin))
                self.rate = 1 / (0.7 / self.rate + 0.3 * max(pace, 1e-8))

    def choose_sizes(self) -> None:
        """Choose sizes for the current link; called once per second."""
        for topic, kind in self._kinds.items():
            if kind not in ('camera', 'cloud'):
                continue
            share, hz = (CAMERA_SHARE, CAMERA_HZ) if kind == 'camera' else (CLOUD_SHARE, CLOUD_HZ)
            room, now = self.rate * share / hz, self.size(topic)
            fitting = [size for size in SIZES if self._bytes[topic] * SMALLER[size] * (UP if size < now else 1.0) <= room]
            self._sizes[topic] = min(fitting, default=SMALLEST)

    def _small(self) -> list[bytes | memoryview]:
        """From each topic in turn the item that has waited longest."""
        parts: list[bytes | memoryview] = []
        size = 0
        while self._rows and size < SMALL_FRAME:
            topic = next(iter(self._rows))
            rows = self._rows.pop(topic)
            packed = rows.popleft().packed
            parts += PART.pack(SMALL_LANE, BEGIN | END, len(packed)), packed
            size += PART.size + len(packed)
            if rows:
                self._rows[topic] = rows  # the others have their turn first
        return parts

    def _bulk(self, ahead: int) -> list[bytes | memoryview]:
        """A part of the bulk item whose turn it is; ``ahead``: bytes before it in the frame."""
        waiting = {*self._slots, *self._lanes}
        if not waiting:
            return []
        topic = min(waiting, key=lambda name: (max(self._used.get(name, 0.0), self._virtual), name))
        lane = self._lanes.get(topic)
        flags = 0
        if lane is None:
            body = self._slots.pop(topic).packed
            lane = self._lanes[topic] = _Lane(self._free_lane(), body)
            flags = BEGIN
            if len(body) >= MIN_MEASURED and not self.has_video:
                self._measured.append((self._sent + ahead + len(body), self._sent, self._acked, self._now()))
        part = lane.body[lane.at : lane.at + int(min(max(self._share * CHUNK_S, MIN_CHUNK), MAX_CHUNK))]
        lane.at += len(part)
        self._bulk_s = max(self._bulk_s, self._now()) + len(part) / self._share if self.has_video else 0.0
        self._virtual = max(self._used.get(topic, 0.0), self._virtual)
        self._used[topic] = self._virtual + len(part) / WEIGHTS[self._kinds[topic]]
        if lane.at >= len(lane.body):
            flags |= END
            del self._lanes[topic]
        return [PART.pack(lane.number, flags, len(part)), part]

    def _free_lane(self) -> int:
        taken = {lane.number for lane in self._lanes.values()}
        return next(number for number in range(1, 256) if number not in taken)
