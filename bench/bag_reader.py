"""CPU microseconds for reading a message from a slice of a bag, next to the readers of `mcap`.

Run it as ``python bench/bag_reader.py``. All read the same slices in turn, several times: the profile of a Go2, and 10,000
small messages per second, from the first message to the last, in file order, with checksums. ``mcap`` follows the index,
``mcap, record by record`` reads sequentially. Memory is the peak allocation.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import process_time

from _report import Bar, Report, main, progress
from bag_writer import ours as write_ours
from bag_writer import stream
from mcap.reader import SeekingReader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile

ROUNDS = 5
EVER = 1 << 64


def ours(path: Path) -> Iterator[int]:
    source = LocalFile(path)
    for message in read_messages(source, read_index(source), MessageFilter(0, EVER, lambda _: True)):
        yield len(message.cdr)


def by_index(path: Path) -> Iterator[int]:
    with path.open('rb') as file:
        for _, _, message in SeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False):
            yield len(message.data)


def by_record(path: Path) -> Iterator[int]:
    with path.open('rb') as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Message):
                yield len(record.data)


READERS: dict[str, Callable[[Path], Iterator[int]]] = {'ours': ours, 'mcap': by_index, 'mcap, record by record': by_record}


def measure(options: argparse.Namespace) -> Report:
    """Every reader once per round, so that other load affects all of them."""
    options.folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=options.folder))
    loads = {'profile': stream(260, 30, options.seconds), 'small': stream(10_000, 0, max(options.seconds / 5, 1))}
    figures: dict[str, dict[str, list[float]]] = {load: {name: [] for name in READERS} for load in loads}
    memory: dict[str, float] = {}
    for load, messages in loads.items():
        (folder / load).mkdir()
        write_ours('zstd')(folder / load, messages)
        path = folder / load / 'bag_0.mcap'
        for number in range(ROUNDS):
            progress(f'{load}, round {number + 1} of {ROUNDS}')
            for name, read in READERS.items():
                start = process_time()
                count = sum(1 for _ in read(path))
                figures[load][name].append((process_time() - start) * 1e6 / count)
                assert count == len(messages)
        for name, read in READERS.items():
            tracemalloc.start()
            sum(1 for _ in read(path))
            memory[f'{name}, {load}'] = round(tracemalloc.get_traced_memory()[1] / 1e6, 1)
            tracemalloc.stop()
    shutil.rmtree(folder)
    bars = []
    for load, names in figures.items():
        ratios = [mine / theirs for mine, theirs in zip(names['ours'], names['mcap'], strict=True)]
        bars.append(
            Bar(f'a message ({load}) against mcap', 'at most 1', median(ratios), 'ratio', median(ratios) <= 1, tuple(ratios))
        )
    return Report(tuple(bars), {
        'us_per_message': {load: {name: round(median(own), 2) for name, own in names.items()} for load, names in figures.items()},
        'most_mb': memory,
    })  # fmt: skip


if __name__ == '__main__':
    main(__doc__, measure, seconds=10)
