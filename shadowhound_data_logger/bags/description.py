"""What a bag holds: its topics, times and files, from its metadata.yaml or, for MCAP, from the summaries of its slices."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.mcap.index import McapIndex
from shadowhound_data_logger.mcap.slice_info import SliceInfo
from shadowhound_data_logger.untrusted import check_size, from_yaml

MOST_QOS_BYTES: Final = 64 << 10
"""Of one topic's profiles: some 200 publishers."""
MOST_BOOT_ID: Final = 100
"""Letters."""
_LATEST_NS: Final = 1 << 63


@dataclass(frozen=True, slots=True)
class DescribedTopic:
    """One topic of one type."""

    name: str
    type: str
    messages: int
    qos: Sequence[Mapping[str, Any]]
    """The offered QoS profiles, as rosbag2 keeps them; empty where they are not known."""
    type_hash: str


@dataclass(frozen=True, slots=True)
class BagPart:
    """One file of a bag. Times are log times, Unix nanoseconds, both inclusive; None where they are not known."""

    name: str
    messages: int | None
    t_start_ns: int | None
    t_end_ns: int | None


@dataclass(frozen=True, slots=True)
class Description:
    """The contents of a bag."""

    storage: str
    """``mcap`` or ``sqlite3``."""
    compression: str
    """Of files or messages, as rosbag2 does it outside the storage: ``zstd file``; empty without."""
    distro: str
    topics: tuple[DescribedTopic, ...]
    parts: tuple[BagPart, ...]
    messages: int
    t_start_ns: int
    t_end_ns: int
    clock: Mapping[str, str] = field(default_factory=dict)
    """Where the clock was not set: how its times are known, by the words of ``metadata_words.py``. Else empty."""

    @property
    def duration_s(self) -> float:
        return max(self.t_end_ns - self.t_start_ns, 0) / 1e9


def of_metadata(content: bytes, name: str) -> Description:
    """From a metadata.yaml of any version of rosbag2. Raises BagDamaged for what is none."""
    try:
        return _described(from_yaml(content.decode())['rosbag2_bagfile_information'])
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise BagDamaged(f'{name} is not metadata of a rosbag2 bag: {type(error).__name__} {error}', path=name) from error


def of_slices(slices: Sequence[SliceInfo]) -> Description:
    """From what the slices themselves say."""
    counts: dict[tuple[str, str], int] = {}
    found: dict[tuple[str, str], DescribedTopic] = {}
    for one in slices:
        types = [channel.topic for channel in one.channels]
        for channel in one.channels:
            key = (channel.topic, channel.type)
            counts[key] = counts.get(key, 0) + one.counts.get(channel.topic, 0) // types.count(channel.topic)
            found.setdefault(key, DescribedTopic(*key, 0, profiles(channel.qos), channel.type_hash))
    filled = [one for one in slices if one.messages]
    return Description(
        storage='mcap', compression='', distro='',
        topics=tuple(replace(topic, messages=counts[key]) for key, topic in found.items()),
        parts=tuple(BagPart(one.path.name, one.messages, one.t_start_ns, one.t_end_ns) for one in slices),
        messages=sum(one.messages for one in slices),
        t_start_ns=min((one.t_start_ns for one in filled), default=0), t_end_ns=max((one.t_end_ns for one in filled), default=0),
    )  # fmt: skip


def slice_info(index: McapIndex, path: Path, size: int, sha256: str = '') -> SliceInfo:
    """A slice as its own summary tells it."""
    counts, repeated = {channel.topic: 0 for channel in index.channels.values()}, Counter[str]()
    for number, count in index.counts.items():
        if number in index.channels:
            counts[index.channels[number].topic] += count
            repeated[index.channels[number].topic] += count if index.channels[number].repeated else 0
    return SliceInfo(path, size, sha256, index.t_start_ns, index.t_end_ns, index.messages, counts, tuple(index.channels.values()),
                     repeated=+repeated)  # fmt: skip


def profiles(qos: object) -> Sequence[Mapping[str, Any]]:
    """Offered QoS profiles: rosbag2 keeps them as a list, before its version 9 as the YAML of one."""
    if isinstance(qos, str):
        try:
            check_size(len(qos), MOST_QOS_BYTES)
            qos = from_yaml(qos) if qos else []
        except ValueError:
            return ()
    return tuple(each for each in qos if isinstance(each, Mapping)) if isinstance(qos, list) else ()


def _described(found: Mapping[str, Any]) -> Description:
    start = _whole(found['starting_time'], 'nanoseconds_since_epoch')
    paths = [PurePosixPath(path).name for path in found['relative_file_paths']]
    told = {PurePosixPath(each['path']).name: each for each in found.get('files') or ()}
    compression = ' '.join(_text(found.get(name) or '') for name in ('compression_format', 'compression_mode')).strip()
    messages = _whole(found, 'message_count')
    return Description(
        storage=_text(found['storage_identifier']), compression='' if compression.lower() == 'none' else compression.lower(),
        distro=_text(found.get('ros_distro') or ''), topics=tuple(_topics(found['topics_with_message_count'] or ())),
        parts=tuple(_part(path, told.get(path)) for path in paths), messages=messages,
        t_start_ns=start if messages else 0, t_end_ns=start + _whole(found['duration'], 'nanoseconds') if messages else 0,
        clock=clock_said(found.get('custom_data')),
    )  # fmt: skip


def clock_said(custom: object) -> dict[str, str]:
    """As ``Description.clock``, from a bag's custom data or a slice's metadata; what is not as we write it says nothing."""
    if not isinstance(custom, Mapping):
        return {}
    known, boot_id, offset_ns = (custom.get(word) for word in (words.CLOCK, words.BOOT_ID, words.CLOCK_OFFSET_NS))
    if known not in {words.SET_LATER, words.UNSET} or not isinstance(boot_id, str) or len(boot_id) > MOST_BOOT_ID:
        return {}
    found = {words.CLOCK: str(known), words.BOOT_ID: boot_id}
    if known == words.UNSET:
        return found
    if not isinstance(offset_ns, str) or not re.fullmatch('[0-9]{1,19}', offset_ns) or int(offset_ns) >= _LATEST_NS:
        return {}
    return {**found, words.CLOCK_OFFSET_NS: offset_ns}


def _topics(found: Iterable[Mapping[str, Any]]) -> Iterable[DescribedTopic]:
    for each in found:
        told = each['topic_metadata']
        yield DescribedTopic(
            _text(told['name']), _text(told['type']), _whole(each, 'message_count'), profiles(told.get('offered_qos_profiles')),
            _text(told.get('type_description_hash') or ''),
        )  # fmt: skip


def _part(path: str, told: Mapping[str, Any] | None) -> BagPart:
    if told is None:
        return BagPart(path, None, None, None)
    start, messages = _whole(told['starting_time'], 'nanoseconds_since_epoch'), _whole(told, 'message_count')
    return BagPart(
        path, messages, start if messages else None, start + _whole(told['duration'], 'nanoseconds') if messages else None
    )


def _whole(told: Mapping[str, Any], name: str) -> int:
    found = told[name]
    if isinstance(found, str) and found.isdecimal() and len(found) < 20:
        found = int(found)
    if type(found) is not int or not 0 <= found < _LATEST_NS:
        raise ValueError(f'{name} is not a whole number of 0 ... 2^63')
    return found


def _text(found: object) -> str:
    if not isinstance(found, str):
        raise TypeError('a list or a number where text is expected')
    return found
