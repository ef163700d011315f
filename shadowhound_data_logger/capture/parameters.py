"""ROS parameters in, frozen settings out: the one place of the node that reads them."""

from __future__ import annotations

import os
from typing import Any, Final

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from shadowhound_data_logger.config import DEFAULT_SENSORS, FOREIGN, Settings, default_parameters
from shadowhound_data_logger.errors import SettingError

FIXED: Final = 'settings are read at the start: change the parameter file and start the node again'


def load(node: Node) -> Settings:
    """The node's settings; every parameter with a default is declared, so that ``ros2 param list`` shows it.

    The node must have been made with ``automatically_declare_parameters_from_overrides``. Raises SettingError.
    """
    given = {name: _plain(parameter.value) for name, parameter in node.get_parameters_by_prefix('').items()}
    settings = Settings.load(given, os.environ, node.get_namespace())
    _check_topics(node, settings)
    unused = set(DEFAULT_SENSORS) - {sensor.name for sensor in settings.sensors}
    for name, default in default_parameters().items():
        if name.partition('.')[0] not in unused and not node.has_parameter(name):
            node.declare_parameter(name, default)
    node.add_on_set_parameters_callback(_refuse)
    return settings


def _check_topics(node: Node, settings: Settings) -> None:
    """Every topic has a valid name and, once resolved (namespace, remapping), a single sensor. Raises SettingError."""
    owners: dict[str, str] = {}
    for sensor in settings.sensors:
        for topic in sensor.topics:
            name = f'{sensor.name}.topics'
            try:
                resolved = node.resolve_topic_name(topic)
            except (RuntimeError, ValueError) as error:  # RCLError is the one, InvalidTopicNameException the other
                reason = str(error).partition(', at ')[0].partition('\n')[0]
                raise SettingError(name, list(sensor.topics), f'valid topic names, not {topic!r} ({reason})') from error
            if resolved in owners:
                text = f'a topic of its own, and {resolved} is in {owners[resolved]} already'
                raise SettingError(name, list(sensor.topics), text)
            owners[resolved] = name


def _plain(value: Any) -> Any:
    """A parameter's value as plain Python: arrays as lists."""
    return list(value) if hasattr(value, '__iter__') and not isinstance(value, (str, bytes)) else value


def _refuse(parameters: list[Parameter]) -> SetParametersResult:
    ours = [parameter.name for parameter in parameters if parameter.name.split('.')[0] not in FOREIGN]
    return SetParametersResult(successful=not ours, reason=FIXED if ours else '')
