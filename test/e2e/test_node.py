"""The node from its operator's view: how it stops, what it refuses, and how it handles a robot's peculiarities."""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from e2e.processes import GENTLE, Processes, until
from e2e.reading import STRING, Objects, cdr, message_class, texts
from e2e.wire import HANG, PASS, Wire
from shadowhound_tower.embedded import Tower

TALK = {'sensors': ['talk'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 600.0}
"""A batch that does not end during a test: it is open until the node closes it."""
COUNT = 50


# -- stopping ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_closes_the_open_batches(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects], number: int
) -> None:
    """Everything received is stored, delivered and accounted for when the node has exited, with exit code 0."""
    node, publisher = processes.node(seaweed.environment(), TALK), processes.publisher()
    publisher.create('/talk', STRING)
    publisher.matched('/talk')
    publisher.publish('/talk', texts(range(COUNT)))
    node.received('/talk', COUNT)
    assert node.topic('/talk')['open'] == COUNT
    ledger = node.stop(number)
    assert ledger['topics']['/talk']['open'] == 0
    assert ledger['topics']['/talk']['stored_in']['delivered'] == COUNT
    assert stored(processes.robot).numbers('talk') == list(range(COUNT))


def test_systemd_is_notified_of_the_state(processes: Processes, seaweed: Tower, tmp_path: Path) -> None:
    """As a service it reports when it is ready, that it is alive, and that it stops."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / 'notify'))
        systemd.settimeout(60.0)
        watched = {'NOTIFY_SOCKET': str(tmp_path / 'notify'), 'WATCHDOG_USEC': '1500000'}
        node = processes.node({**seaweed.environment(), **watched}, TALK)
        assert systemd.recv(1000).decode().startswith('READY=1\nSTATUS=logging /talk to the S3 server')
        assert [systemd.recv(1000) for _ in range(2)] == [b'WATCHDOG=1'] * 2
        node.stop()
        reports = [systemd.recv(1000)]
        while not reports[-1].startswith(b'STOPPING=1'):
            reports.append(systemd.recv(1000))


def test_the_next_start_delivers_the_rest(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """A stop while the store is unreachable keeps everything in the spool, and reports it; the next start delivers it."""
    with Wire(seaweed.endpoint_url) as wire:
        wire.set((500, 'InternalError'))
        environ = {**seaweed.environment(), 'AWS_ENDPOINT_URL': wire.url}
        node, publisher = processes.node(environ, TALK), processes.publisher()
        publisher.create('/talk', STRING)
        publisher.matched('/talk')
        publisher.publish('/talk', texts(range(COUNT)))
        node.received('/talk', COUNT)
        assert node.stop()['topics']['/talk']['stored_in']['pending'] == COUNT
        assert 'stay in the spool' in node.log
        wire.set(PASS)
        processes.node(environ, TALK).delivered()
    assert stored(processes.robot).numbers('talk') == list(range(COUNT))


@pytest.mark.long('a node of its own that hangs')
def test_a_second_signal_exits_immediately(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """While it drains to a hung server, a second signal after a second stops it, and spooled data is delivered later."""
    with Wire(seaweed.endpoint_url) as wire:
        wire.set(HANG)
        environ = {**seaweed.environment(), 'AWS_ENDPOINT_URL': wire.url}
        node, publisher = processes.node(environ, {**TALK, 'shutdown.drain_s': 300.0}), processes.publisher()
        publisher.create('/talk', STRING)
        publisher.matched('/talk')
        publisher.publish('/talk', texts(range(COUNT)))
        node.received('/talk', COUNT)
        node.signal(signal.SIGINT)
        node.signal(signal.SIGINT)  # the same key press
        until(lambda: node.topic('/talk')['stored'] == COUNT, 'the open batch is durable')
        said_s = time.monotonic()
        until(lambda: time.monotonic() > said_s + 1.1, 'the second that distinguishes a second signal from an echo')
        assert node.popen.poll() is None
        node.signal(signal.SIGINT)
        assert node.wait() == 128 + signal.SIGINT
        assert node.topic('/talk')['stored_in']['pending'] == COUNT
        wire.set(PASS)
        processes.node(environ, TALK).delivered()
    assert stored(processes.robot).numbers('talk') == list(range(COUNT))


def test_without_a_server_the_store_is_a_folder(processes: Processes) -> None:
    """Without settings the data is written to a folder with the same layout, and the node reports where."""
    node, publisher = processes.node(None, TALK), processes.publisher()
    publisher.create('/talk', STRING)
    publisher.matched('/talk')
    publisher.publish('/talk', texts(range(COUNT)))
    node.received('/talk', COUNT)
    node.stop()
    assert str(node.home / 'store') in node.log
    folder = node.home / 'store' / 'sensor-data' / processes.robot / 'talk'
    assert len(list(folder.rglob('*_talk.json'))) == 1


# -- settings ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('parameters', 'words'),
    [
        ({'camera.rate_hertz': 2.0}, ('camera.rate_hertz = 2.0', 'camera.enabled', 'camera.rate_hz')),
        ({'queue.max_bytes': 17}, ('queue.max_bytes = 17', 'at least')),
        ({'imu.topics': ['no topic!']}, ("imu.topics = ['no topic!']", 'valid topic names')),
        ({'events.regex': '.*', 'events.conditions': ['x: t!:f < 1']}, ("events.conditions = 'x: t!:f < 1'", 'character 2')),
        ({'imu.topics': ['/odom']}, ("odom.topics = ['odom', 'utlidar/robot_odom']", '/odom is already in imu.topics')),
        ({'robot': '../x'}, ("robot = '../x'", 'letters, digits')),
    ],
    ids=['unknown', 'range', 'topic name', 'condition', 'topic twice', 'robot'],
)
def test_a_wrong_parameter_refuses_the_start(processes: Processes, parameters: dict[str, Any], words: tuple[str, ...]) -> None:
    """Exit code 2, and one line with the name, its value and what is allowed; nothing is left behind."""
    node = processes.node(None, parameters, ready=False)
    assert node.wait() == 2, node.log
    lines = [each for each in node.log.splitlines() if not each.startswith('[INFO]')]
    (line,) = (each for each in lines if 'left in shared memory' not in each)  # left by the killed nodes of other tests
    for word in words:
        assert word in line
    assert not (node.home / 'spool').exists()


def test_an_invalid_parameter_file_refuses_the_start(processes: Processes) -> None:
    """A parameter file that cannot be read prevents the start as well, without a traceback."""
    node = processes.node(None, {}, '--params-file', '/nonexistent.yaml', ready=False)
    assert node.wait() == 2, node.log
    assert '/nonexistent.yaml' in node.log
    assert 'Traceback' not in node.log


# -- peculiarities of a robot ------------------------------------------------------------------------------------------


def test_a_namespace_names_the_robot(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """In a namespace, topics are below it, and keys start with it."""
    robot = f'tachi_{processes.robot}'
    node = processes.node(seaweed.environment(), TALK, '-r', f'__ns:=/{robot}', robot='')
    publisher = processes.publisher()
    publisher.create(f'/{robot}/talk', STRING)
    publisher.matched(f'/{robot}/talk')
    publisher.publish(f'/{robot}/talk', texts(range(COUNT)))
    node.received(f'/{robot}/talk', COUNT)
    node.stop()
    objects = stored(robot)
    assert objects.numbers('talk') == list(range(COUNT))
    assert all(document['robot'] == robot for document in objects.documents('talk'))


def without_go2_interfaces() -> dict[str, str]:
    """The variables of an environment without that package."""
    return {
        name: os.pathsep.join(part for part in os.environ.get(name, '').split(os.pathsep) if 'go2_interfaces' not in part)
        for name in ('AMENT_PREFIX_PATH', 'PYTHONPATH')
    }


HIDE_GO2 = "import sys\nsys.modules['go2_interfaces'] = None\n"


@pytest.mark.long('a node of its own')
@pytest.mark.parametrize('made', ['on', 'off'])
def test_without_go2_interfaces_only_its_topics_are_affected(processes: Processes, tmp_path: Path, made: str) -> None:
    """They are received from their definitions; if that is off they log one warning each, and the others continue."""
    (tmp_path / 'hidden').mkdir()
    (tmp_path / 'hidden' / 'sitecustomize.py').write_text(HIDE_GO2)
    environ = without_go2_interfaces()
    environ['PYTHONPATH'] = os.pathsep.join(filter(None, (str(tmp_path / 'hidden'), environ['PYTHONPATH'])))
    node = processes.node(None, {}, environ=environ | {'SHADOWHOUND_TYPE_SUPPORT': made})
    sim = processes.sim(GENTLE)
    node.received('/odom', 30)
    node.received('/camera/compressed', 10)
    own = ('/imu', '/go2_states', '/lowstate')
    for topic in own if made == 'on' else ():
        node.received(topic, 5)
    sim.signal(signal.SIGINT)
    assert sim.wait() == 0
    ledger = node.stop()
    others = {'/odom', '/joint_states', '/camera/compressed', '/camera/camera_info', '/point_cloud2'}
    assert set(ledger['topics']) == others | set(own if made == 'on' else ())
    for topic in own:
        assert node.log.count(f'{topic} is not logged: its message package is not installed here') == (made == 'off')


def stamped(type_name: str, seconds: int = 0, **fields: Any) -> bytes:
    message = message_class(type_name)(**fields)
    message.header.stamp.sec = seconds
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def cloud(points: list[tuple[float, float, float]], **layout: int) -> bytes:
    from sensor_msgs.msg import PointField

    fields = [PointField(name=name, offset=4 * number, datatype=PointField.FLOAT32, count=1) for number, name in enumerate('xyz')]
    data = b''.join(struct.pack('<3f', *point) for point in points)
    layout = {'width': len(points), 'height': 1, 'point_step': 12, 'row_step': len(data)} | layout
    return stamped('sensor_msgs/msg/PointCloud2', fields=fields, data=data, **layout)


def test_malformed_messages_are_rejected_and_counted(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects]
) -> None:
    """Unreadable messages are rejected by reason and counted, those without an encoder are stored serialized, with their date."""
    jpeg, image = 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Image'
    good = simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8))
    nan = float('nan')
    messages = {
        '/jpeg': (jpeg, [stamped(jpeg, data=data) for data in (b'no image', good, b'', good[:40])]),
        '/raw': (image, [
            stamped(image, width=640, height=480, encoding='bgr8', step=1920, data=b'short'),
            stamped(image, width=2, height=2, encoding='mono8', step=2, data=b'four'),
            stamped(image, width=2, height=2, encoding='bayer', step=2, data=b'four'),
        ]),
        '/cloud': ('sensor_msgs/msg/PointCloud2', [cloud([]), cloud([(nan, nan, nan)] * 3), cloud([(1.0, 2.0, 3.0)]),
                                                 cloud([(1.0, 2.0, 3.0)] * 6, width=3, height=2, row_step=0)]),
    }  # fmt: skip
    parameters: dict[str, Any] = {'sensors': ['jpeg', 'raw', 'cloud']}
    for topic, (type_name, _) in messages.items():
        name = topic[1:]
        parameters |= {f'{name}.topics': [name], f'{name}.types': [type_name], f'{name}.rate_hz': 0.0,
                       f'{name}.format': 'pcd' if name == 'cloud' else 'jpeg'}  # fmt: skip
    node, publisher = processes.node(seaweed.environment(), parameters), processes.publisher()
    for topic, (type_name, bad) in messages.items():
        publisher.create(topic, type_name)
        publisher.matched(topic)
        publisher.publish(topic, bad)
        node.received(topic, len(bad))
    topics = node.stop()['topics']
    assert topics['/jpeg']['rejected'] == {'empty': 1, 'malformed': 1}
    assert topics['/raw']['rejected'] == {'size_mismatch': 1}
    assert (topics['/cloud']['rejected'], topics['/cloud']['corrected']) == ({}, {'row_step': 1})
    assert [topics[topic]['stored_in']['delivered'] for topic in messages] == [2, 2, 4]
    assert '/raw: a message of /publisher cannot be stored: size_mismatch' in node.log
    objects = stored(processes.robot)
    assert Counter(Path(key).suffix for key in objects.contents) == {'.jpg': 2, '.cdr': 2, '.pcd': 4}
    assert not [key for key in objects.contents if '/1970' in key], 'a header stamp of 1970 is not believed'


def test_a_truncated_message_is_rejected(processes: Processes) -> None:
    """Bytes that are not a message of the topic's type are rejected as malformed."""
    node, publisher = processes.node(None, {**TALK, 'talk.batch_s': 0.0}), processes.publisher()
    publisher.create('/talk', STRING)
    publisher.matched('/talk')
    publisher.publish('/talk', [cdr(STRING, data='whole'), cdr(STRING, data='cut short')[:9]])
    node.received('/talk', 2)
    row = node.stop()['topics']['/talk']
    assert (row['stored'], row['rejected']) == (1, {'malformed': 1})
