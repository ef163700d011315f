#!/usr/bin/env python3
"""Prepares a Tower's S3 server: its buckets, and permissions that keep a robot from deleting or replacing stored objects.

It needs only boto3, takes AWS_ENDPOINT_URL and the keys of the user ``tower`` from the environment, and can be run again at any
time. Replacing: SeaweedFS has no policy condition for a PUT without If-None-Match, so versions are kept: the first one stays
below a second one, and a robot can delete neither. Features that the server rejects are reported, and are not a failure.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import boto3
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

BUCKETS = ('sensor-data', 'trajectories', 'lerobot', 'mlflow', 'lake')
ROBOT_BUCKETS = ('sensor-data', 'trajectories')
OWN_USERS = ('tower', 'mlflow', 'spark', 'prune')
ACCOUNT = '000000000000'
"""The account of every user of a SeaweedFS server, in a policy's ARN."""
OLD_VERSION_DAYS = 30
NO_REQUESTS = b'{"format":1,"entries":[]}'
UNFINISHED_DAYS = 7
GIB = 1 << 30
"""A robot that is offline for longer restarts a large upload."""


def policy(bucket: str, robots: Sequence[str], full: Sequence[str] = ()) -> str:
    """Denies to robots and Spark what their actions would allow: SeaweedFS's ``Write`` includes deleting.

    A URL signed with a robot's keys would let other clients use its permissions later, without the keys: in the old form
    (version 2) for years. An object that a robot encrypted with its own key (SSE-C) would be unreadable for all others.
    ``full`` are robots that have reached their quota.
    """

    def deny(sid: str, users: Sequence[str], actions: Sequence[str], **condition: dict[str, str]) -> dict[str, Any]:
        return {
            'Sid': sid, 'Effect': 'Deny', 'Principal': {'AWS': [f'arn:aws:iam::{ACCOUNT}:user/{name}' for name in users]},
            'Action': actions, 'Resource': [f'arn:aws:s3:::{bucket}/*'], **({'Condition': condition} if condition else {}),
        }  # fmt: skip

    statements = [
        deny('RobotsDoNotDelete', (*robots, 'spark'), ['s3:DeleteObject', 's3:DeleteObjectVersion']),
        deny('RobotsSignNoUrls', robots, ['s3:*'], StringNotEquals={'s3:authType': 'REST-HEADER'}),
        deny('NobodySignsUrlsForYears', ['spark'], ['s3:*'], StringEquals={'s3:authType': 'REST-QUERY-STRING'}),
        deny('RobotsHideNothing', robots, ['s3:PutObject'],
             Null={'s3:x-amz-server-side-encryption-customer-algorithm': 'false'}),
    ]  # fmt: skip
    if full:
        statements.append(deny('RobotsOverTheirQuota', full, ['s3:PutObject']))
    return json.dumps({'Version': '2012-10-17', 'Statement': statements})


def stored_bytes(s3: Any, robot: str) -> int:
    """The bytes stored by a robot: all versions of its objects, and the parts of unfinished uploads."""
    size = 0
    for bucket in ROBOT_BUCKETS:
        given = {'Bucket': bucket, 'Prefix': f'{robot}/'}
        for page in s3.get_paginator('list_object_versions').paginate(**given):
            size += sum(each['Size'] for each in page.get('Versions', ()))
        for page in s3.get_paginator('list_multipart_uploads').paginate(**given):
            for upload in page.get('Uploads', ()):
                parts = s3.get_paginator('list_parts')
                for part in parts.paginate(Bucket=bucket, Key=upload['Key'], UploadId=upload['UploadId']):
                    size += sum(each['Size'] for each in part.get('Parts', ()))
    return size


def over_quota(s3: Any, quotas: Sequence[tuple[str, float]]) -> dict[str, str]:
    """Each robot that has reached its quota, and a sentence about it."""
    found = {}
    for robot, gib in quotas:
        size = stored_bytes(s3, robot) / GIB
        if size >= gib:
            found[robot] = f'{robot} has stored {size:,.3f} GiB of {gib:g} GiB: it cannot store more'
    return found


def rules(bucket: str, robots: Sequence[str] = (), expiry: Sequence[tuple[str, int]] = ()) -> dict[str, Any]:
    """Lifecycle rules: parts of unfinished uploads are deleted, and so are versions that were replaced or deleted long ago.

    ``expiry`` has sensors, and the days after which the server deletes their objects.
    """
    everything = {'Filter': {'Prefix': ''}, 'Status': 'Enabled'}
    found = [
        {'ID': 'unfinished-uploads', 'AbortIncompleteMultipartUpload': {'DaysAfterInitiation': UNFINISHED_DAYS}, **everything}
    ]
    if bucket in ROBOT_BUCKETS:
        found += [{'ID': 'old-versions', 'NoncurrentVersionExpiration': {'NoncurrentDays': OLD_VERSION_DAYS}, **everything}]
        found += [
            {'ID': f'expire-{robot}-{sensor}', 'Filter': {'Prefix': f'{robot}/{sensor}/'}, 'Status': 'Enabled',
             'Expiration': {'Days': days}}
            for robot in robots for sensor, days in expiry
        ]  # fmt: skip
    return {'Rules': found}


