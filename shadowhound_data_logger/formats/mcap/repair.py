"""Copies the intact part of an MCAP file, by any writer and with any damage, into a complete file.

The header, schemas, channels, intact chunks, attachments, metadata and unknown records are copied verbatim. All indexes, the
statistics and rosbag2's own metadata record are rebuilt. Messages outside chunks, and those of damaged chunks, are written to
new, uncompressed chunks, because readers that use the index find only messages in chunks.

Losses are listed. A chunk with a wrong checksum is lost unless its messages are requested: it is unknown which of them are
wrong, and the new checksum in the copy would confirm them.
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
from shadowhound_data_logger.formats.mcap.damage_scan import Damaged, DamageScan, Piece
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
from shadowhound_data_logger.formats.mcap.index import FOOTER_BYTES, MAX_SUMMARY_BYTES, UNREADABLE, Schemas, parse
from shadowhound_data_logger.formats.mcap.record_finder import (
    BLOCK_BYTES,
    INDEX_ENTRY,
    INDEX_HEAD,
    ChunkContents,
    IntactChunk,
    IntactRecord,
    RecordFinder,
)
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo

PENDING_BYTES: Final = 1 << 20
"""Messages outside chunks are written in chunks of about this size."""
MAX_LOSSES: Final = 1000
"""Losses that are listed separately; further ones are summed up."""
MORE: Final = 'further damage'
WRONG_DATA: Final = 'the checksum of the data does not match: some of the data is wrong, but it is unknown which'
_SUMMARY: Final = frozenset({
    Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET,
})  # fmt: skip
_WITHOUT_MESSAGES: Final = _SUMMARY | {
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER,
}  # fmt: skip
OnProgress = Callable[[int], None]
"""Receives the number of bytes that were processed."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Bytes that are not in the copy. They were written between the two log times, which are None if unknown."""

    at: int
    bytes: int
    what: str
    messages: int | None
    """None if unknown."""
    from_ns: int | None
    to_ns: int | None


@dataclass(frozen=True, slots=True)
class McapRepair:
    """The contents and losses of a file. ``info`` describes the copy; without one, its size is 0 and its checksum empty."""

    info: SliceInfo
    bytes: int
    """Size of the damaged file."""
    losses: tuple[Loss, ...]
    rebuilt: tuple[str, ...]
    """Parts without messages that were missing or wrong, and were rebuilt for the copy."""
    lost_messages: int | None
    """None if unknown."""
    unverified: int
    """Messages of chunks with a wrong checksum: in the copy if they were requested, otherwise lost."""
    is_cut: bool
    """Whether the end is missing, so that more messages may have followed."""

    @property
    def is_damaged(self) -> bool:
        return bool(self.losses or self.rebuilt)


def examine(path: Path, on_progress: OnProgress = lambda _: None) -> McapRepair:
    """What ``repair`` would do. Raises BagDamaged if the file is not MCAP or cannot be read."""
    with _opened(path) as file:
        return _Repair(file, path, None, on_progress).run()


