"""Uploads yield to viewers on other machines, and no longer than necessary: a real node, and the page in a separate network."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from domains import free_domain
from e2e.machines import ROBOT, Machines, inside
from e2e.processes import COMMANDS, HERE, Node, Processes, until

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.spool.status import read

pytestmark = [pytest.mark.ros, pytest.mark.long('a node and two machines')]

NOBODY = {'AWS_ENDPOINT_URL': 'http://127.0.0.1:9', 'AWS_ACCESS_KEY_ID': 'any', 'AWS_SECRET_ACCESS_KEY': 'any'}
"""An unreachable store: the limit of uploads is known anyway."""
OWN_MBPS, SHARED_MBPS = 20.0, 3.0
LEASE_S = 5.0
STATUS_S = 1.0
"""The interval between two statuses of the node."""
BUSY_S = 2.0
"""A busy machine may be late."""
EXEC = 'import os, sys; os.execvp(sys.argv[1], sys.argv[1:])'
"""Makes the page keep the id of the started process, however it was started."""


def cap(node: Node) -> float | None:
    """The current limit of uploads, according to the node; None before its first status."""
    report = read(node.home / 'spool', node.robot, SystemClock.of_this_machine())
    return report.node.store.max_mbps if report.running else None


def watching(stack: ExitStack, machine: int, url: str, token: str) -> Iterator[float]:
    """Start a viewer there; the cap, once for each second of its viewing."""
    path = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get('PYTHONPATH')])])
    viewer = subprocess.Popen([*inside(machine), sys.executable, str(HERE / 'watcher.py'), url, token], stdout=subprocess.PIPE,
                              text=True, env={**os.environ, 'PYTHONPATH': path})  # fmt: skip
    stack.callback(viewer.communicate)
    stack.callback(viewer.kill)
    assert viewer.stdout is not None
    return map(float, viewer.stdout)


def test_uploads_yield_to_viewers_on_other_machines(tmp_path: Path, domain: int) -> None:
    """Not to a viewer on the robot itself; while the other one is watching; and at most 5 s after the page was killed."""
    pytest.importorskip('rclpy')
    with ExitStack() as stack:
        machines = Machines(stack)
        robot = f'r{secrets.token_hex(4)}'
        processes = Processes(tmp_path, domain, robot)
        stack.callback(processes.end)
        elsewhere = Processes(tmp_path, stack.enter_context(free_domain()), robot)  # two networks share no ports of a domain
        stack.callback(elsewhere.end)
        node = processes.node(NOBODY, {'upload.max_mbps': OWN_MBPS})
        until(lambda: cap(node) == OWN_MBPS, lambda: f'the cap of the node: {cap(node)}')
        program = ['-c', EXEC, *inside(machines.robot), sys.executable, '-m', COMMANDS]
        page, url = elsewhere.page(node, '--bind', '0.0.0.0', '--uploads-mbps', str(SHARED_MBPS), program=program)
        port, token = url.rstrip('/').rpartition(':')[2], (node.home / 'live' / 'viewer.token').read_text().strip()

        near = watching(stack, machines.robot, f'http://127.0.0.1:{port}/', token)
        assert [next(near) for _ in range(5)] == [OWN_MBPS] * 5

        far = watching(stack, machines.other, f'http://{ROBOT}:{port}/', token)
        assert next(mbps for mbps in far if mbps != OWN_MBPS) == SHARED_MBPS
        more = round(LEASE_S) + 3
        assert [next(far) for _ in range(more)] == [SHARED_MBPS] * more
        assert cap(node) == SHARED_MBPS

        page.signal(signal.SIGKILL)
        page.wait()
        until(lambda: cap(node) == OWN_MBPS, lambda: f'the cap after the kill: {cap(node)}', LEASE_S + STATUS_S + BUSY_S)
