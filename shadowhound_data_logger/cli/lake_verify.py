"""``shadowhound-data lake verify``: whether the store has what its catalogue says, and that of the store it was moved from."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import Console
from rich.text import Text

from shadowhound_data_logger.cli.question import asking, question, quietly, settings, tell_left_out
from shadowhound_data_logger.cli.tables import duration, number, plain, show_whole
from shadowhound_data_logger.cli.verify import findings, piles, progress
from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.ship.audit import KINDS, Audit, audit
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.verify import Rows

THREADS: Final = 16
UNLISTED: Final = 'unlisted'
WORDS: Final = {**KINDS, UNLISTED: "not in the store's own catalogue; `lake reindex` adds those that are there"}


@click.command()
@question
@click.option('--catalogue', type=click.Path(exists=True, file_okay=False, path_type=Path), metavar='DIR',
              help='Of another store, as `fetch ROBOT/_catalog/ --to DIR` brought it.')  # fmt: skip
@click.option('--deep', is_flag=True, help='Read every object back.')
@click.option('--threads', type=click.IntRange(1, 256), default=THREADS, show_default=True, help='Objects at a time.')
@click.option('--json', 'as_json', is_flag=True, help='Print it as JSON, with all keys.')
def verify(*, flags: Mapping[str, Any], catalogue: Path | None, deep: bool, threads: int, as_json: bool) -> int:
    """Ask the store for every object of the catalogue: is it there, with its size and checksum?

    All objects, or those that the flags ask for. Of a store that was moved, name the catalogue of the old one as well: what the
    new one lost of its own is found only so. Exit code 1 when something is not as the catalogue says, or when it says nothing.
    """
    if catalogue and 'success' in flags:
        raise click.UsageError('which missions failed is not in a catalogue: --failed and --succeeded do not go with --catalogue')
    with asking():
        from shadowhound_data_logger.lake import query, selecting  # noqa: PLC0415 - Daft takes half a second
        from shadowhound_data_logger.lake import verify as library  # noqa: PLC0415

        store = settings()
        begun_s = time.monotonic()
        left_out = quietly()
        own = library.rows(query.default_source(store), left_out, **flags)
        theirs = library.rows(selecting.fetched(catalogue), left_out, **flags) if catalogue else own
        if not len(theirs) and catalogue:
            raise click.UsageError(f'there are no rows in {catalogue}: `shadowhound-data fetch ROBOT/_catalog/ --to {catalogue}`')
        rows, lacking = (theirs.joined(own), theirs.lacking(own)) if catalogue else (own, [])
    with closing(open_store(store, UploadSettings())) as target, progress() as bar:
        task = bar.add_task('read back' if deep else 'asked for', total=len(rows))
        asked = library.Asked(store, target.probe)
        found = audit(rows, asked, deep=deep, threads=threads, keys=None, tell=lambda: bar.advance(task))
        where = target.describe()
    said = {'store': where, 'catalogue': catalogue and str(catalogue), **_said(rows, found, lacking, deep=deep)}
    said['took_s'] = round(time.monotonic() - begun_s, 3)
    said['left_out'] = [asdict(one) for one in left_out]
    said['ok'] = said['ok'] and not said['left_out']
    if as_json:
        click.echo(json.dumps(said, indent=2))
    else:
        _show(said)
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


def _show(said: Mapping[str, Any]) -> None:
    by = f'its own catalogue and the one in {said["catalogue"]}' if said['catalogue'] else 'its own catalogue'
    asked = f'{said["store"]} was asked for {number(said["asked"])} of the {number(said["known"])} objects of {by}'
    lines: list[Any] = [plain(f'{asked}, in {duration(said["took_s"])}.')]
    if said['unproved']:
        lines.append(plain(f'Of {number(said["unproved"])} no checksum is known: their sizes are compared alone.', 'yellow'))
    show_whole([*lines, *piles(said['findings'], WORDS), '', _verdict(said)], Console(highlight=False))


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
