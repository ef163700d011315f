"""``shadowhound-data spool``: what waits on this machine, deliver it without a node, and try again what was quarantined."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any, Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.common import ExitCode, as_json, examples, exit_code, spool_folder, the_spool
from shadowhound_data_logger.cli.output import counted, duration, number, plain, plain_table, print_json, print_page, volume
from shadowhound_data_logger.cli.progress import ProgressBar, progress
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock, SystemClock, iso
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.uploader import Uploader, UploadStatus, delivering
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.listing import STATES_IN_SPOOL, SensorUsage, objects, usage_by_sensor
from shadowhound_data_logger.spool.listing import resend_gaps as resend_all_gaps
from shadowhound_data_logger.spool.listing import retry as retry_objects
from shadowhound_data_logger.spool.local_robot import robots
from shadowhound_data_logger.spool.object_table import MISSING
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import limits, targets
from shadowhound_data_logger.spool.status import read as read_status
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store

MOST: Final = 1000
LOOK_S: Final = 0.2
CLOSE_S: Final = 5.0
OTHER: Final = 'another process delivers from this spool: look at it with shadowhound-data status'
"""What holds the drain lock is a node, or for a moment a mission agent."""
STYLES: Final = {State.HELD.value: 'yellow', State.QUARANTINED.value: 'red'}


@click.group(invoke_without_command=True, epilog=examples('spool', 'spool drain'))
@spool_folder
@as_json
@click.pass_context
def spool(context: click.Context, *, spool: Path | None, as_json: bool) -> ExitCode:
    """Show what is not in the store yet, and why.

    It works whether or not a node runs. Exit code 1 if something is quarantined.
    """
    context.obj = folder = the_spool(spool).absolute()
    return ExitCode.FINE if context.invoked_subcommand else _overview(folder, as_json=as_json)


@spool.command(
    'list',
    epilog=examples('spool list --state quarantined', 'spool list sensor-data/thor/camera/'),
)
@click.argument('prefix', default='', metavar='[BUCKET/PREFIX]')
@click.option('--state', type=click.Choice([state.value for state in STATES_IN_SPOOL]), help='Only objects in this state.')
@click.option('--sensor', metavar='NAME', help='Only of this sensor.')
@click.option('--limit', type=click.IntRange(1), default=MOST, show_default=True, help='At most N results.', metavar='N')
@as_json
@click.pass_obj
def list_(folder: Path, *, prefix: str, state: str | None, sensor: str | None, limit: int, as_json: bool) -> ExitCode:
    """List the objects, the oldest first.

    It shows the bucket and key, the state, and the file in the spool of each object.
    """
    with _opened(folder) as index:
        found = objects(index, folder, state=State(state) if state else None, sensor=sensor, prefix=prefix)
        rows, more = list(islice(found, limit)), next(found, None) is not None
    if as_json:
        print_json([asdict(row) for row in rows])
    else:
        table = plain_table('', ('object', 'state', 'size', 'file'), left=('object', 'state', 'file'))
        for row in rows:
            table.add_row(plain(f'{row.bucket}/{row.key}'), _state(row.state, row.reason), volume(row.bytes), plain(row.path))
        such = 'such ' if state or sensor or prefix else ''
        print_page(table if rows else plain(f'There are no {such}objects in {folder}.'))
    if more:
        click.echo(f'... there are more than {number(limit)}: --limit', err=True)
    return ExitCode.FINE


@spool.command(epilog=examples('spool drain', 'spool --spool /mnt/dead_robot/spool drain'))
@click.option('--idle-timeout', type=click.FloatRange(1.0, 1e6), default=60.0, show_default=True, metavar='S',
              help='Give up after S seconds without progress.')  # fmt: skip
@as_json
@click.pass_obj
def drain(folder: Path, *, idle_timeout: float, as_json: bool) -> ExitCode:
    """Upload everything that waits, without a node.

    Use it before a robot is put away, or with the disk of a broken one. It needs the AWS_... variables of the node; without
    them the store is a folder. Each object is verified as by the node and gets its row in the catalog. Exit code 1 if objects
    remain or were rejected. Ctrl-C loses nothing.
    """
    _check(folder)
    return _drain(folder, patience_s=idle_timeout, as_json=as_json)


@spool.command(epilog=examples('spool retry', 'spool retry --reason access_denied'))
@click.argument('names', nargs=-1, metavar='[BUCKET/KEY]...')
@click.option('--reason', help='Only those quarantined for this reason, such as access_denied.')
@as_json
@click.pass_obj
def retry(folder: Path, *, names: Sequence[str], reason: str | None, as_json: bool) -> ExitCode:
    """Retry quarantined objects once the cause is fixed.

    It retries all of them, or those that are named.

    A running node retries them immediately; without a node, run `shadowhound-data spool drain`.
    """
    try:
        done = retry_objects(folder, reason=reason, names=frozenset(names))
    except (OSError, sqlite3.Error) as error:
        remedy = 'is it yours, and its disk neither full nor read-only?'
        raise SpoolError(f'the spool {folder} cannot be changed: {error}', remedy=remedy) from error
    if as_json:
        print_json(asdict(done))
    else:
        click.echo(f'{counted(done.objects, "object")} ({volume(done.bytes)}) will be tried again')
        if done.gone:
            click.echo(f'{counted(done.gone, "file")} no longer there')
    return exit_code(finding=done.gone or (names and done.objects < len(frozenset(names))))


@spool.command('resend-gaps', epilog=examples('spool resend-gaps'))
@as_json
@click.pass_obj
def resend_gaps(folder: Path, *, as_json: bool) -> ExitCode:
    """Send the gap journal to the store again.

    Use it if the store lost parts of it. A running node sends it within a minute (catalog.period_s). Gaps older than
    spool.remember_days cannot be sent again.
    """
    _check(folder)
    try:
        rows = resend_all_gaps(folder)
    except sqlite3.Error as error:
        remedy = 'is it yours, and its disk neither full nor read-only?'
        raise SpoolError(f'the spool {folder} cannot be changed: {error}', remedy=remedy) from error
    if as_json:
        print_json({'rows': rows})
    else:
        click.echo(f'{counted(rows, "row")} of the gap journal will be sent again with the next part')
    return ExitCode.FINE


def _overview(folder: Path, *, as_json: bool) -> ExitCode:
    clock = SystemClock.of_this_machine()
    with _opened(folder) as index:
        found = usage_by_sensor(index)
    running = [name for name in robots(folder) if read_status(folder, name, clock).running]
    quarantined = sum(usage.objects for usage in found if usage.state == State.QUARANTINED.value)
    if as_json:
        heaps = [{**asdict(usage), 'oldest': iso(usage.oldest_ns)} for usage in found]
        print_json({'spool': str(folder), 'running': running, 'heaps': heaps, 'quarantined': quarantined})
    else:
        print_page(*_view(folder, found, running, clock))
    return exit_code(finding=quarantined)


def _view(folder: Path, found: Sequence[SensorUsage], running: Sequence[str], clock: Clock) -> Iterator[RenderableType]:
    """A table, and what can be done about what is in it."""
    if not found:
        yield plain(f'Nothing waits in {folder}; what became of it: shadowhound-data ledger', 'green')
        return
    yield plain(f'In {folder}', 'bold')
    table = plain_table('', ('sensor', 'state', 'objects', 'size', 'oldest'), left=('sensor', 'state'))
    now_ns = clock.wall_ns()
    for usage in found:
        is_known = EARLIEST_SANE_NS <= usage.oldest_ns <= now_ns
        age = duration((now_ns - usage.oldest_ns) / SECOND) if is_known else '-'
        table.add_row(plain(usage.sensor), _state(usage.state, usage.reason), number(usage.objects), volume(usage.bytes), age)
    if len(found) > 1:
        table.add_section()
        table.add_row('all', '', number(sum(usage.objects for usage in found)), volume(sum(usage.bytes for usage in found)), '')
    yield table
    for advice in _advice({(usage.state, usage.reason) for usage in found}, running):
        yield from ('', advice)


def _advice(what: set[tuple[str, str | None]], running: Sequence[str]) -> Iterator[Text]:
    reasons = sorted(reason or '' for state, reason in what if state == State.QUARANTINED.value)
    if (State.PENDING.value, None) in what and not running:
        yield plain('No node runs here. Start one, or: shadowhound-data spool drain')
    for reason in reasons:
        if reason == MISSING:
            yield plain('missing: these files were removed from the spool; they are tried again if they are restored.')
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
        remedy = 'has the node run here? SHADOWHOUND_HOME names its folder'
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


def _drain(folder: Path, *, patience_s: float, as_json: bool) -> ExitCode:
    """The exit code."""
    settings, clock = Settings.load({}, os.environ), SystemClock.of_this_machine()
    where = _destination(folder, settings)
    # A separate robot name: its session is not the node's, and it must not settle what the node left open.
    spool = Spool(folder, limits(folder, settings.spool), clock, f'{settings.robot} drain')
    spool.open()
    catalog = CatalogWriter(folder, settings.catalog, settings.robot, clock)
    try:
        with (
            closing(spool),
            delivering(spool, settings, CLOSE_S) as (uploader, writer),
            progress('delivered', spool.pending_count(), of='objects') as bar,
        ):
            _wait(spool, uploader, writer, catalog, patience_s, bar)
            writer.flush(CLOSE_S)
            report = {'store': where, **_drained(folder, spool, uploader.status())}
    except (OSError, sqlite3.Error) as error:
        raise SpoolError(f'the spool {folder} cannot be used: {error}') from error
    if as_json:
        print_json(report)
    else:
        click.echo(_drained_lines(report))
    return exit_code(finding=not report['ok'])


def _destination(folder: Path, settings: Settings) -> str:
    """The store of this shell. Raises SpoolError where that is a folder, and the node delivers to a server."""
    with closing(open_store(settings.store, settings.upload)) as store:
        where = store.describe()
    others = [target for target in targets(folder) if target != where]
    if others and not settings.store.endpoint_url:
        raise SpoolError(f'nothing was delivered: this shell names no server, and the node of this spool delivers to {others[0]}',
                         remedy="set the node's AWS_... variables, AWS_ENDPOINT_URL first")  # fmt: skip
    return where


def _wait(spool: Spool, uploader: Uploader, writer: SpoolWriter, catalog: CatalogWriter, patience_s: float,
          bar: ProgressBar) -> None:  # fmt: skip
    """Until everything that can be delivered is, including files of the catalog, or nothing was delivered for so many seconds."""
    done, sent, retries, moved_s = -1, 0, 0, time.monotonic()
    while time.monotonic() - moved_s < patience_s:
        is_drained = uploader.drain(LOOK_S)
        status = uploader.status()
        if status.delivered + status.quarantined > done:
            done, retries, moved_s = status.delivered + status.quarantined, status.retries, time.monotonic()
        elif status.sent_bytes > sent and status.retries == retries:  # a large one is under way, and none is sent in vain
            moved_s = time.monotonic()
        sent = status.sent_bytes
        what = 'delivered' if status.state in {'idle', 'shipping'} else status.state.replace('_', ' ')
        bar.begin(status.delivered + spool.pending_count())
        bar.say(what, done=status.delivered)
        if not is_drained:
            time.sleep(LOOK_S)  # it returns immediately if the store is unreachable
            continue
        parts = catalog.parts()
        for part in parts:
            writer.put(part)
        if not (parts and writer.flush(CLOSE_S)):
            return


def _drained(folder: Path, spool: Spool, status: UploadStatus) -> dict[str, Any]:
    usage = spool.usage()
    why = OTHER if status.state == 'not_draining' else status.last_error
    return {
        'spool': str(folder), 'delivered': status.delivered, 'pending': usage.pending, 'held': usage.held,
        'quarantined': usage.quarantined, 'newly_quarantined': status.quarantined,
        'last_error': why if usage.pending or status.quarantined else '', 'ok': not usage.pending and not status.quarantined,
    }  # fmt: skip


def _drained_lines(report: dict[str, Any]) -> str:
    lines = [f'{counted(report["delivered"], "object")} delivered to {report["store"]} and confirmed']
    if report['pending']:
        lines.append(f'{counted(report["pending"], "object")} still waiting: {report["last_error"] or "try again later"}')
    if report['held']:
        lines.append(f'{counted(report["held"], "object")} without a name yet (shadowhound-data spool)')
    if report['quarantined']:
        lines.append(f'{counted(report["quarantined"], "object")} quarantined (shadowhound-data spool)')
    return '\n'.join(lines)
