"""The files of a bag as one sequence of messages, for any storage: MCAP in a folder or a store, SQLite and packed files.

All code that reads bags opens them here, so `info`, `cut`, `verify` and `upload` agree: a bag contains what its files contain.
``metadata.yaml`` is a claim that is compared with them.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any, Final, Protocol

from shadowhound_data_logger.bags.description import Description, describe_files, describe_manifest, describe_metadata
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import MANIFEST, MCAP, METADATA, PACKED, SLICES, SQLITE, natural_key
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.untrusted import MAX_CHUNK_BYTES, decompress
from shadowhound_data_logger.core.zstd import ZstdError, ZstdFile
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.format import CDR, ROS2
from shadowhound_data_logger.formats.mcap.index import McapIndex, read_index, read_profile, read_summary
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, RecordedMessage, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Meter, Ranged, read_whole
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import qos_in_numbers
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo

THREADS: Final = 8
"""Number of files that are opened concurrently."""
PIECE_BYTES: Final = 1 << 20
MAX_RATIO: Final = 1000
"""Maximum ratio of an unpacked file to the packed one. An unpacked file never takes more than half of the free disk space."""
OWN_METADATA: Final = frozenset({'rosbag2', 'shadowhound_recording'})
"""Metadata records that describe the file itself, so they are not copied."""
NOT_READ: Final = 'these figures are from metadata.yaml alone: the files cannot be read in the store; fetch the bag to check them'
WAL_HEADER_BYTES: Final = 32
"""Size of an empty write-ahead log of SQLite."""
ZSTD_MAGIC: Final = b'\x28\xb5\x2f\xfd'
_TABLES: Final = {'messages', 'topics', 'schema', 'metadata', 'message_definitions'}
_LATEST_NS: Final = 1 << 63


class BagFile(Protocol):
    """One file of a bag."""

    @property
    def profile(self) -> str:
        """The profile of its messages, as in the header of MCAP. All members raise BagDamaged."""

    @property
    def info(self) -> SliceInfo: ...

    @property
    def extras(self) -> int:
        """The number of attachments and metadata records."""

    def check(self) -> SliceInfo:
        """Returns ``info`` after running the checks that the storage offers."""

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]: ...


class McapFile:
    """An MCAP file on the disk or in a store; opened on first use, summary first."""

    def __init__(self, source: Ranged) -> None:
        self._source = source

    @cached_property
    def _index(self) -> McapIndex:
        return read_index(self._source)

    @cached_property
    def profile(self) -> str:
        return read_profile(self._source)

    @property
    def info(self) -> SliceInfo:
        return self._index.info(Path(self._source.name), self._source.size)

    @property
    def extras(self) -> int:
        return self._index.attachments + sum(name not in OWN_METADATA for name in self._index.metadata)

    def check(self) -> SliceInfo:
        return self.info

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        return read_messages(self._source, self._index, wanted)


class SqliteFile:
    """A file of rosbag2's SQLite storage, of any version. Its messages have only an arrival time, which is used for both times.

    Its tables are checked before they are read: a view would execute code that the file's author chose.
    """

    profile = ROS2
    extras = 0

    def __init__(self, path: Path) -> None:
        self._path = path

    @cached_property
    def _channels(self) -> dict[int, Channel]:
        for suffix in ('-wal', '-journal'):
            rest = self._path.with_name(self._path.name + suffix)
            if rest.exists() and rest.stat().st_size > WAL_HEADER_BYTES:
                text = f'{self._path} was not closed: {rest.name} may have messages that are not in it'
                raise BagDamaged(text, path=str(self._path))
        check_tables(self._path)
        with self._open_database() as database:
            columns = {str(name) for _, name, *_ in database.execute('PRAGMA table_info(topics)')}
            wanted = [name if name in columns else "''" for name in ('offered_qos_profiles', 'type_description_hash')]
            topics = database.execute(f'SELECT id, name, type, serialization_format, {", ".join(wanted)} FROM topics').fetchall()  # noqa: S608 - of the two above
            known = dict[str, tuple[str, str]]()
            if database.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'").fetchone():
                query = 'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
                known = {kind: (encoding, text) for kind, encoding, text in database.execute(query)}
            return {number: _channel(fields, known) for number, *fields in topics}

    @cached_property
    def info(self) -> SliceInfo:
        channels = self._channels
        with self._open_database() as database:
            query = 'SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id'
            rows = database.execute(query).fetchall()
            for number, _, *times in rows:
                if number not in channels:
                    raise ValueError(f'it has messages of topic {number!r:.80}, which it does not define')
                list(map(_time, times))
        counts = {number: count for number, count, _, _ in rows}
        by_channel = dict[Channel, int]()
        for number, channel in channels.items():
            by_channel[channel] = by_channel.get(channel, 0) + counts.get(number, 0)
        return SliceInfo(
            self._path, self._path.stat().st_size, '', min((row[2] for row in rows), default=0),
            max((row[3] for row in rows), default=0), sum(counts.values()), by_channel,
        )  # fmt: skip

    def check(self) -> SliceInfo:
        check_tables(self._path)
        with self._open_database() as database:
            answer = database.execute('PRAGMA quick_check(1)').fetchone()[0]
            if answer != 'ok':
                raise ValueError(str(answer))
        return self.info

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        chosen = {number: channel for number, channel in self._channels.items() if wanted.channel(channel)}
        marks = ', '.join('?' * len(chosen))
        query = (
            f'SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? AND timestamp <= ? AND topic_id IN ({marks}) '  # noqa: S608 - question marks
            'ORDER BY timestamp, id'
        )
        first, last = max(wanted.start_ns, 0), min(wanted.end_ns, _LATEST_NS) - 1
        with self._open_database() as database:
            for number, log_ns, data in database.execute(query, (first, last, *chosen)):
                if not isinstance(data, bytes):
                    raise TypeError('a message has no content')
                yield RecordedMessage(chosen[number], _time(log_ns), log_ns, 0, data)

    @contextmanager
    def _open_database(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(f'{self._path.absolute().as_uri()}?mode=ro&immutable=1', uri=True)) as database:
                yield database
        except (sqlite3.Error, OSError, UnicodeDecodeError, TypeError, ValueError, LookupError) as error:
            raise BagDamaged(f'{self._path} cannot be read: {error}', path=str(self._path)) from error


class PackedFile:
    """A file that rosbag2 compressed as a whole. It is unpacked into a temporary folder on each use."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def profile(self) -> str:
        with self._unpacked() as part:
            return part.profile

    @cached_property
    def _read(self) -> tuple[SliceInfo, int]:
        with self._unpacked() as part:
            return replace(part.info, path=self._path), part.extras

    def check(self) -> SliceInfo:
        with self._unpacked() as part:
            return replace(part.check(), path=self._path)

    @property
    def info(self) -> SliceInfo:
        return self._read[0]

    @property
    def extras(self) -> int:
        return self._read[1]

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        with self._unpacked() as part:
            yield from part.messages(wanted)

    @contextmanager
    def _unpacked(self) -> Iterator[BagFile]:
        with tempfile.TemporaryDirectory(prefix='shadowhound-bag-') as folder:
            whole = Path(folder, self._path.stem)
            _unpack(self._path, whole)
            yield open_bag_file(LocalFile(whole))


