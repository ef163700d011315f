"""Python programs that are forked from a process with their imports already loaded.

Importing rclpy and the package takes a program more CPU time than most tests of it, and few tests are about its startup. A
forked program has its own environment, arguments and files, receives signals, and exits as an interpreter
does. Variables that an interpreter or the RMW reads when it is loaded need a separate process.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Final

MODULES: Final = (
    'shadowhound_data_logger.node.node', 'shadowhound_sim.sim_go2_node', 'rclpy.serialization',
    'diagnostic_msgs.msg', 'geometry_msgs.msg', 'go2_interfaces.msg', 'nav_msgs.msg', 'rcl_interfaces.msg', 'sensor_msgs.msg',
    'std_msgs.msg', 'std_srvs.srv',
)  # fmt: skip
"""What is there already; one of them may not be installed."""
TYPES: Final = (
    'geometry_msgs.msg:Pose',
    'go2_interfaces.msg:IMU',
    'nav_msgs.msg:Odometry',
    'sensor_msgs.msg:Image',
    'std_msgs.msg:String',
)
"""Whose packages have the library of their types loaded."""
OWN_PROCESS: Final = frozenset({'RMW_IMPLEMENTATION', 'LD_PRELOAD', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'PYTHONPATH'})
"""Variables that are read before the program begins."""
LONGEST: Final = 1 << 20
"""Bytes of an order, its environment included."""


class Forked:
    """A program with the methods of ``subprocess.Popen`` that the tests use. ``wait`` or ``kill`` ends it."""

    def __init__(self, pid: int, status: int, stdin: IO[str] | None, stdout: IO[str] | None) -> None:
        self.pid, self.stdin, self.stdout = pid, stdin, stdout
        self.returncode: int | None = None
        self._status = status

    def poll(self) -> int | None:
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        ended = self._ended(timeout)
        if ended is None:
            raise subprocess.TimeoutExpired(f'process {self.pid}', timeout or 0.0)
        return ended

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None:
            with selectors.DefaultSelector() as selector:
                selector.register(self._status, selectors.EVENT_READ)
                if not selector.select(timeout):
                    return None
            status = os.read(self._status, 100)
            os.close(self._status)
            self.returncode = int(status or -signal.SIGKILL)  # empty if the server was killed, too
        return self.returncode


class ForkServer:
    """The process that has imported all; one for each process of tests, started with its first program, ended with it."""

    def __init__(self) -> None:
        ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (ours, its):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LONGEST)
        with its:
            environ = {**os.environ, 'PYTHONUNBUFFERED': '1'}
            command = [sys.executable, __file__, str(its.fileno())]
            self._process = subprocess.Popen(command, pass_fds=[its.fileno()], env=environ, stdin=subprocess.DEVNULL)
        self._socket = ours

    def start(self, command: Sequence[str], environ: Mapping[str, str], stdin: int, stdout: int, stderr: int) -> tuple[int, int]:
        """The words after ``python``; the process's id, and what its exit code can be read from as text."""
        status, its_status = os.pipe()
        order = {'command': list(command), 'environ': dict(environ), 'folder': str(Path.cwd())}
        try:
            socket.send_fds(self._socket, [json.dumps(order).encode()], [stdin, stdout, stderr, its_status])
        finally:
            os.close(its_status)
        return int(self._socket.recv(100)), status

    def close(self) -> None:
        """End it, and what it started; idempotent."""
        self._socket.close()
        self._process.wait()


_servers: list[ForkServer] = []


def can_fork(environ: Mapping[str, str]) -> bool:
    """Whether a program in that environment finds the same as in a separate process."""
    return all(environ.get(name) == os.environ.get(name) for name in OWN_PROCESS) and 'RMW_IMPLEMENTATION' not in environ


def fork(command: Sequence[str], environ: Mapping[str, str], output: IO[Any], *, piped: bool = False) -> Forked:
    """Start ``python COMMAND ...``; its standard error, and its output where that is not piped, go to the file."""
    if not _servers:
        _servers.append(ForkServer())
        atexit.register(_servers[0].close)
    if not piped:
        with open(os.devnull, 'rb') as nothing:  # noqa: PTH123 - a device
            return Forked(*_servers[0].start(command, environ, nothing.fileno(), output.fileno(), output.fileno()), None, None)
    its_in, our_out = os.pipe()
    our_in, its_out = os.pipe()
    try:
        pid, status = _servers[0].start(command, environ, its_in, its_out, output.fileno())
    finally:
        os.close(its_in)
        os.close(its_out)
    return Forked(pid, status, open(our_out, 'w'), open(our_in))  # noqa: PTH123 - ends of pipes


# -- in the server -----------------------------------------------------------------------------------------------------


def import_all() -> None:
    """What the programs import, and what they load with their first message of a type."""
    for name in MODULES:
        if find_spec(name.partition('.')[0]) is not None:
            import_module(name)
    from rclpy.type_support import check_for_type_support

    for name in TYPES:
        module, _, kind = name.partition(':')
        if module in sys.modules:
            check_for_type_support(getattr(sys.modules[module], kind))
    gc.collect()
    gc.freeze()  # what is there stays shared memory


def serve(orders: socket.socket) -> list[str] | None:
    """Fork as ordered. Returns in each child, with its command; in the server, with None, when its client has exited."""
    selector = selectors.DefaultSelector()
    selector.register(orders, selectors.EVENT_READ)
    children: dict[int, tuple[int, int]] = {}
    while True:
        for key, _ in selector.select():
            if key.fd in children:
                pid, status = children.pop(key.fd)
                selector.unregister(key.fd)
                os.close(key.fd)
                with contextlib.suppress(BrokenPipeError):
                    os.write(status, str(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])).encode())
                os.close(status)
                continue
            text, files, _, _ = socket.recv_fds(orders, LONGEST, 4)
            if not text:
                for pid, _ in children.values():
                    os.kill(pid, signal.SIGKILL)
                return None
            with warnings.catch_warnings():  # of the threads that libraries have, from Python 3.12 on
                warnings.simplefilter('ignore', DeprecationWarning)
                pid = os.fork()
            if pid == 0:
                for other in (*children, *(status for _, status in children.values()), orders.fileno(), files[3]):
                    os.close(other)
                selector.close()
                return become(json.loads(text), files[:3])
            for file in files[:3]:
                os.close(file)
            watched = os.pidfd_open(pid)
            children[watched] = pid, files[3]
            selector.register(watched, selectors.EVENT_READ)
            orders.send(str(pid).encode())


def become(order: dict[str, Any], files: list[int]) -> list[str]:
    """The process that the order describes; its command."""
    for number, file in enumerate(files):
        os.dup2(file, number)
        os.close(file)
    os.environ.clear()
    os.environ.update(order['environ'])
    os.chdir(order['folder'])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    command: list[str] = order['command']
    return command


def run(command: list[str]) -> None:
    """As ``python COMMAND ...`` does: ``-m MODULE``, or a file. The folder of the tests is on the path besides."""
    if command[0] == '-m':
        sys.path.insert(0, os.getcwd())  # noqa: PTH109 - as Python says it
        sys.argv = command[1:]
        runpy.run_module(command[1], run_name='__main__', alter_sys=True)
    else:
        sys.path.insert(0, str(Path(command[0]).parent))
        sys.argv = command
        runpy.run_path(command[0], run_name='__main__')


if __name__ == '__main__':
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import_all()
    if (asked := serve(socket.socket(fileno=int(sys.argv[1])))) is not None:
        run(asked)
