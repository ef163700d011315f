"""``shadowhound-data status``: what the node does now, once, as a live view, or as JSON."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from shadowhound_data_logger.cli.common import (
    ExitCode,
    as_json,
    examples,
    exit_code,
    robot_name,
    spool_folder,
    the_home,
    the_spool,
)
from shadowhound_data_logger.cli.output import (
    duration,
    figure,
    fit,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    share_bar,
    shown_iso,
    unsure,
    volume,
)
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock, SystemClock, utc
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import LIMITS, SANDBOX
from shadowhound_data_logger.policies.trust import follows_signers, why_stale
from shadowhound_data_logger.spool.gaps import EXACT
from shadowhound_data_logger.spool.status import FINE_STORE, NOT_RUNNING, NOT_RUNNING_TEXT, robots
from shadowhound_data_logger.spool.status import read as read_status

LOSSES: Final = ('dropped', 'rejected')
"""Columns that appear once there is something in them."""
_ISOLATIONS: Final = {SANDBOX: 'a sandbox', LIMITS: 'resource limits alone, without a sandbox'}
HEADS: Final = {'running': ('running', 'green'), 'not_answering': ('NOT ANSWERING', 'red'), 'not_running': ('not running', 'red')}


@click.command(epilog=examples('status', 'status --watch'))
@click.option('--watch', is_flag=True, help='Repeat until Ctrl-C: a live view, or with --json one line each time.')
@click.option(
    '--interval', type=click.FloatRange(0.05, 3600.0), default=1.0, show_default=True, help='Seconds between two updates.'
)
@as_json
@click.option(
    '--robot', envvar='SHADOWHOUND_ROBOT', callback=robot_name, help='Robot of the node  [default: the one that runs here]'
)
@spool_folder
def status(*, watch: bool, interval: float, as_json: bool, robot: str | None, spool: Path | None) -> ExitCode:
    """Show what the node on this machine does now.

    Rates and ages of its topics, its queue, spool, store and workers; when no node runs, what is in its spool. Exit code 1 when
    something needs attention: the node does not run, the store cannot be reached, messages were lost, objects were evicted. With
    --watch it is 0.
    """
    folder, clock = the_spool(spool), SystemClock.of_this_machine()

    def look() -> dict[str, Any]:
        return _look(folder, robot, clock)

    console = Console(highlight=False)
    if watch:
        _watch(look, console, interval, as_json=as_json)
        return ExitCode.FINE
    found = look()
    if as_json:
        print_json(found)
    else:
        print_page(*view(found, console), console=console)
    return exit_code(finding=found['findings'])


def _look(spool: Path, robot: str | None, clock: Clock) -> dict[str, Any]:
    """The robot asked for, else the first that runs, else the first there is; ``others`` are those that run as well."""
    names = [robot] if robot else robots(spool) or ['thor']
    found = [read_status(spool, name, clock) for name in names]
    chosen = next((each for each in found if each['running']), found[0])
    folder = PolicyFolder(the_home())
    if follows_signers(folder.path) and (stale := why_stale(folder.path, clock.wall_ns())):
        chosen['findings'].append(f'No new version of a policy is taken: {stale}.')
    if active := folder.current():
        chosen['policy'] = {'active': active, 'isolation': None}
        try:
            chosen['policy']['isolation'] = folder.state().verified.get(active)
        except PolicyError as error:
            chosen['findings'].append(str(error))
    return {**chosen, 'others': [each['robot'] for each in found if each['running'] and each is not chosen]}


def _watch(look: Callable[[], dict[str, Any]], console: Console, interval: float, *, as_json: bool) -> None:
    """Until Ctrl-C; on a terminal the last view stays on the screen."""
    try:
        if as_json or not console.is_terminal or console.is_dumb_terminal:
            while True:
                found = look()
                if as_json:
                    print_json(found, is_line=True)
                else:
                    print_page(*view(found, console), '', console=console)
                time.sleep(interval)
        with Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                parts = view(look(), console)
                fit(parts, console)
                live.update(Group(*parts), refresh=True)
                time.sleep(interval)
    except KeyboardInterrupt:
        if console.is_terminal and not as_json:
            print_page(*view(look(), console), console=console)


def view(found: Mapping[str, Any], console: Console) -> list[RenderableType]:
    """All there is to say, top down: who, topics, the way to the store, findings."""
    live = found['state'] != NOT_RUNNING
    parts: list[RenderableType] = [_head(found), '']
    if live:
        parts += [*_topics(found['topics'], found['middleware']['unheard'] or {}), '']
    if live and found.get('not_logged'):
        parts += [plain(f'Not logged: {", ".join(found["not_logged"])} (`ledger` says why)', 'dim'), '']
    if live or found['spool']:
        parts += [_way(found, console, live=live), '']
    if found.get('policy'):
        tested = found['policy']['isolation'] or 'an unknown isolation'
        parts += [plain(f'Active policy: {found["policy"]["active"]}, tested in {_ISOLATIONS.get(tested, tested)}'), '']
    if not live and found['spool']:
        parts.append(Text('What became of every message: shadowhound-data ledger', 'dim'))
    parts += [plain(line, 'yellow') for line in found['findings'] if live or line != NOT_RUNNING_TEXT]
    if not found['findings']:
        parts.append(Text(_fine(found['topics']), 'green'))
    if found['others']:
        parts.append(plain(f'Also running here: {", ".join(found["others"])} (--robot NAME)', 'dim'))
    return parts


def _fine(topics: Mapping[str, Any]) -> str:
    """Nothing to be looked at; what nobody can know is not called nothing."""
    heard = [row['accounting'] for row in topics.values() if row['received']]
    if not set(heard) - {EXACT}:
        return 'Fine: nothing missed, dropped, rejected, evicted or quarantined in this session.'
    return f'Fine: nothing dropped, rejected, evicted or quarantined in this session; what was missed is {unsure(heard)}.'


def _head(found: Mapping[str, Any]) -> Text:
    state, style = HEADS[found['state']]
    head = Text.assemble(plain(found['robot'], 'bold'), '  ', (state, style))
    if found['state'] == NOT_RUNNING:
        return head.append_text(plain(_ended(found['session'])))
    since = found['uptime_s'] if found['running'] else found['age_s']
    head.append_text(plain(f' for {duration(since)}, process {found["pid"]}, version {found["version"]}'))
    if found['paused']:
        head.append('  PAUSED', 'yellow')
    return head


def _ended(session: Mapping[str, Any] | None) -> str:
    if session is None:
        return '; it has not run here yet'
    began, ended = (stamp and shown_iso(stamp) for stamp in (session['started'], session['ended']))
    if ended:
        return f'; last session {began} to {ended} UTC'
    return f'; session of {began} UTC cut off, or just beginning'


def _topics(topics: Mapping[str, Any], unheard_of: Mapping[str, Any]) -> Iterator[RenderableType]:
    """The table of what arrives, and the names of what does not."""
    unheard = {topic: row for topic, row in topics.items() if not row['received']}
    silent = [topic for topic, row in unheard.items() if row['enabled'] and not row['publishers'] and topic not in unheard_of]
    off = [topic for topic, row in unheard.items() if not row['enabled']]
    rows = {topic: row for topic, row in topics.items() if topic not in (*silent, *off)}
    losses = [name for name in LOSSES if any(row[name] for row in rows.values())]
    table = plain_table('Messages of this session', ('topic', 'Hz', 'age', 'received', 'stored', 'missed', *losses))
    for topic, row in rows.items():
        rate = f'{row["rate_hz"]:,.1f}' if row['enabled'] else 'off'
        age = '-' if row['age_s'] is None else duration(row['age_s'])
        counts = (number(row[name]) for name in ('received', 'stored'))
        lost = (Text(figure(row, name), 'yellow' if row[name] or row.get(f'{name}_estimated') else '')
                for name in ('missed', *losses))  # fmt: skip
        table.add_row(plain(topic), rate, age, *counts, *lost)
    if rows:
        yield table
    for what, names in (('Nobody publishes', silent), ('Off:', off)):
        if names:
            yield plain(f'{what} {", ".join(names)}', 'dim')


def _way(found: Mapping[str, Any], console: Console, *, live: bool) -> Table:
    """Queue, spool, store, and the workers that fail, as lines under one another."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(style='bold', no_wrap=True)
    grid.add_column(no_wrap=True)
    grid.add_column(overflow='fold')
    if live:
        queue = found['queue']
        share = max(_share(queue['messages'], queue['max_messages']), _share(queue['bytes'], queue['max_bytes']))
        text = f'{queue["messages"]:,} of {queue["max_messages"]:,} messages, {volume(queue["bytes"])}'
        grid.add_row('queue', share_bar(share, console), text)
    if found['spool']:
        spool = found['spool']
        grid.add_row('spool', share_bar(_share(spool['bytes'], spool['max_bytes']), console), _disk(spool))
        grid.add_row('', '', _usage(spool))
    if live:
        _add_store(grid, found)
        if found.get('mission'):
            _add_mission(grid, found)
        if found.get('bag', {}).get('recording'):
            _add_bag(grid, found['bag'])
        if found.get('events', {}).get('enabled'):
            _add_events(grid, found['events'])
        for name, row in found['workers'].items():
            if row['failing']:
                grid.add_row(plain(name), Text('fails', 'red'), plain(f'{row["failures"]:,} times so far: {row["last_error"]}'))
            elif name in found['stalls']:
                grid.add_row(plain(name), Text('hangs', 'yellow'), f'for {duration(row["busy_s"])}')
            elif row['failures']:
                text = f'failed {row["failures"]:,} times and was started again, last: {row["last_error"]}'
                grid.add_row(plain(name), Text('works', 'green'), plain(text))
    return grid


