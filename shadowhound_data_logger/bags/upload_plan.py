"""A finished bag in a folder as the objects that it becomes: its files as they are and a manifest, or one archive.

SQLite or MCAP, split or compressed: whatever has rosbag2's metadata.yaml. A bag that is still being written is refused.
"""

from __future__ import annotations

import gzip
import re
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Final, cast

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.bags.description import BagPart, Description, of_metadata, slice_info
from shadowhound_data_logger.bags.manifest import COMPLETE, Manifest, RecordedTopic, SliceEntry
from shadowhound_data_logger.bags.naming import MANIFEST, METADATA, prefix_of
from shadowhound_data_logger.bags.remote import ARCHIVE, natural
from shadowhound_data_logger.durable_files import fingerprint
from shadowhound_data_logger.errors import BagDamaged, BagError
from shadowhound_data_logger.keys import MAX_BAG_BYTES, check_key, check_name
from shadowhound_data_logger.mcap.index import read_index
from shadowhound_data_logger.mcap.ranges import LocalFile

CONTENT_TYPES: Final = {'.yaml': 'application/yaml', '.json': 'application/json', '.gz': 'application/gzip'}
_NUMBER: Final = re.compile(r'_(\d+)\.', re.ASCII)
_UNFINISHED: Final = ('-wal', '-journal', '.open', '.part', '.tmp')
"""What the names of files end with that somebody is still writing."""


@dataclass(frozen=True, slots=True)
class Outgoing:
    """One file and the object that it becomes."""

    name: str
    key: str
    path: Path
    size: int
    sha256: str
    metadata: Mapping[str, str] = field(default_factory=dict)
    t_start_ns: int = 0
    t_end_ns: int = 0

    @property
    def content_type(self) -> str:
        return CONTENT_TYPES.get(self.path.suffix, 'application/octet-stream')


@dataclass(frozen=True, slots=True)
class UploadPlan:
    """A bag on its way; the manifest is the last of its files."""

    robot: str
    bag: str
    folder: Path
    files: tuple[Outgoing, ...]

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)


def finished(folder: Path) -> Description:
    """What a finished bag holds. Raises BagError saying why it is none."""
    if not folder.is_dir():
        raise BagError(f'{folder} is not a folder', remedy='name the folder that ros2 bag record -o made', path=str(folder))
    names = {path.name: path for path in folder.iterdir()}
    if METADATA not in names:
        remedy = 'ros2 bag record writes it when it ends; after a crash, `ros2 bag reindex` makes it'
        raise BagError(f'{folder} is not a finished bag: it has no {METADATA}', remedy=remedy, path=str(folder))
    for name, path in names.items():
        if name.endswith(_UNFINISHED) and path.stat().st_size:
            raise BagError(f'{folder} is not finished: {name} is there', remedy='does somebody record into it?', path=str(folder))
    inside = folder.resolve()
    for path in folder.rglob('*'):
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            remedy = 'put the file itself there'
            raise BagError(f'{path} is a link out of the bag', remedy=remedy, path=str(path))
    described = of_metadata(names[METADATA].read_bytes(), str(names[METADATA]))
    for part in described.parts:
        if part.name not in names:
            raise BagError(f'{folder} is not whole: {part.name}, which {METADATA} names, is missing', path=str(folder))
        if part.name.endswith('.mcap'):
            read_index(LocalFile(names[part.name]))
    return described


def plan_of(folder: Path, robot: str, bag: str, work: Path) -> UploadPlan:
    """Its files as they are; the manifest is made in the folder ``work``. Raises BagError, BagDamaged, NameRefused, OSError."""
    described = finished(folder)
    check_name(bag, 'the bag', MAX_BAG_BYTES)
    parts = {part.name: part for part in described.parts}
    paths = sorted((path for path in folder.rglob('*') if path.is_file()), key=lambda path: natural(str(path)))
    files = [_outgoing(path, str(path.relative_to(folder)), robot, bag) for path in paths if path != folder / MANIFEST]
    files = [_marked(file, parts.get(file.name), robot, bag) for file in files]
    manifest = _manifest(files, described, robot, bag, folder)
    made = work / MANIFEST
    made.write_bytes(manifest.to_json())
    files.append(replace(_outgoing(made, MANIFEST, robot, bag), t_start_ns=described.t_start_ns, t_end_ns=described.t_end_ns))
    return UploadPlan(robot, bag, folder, tuple(files))