def repair(path: Path, out: Path, on_progress: OnProgress = lambda _: None, *, unverified: bool = False, ros_distro: str = '',
           mode: int = 0o666) -> McapRepair:  # fmt: skip
    """Write a complete file ``out``, which must not exist; it is on the disk when this returns.

    ``unverified``: also keep messages of chunks with a wrong checksum. Raises BagDamaged as ``examine`` does, and OSError.
    """
    with _opened(path) as file:
        target = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        try:
            found = _Repair(file, path, target, on_progress, unverified=unverified, ros_distro=ros_distro).run()
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
class _Report:
    """Losses in file order, and rebuilt parts, so far."""

    losses: list[Loss] = field(default_factory=list)
    rebuilt: dict[str, None] = field(default_factory=dict)
    """Ordered set of the parts that were rebuilt."""
    last_ns: int | None = None
    """Log time of the last message that was kept."""
    _first_open: int = 0
    """Index of the first loss after which no message was kept yet."""

    def add_loss(self, at: int, size: int, what: str, messages: int | None, times: tuple[int, int] | None) -> None:
        from_ns, to_ns = times or (self.last_ns, None)
        loss, last = Loss(at, size, what, messages, from_ns, to_ns), self.losses[-1] if self.losses else None
        if last is not None and (len(self.losses) >= MAX_LOSSES or (last.what == what and last.at + last.bytes == at)):
            known = None if last.messages is None or messages is None else last.messages + messages
            is_more = len(self.losses) >= MAX_LOSSES
            self.losses[-1] = replace(last, bytes=last.bytes + size, messages=known, to_ns=to_ns, what=MORE if is_more else what)
            self._first_open = min(self._first_open, len(self.losses) - 1)
        else:
            self.losses.append(loss)

    def add_kept(self, first_ns: int, last_ns: int) -> None:
        """Note that messages with these log times follow in the copy."""
        for index in range(self._first_open, len(self.losses)):
            loss = self.losses[index]
            self.losses[index] = replace(loss, to_ns=first_ns if loss.to_ns is None else loss.to_ns)
        self._first_open, self.last_ns = len(self.losses), last_ns

    def set_messages(self, messages: int) -> None:
        """Set the count of the last loss, from the message indexes of its chunk."""
        last = self.losses[-1]
        self.losses[-1] = replace(last, messages=max(messages, 0))


