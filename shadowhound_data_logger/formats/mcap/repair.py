"""Copies what is intact in an MCAP file, of any writer and damaged in any way, into a complete one.

Copied verbatim: the header, schemas, channels, intact chunks, attachments, metadata and unknown records. Written again: all
indexes, statistics, and rosbag2's own metadata record. Messages outside of chunks, and those of a damaged chunk, get their own
chunks, which are not compressed, because readers that use the index find no others.

What is lost is listed. A chunk whose checksum does not match is lost unless its messages are requested: it is unknown which of
them are wrong, and in the copy the new checksum would confirm them.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header, Metadata, Schema, Statistics

from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.format import (
    CHUNK,
    MAGIC,
    RECORD,
    ChannelTrack,
    ChunkPacking,
    Contents,
    head,
    record,
    span,
    text,
)
from shadowhound_data_logger.formats.mcap.index import FOOTER_BYTES, UNREADABLE, Schemas, parsed
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.salvage import (
    BLOCK_BYTES,
    MOST_SUMMARY_BYTES,
    ChunkContents,
    Damaged,
    Declarations,
    IntactChunk,
    IntactRecord,
    Salvage,
)
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo

PENDING_BYTES: Final = 1 << 20
"""Messages without a chunk are written in chunks of about this size."""
MAX_LOSSES: Final = 1000
"""Listed one by one; further ones are added up."""
MORE: Final = 'further damage'
WRONG_DATA: Final = 'the checksum of the data does not match: something in it is wrong, and it is unknown what'
_INDEX_HEAD: Final = 6
_INDEX_ENTRY: Final = 16
_SUMMARY: Final = frozenset({
    Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET,
})  # fmt: skip
_WITHOUT_MESSAGES: Final = _SUMMARY | {
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER,
}  # fmt: skip
Telling = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class Loss:
    """Bytes that are not in the copy. Times are log times between which they were written, None if unknown."""

    at: int
    bytes: int
    what: str
    messages: int | None
    """None if unknown."""
    from_ns: int | None
    to_ns: int | None


@dataclass(frozen=True, slots=True)
class McapRepair:
    """What a file holds and what it lost. ``info`` is that of the copy, its size and checksum are 0 and empty without one."""

    info: SliceInfo
    bytes: int
    """Of the damaged file."""
    losses: tuple[Loss, ...]
    rebuilt: tuple[str, ...]
    """Parts without messages that were missing or wrong, and that the copy has."""
    lost_messages: int | None
    """None if unknown."""
    unverified: int
    """Messages of chunks whose checksum does not match: in the copy if they were requested, otherwise lost."""
    is_cut: bool
    """Whether the end is missing, so that it is unknown whether more followed."""

    @property
    def is_damaged(self) -> bool:
        return bool(self.losses or self.rebuilt)


def examine(path: Path, told: Telling = lambda _: None) -> McapRepair:
    """What ``repair`` would do. Raises BagDamaged for a file that is not MCAP at all, or cannot be read."""
    with _opened(path) as file:
        return _Copy(file, path, None, told).run()


def repair(path: Path, out: Path, told: Telling = lambda _: None, *, unverified: bool = False, ros_distro: str = '',
           mode: int = 0o666) -> McapRepair:  # fmt: skip
    """Write a complete file ``out``, which must not exist; it is on the disk when this returns.

    ``unverified``: also keep messages of chunks whose checksum does not match. Raises BagDamaged as ``examine``, and OSError.
    """
    with _opened(path) as file:
        target = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        try:
            found = _Copy(file, path, target, told, unverified=unverified, ros_distro=ros_distro).run()
            os.fsync(target)
        except BaseException:
            out.unlink()
            raise
        finally:
            os.close(target)
    sync(out.parent)
    return replace(found, info=replace(found.info, path=out))


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise BagDamaged(f'{path} cannot be read: {error.strerror}', path=str(path)) from error
    try:
        yield file
    finally:
        os.close(file)


@dataclass(slots=True)
class _Losses:
    """What was lost so far, in the order of the file."""

    found: list[Loss] = field(default_factory=list)
    last_ns: int | None = None
    """Log time of the last message that was kept."""
    _open: int = 0
    """The first of ``found`` after which no message was kept yet."""

    def add(self, at: int, size: int, what: str, messages: int | None, times: tuple[int, int] | None) -> None:
        from_ns, to_ns = times or (self.last_ns, None)
        loss, last = Loss(at, size, what, messages, from_ns, to_ns), self.found[-1] if self.found else None
        if last is not None and (len(self.found) >= MAX_LOSSES or (last.what == what and last.at + last.bytes == at)):
            known = None if last.messages is None or messages is None else last.messages + messages
            is_more = len(self.found) >= MAX_LOSSES
            self.found[-1] = replace(last, bytes=last.bytes + size, messages=known, to_ns=to_ns, what=MORE if is_more else what)
            self._open = min(self._open, len(self.found) - 1)
        else:
            self.found.append(loss)

    def kept(self, first_ns: int, last_ns: int) -> None:
        """Messages of these log times follow."""
        for place in range(self._open, len(self.found)):
            loss = self.found[place]
            self.found[place] = replace(loss, to_ns=first_ns if loss.to_ns is None else loss.to_ns)
        self._open, self.last_ns = len(self.found), last_ns

    def count(self, messages: int) -> None:
        """The index of the last one's chunk shows how many messages it had."""
        last = self.found[-1]
        self.found[-1] = replace(last, messages=max(messages, 0))


