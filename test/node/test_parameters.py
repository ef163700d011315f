"""Parameters of a real node: their descriptions, which can be changed at run time, and how invalid values are refused."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

import rclpy
from domains import free_domain
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from shadowhound_data_logger.core.config import SensorSettings, Settings
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.node.parameters import Parameters, live

pytestmark = pytest.mark.ros

GIVEN = {'sensors': ['camera', 'mine'], 'mine.topics': ['mine'], 'camera.rate_hz': 2, 'spool.min_free_bytes': 0}


@pytest.fixture(scope='module')
def node() -> Iterator[Node]:
    """One node for all tests, which do not depend on the values that others set."""
    context = Context()
    with free_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = Node(
            'sensor_logger_node', context=context, automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[Parameter(name, value=value) for name, value in GIVEN.items()],
        )  # fmt: skip
        yield node
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.fixture(scope='module')
def loaded(node: Node) -> tuple[Parameters, Settings]:
    parameters = Parameters(node)
    return parameters, parameters.load()


def sensor(settings: Settings | None, name: str = 'camera') -> SensorSettings:
    assert settings is not None
    return next(sensor for sensor in settings.sensors if sensor.name == name)


@pytest.mark.parametrize(('section', 'given'), [('/**', True), ('sensor_logger_node', True), ('sensor_loger_node', False)])
def test_a_file_for_another_node_gives_nothing(tmp_path: Path, section: str, *, given: bool) -> None:
    """A misspelled section is not an error to rcl: the missing parameters are the only sign of it."""
    file = tmp_path / 'mine.yaml'
    file.write_text(f'{section}:\n  ros__parameters:\n    camera:\n      rate_hz: 2.0\n')
    context = Context()
    with free_domain() as domain:
        rclpy.init(args=['--ros-args', '--params-file', str(file)], context=context, domain_id=domain)
        node = Node('sensor_logger_node', context=context, automatically_declare_parameters_from_overrides=True)
        assert Parameters(node).given() is given
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_every_setting_is_a_parameter(node: Node, loaded: tuple[Parameters, Settings]) -> None:
    """Including those of a custom sensor, with the values in use; unused sensors have none."""
    names = node.get_parameters_by_prefix('')
    for name in ('robot', 'sensors', 'queue.max_bytes', 'camera.quality', 'mine.rate_hz', 'mine.types'):
        assert name in names
    assert not [name for name in names if name.startswith('imu.')]
    assert node.get_parameter('mine.rate_hz').value == sensor(loaded[1], 'mine').rate_hz
    assert list(node.get_parameter('mine.topics').value) == ['mine']


@pytest.mark.parametrize('name', ['camera.rate_hz', 'camera.quality', 'mine.enabled', 'queue.max_bytes', 'robot'])
def test_every_parameter_is_described(node: Node, loaded: tuple[Parameters, Settings], name: str) -> None:
    """With its help text, set in the file or not; settings that cannot be changed at run time are read-only and say why."""
    descriptor = node.describe_parameter(name)
    assert descriptor.description
    assert descriptor.read_only is (name not in live(loaded[1]))
    assert descriptor.read_only is ('restart the node' in descriptor.additional_constraints)


def test_the_ranges_are_those_of_the_settings(node: Node, loaded: tuple[Parameters, Settings]) -> None:
    """No default is outside, and an open range ends at the largest number."""
    assert loaded
    (quality,) = node.describe_parameter('camera.quality').integer_range
    assert (quality.from_value, quality.to_value) == (1, 100)
    (rate,) = node.describe_parameter('camera.rate_hz').floating_point_range
    assert (rate.from_value, rate.to_value) == (0.0, 1e6)
    (size,) = node.describe_parameter('queue.max_bytes').integer_range
    assert (size.from_value, size.to_value) == (1 << 20, (1 << 63) - 1)
    assert 'One of jpeg' in node.describe_parameter('camera.format').additional_constraints


@pytest.mark.parametrize(
    ('name', 'value'),
    [('rate_hz', 5.0), ('rate_hz', 7), ('quality', 60), ('priority', 0), ('enabled', False), ('enabled', True)],
)
def test_a_live_parameter_is_changed(node: Node, loaded: tuple[Parameters, Settings], name: str, value: float) -> None:
    """The settings are read again with the new value, which may be an integer for a float."""
    result = node.set_parameters_atomically([Parameter(f'camera.{name}', value=value)])
    assert result.successful, result.reason
    assert getattr(sensor(loaded[0].changed()), name) == value
    assert loaded[0].changed() is None


def test_the_cap_of_the_upload_is_changed(node: Node, loaded: tuple[Parameters, Settings]) -> None:
    """Settings that belong to no sensor can be changed, too."""
    assert node.set_parameters_atomically([Parameter('upload.max_mbps', value=2.5)]).successful
    settings = loaded[0].changed()
    assert settings
    assert settings.upload.max_mbps == 2.5


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('camera.rate_hz', -1.0, ('camera.rate_hz', '-1.0', '0.0')),
        ('camera.rate_hz', 1e-9, ('camera.rate_hz', '1e-09', 'at least 0.0001')),
        ('camera.rate_hz', 'fast', ('camera.rate_hz', "'fast'", 'a number')),
        ('camera.quality', 101, ('camera.quality', '101', '100')),
        ('camera.quality', 60.5, ('camera.quality', '60.5', 'a whole number')),
        ('camera.enabled', 1, ('camera.enabled', '1', 'true or false')),
        ('camera.format', 'png', ('camera.format', 'read-only')),
        ('sensors', ['camera'], ('sensors', 'read-only')),
    ],
)
def test_a_wrong_value_is_refused(
    node: Node, loaded: tuple[Parameters, Settings], name: str, value: object, words: tuple[str, ...]
) -> None:
    """With the name, the value and what is allowed; the old value stays in effect."""
    before = node.get_parameter(name).value
    result = node.set_parameters_atomically([Parameter(name, value=value)])
    assert not result.successful
    assert all(word in result.reason for word in words), result.reason
    assert node.get_parameter(name).value == before
    assert loaded[0].changed() is None


def test_several_are_set_together_or_not_at_all(node: Node, loaded: tuple[Parameters, Settings]) -> None:
    """One refused parameter refuses all others of the call, ours and those of ROS itself."""
    good = Parameter('camera.priority', value=9)
    for bad in (Parameter('mine.rate_hz', value=1e-9), Parameter('use_sim_time', value='maybe')):
        assert not node.set_parameters_atomically([good, bad]).successful
        settings = loaded[0].changed()
        assert settings is None or sensor(settings).priority != 9
    assert node.set_parameters_atomically([good, Parameter('mine.rate_hz', value=3.0)]).successful
    settings = loaded[0].changed()
    assert (sensor(settings).priority, sensor(settings, 'mine').rate_hz) == (9, 3.0)


def test_a_live_parameter_is_not_deleted(node: Node, loaded: tuple[Parameters, Settings]) -> None:
    """A parameter without a value would be a setting without one."""
    result = node.set_parameters_atomically([Parameter('camera.rate_hz', Parameter.Type.NOT_SET)])
    assert not result.successful
    assert loaded[0].changed() is None
    assert node.has_parameter('camera.rate_hz')


@pytest.mark.parametrize('other', ['/mine', 'mine', '/talk'])
def test_two_sensors_with_one_topic_stop_the_start(other: str) -> None:
    """Also under two names, with and without the slash or by a remapping: each topic has one sensor."""
    context = Context()
    given = {'sensors': ['first', 'second'], 'first.topics': ['mine'], 'second.topics': [other]}
    with free_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = Node('sensor_logger_node', context=context, automatically_declare_parameters_from_overrides=True,
                    cli_args=['--ros-args', '-r', '/talk:=/mine'],
                    parameter_overrides=[Parameter(name, value=value) for name, value in given.items()])  # fmt: skip
        try:
            with pytest.raises(SettingError, match=r'second\.topics') as refused:
                Parameters(node).load()
        finally:
            node.destroy_node()
            rclpy.shutdown(context=context)
    assert 'first.topics' in str(refused.value)
