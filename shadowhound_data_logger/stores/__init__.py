"""Where objects are kept: S3, a folder, or memory; one Protocol (``base.py``), one table of errors (``s3_errors.py``).

How fast bytes may leave is kept by ``bandwidth.py``, how long a retry waits by ``retry.py``, both beside the folders;
``download.py`` makes a file of what is fetched.
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
    """The store that the settings name, opened: S3 with an endpoint, else a folder. Close it once.

    Raises SettingError for an endpoint that no request can be sent to.
    """
    store: ObjectStore = DirectoryStore(settings.directory)
    if settings.endpoint_url:
        with _without_pyopenssl():
            from shadowhound_data_logger.stores.s3 import S3Store  # noqa: PLC0415 - botocore costs 60 MB and half a second

        store = S3Store(settings, upload)
    store.open()
    return store


def open_reader(settings: StoreSettings) -> ObjectStore:
    """The same for a machine that reads much: by obstore, which the extra ``lake`` brings. Asks nobody yet.

    A process that is forked afterwards must not use it.
    """
    if not settings.endpoint_url:
        return open_store(settings, UploadSettings())
    from shadowhound_data_logger.stores.s3_obstore import ObstoreStore  # noqa: PLC0415 - a robot has no obstore

    store = ObstoreStore(settings, UploadSettings())
    store.open()
    return store


@contextmanager
def _without_pyopenssl() -> Iterator[None]:
    """Hide pyOpenSSL, which botocore loads and never uses: 12 MB in each process where the extra ``webrtc`` is installed.

    Another thread that imports it meanwhile does not find it either.
    """
    modules: dict[str, Any] = sys.modules
    if 'OpenSSL' in modules:
        yield
        return
    modules['OpenSSL'] = None  # to import it is an error meanwhile
    try:
        yield
    finally:
        del modules['OpenSSL']
