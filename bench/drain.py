"""Prints how fast a backlog is uploaded, next to a bare boto3 thread pool that sends the same objects to the same server.

Run it as ``python bench/drain.py [--threads N] [--rounds N] [--folder F] [--json]``; it starts a SeaweedFS, and F should be on
the disk that the spool will be on. Both take turns, so that other load affects both: each ratio is of two consecutive runs, and
their median counts. The CPU is this process's, without the server's.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import shutil
import statistics
import tempfile
import zlib
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

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store

NOON_NS = 1_760_788_800 * SECOND
BACKLOGS = ((2000, 50_000), (3000, 2000))
"""(objects, bytes each): camera frames, and records."""
BUCKET = 'sensor-data'
GROUP = 100
DEADLINE_S = 600.0


@dataclass(frozen=True, slots=True)
class Run:
    """One uploaded backlog."""

    seconds: float
    cpu_seconds: float


def backlog(count: int, size: int, label: str) -> list[DataObject]:
    """Objects with random content, as made by the encoders."""
    return [
        DataObject(
            bucket=BUCKET, key=f'thor/camera/{label}/{number:06d}_front.jpg', body=os.urandom(size), content_type='image/jpeg',
            sensor='camera', topic=None, type='sensor_msgs/msg/CompressedImage', samples=1, t_start_ns=NOON_NS, t_end_ns=NOON_NS,
            metadata={'robot': 'thor'},
        )
        for number in range(count)
    ]  # fmt: skip


def timed(send: Callable[[], object]) -> Run:
    began, cpu = perf_counter(), process_time()
    send()
    return Run(perf_counter() - began, process_time() - cpu)


def drain(folder: Path, settings: StoreSettings, threads: int, objects: Sequence[DataObject]) -> Run:
    """From a full spool until every object is confirmed and its outcome is durable."""
    upload = UploadSettings(threads=threads)
    spool = Spool(folder / 'spool', SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    for start in range(0, len(objects), GROUP):
        spool.commit(objects[start : start + GROUP])
    with closing(open_store(settings, upload)) as store:
        writer = SpoolWriter(spool)
        uploader = Uploader(spool, store, upload, writer.settle)
        writer.on_commit(settled=uploader.settled)
        writer.prompt = True

        def send() -> None:
            writer.open()
            uploader.open()
            if not uploader.drain(DEADLINE_S):
                raise SystemExit(f'it did not drain: {uploader.status()}')

        run = timed(send)
        uploader.close(5.0)
        writer.close(5.0)
    spool.close()
    shutil.rmtree(folder / 'spool')
    return run


def bare(folder: Path, settings: StoreSettings, threads: int, objects: Sequence[DataObject]) -> Run:
    """From files until every put returned: the same requests, without verification or bookkeeping."""
    paths: list[tuple[Path, DataObject, dict[str, str]]] = []
    for number, item in enumerate(objects):
        path = folder / f'bare-{number}'
        path.write_bytes(item.body)
        paths.append((path, item, {**item.metadata, 'sha256': hashlib.sha256(item.body).hexdigest()}))
    client: Any = boto3.client(
        's3', endpoint_url=settings.endpoint_url, region_name=settings.region, aws_access_key_id=settings.access_key_id,
        aws_secret_access_key=settings.secret_access_key,
        config=Config(
            signature_version='s3v4', s3={'addressing_style': 'path'}, max_pool_connections=max(10, threads),
            request_checksum_calculation='when_required', response_checksum_validation='when_required',
        ),
    )  # fmt: skip

    def put(entry: tuple[Path, DataObject, dict[str, str]]) -> None:
        path, item, metadata = entry
        body = path.read_bytes()
        crc32 = base64.b64encode(zlib.crc32(body).to_bytes(4, 'big')).decode('ascii')
        client.put_object(Bucket=item.bucket, Key=item.key, Body=body, ContentType=item.content_type, Metadata=metadata,
                          ChecksumCRC32=crc32, IfNoneMatch='*')  # fmt: skip

    with ThreadPoolExecutor(threads) as pool:
        run = timed(lambda: list(pool.map(put, paths)))
    client.close()
    for path, _, _ in paths:
        path.unlink()
    return run


def measure(folder: Path, settings: StoreSettings, threads: int, rounds: int, scale: float) -> list[dict[str, Any]]:
    """One row per kind of backlog."""
    rows = []
    drain(folder, settings, threads, backlog(50, 1000, 'warm'))
    for whole, size in BACKLOGS:
        count = max(round(whole * scale), 1)
        ours: list[Run] = []
        theirs: list[Run] = []
        for turn in range(rounds):
            first, second = (ours, theirs) if turn % 2 else (theirs, ours)
            for runs in (first, second):
                way, name = (drain, 'drain') if runs is ours else (bare, 'bare')
                runs.append(way(folder, settings, threads, backlog(count, size, f'{size}-{turn}-{name}')))
        rows.append({'objects': count, 'bytes': size, 'threads': threads, **summary(count, ours, theirs)})
    return rows


def summary(count: int, ours: Sequence[Run], theirs: Sequence[Run]) -> dict[str, Any]:
    """Medians, and each ratio with its quartiles: above 1 we are faster, or cheaper."""
    speed = [their.seconds / our.seconds for our, their in zip(ours, theirs, strict=True)]
    cpu = [our.cpu_seconds / their.cpu_seconds for our, their in zip(ours, theirs, strict=True)]
    return {
        'drain_per_s': round(count / statistics.median(run.seconds for run in ours), 1),
        'bare_per_s': round(count / statistics.median(run.seconds for run in theirs), 1),
        'speed_ratio': round(statistics.median(speed), 3),
        'speed_ratios': sorted(round(ratio, 3) for ratio in speed),
        'drain_cpu_ms': round(1e3 / count * statistics.median(run.cpu_seconds for run in ours), 3),
        'bare_cpu_ms': round(1e3 / count * statistics.median(run.cpu_seconds for run in theirs), 3),
        'cpu_ratio': round(statistics.median(cpu), 3),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [f'{"backlog":>16} {"drain":>8} {"boto3":>8} {"speed, drain : boto3":>28} {"CPU an object, drain / boto3":>30}']
    for row in rows:
        ratios = row['speed_ratios']
        what = f'{row["objects"]} x {row["bytes"] / 1000:g} KB'
        speed = f'{row["speed_ratio"]:.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})'
        cpu = f'{row["drain_cpu_ms"]:.2f} / {row["bare_cpu_ms"]:.2f} ms = {row["cpu_ratio"]:.2f}'
        lines.append(f'{what:>16} {row["drain_per_s"]:>6.0f}/s {row["bare_per_s"]:>6.0f}/s {speed:>28} {cpu:>30}')
    return '\n'.join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--threads', type=int, default=UploadSettings().threads)
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--scale', type=float, default=1.0, help='of the backlogs, for a quick look')
    parser.add_argument('--folder', type=Path, help='where the spool lies; default: a temporary folder')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as name, Tower(Path(name) / 'tower') as tower:
        rows = measure(Path(name), tower.store_settings(), options.threads, options.rounds, options.scale)
    print(json.dumps({'drain': rows}) if options.json else table(rows))


if __name__ == '__main__':
    main()
