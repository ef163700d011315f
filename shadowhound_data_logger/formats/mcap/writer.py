"""Writes one slice of a bag: an MCAP file in rosbag2's layout, which survives any crash up to the last ``sync``."""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.zstd import compress
from shadowhound_data_logger.formats.mcap.format import (
    CHUNK,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    ROS2,
    ChannelTrack,
    ChunkPacking,
    Contents,
    head,
    mapping,
    record,
    span,
    text,
)
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo

OPEN_SUFFIX: Final = '.open'
"""Suffix of the name of a slice that is being written."""
DEFAULT_CHUNK_BYTES: Final = 1 << 20
_MESSAGE: Final = int(Opcode.MESSAGE)


class SliceWriter:
    """Writes one slice, so that a crash loses only messages that were not synced.

    Lifecycle: new; ``write`` and ``sync`` any number of times; ``close`` or ``abort`` once. One thread at a time.

    The file is ``<path>.open`` until ``close`` renames it. Disk errors are OSErrors; after one, only ``abort`` is allowed, and
    recovery makes a complete slice of what was written before.
    """

    def __init__(
        self, path: Path, *, compression: str = 'zstd', chunk_bytes: int = DEFAULT_CHUNK_BYTES, ros_distro: str = '',
        mode: int = 0o600, profile: str = ROS2,
    ) -> None:  # fmt: skip
        """``mode``: permissions of the file, before the umask. ``profile``: a copy has the profile of the original."""
        self.path = path
        self._ros_distro = ros_distro
        if compression not in _COMPRESSORS:
            raise ValueError(f'compression is {compression!r} and must be one of {", ".join(_COMPRESSORS)}')
        self._compress = _COMPRESSORS[compression]
        self._compression = compression if compression != 'none' else ''
        self._chunk_bytes = chunk_bytes
        self._contents = Contents()
        self._last: dict[str, tuple[Channel, ChannelTrack]] = {}
        """The channel of the last message, by topic: this lookup is faster than hashing a channel."""
        self._tracks: dict[Channel, ChannelTrack] = {}
        self._chunk = bytearray(chunk_bytes)
        self._view = memoryview(self._chunk)
        self._used = 0
        self._declared = b''
        """Written before the chunk, not into it: if the chunk is damaged, later chunks still have their channels."""
        self._digest = hashlib.sha256()
        if path.exists():
            raise FileExistsError(f'{path} already exists')
        self._open_path = path.with_name(path.name + OPEN_SUFFIX)
        self._file = os.open(self._open_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        self._written = 0
        try:
            self._append(head(profile))
            sync(path.parent)  # a power cut loses even a synced file if its directory entry was not synced
        except OSError:
            self.abort()
            raise

    @property
    def size(self) -> int:
        """Bytes in the file, plus bytes in the open chunk before compression."""
        return self._written + self._used

    def write(self, channel: Channel, log_ns: int, publish_ns: int, sequence: int, cdr: bytes) -> None:
        """Add a received message; copies ``cdr``.

        Stamps are Unix nanoseconds; if the publisher's is unknown (0 or less), the log time is used, as MCAP requires.
        """
        log_ns = max(log_ns, 0)
        self.copy(channel, log_ns, publish_ns if publish_ns > 0 else log_ns, sequence, cdr)

    def copy(self, channel: Channel, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Add a message from another file with its times (uint64) unchanged."""
        last = self._last.get(channel.topic)
        track = last[1] if last is not None and last[0] is channel else self._track(channel)
        length, at = len(data), self._used
        after = at + MESSAGE.size + length
        if after > self._chunk_bytes:
            at, after = 0, self._make_room(MESSAGE.size + length)
        size = length + MESSAGE_FIELDS
        MESSAGE.pack_into(self._chunk, at, _MESSAGE, size, track.number, sequence & 0xFFFFFFFF, log_ns, publish_ns)
        self._view[at + MESSAGE.size : after] = data
        track.index.append(log_ns)
        track.index.append(at)
        self._used = after

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record; it is on the disk after the next ``sync``."""
        self._end_chunk()
        metadata = record(Opcode.METADATA, text(name), mapping(values))
        self._contents.add_metadata(self._written, len(metadata), name)
        self._append(metadata)

    def sync(self) -> None:
        """End the chunk and wait until it is on the disk."""
        self._end_chunk()
        os.fdatasync(self._file)

    def close(self) -> SliceInfo:
        """Complete and rename the file; it is on the disk when this returns."""
        self._end_chunk()
        contents = self._contents
        metadata = bagfile_information([contents.info(self.path)], ros_distro=self._ros_distro)
        self._append(contents.ending(self._written, to_yaml(metadata)))
        os.fsync(self._file)
        os.close(self._file)
        self._file = -1
        os.replace(self._open_path, self.path)
        sync(self.path.parent)
        return contents.info(self.path, self._written, self._digest.hexdigest())

    def abort(self) -> None:
        """Close the file without completing it, for recovery; the open chunk is lost. No effect after ``close``."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _track(self, channel: Channel) -> ChannelTrack:
        track = self._tracks.get(channel)
        if track is None:
            track, records = self._contents.declare(channel)
            self._tracks[channel] = track
            self._declared += records
        self._last[channel.topic] = channel, track
        return track

    def _make_room(self, size: int) -> int:
        """End the chunk; a message larger than the maximum chunk gets a separate one."""
        self._end_chunk()
        if size > len(self._chunk):
            self._chunk = bytearray(size)
            self._view = memoryview(self._chunk)
        return size

    def _end_chunk(self) -> None:
        tracks = [track for track in self._contents.tracks.values() if track.index]
        if not tracks:
            return
        raw, compression = self._view[: self._used], self._compression
        data = self._compress(raw)
        if len(data) >= len(raw):
            data, compression = raw, ''
        fields = CHUNK.pack(*span(tracks), len(raw), zlib.crc32(raw)) + text(compression) + struct.pack('<Q', len(data))
        at = self._written + len(self._declared)
        indexes = self._contents.add_chunk(at, ChunkPacking(compression, len(data), len(raw)), tracks)
        declared, self._declared = self._declared, b''
        self._used = 0
        self._append(declared + RECORD.pack(Opcode.CHUNK, len(fields) + len(data)) + fields, data, indexes)

    def _append(self, *parts: bytes | memoryview) -> None:
        for part in parts:
            self._digest.update(part)
            view = memoryview(part)
            while view:
                view = view[os.write(self._file, view) :]
            self._written += len(part)


def _zstd(raw: memoryview) -> bytes:
    return compress(raw, 1)


_COMPRESSORS: Final[dict[str, Callable[[memoryview], bytes | memoryview]]] = {'zstd': _zstd, 'none': lambda raw: raw}
