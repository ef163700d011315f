"""Listings and totals of the spool for the command line, the live page and the doctor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.spool.history_table import CATALOG
from shadowhound_data_logger.spool.object_table import IN_SPOOL
from shadowhound_data_logger.spool.schema import Table, after

DAY_NS: Final = 24 * 3600 * SECOND
MAX_NS: Final = (1 << 63) - 1
_DESCRIBED: Final = (meta.MISSION_ID, meta.MISSION_TYPE, meta.POSE, meta.BATTERY, meta.CONTENT_KEY)
_RECEIVED: Final = tuple(
    f"CAST(json_extract(metadata, '$.{word}') AS INTEGER)" for word in (meta.RECEIVED_START_NS, meta.RECEIVED_END_NS)
)
_ARRIVED: Final = """ifnull(CASE WHEN json_valid(metadata)
  THEN CAST(json_extract(metadata, '$.received_start_ns') AS INTEGER) END, t_start_ns)"""
"""The expression of the index ``arrived`` in schema.sql."""
_START: Final = {BY_STAMP: 't_start_ns', BY_RECEIVED: _ARRIVED}
_SENSORS: Final = f"""
WITH RECURSIVE found(name) AS (SELECT min(sensor) FROM objects UNION ALL
  SELECT (SELECT min(sensor) FROM objects WHERE sensor > found.name) FROM found WHERE found.name IS NOT NULL)
SELECT name FROM found WHERE name IS NOT NULL AND name <> '{CATALOG}'"""  # noqa: S608 - own constants only
"""Seeks one row per sensor instead of reading all rows."""


class OverviewTable(Table):
    """Read-only queries over all objects."""

    def tally(self) -> list[tuple[str, str, int, int, int]]:
        """(topic or '', state or 'spooled', objects, bytes, samples)."""
        return self._db.execute('SELECT topic, state, objects, bytes, samples FROM tally').fetchall()

    def by_sensor(self) -> list[tuple[Any, ...]]:
        """(sensor, state, reason, objects, bytes, oldest created_ns) of the objects in the spool, by priority."""
        return self._db.execute(
            f'SELECT sensor, state, reason, count(*), sum(bytes), min(created_ns) FROM objects WHERE {IN_SPOOL}'  # noqa: S608
            ' GROUP BY sensor, state, reason ORDER BY min(priority), sensor, state, reason'
        ).fetchall()

    def quarantine_reasons(self) -> dict[str, int]:
        """Reason -> quarantined objects."""
        query = "SELECT reason, count(*) FROM objects WHERE state = 'quarantined' GROUP BY reason"
        return {str(reason): count for reason, count in self._db.execute(query)}

    def objects(self, state: State | None, sensor: str | None, prefix: str) -> Iterator[tuple[Any, ...]]:
        """(bucket, key, sensor, state, reason, bytes, created_ns) of the objects in the spool, in the order of spooling.

        ``bucket/key`` starts with ``prefix``.
        """
        return self._db.execute(
            f'SELECT bucket, key, sensor, state, reason, bytes, created_ns FROM objects WHERE {IN_SPOOL}'  # noqa: S608
            ' AND state = ifnull(?, state) AND sensor = ifnull(?, sensor)'
            " AND substr(bucket || '/' || key, 1, length(?)) = ? ORDER BY id",
            (state and state.value, sensor, prefix, prefix),
        )

    def sensors(self) -> list[str]:
        """Sensors of objects, except the catalog."""
        return [name for (name,) in self._db.execute(_SENSORS)]

    def recorded(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP, sensors: Sequence[str] | None = None,
                 state: State | None = None) -> Iterator[tuple[Any, ...]]:  # fmt: skip
        """Objects of a robot that are not lost and begin in this time, with what the catalog has of them, by time.

        (bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns, received_start_ns, received_end_ns,
        mission_id, mission_type, pose, battery, content_key).
        """
        start = _START[by]
        described = ', '.join(f"json_extract(metadata, '$.{word}')" for word in _DESCRIBED)
        sensors = self.sensors() if sensors is None else sensors
        state_is = "state <> 'evicted'" if state is None else f"state = '{state.value}'"
        return self._db.execute(
            'SELECT bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns,'  # noqa: S608
            f' {", ".join(_RECEIVED)}, {described} FROM objects'
            f' WHERE sensor IN ({", ".join("?" * len(sensors))}) AND {start} >= ? AND {start} < ? AND key >= ? AND key < ?'
            f' AND {state_is} AND json_valid(metadata) ORDER BY {start}',
            (*sensors, begin_ns, end_ns, f'{robot}/', after(f'{robot}/')),
        )

    def edge(self, robot: str, sensor: str, begin_ns: int, end_ns: int, by: str, *, is_last: bool) -> tuple[Any, ...] | None:
        """The first or the last object of a sensor that begins in this time and is not lost, found without reading others.

        (start by that clock, t_start_ns, t_end_ns, received_end_ns, topic, state, settled_ns, mission, mission_type, battery)
        """
        start = _START[by]
        row: tuple[Any, ...] | None = self._db.execute(
            f'SELECT {start}, t_start_ns, t_end_ns, {_RECEIVED[1]}, topic, state, settled_ns, mission,'  # noqa: S608
            f" json_extract(metadata, '$.{meta.MISSION_TYPE}'), json_extract(metadata, '$.{meta.BATTERY}') FROM objects"
            f' WHERE sensor = ? AND {start} >= ? AND {start} < ? AND key >= ? AND key < ?'
            f" AND state <> 'evicted' AND json_valid(metadata) ORDER BY {start} {'DESC' if is_last else ''} LIMIT 1",
            (sensor, begin_ns, end_ns, f'{robot}/', after(f'{robot}/')),
        ).fetchone()
        return row

    def recorded_days(self, robot: str) -> list[int]:
        """Days since 1970 on which objects begin."""
        found = set()
        for sensor in self.sensors():
            at_ns = EARLIEST_SANE_NS
            while (row := self.edge(robot, sensor, at_ns, MAX_NS, BY_STAMP, is_last=False)) is not None:
                found.add(row[1] // DAY_NS)
                at_ns = (row[1] // DAY_NS + 1) * DAY_NS
        return sorted(found)
