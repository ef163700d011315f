"""Recovery of slices: after any damage or kill a slice is readable, in bounded memory; infos of complete files."""

from __future__ import annotations

import os
import random
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import pytest
from bags.slices import TALK, check, closed, fill, in_order, indexed, messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
from profiles import examples
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap import damage_scan, record_finder, recovery
from shadowhound_data_logger.formats.mcap.format import CHUNK, Contents, head, record, text
from shadowhound_data_logger.formats.mcap.recovery import read_info, recover
from shadowhound_data_logger.formats.mcap.slice_info import Damage, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

COUNT, A_CHUNK = 60, 12
HOSTILE = settings(max_examples=examples(60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip syncs for hundreds of files that need not survive the machine."""
    for name in ('fsync', 'fdatasync'):
        monkeypatch.setattr(os, name, lambda _: None)


@pytest.fixture(scope='module')
def opened(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A slice as a killed process leaves it: five chunks, the last of them synced."""
    folder = tmp_path_factory.mktemp('opened')
    writer = SliceWriter(folder / 'bag_0.mcap', compression='none')
    fill(writer, messages(COUNT), sync_every=A_CHUNK)
    writer.abort()
    return (folder / 'bag_0.mcap.open').read_bytes()


WRITTEN = [one for _, one in messages(COUNT)]


def recovered(folder: Path, content: bytes) -> SliceInfo:
    """A recovered slice with this content; checked by readers."""
    (folder / 'bag_0.mcap').unlink(missing_ok=True)
    (folder / 'bag_0.mcap.open').write_bytes(content)
    info = recover(folder / 'bag_0.mcap.open')
    assert [one.name for one in folder.iterdir()] == ['bag_0.mcap']
    assert info.bytes == info.path.stat().st_size
    found = in_order(info.path)
    assert indexed(info.path) == sorted(found, key=lambda one: one.log_ns)
    assert info.messages == len(found) == sum(info.counts.values())
    check(info.path)
    return info


def test_a_killed_writer_loses_its_open_chunk(tmp_path: Path, opened: bytes) -> None:
    """Everything synced is there, and nothing is reported as damaged."""
    info = recovered(tmp_path, opened)
    assert in_order(info.path) == WRITTEN
    assert info.damage == Damage(0, 0, 0)


def test_a_recovered_slice_is_a_closed_one(tmp_path: Path, opened: bytes) -> None:
    """Byte for byte what the writer would have written, with the same SHA-256, times, counts and channels."""
    info, _ = closed(tmp_path / 'bag_0.mcap', COUNT, sync_every=A_CHUNK)
    content = info.path.read_bytes()
    again = recovered(tmp_path, opened)
    assert again.path.read_bytes() == content
    assert again.sha256 == info.sha256
    assert (again.t_start_ns, again.t_end_ns, again.counts, again.channels) == (
        info.t_start_ns, info.t_end_ns, info.counts, info.channels,
    )  # fmt: skip


@HOSTILE
@given(st.data())
def test_a_file_cut_off_anywhere_keeps_its_complete_chunks(tmp_path: Path, opened: bytes, data: st.DataObject) -> None:
    """The complete chunks from the beginning are kept; at most one chunk is torn, and its bytes are reported."""
    length = data.draw(st.integers(0, len(opened)))
    info = recovered(tmp_path, opened[:length])
    found = in_order(info.path)
    assert found == WRITTEN[: len(found)]
    assert not len(found) % A_CHUNK
    assert info.damage is not None
    assert info.damage.chunks == 0
    more = recovered(tmp_path, opened[: length + info.damage.tail_bytes])
    assert more.messages >= info.messages


@HOSTILE
@given(st.data())
def test_a_flipped_byte_costs_its_chunk(tmp_path: Path, opened: bytes, data: st.DataObject) -> None:
    """Nothing is read that was not written: a chunk with a wrong checksum is skipped and reported."""
    at, flipped = data.draw(st.integers(0, len(opened) - 1)), data.draw(st.integers(1, 255))
    content = bytearray(opened)
    content[at] ^= flipped
    info = recovered(tmp_path, bytes(content))
    found = in_order(info.path)
    assert info.damage is not None
    if info.damage == Damage(0, 0, 0):
        assert [one[1:] for one in found] == [one[1:] for one in WRITTEN]  # a topic's name has no checksum
    else:
        assert {one[1:] for one in found} < {one[1:] for one in WRITTEN}


@pytest.mark.parametrize('op', [*range(0x12), 0x7F])
def test_a_chunk_with_another_opcode_is_skipped(tmp_path: Path, opened: bytes, op: int) -> None:
    """It is found by its fields and its checksum, whatever the first byte of its record is now."""
    at = [place for place in range(len(opened)) if opened[place : place + 9] == opened[opened.index(b'\x06') :][:9]][2]
    content = bytearray(opened)
    content[at] = op
    info = recovered(tmp_path, bytes(content))
    assert (info.messages, info.damage) == (COUNT, Damage(0, 0, 0))


def test_a_broken_chunk_in_the_middle_costs_only_itself(tmp_path: Path, opened: bytes) -> None:
    """Those after it are kept, and its messages are counted by the index that follows it."""
    marked = WRITTEN[A_CHUNK + 1].cdr
    content = opened.replace(marked, bytes(len(marked)))
    assert content != opened
    info = recovered(tmp_path, content)
    assert in_order(info.path) == WRITTEN[:A_CHUNK] + WRITTEN[2 * A_CHUNK :]
    assert info.damage == Damage(tail_bytes=0, chunks=1, messages=A_CHUNK)


def test_a_broken_index_is_rebuilt(tmp_path: Path, opened: bytes) -> None:
    """Index entries that point elsewhere are ignored: they are rebuilt from the chunk."""
    entry = WRITTEN[A_CHUNK].log_ns.to_bytes(8, 'little')
    at = opened.rindex(entry)
    content = opened[:at] + bytes(8) + opened[at + 8 :]
    assert in_order(recovered(tmp_path, content).path) == WRITTEN


@pytest.mark.parametrize('tail', [bytes(5000), b'\xff' * 300, random.Random(3).randbytes(70_000)], ids=['zeros', 'ones', 'noise'])
def test_any_bytes_at_the_end_are_cut_off(tmp_path: Path, opened: bytes, tail: bytes) -> None:
    """Bytes that a file system leaves after a power cut are removed."""
    info = recovered(tmp_path, opened + tail)
    assert in_order(info.path) == WRITTEN
    assert info.damage == Damage(len(tail), 0, 0)


@pytest.mark.parametrize('content', [b'', b'\x89MCAP', bytes(100), b'no bag at all' * 50])
def test_a_file_without_intact_chunks_becomes_an_empty_slice(tmp_path: Path, content: bytes) -> None:
    """A file without one whole chunk becomes an empty slice."""
    assert recovered(tmp_path, content).messages == 0


def test_a_half_closed_slice_is_recovered(tmp_path: Path, opened: bytes) -> None:
    """A kill while the ending is written costs nothing: it is written again."""
    info, _ = closed(tmp_path / 'bag_0.mcap', COUNT, sync_every=A_CHUNK)
    content = info.path.read_bytes()
    for length in range(len(opened), len(content) + 1, 61):
        again = recovered(tmp_path, content[:length])
        assert again.path.read_bytes() == content
        assert again.damage == Damage(0, 0, 0)


def test_a_channel_that_only_the_summary_has_is_kept(tmp_path: Path, opened: bytes) -> None:
    """Nothing can be inserted into a slice in place: the messages of a channel whose record is damaged are lost, and counted."""
    info, _ = closed(tmp_path / 'bag_0.mcap', COUNT, sync_every=A_CHUNK)
    content = bytearray(info.path.read_bytes())
    content[content.index(b'/echo') - 4] ^= 0xFF
    info = recovered(tmp_path, bytes(content))
    assert info.messages == 0
    assert info.damage is not None
    assert info.damage.chunks + info.damage.tail_bytes > 0


class Killed(BaseException):
    """An exception that no handler may catch."""


@pytest.mark.parametrize('after', range(5))
def test_a_killed_recovery_is_repeated(tmp_path: Path, opened: bytes, after: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recovery interrupted at any step, also within a write, is repeated with the same result."""
    marked = WRITTEN[A_CHUNK + 1].cdr
    content = opened.replace(marked, bytes(len(marked)))[:-100]
    wanted = recovered(tmp_path, content).path.read_bytes()
    (tmp_path / 'bag_0.mcap').unlink()
    left = after

    def step(name: str) -> Any:
        real = getattr(os, name)

        def call(*arguments: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                if name == 'pwrite':
                    file, view, at = arguments
                    real(file, view[: len(view) // 2], at)
                raise Killed
            return real(*arguments)

        return call

    for name in ('pwrite', 'ftruncate', 'replace'):
        monkeypatch.setattr(os, name, step(name))
    (tmp_path / 'bag_0.mcap.open').write_bytes(content)
    with pytest.raises(Killed):
        recover(tmp_path / 'bag_0.mcap.open')
    left = 1000
    info = recover(tmp_path / 'bag_0.mcap.open')
    assert info.path.read_bytes() == wanted


PROGRAM = """
import sys
from pathlib import Path
from bags.slices import fill, messages
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
writer = SliceWriter(Path(sys.argv[1]), chunk_bytes=2000)
while True:
    fill(writer, messages(37))
    writer.sync()
    print(37, flush=True)
"""


@pytest.mark.parametrize('after', [1, 3, 20])
def test_a_killed_writer_loses_nothing_that_was_synced(tmp_path: Path, after: int) -> None:
    command = [sys.executable, '-c', PROGRAM, str(tmp_path / 'bag_0.mcap')]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, env={**os.environ, 'PYTHONPATH': str(Path(__file__).parents[2])}
    ) as writer:
        assert writer.stdout is not None
        synced = sum(int(writer.stdout.readline()) for _ in range(after))
        writer.kill()
        synced += sum(int(line) for line in writer.stdout.read().splitlines())
    info = recover(tmp_path / 'bag_0.mcap.open')
    found = in_order(info.path)
    assert len(found) >= synced >= after * 37
    assert found == [one for number in range(len(found) // 37 + 1) for one in WRITTEN[:37]][: len(found)]


def test_names_are_kept_apart(tmp_path: Path, opened: bytes) -> None:
    """A file that is not an open slice is refused, and a complete slice is never overwritten."""
    (tmp_path / 'bag_0.mcap.open').write_bytes(opened)
    (tmp_path / 'bag_0.mcap').write_bytes(b'whole')
    with pytest.raises(FileExistsError):
        recover(tmp_path / 'bag_0.mcap.open')
    with pytest.raises(ValueError, match='not an open slice'):
        recover(tmp_path / 'bag_0.mcap')
    assert (tmp_path / 'bag_0.mcap').read_bytes() == b'whole'
    assert (tmp_path / 'bag_0.mcap.open').read_bytes() == opened


def test_the_info_of_a_slice_is_what_closing_it_returned(tmp_path: Path) -> None:
    info, _ = closed(tmp_path / 'bag_0.mcap', 70, compression='zstd', sync_every=30)
    assert read_info(info.path, digest=True) == info
    assert read_info(info.path).sha256 == ''
    assert fingerprint(info.path) == (info.bytes, info.sha256)


def test_a_bag_of_the_rosbags_package_is_read(tmp_path: Path) -> None:
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
def test_files_of_other_writers_are_read_without_a_complete_summary(tmp_path: Path, options: dict[str, bool]) -> None:
    """Counts and times are known without statistics, without chunks, without any index: then from its messages."""
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
def test_an_incomplete_file_is_named(tmp_path: Path, content: bytes) -> None:
    """A truncated or foreign file is named."""
    path = tmp_path / 'bag_0.mcap'
    path.write_bytes(content)
    with pytest.raises(BagDamaged, match='bag_0'):
        read_info(path)


if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

LONG = bool(os.environ.get('SHADOWHOUND_TEST_LONG'))
MEBI = 1 << 20
BOUNDED = settings(max_examples=examples(80), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
NUMBERS = st.sampled_from([0, 1, 22, 1 << 15, 1 << 31, 1 << 32, 1 << 62, (1 << 64) - 1])


def recovered_hostile(folder: Path, content: bytes) -> SliceInfo:
    (folder / 'bag_0.mcap').unlink(missing_ok=True)
    (folder / 'bag_0.mcap.open').write_bytes(content)
    return recover(folder / 'bag_0.mcap.open')


def chunk(data: bytes, *, size: int, compression: str = '', crc: int = 0) -> bytes:
    """A chunk record with these fields."""
    fields = CHUNK.pack(1, 1, size, crc) + text(compression) + struct.pack('<Q', len(data))
    return record(Opcode.CHUNK, fields, data)


def declared() -> bytes:
    """A schema and a channel, which a chunk may refer to."""
    return Contents().declare(TALK)[1]


@BOUNDED
@given(st.lists(st.tuples(st.integers(0, 255), NUMBERS, st.binary(max_size=80)), max_size=12))
def test_records_of_any_kind_leave_a_readable_slice(tmp_path: Path, records: list[tuple[int, int, bytes]]) -> None:
    """Records with false lengths, or noise as contents, leave a readable slice."""
    body = b''.join(
        struct.pack('<BQ', op, length if number % 3 == 2 else len(content)) + content
        for number, (op, length, content) in enumerate(records)
    )
    info = recovered_hostile(tmp_path, head() + declared() + body)
    assert in_order(info.path) == []


@BOUNDED
@given(st.binary(max_size=200), NUMBERS, st.sampled_from(['', 'zstd', 'lz4', 'x']), st.booleans())
def test_chunks_of_any_kind_leave_a_readable_slice(tmp_path: Path, data: bytes, size: int, compression: str, packs: bool) -> None:
    """A chunk with a correct checksum whose content is not messages is skipped."""
    packed = zstd.compress(data) if packs else data
    content = chunk(packed, size=len(data) if size == 1 else size, compression=compression, crc=zlib.crc32(data))
    info = recovered_hostile(tmp_path, head() + declared() + content)
    assert info.messages == len(in_order(info.path)) == 0


@pytest.fixture(scope='module')
def bomb() -> bytes:
    """A few kilobytes that unpack to 1 GB."""
    packer = zstd.ZstdCompressor()
    return b''.join(packer.compress(bytes(MEBI)) for _ in range(1024)) + packer.flush()


@pytest.mark.parametrize('claimed', [1000, 300 * MEBI, 1 << 60])
def test_a_chunk_that_unpacks_to_more_takes_no_memory(tmp_path: Path, bomb: bytes, claimed: int) -> None:
    """Unpacking to more than declared, or declaring more than any chunk has, takes no memory."""
    tracemalloc.start()
    info = recovered_hostile(tmp_path, head() + declared() + chunk(bomb, size=claimed, compression='zstd'))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert info.messages == 0
    assert peak < 5 * MEBI


def test_a_chunk_as_large_as_its_file_is_not_loaded(tmp_path: Path) -> None:
    """A record of 2 GB in a sparse file of that size is not read into memory."""
    path = tmp_path / 'bag_0.mcap.open'
    path.write_bytes(head() + struct.pack('<BQ', Opcode.CHUNK, 2 << 30))
    os.truncate(path, len(head()) + 9 + (2 << 30))
    tracemalloc.start()
    info = recover(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert info.damage is not None
    assert info.damage.tail_bytes == 9 + (2 << 30)
    assert peak < 5 * MEBI


def test_a_summary_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Endless tiny chunks or an endless schema are cut off; endless broken records take no memory."""
    for module in (damage_scan, record_finder, recovery):
        monkeypatch.setattr(module, 'MAX_SUMMARY_BYTES', 3000)
    writer = SliceWriter(tmp_path / 'bag_1.mcap', compression='none')
    written = fill(writer, messages(90), sync_every=1)
    writer.abort()
    content = (tmp_path / 'bag_1.mcap.open').read_bytes()
    info = recovered_hostile(tmp_path, content)
    found = in_order(info.path)
    assert 0 < len(found) < 60
    assert found == written[: len(found)]
    assert info.damage is not None
    assert info.damage.tail_bytes > 2000
    schema = record(Opcode.SCHEMA, struct.pack('<H', 1), text('a'), text('b'), text('c' * 4000))
    assert recovered_hostile(tmp_path, head() + schema + declared()).channels == {TALK: 0}
    retired = recovered_hostile(tmp_path, head() + struct.pack('<BQ', 0x86, 0) * 100 + declared())
    assert retired.channels == {TALK: 0}


RECOVER = """
import resource, sys
from pathlib import Path
from shadowhound_data_logger.formats.mcap.recovery import recover
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
info = recover(Path(sys.argv[1]))
print(info.messages, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.parametrize('size', [24 * MEBI, pytest.param(1 << 30, marks=[
    pytest.mark.slow, pytest.mark.long('writes and reads 1 GB'),
])])  # fmt: skip
def test_memory_does_not_grow_with_the_slice(tmp_path: Path, size: int) -> None:
    """A torn slice of a gigabyte is recovered with the memory of a few chunks: 16 MB more than the process had."""
    noise = random.Random(5).randbytes(150_000)
    writer = SliceWriter(tmp_path / 'bag_0.mcap', compression='none')
    count = 0
    while writer.size < size:
        for channel, one in messages(25):
            writer.write(channel, one.log_ns + count, one.publish_ns, count, noise if not count % 25 else one.cdr)
            count += 1
    writer.sync()
    fill(writer, messages(5))
    writer.abort()
    path = tmp_path / 'bag_0.mcap.open'
    os.truncate(path, path.stat().st_size + 100_000)
    ran = subprocess.run([sys.executable, '-c', RECOVER, str(path)], capture_output=True, text=True, check=True, timeout=250)
    found, grown_kb = map(int, ran.stdout.split())
    assert found == count
    assert grown_kb < 16 * 1024
    if not LONG:
        check(tmp_path / 'bag_0.mcap')
