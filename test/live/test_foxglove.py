"""Foxglove and Lichtblick: their protocol, who may, and messages that arrive as they were published."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from domains import free_domain
from live.test_access import Page, serving

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.live import server as module
from shadowhound_data_logger.live.access import Access, SignIn, make_tokens
from shadowhound_data_logger.live.foxglove import MOST_WAITING, PROTOCOLS, FoxgloveClient
from shadowhound_data_logger.live.kinds import RAW, LiveItem
from shadowhound_data_logger.live.server import LiveServer, LiveSettings

CAMERA, IMU, OTHER = '/camera', '/imu', '/other'
GRAPH = {CAMERA: 'sensor_msgs/msg/CompressedImage', IMU: 'sensor_msgs/msg/Imu', OTHER: 'nobody/msg/Knows'}


def message(topic: str, number: int, size: int = 10) -> LiveItem:
    return LiveItem(topic, 'raw', RAW, {'at_ns': number}, bytes([number % 256]) * size)


def all_of(client: FoxgloveClient) -> list[Any]:
    """Texts as parsed, messages as (subscription, time, body)."""
    found: list[Any] = []
    while (said := client.next()) is not None:
        found.append(json.loads(said) if isinstance(said, str) else (*struct.unpack('<BIQ', said[:13])[1:], said[13:]))
    return found


def subscribed(*topics: str) -> FoxgloveClient:
    """A client that is subscribed by the numbers 100, 101, ..."""
    client = FoxgloveClient('thor', 'session')
    client.publish(GRAPH)
    channels = {channel['topic']: channel['id'] for channel in all_of(client)[1]['channels']}
    wanted = [{'id': 100 + place, 'channelId': channels[topic]} for place, topic in enumerate(topics)]
    client.take({'op': 'subscribe', 'subscriptions': wanted})
    return client


def test_channels_have_definitions_and_follow_the_graph() -> None:
    """Types that nobody can describe are no channels; a topic that is gone or changes its type is taken back."""
    client = FoxgloveClient('thor', 'session')
    client.publish(GRAPH)
    about, told = all_of(client)
    assert (about['op'], about['sessionId']) == ('serverInfo', 'session')
    assert [channel['topic'] for channel in told['channels']] == [CAMERA, IMU]
    imu = told['channels'][1]
    assert (imu['encoding'], imu['schemaName'], imu['schemaEncoding']) == ('cdr', GRAPH[IMU], 'ros2msg')
    assert imu['schema'] == describe(GRAPH[IMU])[1]
    client.take({'op': 'subscribe', 'subscriptions': [{'id': 1, 'channelId': imu['id']}]})
    client.offer(message(IMU, 1))
    client.publish({CAMERA: GRAPH[CAMERA], IMU: 'std_msgs/msg/String'})
    gone, new = all_of(client)
    assert gone == {'op': 'unadvertise', 'channelIds': [imu['id']]}
    assert new['channels'][0]['id'] != imu['id']
    assert not client.watched


def test_what_a_slow_client_misses_is_large_or_old() -> None:
    """Of large messages the newest waits, of small ones some; small ones go first."""
    client = subscribed(CAMERA, IMU)
    for number in range(300):
        client.offer(message(CAMERA, number, 100_000))
        client.offer(message(IMU, number))
    found = all_of(client)
    assert [at for number, at, _ in found if number == 101] == list(range(300 - MOST_WAITING, 300))
    assert found[-1] == (100, 299, message(CAMERA, 299, 100_000).body)
    assert len(found) == MOST_WAITING + 1


@pytest.mark.parametrize('said', [
    {}, {'op': 7}, {'op': 'subscribe'}, {'op': 'subscribe', 'subscriptions': [1, None, {}, {'id': -1, 'channelId': 1}]},
    {'op': 'subscribe', 'subscriptions': [{'id': 1 << 32, 'channelId': 1}, {'id': 1, 'channelId': 'x'}]},
    {'op': 'subscribe', 'subscriptions': [{'id': True, 'channelId': 1}]},
    {'op': 'unsubscribe', 'subscriptionIds': [[], {}, 'x']}, {'op': 'unsubscribe', 'subscriptionIds': 7}, {'op': 'advertise'},
])  # fmt: skip
def test_a_client_that_says_nonsense_gets_nothing_new(said: dict[str, Any]) -> None:
    """And what it has goes on."""
    client = subscribed(IMU)
    client.take(said)
    assert client.watched == {IMU}
    client.offer(message(IMU, 5))
    assert (100, 5, message(IMU, 5).body) in all_of(client)


def test_a_subscription_ends() -> None:
    """Then nothing of it waits any more, and the topic is no longer read."""
    client = subscribed(IMU, CAMERA)
    client.offer(message(IMU, 1))
    client.take({'op': 'unsubscribe', 'subscriptionIds': [100]})
    client.offer(message(IMU, 2))
    assert client.watched == {CAMERA}
    assert all_of(client) == []


def test_a_ticket_is_for_one_address_and_ends(tmp_path: Path) -> None:
    """With the sign-in of whoever asked for it, whether by its time or by a sign-out, and with new tokens."""
    now = [1000.0]
    access = Access(make_tokens(tmp_path), is_open=True, now=lambda: now[0])
    signed_in, _ = access.sign_in((tmp_path / 'viewer.token').read_text().strip(), '192.0.2.1') or (SignIn('none'), '')
    ticket = access.ticket(signed_in, '192.0.2.1')
    assert access.of_ticket(ticket, '192.0.2.1') == signed_in.nonce
    assert access.of_ticket(access.ticket(SignIn('viewer'), '127.0.0.1'), '127.0.0.1') == ''
    for wrong in (ticket[:-1], ticket.replace('viewer', 'operator'), '', '...', 'viewer.9999999999..' + 64 * '0', 'x' * 9999):
        assert access.of_ticket(wrong, '192.0.2.1') is None
    assert access.of_ticket(ticket, '192.0.2.2') is None
    assert access.who(ticket) == SignIn('viewer')  # which everybody is here: it is no cookie
    now[0] += 6 * 3600
    late = access.ticket(signed_in, '192.0.2.1')
    assert access.of_ticket(late, '192.0.2.1') == signed_in.nonce
    now[0] += 7 * 3600
    assert [access.of_ticket(each, '192.0.2.1') for each in (ticket, late)] == [None, None]
    now[0] -= 13 * 3600
    access.sign_out(signed_in)
    assert access.of_ticket(ticket, '192.0.2.1') is None


async def _path(page: Page, who: str) -> str:
    status, _, body = await page.ask(who, 'GET', '/api/foxglove')
    assert status == (401 if who == 'stranger' else 200)
    return str(json.loads(body[body.index(b'{') : body.rindex(b'}') + 1]).get('path', ''))


def test_who_may_connect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever has a ticket of a viewer, from whatever page; nobody without one, and nobody by a foreign name of this machine."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            page.server._on_graph(GRAPH)
            assert await _path(page, 'stranger') == ''
            path = await _path(page, 'viewer')
            async with aiohttp.ClientSession() as session:
                for wrong, headers, status in (
                    (path[:-1], {}, 401),
                    ('/foxglove', {}, 401),
                    (path, {'Host': 'evil.example'}, 403),
                ):
                    async with session.get(f'{page.origin}{wrong}', headers=headers) as answer:
                        assert answer.status == status, wrong
                monkeypatch.setattr(module, 'MOST_FOXGLOVES', 1)
                async with session.ws_connect(
                    f'{page.origin}{path}', protocols=PROTOCOLS, headers={'Origin': 'https://app.foxglove.dev'}
                ) as ws:
                    assert ws.protocol == PROTOCOLS[0]
                    assert (await ws.receive_json(timeout=60))['op'] == 'serverInfo'
                    channels = (await ws.receive_json(timeout=60))['channels']
                    assert page.server._wanted == {}
                    await ws.send_json({'op': 'subscribe', 'subscriptions': [{'id': 9, 'channelId': channels[1]['id']}]})
                    while page.server._wanted != {IMU: {RAW}}:
                        await asyncio.sleep(0.01)
                    page.server._on_items([message(CAMERA, 1), message(IMU, 2)])
                    assert await ws.receive_bytes(timeout=60) == struct.pack('<BIQ', 1, 9, 2) + message(IMU, 2).body
                    async with session.get(f'{page.origin}{path}') as answer:
                        assert answer.status == 429
                    await page.ask('viewer', 'POST', '/api/sign-out')
                    while not ws.closed:
                        await ws.receive(60)
                while page.server._wanted is not None:
                    await asyncio.sleep(0.01)

    asyncio.run(run())


def test_a_client_is_told_why_it_may_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In its own protocol, which its alerts show: of an HTTP answer to a WebSocket a browser tells nothing."""

    async def told(session: aiohttp.ClientSession, url: str) -> tuple[dict[str, Any], int | None]:
        async with session.ws_connect(url, protocols=PROTOCOLS, headers={'Origin': 'http://lichtblick.example'}) as ws:
            status = await ws.receive_json(timeout=60)
            assert (await ws.receive(60)).type is aiohttp.WSMsgType.CLOSE
            return status, ws.close_code

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page, aiohttp.ClientSession() as session:
            page.server._on_graph(GRAPH)
            path = await _path(page, 'viewer')
            for wrong in ('/foxglove', path[:-1], f'/foxglove?ticket={page.token("viewer")}'):
                status, code = await told(session, f'{page.origin}{wrong}')
                assert (status['op'], status['level'], code) == ('status', 2, 1008)
                assert status['message'].startswith('get a new address')
            assert (page.server._foxgloves, page.server._wanted) == (set(), None)
            monkeypatch.setattr(module, 'MOST_FOXGLOVES', 0)
            status, code = await told(session, f'{page.origin}{path}')
            assert (status['level'], status['message'][:2], code) == (2, '0 ', 1013)

    asyncio.run(run())


