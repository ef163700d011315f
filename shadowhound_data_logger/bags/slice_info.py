"""What is known of a whole slice without opening it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shadowhound_data_logger.bags.channel import Channel


@dataclass(frozen=True, slots=True)
class Damage:
    """What recovery had to leave out of a slice that was not closed.

    ``tail_bytes`` were written but made no whole chunk; ``chunks`` lie in the middle, broken, and are skipped by readers;
    ``messages`` is how many of both together are known to be lost, at least. What had not reached the disk leaves no trace.
    """

    tail_bytes: int
    chunks: int
    messages: int


@dataclass(frozen=True, slots=True)
class SliceInfo:
    """A finished MCAP file. Times are log times, Unix nanoseconds, both inclusive, 0 in a slice without messages.

    ``sha256`` is in hex, empty where it was not asked for. ``counts`` has every channel's topic, also those without messages.
    ``damage`` is None unless the slice was recovered.
    """

    path: Path
    bytes: int
    sha256: str
    t_start_ns: int
    t_end_ns: int
    messages: int
    counts: Mapping[str, int]
    channels: tuple[Channel, ...]
    damage: Damage | None = None
