"""metadata.yaml as Humble's and Jazzy's rosbag2 read it, and complete bags in the reader of ``rosbags``."""

from __future__ import annotations

import random
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from bags.slices import TALK, Recorded
from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml, offered_qos, qos_in_numbers, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

OTHER = Channel('/späti', 'std_msgs/msg/Empty', '', '', '', '')


def info(number: int, start: int, end: int, count: int, *channels: Channel) -> SliceInfo:
    counts = dict.fromkeys(channels, count)
    return SliceInfo(Path(f'/somewhere/bag_{number}.mcap'), 100, '0' * 64, start, end, sum(counts.values()), counts)


def read(content: bytes) -> dict[str, Any]:
    """The inner mapping, of types that yaml-cpp's ``as`` takes."""
    found = yaml.safe_load(content)['rosbag2_bagfile_information']
    assert isinstance(found, dict)
    return found


def test_the_metadata_spans_all_slices() -> None:
    """Times span all slices, counts are sums, files are in order, each topic appears once."""
    slices = [info(0, 100, 200, 2, TALK), info(1, 0, 0, 0, OTHER), info(2, 150, 390, 3, TALK, OTHER)]
    found = read(metadata_yaml(slices, ros_distro='humble', custom_data={'robot': 'thor', 'a b': 'c: "d"'}))
    assert found['version'] == 8
    assert found['storage_identifier'] == 'mcap'
    assert found['starting_time'] == {'nanoseconds_since_epoch': 100}
    assert found['duration'] == {'nanoseconds': 290}
    assert found['message_count'] == 8
    assert found['relative_file_paths'] == ['bag_0.mcap', 'bag_1.mcap', 'bag_2.mcap']
    assert found['files'] == [
        {'path': f'bag_{number}.mcap', 'starting_time': {'nanoseconds_since_epoch': start}, 'duration': {'nanoseconds': long},
         'message_count': count}
        for number, (start, long, count) in enumerate([(100, 100, 2), (0, 0, 0), (150, 240, 6)])
    ]  # fmt: skip
    assert [(one['topic_metadata']['name'], one['message_count']) for one in found['topics_with_message_count']] == [
        ('/talk', 5), ('/späti', 3),
    ]  # fmt: skip
    assert found['topics_with_message_count'][0]['topic_metadata'] == {
        'name': '/talk', 'type': TALK.type, 'serialization_format': 'cdr', 'offered_qos_profiles': '',
        'type_description_hash': TALK.type_hash,
    }  # fmt: skip
    assert (found['compression_format'], found['compression_mode'], found['ros_distro']) == ('', '', 'humble')
    assert found['custom_data'] == {'robot': 'thor', 'a b': 'c: "d"'}


def test_a_bag_without_messages_has_metadata() -> None:
    """No slices, or none with messages, is a bag that begins and ends at 0."""
    for slices in ([], [info(0, 0, 0, 0)]):
        found = read(metadata_yaml(slices, ros_distro=''))
        assert (found['message_count'], found['duration'], found['starting_time']) == (
            0, {'nanoseconds': 0}, {'nanoseconds_since_epoch': 0},
        )  # fmt: skip
        assert found['topics_with_message_count'] == []


class Policy(IntEnum):
    """As rclpy's policies are."""

    ONE = 1
    TWO = 2


def profile(**changed: Any) -> SimpleNamespace:
    unset = SimpleNamespace(nanoseconds=0)
    known: dict[str, Any] = {
        'history': Policy.ONE, 'depth': 5, 'reliability': Policy.TWO, 'durability': Policy.TWO, 'deadline': unset,
        'lifespan': SimpleNamespace(nanoseconds=2_500_000_000), 'liveliness': Policy.ONE, 'liveliness_lease_duration': unset,
        'avoid_ros_namespace_conventions': False,
    }  # fmt: skip
    return SimpleNamespace(**{**known, **changed})


