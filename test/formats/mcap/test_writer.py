"""The writer of slices: what goes in comes out in other people's readers, and nothing unfinished bears a slice's name."""

from __future__ import annotations

import errno
import hashlib
import os
import random
from pathlib import Path

import pytest
from bags.slices import BLOB, ECHO, TALK, Recorded, check, closed, fill, in_order, indexed, messages
from mcap.reader import make_reader

from shadowhound_data_logger.formats.mcap.index import read_metadata
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.slice_info import Channel, Damage
from shadowhound_data_logger.formats.mcap.writer import SliceWriter


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_messages_are_read_as_written(tmp_path: Path, compression: str) -> None:
    """Topic, both stamps, sequence and bytes of every message are read back, through the indexes and without them."""
    info, written = closed(tmp_path / 'bag_0.mcap', 300, compression=compression, sync_every=70)
    assert indexed(info.path) == in_order(info.path) == written
    check(info.path)


def test_the_returned_info_describes_the_file(tmp_path: Path) -> None:
    """Size, SHA-256, times, counts and channels are those of the file that was closed."""
    info, written = closed(tmp_path / 'bag_0.mcap', 100)
    content = info.path.read_bytes()
    assert (info.bytes, info.sha256) == (len(content), hashlib.sha256(content).hexdigest())
    assert (info.t_start_ns, info.t_end_ns, info.messages) == (written[0].log_ns, written[-1].log_ns, 100)
    assert info.counts == {'/talk': 34, '/echo': 33, '/blob': 33}
    assert tuple(info.channels) == (TALK, ECHO, BLOB)
    assert info.damage is None


