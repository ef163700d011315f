#!/usr/bin/env python3
"""The cost and the delay of the live page: CPU of node and page with and without viewers, and slow links.

    scripts/with-env python bench/live.py [--seconds 20] [--viewers 3] [--link 8 [--video] | --round-trip 100 | --beside 0.5
    | --browser | --pairs 7 | --minutes 60 | --floor] [--kills 2]

Viewers are WebSocket clients without a browser that acknowledge what they read. ``--link`` puts them and the page into a
network namespace whose uplink from the page has this many Mbit/s (tc htb; needs root); with ``--video`` the viewer takes the
camera as WebRTC and decodes it; ``--drop`` narrows the link in the middle. With
``--round-trip`` each packet is delayed by half of this many ms, as through a VPN, next to a viewer without delay; it needs root
as well. ``--beside`` adds a second viewer that reads this many Mbit/s, and measures its
effect on the first. ``--browser`` opens the page in a Chromium on a simulated separate machine (a network namespace): delays of
items until they arrive and are drawn, the first frame, outages of 10 s. ``--pairs`` alternates the node's CPU with and without
viewers, ``--minutes`` measures the page's memory while viewers come and go. ``--floor`` measures the page with one viewer next
to processes that only read the same topics (live_floor.py), all at the same time. ``--kills`` kills it while eight watch; one
of them never reads.

One line of JSON for each part, then the bars; the exit code is 1 if one is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import secrets
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import aiohttp
import aiortc
from _link import FAR, NEAR, LongWay
from _report import Bar, show, spread

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from domains import free_domain
from e2e.live_frames import Frames, first_shown_ms
from e2e.machines import ROBOT, Machines
from e2e.processes import Node, Process, Processes, until

TOPICS = ['/camera/compressed', '/point_cloud2', '/imu', '/odom', '/joint_states', '/lowstate']
KINDS = ('camera', 'cloud', 'imu', 'odom', 'joints', 'battery')
OWN = '192.0.2.1'
"""Of the page, with ``--link``."""
WATCHING = 8
"""While the page is killed."""
TAKINGS = 1.8
"""The page's CPU with one viewer, relative to taking all messages 30 times a second: 4 % of a core where that costs 2.2 %."""
MAX_LATE_MS, FULL_SHARE = 60.0, 0.9
"""Maximum delay of an IMU message besides the link's, and the share of a near viewer's bytes that a far one must receive."""
BESIDE = 1.2
"""Maximum p95 of a viewer next to one on a slow link, relative to its p95 alone."""


