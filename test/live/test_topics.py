"""Subscriptions and their rates: real publishers, and viewers without a browser."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from domains import free_domain
from e2e.live_frames import Frames
from live.test_kinds import image
from ros.unknown_type import hidden, publisher

from shadowhound_data_logger.live import kinds
from shadowhound_data_logger.live.server import LiveServer, LiveSettings

pytestmark = [pytest.mark.ros, pytest.mark.long('publishers over DDS')]

IMU, OTHER, RAW_IMAGE = '/imu', '/other_imu', '/image_raw'
SOON_S = 10.0


class Tab:
    """A viewer, and when (``at``) the items that it got of each topic arrived at the robot."""

    def __init__(self, ws: aiohttp.ClientWebSocketResponse) -> None:
        self._ws = ws
        self.topics: list[str] = []
        self.told: dict[str, tuple[str, str, int]] = {}
        self.heads: dict[str, dict[str, Any]] = {}
        self.at: dict[str, set[float]] = {}
        self.samples: dict[str, dict[str, Any]] = {}

    async def watch(self, *topics: str) -> None:
        """Watch exactly these; a hidden tab watches none."""
        await self._ws.send_json({'watch': topics})

    async def read(self) -> None:
        frames = Frames()
        async for message in self._ws:
            for head, _ in frames.take(message.data):
                if head['kind'] == 'topics':
                    self.topics = [topic for topic, *_ in head['topics']]
                    self.told = {topic: (kind, name, count) for topic, kind, name, count in head['topics']}
                elif head['topic']:
                    self.heads[head['topic']] = head
                    self.at.setdefault(head['topic'], set()).add(head['at'])
                elif head['kind'] == 'sample':
                    self.samples[head['of']] = head
                elif head['kind'] == 'figures':  # each second, in which a page sends something too
                    await self._ws.send_json({'ping': 1})
            if (report := frames.acknowledgement()) is not None:
                await self._ws.send_bytes(report)


class Robot:
    """Publishers, and their live page."""

    def __init__(self, server: LiveServer, node: Any) -> None:
        from sensor_msgs.msg import Image, Imu

        self._origin, self.node = f'http://127.0.0.1:{server.port}', node
        types = {IMU: Imu, OTHER: Imu, RAW_IMAGE: Image}
        self.publishers = {topic: node.create_publisher(kind, topic, 10) for topic, kind in types.items()}

    def read(self) -> dict[str, int]:
        """Topic -> number of subscriptions, if any."""
        counts = {topic: publisher.get_subscription_count() for topic, publisher in self.publishers.items()}
        return {topic: count for topic, count in counts.items() if count}

    @asynccontextmanager
    async def tab(self) -> AsyncIterator[Tab]:
        """A viewer that has the list of topics and watches none yet."""
        async with (
            aiohttp.ClientSession(headers={'Origin': self._origin}) as session,
            session.ws_connect(f'{self._origin}/ws') as ws,
        ):
            tab = Tab(ws)
            reading = asyncio.create_task(tab.read())
            try:
                await until(lambda: {*tab.topics} >= {IMU, OTHER, RAW_IMAGE}, 'the topics are found')
                yield tab
            finally:
                reading.cancel()
                await asyncio.gather(reading, return_exceptions=True)

    async def shown(self, topic: str, message: Any, *tabs: Tab) -> None:
        """Publish until one more item of each has arrived."""
        before = [len(tab.at.get(topic, ())) for tab in tabs]

        def came() -> bool:
            self.publishers[topic].publish(message)
            return all(len(tab.at.get(topic, ())) > count for tab, count in zip(tabs, before, strict=True))

        await until(came, f'{topic} is shown', every_s=0.1)


async def until(condition: Callable[[], bool], what: str, seconds: float = 60.0, every_s: float = 0.02) -> None:
    end_s = asyncio.get_running_loop().time() + seconds
    while not condition():
        assert asyncio.get_running_loop().time() < end_s, f'within {seconds:g} s: {what}'
        await asyncio.sleep(every_s)


@asynccontextmanager
async def robot(folder: Path) -> AsyncIterator[Robot]:
    from rclpy.node import Node

    server = LiveServer(LiveSettings(spool=folder / 'spool', robot='thor', tokens=folder / 'live', port=0))
    await server.open()
    node = Node('talker', start_parameter_services=False, enable_rosout=False)
    try:
        yield Robot(server, node)
    finally:
        node.destroy_node()
        await server.close()


def run(folder: Path, monkeypatch: pytest.MonkeyPatch, doing: Callable[[Robot], Any]) -> None:
    """Run with a robot, in a separate domain."""
    pytest.importorskip('rclpy')

    async def with_robot() -> None:
        async with robot(folder) as found:
            await doing(found)

    with free_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        asyncio.run(with_robot())


def test_a_topic_is_read_once_and_only_while_watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the publishers count: no subscription before, one for any number of viewers, none once the last tab hides or leaves."""

    async def doing(found: Robot) -> None:
        from sensor_msgs.msg import Imu

        async with found.tab() as first:
            async with found.tab() as second:
                assert found.read() == {}
                await first.watch(IMU)
                await found.shown(IMU, Imu(), first)
                assert found.read() == {IMU: 1}
                await second.watch(IMU)
                await found.shown(IMU, Imu(), first, second)
                assert found.read() == {IMU: 1}
                await first.watch()
                await found.shown(IMU, Imu(), second)
                assert found.read() == {IMU: 1}
                await second.watch()
                await until(lambda: found.read() == {}, 'both are hidden', SOON_S)
                await second.watch(OTHER)
                await found.shown(OTHER, Imu(), second)
                assert found.read() == {OTHER: 1}
            await until(lambda: found.read() == {}, 'no visible tab is left', SOON_S)

    run(tmp_path, monkeypatch, doing)


