"""The messages of a bag's files, whatever their storage: MCAP as it lies, also in a store; SQLite and packed files from the disk.

rosbags reads the SQLite, once it is known that its tables are tables: a view would be a program of whoever wrote the file.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Final

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat

from shadowhound_data_logger.bags.description import BagPart, Description
from shadowhound_data_logger.encode.definitions import describe
from shadowhound_data_logger.errors import BagDamaged, DataLoggerError
from shadowhound_data_logger.mcap.index import McapIndex, read_index
from shadowhound_data_logger.mcap.messages import MessageFilter, RecordedMessage, read_messages
from shadowhound_data_logger.mcap.ranges import LocalFile, Ranged
from shadowhound_data_logger.mcap.slice_info import Channel
from shadowhound_data_logger.untrusted import MOST_CHUNK_BYTES, path_below, unpacked
from shadowhound_data_logger.zstd import ZstdError, ZstdFile

THREADS: Final = 8
"""Slices that are opened at a time."""
PIECE_BYTES: Final = 1 << 20
MOST_RATIO: Final = 1000
"""Of a file that is unpacked onto the disk, to what it is packed; half of the disk's free room is never exceeded."""
_ENCODINGS = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}
_TABLES: Final = {'messages', 'topics', 'schema', 'metadata', 'message_definitions'}


def is_plain(told: Description | None, slices: Sequence[str]) -> bool:
    """Whether a bag is of MCAP files that can be read as they lie."""
    if told is None:
        return bool(slices) and all(name.endswith('.mcap') for name in slices)
    return told.storage == 'mcap' and not told.compression


class Plain:
    """Reads the slices of an MCAP bag as one row of messages.

    A slice is opened when something of it is wanted, by its summary first.

    Life: New; used by one thread. ``told`` saves opening slices of which it says that they are of another time; without it
    ``clock`` may say what it would (``Description.clock``).
    """

    def __init__(self, sources: Sequence[Ranged], told: Description | None, clock: Mapping[str, str] | None = None) -> None:
        self._sources = sources
        self._told = told
        self._clock = clock or {}
        self._times = _times(told, sources)
        self._index: Callable[[int], McapIndex] = cache(lambda place: read_index(sources[place]))

    def span(self) -> tuple[int, int]:
        if self._told is not None and self._told.messages:
            return self._told.t_start_ns, self._told.t_end_ns
        self._open(range(len(self._sources)))
        found = [index for index in map(self._index, range(len(self._sources))) if index.messages]
        return min((index.t_start_ns for index in found), default=0), max((index.t_end_ns for index in found), default=0)

    def topics(self) -> set[str]:
        if self._told is not None:
            return {topic.name for topic in self._told.topics}
        places = range(len(self._sources))
        self._open(places)
        return {channel.topic for place in places for channel in self._index(place).channels.values()}

    def clock(self) -> Mapping[str, str]:
        return self._clock if self._told is None else self._told.clock

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        places = [place for place in range(len(self._sources)) if self._may_have(place, wanted)]
        self._open(places)
        for place in places:
            yield from read_messages(self._sources[place], self._index(place), wanted)

    def _open(self, places: Sequence[int]) -> None:
        """Several at a time."""
        with ThreadPoolExecutor(THREADS, 'bag-open') as pool:
            list(pool.map(self._index, places))

    def _may_have(self, place: int, wanted: MessageFilter) -> bool:
        part = self._times[place]
        if part is None or part.t_start_ns is None or part.t_end_ns is None:
            return part is None or part.messages != 0
        return part.t_start_ns < wanted.end_ns and part.t_end_ns >= wanted.start_ns


def _times(told: Description | None, sources: Sequence[Ranged]) -> list[BagPart | None]:
    parts = {part.name: part for part in told.parts} if told else {}
    return [parts.get(source.name.rpartition('/')[2]) for source in sources]


class Packed:
    """Reads a bag that is not plain MCAP: SQLite, or compressed outside the storage. Its files are those that the metadata name.

    SQLite knows one stamp alone, when a message came; it stands for both.
    """

    def __init__(self, folder: Path, told: Description) -> None:
        self._folder = folder
        self._told = told

    def span(self) -> tuple[int, int]:
        return (self._told.t_start_ns, self._told.t_end_ns) if self._told.messages else (0, 0)

    def topics(self) -> set[str]:
        return {topic.name for topic in self._told.topics}

    def clock(self) -> Mapping[str, str]:
        return self._told.clock

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        is_by_message = 'message' in self._told.compression
        for part in self._told.parts:
            with self._unpacked(part.name) as path:
                found = Plain([LocalFile(path)], None).messages(wanted) if path.suffix == '.mcap' else _stored(path, wanted)
                for message in found:
                    yield _plain(message, path) if is_by_message else message

    @contextmanager
    def _unpacked(self, name: str) -> Iterator[Path]:
        """The file as its storage wrote it."""
        path = path_below(self._folder, name)
        if 'file' not in self._told.compression:
            yield path
            return
        if not self._told.compression.startswith('zstd'):
            raise BagDamaged(f'{path} is compressed with {self._told.compression!r}, which is not supported', path=str(path))
        with tempfile.TemporaryDirectory(prefix='shadowhound-bag-') as folder:
            whole = Path(folder, path.stem)
            _unpack(path, whole)
            yield whole


