"""Operating a running node: flush, pause, settings changed at run time, diagnostics, several robots on one machine."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import pytest
from click.testing import CliRunner
from diagnostic_msgs.msg import DiagnosticStatus
from e2e.processes import Node, Processes, Publisher, until
from e2e.reading import STRING, Objects, texts
from e2e.station import Station
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.spool import status
from shadowhound_data_logger.spool.control import connect

COUNT = 50
NEVER_S = 3600.0
SENSORS = ['flushed', 'repeated', 'paused', 'switched', 'dormant', 'sampled', 'told', 'asked']


@dataclass(frozen=True, slots=True)
class Operated:
    """A node with batches that close on request, a publisher, and an operator."""

    node: Node
    publisher: Publisher
    station: Station
    stored: Callable[..., Objects]

    def publish(self, name: str, numbers: range) -> None:
        """Publish messages; returns when the node has received them."""
        before = self.node.topic(f'/{name}').get('received', 0)
        self.publisher.publish(f'/{name}', texts(numbers))
        self.node.received(f'/{name}', before + len(numbers))

    def numbers(self, name: str) -> list[int]:
        """The numbers in the store, once everything spooled is there."""
        until(lambda: not self.node.topic(f'/{name}')['stored_in']['pending'], f'{name} is delivered')
        return self.stored(f'{self.node.robot}/{name}').numbers(name)


@pytest.fixture(scope='module')
def operated(shared: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> Iterator[Operated]:
    parameters: dict[str, Any] = {'sensors': SENSORS, 'dormant.enabled': False, 'sampled.rate_hz': 0.001}
    for name in SENSORS:
        parameters |= {f'{name}.topics': [name], f'{name}.types': [STRING], f'{name}.batch_s': NEVER_S}
        parameters.setdefault(f'{name}.rate_hz', 0.0)
    node, publisher = shared.node(seaweed.environment(), parameters), shared.publisher()
    for name in SENSORS:
        publisher.create(f'/{name}', STRING)
    station = Station(shared.environ)
    yield Operated(node, publisher, station, stored)
    station.close()


def test_a_flush_spools_all_that_was_published_before(operated: Operated) -> None:
    """With its response everything is durable, including messages that were still in the middleware."""
    operated.publisher.matched('/flushed')
    operated.publisher.publish('/flushed', texts(range(COUNT)), 0.0)
    answer = operated.station.flush()
    row = operated.node.topic('/flushed')
    assert (row['received'], row['stored'], row['open']) == (COUNT, COUNT, 0)
    assert answer == f'1 object with {COUNT} messages spooled'
    assert operated.station.flush() == '0 objects with 0 messages spooled'
    assert operated.numbers('flushed') == list(range(COUNT))


def test_flushes_within_a_second_overwrite_nothing(operated: Operated) -> None:
    """Objects of the same period have different names."""
    operated.publisher.matched('/repeated')
    for number in range(5):
        operated.publisher.publish('/repeated', texts([number]), 0.0)
        assert operated.station.flush() == '1 object with 1 message spooled'
    assert operated.numbers('repeated') == list(range(5))
    assert len(operated.stored(f'{operated.node.robot}/repeated').contents) == 5


def test_a_pause_counts_what_it_does_not_store(operated: Operated) -> None:
    """Messages before it are spooled, those during it are counted as lost by it, those after it are stored."""
    operated.publisher.matched('/paused')
    operated.publish('paused', range(COUNT))
    assert f'1 object with {COUNT} messages spooled' in operated.station.pause(paused=True)
    operated.publish('paused', range(COUNT, 2 * COUNT))
    assert operated.node.topic('/paused')['dropped'] == {'paused': COUNT}
    until(lambda: operated.station.diagnostics()['sensor_logger: node'].level == DiagnosticStatus.WARN, 'the pause is reported')
    assert operated.station.pause(paused=False) == 'messages are stored again'
    operated.publish('paused', range(2 * COUNT, 3 * COUNT))
    operated.station.flush()
    assert operated.numbers('paused') == [*range(COUNT), *range(2 * COUNT, 3 * COUNT)]
    assert operated.node.topic('/paused')['missed'] == operated.node.known(0)


def test_a_sensor_is_switched_off_and_on(operated: Operated) -> None:
    """While it is disabled its messages do not count, so nothing was missed when it is enabled again."""
    operated.publisher.matched('/switched')
    operated.publish('switched', range(COUNT))
    assert operated.station.set(switched__enabled=False) == ''
    until(lambda: operated.node.topic('/switched')['stored'] == COUNT, 'its open batch is spooled')
    listening = operated.station.node.get_subscriptions_info_by_topic
    until(lambda: not listening('/switched'), lambda: f'no subscriptions left: {[str(each) for each in listening("/switched")]}')
    operated.publisher.publish('/switched', texts(range(COUNT, 2 * COUNT)))
    assert operated.station.set(switched__enabled=True) == ''
    operated.publisher.heard('/switched', operated.node, texts(['again'])[0])
    operated.publish('switched', range(2 * COUNT, 3 * COUNT))
    operated.station.flush()
    row = operated.node.topic('/switched')
    assert (row['published'], row['missed']) == (operated.node.known(row['received']), operated.node.known(0))
    assert (row['accounting'] == 'exact') is operated.node.hears_numbers
    assert operated.numbers('switched') == [*range(COUNT), *range(2 * COUNT, 3 * COUNT)]


def test_a_sensor_that_is_off_in_the_file_is_switched_on(operated: Operated) -> None:
    """It exists, and has a subscription once it is enabled."""
    assert not operated.station.node.count_subscribers('/dormant')
    assert operated.station.set(dormant__enabled=True) == ''
    operated.publisher.matched('/dormant')
    operated.publish('dormant', range(COUNT))
    operated.station.flush()
    assert operated.numbers('dormant') == list(range(COUNT))


def test_a_changed_rate_applies_immediately(operated: Operated) -> None:
    """One message per thousand seconds becomes every message; the number may be an integer."""
    operated.publisher.matched('/sampled')
    operated.publish('sampled', range(COUNT))
    assert operated.node.topic('/sampled')['skipped'] == COUNT - 1
    assert operated.station.set(sampled__rate_hz=0) == ''
    operated.node.await_log('sampled.rate_hz = 0.0 from now on')
    operated.station.flush()  # the intake has handled the change
    operated.publish('sampled', range(COUNT, 2 * COUNT))
    operated.station.flush()
    assert operated.numbers('sampled') == [0, *range(COUNT, 2 * COUNT)]


def test_a_wrong_setting_changes_nothing(operated: Operated) -> None:
    """It is refused by name, value and what is allowed, with everything set in the same call; read-only settings as well."""
    reason = operated.station.set(told__priority=1, told__rate_hz=1e-9)
    assert all(words in reason for words in ('told.rate_hz', '1e-09', 'at least 0.0001'))
    assert 'read-only' in operated.station.set(told__batch_s=1.0)
    assert operated.station.get('told.priority') == 5
    assert operated.station.get('told.batch_s') == NEVER_S


def tell(operated: Operated, *words: str) -> tuple[bool, str]:
    """The output of ``shadowhound-data node``; its exit code agrees."""
    spool = str(operated.node.home / 'spool')
    result = CliRunner().invoke(cli, ['node', *words, '--json', '--spool', spool], standalone_mode=False)
    answer = json.loads(result.stdout)
    assert (result.return_value, answer['robot']) == (0 if answer['ok'] else 1, operated.node.robot)
    return answer['ok'], answer['message' if answer['ok'] else 'error']


def test_the_command_line_does_what_the_services_do(operated: Operated) -> None:
    """Over the socket the node responds with the same text, and each of the two sees the effects of the other."""
    operated.publisher.matched('/asked')
    operated.publisher.publish('/asked', texts(range(COUNT)), 0.0)
    assert tell(operated, 'flush') == (True, f'1 object with {COUNT} messages spooled')
    assert operated.station.flush() == '0 objects with 0 messages spooled'
    assert tell(operated, 'pause')[1].endswith(f'delivery continues; {operated.station.flush()}')
    assert operated.station.pause(paused=True) == tell(operated, 'pause')[1] == 'paused already'
    assert operated.station.pause(paused=False) == 'messages are stored again'
    assert tell(operated, 'resume') == (True, 'not paused')
    done, bag = tell(operated, 'bag', 'start')
    assert done
    assert operated.station.bag('start') == tell(operated, 'bag', 'start') == (False, f'{bag} is being recorded already')
    assert operated.station.bag('split') == tell(operated, 'bag', 'split') == (True, f'{bag} has 0 closed slices')
    assert operated.station.bag_pause(paused=True) == tell(operated, 'bag', 'pause') == (True, f'{bag} is paused')
    assert operated.station.bag_pause(paused=False) == tell(operated, 'bag', 'resume') == (True, f'{bag} is being recorded')
    assert operated.station.bag('stop') == (True, f'{bag}: 0 messages in 0 slices')
    assert operated.station.bag('stop') == tell(operated, 'bag', 'stop') == (False, 'nothing is recorded')
    assert operated.station.event() == tell(operated, 'event')
    assert not operated.station.event()[0]


@pytest.mark.parametrize(
    ('name', 'value'),
    [('rate_hz', 5.0), ('rate_hz', 5), ('priority', 7), ('priority', 7.5), ('rate_hz', -1.0), ('rate_hz', 1e-9),
     ('rate_hz', 'often'), ('enabled', 1), ('priority', 10), ('quality', 101), ('batch_s', 1.0)],
)  # fmt: skip
def test_a_parameter_is_checked_alike_by_services_and_command_line(operated: Operated, name: str, value: Any) -> None:
    """By the command line and by ROS; the reasons are the same, with more detail if the parameter can never be set."""
    full = f'asked.{name}'
    before = operated.station.get(full)
    reason = operated.station.set(**{f'asked__{name}': value})
    by_ros = operated.station.get(full)
    operated.station.set(**{f'asked__{name}': before})
    done, words = tell(operated, 'set', full, f'{value:.9f}' if isinstance(value, float) else str(value))
    assert done is (not reason)
    assert words == f'{full} = {value}' if done else words.startswith(reason)
    assert ('restart the node' in words) is (name == 'batch_s')
    until(lambda: operated.station.get(full) == by_ros, 'a front follows')
    assert by_ros == (value if done else before)


def test_diagnostics_cover_each_part(operated: Operated) -> None:
    """While there is a subscriber there is an entry for each topic and stage, with the robot as hardware."""
    operated.publisher.matched('/told')
    operated.publish('told', range(COUNT))
    found = operated.station.diagnostics()
    parts = [f'/{name}' for name in SENSORS] + ['node', 'bag', 'events', 'spool', 'store', 'clock', 'workers']
    assert set(found) == {f'sensor_logger: {part}' for part in parts}
    assert {entry.hardware_id for entry in found.values()} == {operated.node.robot}
    assert found['sensor_logger: /told'].level == DiagnosticStatus.OK
    assert found['sensor_logger: workers'].message == 'all work'
    assert int({pair.key: pair.value for pair in found['sensor_logger: /told'].values}['received']) >= COUNT
    operated.publisher.destroy('/told')
    stale = DiagnosticStatus.STALE
    until(lambda: operated.station.diagnostics()['sensor_logger: /told'].level == stale, 'the topic has no publisher')


def test_the_status_file_matches_the_ledger(operated: Operated) -> None:
    """The command line finds a running node, and after the last object an account of every topic like that of the ledger."""
    node, clock = operated.node, SystemClock.of_this_machine()
    operated.station.flush()
    rows = node.ledger()['topics']

    def is_reported() -> bool:
        found = status.read(node.home / 'spool', node.robot, clock)
        assert found.running
        return all(found.node.topics[name].stored == row['stored'] and not found.node.topics[name].open
                   and found.node.topics[name].missed == row['missed'] for name, row in rows.items())  # fmt: skip

    until(is_reported, 'the status is that of the ledger')


# -- several robots ----------------------------------------------------------------------------------------------------


@pytest.mark.long('robots of their own')
def test_two_robots_on_one_machine_share_a_spool(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """Two nodes in different namespaces share a spool: both log, one of them delivers for both, both accounts balance."""
    robots = [f'{processes.robot}_{number}' for number in range(2)]
    parameters = {'sensors': ['talk'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 0.2}
    nodes = [processes.node(seaweed.environment(), parameters, '-r', f'__ns:=/{robot}', robot='') for robot in robots]
    publisher = processes.publisher()
    for robot, node in zip(robots, nodes, strict=True):
        node.robot = robot
        publisher.create(f'/{robot}/talk', STRING)
        publisher.matched(f'/{robot}/talk')
        publisher.publish(f'/{robot}/talk', texts(range(COUNT)))
    for robot, node in zip(robots, nodes, strict=True):
        row = node.settled(f'/{robot}/talk', COUNT)
        assert (row['published'], row['received'], row['missed']) == (COUNT, COUNT, 0)
        assert row['stored_in']['delivered'] == COUNT
        assert stored(robot).numbers('talk') == list(range(COUNT))

    for robot, node in zip(robots, nodes, strict=True):
        with closing(connect(node.home / 'spool', robot)) as connection:
            assert connection.ask('describe')['node'] == f'/{robot}/sensor_logger_node'

    def states() -> list[str]:
        files = [status.file(node.home / 'spool', node.robot) for node in nodes]
        return sorted(json.loads(path.read_text())['store']['state'] for path in files)

    until(lambda: states() == ['idle', 'not_draining'], 'exactly one of them delivers')
    for node in nodes:
        node.stop()
        assert json.loads(status.file(node.home / 'spool', node.robot).read_text())['ended']
