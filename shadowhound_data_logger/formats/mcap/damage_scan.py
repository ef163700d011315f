"""Splits a damaged MCAP file into intact and damaged pieces: truncated anywhere, with flipped, lost or added bytes.

One pass in file order. After damage, the scan continues at the next intact record (``record_finder.py``, which also states the
limits of memory and time). ``recovery.py`` completes one of our open slices in place, ``repair.py`` copies any file: both use
this scan.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Footer, Statistics

from shadowhound_data_logger.core.untrusted import MAX_CHUNK_BYTES, decompress_damaged
from shadowhound_data_logger.formats.mcap.format import CHUNK, MAGIC, RECORD
from shadowhound_data_logger.formats.mcap.index import MAX_SUMMARY_BYTES, UNREADABLE, parse
from shadowhound_data_logger.formats.mcap.record_finder import (
    BLOCK_BYTES,
    CHUNK_FIELDS,
    COMPRESSIONS,
    DECLARATIONS,
    IN_CHUNKS,
    MIN_BYTES,
    SUMMARY,
    ChunkContents,
    IntactChunk,
    IntactRecord,
    RecordFinder,
    fields_length,
)

PRIVATE: Final = 0x80
"""The first private opcode: readers skip such records. ``recovery.py`` adds it to the opcode of a damaged record."""
TAIL_BYTES: Final = 4 << 20
"""The footer is searched in this many bytes at the end of the file."""
_FOOTER: Final = RECORD.pack(Opcode.FOOTER, MIN_BYTES[Opcode.FOOTER])
_DATA_END: Final = RECORD.pack(Opcode.DATA_END, MIN_BYTES[Opcode.DATA_END])


@dataclass(frozen=True, slots=True)
class Damaged:
    """Bytes that differ, at least in part, from those that the writer wrote."""

    at: int
    size: int
    op: int
    """Opcode of the record that starts there; 0 if unknown."""
    what: str
    is_torn: bool = False
    """Whether a record starts there that continues after the end of the file."""


@dataclass(frozen=True, slots=True)
class RecoveredChunk:
    """The readable part of a damaged chunk."""

    what: str
    contents: ChunkContents | None
    is_verified: bool
    """Whether nothing contradicts the contents; False if a checksum does not match."""
    is_complete: bool
    """Whether the contents certainly have all messages of the chunk, except those count_by_channel as lost."""
    times: tuple[int, int] | None
    """The times in its header, if it can be read."""


Piece = IntactRecord | IntactChunk | Damaged


class DamageScan:
    """The pieces of a file in order; together they cover it up to its end.

    Lifecycle: new with an open file; ``pieces`` once.
    """

    def __init__(self, file: int, on_progress: Callable[[int], None] = lambda _: None) -> None:
        """``on_progress`` is called with the size of each piece that was processed."""
        self.finder = RecordFinder(file)
        self.statistics: Statistics | None = None
        """From the summary, if the end of the file is intact."""
        self._is_summary_verified = False
        """Whether the checksum of the summary matches: then its schemas and channels replace others outside chunks."""
        self._on_progress = on_progress
        self._is_chunked = self._follows_search = False
        """Whether there are chunks, and whether all pieces since the last one were found by the search."""

    def pieces(self) -> Iterator[Piece]:
        """Raises only OSError. Ends after the DataEnd record, or at the end of the file."""
        finder = self.finder
        self._find_summary()
        self._is_chunked = self.statistics is not None and self.statistics.chunk_count > 0
        at = 0
        while at < finder.size:
            piece: Piece | None = finder.piece(at) if at else finder.first()
            if piece is None or (isinstance(piece, IntactRecord) and self._is_doubtful(piece)):
                piece = self._damaged(at)
                if piece.op == Opcode.CHUNK and (contents := self.recover_chunk(piece).contents) is not None:
                    for op, content in contents.declarations:
                        finder.unverified.add(op, content)
            elif isinstance(piece, IntactRecord) and piece.op in IN_CHUNKS:
                piece = self._outside_chunks(piece)
            elif isinstance(piece, IntactChunk):
                for op, content in piece.contents.declarations:
                    finder.known.add(op, content)
            if finder.known.size > MAX_SUMMARY_BYTES:
                what = f'its schemas and channels have more than {MAX_SUMMARY_BYTES:,} bytes'
                piece = Damaged(at, finder.size - at, 0, what)
            if isinstance(piece, IntactChunk) or piece.op == Opcode.CHUNK:
                self._is_chunked = True
            self._follows_search = self._follows_search and not isinstance(piece, IntactChunk)
            finder.follows_chunk = isinstance(piece, IntactChunk) or piece.op in {Opcode.CHUNK, Opcode.MESSAGE_INDEX}
            yield piece
            self._on_progress(piece.size)
            at = piece.at + piece.size
            if isinstance(piece, IntactRecord) and piece.op == Opcode.DATA_END:
                return

    def recover_chunk(self, damaged: Damaged) -> RecoveredChunk:
        """The readable part of a chunk that is truncated or inconsistent."""
        start, is_torn = damaged.at + RECORD.size, damaged.is_torn
        head = self.finder.read(start, min(damaged.size - RECORD.size, CHUNK_FIELDS + 256))
        what = 'a truncated chunk' if is_torn else 'a chunk with a damaged header'
        if len(head) < CHUNK_FIELDS:
            return RecoveredChunk(what, None, False, False, None)
        start_ns, end_ns, size, crc = CHUNK.unpack_from(head)
        times = (start_ns, end_ns) if start_ns <= end_ns else None
        length = int.from_bytes(head[CHUNK.size : CHUNK.size + 4], 'little')
        name = head[CHUNK.size + 4 : CHUNK.size + 4 + length].decode(errors='replace')
        if not is_torn:
            return self._recover_inconsistent_chunk(damaged, name, size, crc, times)
        if name not in COMPRESSIONS or size > MAX_CHUNK_BYTES:
            return RecoveredChunk(f'{what} with the unsupported compression {name[:20]!r}', None, False, False, times)
        data = self._compressed_data(damaged, name, head)
        raw = decompress_damaged(name, data, size) if name else data
        return RecoveredChunk(what, self.finder.walk_chunk(memoryview(raw))[0], True, False, times)

    def _recover_inconsistent_chunk(
        self, damaged: Damaged, name: str, size: int, crc: int, times: tuple[int, int] | None
    ) -> RecoveredChunk:
        """A chunk with all its bytes: its checksum shows which of its fields are wrong."""
        best, what = None, f'a chunk with the unsupported compression {name[:20]!r}'
        head = self.finder.read(damaged.at + RECORD.size, CHUNK_FIELDS + 4)
        for compression in sorted(COMPRESSIONS, key=lambda each: each != name):
            data = self._compressed_data(damaged, compression, head)
            likely = 16 * len(data) + BLOCK_BYTES  # the size itself may be wrong
            limit = size if likely < size <= MAX_CHUNK_BYTES else min(likely, MAX_CHUNK_BYTES)
            raw = decompress_damaged(compression, data, limit) if compression else data
            contents, end = self.finder.walk_chunk(memoryview(raw))
            if crc and zlib.crc32(raw) == crc:
                what = f'{contents.lost} messages of unknown channels' if contents.lost else 'wrong fields of a chunk'
                return RecoveredChunk(what, contents, True, end == len(raw), times)
            if compression == name:
                is_complete = not crc and len(raw) == size and end == size
                what = 'a chunk with a wrong checksum' if crc else 'a chunk with incomplete records'
                what = f'{contents.lost} messages of unknown channels' if is_complete and contents.lost else what
                best = RecoveredChunk(what, contents, is_complete, is_complete, times)
        return best or RecoveredChunk(what, None, False, False, times)

    def _compressed_data(self, damaged: Damaged, compression: str, head: bytes) -> bytes:
        """The available data of a chunk, if this is the name of its compression."""
        place = CHUNK.size + 4 + len(compression)
        length = min(int.from_bytes(head[place : place + 8], 'little'), damaged.size - RECORD.size - place - 8, MAX_CHUNK_BYTES)
        return self.finder.read(damaged.at + RECORD.size + place + 8, max(length, 0))

    def _is_doubtful(self, record: IntactRecord) -> bool:
        """Whether only the record's own length confirms it, and no record follows."""
        if record.op != Opcode.MESSAGE and record.op <= Opcode.DATA_END:
            return False
        after = record.at + record.size
        if self.finder.is_record(after):
            return False
        found = self.finder.search(record.at + 1)
        return found < self.finder.size and found != after

    def _damaged(self, at: int) -> Damaged:
        finder = self.finder
        op, length = finder.opcode_and_length(at)
        fits = finder.fits(at, op, length)
        if not at:
            end = finder.search(1)
            return Damaged(0, end, 0, 'the beginning of the file is missing')
        end = at + RECORD.size + length
        if not fits or (end < finder.size and not finder.is_confirmed(end)):
            self._follows_search = True
            end = finder.search(at + 1, at + RECORD.size + finder.chunk_length(at) if op == Opcode.CHUNK else 0)
        is_torn = end == finder.size and not fits and bool(op)
        if op == Opcode.CHUNK:
            return Damaged(at, end - at, op, 'a chunk', is_torn)
        is_framed = fits and end == at + RECORD.size + length
        return Damaged(at, end - at, op if is_framed else 0, _describe(op, is_torn=is_torn), is_torn)

    def _outside_chunks(self, piece: IntactRecord) -> Piece:
        """A message, schema or channel outside chunks; in a file with chunks, the search found it inside a damaged chunk."""
        is_declaration = piece.op in DECLARATIONS and piece.content is not None
        if self._is_chunked and self._follows_search:
            if is_declaration:
                self.finder.unverified.add(piece.op, piece.content or b'')
            return Damaged(piece.at, piece.size, piece.op, 'a record of a damaged chunk')
        if is_declaration:
            content = piece.content or b''
            if self._is_summary_verified:  # the data has no checksum for records outside chunks
                summary = self.finder.summary
                declared = summary.schemas if piece.op == Opcode.SCHEMA else summary.channels
                content = declared.get(int.from_bytes(content[:2], 'little'), content)
            piece = replace(piece, content=content)
            self.finder.known.add(piece.op, content)
        return piece

    def _find_summary(self) -> None:
        """Read the summary if it exists; bytes may follow the end of the file, or be missing."""
        finder = self.finder
        start = max(finder.size - TAIL_BYTES, 0)
        tail = finder.read(start, TAIL_BYTES)
        footer_at = tail.rfind(_FOOTER)
        if footer_at < 0 or footer_at + len(_FOOTER) + MIN_BYTES[Opcode.FOOTER] > len(tail):
            return
        content = tail[footer_at + len(_FOOTER) :][: MIN_BYTES[Opcode.FOOTER]]
        footer, end = parse(Footer, content), start + footer_at + len(_FOOTER) + len(content) - 4
        after_data = tail.rfind(_DATA_END, 0, footer_at)
        for at in (footer.summary_start, start + after_data + len(_DATA_END) + 4 if after_data >= 0 else 0):
            if len(MAGIC) <= at < end and end - at <= MAX_SUMMARY_BYTES:
                self._is_summary_verified = bool(footer.summary_crc) and finder.crc(at, end) == footer.summary_crc
                self._read_summary(at)
                if self._is_summary_verified:
                    return

    def _read_summary(self, at: int) -> None:
        finder = self.finder
        while len(MAGIC) <= at < finder.size and finder.summary.size < MAX_SUMMARY_BYTES:
            op, length = finder.opcode_and_length(at)
            if op not in SUMMARY or not finder.fits(at, op, length) or op == Opcode.FOOTER or length > MAX_SUMMARY_BYTES:
                return
            if op in DECLARATIONS:
                content = finder.read(at + RECORD.size, length)
                if fields_length(DECLARATIONS[op], content) is None:
                    return
                finder.summary.add(op, content)
            elif op == Opcode.STATISTICS:
                with suppress(*UNREADABLE):
                    self.statistics = parse(Statistics, finder.read(at + RECORD.size, length))
            at += RECORD.size + length


def _describe(op: int, *, is_torn: bool) -> str:
    try:
        name = Opcode(op).name.lower().replace('_', ' ')
    except ValueError:
        return 'bytes that are not a record'
    return f'a truncated record ({name})' if is_torn else f'a record with wrong content ({name})'
