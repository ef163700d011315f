#!/usr/bin/env python3
"""How late our page and foxglove-sdk's server are on the same slow links, side by side: one line of JSON for each link.

    pip install --target FOLDER foxglove-sdk==0.30.3
    scripts/with-env python bench/live_foxglove.py --sdk FOLDER [--links 8 2] [--seconds 20]

Needs root: both run in a network namespace where what they send leaves at so many Mbit/s (``shape`` in live.py), one after the
other, each with one viewer, of the same simulated robot. foxglove-sdk has its defaults, and is given each message as it came
(CDR), by readers such as the page's. Both are late by the same clock: from when a message came to this machine to the viewer's
handler, all of them after ten seconds in which a backlog has its time to fill. foxglove-sdk is no dependency of this package.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import secrets
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import aiohttp

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from domains import free_domain
from e2e.processes import Process, Processes, until
from live import KINDS, TOPICS, Watcher, shape  # live.py beside this file

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.live.foxglove import PROTOCOLS
from shadowhound_data_logger.live.kinds import KINDS as KIND_OF_TYPE

SDK = 'LIVE_BENCH_SDK'
"""The variable with the folder of foxglove-sdk, for the processes of this benchmark."""
FILL_S = 10.0
DISCOVERY_S = 2.0
KIND = dict(zip(TOPICS, KINDS, strict=True))
MESSAGE_DATA = 1
"""github.com/foxglove/ws-protocol, docs/spec.md"""


def load_sdk() -> Any:
    """foxglove-sdk, from its folder. Ends the program where it is not there; another package has its name on PyPI."""
    folder = os.environ.get(SDK, '')
    sys.path[:0] = [folder] if folder else []
    try:
        foxglove = import_module('foxglove')
    except ImportError:
        foxglove = None
    if not hasattr(foxglove, 'start_server'):
        raise SystemExit('live_foxglove: foxglove-sdk is not there: pip install --target FOLDER foxglove-sdk, then --sdk FOLDER')
    return foxglove


def serve() -> None:
    """The process with foxglove-sdk's server: says at which port, and runs until it is ended."""
    import rclpy  # noqa: PLC0415 - of this process alone
    from rclpy.node import Node  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    from shadowhound_data_logger.live.topics import POLL_S, _Watched  # noqa: PLC0415

    foxglove = load_sdk()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node('live_foxglove', start_parameter_services=False, enable_rosout=False)
    time.sleep(DISCOVERY_S)
    types = {topic: names[0] for topic, names in node.get_topic_names_and_types() if topic in TOPICS}
    read = []
    for topic, name in types.items():
        encoding, definition, _ = describe(name)
        schema = foxglove.Schema(name=name, encoding=encoding, data=definition.encode())
        channel = foxglove.Channel(topic, message_encoding='cdr', schema=schema)
        read.append((channel, _Watched(node, topic, name, KIND_OF_TYPE[name], is_raw=True)))
    server = foxglove.start_server(name='bench', host='127.0.0.1', port=0)
    print('port', server.port, len(read), flush=True)
    next_s = time.monotonic()
    while True:
        next_s += POLL_S
        time.sleep(max(0.0, next_s - time.monotonic()))
        for channel, one in read:
            for message in one.reader.drain(one.most):
                channel.log(message.cdr, log_time=message.received_ns or time.time_ns())


class FoxgloveWatcher(Watcher):
    """A viewer that speaks Foxglove's protocol."""

    async def run(self, **_: object) -> None:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(self.url, protocols=PROTOCOLS, max_msg_size=0) as ws,
        ):
            topics: dict[int, str] = {}
            async for message in ws:
                if message.type is aiohttp.WSMsgType.TEXT:
                    said = json.loads(message.data)
                    channels = said['channels'] if said['op'] == 'advertise' else ()
                    new = [each for each in channels if each['topic'] in self.topics]
                    topics |= {each['id']: each['topic'] for each in new}
                    wanted = [{'id': each['id'], 'channelId': each['id']} for each in new]
                    await ws.send_json({'op': 'subscribe', 'subscriptions': wanted})
                    continue
                self.bytes += len(message.data)
                opcode, number, at_ns = struct.unpack_from('<BIQ', message.data)
                if opcode == MESSAGE_DATA:
                    self.late_ms.setdefault(KIND[topics[number]], []).append((time.time_ns() - at_ns) / 1e6)


def measured(watcher: Watcher, seconds: float) -> dict[str, Any]:
    """What the viewer gets, and how late."""

    async def run() -> dict[str, Any]:
        task = asyncio.create_task(watcher.run())
        await asyncio.sleep(FILL_S)
        watcher.late_ms.clear()
        watcher.bytes = watcher.acknowledgements = 0
        await asyncio.sleep(seconds)
        found = watcher.told(seconds)
        task.cancel()
        (ended,) = await asyncio.gather(task, return_exceptions=True)
        if not isinstance(ended, asyncio.CancelledError):
            raise SystemExit(f'live_foxglove: {type(watcher).__name__} ended early: {ended!r}')
        return {name: found[name] for name in ('mbps', *KINDS) if name in found}

    return asyncio.run(run())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sdk', type=Path, metavar='FOLDER', help='where pip has put foxglove-sdk (--target)')
    parser.add_argument('--links', type=float, nargs='+', default=[8.0, 2.0], metavar='MBPS')
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--serve', action='store_true', help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.sdk is not None:
        os.environ[SDK] = str(given.sdk.resolve())
    if given.serve:
        serve()
    load_sdk()
    if 'LIVE_BENCH' not in os.environ:
        command = ['unshare', '-n', sys.executable, *sys.argv]
        sys.exit(subprocess.run(command, env={**os.environ, 'LIVE_BENCH': '1'}, check=False).returncode)
    subprocess.run(['ip', 'link', 'set', 'lo', 'up'], check=True)
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        domain = stack.enter_context(free_domain())
        processes = Processes(Path(folder), domain, f'r{secrets.token_hex(4)}')
        stack.callback(processes.end)
        node = processes.node()
        processes.sim()
        _, url = processes.page(node)
        until(lambda: node.topic('/imu').get('received', 0) > 50, 'the robot is heard')
        shape(url, given.links[0])
        for place, mbps in enumerate(given.links):
            subprocess.run(f'tc class change dev lo parent 1: classid 1:2 htb rate {mbps}mbit burst 8kb'.split(), check=True)
            row: dict[str, Any] = {'link_mbps': mbps, 'load': os.getloadavg()[0]}
            row['page'] = measured(Watcher(url, TOPICS), given.seconds)
            server = Process('foxglove', [__file__, '--serve'], Path(folder) / f'foxglove-{place}.log', processes.environ)
            processes.started.append(server)
            server.said('port ')
            port = server.log.partition('port ')[2].split()[0]
            filtered = f'protocol ip prio 1 u32 match ip sport {port} 0xffff flowid 1:2'
            subprocess.run(f'tc filter add dev lo parent 1: {filtered}'.split(), check=True)
            row['foxglove_sdk'] = measured(FoxgloveWatcher(f'ws://127.0.0.1:{port}', TOPICS), given.seconds)
            server.kill()
            print(json.dumps(row), flush=True)


if __name__ == '__main__':
    main()
