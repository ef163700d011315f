"""Finds the intact records of a damaged MCAP file: verifies the record at an offset, and searches for the next intact one.

A chunk is intact if its CRC-32 matches, or if it has none and its records are complete. A record outside chunks is intact if its
fields are consistent and another record follows it. For any input, memory is bounded by one chunk, compressed and uncompressed,
``MAX_CHUNK_BYTES`` each, and by the schemas and channels, ``MAX_SUMMARY_BYTES``. The search reads each byte at most ``SEARCHES``
times on average.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata, Schema

from shadowhound_data_logger.core.untrusted import MAX_CHUNK_BYTES, decompress
from shadowhound_data_logger.formats.mcap.format import CHUNK, MAGIC, RECORD, ChunkPacking
from shadowhound_data_logger.formats.mcap.index import MAX_SUMMARY_BYTES, UNREADABLE, parse, parsed_length

BLOCK_BYTES: Final = 1 << 20
SEARCHES: Final = 4
"""How often the search for intact records may read the file, on average."""
CHUNK_FIELDS: Final = 40
"""Size of a chunk's fields, without the name of its compression and the data."""
COMPRESSIONS: Final = ('', 'zstd', 'lz4')
DECLARATIONS: Final[Mapping[int, type[Schema | Channel]]] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
IN_CHUNKS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})
"""Records that chunks contain."""
INDEX_HEAD: Final = 6
"""Bytes in a message index before its entries."""
INDEX_ENTRY: Final = 16
MIN_BYTES: Final[Mapping[int, int]] = {
    Opcode.HEADER: 8, Opcode.FOOTER: 20, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: 22, Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6, Opcode.CHUNK_INDEX: 56, Opcode.ATTACHMENT: 36, Opcode.ATTACHMENT_INDEX: 48, Opcode.STATISTICS: 46,
    Opcode.METADATA: 8, Opcode.METADATA_INDEX: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4,
}  # fmt: skip
"""Minimum size of a record's content."""
SUMMARY: Final = frozenset({
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET, Opcode.FOOTER,
})  # fmt: skip
"""Records that may follow the end of the data."""
_START: Final = re.compile(rb'(?=[\x02-\x07\x09\x0c\x0f].{5}\x00{3})', re.DOTALL)
"""The start of a record that the search looks for: not an index, and shorter than a terabyte."""


@dataclass(frozen=True, slots=True)
class IntactRecord:
    """An intact or unknown record outside chunks. ``size`` is the size of the whole record."""

    at: int
    size: int
    op: int
    content: bytes | None
    """None if the record is large or only needs to be copied."""


@dataclass(frozen=True, slots=True)
class ChunkContents:
    """The records in a chunk."""

    raw: memoryview
    index: dict[int, array[int]]
    """Log times and offsets (time, offset, time, ...) by channel, in the order of the first messages."""
    declarations: tuple[tuple[int, bytes], ...]
    """Opcode and content of its schemas and channels."""
    needs: frozenset[int]
    """Channels of its messages that it does not declare before them."""
    lost: int = 0
    """The number of messages with undeclared channels; ``raw`` and ``index`` do not contain them."""

    @property
    def messages(self) -> int:
        return sum(len(entries) for entries in self.index.values()) // 2


@dataclass(frozen=True, slots=True)
class IntactChunk:
    """A chunk that can be kept unchanged. ``size`` is that of its record."""

    at: int
    size: int
    packing: ChunkPacking
    times: tuple[int, int]
    """The times in its header, which no checksum covers."""
    contents: ChunkContents


@dataclass(slots=True)
class Declarations:
    """The schemas and channels of a file: contents of their records by id."""

    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    size: int = 0

    def add(self, op: int, content: bytes) -> None:
        """Keep the first one with an id. The content must have been parsed before."""
        known = self.schemas if op == Opcode.SCHEMA else self.channels
        number = int.from_bytes(content[:2], 'little')
        if number not in known:
            known[number] = content
            self.size += len(content)

    def contradicts(self, op: int, content: bytes) -> bool:
        """Whether another schema or channel has the same id."""
        known = self.schemas if op == Opcode.SCHEMA else self.channels
        return known.get(int.from_bytes(content[:2], 'little'), content) != content

    def has_schema_of(self, channel: bytes) -> bool:
        number = int.from_bytes(channel[2:4], 'little')
        return not number or number in self.schemas


