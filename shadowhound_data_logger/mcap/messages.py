"""The messages of an MCAP file, with both stamps, in the order in which they were written; only the chunks needed are read.

Every chunk that is opened is checked against its CRC-32, where the writer left one.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk as ChunkRecord

from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.mcap.format import MAGIC, RECORD
from shadowhound_data_logger.mcap.index import UNREADABLE, Chunk, McapIndex, Schemas, parsed, records
from shadowhound_data_logger.mcap.ranges import Ranged
from shadowhound_data_logger.mcap.slice_info import Channel
from shadowhound_data_logger.untrusted import MOST_CHUNK_BYTES, unpacked

SPAN_BYTES: Final = 8 << 20
"""Neighbouring chunks are read with one request up to this size."""
GAP_BYTES: Final = 256 << 10
"""So much that nobody asked for costs less than another request."""
READ_AHEAD: Final = 4
"""Spans that are read at the same time, while the first of them is unpacked."""
BLOCK_BYTES: Final = 4 << 20
"""Of a file that is read from one end to the other."""
MOST_RECORD_BYTES: Final = MOST_CHUNK_BYTES + 1024
"""A chunk, and what says of it how it is packed."""
_MESSAGE = struct.Struct('<HIQQ')


class RecordedMessage(NamedTuple):
    """One message as it was recorded."""

    channel: Channel
    log_ns: int
    """When it was received: the time that rosbag2 and its players go by."""
    publish_ns: int
    sequence: int
    cdr: bytes


@dataclass(frozen=True, slots=True)
class MessageFilter:
    """Which messages: from ``start_ns``, before ``end_ns``, of the channels that ``channel`` says yes to."""

    start_ns: int
    end_ns: int
    channel: Callable[[Channel], bool]


def read_messages(source: Ranged, index: McapIndex, wanted: MessageFilter) -> Iterator[RecordedMessage]:
    """Raises BagDamaged for a chunk that is not what its writer wrote."""
    if not index.is_indexed:
        yield from _scan(source, index, wanted)
        return
    channels = {number: channel for number, channel in index.channels.items() if wanted.channel(channel)}
    chunks = [
        chunk for chunk in index.chunks
        if chunk.t_start_ns < wanted.end_ns and chunk.t_end_ns >= wanted.start_ns
        and any(count and number in channels for number, count in chunk.counts.items())
    ]  # fmt: skip
    for chunk in chunks:
        if chunk.length > MOST_RECORD_BYTES:
            raise BagDamaged(f'{source.name} has a chunk of {chunk.length:,} bytes at {chunk.start}', path=source.name)
    for chunk, record in _read_chunks(source, chunks):
        kind, length = RECORD.unpack_from(record) if len(record) >= RECORD.size else (0, 0)
        if (kind, RECORD.size + length) != (Opcode.CHUNK, chunk.length):
            raise BagDamaged(f'{source.name} has no chunk at {chunk.start}', path=source.name)
        content = unpack(record[RECORD.size :], f'the chunk at {chunk.start} of {source.name}')
        yield from _in_chunk(content, channels, wanted, source.name)


def unpack(content: memoryview, name: str) -> memoryview:
    """The records in a chunk. Raises BagDamaged for a checksum that does not hold or a compression nobody here knows."""
    try:
        chunk = parsed(ChunkRecord, content)
        size, crc = chunk.uncompressed_size, chunk.uncompressed_crc
        found = unpacked(chunk.compression, chunk.data, size) if chunk.compression else chunk.data
    except (*UNREADABLE, ValueError) as error:
        raise BagDamaged(f'{name} cannot be unpacked: {error}', path=name) from error
    if len(found) != size or (crc and zlib.crc32(found) != crc):
        raise BagDamaged(f'{name} is damaged: its CRC-32 or its length does not match', path=name)
    return memoryview(found)


def walk(source: Ranged, end: int) -> Iterator[tuple[int, int, memoryview]]:
    """Every record up to ``end``: what it is, where it begins, its content. Holds one of them and a block in memory."""
    if source.read(0, len(MAGIC)) != MAGIC:
        raise BagDamaged(f'{source.name} does not begin as an MCAP file', path=source.name)
    start, block = len(MAGIC), memoryview(b'')  # block is what is in memory from start on
    while start < end:
        length = RECORD.unpack_from(block)[1] if len(block) >= RECORD.size else 0
        size = RECORD.size + length
        if start + size > end:
            raise BagDamaged(f'{source.name} has a torn record at {start}', path=source.name)
        if size > MOST_RECORD_BYTES:
            raise BagDamaged(f'{source.name} has a record of {size:,} bytes at {start}', path=source.name)
        if len(block) < size:
            more = min(max(BLOCK_BYTES, size), end - start) - len(block)
            block = memoryview(bytes(block) + source.read(start + len(block), more))
            continue
        yield block[0], start, block[RECORD.size : size]
        start, block = start + size, block[size:]


def _in_chunk(content: memoryview, channels: dict[int, Channel], wanted: MessageFilter, name: str) -> Iterator[RecordedMessage]:
    for kind, _, record in records(content, name):
        if kind == Opcode.MESSAGE and (found := _message(record, channels, wanted)):
            yield found


def _message(record: memoryview, channels: dict[int, Channel], wanted: MessageFilter) -> RecordedMessage | None:
    if len(record) < _MESSAGE.size:
        return None  # no message, whatever its first byte says
    number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(record)
    channel = channels.get(number)
    if channel is None or not wanted.start_ns <= log_ns < wanted.end_ns:
        return None
    return RecordedMessage(channel, log_ns, publish_ns, sequence, bytes(record[_MESSAGE.size :]))


def _read_chunks(source: Ranged, chunks: Sequence[Chunk]) -> Iterator[tuple[Chunk, memoryview]]:
    """Each chunk's record, neighbours together, a few requests ahead."""
    reading: deque[tuple[list[Chunk], Future[bytes]]] = deque()
    waiting = deque(_spans(chunks))
    pool = ThreadPoolExecutor(READ_AHEAD, 'bag-read')
    try:
        while reading or waiting:
            while waiting and len(reading) < READ_AHEAD:
                span = waiting.popleft()
                first, last = span[0], span[-1]
                reading.append((span, pool.submit(source.read, first.start, last.start + last.length - first.start)))
            span, answer = reading.popleft()
            content = memoryview(answer.result())
            for chunk in span:
                place = chunk.start - span[0].start
                yield chunk, content[place : place + chunk.length]
    finally:
        pool.shutdown(cancel_futures=True)


