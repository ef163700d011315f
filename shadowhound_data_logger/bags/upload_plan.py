"""Plans the objects of a finished bag in a folder: its unchanged files and a manifest, or one archive.

Accepts every bag with rosbag2's metadata.yaml: SQLite or MCAP, split or compressed. Rejects a bag that is still being written.
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

from shadowhound_data_logger.bags.contents import files_of, not_a_bag, open_folder
from shadowhound_data_logger.bags.description import Description
from shadowhound_data_logger.bags.manifest import COMPLETE, GAPS, Manifest, Missing, RecordedTopic, SliceEntry
from shadowhound_data_logger.bags.naming import MANIFEST, METADATA, UNSAFE, prefix_of
from shadowhound_data_logger.bags.remote import ARCHIVE
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, MAX_SEGMENT_BYTES, check_key, check_name, is_segment, unique
from shadowhound_data_logger.core.untrusted import from_yaml
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo

CONTENT_TYPES: Final = {'.yaml': 'application/yaml', '.json': 'application/json', '.gz': 'application/gzip'}
_NUMBER: Final = re.compile(r'_(\d+)\.', re.ASCII)
_UNFINISHED: Final = ('-wal', '-journal', '.open', '.part', '.tmp')
"""Suffixes of files that are still being written."""


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file and its object."""

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
    """The files of a bag to upload; the manifest is the last one."""

    robot: str
    bag: str
    folder: Path
    files: tuple[PlannedFile, ...]
    remarks: tuple[str, ...] = ()
    """Contradictions between metadata.yaml and the files; the manifest describes the files."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Unreadable files, which are uploaded anyway, and why."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Files whose names are invalid in a key -> their names in the store and in its metadata.yaml."""

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)


@dataclass(frozen=True, slots=True)
class FinishedBag:
    """A bag whose recording has ended."""

    folder: Path
    description: Description
    infos: Mapping[str, SliceInfo]
    """The contents of its readable files."""


def read_finished(folder: Path) -> FinishedBag:
    """Read all summaries. Raises BagError if it is not a finished bag, BagDamaged if no file is readable."""
    if not folder.is_dir():
        remedy = 'name the folder that `ros2 bag record -o` made'
        raise BagError(f'{folder} is not a folder', remedy=remedy, path=str(folder))
    names = {path.name: path for path in folder.iterdir()}
    if METADATA not in names:
        remedy = 'ros2 bag record writes it when it ends; after a crash, `shadowhound-data bag repair --in-place` makes it'
        raise BagError(f'{folder} is not a finished bag: it has no {METADATA}', remedy=remedy, path=str(folder))
    for name, path in names.items():
        if name.endswith(_UNFINISHED) and path.stat().st_size:
            remedy = 'wait until its recorder has stopped'
            raise BagError(f'{folder} is not finished: it has {name}', remedy=remedy, path=str(folder))
    inside = folder.resolve()
    for path in folder.rglob('*'):
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            remedy = 'replace the link with the file'
            raise BagError(f'{path} is a link to a file outside the bag', remedy=remedy, path=str(path))
    reader = open_folder(folder).reader
    description = reader.describe()
    if not description.parts:
        raise not_a_bag(folder)
    if description.absent:
        text = f'{folder} is not complete: {", ".join(description.absent)}, which {METADATA} names, is missing'
        raise BagError(text, path=str(folder), remedy=f'add it, or remove its name from {METADATA}')
    return FinishedBag(folder, description, reader.infos())


def plan_of(found: FinishedBag, robot: str, bag: str, work: Path) -> UploadPlan:
    """A plan with the unchanged files; writes the manifest to ``work``. Raises BagError, BagDamaged, NameRefused, OSError."""
    folder, description = found.folder, found.description
    check_name(bag, 'the bag', MAX_BAG_BYTES)
    paths = {name: path for name, path in files_of(folder).items() if name != MANIFEST}
    names = _stored_names(list(paths))
    renamed = {name: stored for name, stored in names.items() if name != stored}
    if renamed.keys() & found.infos.keys():
        paths[METADATA] = _renamed_metadata(paths[METADATA], renamed, work)
    infos = {names[name]: info for name, info in found.infos.items()}
    files = [
        _with_metadata(_outgoing(path, names[name], robot, bag), infos.get(names[name]), robot, bag)
        for name, path in paths.items()
    ]
    manifest = _manifest(files, replace(found, infos=infos), robot, bag)
    made = work / MANIFEST
    made.write_bytes(manifest.to_json())
    start_ns, end_ns = _index_time(description.t_start_ns), _index_time(description.t_end_ns)
    files.append(replace(_outgoing(made, MANIFEST, robot, bag), t_start_ns=start_ns, t_end_ns=end_ns))
    return UploadPlan(robot, bag, folder, tuple(files), description.remarks, description.damaged, renamed)


