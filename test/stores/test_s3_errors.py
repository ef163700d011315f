"""Each failure of an S3 client has its class and message; faults in front of a real server lose nothing."""

from __future__ import annotations

import random
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from botocore import exceptions as boto
from botocore.parsers import ResponseParserError
from faults.front import STATUS_LINE, Front
from faults.kinds import FAULTS, STORING, Condition, Fault, Script
from shadowhound_tower.embedded import Tower
from shipping.fakes import until
from stores.spooled import Spool
from urllib3 import exceptions as urllib3

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_errors import Request, classify, public_url

URL = 'http://192.168.1.5:9000'
ASKED = Request(URL, 'sensor-data', 'thor/a.jpg', 5.0, 30.0)

ANSWERS: tuple[tuple[int, str, type[StoreError]], ...] = (
    (400, 'AuthorizationHeaderMalformed', CredentialsRejected),
    (400, 'BadDigest', StoreUnavailable),
    (400, 'EntityTooLarge', ObjectRefused),
    (400, 'ExpiredToken', CredentialsRejected),
    (400, 'IncompleteBody', StoreUnavailable),
    (400, 'InvalidArgument', ObjectRefused),
    (400, 'InvalidBucketName', BucketMissing),
    (400, 'InvalidDigest', StoreUnavailable),
    (400, 'InvalidObjectName', ObjectRefused),
    (400, 'InvalidRequest', ObjectRefused),
    (400, 'InvalidToken', CredentialsRejected),
    (400, 'KeyTooLongError', ObjectRefused),
    (400, 'RequestTimeout', StoreUnavailable),
    (400, 'XAmzContentChecksumMismatch', StoreUnavailable),
    (400, 'XAmzContentSHA256Mismatch', StoreUnavailable),
    (400, 'XMinioAdminBucketQuotaExceeded', StoreUnavailable),
    (400, 'XMinioBackendDown', StoreUnavailable),
    (400, 'XMinioInvalidObjectName', ObjectRefused),
    (400, 'XMinioObjectExistsAsDirectory', ObjectRefused),
    (301, 'PermanentRedirect', StoreUnavailable),
    (403, 'AccessDenied', AccessDenied),
    (403, 'InvalidAccessKeyId', CredentialsRejected),
    (403, 'InvalidTokenId', CredentialsRejected),
    (403, 'RequestTimeTooSkewed', StoreUnavailable),
    (403, 'SignatureDoesNotMatch', CredentialsRejected),
    (403, 'SomethingNew', AccessDenied),
    (404, 'NoSuchBucket', BucketMissing),
    (404, 'NoSuchKey', ObjectRefused),
    (409, 'ConditionalRequestConflict', StoreUnavailable),
    (409, 'OperationAborted', StoreUnavailable),
    (411, 'MissingContentLength', ObjectRefused),
    (429, 'TooManyRequests', StoreUnavailable),
    (499, 'ClientDisconnected', StoreUnavailable),
    (500, 'InternalError', StoreUnavailable),
    (501, 'NotImplemented', StoreUnavailable),
    (503, 'SlowDown', StoreUnavailable),
    (503, 'SlowDownWrite', StoreUnavailable),
    (503, 'XMinioServerNotInitialized', StoreUnavailable),
    (507, 'XMinioStorageFull', StoreUnavailable),
    # Without an S3 error a response is no evidence about an object.
    (302, '302', StoreUnavailable),
    (400, '400', StoreUnavailable),
    (403, '403', StoreUnavailable),
    (404, '404', StoreUnavailable),
    (405, '405', StoreUnavailable),
    (429, '429', StoreUnavailable),
    (502, '502', StoreUnavailable),
    (504, '504', StoreUnavailable),
)

