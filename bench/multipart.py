"""Prints how fast slices are uploaded in parts, next to boto3's ``upload_fileobj`` with the same files and server.

Run it as ``python bench/multipart.py [--slices N] [--mebibytes M] [--rounds N] [--folder F] [--json]``; it starts a SeaweedFS.
Both take turns, so that other load affects both: each ratio is of two consecutive runs, and their median counts. The CPU is
this process's, without the server's. Ours sends the parts of one slice in sequence, verifies the complete file against its
SHA-256 and could resume at any part; boto3's sends up to ten parts at a time and does neither.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import boto3
from botocore.config import Config
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores import open_store

BUCKET = 'sensor-data'
AT_ONCE = 2
"""Concurrent slices: half of the default threads are for large objects."""


@dataclass(frozen=True, slots=True)
class Run:
    """All slices uploaded once."""

    seconds: float
    cpu_seconds: float


def slices(folder: Path, count: int, size: int) -> list[SpooledObject]:
    """Files with random content, as in the spool."""
    made = []
    for number in range(count):
        path, content = folder / f'{number}.mcap', os.urandom(size)
        path.write_bytes(content)
        sha256 = hashlib.sha256(content).hexdigest()
        made.append(SpooledObject(number, BUCKET, f'{number}.mcap', path, size, sha256, 'application/x-mcap', {}, 8, 0))
    return made


def timed(send: Callable[[SpooledObject], object], items: Sequence[SpooledObject]) -> Run:
    began, cpu = perf_counter(), process_time()
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(send, items))
    return Run(perf_counter() - began, process_time() - cpu)


def named(items: Sequence[SpooledObject], label: str) -> list[SpooledObject]:
    """The same files with other keys."""
    return [SpooledObject(item.id, BUCKET, f'thor/rosbags/{label}/{item.key}', item.path, item.size, item.sha256,
                          item.content_type, {}, 8, 0) for item in items]  # fmt: skip


def measure(settings: StoreSettings, items: Sequence[SpooledObject], rounds: int) -> list[tuple[Run, Run]]:
    """(ours, theirs) of each round, after one round of both that is not measured."""
    client = boto3.client(
        's3', endpoint_url=settings.endpoint_url, region_name=settings.region, aws_access_key_id=settings.access_key_id,
        aws_secret_access_key=settings.secret_access_key, config=Config(s3={'addressing_style': 'path'}),
    )  # fmt: skip

    def upload(item: SpooledObject) -> None:
        with item.path.open('rb') as file:
            client.upload_fileobj(file, item.bucket, item.key, ExtraArgs={'Metadata': {'sha256': item.sha256}})

    found = []
    with closing(open_store(settings, UploadSettings())) as store:
        for number in range(-1, rounds):
            ours = timed(store.put, named(items, f'ours-{number}'))
            found.append((ours, timed(upload, named(items, f'theirs-{number}'))))
    return found[1:]


def summary(runs: Sequence[tuple[Run, Run]], mebibytes: int) -> dict[str, Any]:
    """Medians of the ratios, ours to theirs, and our absolute values."""
    time_ratios = [ours.seconds / theirs.seconds for ours, theirs in runs]
    cpu_ratios = [ours.cpu_seconds / theirs.cpu_seconds for ours, theirs in runs]
    return {
        'mebibytes': mebibytes,
        'mebibytes_per_s': round(mebibytes / statistics.median(ours.seconds for ours, _ in runs), 1),
        'cpu_ms_per_mebibyte': round(1000 * statistics.median(ours.cpu_seconds for ours, _ in runs) / mebibytes, 2),
        'time_ratio': round(statistics.median(time_ratios), 2), 'time_ratios': [round(ratio, 2) for ratio in time_ratios],
        'cpu_ratio': round(statistics.median(cpu_ratios), 2), 'cpu_ratios': [round(ratio, 2) for ratio in cpu_ratios],
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--slices', type=int, default=4)
    parser.add_argument('--mebibytes', type=int, default=64, help='of each slice')
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--folder', type=Path, help='where the slices and the server keep their files')
    parser.add_argument('--json', action='store_true')
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=given.folder) as folder, Tower(Path(folder) / 'tower') as tower:
        items = slices(Path(folder), given.slices, given.mebibytes << 20)
        found = summary(measure(tower.store_settings(), items, given.rounds), given.slices * given.mebibytes)
    if given.json:
        print(json.dumps(found, indent=2))
        return
    print(f'{found["mebibytes"]} MiB in {given.slices} slices: {found["mebibytes_per_s"]} MiB/s, '
          f'{found["cpu_ms_per_mebibyte"]} ms of CPU a MiB')  # fmt: skip
    print(f'time: {found["time_ratio"]:.2f} of upload_fileobj {found["time_ratios"]}')
    print(f'CPU:  {found["cpu_ratio"]:.2f} of upload_fileobj {found["cpu_ratios"]}')


if __name__ == '__main__':
    main()
