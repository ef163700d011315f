"""The permissions of a Tower's users on a real SeaweedFS, also for objects sent in parts."""

from __future__ import annotations

import hashlib
import itertools
import os
import random
import re
import signal
import subprocess
import sys
import time
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import boto3
import pytest
import urllib3
from botocore.config import Config
from botocore.exceptions import ClientError
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from lake.making import add, add_part, row
from shadowhound_tower.embedded import Tower
from tower_scripts import make_secrets, prepare

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, ForeignObject, LakeError
from shadowhound_data_logger.core.mailbox import KeptFilter, decode_inbox, inbox_key
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.doctor.model import Severity
from shadowhound_data_logger.doctor.s3 import RACED, RACERS, race_mailboxes
from shadowhound_data_logger.doctor.s3_put import single_requests
from shadowhound_data_logger.lake import prune, pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.shipping.audit import AuditProgress, audit
from shadowhound_data_logger.stores import content, open_store, s3_puts
from shadowhound_data_logger.stores.s3 import S3Store

pytestmark = pytest.mark.seaweedfs
Connect = Callable[[str], Any]


def _is_denied(call: Callable[..., Any], **arguments: Any) -> bool:
    try:
        call(**arguments)
    except ClientError as error:
        return bool(error.response['ResponseMetadata']['HTTPStatusCode'] == 403)
    return False


def _object(folder: Path, key: str, body: bytes) -> SpooledObject:
    path = folder / key.replace('/', '_')
    path.write_bytes(body)
    sha256 = hashlib.sha256(body).hexdigest()
    return SpooledObject(1, 'sensor-data', key, path, len(body), sha256, 'text/plain', {'sha256': sha256}, 5, 0)


def test_the_logger_works_with_a_robots_keys(server: Tower, tmp_path: Path) -> None:
    """Everything that delivery requests is allowed, and the condition is honored on a versioned bucket."""
    store = S3Store(server.store_settings('thor'), UploadSettings())
    store.open()
    try:
        store.probe()
        item = _object(tmp_path, 'thor/camera/a.txt', b'one')
        assert store.put(item) is Put.CREATED
        assert store.put(item) is Put.IDENTICAL
        with pytest.raises(ForeignObject):
            store.put(_object(tmp_path, 'thor/camera/a.txt', b'two'))
        info = store.head('sensor-data', 'thor/camera/a.txt')
        assert info
        assert info.sha256 == item.sha256
        assert store.head('sensor-data', 'thor/camera/none.txt') is None
        with pytest.raises(AccessDenied):
            store.put(_object(tmp_path, 'tachi/camera/a.txt', b'one'))
    finally:
        store.close()


def test_a_robot_cannot_delete(as_user: Connect) -> None:
    """Neither one object, nor many at once, nor a version; and it cannot change the policy."""
    thor = as_user('thor')
    thor.put_object(Bucket='sensor-data', Key='thor/keep', Body=b'one')
    version = as_user('tower').list_object_versions(Bucket='sensor-data', Prefix='thor/keep')['Versions'][0]['VersionId']
    assert _is_denied(thor.delete_object, Bucket='sensor-data', Key='thor/keep')
    assert _is_denied(thor.delete_object, Bucket='sensor-data', Key='thor/keep', VersionId=version)
    answer = thor.delete_objects(Bucket='sensor-data', Delete={'Objects': [{'Key': 'thor/keep'}]})
    assert not answer.get('Deleted')
    assert _is_denied(thor.delete_bucket_policy, Bucket='sensor-data')
    assert _is_denied(thor.put_bucket_policy, Bucket='sensor-data', Policy='{"Version": "2012-10-17", "Statement": []}')
    rules = {'Rules': [{'ID': 'x', 'Status': 'Enabled', 'Filter': {'Prefix': ''}, 'Expiration': {'Days': 1}}]}
    assert _is_denied(thor.put_bucket_lifecycle_configuration, Bucket='sensor-data', LifecycleConfiguration=rules)
    assert _is_denied(thor.put_bucket_versioning, Bucket='sensor-data', VersioningConfiguration={'Status': 'Suspended'})
    assert as_user('spark').get_object(Bucket='sensor-data', Key='thor/keep')['Body'].read() == b'one'