def open_bag_file(source: Ranged) -> BagFile:
    """The reader for a file, selected by its name; SQLite and packed files must be on the disk."""
    if isinstance(source, LocalFile) and source.name.endswith(PACKED):
        return PackedFile(source.path)
    if isinstance(source, LocalFile) and source.name.endswith(SQLITE):
        return SqliteFile(source.path)
    if source.name.endswith(MCAP):
        return McapFile(source)
    raise BagDamaged(f'{source.name} is not a file that can be read here: one of {", ".join(SLICES)}', path=source.name)


class BagReader:
    """Reads all files of a bag.

    Lifecycle: new; used by one thread. A file that cannot be opened is skipped and listed in ``damaged``; damage within a file
    raises BagDamaged when it is reached.
    """

    def __init__(self, sources: Mapping[str, Ranged], claimed: Description | None, manifest: Manifest | None = None) -> None:
        """``sources`` by name, in their order. A manifest, which was made from the files, saves opening all of them."""
        self.claimed = claimed
        self._manifest = manifest
        self._recorded = {each.file: each for each in manifest.slices} if manifest is not None else {}
        self._names = {name: source.name for name, source in sources.items()}
        self._parts: dict[str, BagFile] = {}
        self._damaged: dict[str, BagDamaged] = {}
        for name, source in sources.items():
            try:
                self._parts[name] = open_bag_file(source)
            except BagDamaged as error:
                self._damaged[name] = error
        self._infos: dict[str, SliceInfo] = {}
        self._is_packed = claimed is not None and 'message' in claimed.compression

    @property
    def damaged(self) -> Mapping[str, str]:
        """Files that could not be opened so far, and why."""
        return {name: reason(error, self._names[name]) for name, error in self._damaged.items()}

    def describe(self) -> Description:
        """The contents from all files, or from the manifest if it lists all of them. Raises BagDamaged if none is readable."""
        is_recorded = self._recorded.keys() >= {*self._parts, *self._damaged}
        if self.claimed is not None and self._manifest is not None and is_recorded:
            return describe_manifest(self._manifest, self._parts, self.claimed)
        infos = self.infos()
        return describe_files(infos, self.damaged, self.claimed)

    def infos(self) -> Mapping[str, SliceInfo]:
        """The contents of each readable file. Raises BagDamaged if none is readable."""
        self._open(list(self._parts))
        if not self._infos:
            self.check()
        return {name: self._infos[name] for name in self._parts if name in self._infos}

    def check(self) -> None:
        """Raises BagDamaged if a file could not be opened so far."""
        for error in self._damaged.values():
            raise error

    def profile(self) -> str:
        """The profile of the first readable file."""
        for name, part in self._parts.items():
            if name not in self._damaged:
                try:
                    return part.profile
                except BagDamaged as error:
                    self._damaged[name] = error
        return ROS2

    def extras(self) -> int:
        """The number of attachments and metadata records in the files that were opened."""
        return sum(self._parts[name].extras for name in self._infos)

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        """The messages in the order of the files, and within each file in file order (SQLite: by time)."""
        names = [name for name in self._parts if self._may_have(name, wanted)]
        self._open(names)
        for name in names:
            if name in self._infos:
                for message in self._parts[name].messages(wanted):
                    yield self._decompressed(message, name)

    def latched_since(self, before_ns: int) -> int:
        """Read from this time on to find all messages latched at ``before_ns``: the start of its file, if that repeats them."""
        for name in reversed(list(self._parts)):
            if name not in self._recorded:
                self._open([name])
            known = self._infos.get(name) or self._recorded.get(name)
            if known is not None and known.messages and known.t_start_ns <= before_ns:
                return known.t_start_ns if known.repeated else 0
        return 0

    def _open(self, names: Sequence[str]) -> None:
        """Open files concurrently."""

        def one(name: str) -> None:
            try:
                self._infos[name] = self._parts[name].info
            except BagDamaged as error:
                self._damaged[name] = error

        wanted = [name for name in names if name not in self._infos and name not in self._damaged]
        with ThreadPoolExecutor(THREADS, 'bag-open') as pool:
            list(pool.map(one, wanted))

    def _may_have(self, name: str, wanted: MessageFilter) -> bool:
        known = self._infos.get(name) or self._recorded.get(name)
        if known is None:
            return True
        return known.messages > 0 and known.t_start_ns < wanted.end_ns and known.t_end_ns >= wanted.start_ns

    def _decompressed(self, message: RecordedMessage, name: str) -> RecordedMessage:
        """The message without rosbag2's per-message compression. CDR never starts with the magic bytes of zstd."""
        is_packed = message.channel.message_encoding == CDR and message.cdr.startswith(ZSTD_MAGIC)
        if not (is_packed or self._is_packed):
            return message
        try:
            return message._replace(cdr=decompress('zstd', message.cdr))
        except ValueError as error:
            raise BagDamaged(f'a message in {name} cannot be unpacked: {error}', path=name) from error


