"""Finds what is intact in an MCAP file, whatever happened to it: torn anywhere, bits flipped, bytes lost or added.

One pass in the order of the file. A chunk is intact if its CRC-32 matches (or has none, and its records are complete); a record
outside of chunks is intact if its fields are consistent and another record follows it. After damage, the next intact record is
searched for. Whatever the file claims, this takes the memory of one chunk, packed and unpacked, ``MAX_CHUNK_BYTES`` each, and of
its schemas and channels, at most ``MOST_SUMMARY_BYTES``; the search reads each byte a few times at most.

``recovery.py`` completes an open slice of ours in place, ``repair.py`` copies any file: both use this.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, Metadata, Schema, Statistics

from shadowhound_data_logger.core.untrusted import partly_unpacked, unpacked
from shadowhound_data_logger.formats.mcap.format import CHUNK, MAGIC, RECORD, ChunkPacking
from shadowhound_data_logger.formats.mcap.index import UNREADABLE, length_of, parsed

MAX_CHUNK_BYTES: Final = 128 << 20
"""Packed and unpacked; larger chunks are not read by this package (``untrusted.py``)."""
MOST_SUMMARY_BYTES: Final = 64 << 20
PRIVATE: Final = 0x80
"""Opcodes from here on are private: readers skip them. ``recovery.py`` adds it to the opcode of a damaged record."""
BLOCK_BYTES: Final = 1 << 20
HINT_BYTES: Final = 4 << 20
"""Of the end of a file, where its footer is searched."""
SEARCHES: Final = 4
"""How often the search for intact records may read the file, on average."""
_LEAST: Final[Mapping[int, int]] = {
    Opcode.HEADER: 8, Opcode.FOOTER: 20, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: 22, Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6, Opcode.CHUNK_INDEX: 56, Opcode.ATTACHMENT: 36, Opcode.ATTACHMENT_INDEX: 48, Opcode.STATISTICS: 46,
    Opcode.METADATA: 8, Opcode.METADATA_INDEX: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4,
}  # fmt: skip
"""Bytes of a record's content, at least."""
_SUMMARY: Final = frozenset({
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET, Opcode.FOOTER,
})  # fmt: skip
"""What may follow the end of the data."""
_START: Final = re.compile(rb'(?=[\x02-\x07\x09\x0c\x0f].{5}\x00{3})', re.DOTALL)
"""Of a record that the search may find: one with content of its own, shorter than a terabyte."""
_CHUNK_FIELDS: Final = 40
_IN_CHUNKS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})
_FOOTER: Final = RECORD.pack(Opcode.FOOTER, _LEAST[Opcode.FOOTER])
_DATA_END: Final = RECORD.pack(Opcode.DATA_END, _LEAST[Opcode.DATA_END])
_COMPRESSIONS: Final = ('', 'zstd', 'lz4')
_INDEX_HEAD: Final = 6
_INDEX_ENTRY: Final = 16
_DECLARED: Final[Mapping[int, type[Schema | Channel]]] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}


@dataclass(frozen=True, slots=True)
class IntactRecord:
    """An intact record outside of chunks, or an unknown one. ``size`` is that of the whole record."""

    at: int
    size: int
    op: int
    content: bytes | None
    """None if it is large or of no interest here: then it is only copied."""


@dataclass(frozen=True, slots=True)
class ChunkContents:
    """The records in a chunk."""

    raw: memoryview
    index: dict[int, array[int]]
    """Of each channel with messages, in the order of the first ones: log time, offset, ..."""
    declarations: tuple[tuple[int, bytes], ...]
    """Opcode and content of its schemas and channels."""
    needs: frozenset[int]
    """Channels of its messages that it does not declare before them."""
    lost: int = 0
    """Messages of channels that are not declared anywhere: they are not in ``raw`` and ``index``."""

    @property
    def messages(self) -> int:
        return sum(len(entries) for entries in self.index.values()) // 2


