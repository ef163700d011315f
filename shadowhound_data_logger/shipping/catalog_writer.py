"""The robot's side of the catalog and the gap journal: writes new rows to row files, and spools these like any object.

Every delivered object is in exactly one file, whichever process delivered it and whenever one was killed: the spool's index lists
the objects without a row, and the transaction that makes a file durable removes its objects from that list.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import Clock, utc
from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.model import LOST, ON_ROBOT, DataObject
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET, KEPT, OBJECTS, SENSOR, Row, TableSchema, row_of
from shadowhound_data_logger.formats.rows.gaps import GAP, GAPS, WITHDRAWN, Statement, complete, date_of, name_of, statement
from shadowhound_data_logger.formats.rows.statistics import STATISTICS, statistic_rows
from shadowhound_data_logger.formats.statistics import unpack_statistics
from shadowhound_data_logger.spool import clock_record
from shadowhound_data_logger.spool.gaps import Gap, Watermark
from shadowhound_data_logger.spool.index import Index

MAX_ROWS: Final = 2000
"""At a time: 60 ms of CPU without their statistics, and 10 MB of memory. Further rows are written by the next call."""
OBJECTS_A_PART: Final = 400
"""Objects per file of statistics. While it is made, those of one object take tens of KB of memory."""
SOON_S: Final = 5.0
"""After the end of a mission: by then its last objects are usually delivered."""
KEPT_S: Final = 5.0
"""Between two files about kept objects: they can be requested once the file has arrived."""
PRIORITY: Final = 1
"""That of a mission's summary."""


