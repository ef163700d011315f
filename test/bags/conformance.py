"""The variants of the MCAP project's conformance tests, made by the reference writer: six inputs, with every set of features.

The features are those of https://github.com/foxglove/mcap/tree/main/tests/conformance: ``ch`` chunks, ``mx`` message indexes,
``st`` statistics, ``rsh`` and ``rch`` repeated schemas and channels, ``ax``, ``mdx`` and ``chx`` indexes of attachments, metadata
and chunks, ``sum`` summary offsets, ``pad`` extra bytes at the end of records, which readers must ignore.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any
from unittest import mock

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

FEATURES = ('ch', 'mx', 'st', 'rsh', 'rch', 'ax', 'mdx', 'chx', 'sum', 'pad')
INDEXES = {'mx': IndexType.MESSAGE, 'ax': IndexType.ATTACHMENT, 'mdx': IndexType.METADATA, 'chx': IndexType.CHUNK}
EXTRA = b'\x01\xff\xff'
UNPADDED = {Opcode.FOOTER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END}
"""Records whose last field takes the remaining bytes, or that are found by their size."""


@dataclass(frozen=True)
class Recorded:
    """The contents of a file."""

    name: str
    schema: tuple[str, str, bytes] | None = None
    channel: tuple[str, str, dict[str, str]] | None = None
    messages: tuple[tuple[int, int, int], ...] = ()
    """Log time, publish time, sequence."""
    attachment: str = ''
    metadata: str = ''

    def can_have(self, features: set[str]) -> bool:
        """Whether the features make sense for it, and with each other."""
        needs = {'ax': self.attachment, 'mdx': self.metadata, 'rsh': self.schema, 'rch': self.channel, 'ch': self.channel}
        return (
            all(has for feature, has in needs.items() if feature in features)
            and not (features & {'chx', 'mx'} and 'ch' not in features)
            and not ('sum' in features and not features & {'chx', 'rsh', 'rch', 'mdx', 'ax', 'st'})
        )


DATA = b'\x01\x02\x03'
EXAMPLE = ('Example', 'c', b'\x04\x05\x06')
CHANNEL = ('example', 'a', {'foo': 'bar'})
INPUTS = (
    Recorded('NoData'),
    Recorded('OneSchemalessMessage', None, ('example', 'text', {}), ((2, 1, 10),)),
    Recorded('OneMessage', EXAMPLE, CHANNEL, ((2, 1, 10),)),
    Recorded('OneAttachment', attachment='myFile'),
    Recorded('OneMetadata', metadata='myMetadata'),
    Recorded('TenMessages', EXAMPLE, CHANNEL, tuple((t, t, n) for n, t in enumerate((0, 2, 1, 3, 3, 5, 4, 7, 8, 9)))),
)


class PaddedBuilder(RecordBuilder):
    """Adds bytes to records that a later version of the format might have."""

    def finish_record(self) -> None:
        if self._buffer.getbuffer()[self._record_start_offset] not in UNPADDED:
            self.write(EXTRA)
        super().finish_record()


def variants() -> Iterator[tuple[str, Recorded, bytes]]:
    """The name, contents and file of each."""
    for recorded in INPUTS:
        for count in range(len(FEATURES) + 1):
            for features in map(set, combinations(FEATURES, count)):
                if recorded.can_have(features):
                    yield '-'.join((recorded.name, *sorted(features))), recorded, made(recorded, features)


def made(recorded: Recorded, features: set[str]) -> bytes:
    """A file with these features."""
    options: dict[str, Any] = {
        'compression': CompressionType.NONE, 'use_chunking': 'ch' in features, 'use_statistics': 'st' in features,
        'repeat_channels': 'rch' in features, 'repeat_schemas': 'rsh' in features, 'use_summary_offsets': 'sum' in features,
        'index_types': IndexType.NONE,
    }  # fmt: skip
    for feature, index in INDEXES.items():
        if feature in features:
            options['index_types'] |= index
    builder = PaddedBuilder if 'pad' in features else RecordBuilder
    file = io.BytesIO()
    with mock.patch('mcap.writer.RecordBuilder', builder), mock.patch('mcap._chunk_builder.RecordBuilder', builder):
        writer = Writer(file, **options)
        writer.start('', '')
        schema = writer.register_schema(*recorded.schema) if recorded.schema else 0
        if recorded.channel:
            topic, encoding, metadata = recorded.channel
            channel = writer.register_channel(topic, encoding, schema, metadata)
        for log_ns, publish_ns, sequence in recorded.messages:
            writer.add_message(channel, log_ns, DATA, publish_ns, sequence)
        if recorded.attachment:
            writer.add_attachment(1, 2, recorded.attachment, 'application/octet-stream', DATA)
        if recorded.metadata:
            writer.add_metadata(recorded.metadata, {'foo': 'bar'})
        writer.finish()
    return file.getvalue()
