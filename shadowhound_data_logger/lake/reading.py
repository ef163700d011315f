"""Parts of the catalogue and of the gap journal as tables. Nothing is unpacked before it is known how much it is.

A part of ours is flat: columns of known types, in pages that are plain or by a dictionary, gzip or zstd. Its footer says where
the pages are, each page's header how large it is; both are read first, and what is something else, or far larger than its file,
is not a part. Only rows of the robot in whose folder it lies count. What is left out is in the ``Findings``; the rest counts.

The format: https://github.com/apache/parquet-format (Encodings.md, src/main/thrift/parquet.thrift). The headers of pages are in
Thrift's compact protocol: https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md
"""

from __future__ import annotations

import io
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.untrusted import check_size, is_path
from shadowhound_data_logger.formats.rows.gaps import GAPS, STATEMENT_KINDS
from shadowhound_data_logger.formats.rows.labels import LABEL_KINDS, LABELS
from shadowhound_data_logger.formats.rows.parts import MAX_FILE_BYTES, read_rows
from shadowhound_data_logger.formats.rows.schema import (
    DOUBLE,
    FORGOTTEN,
    INT32,
    INT64,
    KEPT,
    OBJECTS,
    STRING,
    SUFFIX,
    TIME,
    TableSchema,
)
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.formats.statistics import NUMBERS
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.select import Wanted

SMALL_BYTES: Final = 256 << 10
"""Up to here a file is read whole: of one-minute parts there are thousands, and a compacted day of a robot is larger."""
PARTS_AHEAD: Final = 4 * THREADS
"""How many small files are requested before their turn."""
BATCH_BYTES: Final = 16 << 20
"""Of rows that are handed on together, and of a large file that is read at a time."""
MOST_BYTES: Final = 256 << 20
"""Of a part: a day of a robot that stores everything, compacted, has 60 MB."""
FOOTER_BYTES: Final = 1 << 18
"""Of a large file, read first."""
MOST_FOOTER_BYTES: Final = 4 << 20
MOST_LIST: Final = 1024
"""Entries of any list in a footer, row groups or columns: 4 million compacted rows."""
SLACK_BYTES: Final = 64 << 10
MOST_RATIO: Final = 100
"""What a part unpacks to beyond the slack, of its size. Ours reach 30, where a number in the key is all that differs."""
_MAGIC: Final = b'PAR1'
_END_BYTES: Final = 8
"""After a footer: its length and the magic."""
_CODECS: Final = {'GZIP', 'ZSTD', 'UNCOMPRESSED'}
_ENCODINGS: Final = {0, 2, 8}
"""PLAIN, PLAIN_DICTIONARY, RLE_DICTIONARY. Of the others some make long values of few bytes."""
_DATA_PAGE, _DICTIONARY_PAGE = 0, 2
_PAGE: Final = re.compile(
    rb'\x15\x00\x15([\x80-\xff]{0,4}[\x00-\x7f])\x15([\x80-\xff]{0,4}[\x00-\x7f])'
    rb'\x2c\x15[\x80-\xff]{0,4}[\x00-\x7f]\x15\x00\x15\x06\x15\x06\x00\x00'
)  # fmt: skip
"""The header of a plain data page as ``parquet.py`` writes it, its sizes in groups."""
_OWNER: Final = {
    OBJECTS.folder: 'key',
    KEPT.folder: 'key',
    FORGOTTEN.folder: 'key',
    STATISTICS.folder: 'key',
    GAPS.folder: 'robot',
    LABELS.folder: 'robot',
}
"""The column that says whose a row is, by the table's folder."""
_COUNTS: Final = ('bytes', 'revision', 'merged', 'received', 'skipped')
_SPANS: Final = (('from_ns', 'to_ns'), ('since_ns', 'until_ns'))
_TIMES: Final = ('t_start', 't_end', 't_from', 't_to', 'made', 'forgotten')
_YEARS_US: Final = (-62_135_596_800_000_000, 253_402_300_799_999_999)
"""1 to 9999, those of a date."""
UNREADABLE: Final = (pa.ArrowException, OSError, MemoryError, ValueError, LookupError, TypeError, OverflowError)
"""What comes of a file that is not a part."""


class Only(NamedTuple):
    """The rows that are wanted, by a few columns: the others are read only of row groups with such rows."""

    columns: tuple[str, ...]
    holds: Callable[[pa.Table], NDArray[np.bool_]]
    """Of a table of those columns. What it is shown has not been checked yet."""