def describe_bag(
    sources: Mapping[str, Ranged], claimed: Description | None, manifest: Manifest | None, *, scans: bool = True
) -> Description | None:
    """The contents of a bag whose files may be in a store; None if there is nothing to read.

    Uses the manifest if it lists all files. Otherwise, SQLite and packed files in a store would have to be downloaded, so for
    such a bag it returns what the metadata claims. Without ``scans``, so it does if the summary of an MCAP file is insufficient.
    """
    names = slices_of(sorted(sources, key=natural_key), claimed)
    if claimed is not None and manifest is not None and {each.file for each in manifest.slices}.issuperset(names):
        return describe_manifest(manifest, sources, claimed)
    if any(not name.endswith(MCAP) and not isinstance(sources[name], LocalFile) for name in names):
        return claimed and replace(claimed, remarks=(NOT_READ,))
    if claimed is not None and not scans and not all(_has_summary(sources[name]) for name in names):
        return replace(claimed, remarks=(NOT_READ,))
    if not names and claimed is None:
        return None
    return BagReader({name: sources[name] for name in names}, claimed).describe()


def _has_summary(source: Ranged) -> bool:
    """Whether an MCAP file can be described, or recognized as damaged, without reading all of it."""
    try:
        return read_summary(source) is not None
    except BagDamaged:
        return True


