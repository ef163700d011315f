"""``shadowhound-data status``: what the node does now, once, as a live view, or as JSON."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
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
    fitted,
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
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock, SystemClock
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.core.status import BagStatus, EventStatus, NodeStatus, SpoolStatus, TopicStatus
from shadowhound_data_logger.core.times import iso_ns
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import LIMITS, SANDBOX
from shadowhound_data_logger.policies.trust import follows_signers, why_stale
from shadowhound_data_logger.spool.gaps import EXACT
from shadowhound_data_logger.spool.local_robot import robots
from shadowhound_data_logger.spool.status import FINE_STORE, NOT_RUNNING, NOT_RUNNING_TEXT, NodeReport, NodeSession
from shadowhound_data_logger.spool.status import read as read_status

LOSSES: Final = ('dropped', 'rejected')
"""Columns that appear once there is something in them."""
_ISOLATIONS: Final = {SANDBOX: 'a sandbox', LIMITS: 'resource limits alone, without a sandbox'}
HEADS: Final = {'running': ('running', 'green'), 'not_answering': ('NOT ANSWERING', 'red'), 'not_running': ('not running', 'red')}


@dataclass(frozen=True, slots=True)
class Page:
    """What the command shows."""

    report: NodeReport
    others: tuple[str, ...] = ()
    """Other robots whose nodes run here; if none runs, those whose nodes have run here."""
    policy: str | None = None
    """The active one."""
    isolation: str | None = None
    """In which the policy was tested; None if unknown."""

    def as_dict(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        policy = {'policy': {'active': self.policy, 'isolation': self.isolation}} if self.policy else {}
        return {**self.report.as_dict(), **policy, 'others': list(self.others)}


@click.command(epilog=examples('status', 'status --watch'))
@click.option('--watch', is_flag=True, help='Repeat until Ctrl-C: a live view, or with --json one line each time.')
@click.option(
    '--interval',
    type=click.FloatRange(0.05, 3600.0),
    default=1.0,
    show_default=True,
    metavar='S',
    help='Seconds between two rounds.',
)
@as_json
@click.option(
    '--robot',
    metavar='NAME',
    envvar='SHADOWHOUND_ROBOT',
    callback=robot_name,
    help='The robot  [default: the one that runs here]',
)
@spool_folder
def status(*, watch: bool, interval: float, as_json: bool, robot: str | None, spool: Path | None) -> ExitCode:
    """Show what the node on this machine is doing.

    It shows the rate and age of each topic, and the queue, spool, store and workers; if no node runs, the content of its
    spool. Exit code 1 if something needs attention: the node does not run, the store is unreachable, messages were lost, or
    objects were evicted. With --watch it is 0.
    """
    folder, clock = the_spool(spool), SystemClock.of_this_machine()

    def poll() -> Page:
        return _look(folder, robot, clock)

    console = Console(highlight=False)
    if watch:
        _watch(poll, console, interval, as_json=as_json)
        return ExitCode.FINE
    page = poll()
    if as_json:
        print_json(page.as_dict())
    else:
        print_page(*view(page, console), console=console)
    return exit_code(finding=page.report.findings)


def _look(spool: Path, robot: str | None, clock: Clock) -> Page:
    """The requested robot, or the first that runs, or the first that has a status."""
    names = [robot] if robot else robots(spool) or ['']
    found = [read_status(spool, name, clock) for name in names]
    chosen = next((each for each in found if each.running), found[0])
    others = tuple(each.robot for each in found if each.running == chosen.running and each is not chosen)
    folder = PolicyFolder(the_home())
    findings = list(chosen.findings)
    if follows_signers(folder.path) and (stale := why_stale(folder.path, clock.wall_ns())):
        findings.append(f'No new version of a policy is taken: {stale}.')
    active, isolation = folder.current(), None
    if active:
        try:
            isolation = folder.state.read().verified.get(active)
        except PolicyError as error:
            findings.append(str(error))
    return Page(replace(chosen, findings=tuple(findings)), others, active, isolation)


def _watch(poll: Callable[[], Page], console: Console, interval: float, *, as_json: bool) -> None:
    """Until Ctrl-C; on a terminal the last view stays on the screen."""
    try:
        if as_json or not console.is_terminal or console.is_dumb_terminal:
            while True:
                page = poll()
                if as_json:
                    print_json(page.as_dict(), is_line=True)
                else:
                    print_page(*view(page, console), '', console=console)
                time.sleep(interval)
        with Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                live.update(Group(*fitted(view(poll(), console), console)), refresh=True)
                time.sleep(interval)
    except KeyboardInterrupt:
        if console.is_terminal and not as_json:
            print_page(*view(poll(), console), console=console)


def view(page: Page, console: Console) -> list[RenderableType]:
    """The whole page, top down: the node, topics, the path to the store, findings."""
    report, node = page.report, page.report.node
    live = report.state != NOT_RUNNING
    parts: list[RenderableType] = [_head(report), '']
    if live:
        parts += [*_topics(node.topics, node.middleware.undiscovered or {}), '']
    if node.not_logged:
        parts += [plain(f'Not logged: {", ".join(node.not_logged)} (`ledger` says why)', 'dim'), '']
    if live or report.spool:
        parts += [_way(report, console, live=live), '']
    if page.policy:
        tested = page.isolation or 'an unknown isolation'
        parts += [plain(f'Active policy: {page.policy}, tested in {_ISOLATIONS.get(tested, tested)}'), '']
    if not live and report.spool:
        parts.append(Text('What became of every message: shadowhound-data ledger', 'dim'))
    parts += [plain(line, 'yellow') for line in report.findings if live or line != NOT_RUNNING_TEXT]
    if not report.findings:
        parts.append(Text(_fine(node.topics), 'green'))
    if page.others:
        also = 'Also running here' if report.running else 'Not running either'
        parts.append(plain(f'{also}: {", ".join(page.others)} (--robot NAME)', 'dim'))
    return parts


def _fine(topics: Mapping[str, TopicStatus]) -> str:
    """Nothing needs attention; unknown losses are not called none."""
    grades = [row.accounting or '' for row in topics.values() if row.received]
    if not grades:
        return 'No message has been received yet: `shadowhound-data doctor --only ros` finds out why.'
    if not set(grades) - {EXACT}:
        return 'Fine: nothing missed, dropped, rejected, evicted or quarantined in this session.'
    return f'Fine: nothing dropped, rejected, evicted or quarantined in this session; what was missed is {unsure(grades)}.'


def _head(report: NodeReport) -> Text:
    state, style = HEADS[report.state]
    node = report.node
    if not report.robot:
        return Text.assemble((state, style), '; no node has run here yet')
    head = Text.assemble(plain(report.robot, 'bold'), '  ', (state, style))
    if report.state == NOT_RUNNING:
        return head.append_text(plain(_ended(report.session)))
    since = node.uptime_s if report.running else report.age_s
    head.append_text(plain(f' for {duration(since or 0.0)}, process {node.pid}, version {node.version}'))
    if node.paused:
        head.append('  PAUSED', 'yellow')
    return head


def _ended(session: NodeSession | None) -> str:
    if session is None:
        return '; it has not run here yet'
    if session.ended:
        return f'; last session {shown_iso(session.started)} to {shown_iso(session.ended)} UTC'
    return f'; session of {shown_iso(session.started)} UTC cut off, or just beginning'


def _topics(topics: Mapping[str, TopicStatus], undiscovered: Collection[str]) -> Iterator[RenderableType]:
    """The table of what arrives, and the names of what does not."""
    unreceived = {topic: row for topic, row in topics.items() if not row.received}
    silent = [topic for topic, row in unreceived.items() if row.enabled and not row.publishers and topic not in undiscovered]
    off = [topic for topic, row in unreceived.items() if not row.enabled]
    rows = {topic: row for topic, row in topics.items() if topic not in (*silent, *off)}
    losses = [name for name in LOSSES if any(getattr(row, name) for row in rows.values())]
    table = plain_table('Messages of this session', ('topic', 'Hz', 'age', 'received', 'stored', 'missed', *losses))
    for topic, row in rows.items():
        rate = f'{row.rate_hz:,.1f}' if row.enabled else 'off'
        age = '-' if row.age_s is None else duration(row.age_s)
        lost = ((row.missed, row.missed_estimated), *((getattr(row, name), None) for name in losses))
        cells = (Text(figure(*counts), 'yellow' if any(counts) else '') for counts in lost)
        table.add_row(plain(topic), rate, age, number(row.received), number(row.stored), *cells)
    if rows:
        yield table
    for what, names in (('Nobody publishes', silent), ('Off:', off)):
        if names:
            yield plain(f'{what} {", ".join(names)}', 'dim')


def _way(report: NodeReport, console: Console, *, live: bool) -> Table:
    """Queue, spool, store, and the workers that fail, as lines under one another."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(style='bold', no_wrap=True)
    grid.add_column(no_wrap=True)
    grid.add_column(overflow='fold')
    node, spool = report.node, report.spool
    if live:
        queue = node.queue
        share = max(_share(queue.messages, queue.max_messages), _share(queue.bytes, queue.max_bytes))
        text = f'{queue.messages:,} of {queue.max_messages:,} messages, {volume(queue.bytes)}'
        grid.add_row('queue', share_bar(share, console), text)
    if spool:
        grid.add_row('spool', share_bar(_share(spool.bytes, spool.max_bytes), console), _disk(spool))
        grid.add_row('', '', _usage(spool))
    if not live:
        return grid
    _add_store(grid, node)
    if node.mission:
        _add_mission(grid, node)
    if node.bag.recording:
        _add_bag(grid, node.bag)
    if node.events.enabled:
        _add_events(grid, node.events)
    for name, worker in node.workers.items():
        if worker.failing:
            grid.add_row(plain(name), Text('fails', 'red'), plain(f'{worker.failures:,} times so far: {worker.last_error}'))
        elif name in node.stalls:
            grid.add_row(plain(name), Text('hangs', 'yellow'), f'for {duration(worker.busy_s)}')
        elif worker.failures:
            text = f'failed {worker.failures:,} times and was started again, last: {worker.last_error}'
            grid.add_row(plain(name), Text('works', 'green'), plain(text))
    return grid