def _disk(spool: Mapping[str, Any]) -> str:
    """``123.5 KB of 21.5 GB, 50.0 GB free``; the limit is a setting, which only a node tells."""
    limit = f' of {volume(spool["max_bytes"])}' if spool['max_bytes'] else ''
    free = '' if spool['free_bytes'] is None else f', the disk has {volume(spool["free_bytes"])} free'
    return f'{volume(spool["bytes"])}{limit}{free}'


def _usage(spool: Mapping[str, Any]) -> str:
    """``3 objects wait (oldest 0.4 s), 1 quarantined``."""
    oldest = '' if spool['oldest_age_s'] is None else f' (oldest {duration(spool["oldest_age_s"])})'
    usage = ''.join(f', {spool[name]:,} {name}' for name in ('held', 'kept', 'quarantined', 'evicted') if spool.get(name))
    return f'{spool["pending"]:,} objects wait{oldest}{usage}'


def _add_store(grid: Table, found: Mapping[str, Any]) -> None:
    store = found['store']
    fine = store['state'] in FINE_STORE
    cap = f' of {store["max_mbps"]:g}' if store['max_mbps'] else ''
    grid.add_row('store', plain(str(store['state']).replace('_', ' '), 'green' if fine else 'red'), plain(store['target']))
    left = '' if store.get('left_s') is None else f', all that waits arrives in {duration(store["left_s"])}'
    grid.add_row('', '', f'{store["delivered"]:,} delivered, {store["mbps"]:.1f}{cap} Mbit/s{left}')
    for name, why in store['waits_for'].items():
        grid.add_row('', '', plain(f'waits for {name}: {why}', 'yellow'))
    if store['last_error'] and (not fine or store['blocked_buckets']):
        grid.add_row('', '', plain(store['last_error'], 'yellow'))
    asked = found.get('requests', {})
    if asked.get('open'):
        left = f', which arrive in {duration(asked["left_s"])}' if asked['left_s'] is not None else ''
        grid.add_row('requests', '', f'{asked["open"]:,} open, for {volume(asked["bytes"])}{left}')


