"""Copies a time span and some topics of a bag into a new bag, message by message.

Messages are not decoded: their content, encoding, both times, sequence number, the schema and metadata of the channel, and the
profile of the file are copied unchanged. QoS policy names are converted to numbers, which Humble can read, and rosbag2's
compression outside the storage to that of MCAP. Attachments and metadata records are counted, but not copied.

If the clock of the bag was not set, the times are copied unchanged too, and metadata.yaml has the clock of the bag.

From an MCAP slice in a store, only the summary and the necessary chunks are read. Other files (SQLite, or compressed outside the
storage) are downloaded first.
"""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from hashlib import sha256
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import BagReader, open_folder
from shadowhound_data_logger.bags.description import BagPart, Description, describe_metadata, is_latched, profiles
from shadowhound_data_logger.bags.fetch import disk_errors, fetch
from shadowhound_data_logger.bags.latched import MAX_LATCHED_BYTES, MAX_PER_TOPIC, Latched
from shadowhound_data_logger.bags.naming import BUCKET, MCAP, METADATA
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.remote import RemoteBag, clock_of, document, read_manifest
from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.errors import BagError, SettingError
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.times import moment_in_bag
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, RecordedMessage
from shadowhound_data_logger.formats.mcap.ranges import Meter, StoredFile
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.stores.base import ObjectStore

UNFINISHED: Final = '.part'
MAY_ARRIVE: Final = 'it may not have arrived yet: shadowhound-data bag list'
END_OF_TIME: Final = 1 << 64
"""Later than any time in MCAP."""
ACCUMULATED: Final = frozenset({'tf2_msgs/msg/TFMessage'})
"""Types for which a subscriber needs all latched messages, not only the last one: each has different transforms."""
SOURCE: Final = 'source'
"""Subfolder for files that must be downloaded completely."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What to copy. Times as in ``times.moment_in_bag``: from ``start``, before ``end``; empty means start or end of the bag."""

    start: str = ''
    end: str = ''
    topics: Sequence[str] = ()
    regex: str = ''
    """Topics that match are copied too; without ``topics`` and ``regex``, all are."""
    spans: tuple[tuple[int, int], ...] | None = None
    """Copy only these half-open time spans, in ns since 1970; they are sorted and do not touch."""


@dataclass(frozen=True, slots=True)
class Cut:
    """The result of a cut."""

    folder: Path
    messages: int
    topics: int
    bytes: int
    t_start_ns: int
    t_end_ns: int
    """Log times of the first and the last message."""
    read_bytes: int
    read_requests: int
    bag_bytes: int
    absent: tuple[str, ...] = ()
    """Requested topics that the bag does not have."""
    missing: tuple[str, ...] = ()
    """Missing slices that overlap the time span."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Unreadable slices, and why: none of their messages was copied."""
    extras: int = 0
    """The number of attachments and metadata records in the slices that were read; they are not copied."""
    remarks: tuple[str, ...] = ()
    """Contradictions between metadata.yaml and the files."""
    latched: int = 0
    """The number of messages from before the start that were latched at the start."""


def cut_remote(store: ObjectStore, bag: RemoteBag, out: Path, choice: Choice) -> Cut:
    """Cut a bag in a store into the new folder ``out``. Raises BagError, BagDamaged, SettingError, StoreError."""
    if bag.is_archive:
        raise BagError(
            f'{bag.name} is an archive, which can only be read as a whole', remedy='fetch it, unpack it and cut the folder'
        )
    meter = Meter()
    file = bag.file(METADATA)
    claimed = describe_metadata(document(store, file), file.key, {each.name for each in bag.files}) if file else None
    with _new_folder(out) as folder:
        if all(each.name.endswith(MCAP) for each in bag.slices):
            sources = {each.name: StoredFile(store, BUCKET, each.key, each.size, meter) for each in bag.slices}
            reader = BagReader(sources, claimed, read_manifest(store, bag))
            return _cut(reader, folder, out, choice, meter, bag.size, {} if claimed else clock_of(store, bag))
        fetched = fetch(store, bag, folder / SOURCE)
        meter.add(fetched.downloaded)
        return _cut(open_folder(fetched.folder).reader, folder, out, choice, meter, bag.size, {})