def archive_of(folder: Path, robot: str, bag: str, work: Path) -> UploadPlan:
    """One ``<bag>.tar.gz`` with the bag's folder in it, made in ``work``; the same bag gives the same bytes."""
    described = finished(folder)
    name = f'{check_name(bag, "the bag", MAX_BAG_BYTES)}{ARCHIVE}'
    path = work / name
    with (
        path.open('wb') as raw,
        gzip.GzipFile('', 'wb', compresslevel=1, fileobj=raw, mtime=0) as packed,
        tarfile.open(fileobj=cast('IO[bytes]', packed), mode='w') as archive,
    ):
        for file in sorted(each for each in folder.rglob('*') if each.is_file()):
            archive.add(file, f'{bag}/{file.relative_to(folder)}', recursive=False, filter=_nobodys)
    key = check_key(f'{prefix_of(robot)}{name}')
    metadata = {words.ROBOT: robot, words.BAG: bag, words.MESSAGES: str(described.messages)}
    item = Outgoing(name, key, path, *fingerprint(path), metadata, described.t_start_ns, described.t_end_ns)
    return UploadPlan(robot, bag, folder, (item,))


def _nobodys(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.uid = member.gid = 0
    member.uname = member.gname = ''
    return member


def _outgoing(path: Path, name: str, robot: str, bag: str) -> Outgoing:
    key = check_key(f'{prefix_of(robot, bag)}{name}')
    return Outgoing(name, key, path, *fingerprint(path), {words.ROBOT: robot, words.BAG: bag})


def _marked(file: Outgoing, part: BagPart | None, robot: str, bag: str) -> Outgoing:
    """With what can be told of a slice without opening it."""
    if part is None or part.messages is None:
        return file
    number = _NUMBER.search(file.name)
    start_ns, end_ns = part.t_start_ns or 0, part.t_end_ns or 0
    told = {words.MESSAGES: part.messages, words.T_START_NS: start_ns, words.T_END_NS: end_ns}
    told |= {words.SLICE: int(number[1])} if number else {}
    metadata = {words.ROBOT: robot, words.BAG: bag, **{name: str(value) for name, value in told.items()}}
    return replace(file, metadata=metadata, t_start_ns=start_ns, t_end_ns=end_ns)


def _manifest(files: list[Outgoing], described: Description, robot: str, bag: str, folder: Path) -> Manifest:
    """What the bag's own says of mission and gaps stays."""
    earlier = _earlier(folder / MANIFEST)
    names = {part.name for part in described.parts}
    topics = tuple(RecordedTopic(topic.name, topic.type, topic.messages) for topic in described.topics)
    entries = tuple(_entries([file for file in files if file.name in names], described))
    if earlier is None:
        return Manifest(bag, robot, None, COMPLETE, (), topics, entries)
    return replace(earlier, bag=bag, robot=robot, topics=topics, slices=entries)


def _earlier(path: Path) -> Manifest | None:
    try:
        return Manifest.from_json(path.read_bytes(), str(path))
    except (FileNotFoundError, BagDamaged):
        return None


def _entries(files: list[Outgoing], described: Description) -> Iterator[SliceEntry]:
    """``counts`` are those of the slice where it tells them, or where it is the only one."""
    for file in files:
        counts, repeated = {topic.name: topic.messages for topic in described.topics} if len(files) == 1 else {}, dict[str, int]()
        messages = int(file.metadata.get(words.MESSAGES, sum(counts.values())))
        t_start_ns, t_end_ns = file.t_start_ns or described.t_start_ns, file.t_end_ns or described.t_end_ns
        if file.name.endswith('.mcap'):
            index = read_index(LocalFile(file.path))
            if index.is_indexed:
                info = slice_info(index, file.path, file.size)
                counts, messages, t_start_ns, t_end_ns = dict(info.counts), info.messages, info.t_start_ns, info.t_end_ns
                repeated = dict(info.repeated)
        yield SliceEntry(file.name, file.key, file.size, file.sha256, messages, t_start_ns, t_end_ns, counts, repeated)
