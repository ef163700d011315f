"""With another RMW the front represents the node: it responds as the node would, and runs as long as the node does."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from e2e.processes import HERE, Node, Processes, until
from e2e.reading import STRING, texts
from e2e.station import Station
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.missions.mission_data_logger import MissionDataLogger
from shadowhound_data_logger.spool.control import connect
from shadowhound_data_logger.spool.status import read

FRONTED = (str(HERE / 'fronted_node.py'),)
FRONT = 'shadowhound_data_logger.node.reporting.front'
OFFERED = 'services and parameters are offered in'
DIRECT, BESIDE = '/direct', '/beside'
COUNT = 20
ENDS_S = 60.0
"""It takes at most 1.5 s on an idle machine."""
SENSORS: dict[str, Any] = {
    'sensors': ['talk'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 3600.0,
    'events.topics': ['talk'], 'events.post_s': 0.1, 'capture.rmw': 'robot',
}  # fmt: skip


@pytest.fixture(scope='module')
def nodes(shared: Processes) -> dict[str, Node]:
    """A node with its own services, and one with a front, otherwise identical; each with a separate home."""
    given = {
        space: shared.node(None, SENSORS, '-r', f'__ns:={space}', home=space.strip('/'), program=program)
        for space, program in ((DIRECT, ('-m', 'shadowhound_data_logger.node.sensor_logger_node')), (BESIDE, FRONTED))
    }
    given[BESIDE].await_log(OFFERED)
    return given


@pytest.fixture(scope='module')
def stations(shared: Processes, nodes: dict[str, Node]) -> Iterator[dict[str, Station]]:
    made = {space: Station(shared.environ, space) for space in nodes}
    yield made
    for station in made.values():
        station.close()


def fronts(node: Node) -> list[int]:
    """The front processes of a node."""
    found = []
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            words = path.read_bytes().decode(errors='replace').split('\0')
        except OSError:
            continue
        if FRONT in words and str(node.popen.pid) in words:
            found.append(int(path.parent.name))
    return found


def services_of(station: Station, name: str, namespace: str) -> set[str]:
    """Without their namespaces; none for a node that is not discovered yet."""
    try:
        found = station.node.get_service_names_and_types_by_node(name, namespace)
    except NodeNameNonExistentError:
        return set()
    return {service.removeprefix(f'{namespace.rstrip("/")}/{name}/') for service, _ in found}


def test_the_front_has_the_name_and_all_services(nodes: dict[str, Node], stations: dict[str, Station]) -> None:
    """The same as on a node with its own services; the subscribing node is hidden and offers nothing."""
    station = stations[BESIDE]
    until(lambda: ('_sensor_logger_intake', BESIDE) in station.node.get_node_names_and_namespaces(), 'the listener is seen')
    some = {'flush', 'pause', 'bag/start', 'event/trigger', 'set_parameters', 'describe_parameters'}

    def alike() -> bool:
        direct, beside = (services_of(station, 'sensor_logger_node', space) for space in (DIRECT, BESIDE))
        return some <= direct == beside

    until(alike, 'it offers all')
    assert services_of(station, '_sensor_logger_intake', BESIDE) == set()
    assert ('_sensor_logger_intake', DIRECT) not in station.node.get_node_names_and_namespaces()


def answers(station: Station) -> Iterator[Any]:
    """The responses of all services, in order; a bag's name is its time, so it is removed from them."""
    yield 'flush', station.flush()
    yield from (('pause', station.pause(paused=paused)) for paused in (True, True, False, False))
    done, bag = station.bag('start')
    yield 'start', done, bag.startswith('recording_')
    for words in (station.bag('start'), station.bag('split'), station.bag_pause(paused=True), station.bag_pause(paused=False),
                  station.bag('stop')):  # fmt: skip
        yield words[0], words[1].replace(bag, 'BAG')
    yield from (station.bag('stop'), station.bag('split'), station.bag_pause(paused=True))
    done, event = station.event()
    yield 'event', done, event.startswith('event_manual_'), event.endswith(' starts')


def test_each_service_answers_as_the_node_would(stations: dict[str, Station]) -> None:
    """With the same text, whether it succeeds or is refused."""
    direct = list(answers(stations[DIRECT]))
    assert list(answers(stations[BESIDE])) == direct
    assert (False, 'nothing is recorded') in direct


