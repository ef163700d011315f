"""``shadowhound-data node``: the requests it sends to the running node, its output, and its exit codes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from node.serving import Serving

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.errors import NodeUnavailable

PARAMETERS = [
    {'name': 'camera.format', 'value': 'jpeg', 'description': 'What it is.', 'constraints': '', 'read_only': True},
    {'name': 'camera.rate_hz', 'value': 2.0, 'description': 'How often.', 'constraints': '', 'read_only': False},
    {'name': 'camera_info.rate_hz', 'value': 0.0, 'description': 'How often.', 'constraints': '', 'read_only': False},
    {'name': 'robot', 'value': '', 'description': 'Who.', 'constraints': '', 'read_only': True},
]


def node(request: Mapping[str, Any]) -> dict[str, Any]:
    """Answers as a node gives them."""
    if request['do'] == 'parameters':
        return {'ok': True, 'robot': 'thor', 'parameters': PARAMETERS}
    if request['do'] == 'get':
        return {'ok': True, 'robot': 'thor', 'values': {name: [1, 'a'] for name in request['names']}}
    if request['do'] == 'bag stop':
        return {'ok': False, 'robot': 'thor', 'error': 'nothing is recorded'}
    return {'ok': True, 'robot': 'thor', 'message': f'{request["do"]} is done'}


@pytest.fixture
def serving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serving]:
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('SHADOWHOUND_ROBOT', raising=False)
    made = Serving(tmp_path / 'spool', do=node)
    yield made
    made.close()


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ['node', *arguments], standalone_mode=False)


@pytest.mark.parametrize(
    ('words', 'request_'),
    [
        (['flush'], {'do': 'flush'}),
        (['pause'], {'do': 'pause'}),
        (['resume'], {'do': 'resume'}),
        (['bag', 'start'], {'do': 'bag start'}),
        (['bag', 'split'], {'do': 'bag split'}),
        (['bag', 'pause'], {'do': 'bag pause'}),
        (['bag', 'resume'], {'do': 'bag resume'}),
        (['event'], {'do': 'event', 'name': 'manual', 'note': ''}),
        (['event', 'fall', '--note', 'on the stairs'], {'do': 'event', 'name': 'fall', 'note': 'on the stairs'}),
        (['set', 'camera.rate_hz', '5.0'], {'do': 'set', 'values': {'camera.rate_hz': 5.0}}),
        (['set', 'camera.rate_hz', '-1'], {'do': 'set', 'values': {'camera.rate_hz': -1}}),
        (['set', 'camera.enabled', 'off'], {'do': 'set', 'values': {'camera.enabled': False}}),
        (['set', 'events.log_event', 'fall|slip'], {'do': 'set', 'values': {'events.log_event': 'fall|slip'}}),
        (['set', 'events.log_event', '.*'], {'do': 'set', 'values': {'events.log_event': '.*'}}),
        (['set', 'events.log_event', '*'], {'do': 'set', 'values': {'events.log_event': '*'}}),
        (['set', 'events.log_event', ''], {'do': 'set', 'values': {'events.log_event': ''}}),
        (['set', 'events.log_event', '"5"'], {'do': 'set', 'values': {'events.log_event': '5'}}),
        (['set', 'x', '2026-10-18'], {'do': 'set', 'values': {'x': '2026-10-18'}}),
        (['set', 'x', '{a: 1}'], {'do': 'set', 'values': {'x': '{a: 1}'}}),
        (['set', 'x', '[a, b]'], {'do': 'set', 'values': {'x': ['a', 'b']}}),
    ],
    ids=' '.join,
)  # fmt: skip
def test_each_verb_sends_its_command(serving: Serving, words: list[str], request_: dict[str, Any]) -> None:
    """It prints the node's answer; a value is parsed as by ``ros2 param set``."""
    result = run(*words)
    assert (result.return_value, result.stdout) == (0, f'{request_["do"]} is done\n'), result.output
    assert serving.asked[-1] == request_
    assert json.loads(run(*words, '--json').stdout) == {'ok': True, 'robot': 'thor', 'message': f'{request_["do"]} is done'}


def test_a_request_that_the_node_refuses_is_a_finding(serving: Serving) -> None:
    """Exit code 1, and the node's answer on standard error; with --json on standard output."""
    result = run('bag', 'stop')
    assert (result.return_value, result.stdout) == (1, '')
    assert result.stderr.splitlines()[0] == 'shadowhound-data node bag stop: nothing is recorded'
    result = run('bag', 'stop', '--json')
    assert (result.return_value, json.loads(result.stdout)['error']) == (1, 'nothing is recorded')


def test_values_are_printed_as_they_are_written(serving: Serving) -> None:
    """As in a parameter file."""
    assert run('get', 'camera.topics').stdout == '[1, "a"]\n'
    assert json.loads(run('get', 'camera.topics', '--json').stdout)['values'] == {'camera.topics': [1, 'a']}


def test_the_parameters_are_listed(serving: Serving) -> None:
    """All of them, or those of a sensor or group, with a mark for live ones."""
    assert [line.split()[:3] for line in run('params').stdout.splitlines()[1:3]] == [
        ['camera.format', 'jpeg', 'at'], ['camera.rate_hz', '2.0', 'yes']
    ]  # fmt: skip
    assert [each['name'] for each in json.loads(run('params', 'camera', '--json').stdout)['parameters']] == [
        'camera.format', 'camera.rate_hz'
    ]  # fmt: skip
    result = run('params', 'camra')
    assert (result.return_value, result.stdout) == (1, '')
    assert "no parameters of 'camra'; there are camera, camera_info, robot" in result.stderr


def test_a_node_is_selected_by_its_robot(serving: Serving, monkeypatch: pytest.MonkeyPatch) -> None:
    """By option or environment; if several run and none is named, it is an error."""
    assert run('flush', '--robot', 'thor').return_value == 0
    monkeypatch.setenv('SHADOWHOUND_ROBOT', 'tachi')
    result = run('flush')
    assert isinstance(result.exception, NodeUnavailable)
    assert 'no node of tachi is running here, only those of thor' in str(result.exception)
    assert serving.asked[-1] == {'do': 'describe'}
