"""Variables that decide which ROS processes can communicate, of this shell and of the robot's driver. Does not load ROS."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import has_go2_messages
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.status import MiddlewareStatus
from shadowhound_data_logger.doctor.machine import MAX_DOMAIN, Process, processes
from shadowhound_data_logger.doctor.model import Context, Result, error, from_error, info, ok, warning
from shadowhound_data_logger.node.intake.middleware import Middleware, choose
from shadowhound_data_logger.spool import status

NAME: Final = 'ros.environment'
DRIVERS: Final = ('go2_driver', 'sim_go2_node')
"""Programs that publish a Go2's sensors: go2_ros2_sdk's driver, and the simulated one."""
RANGES: Final = ('SUBNET', 'LOCALHOST', 'OFF', 'SYSTEM_DEFAULT')
"""https://docs.ros.org/en/rolling/Tutorials/Advanced/Improved-Dynamic-Discovery.html"""
ZENOH: Final = 'rmw_zenoh_cpp'
ROUTER: Final = ('localhost', 7447)
"""Zenoh's default router, unless a configuration names another one (rmw_zenoh's README)."""
ROUTER_S: Final = 1.0
AGREE: Final = ('ROS_DOMAIN_ID', 'RMW_IMPLEMENTATION', 'ROS_LOCALHOST_ONLY')
DEFAULTS: Final = {'ROS_DOMAIN_ID': '0', 'ROS_LOCALHOST_ONLY': '0'}


def check(context: Context) -> Iterator[Result]:
    """Check domain, discovery, RMW and the driver's variables."""
    environ = context.environ
    yield _domain(environ)
    yield from _range(environ)
    yield from _middleware(environ)
    yield _listener(context)
    yield from _driver(context)


def domain_of(environ: Mapping[str, str]) -> str:
    """The domain as given; 0 if not set."""
    return environ.get('ROS_DOMAIN_ID') or '0'


def middleware(context: Context) -> Middleware:
    """The RMW that a node started here with these settings listens with; raises SettingError."""
    return choose(context.settings.capture.rmw, context.environ)


def running(context: Context) -> MiddlewareStatus | None:
    """The middleware of the running node, from its status; None if none runs."""
    found = status.read(context.settings.spool_path, context.settings.robot, SystemClock.of_this_machine())
    return found.node.middleware if found.running and found.node.middleware.rmw else None


def _listener(context: Context) -> Result:
    """The listener's RMW, and why."""
    name, node = 'ros.listener', running(context)
    try:
        here = middleware(context)
    except SettingError as problem:
        return from_error(name, problem, 'the node does not start with it')
    chosen = node or here
    rmw, robot, why, asked = chosen.rmw, chosen.robot, chosen.why, chosen.asked
    because = f"the robot's is {robot}: {why}" if rmw != robot else why
    verb = 'listens' if node is not None else 'would listen'
    return ok(name, f'the node {verb} with {rmw} ({because}); capture.rmw is {asked}', rmw=rmw, robot=robot, asked=asked)


def _domain(environ: Mapping[str, str]) -> Result:
    name, given = 'ros.domain_id', domain_of(environ)
    if not given.isdecimal() or int(given) > MAX_DOMAIN:
        return error(name, f'ROS_DOMAIN_ID is {given!r}', f'it must be a number from 0 to {MAX_DOMAIN}', 'export ROS_DOMAIN_ID=0')
    return ok(name, f'ROS_DOMAIN_ID is {given}' + (' (not set)' if not environ.get('ROS_DOMAIN_ID') else ''))


