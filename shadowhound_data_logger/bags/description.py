"""The contents of a bag: its topics, times and files, according to its files, or as metadata.yaml claims.

rosbag2 has written wrong totals: for a split bag, Galactic recorded start and duration of the last file, Humble of the first.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any, Final

from shadowhound_data_logger.bags.manifest import Manifest, SliceEntry
from shadowhound_data_logger.bags.naming import SQLITE, natural_key
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import check_size, from_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo, count_by_channel

MAX_QOS_BYTES: Final = 64 << 10
"""Maximum size of one topic's profiles: some 200 publishers."""
MAX_BOOT_ID: Final = 100
"""Maximum length."""
_INFINITE_S: Final = 9_000_000_000
_LATEST_NS: Final = 1 << 64


@dataclass(frozen=True, slots=True)
class DescribedTopic:
    """One topic of one type."""

    name: str
    type: str
    messages: int | None
    """As in ``Description``."""
    qos: Sequence[Mapping[str, Any]]
    """The offered QoS profiles, as rosbag2 stores them; empty if unknown."""
    type_hash: str


@dataclass(frozen=True, slots=True)
class BagPart:
    """One file of a bag. Times are log times, Unix nanoseconds, both inclusive; None if unknown, or without messages."""

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
    """rosbag2's compression outside the storage, such as ``zstd file``; empty if none."""
    distro: str
    topics: tuple[DescribedTopic, ...]
    parts: tuple[BagPart, ...]
    messages: int | None
    """The number in the readable files; None if no file is readable."""
    t_start_ns: int | None
    t_end_ns: int | None
    """As in ``BagPart``."""
    clock: Mapping[str, str] = field(default_factory=dict)
    """If the clock was not set: how its times are known, with the keys of ``metadata_keys.py``. Otherwise empty."""
    absent: tuple[str, ...] = ()
    """Files that the metadata names but that do not exist."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Files that cannot be read, and why."""
    remarks: tuple[str, ...] = ()
    """Where metadata.yaml contradicts the files."""

    @property
    def duration_s(self) -> float | None:
        if self.t_start_ns is None or self.t_end_ns is None:
            return None if self.messages is None else 0.0
        return max(self.t_end_ns - self.t_start_ns, 0) / 1e9


def describe_metadata(content: bytes, name: str, there: Container[str] = ()) -> Description:
    """What a metadata.yaml of any version of rosbag2 claims. Raises BagDamaged if it is invalid.

    Paths in it may be absolute or include folders (``bag/bag_0.db3``, Foxy): a file is identified by its path if it is in
    ``there``, otherwise by its name.
    """
    try:
        return _described(from_yaml(content.decode())['rosbag2_bagfile_information'], there)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise BagDamaged(f'{name} is not metadata of a rosbag2 bag: {type(error).__name__} {error}', path=name) from error


def describe_files(infos: Mapping[str, SliceInfo], damaged: Mapping[str, str], claimed: Description | None) -> Description:
    """The contents according to the files, by name, with the metadata's claims about the bag.

    Absent and damaged files are not counted.
    """
    topics: dict[tuple[str, str], DescribedTopic] = {}
    for channel, count in count_by_channel(each for one in infos.values() for each in one.channels.items()).items():
        name, qos = (channel.topic, channel.type), profiles(channel.qos)
        known = topics.setdefault(name, DescribedTopic(*name, 0, (), channel.type_hash))
        topics[name] = replace(
            known, messages=(known.messages or 0) + count, qos=(*known.qos, *(each for each in qos if each not in known.qos))
        )
    for topic in claimed.topics if claimed is not None else ():  # adds topics without messages, and QoS missing in the files
        there = topics.setdefault((topic.name, topic.type), replace(topic, messages=0 if infos else None))
        topics[topic.name, topic.type] = there if there.qos else replace(there, qos=topic.qos)
    filled = [one for one in infos.values() if one.messages]
    parts = [_part_of(name, one) for name, one in infos.items()] + [BagPart(name, None, None, None) for name in damaged]
    absent = [part for part in claimed.parts if part.name not in {*infos, *damaged}] if claimed is not None else []
    found = Description(
        storage='sqlite3' if any(SQLITE in name for name in infos) else 'mcap', compression='', distro='',
        topics=tuple(topics.values()),
        parts=tuple(sorted((*parts, *absent), key=lambda part: natural_key(part.name))),
        messages=sum(one.messages for one in infos.values()) if infos or not absent else None,
        t_start_ns=min((one.t_start_ns for one in filled), default=None),
        t_end_ns=max((one.t_end_ns for one in filled), default=None), absent=tuple(part.name for part in absent), damaged=damaged,
    )  # fmt: skip
    if claimed is None:
        return found
    storage = claimed.storage or found.storage
    whole = replace(found, storage=storage, compression=claimed.compression, distro=claimed.distro, clock=claimed.clock)
    return whole if absent or damaged else replace(whole, remarks=tuple(_contradictions(whole, claimed)))


