"""``shadowhound-data VERB``: exit code 0 is fine, 1 a finding, 2 bad usage."""

from __future__ import annotations

import io
import sys

import click

from shadowhound_data_logger.cli.bag import bag
from shadowhound_data_logger.cli.doctor import doctor
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.cli.lake import lake
from shadowhound_data_logger.cli.ledger import ledger
from shadowhound_data_logger.cli.missions import missions
from shadowhound_data_logger.cli.node import node
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.cli.spool import spool
from shadowhound_data_logger.cli.status import status
from shadowhound_data_logger.errors import DataLoggerError
from shadowhound_data_logger.untrusted import visible


@click.group(context_settings={'help_option_names': ['-h', '--help']})
@click.version_option(package_name='shadowhound_data_logger', prog_name='shadowhound-data')
def cli() -> None:
    """What became of a robot's data: ask its spool and its store.

    SHADOWHOUND_HOME names the folder of the spool (default ~/.shadowhound), SHADOWHOUND_ROBOT the robot (default: who ran).
    """


cli.add_command(doctor)
cli.add_command(bag)
cli.add_command(fetch)
cli.add_command(lake)
cli.add_command(ledger)
cli.add_command(missions)
cli.add_command(node)
cli.add_command(query)
cli.add_command(spool)
cli.add_command(status)


def main() -> None:
    """The console script."""
    try:
        sys.exit(cli(standalone_mode=False) or 0)
    except click.exceptions.Exit as error:
        sys.exit(error.exit_code)
    except click.ClickException as error:
        told = io.StringIO()
        error.show(told)
        click.echo(visible_lines(told.getvalue()), nl=False, err=True)
        sys.exit(2)
    except click.Abort:
        sys.exit(130)
    except DataLoggerError as error:
        click.echo(f'shadowhound-data: {visible_lines(str(error))}', err=True)
        sys.exit(1)


def visible_lines(text: str) -> str:
    """An error may name what a robot wrote."""
    return '\n'.join(map(visible, text.split('\n')))


if __name__ == '__main__':
    main()