FAILURES: tuple[tuple[Exception, type[StoreError], str], ...] = (
    (boto.EndpointConnectionError(endpoint_url=URL, error=ConnectionRefusedError(111, 'no')), StoreUnavailable, 'refused'),
    (boto.EndpointConnectionError(endpoint_url=URL, error=OSError(113, 'No route to host')), StoreUnavailable, 'No route'),
    (boto.ConnectTimeoutError(endpoint_url=URL), StoreUnavailable, 'no connection to the S3 server at http://192.168.1.5:9000'),
    (boto.ReadTimeoutError(endpoint_url=URL), StoreUnavailable, 'no answer within 30 s'),
    (boto.ConnectionClosedError(endpoint_url=URL), StoreUnavailable, 'closed the connection'),
    (boto.IncompleteReadError(actual_bytes=1, expected_bytes=2), StoreUnavailable, 'closed the connection'),
    (boto.ResponseStreamingError(error='x'), StoreUnavailable, 'closed the connection'),
    (urllib3.ReadTimeoutError(None, None, 'x'), StoreUnavailable, 'no answer within 30 s'),  # type: ignore[arg-type]
    (urllib3.ProtocolError('x'), StoreUnavailable, 'closed the connection'),
    (boto.SSLError(endpoint_url=URL, error='x'), StoreUnavailable, 'no TLS connection'),
    (boto.ProxyConnectionError(proxy_url='http://p'), StoreUnavailable, 'NO_PROXY'),
    (boto.HTTPClientError(error='x'), StoreUnavailable, 'HTTPClientError'),
    (boto.NoCredentialsError(), CredentialsRejected, 'there are no credentials'),
    (boto.PartialCredentialsError(provider='env', cred_var='x'), CredentialsRejected, 'there are no credentials'),
    (boto.ParamValidationError(report='Non ascii characters found in S3 metadata'), ObjectRefused, 'not plain text'),
    (boto.ParamValidationError(report='Invalid bucket name "A"'), BucketMissing, 'lower-case'),
    (ResponseParserError('x'), StoreUnavailable, 'like an S3 server'),
    (ValueError("invalid literal for int() with base 10: ''"), StoreUnavailable, 'like an S3 server'),
    (OSError(5, 'Input/output error'), StoreUnavailable, 'Input/output error'),
)


def _answer(status: int, code: str, operation: str = 'PutObject') -> boto.ClientError:
    answer = {'Error': {'Code': code, 'Message': 'why'}, 'ResponseMetadata': {'HTTPStatusCode': status}}
    return boto.ClientError(answer, operation)  # type: ignore[arg-type]


@pytest.mark.parametrize(('status', 'code', 'kind'), ANSWERS)
def test_each_answer_has_its_class(status: int, code: str, kind: type[StoreError]) -> None:
    """The code decides, otherwise the status; the endpoint or the bucket is named, and programs can read the code."""
    error = classify(_answer(status, code), ASKED)
    assert type(error) is kind
    assert URL in str(error)
    assert error.data['status'] == status
    assert (error.data['bucket'], error.data['key']) == ('sensor-data', 'thor/a.jpg')
    assert '{' not in str(error)


@pytest.mark.parametrize(('failure', 'kind', 'words'), FAILURES)
def test_each_failure_without_an_answer_has_its_class_and_words(failure: Exception, kind: type[StoreError], words: str) -> None:
    """Failures before the server was reached are distinguished."""
    error = classify(failure, ASKED)
    assert type(error) is kind
    assert words in str(error)


def test_a_refused_head_has_no_body_and_is_access_denied() -> None:
    """It is the only 403 without an S3 error that may come from an S3 server."""
    assert type(classify(_answer(403, '403', 'HeadObject'), ASKED)) is AccessDenied


@pytest.mark.parametrize(
    ('url', 'shown'),
    [
        ('http://tower:9000', 'http://tower:9000'),
        ('http://me:secret@tower:9000/x', 'http://tower:9000/x'),
        ('http://p@ss:w@rd@[::1]:9000', 'http://[::1]:9000'),
    ],
)
def test_a_url_is_shown_without_its_password(url: str, shown: str) -> None:
    """Everything before the last @ of the host part is removed."""
    assert public_url(url) == shown


