"""Checks whether a bag is what its writer recorded: every promised file, its size and checksum; every chunk on request.

Without a manifest there is nothing to compare the content with: the files that metadata.yaml names must exist and be readable.
Where it contradicts them about the bag as a whole, that is a remark.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from hashlib import sha256 as sha256_new
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import files_of, no_bag, opened, reason, slices_of
from shadowhound_data_logger.bags.description import Description, of_files, of_metadata
from shadowhound_data_logger.bags.manifest import Manifest, Missing
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, MCAP, METADATA, SLICES
from shadowhound_data_logger.bags.remote import FOREIGN, RemoteBag, RemoteFile, document, state_of
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import is_path
from shadowhound_data_logger.formats.mcap.index import DATA_END_BYTES, McapIndex, check_crcs, read_end, read_summary, scan
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Meter, Ranged, StoredFile, read_whole
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.verify import CHECKSUM, SIZE, compare

THREADS: Final = 4
PIECE_BYTES: Final = 8 << 20


@dataclass(frozen=True, slots=True)
class FileCheck:
    """One file; ``finding`` is empty when it is sound."""

    name: str
    finding: str
    checked: str
    """What was compared: ``presence``, ``size``, ``sha256`` (the store's word), ``summary``, ``content``, with it ``chunks``."""
    info: SliceInfo | None = field(default=None, repr=False)
    """What the file holds, if it was opened."""


@dataclass(frozen=True, slots=True)
class VerifiedBag:
    """What a verification found."""

    bag: str
    state: str
    checks: tuple[FileCheck, ...]
    read_bytes: int
    missing: tuple[Missing, ...]
    """What the manifest says that the recording could not get in: no finding, since the bag is as it was recorded."""
    remarks: tuple[str, ...] = ()
    """Where metadata.yaml contradicts the files, all of which are sound."""

    @property
    def findings(self) -> tuple[FileCheck, ...]:
        return tuple(check for check in self.checks if check.finding)

    @property
    def is_intact(self) -> bool:
        return not self.findings


Telling = Callable[[int], None]
"""Hears how many more bytes were read."""


@dataclass(frozen=True, slots=True)
class _Expected:
    """What a file should be; None where nobody says."""

    name: str
    size: int | None
    sha256: str | None
    messages: int | None


def verify_remote(store: ObjectStore, bag: RemoteBag, *, deep: bool = False, told: Telling = lambda _: None) -> VerifiedBag:
    """``deep`` reads everything; else what the store says of each file is compared. Raises StoreError."""
    meter = Meter()
    names = [file.name for file in bag.files]
    manifest, described, early = _writers_word(lambda name: _stored(store, bag, name), names)
    expected = _expected(manifest, described, names)

    def one(each: _Expected) -> FileCheck:
        file = bag.file(each.name)
        if file is None:
            return FileCheck(each.name, 'is not in the store', 'presence')
        return _check_remote(store, file, each, meter, deep, told)

    with ThreadPoolExecutor(THREADS, 'bag-verify') as pool:
        checks = (*early, *pool.map(one, expected))
    tags = {} if manifest or described else _tags(store, bag)
    state = state_of(bag, manifest, tags)
    return VerifiedBag(bag.name, state, checks, meter.bytes, _missing(manifest), _remarks(checks, described))


def verify_folder(path: Path, *, deep: bool = False, told: Telling = lambda _: None) -> VerifiedBag:
    """A folder, or one file of messages. Reads every file that a manifest knows. Raises BagError where there is no bag."""
    files = files_of(path)
    manifest, described, early = _writers_word(lambda name: _local(files.get(name)), list(files))
    if manifest is None and described is None and not early and not slices_of(list(files), None):
        raise no_bag(path)
    checks = (*early, *(_check_local(files, each, deep, told) for each in _expected(manifest, described, list(files))))
    sizes = {name: each.stat().st_size for name, each in files.items()}
    bag = RemoteBag('', path.name, tuple(RemoteFile(name, '', size) for name, size in sizes.items()))
    state = state_of(bag, manifest, {}) if manifest else FOREIGN
    return VerifiedBag(path.name, state, checks, sum(sizes.values()), _missing(manifest), _remarks(checks, described))


def _remarks(checks: Sequence[FileCheck], described: Description | None) -> tuple[str, ...]:
    """For a bag whose files were all opened and are sound."""
    infos = {check.name: check.info for check in checks if check.info is not None}
    if described is None or len(infos) < len(checks) or any(check.finding for check in checks):
        return ()
    return of_files(infos, {}, described).remarks


def _missing(manifest: Manifest | None) -> tuple[Missing, ...]:
    return manifest.missing if manifest else ()


def _writers_word(
    get: Callable[[str], bytes | None], there: Sequence[str]
) -> tuple[Manifest | None, Description | None, tuple[FileCheck, ...]]:
    """Manifest and metadata, and what is wrong with them."""
    manifest, described, findings = None, None, []
    try:
        if (content := get(MANIFEST)) is not None:
            manifest = Manifest.from_json(content, MANIFEST)
    except BagDamaged as error:
        findings.append(FileCheck(MANIFEST, str(error), 'content'))
    try:
        if (content := get(METADATA)) is not None:
            described = of_metadata(content, METADATA, there)
        elif manifest is not None:
            findings.append(FileCheck(METADATA, 'is missing', 'presence'))
    except BagDamaged as error:
        findings.append(FileCheck(METADATA, str(error), 'content'))
    return manifest, described, tuple(findings)


def _expected(manifest: Manifest | None, described: Description | None, there: Sequence[str]) -> list[_Expected]:
    """By the manifest, else by the metadata, else by what is there."""
    if manifest is not None:
        found = {each.file: _Expected(each.file, each.bytes, each.sha256, each.messages) for each in manifest.slices}
    elif described is not None:
        found = {each.name: _Expected(each.name, None, None, each.messages) for each in described.parts}
    else:
        found = {}
    return [*found.values(), *(_Expected(name, None, None, None) for name in slices_of(there, described) if name not in found)]


def _check_remote(
    store: ObjectStore, file: RemoteFile, expected: _Expected, meter: Meter, deep: bool, told: Telling
) -> FileCheck:
    held = store.head(BUCKET, file.key)
    if held is not None and words.THINNED in held.metadata:  # thinned after the manifest was made; the gap journal has the rest
        expected = _Expected(expected.name, None, held.sha256, None)
    kind = compare(held, expected.size, expected.sha256)
    if held is None:
        return FileCheck(file.name, 'is not in the store', 'presence')
    if kind == SIZE:
        return FileCheck(file.name, f'has {held.size} bytes, {expected.size} were recorded', SIZE)
    if kind == CHECKSUM:
        return FileCheck(file.name, f'has the SHA-256 {held.sha256}, {expected.sha256} was recorded', 'sha256')
    source = StoredFile(store, BUCKET, file.key, file.size, meter)
    if deep:
        return _check_content(source, replace(expected, sha256=expected.sha256 or held.sha256), deep, told)
    return _check_summary(source, expected, 'sha256' if held.sha256 else 'size')


def _check_local(files: Mapping[str, Path], expected: _Expected, deep: bool, told: Telling) -> FileCheck:
    if not is_path(expected.name):
        return FileCheck(expected.name, 'is the name of no file', 'presence')
    path = files.get(expected.name)
    if path is None:
        return FileCheck(expected.name, 'is missing', 'presence')
    size = path.stat().st_size
    if expected.size is not None and size != expected.size:
        return FileCheck(expected.name, f'has {size} bytes, {expected.size} were recorded', 'size')
    source = LocalFile(path)
    if (deep and path.suffix == MCAP) or expected.sha256:
        found = _check_content(source, expected, deep, told)
        if found.finding or path.suffix == MCAP:
            return found
    return _check_summary(source, expected, 'summary' if path.suffix == MCAP else 'content')


def _check_summary(source: Ranged, expected: _Expected, checked: str) -> FileCheck:
    """In a store, only the summary is read; on the disk, everything that ``BagFile.check`` needs."""
    if not expected.name.endswith(MCAP) and not (expected.name.endswith(SLICES) and isinstance(source, LocalFile)):
        return FileCheck(expected.name, '', checked)
    try:
        if isinstance(source, StoredFile):
            index = read_summary(source)
            if index is None:
                return FileCheck(expected.name, '', checked)  # it would have to be downloaded
            info = index.info(Path(source.name), source.size)
        else:
            info = opened(source).check()
    except BagDamaged as error:
        return FileCheck(expected.name, reason(error, source.name), checked)
    if expected.messages not in {None, info.messages}:
        return FileCheck(expected.name, f'has {info.messages:,} messages, {expected.messages:,} were recorded', checked)
    return FileCheck(expected.name, '', checked, info)


def _check_content(source: Ranged, expected: _Expected, deep: bool, told: Telling) -> FileCheck:
    """Reads all of it once; ``deep`` unpacks every chunk on the way, checks every CRC-32, and counts."""
    once = _Once(source, told)
    checked, info = 'content' if expected.sha256 else 'size', None
    if expected.name.endswith(MCAP) and deep:
        checked += ' and chunks'
        try:
            summary, data_end = read_end(source)
            once.crc_end = data_end - DATA_END_BYTES
            counted = scan(once, data_end)
            info = counted.info(Path(source.name), source.size)
            if counted.data_end == data_end:
                return FileCheck(expected.name, 'has no record that ends its data', checked)
            if finding := _difference(counted, summary or counted, expected):
                return FileCheck(expected.name, finding, checked)
            once.rest()
            check_crcs(source, data_end, once.crc)
        except BagDamaged as error:
            return FileCheck(expected.name, reason(error, source.name), checked)
    found = once.rest()
    if expected.sha256 and found != expected.sha256:
        return FileCheck(expected.name, f'has content of the SHA-256 {found}, {expected.sha256} was recorded', checked)
    return FileCheck(expected.name, '', checked, info)


def _difference(counted: McapIndex, index: McapIndex, expected: _Expected) -> str:
    """Between what was counted in a file and what its summary or the manifest has."""
    promised = index.messages if expected.messages is None else expected.messages
    if counted.messages != promised:
        return f'has {counted.messages:,} messages, {promised:,} were recorded'
    if counted.counts != index.counts or any(counted.channels[each] != index.channels[each] for each in counted.counts):
        return 'has other channels, or other numbers of messages on them, than its summary'
    if (counted.t_start_ns, counted.t_end_ns) != (index.t_start_ns, index.t_end_ns):
        return 'has messages of other times than its summary'
    return ''


class _Once:
    """A file that is read once from beginning to end and hashed on the way, including the parts that the caller skips."""

    def __init__(self, source: Ranged, told: Telling) -> None:
        self.name = source.name
        self.size = source.size
        self._source = source
        self._told = told
        self._digest = sha256_new()
        self._at = 0
        self.crc, self.crc_end = 0, 0
        """Of the bytes before ``crc_end``, once those have been read."""

    def read(self, start: int, length: int) -> bytes:
        while self._at < start:
            self.read(self._at, min(PIECE_BYTES, start - self._at))
        assert start == self._at, 'out of order'
        found = self._source.read(start, length)
        self._digest.update(found)
        if start < self.crc_end:
            self.crc = zlib.crc32(found[: self.crc_end - start], self.crc)
        self._at += length
        self._told(length)
        return found

    def rest(self) -> str:
        """Reads on to the end; the SHA-256 of all of it."""
        while self._at < self.size:
            self.read(self._at, min(PIECE_BYTES, self.size - self._at))
        return self._digest.hexdigest()


def _stored(store: ObjectStore, bag: RemoteBag, name: str) -> bytes | None:
    file = bag.file(name)
    return document(store, file) if file else None


def _local(path: Path | None) -> bytes | None:
    return read_whole(LocalFile(path)) if path is not None else None


def _tags(store: ObjectStore, bag: RemoteBag) -> Mapping[str, str]:
    held = store.head(BUCKET, bag.slices[0].key) if bag.slices else None
    return held.metadata if held else {}
