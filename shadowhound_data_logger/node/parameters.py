"""Converts ROS parameters to frozen settings: the only place in the node that reads them, at startup and later."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import Field, fields
from typing import Any, Final

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from shadowhound_data_logger.core.config import NOT_SETTINGS, Settings, fields_of, is_type
from shadowhound_data_logger.core.errors import DataLoggerError, SettingError
from shadowhound_data_logger.core.expression import conditions
from shadowhound_data_logger.core.options import GROUPS
from shadowhound_data_logger.core.rules import read_rule

FIXED: Final = 'Read at startup: change the parameter file and restart the node.'
MAX_INT: Final = (1 << 63) - 1
ROBOT: Final = 'The first part of every key. If empty: SHADOWHOUND_ROBOT, the namespace, thor for a Go2, or the host name.'
SENSORS: Final = 'The names of the sensors.'
Described = dict[str, Any]
"""A parameter: name, value, description, constraints, read_only, and low and high, which are None without a range."""
_OPEN: Final[Mapping[str, None]] = {'low': None, 'high': None}


class Parameters:
    """The node's parameters. Live ones can be changed; a change is checked as at startup, all or nothing.

    The node must have been created with ``automatically_declare_parameters_from_overrides``.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._changed = False
        self._described: list[Described] = []

    def given(self) -> bool:
        """Whether the file or command line set any of our parameters; call it before ``load`` declares the rest."""
        return any(name.partition('.')[0] not in NOT_SETTINGS for name in self._node.get_parameters_by_prefix(''))

    def load(self) -> Settings:
        """The settings; declares every parameter, so that ``ros2 param list`` shows it. Raises SettingError."""
        settings = self._read()
        _check_topics(self._node, settings)
        self._described = sorted(_declarations(settings), key=lambda each: str(each['name']))
        for each in self._described:
            declare(self._node, each)
        self._node.add_on_set_parameters_callback(self._validate)
        return settings

    def changed(self) -> Settings | None:
        """The current settings; None if no parameter was set since the last call."""
        if not self._changed:
            return None
        self._changed = False
        return self._read()

    # -- for ``commands`` -------------------------------------------------------------------------------------------

    def get(self, names: Sequence[str]) -> dict[str, Any]:
        """Values by name; raises DataLoggerError for an unknown name."""
        for name in names:
            self._check_known(name)
        return {name: plain(self._node.get_parameter(name).value) for name in names}

    def set(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        """Set all or none, as ``ros2 param set`` does; returns whether it succeeded, and why not. Raises DataLoggerError."""
        for name, value in values.items():
            self._check_known(name)
            if value is not None and not _is_parameter(value):
                raise SettingError(name, value, 'true or false, a number of 64 bits, a string, or a list of one of these')
        result = self._node.set_parameters_atomically([parameter(name, value) for name, value in values.items()])
        if not result.successful:
            is_fixed = any(self._node.describe_parameter(name).read_only for name in values)
            return False, f'{result.reason} {FIXED}' if is_fixed else result.reason
        return True, ', '.join(f'{name} = {value}' for name, value in values.items())

    def described(self) -> list[Described]:
        """Each of our parameters with its current value."""
        return [{**each, 'value': plain(self._node.get_parameter(each['name']).value)} for each in self._described]

    def _check_known(self, name: str) -> None:
        if not self._node.has_parameter(name):
            known = [each for each in self._node.get_parameters_by_prefix('') if each.partition('.')[0] not in NOT_SETTINGS]
            near = [each for each in known if each.partition('.')[0] == name.partition('.')[0]]
            there_are = ', '.join(sorted(near or {each.partition('.')[0] for each in known}))
            raise DataLoggerError(f'there is no parameter {name!r}', remedy=f'known are {there_are}')

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether the node could have been started with these values; they apply after ``changed``."""
        try:
            self._read(parameters)
        except SettingError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._changed = True
        return SetParametersResult(successful=True)

    def _read(self, instead: Sequence[Parameter] = ()) -> Settings:
        parameters = {**self._node.get_parameters_by_prefix(''), **{parameter.name: parameter for parameter in instead}}
        given = {name: plain(parameter.value) for name, parameter in parameters.items()}
        return Settings.load(given, os.environ, self._node.get_namespace())


def live(settings: Settings) -> dict[str, Any]:
    """The settings that can be changed at run time, by parameter name."""
    return {name: value for name, value, spec in _flat(settings) if spec.metadata['live']}


def _flat(settings: Settings) -> Iterator[tuple[str, Any, Field[Any]]]:
    """Name, value and field of every setting of a group or a sensor."""
    owners: list[tuple[str, Any]] = [(name, getattr(settings, name)) for name in GROUPS]
    owners += [(sensor.name, sensor) for sensor in settings.sensors]
    for prefix, owner in owners:
        yield from ((f'{prefix}.{spec.name}', getattr(owner, spec.name), spec) for spec in fields(owner) if spec.metadata)


def _declarations(settings: Settings) -> Iterator[Described]:
    """Descriptions of all parameters."""
    for name, value, text in (('robot', '', ROBOT), ('sensors', [sensor.name for sensor in settings.sensors], SENSORS)):
        yield {'name': name, 'value': value, 'description': text, 'constraints': FIXED, 'read_only': True, **_OPEN}
    for name, value, spec in _flat(settings):
        choices, is_live = spec.metadata['choices'], spec.metadata['live']
        constraints = [f'One of {", ".join(choices)}.'] if choices else []
        low, high = _span(spec)
        yield {
            'name': name, 'value': list(value) if isinstance(value, tuple) else value, 'description': spec.metadata['help'],
            'constraints': ' '.join(constraints if is_live else [*constraints, FIXED]), 'read_only': not is_live,
            'low': low, 'high': high,
        }  # fmt: skip


def _span(spec: Field[Any]) -> tuple[float | None, float | None]:
    """The bounds of a number, in its type; an open end is the largest value of the type."""
    low, high = spec.metadata['low'], spec.metadata['high']
    if low is None or not isinstance(spec.default, (int, float)):
        return None, None
    if isinstance(spec.default, float):
        return float(low), sys.float_info.max if high is None else float(high)
    return int(low), MAX_INT if high is None else int(high)


def declare(node: Node, each: Described) -> None:
    """Declare a parameter with its description. Its type is dynamic, so that 5 is accepted for 5.0."""
    descriptor = ParameterDescriptor(
        description=each['description'], additional_constraints=each['constraints'], read_only=each['read_only'],
        dynamic_typing=True,
    )  # fmt: skip
    low, high = each['low'], each['high']
    if isinstance(low, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif low is not None:
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    if node.has_parameter(each['name']):
        node.set_descriptor(each['name'], descriptor)
    else:
        node.declare_parameter(each['name'], each['value'], descriptor, ignore_override=True)


def _is_parameter(value: object) -> bool:
    """Whether ROS has a type for it."""
    if isinstance(value, list):
        kinds = {type(part) for part in value}
        return len(kinds) < 2 and list not in kinds and all(_is_parameter(part) for part in value)
    return isinstance(value, (bool, float, str)) or (isinstance(value, int) and abs(value) <= MAX_INT)


def _check_topics(node: Node, settings: Settings) -> None:
    """Check that every topic name is valid and, once resolved, belongs to a single sensor. Raises SettingError."""
    owners: dict[str, str] = {}
    mission = settings.mission
    for name, given in (('odometry', mission.odometry), ('battery', mission.battery), ('temperature', mission.temperature)):
        for topic in (source for source, _ in fields_of(given) if not is_type(source)):
            _resolve(node, f'mission.{name}', topic, given)
    for topic in settings.events.topics:
        if topic:
            _resolve(node, 'events.topics', topic, list(settings.events.topics))
    for condition in conditions(settings.events.conditions):
        _resolve(node, 'events.conditions', condition.test.source, condition.test.text)
    for name, text in (
        ('upload.when', settings.upload.when),
        ('keep.when', settings.keep.when),
        ('events.when', settings.events.when),
    ):
        rule = read_rule(text, name)
        for topic in rule.topics() if rule is not None else ():
            _resolve(node, name, topic, text)
    for sensor in settings.sensors:
        for topic in sensor.topics:
            name = f'{sensor.name}.topics'
            resolved = _resolve(node, name, topic, list(sensor.topics))
            if resolved in owners:
                text = f'a unique topic; {resolved} is already in {owners[resolved]}'
                raise SettingError(name, list(sensor.topics), text)
            owners[resolved] = name


def _resolve(node: Node, name: str, topic: str, given: object) -> str:
    """The full name of a topic; raises SettingError for an invalid one."""
    try:
        return str(node.resolve_topic_name(topic))
    except (RuntimeError, ValueError) as error:  # one raises RCLError, the other InvalidTopicNameException
        reason = str(error).partition(', at ')[0].partition('\n')[0]
        raise SettingError(name, given, f'valid topic names, not {topic!r} ({reason})') from error


def parameter(name: str, value: Any) -> Parameter:
    """A ROS parameter; None means no value."""
    return Parameter(name, value=value) if value is not None else Parameter(name, Parameter.Type.NOT_SET)


def plain(value: Any) -> Any:
    """A parameter's value as plain Python: arrays as lists."""
    return list(value) if hasattr(value, '__iter__') and not isinstance(value, (str, bytes)) else value
