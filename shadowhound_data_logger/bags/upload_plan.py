"""A finished bag in a folder as the objects that it becomes: its files as they are and a manifest, or one archive.

SQLite or MCAP, split or compressed: whatever has rosbag2's metadata.yaml. A bag that is still being written is refused.
"""

from __future__ import annotations

import gzip
import re
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path, PurePosixPath
from typing import IO, Final, cast

from shadowhound_data_logger.bags.contents import files_of, no_bag, open_folder
from shadowhound_data_logger.bags.description import Description
from shadowhound_data_logger.bags.manifest import COMPLETE, GAPS, Manifest, Missing, RecordedTopic, SliceEntry
from shadowhound_data_logger.bags.naming import MANIFEST, METADATA, UNSAFE, prefix_of
from shadowhound_data_logger.bags.remote import ARCHIVE
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, MAX_SEGMENT_BYTES, check_key, check_name, is_segment, unique
from shadowhound_data_logger.core.untrusted import from_yaml
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo

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
    remarks: tuple[str, ...] = ()
    """Where metadata.yaml contradicts the files; the manifest has what these hold."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Files that are uploaded although they cannot be read, and why."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Files whose name cannot be part of a key, and the name that they have in the store, also in its metadata.yaml."""

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)


@dataclass(frozen=True, slots=True)
class FinishedBag:
    """A bag whose recording has ended."""

    folder: Path
    description: Description
    infos: Mapping[str, SliceInfo]
    """What its files hold, of those that can be read."""


def finished(folder: Path) -> FinishedBag:
    """Reads all summaries. Raises BagError saying why it is not a finished bag, BagDamaged where no file can be read."""
    if not folder.is_dir():
        remedy = 'name the folder that `ros2 bag record -o` made'
        raise BagError(f'{folder} is not a folder', remedy=remedy, path=str(folder))
    names = {path.name: path for path in folder.iterdir()}
    if METADATA not in names:
        remedy = 'ros2 bag record writes it when it ends; after a crash, `shadowhound-data bag repair --in-place` makes it'
        raise BagError(f'{folder} is not a finished bag: it has no {METADATA}', remedy=remedy, path=str(folder))
    for name, path in names.items():
        if name.endswith(_UNFINISHED) and path.stat().st_size:
            remedy = 'is it still being recorded?'
            raise BagError(f'{folder} is not finished: {name} is there', remedy=remedy, path=str(folder))
    inside = folder.resolve()
    for path in folder.rglob('*'):
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            remedy = 'put the file itself there'
            raise BagError(f'{path} is a link out of the bag', remedy=remedy, path=str(path))
    reader = open_folder(folder).reader
    described = reader.describe()
    if not described.parts:
        raise no_bag(folder)
    if described.absent:
        text = f'{folder} is not complete: {", ".join(described.absent)}, which {METADATA} names, is missing'
        raise BagError(text, path=str(folder), remedy=f'put it there, or take its name out of {METADATA}')
    return FinishedBag(folder, described, reader.infos())


def plan_of(found: FinishedBag, robot: str, bag: str, work: Path) -> UploadPlan:
    """Its files as they are; the manifest is made in the folder ``work``. Raises BagError, BagDamaged, NameRefused, OSError."""
    folder, described = found.folder, found.description
    check_name(bag, 'the bag', MAX_BAG_BYTES)
    paths = {name: path for name, path in files_of(folder).items() if name != MANIFEST}
    names = _stored_names(list(paths))
    renamed = {name: stored for name, stored in names.items() if name != stored}
    if renamed.keys() & found.infos.keys():
        paths[METADATA] = _renamed_metadata(paths[METADATA], renamed, work)
    infos = {names[name]: info for name, info in found.infos.items()}
    files = [
        _marked(_outgoing(path, names[name], robot, bag), infos.get(names[name]), robot, bag) for name, path in paths.items()
    ]
    manifest = _manifest(files, replace(found, infos=infos), robot, bag)
    made = work / MANIFEST
    made.write_bytes(manifest.to_json())
    start_ns, end_ns = _kept(described.t_start_ns), _kept(described.t_end_ns)
    files.append(replace(_outgoing(made, MANIFEST, robot, bag), t_start_ns=start_ns, t_end_ns=end_ns))
    return UploadPlan(robot, bag, folder, tuple(files), described.remarks, described.damaged, renamed)


