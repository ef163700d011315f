"""The S3 server: what it is, whether it accepts our signature and objects, and whether conditional puts work.

It leaves behind ``<robot>/_doctor/probe`` in each bucket that this machine writes to, 64 constant bytes, because the robot's
keys cannot delete. On Tower it also races to create more objects and deletes them. On Tower and Spark it races to replace
``_requests/_doctor/inbox.json``.
"""

from __future__ import annotations

import hashlib
import http.client
import ssl
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Final
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    SettingError,
    StoreError,
)
from shadowhound_data_logger.core.mailbox import MAILBOX_BUCKET, inbox_key
from shadowhound_data_logger.doctor import network, s3_put, services
from shadowhound_data_logger.doctor.model import (
    Context,
    Result,
    Role,
    Severity,
    error,
    from_error,
    info,
    measured,
    ok,
    skipped,
    warning,
)
from shadowhound_data_logger.doctor.services import ANSWER_S, TowerService

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.s3_requests import S3Requests

NAME: Final = 's3'
TOWER_BUCKETS: Final = ('sensor-data', 'trajectories', 'lerobot', 'mlflow')
SKEW_S: Final = 5.0
"""From here on, times of two machines cannot be compared."""
REFUSED_SKEW_S: Final = 900.0
"""RequestTimeTooSkewed of S3: 15 minutes."""
SLOW_S: Final = 0.5
"""If a small request takes longer than this, four upload threads send fewer than eight objects per second."""
LATENCY_TRIES: Final = 5
LISTING_BYTES: Final = 1024
RACED: Final = '_doctor'
"""Has a mailbox, and is not a robot."""
RACERS, RACES = 4, 3
MINIO: Final = "MinIO's open-source server was archived in April 2026: it keeps working, without fixes and security advisories"


def check(context: Context) -> Iterator[Result]:
    """Check the server's identity, clock, signature, permissions, puts and latency."""
    service = services.s3(context)
    if service is None:
        yield info(NAME, f'not run: this shell names no S3 server; the store is {context.settings.store.directory}')
        return
    if failed := context.failed('network.s3'):
        yield skipped(NAME, failed)
        return
    for result in _without_keys(service, context):
        yield result
        if result.check == 's3.answer' and result.is_finding:
            return
    try:
        with s3_put.single_requests(context.settings.store) as requests:
            requests.probe()
            yield ok('s3.signature', 'the server accepts our signature')
            yield from _use(requests, context)
    except SettingError as problem:
        yield from_error('s3.setting', problem)
    except CredentialsRejected as problem:
        yield from_error('s3.signature', problem, 'the key pair is invalid on this server: mistyped, or changed on the server')
    except StoreError as problem:
        yield _unusable(problem)


def _unusable(problem: StoreError) -> Result:
    """The finding for an error that ends the check early."""
    if problem.data.get('code') in {'RequestTimeTooSkewed', 'RequestExpired'}:
        return from_error('s3.clock', problem, 'the server rejects signatures that are more than 15 minutes off')
    if problem.data.get('status', 0) >= 500:
        return from_error(
            's3.answer', problem, 'the server fails (a full disk, storage that it cannot reach), or it is not an S3 server'
        )
    if 'like an S3 server' in str(problem):
        return from_error('s3.answer', problem, 'another program answers on this port, or a proxy or login page in between')
    return from_error('s3.answer', problem, 'the connection is bad, or the server is overloaded')


def _without_keys(service: TowerService, context: Context) -> Iterator[Result]:
    """What the server reveals without keys: its name and time, and nothing else."""
    trust = ssl.create_default_context(cafile=network.bundle(service, context)[1] or None) if service.tls else None
    request = Request(service.url, headers={'User-Agent': 'shadowhound-doctor'})  # noqa: S310 - http(s), see services
    try:
        with urlopen(request, timeout=ANSWER_S, context=trust) as answer:  # noqa: S310
            headers, body = answer.headers, answer.read(LISTING_BYTES)
    except HTTPError as problem:  # the usual response to a request without keys
        headers, body = problem.headers, b''
        problem.close()
    except (URLError, OSError, http.client.HTTPException) as problem:
        yield _no_answer(service, getattr(problem, 'reason', problem))
        return
    yield _identity(headers.get('Server', ''), service)
    yield from _clock(headers.get('Date', ''))
    if b'ListAllMyBucketsResult' in body:
        yield warning(
            's3.open',
            'the server lists its buckets without keys',
            'it was started without credentials: every client that can reach it has full access',
            'on the server: make tower-secrets, and start it with them (docs/tower.md)',
        )


def _no_answer(service: TowerService, reason: object) -> Result:
    remedy = 'on the server: docker compose logs --tail 50 ; docker compose restart ; df -h'
    if isinstance(reason, TimeoutError):
        seen = f'{service.url} accepts the connection but does not answer within {ANSWER_S:g} s'
        return error('s3.answer', seen, 'the server hangs: a full or dead disk, or storage that it cannot reach', remedy)
    return error('s3.answer', f'{service.url} does not speak HTTP: {reason}', 'something else listens on this port', remedy)


