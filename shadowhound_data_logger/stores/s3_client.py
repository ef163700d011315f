"""The client of one S3 server: botocore without retries, with keys that are renewed, a rate limit, and our own errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import botocore
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ProfileNotFound
from botocore.handlers import add_expect_header
from botocore.session import Session

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected, SettingError, StoreUnavailable
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.credentials import Keys, no_profile, session_with, trusted
from shadowhound_data_logger.stores.s3_errors import REQUEST_ERRORS, Request, classify, public_url

OLDEST_BOTOCORE: Final = (1, 36)
"""The first version with If-None-Match on PUT and the checksum settings; those of Debian for Humble and Jazzy are older."""
AGENT: Final = 'shadowhound-data-logger'


class S3Client:
    """A botocore client for one S3 server.

    Lifecycle: new; open once; ``requesting`` from any thread; close once.
    """

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self.endpoint = public_url(settings.endpoint_url or '')
        """Without credentials."""
        self.region = settings.region
        self.pace = Pace(upload.max_mbps)
        self._settings = settings
        self._upload = upload
        self._keys: Keys | None = None
        self._client: Any = None

    @property
    def generation(self) -> int:
        """Of the keys: it changes when newer keys replace refused ones, so that the same request may succeed."""
        return self._keys.generation if self._keys else 0

    def open(self) -> None:
        """Raises SettingError for an endpoint to which no request can be sent, or if botocore is too old."""
        if self._client is None:
            self._keys = Keys(self._settings)
            self._client = _client(session_with(self._keys), self._settings, self._upload)

    def close(self) -> None:
        """Abort what is being sent, and close the connections; idempotent."""
        client, self._client = self._client, None
        self.pace.abandon()
        if client is not None:
            client.close()

    @contextmanager
    def requesting(self, bucket: str, key: str) -> Iterator[Any]:
        """The botocore client, for a request about this object: its errors are raised as StoreError."""
        with self.translating(bucket, key):
            if self._client is None:
                raise StoreUnavailable('the store is not open', endpoint=self.endpoint, bucket=bucket, key=key)
            yield self._client

    @contextmanager
    def translating(self, bucket: str, key: str) -> Iterator[None]:
        """Raise StoreError for errors of a request or of its answer; reads the keys again if they were refused."""
        generation = self.generation
        try:
            yield
        except REQUEST_ERRORS as error:
            timeouts = (self._upload.connect_timeout_s, self._upload.read_timeout_s)
            problem = classify(error, Request(self.endpoint, bucket, key, *timeouts))
            if isinstance(problem, CredentialsRejected) and self._keys:
                self._keys.renew(generation)
            raise problem from error

    def confirm(self, answer: Mapping[str, Any], bucket: str, key: str) -> None:
        """Raises StoreUnavailable for an answer without ETag: a captive portal, for example, answers 200 to any request."""
        if not answer.get('ETag'):
            raise self.not_s3(bucket, key)

    def not_s3(self, bucket: str, key: str) -> StoreUnavailable:
        """The error for an answer that no S3 server gives."""
        return StoreUnavailable(
            f'{self.endpoint} does not answer like an S3 server',
            remedy=f'is this the port of the S3 server, and no login page in between? `curl -i {self.endpoint}`',
            endpoint=self.endpoint, bucket=bucket, key=key,
        )  # fmt: skip


def _client(session: Session, settings: StoreSettings, upload: UploadSettings) -> Any:
    """A botocore client without retries, because delivery decides when to retry.

    Bodies are not signed: a checksum in the signed headers, which the server verifies, replaces that, so that a body is read only
    once, at the permitted rate. They are sent without ``Expect: 100-continue``, because botocore loops forever if the connection
    ends within the server's ``100 Continue``.
    """
    if tuple(int(part) for part in botocore.__version__.split('.')[:2]) < OLDEST_BOTOCORE:
        raise SettingError('botocore', botocore.__version__, 'version 1.36 or later (`pip install --upgrade boto3`)')
    config = Config(
        signature_version='s3v4', s3={'addressing_style': 'path', 'payload_signing_enabled': False},
        retries={'mode': 'standard', 'total_max_attempts': 1},
        connect_timeout=upload.connect_timeout_s, read_timeout=upload.read_timeout_s, tcp_keepalive=True,
        max_pool_connections=max(10, upload.threads), user_agent=AGENT, parameter_validation=False,
        request_checksum_calculation='when_required', response_checksum_validation='when_required',
    )  # fmt: skip
    try:
        trust = trusted(session, settings.endpoint_url or '')
        client = session.create_client('s3', endpoint_url=settings.endpoint_url, region_name=settings.region, config=config,
                                       verify=trust)  # fmt: skip
    except ValueError as error:
        endpoint = public_url(settings.endpoint_url or '')
        raise SettingError('AWS_ENDPOINT_URL', endpoint, 'a URL such as http://SERVER:9000') from error
    except ProfileNotFound as error:
        raise no_profile(error) from error
    except BotoCoreError as error:
        raise SettingError('the AWS configuration', type(error).__name__, f'one that botocore can read: {error}') from error
    client.meta.events.register_last('before-parameter-build.s3', _follow_no_redirect)
    client.meta.events.unregister('before-call.s3', add_expect_header)
    return client


def _follow_no_redirect(context: dict[str, Any], **_: Any) -> None:
    """Make botocore believe that it has already followed a redirect: it asks the target of each redirect for its region.

    With a login page that redirects every request, it would recurse up to Python's limit.
    """
    context.setdefault('s3_redirect', {})['redirected'] = True
