"""MCAP as rosbag2 writes it: the bytes of its records, without file access. The format: https://mcap.dev/spec."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from shadowhound_data_logger.formats.mcap.slice_info import Channel, Damage, SliceInfo, count_by_channel

MAGIC: Final = b'\x89MCAP0\r\n'
LIBRARY: Final = 'shadowhound_data_logger'
RECORD: Final = struct.Struct('<BQ')
MESSAGE: Final = struct.Struct('<BQHIQQ')
"""A message up to its data: opcode and length, channel, sequence, log time, publish time."""
MESSAGE_FIELDS: Final = MESSAGE.size - RECORD.size
CHUNK: Final = struct.Struct('<QQQI')
"""Start, end, uncompressed size, CRC; the name of the compression and the data follow."""
_STATISTICS: Final = struct.Struct('<QHIIIIQQ')
_FOOTER: Final = struct.Struct('<QQI')
_PLACE: Final = struct.Struct('<HQ')
_COUNTED: Final = struct.Struct('<HI')
ROS2: Final = 'ros2'
"""The profile in the header of files that rosbag2 can read."""
CDR: Final = 'cdr'
REPEATED: Final = 'shadowhound_repeated'
"""Key in the metadata of a channel: see ``Channel.repeated``."""


def record(op: int, *parts: bytes) -> bytes:
    """One record with its opcode and length."""
    body = b''.join(parts)
    return RECORD.pack(op, len(body)) + body


def text(value: str) -> bytes:
    """A string with its length. Characters that UTF-8 cannot encode (lone surrogates) are replaced."""
    encoded = value.encode(errors='replace')
    return struct.pack('<I', len(encoded)) + encoded


def mapping(values: Mapping[str, str]) -> bytes:
    """A map of strings."""
    body = b''.join(text(key) + text(value) for key, value in values.items())
    return struct.pack('<I', len(body)) + body


def definition_bytes(definition: str) -> bytes:
    """The bytes of a schema; ``Schemas`` decodes losslessly even if they are not text."""
    try:
        return definition.encode(errors='surrogateescape')
    except UnicodeEncodeError:
        return definition.encode(errors='replace')


def head(profile: str = ROS2) -> bytes:
    """The start of a slice. It is the same in all slices that the node records, so recovery knows where the records start."""
    return MAGIC + record(Opcode.HEADER, text(profile), text(LIBRARY))


@dataclass(slots=True)
class ChannelTrack:
    """A channel of an open slice: the message count of complete chunks, and the index of the open chunk (time, offset, ...)."""

    number: int
    channel: Channel
    count: int = 0
    index: array[int] = field(default_factory=lambda: array('Q'))


def span(tracks: Sequence[ChannelTrack]) -> tuple[int, int]:
    """The first and the last log time in the open chunk, which must have messages in each of these tracks."""
    return min(min(track.index[::2]) for track in tracks), max(max(track.index[::2]) for track in tracks)


@dataclass(frozen=True, slots=True)
class ChunkPacking:
    """The compression and sizes of a chunk's records."""

    compression: str
    compressed: int
    size: int