class Watcher:
    """A viewer without a browser: counts items by kind, and their delay by the clock of this machine."""

    def __init__(self, url: str, topics: list[str]) -> None:
        self.url, self.topics = url, topics
        self.late_ms: dict[str, list[float]] = {}
        self.bytes = self.acknowledgements = 0
        self.takes_video = False
        self.video: Video | None = None
        self.token = ''

    async def run(self, *, reads: bool = True, bytes_s: float = 0.0) -> None:
        """``bytes_s``: maximum read rate."""
        jar = aiohttp.CookieJar(unsafe=True)  # of addresses too
        async with (
            aiohttp.ClientSession(headers={'Origin': self.url.rstrip('/')}, cookie_jar=jar) as session,
            await self.connected(session) as ws,
        ):
            await self.watch(ws)
            frames = Frames()
            if not reads:
                await asyncio.sleep(3600)
            pinged_s = time.monotonic()
            acknowledging: asyncio.Task[None] | None = None

            async def acknowledge() -> None:  # after what arrived with it, as in link.js
                if (reported := frames.acknowledgement()) is not None:
                    self.acknowledgements += 1
                    await ws.send_bytes(reported)

            async for message in ws:
                self.bytes += len(message.data)
                if bytes_s:
                    await asyncio.sleep(len(message.data) / bytes_s)
                items = frames.take(message.data)
                if acknowledging is None or acknowledging.done():
                    acknowledging = asyncio.create_task(acknowledge())
                for head, body in items:
                    if head['kind'] == 'video' and self.video is not None:
                        await self.video.on_item(head)
                    if 'at' in head and head['kind'] in KINDS:
                        self.note(head, body)
                if time.monotonic() - pinged_s > 1:
                    pinged_s = time.monotonic()
                    await ws.send_json({'ping': pinged_s})
                if self.video is not None:
                    await self.video.report(ws)

    async def watch(self, ws: aiohttp.ClientWebSocketResponse) -> None:
        await ws.send_json({'watch': self.topics})
        if self.takes_video:
            self.video = Video(self.late_ms)
            offer = await self.video.offer()
            await ws.send_json({'watch': self.topics[1:], 'video': {'topic': self.topics[0], 'offer': offer}})

    def note(self, head: dict[str, Any], body: bytes) -> None:
        """Its delay: one machine has one monotonic clock."""
        now_ms = time.monotonic() * 1e3
        times = struct.unpack_from(f'<{head["rows"]}d', body) if 'rows' in head else (head['at'],)
        self.late_ms.setdefault(head['kind'], []).extend(now_ms - at_ms for at_ms in times)

    async def connected(self, session: aiohttp.ClientSession) -> aiohttp.ClientWebSocketResponse:
        if self.token:
            async with session.post(f'{self.url}api/session', json={'token': self.token}) as answer:
                answer.raise_for_status()
        return await session.ws_connect(f'{self.url}ws')

    def told(self, seconds: float) -> dict[str, Any]:
        found: dict[str, Any] = {
            'mbps': round(self.bytes * 8e-6 / seconds, 2), 'acknowledgements_hz': round(self.acknowledgements / seconds, 1)
        }  # fmt: skip
        for kind, unordered in sorted(self.late_ms.items()):
            late = sorted(unordered)
            found[kind] = {'hz': round(len(late) / seconds, 1), 'median_ms': round(statistics.median(late), 1),
                           'p95_ms': round(late[int(len(late) * 0.95)], 1)}  # fmt: skip
        if self.video is not None:
            found['frozen_s'] = round(self.video.frozen_s, 2)
        return found


class Video:
    """A receiver of video: the delay of decoded frames. aiortc returns a frame when the next one starts to arrive."""

    def __init__(self, late_ms: dict[str, list[float]]) -> None:
        self.late_ms = late_ms
        self.pc = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        self.first_ms: float | None = None
        self.sent_ms: list[float] = []
        self.shown: list[int] = []
        self.delays: list[float] = []
        self.frozen_s = 0.0
        """Longest interval between frames."""
        self._shown_s = self._reported_s = time.monotonic()
        self._before = (0, 0, 0)

    async def offer(self) -> str:
        self.pc.addTransceiver('video', direction='recvonly')
        self.pc.on('track', lambda track: setattr(self, 'task', asyncio.create_task(self.read(track))))
        await self.pc.setLocalDescription(await self.pc.createOffer())
        return self.pc.localDescription.sdp

    async def on_item(self, head: dict[str, Any]) -> None:
        if 'answer' in head:
            await self.pc.setRemoteDescription(aiortc.RTCSessionDescription(head['answer'], 'answer'))
        elif 'problem' in head:
            raise SystemExit(head['problem'])
        elif 'at' in head:
            self.sent_ms.append(head['at'])

    async def report(self, ws: aiohttp.ClientWebSocketResponse) -> None:
        """Twice per second, as in video.js; aiortc has no count of its requests for key frames."""
        now_s = time.monotonic()
        if self.pc.connectionState != 'connected' or now_s - self._reported_s < 0.5:
            return
        stats = (await self.pc.getReceivers()[0].getStats()).values()
        stream = next((each for each in stats if each.type == 'inbound-rtp'), None)
        size = sum(each.bytesReceived for each in stats if each.type == 'transport')
        now = (size, stream.packetsReceived, stream.packetsLost) if stream is not None else self._before
        size, packets, lost = (after - before for after, before in zip(now, self._before, strict=True))
        seconds, self._before, self._reported_s = now_s - self._reported_s, now, now_s
        delay = statistics.median(self.delays) if self.delays else None
        self.delays.clear()
        report = {'bitrate': size * 8 / seconds, 'lost': max(0, lost) / max(1, packets + lost), 'delay': delay,
                  'key': packets > 0 and now_s - self._shown_s > 1}  # fmt: skip
        await ws.send_json({'video': {'report': report}})

    async def read(self, track: aiortc.MediaStreamTrack) -> None:
        while True:
            frame = await track.recv()  # its pts begin with 0
            now_s = time.monotonic()
            if self.shown:
                self.frozen_s = max(self.frozen_s, now_s - self._shown_s)
            self._shown_s = now_s
            if self.first_ms is None:
                self.shown.append(frame.pts)
                self.first_ms = first_shown_ms(self.sent_ms, self.shown)
            if self.first_ms is not None:
                self.delays.append(now_s * 1e3 - self.first_ms - frame.pts / 90)
                self.late_ms.setdefault('camera', []).append(self.delays[-1])