class CatalogWriter:
    """Makes row files of the catalog and of the gap journal from what was delivered and lost.

    Lifecycle: ``due`` is called regularly, on one thread. The thread that commits spools the files that it returns.
    """

    def __init__(self, spool: Path, settings: CatalogSettings, robot: str, clock: Clock,
                 monotonic: Callable[[], float] = time.monotonic, *, keeps: bool = False) -> None:  # fmt: skip
        """``keeps``: objects are kept here until they are requested, so their rows are written soon."""
        self._spool = spool
        self._settings = settings
        self._robot = robot
        self._clock = clock
        self._monotonic = monotonic
        self._due_s = monotonic()
        self._handed: list[frozenset[int]] = []
        """The ids of the rows of each file that is being delivered."""
        self._gaps = _GapParts(spool, robot, clock)
        self._keeps = keeps
        self._kept_due_s = monotonic()
        self._reported: list[frozenset[tuple[int, str]]] = []
        """The same for each file about kept objects."""

    def due(self) -> list[DataObject]:
        """The row files of a period that has ended; at first of what an earlier process left.

        Raises SpoolError or sqlite3.Error; the next call tries again.
        """
        now_s = self._monotonic()
        if now_s < self._due_s:
            if not self._keeps or now_s < self._kept_due_s:
                return []
            self._kept_due_s = now_s + KEPT_S
            return self._kept_parts()
        made = self.parts()
        if sum(len(part.catalogs) for part in made) < MAX_ROWS and not self._gaps.has_more:
            self._due_s = now_s + self._settings.period_s
        return made

    def expedite(self) -> None:
        """Write rows soon, at the end of a mission. Any thread."""
        self._due_s = min(self._due_s, self._monotonic() + SOON_S)

    def parts(self) -> list[DataObject]:
        """Row files with what is in none yet and was not returned before: delivered objects, and gaps.

        Raises SpoolError or sqlite3.Error.
        """
        if not self._settings.enabled:
            with closing(Index(self._spool / 'index.db')) as index:
                index.open()
                with index.transaction():
                    index.catalog.clear()
            return []
        with closing(Index(self._spool / 'index.db', read_only=True)) as index:
            index.open()
            listed = index.catalog.uncataloged(MAX_ROWS)
        there = {item.id for item in listed}
        # A file removes all of its rows from the list at once: if one is missing there without the others, it is in another file.
        self._handed = [numbers for numbers in self._handed if numbers <= there]
        handed = frozenset[int]().union(*self._handed)
        new = [item for item in listed if item.id not in handed]
        rows = [(item.id, row_of(item.bucket, item.key, item.size, item.content_type, item.metadata)) for item in new]
        made = [self._part(robot, date, found) for robot, date, found in parts.by_folder(rows)]
        self._handed += [frozenset(part.catalogs) for part in made]
        packed = {item.id: item.statistics for item in new if item.statistics}
        statistics = self._statistics_parts([(number, row) for number, row in rows if number in packed], packed)
        # Before the rows, with which they leave the index; statistics that are written twice do no harm.
        return [*statistics, *made, *self._gaps.parts(), *self._kept_parts()]

    def _statistics_parts(self, rows: list[tuple[int, Row]], packed: Mapping[int, bytes]) -> Iterator[DataObject]:
        for begin in range(0, len(rows), OBJECTS_A_PART):
            statistics = (
                (number, one)
                for number, row in rows[begin : begin + OBJECTS_A_PART]
                for one in statistic_rows(row, unpack_statistics(packed[number]))
            )
            yield from (self._part(*each, STATISTICS) for each in parts.by_folder(statistics))

    def _kept_parts(self) -> list[DataObject]:
        """Row files with kept objects that are in none yet and were not returned. Raises SpoolError or sqlite3.Error."""
        if not self._settings.enabled:
            return []
        with closing(Index(self._spool / 'index.db', read_only=True)) as index:
            index.open()
            listed = index.catalog.unreported(MAX_ROWS)
        there = {(item.id, state) for state, _, item in listed}
        self._reported = [reports for reports in self._reported if reports <= there]
        handed = frozenset[tuple[int, str]]().union(*self._reported)
        new = [each for each in listed if (each[2].id, each[0]) not in handed]
        rows = [
            (index, {**row_of(item.bucket, item.key, item.size, item.content_type, item.metadata),
                     'where': LOST if state == LOST else ON_ROBOT, 'reason': reason if state == LOST else None})
            for index, (state, reason, item) in enumerate(new)
        ]  # fmt: skip
        made = []
        for robot, date, found in parts.by_folder(rows):
            reports = tuple((new[index][2].id, new[index][0]) for index, _ in found)
            part = self._part(robot, date, found, KEPT)
            made.append(replace(part, catalogs=(), reports=reports))
            self._reported.append(frozenset(reports))
        return made

    def _part(self, robot: str | None, date: str, found: list[tuple[int, Row]], of: TableSchema = OBJECTS) -> DataObject:
        robot, rows = self._named(robot), [row for _, row in found]
        now_ns = self._clock.wall_ns()
        name = f'{utc(now_ns):%Y%m%dT%H%M%S}_{self._clock.boot_id[:8]}'
        times = [row['t_start_ns'] for row in rows if row['t_start'] is not None] or [now_ns]
        return DataObject(
            bucket=BUCKET, key=of.part_key(robot, date, name), body=parts.encode(rows, of), content_type=parts.CONTENT_TYPE,
            sensor=SENSOR, topic=None, type='', samples=0, t_start_ns=min(times), t_end_ns=max(times), priority=PRIORITY,
            protected=True, metadata={meta.ROBOT: robot, meta.COUNT: str(len(rows))},
            catalogs=tuple(number for number, _ in found) if of is OBJECTS else (),
        )  # fmt: skip

    def _named(self, robot: str | None) -> str:
        """The robot of a row, or this one if that is not a valid name."""
        try:
            return check_name(robot or '', 'the robot name')
        except NameRefused:
            return self._robot