def _disk(spool: SpoolStatus) -> str:
    """``123.5 KB of 21.5 GB, 50.0 GB free``; the limit is a setting of the node, unknown if none has run."""
    limit = f' of {volume(spool.max_bytes)}' if spool.max_bytes else ''
    free = '' if spool.free_bytes is None else f', the disk has {volume(spool.free_bytes)} free'
    return f'{volume(spool.bytes)}{limit}{free}'


def _usage(spool: SpoolStatus) -> str:
    """``3 objects wait (oldest 0.4 s), 1 quarantined``."""
    oldest = '' if spool.oldest_age_s is None else f' (oldest {duration(spool.oldest_age_s)})'
    others = {'held': spool.held, 'kept': spool.kept, 'quarantined': spool.quarantined, 'evicted': spool.evicted}
    usage = ''.join(f', {count:,} {name}' for name, count in others.items() if count)
    return f'{spool.pending:,} objects wait{oldest}{usage}'


def _add_store(grid: Table, node: NodeStatus) -> None:
    store = node.store
    fine = store.state in FINE_STORE
    cap = f' of {store.max_mbps:g}' if store.max_mbps else ''
    grid.add_row('store', plain(store.state.replace('_', ' '), 'green' if fine else 'red'), plain(store.target))
    left = '' if store.left_s is None else f', all that waits arrives in {duration(store.left_s)}'
    grid.add_row('', '', f'{store.delivered:,} delivered, {store.mbps:.1f}{cap} Mbit/s{left}')
    for name, why in store.waits_for.items():
        grid.add_row('', '', plain(f'waits for {name}: {why}', 'yellow'))
    if store.last_error and (not fine or store.blocked_buckets):
        grid.add_row('', '', plain(store.last_error, 'yellow'))
    requests = node.requests
    if requests.open:
        left = f', which arrive in {duration(requests.left_s)}' if requests.left_s is not None else ''
        grid.add_row('requests', '', f'{requests.open:,} open, for {volume(requests.bytes)}{left}')


