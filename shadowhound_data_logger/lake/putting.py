"""Parts into the store, from this side of it: never over another, verified, as everything else is put."""

from __future__ import annotations

import hashlib
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.catalogue.parts import CONTENT_TYPE
from shadowhound_data_logger.catalogue.schema import BUCKET, SENSOR
from shadowhound_data_logger.errors import ForeignObject
from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.stores.base import ObjectStore


def put_part(store: ObjectStore, key: str, robot: str, body: bytes, rows: int) -> None:
    """Returns when the store has it. Its key says which rows are in it: who was there first wrote the same. Raises StoreError."""
    with tempfile.TemporaryDirectory(prefix='shadowhound-lake-') as folder:
        path = Path(folder, 'part.parquet')
        path.write_bytes(body)
        metadata = {words.ROBOT: robot, words.SENSOR: SENSOR, words.COUNT: str(rows)}
        item = SpooledObject(
            id=0, bucket=BUCKET, key=key, path=path, size=len(body), sha256=hashlib.sha256(body).hexdigest(),
            content_type=CONTENT_TYPE, metadata=metadata, priority=5, created_ns=time.time_ns(),
        )  # fmt: skip
        with suppress(ForeignObject):  # written by another version of the library, or in another order
            store.put(item)
