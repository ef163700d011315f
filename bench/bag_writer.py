"""CPU microseconds for writing a message into a slice of a bag, next to the writers of `rosbags` and `mcap`.

Run it as ``python bench/bag_writer.py``. All write the same messages in turn, several times: the profile of a Go2 (30 images of
150 KB and 230 small messages per second), and 10,000 small messages per second. Ours ends a chunk and syncs once per second of
the recording, and computes the SHA-256 of the file; ``mcap, as ours`` does the same (its ``flush``, a file that hashes). The
others do neither. `rosbags` skips CRC-32s as well. Memory is the peak allocation.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import os
import random
import shutil
import tempfile
import tracemalloc
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

from _report import Bar, Report, main, progress
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

STRING = 'string data\n'
CHANNELS = tuple(Channel(f'/topic{number}', 'std_msgs/msg/String', 'ros2msg', STRING, '', '') for number in range(12))
ROUNDS = 5
BUDGET_US = 10.0
SECOND = 10**9
PICTURE_BYTES, SMALL_BYTES = 150_000, 300
Stream = Sequence[tuple[int, int, bytes]]
"""(channel index, log time, bytes)."""


def stream(per_second: int, pictures: int, seconds: float) -> Stream:
    """Evenly spaced; images are noise, like JPEGs, and small messages resemble records: half of each is zeros."""
    noise = random.Random(1)
    picture = [noise.randbytes(PICTURE_BYTES) for _ in range(31)]  # zstd finds repeats in a chunk
    small = [noise.randbytes(SMALL_BYTES // 2) + bytes(SMALL_BYTES // 2) for _ in range(97)]
    every = per_second // pictures if pictures else 0
    return [
        (0, at, picture[number // every % 31]) if every and not number % every else (1 + number % 11, at, small[number % 97])
        for number in range(int(per_second * seconds))
        for at in (number * SECOND // per_second,)
    ]


def ours(compression: str) -> Callable[[Path, Stream], None]:
    def write(folder: Path, messages: Stream) -> None:
        writer = SliceWriter(folder / 'bag_0.mcap', compression=compression)
        synced = 0
        for place, at, cdr in messages:
            writer.write(CHANNELS[place], at, at, 0, cdr)
            if at - synced >= SECOND:
                writer.sync()
                synced = at
        writer.close()

    return write


def rosbags(compression: CompressionMode) -> Callable[[Path, Stream], None]:
    def write(folder: Path, messages: Stream) -> None:
        writer = BagWriter(folder / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections = [writer.add_connection(one.topic, one.type, msgdef=STRING, rihs01='none') for one in CHANNELS]
            for place, at, cdr in messages:
                writer.write(connections[place], at, cdr)

    return write


def mcap(compression: CompressionType) -> Callable[[Path, Stream], None]:
    def write(folder: Path, messages: Stream) -> None:
        with (folder / 'bag.mcap').open('wb') as file:
            writer = McapWriter(file, compression=compression)
            writer.start('ros2')
            schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', STRING.encode())
            channels = [writer.register_channel(one.topic, 'cdr', schema) for one in CHANNELS]
            for place, at, cdr in messages:
                writer.add_message(channels[place], at, cdr, at)
            writer.finish()

    return write


class Hashing(io.RawIOBase):
    """A file that computes its SHA-256."""

    def __init__(self, path: Path) -> None:
        self.file = path.open('wb', buffering=0)
        self.digest = hashlib.sha256()
        self._at = 0

    def writable(self) -> bool:
        return True

    def write(self, content: Any) -> int:
        self.digest.update(content)
        self._at += len(content)
        view = memoryview(content)
        while view:
            view = view[self.file.write(view) :]
        return len(content)

    def tell(self) -> int:
        return self._at


def mcap_as_ours(compression: CompressionType) -> Callable[[Path, Stream], None]:
    def write(folder: Path, messages: Stream) -> None:
        hashing = Hashing(folder / 'bag.mcap')
        writer = McapWriter(io.BufferedWriter(hashing), compression=compression)
        writer.start('ros2')
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', STRING.encode())
        channels = [writer.register_channel(one.topic, 'cdr', schema) for one in CHANNELS]
        synced = 0
        for place, at, cdr in messages:
            writer.add_message(channels[place], at, cdr, at)
            if at - synced >= SECOND:
                writer.flush()
                os.fdatasync(hashing.file.fileno())
                synced = at
        writer.finish()
        writer.flush()
        hashing.file.close()

    return write


def bytes_alone(folder: Path, messages: Stream) -> None:
    """The cost of the bytes for any such writer: CRC-32, SHA-256, writes of a megabyte, one sync per second."""
    digest = hashlib.sha256()
    size = sum(31 + len(cdr) for _, _, cdr in messages)
    block = random.Random(2).randbytes(1 << 20)
    syncs = max(size * SECOND // (messages[-1][1] or SECOND) >> 20, 1)
    with (folder / 'raw').open('wb', buffering=0) as file:
        for number in range(size >> 20):
            zlib.crc32(block)
            digest.update(block)
            file.write(block)
            if not number % syncs:
                os.fdatasync(file.fileno())


WRITERS: dict[str, Callable[[Path, Stream], None]] = {
    'ours': ours('none'), 'rosbags': rosbags(CompressionMode.NONE), 'mcap': mcap(CompressionType.NONE),
    'bytes alone': bytes_alone, 'ours, zstd': ours('zstd'), 'rosbags, zstd': rosbags(CompressionMode.STORAGE),
    'mcap, zstd': mcap(CompressionType.ZSTD), 'mcap, as ours': mcap_as_ours(CompressionType.NONE),
    'mcap, as ours, zstd': mcap_as_ours(CompressionType.ZSTD),
}  # fmt: skip


def measure(options: argparse.Namespace) -> Report:
    """Every writer once per round, so that other load affects all of them."""
    loads = {'profile': stream(260, 30, options.seconds), 'small': stream(10_000, 0, max(options.seconds / 5, 1))}
    options.folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, dict[str, list[float]]] = {load: {name: [] for name in WRITERS} for load in loads}
    for number in range(ROUNDS):
        progress(f'round {number + 1} of {ROUNDS}')
        for load, messages in loads.items():
            for name, write in WRITERS.items():
                folder = Path(tempfile.mkdtemp(dir=options.folder))
                start = process_time()
                write(folder, messages)
                figures[load][name].append((process_time() - start) * 1e6 / len(messages))
                shutil.rmtree(folder)
    return Report(tuple(_bars(figures)), {
        'us_per_message': {
            load: {name: round(median(rounds), 2) for name, rounds in names.items()} for load, names in figures.items()
        },
        'most_mb': {name: _most_mb(write, options.folder) for name, write in WRITERS.items() if name != 'bytes alone'},
    })  # fmt: skip


def _most_mb(write: Callable[[Path, Stream], None], folder: Path) -> float:
    """Peak allocation over two seconds of the profile, without the messages."""
    messages, place = stream(260, 30, 2), Path(tempfile.mkdtemp(dir=folder))
    tracemalloc.start()
    try:
        write(place, messages)
        return round(tracemalloc.get_traced_memory()[1] / 1e6, 1)
    finally:
        tracemalloc.stop()
        shutil.rmtree(place)


def _bars(figures: dict[str, dict[str, list[float]]]) -> list[Bar]:
    small = figures['small']
    own = [mine - least for mine, least in zip(figures['profile']['ours'], figures['profile']['bytes alone'], strict=True)]
    budget = f'at most {BUDGET_US:g}'
    bars = [
        Bar('a small message', budget, median(small['ours']), 'us', median(small['ours']) <= BUDGET_US, tuple(small['ours'])),
        Bar('a message of the profile, beside its bytes', budget, median(own), 'us', median(own) <= BUDGET_US, tuple(own)),
    ]
    for other in ('rosbags', 'mcap, as ours'):
        ratios = [mine / theirs for mine, theirs in zip(small['ours'], small[other], strict=True)]
        ratio = median(ratios)
        bars.append(Bar(f'a small message against {other}', 'at most 0.5', ratio, 'ratio', ratio <= 0.5, tuple(ratios)))
    ratios = [mine / theirs for mine, theirs in zip(figures['profile']['ours'], figures['profile']['mcap, as ours'], strict=True)]
    bars.append(
        Bar(
            'a message of the profile against mcap, as ours',
            'at most 1',
            median(ratios),
            'ratio',
            median(ratios) <= 1,
            tuple(ratios),
        )
    )
    return bars


if __name__ == '__main__':
    main(__doc__, measure, seconds=10)