def cut_folder(path: Path, out: Path, choice: Choice) -> Cut:
    """Cut a bag on the disk, or one of its files. Raises BagError, BagDamaged, SettingError."""
    if path.resolve() in out.absolute().resolve().parents:
        raise BagError(f'{out} is inside the bag', remedy='choose a folder outside the bag')
    meter = Meter()
    bag = open_folder(path, meter)
    size = sum(each.stat().st_size for each in bag.files.values())
    with _new_folder(out) as new:
        return _cut(bag.reader, new, out, choice, meter, size, {})


def _cut(reader: BagReader, folder: Path, out: Path, choice: Choice, meter: Meter, bag_bytes: int,
         clock: Mapping[str, str]) -> Cut:  # fmt: skip
    bag = reader.describe()
    first_ns, last_ns = _span(bag)
    start_ns = moment_in_bag('--start', choice.start, first_ns, last_ns) if choice.start else first_ns
    end_ns = moment_in_bag('--end', choice.end, first_ns, last_ns) if choice.end else last_ns + 1
    topics = {topic.name for topic in bag.topics}
    chosen, absent = _topics(choice, topics)
    if start_ns > last_ns and not choice.end:
        raise _nothing(bag, choice, absent, start_ns, start_ns)
    if end_ns <= start_ns:
        raise SettingError('--end', choice.end, f'a time after --start, which is {iso(start_ns)}')
    least, most = start_ns if choice.start else 0, end_ns if choice.end else END_OF_TIME  # the bag's own times may be incomplete
    latched = _LatchedBefore(reader, {topic.name for topic in bag.topics if is_latched(topic.qos)} & chosen)
    writer = SliceWriter(folder / f'{out.name}_0.mcap', mode=0o666, profile=reader.profile())
    try:
        for first, last in ((least, most),) if choice.spans is None else choice.spans:
            if (begin := max(first, least)) < (end := min(last, most)):
                for message in latched.before(begin) if begin > first_ns else ():
                    writer.copy(message.channel, message.log_ns, message.publish_ns, message.sequence, message.cdr)
                for message in reader.messages(MessageFilter(begin, end, lambda channel: channel.topic in chosen)):
                    if latched.is_new(message):
                        writer.copy(message.channel, message.log_ns, message.publish_ns, message.sequence, message.cdr)
        info = writer.close()
    finally:
        writer.abort()
    missing = tuple(part.name for part in bag.parts if part.name in bag.absent and _overlaps(part, start_ns, end_ns))
    if not info.messages:
        if missing:
            raise BagError(f'the messages of this time are in {", ".join(missing)}, which is missing', remedy=MAY_ARRIVE)
        reader.check()
        raise _nothing(bag, choice, absent, start_ns, end_ns)
    (folder / METADATA).write_bytes(metadata_yaml([info], ros_distro='', custom_data=bag.clock or clock))
    return Cut(
        out, info.messages, sum(count > 0 for count in info.counts.values()), info.bytes, info.t_start_ns, info.t_end_ns,
        meter.bytes, meter.requests, bag_bytes, absent, missing, reader.damaged,
        reader.extras(), bag.remarks, latched.count,
    )  # fmt: skip


