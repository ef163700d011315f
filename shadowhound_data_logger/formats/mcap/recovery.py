"""Completes slices that were not closed, in place, and reads what a complete slice holds.

A slice whose writer was killed, or whose disk lost power, ends where it was last synced or somewhere after: with a torn
chunk, zeros, anything. ``salvage.py`` finds what is intact; here it becomes a complete file without a second copy, for which a
full disk has no room. Every step can be interrupted and repeated. Whatever the file claims, this takes the memory of one chunk,
packed and unpacked, and of the summary's content, at most ``MOST_SUMMARY_BYTES`` before Python's overhead.

This repairs the bytes of a slice; ``bags/recovery.py`` decides about a bag, ``spool/recovery.py`` repairs a spool.
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
from shadowhound_data_logger.formats.mcap import salvage
from shadowhound_data_logger.formats.mcap.format import RECORD, ChannelTrack, Contents, head, record, span, text
from shadowhound_data_logger.formats.mcap.index import UNREADABLE, Schemas, parsed, read_index
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.salvage import PRIVATE, IntactChunk, IntactRecord, Piece, Salvage
from shadowhound_data_logger.formats.mcap.slice_info import Damage, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import OPEN

_ENDING: Final = text('rosbag2')
"""The beginning of the metadata record that follows the last chunk of a slice that was being closed; it is written again."""
_INDEX_HEAD: Final = 6
_INDEX_ENTRY: Final = 16


@dataclass(slots=True)
class SliceScan:
    """What is intact in a slice, and how it becomes complete: write the repairs, cut it off at ``end``, append the ending."""

    contents: Contents = field(default_factory=Contents)
    end: int = 0
    """Where the last intact record ends."""
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
    """Bytes since the last intact record. If another one follows, they become one record that readers skip."""

    at: int
    chunks: int = 0
    messages: int = 0


class _Scanner:
    """One pass over one file."""

    def __init__(self, file: int) -> None:
        self._salvage = Salvage(file)
        self._found = SliceScan(end=len(head()))
        self._tracks = self._found.contents.tracks
        self._schemas = Schemas()
        self._held_bytes = 0
        self._suspects: _Suspects | None = None

    def run(self) -> SliceScan:
        found, size = self._found, self._salvage.size
        if self._salvage.read(0, found.end) != head():
            found.repairs.append((0, head()))
        end = size
        for piece in self._salvage.pieces():
            if piece.at + piece.size <= found.end:
                continue  # the header, or the message indexes of a chunk
            if self._is_ending(piece) or self._held_bytes > salvage.MOST_SUMMARY_BYTES:
                end = piece.at
                break
            if piece.at < found.end or not self._accept(piece):
                self._suspect(piece)
        if self._held_bytes > salvage.MOST_SUMMARY_BYTES:
            self._suspects, end = self._suspects or _Suspects(end), size
        if self._suspects is not None:
            found.tail_bytes = max(end - self._suspects.at, 0)
            found.lost_messages += self._suspects.messages
        return found

    def _is_ending(self, piece: Piece) -> bool:
        if not isinstance(piece, (IntactRecord, salvage.Damaged)) or piece.op not in {Opcode.METADATA, 0}:
            return False
        start = self._salvage.read(piece.at, RECORD.size + len(_ENDING))
        return start[:1] == bytes([Opcode.METADATA]) and _ENDING.startswith(start[RECORD.size :])

    def _accept(self, piece: Piece) -> bool:
        """Whether a piece stays in the slice; suspects before it are skipped by readers from now on."""
        found, suspects = self._found, self._suspects
        if suspects is not None and piece.at - suspects.at < RECORD.size:
            return False  # there is no room for a record
        after = piece.at + piece.size
        if isinstance(piece, IntactChunk):
            if not piece.contents.messages or not piece.contents.index.keys() <= self._tracks.keys():
                return False
            after = self._chunk(piece)
        elif not isinstance(piece, IntactRecord) or not self._take(piece):
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
            self._suspects.messages += (piece.size - RECORD.size - _INDEX_HEAD) // _INDEX_ENTRY

    def _take(self, piece: IntactRecord) -> bool:
        """Take in a schema, a channel or metadata."""
        contents = self._found.contents
        if piece.content is None:
            return False
        if piece.op == Opcode.METADATA:
            contents.add_metadata(piece.at, piece.size, parsed(Metadata, piece.content).name)
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

    def _chunk(self, piece: IntactChunk) -> int:
        """Take in a chunk, with the message indexes after it; where they end."""
        for number, index in piece.contents.index.items():
            self._tracks[number].index = index
        tracks = [track for track in self._tracks.values() if track.index]
        contents, after = self._found.contents, piece.at + piece.size
        header = RECORD.pack(Opcode.CHUNK, piece.size - RECORD.size) + struct.pack('<QQ', *span(tracks))
        indexes = contents.chunk(piece.at, piece.packing, tracks)
        self._held_bytes += len(contents.chunks[-1])
        for at, content in ((piece.at, header), (after, indexes)):
            if self._salvage.read(at, len(content)) != content:
                self._repair(at, content)
        return after + len(indexes)

    def _repair(self, at: int, content: bytes) -> None:
        self._held_bytes += len(content)
        self._found.repairs.append((at, content))


log = logging.getLogger(__name__)


def recover(path: Path, *, ros_distro: str = '') -> SliceInfo:
    """Turn ``<name>.mcap.open`` into ``<name>.mcap``; its ``damage`` is what could not be kept.

    Never fails for what the file holds: one with nothing intact in it becomes an empty slice. Raises OSError if it cannot
    be read or written, FileExistsError if a file has its final name already.
    """
    if not path.name.endswith(OPEN):
        raise ValueError(f'{path} is not an open slice')
    final = path.with_name(path.name.removesuffix(OPEN))
    if final.exists():
        raise FileExistsError(f'{final} is there already, beside {path}')
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        found = scan(file)
        for at, content in found.repairs:
            _write(file, at, content)
        os.ftruncate(file, found.end)
        said = bagfile_information([found.contents.info(final)], ros_distro=ros_distro)
        _write(file, found.end, found.contents.ending(found.end, to_yaml(said)))
        os.fsync(file)
    finally:
        os.close(file)
    size, sha256 = fingerprint(path)
    os.replace(path, final)
    sync(final.parent)
    info = found.contents.info(final, size, sha256, found.damage)
    log.info('recovered %s: %d messages; left out %s', final, info.messages, found.damage)
    return info


def read_info(path: Path, *, digest: bool = False) -> SliceInfo:
    """Of a complete MCAP file, ours or another recorder's. ``sha256`` is computed when ``digest`` is set.

    Raises BagDamaged for a file that is not a complete MCAP file.
    """
    source = LocalFile(path)
    return read_index(source).info(path, source.size, fingerprint(path)[1] if digest else '')


def _write(file: int, at: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, at)
        view, at = view[written:], at + written
