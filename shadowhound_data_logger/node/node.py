"""The node's life: its arguments, its signals, its main loop. Importing this loads rclpy, and with it the middleware."""

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
What it is doing: shadowhound-data status. Without AWS_ENDPOINT_URL it stores to a folder, $SHADOWHOUND_HOME/store."""
LISTENER = '_sensor_logger_intake'
"""Name of the node where the front has the public one; `ros2 node list` hides what begins so."""
NO_SERVICE = 'start_type_description_service'
"""A parameter of rclpy since Jazzy."""
UNHEARD = 'the parameter file has nothing for {name}, so the defaults hold: begin its section with /**, or with that name'
NO_FRONT = (
    '{rmw} is not installed here, so services, parameters and /diagnostics are not offered to the robot: install it, '
    'or use `shadowhound-data node`'
)
SPIN_S = 0.5
"""How long a signal may wait to be seen; two of them are the second that is between two statuses."""
GIVE_BACK_S = 20.0
"""How often what a crowd of topics or an outage took is given back: half a millisecond with a heap of 100 MB."""
SECOND_SIGNAL_S = 1.0
"""A second signal later than this ends the node at once; an earlier one is the same key press."""
WATCHDOG_PART: Final = 3
"""The node says that it lives this many times within the time that systemd allows, so that one lost word is not a death."""


@dataclass(frozen=True, slots=True)
class Ros:
    """How the logger takes part in ROS."""

    node: Node
    """The node that listens."""
    name: str
    """The full name under which ROS knows the logger."""
    middleware: Middleware
    front: Front | None
    """Offers services, parameters and diagnostics in the robot's RMW; None if the node itself does, or no process can."""


class SystemdService:
    """What the node tells systemd when it is a service: that it is ready, that it lives, that it stops (sd_notify(3)).

    Without systemd it tells nobody and costs nothing. New; ``ready`` once; ``alive`` from the main loop, as often as it turns;
    ``stopping`` once.
    """

    def __init__(self, environ: MutableMapping[str, str]) -> None:
        """Takes the variables out of the environment: they are this process's, and none of its children's."""
        self._address = environ.pop('NOTIFY_SOCKET', '')
        pid, interval_us = environ.pop('WATCHDOG_PID', ''), environ.pop('WATCHDOG_USEC', '')
        is_watched = bool(self._address) and interval_us.isdigit() and pid in {'', str(os.getpid())}
        self._pause_s = int(interval_us) / 1e6 / WATCHDOG_PART if is_watched else None
        self._due_s = 0.0
        self._told = False

    def ready(self, what: str) -> None:
        """It logs now; ``what`` is shown by ``systemctl status``."""
        self._tell(f'READY=1\nSTATUS={what}')

    def alive(self) -> None:
        """Its main loop turned; a loop that hangs lets systemd end it with SIGABRT and start it again."""
        if self._pause_s is not None and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._pause_s
            self._tell('WATCHDOG=1')

    def stopping(self) -> None:
        self._tell('STOPPING=1\nSTATUS=closing: open batches are finished and delivered')

    def _tell(self, text: str) -> None:
        """Never raises and never waits: systemd's silence is not a reason to stop logging."""
        if not self._address:
            return
        name = '\0' + self._address[1:] if self._address.startswith('@') else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC) as sender:
                sender.sendto(text.encode(), name)
        except OSError as error:
            if not self._told:
                self._told = True
                log.warning('cannot report to systemd: %s', error)


class StopSignals:
    """SIGINT and SIGTERM ask to stop; a second one, later, ends the process: what is spooled is durable already."""

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
    """Answer arguments that are not for ROS; the exit code."""
    if rest[0] in {'-h', '--help'}:
        print(USAGE)  # noqa: T201
        return 0
    print(f'sensor_logger_node: {rest[0]!r} is not an argument of it; settings follow --ros-args\n{USAGE}', file=sys.stderr)  # noqa: T201
    return 2


def run(arguments: list[str], middleware: Middleware, robot: Mapping[str, str]) -> int:
    """From the start of ROS to its end; the exit code.

    ``arguments`` are those of ROS, without the program's name; ``robot`` is the environment before we changed it.
    """
    heap.limit_arenas()
    try:
        if rest := remove_ros_args(arguments):  # a --params-file without --ros-args, say: rcl would ignore it
            return refuse(rest)
        rclpy.init(args=[sys.argv[0], *arguments], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # a parameter file or argument that rcl cannot parse; there is no logger yet
        print(f'sensor_logger_node: {error}', file=sys.stderr)  # noqa: T201
        return 2
    stop = StopSignals()
    freed = orphans(is_freed=True)  # before anything of ours needs the room that the node before may have left full
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
        node.get_logger().warning(UNHEARD.format(name=name))
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
    except BaseException as error:  # the one supervised catch-all of the main loop; systemd starts the node again
        logging.getLogger(__name__).critical('the node ends: %s: %s', type(error).__name__, error, exc_info=error)
        return 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        guard.close()
    return 0


def make_node(arguments: Sequence[str], *, is_public: bool) -> tuple[Node, str]:
    """The node that listens, and the full name under which ROS knows the logger.

    Where the front has that name, the node that listens has another one, no services, and all else that the arguments say of it.
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
    """Until a signal comes."""
    service = SystemdService(os.environ)
    node, middleware = ros.node, ros.middleware
    parameters = Parameters(node)
    given = parameters.load()
    if given.capture.rmw != middleware.asked:
        allowed = f'{middleware.asked!r}, which is what the command line says to those who read it before ROS is loaded'
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
    """Hands records on. Each severity has its own line below: rclpy ties a severity to the calling line."""

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
