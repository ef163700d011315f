"""Parts of the catalogue as no robot of ours writes them: what is none, what lies about its size, what speaks of others."""

from __future__ import annotations

import base64
import io
import json
import random
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.parquet import encryption

from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import schema
from shadowhound_data_logger.lake import reading
from shadowhound_data_logger.lake.live_files import SOURCES, compacted_key

DATE: Final = '2026-10-28'
MAGIC: Final = b'PAR1'
ZSTD: Final = b'\x28\xb5\x2f\xfd'
LONG: Final = 'thor/camera/' + 42_000 * 'a'


def put(settings: StoreSettings, body: bytes, name: str = 'thor_bad', robot: str = 'thor',
        of: schema.TableSchema = schema.OBJECTS) -> str:  # fmt: skip
    """As a robot that may write below its own prefix puts it; its key."""
    key = f'{of.prefix(robot)}date={DATE}/{name}{schema.SUFFIX if body.startswith(ZSTD) else ".parquet"}'
    path = settings.directory / schema.BUCKET / key
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(body)
    return key


def arrow(rows: Sequence[schema.Row], about: Mapping[str, str] | None = None, **columns: Any) -> bytes:
    """These rows by pyarrow, with some columns replaced."""
    table = pa.table({name: columns.get(name, [row[name] for row in rows]) for name in schema.COLUMNS},
                     schema=None if columns else reading.arrow_schema())  # fmt: skip
    return written(table, about)


def written(table: pa.Table, about: Mapping[str, str] | None = None, *, group: int | None = None, **how: Any) -> bytes:
    """A file of groups of so many rows."""
    body = io.BytesIO()
    with pq.ParquetWriter(body, table.schema, **{'compression': 'zstd', 'store_schema': False, **how}) as file:
        file.write_table(table, row_group_size=group)
        if about:
            file.add_key_value_metadata(dict(about))
    return body.getvalue()


def dictionary_bomb(row: schema.Row, count: int = 1_000_000) -> bytes:
    """Some kilobytes that are so many rows of one key of 42 KB: 42 GB of a million."""
    whole = pa.Table.from_pylist([row], schema=reading.arrow_schema())
    columns = [
        _repeated(whole[name][0], LONG if name == 'key' else None, count) for name in schema.COLUMNS if row[name] is not None
    ]
    table = pa.table(columns, names=[name for name in schema.COLUMNS if row[name] is not None])
    return written(table)


def _repeated(value: pa.Scalar, text: str | None, count: int) -> pa.Array:
    values = pa.array([text]) if text else pa.array([value.as_py()], value.type)
    return pa.DictionaryArray.from_arrays(pa.array(memoryview(bytes(4 * count)).cast('i'), pa.int32()), values)


def zeros_bomb(rows: Sequence[schema.Row], size: int = 1 << 26) -> bytes:
    """A page of a text of so many zeros in each row, as zstd makes some kilobytes of it."""
    table = pa.Table.from_pylist(list(rows), schema=reading.arrow_schema())
    place = table.column_names.index('topic')
    return written(table.set_column(place, 'topic', pa.array(['\0' * size] * len(table))), use_dictionary=False)


def source_list_bomb(rows: Sequence[schema.Row]) -> tuple[str, bytes]:
    """The name and content of a compacted part whose list of sources is a gigabyte of JSON in a megabyte."""
    piece, pieces = b'a' * (1 << 20), 1024
    parts_ = (b'["', piece, b'"]')
    packers = [zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS) for _ in parts_]
    first, middle, last = (packer.compress(part) + packer.flush(zlib.Z_FULL_FLUSH if part != b'"]' else zlib.Z_FINISH)
                           for packer, part in zip(packers, parts_, strict=True))  # fmt: skip
    check = zlib.adler32(b'["')
    for _ in range(pieces):
        check = zlib.adler32(piece, check)
    squeezed = b'\x78\xda' + first + middle * pieces + last + struct.pack('>I', zlib.adler32(b'"]', check))
    return compacted(rows, base64.b64encode(squeezed).decode())


