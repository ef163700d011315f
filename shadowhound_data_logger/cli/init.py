"""``shadowhound-data init``: a parameter file for the robot whose ROS graph this machine is in."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, exit_code
from shadowhound_data_logger.cli.output import print_json
from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.config import DEFAULT_SENSORS, SensorSettings, Settings, default_robot
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.keys import is_name, printable
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.ros_arguments import NODE
from shadowhound_data_logger.core.type_rules import not_logged, sensor_for
from shadowhound_data_logger.ros.endpoints import alternatives

if TYPE_CHECKING:
    from shadowhound_data_logger.doctor.ros_watch import WatchedTopic
    from shadowhound_data_logger.ros.endpoints import Endpoint

LOGGER_NODES: Final = frozenset({NODE, 'shadowhound_policy'})
LATCHED_S: Final = 3600.0
"""Assumed period of a topic that is stored on change."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A topic that was found, and what to do with it."""

    topic: str
    type: str
    rate_hz: float
    bytes: float
    """Of a message, as serialized; 0 if none was received."""
    sensor: SensorSettings | None
    why_not: str = ''
    stored_bytes: float | None = None
    """Of a message, as stored; None if none could be encoded."""

    @property
    def mb_per_hour(self) -> float | None:
        """What its sensor stores; None if that is unknown."""
        if self.sensor is None or self.stored_bytes is None:
            return None
        if self.sensor.on_change:
            kept_hz = 1 / LATCHED_S
        else:
            kept_hz = min(self.rate_hz, self.sensor.rate_hz) if self.sensor.rate_hz else self.rate_hz
        return self.stored_bytes * kept_hz * 3600 / 1e6


@click.command(
    epilog=examples(
        'init --to robot.yaml',
        'init --duration 30 --namespace /robot0 --robot robot0 --to robot0.yaml',
        'init | less',
    )
)
@click.option('--to', type=click.Path(path_type=Path, dir_okay=False), metavar='FILE',
              help='Where to write it  [default: standard output]')  # fmt: skip
@click.option('--duration', type=click.FloatRange(1, 600), default=10.0, show_default=True, metavar='S',
              help='Stop after S seconds, or with Ctrl-C.')  # fmt: skip
@click.option('--namespace', default='/', metavar='NAME', show_default=True, help='Namespace of the node, as in -r __ns:=/tachi.')
@click.option(
    '--robot',
    metavar='NAME',
    help='The robot  [default: SHADOWHOUND_ROBOT, otherwise the namespace or the host name]',
)
@click.option('--overwrite', is_flag=True, help='Overwrite the file.')
@as_json
def init(to: Path | None, duration: float, namespace: str, robot: str | None, *, overwrite: bool, as_json: bool) -> ExitCode:
    """Write a parameter file for this robot.

    Listens to the ROS graph, and proposes a sensor for each topic by its type, with the measured rate and size and what it would
    store in an hour. Nothing is published, and nothing else is written.
    """
    if to is not None and to.exists() and not overwrite:
        raise BadUsage(f'{to} exists', 'name another file, or add --overwrite')
    namespace = '/' + namespace.strip('/')
    name = robot or os.environ.get('SHADOWHOUND_ROBOT') or default_robot(os.environ, namespace)
    if not is_name(name):
        raise BadUsage(f'{name!r} is not a name of a robot', '--robot NAME, of letters, digits, - and _')
    if find_spec('rclpy') is None:
        raise DataLoggerError('rclpy cannot be imported', remedy='source ROS in this shell: . /opt/ros/humble/setup.bash')
    click.echo(f'listening for {duration:g} s ...', err=True)
    found = _proposals(duration, namespace, name)
    text = '\n'.join(_yaml(found, name, namespace)) + '\n'
    if to is not None:
        to.write_text(text, encoding='utf-8')
    if as_json:
        print_json({'robot': name, 'topics': [_document(each) for each in found]})
    elif to is None:
        sys.stdout.write(text)
    logged = [each for each in found if each.sensor is not None]
    click.echo(f'{len(logged)} of {len(found)} topics are logged{"" if to is None else f" with {to}"}.', err=True)
    if not found:
        click.echo('No topic has a publisher: is the robot running, and ROS_DOMAIN_ID the same? `shadowhound-data doctor` looks.',
                   err=True)  # fmt: skip
    return exit_code(finding=not found)


def _proposals(seconds: float, namespace: str, robot: str) -> list[Proposal]:
    """By topic."""
    from shadowhound_data_logger.doctor import ros_watch  # noqa: PLC0415 - rclpy
    from shadowhound_data_logger.formats.types import MessageTypes  # noqa: PLC0415

    defaults = Settings.load({}, {**os.environ, 'SHADOWHOUND_ROBOT': robot}, namespace).sensors
    with ros_watch.node(namespace=namespace) as node:
        named = {node.resolve_topic_name(topic): (sensor, topic, types) for sensor in defaults
                 for topic, types in zip(sensor.topics, sensor.types, strict=False)}  # fmt: skip
        published = ros_watch.published(node, within=namespace)
        found = {topic: others for topic, each in published.items() if (others := [one for one in each if not _is_loggers(one)])}
        watched = ros_watch.listen(node, found, seconds, {})
    graph = {one.topic: (one.type,) for one in watched}
    proposals: list[Proposal] = []
    taken: set[str] = set()
    types = MessageTypes()
    for one in sorted(watched, key=lambda one: one.topic):
        sensor, why = _sensor(one, named, graph, taken)
        if one.unavailable:
            sensor, why = None, one.unavailable
        if sensor is not None:
            taken.add(sensor.name)
        stored = _stored_bytes(one, sensor, robot, types) if sensor is not None else None
        proposals.append(
            Proposal(
                one.topic,
                one.type,
                one.rate_hz,
                one.size / one.received if one.received else len(one.newest),
                sensor,
                why,
                stored,
            )
        )
    return proposals