def _spans(chunks: Sequence[Chunk]) -> Iterator[list[Chunk]]:
    span: list[Chunk] = []
    for chunk in chunks:
        if span:
            end = span[-1].start + span[-1].length
            if chunk.start - end > GAP_BYTES or chunk.start + chunk.length - span[0].start > SPAN_BYTES:
                yield span
                span = []
        span.append(chunk)
    if span:
        yield span


def _scan(source: Ranged, index: McapIndex, wanted: MessageFilter) -> Iterator[RecordedMessage]:
    """For a file without an index."""
    schemas = Schemas()
    known: dict[int, Channel] = {}
    for kind, start, content in walk(source, index.data_end):
        if kind in {Opcode.DATA_END, Opcode.FOOTER}:
            return
        inner = [(kind, 0, content)]
        if kind == Opcode.CHUNK:
            name = f'the chunk at {start} of {source.name}'
            inner = list(records(unpack(content, name), name))
        for part, _, record in inner:
            if part in {Opcode.SCHEMA, Opcode.CHANNEL}:
                _add(schemas, part, record, source.name)
                known = {number: channel for number, channel in schemas.channels.items() if wanted.channel(channel)}
            elif part == Opcode.MESSAGE and (found := _message(record, known, wanted)):
                yield found


def _add(schemas: Schemas, kind: int, record: memoryview, name: str) -> None:
    try:
        schemas.add(kind, record)
    except UNREADABLE as error:
        raise BagDamaged(f'{name} has a schema or channel that cannot be read: {error}', path=name) from error
