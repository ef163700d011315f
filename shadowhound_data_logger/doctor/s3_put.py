"""Probe objects: whether a put is accepted, reads back equal, never overwrites and is rejected when damaged, and its speed."""

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
from shadowhound_data_logger.doctor.model import Result, error, from_error, measured, ok, warning
from shadowhound_data_logger.doctor.services import ANSWER_S, CONNECT_S

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.s3_requests import S3Requests

TRAJECTORIES: Final = 'trajectories'
"""The key prefix of missions' trajectory copies (missions/objects.py)."""
BODY: Final = b'written by shadowhound-data doctor; may be deleted at any time\n\n'
SMALL_BYTES: Final = 64 << 10
LARGE_BYTES: Final = 2 << 20
LARGE_WITHIN_S: Final = 4.0
"""The large probe is skipped if the small one predicts that it takes longer."""
SLOW_MBPS: Final = 4.0
"""The default settings need 3.3 Mbit/s on average (docs/thor.md)."""


@contextmanager
def single_requests(settings: StoreSettings) -> Iterator[S3Requests]:
    """A client that sends each request once, unchanged. Raises SettingError.

    A store (``stores/base.py``) hides what a check must see: it creates a missing bucket, looks first where a condition is not
    honored, sends no wrong checksum, and lists a complete prefix where the first page is enough.
    """
    from shadowhound_data_logger.stores.s3_client import S3Client  # noqa: PLC0415 - botocore costs half a second
    from shadowhound_data_logger.stores.s3_requests import S3Requests  # noqa: PLC0415

    upload = UploadSettings(threads=1, connect_timeout_s=CONNECT_S, read_timeout_s=ANSWER_S)
    with closing(S3Client(settings, upload)) as client:
        client.open()
        yield S3Requests(client)


def buckets(settings: Settings) -> tuple[str, ...]:
    """The buckets that a robot writes to."""
    return tuple(dict.fromkeys([*(sensor.bucket for sensor in settings.sensors if sensor.enabled), TRAJECTORIES]))


def missing_bucket(name: str, endpoint: str) -> Result:
    """The finding for a missing bucket; ``--fix`` creates it if the keys allow that."""
    return error(
        's3.bucket',
        f'there is no bucket {name}',
        'it was not created on this server',
        f'aws --endpoint-url {endpoint} s3 mb s3://{name}  # or: shadowhound-data doctor --fix',
        fix=('bucket', name),
    )


def key(robot: str) -> str:
    """Key of the probe, the same in each bucket."""
    return f'{robot}/_doctor/probe'


def write(requests: S3Requests, bucket: str, robot: str) -> Iterator[Result]:
    """Put the probe twice, and read it back. Raises StoreError for a problem of the server as a whole."""
    from shadowhound_data_logger.stores.s3_requests import Sent  # noqa: PLC0415 - botocore costs half a second

    item = probe(bucket, key(robot))
    try:
        sent = requests.put(item, BODY, conditional=True)
        if sent is Sent.NOT_IMPLEMENTED:
            requests.put(item, BODY, conditional=False)
        elif sent is Sent.CREATED:  # the first time; now it exists, and a condition that is honored is rejected
            sent = requests.put(item, BODY, conditional=True)
        body = b''.join(requests.content(bucket, item.key))
    except BucketMissing:
        yield missing_bucket(bucket, requests.endpoint)
        return
    except (AccessDenied, ObjectRefused) as problem:
        yield from_error(
            's3.write',
            problem,
            f'no permission to put and get under {bucket}/{robot}/, or no such bucket: the server does not report which',
        )
        return
    if body != BODY:
        yield error(
            's3.read',
            f'{bucket}/{item.key} reads back differently',
            'another client writes there, or the server damages content',
            'on the server: check its disks and its log',
        )
        return
    yield ok('s3.write', f'{bucket}: an object was written and read back')
    if sent is Sent.TAKEN:
        yield ok('s3.condition', f'{bucket}: If-None-Match is honored, objects are never overwritten')
        return
    how = 'does not know' if sent is Sent.NOT_IMPLEMENTED else 'ignores'
    yield warning(
        's3.condition',
        f'{bucket}: the server {how} If-None-Match',
        'it would overwrite; each put must look first, which is slower, and concurrent writers are not detected',
        'update the S3 server: SeaweedFS, or MinIO of 2024 or later',
    )


def promises(requests: S3Requests, bucket: str, robot: str, latency_s: float) -> Iterator[Result]:
    """Upload bodies that do not match their checksum: a server that verifies keeps none of them, so they also measure the speed.

    ``latency_s`` is the duration of a request with almost no body.
    """
    name = f'{robot}/_doctor/damaged'
    took_s, refused = _damaged(requests, bucket, name, SMALL_BYTES)
    size = SMALL_BYTES
    if (took_s - latency_s) * LARGE_BYTES / SMALL_BYTES < LARGE_WITHIN_S:
        size = LARGE_BYTES
        took_s, refused = _damaged(requests, bucket, name, size)
    if refused:
        yield ok('s3.checksum', 'the server verifies checksums: content damaged in transit is rejected')
    else:
        yield error(
            's3.checksum',
            'the server accepted an object with a wrong CRC32',
            'it does not verify x-amz-checksum-sha256: content damaged in transit would be confirmed',
            'update the S3 server',
        )
    mbps = 8e-6 * size / max(took_s - latency_s, took_s / 2)
    yield measured(
        's3.throughput',
        f'{mbps:,.1f} Mbit/s to the server ({size >> 10} KiB in {took_s:.2f} s)',
        'below the data rate of the default settings: the backlog grows',
        'iw dev wlan0 link ; log less: camera.rate_hz, lidar.rate_hz, camera.quality in the parameter file',
        is_fine=mbps >= SLOW_MBPS,
        upload_mbps=round(mbps, 2),
    )


def _damaged(requests: S3Requests, bucket: str, name: str, size: int) -> tuple[float, bool]:
    """Seconds that it took, and whether the server rejected it."""
    body = os.urandom(size)
    item = replace(probe(bucket, name, body), sha256=hashlib.sha256(b'another').hexdigest())
    began_s = time.perf_counter()
    try:
        requests.put(item, body, conditional=False)
        refused = False
    except (StoreUnavailable, ObjectRefused) as problem:
        if not problem.data.get('status'):  # no response: a broken connection does not mean a checksum was verified
            raise
        refused = True
    return time.perf_counter() - began_s, refused


def probe(bucket: str, name: str, body: bytes = BODY) -> SpooledObject:
    """A probe object for a put; it has no file."""
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
