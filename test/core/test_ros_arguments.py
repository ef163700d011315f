"""Parameters of the command line, read as rcl reads them but without it."""

from __future__ import annotations

from pathlib import Path

import pytest

from shadowhound_data_logger.core.ros_arguments import ParametersUnreadable, parameter, read_parameters, rules_for

NAME = 'capture.rmw'


def test_the_last_argument_counts(tmp_path: Path) -> None:
    """Files and individual parameters in order; arguments before --ros-args or after -- are ignored."""
    file = tmp_path / 'a.yaml'
    file.write_text('/**:\n  ros__parameters: {capture: {rmw: robot}}\n')
    ros = ['--ros-args', '--params-file', str(file)]
    assert parameter(ros, NAME) == 'robot'
    assert parameter([*ros, '-p', 'capture.rmw:=fastrtps'], NAME) == 'fastrtps'
    assert parameter(['--ros-args', '-p', 'capture.rmw:=fastrtps', *ros[1:]], NAME) == 'robot'
    assert parameter([*ros, '--', '-p', 'capture.rmw:=fastrtps'], NAME) == 'robot'
    assert parameter([*ros, '--', '--ros-args', '--param', 'sensor_logger_node:capture.rmw:=auto'], NAME) == 'auto'
    assert parameter([*ros, '-p', 'other_node:capture.rmw:=auto'], NAME) == 'robot'
    assert parameter(['-p', 'capture.rmw:=auto'], NAME) is None
    assert parameter([], NAME) is None


@pytest.mark.parametrize(
    ('section', 'namespace', 'counts'),
    [
        ('/**', '', True), ('/**', '/tachi', True), ('sensor_logger_node', '', True), ('/sensor_logger_node', '', True),
        ('/sensor_logger_node', '/tachi', False), ('/tachi/sensor_logger_node', '/tachi', True),
        ('/*/sensor_logger_node', '/tachi', True), ('/*/sensor_logger_node', '', False),
        ('/**/sensor_logger_node', '/a/b', True), ('/**/sensor_logger_node', '', True), ('/tachi/**', '/tachi', True),
        ('/tachi/**', '/other', False), ('/other_node', '', False),
    ],
)  # fmt: skip
def test_only_sections_of_this_node_apply(section: str, namespace: str, counts: bool, tmp_path: Path) -> None:
    """By the node's full name, with rcl's wildcards."""
    file = tmp_path / 'a.yaml'
    file.write_text(f'"{section}":\n  ros__parameters:\n    capture.rmw: robot\n')
    arguments = ['--ros-args', '-r', f'__ns:={namespace or "/"}', '--params-file', str(file)]
    assert parameter(arguments, NAME) == ('robot' if counts else None)


def test_namespaces_are_nested_keys(tmp_path: Path) -> None:
    """A namespace may be a key above the node's; without a name to look for, every namespace matches."""
    file = tmp_path / 'a.yaml'
    file.write_text('tachi:\n  sensor_logger_node:\n    ros__parameters: {robot: tachi}\nother:\n  ros__parameters: {robot: x}\n')
    assert read_parameters(file) == read_parameters(file, '/tachi/sensor_logger_node') == {'robot': 'tachi'}
    assert read_parameters(file, '/sensor_logger_node') == {}


@pytest.mark.parametrize('text', ['sensor_logger_node: {}', 'a: [', '3', 'a: {b: {c: 1}}'])
def test_an_invalid_parameter_file_is_refused(text: str, tmp_path: Path) -> None:
    """The error names it."""
    file = tmp_path / 'a.yaml'
    file.write_text(text)
    with pytest.raises(ParametersUnreadable, match=r'a\.yaml is not a parameter file'):
        parameter(['--ros-args', '--params-file', str(file)], NAME)


def test_remapping_rules_for_other_nodes_do_not_apply() -> None:
    """Without the node's name; rules for all nodes, for another one, or for a topic of that name are not returned."""
    arguments = [
        '-r',
        'a:x:=/no',
        '--ros-args',
        '-r',
        'a:x:=/y',
        '-r',
        'x:=/z',
        '--remap',
        'b:x:=/z',
        '-r',
        'a:=c',
        '-r',
        'a:__ns:=/n',
    ]
    assert rules_for(arguments, 'a') == ['x:=/y', '__ns:=/n']