def tables(source: Bucket, entries: Sequence[ObjectInfo], columns: Sequence[str], findings: Findings,
           wanted: Wanted | None = None, of: TableSchema = OBJECTS, only: Only | None = None) -> Iterator[pa.Table]:  # fmt: skip
    """The rows of these parts, in their order, some megabytes at a time; a column that a part does not have yet is null.

    Row groups that cannot hold what is ``wanted`` are left out, and so are rows that ``only`` does not name. Raises StoreError.
    """
    schema = narrow(_needed((*columns, *only.columns) if only else columns, of), of)
    rows = _Rows(schema, findings, of=of)
    for entry, body in _bodies(source, entries):
        if rows.robot != of.robot_of(entry.key) or rows.nbytes > BATCH_BYTES:
            yield from rows.taken(columns)
            rows = _Rows(schema, findings, of.robot_of(entry.key), of)
        for table, size in _contents(source, entry, body, schema, findings, of, _Choice(columns, wanted, only)):
            rows.add(entry.key, table, size)
            if rows.nbytes > BATCH_BYTES:
                yield from rows.taken(columns)
                rows = _Rows(schema, findings, rows.robot, of)
    yield from rows.taken(columns)


def whole(source: Bucket, entries: Sequence[ObjectInfo], findings: Findings,
          of: TableSchema = OBJECTS) -> Iterator[tuple[ObjectInfo, pa.Table]]:  # fmt: skip
    """All columns of each of these parts of which nothing is left out. Raises StoreError."""
    schema = narrow(arrow_schema(of).names, of)
    for entry, body in _bodies(source, entries):
        found = Findings(lambda _: None)
        rows = _Rows(schema, found, of.robot_of(entry.key), of)
        for table, size in _contents(source, entry, body, schema, found, of, _Choice(schema.names)):
            rows.add(entry.key, table, size)
        made = list(rows.taken(schema.names))
        if not len(found):
            yield entry, pa.concat_tables([schema.empty_table(), *made])
        for one in found:
            findings.add(one.key, one.why, one.rows)


@lru_cache(maxsize=8)
def arrow_schema(of: TableSchema = OBJECTS) -> pa.Schema:
    """The columns of a table as pyarrow has them."""
    kinds = {STRING: pa.string(), INT32: pa.int32(), INT64: pa.int64(), DOUBLE: pa.float64(), TIME: pa.timestamp('us', tz='UTC')}
    return pa.schema([pa.field(name, kinds[kind], nullable=name not in of.required) for name, kind in of.columns.items()])


def narrow(columns: Sequence[str], of: TableSchema = OBJECTS) -> pa.Schema:
    """These columns."""
    schema = arrow_schema(of)
    return pa.schema([schema.field(name) for name in columns])


def footer(source: Bucket, entry: ObjectInfo) -> Mapping[bytes, bytes]:
    """What a part says of itself beside its rows. Raises ValueError and its kind for a file that is not a part, StoreError."""
    if not is_path(entry.key):
        raise ValueError('its name is not a path')
    return _opened(_tail(source, entry)).metadata.metadata or {}


def _needed(columns: Sequence[str], of: TableSchema) -> list[str]:
    """In the order of the schema; what tells whose a row is, is always looked at."""
    return [name for name in arrow_schema(of).names if name in columns or name == _OWNER[of.folder]]


def _bodies(source: Bucket, entries: Sequence[ObjectInfo]) -> Iterator[tuple[ObjectInfo, bytes | ObjectRefused | None]]:
    """Each with its content where that is small, or why it cannot be had."""

    def body(entry: ObjectInfo) -> bytes | ObjectRefused | None:
        try:
            return source.get(entry.key, SMALL_BYTES) if entry.size <= SMALL_BYTES and is_path(entry.key) else None
        except ObjectRefused as error:
            if error.data.get('reason') == 'missing':
                raise
            return error

    with ThreadPoolExecutor(THREADS, 'lake-read') as pool:  # they wait for the server; several that parse hinder each other
        coming = deque[tuple[ObjectInfo, Future[bytes | ObjectRefused | None]]]()
        for entry in entries:
            coming.append((entry, pool.submit(body, entry)))
            if len(coming) == PARTS_AHEAD:
                first, found = coming.popleft()
                yield first, found.result()
        for entry, found in coming:
            yield entry, found.result()


class _Choice(NamedTuple):
    """What of a part is asked for: beyond these columns only what tells whose a row is."""

    columns: Sequence[str]
    wanted: Wanted | None = None
    only: Only | None = None


def _contents(source: Bucket, entry: ObjectInfo, body: bytes | ObjectRefused | None, schema: pa.Schema, findings: Findings,
              of: TableSchema, choice: _Choice) -> Iterator[tuple[pa.Table, int]]:  # fmt: skip
    """The rows of one part, as far as it is one, and how many bytes they take."""
    if entry.key.endswith(SUFFIX):
        yield from _row_file(source, entry, body, schema, findings, of, choice)
        return
    done, part = 0, None
    try:
        if isinstance(body, ObjectRefused) or not is_path(entry.key):
            raise ValueError('its name is not a path, or it is larger than its listing says')
        part = _Part(source, entry, body, of)
        for table, size in part.tables(schema, choice):
            yield table, size
            done += len(table)
    except UNREADABLE as error:
        findings.add(entry.key, _why(error), part.count - done if part is not None and done else None)


