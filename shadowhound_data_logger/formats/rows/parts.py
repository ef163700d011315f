"""Row files: what robots write about their data, one JSON object per line, compressed with zstd (docs/formats.md).

Every line has its kind as ``row`` (an object, a gap, ...) and the columns of that kind's table; a column that is null is omitted.
Anyone with a robot's credentials can write such a file, so the reader trusts nothing: it decompresses piece by piece up to a
limit, bounds the lines, and checks the type and range of each value. A row may name only its own robot and the keys of that
robot. Rejected lines are counted by reason, and the other rows are used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import orjson

from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.zstd import DecompressionParameter, ZstdDecompressor, ZstdError, compress
from shadowhound_data_logger.formats.rows.catalog import (
    DOUBLE,
    FORGOTTEN,
    INT32,
    INT64,
    KEPT,
    OBJECTS,
    STRING,
    TIME,
    Row,
    TableSchema,
    date_of,
)
from shadowhound_data_logger.formats.rows.gaps import COMPLETE, GAP, GAPS, WITHDRAWN
from shadowhound_data_logger.formats.rows.labels import LABEL_KINDS, LABELS
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.formats.statistics import NUMBERS

CONTENT_TYPE: Final = 'application/zstd'
KINDS: Final[Mapping[str, TableSchema]] = {
    'object': OBJECTS,
    'kept': KEPT,
    'forgotten': FORGOTTEN,
    'gap': GAPS,
    'watermark': GAPS,
    'statistic': STATISTICS,
    'label': LABELS,
}
"""The table of each kind of row."""
MAX_FILE_BYTES: Final = 16 << 20
MAX_BYTES: Final = 64 << 20
"""Decompressed: the statistics of 400 objects can have 26,000 rows, which take 10 MB."""
MAX_RATIO: Final = 400
"""Maximum ratio of the decompressed size, minus the slack, to the file size. Rows that differ only in a number reach 230."""
SLACK_BYTES: Final = 1 << 20
MAX_LINE_BYTES: Final = 64 << 10
MAX_LINES: Final = 100_000
_PIECE_BYTES: Final = 1 << 18
_LEVEL: Final = 3
_WINDOW: Final[Mapping[int, int]] = {DecompressionParameter.window_log_max: 23}
"""8 MiB: four times what this level needs; a file cannot make its reader allocate more."""
_KIND_OF: Final = {of.folder: kind for kind, of in KINDS.items() if kind != 'watermark'}
_OWNED_BY_ROBOT: Final = frozenset({GAPS.folder, LABELS.folder})
"""Tables whose rows must name their robot; the rows of the others have a key below its name."""
_WHAT: Final[Mapping[str, tuple[str, ...]]] = {'gap': (GAP, WITHDRAWN), 'watermark': (COMPLETE,), 'label': LABEL_KINDS}
_NOT_NEGATIVE: Final = frozenset({'bytes', 'revision', 'merged', 'received', 'skipped'})
_SPANS: Final[Mapping[str, Sequence[tuple[str, str]]]] = {
    GAPS.folder: (('from_ns', 'to_ns'),),
    LABELS.folder: (('since_ns', 'until_ns'),),
}
_YEARS_US: Final = (-62_135_596_800_000_000, 253_402_300_799_999_999)
"""Years 1 to 9999, those that a date can have."""


class Rejected(NamedTuple):
    """Lines that were rejected for the same reason."""

    why: str
    lines: int
    """How many."""
    first: int
    """The number of the first of them, counted from 1."""


@dataclass(slots=True)
class RowsRead:
    """What a file contains."""

    rows: dict[str, list[Row]] = field(default_factory=dict)
    """By the folder of their table, in the order of the file; each has all columns of the table."""
    rejected: list[Rejected] = field(default_factory=list)
    unknown: int = 0
    """Valid rows with columns that this version does not know, because the robot is newer; these columns are ignored."""
    ended: str | None = None
    """Why the rest of the file was not read; None if it was read to its end."""

    @property
    def findings(self) -> str:
        """What is missing and why, in a sentence; empty for a valid file."""
        found = [f'{rows_are(each.lines)} rejected: {each.why} (first in line {each.first:,})' for each in self.rejected]
        return '; '.join([*found, *([f'the rest of the file is not read: {self.ended}'] if self.ended else [])])


def rows_are(count: int) -> str:
    """``1 row is``, ``2 rows are``."""
    return '1 row is' if count == 1 else f'{count:,} rows are'


def encode(rows: Sequence[Row], of: TableSchema = OBJECTS) -> bytes:
    """The row file of these rows of one table, in their order."""
    return compress(b''.join(_line(row, of) for row in rows), _LEVEL)


def by_folder(rows: Iterable[tuple[int, Row]]) -> Iterator[tuple[str | None, str, list[tuple[int, Row]]]]:
    """(robot, date, rows sorted by time) for each file to write; each row with the id of its object."""
    folders: dict[tuple[str | None, str], list[tuple[int, Row]]] = {}
    for number, row in rows:
        folders.setdefault((row['robot'], date_of(row)), []).append((number, row))
    for (robot, date), found in folders.items():
        yield robot, date, sorted(found, key=lambda pair: (pair[1]['t_start_ns'] or 0, pair[0]))


def read_rows(content: bytes, robot: str) -> RowsRead:
    """The valid rows of a robot's row file. Raises nothing for its content."""
    found, reasons = RowsRead(), dict[str, Rejected]()
    for number, line in enumerate(_lines(content, found), 1):
        if number > MAX_LINES:
            found.ended = f'it has more than {MAX_LINES:,} lines'
            break
        try:
            of, row, has_unknown = _checked(line, robot)
        except ValueError as error:
            why = str(error)
            before = reasons.get(why, Rejected(why, 0, number))
            reasons[why] = before._replace(lines=before.lines + 1)
        else:
            found.rows.setdefault(of.folder, []).append(row)
            found.unknown += has_unknown
    found.rejected = list(reasons.values())
    return found