class RecordFinder:
    """Reads an open file by offset, and knows the schemas and channels that were found so far.

    ``DamageScan`` sets the declarations and ``follows_chunk`` while it walks through the file. All methods raise only OSError.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self.size = os.fstat(file).st_size
        self.known = Declarations()
        """Found in the data so far."""
        self.summary = Declarations()
        """From the summary, if the end of the file is intact; they may be damaged in the data."""
        self.unverified = Declarations()
        """Found in damaged chunks: intact chunks may need them."""
        self.follows_chunk = False
        """Whether the previous piece was a chunk or a message index."""
        self._budget = SEARCHES * self.size + (16 << 20)
        """Bytes that the search may still read."""

    @property
    def sources(self) -> tuple[Declarations, Declarations, Declarations]:
        """All declarations, most reliable first."""
        return self.known, self.summary, self.unverified

    # -- bytes -----------------------------------------------------------------------------------------------------

    def read(self, at: int, length: int) -> bytes:
        """At most ``length`` bytes; damaged fields may give any offset and length."""
        return os.pread(self._file, min(length, self.size - at), at) if 0 <= at < self.size and length > 0 else b''

    def crc(self, start: int, end: int) -> int:
        """The CRC-32 of these bytes."""
        found = 0
        while start < end and (block := self.read(start, min(BLOCK_BYTES, end - start))):
            found, start = zlib.crc32(block, found), start + len(block)
        return found

    def opcode_and_length(self, at: int) -> tuple[int, int]:
        """The first fields of a record; zeros at the end of the file."""
        start = self.read(at, RECORD.size)
        return RECORD.unpack(start) if len(start) == RECORD.size else (0, 0)

    def fits(self, at: int, op: int, length: int) -> bool:
        """Whether a record's length is possible and within the file."""
        return bool(op) and length >= MIN_BYTES.get(op, 0) and at + RECORD.size + length <= self.size

    # -- one record ------------------------------------------------------------------------------------------------

    def first(self) -> IntactRecord | None:
        """The magic bytes and the header. If its length is damaged, it is computed from the fields."""
        at = len(MAGIC)
        op, length = self.opcode_and_length(at)
        content = self.read(at + RECORD.size, min(length, BLOCK_BYTES))
        if self.read(0, at) != MAGIC or op != Opcode.HEADER:
            return None
        known = fields_length(Header, content)
        start = at + RECORD.size
        if known is None or (length != known and not self.is_confirmed(start + length)):
            content = self.read(start, BLOCK_BYTES)
            known = fields_length(Header, content)
            if known is None or not self.is_confirmed(start + known):
                return None
            return IntactRecord(0, start + known, op, content[:known])
        return IntactRecord(0, start + length, op, content) if length <= BLOCK_BYTES else None

    def piece(self, at: int) -> IntactRecord | IntactChunk | None:
        """The intact record or chunk at an offset; None if there is none."""
        op, length = self.opcode_and_length(at)
        fits = self.fits(at, op, length)
        if op == Opcode.CHUNK and fits and length <= MAX_CHUNK_BYTES and (chunk := self._chunk(at, length)):
            return chunk
        if op not in MIN_BYTES and (chunk := self._misnamed_chunk(at)):
            return chunk
        if fits and op != Opcode.CHUNK and (record := self._record(at, op, length)):
            return record
        return self._misnamed_chunk(at)

    def _record(self, at: int, op: int, length: int) -> IntactRecord | None:
        size, start = RECORD.size + length, at + RECORD.size
        content: bytes | None = None
        if op == Opcode.ATTACHMENT:
            is_intact = _is_attachment(self, at, length)
        elif op == Opcode.DATA_END:
            next_op, next_length = self.opcode_and_length(at + size)
            is_intact = length == MIN_BYTES[op] and next_op in SUMMARY and self.fits(at + size, next_op, next_length)
            content = self.read(start, length)
        elif op == Opcode.FOOTER:
            is_intact = length == MIN_BYTES[op] and self.read(at + size, len(MAGIC)) == MAGIC
        elif op == Opcode.MESSAGE_INDEX or (op == Opcode.MESSAGE and self.follows_chunk and self._is_index(at, length)):
            is_intact, op = self._is_index(at, length), Opcode.MESSAGE_INDEX  # after a chunk, the opcode of a message is damage
        elif op == Opcode.MESSAGE:
            is_intact = length <= MAX_CHUNK_BYTES and self._has_channel(int.from_bytes(self.read(start, 2), 'little'))
            content = self.read(start, length) if is_intact else None
        elif op in DECLARATIONS or op == Opcode.METADATA:
            content = self.read(start, length) if length <= MAX_SUMMARY_BYTES else None
            known = fields_length(DECLARATIONS.get(op, Metadata), content) if content is not None else None
            is_intact = known is not None and (known == length or self.is_confirmed(at + size))
        else:
            is_intact = op > Opcode.DATA_END
        return IntactRecord(at, size, op, content) if is_intact else None

    def _is_index(self, at: int, length: int) -> bool:
        """Whether the record has the layout of a message index."""
        entries = int.from_bytes(self.read(at + RECORD.size + 2, 4), 'little')
        return entries + INDEX_HEAD == length and not entries % INDEX_ENTRY

    def _chunk(self, at: int, length: int) -> IntactChunk | None:
        found = self._unpack_chunk(at, length)
        if found is None:
            return None
        packing, raw, times = found
        contents, end = self.walk_chunk(raw)
        if end != len(raw) or len(contents.raw) != end:
            return None
        return IntactChunk(at, RECORD.size + length, packing, times, contents)

    def _unpack_chunk(self, at: int, length: int) -> tuple[ChunkPacking, memoryview, tuple[int, int]] | None:
        """The records of a chunk, unless its checksum contradicts them, and the times in its header."""
        try:
            chunk = parse(Chunk, self.read(at + RECORD.size, length))
            packing = ChunkPacking(chunk.compression, len(chunk.data), chunk.uncompressed_size)
            raw = decompress(chunk.compression, chunk.data, packing.size) if chunk.compression else chunk.data
        except (*UNREADABLE, ValueError):
            return None
        if length != CHUNK_FIELDS + len(chunk.compression.encode()) + packing.compressed or len(raw) != packing.size:
            return None
        if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
            return None
        return packing, memoryview(raw), (chunk.message_start_time, chunk.message_end_time)

    def _misnamed_chunk(self, at: int) -> IntactChunk | None:
        """A chunk with a damaged opcode or length: its length is computed from its fields and confirmed by its CRC-32."""
        length = self.chunk_length(at)
        if not length or self.read(at + RECORD.size + CHUNK.size - 4, 4) == bytes(4):
            return None
        if length > MAX_CHUNK_BYTES or at + RECORD.size + length > self.size or not self._spend(length):
            return None
        return self._chunk(at, length)

    def walk_chunk(self, raw: memoryview) -> tuple[ChunkContents, int]:
        """The records in a chunk without messages of unknown channels, and the offset of the first incomplete record."""
        index: dict[int, array[int]] = {}
        declared = Declarations()
        declarations: list[tuple[int, bytes]] = []
        parts: list[memoryview] = []
        needs = set[int]()
        at, start, removed, lost, end = 0, 0, 0, 0, len(raw)
        while at + RECORD.size <= end:
            op, length = RECORD.unpack_from(raw, at)
            after = at + RECORD.size + length
            if after > end or length < MIN_BYTES.get(op, 0) or not op:
                break
            if op == Opcode.MESSAGE:
                number, _, log_ns = struct.unpack_from('<HIQ', raw, at + RECORD.size)
                if number not in index and not self._has_channel(number, declared):
                    parts.append(raw[start:at])
                    removed, start, lost = removed + after - at, after, lost + 1
                else:
                    if number not in index and number not in declared.channels:
                        needs.add(number)
                    index.setdefault(number, array('Q')).extend((log_ns, at - removed))
            elif op in DECLARATIONS:
                content = bytes(raw[at + RECORD.size : after])
                if fields_length(DECLARATIONS[op], content) != length:
                    break  # the reference reader cannot continue after additional bytes either
                is_unusable = op == Opcode.CHANNEL and not any(each.has_schema_of(content) for each in (declared, *self.sources))
                if is_unusable or self.known.contradicts(op, content):
                    parts.append(raw[start:at])
                    removed, start = removed + after - at, after
                else:
                    declared.add(op, content)
                    declarations.append((op, content))
            at = after
        kept = raw[start:at]
        if parts:
            kept = memoryview(b''.join([*parts, kept]))
        return ChunkContents(kept, index, tuple(declarations), frozenset(needs), lost), at

    def chunk_length(self, at: int) -> int:
        """The length of a chunk's content according to its fields; 0 if they are invalid."""
        head = self.read(at + RECORD.size, CHUNK_FIELDS + 4)
        name_length = int.from_bytes(head[CHUNK.size : CHUNK.size + 4], 'little')
        place = CHUNK.size + 4 + name_length
        if head[CHUNK.size + 4 : place].decode(errors='replace') not in COMPRESSIONS or place + 8 > len(head):
            return 0
        return place + 8 + int.from_bytes(head[place : place + 8], 'little')

    def _has_channel(self, channel: int, more: Declarations | None = None) -> bool:
        """Whether a channel and its schema are declared."""
        every = [*([] if more is None else [more]), *self.sources]
        content = next((each.channels[channel] for each in every if channel in each.channels), None)
        return content is not None and any(each.has_schema_of(content) for each in every)

    # -- search ----------------------------------------------------------------------------------------------------

    def search(self, start: int, chunk_end: int = 0) -> int:
        """The offset of the next intact record or chunk; the end of the file if there is none or the budget is used up.

        Before ``chunk_end``, records that chunks contain are ignored: they belong to a damaged chunk.
        """
        while start < self.size and self._spend(BLOCK_BYTES // 16):
            block = self.read(start, BLOCK_BYTES + RECORD.size)
            is_zeros = block.count(0) == len(block)
            for match in () if is_zeros else _START.finditer(block, 0, min(BLOCK_BYTES, len(block)) + RECORD.size):
                at = start + match.start()
                is_outside = at >= chunk_end or block[match.start()] not in IN_CHUNKS
                if match.start() < BLOCK_BYTES and is_outside and self.is_confirmed(at):
                    return at
                if self._budget <= 0:
                    return self.size
            self._spend(len(block))
            start += BLOCK_BYTES
        return self.size

    def is_confirmed(self, at: int) -> bool:
        """Whether there is certainly a record: its checksum matches, or another record follows."""
        op, length = self.opcode_and_length(at)
        if not self.fits(at, op, length) or not self._spend(min(length, MAX_CHUNK_BYTES)):
            return False
        if op == Opcode.CHUNK and self.read(at + RECORD.size + CHUNK.size - 4, 4) != bytes(4):
            return length <= MAX_CHUNK_BYTES and self._unpack_chunk(at, length) is not None  # its channels may be unknown
        piece = self.piece(at)
        if piece is None:
            return False
        after = at + piece.size
        if after >= self.size:
            return op != Opcode.MESSAGE_INDEX if isinstance(piece, IntactRecord) else bool(piece.contents.messages)
        return op == Opcode.FOOTER or self.is_record(after)

    def is_record(self, at: int) -> bool:
        """Whether there seems to be a record; it may be truncated by the end of the file."""
        if at + RECORD.size > self.size:
            return True
        op, length = self.opcode_and_length(at)
        if self.fits(at, op, length):
            return True
        return op in {Opcode.CHUNK, Opcode.MESSAGE} and MIN_BYTES[op] <= length <= MAX_CHUNK_BYTES

    def _spend(self, count: int) -> bool:
        """Charge bytes to the budget of the search; False if it is used up."""
        self._budget -= count
        return self._budget > 0


def fields_length(kind: type[Schema | Channel | Metadata | Header], content: bytes) -> int | None:
    """The length of a record's fields; None if they are incomplete or invalid: no schema has the id 0."""
    if kind is Schema and content[:2] == bytes(2):
        return None
    try:
        return parsed_length(kind, content)
    except UNREADABLE:
        return None


def _is_attachment(finder: RecordFinder, at: int, length: int) -> bool:
    """Whether its lengths are consistent, and its CRC-32 matches if it has one."""
    start, end = at + RECORD.size, at + RECORD.size + length
    place = start + 16
    for _ in range(2):  # name and media type
        place += 4 + int.from_bytes(finder.read(place, 4), 'little')
        if place + 8 > end:
            return False
    place += 8 + int.from_bytes(finder.read(place, 8), 'little')
    if place + 4 != end:
        return False
    crc = int.from_bytes(finder.read(place, 4), 'little')
    return not crc or finder.crc(start, place) == crc
