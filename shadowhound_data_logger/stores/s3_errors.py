"""What an S3 client's failure means for delivery, in one table: the error class, a message and a remedy for the operator.

Codes: https://docs.aws.amazon.com/AmazonS3/latest/API/ErrorResponses.html, and MinIO's ``cmd/api-errors.go`` for ``XMinio...``,
``SlowDownWrite``, ``InvalidTokenId``. No message quotes a request, so none can contain a secret.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

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
    StoreUntrusted,
)
from shadowhound_data_logger.core.tls import causes, certificate_problem, rustls_certificate_problem

REQUEST_ERRORS: Final = (boto.BotoCoreError, boto.ClientError, ResponseParserError, urllib3.HTTPError, OSError, ValueError)
"""Everything that a request through botocore can raise. ValueError is raised for a truncated header.

urllib3's errors are raised if the body of an error response is truncated, because botocore reads it outside its translation.
"""


@dataclass(frozen=True, slots=True)
class Request:
    """A request, as error messages name it."""

    endpoint: str
    """URL without credentials."""
    bucket: str = ''
    key: str = ''
    connect_timeout_s: float = 0.0
    read_timeout_s: float = 0.0


_Row = tuple[type[StoreError], str, str]

_KEYS = 'check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or the file of the profile'
_SESSION = 'check AWS_SESSION_TOKEN; a server of your own needs none'
_CLOCK = 'set the clock of this machine and of the server: `timedatectl` on both'
_REGION = 'set AWS_DEFAULT_REGION to the region of the server'
_NAME = 'the object is in quarantine'
_WIRE = 'it will be sent again; if this continues, check memory and network'
_AGAIN = 'it will be retried'
_POLICY = "the key pair is valid; is it this robot's own? It needs s3:PutObject and s3:GetObject on {bucket}"
_SPACE = 'free some space on the server'
_BUCKET = 'create it (`aws --endpoint-url {endpoint} s3 mb s3://{bucket}`), or let these credentials create buckets'
_NOT_S3 = 'is this the port of the S3 server? `curl -i {endpoint}`'

_CODES: Final[dict[str, _Row]] = {
    'InvalidAccessKeyId': (CredentialsRejected, 'the S3 server at {endpoint} does not know the access key id', _KEYS),
    'SignatureDoesNotMatch': (CredentialsRejected, 'the S3 server at {endpoint} refuses the signature: the secret key is wrong',
                              _KEYS),
    'AuthorizationHeaderMalformed': (CredentialsRejected, 'the S3 server at {endpoint} refuses the signature: another region',
                                     _REGION),
    'InvalidRegion': (CredentialsRejected, 'the S3 server at {endpoint} refuses the region', _REGION),
    'PermanentRedirect': (StoreUnavailable, 'the S3 server at {endpoint} has {bucket} in another region', _REGION),
    'TemporaryRedirect': (StoreUnavailable, 'the S3 server at {endpoint} has {bucket} in another region', _REGION),
    'IllegalLocationConstraintException': (StoreUnavailable, 'the S3 server at {endpoint} has {bucket} in another region',
                                           _REGION),
    'ExpiredToken': (CredentialsRejected, 'the session token for {endpoint} has expired', _SESSION),
    'InvalidToken': (CredentialsRejected, 'the S3 server at {endpoint} refuses the session token', _SESSION),
    'InvalidTokenId': (CredentialsRejected, 'the S3 server at {endpoint} refuses the session token', _SESSION),
    'InvalidSecurity': (CredentialsRejected, 'the S3 server at {endpoint} refuses the credentials', _KEYS),
    'AccountProblem': (CredentialsRejected, 'the S3 server at {endpoint} has closed the account', _KEYS),
    'NotSignedUp': (CredentialsRejected, 'the S3 server at {endpoint} has no such account', _KEYS),
    'RequestTimeTooSkewed': (StoreUnavailable, 'the clocks of this machine and of {endpoint} differ too much', _CLOCK),
    'RequestExpired': (StoreUnavailable, 'the clocks of this machine and of {endpoint} differ too much', _CLOCK),
    'AccessDenied': (AccessDenied, 'the S3 server at {endpoint} denies these credentials {bucket}/{key}', _POLICY),
    'AllAccessDisabled': (AccessDenied, 'the S3 server at {endpoint} denies everyone {bucket}/{key}', _POLICY),
    'NoSuchBucket': (BucketMissing, 'there is no bucket {bucket} on the S3 server at {endpoint}', _BUCKET),
    'InvalidBucketName': (BucketMissing, 'the S3 server at {endpoint} allows no bucket of the name {bucket}',
                          'use 3 to 63 lower-case letters, digits and "-"'),
    'NoSuchKey': (ObjectRefused, 'there is no {bucket}/{key} on the S3 server at {endpoint}', ''),
    'NoSuchUpload': (StoreUnavailable, 'another client ended the upload of {bucket}/{key} to {endpoint}', _AGAIN),
    'InvalidPart': (StoreUnavailable, 'the S3 server at {endpoint} lost a part of {bucket}/{key}', _AGAIN),
    'InvalidPartOrder': (StoreUnavailable, 'the S3 server at {endpoint} lost a part of {bucket}/{key}', _AGAIN),
    'EntityTooSmall': (StoreUnavailable, 'the S3 server at {endpoint} lost a part of {bucket}/{key}', _AGAIN),
    'KeyTooLongError': (ObjectRefused, 'the key {key:.80} is too long for the S3 server at {endpoint}', _NAME),
    'InvalidObjectName': (ObjectRefused, 'the S3 server at {endpoint} allows no object of the name {key}', _NAME),
    'XMinioInvalidObjectName': (ObjectRefused, 'the S3 server at {endpoint} allows no object of the name {key}', _NAME),
    'XMinioObjectExistsAsDirectory': (ObjectRefused, 'the S3 server at {endpoint} has a folder of the name {bucket}/{key}',
                                      _NAME),
    'XMinioParentIsObject': (ObjectRefused, 'a folder of {bucket}/{key} is an object on the S3 server at {endpoint}', _NAME),
    'EntityTooLarge': (ObjectRefused, '{bucket}/{key} is too large for the S3 server at {endpoint}', ''),
    'InvalidArgument': (ObjectRefused, 'the S3 server at {endpoint} refuses a property of {bucket}/{key}', ''),
    'BadDigest': (StoreUnavailable, '{bucket}/{key} was damaged in transit to {endpoint}', _WIRE),
    'InvalidDigest': (StoreUnavailable, '{bucket}/{key} was damaged in transit to {endpoint}', _WIRE),
    'XAmzContentChecksumMismatch': (StoreUnavailable, '{bucket}/{key} was damaged in transit to {endpoint}', _WIRE),
    'XAmzContentSHA256Mismatch': (StoreUnavailable, '{bucket}/{key} was damaged in transit to {endpoint}', _WIRE),
    'IncompleteBody': (StoreUnavailable, '{bucket}/{key} reached {endpoint} incompletely', _WIRE),
    'RequestTimeout': (StoreUnavailable, 'the S3 server at {endpoint} gave up waiting for the rest of {bucket}/{key}', _AGAIN),
    'SlowDown': (StoreUnavailable, 'the S3 server at {endpoint} is overloaded ({status} {code})', _AGAIN),
    'SlowDownRead': (StoreUnavailable, 'the S3 server at {endpoint} is overloaded ({status} {code})', _AGAIN),
    'SlowDownWrite': (StoreUnavailable, 'the S3 server at {endpoint} is overloaded ({status} {code})', _AGAIN),
    'TooManyRequests': (StoreUnavailable, 'the S3 server at {endpoint} is overloaded ({status} {code})', _AGAIN),
    'ConditionalRequestConflict': (StoreUnavailable, 'another put of {bucket}/{key} is under way on {endpoint}', _AGAIN),
    'OperationAborted': (StoreUnavailable, 'another request for {bucket} is under way on {endpoint}', _AGAIN),
    'XMinioStorageFull': (StoreUnavailable, 'the disk of the S3 server at {endpoint} is full', _SPACE),
    'XMinioAdminBucketQuotaExceeded': (StoreUnavailable, 'the quota of bucket {bucket} on {endpoint} is used up', _SPACE),
    'XMinioBackendDown': (StoreUnavailable, 'the storage behind the S3 server at {endpoint} is down',
                          'check the log of the server'),
    'XMinioInsecureClientRequest': (StoreUnavailable, 'the S3 server at {endpoint} requires TLS',
                                    'use https:// in AWS_ENDPOINT_URL'),
}  # fmt: skip

_NO_KEYS: Final = (boto.NoCredentialsError, boto.PartialCredentialsError, boto.CredentialRetrievalError, boto.NoAuthTokenError,
                   boto.ProfileNotFound, boto.ConfigParseError)  # fmt: skip
_SLOW: Final = (boto.ReadTimeoutError, urllib3.ReadTimeoutError)
_BROKEN: Final = (boto.ConnectionClosedError, boto.ResponseStreamingError, boto.IncompleteReadError, urllib3.ProtocolError,
                  ConnectionResetError)  # fmt: skip

_SILENT: Final[_Row] = (StoreUnavailable, 'the S3 server at {endpoint} gave no answer for {bucket}/{key}',
                         'is the server on, and the WiFi?')  # fmt: skip
_PROXY: Final[_Row] = (StoreUnavailable, 'the proxy to {endpoint} cannot be reached', 'add the server to NO_PROXY')
_FAILURES: Final[tuple[tuple[type[BaseException] | tuple[type[BaseException], ...], _Row], ...]] = (
    (_NO_KEYS, (CredentialsRejected, 'there are no credentials for the S3 server at {endpoint}',
                'set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SHARED_CREDENTIALS_FILE to a file with them')),
    (boto.ParamValidationError, (ObjectRefused,
                                 'no S3 request can carry {bucket}/{key}: its metadata or type is not plain text', '')),
    (ResponseParserError, (StoreUnavailable, '{endpoint} does not answer like an S3 server', _NOT_S3)),
    (boto.SSLError, (StoreUnavailable, 'no TLS connection to the S3 server at {endpoint}',
                     'does the server speak TLS there? otherwise use http:// in AWS_ENDPOINT_URL')),
    (boto.ProxyConnectionError, _PROXY),
    (boto.ConnectTimeoutError, (StoreUnavailable, 'no connection to the S3 server at {endpoint} within {connect_timeout_s:g} s',
                                'is the server on, and the WiFi?')),
    (_SLOW, (StoreUnavailable, 'the S3 server at {endpoint} gave no answer within {read_timeout_s:g} s',
             'does the server hang? check its log')),
    (ConnectionRefusedError, (StoreUnavailable, 'the S3 server at {endpoint} refused the connection',
                              'is the S3 server running? `curl -i {endpoint}`')),
    (socket.gaierror, (StoreUnavailable, 'the name of the S3 server at {endpoint} cannot be resolved',
                       'use its IP address in AWS_ENDPOINT_URL')),
    (_BROKEN, (StoreUnavailable, 'the S3 server at {endpoint} closed the connection', _AGAIN)),
    # Last, because SSL errors are ValueErrors:
    (ValueError, (StoreUnavailable, '{endpoint} does not answer like an S3 server', _NOT_S3)),
)  # fmt: skip
"""Failures without an answer; the first row whose class matches the error or one of its causes counts."""


def classify(error: Exception, request: Request) -> StoreError:
    """The StoreError for one of ``REQUEST_ERRORS``; only this table decides whether an error is transient or terminal.

    Unknown errors are StoreUnavailable: a waiting object is better than one in quarantine for a fault that is not its own.
    """
    if isinstance(error, boto.ClientError):
        return _answered(error, request)
    untrusted = certificate_problem(error, 'the S3 server at {endpoint}', bundle='AWS_CA_BUNDLE', address='AWS_ENDPOINT_URL')
    kind, message, remedy = (StoreUntrusted, *untrusted) if untrusted else _unanswered(error)
    return _error(kind, message, remedy, request, code=type(error).__name__)


def public_url(url: str) -> str:
    """The URL without user name and password."""
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rpartition('@')[2]).geturl()


def code_of(error: boto.ClientError) -> str:
    """The S3 error code; the HTTP status as text if the answer has no S3 body."""
    code: str = error.response.get('Error', {}).get('Code', '')
    return code or str(status_of(error))


def status_of(error: boto.ClientError) -> int:
    """The HTTP status; 0 if there is none."""
    return error.response.get('ResponseMetadata', {}).get('HTTPStatusCode', 0)


def _answered(error: boto.ClientError, request: Request) -> StoreError:
    detail = str(error.response.get('Error', {}).get('Message', ''))
    return refused(code_of(error), status_of(error), detail, request, is_head=error.operation_name == 'HeadObject')


def refused(code: str, status: int, detail: str, request: Request, *, is_head: bool = False) -> StoreError:
    """The same for another client's error: S3 error code (otherwise the HTTP status as text), HTTP status, message."""
    row = _CODES.get(code)
    if row is None and (status >= 500 or status in {408, 409, 425, 429, 499}):
        row = (StoreUnavailable, 'the S3 server at {endpoint} answers with a server error ({status} {code})', 'check its log')
    elif row is None and not code.isdigit() and status in {401, 403}:
        row = (AccessDenied, 'the S3 server at {endpoint} denies these credentials {bucket}/{key} ({code})', _POLICY)
    elif row is None and not code.isdigit() and status >= 400:
        row = (ObjectRefused, 'the S3 server at {endpoint} refuses {bucket}/{key} ({status} {code}: {detail})', '')
    elif row is None and status == 403 and is_head:
        row = _CODES['AccessDenied']
    elif row is None:  # a captive portal, a proxy or a web server on this port: not the object's fault
        row = (StoreUnavailable, '{endpoint} does not answer like an S3 server ({status} without an S3 error)', _NOT_S3)
    detail = detail[:200]
    return _error(*row, request, code=detail if code.isdigit() else code, status=status, detail=detail)