class _CopyWriter:
    """Writes the complete file: declarations before the messages that need them, then indexes and summary.

    Without ``out``, it only computes what it would write.
    """

    def __init__(self, finder: RecordFinder, report: _Report, out: int | None) -> None:
        self.contents = Contents()
        self.size = 0
        self._finder = finder
        self._report = report
        self._out = out
        self._schemas = Schemas()
        self._digest = hashlib.sha256()
        self._pending = bytearray()
        self._pending_index: dict[int, array[int]] = {}

    @property
    def sha256(self) -> str:
        """Checksum of the file in hex; empty without ``out``."""
        return '' if self._out is None else self._digest.hexdigest()

    def write(self, content: bytes | bytearray) -> None:
        self.size += len(content)
        if self._out is None:
            return
        self._digest.update(content)
        view = memoryview(content)
        while view:
            view = view[os.write(self._out, view) :]

    def copy(self, at: int, size: int) -> None:
        """Copy bytes of the damaged file."""
        for start in range(at, at + size, BLOCK_BYTES):
            self.write(self._finder.read(start, min(BLOCK_BYTES, at + size - start)))

    # -- messages --------------------------------------------------------------------------------------------------

    def add_message(self, content: bytes) -> None:
        """Add a message that is outside chunks to the pending chunk."""
        number, _, log_ns = struct.unpack_from('<HIQ', content)
        self._declare_channels([number])
        self._pending_index.setdefault(number, array('Q')).extend((log_ns, len(self._pending)))
        self._pending += record(Opcode.MESSAGE, content)
        if len(self._pending) >= PENDING_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the pending chunk."""
        if self._pending_index:
            raw, index = memoryview(bytes(self._pending)), self._pending_index
            self._pending, self._pending_index = bytearray(), {}
            self._write_chunk(raw, index)

    def copy_chunk(self, piece: IntactChunk) -> None:
        """Copy a chunk unchanged, except for the times in its header, which no checksum covers: they are computed."""
        self.flush()
        self._register_declarations(piece.contents)
        tracks = self._tracks(piece.contents.index)
        fields = bytearray(self._finder.read(piece.at + RECORD.size, piece.size - RECORD.size))
        if tracks and piece.times != span(tracks):
            self._report.rebuilt['the times of chunks'] = None
            struct.pack_into('<QQ', fields, 0, *span(tracks))
        if self._finder.read(piece.at, RECORD.size) != RECORD.pack(Opcode.CHUNK, len(fields)):
            self._report.rebuilt['the headers of chunks'] = None
        self._append_chunk(fields, piece.packing, tracks)

    def write_recovered(self, contents: ChunkContents) -> None:
        """Write the messages of a damaged chunk as a new chunk."""
        self._register_declarations(contents)
        self._write_chunk(contents.raw, contents.index)

    def _write_chunk(self, raw: memoryview, index: dict[int, array[int]]) -> None:
        tracks = self._tracks(index)
        times = span(tracks) if tracks else (0, 0)
        fields = CHUNK.pack(*times, len(raw), zlib.crc32(raw)) + text('') + struct.pack('<Q', len(raw)) + raw
        self._append_chunk(fields, ChunkPacking('', len(raw), len(raw)), tracks)

    def _append_chunk(self, fields: bytes | bytearray, packing: ChunkPacking, tracks: list[ChannelTrack]) -> None:
        if tracks:
            self._report.add_kept(*span(tracks))
        at = self.size
        self.write(RECORD.pack(Opcode.CHUNK, len(fields)))
        self.write(fields)
        self.write(self.contents.add_chunk(at, packing, tracks))

    def _tracks(self, index: dict[int, array[int]]) -> list[ChannelTrack]:
        """The tracks of messages that will be written, with their index; declares their channels."""
        self._declare_channels(index)
        for number, entries in index.items():
            self.contents.tracks[number].index = entries
        return [self.contents.tracks[number] for number in index]

    # -- declarations ----------------------------------------------------------------------------------------------

    def declare(self, op: int, content: bytes) -> bool:
        """Write a schema or channel unless the copy has it; False if it contradicts the copy's or its schema is missing."""
        number = int.from_bytes(content[:2], 'little')
        known = self.contents.schemas if op == Opcode.SCHEMA else self.contents.declared
        if number in known:
            return known[number] == record(op, content)
        if op == Opcode.CHANNEL and not self._declare_schema_of(content):
            return False
        self._register(op, content)
        self.write(record(op, content))
        return True

    def _register(self, op: int, content: bytes) -> None:
        """Add a schema or channel that is in the copy, perhaps in a chunk, to the contents."""
        number, contents = int.from_bytes(content[:2], 'little'), self.contents
        known = contents.schemas if op == Opcode.SCHEMA else contents.declared
        if number in known:
            return
        if op == Opcode.CHANNEL and not self._declare_schema_of(content):
            return
        self._schemas.add(op, content)
        known[number] = record(op, content)
        if op == Opcode.CHANNEL:
            contents.tracks[number] = ChannelTrack(number, self._schemas.channels[number])

    def _register_declarations(self, contents: ChunkContents) -> None:
        """Prepare for a chunk: write the channels that it needs, and register those that it declares."""
        self._declare_channels(contents.needs)
        for op, content in contents.declarations:
            self._register(op, content)

    def _declare_channels(self, channels: Iterable[int]) -> None:
        """Write channels whose declarations in the data are damaged, from another source."""
        for number in channels:
            if number not in self.contents.tracks:
                self.declare(Opcode.CHANNEL, self._find_declaration('channels', number))

    def _declare_schema_of(self, channel: bytes) -> bool:
        number = int.from_bytes(channel[2:4], 'little')
        if not number or number in self.contents.schemas:
            return True
        content = self._find_declaration('schemas', number)
        return bool(content) and self.declare(Opcode.SCHEMA, content)

    def _find_declaration(self, kind: str, number: int) -> bytes:
        finder = self._finder
        found = next((each for each in finder.sources if number in getattr(each, kind)), None)
        if found is finder.unverified:
            self._report.rebuilt['schemas and channels, from a chunk with a wrong checksum'] = None
        if found is None:
            return b''
        content = bytes(getattr(found, kind)[number])
        # Later declarations must not contradict this one.
        finder.known.add(Opcode.SCHEMA if kind == 'schemas' else Opcode.CHANNEL, content)
        return content