def test_objects_that_a_robot_replaces_are_kept(as_user: Connect) -> None:
    """The server cannot refuse a PUT without a condition, but the first version stays, and the robot cannot remove it."""
    thor, tower = as_user('thor'), as_user('tower')
    assert _is_denied(thor.put_object, Bucket='lake', Key='objects/_delta_log/00000000000000000000.json', Body=b'{}')
    assert _is_denied(as_user('spark').put_object, Bucket='lake', Key='objects/x', Body=b'{}')
    thor.put_object(Bucket='trajectories', Key='thor/path.csv', Body=b'one')
    thor.put_object(Bucket='trajectories', Key='thor/path.csv', Body=b'two')
    versions = tower.list_object_versions(Bucket='trajectories', Prefix='thor/path.csv')['Versions']
    first = next(version['VersionId'] for version in versions if not version['IsLatest'])
    assert _is_denied(thor.delete_object, Bucket='trajectories', Key='thor/path.csv', VersionId=first)
    assert tower.get_object(Bucket='trajectories', Key='thor/path.csv', VersionId=first)['Body'].read() == b'one'


def test_a_robot_has_access_to_its_own_objects_only(as_user: Connect) -> None:
    """It can neither read, write, copy nor list other objects, nor create a bucket."""
    as_user('tachi').put_object(Bucket='sensor-data', Key='tachi/secret', Body=b'one')
    thor = as_user('thor')
    assert _is_denied(thor.get_object, Bucket='sensor-data', Key='tachi/secret')
    assert _is_denied(thor.put_object, Bucket='sensor-data', Key='tachi/other', Body=b'two')
    assert _is_denied(thor.copy_object, Bucket='sensor-data', Key='thor/copy', CopySource='sensor-data/tachi/secret')
    assert _is_denied(thor.list_objects_v2, Bucket='sensor-data')
    assert _is_denied(thor.put_object, Bucket='mlflow', Key='thor/x', Body=b'two')
    assert _is_denied(thor.get_object, Bucket='lerobot', Key='thor/x')
    assert _is_denied(thor.create_bucket, Bucket='thors-own')


def test_spark_reads_everything_and_changes_nothing_of_a_robot(as_user: Connect) -> None:
    """It lists and reads all buckets, and can neither write nor delete what robots or MLflow wrote."""
    as_user('thor').put_object(Bucket='sensor-data', Key='thor/for-spark', Body=b'one')
    spark = as_user('spark')
    listed = [entry['Key'] for entry in spark.list_objects_v2(Bucket='sensor-data', Prefix='thor/for-spark')['Contents']]
    assert listed == ['thor/for-spark']
    assert spark.get_object(Bucket='sensor-data', Key='thor/for-spark')['Body'].read() == b'one'
    assert _is_denied(spark.put_object, Bucket='sensor-data', Key='thor/x', Body=b'two')
    assert _is_denied(spark.delete_object, Bucket='sensor-data', Key='thor/for-spark')
    assert _is_denied(spark.put_object, Bucket='mlflow', Key='1/x', Body=b'two')
    assert {bucket['Name'] for bucket in spark.list_buckets()['Buckets']} == {
        'sensor-data', 'trajectories', 'lerobot', 'mlflow', 'lake',
    }  # fmt: skip


def test_only_spark_writes_training_sets(as_user: Connect) -> None:
    """It puts datasets into their bucket, replaces and deletes them; a robot can do none of this."""
    spark, thor, key = as_user('spark'), as_user('thor'), 'datasets/go2/set/meta/info.json'
    spark.put_object(Bucket='lerobot', Key=key, Body=b'one')
    for call in (thor.put_object, thor.get_object, thor.delete_object):
        assert _is_denied(call, Bucket='lerobot', Key=key)
    assert _is_denied(thor.put_object, Bucket='lerobot', Key='thor/x', Body=b'two')
    spark.delete_object(Bucket='lerobot', Key=key)
    assert 'Contents' not in spark.list_objects_v2(Bucket='lerobot', Prefix=key)