@dataclass(frozen=True, slots=True)
class FolderBag:
    """A bag on the disk: a folder, or one file of messages."""

    path: Path
    files: Mapping[str, Path]
    """All files by their path in the folder."""
    manifest: Manifest | None
    reader: BagReader


def open_folder(path: Path, meter: Meter | None = None) -> FolderBag:
    """Open a bag on the disk. Raises BagError if there is none, BagDamaged if its manifest or metadata is invalid."""
    files = files_of(path)
    claimed = (
        describe_metadata(read_whole(LocalFile(files[METADATA])), str(files[METADATA]), files) if METADATA in files else None
    )
    manifest = None
    if MANIFEST in files:
        manifest = Manifest.from_json(read_whole(LocalFile(files[MANIFEST])), str(files[MANIFEST]))
    names = slices_of(list(files), claimed)
    if not names and claimed is None:
        raise not_a_bag(path)
    sources = {name: LocalFile(files[name], meter) for name in names}
    return FolderBag(path, files, manifest, BagReader(sources, claimed))


def files_of(path: Path) -> dict[str, Path]:
    """The files in a folder by their path in it, in natural order; or the file itself. Raises BagError."""
    if path.is_file():
        return {path.name: path}
    if not path.is_dir():
        raise BagError(f'there is no folder {path}', remedy='name the folder that `ros2 bag record -o` made', path=str(path))
    found = {str(each.relative_to(path)): each for each in path.rglob('*') if each.is_file()}
    return {name: found[name] for name in sorted(found, key=natural_key)}


def slices_of(names: Sequence[str], claimed: Description | None) -> list[str]:
    """The files with messages: all in the folder itself, and those in subfolders that the metadata names.

    If a file exists both packed and unpacked, the one that the metadata names is used.
    """
    named = {part.name for part in claimed.parts} if claimed is not None else set()
    found = [name for name in names if name in named or (name.endswith(SLICES) and '/' not in name)]
    twice = {name for name in found if name + PACKED in found}  # left by a recorder that crashed while it compressed them
    dropped = {name if name + PACKED in named and name not in named else name + PACKED for name in twice}
    return [name for name in found if name not in dropped]


def reason(error: BagDamaged, name: str) -> str:
    """What is wrong with a file, without its name: the text follows the name."""
    text = error.what.removeprefix(name)
    return text.strip() if text != error.what else f'is damaged: {error.what}'.replace(f' of {name}', '')