def _row_file(source: Bucket, entry: ObjectInfo, body: bytes | ObjectRefused | None, schema: pa.Schema, findings: Findings,
              of: TableSchema, choice: _Choice) -> Iterator[tuple[pa.Table, int]]:  # fmt: skip
    """The rows of a row file that are of this table."""
    try:
        if not is_path(entry.key):
            raise ValueError('its name is not a path')
        check_size(entry.size, MAX_FILE_BYTES)
        found = read_rows(source.get(entry.key, MAX_FILE_BYTES) if body is None else _content(body), of.robot_of(entry.key))
    except UNREADABLE as error:
        findings.add(entry.key, _why(error))
        return
    if found.findings:
        count = sum(each.lines for each in found.rejected)
        findings.add(entry.key, found.findings, None if found.ended else count)
    others = sum(len(rows) for folder, rows in found.rows.items() if folder != of.folder)
    if others:
        findings.add(entry.key, f'{others:,} of its rows belong to another table', others)
    rows = found.rows.get(of.folder, [])
    if rows:
        table = pa.Table.from_pylist(rows, schema=schema)
        if choice.only is not None:
            table = table.filter(pa.array(choice.only.holds(table.select(choice.only.columns))))
        yield table, table.nbytes


def _content(body: bytes | ObjectRefused) -> bytes:
    if isinstance(body, ObjectRefused):
        raise ValueError('it is larger than its listing says')  # noqa: TRY004 - of the file, not of a type
    return body


