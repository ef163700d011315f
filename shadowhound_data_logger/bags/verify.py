"""Checks whether a bag is what its writer says: every promised file, its size and checksum; every chunk on request.

Without a manifest there is nobody to compare with: what the metadata.yaml names must be there, and open.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from hashlib import sha256 as sha256_new
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.bags.contents import check_tables
from shadowhound_data_logger.bags.description import Description, of_metadata
from shadowhound_data_logger.bags.manifest import Manifest, Missing
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA
from shadowhound_data_logger.bags.remote import FOREIGN, RemoteBag, RemoteFile, document, state_of
from shadowhound_data_logger.errors import BagDamaged, BagError
from shadowhound_data_logger.mcap.index import read_index, records
from shadowhound_data_logger.mcap.messages import unpack, walk
from shadowhound_data_logger.mcap.ranges import LocalFile, Meter, Ranged, StoredFile, read_whole
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.untrusted import is_path

THREADS: Final = 4
PIECE_BYTES: Final = 8 << 20


@dataclass(frozen=True, slots=True)
class FileCheck:
    """One file; ``finding`` is empty when it is sound."""

    name: str
    finding: str
    checked: str
    """What was compared: ``presence``, ``size``, ``sha256`` (the store's word), ``summary``, ``content``, with it ``chunks``."""


@dataclass(frozen=True, slots=True)
class VerifiedBag:
    """What a verification found."""

    bag: str
    state: str
    checks: tuple[FileCheck, ...]
    read_bytes: int
    missing: tuple[Missing, ...]
    """What the manifest says that the recording could not get in: no finding, since the bag is as it was recorded."""

    @property
    def findings(self) -> tuple[FileCheck, ...]:
        return tuple(check for check in self.checks if check.finding)

    @property
    def is_sound(self) -> bool:
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
    manifest, described, early = _writers_word(lambda name: _stored(store, bag, name))
    expected = _expected(manifest, described, {file.name: file.size for file in bag.files})

    def one(each: _Expected) -> FileCheck:
        file = bag.file(each.name)
        if file is None:
            return FileCheck(each.name, 'is not in the store', 'presence')
        return _check_remote(store, file, each, meter, deep, told)

    with ThreadPoolExecutor(THREADS, 'bag-verify') as pool:
        checks = tuple(pool.map(one, expected))
    tags = {} if manifest or described else _tags(store, bag)
    return VerifiedBag(bag.name, state_of(bag, manifest, tags), (*early, *checks), meter.bytes, _missing(manifest))


def verify_folder(folder: Path, *, deep: bool = False, told: Telling = lambda _: None) -> VerifiedBag:
    """Reads every file that a manifest knows. Raises BagError where there is no bag."""
    files = {str(path.relative_to(folder)): path.stat().st_size for path in sorted(folder.rglob('*')) if path.is_file()}
    if not files:
        raise BagError(f'{folder} holds no bag', path=str(folder))
    bag = RemoteBag('', folder.name, tuple(RemoteFile(name, '', size) for name, size in files.items()))
    manifest, described, early = _writers_word(lambda name: _local(folder / name))
    if manifest is None and described is None and not bag.slices:
        raise BagError(f'{folder} holds no bag: neither {METADATA} nor a slice is in it', path=str(folder))
    checks = [_check_local(folder, each, deep, told) for each in _expected(manifest, described, files)]
    state = state_of(bag, manifest, {}) if manifest else FOREIGN
    return VerifiedBag(folder.name, state, (*early, *checks), sum(files.values()), _missing(manifest))


def _missing(manifest: Manifest | None) -> tuple[Missing, ...]:
    return manifest.missing if manifest else ()


def _writers_word(get: Callable[[str], bytes | None]) -> tuple[Manifest | None, Description | None, tuple[FileCheck, ...]]:
    """Manifest and metadata, and what is wrong with them."""
    manifest, described, findings = None, None, []
    try:
        if (content := get(MANIFEST)) is not None:
            manifest = Manifest.from_json(content, MANIFEST)
    except BagDamaged as error:
        findings.append(FileCheck(MANIFEST, str(error), 'content'))
    try:
        if (content := get(METADATA)) is not None:
            described = of_metadata(content, METADATA)
        elif manifest is not None:
            findings.append(FileCheck(METADATA, 'is missing', 'presence'))
    except BagDamaged as error:
        findings.append(FileCheck(METADATA, str(error), 'content'))
    return manifest, described, tuple(findings)


def _expected(manifest: Manifest | None, described: Description | None, there: Mapping[str, int]) -> list[_Expected]:
    """By the manifest, else by the metadata, else by what is there."""
    if manifest is not None:
        found = {each.file: _Expected(each.file, each.bytes, each.sha256, each.messages) for each in manifest.slices}
    elif described is not None:
        found = {each.name: _Expected(each.name, None, None, each.messages) for each in described.parts}
    else:
        found = {}
    slices = RemoteBag('', '', tuple(RemoteFile(name, '', size) for name, size in there.items())).slices
    return [*found.values(), *(_Expected(file.name, None, None, None) for file in slices if file.name not in found)]


def _check_remote(
    store: ObjectStore, file: RemoteFile, expected: _Expected, meter: Meter, deep: bool, told: Telling
) -> FileCheck:
    held = store.head(BUCKET, file.key)
    if held is None:
        return FileCheck(file.name, 'is not in the store', 'presence')
    if words.THINNED in held.metadata:  # the robot ran out of room after the manifest was made; the gap journal has what went
        expected = _Expected(expected.name, None, held.sha256, None)
    if expected.size is not None and file.size != expected.size:
        return FileCheck(file.name, f'has {file.size} bytes, {expected.size} were recorded', 'size')
    if held.sha256 and expected.sha256 and held.sha256 != expected.sha256:
        return FileCheck(file.name, f'has the SHA-256 {held.sha256}, {expected.sha256} was recorded', 'sha256')
    source = StoredFile(store, BUCKET, file.key, file.size, meter)
    if deep:
        return _check_content(source, replace(expected, sha256=expected.sha256 or held.sha256), deep, told)
    return _check_summary(source, expected, 'sha256' if held.sha256 else 'size')


def _check_local(folder: Path, expected: _Expected, deep: bool, told: Telling) -> FileCheck:
    if not is_path(expected.name):
        return FileCheck(expected.name, 'is the name of no file', 'presence')
    path = folder / expected.name
    if not path.is_file():
        return FileCheck(expected.name, 'is missing', 'presence')
    size = path.stat().st_size
    if expected.size is not None and size != expected.size:
        return FileCheck(expected.name, f'has {size} bytes, {expected.size} were recorded', 'size')
    source = LocalFile(path)
    if deep or expected.sha256:
        found = _check_content(source, expected, deep, told)
        if found.finding or path.suffix != '.db3':
            return found
    return _check_sqlite(path, expected) if path.suffix == '.db3' else _check_summary(source, expected, 'summary')


def _check_summary(source: Ranged, expected: _Expected, checked: str) -> FileCheck:
    if not expected.name.endswith('.mcap'):
        return FileCheck(expected.name, '', checked)
    try:
        index = read_index(source)
    except BagDamaged as error:
        return FileCheck(expected.name, str(error), checked)
    if index.is_indexed and expected.messages not in {None, index.messages}:
        return FileCheck(expected.name, f'has {index.messages} messages, {expected.messages} were recorded', checked)
    return FileCheck(expected.name, '', checked)


def _check_content(source: Ranged, expected: _Expected, deep: bool, told: Telling) -> FileCheck:
    """Reads all of it once; ``deep`` unpacks every chunk on the way, which checks its CRC-32, and counts."""
    once = _Once(source, told)
    checked = 'content' if expected.sha256 else 'size'
    if deep and expected.name.endswith('.mcap'):
        checked += ' and chunks'
        try:
            index = read_index(source)
            count = sum(_messages(kind, start, content, source.name) for kind, start, content in walk(once, index.data_end))
        except BagDamaged as error:
            return FileCheck(expected.name, str(error), checked)
        promised = expected.messages if expected.messages is not None else index.messages if index.is_indexed else count
        if count != promised:
            return FileCheck(expected.name, f'has {count} messages, {promised} were recorded', checked)
    found = once.rest()
    if expected.sha256 and found != expected.sha256:
        return FileCheck(expected.name, f'has content of the SHA-256 {found}, {expected.sha256} was recorded', checked)
    return FileCheck(expected.name, '', checked)


def _messages(kind: int, start: int, content: memoryview, name: str) -> int:
    """In one record."""
    if kind == Opcode.CHUNK:
        where = f'the chunk at {start} of {name}'
        return sum(inner == Opcode.MESSAGE for inner, _, _ in records(unpack(content, where), where))
    return int(kind == Opcode.MESSAGE)


class _Once:
    """A file that is read from its beginning to its end, and hashed on the way."""

    def __init__(self, source: Ranged, told: Telling) -> None:
        self.name = source.name
        self.size = source.size
        self._source = source
        self._told = told
        self._digest = sha256_new()
        self._at = 0

    def read(self, start: int, length: int) -> bytes:
        found = self._source.read(start, length)
        assert start == self._at, 'out of order'
        self._digest.update(found)
        self._at += length
        self._told(length)
        return found

    def rest(self) -> str:
        """Reads on to the end; the SHA-256 of all of it."""
        while self._at < self.size:
            self.read(self._at, min(PIECE_BYTES, self.size - self._at))
        return self._digest.hexdigest()


def _check_sqlite(path: Path, expected: _Expected) -> FileCheck:
    try:
        check_tables(path)
    except BagDamaged as error:
        return FileCheck(expected.name, f'is not an SQLite bag: {error}', 'content')
    try:
        with sqlite3.connect(f'{path.absolute().as_uri()}?mode=ro&immutable=1', uri=True) as database:
            answer = database.execute('PRAGMA quick_check(1)').fetchone()[0]
            count = database.execute('SELECT count(*) FROM messages').fetchone()[0]
        database.close()
    except sqlite3.Error as error:
        return FileCheck(expected.name, f'is not an SQLite bag: {error}', 'content')
    if answer != 'ok':
        return FileCheck(expected.name, f'is damaged: {answer}', 'content')
    if expected.messages not in {None, count}:
        return FileCheck(expected.name, f'has {count} messages, {expected.messages} were recorded', 'content')
    return FileCheck(expected.name, '', 'content')


def _stored(store: ObjectStore, bag: RemoteBag, name: str) -> bytes | None:
    file = bag.file(name)
    return document(store, file) if file else None


def _local(path: Path) -> bytes | None:
    return read_whole(LocalFile(path)) if path.is_file() else None


def _tags(store: ObjectStore, bag: RemoteBag) -> Mapping[str, str]:
    held = store.head(BUCKET, bag.slices[0].key) if bag.slices else None
    return held.metadata if held else {}
