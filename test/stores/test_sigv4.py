"""The signature of a PUT: the very same that botocore makes."""

from __future__ import annotations

import hashlib
from datetime import datetime, timezone
from unittest import mock
from urllib.parse import quote

import pytest
from botocore.auth import S3SigV4Auth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials

from shadowhound_data_logger.stores.s3_http import signed

NOW = datetime(2025, 10, 18, 12, 0, 5, tzinfo=timezone.utc)
BODY = b'{"robot": "thor"}'
PLAIN = {'content-type': 'application/json', 'if-none-match': '*', 'x-amz-meta-robot': 'thor'}


class _KnownHash(S3SigV4Auth):
    def payload(self, request: AWSRequest) -> str:
        return hashlib.sha256(BODY).hexdigest()


@pytest.mark.parametrize(
    ('key', 'headers', 'token', 'region'),
    [
        ('thor/imu/20251018/120000_imu.json', PLAIN, None, 'us-east-1'),
        ('thor/imu/20251018/120000_imu.json', PLAIN, 'a/session+token==', 'eu-central-1'),
        ("thor/a!b*c'(d)=e+f@g.json", PLAIN, None, 'us-east-1'),
        ('thor/x.json', {**PLAIN, 'x-amz-meta-said': '  two  spaces,   and one '}, None, 'us-east-1'),
        ('thor/x.json', {}, None, 'us-east-1'),
    ],
)
def test_same_as_botocore(key: str, headers: dict[str, str], token: str | None, region: str) -> None:
    """For one request at one instant, both write the same headers."""
    keys = Credentials('AKIDEXAMPLE', 'wJalrXUtnFEMI/K7MDENG+bPxRfiCYEXAMPLEKEY', token)
    path = f'/sensor-data/{quote(key)}'
    ours = signed('PUT', path, {**headers, 'host': 'tower:9000'}, hashlib.sha256(BODY).hexdigest(), now=NOW,
                  credentials=keys.get_frozen_credentials(), region=region)  # fmt: skip
    theirs = AWSRequest(method='PUT', url=f'http://tower:9000{path}', headers={**headers, 'Host': 'tower:9000'}, data=BODY)
    with mock.patch('botocore.auth.get_current_datetime', return_value=NOW.replace(tzinfo=None)):
        _KnownHash(keys, 's3', region).add_auth(theirs)
    assert ours['authorization'] == theirs.headers['Authorization']
    assert {name.lower(): value for name, value in theirs.headers.items()} == ours


def test_a_query_is_signed_as_botocore_signs_it() -> None:
    """That of a part, whose upload has an id with every kind of character."""
    keys = Credentials('AKIDEXAMPLE', 'wJalrXUtnFEMI/K7MDENG+bPxRfiCYEXAMPLEKEY')
    target = f'/sensor-data/thor/x.mcap?partNumber=12&uploadId={quote("aB3_-.~/+= ", safe="")}'
    ours = signed('PUT', target, {'content-md5': 'x==', 'host': 'tower:9000'}, hashlib.sha256(BODY).hexdigest(), now=NOW,
                  credentials=keys.get_frozen_credentials(), region='us-east-1')  # fmt: skip
    theirs = AWSRequest(method='PUT', url=f'http://tower:9000{target}', headers={'content-md5': 'x==', 'Host': 'tower:9000'},
                        data=BODY)  # fmt: skip
    with mock.patch('botocore.auth.get_current_datetime', return_value=NOW.replace(tzinfo=None)):
        _KnownHash(keys, 's3', 'us-east-1').add_auth(theirs)
    assert ours['authorization'] == theirs.headers['Authorization']
