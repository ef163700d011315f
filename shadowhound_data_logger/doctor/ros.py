"""The robot's topics: publishers, QoS, rates and types. Runs in a child process."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from shadowhound_data_logger.core.config import DEFAULT_ROBOT, SensorSettings, has_go2_messages
from shadowhound_data_logger.core.errors import Rejected, SettingError
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.options import AUTO, COMPRESSED_IMAGE, IMAGE, NAMED, POINT_CLOUD
from shadowhound_data_logger.core.ros_arguments import NODE
from shadowhound_data_logger.core.type_rules import is_of_unitree, not_logged, sensor_for
from shadowhound_data_logger.doctor.machine import domains, processes
from shadowhound_data_logger.doctor.model import Context, Result, error, info, ok, warning
from shadowhound_data_logger.doctor.ros_environment import DRIVERS, domain_of, middleware
from shadowhound_data_logger.formats.records import TRANSFORMS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.middleware import Middleware
from shadowhound_data_logger.ros.endpoints import Endpoint, alternatives, logged_type

if TYPE_CHECKING:
    from shadowhound_data_logger.doctor.ros_watch import WatchedTopic


class Stream(NamedTuple):
    """The expected properties of a topic."""

    rate_hz: float
    reliable: bool | None = None
    """None if either is fine."""
    optional: bool = False
    """Whether many robots lack it."""


STREAMS: Final = {
    'camera/image_raw': Stream(30.0),
    'camera/compressed': Stream(30.0),
    'camera/camera_info': Stream(30.0),
    'point_cloud2': Stream(10.0),
    'imu': Stream(100.0, reliable=True),
    'odom': Stream(50.0, reliable=True),
    'go2_states': Stream(20.0, reliable=True),
    'joint_states': Stream(50.0, reliable=True),
    'lowstate': Stream(20.0, optional=True),
    'utlidar/voxel_map_compressed': Stream(10.0, optional=True),
}
"""Of a Unitree Go2, by topic."""
UNKNOWN: Final = Stream(0.0)
"""No expectations."""


NAME: Final = 'ros'
WINDOW_S: Final = 2.5
PEEK_S: Final = 1.2
MAX_PEEKS: Final = 3
MAX_SHOWN: Final = 8
"""Maximum topics named in a result."""
MAX_NODES: Final = 3
TOO_SLOW, TOO_LOSSY = 0.5, 0.1
"""Below half of the expected rate; more than a tenth lost."""
MIN_EXPECTED: Final = 4
"""Minimum number of expected messages in the window for a rate to be meaningful."""
STEADY: Final = frozenset({
    COMPRESSED_IMAGE, IMAGE, POINT_CLOUD, 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/JointState',
    'sensor_msgs/msg/LaserScan', 'sensor_msgs/msg/MagneticField', 'sensor_msgs/msg/NavSatFix', 'sensor_msgs/msg/Range',
})  # fmt: skip
"""Types of sensors that publish all the time: silence is a fault, whatever their rate."""
MAX_FOUND: Final = 100
"""Maximum topics that no sensor names to listen to."""
TYPES_REMEDY: Final = '. ~/ros2_ws/install/setup.bash  # or: colcon build --packages-select {package} && . install/setup.bash'
OURS_REMEDY: Final = (
    'colcon build --base-paths src/shadowhound_data_logger/interfaces/{package} && . install/setup.bash  # in the workspace'
)
TF: Final = '/tf'
STALE_S: Final = 5.0
"""Maximum age of a current transform: localization is late, and the clocks of two machines differ."""
DRIVER: Final = 'go2_interfaces'
"""Used while nothing is published at all: the driver may start later."""


def check(context: Context) -> Iterator[Result]:
    """Check the topics of all sensors."""
    if find_spec('rclpy') is None:
        yield error(
            'ros.sourced',
            'rclpy cannot be imported',
            'ROS is not sourced in this shell',
            '. /opt/ros/humble/setup.bash && . ~/ros2_ws/install/setup.bash',
        )
        return
    listener = _listener(context)
    if listener is not None:
        listener.enter(os.environ)  # before ROS is loaded, as in the node
    from shadowhound_data_logger.doctor import ros_watch  # noqa: PLC0415 - rclpy: a second, and not installed everywhere

    sensors = [sensor for sensor in context.settings.sensors if sensor.enabled]
    with _profiled(listener), ros_watch.node(namespace=context.namespace) as node:
        resolved = {topic: node.resolve_topic_name(topic) for sensor in sensors for topic in sensor.topics}
        names = list(dict.fromkeys(resolved.values()))
        found = ros_watch.discover(node, names)
        pairs = [pair for sensor in sensors for pair in zip(sensor.topics, sensor.types, strict=False)]
        types = {resolved[topic]: logged_type(found[resolved[topic]], name) for topic, name in pairs}
        packages = {each.type.partition('/')[0] for publishers in found.values() for each in publishers}
        is_unitree = any(map(is_of_unitree, (f'{name}/' for name in packages)))
        own = {sensor.name for sensor in sensors}
        if context.settings.capture.topics != NAMED and not (is_unitree and context.settings.capture.topics == AUTO):
            for sensor, publishers in _found(ros_watch.in_graph(node, context.namespace), own, set(names)):
                (topic,), (types[topic],) = sensor.topics, sensor.types
                sensors.append(sensor)
                resolved[topic], found[topic] = topic, publishers
        if publishers := ros_watch.publishers_of(node, TF):
            found[TF] = publishers
        watched = {one.topic: one for one in ros_watch.listen(node, found, WINDOW_S, types)} if any(found.values()) else {}
        others = [] if watched else list(ros_watch.published(node))
        waiting = ros_watch.waiting_for_clock(node)
    yield from _clock(waiting)
    configured = [sensor for sensor in sensors if sensor.name in own]
    yield from _types(configured, packages | {DRIVER} if not watched and is_go2(context) else packages)
    if not watched:
        yield from _no_publishers(context, names, listener, others)
        return
    if TF in watched:
        yield from _transforms(watched[TF])
    is_complete = context.settings.capture.topics == NAMED or DRIVER in packages
    streams = STREAMS if is_unitree else {}
    for sensor in sensors:
        topics = [watched[resolved[topic]] for topic in sensor.topics]
        if is_complete or any(one.publishers for one in topics):  # only the driver of a Go2 publishes all of the default sensors
            yield from _sensor(sensor, topics, context.rates_hz, streams)


def _found(
    graph: Mapping[str, Sequence[Endpoint]], names: Collection[str], topics: Collection[str]
) -> Iterator[tuple[SensorSettings, list[Endpoint]]]:
    """The sensors that the node adds for topics besides ``topics``, with their publishers; ``names`` are taken."""
    taken = set(names)
    types = {topic: [each.type for each in publishers] for topic, publishers in graph.items()}
    for topic in sorted(graph.keys() - topics):
        publishers = [each for each in graph[topic] if not each.node.endswith(f'/{NODE}')]
        if not publishers or not_logged(topic, publishers[0].type, types):
            continue
        latched = all(each.transient_local for each in publishers)
        sensor = sensor_for(topic, publishers[0].type, taken, is_latched=latched)
        if sensor is not None and len(taken) - len(names) < MAX_FOUND:
            taken.add(sensor.name)
            yield sensor, publishers


def is_go2(context: Context) -> bool:
    """Whether the robot is a Go2 as far as this machine and the settings show, without its topics."""
    settings = context.settings
    named = (name for sensor in settings.sensors if sensor.name not in settings.assumed for name in sensor.types)
    return has_go2_messages(context.environ) or settings.robot == DEFAULT_ROBOT or any(map(is_of_unitree, named))


def _clock(waiting: Sequence[str]) -> Iterator[Result]:
    """Report nodes that take their time from a simulator that is not running."""
    if waiting:
        shown = [printable(name) for name in waiting[:MAX_SHOWN]]
        yield warning(
            'ros.clock',
            f'{", ".join(shown)} use sim time, and nothing publishes /clock',
            'the time of these nodes is 0: their messages are dated by arrival',
            f'start the simulator, or: ros2 param set {shown[0]} use_sim_time false',
        )


def _transforms(one: WatchedTopic) -> Iterator[Result]:
    """Report frames that do not update."""
    if one.unavailable:
        return
    if not one.received:
        text = f'{TF} has a publisher, but no transform arrived in {WINDOW_S:g} s'
    elif (age_s := _age_s(one.newest)) > STALE_S:
        text = f'the newest transform on {TF} is {age_s:.0f} s old'
    else:
        yield ok('ros.tf', f'{TF} has {one.rate_hz:.0f} messages per second')
        return
    yield warning(
        'ros.tf',
        text,
        'the pose of the robot is unknown or outdated',
        f'ros2 topic hz {TF} ; ros2 run tf2_ros tf2_monitor',
    )


def _age_s(cdr: bytes) -> float:
    """Age of the newest transform in a message; 0 if it has none."""
    try:
        stamps = [each.header.stamp for each in MessageTypes().deserialize(TRANSFORMS, cdr).transforms]
    except Rejected:
        return 0.0
    return time.time() - max(stamp.sec + stamp.nanosec / 1e9 for stamp in stamps) if stamps else 0.0


def _listener(context: Context) -> Middleware | None:
    """How the node listens, if it uses another RMW than the robot."""
    try:
        found = middleware(context)
    except SettingError:  # reported by ros.listener
        return None
    return found if found.is_foreign else None


def _profiled(listener: Middleware | None, domain: int | None = None) -> AbstractContextManager[None]:
    """The middleware's environment while a participant is created, in the environment's domain or another one."""
    if listener is None:
        return nullcontext()
    return (listener if domain is None else replace(listener, domain=domain)).profiled(os.environ)


def _types(sensors: Sequence[SensorSettings], packages: Collection[str]) -> Iterator[Result]:
    """Check the types that the settings expect; Unitree types only if they are in one of these packages."""
    from shadowhound_data_logger.ros.reader import unavailable  # noqa: PLC0415 - rclpy

    missing: dict[str, dict[str, str]] = {}
    for names in sorted({alternatives(name) for sensor in sensors for name in sensor.types if name}):
        reasons = {name: unavailable(name) for name in names}
        is_needed = [name for name in names if not is_of_unitree(name) or name.partition('/')[0] in packages]
        if is_needed and all(reasons.values()):
            missing.setdefault(is_needed[0].partition('/')[0], {})[is_needed[0]] = reasons[is_needed[0]]
    for package, by_type in missing.items():
        yield error(
            'ros.types',
            f'{", ".join(by_type)} cannot be received: {next(iter(by_type.values()))}',
            'the workspace with this package is not sourced in this shell, was not built for this Python, or has no such type',
            _types_remedy(package),
        )
    if not missing:
        yield ok('ros.types', 'all message types can be received')


def _types_remedy(package: str) -> str:
    """The remedy for a missing message package."""
    from shadowhound_data_logger.ros.reader import SHIPPED  # noqa: PLC0415 - rclpy

    remedy = (OURS_REMEDY if package in SHIPPED - {DRIVER} else TYPES_REMEDY).format(package=package)
    if package in SHIPPED:
        return remedy
    return f'sudo apt install ros-{os.environ.get("ROS_DISTRO", "$ROS_DISTRO")}-{package.replace("_", "-")}  # or {remedy}'


def _no_publishers(
    context: Context, topics: Sequence[str], listener: Middleware | None, published: Sequence[str]
) -> Iterator[Result]:
    """None of the topics has a publisher: another namespace, another robot, another domain, or no driver.

    ``published`` are the topics that have publishers in this domain.
    """
    ours = domain_of(context.environ)
    shown = ', '.join(published[:MAX_SHOWN]) + f' and {len(published) - MAX_SHOWN} more' * (len(published) > MAX_SHOWN)
    what = f'none of {", ".join(topics[:4])}, ... has a publisher, but these topics have: {shown}'
    if names := _namespaces(context, topics, published):
        several = f'  # one node for each of {", ".join(names)}' if len(names) > 1 else ''
        remedy = f'ros2 run shadowhound_data_logger sensor_logger_node --ros-args -r __ns:={names[0]}{several}'
        yield error('ros.topics', what, f'the robot publishes in the namespace {names[0]}', remedy)
        return
    theirs = [domain_of(driver.environ) for driver in processes(context.root, *DRIVERS) if driver.environ]
    others = [int(domain) for domain in dict.fromkeys([*theirs, *map(str, domains(context.root))]) if domain != ours]
    for domain in others[:MAX_PEEKS]:
        if there := _peek(domain, topics, listener):
            yield error(
                'ros.domain',
                f'nothing is published in domain {ours}, but {len(there)} of the topics are in domain {domain} ({there[0]}, ...)',
                "this shell has another ROS_DOMAIN_ID than the robot's driver",
                f'export ROS_DOMAIN_ID={domain}  # here and for the node',
            )
            return
    if published:
        remedy = 'shadowhound-data init --to robot.yaml  # settings for the topics that are published'
        yield error('ros.topics', what, 'the settings are for another robot', remedy)
        return
    go2 = is_go2(context)
    drivers = 'ps aux | grep go2_driver ; ros2 launch go2_robot_sdk robot.launch.py' if go2 else 'ros2 node list'
    yield error(
        'ros.topics',
        f'there is no publisher of {", ".join(topics[:4])}, ... in domain {ours}'
        if go2
        else f'no robot publishes in domain {ours}',
        "the robot's driver is not running, is not connected to the robot, or is in another domain or network",
        f'{drivers} ; echo $ROS_DOMAIN_ID  # equal everywhere?',
    )


def _namespaces(context: Context, topics: Sequence[str], published: Sequence[str]) -> list[str]:
    """Namespaces in which topics of these names are published, the one with the most topics first."""
    names = {topic.removeprefix(context.namespace.rstrip('/')) for topic in topics}
    found = Counter(other.removesuffix(name) or '/' for other in published for name in names if other.endswith(name))
    return sorted(found, key=lambda name: (-found[name], name))


def _peek(domain: int, topics: Sequence[str], listener: Middleware | None) -> list[str]:
    """The topics that are published in another domain."""
    from shadowhound_data_logger.doctor import ros_watch  # noqa: PLC0415 - rclpy

    with _profiled(listener, domain), ros_watch.node(domain) as node:
        return [topic for topic, publishers in ros_watch.discover(node, topics, PEEK_S).items() if publishers]


def _sensor(
    sensor: SensorSettings, watched: Sequence[WatchedTopic], rates_hz: Mapping[str, float], streams: Mapping[str, Stream]
) -> Iterator[Result]:
    """A sensor is present if one of its topics is; each topic that is present is checked.

    ``rates_hz`` are those that the user expects, ``streams`` has what is known about the topics of this kind of robot.
    """
    present = [(topic, one) for topic, one in zip(sensor.topics, watched, strict=True) if one.publishers]
    if not present:
        names = ' nor '.join(one.topic for one in watched)
        stream = streams.get(sensor.topics[0], UNKNOWN)
        if stream.optional:
            yield info('ros.topic', f'{names} has no publisher', 'many robots have none')
        else:
            yield warning(
                'ros.topic',
                f'{names} has no publisher',
                f'{sensor.name} is not logged',
                f'ros2 topic list | grep {watched[0].topic} ; is this part of the driver running? If not: {sensor.name}.enabled: '
                'false in the parameter file',
            )
        return
    for topic, one in present:
        stream = streams.get(topic, UNKNOWN)
        expected = rates_hz.get(one.topic, rates_hz.get(topic, stream.rate_hz or sensor.rate_hz))
        yield from _check_topic(one, sensor, stream, expected)


def _check_topic(one: WatchedTopic, sensor: SensorSettings, stream: Stream, expected_hz: float) -> Iterator[Result]:
    others = sorted({publisher.type for publisher in one.publishers} - {one.type})
    if others:
        yield _other_types(one, sensor, others)
    if not any(publisher.type == one.type for publisher in one.publishers):
        return
    if one.unavailable:
        yield error(
            'ros.types',
            f'{one.topic} cannot be received: {one.unavailable}',
            'only topics whose type is installed here can be received',
            _types_remedy(one.type.partition('/')[0]),
        )
        return
    yield from _qos(one, stream)
    yield _rate(one, sensor, expected_hz)


def _other_types(one: WatchedTopic, sensor: SensorSettings, others: Sequence[str]) -> Result:
    by = sorted({publisher.node for publisher in one.publishers if publisher.type in others} - {''})
    whose = ', '.join(by[:MAX_NODES]) or 'a program that is not a ROS node'
    own = f'{sensor.name}.types: [{others[0]}]'
    return error(
        'ros.type',
        f'{one.topic} is published as {" and as ".join(others)} by {whose}; {sensor.name} logs only {one.type}',
        'messages of another type are never logged for this sensor: they are counted as rejected (wrong_type) if '
        'their type is installed, otherwise their number is not known',
        f'ros2 topic info -v {one.topic}  # and stop that publisher; or, if it is the robot: {own}',
    )


def _qos(one: WatchedTopic, stream: Stream) -> Iterator[Result]:
    if one.incompatible:
        yield warning(
            'ros.qos',
            f'{", ".join(one.incompatible)} subscribes to {one.topic} and receives nothing',
            'it requests RELIABLE or TRANSIENT_LOCAL, and the publisher offers less; ROS does not report this',
            'subscribe with rclpy.qos.qos_profile_sensor_data there; the logger itself follows the publisher',
        )
    if stream.reliable and not all(publisher.reliable for publisher in one.publishers if publisher.type == one.type):
        yield warning(
            'ros.qos',
            f'{one.topic} is published BEST_EFFORT, but RELIABLE is expected',
            'messages lost in the network are not sent again',
            f'ros2 topic info -v {one.topic}  # and set its publisher to RELIABLE',
        )


def _rate(one: WatchedTopic, sensor: SensorSettings, expected_hz: float) -> Result:
    figures: dict[str, Any] = {'topic': one.topic, 'rate_hz': round(one.rate_hz, 2), 'received': one.received, 'sent': one.sent}
    due = expected_hz * one.window_s
    if sensor.on_change and not one.received:
        return info('ros.rate', f'{one.topic}: nothing in {one.window_s:.1f} s; it is kept on change only', **figures)
    if not one.received and (due >= MIN_EXPECTED or one.type in STEADY):
        return (error if due >= MIN_EXPECTED else warning)(
            'ros.loss',
            f'{one.topic} has a publisher, but no message arrives',
            'large messages are lost between driver and logger (see sockets), the two run as different users, or a firewall '
            'drops everything but discovery; or the device is off or not connected, and the driver has nothing to publish',
            f'ros2 topic hz {one.topic} ; shadowhound-data doctor --only sockets',
            **figures,
        )
    if one.sent and due >= MIN_EXPECTED and one.received < (1 - TOO_LOSSY) * one.sent:
        return warning(
            'ros.loss',
            f'{one.topic}: {one.received} of {one.sent} messages arrived',
            "they do not fit into shared memory or the kernel's socket buffers",
            'shadowhound-data doctor --only sockets  # what to set, for the driver and here',
            **figures,
        )
    if due >= MIN_EXPECTED and one.rate_hz < TOO_SLOW * expected_hz:
        return warning(
            'ros.rate',
            f'{one.topic} arrives at {one.rate_hz:.1f} Hz, {expected_hz:g} Hz are expected',
            'the driver is slower than expected, the connection to the robot is weak, or this machine is busy',
            f'ros2 topic hz {one.topic} ; if that is correct: doctor --rate {one.topic}={max(one.rate_hz, 0.1):.0f}',
            **figures,
        )
    return ok('ros.rate', f'{one.topic} arrives at {one.rate_hz:.1f} Hz', **figures)
