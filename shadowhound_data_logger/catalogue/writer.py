"""The robot's side of the catalogue: what was delivered since the last time becomes parts, spooled like everything else.

Every delivered object is in exactly one part, whoever delivered it and whenever a process died: the list of what is in none
yet is the spool index's, and a part takes its rows off it in the transaction that makes the part durable.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.catalogue import parts
from shadowhound_data_logger.catalogue.schema import BUCKET, OBJECTS, SENSOR, Row, row_of
from shadowhound_data_logger.clock import Clock, utc
from shadowhound_data_logger.config import CatalogueSettings
from shadowhound_data_logger.errors import NameRefused
from shadowhound_data_logger.keys import check_name
from shadowhound_data_logger.model import DataObject
from shadowhound_data_logger.spool import uncatalogued

MOST_ROWS: Final = 5000
"""At a time: a tenth of a second of CPU. While there are more, the next ones come with the next look."""
PRIORITY: Final = 1
"""As a mission's summary: a part has what the store holds already."""


class CatalogueWriter:
    """New; ``due`` now and then, on one thread. What it returns is to be spooled, by the thread that commits."""

    def __init__(self, spool: Path, settings: CatalogueSettings, robot: str, clock: Clock,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._spool = spool
        self._settings = settings
        self._robot = robot
        self._clock = clock
        self._monotonic = monotonic
        self._due_s = monotonic()
        self._handed: dict[int, frozenset[int]] = {}
        """Id -> the ids of all the rows of its part, which is on its way."""

    def due(self) -> list[DataObject]:
        """The parts of a period that is over, at first of what an earlier process left.

        Raises SpoolError or sqlite3.Error; the next look tries again.
        """
        now_s = self._monotonic()
        if now_s < self._due_s:
            return []
        made = self.parts()
        if sum(len(part.catalogues) for part in made) < MOST_ROWS:
            self._due_s = now_s + self._settings.period_s
        return made

    def parts(self) -> list[DataObject]:
        """Parts of what is delivered and in none yet, nor handed out before. Raises SpoolError or sqlite3.Error."""
        if not self._settings.enabled:
            uncatalogued.clear(self._spool)
            return []
        listed = uncatalogued.waiting(self._spool, MOST_ROWS)
        there = {item.id for item in listed}
        # A part takes all its rows at once: where one has gone without the others, another process's part has it, not ours.
        self._handed = {number: rows for number, rows in self._handed.items() if rows <= there}
        new = [item for item in listed if item.id not in self._handed]
        rows = [(item.id, row_of(item.bucket, item.key, item.size, item.content_type, item.metadata)) for item in new]
        made = [self._part(robot, date, found) for robot, date, found in parts.by_folder(rows)]
        self._handed.update((number, frozenset(part.catalogues)) for part in made for number in part.catalogues)
        return made

    def _part(self, robot: str | None, date: str, found: list[tuple[int, Row]]) -> DataObject:
        robot, rows = self._named(robot), [row for _, row in found]
        now_ns = self._clock.wall_ns()
        name = f'{utc(now_ns):%Y%m%dT%H%M%S}_{self._clock.boot_id[:8]}'
        times = [row['t_start_ns'] for row in rows if row['t_start'] is not None] or [now_ns]
        return DataObject(
            bucket=BUCKET, key=OBJECTS.part_key(robot, date, name), body=parts.encode(rows), content_type=parts.CONTENT_TYPE,
            sensor=SENSOR, topic=None, type='', samples=0, t_start_ns=min(times), t_end_ns=max(times), priority=PRIORITY,
            protected=True, metadata={words.ROBOT: robot, words.COUNT: str(len(rows))},
            catalogues=tuple(number for number, _ in found),
        )  # fmt: skip

    def _named(self, robot: str | None) -> str:
        """The robot of a row, or this one where that is no name."""
        try:
            return check_name(robot or '', 'the robot name')
        except NameRefused:
            return self._robot
