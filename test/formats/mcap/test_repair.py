"""Repair: whatever was done to a file of any writer, what is intact is copied, the copy is valid, and what is lost is listed."""

from __future__ import annotations

import io
import os
import random
import struct
import tracemalloc
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from bags.slices import closed, indexed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer
from mcap.writer import Writer as McapWriter
from profiles import examples
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.zstd import compress
from shadowhound_data_logger.formats.mcap.format import CHUNK, head, record, text
from shadowhound_data_logger.formats.mcap.repair import WRONG_DATA, McapRepair, examine, repair

NOON_NS = 1_760_788_800_000_000_000
MESSAGES, A_CHUNK = 24, 6


class Found(NamedTuple):
    """A message with all that is needed to decode it."""

    topic: str
    encoding: str
    schema: tuple[str, str, bytes] | None
    metadata: tuple[tuple[str, str], ...]
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes


def write(path: Path, compression: CompressionType = CompressionType.NONE, *, chunked: bool = True, crcs: bool = True,
          indexes: IndexType = IndexType.ALL, summary: bool = True) -> None:  # fmt: skip
    """Three channels (two on one topic, one without a schema), a binary schema, an attachment and metadata in the middle."""
    size = 330 if chunked else 1 << 20
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=size, compression=compression, use_chunking=chunked, enable_crcs=crcs,
                        index_types=indexes, use_statistics=summary, use_summary_offsets=summary,
                        repeat_channels=summary, repeat_schemas=summary)  # fmt: skip
        writer.start('x-test', 'foreign')
        schema = writer.register_schema('pkg.Type', 'protobuf', b'\xff\x00binary\x80')
        channels = [
            writer.register_channel('no/slash', 'protobuf', schema, {'key': 'value'}),
            writer.register_channel('no/slash', 'protobuf', schema, {'key': 'other'}),
            writer.register_channel('/json', 'json', 0),
        ]
        for number in range(MESSAGES):
            at = NOON_NS + number * 1_000_000
            writer.add_message(channels[number % 3], at, bytes([number]) * 20, at - 500, number)
            if number == MESSAGES // 2:
                writer.add_attachment(NOON_NS, NOON_NS, 'notes.txt', 'text/plain', b'0123456789')
                writer.add_metadata('weather', {'sky': 'clear'})
        writer.finish()


def messages(path: Path, *, seeking: bool = True) -> list[Found]:
    """By the reference reader, with all checksums verified."""
    with path.open('rb') as file:
        if seeking:
            reader: SeekingReader | NonSeekingReader = SeekingReader(file, validate_crcs=True)
        else:
            reader = NonSeekingReader(file, validate_crcs=True)
        return [
            Found(channel.topic, channel.message_encoding, schema and (schema.name, schema.encoding, schema.data),
                  tuple(channel.metadata.items()), message.log_time, message.publish_time, message.sequence, message.data)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]  # fmt: skip


def check(path: Path) -> list[Found]:
    """The messages of a file that is valid: both ways of reading find the same, and the statistics count it."""
    found = messages(path)
    assert Counter(found) == Counter(messages(path, seeking=False))
    with path.open('rb') as file:
        reader = SeekingReader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(found)
        assert sum(summary.statistics.channel_message_counts.values()) == len(found)
        assert summary.statistics.attachment_count == len(list(reader.iter_attachments())) == len(summary.attachment_indexes)
        assert summary.statistics.metadata_count == len(list(reader.iter_metadata()))
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
    return found


class Span(NamedTuple):
    """Where the last byte of a chunk, or of a message outside of chunks, ends, and the numbers of its messages."""

    end: int
    sequences: frozenset[int]