def unreachable(reason: str, request: Request, *, is_proxied: bool = False) -> StoreError:
    """The error for a request without an answer, by a client whose errors are only text."""
    untrusted = rustls_certificate_problem(
        reason, 'the S3 server at {endpoint}', bundle='AWS_CA_BUNDLE', address='AWS_ENDPOINT_URL'
    )
    row = (StoreUntrusted, *untrusted) if untrusted else _PROXY if is_proxied else _SILENT
    return _error(*row, request, code='no answer')


def _unanswered(error: Exception) -> _Row:
    if isinstance(error, boto.ParamValidationError) and 'nvalid bucket name' in str(error):
        return _CODES['InvalidBucketName']
    found = tuple(causes(error))
    for kinds, row in _FAILURES:
        if any(isinstance(cause, kinds) for cause in found):
            return row
    reason = next((cause.strerror for cause in reversed(found) if isinstance(cause, OSError) and cause.strerror), '')
    reason = reason or type(error).__name__
    return StoreUnavailable, f'the S3 server at {{endpoint}} cannot be reached: {reason}', 'is the WiFi connected?'


def _error(kind: type[StoreError], message: str, remedy: str, request: Request, **data: Any) -> StoreError:
    nouns = {
        'endpoint': request.endpoint, 'bucket': request.bucket, 'key': request.key,
        'connect_timeout_s': request.connect_timeout_s, 'read_timeout_s': request.read_timeout_s, **data,
    }  # fmt: skip
    reason = 'missing' if data['code'] == 'NoSuchKey' else data['code']
    facts = {'endpoint': request.endpoint, 'bucket': request.bucket, 'key': request.key, 'reason': reason, **data}
    return kind(message.format(**nouns), remedy=remedy.format(**nouns), **facts)
