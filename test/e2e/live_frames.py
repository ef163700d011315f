"""Frames of the live page's WebSocket, assembled as in a browser."""

from __future__ import annotations

import json
from typing import Any

from shadowhound_data_logger.live.viewer import ACKNOWLEDGED, BEGIN, END, SMALL_LANE


class Frames:
    """The frames received on one connection."""

    def __init__(self) -> None:
        self.bytes = 0
        self._told = 0
        self._parts: dict[int, bytes] = {}

    def take(self, frame: bytes) -> list[tuple[dict[str, Any], bytes]]:
        """Head and body of each item that this frame completes."""
        self.bytes += len(frame)
        lane, flags = frame[:2]
        if lane == SMALL_LANE:
            return [opened(item) for item in _several(frame[4:])]
        assert bool(flags & BEGIN) is (lane not in self._parts)
        self._parts[lane] = self._parts.get(lane, b'') + frame[4:]
        return [opened(self._parts.pop(lane))] if flags & END else []

    def acknowledgement(self) -> bytes | None:
        """The acknowledgement to send now, if any."""
        if self.bytes - self._told < ACKNOWLEDGED:
            return None
        self._told = self.bytes
        return (self.bytes & 0xFFFF_FFFF).to_bytes(4, 'little')


def _several(content: bytes) -> list[bytes]:
    found = []
    while content:
        end = 4 + int.from_bytes(content[:4], 'little')
        found.append(content[4:end])
        content = content[end:]
    return found


def opened(item: bytes) -> tuple[dict[str, Any], bytes]:
    end = 4 + int.from_bytes(item[:4], 'little')
    assert end % 8 == 0
    return json.loads(item[4:end]), item[end:]