def cpu_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def private_mb(pid: int) -> float:
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()
    return round(sum(int(line.split()[1]) for line in lines if line.startswith('Private_')) / 1024, 1)


def watched(url: str, count: int, seconds: float, pids: dict[str, int], *,
            silent: int = 0, video: bool = False, token: str = '') -> dict[str, Any]:  # fmt: skip
    """This many viewers for this long, ``silent`` of them read nothing: what each receives, and the CPU of the processes, % of a
    core.
    """
    watchers = [Watcher(url, TOPICS) for _ in range(count)]
    for watcher in watchers:
        watcher.takes_video, watcher.token = video, token

    async def run() -> tuple[float, dict[str, float]]:
        tasks = [asyncio.create_task(watcher.run(reads=place >= silent)) for place, watcher in enumerate(watchers)]
        await asyncio.sleep(15 if video else 4)  # discovery; receivers of video learn the bandwidth of their link
        for watcher in watchers:
            watcher.late_ms.clear()
            watcher.acknowledgements = 0
            if watcher.video is not None:
                watcher.video.frozen_s = 0.0
        sizes = [watcher.bytes for watcher in watchers]
        before, began = {name: cpu_s(pid) for name, pid in pids.items()}, time.monotonic()
        await asyncio.sleep(seconds)
        took = time.monotonic() - began
        used = {name: round(100 * (cpu_s(pid) - before[name]) / took, 2) for name, pid in pids.items()}
        for task, watcher, size in zip(tasks, watchers, sizes, strict=True):
            task.cancel()
            watcher.told_bytes = watcher.bytes - size
            watcher.bytes = watcher.told_bytes
        await asyncio.gather(*tasks, return_exceptions=True)
        return took, used

    took, used = asyncio.run(run())
    return {'viewers': count, 'deaf': silent, 'cpu_percent': used, 'private_mb': private_mb(pids['live']),
            'each': [watcher.told(took) for watcher in watchers[silent:][:2]]}  # fmt: skip


def killed(url: str, live: Process) -> int:
    """Kill the page while viewers watch, the first without reading; returns how many of the others had been sent something."""
    watchers = [Watcher(url, TOPICS) for _ in range(WATCHING)]

    async def run() -> None:
        tasks = [asyncio.create_task(watcher.run(reads=place > 0)) for place, watcher in enumerate(watchers)]
        await asyncio.sleep(4)
        live.signal(signal.SIGKILL)
        await asyncio.wait(tasks[1:], timeout=5)
        tasks[0].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(run())
    live.wait()
    return sum(watcher.bytes > 0 for watcher in watchers)