IMPATIENT = UploadSettings(connect_timeout_s=1.0, read_timeout_s=0.3)
KINDS: dict[Fault, type[StoreError]] = {Fault.DENIED: AccessDenied}
SAID = {
    Fault.REFUSED: 'closed the connection', Fault.RESET: 'closed the connection', Fault.HUNG: 'gave no answer within 0.3 s',
    Fault.SLOW: 'gave no answer within 0.3 s', Fault.ERROR_500: '500 InternalError', Fault.SLOW_DOWN: '503 SlowDown',
    Fault.DENIED: 'denies these credentials', Fault.SKEWED: 'differ too much', Fault.PORTAL: 'does not answer like an S3 server',
    Fault.CUT: 'does not answer like an S3 server', Fault.ACK_LOST: 'closed the connection',
}  # fmt: skip
BUCKET = 'faults'
CONTENT = b'content' * 100


@pytest.fixture
def front(seaweed: Tower) -> Iterator[Front]:
    with Front(seaweed.endpoint_url, secret=seaweed.store_settings().secret_access_key or '') as standing:
        yield standing


@pytest.fixture(scope='module')
def direct(seaweed: Tower) -> Iterator[S3Store]:
    """The server without the proxy."""
    store = S3Store(seaweed.store_settings(), UploadSettings())
    store.open()
    yield store
    store.close()


@pytest.fixture
def opened(request: pytest.FixtureRequest, seaweed: Tower, front: Front) -> Iterator[S3Store]:
    """The server behind the proxy; with a short timeout only for faults without a response."""
    fault = getattr(request.node, 'callspec', None) and request.node.callspec.params.get('fault')
    patience = IMPATIENT if fault in {Fault.HUNG, Fault.SLOW} else UploadSettings()
    store = S3Store(replace(seaweed.store_settings(), endpoint_url=front.url), patience)
    store.open()
    yield store
    store.close()


@pytest.fixture
def patient(seaweed: Tower, front: Front) -> Iterator[S3Store]:
    """The server behind the proxy, with long timeouts, for use after the fault."""
    store = S3Store(replace(seaweed.store_settings(), endpoint_url=front.url), UploadSettings())
    store.open()
    yield store
    store.close()


@pytest.fixture
def key() -> str:
    """A key that no other test has used: all share a bucket, which the server takes some time to create."""
    return uuid.uuid4().hex


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path, BUCKET)


@pytest.fixture
def proved(opened: S3Store, spool: Spool) -> S3Store:
    """The store has tested its server: each put is one request from here on."""
    again(opened, spool(uuid.uuid4().hex, b'proof'))
    return opened


def again(store: S3Store, item: SpooledObject) -> Put:
    """Put until it succeeds."""
    ends: list[Put] = []

    def works() -> bool:
        try:
            ends.append(store.put(item))
        except StoreUnavailable:
            return False
        return True

    until(works)
    return ends[0]


@pytest.mark.seaweedfs
@pytest.mark.parametrize('fault', [fault for fault in FAULTS if fault is not Fault.NO_CONDITION])
def test_each_fault_is_distinguished_and_the_next_put_succeeds_once(
    fault: Fault, proved: S3Store, patient: S3Store, direct: S3Store, front: Front, spool: Spool, key: str
) -> None:
    """Each has its error, the object exists or not as the fault implies, and after the next put it exists, once."""
    item = spool(key, CONTENT)
    again(patient, spool(uuid.uuid4().hex, b'proof'))
    front.cut = lambda _: STATUS_LINE
    front.script = Script([fault])
    with pytest.raises(KINDS.get(fault, StoreUnavailable), match=SAID[fault]):
        proved.put(item)
    until(lambda: front.is_quiet)
    there = direct.head(BUCKET, key) is not None
    assert there is (fault in STORING)
    assert again(patient, item) is (Put.IDENTICAL if there else Put.CREATED)
    assert direct.get(BUCKET, key) == CONTENT
    assert front.stored[f'/{BUCKET}/{key}'] == [item.sha256]


@pytest.mark.seaweedfs
def test_a_refused_connection_is_retried(proved: S3Store, front: Front, spool: Spool, key: str) -> None:
    """For a while no connection is possible, and then one is."""
    front.refuse()

    def refused() -> bool:
        try:
            proved.put(spool(uuid.uuid4().hex, CONTENT))
        except StoreUnavailable as error:
            return 'refused the connection' in str(error)
        return False

    until(refused)
    assert again(proved, spool(key, CONTENT)) is Put.CREATED


