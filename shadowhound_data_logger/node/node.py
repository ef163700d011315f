"""The node's process: arguments, signals, main loop. Importing this loads rclpy, and with it the middleware."""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Final

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, remove_ros_args

from shadowhound_data_logger.core import heap
from shadowhound_data_logger.core.errors import DataLoggerError, SettingError
from shadowhound_data_logger.core.ros_arguments import NODE, rules_for
from shadowhound_data_logger.node.intake.early import EarlyReaders
from shadowhound_data_logger.node.intake.middleware import SETTING, Middleware
from shadowhound_data_logger.node.parameters import Parameters
from shadowhound_data_logger.node.reporting.front import Front
from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided, orphans

log = logging.getLogger(__name__)

USAGE = """\
usage: sensor_logger_node [--ros-args [--params-file FILE] [-p NAME:=VALUE ...] [-r __ns:=/NAMESPACE] ...]
Its state: shadowhound-data status. Without AWS_ENDPOINT_URL it stores to the folder $SHADOWHOUND_HOME/store."""
LISTENER = '_sensor_logger_intake'
"""Name of the listening node if the front has the public one; `ros2 node list` hides names that start with _."""
NO_SERVICE = 'start_type_description_service'
"""A parameter of rclpy since Jazzy."""
UNUSED_FILE = 'the parameter file has nothing for {name}, so the defaults apply: start its section with /**, or with that name'
NO_FRONT = (
    '{rmw} is not installed here, so services, parameters and /diagnostics are not offered to the robot: install it, '
    'or use `shadowhound-data node`'
)
SPIN_S = 0.5
"""Maximum delay until a signal is seen; two of them make the second between two statuses."""
GIVE_BACK_S = 20.0
"""Interval for returning memory to the system after many topics or an outage; takes 0.5 ms with a heap of 100 MB."""
SECOND_SIGNAL_S = 1.0
"""A second signal later than this exits immediately; an earlier one is the same key press."""
WATCHDOG_PART: Final = 3
"""Number of watchdog pings within systemd's timeout, so that one lost ping does not kill the node."""


@dataclass(frozen=True, slots=True)
class Ros:
    """The logger's ROS nodes and middleware."""

    node: Node
    """The node with the subscriptions."""
    name: str
    """The logger's full public name in ROS."""
    middleware: Middleware
    front: Front | None
    """Offers services, parameters and diagnostics in the robot's RMW; None if the node itself does, or no process can."""


class SystemdService:
    """Notifies systemd, if it started this service: ready, alive, stopping (sd_notify(3)).

    Does nothing without systemd. New; ``ready`` once; ``alive`` from the main loop, as often as it runs; ``stopping`` once.
    """

    def __init__(self, environ: MutableMapping[str, str]) -> None:
        """Removes the variables from the environment: they are for this process, not its children."""
        self._address = environ.pop('NOTIFY_SOCKET', '')
        pid, interval_us = environ.pop('WATCHDOG_PID', ''), environ.pop('WATCHDOG_USEC', '')
        is_watched = bool(self._address) and interval_us.isdigit() and pid in {'', str(os.getpid())}
        self._pause_s = int(interval_us) / 1e6 / WATCHDOG_PART if is_watched else None
        self._due_s = 0.0
        self._failure_logged = False

    def ready(self, what: str) -> None:
        """Logging has started; ``systemctl status`` shows ``what``."""
        self._notify(f'READY=1\nSTATUS={what}')

    def alive(self) -> None:
        """The main loop runs; if it hangs, systemd ends the process with SIGABRT and restarts it."""
        if self._pause_s is not None and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._pause_s
            self._notify('WATCHDOG=1')

    def stopping(self) -> None:
        self._notify('STOPPING=1\nSTATUS=closing: open batches are finished and delivered')

    def _notify(self, text: str) -> None:
        """Never raises and never blocks: a problem with systemd must not stop logging."""
        if not self._address:
            return
        name = '\0' + self._address[1:] if self._address.startswith('@') else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC) as sender:
                sender.sendto(text.encode(), name)
        except OSError as error:
            if not self._failure_logged:
                self._failure_logged = True
                log.warning('cannot report to systemd: %s', error)


class StopSignals:
    """SIGINT and SIGTERM request a stop; a second, later one exits the process: spooled data is durable already."""

    def __init__(self) -> None:
        self.first_s: float | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    @property
    def received(self) -> bool:
        return self.first_s is not None

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if self.first_s is None:
            self.first_s = time.monotonic()
        elif time.monotonic() - self.first_s > SECOND_SIGNAL_S:
            os._exit(128 + number)


def refuse(rest: list[str]) -> int:
    """Report arguments that are not for ROS; returns the exit code."""
    if rest[0] in {'-h', '--help'}:
        print(USAGE)  # noqa: T201
        return 0
    print(f'sensor_logger_node: {rest[0]!r} is not a valid argument; settings follow --ros-args\n{USAGE}', file=sys.stderr)  # noqa: T201
    return 2


