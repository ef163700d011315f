"""Verifies that a bag is what was recorded: every file in the manifest, its size and checksum; on request, every chunk.

Without a manifest, the content cannot be compared: then the files that metadata.yaml names must exist and be readable.
Contradictions between metadata.yaml and the files are remarks.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from hashlib import sha256 as sha256_new
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import files_of, not_a_bag, open_bag_file, reason, slices_of
from shadowhound_data_logger.bags.description import Description, describe_files, describe_metadata
from shadowhound_data_logger.bags.manifest import Manifest, Missing
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, MCAP, METADATA, SLICES
from shadowhound_data_logger.bags.remote import FOREIGN, RemoteBag, RemoteFile, document, state_of
from shadowhound_data_logger.core import metadata_keys as meta
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
    """The result for one file; ``finding`` is empty if it is intact."""

    name: str
    finding: str
    checked: str
    """What was compared: ``presence``, ``size``, ``sha256`` (as the store reports it), ``summary``, ``content``, ``chunks``."""
    info: SliceInfo | None = field(default=None, repr=False)
    """The contents of the file, if it was opened."""


@dataclass(frozen=True, slots=True)
class VerifiedBag:
    """The result of a verification."""

    bag: str
    state: str
    checks: tuple[FileCheck, ...]
    read_bytes: int
    missing: tuple[Missing, ...]
    """Losses during the recording, from the manifest. They are not findings, because the bag is as it was recorded."""
    remarks: tuple[str, ...] = ()
    """Contradictions between metadata.yaml and the files, if all files are intact."""

    @property
    def findings(self) -> tuple[FileCheck, ...]:
        return tuple(check for check in self.checks if check.finding)

    @property
    def is_intact(self) -> bool:
        return not self.findings


OnProgress = Callable[[int], None]
"""Called with the number of additional bytes that were read."""


@dataclass(frozen=True, slots=True)
class _Expected:
    """The expected properties of a file; None if unknown."""

    name: str
    size: int | None
    sha256: str | None
    messages: int | None


def verify_remote(
    store: ObjectStore, bag: RemoteBag, *, deep: bool = False, on_progress: OnProgress = lambda _: None
) -> VerifiedBag:
    """Verify a bag in a store. ``deep`` reads all content; otherwise compares what the store reports. Raises StoreError."""
    meter = Meter()
    names = [file.name for file in bag.files]
    manifest, claimed, early = _read_claims(lambda name: _stored(store, bag, name), names)
    expected = _expected(manifest, claimed, names)

    def one(each: _Expected) -> FileCheck:
        file = bag.file(each.name)
        if file is None:
            return FileCheck(each.name, 'is not in the store', 'presence')
        return _check_remote(store, file, each, meter, deep, on_progress)

    with ThreadPoolExecutor(THREADS, 'bag-verify') as pool:
        checks = (*early, *pool.map(one, expected))
    tags = {} if manifest or claimed else _tags(store, bag)
    state = state_of(bag, manifest, tags)
    return VerifiedBag(bag.name, state, checks, meter.bytes, _missing(manifest), _remarks(checks, claimed))


def verify_folder(path: Path, *, deep: bool = False, on_progress: OnProgress = lambda _: None) -> VerifiedBag:
    """Verify a folder or one file of messages. Reads every file in the manifest. Raises BagError if there is no bag."""
    files = files_of(path)
    manifest, claimed, early = _read_claims(lambda name: _local(files.get(name)), list(files))
    if manifest is None and claimed is None and not early and not slices_of(list(files), None):
        raise not_a_bag(path)
    checks = (*early, *(_check_local(files, each, deep, on_progress) for each in _expected(manifest, claimed, list(files))))
    sizes = {name: each.stat().st_size for name, each in files.items()}
    bag = RemoteBag('', path.name, tuple(RemoteFile(name, '', size) for name, size in sizes.items()))
    state = state_of(bag, manifest, {}) if manifest else FOREIGN
    return VerifiedBag(path.name, state, checks, sum(sizes.values()), _missing(manifest), _remarks(checks, claimed))


def _remarks(checks: Sequence[FileCheck], claimed: Description | None) -> tuple[str, ...]:
    """The remarks for a bag whose files were all opened and are intact."""
    infos = {check.name: check.info for check in checks if check.info is not None}
    if claimed is None or len(infos) < len(checks) or any(check.finding for check in checks):
        return ()
    return describe_files(infos, {}, claimed).remarks


def _missing(manifest: Manifest | None) -> tuple[Missing, ...]:
    return manifest.missing if manifest else ()


def _read_claims(
    get: Callable[[str], bytes | None], there: Sequence[str]
) -> tuple[Manifest | None, Description | None, tuple[FileCheck, ...]]:
    """Manifest and metadata, and findings about them."""
    manifest, claimed, findings = None, None, []
    try:
        if (content := get(MANIFEST)) is not None:
            manifest = Manifest.from_json(content, MANIFEST)
    except BagDamaged as error:
        findings.append(FileCheck(MANIFEST, str(error), 'content'))
    try:
        if (content := get(METADATA)) is not None:
            claimed = describe_metadata(content, METADATA, there)
        elif manifest is not None:
            findings.append(FileCheck(METADATA, 'is missing', 'presence'))
    except BagDamaged as error:
        findings.append(FileCheck(METADATA, str(error), 'content'))
    return manifest, claimed, tuple(findings)


def _expected(manifest: Manifest | None, claimed: Description | None, there: Sequence[str]) -> list[_Expected]:
    """The expected files from the manifest, otherwise from the metadata, plus the files that exist."""
    if manifest is not None:
        found = {each.file: _Expected(each.file, each.bytes, each.sha256, each.messages) for each in manifest.slices}
    elif claimed is not None:
        found = {each.name: _Expected(each.name, None, None, each.messages) for each in claimed.parts}
    else:
        found = {}
    return [*found.values(), *(_Expected(name, None, None, None) for name in slices_of(there, claimed) if name not in found)]


def _check_remote(
    store: ObjectStore, file: RemoteFile, expected: _Expected, meter: Meter, deep: bool, on_progress: OnProgress
) -> FileCheck:
    held = store.head(BUCKET, file.key)
    if held is not None and meta.THINNED in held.metadata:  # thinned after the manifest was written, see the gap journal
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
        return _check_content(source, replace(expected, sha256=expected.sha256 or held.sha256), deep, on_progress)
    return _check_summary(source, expected, 'sha256' if held.sha256 else 'size')


def _check_local(files: Mapping[str, Path], expected: _Expected, deep: bool, on_progress: OnProgress) -> FileCheck:
    if not is_path(expected.name):
        return FileCheck(expected.name, 'is not a valid file name', 'presence')
    path = files.get(expected.name)
    if path is None:
        return FileCheck(expected.name, 'is missing', 'presence')
    size = path.stat().st_size
    if expected.size is not None and size != expected.size:
        return FileCheck(expected.name, f'has {size} bytes, {expected.size} were recorded', 'size')
    source = LocalFile(path)
    if (deep and path.suffix == MCAP) or expected.sha256:
        found = _check_content(source, expected, deep, on_progress)
        if found.finding or path.suffix == MCAP:
            return found
    return _check_summary(source, expected, 'summary' if path.suffix == MCAP else 'content')


def _check_summary(source: Ranged, expected: _Expected, checked: str) -> FileCheck:
    """Reads only the summary of a file in a store, and everything that ``BagFile.check`` needs of a file on the disk."""
    if not expected.name.endswith(MCAP) and not (expected.name.endswith(SLICES) and isinstance(source, LocalFile)):
        return FileCheck(expected.name, '', checked)
    try:
        if isinstance(source, StoredFile):
            index = read_summary(source)
            if index is None:
                return FileCheck(expected.name, '', checked)  # checking would require a download
            info = index.info(Path(source.name), source.size)
        else:
            info = open_bag_file(source).check()
    except BagDamaged as error:
        return FileCheck(expected.name, reason(error, source.name), checked)
    if expected.messages not in {None, info.messages}:
        return FileCheck(expected.name, f'has {info.messages:,} messages, {expected.messages:,} were recorded', checked)
    return FileCheck(expected.name, '', checked, info)


def _check_content(source: Ranged, expected: _Expected, deep: bool, on_progress: OnProgress) -> FileCheck:
    """Reads the file once; ``deep`` also unpacks every chunk, checks every CRC-32, and counts the messages."""
    reader = _SequentialReader(source, on_progress)
    checked, info = 'content' if expected.sha256 else 'size', None
    if expected.name.endswith(MCAP) and deep:
        checked += ' and chunks'
        try:
            summary, data_end = read_end(source)
            reader.crc_end = data_end - DATA_END_BYTES
            counted = scan(reader, data_end)
            info = counted.info(Path(source.name), source.size)
            if counted.data_end == data_end:
                return FileCheck(expected.name, 'has no DataEnd record', checked)
            if finding := _difference(counted, summary or counted, expected):
                return FileCheck(expected.name, finding, checked)
            reader.finish()
            check_crcs(source, data_end, reader.crc)
        except BagDamaged as error:
            return FileCheck(expected.name, reason(error, source.name), checked)
    found = reader.finish()
    if expected.sha256 and found != expected.sha256:
        return FileCheck(expected.name, f'has content with the SHA-256 {found}, {expected.sha256} was recorded', checked)
    return FileCheck(expected.name, '', checked, info)


def _difference(counted: McapIndex, index: McapIndex, expected: _Expected) -> str:
    """The difference between the counted contents of a file and its summary or the manifest; empty if none."""
    promised = index.messages if expected.messages is None else expected.messages
    if counted.messages != promised:
        return f'has {counted.messages:,} messages, {promised:,} were recorded'
    if counted.counts != index.counts or any(counted.channels[each] != index.channels[each] for each in counted.counts):
        return 'has messages on other channels, or other counts, than its summary'
    if (counted.t_start_ns, counted.t_end_ns) != (index.t_start_ns, index.t_end_ns):
        return 'has messages with other times than its summary'
    return ''


class _SequentialReader:
    """Reads a file once from start to end and hashes it, including the parts that the caller skips."""

    def __init__(self, source: Ranged, on_progress: OnProgress) -> None:
        self.name = source.name
        self.size = source.size
        self._source = source
        self._on_progress = on_progress
        self._digest = sha256_new()
        self._at = 0
        self.crc, self.crc_end = 0, 0
        """CRC-32 of the bytes before ``crc_end``, after they were read."""

    def read(self, start: int, length: int) -> bytes:
        while self._at < start:
            self.read(self._at, min(PIECE_BYTES, start - self._at))
        assert start == self._at, 'out of order'
        found = self._source.read(start, length)
        self._digest.update(found)
        if start < self.crc_end:
            self.crc = zlib.crc32(found[: self.crc_end - start], self.crc)
        self._at += length
        self._on_progress(length)
        return found

    def finish(self) -> str:
        """Read to the end; returns the SHA-256 of the file."""
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