@pytest.mark.seaweedfs
@pytest.mark.parametrize('condition', [Condition.NOT_IMPLEMENTED, Condition.OVERWRITES])
def test_a_server_without_if_none_match_overwrites_nothing(
    condition: Condition, opened: S3Store, direct: S3Store, front: Front, spool: Spool, key: str
) -> None:
    """Even the first put overwrites nothing, whether or not the server reports its lack of support."""
    front.condition = condition
    direct.put(spool(key, b'theirs'))
    for content in (b'other', b'others'):
        with pytest.raises(ForeignObject):
            opened.put(spool(key, content))
    assert opened.put(spool(f'{key}-other', b'ours')) is Put.CREATED
    assert opened.put(spool(f'{key}-other', b'ours')) is Put.IDENTICAL
    assert direct.get(BUCKET, key) == b'theirs'
    assert direct.get(BUCKET, f'{key}-other') == b'ours'


@pytest.mark.seaweedfs
def test_a_server_that_stops_supporting_if_none_match_overwrites_nothing(
    proved: S3Store, direct: S3Store, front: Front, spool: Spool, key: str
) -> None:
    """If one that supported it so far responds with 501 once, existing keys are checked before any put without it."""
    direct.put(spool(key, b'theirs'))
    front.script = Script([Fault.NO_CONDITION])
    with pytest.raises(ForeignObject):
        proved.put(spool(key, b'ours'))
    assert direct.get(BUCKET, key) == b'theirs'


@pytest.mark.seaweedfs
@pytest.mark.parametrize(('there', 'content'), [(False, CONTENT), (True, CONTENT), (True, b'')])
@pytest.mark.parametrize('fault', [Fault.ERROR_500, Fault.SLOW_DOWN, Fault.DENIED, Fault.SKEWED])
def test_a_transient_head_failure_quarantines_nothing(
    there: bool, content: bytes, fault: Fault, opened: S3Store, direct: S3Store, front: Front, spool: Spool
) -> None:
    """The check for the reason may succeed by then, with or without the object."""
    item = spool(uuid.uuid4().hex, content)
    direct.put(item if there else spool(uuid.uuid4().hex, content))
    front.script = Script([fault])
    assert again(opened, item) is (Put.IDENTICAL if there else Put.CREATED)


@pytest.mark.seaweedfs
@pytest.mark.long('a second of CPU or more')
@pytest.mark.filterwarnings('ignore:tzname')  # in the middle of a date
def test_a_truncated_answer_quarantines_nothing(proved: S3Store, front: Front, spool: Spool, key: str) -> None:
    """Wherever the response about a taken key is truncated, the object is recognized, or the put is retried."""
    item = spool(key, CONTENT)
    proved.put(item)
    lengths = [0]

    def cut(answer: bytes) -> int:
        lengths[0] = len(answer)
        return place

    front.cut = cut
    place = STATUS_LINE
    ends: set[Put | None] = set()
    while place <= lengths[0] or not lengths[0]:
        front.script = Script([Fault.NONE, Fault.CUT])  # 412, and the check of the existing object
        try:
            ends.add(proved.put(item))
        except StoreUnavailable:
            ends.add(None)
        place += random.Random(place).randint(1, 7)
    assert ends == {Put.IDENTICAL, None}


@pytest.mark.seaweedfs
def test_a_head_that_fails_for_an_unknown_reason_proves_nothing(
    opened: S3Store, direct: S3Store, front: Front, spool: Spool, key: str
) -> None:
    """A wrong clock, and a login page in response to the check: neither means that reading is forbidden.

    Otherwise a server that overwrites would lose what another writer has stored.
    """
    again(direct, spool(key, b'of another writer'))
    front.condition = Condition.OVERWRITES
    faults = iter([Fault.SKEWED, Fault.PORTAL])
    front.script = lambda: next(faults, Fault.NONE)
    with pytest.raises(StoreUnavailable, match='another answer'):
        opened.put(spool(key, CONTENT))
    with pytest.raises(ForeignObject):
        opened.put(spool(key, CONTENT))
    assert direct.get(BUCKET, key) == b'of another writer'
