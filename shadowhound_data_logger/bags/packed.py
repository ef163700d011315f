"""Bags that only rosbags reads: SQLite, and those that are compressed outside the storage. They lie on the disk."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import dump_qos_v8

from shadowhound_data_logger.bags.channel import Channel
from shadowhound_data_logger.bags.definitions import describe
from shadowhound_data_logger.bags.mcap_messages import Message, Wanted
from shadowhound_data_logger.errors import BagDamaged

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_ENCODINGS = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}


class Packed:
    """A folder with a metadata.yaml. It knows one stamp alone: when a message was received; it stands for the other one too."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def span(self) -> tuple[int, int]:
        with self._opened() as reader:
            return (reader.start_time, reader.end_time - 1) if reader.message_count else (0, 0)

    def topics(self) -> set[str]:
        with self._opened() as reader:
            return {connection.topic for connection in reader.connections}

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        with self._opened() as reader:
            channels = {connection.id: channel_of(connection) for connection in reader.connections}
            chosen = [connection for connection in reader.connections if wanted.channel(channels[connection.id])]
            if chosen:
                for connection, log_ns, cdr in reader.messages(chosen, wanted.start_ns, wanted.end_ns):
                    yield Message(channels[connection.id], log_ns, log_ns, 0, bytes(cdr))

    @contextmanager
    def _opened(self) -> Iterator[Reader]:
        try:
            with Reader(self._folder) as reader:
                yield reader
        except (ReaderError, zstd.ZstdError, FileNotFoundError) as error:
            raise BagDamaged(f'{self._folder} cannot be read: {error}', path=str(self._folder)) from error


def channel_of(connection: Connection) -> Channel:
    """A bag without definitions (SQLite before Iron) gets those that are known here."""
    encoding, definition, type_hash = _ENCODINGS.get(connection.msgdef.format, ''), connection.msgdef.data, connection.digest
    if not encoding or not definition:
        encoding, definition, known = describe(connection.msgtype)
        type_hash = type_hash or known
    qos = dump_qos_v8(connection.ext.offered_qos_profiles) if isinstance(connection.ext, ConnectionExtRosbag2) else ''
    return Channel(connection.topic, connection.msgtype, encoding, definition, type_hash, qos)
