"""How the catalogue lies in the store, robot by robot."""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from shadowhound_data_logger.clock import utc
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.reading import THREADS
from shadowhound_data_logger.lake.standing import Day, days, is_compacted, robots


@dataclass(frozen=True, slots=True)
class CatalogueState:
    """Of one robot's catalogue."""

    robot: str
    days: int
    first: str
    """Date, as all dates UTC."""
    last: str
    files: int
    size: int
    """Bytes of all of them."""
    compacted: int
    """Days that are one file."""
    open_days: int
    """Days that are over and have several."""
    covered: int
    """Files that others stand for: they only take room."""


def state(source: Bucket, robot: str | None = None, findings: Findings | None = None) -> list[CatalogueState]:
    """Of all robots that have a catalogue. Raises StoreError."""
    findings = Findings() if findings is None else findings
    today = f'{utc(time.time_ns()):%Y-%m-%d}'
    with ThreadPoolExecutor(THREADS) as pool:
        found = {name: days(source, [name], None, pool, findings) for name in ([robot] if robot else robots(source))}
    return [_state(name, each, today) for name, each in found.items() if each]


def _state(robot: str, found: Iterable[Day], today: str) -> CatalogueState:
    each = list(found)
    entries = [entry for day in each for entry in (*day.entries, *day.covered)]
    return CatalogueState(
        robot=robot, days=len(each), first=each[0].date, last=each[-1].date, files=len(entries),
        size=sum(entry.size for entry in entries), covered=sum(len(day.covered) for day in each),
        compacted=sum(len(day.entries) == 1 and is_compacted(day.entries[0].key) for day in each),
        open_days=sum(len(day.entries) > 1 and day.date < today for day in each),
    )  # fmt: skip
