"""Writes a table as a Parquet file, in pure Python: the little of the format that the catalog needs, which all readers read.

One row group, a PLAIN page a column, gzip; nulls as definition levels; null counts, least and greatest value of each column.
https://github.com/apache/parquet-format (Encodings.md, LogicalTypes.md, src/main/thrift/parquet.thrift); the metadata is
Thrift's compact protocol: https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

STRING, INT32, INT64, DOUBLE, TIME = 'string', 'int32', 'int64', 'double', 'time'
"""Kinds of columns. ``TIME`` is whole microseconds since 1970, UTC."""
MAGIC: Final = b'PAR1'
_PLAIN, _RLE = 0, 3
_GZIP: Final = 2
_REQUIRED, _OPTIONAL = 0, 1
_LEVEL: Final = 6
"""Of the compression: 9 takes twice the time for one percent."""


@dataclass(frozen=True, slots=True)
class Column:
    """Name and kind; ``optional`` ones may have None among their values."""

    name: str
    kind: str
    optional: bool = True


@dataclass(frozen=True, slots=True)
class _Kind:
    """How a kind is stored: a physical type, what it means, and its values as bytes."""

    physical: int
    converted: int | None
    logical: bytes | None
    pack: Callable[[Sequence[Any]], bytes]


@dataclass(frozen=True, slots=True)
class _Chunk:
    """A written column: where it begins, and its sizes with the page's header."""

    column: Column
    offset: int
    values: int
    plain_bytes: int
    stored_bytes: int
    statistics: bytes


def table(columns: Mapping[Column, Sequence[Any]], about: Mapping[str, str]) -> bytes:
    """The file: all columns have as many values; ``about`` goes to the file's key-value metadata.

    Half a surrogate pair in a text becomes ``?``. Raises struct.error or AttributeError for a value that is not of its kind.
    """
    rows = len(next(iter(columns.values())))
    out = bytearray(MAGIC)
    chunks = [_write(out, column, values) for column, values in columns.items()]
    footer = _footer(chunks, rows, about)
    return bytes(out + footer + struct.pack('<I', len(footer)) + MAGIC)


def _write(out: bytearray, column: Column, values: Sequence[Any]) -> _Chunk:
    """Add a column's page to the file."""
    kind = _KINDS[column.kind]
    present = [value for value in values if value is not None]
    plain = kind.pack(present)
    if column.optional:
        levels = _levels(values, len(present))
        plain = struct.pack('<I', len(levels)) + levels + plain
    squeeze = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)  # 16: with gzip's header, as the format wants it
    stored = squeeze.compress(plain) + squeeze.flush()
    page = _struct((1, _I32, len(values)), (2, _I32, _PLAIN), (3, _I32, _RLE), (4, _I32, _RLE))
    header = _struct((1, _I32, 0), (2, _I32, len(plain)), (3, _I32, len(stored)), (5, _STRUCT, page))
    offset = len(out)
    out += header
    out += stored
    return _Chunk(column, offset, len(values), len(header) + len(plain), len(header) + len(stored),
                  _statistics(column.kind, kind, present, len(values) - len(present)))  # fmt: skip


def _levels(values: Sequence[Any], present: int) -> bytes:
    """Definition levels, 1 for a value and 0 for null: one run where all are alike, else a bit each."""
    if present in (0, len(values)):
        return _varint(len(values) << 1) + bytes((present > 0,))
    groups = (len(values) + 7) // 8
    bits = int(''.join('0' if value is None else '1' for value in reversed(values)), 2)
    return _varint(groups << 1 | 1) + bits.to_bytes(groups, 'little')


def _statistics(name: str, kind: _Kind, present: Sequence[Any], nulls: int) -> bytes:
    """The nulls, the greatest and the least value; a zero is signed so that neither sign is left out."""
    if not present:
        return _struct((3, _I64, nulls))
    least, greatest = min(present), max(present)
    if name == DOUBLE:
        least, greatest = least or -0.0, greatest or 0.0
    skip = 4 if name == STRING else 0  # the length
    return _struct((3, _I64, nulls), (5, _BINARY, kind.pack([greatest])[skip:]), (6, _BINARY, kind.pack([least])[skip:]))


