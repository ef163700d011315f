"""The contents of a complete file, from its summary: ours, and other writers' with more or less of a summary."""

from __future__ import annotations

from pathlib import Path

import pytest
from bags.slices import closed
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.recovery import read_info


def test_ours(tmp_path: Path) -> None:
    """The same as closing it returned."""
    info, _ = closed(tmp_path / 'bag_0.mcap', 70, compression='zstd', sync_every=30)
    assert read_info(info.path, digest=True) == info
    assert read_info(info.path).sha256 == ''
    assert fingerprint(info.path) == (info.bytes, info.sha256)


def test_one_of_rosbags(tmp_path: Path) -> None:
    """A bag of the `rosbags` package, zstd and all."""
    store = get_typestore(Stores.LATEST)
    with BagWriter(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/talk', 'std_msgs/msg/String', typestore=store)
        for number in range(5):
            writer.write(connection, 100 + number, b'\0\1\0\0\4\0\0\0abc\0')
    info = read_info(tmp_path / 'bag' / 'bag.mcap')
    assert (info.messages, info.t_start_ns, info.t_end_ns, info.counts) == (5, 100, 104, {'/talk': 5})
    assert [(one.topic, one.type, one.encoding) for one in info.channels] == [('/talk', 'std_msgs/msg/String', 'ros2msg')]


@pytest.mark.parametrize('options', [
    {},
    {'use_statistics': False},
    {'use_chunking': False},
    {'use_chunking': False, 'use_statistics': False},
    {'index_types': IndexType.NONE, 'use_statistics': False, 'use_summary_offsets': False, 'repeat_channels': False},
    {'compression': CompressionType.LZ4, 'enable_crcs': False},
], ids=str)  # fmt: skip
def test_another_writers(tmp_path: Path, options: dict[str, bool]) -> None:
    """Counts and times are known without statistics, without chunks, without any index: by its messages then."""
    path = tmp_path / 'other.mcap'
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=100, **options)  # type: ignore[arg-type]
        writer.start('ros2', 'somebody')
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data\n')
        talk = writer.register_channel('/talk', 'cdr', schema, {'offered_qos_profiles': '- history: 1\n'})
        echo = writer.register_channel('/echo', 'cdr', schema)
        for number in range(9):
            writer.add_message(echo if number % 3 else talk, 1000 - number, b'1234' * 20, 1000 - number)
        writer.finish()
    info = read_info(path)
    assert (info.messages, info.t_start_ns, info.t_end_ns) == (9, 992, 1000)
    assert info.counts == {'/talk': 3, '/echo': 6}
    assert {one.topic: one.qos for one in info.channels} == {'/talk': '- history: 1\n', '/echo': ''}


@pytest.mark.parametrize('content', [b'', b'no bag', b'\x89MCAP0\r\n' * 30])
def test_an_incomplete_file(tmp_path: Path, content: bytes) -> None:
    """What was cut off, or is something else, is named."""
    path = tmp_path / 'bag_0.mcap'
    path.write_bytes(content)
    with pytest.raises(BagDamaged, match='bag_0'):
        read_info(path)
