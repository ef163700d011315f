"""MCAP files of other writers, small enough to be cut at every byte, and what the reference reader finds in a file."""

from __future__ import annotations

import io
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

NOON_NS = 1_760_788_800_000_000_000
MESSAGES, A_CHUNK = 24, 6


class Found(NamedTuple):
    """A message with all that is needed to decode it."""

    topic: str
    encoding: str
    schema: tuple[str, str, bytes] | None
    metadata: tuple[tuple[str, str], ...]
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes


def write(path: Path, compression: CompressionType = CompressionType.NONE, *, chunked: bool = True, crcs: bool = True,
          indexes: IndexType = IndexType.ALL, summary: bool = True) -> None:  # fmt: skip
    """Three channels (two on one topic, one without a schema), a binary schema, an attachment and metadata in the middle."""
    size = 330 if chunked else 1 << 20
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=size, compression=compression, use_chunking=chunked, enable_crcs=crcs,
                        index_types=indexes, use_statistics=summary, use_summary_offsets=summary,
                        repeat_channels=summary, repeat_schemas=summary)  # fmt: skip
        writer.start('x-test', 'foreign')
        schema = writer.register_schema('pkg.Type', 'protobuf', b'\xff\x00binary\x80')
        channels = [
            writer.register_channel('no/slash', 'protobuf', schema, {'key': 'value'}),
            writer.register_channel('no/slash', 'protobuf', schema, {'key': 'other'}),
            writer.register_channel('/json', 'json', 0),
        ]
        for number in range(MESSAGES):
            at = NOON_NS + number * 1_000_000
            writer.add_message(channels[number % 3], at, bytes([number]) * 20, at - 500, number)
            if number == MESSAGES // 2:
                writer.add_attachment(NOON_NS, NOON_NS, 'notes.txt', 'text/plain', b'0123456789')
                writer.add_metadata('weather', {'sky': 'clear'})
        writer.finish()


def messages(path: Path, *, seeking: bool = True) -> list[Found]:
    """By the reference reader, with all checksums verified."""
    with path.open('rb') as file:
        if seeking:
            reader: SeekingReader | NonSeekingReader = SeekingReader(file, validate_crcs=True)
        else:
            reader = NonSeekingReader(file, validate_crcs=True)
        return [
            Found(channel.topic, channel.message_encoding, schema and (schema.name, schema.encoding, schema.data),
                  tuple(channel.metadata.items()), message.log_time, message.publish_time, message.sequence, message.data)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]  # fmt: skip


def check(path: Path) -> list[Found]:
    """The messages of a file that is valid: both ways of reading find the same, and the statistics count it."""
    found = messages(path)
    assert Counter(found) == Counter(messages(path, seeking=False))
    with path.open('rb') as file:
        reader = SeekingReader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(found)
        assert sum(summary.statistics.channel_message_counts.values()) == len(found)
        assert summary.statistics.attachment_count == len(list(reader.iter_attachments())) == len(summary.attachment_indexes)
        assert summary.statistics.metadata_count == len(list(reader.iter_metadata()))
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
    return found


class Span(NamedTuple):
    """Where the last byte of a chunk, or of a message outside of chunks, ends, and the numbers of its messages."""

    end: int
    sequences: frozenset[int]


def spans(content: bytes) -> list[Span]:
    """Of an intact file."""
    found: list[Span] = []
    file = io.BytesIO(content)
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk):
            inner = frozenset(each.sequence for each in breakup_chunk(record) if isinstance(each, Message))
            found.append(Span(file.tell(), inner))
        elif isinstance(record, Message):
            found.append(Span(file.tell(), frozenset({record.sequence})))
        elif isinstance(record, (Footer, Schema)):
            continue
    return found
