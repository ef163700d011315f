"""Middleware that neither numbers messages nor names their sender, as rclpy of Humble: losses are those it reports."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from e2e.processes import Node, Processes, Publisher, until
from e2e.reading import STRING, texts

LEAVE_OUT = """
from shadowhound_data_logger import model
from shadowhound_data_logger.capture import reader
reader.Taken = lambda cdr, source_ns, publisher, number, received_ns: model.Taken(cdr, source_ns, None, None, received_ns)
"""
UDP = {'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}
"""What nobody takes from its socket buffers is overrun by what follows."""
COUNT = 100


def started(processes: Processes, folder: Path, sensors: list[str]) -> tuple[Node, Publisher]:
    """A node that is told no numbers, and a publisher."""
    hidden = folder / 'hidden'
    hidden.mkdir()
    (hidden / 'sitecustomize.py').write_text(LEAVE_OUT)
    path = os.pathsep.join(filter(None, (str(hidden), os.environ.get('PYTHONPATH', ''))))
    parameters: dict[str, object] = {'sensors': sensors}
    for name in sensors:
        parameters |= {f'{name}.topics': [name], f'{name}.rate_hz': 0.0, f'{name}.batch_s': 0.5}
    return processes.node(None, parameters, environ={'PYTHONPATH': path}), processes.publisher()


def test_nothing_is_lost(processes: Processes, tmp_path: Path) -> None:
    """Then nothing is missed, also where a history is delivered that two subscriptions hear."""
    node, publisher = started(processes, tmp_path, ['plain', 'latched'])
    publisher.create('/plain', STRING)
    publisher.create('/latched', STRING, latched=True)
    publisher.publish('/latched', texts(range(COUNT)))
    for name in ('plain', 'latched'):
        publisher.heard(f'/{name}', node, texts(['warm-up'])[0])
        publisher.publish(f'/{name}', texts(range(COUNT, 2 * COUNT)))
        node.settled(f'/{name}', COUNT)
    for row in node.stop()['topics'].values():
        assert (row['accounting'], row['missed'], row['published']) == ('reported', 0, row['received'])
        assert row['stored'] == row['received'] >= COUNT


@pytest.mark.parametrize('reliable', [False, True])
def test_what_is_lost_is_reported(processes: Processes, tmp_path: Path, *, reliable: bool) -> None:
    """What the middleware could not deliver is missed, to the message, though nobody saw a number."""
    for name in ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE'):
        processes.environ.pop(name, None)
    processes.environ |= UDP
    node, publisher = started(processes, tmp_path, ['lossy'])
    publisher.create('/lossy', STRING, reliable=reliable, depth=1)
    publisher.heard('/lossy', node, texts(['warm-up'])[0])
    publisher.publish('/lossy', texts(['ready']))
    until(lambda: 'ready' in stored(node), 'nothing is on its way any more')
    node.signal(signal.SIGSTOP)
    publisher.publish('/lossy', texts(f'{number}'.ljust(60_000) for number in range(COUNT)), 0.0)
    node.signal(signal.SIGCONT)
    publisher.publish('/lossy', texts([*range(COUNT, COUNT + 10), 'last']), 0.1)
    until(lambda: 'last' in stored(node), 'the last message is delivered')
    row = node.stop()['topics']['/lossy']
    assert row['accounting'] == 'reported'
    assert row['missed'] > 0, 'a node that stands still was meant to lose messages'
    assert row['missed'] == COUNT + 10 - sum(text.strip().isdigit() for text in stored(node))


def stored(node: Node) -> list[str]:
    """The data of all Strings in its store, a folder."""
    paths = (node.home / 'store' / 'sensor-data' / node.robot).rglob('*_lossy*.json')
    return [sample['data'] for path in paths for sample in json.loads(path.read_text())['samples']]