class _Repair:
    """One pass over a damaged file, which writes the copy and the report."""

    def __init__(self, file: int, path: Path, out: int | None, on_progress: OnProgress, *, unverified: bool = False,
                 ros_distro: str = '') -> None:  # fmt: skip
        self._scan = DamageScan(file, on_progress)
        self._finder = self._scan.finder
        self._path = path
        self._ros_distro = ros_distro
        self._keeps_unverified = unverified
        self._report = _Report()
        self._writer = _CopyWriter(self._finder, self._report, out)
        self._profile = ''
        self._unverified = 0
        self._kept_of_damaged: int | None = None
        """While message indexes of a damaged chunk may follow: the number of its messages that were kept."""
        self._expected = 0
        self._indexes: Mapping[int, array[int]] = {}
        """The indexes of the previous chunk, computed from its messages."""
        self._places: dict[int, int] = {}
        """Offset -> size of the chunks, attachments and metadata records, for which the summary has indexes."""

    def run(self) -> McapRepair:
        end: int | None = None
        rebuilt, is_cut = self._report.rebuilt, False
        for piece in self._scan.pieces():
            if isinstance(piece, IntactRecord) and piece.op == Opcode.MESSAGE_INDEX:
                self._check_index(piece)
                continue
            self._kept_of_damaged, self._indexes = None, {}
            if not piece.at:
                self._write_header(piece)
            elif isinstance(piece, IntactChunk):
                self._indexes, self._places[piece.at] = piece.contents.index, piece.size
                self._writer.copy_chunk(piece)
            elif isinstance(piece, Damaged):
                self._add_damaged(piece)
            elif piece.op == Opcode.DATA_END:
                end = piece.at
            elif piece.op == Opcode.FOOTER:
                rebuilt['the end of the data'] = None
                self._add_surplus(piece.at + piece.size + len(MAGIC))
                break
            else:
                self._copy_record(piece)
        self._writer.flush()
        if not self._writer.size:
            self._write_header(None)
        if end is not None:
            self._check_summary(end)
        elif 'the end of the data' not in rebuilt:
            rebuilt['the summary and the footer'], is_cut = None, True
        return self._finish(is_cut=is_cut)

    def _write_header(self, piece: Piece | None) -> None:
        """Write the header; a missing one is rebuilt with the profile that the schemas suggest."""
        if isinstance(piece, IntactRecord) and piece.content is not None:
            self._profile = parse(Header, piece.content).profile
            header = MAGIC + record(Opcode.HEADER, piece.content)
            if self._finder.read(0, len(header)) != header:
                self._report.rebuilt['the header'] = None
            self._writer.write(header)
            return
        encodings = {parse(Schema, content).encoding for content in self._finder.summary.schemas.values()}
        self._profile = 'ros2' if not encodings or encodings & {'ros2msg', 'ros2idl'} else ''
        self._report.rebuilt['the header'] = None
        self._writer.write(head() if self._profile else MAGIC + record(Opcode.HEADER, text(''), text('')))
        if piece is not None:
            if piece.size >= self._finder.size:
                raise BagDamaged(f'{self._path} is not an MCAP file, or nothing in it can be read', path=str(self._path))
            self._report.add_loss(piece.at, piece.size, 'the beginning of the file', None, None)

    # -- pieces ----------------------------------------------------------------------------------------------------

    def _copy_record(self, piece: IntactRecord) -> None:
        """Copy a record outside chunks, unless the copy gets a new one."""
        content, writer = piece.content, self._writer
        if piece.op in {Opcode.SCHEMA, Opcode.CHANNEL} and content is not None:
            if self._finder.read(piece.at + RECORD.size, piece.size - RECORD.size) != content:
                self._report.rebuilt['schemas and channels, from the summary'] = None
            if not writer.declare(piece.op, content):
                what = 'a channel without its schema, or with the number of another one'
                self._report.add_loss(piece.at, piece.size, what, 0, None)
        elif piece.op == Opcode.MESSAGE and content is not None:
            writer.add_message(content)
        elif piece.op == Opcode.METADATA and content is not None:
            self._places[piece.at] = piece.size
            name = parse(Metadata, content).name
            if name != 'rosbag2' or self._profile != 'ros2':
                writer.flush()
                writer.contents.add_metadata(writer.size, piece.size, name)
                writer.copy(piece.at, piece.size)
        elif piece.op == Opcode.ATTACHMENT:
            self._places[piece.at] = piece.size
            writer.flush()
            self._copy_attachment(piece)
        elif piece.op not in _SUMMARY and piece.op != Opcode.HEADER:
            writer.flush()
            writer.copy(piece.at, piece.size)

    def _copy_attachment(self, piece: IntactRecord) -> None:
        start = piece.at + RECORD.size
        times = struct.unpack('<QQ', self._finder.read(start, 16))
        place, texts = start + 16, []
        for _ in range(2):
            length = int.from_bytes(self._finder.read(place, 4), 'little')
            texts.append(self._finder.read(place + 4, min(length, 1 << 16)).decode(errors='replace'))
            place += 4 + length
        size = int.from_bytes(self._finder.read(place, 8), 'little')
        writer = self._writer
        writer.contents.add_attachment(writer.size, piece.size, texts[0], texts[1], size, (times[0], times[1]))
        writer.copy(piece.at, piece.size)

    def _add_damaged(self, piece: Damaged) -> None:
        """Write the readable messages of a damaged piece, and report the rest."""
        self._writer.flush()  # sets the times of earlier losses
        if piece.op != Opcode.CHUNK:
            messages = 1 if piece.op == Opcode.MESSAGE else 0 if piece.op in _WITHOUT_MESSAGES else None
            self._report.add_loss(piece.at, piece.size, piece.what, messages, None)
            return
        found = self._scan.recover_chunk(piece)
        contents, kept = found.contents, 0
        if contents is not None and not found.is_verified:
            self._unverified += contents.messages
        if contents is not None and contents.messages and (found.is_verified or self._keeps_unverified):
            kept = contents.messages
            self._writer.write_recovered(contents)
        messages = None
        if contents is not None and not piece.is_torn:
            messages = contents.lost + contents.messages - kept if found.is_complete or not found.is_verified else None
        if found.is_complete and not messages:
            self._report.rebuilt[found.what] = None
        else:
            self._report.add_loss(piece.at, piece.size, found.what, messages, found.times)
            self._kept_of_damaged, self._expected = kept, 0

    def _check_index(self, piece: IntactRecord) -> None:
        """The index of a damaged chunk has the number of its messages; that of an intact chunk must match its messages."""
        entries = (piece.size - RECORD.size - INDEX_HEAD) // INDEX_ENTRY
        if self._kept_of_damaged is not None:
            self._expected += entries
            self._report.set_messages(self._expected - self._kept_of_damaged)
            return
        content = self._finder.read(piece.at, piece.size)
        number = int.from_bytes(content[RECORD.size : RECORD.size + 2], 'little')
        computed, written = self._indexes.get(number), array('Q', content[RECORD.size + INDEX_HEAD :])
        differs = computed != written and (computed is None or _pairs(computed) != _pairs(written))
        if content[0] != Opcode.MESSAGE_INDEX or differs:
            self._report.rebuilt['message indexes'] = None

    def _add_surplus(self, end: int) -> None:
        """Report bytes after the end of the MCAP file."""
        self._writer.flush()
        if end < self._finder.size:
            self._report.add_loss(end, self._finder.size - end, 'bytes after the end of the file', 0, None)

    # -- the end ---------------------------------------------------------------------------------------------------

    def _check_summary(self, data_end: int) -> None:
        """Check that everything after the data is complete and matches the contents."""
        finder, rebuilt, losses = self._finder, self._report.rebuilt, self._report.losses
        place, summary = data_end + RECORD.size + 4, data_end + RECORD.size + 4
        is_wrong, chunks = False, 0
        while True:
            op, length = finder.opcode_and_length(place)
            if not op or place + RECORD.size + length > finder.size:
                rebuilt['the summary and the footer'] = None
                return
            if op == Opcode.FOOTER:
                break
            content = finder.read(place + RECORD.size, min(length, MAX_SUMMARY_BYTES))
            is_wrong |= not self._matches_contents(op, content)
            chunks += op == Opcode.CHUNK_INDEX
            place += RECORD.size + length
        tail = finder.read(place + RECORD.size, FOOTER_BYTES + len(MAGIC))
        footer = parse(Footer, tail.ljust(FOOTER_BYTES, b'\0')[:FOOTER_BYTES])
        if length != FOOTER_BYTES or tail[FOOTER_BYTES:] != MAGIC or footer.summary_start not in {0, summary}:
            rebuilt['the footer'] = None
        self._add_surplus(min(place + RECORD.size + FOOTER_BYTES + len(MAGIC), finder.size))
        if footer.summary_start == summary and footer.summary_crc:
            is_wrong |= finder.crc(summary, place + RECORD.size + FOOTER_BYTES - 4) != footer.summary_crc
        if not losses and (is_wrong or (chunks and chunks != len(self._writer.contents.chunks))):
            rebuilt['the summary'] = None
        data_crc = int.from_bytes(finder.read(data_end + RECORD.size, 4), 'little')
        if data_crc and not losses and not rebuilt and finder.crc(0, data_end) != data_crc:
            self._report.add_loss(0, 0, WRONG_DATA, 0, None)

    def _matches_contents(self, op: int, content: bytes) -> bool:
        """Whether a record of the summary matches the data."""
        contents = self._writer.contents
        try:
            if op in {Opcode.SCHEMA, Opcode.CHANNEL}:
                known = contents.schemas if op == Opcode.SCHEMA else contents.declared
                return bool(known.get(int.from_bytes(content[:2], 'little'), record(op, content)) == record(op, content))
            if op == Opcode.STATISTICS:
                return bool(parse(Statistics, content).message_count == contents.messages)
            if op == Opcode.CHUNK_INDEX:
                chunk = parse(ChunkIndex, content)
                return bool(self._places.get(chunk.chunk_start_offset) == chunk.chunk_length)
            if op in {Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}:
                at, size = struct.unpack_from('<QQ', content)
                return bool(self._places.get(at) == size)
        except UNREADABLE:
            return False
        return op == Opcode.SUMMARY_OFFSET or op > Opcode.DATA_END

    def _finish(self, *, is_cut: bool) -> McapRepair:
        """Write the summary, and return the result."""
        writer, metadata = self._writer, None
        if self._profile == 'ros2':
            metadata = to_yaml(bagfile_information([writer.contents.info(self._path)], ros_distro=self._ros_distro))
        writer.write(writer.contents.ending(writer.size, metadata))
        sha256 = writer.sha256
        info = writer.contents.info(self._path, writer.size if sha256 else 0, sha256)
        losses, statistics = tuple(self._report.losses), self._scan.statistics
        lost = None if any(loss.messages is None for loss in losses) else sum(loss.messages or 0 for loss in losses)
        if lost is None and statistics is not None and statistics.message_count >= info.messages:
            lost = statistics.message_count - info.messages
        return McapRepair(info, self._finder.size, losses, tuple(self._report.rebuilt), lost, self._unverified, is_cut)


def _pairs(index: array[int]) -> list[tuple[int, int]]:
    """Times and offsets, sorted: writers may use any order."""
    return sorted(zip(index[::2], index[1::2], strict=False))