def expiry_of(text: str) -> tuple[str, int]:
    """The sensor and the days of ``camera=90``. Raises ArgumentTypeError."""
    sensor, _, days = text.partition('=')
    if not re.fullmatch(r'[A-Za-z0-9][A-Za-z0-9_-]*', sensor) or not re.fullmatch(r'[1-9][0-9]{0,4}', days):
        raise argparse.ArgumentTypeError(f'{text!r} is not SENSOR=DAYS, such as camera=90')
    return sensor, int(days)


def quota_of(text: str) -> tuple[str, float]:
    """The robot and the GiB of ``thor=500``. Raises ArgumentTypeError."""
    robot, _, gib = text.partition('=')
    if not re.fullmatch(r'[A-Za-z0-9][A-Za-z0-9_-]*', robot) or not re.fullmatch(r'[0-9]{1,9}(\.[0-9]{1,9})?', gib):
        raise argparse.ArgumentTypeError(f'{text!r} is not ROBOT=GIB, such as thor=500')
    return robot, float(gib)


def make_mailbox(s3: Any, robot: str) -> None:
    """Create the object through which other clients request a robot's kept data; an existing one stays."""
    key = f'_requests/{robot}/inbox.json'
    try:
        s3.put_object(Bucket='sensor-data', Key=key, Body=NO_REQUESTS, ContentType='application/json', IfNoneMatch='*')
    except ClientError as error:
        if error.response['ResponseMetadata']['HTTPStatusCode'] not in {409, 412}:
            raise


def robots_of(users: Path) -> list[str]:
    """The users of a users.json that are robots."""
    return [name for name in json.loads(users.read_text(encoding='utf-8')) if name not in OWN_USERS]


def connect() -> Any:
    """An S3 client with short timeouts and the current keys: boto3's default session remembers the first keys it saw."""
    settings = Config(connect_timeout=3, read_timeout=15, retries={'total_max_attempts': 2}, s3={'addressing_style': 'path'})
    session = boto3.session.Session()
    return session.client('s3', endpoint_url=os.environ['AWS_ENDPOINT_URL'], region_name='us-east-1', config=settings)


def wait(s3: Any, seconds: float) -> None:
    """Wait until the server answers; raises its last error."""
    end = time.monotonic() + seconds
    while True:
        try:
            s3.list_buckets()
        except (BotoCoreError, ClientError):
            if time.monotonic() > end:
                raise
            time.sleep(0.5)
        else:
            return


def prepare(s3: Any, robots: Sequence[str], expiry: Sequence[tuple[str, int]] = (),
            quotas: Sequence[tuple[str, float]] = ()) -> list[str]:  # fmt: skip
    """Prepare the server; returns a sentence for each feature that it rejects, and for each robot over its quota.

    Raises ClientError if there are no buckets.
    """
    missing: list[str] = []
    present = {bucket['Name'] for bucket in s3.list_buckets()['Buckets']}
    for bucket in BUCKETS:
        if bucket not in present:
            s3.create_bucket(Bucket=bucket)
    full = over_quota(s3, quotas)
    for bucket in BUCKETS:
        lifecycle = rules(bucket, robots, expiry)
        steps = {'lifecycle rules': partial(s3.put_bucket_lifecycle_configuration, LifecycleConfiguration=lifecycle)}
        if bucket in ROBOT_BUCKETS:
            steps['versions'] = partial(s3.put_bucket_versioning, VersioningConfiguration={'Status': 'Enabled'})
            steps['a policy for robots'] = partial(s3.put_bucket_policy, Policy=policy(bucket, robots, list(full)))
        for what, step in steps.items():
            try:
                step(Bucket=bucket)
            except ClientError as error:
                missing.append(f'{bucket}: the server does not accept {what}: {error.response["Error"].get("Code")}')
    for robot in robots:
        make_mailbox(s3, robot)
    return [*missing, *full.values()]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="Prepare a Tower's S3 server: buckets, versions, policy, lifecycle.")
    parser.add_argument(
        '--robot', action='append', default=[], metavar='NAME', help='a robot that must not delete (default: thor)'
    )
    parser.add_argument('--users', type=Path, metavar='FILE', help='take the robots from users.json of make_secrets.py')
    parser.add_argument(
        '--expire',
        action='append',
        default=[],
        type=expiry_of,
        metavar='SENSOR=DAYS',
        help='let the server delete objects of a sensor after this many days, even if datasets refer to them',
    )
    parser.add_argument(
        '--quota',
        action='append',
        default=[],
        type=quota_of,
        metavar='ROBOT=GIB',
        help='stop uploads of a robot that has stored this much, until this is run again with free space',
    )
    parser.add_argument('--wait', type=float, default=60.0, metavar='S', help='how long to wait for the server')
    options = parser.parse_args(arguments)
    if not os.environ.get('AWS_ENDPOINT_URL'):
        print('prepare: AWS_ENDPOINT_URL is not set', file=sys.stderr)
        return 2
    try:
        robots = options.robot or (robots_of(options.users) if options.users else ['thor'])
        s3 = connect()
        wait(s3, options.wait)
        missing = prepare(s3, robots, options.expire, options.quota)
    except (OSError, ValueError) as error:
        print(f'prepare: {options.users}: {error}', file=sys.stderr)
        return 2
    except (BotoCoreError, ClientError) as error:
        print(f'prepare: {os.environ["AWS_ENDPOINT_URL"]}: {error}', file=sys.stderr)
        return 1
    for text in missing:
        print(f'prepare: {text}', file=sys.stderr)
    print(f'prepared: {", ".join(BUCKETS)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