def test_qos_is_in_numbers() -> None:
    """Policies are rmw's numbers, which Humble needs and Jazzy accepts; a duration that is not set is rmw's infinity."""
    infinite = {'sec': 9223372036, 'nsec': 854775807}
    (first, second) = yaml.safe_load(offered_qos([profile(), profile(depth=1)]))
    assert first == {
        'history': 1, 'depth': 5, 'reliability': 2, 'durability': 2, 'liveliness': 1, 'avoid_ros_namespace_conventions': False,
        'lifespan': {'sec': 2, 'nsec': 500_000_000}, 'liveliness_lease_duration': infinite, 'deadline': infinite,
    }  # fmt: skip
    assert second['depth'] == 1
    assert offered_qos([]) == ''


IN_WORDS = """- history: unknown
  depth: 0
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  liveliness: manual_by_topic
  liveliness_lease_duration:
    sec: 3
    nsec: 0
  avoid_ros_namespace_conventions: false
- {history: keep_last, depth: 7, reliability: best_effort, durability: volatile, liveliness: automatic}"""
"""As `ros2 bag record` of Jazzy and Kilted keeps it in an MCAP file."""


def test_qos_in_words_becomes_numbers() -> None:
    """The numbers are those of rmw/types.h; numbers, other fields and text that is not QoS are unchanged."""
    first, second = yaml.safe_load(qos_in_numbers(IN_WORDS))
    assert first == yaml.safe_load(IN_WORDS)[0] | {'history': 3, 'reliability': 1, 'durability': 1, 'liveliness': 3}
    assert second == {'history': 1, 'depth': 7, 'reliability': 2, 'durability': 2, 'liveliness': 1}
    numbers = offered_qos([profile()])
    assert yaml.safe_load(qos_in_numbers('- {"durability": "volatile"}  # reliability: reliable')) == [{'durability': 2}]
    for text in (
        numbers,
        '',
        'history: of a robot',
        '- [',
        '\x00',
        '- &a {history: *a}',
    ):
        assert qos_in_numbers(text) == text


@pytest.mark.ros
def test_qos_of_rclpy_is_accepted() -> None:
    """The QoS that rclpy reports for a publisher can be used directly."""
    qos = pytest.importorskip('rclpy.qos')
    (found,) = yaml.safe_load(offered_qos([qos.qos_profile_sensor_data]))
    assert (found['history'], found['depth'], found['reliability'], found['durability']) == (1, 5, 2, 2)


texts = st.text(
    st.characters(codec='utf-8', exclude_categories=['Cc', 'Cs', 'Zl', 'Zp'], exclude_characters='\ufeff'), max_size=20
)
values = st.recursive(
    st.integers() | texts | st.booleans(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3), max_leaves=12,
)  # fmt: skip


@given(st.dictionaries(texts, values, min_size=1, max_size=4))
def test_yaml_values_keep_their_types(value: dict[str, Any]) -> None:
    """No text is taken for a number, a date or a comment, however it is nested."""
    assert yaml.safe_load(to_yaml(value)) == value


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


def test_rosbags_reads_a_folder_of_slices(bag: tuple[Path, list[Recorded]]) -> None:
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


def test_rosbags_decodes_messages_with_the_types_of_the_bag(bag: tuple[Path, list[Recorded]]) -> None:
    """Messages are decoded with the definitions in the slices only; an unknown type does not prevent that."""
    folder, _ = bag
    with AnyReader([folder]) as reader:
        wanted = [one for one in reader.connections if one.topic == '/odom']
        found = [
            reader.deserialize(data, one.msgtype).pose.pose.position.x  # type: ignore[attr-defined]
            for one, _, data in reader.messages(connections=wanted)
        ]
    assert found == [float(number) for number in range(100) if number % 5 > 1]


def test_rosbags_reads_a_single_slice(bag: tuple[Path, list[Recorded]]) -> None:
    """A single slice is a bag, from which a time range can be read."""
    folder, written = bag
    with AnyReader([folder / 'patrol_2.mcap']) as reader:
        found = [(one.topic, at) for one, at, _ in reader.messages(start=written[55].log_ns, stop=written[60].log_ns)]
    assert found == [(one.topic, one.log_ns) for one in written[55:60]]
