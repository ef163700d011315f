"""A robot with Cyclone DDS: the node subscribes through Fast DDS, receives its messages, and accounts for all of them."""

from __future__ import annotations

import os
import signal
import time
from importlib.util import find_spec

import pytest
from e2e.processes import Processes, until
from e2e.reading import STRING, cdr, texts

from shadowhound_data_logger.node.intake.middleware import possible_buffer

pytestmark = pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')  # imported by children

CYCLONE = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
"""The environment of such a robot."""
COUNT = 200
SENSORS = {'sensors': ['plain'], 'plain.topics': ['plain'], 'plain.rate_hz': 0.0, 'plain.batch_s': 0.2}


@pytest.mark.parametrize('reliable', [False, pytest.param(True, marks=pytest.mark.long('a robot of its own'))])
def test_the_account_of_a_cyclone_robot_is_exact(processes: Processes, *, reliable: bool) -> None:
    """Its messages are numbered for us, though its own RMW has no numbers; the first line reports our RMW."""
    node = processes.node(None, SENSORS, environ=CYCLONE)
    assert "listening by rmw_fastrtps_cpp (the robot's is rmw_cyclonedds_cpp" in node.log
    driver = processes.publisher(cyclone=True)
    driver.create('/plain', STRING, reliable=reliable)
    driver.heard('/plain', node, texts(['warm-up'])[0])
    driver.publish('/plain', texts(range(COUNT)))
    node.received('/plain', COUNT)
    row = node.stop()['topics']['/plain']
    assert (row['accounting'], row['missed'], row['published']) == ('exact', 0, row['received'])


LARGE = {
    'image': ('sensor_msgs/msg/Image', 15.0, {'height': 480, 'width': 640, 'encoding': 'bgr8', 'data': bytes(921_600)}),
    'cloud': ('sensor_msgs/msg/PointCloud2', 10.0, {'height': 1, 'width': 20_000, 'point_step': 16, 'data': bytes(320_000)}),
}
LARGE_COUNT = 40


@pytest.mark.skipif(possible_buffer() < 1 << 20, reason='net.core.rmem_max is below 1 MB: a matter of luck for either')
@pytest.mark.long('fourteen seconds of images and clouds')
@pytest.mark.parametrize('kind', LARGE)
def test_large_messages_arrive_as_they_do_with_cyclone_dds(processes: Processes, kind: str) -> None:
    """Raw images and clouds, BEST_EFFORT and depth 1 as in a Go2's driver: never fewer than its own RMW receives."""
    type_name, rate_hz, fields = LARGE[kind]
    own = {'sensors': ['large'], 'large.topics': ['large'], 'large.types': [type_name], 'large.format': 'cdr'}
    node = processes.node(None, own, environ=CYCLONE)
    driver, reader = processes.publisher(cyclone=True), processes.publisher(cyclone=True)
    message = cdr(type_name, **fields)
    driver.create('/large', type_name, reliable=False, depth=1)
    reader.listen('/large', type_name, reliable=False, depth=10)
    driver.heard('/large', node, message)
    driver.matched('/large', 2)
    before = node.topic('/large')['received'], reader.count('/large')
    driver.again('/large', message, LARGE_COUNT, 1 / rate_hz)
    node.received('/large', before[0] + reader.count('/large') - before[1])
    row = node.stop()['topics']['/large']
    assert row['accounting'] == 'exact'
    assert row['published'] == row['received'] + row['missed']


@pytest.mark.slow
@pytest.mark.long('a node that is stopped until Fast DDS loses its place')
def test_a_publisher_that_outruns_the_node_loses_messages_and_not_the_topic(processes: Processes) -> None:
    """It no longer has the fragments that the node lacks, and Fast DDS loses its position: it continues, nothing is invented.

    Humble's Fast DDS 2.6 keeps its position, so there the node is only stopped several times.
    """
    stops = 0
    node, driver = processes.node(None, SENSORS, environ=CYCLONE), processes.publisher(cyclone=True)
    driver.create('/plain', STRING, depth=1)
    driver.heard('/plain', node, texts(['warm-up'])[0])
    driver.begin_numbered('/plain', 'large', 300_000, 0.01)

    def is_lost() -> bool:
        nonlocal stops
        node.signal(signal.SIGSTOP)
        time.sleep(0.3)
        node.signal(signal.SIGCONT)
        time.sleep(0.2)
        stops += 1
        return 'subscribing again' in node.log or (os.environ.get('ROS_DISTRO') == 'humble' and stops == 40)

    until(is_lost, 'Fast DDS loses its place', 150.0)
    node.received('/plain', node.topic('/plain')['received'] + 50)
    driver.halt_numbered('/plain')
    row = node.stop()['topics']['/plain']
    assert (row['accounting'], row['rejected']) == ('exact', {})
    assert row['missed'] > 0
