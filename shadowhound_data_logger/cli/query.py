"""``shadowhound-data query``: what is stored, by flags or by SQL, as a table, CSV, JSON, keys or pictures."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import RenderableType

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, store_hint, the_store_settings
from shadowhound_data_logger.cli.likeness import model_option, most_similar
from shadowhound_data_logger.cli.output import (
    counted,
    duration,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    shown_by,
    shown_time,
    volume,
    with_dates,
)
from shadowhound_data_logger.cli.question import asking, by_flag, question, question_text, quietly, report_skipped
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.expression import STORED, parse
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.core.untrusted import csv_cell, visible
from shadowhound_data_logger.lake.bucket import default_source

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.values import ValueAnswer

SHOWN: Final = 30
"""Rows of a table unless --limit says more."""
COLUMNS: Final = ('likeness', 't_start', 'sensor', 'key', 'bytes', 'x', 'y', 'battery_pct', 'mission_type', 'labels')
"""Of a table of objects; the other formats have all."""
MINOR: Final = ('mission_type', 'battery_pct', 'sensor', 'y', 'x')
"""Of these, what a narrow terminal does not show."""
MAX_POSES: Final = 20_000
MAX_TIMES: Final = 100
_OBJECTS: Final = {'bucket', 'key'}
_ORDER: Final = re.compile(r'\w+(\s+(asc|desc))?', re.IGNORECASE)


@click.command(
    epilog=examples(
        'query --sensor camera --since yesterday --near 2.0,6.5,3 --sheet kitchen.jpg',
        'query --topic /odom --limit 5 --format csv',
        "query --when 'imu.accelerometer.2 > 15' --since 7d --json > bumps.json",
        'query --sensor camera --ranges bumps.json',
        'query --sensor camera --like door.jpg --model clip-vit-base-patch32 --limit 20',
        'query "SELECT sensor, count(*) AS n FROM objects GROUP BY sensor" --since 7d',
    )
)
@click.argument('sql', required=False)
@question
@by_flag
@click.option('--order', metavar='COLUMN', help="Sort by this column, such as 't_start desc'  [default: t_start]")
@click.option('--limit', type=click.IntRange(1), metavar='N', help='At most N results.')
@click.option(
    '--format',
    'kind',
    type=click.Choice(['table', 'csv', 'json', 'keys']),
    default='table',
    show_default=True,
    help='Format of the output.',
)
@click.option('--when', metavar='EXPRESSION',
              help="Find times at which values in the objects meet a condition: 'imu.accelerometer.2 > 15'.")  # fmt: skip
@click.option('--scan', is_flag=True, help='With --when: open objects without statistics as well.')
@click.option('--join', 'join_s', type=click.FloatRange(0.0), metavar='S',
              help='Join times that are at most S seconds apart  [default: 1, or two periods of a slower sensor]')  # fmt: skip
@click.option(
    '--pad', 'pad_s', type=click.FloatRange(0.0), default=0.0, metavar='S', help='Extend each time by S seconds at both ends.'
)
@click.option('--like', 'like', type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar='FILE',
              help='Find the images most similar to this one, with vectors made by `lake embed`; needs --model.')  # fmt: skip
@click.option('--like-text', metavar='TEXT', help='Find the images that best match these words; needs --model.')
@model_option
@click.option('--as-of', metavar='TIME', help='Use the version of the tables at this time, to the second.')
@click.option('--labels', 'with_labels', is_flag=True, help='Add a column with the labels.')
@as_json
@click.option('--sheet', type=click.Path(path_type=Path), metavar='FILE.jpg', help='Write a contact sheet of the images found.')
@click.option(
    '--map', 'ground', type=click.Path(path_type=Path), metavar='FILE.png', help='Draw where the objects were recorded.'
)
def query(*, sql: str | None, flags: Mapping[str, Any], order: str | None, limit: int | None, kind: str,  # noqa: PLR0913 - one an option
          as_json: bool, with_labels: bool, when: str | None, scan: bool, join_s: float | None, pad_s: float, like: Path | None,
          like_text: str | None, model: Path | None, as_of: str | None, sheet: Path | None,
          ground: Path | None) -> ExitCode:  # fmt: skip
    """Query what is stored, with flags or SQL.

    An object must match all flags; times are UTC.

    SQL has the views objects, missions, topics, gaps, watermarks, labels and forgotten, restricted by the flags.

    --when 'imu.accelerometer.2 > 15 and max(imu.temperature) < 60' tests the values in the objects: the answer is times,
    which --ranges accepts. A plain name tests each message; first last min max mean count nan_count test each object.

    --like and --like-text compare all images that the flags select, and list the most similar first; 1 is identical to the
    model.

    Exit code 1 if files of the catalog are damaged: they are skipped and named on standard error.
    """
    with asking():
        from shadowhound_data_logger.lake import labels, names  # noqa: PLC0415

        if when is not None:
            if sql or sheet or ground or order or limit or with_labels or kind not in {'table', 'json'}:
                raise BadUsage('--when answers with times, without SQL, --order, --limit, --labels, --sheet, --map',
                               'write them to a file with --json, and query again with --ranges FILE')  # fmt: skip
            return _times(when, flags, scan=scan, join_s=join_s, pad_s=pad_s, is_json=as_json or kind == 'json')
        if scan or join_s is not None or pad_s:
            raise BadUsage('--scan, --join and --pad are about the times that --when finds', 'add --when, or leave them out')
        if sql and with_labels:
            raise BadUsage('--labels adds a column to objects, not to SQL', 'SQL has the view labels: SELECT * FROM labels')
        source, left_out = default_source(the_store_settings()), quietly()
        if like or like_text or model:
            if sql or order or bool(like) is bool(like_text):
                raise BadUsage('--like FILE or --like-text TEXT asks for pictures, the most similar first',
                               'omit the other one, SQL and --order')  # fmt: skip
            found = most_similar(source, like, like_text, model, limit or SHOWN, left_out, flags)
            limit = limit or SHOWN
        else:
            try:
                found = _found(source, sql, flags, order, limit, left_out, as_of)
            except LakeError as error:
                raise _with_hint(error, flags.get('where')) from error
            if flags and not len(found if not sql else _found(source, None, flags, None, 1, left_out)):
                names.check_names(source, left_out, **flags)
        if with_labels:
            found = labels.with_column(found, labels.read(source, flags.get('robot'), findings=left_out))
    if (sheet or ground or kind == 'keys') and not _OBJECTS.issubset(found.column_names):
        raise BadUsage('keys and pictures need the columns bucket and key', 'SELECT bucket, key FROM objects ...')
    with asking():
        if sheet or ground:
            _pictures(source, found.to_pylist(), flags, left_out, sheet, ground)
    _print(
        found,
        'json' if as_json else kind,
        source.describe(),
        is_objects=not sql,
        is_limited=limit is not None,
        by=flags.get('by', BY_STAMP),
    )
    return report_skipped(left_out)


def _found(source: Any, sql: str | None, flags: Mapping[str, Any], order: str | None, limit: int | None, left_out: Any,
           as_of: str | None = None) -> Any:  # fmt: skip
    from shadowhound_data_logger.lake import query as lake  # noqa: PLC0415 - the extra lake

    if order is not None and not all(_ORDER.fullmatch(part.strip()) for part in order.split(',')):
        raise BadUsage(f'--order {order!r} is not a column', "--order 't_start desc' is one, in descending order")
    if not sql:
        return lake.objects(source, findings=left_out, order=order or 't_start_ns', limit=limit, as_of=as_of, **flags)
    found = lake.sql(sql, source, findings=left_out, as_of=as_of, **flags)
    return lake.ordered(found, order, limit) if order or limit else found


def _with_hint(error: LakeError, where: str | None) -> LakeError:
    """The error of a ``--where`` that is no SQL over the columns, with what to do if it is about values."""
    try:
        parse(where or '', 'where', STORED)
    except SettingError:
        return error
    return LakeError(error.what, remedy=f'--where is SQL over the columns; for values in the objects: --when {where!r}')


def _times(when: str, flags: Mapping[str, Any], *, scan: bool, join_s: float | None, pad_s: float, is_json: bool) -> ExitCode:
    """When values in the objects were so."""
    from shadowhound_data_logger.lake import names, values  # noqa: PLC0415

    source, left_out = default_source(the_store_settings()), quietly()
    found = values.ranges(when, source, scan=scan, join_s=join_s, pad_s=pad_s, findings=left_out, **flags)
    if not found.objects:
        names.check_names(source, left_out, **{'sensor': values.sensor_of(when), **flags})
    if found.fields:
        names.check_name_of('field', values.field_of(when, found.fields), found.fields)
    _print_times(when, found, is_json=is_json)
    return report_skipped(left_out)


def _print_times(condition: str, found: ValueAnswer, *, is_json: bool) -> None:
    if is_json:
        fresh = [with_dates({**asdict(each), 'fresh_ns': each.fresh_ns}) for each in found.fresh]
        print_json({'when': condition, **asdict(found), 'ranges': [with_dates(asdict(each)) for each in found.ranges],
                    'fresh': fresh})  # fmt: skip
        return
    table = plain_table('', ('robot', 'from (UTC)', 'to (UTC)', 'lasts', 'messages'), ('robot', 'from (UTC)', 'to (UTC)'))
    table.title = None
    for each in found.ranges[:MAX_TIMES]:
        lasts = duration((each.until_ns - each.since_ns) / SECOND)
        table.add_row(plain(each.robot), shown_time(each.since_ns), shown_time(each.until_ns), lasts, number(each.messages))
    parts: list[RenderableType] = [table, ''] if found.ranges else []
    print_page(*parts, *_about_times(found))


def _about_times(found: ValueAnswer) -> Iterator[RenderableType]:
    """How many, what was opened for it, what may be missing, and up to when it is all that there is."""
    if not found.objects:
        yield plain(f'There are no such objects.{store_hint()}')
        return
    more = f'; the first {MAX_TIMES} are shown (--json has all)' if len(found.ranges) > MAX_TIMES else ''
    percent = 100 * found.opened / found.objects
    share = f'{percent:.{0 if percent >= 10 else 2}{"f" if percent >= 10 else "g"}} %' if found.opened else 'none'
    opened = f'{number(found.opened)} of {counted(found.objects, "object")} opened ({share})'
    yield plain(f'{counted(len(found.ranges), "time")}{more}. {opened}.')
    if found.fields:
        yield plain(f'There is no such field. There are {", ".join(found.fields)}.', 'yellow')
    if found.unknown:
        yield plain(f'{counted(found.unknown, "object")} without statistics may hold more: --scan opens them.', 'yellow')
    for each in found.fresh:
        until = f'up to {shown_time(each.fresh_ns)}' if each.fresh_ns is not None else 'up to a time that is not known'
        yield plain(f'{each.robot} {each.topic}: fresh {until}.')


def _print(found: Any, kind: str, where: str, *, is_objects: bool, is_limited: bool, by: str) -> None:
    if kind == 'keys':
        for bucket, key in zip(found['bucket'].to_pylist(), found['key'].to_pylist(), strict=True):
            click.echo(visible(f'{bucket}/{key}'))
    elif kind == 'json':
        print_json([_json_row(row) for row in found.to_pylist()])
    elif kind == 'csv':
        writer = csv.writer(sys.stdout, lineterminator='\n')
        writer.writerow(map(csv_cell, found.column_names))
        writer.writerows(map(csv_cell, _json_row(row).values()) for row in found.to_pylist())
    else:
        print_page(*_table(found, where, is_objects=is_objects, is_limited=is_limited, by=by))


def _table(found: Any, where: str, *, is_objects: bool, is_limited: bool, by: str) -> Iterator[RenderableType]:
    columns = [name for name in COLUMNS if name in found.column_names] if is_objects else found.column_names
    rows = found.select(columns).slice(0, len(found) if is_limited else SHOWN).to_pylist()
    if is_objects:
        columns = [name for name in columns if any(row[name] is not None for row in rows)]
    left = {name for name in columns if any(isinstance(row[name], (str, datetime)) for row in rows)}
    minor = [name for name in MINOR if name in columns] if is_objects else []
    table = plain_table('', columns, left, minor)
    table.title = None
    for row in rows:
        table.add_row(*(plain(_cell(name, row[name])) for name in columns))
    if rows:
        yield table
        yield ''
    yield plain(_verdict(found, len(rows), where, is_objects=is_objects))
    if rows and (is_objects or by == BY_RECEIVED):
        yield plain(shown_by(by))


def _verdict(found: Any, shown: int, where: str, *, is_objects: bool) -> str:
    what = 'objects' if is_objects else 'rows'
    if not len(found):
        return f'No {what} in {where} match the query. A node adds rows once per minute.{store_hint()}'
    text = counted(len(found), what[:-1])
    if is_objects:
        text += f', {volume(sum(found["bytes"].to_pylist()))}'
    return f'{text}; the first {shown} are shown (--limit, or another --format)' if shown < len(found) else text


def _cell(name: str, value: Any) -> str:
    if value is None:
        return '-'
    if isinstance(value, datetime):
        return f'{value:%Y-%m-%d %H:%M:%S}'
    if isinstance(value, list):
        return ', '.join(map(str, value)) or '-'
    if isinstance(value, float):
        return f'{value:.2f}' if name in {'x', 'y', 'yaw'} else f'{value:.3f}' if name == 'likeness' else f'{value:g}'
    return number(value) if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _json_row(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: f'{value:%Y-%m-%dT%H:%M:%S.%fZ}' if isinstance(value, datetime) else value for name, value in row.items()}


def _pictures(source: Any, rows: Sequence[Mapping[str, Any]], flags: Mapping[str, Any], left_out: Any, sheet: Path | None,
              ground: Path | None) -> None:  # fmt: skip
    from shadowhound_data_logger.lake import pictures  # noqa: PLC0415
    from shadowhound_data_logger.lake import query as lake  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415
    from shadowhound_data_logger.lake.select import wanted  # noqa: PLC0415

    if sheet:
        pictures.sheet(rows, lambda bucket: Bucket(source.settings, bucket), question_text(flags), sheet)
        click.echo(f'Wrote {sheet}', err=True)
    if ground:
        around = {name: flags[name] for name in ('robot', 'since', 'until') if name in flags}
        poses = lake.objects(source, findings=left_out, columns=('x', 'y'), where='x IS NOT NULL', **around).to_pydict()
        path = list(zip(poses['x'], poses['y'], strict=True))
        near = wanted(0, near=flags.get('near')).near
        pictures.ground(rows, path[:: len(path) // MAX_POSES + 1], near, question_text(flags), ground)
        click.echo(f'Wrote {ground}', err=True)