def test_the_summary_is_as_rosbag2_writes_it(tmp_path: Path) -> None:
    """Profile, encodings, channel metadata and the metadata record are where rosbag2's storage plug-in looks for them."""
    info, _ = closed(tmp_path / 'bag_0.mcap', 10)
    with info.path.open('rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == 'ros2'
        assert summary is not None
        assert [(one.name, one.encoding, one.data) for one in summary.schemas.values()] == [
            (TALK.type, 'ros2msg', TALK.definition.encode()), (BLOB.type, '', b''),
        ]  # fmt: skip
        assert [(one.topic, one.message_encoding, one.metadata) for one in summary.channels.values()] == [
            ('/talk', 'cdr', {'topic_type_hash': TALK.type_hash}),
            ('/echo', 'cdr', {'offered_qos_profiles': ECHO.qos, 'topic_type_hash': ECHO.type_hash}), ('/blob', 'cdr', {}),
        ]  # fmt: skip
        assert summary.statistics is not None
        assert summary.statistics.channel_message_counts == {1: 4, 2: 3, 3: 3}
        (record,) = reader.iter_metadata()
    assert record.name == 'rosbag2'
    assert 'version: 8' in record.metadata['serialized_metadata']


def test_a_file_gets_its_name_when_it_is_complete(tmp_path: Path) -> None:
    """The file is ``.open`` until it is closed, and neither name is ever taken from another file."""
    path = tmp_path / 'bag_0.mcap'
    writer = SliceWriter(path)
    assert [one.name for one in tmp_path.iterdir()] == ['bag_0.mcap.open']
    with pytest.raises(FileExistsError):
        SliceWriter(path)
    writer.close()
    assert [one.name for one in tmp_path.iterdir()] == ['bag_0.mcap']
    with pytest.raises(FileExistsError):
        SliceWriter(path)


def test_a_sync_leaves_nothing_in_memory(tmp_path: Path) -> None:
    """What was written before a sync is in the file, what came after it and made no chunk is not."""
    path = tmp_path / 'bag_0.mcap'
    writer = SliceWriter(path)
    written = fill(writer, messages(50))
    writer.sync()
    size = writer.size
    assert size == (tmp_path / 'bag_0.mcap.open').stat().st_size
    writer.sync()  # nothing new: no empty chunk
    assert writer.size == size
    fill(writer, messages(3))
    assert writer.size > size
    writer.abort()
    assert in_order(recover(tmp_path / 'bag_0.mcap.open').path) == written


def test_a_chunk_ends_automatically(tmp_path: Path) -> None:
    """No chunk has more bytes than it may have, but for a single message that is larger."""
    writer = SliceWriter(tmp_path / 'bag_0.mcap', compression='none', chunk_bytes=1000)
    written = fill(writer, messages(40, size=100))
    written += fill(writer, messages(1, size=50_000))
    written += fill(writer, messages(9, size=100))
    info = writer.close()
    assert in_order(info.path) == written
    with info.path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert sizes == [7 * 131] * 5 + [5 * 131, 50_031, 7 * 131, 2 * 131]
    check(info.path)


def test_incompressible_chunks_are_stored(tmp_path: Path) -> None:
    """A chunk that zstd does not make smaller (images) is stored uncompressed, so readers need not unpack it."""
    noise = random.Random(1).randbytes(20_000)
    writer = SliceWriter(tmp_path / 'bag_0.mcap', compression='zstd')
    writer.write(BLOB, 1, 1, 0, noise)
    writer.sync()
    writer.write(BLOB, 2, 2, 0, bytes(20_000))
    info = writer.close()
    with info.path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert [chunk.compression for chunk in summary.chunk_indexes] == ['', 'zstd']
    assert [one.cdr for one in indexed(info.path)] == [noise, bytes(20_000)]


def test_invalid_stamps_are_replaced(tmp_path: Path) -> None:
    """A publisher's stamp that is not known is the log time, a time before 1970 is 1970, a sequence wraps."""
    writer = SliceWriter(tmp_path / 'bag_0.mcap')
    writer.write(TALK, 50, 0, (1 << 32) + 7, b'1234')
    writer.write(TALK, -3, -5, 0, b'1234')
    info = writer.close()
    assert indexed(info.path) == [Recorded('/talk', 0, 0, 0, b'1234'), Recorded('/talk', 50, 50, 7, b'1234')]


def test_a_topic_may_change_its_type(tmp_path: Path) -> None:
    """Each message is decoded with the type it was published with, on a channel with its QoS."""
    other = Channel('/talk', 'std_msgs/msg/Empty', 'ros2msg', '', '', '')
    again = Channel('/talk', TALK.type, 'ros2msg', STRING_WITH_COMMENT, '', '- history: 1\n')
    writer = SliceWriter(tmp_path / 'bag_0.mcap')
    for number, channel in enumerate([TALK, other, again, TALK, other]):
        writer.write(channel, number, number, 0, b'1234')
    info = writer.close()
    with info.path.open('rb') as file:
        types = [schema.name for schema, _, _ in make_reader(file).iter_messages() if schema]
    assert types == [TALK.type, other.type, TALK.type, TALK.type, other.type]
    assert info.counts == {'/talk': 5}
    assert info.channels == {TALK: 2, other: 2, again: 1}


STRING_WITH_COMMENT = '# the same\nstring data\n'


def test_a_slice_without_messages_is_complete(tmp_path: Path) -> None:
    """A slice without messages is a complete file too."""
    info = SliceWriter(tmp_path / 'bag_0.mcap').close()
    assert indexed(info.path) == in_order(info.path) == []
    assert (info.messages, info.t_start_ns, info.t_end_ns, info.counts) == (0, 0, 0, {})
    check(info.path)


def test_a_full_disk_keeps_what_was_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full in the middle of a chunk is an OSError, and what was synced before it is recovered."""
    writer = SliceWriter(tmp_path / 'bag_0.mcap')
    written = fill(writer, messages(30))
    writer.sync()
    fill(writer, messages(30))
    write, calls = os.write, iter([10])

    def full(file: int, data: memoryview) -> int:
        count = next(calls, 0)
        if not count:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data[:count])

    monkeypatch.setattr(os, 'write', full)
    with pytest.raises(OSError, match='No space'):
        writer.sync()
    monkeypatch.undo()
    writer.abort()
    writer.abort()
    info = recover(tmp_path / 'bag_0.mcap.open')
    assert in_order(info.path) == written
    assert info.damage is not None
    assert info.damage.tail_bytes == 10


def test_an_unknown_compression_is_refused(tmp_path: Path) -> None:
    """Nothing is created if the compression is unknown."""
    with pytest.raises(ValueError, match='lz4'):
        SliceWriter(tmp_path / 'bag_0.mcap', compression='lz4')
    assert not list(tmp_path.iterdir())


def test_metadata_records_may_be_between_messages(tmp_path: Path) -> None:
    """Other readers list the records and read the messages; so does recovery, of a slice that was not closed."""
    for name in ('closed', 'killed'):
        writer = SliceWriter(tmp_path / f'{name}.mcap', compression='none')
        writer.add_metadata('of_mine', {'number': '0'})
        written = fill(writer, messages(10))
        writer.add_metadata('of_mine', {'number': '1', 'text': 'ü' * 1000})
        written += fill(writer, list(messages(20))[10:])
        writer.sync()
        assert [report['number'] for report in read_metadata(tmp_path / f'{name}.mcap.open', 'of_mine')] == ['0', '1']
        if name == 'closed':
            writer.close()
        else:
            writer.abort()
            assert recover(tmp_path / 'killed.mcap.open').damage == Damage(0, 0, 0)
        path = tmp_path / f'{name}.mcap'
        assert in_order(path) == indexed(path) == written
        check(path)
        with path.open('rb') as file:
            reader = make_reader(file)
            assert [one.name for one in reader.iter_metadata()] == ['of_mine', 'of_mine', 'rosbag2']
            assert reader.get_summary().statistics.metadata_count == 3  # type: ignore[union-attr]
        assert [report['number'] for report in read_metadata(path, 'of_mine')] == ['0', '1']
    assert (tmp_path / 'closed.mcap').stat().st_size == (tmp_path / 'killed.mcap').stat().st_size
    torn = (tmp_path / 'closed.mcap').read_bytes()[:100]
    (tmp_path / 'torn').write_bytes(torn)
    assert len(list(read_metadata(tmp_path / 'torn', 'of_mine'))) == 1