def describe_manifest(manifest: Manifest, there: Container[str], claimed: Description) -> Description:
    """The contents according to the manifest, including files that are not ``there``."""
    counts = {(topic.topic, topic.type): topic.messages for topic in manifest.topics}
    known = {(topic.name, topic.type): topic for topic in claimed.topics}
    topics = [known.get(name, DescribedTopic(*name, 0, (), '')) for name in dict.fromkeys((*known, *counts))]
    parts = [_part_of(each.file, each) for each in manifest.slices]
    found = replace(
        claimed, topics=tuple(replace(topic, messages=counts.get((topic.name, topic.type), 0)) for topic in topics),
        parts=tuple(sorted(parts, key=lambda part: natural_key(part.name))),
        messages=sum(each.messages for each in manifest.slices),
        t_start_ns=min((part.t_start_ns for part in parts if part.t_start_ns is not None), default=None),
        t_end_ns=max((part.t_end_ns for part in parts if part.t_end_ns is not None), default=None),
        absent=tuple(part.name for part in parts if part.name not in there),
    )  # fmt: skip
    return replace(found, remarks=tuple(_contradictions(found, claimed)))


def _part_of(name: str, info: SliceInfo | SliceEntry) -> BagPart:
    times = (info.t_start_ns, info.t_end_ns) if info.messages else (None, None)
    return BagPart(name, info.messages, *times)


def _contradictions(found: Description, claimed: Description) -> Iterator[str]:
    """The differences between the metadata's claims and the files, for a bag with all its files."""
    names = {part.name for part in claimed.parts}
    unnamed = [part.name for part in found.parts if part.name not in names]
    if unnamed:
        yield f'metadata.yaml does not name {", ".join(unnamed)}'
    if claimed.messages is None:
        yield 'metadata.yaml has no number of messages'
    elif found.messages is not None and found.messages != claimed.messages:
        yield f'metadata.yaml claims {claimed.messages:,} messages, the files have {found.messages:,}'
    elif _counts(found) != _counts(claimed):
        yield 'metadata.yaml claims other numbers of messages for the topics than the files have'
    if claimed.messages and claimed.t_start_ns is None:
        yield 'metadata.yaml has no starting time or no duration'
    elif (found.t_start_ns, found.t_end_ns) != (claimed.t_start_ns, claimed.t_end_ns) and claimed.messages and found.messages:
        yield f'metadata.yaml claims the time {_span(claimed)}, the files have {_span(found)}'


def _counts(bag: Description) -> dict[tuple[str, str], int]:
    return {(topic.name, topic.type): topic.messages for topic in bag.topics if topic.messages}


def _span(bag: Description) -> str:
    if bag.t_start_ns is None or bag.t_end_ns is None:
        return 'unknown'
    return f'{_iso_ns(bag.t_start_ns)} to {_iso_ns(bag.t_end_ns)}'


def _iso_ns(time_ns: int) -> str:
    """With nanoseconds, because bags of tests are shorter than a microsecond."""
    return f'{iso(time_ns)[:-1]}{time_ns % 1000:03d}Z'


