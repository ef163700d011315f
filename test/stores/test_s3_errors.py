"""Which failures of an S3 client are transient, which terminal, and what each is called: row by row."""

from __future__ import annotations

import pytest
from botocore import exceptions as boto
from botocore.parsers import ResponseParserError
from urllib3 import exceptions as urllib3

from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
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
    # Without an S3 error in it an answer says nothing of an object.
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
    """The code decides, else the status; the endpoint or the bucket is named, and a program can read the code."""
    error = classify(_answer(status, code), ASKED)
    assert type(error) is kind
    assert URL in str(error)
    assert error.data['status'] == status
    assert (error.data['bucket'], error.data['key']) == ('sensor-data', 'thor/a.jpg')
    assert '{' not in str(error)


@pytest.mark.parametrize(('failure', 'kind', 'words'), FAILURES)
def test_each_failure_without_an_answer_has_its_class_and_words(failure: Exception, kind: type[StoreError], words: str) -> None:
    """What did not reach the server is told apart."""
    error = classify(failure, ASKED)
    assert type(error) is kind
    assert words in str(error)


def test_a_refused_head_has_no_body_and_is_access_denied() -> None:
    """The only 403 without an S3 error that may come from an S3 server."""
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
    """Whatever stands before the last @ of the host part is gone."""
    assert public_url(url) == shown