def _identity(server: str, service: TowerService) -> Result:
    if 'minio' in server.lower():
        return info('s3.server', f'{service.url} is {server}', MINIO, 'plan to move to SeaweedFS: docs/tower.md', server=server)
    return ok('s3.server', f'{service.url} is {server or "a server that does not identify itself"}', server=server)


def _clock(date: str) -> Iterator[Result]:
    """Compare clocks by the Date header, which has whole seconds."""
    try:
        skew_s = time.time() - parsedate_to_datetime(date).timestamp() - 0.5
    except (TypeError, ValueError):
        return
    which = 'ahead of' if skew_s > 0 else 'behind'
    seen = f'the clock of this machine is {abs(skew_s):.0f} s {which} that of the server'
    remedy = 'on both machines: timedatectl ; sudo timedatectl set-ntp true  (docs/thor.md, Wrong clock)'
    if abs(skew_s) >= REFUSED_SKEW_S - 60.0:
        yield error('s3.clock', seen, 'beyond 15 minutes the server rejects every signature', remedy, skew_s=round(skew_s, 1))
    elif abs(skew_s) > SKEW_S:
        yield warning('s3.clock', seen, 'times of robot and server cannot be compared', remedy, skew_s=round(skew_s, 1))
    else:
        yield ok('s3.clock', 'the clocks of this machine and of the server agree', skew_s=round(skew_s, 1))


def _use(requests: S3Requests, context: Context) -> Iterator[Result]:
    if context.role is Role.WORKSTATION:
        yield from _read(requests, context)
        yield from race_mailboxes(requests)
        return
    missing: set[str] = set()
    if context.role is Role.SERVER:
        for result in _buckets(requests):
            missing |= set(result.fix[1:])
            yield result
    written = []
    for bucket in s3_put.buckets(context.settings):
        if bucket in missing:
            continue
        results = list(s3_put.write(requests, bucket, context.settings.robot))
        yield from results
        written += [] if any(result.severity is Severity.ERROR for result in results) else [bucket]
    if not written:
        return
    latency = _latency(requests, written[0], context.settings.robot)
    yield latency
    yield from s3_put.promises(requests, written[0], context.settings.robot, latency.data['latency_s'])
    if context.role is Role.SERVER:
        yield from _delete(requests, written[0], context.settings.robot)
        yield from race_creates(requests, written[0], context.settings.robot)
        yield from race_mailboxes(requests)


def _buckets(requests: S3Requests) -> Iterator[Result]:
    """On Tower: check the buckets that the guide lists."""
    try:
        there = requests.buckets()
    except AccessDenied as problem:
        yield from_error('s3.buckets', problem, "these are not the server's own keys; --role robot checks a robot's keys")
        return
    for name in TOWER_BUCKETS:
        if name not in there:
            yield s3_put.missing_bucket(name, requests.endpoint)
    if all(name in there for name in TOWER_BUCKETS):
        yield ok('s3.buckets', f'the buckets {", ".join(TOWER_BUCKETS)} exist')


