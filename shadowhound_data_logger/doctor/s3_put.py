"""Probe objects: whether a put is accepted, reads back equal, never overwrites and is refused when damaged, and its speed."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from shadowhound_data_logger.core.config import Settings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.doctor.model import Result, error, measured, of_error, ok, warning
from shadowhound_data_logger.doctor.services import ANSWER_S, CONNECT_S

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.s3_requests import S3Requests

TRAJECTORIES: Final = 'trajectories'
"""Where missions put the copy of their way (missions/objects.py)."""
BODY: Final = b'written by shadowhound-data doctor; may be deleted at any time\n\n'
SMALL_BYTES: Final = 64 << 10
LARGE_BYTES: Final = 2 << 20
LARGE_WITHIN_S: Final = 4.0
"""The large one is tried where the small one says that it takes no longer."""
SLOW_MBPS: Final = 4.0
"""The default settings need 3.3 Mbit/s on average (docs/thor.md)."""


@contextmanager
def single_requests(settings: StoreSettings) -> Iterator[S3Requests]:
    """Requests that are sent as they are asked for, one try each. Raises SettingError.

    A store (``stores/base.py``) hides what a check wants to see: it creates a bucket that is missing, looks by itself where a
    condition is not honoured, sends no wrong checksum, and lists all of a prefix where the first page is enough.
    """
    from shadowhound_data_logger.stores.s3_client import S3Client  # noqa: PLC0415 - botocore costs half a second
    from shadowhound_data_logger.stores.s3_requests import S3Requests  # noqa: PLC0415

    upload = UploadSettings(threads=1, connect_timeout_s=CONNECT_S, read_timeout_s=ANSWER_S)
    with closing(S3Client(settings, upload)) as client:
        client.open()
        yield S3Requests(client)


def buckets(settings: Settings) -> tuple[str, ...]:
    """Those that a robot writes to."""
    return tuple(dict.fromkeys([*(sensor.bucket for sensor in settings.sensors if sensor.enabled), TRAJECTORIES]))


def missing_bucket(name: str, endpoint: str) -> Result:
    """The finding; ``--fix`` can repair it where the keys allow that."""
    return error(
        's3.bucket',
        f'there is no bucket {name}',
        'it was not created on this server',
        f'aws --endpoint-url {endpoint} s3 mb s3://{name}  # or: shadowhound-data doctor --fix',
        fix=('bucket', name),
    )


def key(robot: str) -> str:
    """Of the probe, the same in each bucket."""
    return f'{robot}/_doctor/probe'


def write(requests: S3Requests, bucket: str, robot: str) -> Iterator[Result]:
    """Put the probe twice, and read it back. Raises StoreError for what is wrong with the server as a whole."""
    from shadowhound_data_logger.stores.s3_requests import Sent  # noqa: PLC0415 - botocore costs half a second

    item = probe(bucket, key(robot))
    try:
        sent = requests.put(item, BODY, conditional=True)
        if sent is Sent.NOT_IMPLEMENTED:
            requests.put(item, BODY, conditional=False)
        elif sent is Sent.CREATED:  # the first time; now it is there, and a condition that is honoured is refused
            sent = requests.put(item, BODY, conditional=True)
        body = b''.join(requests.content(bucket, item.key))
    except BucketMissing:
        yield missing_bucket(bucket, requests.endpoint)
        return
    except (AccessDenied, ObjectRefused) as problem:
        yield of_error(
            's3.write',
            problem,
            f'no right to put and get under {bucket}/{robot}/, or no such bucket: a server does not say which',
        )
        return
    if body != BODY:
        yield error(
            's3.read',
            f'{bucket}/{item.key} does not come back as it was written',
            'somebody else writes there, or the server damages what it holds',
            'on Tower: look at its disks and its log',
        )
        return
    yield ok('s3.write', f'{bucket}: an object was written and read back')
    if sent is Sent.TAKEN:
        yield ok('s3.condition', f'{bucket}: If-None-Match is honoured, nothing is ever overwritten')
        return
    how = 'does not know' if sent is Sent.NOT_IMPLEMENTED else 'ignores'
    yield warning(
        's3.condition',
        f'{bucket}: the server {how} If-None-Match',
        'it would overwrite; each put has to look first, which is slower, and two writers in one instant go unseen',
        'update the S3 server on Tower: SeaweedFS, or MinIO of 2024 or later',
    )


def promises(requests: S3Requests, bucket: str, robot: str, latency_s: float) -> Iterator[Result]:
    """Bodies that do not match their checksum: a server that verifies keeps nothing of them, so they also measure the speed.

    ``latency_s`` is what a request takes that sends next to nothing.
    """
    name = f'{robot}/_doctor/damaged'
    took_s, refused = _damaged(requests, bucket, name, SMALL_BYTES)
    size = SMALL_BYTES
    if (took_s - latency_s) * LARGE_BYTES / SMALL_BYTES < LARGE_WITHIN_S:
        size = LARGE_BYTES
        took_s, refused = _damaged(requests, bucket, name, size)
    if refused:
        yield ok('s3.checksum', 'the server verifies checksums: what is damaged on its way is refused')
    else:
        yield error(
            's3.checksum',
            'the server took an object whose CRC32 is wrong',
            'it does not verify x-amz-checksum-sha256: what is damaged on its way would be confirmed',
            'update the S3 server on Tower',
        )
    mbps = 8e-6 * size / max(took_s - latency_s, took_s / 2)
    yield measured(
        's3.throughput',
        f'{mbps:,.1f} Mbit/s to Tower ({size >> 10} KiB in {took_s:.2f} s)',
        'below what the default settings make: the backlog grows',
        'iw dev wlan0 link ; log less: camera.rate_hz, lidar.rate_hz, camera.quality in the parameter file',
        is_fine=mbps >= SLOW_MBPS,
        upload_mbps=round(mbps, 2),
    )


def _damaged(requests: S3Requests, bucket: str, name: str, size: int) -> tuple[float, bool]:
    """Seconds that it took, and whether the server refused it."""
    body = os.urandom(size)
    item = replace(probe(bucket, name, body), sha256=hashlib.sha256(b'another').hexdigest())
    began_s = time.perf_counter()
    try:
        requests.put(item, body, conditional=False)
        refused = False
    except (StoreUnavailable, ObjectRefused) as problem:
        if not problem.data.get('status'):  # no answer: a break that says nothing of checksums
            raise
        refused = True
    return time.perf_counter() - began_s, refused


def probe(bucket: str, name: str, body: bytes = BODY) -> SpooledObject:
    """An object as a put wants it; there is no file of it."""
    sha256 = hashlib.sha256(body).hexdigest()
    return SpooledObject(
        id=0,
        bucket=bucket,
        key=name,
        path=Path(),
        size=len(body),
        sha256=sha256,
        content_type='text/plain',
        metadata={},
        priority=0,
        created_ns=0,
    )
