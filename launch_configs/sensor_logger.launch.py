"""Launches the data logger, one node per robot, and restarts a node that crashes.

ros2 launch shadowhound_data_logger sensor_logger.launch.py namespace:=tachi params_file:=/path/to/my.yaml live:=true
ros2 launch shadowhound_data_logger sensor_logger.launch.py robots:=robot0,robot1
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.condition import Condition
from launch.conditions import IfCondition, LaunchConfigurationNotEquals
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

FOLDER = Path(__file__).resolve().parent
SPOOL = Path(os.environ.get('SHADOWHOUND_HOME') or '~/.shadowhound').expanduser() / 'spool'
"""Passed to the page, which would otherwise be that of the store until the node has run for the first time."""
RESTART_AFTER_S = 2.0
FINAL = (0, 2)
"""Exit codes after which the node is not restarted: stopped on request, and invalid settings."""
PROFILE_VARIABLES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
"""Fast DDS 3 reads the first and warns about the second, Fast DDS 2 reads the second only."""
FAST_DDS_2 = ('humble', 'iron', 'jazzy')


def profile() -> list[Action]:
    """Set the Fast DDS profile with which raw images arrive, unless one is set."""
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        return []
    variable = PROFILE_VARIABLES[os.environ.get('ROS_DISTRO') in FAST_DDS_2]
    return [SetEnvironmentVariable(variable, str(FOLDER / 'fastdds_shm.xml'))]


def loggers(context: LaunchContext) -> list[Action]:
    """A node per robot: in each namespace of ``robots``, or one in ``namespace``."""
    robots = [name.strip() for name in LaunchConfiguration('robots').perform(context).split(',') if name.strip()]
    namespaces = robots or [LaunchConfiguration('namespace').perform(context)]
    file = LaunchConfiguration('params_file').perform(context)
    return [action for namespace in namespaces for action in logger(namespace, [file] if file else [])]


def logger(namespace: str, parameters: list[str]) -> list[Action]:
    """The node of a namespace, and what to do when it exits."""
    node = Node(  # without a name, because the node has one, and launch would warn about a second one at each restart
        package='shadowhound_data_logger',
        executable='sensor_logger_node',
        namespace=namespace,
        parameters=parameters,
        output='screen',
        emulate_tty=True,
    )

    def ended(event: ProcessExited, context: LaunchContext) -> list[Any]:
        if event.returncode in FINAL or context.is_shutdown:
            return []
        again = LogInfo(msg=f'sensor_logger_node exited with {event.returncode}: it is restarted in {RESTART_AFTER_S:g} s')
        return [again, TimerAction(period=RESTART_AFTER_S, actions=logger(namespace, parameters))]

    return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=ended)), node]


def command(*arguments: str | LaunchConfiguration, condition: Condition) -> Action:
    """A verb of ``shadowhound-data``, always restarted. Not a ``Node``, which would append --ros-args."""
    return ExecuteProcess(
        cmd=[ExecutableInPackage(package='shadowhound_data_logger', executable='shadowhound-data'), *arguments],
        condition=condition,
        output='screen',
        respawn=True,
        respawn_delay=RESTART_AFTER_S,
    )


def live_page() -> Action:
    """The live page, with ``live:=true``."""
    bind = LaunchConfiguration('live_bind')
    return command('live', '--spool', str(SPOOL), '--bind', bind, condition=IfCondition(LaunchConfiguration('live')))


def policies() -> Action:
    """The process that follows the registry for a trained policy, with ``policy:=NAME``."""
    return command('policy', 'run', '--name', LaunchConfiguration('policy'), condition=LaunchConfigurationNotEquals('policy', ''))


def generate_launch_description() -> LaunchDescription:
    """The entry point of `ros2 launch`."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('params_file', default_value='', description='The parameter file.'),
            DeclareLaunchArgument('namespace', default_value='', description='Namespace of the robot.'),
            DeclareLaunchArgument('robots', default_value='', description='Namespaces of several robots: a node for each.'),
            DeclareLaunchArgument('live', default_value='false', description='Serve the live page too.'),
            DeclareLaunchArgument('live_bind', default_value='127.0.0.1', description='Where it listens.'),
            DeclareLaunchArgument('policy', default_value='', description='Follow the registry for this policy.'),
            *profile(),
            OpaqueFunction(function=loggers),
            live_page(),
            policies(),
        ]
    )
