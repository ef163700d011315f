"""``shadowhound-data spool``: what waits on this machine, deliver it without a node, and try again what was quarantined."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Final

import click
from rich.console import Console, RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.tables import duration, number, plain, plain_table, show_whole, volume
from shadowhound_data_logger.clock import EARLIEST_SANE_NS, SECOND, Clock, SystemClock, iso
from shadowhound_data_logger.config import home
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool.index import MISSING, Index
from shadowhound_data_logger.spool.listing import HERE, Heap, heaps, objects
from shadowhound_data_logger.spool.listing import retry as retry_objects
from shadowhound_data_logger.spool.status import read, robots

MOST: Final = 1000
STYLES: Final = {State.HELD.value: 'yellow', State.QUARANTINED.value: 'red'}
_as_json = click.option('--json', 'as_json', is_flag=True, help='Print it as JSON.')


@click.group(invoke_without_command=True)
@click.option('--spool', type=click.Path(path_type=Path, file_okay=False), help='The spool  [default: $SHADOWHOUND_HOME/spool]')
@_as_json
@click.pass_context
def spool(context: click.Context, *, spool: Path | None, as_json: bool) -> int:
    """What lies on this machine and is not in the store: how much, how old, and why.

    It reads the spool while a node runs and when none does. Exit code 1 when something is quarantined.
    """
    context.obj = folder = (spool or home(os.environ) / 'spool').absolute()
    return 0 if context.invoked_subcommand else _overview(folder, as_json=as_json)


@spool.command('list')
@click.argument('prefix', default='', metavar='[BUCKET/PREFIX]')
@click.option('--state', type=click.Choice([state.value for state in HERE]), help='Only these.')
@click.option('--sensor', help='Only of this sensor.')
@click.option('--limit', type=click.IntRange(1), default=MOST, show_default=True, help='So many at most, the oldest first.')
@_as_json
@click.pass_obj
def list_(folder: Path, *, prefix: str, state: str | None, sensor: str | None, limit: int, as_json: bool) -> int:
    """Each object, the oldest first: its bucket and key, its state, and where its file lies below the spool."""
    with _opened(folder) as index:
        found = objects(index, folder, state=State(state) if state else None, sensor=sensor, prefix=prefix)
        rows, more = list(islice(found, limit)), next(found, None) is not None
    if as_json:
        click.echo(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        table = plain_table('', ('object', 'state', 'size', 'file'), left=('object', 'state', 'file'))
        for row in rows:
            table.add_row(plain(f'{row.bucket}/{row.key}'), _state(row.state, row.reason), volume(row.bytes), plain(row.path))
        show_whole([table if rows else Text('Nothing.')], Console(highlight=False))
    if more:
        click.echo(f'... there are more than {number(limit)}: --limit', err=True)
    return 0


@spool.command()
@click.option('--patience', type=click.FloatRange(1.0, 1e6), default=60.0, show_default=True,
              help='Seconds in which nothing gets on after which it gives up.')  # fmt: skip
@_as_json
@click.pass_obj
def drain(folder: Path, *, patience: float, as_json: bool) -> int:
    """Deliver all that waits, where no node runs to do it: before a robot is put away, or from the disk of one that is broken.

    The store is the one that the environment names. Each object is verified as by the node, and gets its row in the catalogue.
    Exit code 1 when something of that is left or refused. Ctrl-C loses nothing.
    """
    from shadowhound_data_logger.cli.spool_drain import drain_all  # noqa: PLC0415 - the other verbs need no store

    _check(folder)
    return drain_all(folder, patience_s=patience, as_json=as_json)


@spool.command()
@click.argument('names', nargs=-1, metavar='[BUCKET/KEY]...')
@click.option('--reason', help='Only those quarantined for this reason, such as access_denied.')
@_as_json
@click.pass_obj
def retry(folder: Path, *, names: Sequence[str], reason: str | None, as_json: bool) -> int:
    """Let what was quarantined wait for delivery again, once the cause is gone: all of it, or these objects.

    A node that runs tries them at once; without one, `shadowhound-data spool drain` does.
    """
    try:
        done = retry_objects(folder, reason=reason, names=frozenset(names))
    except (OSError, sqlite3.Error) as error:
        remedy = 'is it yours, and its disk neither full nor read-only?'
        raise SpoolError(f'the spool {folder} cannot be changed: {error}', remedy=remedy) from error
    if as_json:
        click.echo(json.dumps(asdict(done), indent=2))
    else:
        click.echo(f'{number(done.objects)} objects ({volume(done.bytes)}) wait for delivery again')
        if done.gone:
            click.echo(f'{number(done.gone)} are not there any more')
    return 1 if done.gone or (names and done.objects < len(frozenset(names))) else 0


def _overview(folder: Path, *, as_json: bool) -> int:
    clock = SystemClock.of_this_machine()
    with _opened(folder) as index:
        found = heaps(index)
    running = [name for name in robots(folder) if read(folder, name, clock)['running']]
    quarantined = sum(heap.objects for heap in found if heap.state == State.QUARANTINED.value)
    if as_json:
        said = [{**asdict(heap), 'oldest': iso(heap.oldest_ns)} for heap in found]
        click.echo(json.dumps({'spool': str(folder), 'running': running, 'heaps': said, 'quarantined': quarantined}, indent=2))
    else:
        show_whole(list(_view(folder, found, running, clock)), Console(highlight=False))
    return 1 if quarantined else 0


def _view(folder: Path, found: Sequence[Heap], running: Sequence[str], clock: Clock) -> Iterator[RenderableType]:
    """A table, and what can be done about what is in it."""
    if not found:
        yield plain(f'Nothing waits in {folder}: all that was spooled has left it.', 'green')
        return
    yield plain(f'In {folder}', 'bold')
    table = plain_table('', ('sensor', 'state', 'objects', 'size', 'oldest'), left=('sensor', 'state'))
    now_ns = clock.wall_ns()
    for heap in found:
        is_known = EARLIEST_SANE_NS <= heap.oldest_ns <= now_ns
        age = duration((now_ns - heap.oldest_ns) / SECOND) if is_known else '-'
        table.add_row(plain(heap.sensor), _state(heap.state, heap.reason), number(heap.objects), volume(heap.bytes), age)
    if len(found) > 1:
        table.add_section()
        table.add_row('all', '', number(sum(heap.objects for heap in found)), volume(sum(heap.bytes for heap in found)), '')
    yield table
    for advice in _advice({(heap.state, heap.reason) for heap in found}, running):
        yield from ('', advice)


def _advice(what: set[tuple[str, str | None]], running: Sequence[str]) -> Iterator[Text]:
    reasons = sorted(reason or '' for state, reason in what if state == State.QUARANTINED.value)
    if (State.PENDING.value, None) in what and not running:
        yield plain('No node runs here. Start one, or: shadowhound-data spool drain')
    for reason in reasons:
        if reason == MISSING:
            yield plain('missing: somebody took these files out of the spool; they are tried again where they come back.')
        else:
            yield plain(f'{reason}: once the cause is gone, shadowhound-data spool retry --reason {reason}')
    if any(state == State.HELD.value and reason == 'clock' for state, reason in what):
        yield plain('held: clock: these wait for their date, until the clock of this machine is set.')
    if any(state == State.HELD.value and (reason or '').startswith('mission-') for state, reason in what):
        yield plain('held: mission-...: these wait for their run in MLflow: shadowhound-data missions')


def _state(state: str, reason: str | None) -> Text:
    return plain(f'{state}: {reason}' if reason else state, STYLES.get(state, ''))


def _check(folder: Path) -> None:
    if not (folder / 'index.db').is_file():
        remedy = 'SHADOWHOUND_HOME names the folder that it lies in; has the node run here?'
        raise SpoolError(f'there is no spool in {folder}', remedy=remedy)


@contextmanager
def _opened(folder: Path) -> Iterator[Index]:
    """The index, to be read."""
    _check(folder)
    index = Index(folder / 'index.db', read_only=True)
    try:
        index.open()
        with closing(index):
            yield index
    except (OSError, sqlite3.Error) as error:
        raise SpoolError(f'the spool {folder} cannot be read: {error}') from error