class _LatchedBefore:
    """The latched messages at the start of a cut, so that it can be played on its own.

    They have separate channels, as at the start of a bag's slices. Repetitions at the start of later slices are not copied again.
    """

    def __init__(self, reader: BagReader, topics: set[str]) -> None:
        self._reader = reader
        self._topics = topics
        self._seen: set[tuple[str, str, bytes]] = set()
        self.count = 0

    def before(self, start_ns: int) -> list[RecordedMessage]:
        """The messages latched at ``start_ns``, in bag order, with the log time ``start_ns`` and their own publish time."""
        if not self._topics:
            return []
        latched, channels, repeats = Latched(MAX_LATCHED_BYTES), dict[tuple[str, str], Channel](), Counter[str]()
        wanted = MessageFilter(self._reader.latched_since(start_ns), start_ns, lambda channel: channel.topic in self._topics)
        for channel, log_ns, publish_ns, sequence, cdr in self._reader.messages(wanted):
            channels[channel.topic, channel.type] = channel
            repeats[channel.topic] += channel.repeated
            publishers = sum(is_latched([each]) for each in profiles(channel.qos))
            count = MAX_PER_TOPIC if channel.type in ACCUMULATED else max(publishers, repeats[channel.topic], 1)
            latched.keep(MessageBatch(channel.topic, channel.type, '', [Taken(cdr, publish_ns, None, sequence, log_ns)], count))
        kept = [
            RecordedMessage(replace(channels[batch.topic, batch.type], repeated=True), start_ns, source_ns, number or 0, cdr)
            for batch in latched for cdr, source_ns, _, number, *_ in batch.messages
        ]  # fmt: skip
        found = [message for message in kept if self.is_new(message)]
        self.count += len(found)
        return found

    def is_new(self, message: RecordedMessage) -> bool:
        """Whether a message is not a repetition of one in the cut."""
        channel = message.channel
        if not channel.repeated and channel.topic not in self._topics:
            return True
        seen = channel.topic, channel.type, sha256(message.cdr).digest()
        is_new = not channel.repeated or seen not in self._seen
        self._seen.add(seen)
        return is_new


def _span(bag: Description) -> tuple[int, int]:
    """Log times of the first and the last message. Raises BagError."""
    if bag.t_start_ns is None or bag.t_end_ns is None:
        raise BagError('the bag has no messages', remedy='shadowhound-data bag info shows its contents')
    return bag.t_start_ns, bag.t_end_ns


def _overlaps(part: BagPart, start_ns: int, end_ns: int) -> bool:
    if part.t_start_ns is None or part.t_end_ns is None:
        return part.messages != 0
    return part.t_start_ns < end_ns and part.t_end_ns >= start_ns


def _topics(choice: Choice, topics: set[str]) -> tuple[set[str], tuple[str, ...]]:
    """The topics to copy, and requested topics that the bag does not have. Raises SettingError for an invalid regex.

    A leading or trailing slash of a name is optional: other recorders have topics without one.
    """
    try:
        pattern = re.compile(choice.regex) if choice.regex else None
    except re.error as error:
        raise SettingError('--regex', choice.regex, f'a regular expression ({error})') from error
    if not choice.topics and pattern is None:
        return topics, ()
    named = {
        name: {name} & topics or {topic for topic in topics if topic.strip('/') == name.strip('/')} for name in choice.topics
    }
    matching = {topic for topic in topics if pattern is not None and pattern.search(topic)}
    return matching.union(*named.values()), tuple(name for name, found in named.items() if not found)


def _nothing(bag: Description, choice: Choice, absent: Sequence[str], start_ns: int, end_ns: int) -> BagError:
    """The error for a cut without messages; names the bag's topics or times."""
    topics = sorted({topic.name for topic in bag.topics})
    first_ns, last_ns = _span(bag)
    for name in absent:
        near = get_close_matches(name, topics, cutoff=0.6)
        return BagError(
            f'the bag has no topic {name}', remedy=f'did you mean {near[0]}?' if near else f'it has {", ".join(topics)}'
        )
    if choice.regex and not any(re.search(choice.regex, topic) for topic in topics):
        return BagError(f'no topic of the bag matches {choice.regex}', remedy=f'it has {", ".join(topics)}')
    text = f'no such message was recorded between {iso(start_ns)} and {iso(end_ns)}'
    if end_ns <= start_ns:
        text = f'nothing was recorded from {iso(start_ns)} on'
    return BagError(text, remedy=f'the bag is from {iso(first_ns)} to {iso(last_ns)}')


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A folder that is renamed to ``out`` on success and deleted otherwise."""
    if out.exists():
        raise BagError(f'{out} already exists', remedy='choose a new folder')
    check_name(out.name, 'the new bag', MAX_BAG_BYTES)
    part = out.with_name(out.name + UNFINISHED)
    with disk_errors(out):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            yield part
            shutil.rmtree(part / SOURCE, ignore_errors=True)
            os.replace(part, out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