def in_browser(url: str, token: str, machines: Machines, folder: Path, seconds: float) -> dict[str, Any]:
    """The page in a Chromium with software GL on a simulated separate machine; finally its link is cut for 10 s, three times."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - for this part alone

    with sync_playwright() as playwright:
        program = machines.program(shutil.which('chromium') or 'chromium', folder)
        flags = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox']
        browser = playwright.chromium.launch(executable_path=program, args=flags)
        page = browser.new_page(viewport={'width': 1280, 'height': 800})
        page.goto(url)
        page.locator('input[name=token]').fill(token)
        page.locator('button.primary').click()
        until(lambda: page.evaluate('shadowhound.drawn.cloud?.length > 20'), 'clouds are drawn')
        page.reload()  # signed in: time until the first frame
        until(lambda: page.evaluate('shadowhound.drawn.cloud?.length > 20'), 'clouds are drawn')
        found: dict[str, Any] = {'first_frame_ms': round(page.evaluate('shadowhound.first'))}
        with browser.new_context(viewport={'width': 1280, 'height': 800}, storage_state=page.context.storage_state()) as cold:
            page.goto('about:blank')  # it draws nothing in that time
            fresh = cold.new_page()
            fresh.goto(url)  # signed in, with an empty cache
            until(lambda: fresh.evaluate('window.shadowhound?.first ?? 0') > 0, 'there is a frame')
            found['first_frame_cold_ms'] = round(fresh.evaluate('shadowhound.first'))
        page.goto(url)
        until(lambda: page.evaluate('shadowhound.drawn.cloud?.length > 20'), 'clouds are drawn')
        page.evaluate('for (const late of [shadowhound.came, shadowhound.drawn]) for (const kind in late) late[kind] = []')
        page.wait_for_timeout(seconds * 1e3)
        for where, kinds in page.evaluate('({came: shadowhound.came, drawn: shadowhound.drawn})').items():
            found[where] = {kind: round(sorted(each)[int(len(each) * 0.95)], 1) for kind, each in kinds.items() if each}
        found |= {'goes_on_s': [], 'ages_wrong_p95_ms': []}
        for _ in range(3):
            machines.cut()
            wrong_ms, end_s = [], time.monotonic() + 10
            while time.monotonic() < end_s:
                before_ms = time.monotonic() * 1e3
                age_ms, at_ms = page.evaluate(
                    "[Number(document.querySelector('[data-age=imu]').dataset.ms), shadowhound.at().imu]"
                )
                wrong_ms.append(abs((before_ms + time.monotonic() * 1e3) / 2 - at_ms - age_ms))
                time.sleep(0.05)
            count = page.evaluate('shadowhound.count.imu')
            machines.mend()
            mended_s = time.monotonic()
            until(lambda count=count: page.evaluate('shadowhound.count.imu') > count, 'it goes on')
            found['goes_on_s'].append(round(time.monotonic() - mended_s, 2))
            found['ages_wrong_p95_ms'].append(round(sorted(wrong_ms)[int(len(wrong_ms) * 0.95)]))
            time.sleep(3)
        browser.close()
        return found


def paired(url: str, viewers: int, seconds: float, pairs: int, pids: dict[str, int]) -> dict[str, Any]:
    """The node's CPU with viewers minus without, alternating, % of a core."""
    more = []
    for _ in range(pairs):
        without, with_viewers = (watched(url, count, seconds, pids)['cpu_percent']['node'] for count in (0, viewers))
        more.append(round(with_viewers - without, 2))
    return {'pairs': pairs, 'seconds': seconds, 'viewers': viewers, 'node_points_more': sorted(more),
            'median': statistics.median(more)}  # fmt: skip


def over_minutes(url: str, viewers: int, minutes: int, pid: int) -> dict[str, Any]:
    """The page's memory at the end of each minute, while other viewers come and go."""
    held = []
    for _ in range(minutes):
        row = watched(url, viewers, 52.0, {'live': pid})
        folder = Path(f'/proc/{pid}')
        held.append((row['private_mb'], len(list((folder / 'fd').iterdir())), len(list((folder / 'task').iterdir()))))
        time.sleep(2)
    found = {name: [minute[place] for minute in held] for place, name in enumerate(('private_mb', 'descriptors', 'threads'))}
    return {'viewers': viewers, **found}


def beside(url: str, seconds: float, slow_mbps: float) -> dict[str, Any]:
    """The effect of a slow viewer on another one: p95 of the fast one alone, and with the slow one."""

    async def run(*, with_slow: bool) -> dict[str, Any]:
        fast, slow = Watcher(url, TOPICS), Watcher(url, TOPICS)
        tasks = [asyncio.create_task(fast.run()), *([asyncio.create_task(slow.run(bytes_s=slow_mbps * 125_000))] * with_slow)]
        await asyncio.sleep(4)
        fast.late_ms.clear()
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return {kind: row['p95_ms'] for kind, row in fast.told(seconds).items() if kind in KINDS}

    rows = [asyncio.run(run(with_slow=with_slow)) for with_slow in (False, True, False, True)]
    return {'slow_mbps': slow_mbps, 'alone': [rows[0], rows[2]], 'beside': [rows[1], rows[3]]}


