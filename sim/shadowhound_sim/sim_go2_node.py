"""A simulated Go2: publishes what the real driver does, at its rates and with its QoS.

It publishes at absolute times from one loop. When it is late it catches up: no message is skipped, and each topic's count is
exactly rate times duration. However it ends (duration, SIGINT, SIGTERM), it finally prints one line of JSON with its counts:
``{"published": {"/imu": 3000, ...}}``.
"""

from __future__ import annotations

import heapq
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import FrameType
from typing import Any, Final

import rclpy
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from shadowhound_data_logger.core.config import NOT_SETTINGS
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_sim.messages import SimulatedSensor, SimulatedTopic, sources
from shadowhound_sim.patrol import Driven
from shadowhound_sim.world import World

LINGER_S: Final = 0.5
"""How long it waits at the end, so that subscribers can receive the last messages."""
NAP_S: Final = 0.05
"""Maximum sleep, so that a signal is handled soon."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimSettings:
    """The parameters of the node."""

    duration_s: float = field(default=0.0, metadata={'low': 0.0, 'high': 1e7})
    """Seconds to run; 0: forever."""
    seed: int = field(default=1, metadata={'low': 0, 'high': (1 << 63) - 1})
    """Seed of all noise."""
    rate_scale: float = field(default=1.0, metadata={'low': 0.01, 'high': 100.0})
    """Multiplies all rates."""
    image_raw: bool = True
    """Publish ``camera/image_raw``."""
    compressed: bool = True
    """Publish ``camera/compressed``."""
    connection: str = field(default='cyclonedds', metadata={'choices': ('cyclonedds', 'webrtc')})
    """The driver's connection: over WebRTC there is no ``lowstate``, and so no battery."""
    obey: bool = False
    """Follow ``cmd_vel`` (geometry_msgs/Twist) instead of the patrol."""

    @classmethod
    def load(cls, parameters: Mapping[str, Any]) -> SimSettings:
        """Raises SettingError for an unknown or invalid parameter."""
        given = {name: value for name, value in parameters.items() if name.split('.')[0] not in NOT_SETTINGS}
        specs = {spec.name: spec for spec in fields(cls)}
        for name, value in given.items():
            if name not in specs:
                raise SettingError(name, value, f'no parameter of that name; known are {", ".join(specs)}')
        return cls(**{name: _checked(name, value, specs[name].default, specs[name].metadata) for name, value in given.items()})


def _checked(name: str, value: Any, default: Any, metadata: Mapping[str, Any]) -> Any:
    """The value in the type of its default; raises SettingError."""
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    if type(value) is not type(default):
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text'}[type(default)]
        raise SettingError(name, value, kind)
    if 'choices' in metadata and value not in metadata['choices']:
        raise SettingError(name, value, ' or '.join(metadata['choices']))
    if 'low' in metadata and not metadata['low'] <= value <= metadata['high']:
        raise SettingError(name, value, f'a number, {metadata["low"]:g} to {metadata["high"]:g}')
    return value


def count(rate_hz: float, duration_s: float) -> int:
    """How many samples at 0, 1/rate, 2/rate, ... s are before ``duration_s``; a product within 1e-6 of a whole number is that
    number.
    """
    return math.ceil(rate_hz * duration_s - 1e-6)


def schedule(rates_hz: Mapping[str, float], duration_s: float) -> Iterator[tuple[float, str]]:
    """(seconds since the start, name) of every sample in order of time, forever if ``duration_s`` is 0."""
    order = list(rates_hz)
    last = {name: count(rates_hz[name], duration_s) if duration_s else math.inf for name in order}
    heap = [(0.0, place, 0) for place, name in enumerate(order) if last[name] > 0]
    heapq.heapify(heap)
    while heap:
        due, place, number = heap[0]
        name = order[place]
        yield due, name
        following = number + 1
        if following < last[name]:
            heapq.heapreplace(heap, (following / rates_hz[name], place, following))
        else:
            heapq.heappop(heap)