def _footer(chunks: Sequence[_Chunk], rows: int, about: Mapping[str, str]) -> bytes:
    """FileMetaData."""
    size, stored = sum(chunk.plain_bytes for chunk in chunks), sum(chunk.stored_bytes for chunk in chunks)
    group = _struct((1, _LIST, (_STRUCT, [_chunk(chunk) for chunk in chunks])), (2, _I64, size), (3, _I64, rows),
                    (5, _I64, len(MAGIC)), (6, _I64, stored))  # fmt: skip
    root = _struct((4, _BINARY, b'schema'), (5, _I32, len(chunks)))
    pairs = [_struct((1, _BINARY, name.encode()), (2, _BINARY, value.encode())) for name, value in about.items()]
    by_type = _struct((1, _STRUCT, _struct()))
    return _struct(
        (1, _I32, 2),
        (2, _LIST, (_STRUCT, [root, *(_element(chunk.column) for chunk in chunks)])),
        (3, _I64, rows),
        (4, _LIST, (_STRUCT, [group])),
        (5, _LIST, (_STRUCT, pairs)),
        (6, _BINARY, b'shadowhound_data_logger'),
        (7, _LIST, (_STRUCT, [by_type] * len(chunks))),
    )


def _element(column: Column) -> bytes:
    """SchemaElement."""
    kind = _KINDS[column.kind]
    return _struct((1, _I32, kind.physical), (3, _I32, _OPTIONAL if column.optional else _REQUIRED),
                   (4, _BINARY, column.name.encode()), (6, _I32, kind.converted), (10, _STRUCT, kind.logical))  # fmt: skip


def _chunk(chunk: _Chunk) -> bytes:
    """ColumnChunk."""
    about = _struct(
        (1, _I32, _KINDS[chunk.column.kind].physical),
        (2, _LIST, (_I32, [_PLAIN, _RLE])),
        (3, _LIST, (_BINARY, [chunk.column.name.encode()])),
        (4, _I32, _GZIP),
        (5, _I64, chunk.values),
        (6, _I64, chunk.plain_bytes),
        (7, _I64, chunk.stored_bytes),
        (9, _I64, chunk.offset),
        (12, _STRUCT, chunk.statistics),
    )
    return _struct((2, _I64, chunk.offset), (3, _STRUCT, about))


# -- Thrift ------------------------------------------------------------------------------------------------------------

_TRUE, _I32, _I64, _BINARY, _LIST, _STRUCT = 1, 5, 6, 8, 9, 12


def _struct(*fields: tuple[int, int, Any]) -> bytes:
    """A struct of (number, type, value) in the order of the numbers; None is left out. A nested struct is its bytes."""
    out = bytearray()
    last = 0
    for number, kind, value in fields:
        if value is not None:
            out.append((number - last) << 4 | kind)
            out += _value(kind, value)
            last = number
    out.append(0)
    return bytes(out)


def _value(kind: int, value: Any) -> bytes:
    if kind in (_I32, _I64):
        return _varint(value << 1 if value >= 0 else (-value << 1) - 1)
    if kind == _BINARY:
        return _varint(len(value)) + bytes(value)
    if kind == _LIST:
        inner, items = value
        head = bytes((len(items) << 4 | inner,)) if len(items) < 15 else bytes((0xF0 | inner,)) + _varint(len(items))
        return head + b''.join(_value(inner, item) for item in items)
    return bytes(value) if kind == _STRUCT else b''


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


_MICROS_UTC: Final = _struct((8, _STRUCT, _struct((1, _TRUE, True), (2, _STRUCT, _struct((2, _STRUCT, _struct()))))))
"""LogicalType: a timestamp that is adjusted to UTC, in microseconds."""


def _texts(values: Sequence[str]) -> bytes:
    encoded = [value.encode(errors='replace') for value in values]
    return b''.join(part for text in encoded for part in (struct.pack('<I', len(text)), text))


def _numbers(code: str) -> Callable[[Sequence[Any]], bytes]:
    return lambda values: struct.pack(f'<{len(values)}{code}', *values)


_KINDS: Final = {
    STRING: _Kind(6, 0, _struct((1, _STRUCT, _struct())), _texts),
    INT32: _Kind(1, None, None, _numbers('i')),
    INT64: _Kind(2, None, None, _numbers('q')),
    DOUBLE: _Kind(5, None, None, _numbers('d')),
    TIME: _Kind(2, 10, _MICROS_UTC, _numbers('q')),
}
