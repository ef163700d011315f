"""``shadowhound-data search`` and ``lake index``: words of missions, events, errors and labels, and the index of them."""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    store_hint,
    the_home,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import (
    counted,
    number,
    plain,
    plain_table,
    print_json,
    print_lines,
    print_page,
    shown_time,
    with_dates,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import FLAGS, asking, quietly, report_skipped

FILE: Final = 'search.db'
MAX_TEXT: Final = 80
"""Letters of a document in the table; JSON has all."""
_ASKED: Final = ('robot', 'since', 'until', 'mission', 'mission_type', 'success', 'label', 'ranges')
_URL: Final = re.compile(r's3://([a-z0-9][a-z0-9.-]{1,61}[a-z0-9])/([^/].*[^/])')
_Command = TypeVar('_Command', bound=Callable[..., Any])


def _flags(command: _Command) -> _Command:
    """Those of ``query`` that documents have an answer to, as one mapping ``flags``."""

    @functools.wraps(command)
    def asked(**given: Any) -> Any:
        flags = {name: given.pop(name) for name in _ASKED}
        return command(flags={name: value for name, value in flags.items() if value is not None}, **given)

    for name in reversed([name for name in FLAGS if name in {*_ASKED, 'failed', 'succeeded'}]):
        asked = FLAGS[name](asked)
    return asked  # type: ignore[return-value]


@click.command(
    epilog=examples(
        'search door handle',
        'search \'"door handle" -kitchen\' --failed --since 30d',
        "search 'stair*' --kind event --json",
    )
)
@click.argument('words', nargs=-1, required=True)
@_flags
@click.option('--kind', type=click.Choice(['mission', 'event', 'error', 'label']), help='Only documents of this kind.')
@click.option('--limit', type=click.IntRange(1, 10_000), default=20, show_default=True, metavar='N', help='At most N results.')
@click.option('--index', metavar='FILE|s3://...', help='The index of words  [default: $SHADOWHOUND_HOME/search.db]')
@as_json
def search(*, words: tuple[str, ...], flags: Mapping[str, Any], kind: str | None, limit: int, index: str | None,
           as_json: bool) -> ExitCode:  # fmt: skip
    """Search the words of missions, events, errors and labels.

    All words must occur: door handle. "A phrase" must occur as written, door* matches the beginning of a word, -door excludes
    a word, and door OR gate takes either. The best match comes first. `lake index` makes and updates the index; the answer
    shows when that was last done.
    """
    with asking():
        from shadowhound_data_logger.lake import search as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.select import wanted  # noqa: PLC0415

        asked = wanted(time.time_ns(), **flags)
        with _index(index) as path:
            found = library.search(path, ' '.join(words), asked, kind=kind, limit=limit)
            fresh_ns, waiting = library.updated(path) or (None, 0)
    if as_json:
        print_json(with_dates({'found': [with_dates(each) for each in found], 'fresh_ns': fresh_ns, 'waiting': waiting}))
        return ExitCode.FINE
    columns = ['what', 'robot', 'when (UTC)', 'mission', 'found', *(['labels'] if any(each['labels'] for each in found) else [])]
    table = plain_table('', columns, columns)
    table.title = None
    for each in found:
        text = each['title'] if not each['excerpt'] or each['excerpt'] == each['title'] else f'{each["title"]}: {each["excerpt"]}'
        text = text.removeprefix(': ')
        cells = [each['kind'], each['robot'], shown_time(each['since_ns']), each['mission_id'] or '-',
                 text if len(text) <= MAX_TEXT else f'{text[:MAX_TEXT]} ...', ', '.join(each['labels'])]  # fmt: skip
        table.add_row(*map(plain, cells[: len(columns)]))
    until = f'up to {shown_time(fresh_ns)}' if fresh_ns is not None else 'up to a time that is not known'
    more = f'; {counted(waiting, "mission")} had no summary yet' if waiting else ''
    print_page(*([table, ''] if found else [plain(f'Nothing has these words.{store_hint()}')]),
               plain(f'Fresh {until} (`lake index`){more}.'))  # fmt: skip
    return ExitCode.FINE


@click.command('index', epilog=examples('lake index', 'lake index --index s3://sensor-data/_search/search.db'))
@click.option('--index', metavar='FILE|s3://...', help='The index of words  [default: $SHADOWHOUND_HOME/search.db]')
@as_json
def lake_index(*, index: str | None, as_json: bool) -> ExitCode:
    """Make the index of words for `search`, or update it.

    The index is one file made from the summaries of missions and the labels in the store. Only new documents are read. With
    s3:// the default file is updated first and then put into the store for all users.
    """
    with asking():
        from shadowhound_data_logger.lake import search as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

        place = _place(index) if index and '://' in index else None
        path = the_home() / FILE if place or not index else Path(index)
        left_out = quietly()
        with progress('reading summaries'):
            found = library.update(path, default_source(the_store_settings()), left_out)
        if place is not None:
            with the_store() as store:
                library.put(store, *place, path)
    if as_json:
        print_json({'index': index or str(path), **asdict(found)})
    else:
        print_lines(f'{counted(found.missions, "mission")} added; {number(found.documents)} documents are in {index or path}.')
        if found.waiting:
            print_lines(f'{counted(found.waiting, "mission")} without a summary yet.')
    return report_skipped(left_out)


@contextmanager
def _index(named: str | None) -> Iterator[Path]:
    from shadowhound_data_logger.lake import search as library  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415

    if named and '://' in named:
        bucket, key = _place(named)
        with library.downloaded(Bucket(the_store_settings(), bucket), key) as path:
            yield path
    else:
        yield Path(named).expanduser() if named else the_home() / FILE


def _place(url: str) -> tuple[str, str]:
    named = _URL.fullmatch(url)
    if named is None:
        raise BadUsage(f'{url} is no place in a store', 's3://BUCKET/KEY, such as s3://sensor-data/_search/search.db')
    return named[1], named[2]