def test_a_raw_image_is_encoded_once_for_all_viewers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of them: as many JPEGs are encoded as images are shown, and each viewer gets all."""
    encode, made = kinds.simplejpeg.encode_jpeg, list[int]()

    def counted(*given: Any, **more: Any) -> bytes:
        made.append(1)
        return bytes(encode(*given, **more))

    monkeypatch.setattr(kinds.simplejpeg, 'encode_jpeg', counted)
    message = image(np.full((48, 64, 3), 128, np.uint8), 'rgb8')

    async def doing(found: Robot) -> None:
        async with AsyncExitStack() as stack:
            tabs = [await stack.enter_async_context(found.tab()) for _ in range(3)]
            for tab in tabs:
                await tab.watch(RAW_IMAGE)
            for _ in range(6):
                await found.shown(RAW_IMAGE, message, *tabs)
            assert found.read() == {RAW_IMAGE: 1}
            await until(lambda: len(made) == len({at for tab in tabs for at in tab.at[RAW_IMAGE]}), f'{made} encoded')
            assert tabs[0].at == tabs[1].at == tabs[2].at

    run(tmp_path, monkeypatch, doing)


def test_topics_with_a_publisher_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With any names: if there are too many topics, those without a publisher are cut."""
    from shadowhound_data_logger.live import topics

    monkeypatch.setattr(topics, 'MAX_TOPICS', 20)

    async def doing(found: Robot) -> None:
        from sensor_msgs.msg import Imu
        from std_msgs.msg import Float32

        for number in range(30):
            found.node.create_subscription(Imu, f'/a_{number}', lambda _: None, 1)
        publisher = found.node.create_publisher(Float32, '/zzz', 1)
        async with found.tab() as tab:
            await until(lambda: '/zzz' in tab.topics, 'the topic is listed')
            assert len(tab.topics) == 20
            publishers = [count for *_, count in tab.told.values()]
            assert publishers == sorted(publishers, key=lambda count: count < 1)
            assert tab.told['/zzz'] == ('', 'std_msgs/msg/Float32', 1)
            assert tab.told[IMU] == ('imu', 'sensor_msgs/msg/Imu', 1)
            assert tab.told['/a_0'] == ('imu', 'sensor_msgs/msg/Imu', 0)
            found.node.destroy_publisher(publisher)
            await until(lambda: '/zzz' not in tab.topics, 'the topic is gone')

    run(tmp_path, monkeypatch, doing)