def floor(url: str, seconds: float, processes: Processes, pids: dict[str, int]) -> dict[str, Any]:
    """The page with one viewer, and processes that only read the same: with a node, with subscriptions, and with takes."""
    readers = {}
    for do in ('join', 'hear', 'take'):
        log = processes.folder / f'{do}.log'
        readers[do] = Process(do, [str(Path(__file__).parent / 'live_floor.py'), do, *TOPICS], log, processes.environ)
        processes.started.append(readers[do])
    for reader in readers.values():
        reader.await_log('ready')
    return watched(url, 1, seconds, {**pids, **{do: reader.popen.pid for do, reader in readers.items()}})


def shape(url: str, mbps: float) -> None:
    """Limit the page's uplink, with packets as on a network; other traffic on this loopback is not limited."""
    port = url.rstrip('/').rpartition(':')[2]
    for command in (
        'ip link set lo mtu 1500',
        'tc qdisc add dev lo root handle 1: htb default 1',
        'tc class add dev lo parent 1: classid 1:1 htb rate 10gbit quantum 60000',
    ):
        subprocess.run(command.split(), check=True)
    limit('add', mbps)
    for command in (
        'tc qdisc add dev lo parent 1:2 bfifo limit 200kb',
        f'tc filter add dev lo parent 1: protocol ip prio 1 u32 match ip sport {port} 0xffff flowid 1:2',
        f'tc filter add dev lo parent 1: protocol ip prio 2 u32 match ip protocol 17 0xff match ip src {OWN} flowid 1:2',  # video
    ):
        subprocess.run(command.split(), check=True)


def limit(do: str, mbps: float) -> None:
    command = f'tc class {do} dev lo parent 1: classid 1:2 htb rate {mbps}mbit burst 8kb'
    subprocess.run(command.split(), check=True)


def at_most(what: str, limit: float, value: float, unit: str, rounds: Sequence[float] = ()) -> Bar:
    return Bar(what, f'at most {limit:g}', value, unit, value <= limit, tuple(rounds))


def at_least(what: str, limit: float, value: float, unit: str) -> Bar:
    return Bar(what, f'at least {limit:g}', value, unit, value >= limit)


def late(row: dict[str, Any], limits: dict[str, float], where: str) -> list[Bar]:
    """The first viewer's p95 of each kind with a limit."""
    return [at_most(f'{kind} to a viewer {where}, p95', ms, row['each'][0][kind]['p95_ms'], 'ms') for kind, ms in limits.items()]


def cost_bars(rows: Sequence[dict[str, Any]]) -> list[Bar]:
    """For the series without a viewer, with one, with some, without."""
    alone, first, some, after = (row['cpu_percent']['live'] for row in rows[:4])
    more = (some - first) / max(1, rows[2]['viewers'] - 1)
    return [
        at_most('CPU of the page without a viewer', 0.5, alone, '% of a core', (alone, after)),
        at_most('CPU of the page for each further viewer', 1.5, more, '% of a core'),
        at_most('private memory of the page with viewers', 120, rows[2]['private_mb'], 'MB'),
        *late(rows[1], dict.fromkeys(KINDS, 60.0), 'on loopback'),
    ]


def link_bars(row: dict[str, Any], mbps: float, *, video: bool) -> list[Bar]:
    where = f'on {mbps:g} Mbit/s'
    if video:
        camera_ms, least_hz = 500.0, 15.0
    else:
        camera_ms, least_hz = (250.0, 8.0) if mbps >= 8 else (1000.0, 0.0)
    return [
        *late(row, {'imu': 100.0 if mbps >= 8 else 300.0, 'camera': camera_ms}, where),
        *([at_least(f'camera to a viewer {where}', least_hz, row['each'][0]['camera']['hz'], 'Hz')] if least_hz else []),
    ]


