"""Frames of the live page's WebSocket, assembled as in a browser."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any, Final

from shadowhound_data_logger.live.viewer import ACKNOWLEDGED, BEGIN, END, PART

PAIRED: Final = 4


def first_shown_ms(sent_ms: Iterable[float], shown: Sequence[int]) -> float | None:
    """The time of the first frame shown (ms), from the times of the first frames sent and RTP timestamps, as in video.js."""
    sent = {round(at_ms * 90): at_ms for at_ms in sent_ms}
    for tick, at_ms in sent.items():
        if sum(each - shown[0] + tick in sent for each in shown) >= PAIRED:
            return at_ms
    return None


class Frames:
    """The frames received on one connection."""

    def __init__(self) -> None:
        self.bytes = 0
        self._told = 0
        self._parts: dict[int, bytes] = {}

    def take(self, frame: bytes) -> list[tuple[dict[str, Any], bytes]]:
        """Head and body of each item that this frame completes."""
        self.bytes += len(frame)
        found, place = [], 0
        while place < len(frame):
            lane, flags, length = PART.unpack_from(frame, place)
            place += PART.size + length
            assert bool(flags & BEGIN) is (lane not in self._parts)
            self._parts[lane] = self._parts.get(lane, b'') + frame[place - length : place]
            if flags & END:
                found.append(opened(self._parts.pop(lane)))
        assert place == len(frame)
        return found

    def acknowledgement(self) -> bytes | None:
        """The acknowledgement to send now, if any."""
        if self.bytes - self._told < ACKNOWLEDGED:
            return None
        self._told = self.bytes
        return (self.bytes & 0xFFFF_FFFF).to_bytes(4, 'little')


def opened(item: bytes) -> tuple[dict[str, Any], bytes]:
    end = 4 + int.from_bytes(item[:4], 'little')
    assert end % 8 == 0
    return json.loads(item[4:end]), item[end:]
