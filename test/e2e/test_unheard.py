"""A publisher that the robot's RMW discovers and the node does not, due to its profile: an error until it is received."""

from __future__ import annotations

import json
import os
import signal
from contextlib import ExitStack
from importlib.util import find_spec

import pytest
from e2e.machines import Machines
from e2e.processes import HERE, Node, Processes, until
from e2e.reading import STRING

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.spool import status

pytestmark = pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')  # imported by children

SENSORS = {'sensors': ['there'], 'there.topics': ['there'], 'there.types': [STRING], 'there.rate_hz': 0.0}
SAID = 'by which the node listens, has not found; what it sends is not logged'


def findings(node: Node) -> list[str]:
    return list(status.read(node.home / 'spool', node.robot, SystemClock.of_this_machine()).findings)


@pytest.mark.long('twelve seconds of two machines')
def test_a_publisher_where_our_profile_does_not_look_is_an_error(processes: Processes) -> None:
    """In log and status, by its topic; once the networks are connected it is logged and no longer an error."""
    domain = processes.environ['ROS_DOMAIN_ID']
    everywhere = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', 'ROS_LOCALHOST_ONLY': '0'}
    with ExitStack() as stack:
        machines = Machines(stack)
        machines.start('publish', '/there', json.dumps([{'ROS_DOMAIN_ID': domain}]), other=True)
        path = os.pathsep.join([str(HERE.parent), *filter(None, [processes.environ.get('PYTHONPATH')])])
        node = processes.node(None, SENSORS, environ={**everywhere, 'PYTHONPATH': path},
                              program=(str(HERE / 'confined_node.py'), str(machines.robot), 'wlan0'))  # fmt: skip
        node.await_log('on 10.78.0.1, receive buffer')
        node.await_log(SAID)
        (line,) = (line for line in node.log.splitlines() if SAID in line)
        assert line.startswith('[ERROR]')
        assert '/there is not fully received: rmw_cyclonedds_cpp finds a publisher that rmw_fastrtps_cpp' in line
        until(lambda: any(SAID in text for text in findings(node)), 'the status reports it')
        assert node.topic('/there').get('received', 0) == 0
        machines.join_networks()
        until(lambda: not any(SAID in text for text in findings(node)), 'it is found')
        node.received('/there', 10)
        assert 'no longer has a publisher' in node.log
        node.signal(signal.SIGINT)
        assert node.wait() == 0
