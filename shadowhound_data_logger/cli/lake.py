"""``shadowhound-data lake``: the catalogue itself: how it lies in the store, made smaller, made anew, compared with the store."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.text import Text

from shadowhound_data_logger.cli.audit import finding_lines, findings
from shadowhound_data_logger.cli.common import as_json, the_store, the_store_settings
from shadowhound_data_logger.cli.output import duration, number, plain, plain_table, print_json, print_page, progress, volume
from shadowhound_data_logger.cli.question import asking, question, quietly, tell_left_out
from shadowhound_data_logger.clock import SystemClock, utc
from shadowhound_data_logger.ship.audit import KINDS, Audit, audit
from shadowhound_data_logger.stores import open_reader
from shadowhound_data_logger.times import moment

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.verify import Rows

UNLISTED: Final = 'unlisted'
WORDS: Final = {**KINDS, UNLISTED: "not in the store's own catalogue; `lake reindex` adds those that are there"}
COLUMNS: Final = ('robot', 'days', 'first', 'last', 'files', 'size', 'compacted', 'to compact', 'stood for')
_robot = click.option('--robot', metavar='NAME', help='Of this robot alone.')


@click.group()
def lake() -> None:
    """The catalogue of what is stored, in the store itself: BUCKET/ROBOT/_catalog/."""


@lake.command('status')
@_robot
@as_json
def lake_status(*, robot: str | None, as_json: bool) -> int:
    """How many files the catalogue has, of which days, and what compacting would do."""
    with asking():
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.standing import state  # noqa: PLC0415

    source = default_source(the_store_settings())
    left_out = quietly()
    found = state(source, robot, left_out)
    if as_json:
        print_json([asdict(row) for row in found])
        return tell_left_out(left_out)
    table = plain_table('', COLUMNS, ('robot', 'first', 'last'))
    table.title = None
    for row in found:
        counts = (row.files, row.size, row.compacted, row.open_days, row.covered)
        table.add_row(plain(row.robot), number(row.days), row.first, row.last, number(counts[0]), volume(counts[1]),
                      *map(number, counts[2:]))  # fmt: skip
    print_page(table if found else plain(f'There is no catalogue yet in {source.describe()}.'))
    return tell_left_out(left_out)


@lake.command('compact')
@_robot
@click.option('--before', metavar='DATE', help='Days earlier than this  [default: today, UTC]')
@click.option('--keep', is_flag=True, help='Delete nothing.')
@click.option('--grace', type=click.FloatRange(0.0), default=60.0, show_default=True, metavar='MIN',
              help='How long files stay that a compacted one stands for: somebody may be reading them.')  # fmt: skip
@as_json
def lake_compact(*, robot: str | None, before: str | None, keep: bool, grace: float, as_json: bool) -> int:
    """Make one file of the many of each day that is over, and delete those that an earlier run made one of.

    Exit code 1 when a file is no part of a catalogue, or has rows that are not its robot's: it is named and stays as it is.
    """
    found = []
    with asking():
        before = before and f'{utc(moment("--before", before, SystemClock.of_this_machine().wall_ns())):%Y-%m-%d}'
        from shadowhound_data_logger.lake import compact as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415

    left_out = quietly()
    how: dict[str, Any] = {'robot': robot, 'before': before or '', 'grace': None if keep else timedelta(minutes=grace)}
    with the_store() as target, progress() as bar:
        for day in library.compact(default_source(the_store_settings()), target, findings=left_out, **how):
            found.append(day)
            bar.say(f'{day.robot} {day.date}')
    if as_json:
        print_json([asdict(day) for day in found])
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


@lake.command('reindex')
@click.option('--robot', metavar='NAME', required=True, help='Whose objects.')
@as_json
def lake_reindex(*, robot: str, as_json: bool) -> int:
    """Add what the catalogue lacks, by listing the store and asking each object that is missing."""
    with asking():
        from shadowhound_data_logger.lake import reindex as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.query import default_source  # noqa: PLC0415

    left_out = quietly()
    with the_store() as target, progress() as bar:
        source = default_source(the_store_settings())
        found = library.reindex(source, target, robot, findings=left_out, tell=lambda so_far: bar.say(
            f'{number(so_far.listed)} objects listed, {number(so_far.added)} added'))  # fmt: skip
    if as_json:
        print_json(asdict(found))
    else:
        click.echo(
            f'{number(found.listed)} objects are in the store; {number(found.added)} were not in the catalogue and are now.'
        )
        if found.gone:
            click.echo(f'{number(found.gone)} rows name objects that are gone from the store.')
    return tell_left_out(left_out)


@lake.command('verify')
@question
@click.option('--catalogue', type=click.Path(exists=True, file_okay=False, path_type=Path), metavar='DIR',
              help='Of another store, as `fetch ROBOT/_catalog/ --to DIR` brought it.')  # fmt: skip
@click.option('--deep', is_flag=True, help='Read every object back.')
@click.option('--threads', type=click.IntRange(1, 256), default=16, show_default=True, help='Objects at a time.')
@as_json
def lake_verify(*, flags: Mapping[str, Any], catalogue: Path | None, deep: bool, threads: int, as_json: bool) -> int:
    """Ask the store for every object of the catalogue: is it there, with its size and checksum?

    All objects, or those that the flags ask for. Of a store that was moved, name the catalogue of the old one as well: what the
    new one lost of its own is found only so. Exit code 1 when something is not as the catalogue says, or when it says nothing.
    """
    if catalogue and 'success' in flags:
        raise click.UsageError('which missions failed is not in a catalogue: --failed and --succeeded do not go with --catalogue')
    with asking():
        from shadowhound_data_logger.lake import query, selecting  # noqa: PLC0415 - Daft takes half a second
        from shadowhound_data_logger.lake import verify as library  # noqa: PLC0415

        store = the_store_settings()
        begun_s = time.monotonic()
        left_out = quietly()
        own = library.rows(query.default_source(store), left_out, **flags)
        theirs = library.rows(selecting.fetched(catalogue), left_out, **flags) if catalogue else own
        if not len(theirs) and catalogue:
            raise click.UsageError(f'there are no rows in {catalogue}: `shadowhound-data fetch ROBOT/_catalog/ --to {catalogue}`')
        rows, lacking = (theirs.joined(own), theirs.lacking(own)) if catalogue else (own, [])
    with closing(open_reader(store)) as target, progress('read back' if deep else 'asked for', len(rows), of='objects') as bar:
        found = audit(rows, target, deep=deep, threads=threads, keys=None, tell=bar.have)
        where = target.describe()
    said = {'store': where, 'catalogue': catalogue and str(catalogue), **_said(rows, found, lacking, deep=deep)}
    said['took_s'] = round(time.monotonic() - begun_s, 3)
    said['left_out'] = [asdict(one) for one in left_out]
    said['ok'] = said['ok'] and not said['left_out']
    if as_json:
        print_json(said)
    else:
        print_page(*_page(said))
        tell_left_out(left_out)
    return 0 if said['ok'] else 1


def _said(rows: Rows, found: Audit, lacking: list[Any], *, deep: bool) -> dict[str, Any]:
    piled = findings(found)
    if lacking:
        first = [{'bucket': one.bucket, 'key': one.key, 'detail': f'{one.size} bytes'} for one in lacking]
        piled[UNLISTED] = {'count': len(first), 'first': first}
    return {
        'deep': deep, 'known': len(rows), 'asked': found.asked, 'sound': found.sound, 'unproved': rows.unproved(),
        'findings': piled, 'unreachable': None if found.away is None else str(found.away),
        'ok': found.away is None and not piled and len(rows) > 0,
    }  # fmt: skip


def _page(said: Mapping[str, Any]) -> list[Any]:
    by = f'its own catalogue and the one in {said["catalogue"]}' if said['catalogue'] else 'its own catalogue'
    asked = f'{said["store"]} was asked for {number(said["asked"])} of the {number(said["known"])} objects of {by}'
    lines: list[Any] = [plain(f'{asked}, in {duration(said["took_s"])}.')]
    if said['unproved']:
        lines.append(plain(f'Of {number(said["unproved"])} no checksum is known: their sizes are compared alone.', 'yellow'))
    return [*lines, *finding_lines(said['findings'], WORDS), '', _verdict(said)]


def _verdict(said: Mapping[str, Any]) -> Text:
    how = 'every byte read back' if said['deep'] else 'by size and checksum'
    if said['unreachable']:
        left = plain(f': {said["unreachable"]}. {number(said["known"] - said["asked"])} objects are not asked for.')
        return Text.assemble(('The store is away', 'yellow'), left)
    if not said['known']:
        return Text.assemble(('Nothing is verified', 'yellow'), ': the catalogue has no such objects.')
    if said['ok']:
        return Text.assemble(('All of them are there', 'green'), f', {how}.')
    if not said['findings']:
        return Text.assemble(('All that it tells of are there', 'yellow'), f', {how}; but it is not whole.')
    wrong = len({(one['bucket'], one['key']) for piled in said['findings'].values() for one in piled['first']})
    return Text.assemble((f'{number(wrong)} are not as the catalogue says', 'red'), f', {how}.')
