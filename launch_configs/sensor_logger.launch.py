"""Launches the data logger, one node per robot, and starts a node again when it crashes.

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
"""Named, since before the first start of the node there is none yet, and the page would be that of the store."""
RESTART_AFTER_S = 2.0
FINAL = (0, 2)
"""Exit codes that mean what they say: asked to stop, and settings that were refused. Starting again would change neither."""
PROFILE_VARIABLES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
"""Fast DDS 3 reads the first and warns of the second, Fast DDS 2 knows the second only."""
FAST_DDS_2 = ('humble', 'iron', 'jazzy')


def profile() -> list[Action]:
    """Name the Fast DDS profile that lets raw images through, unless there is one already."""
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
    """The node of a namespace, and what to do when it ends."""
    node = Node(  # without a name: the node has one, and launch would warn of a second one at each restart
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
        again = LogInfo(msg=f'sensor_logger_node ended with {event.returncode}: it starts again in {RESTART_AFTER_S:g} s')
        return [again, TimerAction(period=RESTART_AFTER_S, actions=logger(namespace, parameters))]

    return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=ended)), node]


def command(*arguments: str | LaunchConfiguration, condition: Condition) -> Action:
    """A verb of ``shadowhound-data``, which starts again whatever ends it. ``Node`` would append --ros-args, which it refuses."""
    return ExecuteProcess(
        cmd=[ExecutableInPackage(package='shadowhound_data_logger', executable='shadowhound-data'), *arguments],
        condition=condition,
        output='screen',
        respawn=True,
        respawn_delay=RESTART_AFTER_S,
    )


def live_page() -> Action:
    """The page on which the robot can be watched, where it is asked for."""
    bind = LaunchConfiguration('live_bind')
    return command('live', '--spool', str(SPOOL), '--bind', bind, condition=IfCondition(LaunchConfiguration('live')))


def policies() -> Action:
    """What follows the registry for a trained policy, where one is named."""
    return command('policy', 'run', '--name', LaunchConfiguration('policy'), condition=LaunchConfigurationNotEquals('policy', ''))


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
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
