"""Completes slices that were not closed, in place, and reads the contents of complete slices.

If the writer is killed or the power fails, a slice ends at its last sync or somewhere after it: with a truncated chunk, zeros,
or anything else. ``damage_scan.py`` finds the intact parts. This module makes a complete file of them without a second copy,
for which a full disk has no room. Every step can be interrupted and repeated. For any input, memory is bounded by one chunk,
compressed and uncompressed, and by the contents of the summary, at most ``MAX_SUMMARY_BYTES`` before Python's overhead.

This module repairs the bytes of a slice; ``bags/recovery.py`` recovers a bag, ``spool/recovery.py`` repairs a spool.
"""

from __future__ import annotations

import logging
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Metadata

from shadowhound_data_logger.core.durable_files import fingerprint, sync
from shadowhound_data_logger.formats.mcap.damage_scan import PRIVATE, Damaged, DamageScan, Piece
from shadowhound_data_logger.formats.mcap.format import RECORD, ChannelTrack, Contents, head, record, span, text
from shadowhound_data_logger.formats.mcap.index import MAX_SUMMARY_BYTES, UNREADABLE, Schemas, parse, read_index
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.record_finder import INDEX_ENTRY, INDEX_HEAD, IntactChunk, IntactRecord
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Damage, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX

log = logging.getLogger(__name__)

_ENDING: Final = text('rosbag2')
"""Start of the metadata record after the last chunk, if the slice was being closed; recovery writes that record again."""


@dataclass(slots=True)
class SliceScan:
    """The intact contents of a slice. To complete it, write the repairs, truncate it at ``end``, and append the ending."""

    contents: Contents = field(default_factory=Contents)
    end: int = 0
    """End of the last intact record."""
    repairs: list[tuple[int, bytes]] = field(default_factory=list)
    """(offset, content)."""
    tail_bytes: int = 0
    lost_chunks: int = 0
    lost_messages: int = 0

    @property
    def damage(self) -> Damage:
        return Damage(self.tail_bytes, self.lost_chunks, self.lost_messages)


def scan(file: int) -> SliceScan:
    """Scan an open file. Raises only OSError."""
    return _Scanner(file).run()


@dataclass(slots=True)
class _Suspects:
    """Bytes since the last intact record. If another intact record follows, they become one record that readers skip."""

    at: int
    chunks: int = 0
    messages: int = 0


