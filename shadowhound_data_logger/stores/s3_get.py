"""The GET of whole objects, for processes that were forked: no thread and no connection is taken over from the parent.

On botocore's HTTP session, without its client: a sixth of the client's CPU. obstore, which the lake reads with otherwise, waits
for ever in the child of a process that used it (docs/decisions/0016).
"""

from __future__ import annotations

import hashlib
import os
import random
import time
from datetime import datetime, timezone
from functools import lru_cache
from typing import Any, Final
from urllib.parse import quote, urlsplit

from botocore.awsrequest import AWSPreparedRequest
from botocore.exceptions import ClientError
from botocore.httpsession import URLLib3Session
from botocore.parsers import create_parser
from botocore.utils import get_environ_proxies

from shadowhound_data_logger.errors import CredentialsRejected, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.options import StoreSettings
from shadowhound_data_logger.stores.credentials import Keys, session_with, trusted
from shadowhound_data_logger.stores.s3_errors import REQUEST_ERRORS, Request, classify, public_url
from shadowhound_data_logger.stores.s3_put import AGENT
from shadowhound_data_logger.stores.sigv4 import signed

CONNECT_S, READ_S = 10.0, 60.0
CONNECTIONS: Final = 32
TRIES: Final = 5
PAUSE_S: Final = 0.2
"""Before the second try; it doubles, and half of it is chance."""
_NOTHING_THERE: Final = 416
"""Of a range of an empty object."""
_EMPTY: Final = hashlib.sha256().hexdigest()
_open_session: Any = URLLib3Session
_prepared: Any = AWSPreparedRequest
_create_parser: Any = create_parser


def read(settings: StoreSettings, bucket: str, key: str, most: int) -> bytes:
    """The content of an object. Raises ObjectRefused when there is none, or it has more than ``most`` bytes, which are not read.

    What passes is tried again for a second or three.
    """
    getter = _of_this_process(settings, os.getpid())
    for left in reversed(range(TRIES)):
        try:
            return getter.get(bucket, key, most)
        except StoreUnavailable:
            if not left:
                raise
            time.sleep(PAUSE_S * 2 ** (TRIES - 1 - left) * random.uniform(0.5, 1.0))
    raise AssertionError('unreachable')


class _Getter:
    """Thread-safe."""

    def __init__(self, settings: StoreSettings) -> None:
        url = urlsplit(settings.endpoint_url or '')
        self._host = url.netloc.rpartition('@')[2]
        self._server = f'{url.scheme}://{self._host}'
        self._root = url.path.rstrip('/')
        self._region = settings.region
        self._endpoint = public_url(settings.endpoint_url or '')
        self._keys = Keys(settings)
        self._parser = _create_parser('rest-xml')
        self._session = _open_session(
            verify=trusted(session_with(self._keys), settings.endpoint_url or ''), proxies=get_environ_proxies(self._server),
            timeout=(CONNECT_S, READ_S), max_pool_connections=CONNECTIONS,
        )  # fmt: skip

    def get(self, bucket: str, key: str, most: int) -> bytes:
        """One request. Raises the errors of ``classify``, ObjectRefused."""
        generation = self._keys.generation
        try:
            return self._get(bucket, key, most)
        except REQUEST_ERRORS as error:
            found = classify(error, Request(self._endpoint, bucket, key, CONNECT_S, READ_S))
            if isinstance(found, CredentialsRejected) and self._keys.renew(generation):
                raise StoreUnavailable(str(found), **found.data) from None  # there are other keys: with those again
            raise found from None

    def _get(self, bucket: str, key: str, most: int) -> bytes:
        target = f'{self._root}/{bucket}/{quote(key)}'
        headers = signed('GET', target, {'host': self._host}, _EMPTY, now=datetime.now(timezone.utc),
                         credentials=self._keys.get_frozen_credentials(), region=self._region)  # fmt: skip
        sent = {**headers, 'user-agent': AGENT, 'range': f'bytes=0-{most}'}  # one more than there should be
        answer = self._session.send(_prepared('GET', f'{self._server}{target}', sent, None, stream_output=False))
        if answer.status_code == _NOTHING_THERE:
            return b''
        if answer.status_code >= 300:
            response = {'status_code': answer.status_code, 'headers': answer.headers, 'body': answer.content}
            raise ClientError(self._parser.parse(response, None), 'GetObject')
        content: bytes = answer.content
        if len(content) > most:
            raise ObjectRefused(f'{bucket}/{key} has more than {most:,} bytes', reason='size', bucket=bucket, key=key)
        return content


@lru_cache(maxsize=4)
def _of_this_process(settings: StoreSettings, _process: int) -> _Getter:
    return _Getter(settings)
