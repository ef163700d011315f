"""Two machines in one network, made of namespaces; the robot has a second interface without a peer."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
from e2e.processes import HERE

ROBOT, OTHER, SECOND = '10.77.0.1', '10.77.0.2', '10.78.0.1'
MAKE = f"""
set -e
ip link set lo up
ip link add eth0 type veth peer name eth1
ip link set eth1 netns "$1"
ip addr add {ROBOT}/24 dev eth0
ip link set eth0 up
ip link add wlan0 type veth peer name nobody
ip addr add {SECOND}/24 dev wlan0
ip link set wlan0 up
ip link set nobody up
"""
"""The robot has a second interface, without a peer."""
JOIN = f'set -e; ip link set lo up; ip addr add {OTHER}/24 dev eth1; ip link set eth1 up'
NOBODY = 'lladdr 02:00:00:00:00:99 nud permanent'
LISTEN = """
import array, socket, sys
told = socket.socket(fileno=0)
listener = socket.create_server((sys.argv[1], 0))
told.sendmsg([b'x'], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array('i', [listener.fileno()]))])
"""


class Machines:
    """Two machines, in a separate user namespace if this user is not root; both end with ``stack``."""

    def __init__(self, stack: ExitStack, robot: int = 0) -> None:
        """Skips if this user may not create namespaces. ``robot`` is a process whose separate network becomes the robot's."""
        self._stack = stack
        user = [] if os.geteuid() == 0 else ['--user', '--map-root-user']
        self.robot = robot or self._hold(['unshare', *user, '--net'])
        """A process on the robot, for ``inside``."""
        self.other = self._hold([*inside(self.robot), 'unshare', '--net'])
        """A process on the other machine."""
        self._run(self.robot, MAKE, str(self.other))
        self._run(self.other, JOIN)

    def join_networks(self) -> None:
        """Also let the other machine reach the robot's second interface."""
        self._run(self.other, f'ip route add {SECOND} via {ROBOT}')

    def cut(self) -> None:
        """Drop all packets between the machines, silently."""
        self._run(self.robot, f'ip neigh replace {OTHER} dev eth0 {NOBODY}')
        self._run(self.other, f'ip neigh replace {ROBOT} dev eth1 {NOBODY}')

    def mend(self) -> None:
        self._run(self.robot, f'ip neigh del {OTHER} dev eth0')
        self._run(self.other, f'ip neigh del {ROBOT} dev eth1')

    def program(self, name: str, folder: Path) -> str:
        """A file that runs that program on the other machine."""
        path = folder / Path(name).name
        path.write_text(f'#!/bin/sh\nexec {shlex.join([*inside(self.other), name])} "$@"\n')
        path.chmod(0o755)
        return str(path)

    def listener(self) -> socket.socket:
        """A socket of this process that listens on the robot, on a port that is free there."""
        ours, theirs = socket.socketpair()
        with ours, theirs:
            subprocess.run([*inside(self.robot), sys.executable, '-c', LISTEN, ROBOT], stdin=theirs, check=True)
            _, (descriptor, *_), _, _ = socket.recv_fds(ours, 1, 1)
        return socket.socket(fileno=descriptor)

    def start(self, *arguments: str, other: bool = False) -> subprocess.Popen[str]:
        """Start finding.py there; returns once it is ready."""
        command = [*inside(self.other if other else self.robot), sys.executable, str(HERE / 'finding.py'), *arguments]
        path = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get('PYTHONPATH')])])
        own = ('CYCLONEDDS_', 'ROS_LOCALHOST', 'ROS_AUTO', 'ROS_STATIC', 'RMW_', 'FASTDDS_', 'FASTRTPS_')
        environ = {name: value for name, value in os.environ.items() if not name.startswith(own)} | {'PYTHONPATH': path}
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ)
        self._stack.callback(_end, process)
        return process

    def _hold(self, command: Sequence[str]) -> int:
        """The id of a sleeping process that keeps the namespaces of unshare and nsenter."""
        holder = subprocess.Popen([*command, 'sh', '-c', 'echo there; exec cat'], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                  stderr=subprocess.PIPE, text=True)  # fmt: skip
        self._stack.callback(_end, holder)
        assert holder.stdout is not None
        if holder.stdout.readline() != 'there\n':
            pytest.skip(f'no namespaces here: {holder.communicate()[1]}')
        return holder.pid

    def _run(self, pid: int, script: str, *arguments: str) -> None:
        command = [*inside(pid), 'sh', '-c', script, 'sh', *arguments]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            pytest.skip(f'no network of our own here: {ran.stderr}')


def inside(pid: int) -> list[str]:
    """The prefix of a command that runs in the network of that process."""
    user = [] if os.geteuid() == 0 else ['--user', '--preserve-credentials']
    return ['nsenter', '--target', str(pid), *user, '--net']


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()
