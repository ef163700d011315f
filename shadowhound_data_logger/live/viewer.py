"""What one browser gets, in which order, and never more than it can take.

A frame of the WebSocket is a byte with its lane, a byte of flags (1: an item begins, 2: it ends), two of nothing, and a part of
an item (``kinds.LiveItem.packed``); on lane 0 it is several whole items, each after a uint32 with its length. Each browser says
how many bytes of frames it has received, as a uint32 that wraps: after 2 KB or more, once for all that came at once. No more than
a window of them is under way; what waits is small, or the newest of its topic.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from shadowhound_data_logger.live.kinds import FULL, HALF, SIZES, SMALLEST, LiveItem
from shadowhound_data_logger.live.panels import BULK

MIN_QUEUE, MAX_QUEUE = 12 << 10, 160 << 10
"""Bytes that may be queued on the link, besides those in flight."""
QUEUE_S: Final = 0.04
"""What is queued lasts so long, within these bounds."""
MIN_CHUNK, MAX_CHUNK = 4 << 10, 64 << 10
"""Bytes of a frame with a part of a large item: on a slow link small items wait for a smaller one."""
CHUNK_S: Final = QUEUE_S / 3
SMALL_FRAME: Final = 4 << 10
"""Bytes of a frame with small items, from which on the next has the rest."""
SMALL_ROOM: Final = 8 << 10
"""Small items may exceed the window by so much: they do not wait for a large one to be acknowledged."""
MAX_ROWS_WAITING: Final = 12
"""Items of a series, each of some 33 ms; older ones are left out."""
SMALL_LANE: Final = 0
OWN: Final = frozenset({'', 'figures', 'topics'})
"""Slots of what every viewer gets, whatever it watches."""
ACKNOWLEDGED: Final = 2 << 10
"""Bytes, at least, before a browser says so again."""
BEGIN, END = 1, 2
WEIGHTS: Final[Mapping[str, float]] = {
    'figures': 4.0, 'camera': 4.0, 'cloud': 1.0, 'topics': 1.0, 'message': 1.0, **dict.fromkeys(BULK, 1.0)
}  # fmt: skip
"""How bulk topics share a link."""
MIN_MEASURED: Final = 4 << 10
"""Bytes of an item by which the link is measured."""
CAMERA_SHARE, CAMERA_HZ = 0.7, 8.0
CLOUD_SHARE, CLOUD_HZ = 0.2, 2.0
SMALLER: Final = {FULL: 1.0, HALF: 0.25, SMALLEST: 0.07}
"""About how large smaller sizes are."""
UP: Final = 1.6
"""By how much the link must be better than a larger size needs, before it is sent."""
FIRST_RATE: Final = 500_000.0
"""Bytes a second that a link is taken for until it was measured."""
MAX_RATE: Final = 3e6
"""Bytes a second with which a round trip is filled: more than a robot shows. A link that becomes narrow delivers these first."""
MAX_ROUND_S: Final = 0.3

BESIDE_VIDEO: Final = 0.15
"""Of the link, for clouds while video has its own way."""


class _Lane:
    """A bulk item on its way."""

    __slots__ = ('at', 'body', 'number')

    def __init__(self, number: int, body: bytes) -> None:
        self.number, self.body, self.at = number, memoryview(body), 0


class Viewer:
    """Decides what one browser is sent, and when. Used by the event loop alone.

    ``offer`` what comes, ``acknowledge`` what the browser says, and after either ``next_frame`` until it is None.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.watched: frozenset[str] = frozenset()
        self.rate = FIRST_RATE
        """Bytes a second that the link carries, as measured."""
        self.replaced = 0
        """Bulk items that were replaced by newer ones before they were sent."""
        self.has_video = False
        """Whether it gets its camera as video beside this: then bulk items are paced, and do not measure the link."""
        self.round_s = 0.0
        """The round trip while nothing is queued; 0 where it is unknown."""
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
        self._measured: deque[tuple[int, int, int, float]] = deque()  # an item's end, and at its begin: sent, acknowledged, when
        self._bulk_s = 0.0  # when bulk may be sent again, beside video

    def watch(self, topics: Iterable[str]) -> None:
        """From now on these and no others."""
        self.watched = frozenset(topics)
        for waiting in (self._rows, self._slots):
            for topic in [topic for topic in waiting if topic not in OWN and topic not in self.watched]:
                del waiting[topic]

    def size(self, topic: str) -> int:
        """In which size it gets a bulk topic."""
        return self._sizes.get(topic, FULL)

    def offer(self, item: LiveItem) -> None:
        """Send it when there is room; a newer one of a bulk topic takes its place."""
        if item.kind in WEIGHTS:
            slot = item.topic or item.kind
            self._kinds[slot] = item.kind
            self._bytes[slot] = round(len(item.packed) / SMALLER[item.size])
            self.replaced += slot in self._slots
            self._slots[slot] = item
        else:
            self._rows.setdefault(item.topic, deque(maxlen=MAX_ROWS_WAITING)).append(item)

    @property
    def window(self) -> int:
        """Bytes that may be sent and not acknowledged: what fills the round trip, and a short queue."""
        rate = self._share
        queue = min(max(rate * QUEUE_S, MIN_QUEUE), MAX_QUEUE)
        return int(queue + min(rate, MAX_RATE) * min(self.round_s, MAX_ROUND_S))

    @property
    def _share(self) -> float:
        """Bytes a second of the link that this has."""
        return self.rate * (BESIDE_VIDEO if self.has_video else 1.0)

    def next_frame(self) -> bytes | None:
        """What is sent now; None while nothing waits or may be sent."""
        under_way, window = self._sent - self._acked, self.window
        if under_way >= window + SMALL_ROOM:
            return None
        if self._rows:
            return self._small()
        is_videos_turn = self.has_video and self._now() < self._bulk_s
        return self._bulk() if under_way < window and not is_videos_turn else None

    def acknowledge(self, received: int) -> None:
        """The browser has received so many bytes, modulo 2^32. What it cannot have received is left out."""
        received = self._sent - ((self._sent - received) & 0xFFFF_FFFF)
        if self._acked < received <= self._sent:
            self._acked = received
            while self._measured and self._measured[0][0] <= received:
                _, begin, before, since_s = self._measured.popleft()
                # The link carries at least what was acknowledged in that time, and at least what was sent in that time less the
                # round trip: the latter is more where it had been idle. The mean is of times, not of rates: one item that
                # a buffer took at once says little about the link.
                took_s = max(self._now() - since_s, 1e-4)
                pace = min(took_s / (received - before), max(took_s - self.round_s, 1e-4) / (received - begin))
                self.rate = 1 / (0.7 / self.rate + 0.3 * max(pace, 1e-8))

    def choose_sizes(self) -> None:
        """For the link as it is now; called once a second."""
        for topic, kind in self._kinds.items():
            if kind not in ('camera', 'cloud'):
                continue
            share, hz = (CAMERA_SHARE, CAMERA_HZ) if kind == 'camera' else (CLOUD_SHARE, CLOUD_HZ)
            room, now = self.rate * share / hz, self.size(topic)
            fitting = [size for size in SIZES if self._bytes[topic] * SMALLER[size] * (UP if size < now else 1.0) <= room]
            self._sizes[topic] = min(fitting, default=SMALLEST)

    def _small(self) -> bytes:
        """Of each topic in turn what has waited longest."""
        frame = bytearray((SMALL_LANE, BEGIN | END, 0, 0))
        while self._rows and len(frame) < SMALL_FRAME:
            topic = next(iter(self._rows))
            rows = self._rows.pop(topic)
            packed = rows.popleft().packed
            frame += len(packed).to_bytes(4, 'little') + packed
            if rows:
                self._rows[topic] = rows  # the others have their turn first
        return self._count(bytes(frame))

    def _bulk(self) -> bytes | None:
        waiting = {*self._slots, *self._lanes}
        if not waiting:
            return None
        topic = min(waiting, key=lambda name: (max(self._used.get(name, 0.0), self._virtual), name))
        lane = self._lanes.get(topic)
        flags = 0
        if lane is None:
            body = self._slots.pop(topic).packed
            lane = self._lanes[topic] = _Lane(self._free_lane(), body)
            flags = BEGIN
            if len(body) >= MIN_MEASURED and not self.has_video:
                self._measured.append((self._sent + len(body), self._sent, self._acked, self._now()))
        part = lane.body[lane.at : lane.at + int(min(max(self._share * CHUNK_S, MIN_CHUNK), MAX_CHUNK))]
        lane.at += len(part)
        self._bulk_s = max(self._bulk_s, self._now()) + len(part) / self._share if self.has_video else 0.0
        self._virtual = max(self._used.get(topic, 0.0), self._virtual)
        self._used[topic] = self._virtual + len(part) / WEIGHTS[self._kinds[topic]]
        if lane.at >= len(lane.body):
            flags |= END
            del self._lanes[topic]
        return self._count(bytes((lane.number, flags, 0, 0)) + part)

    def _free_lane(self) -> int:
        taken = {lane.number for lane in self._lanes.values()}
        return next(number for number in range(1, 256) if number not in taken)

    def _count(self, frame: bytes) -> bytes:
        self._sent += len(frame)
        return frame