def _is_loggers(publisher: Endpoint) -> bool:
    """Whether a node of this package publishes it."""
    return publisher.node.rpartition('/')[2] in LOGGER_NODES


def _sensor(one: WatchedTopic, named: Mapping[str, tuple[SensorSettings, str, str]], graph: Mapping[str, Sequence[str]],
            taken: set[str]) -> tuple[SensorSettings | None, str]:  # fmt: skip
    """That of the default settings if the topic is one of its topics, else one by the rule for its type; or why none."""
    sensor, _, allowed = named.get(one.topic, (None, '', ''))
    if sensor is not None and sensor.name in taken:
        return None, f'the sensor {sensor.name} takes another topic'
    if sensor is not None and one.type in alternatives(allowed):
        return replace(sensor, enabled=True), ''
    if why := not_logged(one.topic, one.type, graph):
        return None, why
    latched = all(each.transient_local for each in one.publishers)
    return sensor_for(one.topic, one.type, {*taken, *DEFAULT_SENSORS}, is_latched=latched), ''


def _stored_bytes(one: WatchedTopic, sensor: SensorSettings, robot: str, types: Any) -> float | None:
    from shadowhound_data_logger.formats.encoders import encode  # noqa: PLC0415 - numpy and encoders

    if not one.newest:
        return None
    now_ns = time.time_ns()
    batch = Batch(sensor.name, one.topic, one.type, (Sample(now_ns, one.newest, now_ns),), len(one.newest))
    made = encode(batch, sensor, robot, types).object
    return None if made is None else float(len(made.body))


def _document(each: Proposal) -> dict[str, Any]:
    return {
        'topic': each.topic, 'type': each.type, 'rate_hz': each.rate_hz, 'bytes': each.bytes, 'why_not': each.why_not,
        'mb_per_hour': each.mb_per_hour, 'sensor': each.sensor and each.sensor.name,
        'settings': dict(_settings(each.sensor, each)) if each.sensor else {},
    }  # fmt: skip


def _yaml(found: Sequence[Proposal], robot: str, namespace: str) -> Iterator[str]:
    """Lines. JSON scalars and lists are YAML."""
    logged = [each for each in found if each.sensor is not None]
    known = [each.mb_per_hour for each in logged if each.mb_per_hour is not None]
    below = f' -r __ns:={namespace}' if namespace.strip('/') else ''
    yield f'# Settings for {robot}, by `shadowhound-data init`, {iso(time.time_ns())}. Every parameter: docs/parameters.md.'
    yield '#'
    yield f'#   ros2 run shadowhound_data_logger sensor_logger_node --ros-args --params-file FILE{below}'
    yield '#'
    missing = len(logged) - len(known)
    unknown = f'; unknown for {missing} topics without a message that could be encoded' * (missing > 0)
    yield f'# About {sum(known):,.0f} MB per hour as proposed, from one message and the rate of each topic{unknown}.'
    yield '/**:'
    yield '  ros__parameters:'
    yield f'    robot: {json.dumps(robot)}'
    yield f'    sensors: {json.dumps([each.sensor.name for each in logged if each.sensor is not None])}  # nothing else is logged'
    for each in logged:
        assert each.sensor is not None
        yield ''
        yield f'    # {_measured(each)}'
        yield f'    {each.sensor.name}:'
        yield from (f'      {name}: {json.dumps(value)}' for name, value in _settings(each.sensor, each))
    left_out = [each for each in found if each.sensor is None]
    if left_out:
        yield ''
        yield '    # Not logged; for a sensor of your own see docs/extending.md:'
        yield from (f'    #   {_measured(each)}: {printable(each.why_not)}' for each in left_out)


def _measured(each: Proposal) -> str:
    text = f'{printable(each.topic)} ({printable(each.type)}), '
    text += f'{each.rate_hz:.1f} Hz, {each.bytes / 1000:,.1f} KB a message' if each.bytes else 'no message came while listening'
    if each.mb_per_hour is not None and each.sensor is not None:
        text += f'; stored {"once an hour" if each.sensor.on_change else "at this rate"}: {each.mb_per_hour:,.1f} MB per hour'
    return text


def _settings(sensor: SensorSettings, each: Proposal) -> Iterator[tuple[str, Any]]:
    """What differs from the defaults of a sensor of this name; its topic and type in any case."""
    standard = {spec.name: spec.default for spec in fields(SensorSettings) if spec.name != 'name'}
    standard |= DEFAULT_SENSORS.get(sensor.name, {})
    for name, default in standard.items():
        value = getattr(sensor, name)
        if name == 'topics':
            yield name, [each.topic]
        elif name == 'types':
            yield name, [each.type]
        elif value != default:
            yield name, list(value) if isinstance(value, tuple) else value
