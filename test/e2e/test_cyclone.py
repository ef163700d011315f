"""A robot that speaks Cyclone DDS: the node listens through Fast DDS, hears it, and accounts for all of it."""

from __future__ import annotations

import pytest
from e2e.processes import Processes
from e2e.reading import STRING, texts

pytest.importorskip('cyclonedds')

CYCLONE = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
"""What the environment of such a robot has."""
COUNT = 200
SENSORS = {'sensors': ['plain'], 'plain.topics': ['plain'], 'plain.rate_hz': 0.0, 'plain.batch_s': 0.2}


@pytest.mark.parametrize('reliable', [False, True])
def test_the_account_of_a_cyclone_robot_is_exact(processes: Processes, *, reliable: bool) -> None:
    """Its messages are numbered for us, though its own RMW would not tell; the first line says how we listen."""
    node = processes.node(None, SENSORS, environ=CYCLONE)
    assert "listening by rmw_fastrtps_cpp (the robot's is rmw_cyclonedds_cpp" in node.log
    driver = processes.publisher(cyclone=True)
    driver.create('/plain', STRING, reliable=reliable)
    driver.heard('/plain', node, texts(['warm-up'])[0])
    driver.publish('/plain', texts(range(COUNT)))
    node.received('/plain', COUNT)
    row = node.stop()['topics']['/plain']
    assert (row['accounting'], row['missed'], row['published']) == ('exact', 0, row['received'])
