"""Bags in a store: their files, and whether they are complete.

A bag is a folder ``<robot>/rosbags/<bag>/`` of slices; its ``manifest.json`` is written last, so a bag without one is still
growing. An archive ``<robot>/rosbags/<bag>.tar.gz`` is also a bag, but only its size is known.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.bags.description import clock_state
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA, SLICES, natural_key, prefix_of
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import UnknownBag
from shadowhound_data_logger.formats.mcap.ranges import StoredFile, read_whole
from shadowhound_data_logger.stores.base import ObjectStore

ARCHIVE: Final = '.tar.gz'
GROWING: Final = 'growing'
FOREIGN: Final = 'foreign'
"""Not uploaded by this package: the expected contents are unknown."""


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """One object of a bag."""

    name: str
    """Path in the bag's folder."""
    key: str
    size: int

    @property
    def is_slice(self) -> bool:
        return self.name.endswith(SLICES)


@dataclass(frozen=True, slots=True)
class RemoteBag:
    """A bag according to a listing of its store."""

    robot: str
    name: str
    files: tuple[RemoteFile, ...]
    """In natural order."""

    @property
    def is_archive(self) -> bool:
        return self.name.endswith(ARCHIVE)

    @property
    def slices(self) -> tuple[RemoteFile, ...]:
        return tuple(file for file in self.files if file.is_slice)

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)

    def file(self, name: str) -> RemoteFile | None:
        return next((file for file in self.files if file.name == name), None)


def find_bags(store: ObjectStore, robot: str) -> list[RemoteBag]:
    """All bags of a robot, by name. Raises StoreError."""
    found: dict[str, list[RemoteFile]] = {}
    prefix = prefix_of(robot)
    for info in store.list(BUCKET, prefix):
        bag, slash, name = info.key[len(prefix) :].partition('/')
        if not slash and not bag.endswith(ARCHIVE):
            continue
        found.setdefault(bag, []).append(RemoteFile(name or bag, info.key, info.size))
    return [RemoteBag(robot, bag, _ordered(files)) for bag, files in sorted(found.items())]


def find_bag(store: ObjectStore, robot: str, bag: str) -> RemoteBag:
    """One bag. Raises UnknownBag, which names similar bags, and StoreError."""
    prefix = prefix_of(robot, bag)
    if bag.endswith(ARCHIVE):
        held = store.head(BUCKET, prefix[:-1])
        files = [RemoteFile(bag, held.key, held.size)] if held else []
    else:
        files = [RemoteFile(info.key[len(prefix) :], info.key, info.size) for info in store.list(BUCKET, prefix)]
    if not files:
        known = [each.name for each in find_bags(store, robot)]
        near = difflib.get_close_matches(bag, known, cutoff=0.4) or known[-3:]
        there = f'the store has {", ".join(near)}' if near else f'the store has no bag of {robot}; --robot names another robot'
        raise UnknownBag(f'there is no bag {bag} of {robot} in {store.describe()}', remedy=there, bag=bag, robot=robot)
    return RemoteBag(robot, bag, _ordered(files))


def read_manifest(store: ObjectStore, bag: RemoteBag) -> Manifest | None:
    """The manifest, or None. Raises BagDamaged if it is invalid, StoreError."""
    file = bag.file(MANIFEST)
    return Manifest.from_json(document(store, file), file.key) if file else None


def document(store: ObjectStore, file: RemoteFile) -> bytes:
    """The content of a manifest or metadata.yaml. Raises BagDamaged if it is too large for one, StoreError."""
    return read_whole(StoredFile(store, BUCKET, file.key, file.size))


def clock_of(store: ObjectStore, bag: RemoteBag) -> dict[str, str]:
    """``Description.clock`` from the object metadata of the first slice, for a bag without metadata.yaml. Raises StoreError."""
    held = store.head(BUCKET, bag.slices[0].key) if bag.slices else None
    return clock_state(held.metadata) if held is not None else {}


def missing_of(bag: RemoteBag, manifest: Manifest) -> list[str]:
    """Slices in the manifest that the bag does not have."""
    there = {file.name for file in bag.files}
    return [entry.file for entry in manifest.slices if entry.file not in there]


def state_of(bag: RemoteBag, manifest: Manifest | None, slice_metadata: Mapping[str, str]) -> str:
    """The state; ``slice_metadata`` is the object metadata of any slice, needed only without a manifest."""
    if manifest is not None:
        return GROWING if missing_of(bag, manifest) else manifest.state
    return GROWING if meta.BAG in slice_metadata and not bag.file(METADATA) else FOREIGN


def _ordered(files: Iterable[RemoteFile]) -> tuple[RemoteFile, ...]:
    return tuple(sorted(files, key=lambda file: natural_key(file.name)))
