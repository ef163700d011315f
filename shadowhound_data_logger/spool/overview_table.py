"""Listings and totals of the spool for people: the command line, the live page and the doctor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.spool.history_table import CATALOG
from shadowhound_data_logger.spool.object_table import IN_SPOOL
from shadowhound_data_logger.spool.table import Table, after

_DESCRIBED: Final = (words.MISSION_ID, words.MISSION_TYPE, words.POSE, words.BATTERY, words.CONTENT_KEY)
_RECEIVED: Final = tuple(
    f"CAST(json_extract(metadata, '$.{word}') AS INTEGER)" for word in (words.RECEIVED_START_NS, words.RECEIVED_END_NS)
)


class OverviewTable(Table):
    """Only reads."""

    def tally(self) -> list[tuple[str, str, int, int, int]]:
        """(topic or '', state or 'spooled', objects, bytes, samples)."""
        return self._db.execute('SELECT topic, state, objects, bytes, samples FROM tally').fetchall()

    def by_sensor(self) -> list[tuple[Any, ...]]:
        """(sensor, state, reason, objects, bytes, oldest created_ns) of what is in the spool, the most important first."""
        return self._db.execute(
            f'SELECT sensor, state, reason, count(*), sum(bytes), min(created_ns) FROM objects WHERE {IN_SPOOL}'  # noqa: S608
            ' GROUP BY sensor, state, reason ORDER BY min(priority), sensor, state, reason'
        ).fetchall()

    def quarantine_reasons(self) -> dict[str, int]:
        """Reason -> quarantined objects."""
        query = "SELECT reason, count(*) FROM objects WHERE state = 'quarantined' GROUP BY reason"
        return {str(reason): count for reason, count in self._db.execute(query)}

    def objects(self, state: State | None, sensor: str | None, prefix: str) -> Iterator[tuple[Any, ...]]:
        """(bucket, key, sensor, state, reason, bytes, created_ns) of what is in the spool, in the order in which it was spooled.

        ``prefix`` is how ``bucket/key`` starts.
        """
        return self._db.execute(
            f'SELECT bucket, key, sensor, state, reason, bytes, created_ns FROM objects WHERE {IN_SPOOL}'  # noqa: S608
            ' AND state = ifnull(?, state) AND sensor = ifnull(?, sensor)'
            " AND substr(bucket || '/' || key, 1, length(?)) = ? ORDER BY id",
            (state and state.value, sensor, prefix, prefix),
        )

    def recorded(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> Iterator[tuple[Any, ...]]:
        """Objects of a robot that are not lost and begin in this time, with what the catalog has of them, by time.

        (bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns, received_start_ns, received_end_ns,
        mission_id, mission_type, pose, battery, content_key); objects with a short row are not included.
        """
        start = f'ifnull({_RECEIVED[0]}, t_start_ns)' if by == BY_RECEIVED else 't_start_ns'
        described = ', '.join(f"json_extract(metadata, '$.{word}')" for word in _DESCRIBED)
        return self._db.execute(
            'SELECT bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns,'  # noqa: S608
            f' {", ".join(_RECEIVED)}, {described} FROM objects'
            f" WHERE {start} >= ? AND {start} < ? AND key >= ? AND key < ? AND state <> 'evicted'"
            f" AND sensor <> '{CATALOG}' AND json_valid(metadata) ORDER BY {start}",
            (begin_ns, end_ns, f'{robot}/', after(f'{robot}/')),
        )

    def recorded_compact(self, robot: str, date: str) -> Iterator[tuple[str, str, str, int, int, int]]:
        """Short rows of delivered objects in folders with this ``YYYYMMDD``: (bucket, key, sensor, bytes, settled_s, late_ms)."""
        return self._db.execute(
            'SELECT bucket, path || name, sensor, bytes, settled_s, late_ms FROM folders'  # noqa: S608
            ' JOIN compact_objects ON folder = folders.id'
            f" WHERE path >= ? AND path < ? AND instr(path, ?) AND state <> 2 AND sensor <> '{CATALOG}'",
            (f'{robot}/', after(f'{robot}/'), date),
        )

    def recorded_days(self, robot: str) -> list[int]:
        """Days since 1970 on which objects with full rows begin."""
        rows = self._db.execute(
            'SELECT DISTINCT t_start_ns / 86400000000000 FROM objects WHERE key >= ? AND key < ? AND t_start_ns >= ?'  # noqa: S608
            f" AND sensor <> '{CATALOG}'",
            (f'{robot}/', after(f'{robot}/'), EARLIEST_SANE_NS),
        )
        return [day for (day,) in rows]

    def folders(self, robot: str) -> list[str]:
        """Folders of keys with short rows."""
        rows = self._db.execute(
            f"SELECT DISTINCT path FROM folders WHERE path >= ? AND path < ? AND sensor <> '{CATALOG}'",  # noqa: S608
            (f'{robot}/', after(f'{robot}/')),
        )
        return [path for (path,) in rows]
