"""A node that is killed again and again under load: what is lost is known, little, and never twice in the store."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from e2e.processes import HERE, NODE, Node, Processes, published, until
from e2e.reading import TYPES, Objects, decode, stamp_ns
from e2e.witness import recorded
from ros.ports import SETTLED, ports_of, seem_to_process
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.ros.shared_memory import FOLDER, orphans

SECOND = 10**9
KILLS = 3
RATES_HZ = {
    '/camera/compressed': 30, '/camera/camera_info': 30, '/point_cloud2': 10, '/imu': 100, '/odom': 50, '/go2_states': 20,
    '/joint_states': 50, '/lowstate': 20,
}  # fmt: skip
LOSS_S = 1.25
"""What a kill may cost besides the restart: a batch of a second and a quarter of a second until its commit."""
SLACK_S = 0.5
"""Two polls for late messages of a batch, and how exactly this test knows the times; how late the machine is comes on top."""
HISTORY_S = 2.0
"""What each subscription holds. A machine that stalls for longer loses messages on the way."""
BEST_EFFORT = {'/camera/camera_info', '/point_cloud2'}
"""What these publish before the node knows of them is lost, and an account begins with the first message that was taken."""
WHOLE = {'/imu': 'imu', '/go2_states': 'states', '/joint_states': 'joints'}
"""Topics of which every message is to be stored."""


def received(node: Node) -> dict[str, int]:
    return {topic: node.topic(topic).get('received', 0) for topic in RATES_HZ}


def hears_all_again(node: Node, before: dict[str, int]) -> None:
    until(lambda: all(count > before[topic] for topic, count in received(node).items()), 'every topic is heard again')


def what_was_heard(recording: Path) -> tuple[dict[str, list[int]], float]:
    """The stamps of each topic, and by how many seconds the robot was late at worst: it publishes on time when it gets a core."""
    stamps: dict[str, list[int]] = {topic: [] for topic in WHOLE}
    late_ns = 0
    for message in recorded(recording):
        decoded = decode(TYPES[message.topic], message.cdr)
        stamp = stamp_ns(decoded) if hasattr(decoded, 'header') else message.source_ns
        stamps[message.topic].append(stamp)
        late_ns = max(late_ns, message.source_ns - stamp)
    return stamps, late_ns / SECOND


def lost(published_ns: list[int], stored_ns: set[int]) -> list[tuple[float, float]]:
    """Each run of published messages that are not stored: when the last stored one before and the first after it were, s."""
    runs = []
    for missing, run in itertools.groupby(enumerate(published_ns), lambda pair: pair[1] not in stored_ns):
        if missing:
            places = [place for place, _ in run]
            before, after = max(places[0] - 1, 0), min(places[-1] + 1, len(published_ns) - 1)
            runs.append((published_ns[before] / SECOND, published_ns[after] / SECOND))
    return runs


@pytest.mark.long('kills under load')
def test_a_kill_under_load_makes_one_short_gap(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """The ledger balances and knows of each message; a kill makes one gap, no longer than the restart and 1.25 s."""
    environ = seaweed.environment()
    node = processes.node(environ)
    recording = processes.folder / 'witness'
    witness = processes.witness({topic: TYPES[topic] for topic in WHOLE}, recording)
    sim = processes.sim()
    restarts: list[tuple[float, float]] = []
    for _ in range(KILLS):
        node.received('/imu', node.topic('/imu').get('received', 0) + 150)
        node.kill()
        killed, before = time.time(), received(node)
        node = processes.node(environ)
        hears_all_again(node, before)
        restarts.append((killed, time.time()))
    node.received('/imu', node.topic('/imu')['received'] + 150)
    sim.signal(signal.SIGINT)
    said = published(sim)
    ledger = node.stop()
    witness.signal(signal.SIGTERM)
    assert witness.wait() == 0

    heard_ns, late_s = what_was_heard(recording)
    loss_s = LOSS_S + SLACK_S + late_s
    causes = {'restart'} if late_s < HISTORY_S else {'restart', 'transport'}
    away_s = sum(heard - killed + loss_s for killed, heard in restarts)
    assert set(ledger['topics']) == set(TYPES)
    for topic, row in ledger['topics'].items():
        unheard = said[topic] - row['published'] if node.hears_numbers else 0
        assert 0 <= unheard <= (RATES_HZ[topic] * (SLACK_S + late_s) if topic in BEST_EFFORT else 0), topic
        assert (topic, row['published'], row['open']) == (topic, node.known(said[topic] - unheard), 0)
        assert (row['accounting'] == 'exact') is node.hears_numbers
        assert set(row['missed_by']) | set(row['dropped']) <= causes, topic
        assert row['missed'] is None or row['missed'] <= RATES_HZ[topic] * away_s, topic
        assert row['rejected'] == {}
    if node.hears_numbers:
        assert ledger['topics']['/imu']['missed_by']['restart'] > 0

    objects = stored(processes.robot)
    assert objects.counted() == {topic: row['stored'] for topic, row in ledger['topics'].items()}
    for topic, name in WHOLE.items():
        stamps = [sample['stamp_ns'] for sample in objects.samples(name)]
        assert len(stamps) == len(set(stamps)), 'nothing is twice in the store'
        gaps = lost(sorted(heard_ns[topic]), set(stamps))
        assert len(gaps) <= KILLS, topic
        for start, end in gaps:
            killed, heard = next((killed, heard) for killed, heard in restarts if start <= heard and end >= killed - loss_s)
            assert end - start <= heard - killed + loss_s, topic
    for name in ('camera', 'odom', 'lidar'):
        seconds = [int(info.metadata['t_start_ns']) // SECOND for key, info in objects.infos.items() if f'/{name}/' in key]
        assert len(seconds) == len(set(seconds)), 'a restart within a second keeps nothing of it twice'


@pytest.mark.long('a kill')
def test_the_next_node_frees_the_shared_memory_of_a_killed_one(processes: Processes) -> None:
    """And that of nobody who lives."""
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
    """It is freed first: a container has 64 MB, of which one that was killed may have left 36."""
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
    """Though it dies while it processes a message: who looks after its ports tells Fast DDS before that looks."""
    node = processes.node()
    if not (ports := ports_of(node.popen.pid)):
        pytest.skip('this middleware has no ports in shared memory')
    seem_to_process(node.popen.pid, ports)
    node.kill()
    until(lambda: all(port.flags == SETTLED for port in ports), 'its ports are settled')


def _maps(node: Node) -> str:
    return Path(f'/proc/{node.popen.pid}/maps').read_text()