VALUES: list[tuple[str, Any]] = [
    ('talk.rate_hz', 5.0), ('talk.rate_hz', 7), ('talk.rate_hz', -1.0), ('talk.rate_hz', 1e-9), ('talk.rate_hz', 'often'),
    ('talk.rate_hz', None), ('talk.priority', 10), ('talk.priority', 2.5), ('talk.enabled', 1), ('talk.quality', 60),
    ('talk.batch_s', 1.0), ('talk.format', 'png'), ('sensors', ['talk']), ('events.log_event', '['), ('events.log_event', 'fall'),
    ('events.max_s', 1.0), ('upload.max_mbps', 8.0), ('talk.nope', 1), ('use_sim_time', 'maybe'), ('talk.rate_hz', 0.0),
]  # fmt: skip


def message(name: str, value: Any) -> ParameterMessage:
    found = Parameter(name, value=value) if value is not None else Parameter(name, Parameter.Type.NOT_SET)
    return found.to_parameter_msg()


def test_each_parameter_is_checked_as_by_the_node(stations: dict[str, Station]) -> None:
    """Individually and together, with the same reasons, and with the same values afterwards."""
    for name, value in VALUES:
        request = SetParameters.Request(parameters=[message(name, value)])
        direct, beside = (stations[space].call(SetParameters, '/set_parameters', request).results for space in (DIRECT, BESIDE))
        assert [(each.successful, each.reason) for each in beside] == [(each.successful, each.reason) for each in direct], name
        if name != 'talk.nope':
            assert stations[BESIDE].get(name) == stations[DIRECT].get(name)
    for values in ({'talk__priority': 3, 'talk__rate_hz': 1e-9}, {'talk__priority': 3, 'talk__rate_hz': 2.0}):
        assert stations[BESIDE].set(**values) == stations[DIRECT].set(**values)
        assert stations[BESIDE].get('talk.priority') == stations[DIRECT].get('talk.priority')


def test_each_parameter_is_described_as_by_the_node(stations: dict[str, Station]) -> None:
    """Names, types, ranges and descriptions."""
    direct, beside = (
        stations[space].call(ListParameters, '/list_parameters', ListParameters.Request()) for space in (DIRECT, BESIDE)
    )
    assert sorted(beside.result.names) == sorted(direct.result.names)
    assert len(direct.result.names) > 50
    request = DescribeParameters.Request(names=sorted(direct.result.names))
    direct, beside = (stations[space].call(DescribeParameters, '/describe_parameters', request) for space in (DIRECT, BESIDE))
    assert beside.descriptors == direct.descriptors


def run(node: Node, *words: str) -> dict[str, Any]:
    """The output of ``shadowhound-data node``."""
    spool = str(node.home / 'spool')
    result = CliRunner().invoke(cli, ['node', *words, '--json', '--spool', spool], standalone_mode=False)
    answer: dict[str, Any] = json.loads(result.stdout)
    return answer


def test_front_and_command_line_see_each_other_s_settings(nodes: dict[str, Node], stations: dict[str, Station]) -> None:
    """Each sees what the other set; the node uses it."""
    node, station = nodes[BESIDE], stations[BESIDE]
    assert station.set(talk__quality=77) == ''
    assert run(node, 'get', 'talk.quality')['values'] == {'talk.quality': 77}
    node.await_log('talk.quality = 77 from now on')
    assert run(node, 'set', 'talk.quality', '66')['ok']
    until(lambda: station.get('talk.quality') == 66, 'the front follows')
    assert station.set(talk__quality=65) == ''
    assert run(node, 'get', 'talk.quality')['values'] == {'talk.quality': 65}


def test_the_front_publishes_the_nodes_state(nodes: dict[str, Node], stations: dict[str, Station]) -> None:
    """``/diagnostics`` has the same entries, with the robot as hardware."""
    received: dict[str, Any] = {}

    def all_heard() -> bool:
        received.update(stations[BESIDE].diagnostics())
        return {name.partition('/')[0] for name in received} == {'direct', 'beside'}

    until(all_heard, 'both tell how they are')
    entries = {space: {name.partition(':')[2].replace(space, '') for name in received if name.startswith(space[1:])}
               for space in nodes}  # fmt: skip
    assert entries[BESIDE] - {'/talk'} == entries[DIRECT] - {'/talk'}
    assert {entry.hardware_id for name, entry in received.items() if name.startswith('beside')} == {nodes[BESIDE].robot}
    assert all(isinstance(pair.value, str) for entry in received.values() for pair in entry.values)


