"""Stores for objects: S3 or a folder, with one Protocol (``base.py``) and one table of errors (``s3_errors.py``).

A put is confirmed only when the content has been verified, and never overwrites. All stores pass the same tests.

``bandwidth.py`` limits the upload rate, ``core/retry.py`` retries, ``download.py`` downloads objects to files.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.stores.directory import DirectoryStore

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.base import ObjectStore

__all__ = ['open_reader', 'open_store']


def open_store(settings: StoreSettings, upload: UploadSettings) -> ObjectStore:
    """Open the store of the settings: S3 if there is an endpoint, otherwise a folder. Close it once.

    Raises SettingError for an endpoint that no request can be sent to.
    """
    store: ObjectStore = DirectoryStore(settings.directory)
    if settings.endpoint_url:
        with _without_pyopenssl():
            from shadowhound_data_logger.stores.s3 import S3Store  # noqa: PLC0415 - botocore takes 60 MB and half a second

        store = S3Store(settings, upload)
    store.open()
    return store


def open_reader(settings: StoreSettings) -> ObjectStore:
    """The same for machines that read many objects: through obstore, from the extra ``lake``. Sends no request yet.

    A child process that is forked afterwards must not use it.
    """
    if not settings.endpoint_url:
        return open_store(settings, UploadSettings())
    from shadowhound_data_logger.stores.s3_obstore import ObstoreStore  # noqa: PLC0415 - a robot has no obstore

    store = ObstoreStore(settings, UploadSettings())
    store.open()
    return store


@contextmanager
def _without_pyopenssl() -> Iterator[None]:
    """Hide pyOpenSSL, which botocore loads but never uses: it takes 12 MB if the extra ``webrtc`` is installed.

    Other threads cannot import it during that time.
    """
    modules: dict[str, Any] = sys.modules
    if 'OpenSSL' in modules:
        yield
        return
    modules['OpenSSL'] = None  # an import raises ImportError
    try:
        yield
    finally:
        del modules['OpenSSL']