@dataclass(frozen=True, slots=True)
class IntactChunk:
    """A chunk that can be kept as it is. ``size`` is that of its record."""

    at: int
    size: int
    packing: ChunkPacking
    times: tuple[int, int]
    """As the chunk itself gives them; not verified by anything."""
    contents: ChunkContents


@dataclass(frozen=True, slots=True)
class Damaged:
    """Bytes that are not, or not completely, what a writer wrote."""

    at: int
    size: int
    op: int
    """Of the record that begins there; 0 if unknown."""
    what: str
    is_torn: bool = False
    """Whether a record begins there that would end after the end of the file."""


@dataclass(frozen=True, slots=True)
class Salvaged:
    """What could be read of a damaged chunk."""

    what: str
    contents: ChunkContents | None
    is_verified: bool
    """Whether nothing contradicts the contents: false where a checksum does not match."""
    is_complete: bool
    """Whether it is known that these are all messages of the chunk, but for the ones that are counted as lost."""
    times: tuple[int, int] | None
    """As the chunk itself gives them, if its header can be read."""


Piece = IntactRecord | IntactChunk | Damaged


@dataclass(slots=True)
class Declarations:
    """The schemas and channels of a file, by id: contents of their records."""

    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    size: int = 0

    def add(self, op: int, content: bytes) -> None:
        """Keeps the first one of an id. The content was parsed before."""
        known = self.schemas if op == Opcode.SCHEMA else self.channels
        number = int.from_bytes(content[:2], 'little')
        if number not in known:
            known[number] = content
            self.size += len(content)

    def contradicts(self, op: int, content: bytes) -> bool:
        """Whether the same id is used for something else."""
        known = self.schemas if op == Opcode.SCHEMA else self.channels
        return known.get(int.from_bytes(content[:2], 'little'), content) != content

    def has_schema_of(self, channel: bytes) -> bool:
        number = int.from_bytes(channel[2:4], 'little')
        return not number or number in self.schemas


