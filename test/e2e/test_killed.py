"""The shared memory of a killed node: the next node frees it, and no publisher waits for it."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from e2e.processes import HERE, NODE, Node, Processes, until
from ros.ports import SETTLED, ports_of, seem_to_process

from shadowhound_data_logger.ros.shared_memory import FOLDER, orphans

RATES_HZ = {
    '/camera/compressed': 30, '/camera/camera_info': 30, '/point_cloud2': 10, '/imu': 100, '/odom': 50, '/go2_states': 20,
    '/joint_states': 50, '/lowstate': 20,
}  # fmt: skip


def received(node: Node) -> dict[str, int]:
    return {topic: node.topic(topic).get('received', 0) for topic in RATES_HZ}


@pytest.mark.long('a kill')
def test_the_next_node_frees_the_shared_memory_of_a_killed_one(processes: Processes) -> None:
    """But not that of a running process."""
    other, dead = processes.node(home='other', robot='other'), processes.node()
    segments = {node: set(re.findall(rf'{FOLDER}/fast(?:dds|rtps)_[0-9a-f]{{16}}\b', _maps(node))) for node in (other, dead)}
    owned = segments[dead] - segments[other]
    dead.kill()
    left = [path for path in map(Path, owned) if path.exists()]
    if not left:
        pytest.skip('this middleware leaves nothing behind')
    for path in left:
        os.utime(f'{path}_el', (0, 0))  # as if it had been killed long ago
    assert {Path(path).name for path in left} <= {each.name for each in orphans()}
    processes.node()
    assert not [path for path in left if path.exists()]
    assert all(Path(path).exists() for path in segments[other] - owned)


@pytest.mark.long('a node')
def test_a_node_has_the_shared_memory_that_it_frees(processes: Processes) -> None:
    """It is freed first: a container has 64 MB, and a killed node may occupy 36 of them."""
    mine = ['unshare', '--mount', 'mount', '-t', 'tmpfs', 'tmpfs', str(FOLDER)]
    if (tried := subprocess.run(mine, capture_output=True, text=True, check=False)).returncode:
        pytest.skip(f'no file system of our own here: {tried.stderr}')
    node = processes.node(program=(str(HERE / 'little_memory.py'), NODE))
    if not node.hears_numbers:
        pytest.skip('this middleware uses no shared memory')
    assert 'freed 39 MB of shared memory' in node.log
    assert 'Failed to create segment' not in node.log


@pytest.mark.long('a kill')
def test_a_killed_node_blocks_no_publisher(processes: Processes) -> None:
    """Even if it is killed while it processes a message: whatever checks its ports notifies Fast DDS first."""
    node = processes.node()
    if not (ports := ports_of(node.popen.pid)):
        pytest.skip('this middleware has no ports in shared memory')
    seem_to_process(node.popen.pid, ports)
    node.kill()
    until(lambda: all(port.flags == SETTLED for port in ports), 'its ports are settled')


def _maps(node: Node) -> str:
    return Path(f'/proc/{node.popen.pid}/maps').read_text()
