"""``shadowhound-data ledger``: what became of every message, as a table or as JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from shadowhound_data_logger.config import home
from shadowhound_data_logger.spool.ledger import imbalances, read


@click.command()
@click.option('--json', 'as_json', is_flag=True, help='Print the ledger as JSON.')
@click.option('--spool', type=click.Path(path_type=Path, file_okay=False), help='The spool to read  [default: $SHADOWHOUND_HOME/spool]')
def ledger(*, as_json: bool, spool: Path | None) -> int:
    """Account for every message: stored and where, or lost and why.

    Reads the spool while the node runs and when it does not. Exit code 1 when the ledger does not balance.
    """
    found = read(spool or home(os.environ) / 'spool', os.environ.get('SHADOWHOUND_ROBOT') or 'thor')
    if as_json:
        click.echo(json.dumps(found, indent=2))
    else:
        show(found, Console())
    return 0 if found['balanced'] else 1


def show(found: dict[str, Any], console: Console) -> None:
    """The ledger as two tables and a verdict."""
    console.print(topics_table(found))
    console.print(_objects_table(found))
    console.print(verdict(found))


def topics_table(found: dict[str, Any]) -> Table:
    """One row a topic; a dash is a figure that the middleware does not tell."""
    table = Table(title=f'messages of {found["robot"]}', title_justify='left')
    for name in ('topic', 'published', 'received', 'missed', 'skipped', 'rejected', 'dropped', 'stored', 'open', 'accounting'):
        table.add_column(name, justify='left' if name in {'topic', 'accounting'} else 'right')
    for topic, row in found['topics'].items():
        table.add_row(
            topic, _number(row['published']), _number(row['received']), _by_cause(row['missed'], row['missed_by']),
            _number(row['skipped']), _by_cause(sum(row['rejected'].values()), row['rejected']),
            _by_cause(sum(row['dropped'].values()), row['dropped']), _number(row['stored']), _number(row['open']), row['accounting'],
        )  # fmt: skip
    return table


def verdict(found: dict[str, Any]) -> str:
    """One line, or one for each identity that does not hold."""
    if found['balanced']:
        return '[green]the ledger balances:[/] every message received is stored, skipped on purpose, or listed with the reason'
    return '\n'.join(f'[red]does not balance:[/] {line}' for line in imbalances(found))


def _objects_table(found: dict[str, Any]) -> Table:
    table = Table(title='objects', title_justify='left')
    table.add_column('')
    for state in found['objects']:
        table.add_column(state, justify='right')
    table.add_row('objects', *(_number(count) for count in found['objects'].values()))
    table.add_row('bytes', *(_bytes(count) for count in found['bytes'].values()))
    return table


def _number(value: int | None) -> str:
    return '-' if value is None else f'{value:,}'


def _by_cause(total: int | None, causes: dict[str, int]) -> str:
    """``12 (restart 12)``."""
    if not total:
        return _number(total)
    return f'{total:,} ({", ".join(f"{cause} {count:,}" for cause, count in sorted(causes.items()))})'


def _bytes(count: float) -> str:
    for unit in ('B', 'KB', 'MB'):
        if count < 1000:
            return f'{count:.0f} {unit}' if unit == 'B' else f'{count:.1f} {unit}'
        count /= 1000
    return f'{count:.1f} GB'