class Salvage:
    """The pieces of a file, in order; together they cover it up to its end.

    New with an open file; ``pieces`` once.
    """

    def __init__(self, file: int, told: Callable[[int], None] = lambda _: None) -> None:
        """``told`` is called with the number of bytes that were passed."""
        self._file = file
        self.size = os.fstat(file).st_size
        self.hints = Declarations()
        """Of the summary, where the end of the file is intact: some may be damaged in the data."""
        self.statistics: Statistics | None = None
        """Of the summary, the same."""
        self.is_verified = False
        """Whether the checksum of the summary matches: then its schemas and channels replace others outside of chunks."""
        self.known = Declarations()
        """Found in the data so far."""
        self.unverified = Declarations()
        """Found in damaged chunks: without them, intact chunks could not be read."""
        self._told = told
        self._is_chunked = self._is_astray = False
        """Whether there are chunks, and whether the pieces since the last one were found by the search."""
        self._follows_chunk = False
        """Whether the piece before was a chunk or the index of one."""
        self._left = SEARCHES * self.size + (16 << 20)
        """Bytes that the search may still read."""

    def pieces(self) -> Iterator[Piece]:
        """Raises only OSError. Ends after the record that ends the data, or at the end of the file."""
        self._read_hints()
        self._is_chunked = self.statistics is not None and self.statistics.chunk_count > 0
        at = 0
        while at < self.size:
            piece: Piece | None = self._first() if not at else self._piece(at)
            if piece is None or (isinstance(piece, IntactRecord) and self._is_doubtful(piece)):
                piece = self._damaged(at)
                if piece.op == Opcode.CHUNK and (contents := self.salvaged(piece).contents) is not None:
                    for op, content in contents.declarations:
                        self.unverified.add(op, content)
            elif isinstance(piece, IntactRecord) and piece.op in _IN_CHUNKS:
                piece = self._outside(piece)
            elif isinstance(piece, IntactChunk):
                for op, content in piece.contents.declarations:
                    self.known.add(op, content)
            if self.known.size > MOST_SUMMARY_BYTES:
                piece = Damaged(at, self.size - at, 0, f'its schemas and channels have more than {MOST_SUMMARY_BYTES:,} bytes')
            if isinstance(piece, IntactChunk) or piece.op == Opcode.CHUNK:
                self._is_chunked = True
            self._is_astray = self._is_astray and not isinstance(piece, IntactChunk)
            self._follows_chunk = isinstance(piece, IntactChunk) or piece.op in {Opcode.CHUNK, Opcode.MESSAGE_INDEX}
            yield piece
            self._told(piece.size)
            at = piece.at + piece.size
            if isinstance(piece, IntactRecord) and piece.op == Opcode.DATA_END:
                return

    def read(self, at: int, length: int) -> bytes:
        """At most these bytes, wherever a damaged field says that they are."""
        return os.pread(self._file, min(length, self.size - at), at) if 0 <= at < self.size and length > 0 else b''

    def _outside(self, piece: IntactRecord) -> Piece:
        """A message, schema or channel outside of chunks: where the search found it, it is one of a damaged chunk."""
        is_declared = piece.op in _DECLARED and piece.content is not None
        if self._is_chunked and self._is_astray:
            if is_declared:
                self.unverified.add(piece.op, piece.content or b'')
            return Damaged(piece.at, piece.size, piece.op, 'a record of a damaged chunk')
        if is_declared:
            piece = replace(piece, content=self._corrected(piece.op, piece.content or b''))
            self.known.add(piece.op, piece.content or b'')
        return piece

    # -- one piece -------------------------------------------------------------------------------------------------

    def _first(self) -> IntactRecord | None:
        """The magic bytes with the header; its own fields give its length where that is damaged."""
        at = len(MAGIC)
        op, length = self._head(at)
        content = self.read(at + RECORD.size, min(length, BLOCK_BYTES))
        if self.read(0, at) != MAGIC or op != Opcode.HEADER:
            return None
        known = _length(Header, content)
        start = at + RECORD.size
        if known is None or (length != known and not self._is_strong(start + length)):
            content = self.read(start, BLOCK_BYTES)
            known = _length(Header, content)
            if known is None or not self._is_strong(start + known):
                return None
            return IntactRecord(0, start + known, op, content[:known])
        return IntactRecord(0, start + length, op, content) if length <= BLOCK_BYTES else None

    def _piece(self, at: int) -> IntactRecord | IntactChunk | None:
        """The intact piece that begins there; None if there is none."""
        op, length = self._head(at)
        fits = self._fits(at, op, length)
        if op == Opcode.CHUNK and fits and length <= MAX_CHUNK_BYTES and (chunk := self._chunk(at, length)):
            return chunk
        if op not in _LEAST and (chunk := self._misnamed_chunk(at)):
            return chunk
        if fits and op != Opcode.CHUNK and (record := self._record(at, op, length)):
            return record
        return self._misnamed_chunk(at)

    def _record(self, at: int, op: int, length: int) -> IntactRecord | None:
        size, start = RECORD.size + length, at + RECORD.size
        content: bytes | None = None
        if op == Opcode.ATTACHMENT:
            is_intact = self._is_attachment(at, length)
        elif op == Opcode.DATA_END:
            next_op, next_length = self._head(at + size)
            is_intact = length == _LEAST[op] and next_op in _SUMMARY and self._fits(at + size, next_op, next_length)
            content = self.read(start, length)
        elif op == Opcode.FOOTER:
            is_intact = length == _LEAST[op] and self.read(at + size, len(MAGIC)) == MAGIC
        elif op == Opcode.MESSAGE_INDEX or (op == Opcode.MESSAGE and self._follows_chunk and self._is_index(at, length)):
            is_intact, op = self._is_index(at, length), Opcode.MESSAGE_INDEX  # a message there would be one by a damaged opcode
        elif op == Opcode.MESSAGE:
            is_intact = length <= MAX_CHUNK_BYTES and self._knows(int.from_bytes(self.read(start, 2), 'little'))
            content = self.read(start, length) if is_intact else None
        elif op in _DECLARED or op == Opcode.METADATA:
            content = self.read(start, length) if length <= MOST_SUMMARY_BYTES else None
            known = _length(_DECLARED.get(op, Metadata), content) if content is not None else None
            is_intact = known is not None and (known == length or self._is_strong(at + size))
        else:
            is_intact = op > Opcode.DATA_END
        return IntactRecord(at, size, op, content) if is_intact else None

    def _is_index(self, at: int, length: int) -> bool:
        """Whether a record can be a message index."""
        entries = int.from_bytes(self.read(at + RECORD.size + 2, 4), 'little')
        return entries + _INDEX_HEAD == length and not entries % _INDEX_ENTRY

    def _is_attachment(self, at: int, length: int) -> bool:
        """Whether the lengths in it add up, and its CRC-32 matches if it has one."""
        start, end = at + RECORD.size, at + RECORD.size + length
        place = start + 16
        for _ in range(2):  # name and media type
            place += 4 + int.from_bytes(self.read(place, 4), 'little')
            if place + 8 > end:
                return False
        place += 8 + int.from_bytes(self.read(place, 8), 'little')
        if place + 4 != end:
            return False
        told = int.from_bytes(self.read(place, 4), 'little')
        return not told or self._crc(start, place) == told

    def _crc(self, start: int, end: int) -> int:
        found = 0
        while start < end and (block := self.read(start, min(BLOCK_BYTES, end - start))):
            found = zlib.crc32(block, found)
            start += len(block)
        return found

    def _chunk(self, at: int, length: int) -> IntactChunk | None:
        found = self._unpacked(at, length)
        if found is None:
            return None
        packing, raw, times = found
        contents, end = self._walk(raw)
        if end != len(raw) or len(contents.raw) != end:
            return None
        return IntactChunk(at, RECORD.size + length, packing, times, contents)

    def _unpacked(self, at: int, length: int) -> tuple[ChunkPacking, memoryview, tuple[int, int]] | None:
        """A chunk's records, if its checksum does not contradict them; also its times, as its header has them."""
        try:
            chunk = parsed(Chunk, self.read(at + RECORD.size, length))
            packing = ChunkPacking(chunk.compression, len(chunk.data), chunk.uncompressed_size)
            raw = unpacked(chunk.compression, chunk.data, packing.size) if chunk.compression else chunk.data
        except (*UNREADABLE, ValueError):
            return None
        if length != _CHUNK_FIELDS + len(chunk.compression.encode()) + packing.compressed or len(raw) != packing.size:
            return None
        if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
            return None
        return packing, memoryview(raw), (chunk.message_start_time, chunk.message_end_time)

    def _misnamed_chunk(self, at: int) -> IntactChunk | None:
        """A chunk whose opcode or length is damaged: its own fields give its length, and its CRC-32 confirms it."""
        length = self._chunk_length(at)
        if not length or self.read(at + RECORD.size + CHUNK.size - 4, 4) == bytes(4):
            return None
        if length > MAX_CHUNK_BYTES or at + RECORD.size + length > self.size or not self._spend(length):
            return None
        return self._chunk(at, length)

    def _walk(self, raw: memoryview) -> tuple[ChunkContents, int]:
        """The records in a chunk, and where the first incomplete one begins. Messages of unknown channels are removed."""
        index: dict[int, array[int]] = {}
        declared = Declarations()
        declarations: list[tuple[int, bytes]] = []
        parts: list[memoryview] = []
        needs = set[int]()
        at, start, removed, lost, end = 0, 0, 0, 0, len(raw)
        while at + RECORD.size <= end:
            op, length = RECORD.unpack_from(raw, at)
            after = at + RECORD.size + length
            if after > end or length < _LEAST.get(op, 0) or not op:
                break
            if op == Opcode.MESSAGE:
                number, _, log_ns = struct.unpack_from('<HIQ', raw, at + RECORD.size)
                if number not in index and not self._knows(number, declared):
                    parts.append(raw[start:at])
                    removed, start, lost = removed + after - at, after, lost + 1
                else:
                    if number not in index and number not in declared.channels:
                        needs.add(number)
                    index.setdefault(number, array('Q')).extend((log_ns, at - removed))
            elif op in _DECLARED:
                content = bytes(raw[at + RECORD.size : after])
                if _length(_DECLARED[op], content) != length:
                    break  # also where more follows its fields: the reference reader loses its way there
                is_unusable = op == Opcode.CHANNEL and not any(
                    each.has_schema_of(content) for each in (declared, *self._sources())
                )
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

    def _corrected(self, op: int, content: bytes) -> bytes:
        """A schema or channel outside of chunks, for which there is no checksum but that of the summary."""
        hints = self.hints.schemas if op == Opcode.SCHEMA else self.hints.channels
        return hints.get(int.from_bytes(content[:2], 'little'), content) if self.is_verified else content

    # -- damage ----------------------------------------------------------------------------------------------------

    def _is_doubtful(self, record: IntactRecord) -> bool:
        """Whether a record has nothing but its own length to confirm it, and what follows is not a record."""
        if record.op != Opcode.MESSAGE and record.op <= Opcode.DATA_END:
            return False
        after = record.at + record.size
        if self._is_record(after):
            return False
        found = self._search(record.at + 1)
        return found < self.size and found != after

    def _damaged(self, at: int) -> Damaged:
        op, length = self._head(at)
        fits = self._fits(at, op, length)
        if not at:
            end = self._search(1)
            return Damaged(0, end, 0, 'the beginning of the file is missing')
        end = at + RECORD.size + length
        if not fits or (end < self.size and not self._is_strong(end)):
            self._is_astray = True
            end = self._search(at + 1, at + RECORD.size + self._chunk_length(at) if op == Opcode.CHUNK else 0)
        is_torn = end == self.size and not fits and bool(op)
        if op == Opcode.CHUNK:
            return Damaged(at, end - at, op, 'a chunk', is_torn)
        is_framed = fits and end == at + RECORD.size + length
        return Damaged(at, end - at, op if is_framed else 0, _name(op, is_torn=is_torn), is_torn)

    def salvaged(self, damaged: Damaged) -> Salvaged:
        """What can be read of a chunk that is torn, or contradicts itself."""
        start, is_torn = damaged.at + RECORD.size, damaged.is_torn
        head = self.read(start, min(damaged.size - RECORD.size, _CHUNK_FIELDS + 256))
        what = 'a chunk that is torn' if is_torn else 'a chunk whose header is damaged'
        if len(head) < _CHUNK_FIELDS:
            return Salvaged(what, None, False, False, None)
        start_ns, end_ns, size, crc = CHUNK.unpack_from(head)
        times = (start_ns, end_ns) if start_ns <= end_ns else None
        length = int.from_bytes(head[CHUNK.size : CHUNK.size + 4], 'little')
        name = head[CHUNK.size + 4 : CHUNK.size + 4 + length].decode(errors='replace')
        if not is_torn:
            return self._contradictory(damaged, name, size, crc, times)
        if name not in _COMPRESSIONS or size > MAX_CHUNK_BYTES:
            return Salvaged(f'{what}, and compressed with {name[:20]!r}', None, False, False, times)
        data = self._packed(damaged, name, head)
        raw = partly_unpacked(name, data, size) if name else data
        return Salvaged(what, self._walk(memoryview(raw))[0], True, False, times)

    def _packed(self, damaged: Damaged, compression: str, head: bytes) -> bytes:
        """The content of a chunk that is compressed so, as far as it is there."""
        place = CHUNK.size + 4 + len(compression)
        length = min(int.from_bytes(head[place : place + 8], 'little'), damaged.size - RECORD.size - place - 8, MAX_CHUNK_BYTES)
        return self.read(damaged.at + RECORD.size + place + 8, max(length, 0))

    def _contradictory(self, damaged: Damaged, name: str, size: int, crc: int, times: tuple[int, int] | None) -> Salvaged:
        """A chunk that is all there: its checksum tells which of its fields are wrong."""
        best, what = None, f'a chunk that is compressed with {name[:20]!r}, which is not supported'
        head = self.read(damaged.at + RECORD.size, _CHUNK_FIELDS + 4)
        for compression in sorted(_COMPRESSIONS, key=lambda each: each != name):
            data = self._packed(damaged, compression, head)
            likely = 16 * len(data) + BLOCK_BYTES  # also where the size is what is wrong
            most = size if likely < size <= MAX_CHUNK_BYTES else min(likely, MAX_CHUNK_BYTES)
            raw = partly_unpacked(compression, data, most) if compression else data
            contents, end = self._walk(memoryview(raw))
            if crc and zlib.crc32(raw) == crc:
                what = f'{contents.lost} messages of unknown channels' if contents.lost else 'wrong fields of a chunk'
                return Salvaged(what, contents, True, end == len(raw), times)
            if compression == name:
                is_whole = not crc and len(raw) == size and end == size
                what = 'a chunk whose checksum does not match' if crc else 'a chunk with records that are not complete'
                what = f'{contents.lost} messages of unknown channels' if is_whole and contents.lost else what
                best = Salvaged(what, contents, is_whole, is_whole, times)
        return best or Salvaged(what, None, False, False, times)

    def _chunk_length(self, at: int) -> int:
        """Of a chunk's content, by its own fields; 0 if they make no sense."""
        head = self.read(at + RECORD.size, _CHUNK_FIELDS + 4)
        name_length = int.from_bytes(head[CHUNK.size : CHUNK.size + 4], 'little')
        place = CHUNK.size + 4 + name_length
        if head[CHUNK.size + 4 : place].decode(errors='replace') not in _COMPRESSIONS or place + 8 > len(head):
            return 0
        return place + 8 + int.from_bytes(head[place : place + 8], 'little')

    def _search(self, start: int, chunk_end: int = 0) -> int:
        """Where the next intact piece begins; the end of the file if there is none, or it would take too long to find it.

        Up to ``chunk_end`` there is a chunk, whose own records are no pieces.
        """
        while start < self.size and self._spend(BLOCK_BYTES // 16):
            block = self.read(start, BLOCK_BYTES + RECORD.size)
            is_zeros = block.count(0) == len(block)
            for match in () if is_zeros else _START.finditer(block, 0, min(BLOCK_BYTES, len(block)) + RECORD.size):
                at = start + match.start()
                is_outside = at >= chunk_end or block[match.start()] not in _IN_CHUNKS
                if match.start() < BLOCK_BYTES and is_outside and self._is_strong(at):
                    return at
                if self._left <= 0:
                    return self.size
            self._spend(len(block))
            start += BLOCK_BYTES
        return self.size

    def _is_strong(self, at: int) -> bool:
        """Whether a record found by the search is surely one: verified by its checksum, or followed by another."""
        op, length = self._head(at)
        if not self._fits(at, op, length) or not self._spend(min(length, MAX_CHUNK_BYTES)):
            return False
        if op == Opcode.CHUNK and self.read(at + RECORD.size + CHUNK.size - 4, 4) != bytes(4):
            return length <= MAX_CHUNK_BYTES and self._unpacked(at, length) is not None  # also one of unknown channels
        piece = self._piece(at)
        if piece is None:
            return False
        after = at + piece.size
        if after >= self.size:
            return op != Opcode.MESSAGE_INDEX if isinstance(piece, IntactRecord) else bool(piece.contents.messages)
        return op == Opcode.FOOTER or self._is_record(after)

    def _is_record(self, at: int) -> bool:
        """Whether a record seems to begin there; also one that is torn, at the end of the file."""
        if at + RECORD.size > self.size:
            return True
        op, length = self._head(at)
        if self._fits(at, op, length):
            return True
        return op in {Opcode.CHUNK, Opcode.MESSAGE} and _LEAST[op] <= length <= MAX_CHUNK_BYTES

    # -- helpers ---------------------------------------------------------------------------------------------------

    def _head(self, at: int) -> tuple[int, int]:
        start = self.read(at, RECORD.size)
        return RECORD.unpack(start) if len(start) == RECORD.size else (0, 0)

    def _fits(self, at: int, op: int, length: int) -> bool:
        return bool(op) and length >= _LEAST.get(op, 0) and at + RECORD.size + length <= self.size

    def _knows(self, channel: int, more: Declarations | None = None) -> bool:
        """Whether a channel is declared, with its schema."""
        every = [*([] if more is None else [more]), *self._sources()]
        content = next((each.channels[channel] for each in every if channel in each.channels), None)
        return content is not None and any(each.has_schema_of(content) for each in every)

    def _sources(self) -> tuple[Declarations, ...]:
        return self.known, self.hints, self.unverified

    def _spend(self, count: int) -> bool:
        self._left -= count
        return self._left > 0

    def _read_hints(self) -> None:
        """The schemas and channels of the summary, as far as there is one; bytes may follow the end of the file, or be lost."""
        start = max(self.size - HINT_BYTES, 0)
        tail = self.read(start, HINT_BYTES)
        footer_at = tail.rfind(_FOOTER)
        if footer_at < 0 or footer_at + len(_FOOTER) + _LEAST[Opcode.FOOTER] > len(tail):
            return
        content = tail[footer_at + len(_FOOTER) :][: _LEAST[Opcode.FOOTER]]
        footer, end = parsed(Footer, content), start + footer_at + len(_FOOTER) + len(content) - 4
        after_data = tail.rfind(_DATA_END, 0, footer_at)
        for at in (footer.summary_start, start + after_data + len(_DATA_END) + 4 if after_data >= 0 else 0):
            if len(MAGIC) <= at < end and end - at <= MOST_SUMMARY_BYTES:
                self.is_verified = bool(footer.summary_crc) and self._crc(at, end) == footer.summary_crc
                self._read_summary(at)
                if self.is_verified:
                    return

    def _read_summary(self, at: int) -> None:
        while len(MAGIC) <= at < self.size and self.hints.size < MOST_SUMMARY_BYTES:
            op, length = self._head(at)
            if op not in _SUMMARY or not self._fits(at, op, length) or op == Opcode.FOOTER or length > MOST_SUMMARY_BYTES:
                return
            if op in _DECLARED:
                content = self.read(at + RECORD.size, length)
                if _length(_DECLARED[op], content) is None:
                    return
                self.hints.add(op, content)
            elif op == Opcode.STATISTICS:
                with suppress(*UNREADABLE):
                    self.statistics = parsed(Statistics, self.read(at + RECORD.size, length))
            at += RECORD.size + length


def _length(kind: type[Schema | Channel | Metadata | Header], content: bytes) -> int | None:
    """Of a record's fields; None where they are not complete, or make no sense: no schema has the number 0."""
    if kind is Schema and content[:2] == bytes(2):
        return None
    try:
        return length_of(kind, content)
    except UNREADABLE:
        return None


def _name(op: int, *, is_torn: bool) -> str:
    try:
        name = Opcode(op).name.lower().replace('_', ' ')
    except ValueError:
        return 'bytes that are not a record'
    return f'a record that is torn ({name})' if is_torn else f'a record with wrong content ({name})'
