"""Which namespaces belong to robots."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.node.intake.found_topics import robots_in

ROBOT = ('odom', 'imu', 'camera/image_raw')


@pytest.mark.parametrize(
    ('topics', 'own', 'robots'),
    [
        ([f'/{name}/{topic}' for name in ('robot1', 'robot0') for topic in ROBOT], '/', ['/robot0', '/robot1']),
        ([f'/fleet/{name}/{topic}' for name in ('a', 'b') for topic in ROBOT], '/fleet', ['/fleet/a', '/fleet/b']),
        ([f'/{topic}' for topic in ROBOT], '/', []),
        ([f'/robot0/{topic}' for topic in ROBOT], '/robot0', []),
        ([f'/robot1/{topic}' for topic in ROBOT], '/robot0', []),
        (['/mavros/imu', '/front/camera/image_raw', '/odom', '/x'], '/', []),
    ],
)
def test_namespaces_of_robots_are_found(topics: list[str], own: str, robots: list[str]) -> None:
    """Those with at least three topics named like those of default sensors; namespaces of a robot's parts are not included."""
    assert robots_in(topics, own) == robots
