"""The contents of an MCAP file and their offsets, from its summary or, if that is incomplete, from its records.

The format: https://mcap.dev/spec. Every part of the summary is optional. If it has the channels and their message counts, two
short reads suffice, so a file in a store is not downloaded; otherwise the file is read once from its start to its end, without
attachments and metadata records.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Container, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk as ChunkRecord
from mcap.records import ChunkIndex, Footer, Metadata, MetadataIndex, Schema, Statistics

from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import MAX_CHUNK_BYTES, decompress
from shadowhound_data_logger.formats.mcap.format import MAGIC, RECORD, REPEATED
from shadowhound_data_logger.formats.mcap.ranges import Ranged
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import qos_in_numbers
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo, count_by_channel

FOOTER_BYTES: Final = 20
TAIL_BYTES: Final = RECORD.size + FOOTER_BYTES + len(MAGIC)
_DATA_END: Final = struct.Struct('<BQI')
DATA_END_BYTES: Final = _DATA_END.size
FIRST_READ: Final = 64 << 10
"""Size of the first read, at the end of the file: it contains the whole summary of most slices."""
MAX_SUMMARY_BYTES: Final = 64 << 20
"""Enough for a hundred thousand chunks: a bag of 100 GB in one file."""
MAX_HEADER_BYTES: Final = 4 << 10
MAX_RECORD_BYTES: Final = MAX_CHUNK_BYTES + 1024
"""The largest chunk, with the fields before its data."""
BLOCK_BYTES: Final = 4 << 20
"""Size of each read of a file that is read completely, and of a group of messages outside chunks."""
INDEX_HEAD: Final = 15
"""Bytes of a message index record before its entries: opcode and length, channel, length of the entries."""
INDEX_ENTRY: Final = 16
UNREADABLE: Final = (McapError, EOFError, struct.error, UnicodeDecodeError)
"""Exceptions that ``parse`` raises for an invalid record."""
MESSAGE: Final = struct.Struct('<HIQQ')
"""Fields of a message record before its data: channel, sequence, log time, publish time."""
_DECLARING: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_SCANNED: Final = frozenset({*_DECLARING, Opcode.MESSAGE, Opcode.CHUNK})
"""Records whose content is needed."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Part of a file that is read at once: a chunk record, or consecutive records outside chunks."""

    start: int
    """Offset of its first record in the file."""
    length: int
    """Total size of its records."""
    t_start_ns: int
    t_end_ns: int
    counts: Mapping[int, int]
    """Channel -> messages."""
    is_chunk: bool = True


@dataclass(frozen=True, slots=True)
class McapIndex:
    """The contents of one file."""

    channels: Mapping[int, Channel]
    counts: Mapping[int, int]
    """Channel -> messages."""
    messages: int
    t_start_ns: int
    t_end_ns: int
    """Both 0 without messages."""
    chunks: tuple[Chunk, ...] | None
    """Chunks in file order; None if the summary does not have them: then ``scan`` finds them."""
    attachments: int
    metadata: tuple[str, ...]
    """The names of its metadata records; empty strings if the summary has only their number."""
    data_end: int
    """End of the messages: the offset of the DataEnd record if it was read, otherwise the end of the data section."""

    def info(self, path: Path, size: int, sha256: str = '') -> SliceInfo:
        """The same without offsets."""
        channels = count_by_channel((channel, self.counts.get(number, 0)) for number, channel in self.channels.items())
        return SliceInfo(path, size, sha256, self.t_start_ns, self.t_end_ns, self.messages, channels)


_Record = TypeVar('_Record', covariant=True)


class RecordKind(Protocol[_Record]):
    """A class of ``mcap.records``."""

    @staticmethod
    def read(stream: ReadDataStream) -> _Record: ...


def parse(kind: RecordKind[_Record], content: bytes | memoryview) -> _Record:
    """The content of one record. Raises one of ``UNREADABLE`` if it is invalid or truncated."""
    return kind.read(ReadDataStream(_Exact(content)))


def parsed_length(kind: RecordKind[_Record], content: bytes | memoryview) -> int:
    """The length of a record's fields; the format allows additional bytes after them. Raises as ``parse`` does."""
    stream = _Exact(content)
    kind.read(ReadDataStream(stream))
    return stream.tell()