def _safe_name(name: str) -> str:
    """A name that is valid in a key, changed as little as possible; the middle of a long name is removed."""
    if is_segment(name):
        return name
    found = UNSAFE.sub('_', name)
    half = MAX_SEGMENT_BYTES // 2
    return found if len(found) <= MAX_SEGMENT_BYTES else found[:half] + found[-half:]


def _stored_names(names: Sequence[str]) -> dict[str, str]:
    """The name of each file in the store: its own, or a similar one that is valid in a key and unique in the bag."""
    stored = {name: '/'.join(map(_safe_name, name.split('/'))) for name in names}
    taken = {name for name in names if stored[name] == name} | {MANIFEST}
    for name in names:
        if stored[name] != name:
            stored[name] = next(each for each in (unique(stored[name], attempt) for attempt in count()) if each not in taken)
            taken.add(stored[name])
    return stored


def _renamed_metadata(path: Path, renamed: Mapping[str, str], work: Path) -> Path:
    """A metadata.yaml with the names of the files in the store, written to ``work``."""
    document = from_yaml(path.read_text(encoding='utf-8'))
    bag = document['rosbag2_bagfile_information']

    def stored(name: str) -> str:
        return renamed.get(name) or renamed.get(PurePosixPath(name).name) or name

    bag['relative_file_paths'] = [stored(each) for each in bag['relative_file_paths']]
    bag['files'] = [{**each, 'path': stored(each['path'])} for each in bag.get('files') or ()]
    made = work / METADATA
    made.write_text(to_yaml(document), encoding='utf-8')
    return made


def archive_of(found: FinishedBag, robot: str, bag: str, work: Path) -> UploadPlan:
    """A plan with one ``<bag>.tar.gz`` of the bag's folder, written to ``work``; the same bag gives the same bytes."""
    folder, description = found.folder, found.description
    name = f'{check_name(bag, "the bag", MAX_BAG_BYTES)}{ARCHIVE}'
    path = work / name
    with (
        path.open('wb') as raw,
        gzip.GzipFile('', 'wb', compresslevel=1, fileobj=raw, mtime=0) as packed,
        tarfile.open(fileobj=cast('IO[bytes]', packed), mode='w') as archive,
    ):
        for file in sorted(each for each in folder.rglob('*') if each.is_file()):
            archive.add(file, f'{bag}/{file.relative_to(folder)}', recursive=False, filter=_anonymous)
    key = check_key(f'{prefix_of(robot)}{name}')
    metadata = {meta.ROBOT: robot, meta.BAG: bag, meta.MESSAGES: str(description.messages)}
    item = PlannedFile(
        name, key, path, *fingerprint(path), metadata, _index_time(description.t_start_ns), _index_time(description.t_end_ns)
    )
    return UploadPlan(robot, bag, folder, (item,), description.remarks, description.damaged)


def _anonymous(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.uid = member.gid = 0
    member.uname = member.gname = ''
    return member


def _outgoing(path: Path, name: str, robot: str, bag: str) -> PlannedFile:
    key = check_key(f'{prefix_of(robot, bag)}{name}')
    return PlannedFile(name, key, path, *fingerprint(path), {meta.ROBOT: robot, meta.BAG: bag})


def _with_metadata(file: PlannedFile, info: SliceInfo | None, robot: str, bag: str) -> PlannedFile:
    """The file with the object metadata that describes a slice."""
    if info is None:
        return file
    number = _NUMBER.search(file.name)
    facts = {meta.MESSAGES: info.messages, meta.T_START_NS: info.t_start_ns, meta.T_END_NS: info.t_end_ns}
    facts |= {meta.SLICE: int(number[1])} if number else {}
    metadata = {meta.ROBOT: robot, meta.BAG: bag, **{name: str(value) for name, value in facts.items()}}
    return replace(file, metadata=metadata, t_start_ns=_index_time(info.t_start_ns), t_end_ns=_index_time(info.t_end_ns))


def _index_time(time_ns: int | None) -> int:
    """The time for the spool's index, which stores 63 bits; 0 if it does not fit or is unknown."""
    return time_ns if time_ns is not None and time_ns < 1 << 63 else 0


def _manifest(files: list[PlannedFile], found: FinishedBag, robot: str, bag: str) -> Manifest:
    """A manifest of the files; mission and gaps are copied from the bag's own manifest."""
    earlier = _read_own_manifest(found.folder / MANIFEST)
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


def _read_own_manifest(path: Path) -> Manifest | None:
    try:
        return Manifest.from_json(path.read_bytes(), str(path))
    except (FileNotFoundError, BagDamaged):
        return None
