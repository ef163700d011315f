"""With what Humble's rclpy offers the node stores all the same, and says what it cannot know there."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from e2e.bag_reading import in_slice
from e2e.processes import HERE, Node, Processes
from e2e.reading import STRING, Objects, texts

from shadowhound_data_logger.sim.tower import Tower

COUNT = 200
TOPICS = ('/one', '/two', '/latched')
SENSORS = {
    'sensors': ['one', 'two', 'latched'], 'spool.commit_s': 0.05, 'bag.record': 'always',
    **{f'{name}.{key}': value for name in ('one', 'two', 'latched')
       for key, value in {'topics': [name], 'types': [STRING], 'rate_hz': 0.0, 'batch_s': 0.2}.items()},
}  # fmt: skip


def on_humble(processes: Processes, store: dict[str, str], folder: Path, *, events: bool) -> Node:
    """A node that sees no more of rclpy than Humble has."""
    folder.mkdir()
    shutil.copy(HERE / 'humble.py', folder / 'sitecustomize.py')
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get('PYTHONPATH'))))
    return processes.node(store, SENSORS, environ={'PYTHONPATH': path, 'MESSAGE_LOST_EVENTS': 'yes' if events else 'no'})


@pytest.mark.parametrize('events', [False, True])
def test_without_numbers_all_is_stored_and_what_is_not_known_is_null(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects], tmp_path: Path, events: bool
) -> None:
    """Of one and of two publishers and from their history, each message once; the accounts claim what they know and no more."""
    first, second = processes.publisher(), processes.publisher()
    first.create('/latched', STRING, latched=True)
    began_ns = time.time_ns()
    first.publish('/latched', texts(range(COUNT)))
    node = on_humble(processes, seaweed.environment(), tmp_path / 'humble', events=events)
    first.create('/one', STRING)
    for publisher in (first, second):
        publisher.create('/two', STRING)
        publisher.matched('/two')
    first.heard('/one', node, texts(['warm-up'])[0])
    first.publish('/one', texts(range(COUNT)))
    first.publish('/two', texts(range(COUNT)))
    second.publish('/two', texts(range(COUNT, 2 * COUNT)))
    expected = {'/one': COUNT, '/two': 2 * COUNT, '/latched': COUNT}
    for topic, count in expected.items():
        node.received(topic, count)
    ledger = node.stop()
    rows: dict[str, dict[str, Any]] = ledger['topics']
    objects = stored(processes.robot)
    for topic, count in expected.items():
        row = rows[topic]
        assert objects.numbers(topic.strip('/')) == list(range(count))
        assert row['accounting'] in {'estimated', 'received-only'}
        assert (row['published'], row['missed'], row['dropped'], row['rejected'], row['open']) == (None, None, {}, {}, 0)
        assert row['stored'] == row['received'] >= count
    slice_file = tmp_path / 'slice.mcap'
    slice_file.write_bytes(next(body for key, body in objects.contents.items() if key.endswith('.mcap')))
    recorded = list(in_slice(slice_file))
    assert {topic: sum(each.topic == topic for each in recorded) for topic in TOPICS} == {
        topic: row['received'] for topic, row in ledger['bags'].items()
    }
    assert all(began_ns < each.log_ns < time.time_ns() for each in recorded), 'the middleware does not say when they came'
    assert len(re.findall(r'\[WARN\]', node.log)) <= 1
    assert '[ERROR]' not in node.log
    assert 'Traceback' not in node.log
