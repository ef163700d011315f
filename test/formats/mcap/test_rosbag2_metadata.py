"""metadata.yaml: what Humble's and Jazzy's rosbag2 read from it, by the rules of their readers."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from bags.slices import TALK
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml, offered_qos, qos_in_numbers, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo

OTHER = Channel('/späti', 'std_msgs/msg/Empty', '', '', '', '')


def info(number: int, start: int, end: int, count: int, *channels: Channel) -> SliceInfo:
    counts = dict.fromkeys(channels, count)
    return SliceInfo(Path(f'/somewhere/bag_{number}.mcap'), 100, '0' * 64, start, end, sum(counts.values()), counts)


def read(content: bytes) -> dict[str, Any]:
    """The inner mapping, of types that yaml-cpp's ``as`` takes."""
    found = yaml.safe_load(content)['rosbag2_bagfile_information']
    assert isinstance(found, dict)
    return found


def test_a_bag_of_several_slices() -> None:
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


def test_a_bag_of_nothing() -> None:
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
def test_qos_of_rclpy() -> None:
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
def test_yaml_is_read_as_it_was_meant(value: dict[str, Any]) -> None:
    """No text is taken for a number, a date or a comment, however it is nested."""
    assert yaml.safe_load(to_yaml(value)) == value
