"""Spooled objects of some content, for tests."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject

MOTO = pytest.param('moto', marks=pytest.mark.long('a second S3 server, a slow one'))
"""The request for moto in addition to SeaweedFS."""
QUICK = UploadSettings(threads=8, connect_timeout_s=2.0, read_timeout_s=20.0)


BUSY_S = 30.0
"""Enough time for SeaweedFS to allocate a new bucket on a busy machine; it responds with 500 until then."""


def with_room(ask: Callable[[], Any]) -> Any:
    """Send the first request to a new bucket of SeaweedFS: again while the server responds with 500."""
    end = time.monotonic() + BUSY_S
    while True:
        try:
            return ask()
        except StoreUnavailable as error:
            if '500 InternalError' not in str(error) or time.monotonic() > end:
                raise
        time.sleep(0.1)


class Spool:
    """Makes spooled objects with files in one folder."""

    def __init__(self, folder: Path, bucket: str) -> None:
        self._folder = folder
        self._bucket = bucket
        self._numbers = count()

    def __call__(
        self, key: str, content: bytes, *, bucket: str = '', content_type: str = 'image/jpeg',
        metadata: Mapping[str, str] | None = None,
    ) -> SpooledObject:  # fmt: skip
        """A file with this content, and its index entry."""
        number = next(self._numbers)
        path = self._folder / f'spooled-{number}'
        path.write_bytes(content)
        sha256 = hashlib.sha256(content).hexdigest()
        return SpooledObject(
            id=number, bucket=bucket or self._bucket, key=key, path=path, size=len(content), sha256=sha256,
            content_type=content_type, metadata={'sha256': sha256, **(metadata or {})}, priority=5, created_ns=0,
        )  # fmt: skip