def spans(content: bytes) -> list[Span]:
    """Of an intact file."""
    found: list[Span] = []
    file = io.BytesIO(content)
    for found_record in StreamReader(file, emit_chunks=True).records:
        if isinstance(found_record, Chunk):
            inner = frozenset(each.sequence for each in breakup_chunk(found_record) if isinstance(each, Message))
            found.append(Span(file.tell(), inner))
        elif isinstance(found_record, Message):
            found.append(Span(file.tell(), frozenset({found_record.sequence})))
        elif isinstance(found_record, (Footer, Schema)):
            continue
    return found


HOSTILE = settings(max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
MEBI = 1 << 20


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, 'fsync', lambda _: None)


def repaired(folder: Path, content: bytes, *, unverified: bool = False) -> tuple[McapRepair | None, list[Found]]:
    """Of a file with this content: what was reported, and the messages of the copy, which is valid; of no MCAP file nothing."""
    torn, out = folder / 'torn.mcap', folder / 'out.mcap'
    torn.write_bytes(content)
    out.unlink(missing_ok=True)
    try:
        found = repair(torn, out, unverified=unverified)
    except BagDamaged:
        assert not out.exists()
        return None, []
    assert torn.read_bytes() == content
    held = check(out)
    assert found.info.messages == len(held) == sum(found.info.counts.values())
    assert found.info.bytes == out.stat().st_size
    return found, held


KINDS: dict[str, dict[str, Any]] = {
    'none': {}, 'lz4': {'compression': CompressionType.LZ4}, 'zstd': {'compression': CompressionType.ZSTD},
    'no message index': {'indexes': IndexType.CHUNK}, 'not chunked': {'chunked': False}, 'no checksums': {'crcs': False},
    'no summary': {'summary': False}, 'no index': {'indexes': IndexType.NONE},
}  # fmt: skip
MORE = pytest.mark.long('thousands of repairs')
SWEPT = [pytest.param(kind, marks=() if kind == 'lz4' else MORE) for kind in KINDS]


def written(folder: Path, kind: str) -> tuple[bytes, list[Found]]:
    path = folder / 'intact.mcap'
    write(path, **KINDS[kind])
    return path.read_bytes(), messages(path, seeking=False)


@pytest.mark.parametrize('kind', KINDS)
def test_an_intact_file_is_intact(tmp_path: Path, kind: str) -> None:
    """Nothing is reported of it, and a copy has the same messages, header, attachments and metadata."""
    _, ours = written(tmp_path, kind)
    assert not examine(tmp_path / 'intact.mcap').is_damaged
    repair(tmp_path / 'intact.mcap', tmp_path / 'copy.mcap')
    assert check(tmp_path / 'copy.mcap') == ours
    assert not examine(tmp_path / 'copy.mcap').is_damaged
    with (tmp_path / 'copy.mcap').open('rb') as file:
        reader = SeekingReader(file)
        assert [(each.name, each.data) for each in reader.iter_attachments()] == [('notes.txt', b'0123456789')]
        assert [(each.name, each.metadata) for each in reader.iter_metadata()] == [('weather', {'sky': 'clear'})]
        assert (reader.get_header().profile, reader.get_header().library) == ('x-test', 'foreign')


def swept(content: bytes) -> list[int]:
    """Every place in a file; without SHADOWHOUND_TEST_LONG every seventh, and the last."""
    return [*range(0, len(content) - 1, 1 if os.environ.get('SHADOWHOUND_TEST_LONG') else 7), len(content) - 1]


@pytest.mark.parametrize('kind', SWEPT)
def test_a_file_cut_at_any_byte_keeps_every_complete_chunk(tmp_path: Path, kind: str) -> None:
    """Every message whose chunk is complete is recovered, nothing else than what was written, and the damage is reported."""
    content, ours = written(tmp_path, kind)
    complete, most = spans(content), 0
    for length in swept(content):
        found, held = repaired(tmp_path, content[:length])
        expected = {number for span in complete if span.end <= length for number in span.sequences}
        assert {each.sequence for each in held} >= expected, length
        assert set(held) <= set(ours)
        assert len(held) >= most
        most = len(held)
        assert found is None or found.is_damaged
    assert most == MESSAGES


