"""``metadata.yaml`` as rosbag2 writes it: ``ros2 bag info`` and ``ros2 bag play`` read it before any slice.

Version 8 of the format, with numeric QoS policies, is the newest that Humble can read (its reader fails on the QoS sequence of
version 9); Jazzy and Kilted read both. Source: rosbag2_storage, metadata_io.cpp of Humble, yaml.hpp of Jazzy.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from shadowhound_data_logger.core.untrusted import from_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo

VERSION: Final = 8
STORAGE: Final = 'mcap'
_INFINITE_NS: Final = (1 << 63) - 1
WIDTH: Final = 1 << 30
"""Maximum line length, large enough that no line is folded."""
_POLICIES: Final = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown', 'best_available'),
}
"""The policy names of version 9; their indexes are the numbers of version 8 (rmw/types.h)."""
_QOS_IN_WORDS: Final = re.compile(rf'\b({"|".join(_POLICIES)})\W{{0,4}}:\W{{0,4}}[a-z]')
MAX_CACHED_BYTES: Final = 4096


def metadata_yaml(slices: Sequence[SliceInfo], *, ros_distro: str, custom_data: Mapping[str, str] | None = None) -> bytes:
    """The file for a bag with these slices, in this order; ``ros_distro`` is empty if unknown."""
    information = bagfile_information(slices, ros_distro=ros_distro, custom_data=custom_data)
    return to_yaml({'rosbag2_bagfile_information': information}).encode()


def bagfile_information(
    slices: Sequence[SliceInfo], *, ros_distro: str, custom_data: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """rosbag2's BagMetadata. A topic with messages of two types is listed with each type.

    If several channels have the same topic and type, as in merged files, their QoS profiles are concatenated.
    """
    start = min((one.t_start_ns for one in slices if one.messages), default=0)
    end = max((one.t_end_ns for one in slices if one.messages), default=0)
    return {
        'version': VERSION,
        'storage_identifier': STORAGE,
        'duration': {'nanoseconds': end - start},
        'starting_time': {'nanoseconds_since_epoch': start},
        'message_count': sum(one.messages for one in slices),
        'topics_with_message_count': _topics(slices),
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [one.path.name for one in slices],
        'files': [
            {
                'path': one.path.name,
                'starting_time': {'nanoseconds_since_epoch': one.t_start_ns},
                'duration': {'nanoseconds': one.t_end_ns - one.t_start_ns},
                'message_count': one.messages,
            }
            for one in slices
        ],
        'custom_data': dict(custom_data or {}),
        'ros_distro': ros_distro,
    }


def offered_qos(profiles: Iterable[Any]) -> str:
    """The QoS of a topic's publishers (rclpy's QoSProfile or similar) in the form in which rosbag2 stores it with the topic."""
    described = [_profile(profile) for profile in profiles]
    return to_yaml(described).rstrip('\n') if described else ''


def qos_in_numbers(qos: str) -> str:
    """A topic's offered QoS profiles with the policy names of Jazzy and Kilted replaced by the numbers of version 8."""
    if not _QOS_IN_WORDS.search(qos):  # written by us or by Humble
        return qos
    return _convert_qos(qos) if len(qos) > MAX_CACHED_BYTES else _convert_qos_cached(qos)


def _convert_qos(qos: str) -> str:
    try:
        profiles = from_yaml(qos)
    except ValueError:
        return qos
    if not isinstance(profiles, list) or not all(isinstance(profile, dict) for profile in profiles):
        return qos
    numbered = [{str(name): _number(name, value) for name, value in profile.items()} for profile in profiles]
    return to_yaml(numbered).rstrip('\n')


_convert_qos_cached = functools.lru_cache(256)(_convert_qos)
"""Cached because parsing takes 3 ms and the topics of a bag share few different profiles."""


def _number(policy: object, value: Any) -> Any:
    words = _POLICIES.get(str(policy), ())
    return words.index(value) if value in words else value


def to_yaml(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """Mappings, sequences, strings and integers as block YAML; strings are quoted so that readers keep their type."""
    from ruamel.yaml import YAML  # noqa: PLC0415 - takes 0.1 s, and most callers do not need it

    yaml, stream = YAML(), io.StringIO()
    yaml.width = WIDTH
    yaml.dump(_quoted(value), stream)
    return stream.getvalue()


def _quoted(value: Any) -> Any:
    from ruamel.yaml.scalarstring import DoubleQuotedScalarString  # noqa: PLC0415

    if isinstance(value, Mapping):
        return {key: _quoted(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_quoted(inner) for inner in value]
    return DoubleQuotedScalarString(value) if isinstance(value, str) else value


def _topics(slices: Sequence[SliceInfo]) -> list[dict[str, Any]]:
    topics: dict[tuple[str, str, str], dict[Channel, int]] = {}
    for one in slices:
        for channel, count in one.channels.items():
            of = topics.setdefault((channel.topic, channel.type, channel.message_encoding), {})
            of[channel] = of.get(channel, 0) + count
    return [
        {
            'topic_metadata': {
                'name': name,
                'type': kind,
                'serialization_format': encoding,
                'offered_qos_profiles': _merged(channel.qos for channel in counts),
                'type_description_hash': next(iter(counts)).type_hash,
            },
            'message_count': sum(counts.values()),
        }
        for (name, kind, encoding), counts in topics.items()
    ]


def _merged(profiles: Iterable[str]) -> str:
    """The different profiles of all channels; block sequences of YAML are joined by concatenation."""
    found = list(dict.fromkeys(qos for qos in profiles if qos))
    if len(found) > 1 and all(qos.startswith('- ') for qos in found):
        return '\n'.join(qos.rstrip('\n') for qos in found)
    return found[0] if found else ''


def _profile(profile: Any) -> dict[str, Any]:
    return {
        'history': int(profile.history),
        'depth': int(profile.depth),
        'reliability': int(profile.reliability),
        'durability': int(profile.durability),
        'deadline': _duration(profile.deadline.nanoseconds),
        'lifespan': _duration(profile.lifespan.nanoseconds),
        'liveliness': int(profile.liveliness),
        'liveliness_lease_duration': _duration(profile.liveliness_lease_duration.nanoseconds),
        'avoid_ros_namespace_conventions': bool(profile.avoid_ros_namespace_conventions),
    }


def _duration(nanoseconds: int) -> dict[str, int]:
    """A duration of 0 means unset, which rosbag2 writes as rmw's infinity; both mean the default."""
    seconds, rest = divmod(nanoseconds or _INFINITE_NS, 10**9)
    return {'sec': seconds, 'nsec': rest}
