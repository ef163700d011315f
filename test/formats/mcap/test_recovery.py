"""Recovery: whatever a kill, a power cut or a bad disk made of an open slice, what was whole can be read by other readers."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bags.slices import check, closed, fill, in_order, indexed, messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.slice_info import Damage, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

COUNT, A_CHUNK = 60, 12
HOSTILE = settings(max_examples=examples(60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def _without_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of files that need not survive the machine."""
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
    """Of an open slice with this content; checked by readers."""
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
    """All that was synced is there, and nothing is called damaged."""
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
def test_cut_off_anywhere(tmp_path: Path, opened: bytes, data: st.DataObject) -> None:
    """What is left is whole chunks from the beginning; at most one chunk is torn, and its bytes are named."""
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
def test_a_byte_that_flipped(tmp_path: Path, opened: bytes, data: st.DataObject) -> None:
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
def test_a_chunk_that_is_called_something_else(tmp_path: Path, opened: bytes, op: int) -> None:
    """It is found by its fields and its checksum, whatever the first byte of its record was turned into."""
    at = [place for place in range(len(opened)) if opened[place : place + 9] == opened[opened.index(b'\x06') :][:9]][2]
    content = bytearray(opened)
    content[at] = op
    info = recovered(tmp_path, bytes(content))
    assert (info.messages, info.damage) == (COUNT, Damage(0, 0, 0))


def test_a_broken_chunk_in_the_middle(tmp_path: Path, opened: bytes) -> None:
    """Those after it are kept, and its messages are counted by the index that follows it."""
    marked = WRITTEN[A_CHUNK + 1].cdr
    content = opened.replace(marked, bytes(len(marked)))
    assert content != opened
    info = recovered(tmp_path, content)
    assert in_order(info.path) == WRITTEN[:A_CHUNK] + WRITTEN[2 * A_CHUNK :]
    assert info.damage == Damage(tail_bytes=0, chunks=1, messages=A_CHUNK)


def test_a_broken_index_is_made_again(tmp_path: Path, opened: bytes) -> None:
    """Index entries that point elsewhere are not trusted: they are what the chunk says."""
    entry = WRITTEN[A_CHUNK].log_ns.to_bytes(8, 'little')
    at = opened.rindex(entry)
    content = opened[:at] + bytes(8) + opened[at + 8 :]
    assert in_order(recovered(tmp_path, content).path) == WRITTEN


@pytest.mark.parametrize('tail', [bytes(5000), b'\xff' * 300, random.Random(3).randbytes(70_000)], ids=['zeros', 'ones', 'noise'])
def test_a_tail_of_anything(tmp_path: Path, opened: bytes, tail: bytes) -> None:
    """What a file system leaves after a power cut is cut off."""
    info = recovered(tmp_path, opened + tail)
    assert in_order(info.path) == WRITTEN
    assert info.damage == Damage(len(tail), 0, 0)


@pytest.mark.parametrize('content', [b'', b'\x89MCAP', bytes(100), b'no bag at all' * 50])
def test_a_file_without_intact_chunks(tmp_path: Path, content: bytes) -> None:
    """A file without one whole chunk becomes an empty slice."""
    assert recovered(tmp_path, content).messages == 0


def test_a_slice_that_was_being_closed(tmp_path: Path, opened: bytes) -> None:
    """A kill while the ending is written costs nothing: it is written again."""
    info, _ = closed(tmp_path / 'bag_0.mcap', COUNT, sync_every=A_CHUNK)
    content = info.path.read_bytes()
    for length in range(len(opened), len(content) + 1, 61):
        again = recovered(tmp_path, content[:length])
        assert again.path.read_bytes() == content
        assert again.damage == Damage(0, 0, 0)


def test_a_channel_that_the_summary_alone_has(tmp_path: Path, opened: bytes) -> None:
    """Nothing can be inserted into a slice in place: the messages of a channel whose record is damaged are lost, and counted."""
    info, _ = closed(tmp_path / 'bag_0.mcap', COUNT, sync_every=A_CHUNK)
    content = bytearray(info.path.read_bytes())
    content[content.index(b'/echo') - 4] ^= 0xFF
    info = recovered(tmp_path, bytes(content))
    assert info.messages == 0
    assert info.damage is not None
    assert info.damage.chunks + info.damage.tail_bytes > 0


class Killed(BaseException):
    """What no handler may catch."""


@pytest.mark.parametrize('after', range(5))
def test_killed_while_recovering(tmp_path: Path, opened: bytes, after: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recovery that was cut short at any step, also within a write, is done again with the same result."""
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
def test_a_real_kill(tmp_path: Path, after: int) -> None:
    """A process that is killed while it writes has lost nothing of what it had synced."""
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
    """A file that is not an open slice is refused, and a whole slice is never written over."""
    (tmp_path / 'bag_0.mcap.open').write_bytes(opened)
    (tmp_path / 'bag_0.mcap').write_bytes(b'whole')
    with pytest.raises(FileExistsError):
        recover(tmp_path / 'bag_0.mcap.open')
    with pytest.raises(ValueError, match='not an open slice'):
        recover(tmp_path / 'bag_0.mcap')
    assert (tmp_path / 'bag_0.mcap').read_bytes() == b'whole'
    assert (tmp_path / 'bag_0.mcap.open').read_bytes() == opened
