"""What is known of a whole slice without opening it: its channels, times, counts, and what recovery had to leave out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic with one type: all that a reader needs to decode its messages.

    ``type`` is the ROS name (``sensor_msgs/msg/Imu``). ``encoding`` says how ``definition`` is written: ``ros2msg`` or
    ``ros2idl``; both are empty where nobody knows the type. ``type_hash`` is ``RIHS01_...``, empty where the distribution
    knows none (Humble). ``qos`` is the YAML that rosbag2 calls offered_qos_profiles, its policies in
    numbers as Humble reads them, empty when it is not known.
    """

    topic: str
    type: str
    encoding: str
    definition: str
    type_hash: str
    qos: str
    repeated: bool = False
    """Whether its messages repeat latched messages of earlier slices, so that this slice can be played on its own. They have a
    channel of their own in addition to that of the topic's other messages."""


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
    ``damage`` is None unless the slice was recovered. ``repeated`` has those of ``counts`` that are on repeated channels.
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
    repeated: Mapping[str, int] = field(default_factory=dict)

    @property
    def recorded(self) -> Mapping[str, int]:
        """By topic, the messages that were received while the slice was written: all but the repeated ones."""
        return {topic: count - self.repeated.get(topic, 0) for topic, count in self.counts.items()}
