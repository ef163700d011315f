"""Recovery of hostile files: it never fails, and its memory is bounded whatever they claim."""

from __future__ import annotations

import os
import random
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import pytest
from bags.slices import TALK, check, fill, in_order, messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from profiles import examples

from shadowhound_data_logger.formats.mcap import damage_scan, record_finder, recovery
from shadowhound_data_logger.formats.mcap.format import CHUNK, Contents, head, record, text
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

LONG = bool(os.environ.get('SHADOWHOUND_TEST_LONG'))
MEBI = 1 << 20
HOSTILE = settings(max_examples=examples(80), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
NUMBERS = st.sampled_from([0, 1, 22, 1 << 15, 1 << 31, 1 << 32, 1 << 62, (1 << 64) - 1])


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('fsync', 'fdatasync'):
        monkeypatch.setattr(os, name, lambda _: None)


def recovered(folder: Path, content: bytes) -> SliceInfo:
    (folder / 'bag_0.mcap').unlink(missing_ok=True)
    (folder / 'bag_0.mcap.open').write_bytes(content)
    return recover(folder / 'bag_0.mcap.open')


def chunk(data: bytes, *, size: int, compression: str = '', crc: int = 0) -> bytes:
    """A chunk record with these claims."""
    fields = CHUNK.pack(1, 1, size, crc) + text(compression) + struct.pack('<Q', len(data))
    return record(Opcode.CHUNK, fields, data)


def declared() -> bytes:
    """A schema and a channel, which a chunk may refer to."""
    return Contents().declare(TALK)[1]


@HOSTILE
@given(st.lists(st.tuples(st.integers(0, 255), NUMBERS, st.binary(max_size=80)), max_size=12))
def test_records_of_any_kind(tmp_path: Path, records: list[tuple[int, int, bytes]]) -> None:
    """Records with lengths that are lies, or contents that are noise, leave a slice that can be read."""
    body = b''.join(
        struct.pack('<BQ', op, length if number % 3 == 2 else len(content)) + content
        for number, (op, length, content) in enumerate(records)
    )
    info = recovered(tmp_path, head() + declared() + body)
    assert in_order(info.path) == []


@HOSTILE
@given(st.binary(max_size=200), NUMBERS, st.sampled_from(['', 'zstd', 'lz4', 'x']), st.booleans())
def test_chunks_of_any_kind(tmp_path: Path, data: bytes, size: int, compression: str, packs: bool) -> None:
    """A chunk with a correct checksum whose content is not messages is skipped."""
    packed = zstd.compress(data) if packs else data
    content = chunk(packed, size=len(data) if size == 1 else size, compression=compression, crc=zlib.crc32(data))
    info = recovered(tmp_path, head() + declared() + content)
    assert info.messages == len(in_order(info.path)) == 0


@pytest.fixture(scope='module')
def bomb() -> bytes:
    """A few kilobytes that unpack to 1 GB."""
    packer = zstd.ZstdCompressor()
    return b''.join(packer.compress(bytes(MEBI)) for _ in range(1024)) + packer.flush()


@pytest.mark.parametrize('claimed', [1000, 300 * MEBI, 1 << 60])
def test_what_unpacks_to_more(tmp_path: Path, bomb: bytes, claimed: int) -> None:
    """What unpacks to more than it claims, or claims more than any chunk has, takes no memory for it."""
    tracemalloc.start()
    info = recovered(tmp_path, head() + declared() + chunk(bomb, size=claimed, compression='zstd'))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert info.messages == 0
    assert peak < 5 * MEBI


def test_a_chunk_as_large_as_its_file(tmp_path: Path) -> None:
    """A record of 2 GB in a file that has as many (nothing but a hole) is not read into memory."""
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
    info = recovered(tmp_path, content)
    found = in_order(info.path)
    assert 0 < len(found) < 60
    assert found == written[: len(found)]
    assert info.damage is not None
    assert info.damage.tail_bytes > 2000
    schema = record(Opcode.SCHEMA, struct.pack('<H', 1), text('a'), text('b'), text('c' * 4000))
    assert recovered(tmp_path, head() + schema + declared()).channels == {TALK: 0}
    retired = recovered(tmp_path, head() + struct.pack('<BQ', 0x86, 0) * 100 + declared())
    assert retired.channels == {TALK: 0}


PROGRAM = """
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
    ran = subprocess.run([sys.executable, '-c', PROGRAM, str(path)], capture_output=True, text=True, check=True, timeout=250)
    found, grown_kb = map(int, ran.stdout.split())
    assert found == count
    assert grown_kb < 16 * 1024
    if not LONG:
        check(tmp_path / 'bag_0.mcap')
