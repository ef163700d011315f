"""Recording one topic, next to ``ros2 bag record``: CPU per recorded message, losses and bytes; and all up to a store.

The recorders take turns, each alone with its own publisher process; the rounds give the spread. rosbag2 runs with its defaults,
in MCAP if it supports that, and without this package's Fast DDS profile. The node records the topic into a bag without
compression, as rosbag2 does, or stores it as it does by default: as objects, here in a folder.

The complete job: files of ten seconds that are in a SeaweedFS as soon as possible after they are complete. For rosbag2,
``rclone copyto`` copies each file once the next one exists; no schedule can be faster. The node uploads the slices of its bag,
which are compressed, as by default. The CPU of recorder and rclone counts, not that of the server and the publisher.

Without ``ros2`` on the PATH, or ``--rosbag2``, only the node is measured.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import boto3
from _report import Bar, Report, main, percentile, progress, ratio
from _world import BUCKET, Failed, Program, World
from imu_publisher import STAMP, STAMP_AT

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile

RATES_HZ: Final = (260, 2_000, 10_000)
"""The total rate of the Go2 profile, and small messages."""
JOB_HZ: Final = 260
SPLIT_S: Final = 10
TOPIC: Final = '/imu'
BAG, OBJECTS, THEIRS = 'bag', 'objects', 'rosbag2'
SENSOR: Final[dict[str, Any]] = {'sensors': ['imu'], 'imu.topics': [TOPIC], 'imu.types': ['sensor_msgs/msg/Imu']}
RECORDED: Final[dict[str, Any]] = {**SENSOR, 'imu.enabled': False, 'bag.record': 'always', 'bag.topics': [TOPIC]}
PARAMETERS: Final = {BAG: {**RECORDED, 'bag.compression': 'none'}, OBJECTS: SENSOR}
ACCOUNTS: Final = {BAG: 'bags', OBJECTS: 'topics'}
MAX_RATIO: Final = 0.8
ROUNDS: Final = 3
QUIET_S: Final = 2.0
LOOK_S: Final = 0.1
HELP_S: Final = 60.0
RESERVE: Final = 'ballast'
"""A file of the spool that is only there to be deleted when the disk is full."""
NO_PROFILE: Final = {'FASTRTPS_DEFAULT_PROFILES_FILE': '', 'FASTDDS_DEFAULT_PROFILES_FILE': ''}


@dataclass(frozen=True, slots=True)
class Rosbag2:
    """An installed ``ros2 bag record``."""

    record: Sequence[str]
    """The command without folder and topic."""
    topics: Sequence[str]
    """What precedes the topics."""
    storage: str
    version: str

    def start(self, world: World, bag: Path, *more: str) -> Program:
        words = [*self.record, '--output', str(bag), *more, *self.topics, TOPIC]
        return world.command('ros2-bag', *words, environ=NO_PROFILE)


def installed(command: str) -> Rosbag2 | None:
    """None if there is no such program. Raises Failed if it cannot record."""
    words = shlex.split(command)
    program = shutil.which(words[0])
    if program is None:
        return None
    report = subprocess.run([*words, '--help'], capture_output=True, text=True, timeout=HELP_S, check=False)
    if report.returncode:
        raise Failed(f'{command} --help failed: {report.stderr}')
    has_mcap = 'mcap' in report.stdout
    topics = ['--topics'] if '--topics' in report.stdout else []
    record = [program, *words[1:], *(['--storage', 'mcap'] if has_mcap else [])]
    return Rosbag2(record, topics, 'mcap' if has_mcap else 'its default', _version(Path(program)))


def _version(program: Path) -> str:
    """The version in the package.xml next to the program, or in a prefix of the environment; empty if it is not found."""
    prefixes = [str(program.resolve().parents[1]), *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    for prefix in prefixes:
        manifest = Path(prefix) / 'share' / 'ros2bag' / 'package.xml'
        if prefix and manifest.is_file():
            return manifest.read_text(encoding='utf-8').partition('<version>')[2].partition('</version>')[0]
    return ''


# -- one topic, onto the disk ------------------------------------------------------------------------------------------


def stream(folder: Path, other: Rosbag2 | None, who: str, rate_hz: int, seconds: float) -> dict[str, Any]:
    """One stream of messages, recorded by one of them; what is published in the first second does not count for its CPU."""
    with World(folder, store=False) as world:
        bag = world.folder / 'rosbag2'
        recorder = world.node(PARAMETERS[who]) if other is None else other.start(world, bag)
        publisher = _publisher(world, recorder)
        first = int(publisher.ask(count=rate_hz, rate_hz=rate_hz)['published'])
        began_ns, before = time.time_ns(), recorder.cpu_s()
        sent = int(publisher.ask(count=round(rate_hz * seconds), rate_hz=rate_hz)['published'])
        used = recorder.cpu_s() - before
        time.sleep(QUIET_S)  # for messages in flight
        recorder.stop()
        if other is None:
            recorded, size = int(world.ledger()[ACCOUNTS[who]][TOPIC]['stored']), _bytes(world.folder / 'home')
            lost = first + sent - recorded
        else:  # it may still be starting when the first ones arrive
            stamps, size = _stamps(bag.glob('*.mcap')), _bytes(bag)
            recorded, lost = len(stamps), sent - sum(stamp_ns >= began_ns for stamp_ns in stamps)
    return {'us': 1e6 * used / max(1, sent - lost), 'published': sent, 'lost': lost, 'bytes': size / max(1, recorded)}


def _publisher(world: World, recorder: Program) -> Program:
    """A publisher that the recorder has found."""
    publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
    if not publisher.ask(subscribers=1)['subscribers']:
        raise recorder.failed(f'does not subscribe to {TOPIC}')
    time.sleep(QUIET_S)
    return publisher


def _bytes(folder: Path) -> int:
    """Bytes of all files that hold data."""
    return sum(path.stat().st_size for path in folder.rglob('*') if path.is_file() and path.name != RESERVE)


def _stamps(files: Iterable[Path]) -> list[int]:
    """When each message in MCAP files was published. Raises Failed if one cannot be read."""
    stamps = []
    for path in sorted(files):
        try:
            source = LocalFile(path)
            for message in read_messages(source, read_index(source), MessageFilter(0, 1 << 64, lambda _: True)):
                seconds, nanoseconds = STAMP.unpack_from(message.cdr, STAMP_AT)
                stamps.append(seconds * SECOND + nanoseconds)
        except BagDamaged as error:
            raise Failed(f'{path.name} cannot be read: {error}') from None
    return stamps


# -- the complete job --------------------------------------------------------------------------------------------------


@dataclass
class Delivery:
    """Watches the bucket, and copies the complete files of a bag into it. ``run`` in a thread, until ``stop`` is set."""

    client: Any
    copy: Sequence[str] = ()
    """``rclone`` with its options; empty if the recorder uploads."""
    environ: Mapping[str, str] = field(default_factory=dict)
    bag: Path = Path()
    seen_ns: dict[str, int] = field(default_factory=dict)
    """When each key was first in the bucket."""
    copied: dict[str, float] = field(default_factory=dict)
    """The CPU seconds of each copy."""
    stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        while not self.stop.wait(LOOK_S):
            self.look()

    def look(self, *, is_last: bool = False) -> None:
        """``is_last``: the last file is complete as well."""
        files = sorted(self.bag.glob('*.mcap'), key=lambda path: (len(path.name), path.name)) if self.copy else []
        for path in files if is_last else files[:-1]:
            if path.name not in self.copied:
                self.copied[path.name] = self._copy(path)
        for each in self.client.list_objects_v2(Bucket=BUCKET).get('Contents', ()):
            if each['Key'].endswith('.mcap'):
                self.seen_ns.setdefault(each['Key'], time.time_ns())

    def _copy(self, path: Path) -> float:
        program, *options = self.copy
        child = subprocess.Popen([program, 'copyto', *options, str(path), f':s3:{BUCKET}/rosbag2/{path.name}'], env=self.environ)
        _, status, used = os.wait4(child.pid, 0)
        if status:
            raise Failed(f'rclone failed with status {status}')
        return used.ru_utime + used.ru_stime

    def stamps(self, to: Path) -> dict[str, list[int]]:
        """Of each key, when its messages were published."""
        found = {}
        for number, key in enumerate(self.seen_ns):
            path = to / f'{number}.mcap'
            self.client.download_file(BUCKET, key, str(path))
            found[key] = _stamps([path])
        return found


def job(folder: Path, other: Rosbag2 | None, rclone: str, seconds: float) -> dict[str, Any]:
    """Record and deliver for a while, by one of them. The last file does not count: it ends with the recorder."""
    with World(folder) as world:
        bag = world.folder / 'rosbag2'
        delivery = _delivery(world, rclone if other is not None else '', bag)
        if other is None:
            recorder, local = world.node({**RECORDED, 'bag.slice_s': float(SPLIT_S)}), world.folder / 'home'
        else:
            recorder, local = other.start(world, bag, '--max-bag-duration', str(SPLIT_S)), bag
        publisher = _publisher(world, recorder)
        before = recorder.cpu_s()
        thread = threading.Thread(target=delivery.run)
        thread.start()
        try:
            sent = int(publisher.ask(count=round(JOB_HZ * seconds), rate_hz=JOB_HZ)['published'])
            ended_ns, used, size = time.time_ns(), recorder.cpu_s() - before, _bytes(local)
        finally:
            delivery.stop.set()
            thread.join()
        in_time = [key for key, seen_ns in delivery.seen_ns.items() if seen_ns <= ended_ns]
        copies = sum(delivery.copied.values())
        recorder.stop()
        delivery.look(is_last=True)
        stamps = delivery.stamps(world.folder)
    late_s = [(delivery.seen_ns[key] - stamp_ns) / SECOND for key in in_time for stamp_ns in stamps[key]]
    if not late_s:
        raise Failed(f'no file was in the store within {seconds:g} s')
    stored = sum(map(len, stamps.values()))
    return {'us': 1e6 * (used + copies) / stored, 'copy_us': 1e6 * copies / stored, 'published': sent, 'lost': sent - stored,
            'bytes': size, 'late_p50_s': percentile(late_s, 50), 'late_max_s': max(late_s)}  # fmt: skip


def _delivery(world: World, rclone: str, bag: Path) -> Delivery:
    """Without ``rclone``, the recorder uploads."""
    assert world.tower is not None
    tower, settings = world.tower, world.tower.store_settings()
    client = boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                          aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip
    server = ['--s3-provider', 'Other', '--s3-env-auth', '--s3-endpoint', tower.endpoint_url, '--s3-force-path-style']
    environ = {name: value for name, value in os.environ.items() if name != 'AWS_CA_BUNDLE'} | tower.environment()
    return Delivery(client, [rclone, '--config', os.devnull, *server] if rclone else (), environ, bag)


# -- all of it ---------------------------------------------------------------------------------------------------------


def measure(options: argparse.Namespace) -> Report:
    other = installed(options.rosbag2)
    if other is None:
        progress(f'there is no {shlex.split(options.rosbag2)[0]} on the PATH: only the node is measured')
    recorders: dict[str, Rosbag2 | None] = {**({THEIRS: other} if other is not None else {}), BAG: None, OBJECTS: None}
    rates: dict[str, Any] = {}
    bars: list[Bar] = []
    for rate_hz in RATES_HZ:
        runs: dict[str, list[dict[str, Any]]] = {who: [] for who in recorders}
        for number in range(ROUNDS):
            for who, each in recorders.items():
                progress(f'{rate_hz:,} messages per second, round {number + 1} of {ROUNDS}: {who}, {options.seconds:g} s')
                runs[who].append(stream(options.folder, each, who, rate_hz, options.seconds))
        rates[str(rate_hz)] = found = {who: _joined(each) for who, each in runs.items()}
        bars += _bars(f'{rate_hz:,} messages per second', 'CPU of the node that records a bag', found, BAG, MAX_RATIO)
    figures = {
        'rates': rates,
        'job_hz': JOB_HZ,
        'split_s': SPLIT_S,
        **({'version': other.version, 'storage': other.storage} if other else {}),
    }
    rclone = shutil.which('rclone')
    if rclone is None and other is not None:
        progress('there is no rclone on the PATH: of the complete job, only the node is measured')
    doing = {who: each for who, each in {THEIRS: other if rclone else None, BAG: None}.items() if each or who == BAG}
    jobs: dict[str, list[dict[str, Any]]] = {who: [] for who in doing}
    for number in range(ROUNDS):
        for who, each in doing.items():
            progress(f'recording and delivering, round {number + 1} of {ROUNDS}: {who}, {2 * options.seconds:g} s')
            jobs[who].append(job(options.folder, each, rclone or '', 2 * options.seconds))
    figures['job'] = found = {who: _joined(each) for who, each in jobs.items()}
    bars += _bars('recording and delivering', 'CPU of the node', found, BAG, MAX_RATIO)
    return Report(tuple(bars), figures)


def _joined(runs: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """Each figure of all rounds."""
    return {name: [run[name] for run in runs] for name in runs[0]}


def _bars(when: str, what: str, found: dict[str, dict[str, list[float]]], ours: str, at_most: float) -> list[Bar]:
    """The CPU relative to rosbag2's, if that was measured, and that the node lost nothing."""
    lost = sum(found[ours]['lost'])
    bars = [Bar(f'{when}: messages lost by the node', 'none', lost, 'messages', lost == 0)]
    if THEIRS in found:
        value, rounds = ratio(found[ours]['us'], found[THEIRS]['us'])
        bars.insert(
            0, Bar(f'{when}: {what} against rosbag2', f'at most {at_most}', value, 'of its CPU', value <= at_most, rounds)
        )
    return bars


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--rosbag2', default='ros2 bag record', metavar='COMMAND', help='how to record with it (default: ros2 bag record)'
    )


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=20.0, more=_more)