def test_any_topic_is_a_tree_and_its_numbers_are_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one subscription, which exists only while a viewer watches it; a path that leads nowhere is reported."""
    wave, number, wrong = '/wave#', '/wave#data', '/wave#data.x'

    async def doing(found: Robot) -> None:
        from std_msgs.msg import Float32

        found.publishers['/wave'] = found.node.create_publisher(Float32, '/wave', 1)
        async with found.tab() as tab:
            await until(lambda: '/wave' in tab.topics, 'the topic is found')
            assert found.read() == {}
            await tab.watch(wave, number)

            def came() -> bool:
                found.publishers['/wave'].publish(Float32(data=7.5))
                return len(tab.at.get(wave, ())) > 3 and len(tab.at.get(number, ())) > 3

            await until(came, 'it is shown', every_s=0.05)
            head = tab.heads[wave]
            assert head['tree'] == {'t': 'std_msgs/msg/Float32', 'f': {'data': 7.5}}
            assert head['bytes'] == 8
            assert 5 < head['hz'] < 21
            assert tab.heads[number]['names'] == ['data']
            assert found.read() == {'/wave': 1}
            await tab.watch(wrong)
            await until(lambda: (came(), wrong in tab.heads)[1], 'why it is not shown', every_s=0.05)
            assert 'is not a number of this message' in tab.heads[wrong]['text']
            await tab.watch()
            await until(lambda: found.read() == {}, 'nobody watches', SOON_S)

    run(tmp_path, monkeypatch, doing)


def test_what_was_published_once_is_shown_to_all_who_come_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A map, to the first viewer and to a second one; also if its publisher starts after the viewer started to watch."""

    async def doing(found: Robot) -> None:
        from nav_msgs.msg import OccupancyGrid
        from rclpy.qos import DurabilityPolicy, QoSProfile

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        message = OccupancyGrid(data=[0, 100])
        message.info.width, message.info.height, message.info.resolution = 2, 1, 0.05
        found.node.create_publisher(OccupancyGrid, '/map', latched).publish(message)
        waiting = found.node.create_subscription(OccupancyGrid, '/later', lambda _: None, latched)
        async with found.tab() as first, found.tab() as second:
            await until(lambda: {'/map', '/later'} <= {*first.topics}, 'the topics are found')
            await first.watch('/map', '/later')
            await until(lambda: '/map' in first.heads, 'the map is shown')
            await second.watch('/map', '/map#')
            await until(lambda: {'/map', '/map#'} <= {*second.heads}, 'the map is shown to the second viewer')
            found.node.create_publisher(OccupancyGrid, '/later', latched).publish(message)
            await until(lambda: '/later' in first.heads, 'the later map is shown')
        assert waiting is not None

    run(tmp_path, monkeypatch, doing)


def test_topics_of_the_table_are_sampled_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has rate, mean size and age after a few seconds, for all viewers, with at most two subscriptions at a time.

    Small messages, many, large, best effort, and from a publisher that sends nothing; none is subscribed to before or after.
    """

    async def doing(found: Robot) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from rclpy.serialization import serialize_message
        from sensor_msgs.msg import Image, Imu
        from std_msgs.msg import Float32

        effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        for topic, kind, profile in (('/slow', Float32, 1), ('/fast', Imu, effort), ('/none', Float32, 1)):
            found.publishers[topic] = found.node.create_publisher(kind, topic, profile)
        sent = {
            '/slow': (5.0, Float32()),
            IMU: (20.0, Imu()),
            '/fast': (200.0, Imu()),
            RAW_IMAGE: (10.0, Image(data=bytes(1 << 20))),
        }
        most: list[int] = []

        def publish() -> None:
            """Each as often as it should be by now."""
            passed_s = time.monotonic() - began_s
            for topic, (hz, message) in sent.items():
                while counts[topic] < passed_s * hz:
                    found.publishers[topic].publish(message)
                    counts[topic] += 1
            most.append(len(found.read()))

        async with found.tab() as first, found.tab() as second:
            await until(lambda: {'/slow', '/fast', '/none'} <= {*first.topics}, 'the topics are found')
            assert found.read() == {}
            await first.watch(*(f'{topic}#?' for topic in (*sent, '/none')))
            began_s, counts = time.monotonic(), dict.fromkeys(sent, 0)
            await until(lambda: (publish(), len(first.samples) == 5)[1], 'all are sampled', every_s=0.002)
            for topic, (hz, message) in sent.items():
                sample = first.samples[topic]
                assert hz * 0.7 < sample['hz'] < hz * 1.3, sample
                assert abs(sample['bytes'] - len(serialize_message(message))) < 4
                assert 0 <= sample['age_s'] < 1.5 / hz + 0.5
                assert not sample['latched']
            assert first.samples[RAW_IMAGE]['messages'] < 15, 'large messages are few'
            silent = first.samples['/none']
            assert (silent['messages'], silent['hz'], silent['bytes'], silent['age_s']) == (0, None, None, None)
            assert max(most) == 2
            assert {**second.samples, **first.samples} == second.samples
            await first.watch()
            await until(lambda: found.read() == {}, 'nobody needs them', SOON_S)

    run(tmp_path, monkeypatch, doing)


def test_a_latched_topic_has_no_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its size, and the age of the message that its publisher keeps; that message is received once."""

    async def doing(found: Robot) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Float32

        latched = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        found.publishers['/once'] = found.node.create_publisher(Float32, '/once', latched)
        for _ in range(5):
            found.publishers['/once'].publish(Float32())
        sent_s = time.monotonic()
        async with found.tab() as tab:
            await until(lambda: '/once' in tab.topics, 'the topic is found')
            await tab.watch('/once#?')
            ends: set[float] = set()
            while len(ends) < 2:
                await until(lambda: '/once' in tab.samples, 'it is sampled')
                sample = tab.samples.pop('/once')
                ends.add(sample['at'])
                assert (sample['latched'], sample['messages'], sample['hz'], sample['bytes']) == (True, 0, None, 8)
                assert abs(sample['at'] / 1e3 - sample['age_s'] - sent_s) < 0.5

    run(tmp_path, monkeypatch, doing)


