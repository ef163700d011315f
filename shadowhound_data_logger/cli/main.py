"""``shadowhound-data VERB``: the verbs by who needs them, and how every one of them ends.

An error has one form: the verb, what is wrong and where, and on the next line what to do. ``common.ExitCode`` has the exit codes.
"""

from __future__ import annotations

import atexit
import gc
import os
import sqlite3
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from itertools import pairwise
from typing import Final

import click
from click.shell_completion import CompletionItem

from shadowhound_data_logger.cli.common import MEANINGS, PROGRAM, BadUsage, ExitCode, LazyCommands, Verb, examples
from shadowhound_data_logger.core.errors import DataLoggerError, SettingError, UnknownName

SECTIONS: Final[dict[str, Sequence[Verb]]] = {
    'On every machine': (Verb('doctor', 'Check this machine, its network and the store, and say what to do.'),),
    'On the robot': (
        Verb('init', 'Write a parameter file for this robot.'),
        Verb('status', 'Show what the node on this machine is doing.'),
        Verb('ledger', 'Account for every message: stored, or lost and why.'),
        Verb('spool', 'Show what is not in the store yet, and why.'),
        Verb('node', 'Control the node on this machine, without ROS.'),
        Verb('live', 'Serve a web page that shows the robot and its data.'),
    ),
    'On servers and workstations': (
        Verb('query', 'Query what is stored, with flags or SQL.'),
        Verb('search', 'Search the words of missions, events, errors and labels.'),
        Verb('fetch', 'Download objects, verified.'),
        Verb('pull', 'Request data that a robot keeps (ship: on_request).'),
        Verb('bag', 'Find, download, check, cut and upload bags.'),
        Verb('lake', 'Manage the tables of what is stored.'),
        Verb('label', 'Label times, objects and boxes in images.'),
        Verb('export', 'Make training sets from missions.'),
    ),
    'Missions': (Verb('missions', 'Show and send missions logged on this machine.'),),
    'Policies': (Verb('policy', 'Sign trained policies and deliver them to robots.'),),
}
"""The verbs by who needs them, in the order of the help."""
NO_VERB: Final[tuple[type[click.ClickException], ...]] = (
    (click.exceptions.NoArgsIsHelpError,) if hasattr(click.exceptions, 'NoArgsIsHelpError') else ()
)
"""A group of verbs without one: its help is the answer. Before click 8.2 that is no error."""
CODES: Final = '\n'.join(('\b', 'Exit codes:', *(f'  {code.value:<4} {meaning}' for code, meaning in MEANINGS.items())))


class Verbs(click.Group):
    """Its help lists the verbs section by section."""

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        for title, verbs in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(verb.name, verb.help) for verb in verbs])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Without importing the verbs, as click would for their help."""
        verbs = [verb for section in SECTIONS.values() for verb in section if verb.name.startswith(incomplete)]
        return [CompletionItem(verb.name, help=verb.help) for verb in verbs] + click.Command.shell_complete(self, ctx, incomplete)

    def format_epilog(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        for part in (examples('doctor', 'status --watch', 'query --sensor camera --since 2h'), CODES):
            formatter.write_paragraph()
            formatter.write_text(part)


@click.group(
    cls=Verbs,
    commands=LazyCommands(verb for section in SECTIONS.values() for verb in section),
    context_settings={'help_option_names': ['-h', '--help']},
)
@click.version_option(package_name='shadowhound_data_logger', prog_name=PROGRAM)
def cli() -> None:
    """Inspect, find and move the data of a robot, in its spool and in the store.

    SHADOWHOUND_HOME contains the spool (default ~/.shadowhound), SHADOWHOUND_ROBOT names the robot (default: the one whose
    node ran here), AWS_ENDPOINT_URL the S3 server (default: the folder SHADOWHOUND_HOME/store). Most verbs print JSON with
    --json.
    """


class _WithoutPandas:
    """Has pandas look as if it were not installed: pyarrow imports it with the first array, which takes half a second."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == 'pandas':
            raise ModuleNotFoundError(f'no command needs {name}', name=name)


def main() -> None:
    """The console script."""
    atexit.register(gc.freeze)  # the interpreter collects garbage at its end, which no process that ends needs
    sys.meta_path.insert(0, _WithoutPandas())
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal that is not UTF-8, or text that is not Unicode
            stream.reconfigure(errors='backslashreplace')
    try:
        code = ExitCode(cli(prog_name=PROGRAM, standalone_mode=False) or 0)
        if sys.stdout is not None:
            sys.stdout.flush()
        sys.exit(code)
    except BrokenPipeError:  # the reader of the output has enough of it, such as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(ExitCode.FINDING)
    except click.exceptions.Exit as error:
        sys.exit(error.exit_code)
    except click.Abort:
        sys.exit(ExitCode.INTERRUPTED)
    except NO_VERB as error:
        click.echo(error.format_message(), err=True)
        sys.exit(ExitCode.USAGE)
    except (click.ClickException, DataLoggerError, OSError, sqlite3.Error, UnicodeEncodeError) as error:
        is_usage = isinstance(error, (click.ClickException, SettingError, UnknownName, UnicodeEncodeError))
        code = ExitCode.USAGE if is_usage else ExitCode.FINDING
        from shadowhound_data_logger.cli.output import print_error, report_error  # noqa: PLC0415 - rich takes a while

        described_error = described(error, sys.argv[1:])
        if wants_json(sys.argv[1:]):
            print_error(*described_error, code)
        else:
            report_error(*described_error)
        sys.exit(code)


def wants_json(arguments: Sequence[str]) -> bool:
    """Whether the answer was to be JSON: also known of a command line that is wrong."""
    given = list(arguments[: arguments.index('--')] if '--' in arguments else arguments)
    return not {'--json', '--format=json'}.isdisjoint(given) or ('--format', 'json') in set(pairwise(given))


def described(error: Exception, arguments: Sequence[str]) -> tuple[str, str, str]:
    """The verb that failed, what is wrong and where, and what to do about it."""
    verb = ' '.join((PROGRAM, *verb_of(arguments)))
    if isinstance(error, DataLoggerError):
        return verb, error.what, error.remedy or error.DEFAULT_REMEDY
    if isinstance(error, click.ClickException):
        return verb, error.format_message().rstrip('.'), (isinstance(error, BadUsage) and error.remedy) or f'{verb} --help'
    if isinstance(error, UnicodeEncodeError):  # bytes of an argument that the locale of the shell does not have
        return verb, f'{error.object!r:.200} is not text', 'is the locale of this shell UTF-8? export LC_ALL=C.UTF-8'
    if isinstance(error, OSError):
        names = ' and '.join(str(name) for name in (error.filename, error.filename2) if name)
        what = error.strerror or str(error)
        return verb, f'{names}: {what}' if names else what, 'does the path exist, is it yours, and has its disk room?'
    return verb, f'the index of the spool cannot be used: {error}', f'{PROGRAM} doctor --only spool looks for the cause'


def verb_of(arguments: Sequence[str]) -> list[str]:
    """The verb, and the verb of that, which a command line names."""
    command: click.Command = cli
    found: list[str] = []
    for argument in arguments:
        if isinstance(command, click.Group) and argument in command.commands:
            command = command.commands[argument]
            found.append(argument)
    return found


if __name__ == '__main__':
    main()