def run(arguments: list[str], middleware: Middleware, robot: Mapping[str, str]) -> int:
    """Run ROS from start to shutdown; returns the exit code.

    ``arguments`` are those of ROS, without the program's name; ``robot`` is the environment before our changes.
    """
    heap.limit_arenas()
    try:
        if rest := remove_ros_args(arguments):  # such as --params-file without --ros-args, which rcl would ignore
            return refuse(rest)
        rclpy.init(args=[sys.argv[0], *arguments], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # a parameter file or argument that rcl cannot parse; there is no logger yet
        print(f'sensor_logger_node: {error}', file=sys.stderr)  # noqa: T201
        return 2
    stop = StopSignals()
    freed = orphans(free=True)  # before we need the shared memory that a killed node may have left full
    with middleware.profiled(os.environ), dead_ports_avoided(get_default_context().get_domain_id()) as avoided:
        node, name = make_node(arguments, is_public=not middleware.is_foreign)
    guard = PortGuard()
    logging.basicConfig(level=logging.INFO, format='%(message)s', handlers=[RosHandler(node.get_logger())])
    if freed:
        size = sum(each.bytes for each in freed)
        log.info('freed %.0f MB of shared memory (%d segments) that killed processes had left', size / 1e6, len(freed))
    if avoided:
        log.info('%d ports in shared memory that killed processes left are not reused', len(avoided))
    node.get_logger().info(f'listening by {middleware.describe()}')
    if '--params-file' in arguments and not Parameters(node).given():  # which is not an error to rcl
        node.get_logger().warning(UNUSED_FILE.format(name=name))
    front = Front(arguments, robot) if middleware.is_foreign and middleware.has_robot else None
    if middleware.is_foreign and front is None:
        node.get_logger().warning(NO_FRONT.format(rmw=middleware.robot))
    try:
        log_until(stop, Ros(node, name, middleware, front))
    except SettingError as error:
        node.get_logger().fatal(f'{error}')
        return 2
    except DataLoggerError as error:
        node.get_logger().fatal(str(error))
        return 1
    except BaseException as error:  # the one supervised catch-all of the main loop; systemd restarts the node
        logging.getLogger(__name__).critical('the node exits: %s: %s', type(error).__name__, error, exc_info=error)
        return 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        guard.close()
    return 0


def make_node(arguments: Sequence[str], *, is_public: bool) -> tuple[Node, str]:
    """The listening node, and the logger's full public name in ROS.

    If the front has the public name, the listening node has another one, no services, and otherwise the same arguments.
    """
    if is_public:
        node = Node(NODE, automatically_declare_parameters_from_overrides=True)
        return node, node.get_fully_qualified_name()
    named = Node(NODE, start_parameter_services=False, enable_rosout=False, automatically_declare_parameters_from_overrides=True)
    given = {**named.get_parameters_by_prefix(''), NO_SERVICE: Parameter(NO_SERVICE, value=False)}
    rules = [f'__node:={LISTENER}', *rules_for(arguments, named.get_name())]
    node = Node(
        LISTENER, namespace=named.get_namespace(), cli_args=['--ros-args', *(word for rule in rules for word in ('-r', rule))],
        start_parameter_services=False, parameter_overrides=list(given.values()),
        automatically_declare_parameters_from_overrides=True,
    )  # fmt: skip
    name = named.get_fully_qualified_name()
    named.destroy_node()
    return node, name


def log_until(stop: StopSignals, ros: Ros) -> None:
    """Run until a signal arrives."""
    service = SystemdService(os.environ)
    node, middleware = ros.node, ros.middleware
    parameters = Parameters(node)
    given = parameters.load()
    if given.capture.rmw != middleware.asked:
        allowed = f'{middleware.asked!r}, the value that the command line gives before ROS is loaded'
        raise SettingError(SETTING, given.capture.rmw, allowed)
    early = EarlyReaders(node, given.sensors)
    from shadowhound_data_logger.node.pipeline import Pipeline  # noqa: PLC0415 - half a second, in which the robot is heard already

    pipeline = Pipeline(ros, given, parameters, early)
    pipeline.open()
    service.ready(pipeline.describe())
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    given_back_s = time.monotonic()
    try:
        while not stop.received:
            executor.spin_once(timeout_sec=SPIN_S)
            if settings := parameters.changed():
                pipeline.apply(settings)
            pipeline.tick()
            service.alive()
            if time.monotonic() - given_back_s > GIVE_BACK_S:
                given_back_s = time.monotonic()
                heap.trim()
    finally:
        service.stopping()
        node.get_logger().info('closing: open batches are finished and delivered')
        pipeline.close()
        executor.shutdown()


class RosHandler(logging.Handler):
    """Forwards log records. Each severity needs a separate line below: rclpy ties a severity to the calling line."""

    def __init__(self, logger: RcutilsLogger) -> None:
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        elif record.levelno >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)