def test_a_slow_topic_has_a_rate_though_it_matches_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic at 1 Hz whose publisher is busy for the first four seconds of a sample, like the diagnostics of a busy robot."""
    from std_msgs.msg import Float32

    async def doing(robot: Robot) -> None:
        publisher = robot.node.create_publisher(Float32, '/slow', 1)
        now_s = asyncio.get_running_loop().time
        due_s, late_s = 0.0, 0.0

        def publish() -> bool:
            """Once per second while it has a subscription, after this delay."""
            nonlocal due_s
            if not publisher.get_subscription_count():
                due_s = now_s() + late_s
            elif now_s() >= due_s:
                publisher.publish(Float32())
                due_s = max(now_s(), due_s) + 1.0
            return '/slow' in tab.samples

        async with robot.tab() as tab:
            await tab.watch('/slow#?')
            for late_s in (0.0, 4.0):
                await until(publish, f'it is sampled, {late_s} s late')
                sample = tab.samples.pop('/slow')
                assert sample['hz'] is not None, (late_s, sample)
                assert 0.7 < sample['hz'] < 1.3, (late_s, sample)

    run(tmp_path, monkeypatch, doing)


def test_why_a_topic_cannot_be_sampled_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once for all viewers, and the others are sampled."""
    from shadowhound_data_logger.live import sampling

    class Reader(sampling.Reader):
        def __init__(self, node: Any, plan: Any, group: Any) -> None:
            if plan.topic == OTHER:
                raise sampling.TypeUnavailable('its message package is not installed here')
            super().__init__(node, plan, group)

    monkeypatch.setattr(sampling, 'Reader', Reader)

    async def doing(found: Robot) -> None:
        from sensor_msgs.msg import Imu

        async with found.tab() as tab:
            await tab.watch(f'{OTHER}#?', f'{IMU}#?')

            def came() -> bool:
                found.publishers[IMU].publish(Imu())
                return {OTHER, IMU} <= {*tab.samples}

            await until(came, 'both are reported', every_s=0.05)
            assert tab.samples[OTHER]['why'] == 'its message package is not installed here'
            assert tab.samples[IMU]['hz'] > 5

    run(tmp_path, monkeypatch, doing)


def test_a_message_of_an_unknown_type_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its publisher provides the definition, also for a sample of the topic."""

    async def doing(found: Robot) -> None:
        with publisher(int(os.environ['ROS_DOMAIN_ID'])):
            async with found.tab() as tab:
                await until(lambda: '/arrays' in tab.topics, 'the topic is found')
                await tab.watch('/arrays#?')
                await until(lambda: '/arrays' in tab.samples, 'it is sampled')
                assert tab.samples['/arrays']['bytes'] > 100
                await tab.watch('/arrays#')
                await until(lambda: '/arrays#' in tab.heads, 'its message is shown')
                assert 'alignment_check' in str(tab.heads['/arrays#'])

    with hidden(monkeypatch):
        run(tmp_path, monkeypatch, doing)