def far_bars(near: dict[str, Any], far: dict[str, Any], round_ms: float) -> list[Bar]:
    where = f'at {round_ms:g} ms of round trip'
    return [
        at_least(f'bytes of a viewer {where}, of those of one beside the robot', FULL_SHARE,
                 far['each'][0]['mbps'] / near['each'][0]['mbps'], 'of them'),
        *late(far, {'imu': round_ms / 2 + MAX_LATE_MS}, where),
    ]  # fmt: skip


def browser_bars(row: dict[str, Any]) -> list[Bar]:
    return [
        *(at_most(f"{kind} to the browser's handler, p95", 60, ms, 'ms') for kind, ms in row['came'].items() if kind in KINDS),
        *(at_most(f'{kind} until it is drawn, p95', 250, ms, 'ms') for kind, ms in row['drawn'].items() if kind in KINDS),
        *(at_most(f'first frame ({name[:-3]})', 2000, row[name], 'ms') for name in row if name.startswith('first_frame')),
        at_most('until the page goes on after an outage', 2, max(row['goes_on_s']), 's', row['goes_on_s']),
        at_most('ages shown in an outage, p95 of the error', 200, max(row['ages_wrong_p95_ms']), 'ms', row['ages_wrong_p95_ms']),
    ]


def beside_bars(row: dict[str, Any]) -> list[Bar]:
    """The mean of both runs for each kind, because the p95 of a single run varies."""
    found = []
    for kind in ('imu', 'camera', 'cloud'):
        alone, with_slow = (statistics.mean(run[kind] for run in row[name]) for name in ('alone', 'beside'))
        found.append(at_most(f'p95 of {kind} beside a slow viewer', BESIDE, with_slow / alone, 'of that alone'))
    return found


def floor_bars(row: dict[str, Any]) -> list[Bar]:
    used = row['cpu_percent']
    what = 'CPU of the page with one viewer, against that of taking the same messages'
    return [at_most(what, TAKINGS, used['live'] / used['take'], 'of it')]


def ending_bars(node: Node, url: str, live: Process, processes: Processes, sim: Process, kills: int) -> list[Bar]:
    """Kill the page this often, then stop the robot and the node: nothing may be missing in its ledger."""
    watching = []
    for _ in range(kills):
        watching.append(killed(url, live))
        live, url = processes.page(node)
    sim.signal(signal.SIGINT)
    sim.wait()
    time.sleep(1)
    ledger = node.stop()
    lost = {topic: (row['missed'], sum(row['dropped'].values())) for topic, row in ledger['topics'].items()}
    received = sum(row['received'] for row in ledger['topics'].values())
    told = {'balanced': ledger['balanced'], 'received': received, 'missed_and_dropped': lost, 'kills': kills}
    print(json.dumps(told), flush=True)
    bars = [
        at_most('messages missed or dropped by the node', 0, sum(map(sum, lost.values())), f'of {received}'),
        Bar('the ledger balances', 'yes', float(ledger['balanced']), '', ledger['balanced']),
    ]
    if kills:
        bars.append(at_least('viewers that were being sent items when the page was killed', WATCHING - 1, min(watching), ''))
    return bars


