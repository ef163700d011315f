"""What an MCAP file holds and where, read from its end: channels, statistics, and the place of every chunk.

The format: https://mcap.dev/spec. Two short reads tell all of it, so a file in a store is not downloaded for it.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Footer, Metadata, Schema, Statistics

from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.mcap.format import MAGIC, RECORD, REPEATED
from shadowhound_data_logger.mcap.ranges import Ranged
from shadowhound_data_logger.mcap.rosbag2_metadata import in_numbers
from shadowhound_data_logger.mcap.slice_info import Channel

FOOTER_BYTES: Final = 20
TAIL_BYTES: Final = RECORD.size + FOOTER_BYTES + len(MAGIC)
FIRST_READ: Final = 64 << 10
"""From the end: the whole summary of most slices, so that one request does."""
MOST_SUMMARY_BYTES: Final = 64 << 20
"""That of a hundred thousand chunks: a bag of 100 GB in one file."""
INDEX_HEAD: Final = 15
"""Bytes of a message index record before its entries: head, channel, length of the entries."""
INDEX_ENTRY: Final = 16
UNREADABLE: Final = (McapError, EOFError, struct.error, UnicodeDecodeError)
"""What ``parsed`` raises for a record that is none of its kind."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where a chunk lies, and what is in it."""

    start: int
    """Of its record in the file."""
    length: int
    """Of its record."""
    t_start_ns: int
    t_end_ns: int
    counts: Mapping[int, int]
    """Channel -> messages; empty where the file has no message indexes, so nothing is known."""


@dataclass(frozen=True, slots=True)
class McapIndex:
    """The contents of one file."""

    channels: Mapping[int, Channel]
    chunks: tuple[Chunk, ...]
    """In the order of the file; none where it is not chunked or has no index."""
    counts: Mapping[int, int]
    """Channel -> messages."""
    messages: int
    t_start_ns: int
    t_end_ns: int
    data_end: int
    """Where the messages end."""
    is_indexed: bool
    """Whether ``chunks`` and ``counts`` tell of every message; else the file has to be read from one end to the other."""


_Record = TypeVar('_Record', covariant=True)


class RecordKind(Protocol[_Record]):
    """A class of ``mcap.records``."""

    @staticmethod
    def read(stream: ReadDataStream) -> _Record: ...


def parsed(kind: RecordKind[_Record], content: bytes | memoryview) -> _Record:
    """The content of one record. Raises one of ``UNREADABLE`` where it says that it is longer than it is."""
    return kind.read(ReadDataStream(_Exact(content)))


class _Exact(io.BytesIO):
    """Gives all that is asked for: `mcap` takes less of a record that is cut off for the whole of it."""

    def read(self, size: int | None = -1, /) -> bytes:
        found = super().read(size)
        if size is None or len(found) != size:
            raise EOFError(f'{size} bytes are wanted, {len(found)} are left')
        return found


@dataclass(slots=True)
class Schemas:
    """Channels as they are found, and the schemas that they need."""

    channels: dict[int, Channel] = field(default_factory=dict)
    _schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)

    def add(self, kind: int, content: bytes | memoryview) -> None:
        """A schema or channel record. Raises one of ``UNREADABLE``."""
        if kind == Opcode.SCHEMA:
            schema = parsed(Schema, content)
            self._schemas[schema.id] = schema.name, schema.encoding, schema.data.decode()
            return
        channel = parsed(ChannelRecord, content)
        name, encoding, definition = self._schemas.get(channel.schema_id, ('', '', ''))
        self.channels[channel.id] = Channel(
            topic=channel.topic, type=name, encoding=encoding, definition=definition,
            type_hash=channel.metadata.get('topic_type_hash', ''),
            qos=in_numbers(channel.metadata.get('offered_qos_profiles', '')), repeated=channel.metadata.get(REPEATED) == 'true',
        )  # fmt: skip


