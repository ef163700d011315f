"""Spools what the node writes about its own work: the ledger, the parts of the catalog, and samples of the link."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import now_ns, utc
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.keys import dated
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.node.keeping.link_track import LinkTrack
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.writer import SpoolWriter

log = logging.getLogger(__name__)


class Bookkeeping:
    """Spools bookkeeping objects. New; ``tick`` once per second; ``end`` once. Used by the main thread."""

    def __init__(self, settings: Settings, clock: ClockWatch, writer: SpoolWriter, mark: Callable[[DataObject], DataObject],
                 catalog: CatalogWriter, link: LinkTrack | None) -> None:  # fmt: skip
        """``mark`` dates an object (``UnsyncedObjects.mark``); ``link`` is None if no data can be requested."""
        self._settings = settings
        self._clock = clock
        self._writer = writer
        self._mark = mark
        self._catalog = catalog
        self._link = link
        self._day = self._today()

    def tick(self) -> None:
        """Spool what is due: parts of the catalog, samples of the link, and at the start of each UTC day the ledger."""
        self.spool_parts(self._catalog.due)
        self._sample_link()
        if self._today() != self._day:
            self._day = self._today()
            self._spool_ledger()

    def end(self) -> None:
        """Spool the last ledger and samples."""
        self._spool_ledger()
        self._sample_link(is_last=True)

    def spool_parts(self, made: Callable[[], list[DataObject]]) -> None:
        """Spool the catalog's next parts; on failure they are kept until the next call."""
        try:
            for part in made():
                self._writer.put(part, wait=False)
        except (DataLoggerError, sqlite3.Error) as error:
            log.warning('the catalog is not written yet: %s', error)

    def _today(self) -> str:
        return f'{utc(self._clock.wall_ns()):%Y%m%d}'

    def _sample_link(self, *, is_last: bool = False) -> None:
        """Record upload throughput and position."""
        found = self._link.poll(is_last=is_last) if self._link is not None else None
        if found is not None:
            self._writer.put(found, wait=False)

    def _spool_ledger(self) -> None:
        """A ledger that cannot be read now must not stop the node: the next one includes all its content."""
        try:
            self._writer.put(self._mark(self._ledger()), wait=False)
        except DataLoggerError as error:
            log.warning('the ledger was not shipped: %s', error)

    def _ledger(self) -> DataObject:
        """The ledger as an object for the store."""
        at_ns, robot = now_ns(self._clock), self._settings.robot
        content = ledger.read(self._settings.spool_path, robot)
        pattern = f'{robot}/_ledger/{{date}}/{{time}}_ledger.json'
        return DataObject(
            bucket='sensor-data', key=dated(pattern, at_ns), key_pattern=pattern,
            body=json.dumps(content, indent=1).encode(), content_type='application/json', sensor='_ledger', topic=None,
            type='', samples=0, t_start_ns=at_ns, t_end_ns=at_ns, priority=0, protected=True, metadata={meta.ROBOT: robot},
        )  # fmt: skip