def test_robots_read_only_policies_there(as_user: Connect) -> None:
    """A robot gets each object below policies, and can neither list, write nor delete there, nor see other folders."""
    spark, thor, key = as_user('spark'), as_user('thor'), 'policies/go2/go2_patrol_v7/manifest.json'
    for name in (key, 'policies_of_others/x', 'datasets/x'):
        spark.put_object(Bucket='lerobot', Key=name, Body=b'one')
    assert thor.get_object(Bucket='lerobot', Key=key)['Body'].read() == b'one'
    assert not _is_denied(thor.head_object, Bucket='lerobot', Key=key)
    for name in ('policies_of_others/x', 'datasets/x'):
        assert _is_denied(thor.get_object, Bucket='lerobot', Key=name)
    assert _is_denied(thor.put_object, Bucket='lerobot', Key=key, Body=b'two')
    assert _is_denied(thor.put_object, Bucket='lerobot', Key='policies/new', Body=b'two')
    assert _is_denied(thor.delete_object, Bucket='lerobot', Key=key)
    assert _is_denied(thor.copy_object, Bucket='lerobot', Key='policies/copy', CopySource=f'lerobot/{key}')
    for prefix in ('', 'policies/'):
        assert _is_denied(thor.list_objects_v2, Bucket='lerobot', Prefix=prefix)


def test_old_data_is_deleted_by_one_user_alone(server: Tower, as_user: Connect, tmp_path: Path) -> None:
    """`lake prune` with the keys of a robot, or of Spark, deletes nothing and writes no row; with its own user's it does."""
    at_ns = 1_790_000_000 * SECOND
    rows = [row('camera', at_ns + number * SECOND) for number in range(3)]
    with closing(S3Store(server.store_settings('thor'), UploadSettings())) as robot:
        robot.open()
        for each in rows:
            add(robot, tmp_path, each['key'], b'one')
        add_part(robot, rows, 'part', tmp_path)
    assert _is_denied(as_user('thor').put_object, Bucket='sensor-data', Key='_forgotten/thor/x', Body=b'one')
    source = Bucket(server.store_settings('spark'), 'sensor-data')
    rules, findings = prune.keep_rules('camera 1d', at_ns + 9 * 86_400 * SECOND), Findings()
    made = prune.plan(source, rules, robot='thor', exported={}, findings=findings)
    assert made.going == 3
    how = {'now_ns': at_ns, 'findings': findings}
    for user in ('thor', 'spark', 'prune'):
        with closing(S3Store(server.store_settings(user), UploadSettings())) as store:
            store.open()
            if user == 'prune':
                assert prune.apply(Bucket(server.store_settings(user), 'sensor-data'), store, made, **how).objects == 3
            else:
                with pytest.raises(LakeError, match='do not permit pruning'):
                    prune.apply(source, store, made, **how)
                assert len(source.list('thor/camera/20260921/')) == 3
                assert source.list('_forgotten/') == []
    assert source.list('thor/camera/20260921/') == []
    assert len(source.list('_forgotten/thor/')) == 2
    assert _is_denied(as_user('prune').put_object, Bucket='lerobot', Key='x', Body=b'one')
    assert _is_denied(as_user('prune').get_object, Bucket='mlflow', Key='x')


def test_the_server_can_delete_by_age(as_user: Connect) -> None:
    """With lifecycle rules for each robot's folder of a sensor; other rules are refused."""
    tower = as_user('tower')
    before = tower.get_bucket_lifecycle_configuration(Bucket='sensor-data')['Rules']
    assert prepare.prepare(tower, ['thor', 'tachi'], [prepare.expiry_of('camera=90')]) == []
    found = {rule['ID']: rule for rule in tower.get_bucket_lifecycle_configuration(Bucket='sensor-data')['Rules']}
    assert found['expire-thor-camera']['Expiration']['Days'] == 90
    assert found['expire-tachi-camera']['Filter']['Prefix'] == 'tachi/camera/'
    prepare.prepare(tower, ['thor', 'tachi'])
    assert tower.get_bucket_lifecycle_configuration(Bucket='sensor-data')['Rules'] == before
    for text in ('camera', 'camera=0', 'camera=x', '../x=1', '_ledger=1'):
        with pytest.raises(ArgumentTypeError):
            prepare.expiry_of(text)


