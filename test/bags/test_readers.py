"""Whole bags, as this package leaves them in a folder, in other people's readers: `rosbags` by folder, and with its own types."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from bags.slices import Recorded
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

QOS = """- history: 1
  depth: 10
  reliability: 2
  durability: 2
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
STORE = get_typestore(Stores.LATEST)
NOON_NS = 1_800_000_000_000_000_000
COUNTS = {'/odom': 60, '/camera/compressed': 20, '/blob': 20}


def recorded() -> Iterator[tuple[Channel, Recorded]]:
    """Odometry and pictures of real types, and a type that no reader knows."""
    odom, picture = (
        Channel(topic, kind, *describe(kind), QOS)
        for topic, kind in (('/odom', 'nav_msgs/msg/Odometry'), ('/camera/compressed', 'sensor_msgs/msg/CompressedImage'))
    )
    blob = Channel('/blob', 'nowhere/msg/Blob', *describe('nowhere/msg/Blob'), '')
    header = STORE.types['std_msgs/msg/Header'](stamp=STORE.types['builtin_interfaces/msg/Time'](7, 8), frame_id='camera')
    jpeg = random.Random(1).randbytes(3000)
    image = STORE.types[picture.type](header=header, format='jpeg', data=memoryview(jpeg).cast('B'))
    for number in range(100):
        at = NOON_NS + number * 10_000_000
        if number % 5 == 0:
            yield picture, Recorded(picture.topic, at, at - 100, number, _image(image, jpeg))
        elif number % 5 == 1:
            yield blob, Recorded(blob.topic, at, at - 100, number, number.to_bytes(9, 'little'))
        else:
            yield odom, Recorded(odom.topic, at, at - 100, number, _odometry(float(number)))


def _image(image: object, jpeg: bytes) -> bytes:
    import numpy as np

    image.data = np.frombuffer(jpeg, np.uint8)  # type: ignore[attr-defined]
    return bytes(STORE.serialize_cdr(image, 'sensor_msgs/msg/CompressedImage'))


def _odometry(x: float) -> bytes:
    import numpy as np

    make = {name.rpartition('/')[2]: kind for name, kind in STORE.types.items() if name.startswith(('geometry_msgs', 'std_msgs'))}
    zero = make['Vector3'](0.0, 0.0, 0.0)
    pose = make['Pose'](make['Point'](x, 0.0, 0.0), make['Quaternion'](0.0, 0.0, 0.0, 1.0))
    message = STORE.types['nav_msgs/msg/Odometry'](
        header=make['Header'](STORE.types['builtin_interfaces/msg/Time'](1, 2), 'odom'), child_frame_id='base_link',
        pose=make['PoseWithCovariance'](pose, np.zeros(36)),
        twist=make['TwistWithCovariance'](make['Twist'](zero, zero), np.zeros(36)),
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, 'nav_msgs/msg/Odometry'))


@pytest.fixture(params=['none', 'zstd'])
def bag(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, list[Recorded]]:
    """Four slices: three closed, the last one recovered, and their metadata.yaml."""
    folder, slices, written = tmp_path / 'patrol', [], []
    folder.mkdir()
    stream = list(recorded())
    for number in range(4):
        path = folder / f'patrol_{number}.mcap'
        writer = SliceWriter(path, compression=request.param, chunk_bytes=4000)
        for channel, one in stream[number * 25 : number * 25 + 25]:
            writer.write(channel, one.log_ns, one.publish_ns, one.sequence, one.cdr)
            written.append(one)
        slices.append(_ended(writer, path, killed=number == 3))
    (folder / 'metadata.yaml').write_bytes(metadata_yaml(slices, ros_distro='humble', custom_data={'robot': 'thor'}))
    return folder, written


def _ended(writer: SliceWriter, path: Path, *, killed: bool) -> SliceInfo:
    if not killed:
        return writer.close()
    writer.sync()
    writer.abort()
    return recover(path.with_name(f'{path.name}.open'))


def test_as_a_folder(bag: tuple[Path, list[Recorded]]) -> None:
    """Counts, times, QoS, types and every byte, over all slices."""
    folder, written = bag
    with Reader(folder) as reader:
        assert (reader.message_count, reader.start_time, reader.duration) == (100, NOON_NS, 990_000_001)
        assert {one.topic: one.msgcount for one in reader.connections} == COUNTS
        assert [(one.topic, at, bytes(data)) for one, at, data in reader.messages()] == [
            (one.topic, one.log_ns, one.cdr) for one in written
        ]
        (odom,) = [one for one in reader.connections if one.topic == '/odom']
        assert odom.ext.offered_qos_profiles[0].depth == 10  # type: ignore[union-attr]
        assert odom.digest in {STORE.hash_rihs01('nav_msgs/msg/Odometry'), ''}


def test_with_the_types_of_the_bag(bag: tuple[Path, list[Recorded]]) -> None:
    """Messages are decoded with the definitions in the slices only; an unknown type does not prevent that."""
    folder, _ = bag
    with AnyReader([folder]) as reader:
        wanted = [one for one in reader.connections if one.topic == '/odom']
        found = [
            reader.deserialize(data, one.msgtype).pose.pose.position.x  # type: ignore[attr-defined]
            for one, _, data in reader.messages(connections=wanted)
        ]
    assert found == [float(number) for number in range(100) if number % 5 > 1]


def test_a_single_slice(bag: tuple[Path, list[Recorded]]) -> None:
    """A single slice is a bag, from which a time range can be read."""
    folder, written = bag
    with AnyReader([folder / 'patrol_2.mcap']) as reader:
        found = [(one.topic, at) for one, at, _ in reader.messages(start=written[55].log_ns, stop=written[60].log_ns)]
    assert found == [(one.topic, one.log_ns) for one in written[55:60]]
