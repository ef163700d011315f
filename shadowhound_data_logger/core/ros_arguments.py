"""Reads the command line and the parameter files of a node without ROS.

https://docs.ros.org/en/humble/How-To-Guides/Node-arguments.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import DataLoggerError

NODE: Final = 'sensor_logger_node'


class ParametersUnreadable(DataLoggerError):
    """A file is not a valid parameter file."""


def parameter(arguments: Sequence[str], name: str) -> Any:
    """The value that the command line gives to a parameter of our node, the last one if several; None if not given.

    Raises ParametersUnreadable. Errors that rcl itself reports are not checked here.
    """
    words = list(_of_ros(arguments))
    rules = dict(rule for flag, value in words if flag in {'-r', '--remap'} and (rule := _rule(value))[0] in {'__ns', '__node'})
    node = rules.get('__node') or NODE
    full = f'{rules.get("__ns", "").rstrip("/")}/{node}'
    found: Any = None
    for flag, value in words:
        if flag == '--params-file':
            found = read_parameters(Path(value), full).get(name, found)
        elif flag in {'-p', '--param'}:
            key, given = _rule(value)
            if key in {name, f'{node}:{name}'}:
                found = given
    return found


def rules_for(arguments: Sequence[str], node: str) -> list[str]:
    """The remap rules for the node of this name only, without its name: ``odom:=/x`` of ``NODE:odom:=/x``."""
    rules = (value for flag, value in _of_ros(arguments) if flag in {'-r', '--remap'})
    return [rule.removeprefix(f'{node}:') for rule in rules if rule.startswith(f'{node}:') and not rule.startswith(f'{node}:=')]


def read_parameters(path: Path, node: str | None = None) -> dict[str, Any]:
    """The parameters of a ROS 2 parameter file for a node, flat. Raises ParametersUnreadable.

    ``node`` is its full name; without it every section for our node counts, whatever its namespace.
    """
    try:
        import yaml  # noqa: PLC0415 - rclpy needs it, too; without ROS it may be missing, and then there are no such files
    except ImportError as error:
        raise ParametersUnreadable(f'{path} cannot be read: {error}', remedy='pip install pyyaml') from error
    try:
        given = yaml.safe_load(path.read_text(encoding='utf-8')) or {}
        flat: dict[str, Any] = {}
        for section, content in _sections(given):
            of_any = node is None and section.rpartition('/')[2] in {NODE, '*', '**'}
            if of_any or _pattern(section).fullmatch(node or f'/{NODE}'):
                flat |= _flat(content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
        text = f'{path} is not a parameter file: {error}'
        raise ParametersUnreadable(text, remedy='see launch_configs/go2.yaml') from error
    return flat


def _of_ros(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(flag, value) of the arguments between ``--ros-args`` and ``--``."""
    inside, flag = False, ''
    for word in arguments:
        if word == '--ros-args':
            inside, flag = True, ''
        elif word == '--':
            inside = False
        elif inside and flag:
            yield flag, word
            flag = ''
        elif inside and word in {'-p', '--param', '--params-file', '-r', '--remap'}:
            flag = word


def _rule(text: str) -> tuple[str, str]:
    """Both sides of ``name:=value``."""
    name, _, value = text.partition(':=')
    return name, value


def _sections(given: Mapping[str, Any], above: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(full name of the node, its parameters); namespaces may be separate keys."""
    for name, content in given.items():
        full = name if name.startswith('/') and not above else f'{above}/{name.strip("/")}'
        if 'ros__parameters' in content:
            yield full, content['ros__parameters']
        elif above or not content:
            raise KeyError('ros__parameters')
        else:
            yield from _sections(content, full)


def _pattern(section: str) -> re.Pattern[str]:
    """``*`` matches one part of a name, ``**`` any number of parts."""
    parts = section.strip('/').split('/')
    return re.compile(''.join({'**': r'(?:/\w+)*', '*': r'/\w+'}.get(part, '/' + re.escape(part)) for part in parts))


def _flat(given: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in given.items():
        flat |= _flat(value, f'{prefix}{name}.') if isinstance(value, dict) else {f'{prefix}{name}': value}
    return flat
