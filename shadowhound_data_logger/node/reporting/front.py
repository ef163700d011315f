"""The front: a small process in the robot's own RMW, next to a node that listens through another one.

Messages interoperate between the DDS vendors, services and parameters do not. So the front has the public name of the node, its
services, parameters, ``~/mission`` and ``/diagnostics``, and forwards requests to the node through the control socket. The node
starts it, and restarts it when it exits; the front exits when the node does, for whatever reason. Logging does not depend on it.

    python -m shadowhound_data_logger.node.reporting.front SOCKET PID [ROS arguments of the node]
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from shadowhound_data_logger.core.config import NOT_SETTINGS
from shadowhound_data_logger.core.errors import DataLoggerError, NodeUnavailable
from shadowhound_data_logger.core.ros_arguments import NODE
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.node.intake.undiscovered import MAX_PUBLISHERS
from shadowhound_data_logger.node.parameters import Described, declare, parameter, plain
from shadowhound_data_logger.node.reporting.interface import Interface
from shadowhound_data_logger.ros.reader import endpoints
from shadowhound_data_logger.spool.control import Connection

COMPARE_S: Final = 2.0
"""Interval between comparisons of publishers, or longer: they take at most this share of the time."""
COMPARE_SHARE, LONGEST_COMPARE_S = 0.05, 20.0
MAX_REPORTED, MAX_LETTERS = 64, 150
"""Publishers in a report, and letters of a name: together they fit into a request."""
LOOK_S: Final = 1.0
"""Interval of polling the node, which also detects that it has exited."""
STEADY_S: Final = 60.0
"""A front that has run for this long is working."""
LONGEST_PAUSE_S: Final = 60.0
"""Maximum pause between restarts of a front that exits repeatedly: each takes half a second of CPU."""
POLL_S: Final = 1.0
END_S: Final = 2.0
"""Time to exit on request; then it is killed."""
SECRET: Final = ('AWS_', 'MLFLOW_', 'NOTIFY_', 'WATCHDOG_')
"""Prefixes of variables that are only for the node."""
PACKAGE: Final = str(Path(__file__).resolve().parents[2])


class Front:
    """Starts the front process for the node and supervises it.

    Lifecycle: New; open once; ``stop``, and ``close`` when there is time to wait. Owns the thread ``front``.
    """

    def __init__(self, arguments: Sequence[str], environ: Mapping[str, str]) -> None:
        """``arguments`` are the ROS arguments of the node, ``environ`` its environment before our changes."""
        self._arguments = arguments
        path = os.pathsep.join(filter(None, (environ.get('PYTHONPATH'), PACKAGE)))
        self._environ = {name: value for name, value in environ.items() if not name.startswith(SECRET)} | {'PYTHONPATH': path}
        self._socket = Path()
        self._process: subprocess.Popen[bytes] | None = None
        self._over = threading.Event()
        self.worker = Worker('front', self._step, longest_pause_s=LONGEST_PAUSE_S)

    def open(self, socket: Path) -> None:
        """``socket`` is the node's control socket."""
        self._socket = socket
        self.worker.start()

    def stop(self) -> None:
        """Request its exit; does not wait."""
        self.worker.stop()
        self._over.set()

    def close(self) -> None:
        self.stop()
        self.worker.join(2 * END_S)

    def _step(self) -> None:
        """Start a front if there is none, and check that it runs; raises DataLoggerError when it exited."""
        if self._process is None:
            command = [sys.executable, '-m', __name__, str(self._socket), str(os.getpid()), *self._arguments]
            # A separate session: Ctrl-C in a terminal is for the node, which must exit first.
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=self._environ, start_new_session=True)
        steady_s = time.monotonic() + STEADY_S
        while not self._over.wait(POLL_S):
            if self._process.poll() is not None:
                code, self._process = self._process.returncode, None
                how = f'with exit code {code}' if code >= 0 else f'by signal {-code}'
                raise DataLoggerError(f'it exited {how}', remedy='until then use the command line: shadowhound-data node')
            if time.monotonic() >= steady_s or not self.worker.failing:
                return
        self._end(self._process)

    @staticmethod
    def _end(process: subprocess.Popen[bytes]) -> None:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class PublicNode:
    """Offers the logger's services in the front process: a ROS node with the logger's public name.

    Created once the node answers; ``poll`` every second.
    """

    def __init__(self, connection: Connection, node: Node) -> None:
        """Raises NodeUnavailable."""
        self._connection = connection
        self._node = node
        self.lost = ''
        """Why the node cannot be reached any more; empty while it can."""
        self._follows = False
        self._mission: Mapping[str, Any] = {}
        self._topics: Sequence[str] = ()
        self._gids: frozenset[str] = frozenset()
        self._reported: frozenset[str] = frozenset()
        """Publishers that each report must include, however many others appear."""
        self._compare_s = 0.0
        described: list[Described] = connection.ask('parameters')['parameters']
        self._live = [each['name'] for each in described if not each['read_only']]
        for each in described:
            declare(node, each)
        node.add_on_set_parameters_callback(self._set)
        self._interface = Interface(node, self._handle)
        self._interface.open()

    def poll(self) -> None:
        """Follow changes of the node (active mission, parameters set elsewhere), and publish diagnostics."""
        answer = self._handle({'do': 'mission'})
        if answer['ok'] and answer['mission'] != self._mission:
            self._mission = answer['mission']
            self._interface.publish_mission(self._mission)
        answer = self._handle({'do': 'get', 'names': self._live})
        if answer['ok']:
            self._follow(answer['values'])
        if time.monotonic() >= self._compare_s:
            self._compare()
        self._interface.publish_diagnostics()

    def _compare(self) -> None:
        """Report publishers of the node's topics that it has not found."""
        began_s = time.monotonic()
        found: dict[str, list[list[str]]] = {}
        room = MAX_REPORTED
        for topic in self._topics:
            others = [each for each in endpoints(self._node, topic) if each.gid not in self._gids]
            others.sort(key=lambda each: (each.gid not in self._reported, each.gid))
            del others[min(room, MAX_PUBLISHERS) :]
            room -= len(others)
            if others:
                found[topic] = [[each.gid, _ascii(each.type), _ascii(each.node)] for each in others]
        self._reported = frozenset(gid for each in found.values() for gid, _, _ in each)
        answer = self._handle({'do': 'compare', 'found': found})
        if answer['ok']:
            self._topics, self._gids = answer['topics'], frozenset(answer['gids'])
        self._compare_s = began_s + min(LONGEST_COMPARE_S, max(COMPARE_S, (time.monotonic() - began_s) / COMPARE_SHARE))

    def _handle(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """As ``Commands.answer``; an unreachable node is an answer as well."""
        try:
            return self._connection.ask(**request)
        except NodeUnavailable as error:
            self.lost = str(error)
            return {'ok': False, 'robot': '', 'error': self.lost}

    def _set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether the node accepts these values."""
        values = {each.name: plain(each.value) for each in parameters if each.name.partition('.')[0] not in NOT_SETTINGS}
        if self._follows or not values:
            return SetParametersResult(successful=True)
        answer = self._handle({'do': 'set', 'values': values})
        return SetParametersResult(successful=answer['ok'], reason='' if answer['ok'] else answer['error'])

    def _follow(self, values: Mapping[str, Any]) -> None:
        changed = [name for name, value in values.items() if plain(self._node.get_parameter(name).value) != value]
        if changed:
            self._follows = True
            try:
                self._node.set_parameters([parameter(name, values[name]) for name in changed])
            finally:
                self._follows = False


def _ascii(name: str) -> str:
    """Names as in ROS; programs without ROS may have others."""
    return name[:MAX_LETTERS].encode('ascii', 'replace').decode()


def main() -> int:
    """The process; it exits with the node, or on request."""
    socket, pid, arguments = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    try:
        with closing(Connection(socket.parent, socket.name)) as connection:
            if connection.ask('describe')['pid'] == pid:  # another one starts its own front
                _serve(connection, arguments)
    except (OSError, NodeUnavailable, RuntimeError) as error:  # the last case is rcl's, if this RMW is not installed
        print(f'the front exits: {error}', file=sys.stderr)  # noqa: T201 - it may have no logger yet
    return 1  # if the node still runs, it did not request this exit


def _serve(connection: Connection, arguments: Sequence[str]) -> None:
    """Serve until the node or this process stops."""
    rclpy.init(args=[sys.argv[0], *arguments])
    node = Node(NODE)
    executor = SingleThreadedExecutor()
    try:
        public = PublicNode(connection, node)
        node.get_logger().info(f'services and parameters are offered in {rclpy.get_rmw_implementation_identifier()}')
        executor.add_node(node)
        due_s = time.monotonic()
        while not public.lost:
            executor.spin_once(timeout_sec=max(0.0, due_s - time.monotonic()))
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + LOOK_S
                public.poll()
    except (ExternalShutdownException, KeyboardInterrupt, RuntimeError):  # rcl raises the last one during its shutdown
        if rclpy.ok():
            raise
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
