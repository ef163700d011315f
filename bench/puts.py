"""CPU milliseconds and memory of a put in this process, next to obstore and boto3.

Run it as ``python bench/puts.py``. Each client puts the same small objects into one SeaweedFS, from as many threads, in turn,
several times: from a file, with metadata, without overwriting. Ours reads the file and checks it against its SHA-256, and the
server verifies a CRC-32. obstore hashes what it sends; of checksums that a server verifies it has SHA-256 and CRC-64. The
memory is the increase of a process after its first round, imports included.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

from _report import Bar, Report, main, progress
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.stores import open_store

ROUNDS, THREADS, SIZE = 7, 4, 2000
BUCKET = 'sensor-data'
Put = Callable[[SpooledObject], object]


def by_ours(settings: StoreSettings) -> Put:
    store = open_store(settings, UploadSettings(threads=THREADS))
    return store.put


def by_obstore(settings: StoreSettings) -> Put:
    import obstore  # noqa: PLC0415 - its memory is measured
    from obstore.store import S3Store  # noqa: PLC0415

    store = S3Store(
        BUCKET, endpoint=settings.endpoint_url, region=settings.region, access_key_id=settings.access_key_id,
        secret_access_key=settings.secret_access_key, client_options={'allow_http': True}, retry_config={'max_retries': 0},
    )  # fmt: skip

    def put(item: SpooledObject) -> None:
        attributes: Any = {'Content-Type': item.content_type, **item.metadata}
        obstore.put(store, item.key, item.path.read_bytes(), attributes=attributes, mode='create', use_multipart=False)

    return put


def by_boto3(settings: StoreSettings) -> Put:
    import boto3  # noqa: PLC0415
    from botocore.config import Config  # noqa: PLC0415

    client: Any = boto3.client(
        's3', endpoint_url=settings.endpoint_url, region_name=settings.region, aws_access_key_id=settings.access_key_id,
        aws_secret_access_key=settings.secret_access_key,
        config=Config(s3={'addressing_style': 'path'}, request_checksum_calculation='when_required'),
    )  # fmt: skip

    def put(item: SpooledObject) -> None:
        client.put_object(Bucket=BUCKET, Key=item.key, Body=item.path.read_bytes(), ContentType=item.content_type,
                          Metadata=dict(item.metadata), IfNoneMatch='*')  # fmt: skip

    return put


WAYS: dict[str, Callable[[StoreSettings], Put]] = {'ours': by_ours, 'obstore': by_obstore, 'boto3': by_boto3}


def objects(folder: Path, label: str, count: int) -> list[SpooledObject]:
    found = []
    for number in range(count):
        body = os.urandom(SIZE)
        path = folder / f'{label}-{number}'
        path.write_bytes(body)
        sha256 = hashlib.sha256(body).hexdigest()
        about = {'robot': 'thor', 'sensor': 'odom', 'topic': '/odom', 'count': '10', 'sha256': sha256}
        found.append(
            SpooledObject(number, BUCKET, f'thor/{label}/{number}.json', path, SIZE, sha256, 'application/json', about, 5, 0)
        )
    return found


def timed(pool: ThreadPoolExecutor, put: Put, items: Sequence[SpooledObject]) -> float:
    """CPU milliseconds per object, of all threads of this process."""
    start = process_time()
    list(pool.map(put, items))
    return (process_time() - start) * 1e3 / len(items)


def resident_mb() -> float:
    return int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6


def grown_mb(way: str, settings: StoreSettings, folder: Path) -> float:
    """In a separate process, without the other clients."""
    program = (
        f'import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import puts; from puts import *\n'
        f'items, before = objects(Path({str(folder)!r}), "memory-{way}", 300), resident_mb()\n'
        f'puts.timed(ThreadPoolExecutor(THREADS), WAYS[{way!r}](StoreSettings(endpoint_url={settings.endpoint_url!r}, '
        f'access_key_id={settings.access_key_id!r}, secret_access_key=sys.stdin.read(), region={settings.region!r})), items)\n'
        'print(resident_mb() - before, flush=True); import os; os._exit(0)'
    )
    secret = settings.secret_access_key or ''
    ran = subprocess.run([sys.executable, '-c', program], input=secret, capture_output=True, text=True, check=True, timeout=120)
    return round(float(ran.stdout), 1)


def measure(options: argparse.Namespace) -> Report:
    """Every client once per round, so that other load affects all of them."""
    options.folder.mkdir(parents=True, exist_ok=True)
    count = int(options.seconds * 50)
    figures: dict[str, list[float]] = {name: [] for name in WAYS}
    with tempfile.TemporaryDirectory(dir=options.folder) as name, Tower(Path(name) / 'tower') as tower:
        folder, settings = Path(name), tower.store_settings()
        ways = {way: begin(settings) for way, begin in WAYS.items()}
        with ThreadPoolExecutor(THREADS) as pool:
            for number in range(ROUNDS + 1):
                progress(f'round {number} of {ROUNDS}')
                for way, put in ways.items():
                    took = timed(pool, put, objects(folder, f'{way}-{number}', count))
                    if number:  # the first one opens connections
                        figures[way].append(took)
        memory = {way: grown_mb(way, settings, folder) for way in WAYS}
    ratios = {way: [mine / theirs for mine, theirs in zip(figures['ours'], own, strict=True)] for way, own in figures.items()}
    ratio = median(ratios['boto3'])
    bar = Bar('CPU of a small put against boto3', 'at most 0.6', ratio, 'ratio', ratio <= 0.6, tuple(ratios['boto3']))
    return Report((bar,), {
        'cpu_ms': {way: round(median(own), 3) for way, own in figures.items()},
        'ours_to_obstore': [round(each, 2) for each in sorted(ratios['obstore'])], 'grown_mb': memory,
    })  # fmt: skip


if __name__ == '__main__':
    main(__doc__, measure, seconds=10)