def test_mlflow_has_its_bucket_alone(as_user: Connect) -> None:
    """It can read, write and delete artifacts, and nothing else."""
    mlflow = as_user('mlflow')
    mlflow.put_object(Bucket='mlflow', Key='1/a', Body=b'one')
    mlflow.delete_object(Bucket='mlflow', Key='1/a')
    assert _is_denied(mlflow.list_objects_v2, Bucket='sensor-data')


def test_preparing_again_changes_nothing(
    server: Tower, as_user: Connect, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A second run keeps the data, and the robots are those of the file that make_secrets.py writes."""
    as_user('thor').put_object(Bucket='sensor-data', Key='thor/stays', Body=b'one')
    for name, value in server.environment().items():
        monkeypatch.setenv(name, value)
    make_secrets.make(tmp_path, None, ['thor', 'tachi'])
    assert prepare.robots_of(tmp_path / 'secrets' / 'users.json') == ['thor', 'tachi']
    assert prepare.main(['--users', str(tmp_path / 'secrets' / 'users.json')]) == 0
    assert _is_denied(as_user('tachi').delete_object, Bucket='sensor-data', Key='tachi/any')
    rules = as_user('tower').get_bucket_lifecycle_configuration(Bucket='sensor-data')['Rules']
    assert {rule['ID'] for rule in rules} == {'unfinished-uploads', 'old-versions'}


@pytest.mark.long('servers of its own')
def test_a_mailbox_is_read_by_its_robot_and_written_by_spark(server: Tower, as_user: Connect,
                                                             monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """The robot may neither write nor delete its own, nor read another one's; Spark may not delete, and loses no race."""
    thor, spark, place = as_user('thor'), as_user('spark'), {'Bucket': 'sensor-data', 'Key': '_requests/thor/inbox.json'}
    assert thor.get_object(**place)['Body'].read() == prepare.NO_REQUESTS
    assert _is_denied(thor.put_object, **place, Body=b'{}')
    assert _is_denied(thor.delete_object, **place)
    assert _is_denied(as_user('tachi').get_object, **place)
    assert _is_denied(spark.delete_object, **place)
    assert _is_denied(spark.put_object, Bucket='sensor-data', Key='thor/_answers/x/1.json', Body=b'{}')
    source = Bucket(server.store_settings('spark'), 'sensor-data')
    robot, other = (
        S3Store(server.store_settings('thor'), UploadSettings()),
        S3Store(server.store_settings('spark'), UploadSettings()),
    )
    with closing(robot), closing(other):
        robot.open()
        other.open()
        with ThreadPoolExecutor(6) as pool:
            wants = [KeptFilter(sensor=f'camera{number}') for number in range(12)]
            asked = set(pool.map(lambda want: pull.put_request(other, source, 'thor', want, by='spark').id, wants))
        found = robot.changed('sensor-data', place['Key'], '', 1 << 20)
        assert found
        assert {entry['id'] for entry in decode_inbox(found[0])} == asked
        assert robot.changed('sensor-data', place['Key'], found[1], 1 << 20) is None
    for name, value in server.environment().items():
        monkeypatch.setenv(name, value)
    assert prepare.main(['--robot', 'thor']) == 0
    assert thor.get_object(**place)['Body'].read() == found[0]


def test_the_doctor_races_for_a_mailbox(server: Tower) -> None:
    """With the keys of users with permission, one wins each time; a robot may not write at all."""
    for user, severity in (('spark', Severity.OK), ('thor', Severity.INFO)):
        with single_requests(server.store_settings(user)) as requests:
            (found,) = race_mailboxes(requests)
        assert (found.check, found.severity) == ('s3.mailbox', severity), found


class _Ignoring:
    """A server that accepts every put, whatever its condition."""

    def __init__(self, *, makes: bool) -> None:
        self._makes = makes
        self._count = itertools.count()
        self.bodies: list[bytes] = []

    def put(self, *_: Any, **__: Any) -> None:
        """The object exists afterwards."""

    def changed(self, *_: Any) -> tuple[bytes, str]:
        return b'', 'version'

    def replace(self, _: str, key: str, body: bytes, __: str) -> bool:
        if key != inbox_key(RACED):
            return self._makes
        self.bodies.append(body)
        return not self._makes or next(self._count) % RACERS == 0


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize(('makes', 'says'), [(False, 'does not apply If-Match'), (True, 'MinIO')])
def test_the_doctor_detects_a_server_that_ignores_if_match(makes: bool, says: str) -> None:
    """Or one that creates a missing object."""
    (found,) = race_mailboxes(_Ignoring(makes=makes))  # type: ignore[arg-type]
    assert found.is_finding
    assert says in found.cause


@pytest.mark.parametrize('winners', [[0, 1, 0], [0, 0, 0], [1, 2, 1]])
def test_two_doctors_may_race_at_the_same_time(monkeypatch: pytest.MonkeyPatch, winners: list[int]) -> None:
    """Of a round, the other doctor may win all; no body repeats, because an ETag would be valid again with it."""
    server = _Ignoring(makes=False)
    for _ in range(2):
        list(race_mailboxes(server))  # type: ignore[arg-type]
    assert len(set(server.bodies)) == len(server.bodies) > RACERS
    rounds = iter(winners)
    monkeypatch.setattr('shadowhound_data_logger.doctor.s3._winners', lambda _: next(rounds))
    (found,) = race_mailboxes(server)  # type: ignore[arg-type]
    assert found.is_finding == (winners != [0, 1, 0])


def _presigned(
    server: Tower, user: str, version: str, seconds: int, method: str = 'get_object', key: str = 'thor/camera/url.txt'
) -> str:
    environ = server.environment(user)
    client = boto3.client(
        's3', endpoint_url=environ['AWS_ENDPOINT_URL'], aws_access_key_id=environ['AWS_ACCESS_KEY_ID'],
        aws_secret_access_key=environ['AWS_SECRET_ACCESS_KEY'], region_name='us-east-1',
        config=Config(signature_version=version, s3={'addressing_style': 'path'}),
    )  # fmt: skip
    return str(
        client.generate_presigned_url(method, Params={'Bucket': 'sensor-data', 'Key': 'thor/camera/url.txt'}, ExpiresIn=seconds)
    )


YEAR_S = 52 * 7 * 86_400


@pytest.mark.parametrize(('user', 'version', 'seconds', 'method', 'status'), [
    ('thor', 's3', YEAR_S, 'get_object', 403), ('thor', 's3', YEAR_S, 'put_object', 403), ('thor', 's3', 60, 'get_object', 403),
    ('thor', 's3v4', 60, 'get_object', 403), ('thor', 's3v4', 60, 'put_object', 403), ('thor', 's3v4', YEAR_S, 'get_object', 400),
    ('spark', 's3', YEAR_S, 'get_object', 403), ('spark', 's3v4', YEAR_S, 'get_object', 400),
    ('spark', 's3v4', 60, 'get_object', 200), ('tower', 's3', YEAR_S, 'get_object', 200),
])  # fmt: skip
def test_presigned_urls_expire_with_a_robots_keys(
    server: Tower, as_user: Connect, user: str, version: str, seconds: int, method: str, status: int
) -> None:
    """A robot signs no URL, and Spark none for longer than a week; the Tower's own user is not restricted."""
    as_user('thor').put_object(Bucket='sensor-data', Key='thor/camera/url.txt', Body=b'mine')
    url = _presigned(server, user, version, seconds, method)
    body = b'theirs' if method == 'put_object' else None
    answer = urllib3.request('PUT' if body else 'GET', url, body=body, retries=False, timeout=30)
    assert answer.status == status
    assert as_user('spark').get_object(Bucket='sensor-data', Key='thor/camera/url.txt')['Body'].read() == b'mine'


@pytest.mark.parametrize('how', ['put', 'copy', 'parts'])
def test_a_robot_cannot_encrypt_with_its_own_key(as_user: Connect, how: str) -> None:
    """With SSE-C nothing is stored, and objects encrypted with the server's key are readable by Spark."""
    thor, where = as_user('thor'), {'Bucket': 'sensor-data', 'Key': f'thor/camera/hidden-{how}.txt'}
    thor.put_object(Bucket='sensor-data', Key='thor/camera/plain.txt', Body=b'plain', ServerSideEncryption='AES256')
    own = {'SSECustomerAlgorithm': 'AES256', 'SSECustomerKey': b'k' * 32}
    calls: dict[str, Callable[..., Any]] = {
        'put': partial(thor.put_object, Body=b'hidden'), 'parts': thor.create_multipart_upload,
        'copy': partial(thor.copy_object, CopySource='sensor-data/thor/camera/plain.txt'),
    }  # fmt: skip
    assert _is_denied(calls[how], **where, **own)
    spark = as_user('spark')
    assert spark.get_object(Bucket='sensor-data', Key='thor/camera/plain.txt')['Body'].read() == b'plain'
    with pytest.raises(ClientError, match='404'):
        spark.head_object(**where)


def test_verify_finds_a_hidden_object(server: Tower, as_user: Connect, tmp_path: Path) -> None:
    """An object encrypted with the client's key (SSE-C) is a finding and does not stop the audit; HEAD only responds with 400."""
    bodies = {'thor/camera/sse-a.txt': b'one', 'thor/camera/sse-b.txt': b'hidden', 'thor/camera/sse-c.txt': b'three'}
    admin = as_user('tower')
    own = {'SSECustomerAlgorithm': 'AES256', 'SSECustomerKey': b'k' * 32}
    expected = []
    for number, (key, body) in enumerate(bodies.items()):
        sha256 = hashlib.sha256(body).hexdigest()
        admin.put_object(Bucket='sensor-data', Key=key, Body=body, Metadata={'sha256': sha256}, **(own if number == 1 else {}))
        expected.append(ObjectInfo('sensor-data', key, len(body), sha256))
    with closing(open_store(server.store_settings('spark'), UploadSettings())) as store:
        store.open()
        with AuditProgress(tmp_path / 'verify', '') as progress:
            found = audit([expected], progress, store, pause=lambda _: pytest.fail('a wait'))
    assert found.away is None
    assert found.counts == {'unreadable': 1}, found
    (finding,) = found.first['unreadable']
    assert finding.key == 'thor/camera/sse-b.txt'
    assert found.sound == 2


def test_a_robot_that_is_over_its_quota_stores_nothing_more(server: Tower, as_user: Connect, monkeypatch: pytest.MonkeyPatch,
                                                            capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    """All versions and unfinished uploads count; other robots continue, and so does this one once it has quota again."""
    for name, value in server.environment().items():
        monkeypatch.setenv(name, value)
    robots = ['--robot', 'thor', '--robot', 'tachi']
    admin, tachi, where = prepare.connect(), as_user('tachi'), {'Bucket': 'trajectories', 'Key': 'tachi/quota.csv'}
    before = prepare.stored_bytes(admin, 'tachi')
    for _ in range(2):
        tachi.put_object(**where, Body=b'x' * (1 << 20))
    upload = tachi.create_multipart_upload(Bucket='sensor-data', Key='tachi/quota.mcap')['UploadId']
    tachi.upload_part(Bucket='sensor-data', Key='tachi/quota.mcap', UploadId=upload, PartNumber=1, Body=b'x' * (1 << 20))
    assert prepare.stored_bytes(admin, 'tachi') == before + (3 << 20)
    try:
        assert prepare.main([*robots, '--quota', f'tachi={(before + (2 << 20)) / prepare.GIB:.9f}', '--quota', 'thor=1000']) == 0
        assert 'tachi has stored' in capsys.readouterr().err
        for bucket in prepare.ROBOT_BUCKETS:
            assert _is_denied(tachi.put_object, Bucket=bucket, Key='tachi/more', Body=b'x')
            assert _is_denied(tachi.create_multipart_upload, Bucket=bucket, Key='tachi/more')
            as_user('thor').put_object(Bucket=bucket, Key='thor/quota', Body=b'x')
        assert _is_denied(
            tachi.upload_part, Bucket='sensor-data', Key='tachi/quota.mcap', UploadId=upload, PartNumber=2, Body=b'x'
        )
        assert tachi.get_object(**where)['ContentLength'] == 1 << 20
        assert prepare.main([*robots, '--quota', 'tachi=1000']) == 0
        tachi.put_object(**where, Body=b'x')
        assert capsys.readouterr().err == ''
    finally:
        assert prepare.main(robots) == 0


@pytest.mark.parametrize('text', ['', 'thor', 'thor=', '=5', 'thor=-1', 'thor=1e3', '../x=5', 'thor=nan'])
def test_an_invalid_quota_is_rejected(text: str) -> None:
    """With the expected format."""
    with pytest.raises(ArgumentTypeError, match='such as thor=500'):
        prepare.quota_of(text)
    assert prepare.quota_of('thor=0.5') == ('thor', 0.5)


PART = 5 << 20
CONTENT = random.Random(1).randbytes(4 * PART + 12_345)
KEY = 'thor/rosbags/patrol_20261121_120000/patrol_20261121_120000_0.mcap'
PARTS = [1, 2, 3, 4, 5]
BEFORE = 2
"""The parts sent before the robot loses power."""
PROGRAM = """
import sys
from pathlib import Path
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.stores import content, s3, s3_puts
sys.path.insert(0, sys.argv[1])
from tower.test_prepare import KEY, PART, slice_of
content.PART_BYTES = s3_puts.MULTIPART_BYTES = PART
settings = StoreSettings(endpoint_url=sys.argv[3], access_key_id=sys.argv[4], secret_access_key=sys.argv[5])
store = s3.S3Store(settings, UploadSettings())
store.open()
store.put(slice_of(Path(sys.argv[2])))
"""


class Watching(Front):
    """Records the parts sent and other requests, and stops responding after this many parts."""

    def __init__(self, url: str, most: int) -> None:
        super().__init__(url, lambda: Fault.HUNG if len(self.sent) >= most else Fault.NONE)
        self.sent: list[int] = []
        self.asked: list[str] = []

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        answer = super().forward(request, slowly=slowly)
        self.asked.append(f'{request.method} {answer.split()[1].decode()}')
        if number := re.search(r'partNumber=(\d+)', request.target):
            self.sent.append(int(number[1]))
        return answer


def slice_of(path: Path, key: str = KEY) -> SpooledObject:
    """The content of the file, as an object of the spool."""
    body = path.read_bytes()
    sha256 = hashlib.sha256(body).hexdigest()
    return SpooledObject(1, 'sensor-data', key, path, len(body), sha256, 'application/x-mcap', {'sensor': 'rosbags'}, 5, 0)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / 'slice.mcap'
    path.write_bytes(CONTENT)
    return path


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a fraction of a slice count as large."""
    monkeypatch.setattr(s3_puts, 'MULTIPART_BYTES', PART)
    monkeypatch.setattr(content, 'PART_BYTES', PART)


@pytest.fixture
def through(server: Tower) -> Iterator[Callable[[Front], S3Store]]:
    """A store with the keys of thor, through a proxy."""
    opened: list[S3Store] = []

    def make(front: Front) -> S3Store:
        settings = replace(server.store_settings('thor'), endpoint_url=front.url)
        opened.append(S3Store(settings, UploadSettings()))
        opened[-1].open()
        return opened[-1]

    yield make
    for store in opened:
        store.close()


def under_way(client: Any, prefix: str = '') -> list[str]:
    return [upload['Key'] for upload in client.list_multipart_uploads(Bucket='sensor-data', Prefix=prefix).get('Uploads', ())]


@pytest.mark.usefixtures('small_parts')
@pytest.mark.long('a kill')
def test_a_slice_interrupted_by_a_kill_is_resumed(
    server: Tower, as_user: Callable[[str], Any], through: Callable[[Front], S3Store], file: Path
) -> None:
    """Existing parts are not sent again, nothing is denied, and no upload is left behind."""
    given = server.environment('thor')
    with Watching(server.endpoint_url, BEFORE) as front:
        keys = (given['AWS_ACCESS_KEY_ID'], given['AWS_SECRET_ACCESS_KEY'])
        command = [sys.executable, '-c', PROGRAM, str(Path(__file__).parents[1]), str(file), front.url, *keys]
        with subprocess.Popen(command, env={**os.environ, **given}) as process:
            end = time.monotonic() + 60
            while len(front.sent) < BEFORE:
                assert time.monotonic() < end, 'nothing is sent'
                assert process.poll() is None
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
        assert front.sent == PARTS[:BEFORE]
    tower = as_user('tower')
    assert under_way(tower, KEY) == [KEY]
    with Watching(server.endpoint_url, sys.maxsize) as front:
        store = through(front)
        assert store.put(slice_of(file)) is Put.CREATED
        assert front.sent == PARTS[BEFORE:]
        assert not [asked for asked in front.asked if asked.endswith('403')]
        assert store.put(slice_of(file)) is Put.IDENTICAL
    found = tower.get_object(Bucket='sensor-data', Key=KEY)
    assert hashlib.sha256(found['Body'].read()).digest() == hashlib.sha256(CONTENT).digest()
    assert found['Metadata']['sha256'] == hashlib.sha256(CONTENT).hexdigest()
    assert under_way(tower, KEY) == []


@pytest.mark.usefixtures('small_parts')
def test_an_upload_of_other_content_is_aborted(
    as_user: Callable[[str], Any], server: Tower, through: Callable[[Front], S3Store], file: Path
) -> None:
    """The policy against deleting does not prevent a robot from aborting its own uploads."""
    key = f'{KEY}.other'
    thor = as_user('thor')
    upload = thor.create_multipart_upload(Bucket='sensor-data', Key=key)['UploadId']
    thor.upload_part(Bucket='sensor-data', Key=key, UploadId=upload, PartNumber=1, Body=bytes(PART))
    with Watching(server.endpoint_url, sys.maxsize) as front:
        assert through(front).put(slice_of(file, key)) is Put.CREATED
        assert 'DELETE 204' in front.asked
    assert under_way(as_user('tower'), key) == []


@pytest.mark.usefixtures('small_parts')
def test_uploads_of_others_are_ignored(as_user: Callable[[str], Any]) -> None:
    """It can neither add to them nor see their parts nor abort them."""
    tachi, thor, key = as_user('tachi'), as_user('thor'), 'tachi/rosbags/a.mcap'
    upload = tachi.create_multipart_upload(Bucket='sensor-data', Key=key)['UploadId']
    what = {'Bucket': 'sensor-data', 'Key': key, 'UploadId': upload}
    tachi.upload_part(**what, PartNumber=1, Body=b'one')
    for ask, more in (
        (thor.upload_part, {'PartNumber': 1, 'Body': b'two'}), (thor.list_parts, {}), (thor.abort_multipart_upload, {}),
        (thor.complete_multipart_upload, {'MultipartUpload': {'Parts': [{'PartNumber': 1, 'ETag': 'x'}]}}),
    ):  # fmt: skip
        with pytest.raises(ClientError) as caught:
            ask(**what, **more)
        assert caught.value.response['ResponseMetadata']['HTTPStatusCode'] == 403
    assert under_way(as_user('tower'), key) == [key]
    tachi.abort_multipart_upload(**what)
