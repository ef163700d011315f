"""``shadowhound-data missions``: the missions logged on this machine, how far they are sent, and sending the rest."""

from __future__ import annotations

import csv
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

import click
from rich.console import Console, RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, exit_code, the_home
from shadowhound_data_logger.cli.output import (
    duration,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    shown_iso,
    value_table,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.untrusted import csv_cell
from shadowhound_data_logger.missions.child import Replayer
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder
from shadowhound_data_logger.missions.overview import (
    ACTIVE,
    MissionBrief,
    MissionOverview,
    export,
    find,
    is_sending,
    overview,
    overviews,
)

POLL_S: Final = 0.5
STYLES: Final = {'FINISHED': 'green', ACTIVE: 'cyan'}
"""By result; any other is red."""
COLUMNS: Final = ('time', 'kind', 'key', 'value', 'step', 'source')


def _folder(_: click.Context, __: click.Parameter, wanted: str) -> MissionFolder:
    found = find(the_home(), wanted)
    if not found:
        raise BadUsage(
            f'there is no mission or run with the id {wanted!r} on this machine', 'shadowhound-data missions list shows the ids'
        )
    if len(found) > 1:
        raise BadUsage(f'the ids of {len(found)} missions begin with {wanted!r}', 'give more of the id')
    return found[0]


_mission = click.argument('folder', metavar='ID', callback=_folder)


@click.group(epilog=examples('missions list', 'missions resume'))
def missions() -> None:
    """Show and send missions logged on this machine.

    ID is the id of a mission or of its MLflow run, or its first characters.
    """


@missions.command('list', epilog=examples('missions list'))
@as_json
def list_(*, as_json: bool) -> ExitCode:
    """List the missions, the newest last.

    Exit code 1 if a mission has ended and is not sent.
    """
    where = the_home()
    found = overviews(where)
    if as_json:
        print_json(as_plain(found))
    elif not found:
        click.echo(f'No mission has been logged in {where / MISSIONS} yet. SHADOWHOUND_HOME names the folder above it.')
    else:
        print_page(_table(found), *_verdict(found, is_sending=is_sending(where / MISSIONS)))
    return exit_code(finding=_late(found))


@missions.command(epilog=examples('missions show patrol_20251018_120000'))
@as_json
@_mission
def show(*, folder: MissionFolder, as_json: bool) -> ExitCode:
    """Show everything about one mission.

    Exit code 1 if it has ended and is not sent; the output shows what is left, and why.
    """
    found = overview(folder)
    if found is None:
        raise BadUsage(f'{folder.path} does not contain a mission', 'shadowhound-data missions list shows the missions')
    if as_json:
        print_json(as_plain(found))
    else:
        print_page(*_page(found))
    return exit_code(finding=_late([found]))


@missions.command(epilog=examples('missions resume --timeout 300'))
@click.option('--timeout', type=click.FloatRange(0.0, 1e7), default=60.0, show_default=True, metavar='S',
              help='Give up after S seconds.')  # fmt: skip
@click.option('--experiment', metavar='NAME', help='The MLflow experiment of new runs  [default: ROBOT_missions]')
@as_json
def resume(*, timeout: float, experiment: str | None, as_json: bool) -> ExitCode:
    """Send what is unsent, and wait for it.

    Exit code 1 if something is left after --timeout; sending continues for ten more minutes in the background.
    """
    where = the_home()
    robots = sorted({each.robot for each in _late(overviews(where))})
    if not robots:
        if as_json:
            print_json({'left': []})
        else:
            click.echo('Nothing is left to send.')
        return ExitCode.FINE
    if len(robots) > 1 and not experiment:
        raise BadUsage(f'these missions are of several robots: {", ".join(robots)}', 'add --experiment NAME')
    replayer = Replayer(where, experiment or f'{robots[0]}_missions', {'SHADOWHOUND_ROBOT': robots[0], **os.environ})
    replayer.start()
    replayer.wake()
    try:
        left = _wait(where, time.monotonic() + timeout)
    finally:
        replayer.release()
    if as_json:
        print_json({'left': as_plain(left)})
        return exit_code(finding=left)
    for each in left:
        print_page(*_reason(each), console=Console(highlight=False, stderr=True))
    click.echo(f'{number(len(left))} not sent within {timeout:g} s.' if left else 'All is sent.')
    return exit_code(finding=left)


@missions.command('export', epilog=examples('missions export patrol_20251018_120000 --format csv --to mission.csv'))
@click.option(
    '--format', 'kind', type=click.Choice(['json', 'csv']), default='json', show_default=True, help='Format of the output.'
)
@click.option('--to', type=click.File('w', encoding='utf-8', lazy=True), default='-', metavar='FILE',
              help='Where to write it  [default: standard output]')  # fmt: skip
@as_json
@_mission
def export_(*, folder: MissionFolder, kind: str, to: IO[str], as_json: bool) -> ExitCode:
    """Write one mission to JSON or CSV.

    It writes all points, events and parameters that were logged on this machine, without MLflow.
    """
    found = export(folder)
    if as_json or kind == 'json':
        json.dump(found, to, indent=2)
        to.write('\n')
    else:
        rows = csv.writer(to, lineterminator='\n')
        rows.writerow(COLUMNS)
        rows.writerows(map(csv_cell, row) for row in _rows(found))
    return ExitCode.FINE


def _rows(found: Mapping[str, Any]) -> Iterator[tuple[object, ...]]:
    started = found['params'].get('timestamp', '')
    yield from ((started, 'param', name, value, '', 'agent') for name, value in found['params'].items())
    for point in found['points']:
        yield iso(point['time_ms'] * 1_000_000), 'metric', point['key'], point['value'], point['step'], point['source']
    for event in found['events']:
        yield event['time'], 'event', event['name'], json.dumps(event['data']), '', 'agent'


def _late(found: Sequence[MissionBrief]) -> list[MissionBrief]:
    """The ended missions that are not sent."""
    return [each for each in found if each.result != ACTIVE and not each.complete]


def _wait(where: Path, end_s: float) -> list[MissionBrief]:
    """Returns what is left."""
    with progress(of='seconds') as bar:
        while (left := _late(overviews(where))) and time.monotonic() < end_s:
            records = sum(each.unsent['records'] for each in left)
            bar.say(f'{number(len(left))} missions, {number(records)} records to send')
            time.sleep(POLL_S)
    return left


def _table(found: Sequence[MissionBrief]) -> RenderableType:
    left = ('mission', 'type', 'started', 'result', 'run')
    table = plain_table(
        'Missions', ('mission', 'type', 'started', 'duration', 'result', 'unsent', 'run'), left, minor=('run', 'type', 'duration')
    )
    for each in found:
        table.add_row(plain(each.mission_id), plain(each.type), shown_iso(each.started), duration(each.duration_s),
                      _result(each), _unsent(each), plain(each.run_id or '-'))  # fmt: skip
    return table


def _verdict(found: Sequence[MissionBrief], *, is_sending: bool) -> Iterator[RenderableType]:
    late = _late(found)
    if late:
        how = 'being sent' if is_sending else 'shadowhound-data missions resume sends it'
        yield ''
        yield Text(f'{number(len(late))} not completely sent: {how}', 'yellow')
        yield from _reason(late[-1])


def _page(found: MissionOverview) -> Iterator[RenderableType]:
    yield Text.assemble(plain(found.mission_id, 'bold'), '  ', _result(found))
    lines = {
        'type': found.type, 'command': found.command, 'robot': found.robot, 'policy': found.policies or '-',
        'started': shown_iso(found.started),
        'ended': shown_iso(found.ended) if found.ended else '-', 'duration': duration(found.duration_s),
        'distance': '-' if found.distance_m is None else f'{found.distance_m:.2f} m',
        'battery used': '-' if found.battery_consumed_pct is None else f'{found.battery_consumed_pct:.1f} %',
        'MLflow run': found.run_id or '-', 'folder': found.folder,
    }  # fmt: skip
    yield value_table('', lines)
    yield ''
    yield value_table('Logged', {name.replace('_', ' '): number(count) for name, count in found.counts.items()})
    if found.last:
        yield ''
        yield value_table('Last values', {name: f'{value:g}' for name, value in found.last.items()})
    yield from (plain(f'Error: {error}', 'red') for error in found.errors)
    yield from (plain(f'Not logged: {count} by {reason}', 'yellow') for reason, count in found.refused.items())
    yield ''
    yield from _reason(found)


def _reason(found: MissionBrief) -> Iterator[RenderableType]:
    """Whether it is sent; otherwise what is left, and why."""
    if found.complete:
        yield Text.assemble(('Sent', 'green'), ': everything is in the run and the spool.')
    else:
        unsent = ', '.join(f'{number(count)} {name}' for name, count in found.unsent.items() if count) or 'the end of it'
        yield plain(f'{found.mission_id}: not sent yet: {unsent}', 'yellow')
    if found.refused_by_server:
        yield plain(f'Refused by the tracking server: {number(found.refused_by_server)}', 'red')
    if found.last_error:
        yield plain(f'Last error: {found.last_error}', 'red' if found.complete else 'yellow')


def _result(found: MissionBrief) -> Text:
    return plain(found.result, STYLES.get(found.result, 'red'))


def _unsent(found: MissionBrief) -> str:
    return '-' if found.complete else number(sum(found.unsent.values()))
