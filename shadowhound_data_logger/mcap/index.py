"""What an MCAP file holds and where, read from its end: channels, statistics, and the place of every chunk.

The format: https://mcap.dev/spec. Two short reads tell all of it, so a file in a store is not downloaded for it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.mcap.format import MAGIC, RECORD, Op
from shadowhound_data_logger.mcap.ranges import Ranged
from shadowhound_data_logger.mcap.rosbag2_metadata import in_numbers
from shadowhound_data_logger.mcap.slice_info import Channel

FOOTER_BYTES: Final = 20
TAIL_BYTES: Final = RECORD.size + FOOTER_BYTES + len(MAGIC)
FIRST_READ: Final = 64 << 10
"""From the end: the whole summary of most slices, so that one request does."""
MOST_SUMMARY_BYTES: Final = 64 << 20
"""That of a hundred thousand chunks: a bag of 100 GB in one file."""
_CHUNK_INDEX = struct.Struct('<QQQQ')
_STATISTICS = struct.Struct('<QHIIIIQQ')
_ID_COUNT = struct.Struct('<HQ')
INDEX_HEAD: Final = 15
"""Bytes of a message index record before its entries: head, channel, length of the entries."""
INDEX_ENTRY: Final = 16


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


@dataclass(slots=True)
class Schemas:
    """Channels as they are found, and the schemas that they need."""

    channels: dict[int, Channel] = field(default_factory=dict)
    _schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)

    def add(self, kind: int, content: memoryview) -> None:
        """A schema or channel record."""
        fields = Fields(content)
        number = fields.uint(2)
        if kind == Op.SCHEMA:
            self._schemas[number] = fields.text(), fields.text(), fields.text()
            return
        name, encoding, definition = self._schemas.get(fields.uint(2), ('', '', ''))
        topic, _, metadata = fields.text(), fields.text(), fields.texts()
        self.channels[number] = Channel(
            topic=topic, type=name, encoding=encoding, definition=definition,
            type_hash=metadata.get('topic_type_hash', ''), qos=in_numbers(metadata.get('offered_qos_profiles', '')),
        )  # fmt: skip


def read_index(source: Ranged) -> McapIndex:
    """Raises BagDamaged for what is no whole MCAP file."""
    tail_length = min(source.size, FIRST_READ)
    if tail_length < len(MAGIC) + TAIL_BYTES:
        raise BagDamaged(f'{source.name} is no MCAP file: it has {source.size} bytes', path=source.name)
    tail_start = source.size - tail_length
    tail = source.read(tail_start, tail_length)
    if not tail.endswith(MAGIC):
        remedy = 'it was cut off; slices of this package are recovered when the node starts again, for others see `mcap recover`'
        raise BagDamaged(f'{source.name} has no end of an MCAP file', remedy=remedy, path=source.name)
    kind, length = RECORD.unpack_from(tail, tail_length - TAIL_BYTES)
    if (kind, length) != (Op.FOOTER, FOOTER_BYTES):
        raise BagDamaged(f'{source.name} has no footer of an MCAP file', path=source.name)
    footer_start = source.size - TAIL_BYTES
    summary_start = int.from_bytes(tail[-TAIL_BYTES + RECORD.size :][:8], 'little')
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


class Fields:
    """Reads the fields of a record one after the other; what is not there raises struct.error or UnicodeDecodeError."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._place = 0

    def uint(self, size: int) -> int:
        return int.from_bytes(self._take(size), 'little')

    def text(self) -> str:
        return str(self._take(self.uint(4)), 'utf-8')

    def texts(self) -> dict[str, str]:
        inner = Fields(self._take(self.uint(4)))
        found: dict[str, str] = {}
        while inner.left:
            name = inner.text()
            found[name] = inner.text()
        return found

    def numbers(self) -> dict[int, int]:
        """A map from channel to a number."""
        return dict(_ID_COUNT.iter_unpack(self._take(self.uint(4))))

    def unpack(self, form: struct.Struct) -> tuple[int, ...]:
        return form.unpack(self._take(form.size))

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def rest(self) -> memoryview:
        return self._content[self._place :]

    def _take(self, size: int) -> memoryview:
        if size > self.left:
            raise struct.error(f'{size} bytes are wanted, {self.left} are left')
        self._place += size
        return self._content[self._place - size : self._place]


def _index(summary: memoryview, data_end: int, source: Ranged) -> McapIndex:
    schemas, chunks, statistics, counts = Schemas(), [], None, {}
    try:
        for kind, _, content in records(summary, source.name):
            if kind in {Op.SCHEMA, Op.CHANNEL}:
                schemas.add(kind, content)
            elif kind == Op.CHUNK_INDEX:
                chunks.append(_chunk(Fields(content), data_end))
            elif kind == Op.STATISTICS:
                fields = Fields(content)
                statistics = fields.unpack(_STATISTICS)
                counts = fields.numbers()
    except (struct.error, UnicodeDecodeError) as error:
        raise BagDamaged(f'{source.name} has a summary that cannot be read: {error}', path=source.name) from error
    messages, t_start_ns, t_end_ns = (statistics[0], statistics[6], statistics[7]) if statistics else (0, 0, 0)
    known = statistics is not None and sum(counts.values()) == messages and counts.keys() <= schemas.channels.keys()
    reached = sum(sum(chunk.counts.values()) for chunk in chunks)
    is_indexed = known and reached == messages
    chunks.sort(key=lambda chunk: chunk.start)
    return McapIndex(schemas.channels, tuple(chunks), counts, messages, t_start_ns, t_end_ns, data_end, is_indexed)


def _chunk(fields: Fields, data_end: int) -> Chunk:
    t_start_ns, t_end_ns, start, length = fields.unpack(_CHUNK_INDEX)
    offsets = fields.numbers()
    index_length = fields.uint(8)
    end = start + length + index_length
    if end > data_end:
        raise struct.error(f'a chunk ends at {end}, outside the data')
    ordered = sorted((place, channel) for channel, place in offsets.items())
    ends = [place for place, _ in ordered[1:]] + [end]
    counts = {
        channel: max(after - place - INDEX_HEAD, 0) // INDEX_ENTRY for (place, channel), after in zip(ordered, ends, strict=True)
    }
    return Chunk(start, length, t_start_ns, t_end_ns, counts)
