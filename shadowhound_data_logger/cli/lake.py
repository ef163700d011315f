"""``shadowhound-data lake``: the catalogue itself: how it lies in the store, made smaller, made anew."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from datetime import date, timedelta
from typing import Any, Final

import click
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TaskID, TextColumn

from shadowhound_data_logger.cli.lake_verify import verify
from shadowhound_data_logger.cli.question import asking, quietly, settings, tell_left_out
from shadowhound_data_logger.cli.tables import number, plain, plain_table, show_whole, volume
from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.stores import open_store

COLUMNS: Final = ('robot', 'days', 'first', 'last', 'files', 'size', 'compacted', 'to compact', 'stood for')
_as_json = click.option('--json', 'as_json', is_flag=True, help='Print it as JSON.')
_robot = click.option('--robot', metavar='NAME', help='Of this robot alone.')


@click.group()
def lake() -> None:
    """The catalogue of what is stored, in the store itself: BUCKET/ROBOT/_catalog/."""


lake.add_command(verify)


@lake.command()
@_robot
@_as_json
def status(*, robot: str | None, as_json: bool) -> int:
    """How many files the catalogue has, of which days, and what compacting would do."""
    with asking():
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.state import state  # noqa: PLC0415

    source = default_source(settings())
    left_out = quietly()
    found = state(source, robot, left_out)
    if as_json:
        click.echo(json.dumps([asdict(row) for row in found], indent=2))
        return tell_left_out(left_out)
    table = plain_table('', COLUMNS, ('robot', 'first', 'last'))
    table.title = None
    for row in found:
        counts = (row.files, row.size, row.compacted, row.open_days, row.covered)
        table.add_row(plain(row.robot), number(row.days), row.first, row.last, number(counts[0]), volume(counts[1]),
                      *map(number, counts[2:]))  # fmt: skip
    show_whole([table] if found else [plain(f'There is no catalogue yet in {source.describe()}.')], Console(highlight=False))
    return tell_left_out(left_out)


@lake.command()
@_robot
@click.option('--before', metavar='DATE', help='Days earlier than this  [default: today, UTC]')
@click.option('--keep', is_flag=True, help='Delete nothing.')
@click.option('--grace', type=click.FloatRange(0.0), default=60.0, show_default=True, metavar='MIN',
              help='How long files stay that a compacted one stands for: somebody may be reading them.')  # fmt: skip
@_as_json
def compact(*, robot: str | None, before: str | None, keep: bool, grace: float, as_json: bool) -> int:
    """Make one file of the many of each day that is over, and delete those that an earlier run made one of.

    Exit code 1 when a file is no part of a catalogue, or has rows that are not its robot's: it is named and stays as it is.
    """
    if before:
        try:
            date.fromisoformat(before)
        except ValueError as error:
            raise click.BadParameter(f'{before!r} is no date such as 2026-11-21') from error
    found = []
    with asking():
        from shadowhound_data_logger.lake import compact as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415

    store, left_out = settings(), quietly()
    how: dict[str, Any] = {'robot': robot, 'before': before or '', 'grace': None if keep else timedelta(minutes=grace)}
    with closing(open_store(store, UploadSettings())) as target, _spinner() as (bar, task):
        for day in library.compact(default_source(store), target, findings=left_out, **how):
            found.append(day)
            bar.update(task, description=f'{day.robot} {day.date}')
    if as_json:
        click.echo(json.dumps([asdict(day) for day in found], indent=2))
        return tell_left_out(left_out)
    merged, deleted, kept = (sum(getattr(day, name) for day in found) for name in ('merged', 'deleted', 'kept'))
    days = sum(day.merged > 0 for day in found)
    click.echo(f'{number(merged)} files are {number(days)} now, one a day.' if merged else 'There is nothing to merge.')
    if deleted:
        click.echo(f'{number(deleted)} that were merged earlier are deleted.')
    if kept:
        click.echo(f'{number(kept)} that are stood for are still there: a later run deletes them.')
    if any(day.denied for day in found):
        click.echo('These credentials may not delete: that costs room, and nothing else.')
    return tell_left_out(left_out)


@lake.command()
@click.option('--robot', metavar='NAME', required=True, help='Whose objects.')
@_as_json
def reindex(*, robot: str, as_json: bool) -> int:
    """Add what the catalogue lacks, by listing the store and asking each object that is missing."""
    with asking():
        from shadowhound_data_logger.lake import reindex as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415

    store, left_out = settings(), quietly()
    with closing(open_store(store, UploadSettings())) as target, _spinner() as (bar, task):
        found = library.reindex(default_source(store), target, robot, findings=left_out, tell=lambda so_far: bar.update(
            task, description=f'{number(so_far.listed)} objects listed, {number(so_far.added)} added'))  # fmt: skip
    if as_json:
        click.echo(json.dumps(asdict(found), indent=2))
    else:
        click.echo(
            f'{number(found.listed)} objects are in the store; {number(found.added)} were not in the catalogue and are now.'
        )
        if found.gone:
            click.echo(f'{number(found.gone)} rows name objects that are gone from the store.')
    return tell_left_out(left_out)


@contextmanager
def _spinner() -> Iterator[tuple[Progress, TaskID]]:
    """A line on standard error that says how far it is, where that is a terminal."""
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn('{task.description}'))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar, bar.add_task('')
