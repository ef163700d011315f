"""Middleware without sequence numbers and senders of messages, as in Humble's rclpy: losses are estimated, or unknown."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
from e2e.processes import Node, Processes, until
from e2e.reading import STRING, texts

LEAVE_OUT = """
from shadowhound_data_logger.core import model
Taken = model.Taken
model.Taken = lambda cdr, source_ns, publisher, number, *times: Taken(cdr, source_ns, None, None, *times)
"""
"""Set before the reader is imported: on Humble that loads the RMW, which is not chosen yet."""
UDP = {'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}
"""Messages not taken from its socket buffers are overrun by later ones."""
COUNT = 100
PERIOD_S = 0.01
SIZE = 30_000


def started(processes: Processes, folder: Path, sensors: list[str], expected_hz: float = 1 / PERIOD_S) -> Node:
    """A node without sequence numbers, and with a rate: on a busy machine no rhythm is even enough to be learned."""
    hidden = folder / 'hidden'
    hidden.mkdir(exist_ok=True)
    (hidden / 'sitecustomize.py').write_text(LEAVE_OUT)
    path = os.pathsep.join(filter(None, (str(hidden), os.environ.get('PYTHONPATH', ''))))
    parameters: dict[str, object] = {'sensors': sensors}
    for name in sensors:
        parameters |= {f'{name}.topics': [name], f'{name}.rate_hz': 0.0, f'{name}.batch_s': 0.5}
        parameters |= {f'{name}.expected_hz': expected_hz}
    return processes.node(None, parameters, environ={'PYTHONPATH': path})


@pytest.mark.long('seven seconds of a topic without a rhythm')
def test_without_a_rhythm_losses_are_unknown(processes: Processes, tmp_path: Path) -> None:
    """Each message is counted once, also when two subscriptions receive a history; missed is null."""
    node, publisher = started(processes, tmp_path, ['plain', 'latched'], 0.0), processes.publisher()
    publisher.create('/plain', STRING)
    publisher.create('/latched', STRING, latched=True)
    publisher.publish('/latched', texts(range(COUNT)))
    for name in ('plain', 'latched'):
        publisher.heard(f'/{name}', node, texts(['warm-up'])[0])
        publisher.publish(f'/{name}', texts(range(COUNT, 2 * COUNT)))
        node.settled(f'/{name}', COUNT)
    for row in node.stop()['topics'].values():
        assert (row['accounting'], row['published'], row['missed'], row['missed_by']) == ('received-only', None, None, {})
        assert row['stored'] == row['received'] >= COUNT


@pytest.mark.long('a kill')
def test_losses_are_estimated_from_the_rhythm(processes: Processes, tmp_path: Path) -> None:
    """By the rate of a publisher that continues while the node is stopped, and after it is killed: within 5 %, and marked."""
    for name in ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE'):
        processes.environ.pop(name, None)
    processes.environ |= UDP
    node, publisher = started(processes, tmp_path, ['lossy']), processes.publisher()
    publisher.create('/lossy', STRING, reliable=False, depth=1)
    publisher.matched('/lossy')
    publisher.begin('/lossy', STRING, PERIOD_S, SIZE)
    node.received('/lossy', COUNT)
    until(lambda: node.topic('/lossy')['accounting'] == 'estimated', 'the rate is believed')
    node.signal(signal.SIGSTOP)
    time.sleep(2.0)
    node.signal(signal.SIGCONT)
    node.received('/lossy', node.topic('/lossy')['received'] + COUNT)
    node.kill()
    before = node.topic('/lossy')['received']
    node = started(processes, tmp_path, ['lossy'])
    node.received('/lossy', before + COUNT)
    publisher.halt('/lossy')
    row = node.stop()['topics']['/lossy']
    assert (row['accounting'], row['published'], row['missed']) == ('estimated', None, None)
    numbers = stored(node)
    lost = max(numbers) - min(numbers) + 1 - row['received']
    assert lost > COUNT, 'a node that is stopped, and one that is dead, were meant to lose messages'
    assert abs(row['missed_estimated'] - lost) <= 0.05 * lost, row
    assert row['published_estimated'] == row['received'] + row['missed_estimated']
    assert row['missed_by']['restart'] > 0
    assert row['missed_by']['transport'] > 0


@pytest.mark.long('nine seconds of a topic')
def test_messages_that_a_dead_publisher_did_not_publish_are_not_lost(processes: Processes, tmp_path: Path) -> None:
    """A killed publisher, and another one in its place two seconds later: the gap between them is not a loss."""
    node = started(processes, tmp_path, ['calm'])
    for _ in range(2):
        publisher = processes.publisher()
        publisher.create('/calm', STRING)
        publisher.matched('/calm')
        before = node.topic('/calm').get('received', 0)
        publisher.begin('/calm', STRING, PERIOD_S)
        node.received('/calm', before + COUNT)
        until(lambda: node.topic('/calm')['accounting'] == 'estimated', 'the rate is believed')
        publisher.kill()
        time.sleep(2.0)
    row = node.stop()['topics']['/calm']
    assert row['accounting'] == 'estimated'
    assert row['missed_estimated'] <= 10, row


def stored(node: Node) -> list[int]:
    """The numbers of all messages in its store, a folder."""
    paths = (node.home / 'store' / 'sensor-data' / node.robot).rglob('*_lossy*.json')
    return [int(sample['data']) for path in paths for sample in json.loads(path.read_text())['samples']]