class _Exact(io.BytesIO):
    """Returns exactly the requested number of bytes or raises: `mcap` would accept a truncated record."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = len(self.getbuffer()) - self.tell()
        if size is None or size > left:
            raise EOFError(f'{size} bytes are required, {left} remain')
        return super().read(size)


@dataclass(slots=True)
class Schemas:
    """Channels that were found, with their schemas. A channel is added when its schema is known."""

    channels: dict[int, Channel] = field(default_factory=dict)
    waiting: dict[int, dict[int, ChannelRecord]] = field(default_factory=dict)
    """Channels whose schema has not been found yet, by that schema."""
    _schemas: dict[int, tuple[str, str, str]] = field(default_factory=lambda: {0: ('', '', '')})

    def add(self, kind: int, content: bytes | memoryview) -> None:
        """Add a schema or channel record. Raises one of ``UNREADABLE`` if it is invalid or contradicts an earlier one."""
        if kind == Opcode.SCHEMA:
            schema = parse(Schema, content)
            found = schema.name, schema.encoding, schema.data.decode(errors='surrogateescape')
            if not schema.id or self._schemas.setdefault(schema.id, found) != found:
                raise McapError(f'schema {schema.id} is defined twice, differently' if schema.id else 'schema 0 is defined')
            for channel in self.waiting.pop(schema.id, {}).values():
                self._add(channel)
            return
        channel = parse(ChannelRecord, content)
        if channel.schema_id in self._schemas:
            self._add(channel)
        elif self.waiting.setdefault(channel.schema_id, {}).setdefault(channel.id, channel) != channel:
            raise McapError(f'channel {channel.id} is defined twice, differently')

    def _add(self, record: ChannelRecord) -> None:
        name, encoding, definition = self._schemas[record.schema_id]
        rest = dict(record.metadata)
        type_hash, qos = (rest.pop(name) if rest.get(name) else '' for name in ('topic_type_hash', 'offered_qos_profiles'))
        repeated = rest.get(REPEATED) == 'true' and bool(rest.pop(REPEATED))
        channel = Channel(
            topic=record.topic, type=name, encoding=encoding, definition=definition, type_hash=type_hash, qos=qos_in_numbers(qos),
            message_encoding=record.message_encoding, metadata=tuple(sorted(rest.items())), repeated=repeated,
        )  # fmt: skip
        if self.channels.setdefault(record.id, channel) != channel:
            raise McapError(f'channel {record.id} is defined twice, differently')


def read_index(source: Ranged) -> McapIndex:
    """The contents from the summary if it has the counts of every channel, otherwise from all records.

    Raises BagDamaged if the file is not a complete MCAP file.
    """
    found, data_end = read_end(source)
    return scan(source, data_end) if found is None else found


def read_summary(source: Ranged) -> McapIndex | None:
    """The contents from the summary; None if it is incomplete or lacks the offset of a chunk. Raises BagDamaged."""
    found, _ = read_end(source)
    return found if found is not None and found.chunks is not None else None


def read_end(source: Ranged) -> tuple[McapIndex | None, int]:
    """The contents from the summary, or None if it lacks message counts, and the end of the data. Raises BagDamaged."""
    summary, data_end = _read_summary(source)
    return _index(summary, data_end, source), data_end


def check_crcs(source: Ranged, data_end: int, data_crc: int) -> None:
    """Raises BagDamaged if the CRC-32 of the summary, or of the data (``data_crc``), differs from that in the file; 0 is unset.

    The CRC of the data covers everything before its last ``DATA_END_BYTES``. It is not checked if the DataEnd record is longer.
    """
    tail = source.read(data_end - DATA_END_BYTES, source.size - len(MAGIC) - data_end + DATA_END_BYTES)
    kind, length, wanted = _DATA_END.unpack_from(tail)
    if (kind, length) == (Opcode.DATA_END, 4) and wanted not in {0, data_crc}:
        raise BagDamaged(f'{source.name} is damaged: the CRC-32 of its data does not match', path=source.name)
    wanted = int.from_bytes(tail[-4:], 'little')
    if wanted not in {0, zlib.crc32(tail[DATA_END_BYTES:-4])}:
        raise BagDamaged(f'{source.name} is damaged: the CRC-32 of its summary does not match', path=source.name)


def read_profile(source: Ranged) -> str:
    """The profile in the header of a file. Raises BagDamaged."""
    start = len(MAGIC) + RECORD.size
    head = source.read(0, min(MAX_HEADER_BYTES, source.size))
    length = int.from_bytes(head[start : start + 4], 'little')
    try:
        if not head.startswith(MAGIC + bytes([Opcode.HEADER])) or start + 4 + length > len(head):
            raise EOFError('it is not the header of an MCAP file')
        return head[start + 4 : start + 4 + length].decode()
    except UNREADABLE as error:
        raise BagDamaged(f'{source.name} has a header that cannot be read: {error}', path=source.name) from error


def scan(source: Ranged, data_end: int) -> McapIndex:
    """The contents from all records; unpacks and checks all chunks. Raises BagDamaged."""
    declared, chunks, attachments, metadata = Schemas(), list[_PartCounter](), 0, list[str]()
    for kind, start, size, content in walk(source, data_end, _SCANNED):
        if kind == Opcode.DATA_END:
            data_end = start
            break
        if kind == Opcode.CHUNK:
            chunks.append(_PartCounter(start, size, is_chunk=True))
            name = f'the chunk at {start} of {source.name}'
            for inner, _, record in records(unpack(content, name), name):
                chunks[-1].add(inner, record, declared, name)
        elif kind in _SCANNED:
            if not chunks or not chunks[-1].takes(start, size):
                chunks.append(_PartCounter(start, 0))
            chunks[-1].length += size
            chunks[-1].add(kind, content, declared, source.name)
        elif kind == Opcode.ATTACHMENT:
            attachments += 1
        elif kind == Opcode.METADATA:
            metadata.append('')
    if declared.waiting:
        raise BagDamaged(f'{source.name} does not define schema {min(declared.waiting)}, which a channel uses', path=source.name)
    filled = [chunk for chunk in chunks if chunk.counts]
    counts: dict[int, int] = {}
    for chunk in filled:
        for number, count in chunk.counts.items():
            counts[number] = counts.get(number, 0) + count
    return McapIndex(
        declared.channels, counts, sum(counts.values()), min((chunk.first_ns for chunk in filled), default=0),
        max((chunk.last_ns for chunk in filled), default=0),
        tuple(Chunk(one.start, one.length, one.first_ns, one.last_ns, one.counts, one.is_chunk) for one in filled),
        attachments, tuple(metadata), data_end,
    )  # fmt: skip


@dataclass(slots=True)
class _PartCounter:
    """Counts the messages of a part of a file."""

    start: int
    length: int
    is_chunk: bool = False
    counts: dict[int, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0

    def takes(self, start: int, size: int) -> bool:
        """Whether a record outside chunks belongs to this part."""
        return not self.is_chunk and self.start + self.length == start and self.length + size <= BLOCK_BYTES

    def add(self, kind: int, record: memoryview, declared: Schemas, name: str) -> None:
        if kind in _DECLARING:
            declare(declared, kind, record, name)
        elif kind == Opcode.MESSAGE:
            number, _, log_ns, _ = message_head(record, name)
            if number not in declared.channels:
                raise BagDamaged(f'{name} has a message of channel {number} before the definition of that channel', path=name)
            self.first_ns = min(self.first_ns, log_ns) if self.counts else log_ns
            self.last_ns = max(self.last_ns, log_ns)
            self.counts[number] = self.counts.get(number, 0) + 1


def declare(declared: Schemas, kind: int, record: memoryview, name: str) -> None:
    """Raises BagDamaged if a schema or channel is invalid or contradicts an earlier one."""
    try:
        declared.add(kind, record)
    except UNREADABLE as error:
        raise BagDamaged(f'{name} has a schema or channel that cannot be used: {error}', path=name) from error


def message_head(record: memoryview, name: str) -> tuple[int, int, int, int]:
    """Channel, sequence, log time, publish time. Raises BagDamaged if the record is too short."""
    if len(record) < MESSAGE.size:
        raise BagDamaged(f'{name} has a message of {len(record)} bytes', path=name)
    number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(record)
    return number, sequence, log_ns, publish_ns


def unpack(content: memoryview, name: str) -> memoryview:
    """The records in a chunk. Raises BagDamaged if its checksum is wrong or its compression is not supported."""
    try:
        chunk = parse(ChunkRecord, content)
        size, crc = chunk.uncompressed_size, chunk.uncompressed_crc
        found = decompress(chunk.compression, chunk.data, size) if chunk.compression else chunk.data
    except (*UNREADABLE, ValueError) as error:
        raise BagDamaged(f'{name} cannot be unpacked: {error}', path=name) from error
    if len(found) != size or (crc and zlib.crc32(found) != crc):
        raise BagDamaged(f'{name} is damaged: its CRC-32 or its length does not match', path=name)
    return memoryview(found)


def walk(source: Ranged, end: int, wanted: Container[int]) -> Iterator[tuple[int, int, int, memoryview]]:
    """Every record up to ``end``: opcode, offset, size, and the content if the opcode is ``wanted``.

    Reads forward only, skips the content of other records, and keeps one record and one block in memory.
    """
    if source.read(0, len(MAGIC)) != MAGIC:
        raise BagDamaged(f'{source.name} does not start with the magic bytes of MCAP', path=source.name)
    start = at = len(MAGIC)
    block = memoryview(b'')  # the bytes from ``at`` on that are in memory

    def content(length: int) -> memoryview:
        nonlocal at, block
        block, at = (block[start - at :], start) if start - at <= len(block) else (memoryview(b''), start)
        if len(block) < length:
            more = min(max(BLOCK_BYTES, length), end - start) - len(block)
            block = memoryview(bytes(block) + source.read(start + len(block), more))
        return block[:length]

    while start < end:
        kind, length = RECORD.unpack(content(RECORD.size)) if start + RECORD.size <= end else (0, end)
        size = RECORD.size + length
        if start + size > end:
            raise BagDamaged(f'{source.name} has a truncated record at {start}', path=source.name)
        if not kind:
            raise BagDamaged(f'{source.name} has zeros instead of a record at {start}', path=source.name)
        if kind not in wanted:
            yield kind, start, size, memoryview(b'')
        elif size > MAX_RECORD_BYTES:
            raise BagDamaged(f'{source.name} has a record of {size:,} bytes at {start}', path=source.name)
        else:
            yield kind, start, size, content(size)[RECORD.size :]
        start += size


def _read_summary(source: Ranged) -> tuple[memoryview, int]:
    """The records of the summary, and the end of the data before it."""
    tail_length = min(source.size, FIRST_READ)
    if tail_length < len(MAGIC) + TAIL_BYTES:
        raise BagDamaged(f'{source.name} is not an MCAP file: it has {source.size} bytes', path=source.name)
    tail_start = source.size - tail_length
    tail = source.read(tail_start, tail_length)
    if not tail.endswith(MAGIC):
        remedy = 'recover it with shadowhound-data bag repair; a node recovers its own slices when it restarts'
        raise BagDamaged(f'{source.name} is truncated: the end of the MCAP file is missing', remedy=remedy, path=source.name)
    kind, length = RECORD.unpack_from(tail, tail_length - TAIL_BYTES)
    if (kind, length) != (Opcode.FOOTER, FOOTER_BYTES):
        raise BagDamaged(f'{source.name} has no MCAP footer', path=source.name)
    footer_start = source.size - TAIL_BYTES
    summary_start = parse(Footer, tail[-FOOTER_BYTES - len(MAGIC) : -len(MAGIC)]).summary_start
    if not summary_start:
        return memoryview(b''), footer_start
    if not len(MAGIC) <= summary_start <= footer_start:
        raise BagDamaged(f'{source.name} has its summary at {summary_start}, outside the file', path=source.name)
    if footer_start - summary_start > MAX_SUMMARY_BYTES:
        raise BagDamaged(f'{source.name} has a summary of {footer_start - summary_start:,} bytes', path=source.name)
    if summary_start < tail_start:
        tail = source.read(summary_start, tail_start - summary_start) + tail
        tail_start = summary_start
    return memoryview(tail)[summary_start - tail_start : footer_start - tail_start], summary_start


def records(content: memoryview, name: str) -> Iterator[tuple[int, int, memoryview]]:
    """The opcode, offset and content of each record. Raises BagDamaged if one is truncated."""
    place = 0
    while place < len(content):
        if place + RECORD.size > len(content):
            raise BagDamaged(f'{name} has a truncated record at {place}', path=name)
        kind, length = RECORD.unpack_from(content, place)
        end = place + RECORD.size + length
        if end > len(content):
            raise BagDamaged(f'{name} has a truncated record at {place}', path=name)
        yield kind, place, content[place + RECORD.size : end]
        place = end


def read_metadata(path: Path, name: str) -> Iterator[Mapping[str, str]]:
    """The metadata records with this name in a file that may be open or truncated. Raises OSError."""
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        size, at = os.fstat(file).st_size, len(MAGIC)
        while len(start := os.pread(file, RECORD.size, at)) == RECORD.size:
            kind, length = RECORD.unpack(start)
            if kind in {0, Opcode.DATA_END} or at + RECORD.size + length > size:
                return
            if kind == Opcode.METADATA and length <= MAX_SUMMARY_BYTES:
                with suppress(*UNREADABLE):
                    found = parse(Metadata, os.pread(file, length, at + RECORD.size))
                    if found.name == name:
                        yield found.metadata
            at += RECORD.size + length
    finally:
        os.close(file)


def _index(summary: memoryview, data_end: int, source: Ranged) -> McapIndex | None:
    """The contents from the summary; None if it lacks the message count of a channel."""
    declared, chunks, metadata, statistics = Schemas(), [], list[str](), None
    try:
        for kind, _, content in records(summary, source.name):
            if kind in _DECLARING:
                declared.add(kind, content)
            elif kind == Opcode.CHUNK_INDEX:
                chunks.append(_chunk(parse(ChunkIndex, content), data_end))
            elif kind == Opcode.METADATA_INDEX:
                metadata.append(parse(MetadataIndex, content).name)
            elif kind == Opcode.STATISTICS:
                statistics = parse(Statistics, content)
    except UNREADABLE as error:
        raise BagDamaged(f'{source.name} has a summary that cannot be read: {error}', path=source.name) from error
    if statistics is None or declared.waiting or len(declared.channels) < statistics.channel_count:
        return None
    counts = {number: count for number, count in statistics.channel_message_counts.items() if count}
    messages = statistics.message_count
    if sum(counts.values()) != messages or not counts.keys() <= declared.channels.keys():
        return None
    chunks.sort(key=lambda chunk: chunk.start)
    found: dict[int, int] = {}
    for chunk in chunks:
        for number, count in chunk.counts.items():
            found[number] = found.get(number, 0) + count
    metadata += [''] * (statistics.metadata_count - len(metadata))
    filled = [chunk for chunk in chunks if any(chunk.counts.values())]
    are_all = {number: count for number, count in found.items() if count} == counts
    start, end = (statistics.message_start_time, statistics.message_end_time) if messages else (0, 0)
    if are_all and filled:  # some versions of the Go library ignore times of 0 in the statistics
        start, end = min(chunk.t_start_ns for chunk in filled), max(chunk.t_end_ns for chunk in filled)
    return McapIndex(
        declared.channels, counts, messages, start, end, tuple(chunks) if are_all else None, statistics.attachment_count,
        tuple(metadata), data_end,
    )  # fmt: skip


def _chunk(found: ChunkIndex, data_end: int) -> Chunk:
    end = found.chunk_start_offset + found.chunk_length + found.message_index_length
    if end > data_end:
        raise EOFError(f'a chunk ends at {end}, outside the data')
    ordered = sorted((place, channel) for channel, place in found.message_index_offsets.items())
    ends = [place for place, _ in ordered[1:]] + [end]
    counts = {
        channel: max(after - place - INDEX_HEAD, 0) // INDEX_ENTRY for (place, channel), after in zip(ordered, ends, strict=False)
    }
    return Chunk(found.chunk_start_offset, found.chunk_length, found.message_start_time, found.message_end_time, counts)