def _latency(requests: S3Requests, bucket: str, robot: str) -> Result:
    took = []
    for _ in range(LATENCY_TRIES):
        began_s = time.perf_counter()
        requests.head(bucket, s3_put.key(robot))
        took.append(time.perf_counter() - began_s)
    middle_s = sorted(took)[LATENCY_TRIES // 2]
    return measured(
        's3.latency',
        f'a small request takes {1000 * middle_s:.1f} ms',
        'a weak WiFi signal, or a busy server',
        'ping -c 10 SERVER ; iw dev wlan0 link',
        is_fine=middle_s <= SLOW_S,
        latency_s=round(middle_s, 4),
    )


def _delete(requests: S3Requests, bucket: str, robot: str) -> Iterator[Result]:
    """Check deletion, which only Tower's own keys need."""
    name = f'{robot}/_doctor/{uuid.uuid4().hex}'
    requests.put(s3_put.probe(bucket, name), s3_put.BODY, conditional=True)
    try:
        requests.delete(bucket, name)
        gone = requests.head(bucket, name) is None
    except AccessDenied as problem:
        yield from_error('s3.delete', problem, "these are not the server's own keys")
        return
    if gone:
        yield ok('s3.delete', 'an object can be deleted')
    else:
        yield warning(
            's3.delete',
            f'{bucket}/{name} was deleted but still exists',
            'versions or a retention rule keep it',
            f'aws --endpoint-url {requests.endpoint} s3api get-bucket-versioning --bucket {bucket}',
        )


def race_creates(requests: S3Requests, bucket: str, robot: str) -> Iterator[Result]:
    """On Tower, whose keys may delete: check that of several clients creating one object at the same time only one succeeds."""
    names = [f'{robot}/_doctor/{uuid.uuid4().hex}' for _ in range(RACES)]
    try:
        winners = [_creators(requests, bucket, name) for name in names]
        for name in names:
            requests.delete(bucket, name)
    except AccessDenied as problem:
        yield from_error('s3.race', problem, "these are not the server's own keys")
        return
    if winners == [1] * RACES:
        yield ok('s3.race', f'of {RACERS} concurrent creators of an object one succeeds')
        return
    yield warning(
        's3.race',
        f'of {RACERS} concurrent creators of an object {winners} succeeded',
        'the server does not apply If-None-Match to concurrent requests: one of two objects with the same key is overwritten',
        'give each robot a unique name (SHADOWHOUND_ROBOT), and update the S3 server',
    )


def _creators(requests: S3Requests, bucket: str, name: str) -> int:
    from shadowhound_data_logger.stores.s3_requests import Sent  # noqa: PLC0415 - botocore costs half a second

    def create(racer: int) -> bool:
        body = b'%d' % racer
        return requests.put(s3_put.probe(bucket, name, body), body, conditional=True) is Sent.CREATED

    with ThreadPoolExecutor(RACERS) as pool:
        return sum(pool.map(create, range(RACERS)))


def _read(requests: S3Requests, context: Context) -> Iterator[Result]:
    """On Spark: list, and read the first object."""
    bucket, prefix = s3_put.buckets(context.settings)[0], f'{context.settings.robot}/'
    try:
        first = next(requests.list(bucket, prefix), None)
        if first is None:
            yield from _nothing(requests, bucket, prefix)
            return
        began_s = time.perf_counter()
        body = b''.join(requests.content(bucket, first.key))
    except AccessDenied as problem:
        yield from_error('s3.read', problem, 'a researcher must be able to list and get')
        return
    mbps = 8e-6 * len(body) / max(time.perf_counter() - began_s, 1e-6)
    yield ok(
        's3.read', f'{bucket}/{first.key} can be read', download_mbps=round(mbps, 2), sha256=hashlib.sha256(body).hexdigest()
    )


def race_mailboxes(requests: S3Requests) -> Iterator[Result]:
    """On Spark and Tower: check that one of several concurrent replacements of a mailbox succeeds, and none if there is none."""
    check, remedy = 's3.mailbox', 'on the server: run tower/make_secrets.py and tower/prepare.py again, and restart the server'
    try:
        item = s3_put.probe(MAILBOX_BUCKET, inbox_key(RACED))
        requests.put(item, s3_put.BODY, conditional=True)
        winners = [_winners(requests) for _ in range(RACES)]
        is_made = _is_created(requests, inbox_key(f'{RACED}_{uuid.uuid4().hex}'))
    except AccessDenied:
        yield info(
            check,
            'these keys may not request objects that a robot keeps',
            'this server was prepared by an earlier version',
            remedy,
        )
        return
    if max(winners) > 1 or not any(winners):  # none of a round: another doctor replaced it
        seen = f'of {RACERS} concurrent replacements of a mailbox {winners} succeeded'
        yield warning(check, seen, 'the server does not apply If-Match: requests get lost', 'use SeaweedFS 4, or a newer MinIO')
    elif is_made:
        yield warning(check, 'If-Match created an object that did not exist', 'a bug of MinIO before 2025', 'update the server')
    else:
        yield ok(check, f'of {RACERS} concurrent replacements of a mailbox one succeeds')


def _winners(requests: S3Requests) -> int:
    found = requests.changed(MAILBOX_BUCKET, inbox_key(RACED), '', LISTING_BYTES)
    assert found is not None  # an ETag is never empty
    bodies = [uuid.uuid4().bytes for _ in range(RACERS)]  # with equal bodies of another doctor an old ETag would be valid again
    with ThreadPoolExecutor(RACERS) as pool:
        return sum(pool.map(lambda body: requests.replace(MAILBOX_BUCKET, inbox_key(RACED), body, found[1]), bodies))


def _is_created(requests: S3Requests, key: str) -> bool:
    try:
        return requests.replace(MAILBOX_BUCKET, key, b'{}', f'"{"0" * 32}"')
    except ObjectRefused:
        return False


def _nothing(requests: S3Requests, bucket: str, prefix: str) -> Iterator[Result]:
    try:
        b''.join(requests.content(bucket, s3_put.key(prefix.rstrip('/'))))
    except BucketMissing:
        yield s3_put.missing_bucket(bucket, requests.endpoint)
    except ObjectRefused:
        yield warning(
            's3.read',
            f'no object exists under {bucket}/{prefix}',
            'no robot of this name has delivered anything yet, or not to this server',
            'SHADOWHOUND_ROBOT names the robot; on it run: shadowhound-data doctor',
        )