def compacted(rows: Sequence[schema.Row], sources: str | Sequence[str]) -> tuple[str, bytes]:
    """A compacted part that says so of its sources."""
    said = sources if isinstance(sources, str) else base64.b64encode(zlib.compress(json.dumps(list(sources)).encode())).decode()
    key = compacted_key('thor', DATE, [said], is_backfilled=False)
    table = pa.Table.from_pylist(list(rows), schema=reading.arrow_schema())
    return Path(key).stem, written(table, {SOURCES: said})


def unfit_histogram(rows: Sequence[schema.Row]) -> bytes:
    """A key that must be there, with the histogram of one that may be missing."""
    body = written(pa.Table.from_pylist(list(rows)).select(['key']))
    optional = b'\x15\x0c\x25\x02\x18\x03key'  # SchemaElement: type, repetition, name
    assert body.count(optional) == 1
    return body.replace(optional, optional.replace(b'\x25\x02', b'\x25\x00'))


def listed_sizes(rows: Sequence[schema.Row]) -> bytes:
    """An empty list of structs where the size statistics of a column belong; pyarrow passes over it."""
    body = written(pa.Table.from_pylist(list(rows)).select(['key']))
    begin, end = footer_of(body)
    sizes = re.compile(rb'\x3c\x16[\x80-\xff]*[\x00-\x7f]\x19\x06\x19\x26\x00.\x00', re.DOTALL)
    footer, count = sizes.subn(b'\x39\x0c', body[begin:end])
    assert count == 1
    return body[:begin] + footer + struct.pack('<I', len(footer)) + MAGIC


def encrypted(rows: Sequence[schema.Row]) -> bytes:
    """A column that only its writer can read, and a footer that everybody can."""

    class Kms(encryption.KmsClient):  # type: ignore[misc]
        def wrap_key(self, key_bytes: bytes, master_key_identifier: str) -> bytes:
            return base64.b64encode(key_bytes)

        def unwrap_key(self, wrapped_key: bytes, master_key_identifier: str) -> bytes:
            return base64.b64decode(wrapped_key)

    how = encryption.EncryptionConfiguration(footer_key='footer', column_keys={'columns': ['topic']}, plaintext_footer=True)
    keys = encryption.CryptoFactory(lambda _: Kms()).file_encryption_properties(encryption.KmsConnectionConfig(), how)
    return written(pa.Table.from_pylist(list(rows), schema=reading.arrow_schema()), encryption_properties=keys)


def footer_of(body: bytes) -> tuple[int, int]:
    """Where it begins and ends."""
    size = struct.unpack('<I', body[-8:-4])[0]
    return len(body) - 8 - size, len(body) - 8


def mutated(body: bytes, rng: random.Random) -> bytes:
    """With some bytes changed, removed or added, mostly in the footer and in the headers of pages."""
    found = bytearray(body)
    begin, end = footer_of(body)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        low, high = rng.choice(((begin, end), (begin, end), (4, begin), (0, len(body))))
        place = rng.randrange(low, max(low + 1, min(high, len(found))))
        change = rng.randrange(5)
        if change == 0:
            found[place : place + 1] = bytes((rng.randrange(256),))
        elif change == 1:
            found[place : place + 1] = bytes((found[min(place, len(found) - 1)] ^ (1 << rng.randrange(8)),))
        elif change == 2:
            found[place : place + 5] = rng.choice((b'\xff\xff\xff\xff\x0f', b'\xfe\xff\xff\xff\x0f', b'\x00' * 5, b'\x80' * 5))
        elif change == 3:
            del found[place : place + rng.randrange(1, 9)]
        else:
            found[place:place] = rng.randbytes(rng.randrange(1, 9))
    if rng.random() < 0.8 and len(found) > 12:  # with a footer that is found
        found[-4:] = MAGIC
        if len(found) != len(body):
            found[-8:-4] = struct.pack('<I', max(0, end - begin + len(found) - len(body)))
    return bytes(found)
