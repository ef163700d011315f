"""The demo's output: a line of progress while it runs, then the results."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from shadowhound_data_logger.cli.ledger import verdict
from shadowhound_data_logger.cli.output import figure, number, plain_table, print_page, volume
from shadowhound_sim.demo_audit import BUCKET, DemoAudit
from shadowhound_sim.demo_processes import OUR_VARIABLE
from shadowhound_sim.demo_run import Record, Show, SpoolReading

LINE_EVERY_S: Final = 5.0
"""Without a terminal."""
HEADING: Final = f'{"time":>5}  {"room":<9}{"messages":>9}{"objects":>9}{"delivered":>11}{"waiting":>9}{"size":>10}  server'
TEAL: Final = '#16917f'
TOWER: Final = {'up': 'up', 'going': 'stopping', 'away': 'DOWN', 'coming': 'DOWN', 'back': 'up again'}


@contextmanager
def progress(console: Console, duration_s: float) -> Iterator[Show]:
    """A function that shows readings: a live line on a terminal, otherwise a line every five seconds and at each change."""
    if not console.is_terminal:
        lines = Lines(console)
        yield lines.show
        lines.end()
        return
    with Live(console=console, auto_refresh=False) as live:

        def show(reading: SpoolReading) -> None:
            bar = ProgressBar(
                total=duration_s,
                completed=min(reading.t, duration_s),
                width=len(HEADING) + 5,
                complete_style=TEAL,
                finished_style=TEAL,
            )
            live.update(Group(Text(HEADING, style='dim'), _styled(reading), bar), refresh=True)

        yield show


class Lines:
    """Progress for a log file."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._next_s = 0.0
        self._tower = ''
        self._unprinted: SpoolReading | None = None
        console.print(HEADING)

    def show(self, reading: SpoolReading) -> None:
        self._unprinted = reading
        if reading.t >= self._next_s or TOWER[reading.tower] != self._tower:
            self.end()
            self._next_s = (reading.t // LINE_EVERY_S + 1) * LINE_EVERY_S
            self._tower = TOWER[reading.tower]

    def end(self) -> None:
        """Print the last reading, unless it was printed."""
        if self._unprinted is not None:
            self._console.print(line(self._unprinted))
            self._unprinted = None


def line(reading: SpoolReading) -> str:
    """One reading under HEADING."""
    return (
        f'{reading.t:>3.0f} s  {reading.room:<9}{reading.messages:>9,}{reading.spooled:>9,}{reading.delivered:>11,}'
        f'{reading.pending:>9,}{volume(reading.bytes):>10}  {TOWER[reading.tower]}'
    )


def show_result(audit: DemoAudit, record: Record, console: Console) -> None:
    """Print the tables, remarks, and the verdicts."""
    print_page(messages_table(audit), '', objects_table(audit), console=console)
    console.print()
    for remark in _remarks(audit, record):
        console.print(remark)
    console.print()
    console.print(verdict(audit.ledger, ()))
    found = '[red]something is wrong' if audit.problems else '[green]all as spooled'
    console.print(f'{audit.read_back:,} objects with {audit.samples:,} messages read back from the S3 server: {found}')
    console.print(f'The catalog in {BUCKET}/*/_catalog/ has {audit.rows:,} rows: one for each object except its own.')
    for problem in audit.problems:
        console.print(Text(f'  {problem}', style='red'))
    if record.errors:
        console.print(f'[red]Errors that the node logged: {len(record.errors)}[/], all of them in node.log; the first:')
        console.print(Text(f'  {record.errors[0]}', style='red'))


def _remarks(audit: DemoAudit, record: Record) -> Iterator[str]:
    before = sum(row.before_match or 0 for row in audit.messages.values())
    if before:
        yield f'{before:,} messages were published before the node found their publishers: the ledger starts after them.'
    for topic, row in audit.messages.items():
        if row.account is None:
            yield f'{topic} is not logged: the compressed image is preferred.'
    if record.outage is not None:
        length_s, after_s = record.outage[1] - record.outage[0], record.caught_up_s
        end = 'they still wait' if after_s is None else f'delivered {max(after_s, 1):.0f} s after its return'
        yield f'The S3 server was down for {length_s:.0f} s: {record.backlog:,} objects waited, {end}.'


def messages_table(audit: DemoAudit) -> Table:
    """One row per topic: what the robot counted as published, and what happened to it."""
    fates = ('received', 'stored', 'skipped', 'missed')
    has_before = any(row.before_match for row in audit.messages.values())
    table = plain_table('Messages by outcome', ('topic', 'published', *(['before match'] if has_before else ()), *fates))
    for topic, row in sorted(audit.messages.items()):
        before = [number(row.before_match)] if has_before else []
        account = row.account
        counts = [figure(None, None)] * len(fates)
        if account is not None:
            counts = [number(account['received']), number(account['stored']), number(account['skipped']),
                      figure(account['missed'], account['missed_estimated'])]  # fmt: skip
        table.add_row(topic, number(row.published), *before, *counts)
    return table


def objects_table(audit: DemoAudit) -> Table:
    """One row per sensor: its objects in the S3 server, and the latest key."""
    columns = ('objects', 'delivered', 'size', 'the latest one')
    table = plain_table('Objects in the S3 server', columns, left=columns[-1:])
    for _, each in sorted(audit.totals.items(), key=lambda item: item[1].latest):
        table.add_row(number(each.objects), number(each.delivered), volume(each.bytes), each.latest)
    totals = audit.totals.values()
    total = (sum(each.objects for each in totals), sum(each.delivered for each in totals), sum(each.bytes for each in totals))
    table.add_row(number(total[0]), number(total[1]), volume(total[2]), 'all', style='bold')
    return table


def show_mission(summary: Mapping[str, Any], console: Console) -> None:
    """The result of a mission, from its summary.json."""
    counts, last = summary['counts'], summary['last']
    walked = f'{summary["distance_m"]:.1f} m in {summary["duration_s"]:.0f} s'
    battery = f', battery {last["battery_pct"]:.0f} %' if 'battery_pct' in last else ''
    console.print(f'The mission {summary["run_name"]}: {walked}{battery}, {number(counts["camera_frames"])} frames.')
    console.print('Its run in MLflow has parameters, metrics over time, trajectory, frames, three plots and a summary.')


def show_where(folder: Path, pictures: list[Path], environ: Mapping[str, str], console: Console, page: str = '') -> None:
    """Where everything is, and how to open it; ``page`` is the live page, if it and the Tower stay."""
    prefix = 'scripts/with-env ' if OUR_VARIABLE in environ else ''
    place = shlex.quote(str(folder))
    console.print('\n[bold]Look at')
    for picture in pictures:
        console.print(f'  {picture}', soft_wrap=True)
    console.print(f'  {folder}/node.log: the log of the node', soft_wrap=True)
    if page:
        console.print(f'\n[bold]The live page stays, with the whole patrol to look back at: {page}')
        console.print('Ctrl-C stops it, and the server.')
        return
    console.print('\n[bold]Look at the bucket')
    console.print('The server has stopped; its data is kept. To start it again, with new credentials:')
    console.print(f'  {prefix}python -m shadowhound_tower.embedded --folder {place}/tower', soft_wrap=True)
    console.print('Paste the "export" lines it prints into another terminal, and use our commands or any S3 client:')
    console.print(f'  {prefix}shadowhound-data query --sensor camera --limit 5', soft_wrap=True)
    console.print('  aws s3 ls --recursive s3://sensor-data/ --endpoint-url "$AWS_ENDPOINT_URL"', soft_wrap=True)
    console.print('It also prints the URL of MLflow and the user for its pages: experiment thor_missions has the mission.')
    console.print('The ledger again, as on a robot:')
    console.print(f'  SHADOWHOUND_HOME={place}/home {prefix}shadowhound-data ledger', soft_wrap=True)


def _styled(reading: SpoolReading) -> Text:
    style = {'DOWN': 'yellow', 'stopping': 'yellow', 'up again': 'green'}.get(TOWER[reading.tower], '')
    text = Text(line(reading))
    text.stylize(style, len(text) - len(TOWER[reading.tower]))
    return text