def _why(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return 'there is not enough memory for it'
    return f'it is not part of a catalogue ({" ".join(str(error).split())[:200] or type(error).__name__})'


class _Rows:
    """Rows of parts of one robot, until there are enough of them to be looked at and handed on."""

    def __init__(self, schema: pa.Schema, findings: Findings, robot: str = '', of: TableSchema = OBJECTS) -> None:
        self.robot = robot
        self._of = of
        self.nbytes = 0
        self._schema = schema
        self._findings = findings
        self._parts: list[tuple[str, int]] = []
        self._tables: list[pa.Table] = []

    def add(self, key: str, table: pa.Table, size: int) -> None:
        self._parts.append((key, len(table)))
        self._tables.append(table if table.schema.equals(self._schema) else _fit(table, self._schema))
        self.nbytes += size

    def taken(self, columns: Sequence[str]) -> Iterator[pa.Table]:
        """The rows that count; nothing where there are none at all."""
        if not self._parts:
            return
        table = self._readable(pa.concat_tables(self._tables).combine_chunks())
        table = self._only(table, _is_own(table, self.robot, self._of), 'are not of its robot')
        yield self._only(table, _is_sane(table, self._of), 'make no sense').select(columns)

    def _readable(self, table: pa.Table) -> pa.Table:
        """Without parts whose texts are none: what is not UTF-8 would be an error wherever it is read."""
        try:
            table.validate(full=True)
        except pa.ArrowInvalid:
            good, start = [], 0
            for key, count in self._parts:
                piece = table.slice(start, count)
                start += count
                try:
                    piece.validate(full=True)
                    good.append((key, piece))
                except pa.ArrowInvalid as error:
                    self._findings.add(key, _why(error))
            self._parts = [(key, len(piece)) for key, piece in good]
            return pa.concat_tables([self._schema.empty_table(), *(piece for _, piece in good)])
        return table

    def _only(self, table: pa.Table, counts: pa.ChunkedArray, what: str) -> pa.Table:
        """The rows that count. The others are told, part by part."""
        if pc.all(counts, min_count=0).as_py():
            return table
        kept, start = [], 0
        for key, count in self._parts:
            left = count - (pc.sum(counts.slice(start, count)).as_py() or 0)
            if left:
                self._findings.add(key, f'{left:,} of its {count:,} rows {what}', left)
            kept.append((key, count - left))
            start += count
        self._parts = kept
        return table.filter(counts)


def _fit(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """With nulls for what it does not have."""
    held = table.column_names
    return pa.table(
        [table[each.name] if each.name in held else pa.nulls(len(table), each.type) for each in schema], schema=schema
    )


def _is_own(table: pa.Table, robot: str, of: TableSchema) -> pa.ChunkedArray:
    """Whether a row is one of the robot whose folder it lies in."""
    if _OWNER[of.folder] == 'robot':
        return pc.fill_null(pc.equal(table['robot'], robot), fill_value=False)
    own = pc.fill_null(pc.starts_with(table['key'], f'{robot}/'), fill_value=False)
    if 'robot' in table.column_names:
        own = pc.and_(own, pc.fill_null(pc.equal(table['robot'], robot), fill_value=True))
    return own


def _is_sane(table: pa.Table, of: TableSchema) -> pa.ChunkedArray:
    """Whether what must be there is, and dates are dates; of the columns that were read.

    Numbers of statistics are judged by those who ask for them: an object without such a row would seem to be without the field.
    """
    sane = pc.is_valid(table[_OWNER[of.folder]])
    for name in (name for name in of.required if name in table.column_names and not (of is STATISTICS and name in NUMBERS)):
        sane = pc.and_(sane, pc.is_valid(table[name]))
    if 'bucket' in table.column_names:
        named = [each for each in pc.unique(table['bucket']).to_pylist() if each is None or is_name(each)]
        sane = pc.and_(sane, pc.is_in(table['bucket'], value_set=pa.array(named, pa.string())))
    if 'what' in table.column_names:
        sane = pc.and_(sane, pc.is_in(table['what'], value_set=pa.array(LABEL_KINDS if of is LABELS else STATEMENT_KINDS)))
    for name in (name for name in _COUNTS if name in table.column_names):
        sane = pc.and_(sane, pc.fill_null(pc.greater_equal(table[name], 0), fill_value=name not in of.required))
    for first, last in _SPANS:
        if {first, last}.issubset(table.column_names):
            sane = pc.and_(sane, pc.fill_null(pc.less_equal(table[first], table[last]), fill_value=True))
    for name in (name for name in _TIMES if name in table.column_names):
        micros = table[name].cast(pa.int64())
        inside = pc.and_(pc.greater_equal(micros, _YEARS_US[0]), pc.less_equal(micros, _YEARS_US[1]))
        sane = pc.and_(sane, pc.fill_null(inside, fill_value=True))
    return sane


# -- one file ------------------------------------------------------------------------------------------------------------------


class _Chunk(NamedTuple):
    """A column of a row group, and where its pages lie."""

    name: str
    begin: int
    end: int
    values: int


class _Part:
    """A file that should be a part. What it does is on the caller's thread; anything of ``UNREADABLE`` says that it is none."""

    def __init__(self, source: Bucket, entry: ObjectInfo, body: bytes | None, of: TableSchema) -> None:
        """``body`` is all of it where it is small."""
        check_size(entry.size, MOST_BYTES)
        self._source, self._entry, self._body, self._of = source, entry, body, of
        self._size = entry.size if body is None else len(body)
        self._file = _opened(_tail(source, entry) if body is None else body)
        self._about = self._file.metadata
        self._left = SLACK_BYTES + MOST_RATIO * self._size
        """Bytes that it may still unpack to."""
        self.count: int = self._about.num_rows

    def tables(self, schema: pa.Schema, choice: _Choice) -> Iterator[tuple[pa.Table, int]]:
        """The columns of the schema that it has, and how many bytes they take."""
        places = _places(self._file, schema, self._of)
        groups = range(self._about.num_row_groups)
        if choice.wanted is not None and (bounds := _bounds(choice.wanted)):
            groups = [number for number in groups if _may_hold(self._about.row_group(number), places, bounds)]  # type: ignore[assignment]
        some: list[int] = []
        size = 0
        for number in groups:
            some.append(number)
            size += sum(chunk.end - chunk.begin for chunk in self._chunks(number, places))
            if size > BATCH_BYTES:
                yield from self._chosen(some, places, choice)
                some, size = [], 0
        if some:
            yield from self._chosen(some, places, choice)

    def _chosen(self, groups: Sequence[int], places: Mapping[str, int], choice: _Choice) -> Iterator[tuple[pa.Table, int]]:
        before = self._left
        if choice.only is None:
            table = self._columns(groups, places, choice)
            yield table, before - self._left
            return
        first = {name: place for name, place in places.items() if name in choice.only.columns}
        table = self._columns(groups, first, choice)
        kept = choice.only.holds(_fit(table, narrow(choice.only.columns, self._of)))
        ends = np.cumsum([self._about.row_group(number).num_rows for number in groups])
        spans = list(zip(groups, [0, *ends[:-1]], ends, strict=True))
        held = [(number, begin, end) for number, begin, end in spans if kept[begin:end].any()]
        if not held:
            return
        table = table.filter(pa.array(kept))
        if rest := {name: place for name, place in places.items() if name not in first}:
            more = self._columns([number for number, _, _ in held], rest, choice)
            more = more.filter(pa.array(np.concatenate([kept[begin:end] for _, begin, end in held])))
            table = pa.table({name: (table if name in first else more)[name] for name in places})
        yield table, before - self._left

    def _columns(self, groups: Sequence[int], places: Mapping[str, int], choice: _Choice) -> pa.Table:
        """These columns; of a large file, texts are not read where the statistics of a row group say enough of them."""
        texts = [name for name in places if self._body is None and self._of.columns[name] == STRING]
        told = {name: [self._told(number, name, places[name], choice) for number in groups] for name in texts}
        read = [name for name in places if all(text is None for text in told.get(name, ()))]
        if len(read) == len(places):
            return self._read(groups, places)
        found = dict(zip(read, self._read(groups, {name: places[name] for name in read}).columns, strict=True)) if read else {}
        for name in (name for name in places if name not in found):
            unsaid = [number for number, text in zip(groups, told[name], strict=True) if text is None]
            rest = self._read(unsaid, {name: places[name]})[name] if unsaid else None
            pieces, done = [], 0
            for number, text in zip(groups, told[name], strict=True):
                rows = self._about.row_group(number).num_rows
                if text is not None:
                    self._spend((8 + len(text)) * rows)
                    pieces.append(pa.repeat(text, rows))
                elif rest is not None:
                    pieces += rest.slice(done, rows).chunks
                    done += rows
            found[name] = pa.chunked_array(pieces, pa.string())
        return pa.table({name: found[name] for name in places})

    def _told(self, number: int, name: str, place: int, choice: _Choice) -> str | None:
        """The text that all rows of a row group have; where nobody asked for the key, what all keys begin with."""
        told = self._about.row_group(number).column(place).statistics
        if told is None or not told.has_min_max or not told.has_null_count or told.null_count:
            return None
        low, high = told.min, told.max
        if not (isinstance(low, str) and isinstance(high, str)):
            return None
        if low == high:
            return low
        own = f'{self._of.robot_of(self._entry.key)}/'
        is_enough = name == 'key' and name not in choice.columns and low.startswith(own) and high.startswith(own)
        return own if is_enough else None

    def _chunks(self, number: int, places: Mapping[str, int]) -> list[_Chunk]:
        """Raises ValueError for one that does not lie in the file or has not a value a row."""
        group, found = self._about.row_group(number), []
        for name, place in places.items():
            about = group.column(place)
            begin = about.data_page_offset
            if about.has_dictionary_page and 0 < about.dictionary_page_offset < begin:
                begin = about.dictionary_page_offset
            chunk = _Chunk(name, begin, begin + about.total_compressed_size, about.num_values)
            if not len(_MAGIC) <= chunk.begin <= chunk.end <= self._size or chunk.values != group.num_rows:
                raise ValueError(f'its column {name} lies nowhere')
            if about.compression not in _CODECS:
                raise ValueError(f'it is compressed with {about.compression}')
            found.append(chunk)
        return found

    def _read(self, groups: Sequence[int], places: Mapping[str, int]) -> pa.Table:
        chunks = [chunk for number in groups for chunk in self._chunks(number, places)]
        columns = list(places)
        values = sum(chunk.values for chunk in chunks)
        self._spend(values * 8)
        if self._body is not None:
            held = None
            walked = [(chunk.name, _walk(self._body, chunk.begin, chunk.end)) for chunk in chunks]
        else:
            spans = [(chunk.begin, chunk.end) for chunk in chunks]
            held = dict(zip((begin for begin, _ in spans), self._source.ranges(self._entry.key, spans), strict=True))
            walked = [(chunk.name, _walk(held[chunk.begin], 0, chunk.end - chunk.begin)) for chunk in chunks]
        self._spend(sum(size for _, (size, _) in walked))
        packed = {name for name, (_, has_dictionary) in walked if has_dictionary}
        table = self._file_of(held, packed).read_row_groups(groups, columns, use_threads=held is not None)
        return self._plain(table, packed, values // len(columns))

    def _file_of(self, held: Mapping[int, bytes] | None, packed: set[str]) -> pq.ParquetFile:
        """Texts that stand in dictionaries stay there, until it is known how long they would be altogether."""
        if held is None and not packed:
            return self._file
        place = pa.BufferReader(self._body) if held is None else pa.PythonFile(_Held(held, self._size), 'r')
        return pq.ParquetFile(place, metadata=self._about, read_dictionary=sorted(packed), pre_buffer=False)

    def _plain(self, table: pa.Table, packed: set[str], rows: int) -> pa.Table:
        """Raises ValueError for columns of unlike lengths, and for texts of dictionaries that would be too long."""
        if any(len(column) != rows for column in table.columns):
            raise ValueError(f'its columns have not {rows:,} values each')
        for place, name in enumerate(table.column_names):
            column = table.column(place)
            if name in packed and pa.types.is_dictionary(column.type):
                column.validate(full=True)
                for chunk in column.chunks:
                    lengths = pc.binary_length(chunk.dictionary).take(chunk.indices)
                    self._spend(pc.sum(lengths.cast(pa.int64())).as_py() or 0)
                table = table.set_column(place, table.schema.field(place).with_type(pa.string()), column.cast(pa.string()))
        return table

    def _spend(self, size: int) -> None:
        self._left -= size
        if size < 0 or self._left < 0:
            raise ValueError(f'it unpacks to more than {MOST_RATIO} times its size')


class _Held(io.RawIOBase):
    """A file of which only some spans are here, each asked for as it is."""

    def __init__(self, spans: Mapping[int, bytes], size: int) -> None:
        self._spans = spans
        self._size = size
        self._at = 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence] + offset
        return self._at

    def read(self, size: int = -1) -> bytes:
        found = self._spans.get(self._at)
        if found is None or size > len(found):
            raise OSError(f'{size} bytes at {self._at} belong to none of its columns')
        self._at += size
        return found[:size]


def _tail(source: Bucket, entry: ObjectInfo) -> bytes:
    """The end of a file, its footer in it."""
    (tail,) = source.ranges(entry.key, [(max(0, entry.size - FOOTER_BYTES), entry.size)])
    size = _footer_size(tail, entry.size)
    return tail if size <= len(tail) else source.ranges(entry.key, [(entry.size - size, entry.size)])[0]


def _footer_size(tail: bytes, size: int) -> int:
    """With what follows it."""
    found = int.from_bytes(tail[-_END_BYTES:-4], 'little') + _END_BYTES
    if tail[-4:] != _MAGIC or found + len(_MAGIC) > size:
        raise ValueError('it has no footer of a Parquet file')
    check_size(found, MOST_FOOTER_BYTES)
    return found


def _opened(tail: bytes) -> pq.ParquetFile:
    _footer_size(tail, len(tail) + len(_MAGIC))
    limits = {'thrift_string_size_limit': MOST_FOOTER_BYTES, 'thrift_container_size_limit': MOST_LIST}
    file = pq.ParquetFile(pa.BufferReader(tail), pre_buffer=False, **limits)
    _check_footer(tail, file.schema)
    return file


def _places(file: pq.ParquetFile, schema: pa.Schema, of: TableSchema) -> dict[str, int]:
    """The columns of a schema that a file has, and their numbers. Raises ValueError where one is not as ours are."""
    found, ours = file.schema_arrow, arrow_schema(of)
    if found.equals(ours):
        return {name: ours.get_field_index(name) for name in schema.names}
    names = found.names
    for field in (ours.field(name) for name in schema.names if name in names or name in of.required):
        place = names.index(field.name) if names.count(field.name) == 1 else -1
        if place < 0 or found.field(place).type != field.type or file.schema.column(place).path != field.name:
            raise ValueError(f'it has no column {field.name} of type {field.type}')
    return {name: names.index(name) for name in schema.names if name in names}


_Bound = tuple[str, Any, Any]
"""A column, and the least and the greatest value that is wanted."""


def _bounds(wanted: Wanted) -> list[_Bound]:
    found: list[_Bound] = []
    if wanted.sensor is not None:
        found.append(('sensor', wanted.sensor, wanted.sensor))
    if wanted.since_ns is not None or wanted.until_ns is not None:
        low = -(1 << 63) if wanted.since_ns is None else wanted.since_ns
        found.append(('t_start_ns', low, (1 << 63 if wanted.until_ns is None else wanted.until_ns) - 1))
    if wanted.near is not None:
        x, y, radius = wanted.near
        found += [('x', x - radius, x + radius), ('y', y - radius, y + radius)]
    return [*found, *wanted.bounds]


def _may_hold(group: Any, places: Mapping[str, int], bounds: Sequence[_Bound]) -> bool:
    """By the statistics of a row group; who lies in them hides his own rows alone."""
    for name, low, high in bounds:
        told = group.column(places[name]).statistics if name in places else None
        if told is not None and told.has_min_max and (told.max < low or told.min > high):
            return False
    return True


# -- the footer ----------------------------------------------------------------------------------------------------------------

_Fields = Mapping[int, Any]
_COLUMN: Final[_Fields] = {3: {1: None, 16: {1: None, 2: None, 3: None}}, 8: None, 9: None}
"""Of a ColumnChunk: its metadata (type, size statistics), crypto metadata, encrypted metadata."""
_FOOTER: Final[_Fields] = {4: [{1: [_COLUMN]}]}
"""Of the FileMetaData its row groups, and their columns; what is a list stands in one."""
_NUMBER: Final = rb'[\x80-\xff]{0,9}[\x00-\x7f]'
_BYTES: Final = b'(?:' + b'|'.join(re.escape(bytes([size])) + b'.{%d}' % size for size in range(128)) + b')'
_USUAL: Final = re.compile(
    b''.join((
        rb'\x26N\x1c\x15([\x00-\x7f])\x19(?:\x15N|\x25NN|\x35NNN|\x45NNNN)\x19\x18B\x15N\x16N\x16N\x16N\x26N',
        rb'(?:\x26N\x1c|\x3c)(?:[\x18\x28\x38\x48\x58]B|[\x16\x26\x36\x46]N|[\x11\x12\x21\x22]){0,64}\x00',
        rb'(?:\x19(?:\x1c(?:\x15N){3}\x00|\x2c(?:(?:\x15N){3}\x00){2}|\x3c(?:(?:\x15N){3}\x00){3}|\x4c(?:(?:\x15N){3}\x00){4})',
        rb'(?:\x3c(?:(\x16)N\x19|\x29)\x06\x19(?=([\x06\x16\x26]))(?:\x06|\x16N|\x26NN)\x00)?)?\x00\x00',
    )).replace(b'N', _NUMBER).replace(b'B', _BYTES), re.DOTALL,
)  # fmt: skip
"""A ColumnChunk as pyarrow or a robot (``parquet.py``) writes it: its type, whether its size statistics have bytes, and the head
of their list of levels."""
_FIELDS: Final = 64
"""At most, in a struct that a pattern matches: matching takes memory for each, and a hostile struct has millions."""


def _heads(kind: int) -> bytes:
    """The first byte of a field of this type, whose number is up to 15 more than that of the field before."""
    return b'[' + re.escape(bytes(step << 4 | kind for step in range(1, 16))) + b']'


def _flat(inside: bytes) -> bytes:
    """A struct of whole numbers, flags, short texts and what is ``inside``."""
    numbers = (_heads(kind) + _NUMBER for kind in (4, 5, 6))
    return b'(?:%b){0,%d}\\x00' % (b'|'.join((*numbers, _heads(8) + _BYTES, _heads(1), _heads(2), inside)), _FIELDS)


_STRUCT: Final = re.compile(_flat(_heads(12) + _flat(_heads(12) + _flat(_heads(12) + _flat(_heads(12) + rb'\x00')))), re.DOTALL)
"""A struct with structs in it, nested as deeply as the type of a timestamp column."""
_BYTE_ARRAY: Final = 6
_FIXED: Final = {1: 1, 2: 1, 3: 1, 7: 8}
"""Bytes of flags, bytes and doubles."""


def _check_footer(tail: bytes, schema: pq.ParquetSchema) -> None:
    """Pyarrow ends the process for these: an encrypted column, and size statistics that do not suit the column.

    What it throws when a column of a row group is asked for (``ColumnChunkMetaData`` in its metadata.cc) it does not catch.
    Raises ValueError, IndexError.
    """
    levels: dict[int, int] = {}
    for group in _picked(tail, len(tail) - int.from_bytes(tail[-_END_BYTES:-4], 'little') - _END_BYTES, _FOOTER)[0].get(4, ()):
        for place, column in enumerate(group.get(1, ())):
            sizes = column.get(3, {}).get(16)
            if 8 in column or 9 in column:
                raise ValueError('a column of it is encrypted')
            if sizes is None:
                continue
            if place not in levels:
                levels[place] = schema.column(place).max_definition_level
            if not (sizes.get(2, 0) <= 1 and sizes.get(3, 0) in {0, levels[place] + 1}
                    and (1 not in sizes or column[3].get(1) == _BYTE_ARRAY)):  # fmt: skip
                raise ValueError('its size statistics do not suit its columns')


def _picked(data: bytes, at: int, wanted: _Fields) -> tuple[dict[int, Any], int]:
    """Of a struct the fields that are wanted, and where it ends: whole numbers, of a list of numbers its length, else True."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        kind, step = head & 15, head >> 4
        if step:
            number += step
        else:
            number, at = _zigzag(data, at)
        if number not in wanted:
            at = at if kind <= 2 else _skipped(data, at, kind)
        elif number in fields:
            raise ValueError('its footer has a field twice')
        elif (inner := wanted[number]) is not None:
            if kind != (9 if isinstance(inner, list) else 12):
                raise ValueError('its footer cannot be read')
            fields[number], at = _listed(data, at, inner[0]) if isinstance(inner, list) else _picked(data, at, inner)
        elif kind == 9 and data[at] & 15 == 6:
            fields[number], at = _listed(data, at, None)
        elif kind in {5, 6}:
            fields[number], at = _zigzag(data, at)
        else:
            fields[number], at = True, at if kind <= 2 else _skipped(data, at, kind)
    return fields, at + 1


def _listed(data: bytes, at: int, wanted: _Fields | None) -> tuple[list[dict[int, Any]] | int, int]:
    """The structs of a list, or how many numbers it has; and where it ends."""
    kind, count, at = _list_head(data, at)
    if wanted is None:
        for _ in range(count):
            at = _skipped(data, at, kind)
        return count, at
    if kind != 12:
        raise ValueError('its footer cannot be read')
    found = []
    for _ in range(count):
        if wanted is _COLUMN and (usual := _USUAL.match(data, at)):
            fields, at = _of_usual(*usual.groups()), usual.end()
        else:
            fields, at = _picked(data, at, wanted)
        found.append(fields)
    return found, at


@lru_cache(maxsize=256)
def _of_usual(kind: bytes, size: bytes | None, levels: bytes | None) -> dict[int, Any]:
    """What ``_picked`` would have picked of it; nobody changes it."""
    sizes = {} if levels is None else {16: {**({1: True} if size else {}), 2: 0, 3: levels[0] >> 4}}
    return {3: {1: _zigzag(kind, 0)[0], **sizes}}


def _list_head(data: bytes, at: int) -> tuple[int, int, int]:
    """The type of a list's entries, how many it has, and where they begin."""
    kind, count = data[at] & 15, data[at] >> 4
    at += 1
    if count == 15:
        count, at = _varint(data, at)
    if count > len(data):
        raise ValueError('its footer cannot be read')
    return kind, count, at


def _skipped(data: bytes, at: int, kind: int, depth: int = 0) -> int:
    """Where a value of this type ends; flags are bytes here, as in lists."""
    if kind in _FIXED:
        return at + _FIXED[kind]
    if kind in {4, 5, 6}:
        return _varint(data, at)[1]
    if kind == 8:
        size, at = _varint(data, at)
        return at + size
    if depth > 8 or kind not in {9, 10, 12}:
        raise ValueError('its footer cannot be read')
    if kind != 12:
        kind, count, at = _list_head(data, at)
        for _ in range(count):
            usual = _STRUCT.match(data, at) if kind == 12 else None
            at = _skipped(data, at, kind, depth + 1) if usual is None else usual.end()
        return at
    while head := data[at]:
        at = at + 1 if head >> 4 else _varint(data, at + 1)[1]
        if head & 15 > 2:
            at = _skipped(data, at, head & 15, depth + 1)
    return at + 1


# -- the headers of pages ------------------------------------------------------------------------------------------------------


def _walk(data: bytes, begin: int, end: int) -> tuple[int, bool]:
    """What the pages of a column unpack to, and whether one is a dictionary, by their headers. Raises ValueError, IndexError."""
    total, has_dictionary = 0, False
    while begin < end:
        if plain := _PAGE.match(data, begin, end):  # as robots write them: most by far
            size, packed, at = _zigzag(plain[1], 0)[0], _zigzag(plain[2], 0)[0], plain.end()
            if _int32(size) < 0 or packed < 0 or at + packed > end:
                raise ValueError('its pages lie nowhere')
            total += size
            begin = at + packed
            continue
        page, at = _struct(data, begin)
        kind, size, packed = (_int32(page.get(number)) for number in (1, 2, 3))
        about = page.get(5 if kind == _DATA_PAGE else 7)
        if kind not in {_DATA_PAGE, _DICTIONARY_PAGE} or not isinstance(about, dict) or _int32(about.get(2)) not in _ENCODINGS:
            raise ValueError('it has pages of another kind than ours')
        if size < 0 or packed < 0 or at + packed > end:
            raise ValueError('its pages lie nowhere')
        has_dictionary |= kind == _DICTIONARY_PAGE
        total += size
        begin = at + packed
    return total, has_dictionary


def _int32(value: Any) -> int:
    """What a reader in C would take it for, or an error where that could be something else."""
    if type(value) is not int or not -(1 << 31) <= value < 1 << 31:
        raise ValueError('the header of a page cannot be read')
    return value


def _struct(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """A struct of whole numbers, flags, bytes (left out) and structs; where it ends. No number comes twice."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        kind, step = head & 15, head >> 4
        if step:
            number += step
        else:
            number, at = _zigzag(data, at)
        if number in fields or not 0 < number < 1 << 15 or depth > 3:
            raise ValueError('the header of a page cannot be read')
        if kind <= 2:
            fields[number] = kind == 1
        elif kind <= 6 and kind != 3:
            fields[number], at = _zigzag(data, at)
        elif kind == 8:
            size, at = _varint(data, at)
            fields[number], at = None, at + size
        elif kind == 12:
            fields[number], at = _struct(data, at, depth + 1)
        else:
            raise ValueError('the header of a page cannot be read')
    return fields, at + 1


def _zigzag(data: bytes, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = data[at]
    at += 1
    if value < 0x80:
        return value, at
    value &= 0x7F
    for shift in range(7, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError('the header of a page cannot be read')
