"""Repairs slices that were not closed, and tells what a whole slice holds.

A slice whose writer was killed, or whose disk lost power, ends where it was last synced or somewhere after: with a torn
chunk, zeros, anything. Every chunk with a valid CRC-32 is kept, up to the last one; the file is repaired in place, so that a
large slice takes neither memory nor a second copy. Every step can be interrupted and repeated. Whatever the file claims,
recovery takes the memory of one chunk, packed and unpacked, each at most ``MOST_CHUNK_BYTES``, and of the summary's content, at
most ``MOST_SUMMARY_BYTES`` before Python's overhead.

This repairs the bytes of a slice; ``bags/recovery.py`` decides about a bag, ``spool/recovery.py`` repairs a spool.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from array import array
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Chunk, Metadata

from shadowhound_data_logger.durable_files import fingerprint, sync
from shadowhound_data_logger.mcap.format import (
    CHUNK,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    ChannelTrack,
    ChunkPacking,
    Contents,
    head,
    record,
    span,
    text,
)
from shadowhound_data_logger.mcap.index import UNREADABLE, Schemas, parsed, read_index
from shadowhound_data_logger.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.mcap.ranges import LocalFile
from shadowhound_data_logger.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.mcap.slice_info import Damage, SliceInfo
from shadowhound_data_logger.mcap.writer import OPEN
from shadowhound_data_logger.zstd import ZstdDecompressor, ZstdError

MOST_CHUNK_BYTES: Final = 256 << 20
MOST_SUMMARY_BYTES: Final = 64 << 20
RETIRED: Final = 0x80
"""Added to the first byte of a record that is damaged: what begins with 0x80 or more is skipped by every reader."""
_DATA: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA})
_ENDING: Final = text('rosbag2')
"""What the metadata record begins with that follows the last chunk of a slice that was being closed; it is written anew."""
_SUSPECT_BYTES: Final = 200
"""In memory, with its repair."""
_INDEX_HEAD: Final = 6
_INDEX_ENTRY: Final = 16


@dataclass(slots=True)
class SliceScan:
    """Finds what is whole in a file, and how it becomes a slice: write the repairs, cut it off at ``end``, append the ending."""

    contents: Contents = field(default_factory=Contents)
    end: int = 0
    """Where the last whole record ends."""
    repairs: list[tuple[int, bytes]] = field(default_factory=list)
    """(offset, content)."""
    tail_bytes: int = 0
    lost_chunks: int = 0
    lost_messages: int = 0

    @property
    def damage(self) -> Damage:
        return Damage(self.tail_bytes, self.lost_chunks, self.lost_messages)


class _Damaged(Exception):
    """A record is not what its writer wrote."""


def scan(file: int) -> SliceScan:
    """Scan an open file. Raises only OSError."""
    return _Scanner(file).run()


class _Scanner:
    """One pass over one file. What is damaged is a suspect until something whole follows it; at the end it is the torn tail."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._size = os.fstat(file).st_size
        self._found = SliceScan()
        self._tracks = self._found.contents.tracks
        self._schemas = Schemas()
        self._held_bytes = 0
        self._suspects: list[tuple[int, int]] = []
        """(offset, opcode) of records since the last whole one."""
        self._suspect_messages = 0

    def run(self) -> SliceScan:
        at = self._found.end = self._header()
        while at < self._size:
            start = os.pread(self._file, RECORD.size, at)
            op, length = RECORD.unpack(start) if len(start) == RECORD.size else (0, 0)
            if op == Opcode.METADATA and _ENDING.startswith(os.pread(self._file, len(_ENDING), at + RECORD.size)):
                break
            after = at + RECORD.size + length
            if after > self._size or op & ~RETIRED not in _DATA or self._held_bytes > MOST_SUMMARY_BYTES:
                self._suspects.append((at, op))
                at = self._size
                break
            at = self._record(op, at, length)
        torn = self._suspects[0][0] if self._suspects else at
        self._found.tail_bytes = max(at - torn, 0)
        self._found.lost_messages += self._suspect_messages
        return self._found

    def _header(self) -> int:
        """Where the records begin; a header that is damaged is written anew, for every slice has the same."""
        wanted = head()
        if os.pread(self._file, len(wanted), 0) != wanted:
            self._found.repairs.append((0, wanted))
        return len(wanted)

    def _record(self, op: int, at: int, length: int) -> int:
        """Take in one record; where the next one begins."""
        after = at + RECORD.size + length
        try:
            if op == Opcode.CHUNK:
                after = self._chunk(at, length)
            elif op in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self._declare(op, at, length)
            elif op == Opcode.METADATA:
                self._metadata(at, length)
            else:  # retired by a recovery before this one, or the index of a chunk that is not whole
                self._suspect(op, at, length)
                return after
        except _Damaged:
            self._suspect(op, at, length)
            return after
        self._accept(after)
        return after

    def _suspect(self, op: int, at: int, length: int) -> None:
        self._suspects.append((at, op))
        self._held_bytes += _SUSPECT_BYTES
        if op & ~RETIRED == Opcode.MESSAGE_INDEX:
            self._suspect_messages += max(length - _INDEX_HEAD, 0) // _INDEX_ENTRY

    def _accept(self, after: int) -> None:
        """All up to here stays: suspects in between are skipped from now on."""
        found = self._found
        found.repairs += [(at, bytes([op | RETIRED])) for at, op in self._suspects]
        found.lost_chunks += sum(op & ~RETIRED == Opcode.CHUNK for _, op in self._suspects)
        found.lost_messages += self._suspect_messages
        found.end = after
        self._suspects, self._suspect_messages = [], 0

    def _declare(self, op: int, at: int, length: int) -> None:
        """A schema or channel."""
        if length > MOST_SUMMARY_BYTES:
            raise _Damaged
        content = self._read(at + RECORD.size, length)
        contents = self._found.contents
        known = contents.schemas if op == Opcode.SCHEMA else contents.declared
        number, schema = int.from_bytes(content[:2], 'little'), int.from_bytes(content[2:4], 'little')
        if number in known or (op == Opcode.CHANNEL and schema not in contents.schemas):
            raise _Damaged
        try:
            self._schemas.add(op, content)
        except UNREADABLE as error:
            raise _Damaged from error
        self._held_bytes += length
        known[number] = record(op, content)
        if op == Opcode.CHANNEL:
            self._tracks[number] = ChannelTrack(number, self._schemas.channels[number])

    def _metadata(self, at: int, length: int) -> None:
        if length > MOST_SUMMARY_BYTES:
            raise _Damaged
        try:
            name = parsed(Metadata, self._read(at + RECORD.size, length)).name
        except UNREADABLE as error:
            raise _Damaged from error
        self._found.contents.add_metadata(at, RECORD.size + length, name)
        self._held_bytes += len(self._found.contents.metadata[-1])

    def _chunk(self, at: int, length: int) -> int:
        """A chunk with the message indexes behind it; where they end."""
        if length > MOST_CHUNK_BYTES:
            raise _Damaged
        body = self._read(at + RECORD.size, length)
        raw, packed = _unpack(body)
        tracks = self._walk(raw)
        if CHUNK.unpack_from(body)[:2] != (times := span(tracks)):
            self._repair(at + RECORD.size, struct.pack('<QQ', *times))
        after = at + RECORD.size + length
        contents = self._found.contents
        indexes = contents.chunk(at, packed, tracks)
        self._held_bytes += len(contents.chunks[-1])
        if os.pread(self._file, len(indexes), after) != indexes:
            self._repair(after, indexes)
        return after + len(indexes)

    def _walk(self, raw: memoryview) -> list[ChannelTrack]:
        """The tracks of a chunk's messages with their indexes, in the order in which the writer has them."""
        indexes: dict[int, array[int]] = {}
        at, end = 0, len(raw)
        try:
            while at < end:
                op, length, number, _, log_ns, _ = MESSAGE.unpack_from(raw, at)
                index = indexes.get(number)
                if index is None:
                    index = indexes[number] = array('Q')
                index.append(log_ns)
                index.append(at)
                at += RECORD.size + length
                if op != Opcode.MESSAGE or length < MESSAGE_FIELDS:
                    raise _Damaged
        except struct.error as error:
            raise _Damaged from error
        if at != end or not indexes or not indexes.keys() <= self._tracks.keys():
            raise _Damaged
        for number, index in indexes.items():
            self._tracks[number].index = index
        return [track for track in self._tracks.values() if track.index]

    def _repair(self, at: int, content: bytes) -> None:
        self._held_bytes += len(content)
        self._found.repairs.append((at, content))

    def _read(self, at: int, length: int) -> bytes:
        body = os.pread(self._file, length, at)
        if len(body) != length:
            raise _Damaged
        return body


