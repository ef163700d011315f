"""What the verbs print with: JSON, tables, progress, figures, and text from outside that can hurt neither layout nor terminal."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any, Final

import click
from rich.console import Console, Group, RenderableType
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.stamps import BY_RECEIVED
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.spool.gaps import ESTIMATED
from shadowhound_data_logger.spool.topic_account import RECEIVED_ONLY

BAR_COLUMNS: Final = 10
WIDEST: Final = 1000
UNSURE: Final = {ESTIMATED: 'estimated', RECEIVED_ONLY: 'not known'}
UNITS: Final = ((86400, 'd', 3600, 'h'), (3600, 'h', 60, 'min'), (60, 'min', 1, 's'))


def print_json(value: object, *, is_line: bool = False) -> None:
    """On standard output, for programs: one value, or one of many, a line each. Other types are written as text."""
    click.echo(json.dumps(value, indent=None if is_line else 2, default=str))


def report_error(verb: str, what: str, remedy: str) -> None:
    """On standard error: the verb, what is wrong and where, and on the next line what to do."""
    for start, text in ((f'{verb}: ', what), ('  -> ', remedy)):  # which may quote what a robot wrote
        click.echo(start + '\n'.join(map(visible, text.split('\n'))), err=True)


def print_error(verb: str, what: str, remedy: str, code: int) -> None:
    """The same for programs: one line of JSON on standard error, so that standard output has answers alone."""
    click.echo(json.dumps({'error': what, 'remedy': remedy, 'verb': verb, 'exit_code': int(code)}), err=True)


def print_page(*parts: RenderableType, console: Console | None = None) -> None:
    """Parts under one another. Tables fit the terminal; without one they are as wide as they need."""
    console = console or Console(highlight=False)
    width = console.width
    if not console.is_terminal:
        console.width = max(width, *(_width(each, console) for each in _tables(parts)), 1)
    console.print(Group(*fitted(parts, console)))
    console.width = width


def print_lines(*lines: str | Text, console: Console | None = None) -> None:
    """Lines that a terminal folds and a file keeps whole."""
    console = console or Console(highlight=False)
    for line in lines:
        console.print(plain(line) if isinstance(line, str) else line, soft_wrap=True)


def plain(text: object, style: str = '') -> Text:
    """Text from outside, verbatim: markup has no effect, and a control character becomes a question mark."""
    return Text(printable(str(text)), style)


class _Table(Table):
    minor: Sequence[str] = ()


def plain_table(title: str, columns: Iterable[str], left: Iterable[str] = ('topic', ''), minor: Sequence[str] = ()) -> Table:
    """Without lines, numbers to the right, nothing cut: a topic is broken across lines before it loses a letter.

    On a narrow terminal, columns in ``minor`` are omitted, the first one first.
    """
    table = _Table(title=title, title_justify='left', title_style='bold', header_style='dim', box=None, pad_edge=False)
    table.minor = minor
    for name in columns:
        is_left = name in left
        table.add_column(plain(name), justify='left' if is_left else 'right', overflow='fold', no_wrap=not is_left)
    return table


def value_table(title: str, values: Mapping[str, object]) -> Table:
    """Names and values under one another."""
    table = plain_table(title, ('', 'value'), ('', 'value'))
    table.show_header = False
    table.padding = (0, 2, 0, 0)
    for name, value in values.items():
        table.add_row(plain(name, 'dim'), plain(value))
    return table


def fitted(parts: Sequence[RenderableType], console: Console) -> list[RenderableType]:
    """The parts, with tables in which no word is broken.

    Columns are two apart, or one where that is too wide. Then minor columns are omitted, or cells of several words are folded
    between them; a table that is still too wide becomes a list of names and values for each row, as in psql's expanded display.
    """
    wide = {id(each): _fitted(each, console) for each in _tables(parts)}
    return [wide.get(id(part), part) for part in parts]


def _tables(parts: Sequence[RenderableType]) -> list[Table]:
    found = [part for part in parts if isinstance(part, Table) and part.show_header]
    for table in found:
        table.padding = (0, 2, 0, 0)
    return found


def _fitted(table: Table, console: Console) -> Table:
    if _width(table, console) <= console.width:
        return table
    table.padding = (0, 1, 0, 0)
    if _width(table, console) <= console.width:
        return table
    minor = table.minor if isinstance(table, _Table) else ()
    for count in range(1, len(minor) + 1):
        less = _without(table, minor[:count])
        if _width(less, console) <= console.width:
            less.caption = plain(f'Not shown: {", ".join(minor[:count])} (--json has all columns)', 'dim')
            less.caption_justify = 'left'
            return less
    sizes = [_size(column, console) for column in table.columns]
    spare = console.width - sum(size.minimum for size in sizes) - len(sizes) + 1
    if spare < 0:
        return _expanded(table)
    widths = [size.minimum for size in sizes]
    for _ in range(spare):  # each column to the one that lacks most
        lacking = [size.maximum - width for size, width in zip(sizes, widths, strict=True)]
        widths[lacking.index(max(lacking))] += 1
    for column, width in zip(table.columns, widths, strict=True):
        column.width = width
    return table


def _without(table: Table, names: Sequence[str]) -> Table:
    kept = [column for column in table.columns if str(column.header) not in names]
    found = plain_table(
        '', (str(column.header) for column in kept), [str(each.header) for each in kept if each.justify == 'left']
    )
    found.title, found.padding = table.title, table.padding
    for cells in zip(*(list(column.cells) for column in kept), strict=True):
        found.add_row(*cells)
    return found


def _size(column: Column, console: Console) -> Measurement:
    """Of its longest word, and of its longest cell."""
    sizes = [Measurement.get(console, console.options.update(max_width=WIDEST), cell) for cell in (column.header, *column.cells)]
    longest = max(size.maximum for size in sizes)
    return Measurement(longest if column.no_wrap else max(size.minimum for size in sizes), longest)


def _expanded(table: Table) -> Table:
    found = plain_table(str(table.title or ''), ('', 'value'), ('', 'value'))
    found.show_header = False
    found.padding = (0, 2, 0, 0)
    rows = zip(*(list(column.cells) for column in table.columns), strict=True)
    for number, cells in enumerate(rows):
        if number:
            found.add_row('', '')
        for column, cell in zip(table.columns, cells, strict=True):
            if str(cell):
                found.add_row(Text(str(column.header), 'dim'), cell)
    return found


def share_bar(share: float, console: Console) -> Text:
    """How full something is, 0 to 1, in ten columns: yellow from a half, red from nine tenths, never empty above 0."""
    full, empty = ('#', '.') if console.options.ascii_only else ('█', '░')
    share = min(max(share, 0.0), 1.0)
    count = max(round(share * BAR_COLUMNS), 1 if share > 0 else 0)
    style = 'red' if share >= 0.9 else 'yellow' if share >= 0.5 else 'green'
    return Text.assemble((full * count, style), (empty * (BAR_COLUMNS - count), 'dim'))


def number(value: int | None) -> str:
    """With separators; a dash if it is unknown."""
    return '-' if value is None else f'{value:,}'


def counted(count: int, noun: str) -> str:
    """``1 object``, ``2,400 objects``."""
    return f'{number(count)} {noun}{"s" * (count != 1)}'


def figure(exact: int | None, estimated: int | None) -> str:
    """A figure of a ledger or a status: ``~12`` if it is estimated, a dash if it is unknown."""
    return number(exact) if estimated is None else f'~{estimated:,}'


def unsure(grades: Sequence[str]) -> str:
    """``estimated for 2 topics and not known for 1 topic``, of the grades of several."""
    counts = {text: grades.count(grade) for grade, text in UNSURE.items()}
    return ' and '.join(f'{text} for {count} topic{"s" * (count > 1)}' for text, count in counts.items() if count)


def volume(count: float) -> str:
    """Bytes in decimal units, as disks and networks are sold."""
    for unit in ('B', 'KB', 'MB'):
        if count < 1000:
            return f'{count:.0f} {unit}' if unit == 'B' else f'{count:.1f} {unit}'
        count /= 1000
    return f'{count:.1f} GB'


def duration(seconds: float) -> str:
    """In the two largest units, such as ``0.4 s``, ``12 s``, ``3 min 5 s``, ``2 h 10 min``, ``4 d 3 h``."""
    if seconds < 60:
        return f'{seconds:.1f} s' if seconds < 10 else f'{seconds:.0f} s'
    left = round(seconds)
    size, unit, part, smaller = next(units for units in UNITS if left >= units[0])
    rest = left % size // part
    return f'{left // size} {unit} {rest} {smaller}' if rest else f'{left // size} {unit}'


def shown_by(by: str) -> str:
    """Which of the two times of messages is shown."""
    return 'Times are when messages arrived.' if by == BY_RECEIVED else 'Times are the stamps of messages.'


def shown_time(time_ns: int | None) -> str:
    """UTC, to the millisecond; a dash if it is unknown."""
    if time_ns is None:
        return '-'
    when = datetime.fromtimestamp(time_ns // SECOND, timezone.utc)
    return f'{when:%Y-%m-%d %H:%M:%S}.{time_ns % SECOND // 1_000_000:03d}'


def shown_iso(stamp: str) -> str:
    """An ISO time as people read it, to the second."""
    return f'{stamp[:10]} {stamp[11:19]}'


def with_dates(value: Mapping[str, Any]) -> dict[str, Any]:
    """For JSON: with each ``..._ns`` as a date, too, to the nanosecond."""
    dates = {name.removesuffix('_ns'): _iso_or_none(time) for name, time in value.items() if name.endswith('_ns')}
    return {**value, **dates}


def _iso_or_none(time_ns: int | None) -> str | None:
    if time_ns is None:
        return None
    when = datetime.fromtimestamp(time_ns // SECOND, timezone.utc)
    return f'{when:%Y-%m-%dT%H:%M:%S}.{time_ns % SECOND:09d}Z'


def _width(table: Table, console: Console) -> int:
    return Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