def read_index(source: Ranged) -> McapIndex:
    """Raises BagDamaged for what is not a whole MCAP file."""
    tail_length = min(source.size, FIRST_READ)
    if tail_length < len(MAGIC) + TAIL_BYTES:
        raise BagDamaged(f'{source.name} is not an MCAP file: it has {source.size} bytes', path=source.name)
    tail_start = source.size - tail_length
    tail = source.read(tail_start, tail_length)
    if not tail.endswith(MAGIC):
        remedy = 'it was cut off; slices of this package are recovered when the node starts again, for others see `mcap recover`'
        raise BagDamaged(f'{source.name} has no end of an MCAP file', remedy=remedy, path=source.name)
    kind, length = RECORD.unpack_from(tail, tail_length - TAIL_BYTES)
    if (kind, length) != (Opcode.FOOTER, FOOTER_BYTES):
        raise BagDamaged(f'{source.name} has no footer of an MCAP file', path=source.name)
    footer_start = source.size - TAIL_BYTES
    summary_start = parsed(Footer, tail[-FOOTER_BYTES - len(MAGIC) : -len(MAGIC)]).summary_start
    if not summary_start:
        return McapIndex({}, (), {}, 0, 0, 0, footer_start, is_indexed=False)
    if not len(MAGIC) <= summary_start <= footer_start:
        raise BagDamaged(f'{source.name} has its summary at {summary_start}, outside the file', path=source.name)
    if footer_start - summary_start > MOST_SUMMARY_BYTES:
        raise BagDamaged(f'{source.name} has a summary of {footer_start - summary_start:,} bytes', path=source.name)
    if summary_start < tail_start:
        tail = source.read(summary_start, tail_start - summary_start) + tail
        tail_start = summary_start
    return _index(memoryview(tail)[summary_start - tail_start : footer_start - tail_start], summary_start, source)


def records(content: memoryview, name: str) -> Iterator[tuple[int, int, memoryview]]:
    """What each record is, where it begins, and its content. Raises BagDamaged for one that is cut off."""
    place = 0
    while place < len(content):
        if place + RECORD.size > len(content):
            raise BagDamaged(f'{name} has a torn record at {place}', path=name)
        kind, length = RECORD.unpack_from(content, place)
        end = place + RECORD.size + length
        if end > len(content):
            raise BagDamaged(f'{name} has a torn record at {place}', path=name)
        yield kind, place, content[place + RECORD.size : end]
        place = end


def read_metadata(path: Path, name: str) -> Iterator[Mapping[str, str]]:
    """The metadata records of this name in a file, as far as it goes: it may still be written, or be torn. Raises OSError."""
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        size, at = os.fstat(file).st_size, len(MAGIC)
        while len(start := os.pread(file, RECORD.size, at)) == RECORD.size:
            kind, length = RECORD.unpack(start)
            if kind in {0, Opcode.DATA_END} or at + RECORD.size + length > size:
                return
            if kind == Opcode.METADATA and length <= MOST_SUMMARY_BYTES:
                with suppress(*UNREADABLE):
                    found = parsed(Metadata, os.pread(file, length, at + RECORD.size))
                    if found.name == name:
                        yield found.metadata
            at += RECORD.size + length
    finally:
        os.close(file)


def _index(summary: memoryview, data_end: int, source: Ranged) -> McapIndex:
    schemas, chunks, statistics = Schemas(), [], None
    try:
        for kind, _, content in records(summary, source.name):
            if kind in {Opcode.SCHEMA, Opcode.CHANNEL}:
                schemas.add(kind, content)
            elif kind == Opcode.CHUNK_INDEX:
                chunks.append(_chunk(parsed(ChunkIndex, content), data_end))
            elif kind == Opcode.STATISTICS:
                statistics = parsed(Statistics, content)
    except UNREADABLE as error:
        raise BagDamaged(f'{source.name} has a summary that cannot be read: {error}', path=source.name) from error
    chunks.sort(key=lambda chunk: chunk.start)
    if statistics is None:
        return McapIndex(schemas.channels, tuple(chunks), {}, 0, 0, 0, data_end, is_indexed=False)
    counts, messages = statistics.channel_message_counts, statistics.message_count
    is_known = sum(counts.values()) == messages and counts.keys() <= schemas.channels.keys()
    is_indexed = is_known and sum(sum(chunk.counts.values()) for chunk in chunks) == messages
    times = statistics.message_start_time, statistics.message_end_time
    return McapIndex(schemas.channels, tuple(chunks), counts, messages, *times, data_end, is_indexed)


def _chunk(found: ChunkIndex, data_end: int) -> Chunk:
    end = found.chunk_start_offset + found.chunk_length + found.message_index_length
    if end > data_end:
        raise EOFError(f'a chunk ends at {end}, outside the data')
    ordered = sorted((place, channel) for channel, place in found.message_index_offsets.items())
    ends = [place for place, _ in ordered[1:]] + [end]
    counts = {
        channel: max(after - place - INDEX_HEAD, 0) // INDEX_ENTRY for (place, channel), after in zip(ordered, ends, strict=True)
    }
    return Chunk(found.chunk_start_offset, found.chunk_length, found.message_start_time, found.message_end_time, counts)