def test_only_a_front_compares_publishers(nodes: dict[str, Node]) -> None:
    """A node that uses the robot's RMW compares nothing, and reports that."""

    def undiscovered(space: str) -> Any:
        node = nodes[space]
        return read(node.home / 'spool', node.robot, SystemClock.of_this_machine()).node.middleware.undiscovered

    until(lambda: undiscovered(BESIDE) == {}, 'the front reports no undiscovered publishers')
    assert undiscovered(DIRECT) is None
    with closing(connect(nodes[DIRECT].home / 'spool')) as connection:
        assert not connection.ask('compare', found={})['ok']


def test_the_front_publishes_missions(nodes: dict[str, Node], stations: dict[str, Station]) -> None:
    """Latched, at the start and at the end."""
    node, station = nodes[BESIDE], stations[BESIDE]
    received: list[str] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = station.node.create_subscription(
        String, f'{BESIDE}/sensor_logger_node/mission', lambda told: received.append(told.data), latched
    )
    logger = MissionDataLogger(home=node.home, robot=node.robot, replay=False, start_timeout_s=0.0)
    try:
        until(lambda: station.spin() or received == [''], 'none is active')
        mission_id = logger.start_mission('patrol', 'go round')
        until(lambda: station.spin() or mission_id in received[-1], 'it is active')
        logger.end_mission(True, 0.0, 0.0)
        until(lambda: station.spin() or received[-1] == '', 'it is over')
    finally:
        logger.close()
        station.node.destroy_subscription(subscription)


@pytest.mark.long('kills')
def test_a_front_that_exits_is_restarted(shared: Processes, nodes: dict[str, Node], stations: dict[str, Station]) -> None:
    """The node continues, loses nothing, and reports it."""
    node, publisher = nodes[BESIDE], shared.publisher()
    publisher.create(f'{BESIDE}/talk', STRING)
    publisher.heard(f'{BESIDE}/talk', node, texts(['warm-up'])[0])
    assert run(node, 'flush')['ok']  # messages that ``heard`` sent more than once are counted
    before = node.topic(f'{BESIDE}/talk')['received']
    (first,) = fronts(node)
    publisher.publish(f'{BESIDE}/talk', texts(range(COUNT)))
    os.kill(first, signal.SIGKILL)
    publisher.publish(f'{BESIDE}/talk', texts(range(COUNT)))
    until(lambda: fronts(node) not in ([], [first]), 'another front is started')
    assert run(node, 'flush')['ok']
    until(lambda: node.log.count(OFFERED) == 2, 'it offers its services')
    until(lambda: stations[BESIDE].answers(2.0), 'its services answer')
    row = node.topic(f'{BESIDE}/talk')
    assert (row['received'], row['missed']) == (before + 2 * COUNT, node.known(0))
    assert 'front failed (1 times so far) and tries again: it exited by signal 9' in node.log


def test_the_front_ends_with_the_node(processes: Processes) -> None:
    """When it is stopped, and when it is killed: within seconds nothing responds on behalf of a node that is gone."""
    node = processes.node(None, SENSORS, program=FRONTED)
    node.await_log(OFFERED)
    assert len(fronts(node)) == 1
    node.kill()
    until(lambda: not fronts(node), 'the front of a killed node ends', ENDS_S)
    again = processes.node(None, SENSORS, program=FRONTED)
    again.await_log(OFFERED)
    again.stop()
    assert fronts(again) == []
    assert 'front failed' not in again.log


def test_name_and_remappings_of_the_command_line_apply_to_the_front(processes: Processes) -> None:
    """A name, rules, and parameters for that name alone: the front has the name, and the node uses all of them."""
    node = processes.node(
        None, SENSORS, '-r', '__node:=mine', '-r', 'mine:talk:=heard', '-p', 'mine:talk.priority:=2', program=FRONTED
    )
    node.await_log('logging /heard to')
    node.await_log(OFFERED)
    assert run(node, 'get', 'talk.priority')['values'] == {'talk.priority': 2}
    station = Station(processes.environ)
    try:
        until(lambda: 'flush' in services_of(station, 'mine', '/'), 'it has that name')
        assert services_of(station, '_sensor_logger_intake', '/') == set()
    finally:
        station.close()
    node.stop()
