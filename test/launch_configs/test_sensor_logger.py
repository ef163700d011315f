"""The launch file, by launch's own words: which processes it starts, and that the programs take their arguments."""

from __future__ import annotations

import runpy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import pytest

from shadowhound_data_logger.cli.main import cli

launch = pytest.importorskip('launch', reason='no launch here: it comes with a ROS that is installed')
pytest.importorskip('launch_ros')

pytestmark = pytest.mark.filterwarnings("ignore:The 'LaunchConfigurationEquals':UserWarning")  # Humble has nothing newer
FILE = Path(__file__).parents[2] / 'launch_configs' / 'sensor_logger.launch.py'


def commands(given: Mapping[str, str], nodes: int = 1) -> list[list[str]]:
    """What it starts next to so many nodes, with these arguments of ``ros2 launch``."""
    from launch.actions import ExecuteProcess, OpaqueFunction
    from launch.utilities import perform_substitutions

    description = runpy.run_path(str(FILE))['generate_launch_description']()
    context = launch.LaunchContext()
    context.launch_configurations.update(given)
    for argument in description.get_launch_arguments():
        argument.execute(context)
    entities = [*description.entities]
    for each in description.entities:
        if isinstance(each, OpaqueFunction):
            entities += each.execute(context) or []
    processes = [each for each in entities if isinstance(each, ExecuteProcess)]
    chosen = [each for each in processes if each.condition is None or each.condition.evaluate(context)]
    found = [[perform_substitutions(context, list(part)) for part in each.cmd] for each in chosen]
    assert sum('sensor_logger_node' in program for program, *_ in found) == nodes
    return [command for command in found if 'sensor_logger_node' not in command[0]]


def parsed(command: list[str]) -> dict[str, Any]:
    """The options that the program makes of it. Raises click.UsageError where it takes them not."""
    program, *words = command
    assert program.endswith('/lib/shadowhound_data_logger/shadowhound-data')
    verb: click.Command = cli
    with click.Context(cli) as context:
        while isinstance(verb, click.Group):
            verb = verb.commands[words.pop(0)]
        return verb.make_context(verb.name, words, parent=context).params


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    return tmp_path


@pytest.mark.parametrize('given', [{}, {'live': 'false'}])
def test_by_default_the_launch_file_starts_the_node_alone(given: dict[str, str]) -> None:
    """No page, and nothing that follows policies."""
    assert commands(given) == []


def test_several_robots_get_a_node_each() -> None:
    """With one command."""
    assert commands({'robots': 'robot0, robot1'}, nodes=2) == []


def test_the_live_page_is_started_on_request(home: Path) -> None:
    """Of the spool that the node will make, at the address that is given; 127.0.0.1 unless there is one."""
    (command,) = commands({'live': 'true'})
    options = parsed(command)
    assert (options['spool'], options['bind'], options['port']) == (home / 'spool', '127.0.0.1', 8765)
    (command,) = commands({'live': 'true', 'live_bind': '0.0.0.0'})
    assert parsed(command)['bind'] == '0.0.0.0'


def test_a_named_policy_is_followed() -> None:
    """By the verb for it."""
    (command,) = commands({'policy': 'go2_patrol'})
    assert parsed(command)['name'] == 'go2_patrol'
