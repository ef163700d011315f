"""Bags as this package and as rosbags write them, in folders and in stores, for the tests of their readers."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.bags.manifest import COMPLETE, Manifest, SliceEntry, topics_of
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of
from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, RecordedMessage, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.stores.base import ObjectStore

T0 = 1_760_788_800_000_000_000
"""2025-10-18 12:00:00 UTC."""
STEP_NS = 10_000_000
IMU = Channel('/imu', 'std_msgs/msg/String', 'ros2msg', 'string data\n', 'RIHS01_' + 'a' * 64, '')
BLOB = Channel('/camera/blob', 'nowhere/msg/Blob', '', '', '', '')
"""With a type that is unknown on this machine."""
EVER = MessageFilter(0, 1 << 63, lambda _: True)
NAME = 'patrol_20251018_120000'


def write_ours(folder: Path, *, slices: int = 3, each: int = 500, is_ended: bool = True, robot: str = 'thor') -> list[SliceInfo]:
    """A bag as the node writes it, one message every 10 ms; every tenth with an additional large one."""
    folder.mkdir(parents=True)
    rng, infos = random.Random(7), []
    for number in range(slices):
        writer = SliceWriter(folder / f'{folder.name}_{number}.mcap', chunk_bytes=64 << 10)
        for place in range(number * each, (number + 1) * each):
            at = T0 + place * STEP_NS
            writer.write(IMU, at, at - 1000, place, rng.randbytes(200))
            if place % 10 == 0:
                writer.write(BLOB, at + 1, at - 500, place // 10, rng.randbytes(20_000))
        infos.append(writer.close())
    if is_ended:
        (folder / 'metadata.yaml').write_bytes(metadata_yaml(infos, ros_distro='humble'))
        entries = tuple(SliceEntry.of(info, f'{prefix_of(robot, folder.name)}{info.path.name}') for info in infos)
        manifest = Manifest(folder.name, robot, None, COMPLETE, (), topics_of(infos), entries)
        (folder / 'manifest.json').write_bytes(manifest.to_json())
    return infos


def write_rosbags(folder: Path, plugin: StoragePlugin, mode: CompressionMode, *, count: int = 300) -> None:
    """A bag as rosbags writes it."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    rng = random.Random(9)
    with writer:
        text = writer.add_connection('/text', 'std_msgs/msg/String', typestore=store)
        imu = writer.add_connection('/imu', 'sensor_msgs/msg/Imu', typestore=store)
        for place in range(count):
            writer.write((text, imu)[place % 2], T0 + place * STEP_NS, rng.randbytes(300))


def stored(store: ObjectStore, folder: Path, *, robot: str = 'thor', without: str = '-') -> None:
    """Put the files of a folder under the keys of a bag, as the node does; files with ``without`` in their names are skipped."""
    for place, path in enumerate(sorted(folder.iterdir())):
        if without not in path.name:
            store.put(put_item(path, f'{prefix_of(robot, folder.name)}{path.name}', folder.name, place))


def put_item(path: Path, key: str, bag: str, place: int) -> SpooledObject:
    """A file as delivery passes it to a store."""
    sha256 = fingerprint(path)[1]
    metadata = {'sha256': sha256}
    if path.suffix == '.mcap':
        index = read_index(LocalFile(path))
        fields = {'messages': index.messages, 't_start_ns': index.t_start_ns, 't_end_ns': index.t_end_ns, 'slice': place}
        metadata |= {'robot': 'thor', 'bag': bag, **{name: str(value) for name, value in fields.items()}}
    return SpooledObject(place, BUCKET, key, path, path.stat().st_size, sha256, 'application/octet-stream', metadata, 5, 0)


def messages_of(paths: Sequence[Path]) -> Iterator[RecordedMessage]:
    """All messages of MCAP files, in order."""
    for path in paths:
        source = LocalFile(path)
        yield from read_messages(source, read_index(source), EVER)


def by_rosbags(folder: Path) -> list[tuple[str, int, bytes]]:
    """The messages of a bag according to another program: topic, log time, CDR."""
    with Reader(folder) as reader:
        return [(connection.topic, log_ns, bytes(cdr)) for connection, log_ns, cdr in reader.messages()]