@pytest.mark.parametrize('mode', [pytest.param(CompressionMode.NONE, marks=MORE), CompressionMode.STORAGE])
def test_a_file_of_rosbags_cut_at_any_byte_keeps_every_complete_chunk(tmp_path: Path, mode: CompressionMode) -> None:
    """Its chunks have no checksum; both packages read what is recovered."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = RosbagsWriter(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    kind = store.types['std_msgs/msg/String']
    with writer:
        connection = writer.add_connection('/talk', 'std_msgs/msg/String', typestore=store)
        for number in range(20):
            writer.write(connection, NOON_NS + number, store.serialize_cdr(kind(f'{number}' * 5), kind.__msgtype__))
    content = (tmp_path / 'bag' / 'bag.mcap').read_bytes()
    complete = spans(content)
    for length in swept(content):
        _, held = repaired(tmp_path, content[:length])
        assert len(held) >= sum(len(span.sequences) for span in complete if span.end <= length)
        assert [each.log_ns for each in held] == [NOON_NS + number for number in range(len(held))]
        if held and not length % 21:
            with Reader(tmp_path / 'out.mcap') as reader:
                assert sum(1 for _ in reader.messages()) == len(held)


@pytest.mark.parametrize('kind', SWEPT)
def test_a_flipped_bit_costs_at_most_its_chunk(tmp_path: Path, kind: str) -> None:
    """In every byte: the messages of other chunks are recovered; with checksums nothing that was not written is in the copy.

    Without a summary the first chunk alone has the declarations of the others.
    """
    content, ours = written(tmp_path, kind)
    complete = spans(content)
    starts = [0, *(span.end for span in complete)]
    rng = random.Random(5)
    for at in swept(content):
        damaged = bytearray(content)
        damaged[at] ^= 1 << rng.randrange(8)
        found, held = repaired(tmp_path, bytes(damaged))
        assert found is not None
        assert kind in {'not chunked', 'no checksums', 'no summary'} or set(held) <= set(ours), at
        there = {each.sequence for each in held}
        for start, span in zip(starts, complete, strict=False):
            if len(span.sequences) > 1 and not start <= at < span.end and (kind != 'no summary' or at > complete[0].end):
                assert there >= span.sequences, (at, span)


@HOSTILE
@given(st.data())
def test_added_or_removed_bytes_cost_at_most_their_chunk(tmp_path: Path, data: st.DataObject) -> None:
    """In the middle: what comes before and after in other chunks is recovered."""
    content, ours = written(tmp_path, 'lz4')
    at, more = data.draw(st.integers(50, len(content) - 1)), data.draw(st.binary(max_size=40))
    gone = data.draw(st.integers(0, 40))
    found, held = repaired(tmp_path, content[:at] + more + content[at + gone :])
    assert found is not None
    assert set(held) <= set(ours)
    complete = spans(content)
    for start, span in zip([0, *(each.end for each in complete)], complete, strict=False):
        if span.end <= at or at + gone <= start:
            assert {each.sequence for each in held} >= span.sequences


def test_damage_outside_of_chunks_is_dated_by_its_neighbors(tmp_path: Path) -> None:
    """It is dated by the messages around it, and how many were there is unknown."""
    content, ours = written(tmp_path, 'not chunked')
    ends = [span.end for span in spans(content)]
    noise = random.Random(4).randbytes(3000)
    found, held = repaired(tmp_path, content[: ends[7] + 10] + noise + content[ends[9] :])
    assert found is not None
    assert held == ours[:8] + ours[10:]
    (loss,) = found.losses
    assert (loss.messages, loss.from_ns, loss.to_ns) == (None, ours[7].log_ns, ours[10].log_ns)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """With one to five kinds of damage at one to five places."""
    found = bytearray(content)
    for _ in range(rng.randrange(1, 6)):
        at, kind, other = rng.randrange(len(found)), rng.randrange(6), rng.randrange(len(content))
        if kind == 0:
            found[at] = rng.randrange(256)
        elif kind == 1:
            del found[at : at + rng.randrange(1, 200)]
        elif kind == 2:
            found[at:at] = rng.randbytes(rng.randrange(1, 200))
        elif kind == 3:
            found[at : at + rng.randrange(1, 100)] = bytes(rng.randrange(1, 100))
        elif kind == 4:
            found[at:at] = content[other : other + rng.randrange(1, 800)]
        else:
            found[at : at + 8] = rng.choice([b'\xff' * 8, (1 << 63).to_bytes(8, 'little'), bytes(8)])
    return bytes(found)


@pytest.mark.parametrize('kind', KINDS)
def test_damage_of_any_kind_gives_a_valid_copy_or_an_error(tmp_path: Path, kind: str) -> None:
    """The copy is valid, or the file is refused; it never fails in another way."""
    content, _ = written(tmp_path, kind)
    rng = random.Random(kind)
    for _ in range(examples(50)):
        repaired(tmp_path, mutated(content, rng), unverified=rng.random() < 0.2)


@pytest.mark.parametrize('tail', [b'\0' * 5000, b'\xff' * 300, random.Random(3).randbytes(70_000), b'\x89MCAP0\r\n' * 3])
def test_bytes_after_the_end_are_ignored(tmp_path: Path, tail: bytes) -> None:
    """They are no part of the copy, and no message is lost."""
    content, ours = written(tmp_path, 'zstd')
    found, held = repaired(tmp_path, content + tail)
    assert found is not None
    assert held == ours
    assert [(loss.at, loss.bytes, loss.messages) for loss in found.losses] == [(len(content), len(tail), 0)]
    assert (found.lost_messages, found.is_cut) == (0, False)


@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_a_torn_chunk_gives_what_can_be_unpacked(tmp_path: Path, compression: CompressionType) -> None:
    """The messages up to the tear, at most a block of the compression less; how many followed is unknown."""
    path = tmp_path / 'large.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file, chunk_size=4 << 20, compression=compression)
        writer.start('ros2')
        channel = writer.register_channel('/t', 'cdr', writer.register_schema('a/msg/A', 'ros2msg', b''))
        noise = random.Random(1)
        for number in range(1000):
            writer.add_message(channel, NOON_NS + number, noise.randbytes(2000), NOON_NS, number)
        writer.finish()
    found, held = repaired(tmp_path, path.read_bytes()[: path.stat().st_size // 2])
    assert found is not None
    assert 400 < len(held) < 600
    assert held == messages(path)[: len(held)]
    (loss,) = found.losses
    assert (loss.what, loss.messages, found.lost_messages, found.is_cut) == ('a truncated chunk', None, None, True)
    assert (loss.from_ns, loss.to_ns) == (NOON_NS, NOON_NS + 999)


def test_a_wrong_checksum_is_reported(tmp_path: Path) -> None:
    """Its messages are lost, counted and dated, unless they are requested."""
    content, ours = written(tmp_path, 'none')
    at = content.index(bytes([9]) * 20)
    content = content[:at] + b'\0' + content[at + 1 :]
    found, held = repaired(tmp_path, content)
    assert found is not None
    lost = set(ours) - set(held)
    (loss,) = found.losses
    assert 9 in {each.sequence for each in lost}
    assert (loss.messages, found.lost_messages, found.unverified) == (len(lost), len(lost), len(lost))
    assert (loss.from_ns, loss.to_ns) == (min(each.log_ns for each in lost), max(each.log_ns for each in lost))
    found, held = repaired(tmp_path, content, unverified=True)
    assert found is not None
    assert {each.sequence for each in held} == set(range(MESSAGES))
    assert (found.lost_messages, found.unverified) == (0, len(lost))


def test_a_wrong_checksum_of_the_data_section_is_reported(tmp_path: Path) -> None:
    """Where it is all there is, the file is reported, though nothing says what is wrong in it."""
    path = tmp_path / 'data.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file, use_chunking=False, enable_data_crcs=True)
        writer.start()
        channel = writer.register_channel('/t', 'json', 0)
        for number in range(5):
            writer.add_message(channel, number, b'content', number, number)
        writer.finish()
    assert not examine(path).is_damaged
    path.write_bytes(path.read_bytes().replace(b'content', b'CONTENT', 1))
    assert [loss.what for loss in examine(path).losses] == [WRONG_DATA]


def test_unknown_records_are_copied(tmp_path: Path) -> None:
    """Private ones and those of a later version of the format, wherever they are."""
    content, ours = written(tmp_path, 'zstd')
    unknown = record(0x90, b'private') + record(0x45, b'later')
    at = len(content[: content.index(b'\x06', 30)])
    found, held = repaired(tmp_path, content[:at] + unknown + content[at:-100])
    assert found is not None
    assert held == ours
    assert unknown in (tmp_path / 'out.mcap').read_bytes()


def test_the_summary_of_a_closed_slice_corrects_its_channels(tmp_path: Path) -> None:
    """Channels outside of chunks have no checksum: the summary, which has one, corrects them."""
    info, done = closed(tmp_path / 'bag_0.mcap', 30)
    content = info.path.read_bytes().replace(b'/echo', b'/ECHO', 1)
    (tmp_path / 'damaged.mcap').write_bytes(content)
    found = repair(tmp_path / 'damaged.mcap', tmp_path / 'out.mcap')
    assert found.rebuilt == ('schemas and channels, from the summary',)
    assert indexed(tmp_path / 'out.mcap') == done
    assert set(found.info.counts) == {'/talk', '/echo', '/blob'}


@HOSTILE
@given(st.lists(st.tuples(st.integers(0, 255), st.sampled_from([0, 1, 22, 1 << 31, 1 << 62, (1 << 64) - 1]),
                          st.binary(max_size=80)), max_size=12))  # fmt: skip
def test_records_of_any_kind_never_fail(tmp_path: Path, records: list[tuple[int, int, bytes]]) -> None:
    """Lengths up to 2^64 and noise for content never fail."""
    body = b''.join(
        struct.pack('<BQ', op, length if number % 3 == 2 else len(content)) + content
        for number, (op, length, content) in enumerate(records)
    )
    repaired(tmp_path, head() + body)


@pytest.mark.parametrize('claimed', [1000, 100 * MEBI, 1 << 62])
def test_a_decompression_bomb_takes_the_memory_of_a_chunk(tmp_path: Path, claimed: int) -> None:
    """What unpacks to a gigabyte takes the memory of a chunk at most, and no time to speak of."""
    bomb = compress(bytes(64 * MEBI), 1)
    fields = CHUNK.pack(1, 1, claimed, zlib.crc32(b'x')) + text('zstd') + struct.pack('<Q', len(bomb))
    channel = record(Opcode.CHANNEL, struct.pack('<HH', 1, 0), text('/t'), text('cdr'), struct.pack('<I', 0))
    tracemalloc.start()
    repaired(tmp_path, head() + channel + record(Opcode.CHUNK, fields, bomb) * 3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < (260 if claimed == 100 * MEBI else 20) * MEBI


def test_the_search_has_an_end(tmp_path: Path) -> None:
    """Bytes that look like chunks at every place are given up after a few passes over the file."""
    fake = struct.pack('<BQ', Opcode.CHUNK, 300_000) + CHUNK.pack(0, 0, 100, 7) + struct.pack('<IQ', 0, 300_000 - 40)
    found, held = repaired(tmp_path, written(tmp_path, 'none')[0][:900] + fake * 20_000)
    assert found is not None
    assert held
    assert found.losses
