"""Delivery for a while by a process that is no node: store, writer and uploader, opened and closed together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.ship.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store


@contextmanager
def delivering(spool: Spool, settings: Settings, close_s: float) -> Iterator[tuple[Uploader, SpoolWriter]]:
    """What waits in an open spool goes to the store of the settings, unless another process has the drain lock.

    On leaving, puts under way and their outcomes have ``close_s`` seconds each. Raises SettingError.
    """
    with ExitStack() as opened:
        store = open_store(settings.store, settings.upload)
        opened.callback(store.close)
        writer = SpoolWriter(spool, settings.spool.commit_s, settled=lambda ids: uploader.settled(ids))  # noqa: PLW0108 - made below
        uploader = Uploader(spool, store, settings.upload, writer.settle)
        writer.open()
        opened.callback(writer.close, close_s)
        uploader.open()
        opened.callback(uploader.close, close_s)
        yield uploader, writer