def _add_mission(grid: Table, node: NodeStatus) -> None:
    """The active mission, its type, since when, and its run."""
    mission = node.mission
    started_ns, now_ns = iso_ns(mission.started), iso_ns(node.time)
    since = 'since an unknown time'
    if started_ns is not None and now_ns is not None:
        since = f'since {shown_iso(mission.started)} UTC, {duration((now_ns - started_ns) / SECOND)}'
        if started_ns < EARLIEST_SANE_NS:
            since = 'started before the clock was set'
    grid.add_row('mission', Text('active', 'cyan'), plain(f'{mission.type}, {since}'))
    grid.add_row('', '', plain(mission.mission_id))
    if mission.policy:
        grid.add_row('', '', plain(f'policy {mission.policy}'))
    grid.add_row('', '', plain(f'MLflow run {mission.run_id}' if mission.run_id else 'no MLflow run yet'))


def _add_bag(grid: Table, bag: BagStatus) -> None:
    """The bag that is being recorded, its size, and its problems."""
    state, style = ('stands still', 'red') if bag.refused else ('paused', 'yellow') if bag.paused else ('records', 'cyan')
    grid.add_row('bag', Text(state, style), plain(f'{bag.bag} for {duration(bag.duration_s)}'))
    grid.add_row('', '', f'{bag.messages:,} messages, {volume(bag.bytes)}, slice {bag.slice}')
    if bag.refused:
        grid.add_row('', '', plain(f'the disk takes nothing: {bag.refused}', 'red'))
    if bag.dropped:
        grid.add_row('', '', plain(f'{bag.dropped:,} messages dropped', 'yellow'))


def _add_events(grid: Table, events: EventStatus) -> None:
    """The content of the ring, the event that is being written, and the last trigger."""
    state, style = ('stands still', 'red') if events.refused else ('writes', 'cyan') if events.bag else ('ready', 'green')
    what = events.bag or f'the last {duration(events.seconds)} are kept'
    grid.add_row('events', Text(state, style), plain(what))
    grid.add_row('', '', f'{volume(events.bytes)} of {volume(events.max_bytes)} of memory, {events.written:,} written')
    if events.refused:
        grid.add_row('', '', plain(f'the disk takes nothing: {events.refused}', 'red'))
    if last := events.last:
        grid.add_row('', '', plain(f'last: {last.name} by {last.by}, {shown_iso(last.time)} UTC'))


def _share(part: float, whole: float | None) -> float:
    return part / whole if whole else 0.0
