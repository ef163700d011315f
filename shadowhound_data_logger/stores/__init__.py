"""Where objects are kept: S3, a folder, or memory; one Protocol (``base.py``), one conformance suite."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shadowhound_data_logger.stores.directory import DirectoryStore

if TYPE_CHECKING:
    from shadowhound_data_logger.config import StoreSettings, UploadSettings
    from shadowhound_data_logger.stores.base import ObjectStore

__all__ = ['open_store']


def open_store(settings: StoreSettings, upload: UploadSettings) -> ObjectStore:
    """The store that the settings name, opened: S3 with an endpoint, else a folder (D13). Close it once.

    Raises SettingError for an endpoint that no request can be sent to.
    """
    store: ObjectStore = DirectoryStore(settings.directory)
    if settings.endpoint_url:
        from shadowhound_data_logger.stores.s3 import S3Store  # noqa: PLC0415 - botocore costs 60 MB and half a second

        store = S3Store(settings, upload)
    store.open()
    return store
