"""A piece of a bag as a new bag: a span of time and some of the topics, message by message as they were recorded.

Where the clock of the bag was not set, the times stay as they are, and metadata.yaml says of the piece what it says of the bag.

Of an MCAP slice in a store only the summary and the chunks that are needed are read. What is not plain MCAP (SQLite, or
compressed outside the storage) is downloaded first.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final, Protocol

from shadowhound_data_logger.bags.contents import Packed, Plain, is_plain
from shadowhound_data_logger.bags.description import BagPart, Description, of_metadata
from shadowhound_data_logger.bags.fetch import fetch, on_disk
from shadowhound_data_logger.bags.naming import BUCKET, METADATA
from shadowhound_data_logger.bags.remote import RemoteBag, clock_of, document, natural
from shadowhound_data_logger.clock import iso
from shadowhound_data_logger.errors import BagDamaged, BagError, SettingError
from shadowhound_data_logger.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.mcap.messages import MessageFilter, RecordedMessage
from shadowhound_data_logger.mcap.ranges import LocalFile, Meter, StoredFile, read_whole
from shadowhound_data_logger.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.mcap.slice_info import Channel
from shadowhound_data_logger.mcap.writer import SliceWriter
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.times import moment_in_bag

UNFINISHED: Final = '.part'
COMES: Final = 'it may not have arrived yet: shadowhound-data bag list'
SOURCE: Final = 'source'
"""Of what has to be downloaded whole."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What to cut out. Times as ``times.moment_in_bag`` takes them: from ``start``, before ``end``; empty for the bag's own."""

    start: str = ''
    end: str = ''
    topics: Sequence[str] = ()
    regex: str = ''
    """A topic that it is found in is taken as well; without both, all are."""
    spans: tuple[tuple[int, int], ...] | None = None
    """Only of these times, in ns since 1970: from the first to before the second, in their order, none meets the next."""


@dataclass(frozen=True, slots=True)
class Cut:
    """What a cut copied, and how much it read."""

    folder: Path
    messages: int
    topics: int
    bytes: int
    t_start_ns: int
    t_end_ns: int
    """Of the messages in it."""
    read_bytes: int
    read_requests: int
    bag_bytes: int
    absent: tuple[str, ...] = ()
    """Topics that were asked for and that the bag does not have."""
    missing: tuple[str, ...] = ()
    """Slices with something of that time that are not there."""


class CutSource(Protocol):
    """Where the messages come from."""

    def span(self) -> tuple[int, int]:
        """Log times of the first and the last message."""

    def topics(self) -> set[str]: ...

    def clock(self) -> Mapping[str, str]:
        """As ``Description.clock``."""

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]: ...


def cut_remote(store: ObjectStore, bag: RemoteBag, out: Path, choice: Choice) -> Cut:
    """Into the new folder ``out``. Raises BagError, BagDamaged, SettingError, StoreError."""
    if bag.is_archive:
        raise BagError(
            f'{bag.name} is an archive, which can only be read as a whole', remedy='fetch it, unpack it and cut the folder'
        )
    meter = Meter()
    file = bag.file(METADATA)
    told = of_metadata(document(store, file), file.key) if file else None
    with _new_folder(out) as folder:
        if is_plain(told, [each.name for each in bag.slices]):
            sources = [StoredFile(store, BUCKET, each.key, each.size, meter) for each in bag.slices]
            others = _others(told, [each.name for each in bag.slices])
            plain = Plain(sources, told, clock_of(store, bag) if told is None else {})
            return _cut(plain, folder, out, choice, meter, bag.size, others)
        fetched = fetch(store, bag, folder / SOURCE)
        meter.add(fetched.downloaded)
        return _cut(_packed(fetched.folder, told), folder, out, choice, meter, bag.size)


def cut_folder(folder: Path, out: Path, choice: Choice) -> Cut:
    """Of a bag on the disk. Raises BagError, BagDamaged, SettingError."""
    if folder.resolve() in out.absolute().resolve().parents:
        raise BagError(f'{out} is within the bag that is cut', remedy='choose a folder beside it')
    meter = Meter()
    names = sorted((path.name for path in folder.glob('*.*') if path.is_file()), key=natural)
    told = of_metadata(read_whole(LocalFile(folder / METADATA)), str(folder / METADATA)) if METADATA in names else None
    slices = [name for name in names if name.endswith('.mcap')]
    size = sum((folder / name).stat().st_size for name in names)
    with _new_folder(out) as new:
        if is_plain(told, slices):
            plain = Plain([LocalFile(folder / name, meter) for name in slices], told)
            return _cut(plain, new, out, choice, meter, size, _others(told, slices))
        return _cut(_packed(folder, told), new, out, choice, meter, size)