class SimulatedGo2:
    """The publishers of one robot and their message counts. Owned by one thread."""

    def __init__(self, node: Node, robot: Sequence[SimulatedSensor]) -> None:
        self.published: dict[str, int] = {}
        self._sources = {source.topics[0].name: source for source in robot}
        self._publishers = {name: [_publisher(node, topic) for topic in source.topics] for name, source in self._sources.items()}
        for publishers in self._publishers.values():
            self.published |= {publisher.topic_name: 0 for publisher in publishers}

    @property
    def rates_hz(self) -> dict[str, float]:
        """Rate of each source, by its first topic."""
        return {name: source.rate_hz for name, source in self._sources.items()}

    def publish(self, name: str, t: float, stamp_ns: int) -> None:
        """Publishes one sample of a source on each of its topics."""
        messages = self._sources[name].fill(t, stamp_ns)
        for publisher, message in zip(self._publishers[name], messages, strict=True):
            publisher.publish(message)
            self.published[publisher.topic_name] += 1

    def linger(self, seconds: float) -> None:
        """Waits until RELIABLE subscribers have acknowledged everything, and gives the others the same time."""
        end = time.monotonic() + seconds
        for publishers in self._publishers.values():
            for publisher in publishers:
                publisher.wait_for_all_acked(Duration(seconds=max(end - time.monotonic(), 0.001)))
        time.sleep(max(end - time.monotonic(), 0.0))


def run(robot: SimulatedGo2, settings: SimSettings, is_stopped: Callable[[], bool],
        on_time: Callable[[float], None] = lambda _: None) -> None:  # fmt: skip
    """Publishes until the duration is over or ``is_stopped``; a stamp is the time at which the sample was due.

    Before each sample ``on_time`` is called with its time, to take commands.
    """
    rates = {name: rate * settings.rate_scale for name, rate in robot.rates_hz.items()}
    start, start_ns = time.monotonic(), time.time_ns()
    for t, name in schedule(rates, settings.duration_s):
        while not is_stopped() and (ahead := start + t - time.monotonic()) > 0:
            time.sleep(min(ahead, NAP_S))
        if is_stopped():
            return
        on_time(t)
        robot.publish(name, t, start_ns + round(t * 1e9))


def main(args: Sequence[str] | None = None) -> int:
    """The console script; returns 0, or 2 for an invalid parameter or argument."""
    caught: list[int] = []

    def remember(number: int, _frame: FrameType | None) -> None:
        caught.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, remember)
    argv = list(sys.argv[1:] if args is None else args)
    rest = remove_ros_args(argv)
    if rest:
        _log(f'{rest[0]!r} is not a valid argument; parameters are given as --ros-args -p name:=value')
        return 2
    rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    # Nothing spins, so there are no services; parameters are checked here and not by rclpy, which would ignore unknown ones.
    options = {'start_parameter_services': False, 'enable_rosout': False, 'automatically_declare_parameters_from_overrides': True}
    node = Node('sim_go2', **options)
    try:
        settings = SimSettings.load({name: parameter.value for name, parameter in node.get_parameters_by_prefix('').items()})
        driven = Driven() if settings.obey else None
        robot = SimulatedGo2(node, _sources(settings, driven))
        _log(f'the robot walks and publishes {" ".join(sorted(robot.published))}; Ctrl-C stops it')
        run(robot, settings, lambda: bool(caught), _command_reader(node, driven) if driven else lambda _: None)
        robot.linger(LINGER_S)
        print(json.dumps({'published': robot.published}), flush=True)
    except SettingError as error:
        _log(str(error))
        return 2
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _log(text: str) -> None:
    print(f'sim_go2_node: {text}', file=sys.stderr, flush=True)


def _command_reader(node: Node, driven: Driven) -> Callable[[float], None]:
    """Returns a function that takes the commands received so far."""
    now = [0.0]

    def on_command(message: Twist) -> None:
        driven.command(now[0], message.linear.x, message.linear.y, message.angular.z)

    def on_time(t: float) -> None:
        now[0] = t
        rclpy.spin_once(node, timeout_sec=0.0)

    node.create_subscription(Twist, 'cmd_vel', on_command, 1)
    return on_time


def _sources(settings: SimSettings, driven: Driven | None) -> list[SimulatedSensor]:
    """All sensors, those of go2_interfaces first, if it is installed."""
    world = World.of(settings.seed, driven)
    common = sources(world, image_raw=settings.image_raw, compressed=settings.compressed)
    try:
        from shadowhound_sim.go2_messages import go2_sources  # noqa: PLC0415  # it may be missing
    except ImportError as error:
        _log(f'runs without imu, go2_states and lowstate, because go2_interfaces is missing ({error})')
        return common
    return [*go2_sources(world, lowstate=settings.connection == 'cyclonedds'), *common]


def _publisher(node: Node, topic: SimulatedTopic) -> Publisher:
    reliability = QoSReliabilityPolicy.RELIABLE if topic.is_reliable else QoSReliabilityPolicy.BEST_EFFORT
    profile = QoSProfile(reliability=reliability, history=QoSHistoryPolicy.KEEP_LAST, depth=topic.depth)
    return node.create_publisher(topic.type, topic.name, profile)


if __name__ == '__main__':
    sys.exit(main())