@dataclass(slots=True)
class Contents:
    """The contents of a slice so far, which become its summary. Owned by the thread that writes the slice."""

    tracks: dict[int, ChannelTrack] = field(default_factory=dict)
    schemas: dict[int, bytes] = field(default_factory=dict)
    """Schema records by id."""
    declared: dict[int, bytes] = field(default_factory=dict)
    """Channel records by id."""
    chunks: list[bytes] = field(default_factory=list)
    """Chunk index records in file order."""
    metadata: list[bytes] = field(default_factory=list)
    """Metadata index records in file order."""
    attachments: list[bytes] = field(default_factory=list)
    """Attachment index records in file order."""
    messages: int = 0
    t_start_ns: int = 0
    t_end_ns: int = 0
    _schema_ids: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def declare(self, channel: Channel) -> tuple[ChannelTrack, bytes]:
        """Add a channel; returns its track, and the records that must precede its first message."""
        schema, records = (channel.type, channel.encoding, channel.definition), b''
        number = self._schema_ids.get(schema) if any(schema) else 0
        if number is None:
            number = self._schema_ids[schema] = len(self.schemas) + 1
            data = definition_bytes(channel.definition)
            fields = struct.pack('<H', number), text(channel.type), text(channel.encoding), struct.pack('<I', len(data))
            self.schemas[number] = records = record(Opcode.SCHEMA, *fields, data)
        track = ChannelTrack(len(self.tracks) + 1, channel)
        metadata = {'offered_qos_profiles': channel.qos, 'topic_type_hash': channel.type_hash}
        metadata = {name: value for name, value in metadata.items() if value}
        metadata |= {**dict(channel.metadata), **({REPEATED: 'true'} if channel.repeated else {})}
        names = text(channel.topic), text(channel.message_encoding)
        declared = record(Opcode.CHANNEL, struct.pack('<HH', track.number, number), *names, mapping(metadata))
        self.tracks[track.number], self.declared[track.number] = track, declared
        return track, records + declared

    def add_chunk(self, at: int, packed: ChunkPacking, tracks: Sequence[ChannelTrack]) -> bytes:
        """Add a chunk that starts at the offset ``at``; returns the message index records after it, one for each track."""
        start, end = span(tracks) if tracks else (0, 0)
        length = RECORD.size + CHUNK.size + 4 + len(packed.compression) + 8 + packed.compressed
        indexes, offsets, messages = bytearray(), bytearray(), self.messages
        for track in tracks:
            offsets += _PLACE.pack(track.number, at + length + len(indexes))
            entries = track.index.tobytes()
            indexes += record(Opcode.MESSAGE_INDEX, _COUNTED.pack(track.number, len(entries)), entries)
            track.count += len(track.index) // 2
            messages += len(track.index) // 2
            track.index = array('Q')
        if tracks:
            self.extend(start, end)
        self.messages = messages
        self.chunks.append(record(
            Opcode.CHUNK_INDEX, struct.pack('<QQQQI', start, end, at, length, len(offsets)), bytes(offsets),
            struct.pack('<Q', len(indexes)), text(packed.compression), struct.pack('<QQ', packed.compressed, packed.size),
        ))  # fmt: skip
        return bytes(indexes)

    def extend(self, start: int, end: int) -> None:
        """Include the log times of messages that are about to be count_by_channel."""
        self.t_start_ns, self.t_end_ns = (min(self.t_start_ns, start), max(self.t_end_ns, end)) if self.messages else (start, end)

    def add_metadata(self, at: int, length: int, name: str) -> None:
        """Add a metadata record that starts at the offset ``at``; ``length`` is that of the whole record."""
        self.metadata.append(record(Opcode.METADATA_INDEX, struct.pack('<QQ', at, length), text(name)))

    def info(self, path: Path, size: int = 0, sha256: str = '', damage: Damage | None = None) -> SliceInfo:
        """The description of the slice, with its channels in the order of their declarations."""
        channels = count_by_channel((track.channel, track.count) for track in self.tracks.values())
        return SliceInfo(path, size, sha256, self.t_start_ns, self.t_end_ns, self.messages, channels, damage)

    def add_attachment(self, at: int, length: int, name: str, media_type: str, size: int, times: tuple[int, int]) -> None:
        """Add an attachment record; ``size`` is that of its content, ``times`` are log time and creation time."""
        numbers = struct.pack('<QQQQQ', at, length, *times, size)
        self.attachments.append(record(Opcode.ATTACHMENT_INDEX, numbers, text(name), text(media_type)))

    def ending(self, at: int, metadata: str | None) -> bytes:
        """Everything after the last chunk, which ends at the offset ``at``: rosbag2's metadata, the summary, the footer."""
        data = b''
        if metadata is not None:
            data = record(Opcode.METADATA, text('rosbag2'), mapping({'serialized_metadata': metadata}))
            self.add_metadata(at, len(data), 'rosbag2')
        data += record(Opcode.DATA_END, struct.pack('<I', 0))
        groups = {
            Opcode.SCHEMA: b''.join(self.schemas.values()),
            Opcode.CHANNEL: b''.join(self.declared.values()),
            Opcode.STATISTICS: self._statistics(),
            Opcode.CHUNK_INDEX: b''.join(self.chunks),
            Opcode.ATTACHMENT_INDEX: b''.join(self.attachments),
            Opcode.METADATA_INDEX: b''.join(self.metadata),
        }
        start = position = at + len(data)
        summary, offsets = b'', b''
        for op, group in groups.items():
            if group:
                offsets += record(Opcode.SUMMARY_OFFSET, struct.pack('<BQQ', op, position, len(group)))
                summary += group
                position += len(group)
        tail = summary + offsets + RECORD.pack(Opcode.FOOTER, _FOOTER.size) + struct.pack('<QQ', start, position)
        return data + tail + struct.pack('<I', zlib.crc32(tail)) + MAGIC

    def _statistics(self) -> bytes:
        counts = b''.join(_PLACE.pack(number, track.count) for number, track in self.tracks.items())
        numbers = self.messages, len(self.schemas), len(self.tracks), len(self.attachments), len(self.metadata), len(self.chunks)
        body = _STATISTICS.pack(*numbers, self.t_start_ns, self.t_end_ns)
        return record(Opcode.STATISTICS, body, struct.pack('<I', len(counts)), counts)