def _add_mission(grid: Table, found: Mapping[str, Any]) -> None:
    """The mission that is active, its type, since when, and its run."""
    mission = found['mission']
    began, now = (datetime.fromisoformat(stamp.replace('Z', '+00:00')) for stamp in (mission['started'], found['time']))
    since = f'since {shown_iso(mission["started"])} UTC, {duration((now - began).total_seconds())}'
    if began < utc(EARLIEST_SANE_NS):
        since = 'begun before the clock was set'
    grid.add_row('mission', Text('active', 'cyan'), plain(f'{mission["type"]}, {since}'))
    grid.add_row('', '', plain(mission['mission_id']))
    if mission.get('policy'):
        grid.add_row('', '', plain(f'policy {mission["policy"]}'))
    grid.add_row('', '', plain(f'MLflow run {mission["run_id"]}' if mission['run_id'] else 'no MLflow run yet'))


def _add_bag(grid: Table, bag: Mapping[str, Any]) -> None:
    """The bag that is recorded, how much is in it, and what is wrong with it."""
    state, style = ('stands still', 'red') if bag['refused'] else ('paused', 'yellow') if bag['paused'] else ('records', 'cyan')
    grid.add_row('bag', Text(state, style), plain(f'{bag["bag"]} for {duration(bag["duration_s"])}'))
    grid.add_row('', '', f'{bag["messages"]:,} messages, {volume(bag["bytes"])}, slice {bag["slice"]}')
    if bag['refused']:
        grid.add_row('', '', plain(f'the disk takes nothing: {bag["refused"]}', 'red'))
    if bag['dropped']:
        grid.add_row('', '', plain(f'{bag["dropped"]:,} messages dropped', 'yellow'))


def _add_events(grid: Table, events: Mapping[str, Any]) -> None:
    """What the ring has, what is written of it, and what triggered last."""
    state, style = ('stands still', 'red') if events['refused'] else ('writes', 'cyan') if events['bag'] else ('ready', 'green')
    what = events['bag'] or f'the last {duration(events["seconds"])} are kept'
    grid.add_row('events', Text(state, style), plain(what))
    grid.add_row('', '', f'{volume(events["bytes"])} of {volume(events["max_bytes"])} of memory, {events["written"]:,} written')
    if events['refused']:
        grid.add_row('', '', plain(f'the disk takes nothing: {events["refused"]}', 'red'))
    if events['last']:
        last = events['last']
        grid.add_row('', '', plain(f'last: {last["name"]} by {last["by"]}, {shown_iso(last["time"])} UTC'))


def _share(part: float, whole: float | None) -> float:
    return part / whole if whole else 0.0