def _safe(name: str) -> str:
    """The nearest name that can be part of a key; of a long name, the middle is removed."""
    if is_segment(name):
        return name
    found = UNSAFE.sub('_', name)
    half = MAX_SEGMENT_BYTES // 2
    return found if len(found) <= MAX_SEGMENT_BYTES else found[:half] + found[-half:]


def _stored_names(names: Sequence[str]) -> dict[str, str]:
    """Each file's own name, or the nearest one that can be part of a key and that no other file of the bag has."""
    stored = {name: '/'.join(map(_safe, name.split('/'))) for name in names}
    taken = {name for name in names if stored[name] == name} | {MANIFEST}
    for name in names:
        if stored[name] != name:
            stored[name] = next(each for each in (unique(stored[name], attempt) for attempt in count()) if each not in taken)
            taken.add(stored[name])
    return stored


def _renamed_metadata(path: Path, renamed: Mapping[str, str], work: Path) -> Path:
    """A metadata.yaml that names the files as they are in the store, made in ``work``."""
    told = from_yaml(path.read_text(encoding='utf-8'))
    bag = told['rosbag2_bagfile_information']

    def stored(name: str) -> str:
        return renamed.get(name) or renamed.get(PurePosixPath(name).name) or name

    bag['relative_file_paths'] = [stored(each) for each in bag['relative_file_paths']]
    bag['files'] = [{**each, 'path': stored(each['path'])} for each in bag.get('files') or ()]
    made = work / METADATA
    made.write_text(to_yaml(told), encoding='utf-8')
    return made


def archive_of(found: FinishedBag, robot: str, bag: str, work: Path) -> UploadPlan:
    """One ``<bag>.tar.gz`` with the bag's folder in it, made in ``work``; the same bag gives the same bytes."""
    folder, described = found.folder, found.description
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
    item = Outgoing(name, key, path, *fingerprint(path), metadata, _kept(described.t_start_ns), _kept(described.t_end_ns))
    return UploadPlan(robot, bag, folder, (item,), described.remarks, described.damaged)


def _nobodys(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.uid = member.gid = 0
    member.uname = member.gname = ''
    return member


def _outgoing(path: Path, name: str, robot: str, bag: str) -> Outgoing:
    key = check_key(f'{prefix_of(robot, bag)}{name}')
    return Outgoing(name, key, path, *fingerprint(path), {words.ROBOT: robot, words.BAG: bag})


def _marked(file: Outgoing, info: SliceInfo | None, robot: str, bag: str) -> Outgoing:
    """With what is shown of a slice without opening it."""
    if info is None:
        return file
    number = _NUMBER.search(file.name)
    told = {words.MESSAGES: info.messages, words.T_START_NS: info.t_start_ns, words.T_END_NS: info.t_end_ns}
    told |= {words.SLICE: int(number[1])} if number else {}
    metadata = {words.ROBOT: robot, words.BAG: bag, **{name: str(value) for name, value in told.items()}}
    return replace(file, metadata=metadata, t_start_ns=_kept(info.t_start_ns), t_end_ns=_kept(info.t_end_ns))


def _kept(time_ns: int | None) -> int:
    """For the index of the spool, which has 63 bits for a time: 0 for a time that does not fit or is unknown."""
    return time_ns if time_ns is not None and time_ns < 1 << 63 else 0


def _manifest(files: list[Outgoing], found: FinishedBag, robot: str, bag: str) -> Manifest:
    """By what the files hold; what the bag's own manifest has of the mission and of gaps is kept."""
    earlier = _earlier(found.folder / MANIFEST)
    topics = tuple(RecordedTopic(topic.name, topic.type, topic.messages or 0) for topic in found.description.topics)
    entries = tuple(
        replace(SliceEntry.of(info, file.key), file=file.name, bytes=file.size, sha256=file.sha256)
        for file in files if (info := found.infos.get(file.name)) is not None
    )  # fmt: skip
    damaged = tuple(Missing(name, why, None) for name, why in found.description.damaged.items())
    if earlier is None:
        return Manifest(bag, robot, None, GAPS if damaged else COMPLETE, damaged, topics, entries)
    return replace(earlier, bag=bag, robot=robot, topics=topics, slices=entries, missing=(*earlier.missing, *damaged),
                   state=GAPS if damaged and earlier.state == COMPLETE else earlier.state)  # fmt: skip


def _earlier(path: Path) -> Manifest | None:
    try:
        return Manifest.from_json(path.read_bytes(), str(path))
    except (FileNotFoundError, BagDamaged):
        return None
