"""A key with different content on a real server is not overwritten; our object is quarantined and named."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from e2e.processes import until
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores.s3 import S3Store

BUCKET, STAMP_NS = 'sensor-data', 1_760_788_800 * SECOND


def image(key: str, body: bytes) -> DataObject:
    return DataObject(
        bucket=BUCKET, key=key, body=body, content_type='image/jpeg', sensor='camera', topic=None, type='', samples=0,
        t_start_ns=STAMP_NS, t_end_ns=STAMP_NS,
    )  # fmt: skip


def deliver(folder: Path, store: S3Store, *objects: DataObject) -> dict[str, int]:
    """From the encoder's object to the server's response; returns the final states of the objects."""
    spool = Spool(folder, SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    writer = SpoolWriter(spool, 0.01)
    uploader = Uploader(spool, store, UploadSettings(threads=2), writer.settle)
    writer.on_commit(spooled=uploader.wake, settled=uploader.settled)
    writer.open()
    uploader.open()
    try:
        for item in objects:
            writer.put(item)
        assert writer.flush(60)
        assert uploader.drain(60)
    finally:
        uploader.close(60)
        writer.close(60)
        spool.close()
    found = ledger.read(folder, 'thor')
    assert found['balanced']
    return {state: count for state, count in found['objects'].items() if count}


def test_a_foreign_object_is_never_overwritten(tmp_path: Path, seaweed: Tower, caplog: pytest.LogCaptureFixture) -> None:
    """Two spools request one key: the first gets it; the second one's object is quarantined, and the log has the reason."""
    caplog.set_level(logging.INFO)
    key = f'thor/{tmp_path.name}/120000_front.jpg'
    store = S3Store(seaweed.store_settings(), UploadSettings())
    store.open()
    try:
        assert deliver(tmp_path / 'theirs', store, image(key, b'theirs')) == {'spooled': 1, 'delivered': 1}
        others = deliver(tmp_path / 'ours', store, image(key, b'ours'), image(key, b'more'))
        assert others == {'spooled': 2, 'delivered': 1, 'quarantined': 1}
        assert store.get(BUCKET, key) == b'theirs'
        assert store.get(BUCKET, key.replace('.jpg', '_1.jpg')) == b'more'
    finally:
        store.close()
    assert (tmp_path / 'ours' / 'quarantine' / 'foreign' / BUCKET / key).read_bytes() == b'ours'
    until(lambda: 'quarantined (foreign' in caplog.text and key in caplog.text, 'the log names the key')


def test_the_same_object_twice_is_a_success(tmp_path: Path, seaweed: Tower) -> None:
    """Content that is there already, as after a lost response, is delivered and not set aside."""
    key = f'thor/{tmp_path.name}/120001_front.jpg'
    store = S3Store(seaweed.store_settings(), UploadSettings())
    store.open()
    try:
        for name in ('first', 'second'):
            assert deliver(tmp_path / name, store, image(key, b'same')) == {'spooled': 1, 'delivered': 1}
    finally:
        store.close()
