"""Reads the messages of an MCAP file, with both stamps, in file order; reads only the chunks that are needed.

The CRC-32 of every chunk that is read is checked, if it has one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, NamedTuple

from mcap.opcode import Opcode

from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.format import RECORD
from shadowhound_data_logger.formats.mcap.index import (
    MAX_RECORD_BYTES,
    MESSAGE,
    Chunk,
    McapIndex,
    message_head,
    records,
    scan,
    unpack,
)
from shadowhound_data_logger.formats.mcap.ranges import Ranged
from shadowhound_data_logger.formats.mcap.slice_info import Channel

SPAN_BYTES: Final = 8 << 20
"""Adjacent chunks are read with one request up to this size."""
GAP_BYTES: Final = 256 << 10
"""Up to this many unneeded bytes are cheaper than another request."""
READ_AHEAD: Final = 4
"""Requests in flight while the first one is unpacked."""


class RecordedMessage(NamedTuple):
    """One recorded message."""

    channel: Channel
    log_ns: int
    """When it was received: the time that rosbag2 and its players use."""
    publish_ns: int
    sequence: int
    cdr: bytes


@dataclass(frozen=True, slots=True)
class MessageFilter:
    """Selects messages from ``start_ns``, before ``end_ns``, of the channels for which ``channel`` returns True."""

    start_ns: int
    end_ns: int
    channel: Callable[[Channel], bool]


def read_messages(source: Ranged, index: McapIndex, wanted: MessageFilter) -> Iterator[RecordedMessage]:
    """Raises BagDamaged for a damaged chunk."""
    channels = {number: channel for number, channel in index.channels.items() if wanted.channel(channel)}
    chunks = [
        chunk for chunk in (scan(source, index.data_end).chunks if index.chunks is None else index.chunks) or ()
        if chunk.t_start_ns < wanted.end_ns and chunk.t_end_ns >= wanted.start_ns
        and any(count and number in channels for number, count in chunk.counts.items())
    ]  # fmt: skip
    for chunk in chunks:
        if chunk.length > MAX_RECORD_BYTES:
            raise BagDamaged(f'{source.name} has a chunk of {chunk.length:,} bytes at {chunk.start}', path=source.name)
    for chunk, record in _read_chunks(source, chunks):
        yield from _messages(_records(source, chunk, record), channels, wanted, source.name)


def _records(source: Ranged, chunk: Chunk, content: memoryview) -> memoryview:
    """The records in a chunk, or consecutive records outside chunks."""
    if not chunk.is_chunk:
        return content
    kind, length = RECORD.unpack_from(content) if len(content) >= RECORD.size else (0, 0)
    if (kind, RECORD.size + length) != (Opcode.CHUNK, chunk.length):
        raise BagDamaged(f'{source.name} has no chunk at {chunk.start}', path=source.name)
    return unpack(content[RECORD.size :], f'the chunk at {chunk.start} of {source.name}')


def _messages(content: memoryview, channels: dict[int, Channel], wanted: MessageFilter, name: str) -> Iterator[RecordedMessage]:
    for kind, _, record in records(content, name):
        if kind == Opcode.MESSAGE:
            number, sequence, log_ns, publish_ns = message_head(record, name)
            channel = channels.get(number)
            if channel is not None and wanted.start_ns <= log_ns < wanted.end_ns:
                yield RecordedMessage(channel, log_ns, publish_ns, sequence, bytes(record[MESSAGE.size :]))


def _read_chunks(source: Ranged, chunks: Sequence[Chunk]) -> Iterator[tuple[Chunk, memoryview]]:
    """Each chunk's record. Reads adjacent chunks together, a few requests ahead."""
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