class _Copy:
    """One pass over a file; without ``out`` nothing is written."""

    def __init__(self, file: int, path: Path, out: int | None, told: Telling, *, unverified: bool = False,
                 ros_distro: str = '') -> None:  # fmt: skip
        self._salvage = Salvage(file, told)
        self._file = file
        self._path = path
        self._out = out
        self._ros_distro = ros_distro
        self._keeps_unverified = unverified
        self._contents = Contents()
        self._schemas = Schemas()
        self._losses = _Losses()
        self._rebuilt: dict[str, None] = {}
        self._unverified = 0
        self._digest = hashlib.sha256()
        self._written = 0
        self._pending = bytearray()
        self._pending_index: dict[int, array[int]] = {}
        self._profile = ''
        self._kept_of_damaged: int | None = None
        """While the message indexes of a damaged chunk may follow: how many of its messages were kept."""
        self._expected = 0
        self._is_cut = False
        self._indexes: Mapping[int, array[int]] = {}
        """Of the chunk before, as its messages give them."""
        self._places: dict[int, int] = {}
        """Offsets and sizes of what the summary has an index of: chunks, attachments, metadata."""

    def run(self) -> McapRepair:
        end: int | None = None
        for piece in self._salvage.pieces():
            if isinstance(piece, IntactRecord) and piece.op == Opcode.MESSAGE_INDEX:
                self._index(piece)
                continue
            self._kept_of_damaged, self._indexes = None, {}
            if not piece.at:
                self._begin(piece)
            elif isinstance(piece, IntactChunk):
                self._chunk(piece)
            elif isinstance(piece, Damaged):
                self._damage(piece)
            elif piece.op == Opcode.DATA_END:
                end = piece.at
            elif piece.op == Opcode.FOOTER:
                self._rebuilt['the end of the data'] = None
                self._after(piece.at + piece.size + len(MAGIC))
                break
            else:
                self._record(piece)
        self._flush()
        if not self._written:
            self._begin(None)
        if end is not None:
            self._check_end(end)
        elif 'the end of the data' not in self._rebuilt:
            self._rebuilt['the summary and the footer'], self._is_cut = None, True
        return self._end()

    def _begin(self, piece: IntactRecord | IntactChunk | Damaged | None) -> None:
        """The header, which a file without one gets by what is known of its schemas."""
        if isinstance(piece, IntactRecord) and piece.content is not None:
            self._profile = parsed(Header, piece.content).profile
            header = MAGIC + record(Opcode.HEADER, piece.content)
            if self._salvage.read(0, len(header)) != header:
                self._rebuilt['the header'] = None
            self._write(header)
            return
        encodings = {parsed(Schema, content).encoding for content in self._salvage.hints.schemas.values()}
        self._profile = 'ros2' if not encodings or encodings & {'ros2msg', 'ros2idl'} else ''
        self._rebuilt['the header'] = None
        self._write(head() if self._profile else MAGIC + record(Opcode.HEADER, text(''), text('')))
        if piece is not None:
            if piece.size >= self._salvage.size:
                raise BagDamaged(f'{self._path} is not an MCAP file, or nothing of it can be read', path=str(self._path))
            self._losses.add(piece.at, piece.size, 'the beginning of the file', None, None)

    # -- pieces ----------------------------------------------------------------------------------------------------

    def _record(self, piece: IntactRecord) -> None:
        """Outside of chunks."""
        content = piece.content
        if piece.op in {Opcode.SCHEMA, Opcode.CHANNEL} and content is not None:
            if self._salvage.read(piece.at + RECORD.size, piece.size - RECORD.size) != content:
                self._rebuilt['schemas and channels, from the summary'] = None
            if not self._declare(piece.op, content):
                self._losses.add(piece.at, piece.size, 'a channel without its schema, or a second one of its number', 0, None)
        elif piece.op == Opcode.MESSAGE and content is not None:
            self._message(content)
        elif piece.op == Opcode.METADATA and content is not None:
            self._places[piece.at] = piece.size
            name = parsed(Metadata, content).name
            if name != 'rosbag2' or self._profile != 'ros2':
                self._flush()
                self._contents.add_metadata(self._written, piece.size, name)
                self._copy(piece.at, piece.size)
        elif piece.op == Opcode.ATTACHMENT:
            self._places[piece.at] = piece.size
            self._flush()
            self._attach(piece)
        elif piece.op not in _SUMMARY and piece.op != Opcode.HEADER:
            self._flush()
            self._copy(piece.at, piece.size)

    def _attach(self, piece: IntactRecord) -> None:
        start = piece.at + RECORD.size
        times = struct.unpack('<QQ', self._salvage.read(start, 16))
        place, texts = start + 16, []
        for _ in range(2):
            length = int.from_bytes(self._salvage.read(place, 4), 'little')
            texts.append(self._salvage.read(place + 4, min(length, 1 << 16)).decode(errors='replace'))
            place += 4 + length
        size = int.from_bytes(self._salvage.read(place, 8), 'little')
        self._contents.add_attachment(self._written, piece.size, texts[0], texts[1], size, (times[0], times[1]))
        self._copy(piece.at, piece.size)

    def _message(self, content: bytes) -> None:
        """One outside of chunks."""
        number, _, log_ns = struct.unpack_from('<HIQ', content)
        self._need([number])
        self._pending_index.setdefault(number, array('Q')).extend((log_ns, len(self._pending)))
        self._pending += record(Opcode.MESSAGE, content)
        if len(self._pending) >= PENDING_BYTES:
            self._flush()

    def _flush(self) -> None:
        if self._pending_index:
            raw, index = memoryview(bytes(self._pending)), self._pending_index
            self._pending, self._pending_index = bytearray(), {}
            self._write_chunk(raw, index)

    def _chunk(self, piece: IntactChunk) -> None:
        """As it is; its times, which no checksum covers, as its messages have them."""
        self._flush()
        self._prepare(piece.contents)
        tracks = self._tracks(piece.contents.index)
        self._indexes, self._places[piece.at] = piece.contents.index, piece.size
        fields = bytearray(self._salvage.read(piece.at + RECORD.size, piece.size - RECORD.size))
        if tracks and piece.times != span(tracks):
            self._rebuilt['the times of chunks'] = None
            struct.pack_into('<QQ', fields, 0, *span(tracks))
        if self._salvage.read(piece.at, RECORD.size) != RECORD.pack(Opcode.CHUNK, len(fields)):
            self._rebuilt['the headers of chunks'] = None
        self._put(fields, piece.packing, tracks)

    def _write_chunk(self, raw: memoryview, index: dict[int, array[int]]) -> None:
        tracks = self._tracks(index)
        times = span(tracks) if tracks else (0, 0)
        fields = CHUNK.pack(*times, len(raw), zlib.crc32(raw)) + text('') + struct.pack('<Q', len(raw)) + raw
        self._put(fields, ChunkPacking('', len(raw), len(raw)), tracks)

    def _put(self, fields: bytes | bytearray, packing: ChunkPacking, tracks: list[ChannelTrack]) -> None:
        if tracks:
            self._losses.kept(*span(tracks))
        at = self._written
        self._write(RECORD.pack(Opcode.CHUNK, len(fields)))
        self._write(fields)
        self._write(self._contents.chunk(at, packing, tracks))

    def _tracks(self, index: dict[int, array[int]]) -> list[ChannelTrack]:
        """Of messages that are about to be written, with their index; their channels are in the copy then."""
        self._need(index)
        for number, entries in index.items():
            self._contents.tracks[number].index = entries
        return [self._contents.tracks[number] for number in index]

    # -- declarations ----------------------------------------------------------------------------------------------

    def _declare(self, op: int, content: bytes) -> bool:
        """Write a schema or a channel, unless it is in the copy; False if it contradicts what is, or lacks its schema."""
        number = int.from_bytes(content[:2], 'little')
        known = self._contents.schemas if op == Opcode.SCHEMA else self._contents.declared
        if number in known:
            return known[number] == record(op, content)
        if op == Opcode.CHANNEL and not self._need_schema(content):
            return False
        self._register(op, content)
        self._write(record(op, content))
        return True

    def _register(self, op: int, content: bytes) -> None:
        """One that is in the copy, maybe in a chunk."""
        number, contents = int.from_bytes(content[:2], 'little'), self._contents
        known = contents.schemas if op == Opcode.SCHEMA else contents.declared
        if number in known:
            return
        if op == Opcode.CHANNEL and not self._need_schema(content):
            return
        self._schemas.add(op, content)
        known[number] = record(op, content)
        if op == Opcode.CHANNEL:
            contents.tracks[number] = ChannelTrack(number, self._schemas.channels[number])

    def _prepare(self, contents: ChunkContents) -> None:
        """A chunk is about to be written: what it does not declare itself precedes it."""
        self._need(contents.needs)
        for op, content in contents.declarations:
            self._register(op, content)

    def _need(self, channels: Iterable[int]) -> None:
        """Channels that are declared in the summary alone, because their declarations in the data are damaged."""
        for number in channels:
            if number not in self._contents.tracks:
                self._declare(Opcode.CHANNEL, self._declaration('channels', number))

    def _need_schema(self, channel: bytes) -> bool:
        number = int.from_bytes(channel[2:4], 'little')
        if not number or number in self._contents.schemas:
            return True
        content = self._declaration('schemas', number)
        return bool(content) and self._declare(Opcode.SCHEMA, content)

    def _declaration(self, kind: str, number: int) -> bytes:
        salvage = self._salvage
        sources: list[Declarations] = [salvage.known, salvage.hints, salvage.unverified]
        found = next((each for each in sources if number in getattr(each, kind)), None)
        if found is salvage.unverified:
            self._rebuilt['schemas and channels, from a chunk whose checksum does not match'] = None
        if found is None:
            return b''
        content = bytes(getattr(found, kind)[number])
        salvage.known.add(Opcode.SCHEMA if kind == 'schemas' else Opcode.CHANNEL, content)  # later ones must not contradict it
        return content

    # -- damage ----------------------------------------------------------------------------------------------------

    def _damage(self, piece: Damaged) -> None:
        self._flush()  # messages before it are dated before it
        if piece.op != Opcode.CHUNK:
            messages = 1 if piece.op == Opcode.MESSAGE else 0 if piece.op in _WITHOUT_MESSAGES else None
            self._losses.add(piece.at, piece.size, piece.what, messages, None)
            return
        found = self._salvage.salvaged(piece)
        contents, kept = found.contents, 0
        if contents is not None and not found.is_verified:
            self._unverified += contents.messages
        if contents is not None and contents.messages and (found.is_verified or self._keeps_unverified):
            self._prepare(contents)
            kept = contents.messages
            self._write_chunk(contents.raw, contents.index)
        messages = None
        if contents is not None and not piece.is_torn:
            messages = contents.lost + contents.messages - kept if found.is_complete or not found.is_verified else None
        if found.is_complete and not messages:
            self._rebuilt[found.what] = None
        else:
            self._losses.add(piece.at, piece.size, found.what, messages, found.times)
            self._kept_of_damaged, self._expected = kept, 0

    def _index(self, piece: IntactRecord) -> None:
        """That of a damaged chunk shows how many messages it had; that of an intact one is what its messages say, or wrong."""
        entries = (piece.size - RECORD.size - _INDEX_HEAD) // _INDEX_ENTRY
        if self._kept_of_damaged is not None:
            self._expected += entries
            self._losses.count(self._expected - self._kept_of_damaged)
            return
        content = self._salvage.read(piece.at, piece.size)
        number = int.from_bytes(content[RECORD.size : RECORD.size + 2], 'little')
        known, told = self._indexes.get(number), array('Q', content[RECORD.size + _INDEX_HEAD :])
        if content[0] != Opcode.MESSAGE_INDEX or (known != told and (known is None or _pairs(known) != _pairs(told))):
            self._rebuilt['message indexes'] = None

    def _after(self, end: int) -> None:
        self._flush()
        if end < self._salvage.size:
            self._losses.add(end, self._salvage.size - end, 'bytes after the end of the file', 0, None)

    # -- the end ---------------------------------------------------------------------------------------------------

    def _check_end(self, data_end: int) -> None:
        """What follows the data: the summary must be complete, and agree with what was found."""
        place, summary = data_end + RECORD.size + 4, data_end + RECORD.size + 4
        is_wrong, chunks = False, 0
        while True:
            start = self._salvage.read(place, RECORD.size)
            op, length = RECORD.unpack(start) if len(start) == RECORD.size else (0, 0)
            if not op or place + RECORD.size + length > self._salvage.size:
                self._rebuilt['the summary and the footer'] = None
                return
            if op == Opcode.FOOTER:
                break
            content = self._salvage.read(place + RECORD.size, min(length, MOST_SUMMARY_BYTES))
            is_wrong |= not self._agrees(op, content)
            chunks += op == Opcode.CHUNK_INDEX
            place += RECORD.size + length
        tail = self._salvage.read(place + RECORD.size, FOOTER_BYTES + len(MAGIC))
        footer = parsed(Footer, tail.ljust(FOOTER_BYTES, b'\0')[:FOOTER_BYTES])
        if length != FOOTER_BYTES or tail[FOOTER_BYTES:] != MAGIC or footer.summary_start not in {0, summary}:
            self._rebuilt['the footer'] = None
        self._after(min(place + RECORD.size + FOOTER_BYTES + len(MAGIC), self._salvage.size))
        if footer.summary_start == summary and footer.summary_crc:
            is_wrong |= self._crc(summary, place + RECORD.size + FOOTER_BYTES - 4) != footer.summary_crc
        if not self._losses.found and (is_wrong or (chunks and chunks != len(self._contents.chunks))):
            self._rebuilt['the summary'] = None
        data_crc = int.from_bytes(self._salvage.read(data_end + RECORD.size, 4), 'little')
        if data_crc and not self._losses.found and not self._rebuilt and self._crc(0, data_end) != data_crc:
            self._losses.add(0, 0, WRONG_DATA, 0, None)

    def _agrees(self, op: int, content: bytes) -> bool:
        """Whether a record of the summary is what was found in the data."""
        try:
            if op in {Opcode.SCHEMA, Opcode.CHANNEL}:
                known = self._contents.schemas if op == Opcode.SCHEMA else self._contents.declared
                return bool(known.get(int.from_bytes(content[:2], 'little'), record(op, content)) == record(op, content))
            if op == Opcode.STATISTICS:
                return bool(parsed(Statistics, content).message_count == self._contents.messages)
            if op == Opcode.CHUNK_INDEX:
                chunk = parsed(ChunkIndex, content)
                return bool(self._places.get(chunk.chunk_start_offset) == chunk.chunk_length)
            if op in {Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}:
                at, size = struct.unpack_from('<QQ', content)
                return bool(self._places.get(at) == size)
        except UNREADABLE:
            return False
        return op == Opcode.SUMMARY_OFFSET or op > Opcode.DATA_END

    def _crc(self, start: int, end: int) -> int:
        found = 0
        while start < end and (block := self._salvage.read(start, min(BLOCK_BYTES, end - start))):
            found, start = zlib.crc32(block, found), start + len(block)
        return found

    def _end(self) -> McapRepair:
        metadata = None
        if self._profile == 'ros2':
            metadata = to_yaml(bagfile_information([self._contents.info(self._path)], ros_distro=self._ros_distro))
        self._write(self._contents.ending(self._written, metadata))
        is_written = self._out is not None
        info = self._contents.info(self._path, self._written if is_written else 0, self._digest.hexdigest() if is_written else '')
        losses, statistics = tuple(self._losses.found), self._salvage.statistics
        lost = None if any(loss.messages is None for loss in losses) else sum(loss.messages or 0 for loss in losses)
        if lost is None and statistics is not None and statistics.message_count >= info.messages:
            lost = statistics.message_count - info.messages
        return McapRepair(info, self._salvage.size, losses, tuple(self._rebuilt), lost, self._unverified, self._is_cut)

    def _copy(self, at: int, size: int) -> None:
        for start in range(at, at + size, BLOCK_BYTES):
            self._write(self._salvage.read(start, min(BLOCK_BYTES, at + size - start)))

    def _write(self, content: bytes | bytearray) -> None:
        self._written += len(content)
        if self._out is None:
            return
        self._digest.update(content)
        view = memoryview(content)
        while view:
            view = view[os.write(self._out, view) :]


def _pairs(index: array[int]) -> list[tuple[int, int]]:
    """Times and offsets, whose order is up to the writer."""
    return sorted(zip(index[::2], index[1::2], strict=False))
