"""``lake reindex``: adds missing rows, from a listing of the store and the metadata of its objects.

It only adds row files. If a robot delivers the same rows later, ingest adds each row once. Therefore it can run at any time, and
it can be killed; the next run continues.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Final

from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET, FORGOTTEN, OBJECTS, Row, TableSchema, is_row, row_of
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, put_part
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import backfilled_key
from shadowhound_data_logger.lake.views import rows_of
from shadowhound_data_logger.stores.base import ObjectStore

KEY: Final = ('bucket', 'key')
BUCKETS: Final = (BUCKET, 'trajectories')
PAGE: Final = 10_000
"""Objects whose rows are written together."""


@dataclass(slots=True)
class Reindexed:
    """The result of a reindex so far."""

    listed: int = 0
    added: int = 0
    parts: int = 0
    gone: int = 0
    """Rows whose objects are missing but were not deleted by ``lake prune``; the rows are kept."""


def reindex(
    source: Bucket, store: ObjectStore, robot: str, *, buckets: tuple[str, ...] = BUCKETS,
    tell: Callable[[Reindexed], None] = lambda _: None, findings: Findings | None = None,
) -> Reindexed:  # fmt: skip
    """Add the missing rows of one robot. Raises StoreError, NameRefused; rows added before an error are kept."""
    check_name(robot, 'the robot name')
    found = Reindexed()
    findings = Findings() if findings is None else findings
    known = _keys(source, robot, findings)
    for bucket in buckets:
        place = Bucket(source.settings, bucket)
        listed = place.list(f'{robot}/', lambda bucket, key: findings.add(f'{bucket}/{key}', 'its key is not a path'))
        entries = (entry for entry in listed if is_row(bucket, entry.key))
        while page := list(islice(entries, PAGE)):
            found.listed += len(page)
            new = [entry for entry in page if (bucket, entry.key) not in known]
            known.difference_update((bucket, entry.key) for entry in page)
            rows = list(_rows(place, new))
            for _, date, numbered in parts.by_folder(enumerate(rows)):
                part = [row for _, row in numbered]
                key = backfilled_key(robot, date, (f'{row["bucket"]}/{row["key"]}' for row in part))
                put_part(store, key, robot, parts.encode(part), len(part))
                found.parts += 1
            found.added += len(rows)
            tell(found)
    forgotten = _keys(source, robot, findings, FORGOTTEN) if known else set()
    found.gone = sum(pair[0] in buckets and pair not in forgotten for pair in known)
    return found


def _keys(source: Bucket, robot: str, findings: Findings, of: TableSchema = OBJECTS) -> set[tuple[str, str]]:
    rows = rows_of(source, of, findings, robot=robot, columns=KEY)
    return set(zip(*(rows[name].to_pylist() for name in KEY), strict=True))


def _rows(place: Bucket, entries: list[ObjectInfo]) -> Iterator[Row]:
    """The rows of the objects that still exist."""

    def row(entry: ObjectInfo) -> Row | None:
        info = place.head(entry.key)
        return None if info is None else row_of(place.name, entry.key, info.size, info.content_type, info.metadata)

    with ThreadPoolExecutor(THREADS) as pool:
        yield from (found for found in pool.map(row, entries) if found is not None)