def not_a_bag(path: Path) -> BagError:
    """The error for a path without a bag."""
    return BagError(
        f'{path} is not a bag: it has neither {METADATA} nor a finished file of messages ({", ".join(SLICES)})',
        remedy='name the folder that `ros2 bag record -o` made', path=str(path),
    )  # fmt: skip


def _channel(fields: Sequence[Any], known: Mapping[str, tuple[str, str]]) -> Channel:
    """The channel of a topic. For a file without definitions (before Iron), uses the definitions on this machine."""
    topic, kind, message_encoding, qos, type_hash = fields
    encoding, definition = known.get(kind, ('', ''))
    if not all(isinstance(text, str) for text in (*fields, encoding, definition)):
        raise TypeError('the name, type or definition of a topic is not text')
    if not definition or encoding not in {'ros2msg', 'ros2idl'}:  # rosbag2 also writes the encoding "unknown"
        encoding, definition, found = describe(kind)
        type_hash = type_hash or found
    return Channel(topic, kind, encoding, definition, type_hash, qos_in_numbers(qos), message_encoding)


def check_tables(path: Path) -> None:
    """Raises BagDamaged for a SQLite file in which reading a table would execute code, or a row exceeds the message limit."""
    try:
        with closing(sqlite3.connect(f'{path.absolute().as_uri()}?mode=ro&immutable=1', uri=True)) as database:
            why = check_schema(database) or _too_large(database)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        raise BagDamaged(f'{path} cannot be read: {error}', path=str(path)) from error
    if why:
        raise BagDamaged(f'{path} is not an SQLite bag: {why}', path=str(path))


def check_schema(database: sqlite3.Connection) -> str:
    """Why the tables must not be read, because reading one would execute code from the file; empty if they are safe."""
    kinds = database.execute('SELECT type, name, sql FROM sqlite_master').fetchmany(1000)
    found = {name for kind, name, made in kinds if kind == 'table' and not str(made).upper().startswith('CREATE VIRTUAL')}
    if not {'messages', 'topics'} <= found or any(kind == 'view' for kind, _, _ in kinds):
        return 'it has other tables'
    for table in sorted(_TABLES & found):
        if any(hidden for *_, hidden in database.execute(f'PRAGMA table_xinfo({table})')):
            return f'it computes a column of {table}'
    return ''


def _too_large(database: sqlite3.Connection) -> str:
    there = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    for table in sorted(_TABLES & there):
        columns = database.execute(f'PRAGMA table_info({table})').fetchall()
        names = [str(name) for _, name, *_ in columns if str(name).isidentifier()]
        longest = [database.execute(f'SELECT max(length("{name}")) FROM {table}').fetchone()[0] for name in names]  # noqa: S608 - checked
        if max(filter(None, longest), default=0) > MAX_CHUNK_BYTES:
            return f'a row of {table} has {max(filter(None, longest)):,} bytes'
    return ''


def _time(value: object) -> int:
    """Checks a timestamp, because SQLite allows any value in any column."""
    if type(value) is not int or not 0 <= value < _LATEST_NS:
        raise TypeError(f'a message has the time {value!r:.80}')
    return value


def _unpack(path: Path, whole: Path) -> None:
    """Raises BagDamaged if the file is not zstd or exceeds the limits when unpacked."""
    try:
        most = min(path.stat().st_size * MAX_RATIO, shutil.disk_usage(whole.parent).free // 2)
        with path.open('rb') as raw, ZstdFile(raw, 'rb') as packed, whole.open('wb') as out:
            _copy(packed, out, most)
    except (ZstdError, OSError, EOFError, ValueError) as error:
        raise BagDamaged(f'{path} cannot be unpacked: {error}', path=str(path)) from error


def _copy(packed: ZstdFile, out: IO[bytes], most: int) -> None:
    left = most
    while piece := packed.read(PIECE_BYTES):
        left -= len(piece)
        if left < 0:
            raise ValueError(f'it unpacks to more than {most:,} bytes')
        out.write(piece)
