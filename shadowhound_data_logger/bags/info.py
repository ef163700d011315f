"""Everything about one bag except its messages, from a few short reads, even if its slices are in a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shadowhound_data_logger.bags.contents import describe_bag, open_folder
from shadowhound_data_logger.bags.description import Description, clock_state, describe_metadata
from shadowhound_data_logger.bags.local import UnsentFile, local_files
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA, natural_key
from shadowhound_data_logger.bags.remote import (
    FOREIGN,
    GROWING,
    RemoteBag,
    RemoteFile,
    find_bag,
    missing_of,
    state_of,
)
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import BagError
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Meter, Ranged, StoredFile, read_whole
from shadowhound_data_logger.stores.base import ObjectStore


@dataclass(frozen=True, slots=True)
class BagInfo:
    """The description of a bag."""

    robot: str
    """Empty for a bag in a folder."""
    bag: str
    state: str
    description: Description
    files: Mapping[str, tuple[int, str]]
    """Name -> size in bytes, and location."""
    manifest: Manifest | None
    missing: Sequence[str]
    """Slices that the manifest or the metadata names but that do not exist."""
    read_bytes: int
    """Bytes that were read."""

    @property
    def bytes(self) -> int:
        return sum(size for size, _ in self.files.values())


def info_of(store: ObjectStore, robot: str, name: str, home: Path) -> BagInfo:
    """Describe a bag in the store or still on this robot. Raises BagError, BagDamaged, StoreError, SpoolError."""
    waiting = {file.name: file for file in local_files(home, robot).values() if file.bag == name}
    try:
        bag = find_bag(store, robot, name)
    except BagError:
        if not waiting:
            raise
        bag = RemoteBag(robot, name, ())
    if bag.is_archive:
        raise BagError(f'{name} is an archive of {bag.size} bytes, which must be unpacked to see its contents',
                       remedy=f'shadowhound-data bag fetch {name} --to .')  # fmt: skip
    meter = Meter()
    sources: dict[str, Ranged] = {
        file.name: LocalFile(file.path, meter) for file in waiting.values() if file.path is not None and file.path.is_file()
    }
    sources |= {file.name: StoredFile(store, BUCKET, file.key, file.size, meter) for file in bag.files}
    where = {file.name: (file.size, file.where) for file in waiting.values()}
    where |= {file.name: (file.size, 'store') for file in bag.files}
    tags = _tags(store, bag, waiting)
    file = sources.get(MANIFEST)
    manifest = Manifest.from_json(read_whole(file), file.name) if file is not None else None
    file = sources.get(METADATA)
    claimed = describe_metadata(read_whole(file), file.name, sources) if file is not None else None
    description = describe_bag(sources, claimed, manifest)
    if description is None:
        remedy = 'check that it is a bag; if its recording has just started, try again later'
        raise BagError(f'{name} has neither {METADATA} nor a finished MCAP slice', remedy=remedy)
    if claimed is None:
        description = replace(description, clock=clock_state(tags))
    return _info(robot, name, where, manifest, description, meter, tags)


def info_folder(path: Path) -> BagInfo:
    """Describe a bag on the disk, or one of its files. Raises BagError, BagDamaged."""
    meter = Meter()
    bag = open_folder(path, meter)
    where = {name: (each.stat().st_size, 'folder') for name, each in bag.files.items()}
    return _info('', path.name, where, bag.manifest, bag.reader.describe(), meter, {})


def _info(robot: str, name: str, where: Mapping[str, tuple[int, str]], manifest: Manifest | None, description: Description,
          meter: Meter, tags: Mapping[str, str]) -> BagInfo:  # fmt: skip
    files = RemoteBag(robot, name, tuple(RemoteFile(each, '', where[each][0]) for each in sorted(where, key=natural_key)))
    state = GROWING if any(each.endswith('.open') for each in where) else state_of(files, manifest, tags)
    missing = missing_of(files, manifest) if manifest else description.absent
    return BagInfo(robot, name, state if robot or manifest else FOREIGN, description,
                   {file.name: where[file.name] for file in files.files}, manifest, missing, meter.bytes)  # fmt: skip


def _tags(store: ObjectStore, bag: RemoteBag, waiting: Mapping[str, UnsentFile]) -> Mapping[str, str]:
    """The object metadata of one slice, which identifies the writer of the bag and the clock of its times."""
    for file in waiting.values():
        return file.metadata or {meta.BAG: bag.name}
    is_described = bag.file(MANIFEST) and bag.file(METADATA)
    held = store.head(BUCKET, bag.slices[0].key) if bag.slices and not is_described else None
    return held.metadata if held else {}
