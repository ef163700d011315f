"""``init`` on a graph with a robot of another vendor: its file logs each topic that has a rule."""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from e2e.processes import COMMANDS, Processes, Publisher, until
from e2e.test_any_robot import SENT, messages, type_of
from ruamel.yaml import YAML
from shadowhound_tower.embedded import Tower

NS = '/tb5'


@pytest.fixture(scope='module')
def publishers(shared: Processes) -> dict[str, Publisher]:
    found = {name: shared.publisher() for name in SENT}
    for name, (message, _, latched) in SENT.items():
        found[name].create(f'{NS}/{name}', type_of(message), latched=latched)
    return found


def init(shared: Processes, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', COMMANDS, 'init', *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=shared.environ, timeout=120, check=False)


def publish(publishers: dict[str, Publisher]) -> None:
    """For some seconds, at the rate of each topic."""
    with ThreadPoolExecutor(len(SENT)) as pool:
        list(pool.map(lambda name: publishers[name].publish(f'{NS}/{name}', messages(name), 1 / (SENT[name][1] or 1.0)), SENT))


def test_the_file_that_init_writes_logs_the_robot(
    shared: Processes, publishers: dict[str, Publisher], seaweed: Tower, tmp_path: Path
) -> None:
    """Rates, sizes and skipped topics are in comments; a node with the file receives and stores what is published then."""
    path = tmp_path / 'robot.yaml'
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(init, shared, '--namespace', NS, '--duration', '1', '--to', str(path))
        while not asking.done():
            publish(publishers)
        ran = asking.result()
    assert ran.returncode == 0, ran.stderr
    assert f'{len(SENT) - 1} of {len(SENT)} topics are logged' in ran.stderr
    text = path.read_text()
    assert '/led (std_msgs/msg/ColorRGBA)' in text.partition('Not logged')[2]
    given = YAML(typ='safe').load(text)['/**']['ros__parameters']
    assert given['robot'] == 'tb5'
    topics = {given[name]['topics'][0] for name in given['sensors']}
    assert topics == {f'{NS}/{name}' for name in SENT if name != 'led'}
    assert {'imu', 'odom', 'joints'} <= set(given['sensors']), 'the names of the default sensors'
    assert 'MB per hour' in next(line for line in text.splitlines() if f'{NS}/scan' in line)
    assert init(shared, '--to', str(path)).returncode == 2, 'it does not overwrite'

    node = shared.node(seaweed.environment(), None, '--params-file', str(path), '-r', f'__ns:={NS}', robot='')
    for name in SENT:
        if name != 'led':
            publishers[name].matched(f'{NS}/{name}')
    names = [row['topic'] for row in json.loads(init(shared, '--duration', '1', '--json').stdout)['topics']]
    assert set(names) == {f'{NS}/{name}' for name in SENT}, 'topics of the logger itself are not proposed'
    publish(publishers)
    for name, (_, rate_hz, latched) in SENT.items():
        if name != 'led' and not latched:
            sent = max(1, round(rate_hz * 6))
            until(lambda name=name, sent=sent: node.topic(f'{NS}/{name}').get('received', 0) >= sent, f'{name} is received')  # type: ignore[misc]
    node.stop()
    for name in SENT.keys() - {'led'}:
        account = node.topic(f'{NS}/{name}')
        assert account['stored'] > 0, (name, json.dumps(account))
        assert account['received'] == account['stored'] + account['skipped'], (name, account)


def test_without_topics_init_reports_an_error(shared: Processes) -> None:
    """The error is also a finding, and in the JSON output."""
    ran = init(shared, '--namespace', '/nobody', '--duration', '1')
    assert ran.returncode == 1
    assert 'No topic has a publisher' in ran.stderr
    assert 'sensors: []' in ran.stdout
    ran = init(shared, '--namespace', '/nobody', '--duration', '1', '--json')
    assert (ran.returncode, json.loads(ran.stdout)) == (1, {'robot': 'nobody', 'topics': []})
