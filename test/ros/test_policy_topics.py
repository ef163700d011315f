"""Nodes receive the active policy, and roll back one that breaks its limits; invalid health messages are counted."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from policies.models import Scene
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from shadowhound_data_logger.ros.policy_topics import MAX_HEALTH_BYTES, NODE, PolicyTopics, serve_policy_topics


class Listener:
    """A node of the robot: the messages received on ``~/policy``, and its ``~/health``."""

    def __init__(self, context: rclpy.Context) -> None:
        self.node = Node('driver', context=context)
        self.heard: list[str] = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, f'/{NODE}/policy', self._hear, latched)
        self.health = self.node.create_publisher(String, f'/{NODE}/health', 10)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)

    def _hear(self, message: String) -> None:
        self.heard.append(message.data)

    def until(self, condition: Callable[[], object], what: str) -> None:
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end, f'{what}: {self.heard}'
            self.executor.spin_once(timeout_sec=0.02)

    def say(self, told: Any) -> None:
        self.health.publish(String(data=told if isinstance(told, str) else json.dumps(told)))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A robot that had version 1 and has version 2."""
    scene = Scene(tmp_path)
    for version in (1, 2):
        scene.publish(version)
        scene.registry.set_alias('champion', version)
        scene.robot.run()
    return scene


@pytest.fixture
def listener(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Listener]:
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    context = rclpy.Context()
    rclpy.init(context=context)
    made = Listener(context)
    yield made
    made.executor.shutdown()
    made.node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_a_policy_is_published_evaluated_and_rolled_back(scene: Scene, listener: Listener) -> None:
    first, second = scene.folder.versions.ids()
    with serve_policy_topics(scene.folder) as topics:
        listener.until(lambda: listener.heard, 'a node that comes later hears it too')
        assert listener.heard[-1] == second
        listener.until(listener.health.get_subscription_count, 'somebody listens to its health')
        bad: list[tuple[str, Any]] = [
            ('size', 'x' * (MAX_HEALTH_BYTES + 1)), ('json', '{'), ('json', []), ('json', {'failures': 9}),
            ('values', {'policy': second, 'failures': -1}), ('values', {'policy': second, 'failures': True}),
            ('values', f'{{"policy": "{second}", "p99_ms": 1e999}}'), ('values', f'{{"policy": "{second}", "p99_ms": NaN}}'),
            ('values', {'policy': second, 'p99_ms': 10**400}), ('values', {'policy': second, 'failures': 10**400}),
            ('json', f'{{"policy": "{second}", "failures": 1{"0" * 3900}'), ('values', {'policy': second, 'p99_ms': 'slow'}),
            ('other', {'policy': first, 'failures': 99}), ('other', {'policy': '../../etc', 'failures': 99}),
            ('json', '[' * 4000),
        ]  # fmt: skip
        for number, (_, report) in enumerate(bad, 1):
            listener.say(report)
            listener.until(lambda number=number: topics.ignored.total() == number, f'number {number} is ignored')
        assert dict(topics.ignored) == {reason: sum(each == reason for each, _ in bad) for reason, _ in bad}
        listener.say({'policy': second, 'failures': 3, 'p99_ms': 1.0})
        listener.say({'policy': first, 'failures': 0})
        listener.until(lambda: topics.ignored.total() == len(bad) + 1, 'the one before it was judged')
        assert scene.folder.current() == second, 'within its limits'
        listener.say({'policy': second, 'failures': 4, 'p99_ms': 1.0})
        listener.until(lambda: listener.heard[-1] == first, 'the last good one is active')
        assert scene.folder.state.read().bad[second].startswith('4 steps failed')
        scene.folder.roll_back()
        listener.until(lambda: listener.heard[-1] == '', 'none is active')


def test_a_policy_that_cannot_be_evaluated_stays_active(
    scene: Scene, listener: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    """With a missing manifest: the fault is reported, and the topics continue."""
    now = scene.folder.current()
    assert now is not None
    node = Node('judge', context=listener.node.context)
    try:
        topics = PolicyTopics(node, scene.folder)
        manifest = scene.folder.versions.path / now / 'manifest.json'
        manifest.parent.chmod(0o700)
        manifest.unlink()
        topics._on_health(String(data=json.dumps({'policy': now, 'failures': 99})))
        assert 'cannot be evaluated' in caplog.text
        assert scene.folder.current() == now
    finally:
        node.destroy_node()