def measured(given: argparse.Namespace, stack: ExitStack, folder: Path) -> list[Bar]:
    """Run one measurement, with a line for each row; returns its bars."""
    machines = Machines(stack, os.getpid()) if given.browser else None
    processes = Processes(folder, stack.enter_context(free_domain()), f'r{secrets.token_hex(4)}')
    stack.callback(processes.end)
    node = processes.node()
    sim = processes.sim(f'rate_scale:={given.scale}')
    way = LongWay(0.0) if given.round_trip else None
    bound = ['--bind', ROBOT] if machines else ['--bind', NEAR, '--name', FAR] if way else ['--bind', OWN] if given.link else []
    live, url = processes.page(node, *bound)
    pids = {'node': node.popen.pid, 'live': live.popen.pid}
    token = (node.home / 'live' / 'viewer.token').read_text().strip()
    until(lambda: node.topic('/imu').get('received', 0) > 50, 'the robot is heard')

    def tell(row: dict[str, Any]) -> dict[str, Any]:
        print(json.dumps({'link_mbps': given.link or None, 'load': os.getloadavg()[0], **row}), flush=True)
        return row

    if machines:
        bars = browser_bars(tell(in_browser(url, token, machines, folder, given.seconds)))
    elif given.pairs:
        row = tell(paired(url, given.viewers, given.seconds, given.pairs, pids))
        what = f'CPU of the node with {given.viewers} viewers more than without, median of {given.pairs} pairs'
        bars = [at_most(what, 0.3, row['median'], 'points of a core', row['node_points_more'])]
    elif given.minutes:
        row = tell(over_minutes(url, given.viewers, given.minutes, live.popen.pid))
        bars = [at_most('private memory of the page at any minute', 120, max(row['private_mb']), 'MB', row['private_mb'])]
    elif given.floor:
        bars = floor_bars(tell(floor(url, given.seconds, processes, pids)))
    elif given.beside:
        bars = beside_bars(tell(beside(url, given.seconds, given.beside)))
    elif given.link:
        shape(url, given.link)
        if given.drop:
            timer = threading.Timer((15 if given.video else 4) + given.seconds / 2, limit, ('change', given.drop))
            stack.callback(timer.cancel)
            timer.start()
        row = tell(watched(url, 1, given.seconds, pids, video=given.video, token=token))
        bars = link_bars(row, given.drop or given.link, video=given.video)
    elif way:
        far_url = url.replace(NEAR, FAR)
        near = tell(watched(far_url, 1, given.seconds, pids, token=token))
        way.round_s = given.round_trip / 1e3
        bars = far_bars(near, tell(watched(far_url, 1, given.seconds, pids, token=token)), given.round_trip)
    elif given.kills:
        bars = []
    else:
        bars = cost_bars([tell(watched(url, count, given.seconds, pids)) for count in (0, 1, given.viewers, 0)])
        tell(watched(url, given.viewers, given.seconds / 2, pids, silent=given.viewers - 1))
    return bars + ending_bars(node, url, live, processes, sim, given.kills)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=20.0, help='how long each row is measured (default 20)')
    parser.add_argument('--viewers', type=int, default=3, help='of the rows with more than one (default 3)')
    parser.add_argument('--link', type=float, default=0.0, metavar='MBPS', help='what the page sends leaves no faster')
    parser.add_argument('--video', action='store_true', help='with --link: take the camera as WebRTC')
    parser.add_argument('--drop', type=float, default=0.0, metavar='MBPS', help='with --link: the rate of the second half')
    parser.add_argument('--round-trip', type=float, default=0.0, metavar='MS', help='a packet and its answer take so long')
    parser.add_argument('--kills', type=int, default=0, help='so often the page is killed while eight watch')
    parser.add_argument('--beside', type=float, default=0.0, metavar='MBPS', help='a second viewer that reads no faster')
    parser.add_argument('--browser', action='store_true', help='in a Chromium on a machine of its own')
    parser.add_argument('--pairs', type=int, default=0, help='so many times without viewers and with them')
    parser.add_argument('--minutes', type=int, default=0, help='so long, while viewers come and go')
    parser.add_argument('--floor', action='store_true', help='beside processes that only read the same topics')
    parser.add_argument('--scale', type=float, default=1.0, help="of the robot's rates (default 1)")
    given = parser.parse_args()
    if (given.link or given.browser or given.round_trip) and 'LIVE_BENCH' not in os.environ:
        command = ['unshare', '-n', sys.executable, *sys.argv]
        return subprocess.run(command, env={**os.environ, 'LIVE_BENCH': '1'}, check=False).returncode
    if given.link or given.round_trip:
        subprocess.run(['ip', 'link', 'set', 'lo', 'up'], check=True)
    if given.link:
        subprocess.run(['ip', 'addr', 'add', f'{OWN}/32', 'dev', 'lo'], check=True)  # there is no video on 127.0.0.1
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bars = measured(given, stack, Path(folder))
    for bar in bars:
        print(f'{"ok    " if bar.holds else "MISSED"} {bar.what}: {show(bar.value)} {bar.unit} ({bar.bar}) {spread(bar.rounds)}')
    return 0 if all(bar.holds for bar in bars) else 1


if __name__ == '__main__':
    sys.exit(main())