def _line(row: Row, of: TableSchema) -> bytes:
    kind = _KIND_OF[of.folder] if row.get('what') != COMPLETE else 'watermark'
    line = {'row': kind, **{name: value for name, value in row.items() if value is not None}}
    try:
        return orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE)
    except TypeError:  # a lone surrogate in a text
        line = {
            name: value.encode(errors='replace').decode() if isinstance(value, str) else value for name, value in line.items()
        }
        return orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE)


def _lines(content: bytes, found: RowsRead) -> Iterator[bytes | None]:
    """The lines, None for one that is too long; sets why the file ended early."""
    rest, is_long = b'', False
    for piece in _pieces(content, found):
        *lines, rest = (rest + piece).split(b'\n')
        for line in lines:
            yield None if is_long or len(line) > MAX_LINE_BYTES else line
            is_long = False
        if len(rest) > MAX_LINE_BYTES:
            rest, is_long = b'', True
    if (rest or is_long) and found.ended is None:
        found.ended = 'its last line is incomplete'


def _pieces(content: bytes, found: RowsRead) -> Iterator[bytes]:
    """The decompressed content, piece by piece, up to the limit."""
    left = min(MAX_BYTES, SLACK_BYTES + MAX_RATIO * len(content))
    reader, data = ZstdDecompressor(options=_WINDOW), content
    if not content:
        found.ended = 'it is empty'
        return
    while data or not reader.eof:
        try:
            piece = reader.decompress(data, min(_PIECE_BYTES, left + 1))
        except (ZstdError, EOFError, MemoryError) as error:
            found.ended = f'it cannot be decompressed: {" ".join(str(error).split())[:200] or type(error).__name__}'
            return
        data = b''
        left -= len(piece)
        if left < 0:
            found.ended = f'it decompresses to more than {MAX_BYTES:,} bytes or {MAX_RATIO} times its size'
            return
        yield piece
        if reader.eof:
            data = reader.unused_data
            reader = ZstdDecompressor(options=_WINDOW) if data else reader
        elif reader.needs_input:
            found.ended = 'it is truncated'
            return


def _checked(line: bytes | None, robot: str) -> tuple[TableSchema, Row, bool]:
    """The row of a line, and whether it has more columns than this version knows.

    Raises ValueError; its text contains nothing from the line.
    """
    if line is None:
        raise ValueError(f'longer than {MAX_LINE_BYTES:,} bytes')
    try:
        values = orjson.loads(line)
    except orjson.JSONDecodeError:
        raise ValueError('not JSON') from None
    kind = values.pop('row', None) if isinstance(values, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError('no known kind of row')
    of = KINDS[kind]
    checks = _CHECKS[of.folder]
    for name, value in values.items():
        check = checks.get(name)
        if check is not None and value is not None and not check(value):
            raise ValueError(f'{name} is invalid')
    has_unknown = not checks.keys() >= values.keys()
    if has_unknown:
        values = {name: value for name, value in values.items() if name in checks}
    row = {**_EMPTY[of.folder], **values}
    for name in _REQUIRED[of.folder]:
        if row[name] is None:
            raise ValueError(f'{name} is missing')
    _check_owner(row, robot, of)
    if row.get('what') not in _WHAT.get(kind, (None,)):
        raise ValueError('what does not suit its kind')
    for first, last in _SPANS.get(of.folder, ()):
        if row[first] is not None and row[last] is not None and row[first] > row[last]:
            raise ValueError(f'{first} is after {last}')
    return of, row, has_unknown


def _check_owner(row: Row, robot: str, of: TableSchema) -> None:
    named = row['robot']
    if named != robot and (named is not None or of.folder in _OWNED_BY_ROBOT):
        raise ValueError('names another robot')
    if of.folder not in _OWNED_BY_ROBOT and not row['key'].startswith(f'{robot}/'):
        raise ValueError('has a key of another robot')


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_time(value: Any) -> bool:
    return type(value) is int and _YEARS_US[0] <= value <= _YEARS_US[1]


def _is_int32(value: Any) -> bool:
    return type(value) is int and -(1 << 31) <= value < 1 << 31


def _is_int64(value: Any) -> bool:
    return type(value) is int and -(1 << 63) <= value < 1 << 63


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 63


def _is_double(value: Any) -> bool:
    return type(value) is float or _is_int64(value)


def _is_bucket(value: Any) -> bool:
    return isinstance(value, str) and is_name(value)


_BY_KIND: Final[Mapping[str, Callable[[Any], bool]]] = {
    STRING: _is_text, INT32: _is_int32, INT64: _is_int64, DOUBLE: _is_double, TIME: _is_time,
}  # fmt: skip


def _check_of(name: str, kind: str) -> Callable[[Any], bool]:
    if name in _NOT_NEGATIVE:
        return _is_count
    return _is_bucket if name == 'bucket' else _BY_KIND[kind]


_TABLES: Final = {of.folder: of for of in KINDS.values()}
_CHECKS: Final = {folder: {name: _check_of(name, kind) for name, kind in of.columns.items()} for folder, of in _TABLES.items()}
_REQUIRED: Final = {
    folder: tuple(name for name in of.required if not (of is STATISTICS and name in NUMBERS)) for folder, of in _TABLES.items()
}
"""Queries check the numbers of statistics: if the row were rejected, the object would appear to lack the field."""
_EMPTY: Final[Mapping[str, Row]] = {folder: dict.fromkeys(of.columns) for folder, of in _TABLES.items()}
