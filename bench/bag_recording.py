"""The cost of recording: CPU of the node while it records the Go2 profile, relative to its intake; and small messages per second.

One node, one simulated robot: rounds with and without a bag alternate, and almost nothing is stored as objects. The bag is not
compressed, and no slice ends within a round, so that uploads are not included. Then a publisher of serialized messages sends
10,000 per second into a bag; the ledger shows whether any was lost.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from _report import Bar, Report, main, progress, ratio
from _world import Failed, Program, World, lost, until

ROUNDS = 5
SENSORS = ('camera', 'camera_info', 'lidar', 'imu', 'odom', 'states', 'joints', 'lowstate')
PARAMETERS: dict[str, Any] = {
    **{f'{name}.rate_hz': 0.0001 for name in SENSORS}, **{f'{name}.batch_s': 0.0 for name in SENSORS},
    'camera_info.on_change': False, 'bag.compression': 'none', 'bag.slice_s': 3600.0, 'bag.slice_bytes': 8 << 30,
}  # fmt: skip
SMALL_HZ = 10_000
TOPIC = '/imu'
SMALL: dict[str, Any] = {
    'sensors': ['imu'], 'imu.topics': [TOPIC], 'imu.types': ['sensor_msgs/msg/Imu'], 'imu.rate_hz': 0.0001, 'imu.batch_s': 0.0,
    'bag.record': 'always', 'bag.compression': 'none',
}  # fmt: skip
WARM_S = 3.0
SETTLE_S = 20.0
BAR = 1.6


def switch(program: Program, what: str) -> None:
    """Start or stop a bag. Raises Failed."""
    answer = program.ask(do=what)
    if not answer['success']:
        raise Failed(f'~/bag/{what}: {answer["message"]}')


def received(world: World) -> int:
    return sum(row['received'] for row in world.ledger()['topics'].values())


def profile(folder: Path, seconds: float) -> dict[str, Any]:
    """CPU per message of each round with and without a bag."""
    used: dict[bool, list[float]] = {False: [], True: []}
    with World(folder, store=False) as world:
        node = world.node(PARAMETERS)
        switcher = world.program('bag_switch', 'bag_switch.py')
        sim = world.sim('image_raw:=false')
        until(lambda: len(world.ledger()['topics']) == len(SENSORS), 'the node to hear the robot', node, sim)
        for _ in range(ROUNDS):
            for recording in (False, True):
                if recording:
                    switch(switcher, 'start')
                time.sleep(WARM_S)
                before, count = node.cpu_s(), received(world)
                time.sleep(seconds / ROUNDS / 2)
                used[recording].append(1e6 * (node.cpu_s() - before) / max(1, received(world) - count))
                if recording:
                    switch(switcher, 'stop')
        sim.stop()
        node.stop()
        rows = list(world.ledger()['bags'].values())
        size = world.ledger()['bytes']['spooled']
    return {
        'intake_us': used[False], 'recording_us': used[True], 'bytes': size, 'balanced': world_balances(rows),
        'recorded': sum(row['stored'] for row in rows), 'lost': lost(rows) + sum(row['open'] for row in rows),
    }  # fmt: skip


def world_balances(rows: Any) -> bool:
    return all(row['received'] == row['stored'] + sum(row['dropped'].values()) + row['open'] for row in rows)


def small(folder: Path, seconds: float) -> dict[str, Any]:
    """10,000 serialized messages per second into a bag."""
    with World(folder, store=False) as world:
        node = world.node(SMALL)
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        publisher.ask(subscribers=1)
        time.sleep(1.0)
        publisher.ask(count=SMALL_HZ, rate_hz=SMALL_HZ)
        time.sleep(1.0)
        before = node.cpu_s()
        report = publisher.ask(count=round(SMALL_HZ * seconds), rate_hz=SMALL_HZ)
        sent, end = SMALL_HZ + report['published'], time.monotonic() + SETTLE_S
        while world.ledger().get('bags', {}).get(TOPIC, {}).get('received', 0) < sent and time.monotonic() < end:
            time.sleep(0.1)
        used = node.cpu_s() - before
        node.stop()
        row = world.ledger()['bags'][TOPIC]
    return {
        'published': sent, 'reached_hz': report['published'] / report['seconds'], 'recorded': row['stored'], 'row': row,
        'node_us': 1e6 * used / report['published'],
    }  # fmt: skip


def measure(options: argparse.Namespace) -> Report:
    progress(f'recording the profile, {options.seconds:g} s')
    found = profile(options.folder, options.seconds)
    progress(f'{SMALL_HZ} small messages a second into a bag, {options.seconds / 4:g} s')
    many = small(options.folder, options.seconds / 4)
    value, rounds = ratio(found['recording_us'], found['intake_us'])
    gone = many['published'] - many['recorded']
    bars = (
        Bar('CPU of the node while it records the Go2 profile, uncompressed, against its intake alone', f'at most {BAR}', value,
            'of the intake', value <= BAR, rounds),
        Bar(f'lost of {SMALL_HZ:,} small messages a second into a bag', 'none', float(gone), 'messages', gone == 0),
    )  # fmt: skip
    return Report(bars, {'profile': found, 'small': many})


if __name__ == '__main__':
    main(__doc__, measure, seconds=40.0)