@pytest.mark.ros
@pytest.mark.long('a publisher over DDS')
def test_a_message_arrives_as_it_was_published(  # noqa: PLR0915 - one conversation
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Byte by byte, of a type that the page shows and of one that it does not; read only while somebody is subscribed."""
    pytest.importorskip('rclpy')
    from rclpy.node import Node
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Imu
    from std_msgs.msg import String

    imu = Imu()
    imu.header.frame_id, imu.angular_velocity.x = 'imu', 0.25
    published = {'/imu': (Imu, serialize_message(imu)), '/word': (String, serialize_message(String(data='a word')))}

    async def run() -> None:
        server = LiveServer(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0))
        await server.open()
        node = Node('talker', start_parameter_services=False, enable_rosout=False)
        try:
            talkers = {topic: node.create_publisher(kind, topic, 10) for topic, (kind, _) in published.items()}
            origin = f'http://127.0.0.1:{server.port}'
            async with aiohttp.ClientSession() as session:
                path = (await (await session.get(f'{origin}/api/foxglove')).json())['path']
                async with session.ws_connect(f'{origin}{path}', protocols=PROTOCOLS) as ws:
                    numbers: dict[int, str] = {}
                    while len(numbers) < len(published):
                        said = await ws.receive_json(timeout=60)
                        for channel in said.get('channels', ()):
                            if channel['topic'] in published:
                                numbers[channel['id']] = channel['topic']
                                assert talkers[channel['topic']].get_subscription_count() == 0
                    await ws.send_json({'op': 'subscribe', 'subscriptions': [{'id': one, 'channelId': one} for one in numbers]})
                    found: dict[str, bytes] = {}
                    end_s = time.monotonic() + 60
                    while found.keys() != published.keys():
                        assert time.monotonic() < end_s, found
                        for topic, (_, cdr) in published.items():
                            talkers[topic].publish(cdr)
                        try:
                            data = (await ws.receive(0.2)).data
                        except asyncio.TimeoutError:
                            continue
                        if isinstance(data, bytes):
                            opcode, number, at_ns = struct.unpack('<BIQ', data[:13])
                            assert opcode == 1
                            assert abs(at_ns - time.time_ns()) < 60e9
                            found[numbers[number]] = data[13:]
                    assert found == {topic: cdr for topic, (_, cdr) in published.items()}
                while any(talker.get_subscription_count() for talker in talkers.values()):
                    assert time.monotonic() < end_s + 60
                    await asyncio.sleep(0.05)
        finally:
            node.destroy_node()
            await server.close()

    with free_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        asyncio.run(run())
