"""``shadowhound-data node``: controls the node that runs on this machine, whatever middleware it speaks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final, TypeVar

import click
from rich.console import RenderableType
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from shadowhound_data_logger.cli.common import ExitCode, as_json, examples, exit_code, robot_name, spool_folder, the_spool
from shadowhound_data_logger.cli.output import plain, plain_table, print_json, print_page, report_error
from shadowhound_data_logger.spool.control import connect

F = TypeVar('F', bound=Callable[..., Any])
LIVE: Final = {True: 'at a start', False: 'yes'}
"""When a parameter can be set, by whether it is read-only."""


def _of_node(verb: F) -> F:
    """The options that each verb has."""
    whose = 'The robot  [default: the only one that runs here]'
    for option in (
        as_json,
        click.option('--robot', metavar='NAME', envvar='SHADOWHOUND_ROBOT', callback=robot_name, help=whose),
        spool_folder,
    ):
        verb = option(verb)
    return verb


@click.group(epilog=examples('node flush', 'node set camera.rate_hz 5.0'))
def node() -> None:
    """Control the node on this machine, without ROS.

    These verbs do the same as its services and parameters.

    They use a socket in the spool: run them as the node's user. Exit code 1 if the node refuses, fails, or does not run.
    """


@node.group(epilog=examples('node bag start', 'node bag stop'))
def bag() -> None:
    """Record a bag at full rate."""


def _add(group: click.Group, name: str, do: str, text: str) -> None:
    @group.command(name, help=text, epilog=examples(f'{"node " * (group is bag)}{group.name} {name}'))
    @_of_node
    def ask(*, robot: str | None, spool: Path | None, as_json: bool) -> ExitCode:
        return _ask(spool, robot, do, as_json=as_json)


_add(node, 'flush', 'flush', 'Write everything received so far to disk, including open batches.')
_add(node, 'pause', 'pause', 'Stop storing messages; uploads continue.')
_add(node, 'resume', 'resume', 'Resume storing messages.')
_add(bag, 'start', 'bag start', 'Start a bag and print its name.')
_add(bag, 'stop', 'bag stop', 'Stop the bag.')
_add(bag, 'split', 'bag split', 'Close the current file, so that it is uploaded now.')
_add(bag, 'pause', 'bag pause', 'Pause recording; messages are still counted.')
_add(bag, 'resume', 'bag resume', 'Resume recording.')


@node.command(epilog=examples('node event', "node event slipped --note 'wet floor'"))
@click.argument('name', default='manual')
@click.option('--note', default='', metavar='TEXT', help='A remark.')
@_of_node
def event(*, name: str, note: str, robot: str | None, spool: Path | None, as_json: bool) -> ExitCode:
    """Save the seconds before and after this moment as a bag.

    It prints the name of the bag. If an event is being recorded, that one is extended instead.
    """
    return _ask(spool, robot, 'event', as_json=as_json, name=name, note=note)


@node.command('set', context_settings={'ignore_unknown_options': True},
              epilog=examples('node set camera.rate_hz 5.0', 'node set upload.max_mbps 20'))  # fmt: skip
@click.argument('name')
@click.argument('value')
@_of_node
def set_(*, name: str, value: str, robot: str | None, spool: Path | None, as_json: bool) -> ExitCode:
    """Set a parameter until the node exits.

    The value is written as in a parameter file: 5.0, true, or a word. `shadowhound-data node params` shows which parameters
    can be set.
    """
    return _ask(spool, robot, 'set', as_json=as_json, values={name: _value(value)})


@node.command(epilog=examples('node get camera.rate_hz'))
@click.argument('name')
@_of_node
def get(*, name: str, robot: str | None, spool: Path | None, as_json: bool) -> ExitCode:
    """Print the value of a parameter."""
    return _ask(spool, robot, 'get', as_json=as_json, show=lambda answer: [_shown(answer['values'][name])], names=[name])


@node.command(epilog=examples('node params', 'node params camera'))
@click.argument('prefix', default='', metavar='[SENSOR|GROUP]')
@_of_node
def params(*, prefix: str, robot: str | None, spool: Path | None, as_json: bool) -> ExitCode:
    """List the parameters and whether they can be set at run time.

    It lists all of them, or those of a sensor or group.
    """

    def chosen(answer: dict[str, Any]) -> dict[str, Any]:
        found = [each for each in answer['parameters'] if not prefix or f'{each["name"]}.'.startswith(f'{prefix}.')]
        if found:
            return {**answer, 'parameters': found}
        groups = ', '.join(sorted({each['name'].partition('.')[0] for each in answer['parameters']}))
        return {'ok': False, 'robot': answer['robot'], 'error': f'there are no parameters of {prefix!r}; there are {groups}'}

    return _ask(spool, robot, 'parameters', as_json=as_json, show=_table, chosen=chosen)


def _ask(
    spool: Path | None, robot: str | None, do: str, *, as_json: bool, show: Callable[[dict[str, Any]], Any] | None = None,
    chosen: Callable[[dict[str, Any]], dict[str, Any]] = lambda answer: answer, **arguments: Any,
) -> ExitCode:  # fmt: skip
    """Ask, print what is answered, and say by the exit code whether it was done."""
    with closing(connect(the_spool(spool), robot)) as connection:
        answer = connection.ask(do, **arguments)
    if answer['ok']:
        answer = chosen(answer)
    if as_json:
        print_json(answer)
    elif not answer['ok']:
        report_error(f'shadowhound-data node {do}', answer['error'], 'shadowhound-data status says what the node does')
    elif show is not None:
        print_page(*show(answer))
    else:
        click.echo(answer['message'])
    return exit_code(finding=not answer['ok'])


def _table(answer: dict[str, Any]) -> Iterator[RenderableType]:
    table = plain_table('', ('parameter', 'value', 'set', ''), left=('parameter', 'value', 'set', ''))
    for each in answer['parameters']:
        value, text = plain(_shown(each['value'])), plain(each['description'], 'dim')
        table.add_row(plain(each['name']), value, LIVE[each['read_only']], text)
    yield table


def _shown(value: object) -> str:
    """In the syntax of a parameter file."""
    return value if isinstance(value, str) else json.dumps(value)


def _value(text: str) -> object:
    """In YAML 1.1, as ``ros2 param set`` reads it; otherwise the text itself."""
    yaml = YAML(typ='safe', pure=True)
    yaml.version = (1, 1)
    try:
        value = yaml.load(text)
    except YAMLError:
        return text
    return value if isinstance(value, (bool, int, float, str, list)) else text