def _packed(folder: Path, told: Description | None) -> Packed:
    if told is None:
        raise BagDamaged(f'{folder} has neither {METADATA} nor MCAP slices alone', path=str(folder))
    return Packed(folder, told)


def _cut(source: CutSource, folder: Path, out: Path, choice: Choice, meter: Meter, bag_bytes: int,
         others: Sequence[BagPart] = ()) -> Cut:  # fmt: skip
    """``others`` are slices that are not there."""
    first_ns, last_ns = source.span()
    start_ns = moment_in_bag('--start', choice.start, first_ns, last_ns) if choice.start else first_ns
    end_ns = moment_in_bag('--end', choice.end, first_ns, last_ns) if choice.end else last_ns + 1
    if start_ns > last_ns and not choice.end:
        raise _nothing(source, choice, start_ns, start_ns)
    if end_ns <= start_ns:
        raise SettingError('--end', choice.end, f'a time after --start, which is {iso(start_ns)}')
    writer = SliceWriter(folder / f'{out.name}_0.mcap', mode=0o666)
    try:
        for first, last in ((start_ns, end_ns),) if choice.spans is None else choice.spans:
            if (begin := max(first, start_ns)) < (end := min(last, end_ns)):
                for message in source.messages(MessageFilter(begin, end, _chosen(choice))):
                    writer.write(message.channel, message.log_ns, message.publish_ns, message.sequence, message.cdr)
        info = writer.close()
    finally:
        writer.abort()
    missing = tuple(part.name for part in others if _overlaps(part, start_ns, end_ns))
    if not info.messages:
        if missing:
            raise BagError(f'what was recorded then is in {", ".join(missing)}, which is not there', remedy=COMES)
        raise _nothing(source, choice, start_ns, end_ns)
    (folder / METADATA).write_bytes(metadata_yaml([info], ros_distro='', custom_data=source.clock()))
    return Cut(out, info.messages, sum(count > 0 for count in info.counts.values()), info.bytes, info.t_start_ns, info.t_end_ns,
               meter.bytes, meter.requests, bag_bytes, _absent(source, choice), missing)  # fmt: skip


def _others(told: Description | None, there: Sequence[str]) -> list[BagPart]:
    """Slices that the metadata names beside those that are there."""
    return [part for part in told.parts if part.name not in there] if told is not None else []


def _overlaps(part: BagPart, start_ns: int, end_ns: int) -> bool:
    if part.t_start_ns is None or part.t_end_ns is None:
        return part.messages != 0
    return part.t_start_ns < end_ns and part.t_end_ns >= start_ns


def _absent(source: CutSource, choice: Choice) -> tuple[str, ...]:
    topics = source.topics() if choice.topics else set()
    return tuple(name for name in choice.topics if '/' + name.lstrip('/') not in topics)


def _chosen(choice: Choice) -> Callable[[Channel], bool]:
    """Raises SettingError for an invalid regular expression."""
    names = {'/' + name.lstrip('/') for name in choice.topics}
    try:
        pattern = re.compile(choice.regex) if choice.regex else None
    except re.error as error:
        raise SettingError('--regex', choice.regex, f'a regular expression ({error})') from error
    if not names and pattern is None:
        return lambda _: True
    return lambda channel: channel.topic in names or (pattern is not None and pattern.search(channel.topic) is not None)


def _nothing(source: CutSource, choice: Choice, start_ns: int, end_ns: int) -> BagError:
    """Says which topics there are, or which times."""
    topics = sorted(source.topics())
    first_ns, last_ns = source.span()
    for name in _absent(source, choice):
        near = get_close_matches(name, topics, cutoff=0.6)
        return BagError(f'the bag has no topic {name}', remedy=f'is it {near[0]}?' if near else f'it has {", ".join(topics)}')
    if choice.regex and not any(re.search(choice.regex, topic) for topic in topics):
        return BagError(f'no topic of the bag matches {choice.regex}', remedy=f'it has {", ".join(topics)}')
    text = f'nothing of that was recorded between {iso(start_ns)} and {iso(end_ns)}'
    if end_ns <= start_ns:
        text = f'nothing was recorded from {iso(start_ns)} on'
    return BagError(text, remedy=f'the bag goes from {iso(first_ns)} to {iso(last_ns)}')


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A folder that becomes ``out`` when all went well, and is gone otherwise."""
    if out.exists():
        raise BagError(f'{out} is there already', remedy='choose a new folder')
    check_name(out.name, 'the new bag', MAX_BAG_BYTES)
    part = out.with_name(out.name + UNFINISHED)
    with on_disk(out):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            yield part
            shutil.rmtree(part / SOURCE, ignore_errors=True)
            os.replace(part, out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
