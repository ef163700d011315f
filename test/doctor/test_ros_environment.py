"""The environment of the topics: sim time without a clock, frames that do not move, a Zenoh router that is down."""

from __future__ import annotations

import socket
import time
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.doctor import ros, ros_environment, ros_watch
from shadowhound_data_logger.doctor.ros_watch import WatchedTopic

STORE = get_typestore(Stores.LATEST)
TRANSFORMS = 'tf2_msgs/msg/TFMessage'


def checks(found: Any) -> list[tuple[str, bool]]:
    return [(each.check, each.is_finding) for each in found]


@pytest.mark.parametrize(('publishers', 'nodes', 'findings'), [(0, ['nav2', 'rviz'], 1), (1, ['nav2'], 0), (0, [], 0)])
def test_sim_time_without_a_clock_is_a_finding(publishers: int, nodes: list[str], findings: int) -> None:
    """Nodes that subscribe to /clock while it has no publisher are named, with the remedy."""
    asked = [SimpleNamespace(node_namespace='/', node_name=name) for name in nodes]
    node: Any = SimpleNamespace(count_publishers=lambda _: publishers, get_subscriptions_info_by_topic=lambda _: asked)
    found = list(ros._clock(ros_watch.waiting_for_clock(node)))
    assert len(found) == findings
    assert all('/nav2, /rviz use sim time' in each.seen and 'ros2 param set /nav2' in each.remedy for each in found)


def tf(age_s: float) -> bytes:
    of, stamp_ns = STORE.types, time.time_ns() - round(age_s * 1e9)
    header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9)), 'odom')
    still = of['geometry_msgs/msg/Transform'](
        of['geometry_msgs/msg/Vector3'](0, 0, 0), of['geometry_msgs/msg/Quaternion'](0, 0, 0, 1)
    )
    return bytes(
        STORE.serialize_cdr(of[TRANSFORMS]([of['geometry_msgs/msg/TransformStamped'](header, 'base', still)]), TRANSFORMS)
    )


@pytest.mark.parametrize(
    ('received', 'age_s', 'is_finding'),
    [(50, 0.1, False), (50, 60.0, True), (0, None, True), (50, None, False)],
    ids=['moving', 'old stamps', 'silent', 'unreadable'],
)
def test_frames_that_do_not_move_are_a_finding(received: int, age_s: float | None, is_finding: bool) -> None:
    """A publisher that is silent, or repeats old transforms."""
    newest = b'' if age_s is None else tf(age_s)
    one = WatchedTopic('/tf', [], TRANSFORMS, received=received, newest=newest, window_s=2.5)
    assert checks(ros._transforms(one)) == [('ros.tf', is_finding)]


def test_an_unreachable_zenoh_router_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that responds is fine, one that does not is a finding, and one named in a configuration is not checked."""
    with closing(socket.create_server(('localhost', 0))) as server:
        monkeypatch.setattr(ros_environment, 'ROUTER', ('localhost', server.getsockname()[1]))
        given = {'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp'}
        assert checks(ros_environment._middleware(given)) == [('ros.middleware', False)]
    assert checks(ros_environment._middleware(given)) == [('ros.middleware', False), ('ros.zenoh', True)]
    configured = {**given, 'ZENOH_SESSION_CONFIG_URI': '/etc/zenoh.json5'}
    assert checks(ros_environment._middleware(configured)) == [('ros.middleware', False)]
