"""Bags of other recorders: files of the reference writer, and their contents in the reference reader."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bags.real_bags import T0
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from shadowhound_data_logger.bags.info import info_folder

S = 10**9
STRING = ('std_msgs/msg/String', 'ros2msg', b'string data\n')
INT = ('std_msgs/msg/Int32', 'ros2msg', b'int32 data\n')
CDR = b'\0\1\0\0\2\0\0\0a\0'
BARE: dict[str, Any] = {
    'index_types': IndexType.NONE, 'use_statistics': False, 'use_summary_offsets': False, 'repeat_channels': False,
    'repeat_schemas': False,
}  # fmt: skip


def write(path: Path, fill: Callable[[Writer], None], *, profile: str = 'ros2', **options: Any) -> Path:
    """A file of the reference writer, in a separate folder; returns the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('wb') as file:
        writer = Writer(file, **options)
        writer.start(profile, 'other')
        fill(writer)
        writer.finish()
    return path.parent


def ten(writer: Writer) -> None:
    """Ten messages on two topics, a second apart."""
    schema = writer.register_schema(*STRING)
    channels = [writer.register_channel(topic, 'cdr', schema) for topic in ('/chat', '/talk')]
    for n in range(10):
        writer.add_message(channels[n % 2], T0 + n * S, CDR, T0 + n * S, n)


def read(path: Path) -> list[tuple[object, ...]]:
    """A file as the `mcap` package reads it: everything about each message and its channel except their ids."""
    with path.open('rb') as file:
        return [
            (channel.topic, channel.message_encoding, channel.metadata, schema and (schema.name, schema.encoding, schema.data),
             message.log_time, message.publish_time, message.sequence, message.data)
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]  # fmt: skip


def topics(folder: Path) -> dict[tuple[str, str], int | None]:
    return {(topic.name, topic.type): topic.messages for topic in info_folder(folder).description.topics}


def metadata_yaml(folder: Path, files: Mapping[str, tuple[int, int, int]] | None = None, **changed: Any) -> None:
    """As rosbag2 4 or 5 writes it; ``files`` has messages, start and duration of each."""
    names = sorted(path.name for path in folder.glob('*_[0-9].*'))
    fields = {
        'version': 5, 'storage_identifier': 'mcap', 'relative_file_paths': names, 'duration': {'nanoseconds': 9 * S},
        'starting_time': {'nanoseconds_since_epoch': T0}, 'message_count': 10, 'compression_format': '', 'compression_mode': '',
        'topics_with_message_count': [
            {'topic_metadata': {'name': topic, 'type': STRING[0], 'serialization_format': 'cdr', 'offered_qos_profiles': ''},
             'message_count': 5} for topic in ('/chat', '/talk')
        ],
        'files': [
            {'path': name, 'starting_time': {'nanoseconds_since_epoch': start}, 'duration': {'nanoseconds': length},
             'message_count': count} for name, (count, start, length) in (files or {}).items()
        ],
    }  # fmt: skip
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': {**fields, **changed}}))
