"""How missions ended: rows of the table ``missions``, from the ``summary.json`` that a mission uploads at its end.

``lake ingest`` adds the row of a mission when it adds rows that name its run. A query reads the summaries of other runs from the
store, like row files that are not ingested yet. A robot can write only its own summaries; values of a wrong type become null.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from typing import Any, Final

import pyarrow as pa

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, utc
from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.untrusted import MAX_SUMMARY_BYTES, from_json
from shadowhound_data_logger.formats.rows.catalog import UNDATED
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.tables import DATE, MISSION_ROWS, ROBOT, Tables, answer, engine

Run = tuple[str, str]
"""Robot and id of the MLflow run."""
MAX_TEXT: Final = 64 << 10
SUMMARY: Final[Mapping[str, str]] = {
    'mission_id': 'mission_id', 'mission_type': 'mission_type', 'start_ns': 'start_ns', 'end_ns': 'end_ns',
    'command': 'mission_command', 'started': 'start', 'ended': 'end', 'result': 'result', 'success': 'success',
    'distance_m': 'distance_m', 'duration_s': 'duration_s', 'battery_consumed_pct': 'battery_consumed_pct', 'policy': 'policy',
    'policies': 'policies',
}  # fmt: skip
"""Column -> its name in ``summary.json``."""


def ended(source: Bucket, runs: Collection[Run], tables: Tables, as_of: datetime | None = None) -> dict[Run, dict[str, Any]]:
    """How these runs ended, from the table as of a time, otherwise from table and store. Raises StoreError, LakeError."""
    if not runs:
        return {}
    found = {(row[ROBOT], row['run_id']): row for row in known(runs, tables, as_of).to_pylist()}
    if as_of is None:
        found |= {(row[ROBOT], row['run_id']): row for row in uploaded(source, {*runs} - {*found}).to_pylist()}
    return found


def known(runs: Collection[Run], tables: Tables, as_of: datetime | None = None) -> pa.Table:
    """The rows of these runs in the table. Raises LakeError."""
    robots, ids = zip(*runs, strict=True)
    wanted = pa.table({ROBOT: pa.array(robots, pa.string()), 'run_id': pa.array(ids, pa.string())})
    with engine({'missions': tables.open(MISSION_ROWS, as_of), 'wanted': wanted}) as ready:
        return answer(ready, 'SELECT m.* FROM missions m JOIN wanted w ON m.robot = w.robot AND m.run_id = w.run_id')


def uploaded(source: Bucket, runs: Collection[Run]) -> pa.Table:
    """The rows of these runs, for those that have uploaded a summary. Raises StoreError."""
    with ThreadPoolExecutor(THREADS, 'lake-missions') as pool:
        found = [row for row in pool.map(lambda run: _row(source, *run), sorted(runs)) if row is not None]
    return pa.Table.from_pylist(found, schema=MISSION_ROWS.schema)


def _row(source: Bucket, robot: str, run_id: str) -> dict[str, Any] | None:
    """None for a mission without a summary, or whose summary is not JSON."""
    try:
        summary = from_json(source.get(f'{robot}/missions/{run_id}/summary.json', MAX_SUMMARY_BYTES), MAX_SUMMARY_BYTES)
    except (ObjectRefused, ValueError):
        return None
    if not isinstance(summary, dict):
        return None
    row = {name: _value(summary.get(there), MISSION_ROWS.schema.field(name).type) for name, there in SUMMARY.items()}
    start_ns = row['start_ns']
    date = UNDATED if start_ns is None or start_ns < EARLIEST_SANE_NS else f'{utc(start_ns):%Y-%m-%d}'
    return {DATE: date, ROBOT: robot, 'run_id': run_id, **row}


def _value(value: Any, kind: pa.DataType) -> Any:
    if pa.types.is_floating(kind):
        return float(value) if isinstance(value, (int, float)) and abs(value) <= sys.float_info.max else None
    if pa.types.is_integer(kind):
        return value if type(value) is int and abs(value) < 1 << 63 else None
    if pa.types.is_string(kind):  # half a surrogate pair is not text
        return value.encode(errors='replace').decode() if isinstance(value, str) and len(value) <= MAX_TEXT else None
    return value if isinstance(value, bool) else None
