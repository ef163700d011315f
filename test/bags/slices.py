"""Slices as tests write them, and as the `mcap` package reads them: every checksum verified, every index followed."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Footer, MessageIndex, SummaryOffset
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

STRING = 'string data\n'
TALK = Channel('/talk', 'std_msgs/msg/String', 'ros2msg', STRING, 'RIHS01_' + 'a' * 64, '')
ECHO = Channel('/echo', 'std_msgs/msg/String', 'ros2msg', STRING, 'RIHS01_' + 'a' * 64, '- history: 1\n')
BLOB = Channel('/blob', 'nowhere/msg/Blob', '', '', '', '')


class Recorded(NamedTuple):
    """A message as written and read."""

    topic: str
    log_ns: int
    publish_ns: int
    sequence: int
    cdr: bytes


def messages(count: int, *, size: int = 20) -> Iterator[tuple[Channel, Recorded]]:
    """On three topics, alternating, a millisecond apart; each with unique bytes."""
    for number in range(count):
        channel = (TALK, ECHO, BLOB)[number % 3]
        at = 1_800_000_000_000_000_000 + number * 1_000_000
        yield channel, Recorded(channel.topic, at, at - 300, number, (number.to_bytes(4, 'little') * size)[: max(size, 4)])


def fill(writer: SliceWriter, written: Iterable[tuple[Channel, Recorded]], *, sync_every: int = 0) -> list[Recorded]:
    """Write them; a sync after each ``sync_every``."""
    done = []
    for channel, one in written:
        writer.write(channel, one.log_ns, one.publish_ns, one.sequence, one.cdr)
        done.append(one)
        if sync_every and not len(done) % sync_every:
            writer.sync()
    return done


def closed(path: Path, count: int, *, compression: str = 'none', sync_every: int = 0) -> tuple[SliceInfo, list[Recorded]]:
    """A complete slice."""
    writer = SliceWriter(path, compression=compression, chunk_bytes=1 << 20)
    done = fill(writer, messages(count), sync_every=sync_every)
    return writer.close(), done


def indexed(path: Path) -> list[Recorded]:
    """The messages by log time, found through the summary and the chunk index."""
    return _read(path, lambda file: SeekingReader(file, validate_crcs=True).iter_messages())


def in_order(path: Path) -> list[Recorded]:
    """The messages in file order, read from its beginning without the summary."""
    return _read(path, lambda file: NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))


def check(path: Path) -> None:
    """Every message index entry points to its message, every summary offset to its group, and the summary's CRC-32 is correct."""
    content = path.read_bytes()
    data = memoryview(b'')
    for record in StreamReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True).records:
        if isinstance(record, Chunk):
            stream, length = get_chunk_data_stream(record, validate_crc=True)
            data = memoryview(stream.read(length))
        elif isinstance(record, MessageIndex):
            for time, offset in record.records:
                assert data[offset] == 5
                assert int.from_bytes(data[offset + 9 : offset + 11], 'little') == record.channel_id
                assert int.from_bytes(data[offset + 15 : offset + 23], 'little') == time
        elif isinstance(record, SummaryOffset):
            assert content[record.group_start] == record.group_opcode
        elif isinstance(record, Footer):
            assert record.summary_crc == zlib.crc32(content[record.summary_start : -12])


def _read(path: Path, read: Callable[[io.BufferedReader], Iterable[tuple[object, object, object]]]) -> list[Recorded]:
    with path.open('rb') as file:
        return [
            Recorded(channel.topic, one.log_time, one.publish_time, one.sequence, one.data)  # type: ignore[attr-defined]
            for _, channel, one in read(file)
        ]
