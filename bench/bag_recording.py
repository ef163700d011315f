"""The cost of recording: CPU of the node while it records the Go2 profile, relative to its intake; and small messages per second.

One node, one simulated robot: rounds with and without a bag alternate, and almost nothing is stored as objects. The bag is not
compressed, and no slice ends within a round, so that uploads are not included. Then a publisher of serialized messages sends
10,000 per second into a bag; the ledger shows whether any was lost.

If ``ros2 bag`` is on the PATH, it records the same stream of small messages as well: each recorder alone, and both at the same
time. rosbag2 runs with its defaults, in MCAP if it supports that.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, Final

from _report import Bar, Report, main, progress, ratio
from _world import Failed, Program, World, lost, until
from imu_publisher import STAMP, STAMP_AT
from rosbags.rosbag2 import Reader, ReaderError

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

RATES_HZ: Final = (260, 2_000, 10_000)
"""Next to rosbag2: the total rate of the Go2 profile, and small messages."""
OURS: Final = 'node'
THEIRS: Final = 'rosbag2'
CASES: Final = {'alone': (OURS,), 'rosbag2 alone': (THEIRS,), 'together': (OURS, THEIRS)}
PARTS: Final = 3
"""Parts of a stream that are measured separately, for the spread."""
QUIET_S: Final = 2.0
HELP_S: Final = 60.0


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


def rosbag2() -> dict[str, Any] | None:
    """The ``ros2 bag record`` on the PATH: its command without folder and topic. None if there is none."""
    program = shutil.which('ros2')
    if program is None:
        return None
    command = [program, 'bag', 'record']
    report = subprocess.run([*command, '--help'], capture_output=True, text=True, timeout=HELP_S, check=False)
    if report.returncode:
        return None
    storage = ['--storage', 'mcap'] if 'mcap' in report.stdout else []
    topics = ['--topics'] if '--topics' in report.stdout else []
    return {'record': [*command, *storage], 'topics': topics, 'storage': 'mcap' if storage else 'its default',
            'ros': os.environ.get('ROS_DISTRO', ''), 'version': _version(Path(program))}  # fmt: skip


def _version(program: Path) -> str:
    """The version in the package.xml next to the program, or in a prefix of the environment; empty if it is not found."""
    prefixes = [str(program.resolve().parents[1]), *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    for prefix in prefixes:
        manifest = Path(prefix) / 'share' / 'ros2bag' / 'package.xml'
        if prefix and manifest.is_file():
            return manifest.read_text(encoding='utf-8').partition('<version>')[2].partition('</version>')[0]
    return ''


def beside(folder: Path, found: dict[str, Any], seconds: float) -> dict[str, Any]:
    """CPU per message and losses at each rate, by case and by recorder."""
    rates: dict[str, Any] = {}
    for rate_hz in RATES_HZ:
        rates[str(rate_hz)] = {}
        for case, recorders in CASES.items():
            progress(f'{rate_hz:,} messages a second: {" and ".join(recorders)}, {seconds:g} s')
            rates[str(rate_hz)][case] = stream(folder, found, rate_hz, seconds, recorders)
    return {**{name: found[name] for name in ('ros', 'version', 'storage')}, 'rates': rates}


def stream(folder: Path, found: dict[str, Any], rate_hz: int, seconds: float, recorders: tuple[str, ...]) -> dict[str, Any]:
    """One stream of small messages, recorded by one or both."""
    with World(folder, store=False) as world:
        bag = world.folder / 'rosbag2'
        running: dict[str, Program] = {}
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        record = [*found['record'], '--output', str(bag), *found['topics'], TOPIC]
        heard = 0  # the node may have two subscriptions
        for name in recorders:
            running[name] = world.node(SMALL) if name == OURS else world.command('ros2-bag', *record)
            if publisher.ask(subscribers=heard + 1)['subscribers'] <= heard:
                raise running[name].failed(f'does not listen to {TOPIC}')
            time.sleep(QUIET_S)
            heard = publisher.ask(subscribers=1)['subscribers']
        first = int(publisher.ask(count=rate_hz, rate_hz=rate_hz)['published'])
        began_ns, sent = time.time_ns(), 0
        used: dict[str, list[float]] = {name: [] for name in running}
        for _ in range(PARTS):
            before = {name: program.cpu_s() for name, program in running.items()}
            report = publisher.ask(count=round(rate_hz * seconds / PARTS), rate_hz=rate_hz)
            for name, program in running.items():
                used[name].append(1e6 * (program.cpu_s() - before[name]) / report['published'])
            sent += report['published']
        time.sleep(QUIET_S)  # for messages in flight
        for program in running.values():
            program.stop()
        stored = {name: world.ledger()['bags'][TOPIC]['stored'] - first if name == OURS else _messages(bag, began_ns)
                  for name in running}  # fmt: skip
    return {'published': sent, 'us': used, 'lost': {name: sent - stored[name] for name in running}}


def _messages(bag: Path, began_ns: int) -> int:
    """Number of messages in a rosbag2 bag that were published since then: it may still be starting when the first ones arrive."""
    try:
        with Reader(bag) as reader:
            stamps = [STAMP.unpack_from(cdr, STAMP_AT) for _, _, cdr in reader.messages()]
    except ReaderError as error:
        raise Failed(f'rosbag2 has left no bag that can be read: {error}') from None
    return sum(seconds * 1_000_000_000 + ns >= began_ns for seconds, ns in stamps)


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
    figures = {'profile': found, 'small': many}
    if (other := rosbag2()) is None:
        progress('there is no ros2 bag on the PATH: nothing is recorded beside')
    else:
        figures['rosbag2'] = beside(options.folder, other, options.seconds / 4)
    return Report(bars, figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=40.0)
