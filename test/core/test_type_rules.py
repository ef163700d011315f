"""Logging of topics without a configured sensor: by type, under unique names."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.config import Settings, default_parameters
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.options import ALL, AUTO, NAMED
from shadowhound_data_logger.core.type_rules import RULES, is_of_unitree, sensor_for


@pytest.mark.parametrize('type_name', RULES)
@pytest.mark.parametrize('is_latched', [False, True])
def test_every_rule_is_a_sensor_that_the_settings_would_accept(type_name: str, is_latched: bool) -> None:
    """Its format, rate and batches are consistent."""
    sensor = sensor_for('/a/b', type_name, (), is_latched=is_latched)
    assert sensor is not None
    default = default_parameters()
    given = {
        'sensors': ['a_b'],
        **{f'a_b.{name}': getattr(sensor, name) for name in ('rate_hz', 'on_change', 'batch_s', 'format')},
    }
    (again,) = Settings.load({**given, 'a_b.topics': ['/a/b'], 'a_b.types': [type_name]}, {}).sensors
    assert (again.rate_hz, again.format) == (sensor.rate_hz, sensor.format)
    assert 'capture.topics' in default


def test_latched_topics_are_kept_when_they_change() -> None:
    """For any type, except that images and clouds keep their rate."""
    latched = sensor_for('/robot_description', 'std_msgs/msg/String', (), is_latched=True)
    picture = sensor_for('/c', 'sensor_msgs/msg/Image', (), is_latched=True)
    assert latched is not None
    assert picture is not None
    assert (latched.on_change, latched.rate_hz, latched.batch_s) == (True, 0.0, 0.0)
    assert (picture.on_change, picture.rate_hz) == (False, 1.0)


@pytest.mark.parametrize(('topic', 'taken', 'name'), [
    ('/scan', (), 'scan'), ('/robot0/front/scan', (), 'robot0_front_scan'), ('/imu', ('imu',), 'imu_2'),
    ('/imu', ('imu', 'imu_2'), 'imu_3'), ('/capture', (), 'capture_2'), ('/robot', (), 'robot_2'), ('/spool', (), 'spool_2'),
])  # fmt: skip
def test_topics_get_sensor_names(topic: str, taken: tuple[str, ...], name: str) -> None:
    """That of the topic, unless another sensor or group of settings has it."""
    sensor = sensor_for(topic, 'std_msgs/msg/Bool', taken, is_latched=False)
    assert sensor is not None
    assert (sensor.name, sensor.topics) == (name, (topic,))


def test_a_type_without_a_rule_is_recorded_as_serialized() -> None:
    assert sensor_for('/led', 'std_msgs/msg/ColorRGBA', (), is_latched=False) is None


def test_the_types_of_a_unitree_are_known() -> None:
    assert is_of_unitree('unitree_go/msg/LowState')
    assert is_of_unitree('go2_interfaces/msg/IMU')
    assert not is_of_unitree('sensor_msgs/msg/Imu')


def test_listed_sensors_are_all_that_is_logged() -> None:
    """Unless the settings select all topics."""
    assert Settings.load({}, {}).capture.topics == AUTO
    assert Settings.load({'sensors': ['imu']}, {}).capture.topics == NAMED
    assert Settings.load({'sensors': ['imu'], 'capture.topics': ALL}, {}).capture.topics == ALL
    with pytest.raises(SettingError, match=r'capture\.topics'):
        Settings.load({'capture.topics': 'none'}, {})