class _GapParts:
    """What changed in the gap journal of one robot since its last row file, whichever process wrote it.

    A spooled file names the version of the journal that it reaches: a kill loses nothing, and rows that are written twice are
    equal. A watermark is written when all rows are: in the file with the last of them, or after that file was delivered.
    """

    def __init__(self, spool: Path, robot: str, clock: Clock) -> None:
        self._spool = spool
        self._robot = robot
        self._clock = clock
        self._version: int | None = None
        self._again = 0
        self._boots: frozenset[str] = frozenset()
        self._marks: dict[tuple[str, str, int], Watermark] = {}
        self._missing: frozenset[int] = frozenset()
        self.has_more = False
        """Whether there are further rows already."""

    def parts(self) -> list[DataObject]:
        """Raises SpoolError or sqlite3.Error."""
        offsets = clock_record.read(self._spool, self._robot).offsets
        with closing(Index(self._spool / 'index.db', read_only=True)) as index:
            index.open()
            with index.snapshot():
                reported, again = index.gaps.reported(self._robot)
                if self._version is None:
                    self._version, self._again = reported, again
                newest, began_ns, others = index.gaps.extent(self._robot)
                is_dated_now = not self._boots.issuperset(offsets) and index.gaps.has_undated()
                self._boots = frozenset(offsets)
                before = self._missing
                self._missing = index.catalog.missing(BUCKET, GAPS.prefix(self._robot), sensor=SENSOR)
                is_new_index = self._version > newest
                if is_dated_now or is_new_index or again != self._again or not self._missing <= before:
                    self._version, self._again = 0, again
                    self._marks.clear()
                found = index.gaps.changed(self._version, MAX_ROWS, offsets)
                self.has_more = bool(found) and found[-1].version < newest and len(found) >= MAX_ROWS
                # A watermark must not be in the store before the gaps that precede it.
                is_waiting = index.catalog.has_waiting(BUCKET, GAPS.prefix(self._robot), sensor=SENSOR, priority=PRIORITY)
                marks = [] if self.has_more or is_waiting else index.gaps.watermarks()
        if found:
            self._version = found[-1].version
        rows = [
            self._row(gap, began_ns)
            for gap in found
            if gap.robot == self._robot or (gap.robot is None and gap.topic not in others)
        ]
        dates = {date_of(row) for row in rows}
        for mark in marks:
            name = mark.sink, mark.topic, mark.session
            if mark.robot == self._robot and self._marks.get(name) != mark:
                watermark = complete(
                    self._robot, f'{began_ns:x}', began_ns + newest, sink=mark.sink, topic=mark.topic, session=mark.session,
                    from_ns=mark.since_ns, to_ns=mark.complete_ns, received_from_ns=mark.received_since_ns,
                    received_to_ns=mark.received_complete_ns, grade=mark.grade, received=mark.received, skipped=mark.skipped,
                )  # fmt: skip
                if dates <= {
                    date_of(watermark)
                }:  # otherwise rows and watermark are in two files, and either can be delivered first
                    self._marks[name] = mark
                    rows.append(watermark)
        return self._made(rows, self._version)

    def _row(self, gap: Gap, began_ns: int) -> Statement:
        """After a damaged index, versions start from 0, but revisions keep growing, because the new index began later."""
        is_dated = gap.boot_id is None or gap.from_ns is not None
        clock = None if gap.boot_id is None else meta.SET_LATER if is_dated else meta.UNSET
        name = name_of(
            gap.began_ns, gap.sink, gap.topic, gap.kind, gap.cause, gap.grade, gap.publisher, gap.mission_id, gap.begin_ns
        )
        return statement(
            self._robot, GAP if gap.count != 0 else WITHDRAWN, name, began_ns + gap.version, sink=gap.sink, topic=gap.topic,
            publisher=gap.publisher, session=gap.session, kind=gap.kind, cause=gap.cause, count=gap.count, merged=gap.merged,
            grade=gap.grade, mission_id=gap.mission_id, clock=clock, from_ns=gap.from_ns if is_dated else gap.from_boot_ns,
            to_ns=gap.to_ns if is_dated else gap.to_boot_ns, received_from_ns=gap.received_from_ns,
            received_to_ns=gap.received_to_ns,
        )  # fmt: skip

    def _made(self, rows: list[Statement], version: int) -> list[DataObject]:
        """One file per date; the last one names the version of the journal that they reach."""
        if not rows:
            return []
        now_ns = self._clock.wall_ns()
        name = f'{utc(now_ns):%Y%m%dT%H%M%S}_{self._clock.boot_id[:8]}'
        made = []
        for date, found in groupby(sorted(rows, key=date_of), key=date_of):
            some = list(found)
            metadata = {meta.ROBOT: self._robot, meta.COUNT: str(len(some))}
            made.append(DataObject(
                bucket=BUCKET, key=GAPS.part_key(self._robot, date, name), body=parts.encode(some, GAPS),
                content_type=parts.CONTENT_TYPE, sensor=SENSOR, topic=None, type='', samples=0,
                t_start_ns=now_ns, t_end_ns=now_ns, priority=PRIORITY, protected=True, metadata=metadata,
            ))  # fmt: skip
        made[-1] = replace(made[-1], metadata={**made[-1].metadata, meta.GAP_VERSION: str(version)})
        return made