def _unpack(body: bytes) -> tuple[memoryview, ChunkPacking]:
    """The records in a chunk, checked."""
    try:
        chunk = parsed(Chunk, body)
        if chunk.uncompressed_size > MOST_CHUNK_BYTES or chunk.compression not in {'', 'zstd'}:
            raise _Damaged
        packed = ChunkPacking(chunk.compression, len(chunk.data), chunk.uncompressed_size)
        raw = ZstdDecompressor().decompress(chunk.data, packed.size + 1) if chunk.compression else chunk.data
    except (*UNREADABLE, ZstdError) as error:
        raise _Damaged from error
    if len(raw) != packed.size or zlib.crc32(raw) != chunk.uncompressed_crc:
        raise _Damaged
    return memoryview(raw), packed


log = logging.getLogger(__name__)

_EVER = (0, 1 << 64)


def recover(path: Path, *, ros_distro: str = '') -> SliceInfo:
    """Turn ``<name>.mcap.open`` into ``<name>.mcap``; what had to be left out stands in its ``damage``.

    Never fails for what the file holds: of one with nothing whole in it an empty slice is left. Raises OSError when it cannot
    be read or written, FileExistsError when a file has its final name already.
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
    """Of a whole MCAP file, ours or another's, by its summary; by all its messages where it has none.

    ``sha256`` is computed when ``digest`` is set. Raises BagDamaged for what is not a whole MCAP file.
    """
    source = LocalFile(path)
    index = read_index(source)
    sha256 = fingerprint(path)[1] if digest else ''
    channels, messages, span = list(index.channels.values()), index.messages, (index.t_start_ns, index.t_end_ns)
    counts, repeated = {channel.topic: 0 for channel in channels}, Counter[str]()
    told = messages and sum(index.counts.values()) == messages and index.counts.keys() <= index.channels.keys()
    if index.is_indexed or told:
        for number, count in index.counts.items():
            counts[index.channels[number].topic] += count
            repeated[index.channels[number].topic] += count if index.channels[number].repeated else 0
    else:
        channels, messages, span, counts = [], 0, (0, 0), {}
        for message in read_messages(source, index, MessageFilter(*_EVER, lambda _: True)):
            if message.channel.topic not in counts:
                channels.append(message.channel)
            counts[message.channel.topic] = counts.get(message.channel.topic, 0) + 1
            repeated[message.channel.topic] += message.channel.repeated
            span = (min(span[0], message.log_ns), max(span[1], message.log_ns)) if messages else (message.log_ns, message.log_ns)
            messages += 1
    return SliceInfo(path, source.size, sha256, *(span if messages else (0, 0)), messages, counts, tuple(channels),
                     repeated=+repeated)  # fmt: skip


def _write(file: int, at: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, at)
        view, at = view[written:], at + written