def profiles(qos: object) -> Sequence[Mapping[str, Any]]:
    """Offered QoS profiles, which rosbag2 stores as a list or, before version 9, as the YAML of a list."""
    if isinstance(qos, str):
        try:
            check_size(len(qos), MAX_QOS_BYTES)
            qos = from_yaml(qos) if qos else []
        except ValueError:
            return ()
    return tuple(each for each in qos if isinstance(each, Mapping)) if isinstance(qos, list) else ()


def is_latched(qos: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a publisher with one of these profiles keeps messages for late subscribers indefinitely."""
    return any(profile.get('durability') in {1, 'transient_local'} and _is_infinite(profile.get('lifespan')) for profile in qos)


def _is_infinite(lifespan: object) -> bool:
    """Both 0 and rmw's infinity mean unset."""
    seconds = lifespan.get('sec') if isinstance(lifespan, Mapping) else 0
    return not isinstance(seconds, int) or not 0 < seconds < _INFINITE_S


def _described(found: Mapping[str, Any], there: Container[str]) -> Description:
    """Reads every version of the format; missing fields are unknown."""
    messages = _integer(found, 'message_count')
    files = {_text(each['path']): each for each in found.get('files') or ()}
    paths = [_text(path) for path in found.get('relative_file_paths') or ()]
    compression = ' '.join(_text(found.get(name) or '') for name in ('compression_format', 'compression_mode')).strip()
    start, end = _times(found, messages)
    return Description(
        storage=_text(found.get('storage_identifier') or ''), distro=_text(found.get('ros_distro') or ''),
        compression='' if compression.lower() == 'none' else compression.lower(),
        topics=tuple(_topics(found.get('topics_with_message_count') or ())),
        messages=messages, t_start_ns=start, t_end_ns=end, clock=clock_state(found.get('custom_data')),
        parts=tuple(_part(path if path in there else PurePosixPath(path).name, files.get(path, {})) for path in paths),
    )  # fmt: skip


def _times(fields: Mapping[str, Any], messages: int | None) -> tuple[int | None, int | None]:
    start = _integer(fields.get('starting_time') or {}, 'nanoseconds_since_epoch')
    length = _integer(fields.get('duration') or {}, 'nanoseconds')
    if not messages or start is None or length is None:
        return None, None
    return start, start + length


def clock_state(custom: object) -> dict[str, str]:
    """``Description.clock`` from a bag's custom data or a slice's metadata; ignores data that we did not write."""
    if not isinstance(custom, Mapping):
        return {}
    known, boot_id, offset_ns = (custom.get(word) for word in (meta.CLOCK, meta.BOOT_ID, meta.CLOCK_OFFSET_NS))
    if known not in {meta.SET_LATER, meta.UNSET} or not isinstance(boot_id, str) or len(boot_id) > MAX_BOOT_ID:
        return {}
    found = {meta.CLOCK: str(known), meta.BOOT_ID: boot_id}
    if known == meta.UNSET:
        return found
    if not isinstance(offset_ns, str) or not re.fullmatch('[0-9]{1,20}', offset_ns) or int(offset_ns) >= _LATEST_NS:
        return {}
    return {**found, meta.CLOCK_OFFSET_NS: offset_ns}


def _topics(found: Iterable[Mapping[str, Any]]) -> Iterable[DescribedTopic]:
    for each in found:
        topic = each['topic_metadata']
        yield DescribedTopic(
            _text(topic['name']), _text(topic['type']), _integer(each, 'message_count'),
            profiles(topic.get('offered_qos_profiles')), _text(topic.get('type_description_hash') or ''),
        )  # fmt: skip


def _part(path: str, fields: Mapping[str, Any]) -> BagPart:
    messages = _integer(fields, 'message_count')
    return BagPart(path, messages, *_times(fields, messages))


def _integer(fields: Mapping[str, Any], name: str) -> int | None:
    found = fields.get(name)
    if isinstance(found, str) and found.isdecimal() and len(found) <= 20:
        found = int(found)
    if found is not None and (type(found) is not int or not 0 <= found < _LATEST_NS):
        raise ValueError(f'{name} is not an integer from 0 to 2^64')
    return found


def _text(found: object) -> str:
    if not isinstance(found, str):
        raise TypeError('a list or a number where text is expected')
    return found
