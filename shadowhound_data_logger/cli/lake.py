"""``shadowhound-data lake``: the tables of what is stored: made of rows, pruned, restored, compared with the store."""

from __future__ import annotations

import time
from dataclasses import asdict
from datetime import timedelta
from typing import TYPE_CHECKING, Final

import click

from shadowhound_data_logger.cli.common import (
    Age,
    ExitCode,
    LazyCommands,
    Verb,
    as_json,
    examples,
    store_hint,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import (
    counted,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, quietly, report_skipped
from shadowhound_data_logger.core.errors import StoreUnavailable

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.ingest import Ingested


THREADS: Final = 16
"""Objects at a time."""
COLUMNS: Final = ('robot', 'days', 'first', 'last', 'objects', 'rows', 'waiting', 'rejected')
only_robot = click.option('--robot', metavar='NAME', help='Only of this robot.')


@click.group(
    epilog=examples('lake status', 'lake ingest'),
    commands=LazyCommands(
        (
            Verb('prune', module='lake_prune', attribute='lake_prune'),
            Verb('verify', module='lake_check', attribute='lake_verify'),
            Verb('coverage', module='lake_check', attribute='lake_coverage'),
            Verb('index', module='search', attribute='lake_index'),
            Verb('embed', module='likeness', attribute='lake_embed'),
            Verb('sink', module='sink', attribute='lake_sink'),
        )
    ),
)
def lake() -> None:
    """Manage the tables of what is stored.

    Robots write rows next to their data; the lake turns them into tables.
    """


@lake.command('status', epilog=examples('lake status'))
@only_robot
@as_json
def lake_status(*, robot: str | None, as_json: bool) -> ExitCode:
    """Show what the tables contain, by robot.

    `waiting` counts row files that are not ingested yet.
    """
    with asking():
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.ingest import states  # noqa: PLC0415

        source, left_out = default_source(the_store_settings()), quietly()
        found = states(source, left_out, robot)
    if as_json:
        print_json([asdict(row) for row in found])
        return report_skipped(left_out)
    table = plain_table('', COLUMNS, ('robot', 'first', 'last'))
    table.title = None
    for row in found:
        counts = map(number, (row.objects, row.rows, row.waiting, row.rejected))
        table.add_row(plain(row.robot), number(row.days), row.first or '-', row.last or '-', *counts)
    print_page(table if found else plain(f'There are no rows yet in {source.describe()}.{store_hint()}'))
    return report_skipped(left_out)


@lake.command('ingest', epilog=examples('lake ingest', 'lake ingest --follow'))
@click.option('--follow', is_flag=True, help='Continue until Ctrl-C, with what is new.')
@click.option(
    '--interval', type=click.FloatRange(1.0), default=30.0, show_default=True, metavar='S', help='Seconds between two rounds.'
)
@click.option('--delete-after', type=Age(), metavar='AGE',
              help='Delete row files that were ingested AGE ago, such as 2h  [default: keep them]')  # fmt: skip
@as_json
def lake_ingest(*, follow: bool, interval: float, delete_after: int | None, as_json: bool) -> ExitCode:
    """Make tables of the rows that robots wrote.

    If the server has a bucket `lake`, the tables are there and shared by all readers, otherwise in this user's home. Each row
    is added exactly once, even if this is killed or several run at a time. Small files are merged and ordered by time.

    Exit code 1 when rows or files are rejected: each file is named.
    """
    with asking():
        from shadowhound_data_logger.lake import ingest as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.tables import Tables  # noqa: PLC0415

    source, left_out = default_source(the_store_settings()), quietly()
    grace = None if delete_after is None else timedelta(microseconds=delete_after / 1000)
    with asking():
        tables = Tables.for_ingest(source)
    while True:
        try:
            with asking():
                done = library.ingest(source, tables, left_out)
                tended = library.maintain(source, tables, left_out, grace=grace)
        except StoreUnavailable as error:
            if not follow:
                raise
            click.echo(str(error), err=True)
        else:
            if as_json:
                print_json({**asdict(done), **asdict(tended), 'tables': tables.root})
            elif not follow or done.files:
                click.echo(_about_ingest(done, tables.root))
        if not follow:
            return report_skipped(left_out)
        time.sleep(interval)


def _about_ingest(done: Ingested, root: str) -> str:
    if not done.files:
        return f'All row files are in the tables ({root}).'
    text = f'{counted(done.rows, "row")} of {counted(done.files, "file")} added to {root}'
    text += f'; {counted(done.rejected, "row")} rejected' * (done.rejected > 0)
    return text + f'; unknown columns of {counted(done.unknown, "row")} ignored' * (done.unknown > 0) + '.'


@lake.command('reindex', epilog=examples('lake reindex --robot thor'))
@click.option('--robot', metavar='NAME', required=True, help='The robot.')
@as_json
def lake_reindex(*, robot: str, as_json: bool) -> ExitCode:
    """Add objects that the catalog lacks.

    It lists the store and reads the metadata of each object without a row.
    """
    with asking():
        from shadowhound_data_logger.lake import reindex as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

    left_out = quietly()
    with the_store() as target, progress() as bar:
        source = default_source(the_store_settings())
        found = library.reindex(source, target, robot, findings=left_out, tell=lambda so_far: bar.say(
            f'{number(so_far.listed)} objects listed, {number(so_far.added)} added'))  # fmt: skip
    if as_json:
        print_json(asdict(found))
    else:
        click.echo(f'{number(found.listed)} objects are in the store; {number(found.added)} were not in the catalog and are now.')
        if found.gone:
            click.echo(f'{number(found.gone)} rows name objects that are gone from the store.')
    return report_skipped(left_out)