def _range(environ: Mapping[str, str]) -> Iterator[Result]:
    name, given = 'ros.discovery', environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '')
    only = environ.get('ROS_LOCALHOST_ONLY', '')
    if given and environ.get('ROS_DISTRO') == 'humble':
        yield warning(
            name,
            f'ROS_AUTOMATIC_DISCOVERY_RANGE is {given}, which Humble does not support',
            'only nodes on this machine are found'
            if only == '1'
            else 'all nodes in the network are found, as if it were not set',
            'unset ROS_AUTOMATIC_DISCOVERY_RANGE; for this machine only: export ROS_LOCALHOST_ONLY=1, for the driver as well',
        )
    elif given and given not in RANGES:
        yield error(
            name,
            f'ROS_AUTOMATIC_DISCOVERY_RANGE is {given!r}',
            f'it must be one of {", ".join(RANGES)}',
            'export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET',
        )
    elif given == 'OFF' and not environ.get('ROS_STATIC_PEERS'):
        yield error(
            name,
            'ROS_AUTOMATIC_DISCOVERY_RANGE is OFF',
            'no other machine is found, and ROS_STATIC_PEERS is not set either',
            'export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET',
        )
    elif given == 'LOCALHOST' or only == '1':
        variable = 'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST' if given == 'LOCALHOST' else 'ROS_LOCALHOST_ONLY=1'
        yield info(name, f'{variable}: only nodes on this machine are found', 'fine if the driver runs here as well')
    else:
        yield ok(name, 'nodes on this machine and in its network are found')


def _middleware(environ: Mapping[str, str]) -> Iterator[Result]:
    given = environ.get('RMW_IMPLEMENTATION', '')
    folders = [Path(prefix) for prefix in environ.get('AMENT_PREFIX_PATH', '').split(':') if prefix]
    there = {path.name for folder in folders for path in folder.glob('share/ament_index/resource_index/rmw_typesupport/*')}
    if given and there and given not in there:
        distro = environ.get('ROS_DISTRO') or 'humble'
        yield error(
            'ros.middleware',
            f'RMW_IMPLEMENTATION is {given}, which is not installed here',
            f'installed: {" and ".join(sorted(there))}',
            f'sudo apt install ros-{distro}-{given.replace("_", "-")}; or: unset RMW_IMPLEMENTATION',
        )
    elif given or there:
        yield ok('ros.middleware', f'the middleware is {given or "the default"}')
    is_configured = environ.get('ZENOH_SESSION_CONFIG_URI') or environ.get('ZENOH_CONFIG_OVERRIDE')
    if given == ZENOH and (given in there or not there) and not is_configured:
        try:
            socket.create_connection(ROUTER, timeout=ROUTER_S).close()
        except OSError as failure:
            yield error(
                'ros.zenoh',
                f'no Zenoh router answers at tcp/{ROUTER[0]}:{ROUTER[1]} ({failure.strerror or failure})',
                'without a router, nodes do not find each other',
                'ros2 run rmw_zenoh_cpp rmw_zenohd',
            )


def _driver(context: Context) -> Iterator[Result]:
    """The driver may run on another machine; if it runs here, its variables must match."""
    found = processes(context.root, *DRIVERS)
    if not found:
        if has_go2_messages(context.environ):
            yield info(
                'ros.driver',
                "the robot's driver is not running on this machine",
                'fine if it runs on another one',
                'ros2 launch go2_robot_sdk robot.launch.py',
            )
        return
    ours = {name: context.environ.get(name) or DEFAULTS.get(name, '') for name in AGREE}
    differ = [
        (driver, name, theirs)
        for driver in found
        if driver.environ
        for name in AGREE
        if (theirs := driver.environ.get(name) or DEFAULTS.get(name, '')) != ours[name]
    ]
    if len({driver.pid for driver, _, _ in differ}) == len(found):  # those that none of them shares
        for driver, name, theirs in differ:
            if driver is differ[0][0]:
                yield _mismatch(driver, name, theirs, ours[name])
    else:
        names = ', '.join(f'{_program(driver)} (process {driver.pid})' for driver in found)
        yield ok('ros.driver', f"the robot's driver runs: {names}")


def _program(driver: Process) -> str:
    """The word of the command line that matched."""
    return next((Path(word).name for word in driver.command.split() if any(name in word for name in DRIVERS)), 'it')


def _mismatch(driver: Process, name: str, theirs: str, ours: str) -> Result:
    seen = f'{name} is {ours or "not set"} here, and {theirs or "not set"} for the driver (process {driver.pid})'
    if name == 'RMW_IMPLEMENTATION':
        remedy = f'export RMW_IMPLEMENTATION={theirs}' if theirs else 'unset RMW_IMPLEMENTATION'
        return warning('ros.driver', seen, 'two middlewares interoperate badly or not at all', remedy)
    remedy = f'export {name}={theirs}  # here and for the node, or the reverse for the driver'
    return error('ros.driver', seen, 'they do not find each other', remedy, theirs=theirs)
