"""The description of a finished slice: its channels with their message counts, its times, and what recovery lost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic with one type, and everything that a reader needs to decode its messages.

    ``type`` is the ROS name (``sensor_msgs/msg/Imu``), or the name of another recorder's schema. ``encoding`` is the format of
    ``definition``: ``ros2msg`` or ``ros2idl``, or another recorder's (``protobuf``, ``jsonschema``); all three are empty if the
    type is unknown. A definition that is not text keeps its bytes (``surrogateescape``). ``type_hash`` is ``RIHS01_...``, empty
    if the distribution has none (Humble). ``qos`` is the YAML that rosbag2 calls offered_qos_profiles, with numeric policies,
    which Humble can read; empty if unknown. ``message_encoding`` is the format of the messages. ``metadata`` is the rest of
    the channel's metadata in the file.
    """

    topic: str
    type: str
    encoding: str
    definition: str
    type_hash: str
    qos: str
    message_encoding: str = 'cdr'
    metadata: tuple[tuple[str, str], ...] = ()
    repeated: bool = False
    """Whether its messages repeat latched messages of earlier slices, so that this slice can be played on its own. The topic's
    other messages have a separate channel."""


def count_by_channel(channels: Iterable[tuple[Channel, int]]) -> dict[Channel, int]:
    """The message count of each channel; channels that differ only in their number in the file are one."""
    found: dict[Channel, int] = {}
    for channel, count in channels:
        found[channel] = found.get(channel, 0) + count
    return found


@dataclass(frozen=True, slots=True)
class Damage:
    """What recovery could not keep of a slice that was not closed.

    ``tail_bytes`` is the size of an incomplete chunk at the end; ``chunks`` is the number of damaged chunks before it, which
    readers skip; ``messages`` is the minimum number of messages lost in both. Data that had not reached the disk is not counted.
    """

    tail_bytes: int
    chunks: int
    messages: int


@dataclass(frozen=True, slots=True)
class SliceInfo:
    """A finished MCAP file. Times are log times, Unix nanoseconds, both inclusive, 0 in a slice without messages.

    ``sha256`` is in hex, empty if it was not requested. ``channels`` has the number of messages of each channel, including
    channels without messages. ``damage`` is None unless the slice was recovered.
    """

    path: Path
    bytes: int
    sha256: str
    t_start_ns: int
    t_end_ns: int
    messages: int
    channels: Mapping[Channel, int]
    damage: Damage | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Message counts by topic, as the ledger needs them."""
        return _by_topic(self.channels.items())

    @property
    def repeated(self) -> dict[str, int]:
        """Message counts by topic on repeated channels, without zeros."""
        return _by_topic((channel, count) for channel, count in self.channels.items() if channel.repeated and count)

    @property
    def recorded(self) -> dict[str, int]:
        """Message counts by topic without the repeated ones: messages received while the slice was written."""
        repeated = self.repeated
        return {topic: count - repeated.get(topic, 0) for topic, count in self.counts.items()}


def _by_topic(channels: Iterable[tuple[Channel, int]]) -> dict[str, int]:
    found: dict[str, int] = {}
    for channel, count in channels:
        found[channel.topic] = found.get(channel.topic, 0) + count
    return found