class _Scanner:
    """One pass over one file."""

    def __init__(self, file: int) -> None:
        self._scan = DamageScan(file)
        self._found = SliceScan(end=len(head()))
        self._tracks = self._found.contents.tracks
        self._schemas = Schemas()
        self._held_bytes = 0
        self._suspects: _Suspects | None = None

    def run(self) -> SliceScan:
        found, size = self._found, self._scan.finder.size
        if self._scan.finder.read(0, found.end) != head():
            found.repairs.append((0, head()))
        end = size
        for piece in self._scan.pieces():
            if piece.at + piece.size <= found.end:
                continue  # the header, or the message indexes of a chunk
            if self._is_ending(piece) or self._held_bytes > MAX_SUMMARY_BYTES:
                end = piece.at
                break
            if piece.at < found.end or not self._accept(piece):
                self._suspect(piece)
        if self._held_bytes > MAX_SUMMARY_BYTES:
            self._suspects, end = self._suspects or _Suspects(end), size
        if self._suspects is not None:
            found.tail_bytes = max(end - self._suspects.at, 0)
            found.lost_messages += self._suspects.messages
        return found

    def _is_ending(self, piece: Piece) -> bool:
        if not isinstance(piece, (IntactRecord, Damaged)) or piece.op not in {Opcode.METADATA, 0}:
            return False
        start = self._scan.finder.read(piece.at, RECORD.size + len(_ENDING))
        return start[:1] == bytes([Opcode.METADATA]) and _ENDING.startswith(start[RECORD.size :])

    def _accept(self, piece: Piece) -> bool:
        """Keep a piece in the slice if possible; readers will skip the suspects before it."""
        found, suspects = self._found, self._suspects
        if suspects is not None and piece.at - suspects.at < RECORD.size:
            return False  # no room for a record
        after = piece.at + piece.size
        if isinstance(piece, IntactChunk):
            if not piece.contents.messages or not piece.contents.index.keys() <= self._tracks.keys():
                return False
            after = self._add_chunk(piece)
        elif not isinstance(piece, IntactRecord) or not self._add_record(piece):
            return False
        if suspects is not None:
            op = Opcode.CHUNK if suspects.chunks else 0
            self._repair(suspects.at, RECORD.pack(PRIVATE | op, piece.at - suspects.at - RECORD.size))
            found.lost_chunks += suspects.chunks
            found.lost_messages += suspects.messages
            self._suspects = None
        found.end = after
        return True

    def _suspect(self, piece: Piece) -> None:
        if self._suspects is None:
            self._suspects = _Suspects(max(piece.at, self._found.end))
        if isinstance(piece, IntactChunk) or piece.op & ~PRIVATE == Opcode.CHUNK:
            self._suspects.chunks += 1
        elif piece.op == Opcode.MESSAGE_INDEX:
            self._suspects.messages += (piece.size - RECORD.size - INDEX_HEAD) // INDEX_ENTRY

    def _add_record(self, piece: IntactRecord) -> bool:
        """Add a schema, channel or metadata record to the contents, unless it is unusable."""
        contents = self._found.contents
        if piece.content is None:
            return False
        if piece.op == Opcode.METADATA:
            contents.add_metadata(piece.at, piece.size, parse(Metadata, piece.content).name)
            self._held_bytes += len(contents.metadata[-1])
            return True
        if piece.op not in {Opcode.SCHEMA, Opcode.CHANNEL}:
            return False
        known = contents.schemas if piece.op == Opcode.SCHEMA else contents.declared
        number, schema = int.from_bytes(piece.content[:2], 'little'), int.from_bytes(piece.content[2:4], 'little')
        if number in known or (piece.op == Opcode.CHANNEL and schema and schema not in contents.schemas):
            return False
        try:
            self._schemas.add(piece.op, piece.content)
        except UNREADABLE:
            return False
        self._held_bytes += len(piece.content)
        known[number] = record(piece.op, piece.content)
        if piece.op == Opcode.CHANNEL:
            self._tracks[number] = ChannelTrack(number, self._schemas.channels[number])
        return True

    def _add_chunk(self, piece: IntactChunk) -> int:
        """Add a chunk and its message indexes to the contents; returns the end of the indexes."""
        for number, index in piece.contents.index.items():
            self._tracks[number].index = index
        tracks = [track for track in self._tracks.values() if track.index]
        contents, after = self._found.contents, piece.at + piece.size
        header = RECORD.pack(Opcode.CHUNK, piece.size - RECORD.size) + struct.pack('<QQ', *span(tracks))
        indexes = contents.add_chunk(piece.at, piece.packing, tracks)
        self._held_bytes += len(contents.chunks[-1])
        for at, content in ((piece.at, header), (after, indexes)):
            if self._scan.finder.read(at, len(content)) != content:
                self._repair(at, content)
        return after + len(indexes)

    def _repair(self, at: int, content: bytes) -> None:
        self._held_bytes += len(content)
        self._found.repairs.append((at, content))


def recover(path: Path, *, ros_distro: str = '') -> SliceInfo:
    """Turn ``<name>.mcap.open`` into ``<name>.mcap``; ``damage`` of the result is what could not be kept.

    Accepts any content: a file without intact records becomes an empty slice. Raises OSError if the file cannot be read or
    written, FileExistsError if a file with the final name exists.
    """
    if not path.name.endswith(OPEN_SUFFIX):
        raise ValueError(f'{path} is not an open slice')
    final = path.with_name(path.name.removesuffix(OPEN_SUFFIX))
    if final.exists():
        raise FileExistsError(f'{final} exists, next to {path}')
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        found = scan(file)
        for at, content in found.repairs:
            _write(file, at, content)
        os.ftruncate(file, found.end)
        metadata = bagfile_information([found.contents.info(final)], ros_distro=ros_distro)
        _write(file, found.end, found.contents.ending(found.end, to_yaml(metadata)))
        os.fsync(file)
    finally:
        os.close(file)
    size, sha256 = fingerprint(path)
    os.replace(path, final)
    sync(final.parent)
    info = found.contents.info(final, size, sha256, found.damage)
    log.info('recovered %s: %d messages; not recovered: %s', final, info.messages, found.damage)
    return info


def read_info(path: Path, *, digest: bool = False) -> SliceInfo:
    """The contents of a complete MCAP file by any recorder. ``sha256`` is computed if ``digest`` is set.

    Raises BagDamaged if the file is not a complete MCAP file.
    """
    source = LocalFile(path)
    return read_index(source).info(path, source.size, fingerprint(path)[1] if digest else '')


def _write(file: int, at: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, at)
        view, at = view[written:], at + written