def check_tables(path: Path) -> None:
    """Raises BagDamaged for a SQLite file of which a table is none, or holds what is larger than any message."""
    try:
        with closing(sqlite3.connect(f'{path.absolute().as_uri()}?mode=ro&immutable=1', uri=True)) as database:
            why = _refusal(database)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        raise BagDamaged(f'{path} cannot be read: {error}', path=str(path)) from error
    if why:
        raise BagDamaged(f'{path} is not an SQLite bag: {why}', path=str(path))


def _refusal(database: sqlite3.Connection) -> str:
    kinds = database.execute('SELECT type, name, sql FROM sqlite_master').fetchmany(1000)
    found = {name for kind, name, made in kinds if kind == 'table' and not str(made).upper().startswith('CREATE VIRTUAL')}
    if not {'messages', 'topics'} <= found or any(kind == 'view' for kind, _, _ in kinds):
        return 'it has other tables'
    for table in sorted(_TABLES & found):
        columns = database.execute(f'PRAGMA table_xinfo({table})').fetchall()
        if any(hidden for *_, hidden in columns):
            return f'it computes a column of {table}'
        names = [str(name) for _, name, *_ in columns if str(name).isidentifier()]
        longest = [database.execute(f'SELECT max(length("{name}")) FROM {table}').fetchone()[0] for name in names]  # noqa: S608 - checked
        if max(filter(None, longest), default=0) > MOST_CHUNK_BYTES:
            return f'a row of {table} has {max(filter(None, longest)):,} bytes'
    return ''


def channel_of(connection: Connection) -> Channel:
    """A bag without definitions (SQLite before Iron) gets those that are known here."""
    encoding, definition, type_hash = _ENCODINGS.get(connection.msgdef.format, ''), connection.msgdef.data, connection.digest
    if not all(isinstance(text, str) for text in (connection.topic, connection.msgtype, definition, type_hash)):
        raise TypeError('the name, type or definition of a topic is not text')
    if not encoding or not definition:
        encoding, definition, known = describe(connection.msgtype)
        type_hash = type_hash or known
    from rosbags.rosbag2.metadata import dump_qos_v8  # noqa: PLC0415 - see _stored

    qos = dump_qos_v8(connection.ext.offered_qos_profiles) if isinstance(connection.ext, ConnectionExtRosbag2) else ''
    return Channel(connection.topic, connection.msgtype, encoding, definition, type_hash, qos)


def _stored(path: Path, wanted: MessageFilter) -> Iterator[RecordedMessage]:
    from rosbags.rosbag2 import Reader  # noqa: PLC0415 - a tenth of a second of every command, for bags of SQLite alone

    check_tables(path)
    try:
        with Reader(path) as reader:
            channels = {connection.id: channel_of(connection) for connection in reader.connections}
            chosen = [connection for connection in reader.connections if wanted.channel(channels[connection.id])]
            for connection, log_ns, cdr in reader.messages(chosen, wanted.start_ns, wanted.end_ns) if chosen else ():
                yield _message(channels[connection.id], log_ns, cdr)
    except DataLoggerError:
        raise
    except Exception as error:  # whatever rosbags, apsw and ruamel make of a file that is none
        raise BagDamaged(f'{path} cannot be read: {error}', path=str(path)) from error


def _message(channel: Channel, log_ns: object, cdr: object) -> RecordedMessage:
    """SQLite keeps whatever it is given in any column."""
    if type(log_ns) is not int or not 0 <= log_ns < 1 << 63 or not isinstance(cdr, (bytes, bytearray, memoryview)):
        raise TypeError('a message has no time or no content')
    return RecordedMessage(channel, log_ns, log_ns, 0, bytes(cdr))


def _plain(message: RecordedMessage, path: Path) -> RecordedMessage:
    try:
        return message._replace(cdr=unpacked('zstd', message.cdr))
    except ValueError as error:
        raise BagDamaged(f'a message in {path} cannot be unpacked: {error}', path=str(path)) from error


def _unpack(path: Path, whole: Path) -> None:
    """Raises BagDamaged for what is not zstd, or unpacks to more than it may."""
    try:
        most = min(path.stat().st_size * MOST_RATIO, shutil.disk_usage(whole.parent).free // 2)
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
