"""Everything about one bag except its messages: from a few short reads, also where its slices are in a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shadowhound_data_logger.bags.contents import described, open_folder
from shadowhound_data_logger.bags.description import Description, clock_state, of_metadata
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
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.errors import BagError
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Meter, Ranged, StoredFile, read_whole
from shadowhound_data_logger.stores.base import ObjectStore


@dataclass(frozen=True, slots=True)
class BagInfo:
    """A bag, described."""

    robot: str
    """Empty of a folder."""
    bag: str
    state: str
    description: Description
    files: Mapping[str, tuple[int, str]]
    """Name -> bytes, and where it is."""
    manifest: Manifest | None
    missing: Sequence[str]
    """Slices that the manifest or the metadata names and that are nowhere."""
    read_bytes: int
    """So many were enough."""

    @property
    def bytes(self) -> int:
        return sum(size for size, _ in self.files.values())


def info_of(store: ObjectStore, robot: str, name: str, home: Path) -> BagInfo:
    """Of a bag in the store or still on this robot. Raises BagError, BagDamaged, StoreError, SpoolError."""
    waiting = {file.name: file for file in local_files(home, robot).values() if file.bag == name}
    try:
        bag = find_bag(store, robot, name)
    except BagError:
        if not waiting:
            raise
        bag = RemoteBag(robot, name, ())
    if bag.is_archive:
        raise BagError(f'{name} is an archive of {bag.size} bytes; what is in it shows when it is unpacked',
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
    claimed = of_metadata(read_whole(file), file.name, sources) if file is not None else None
    description = described(sources, claimed, manifest)
    if description is None:
        raise BagError(f'{name} has neither {METADATA} nor a finished MCAP slice', remedy='is it a bag, or only starting?')
    if claimed is None:
        description = replace(description, clock=clock_state(tags))
    return _info(robot, name, where, manifest, description, meter, tags)


def info_folder(path: Path) -> BagInfo:
    """Of a bag on the disk, or of one of its files. Raises BagError, BagDamaged."""
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
    """What was written beside one slice: enough to tell whose it is, and by which clock its times are."""
    for file in waiting.values():
        return file.metadata or {words.BAG: bag.name}
    is_told = bag.file(MANIFEST) and bag.file(METADATA)
    held = store.head(BUCKET, bag.slices[0].key) if bag.slices and not is_told else None
    return held.metadata if held else {}
