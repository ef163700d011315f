"""The objects that a store must have, which ``shipping/audit.py`` checks: every object with a row.

If a store lost rows, it is unknown which objects it lost with them. Therefore the rows of another store, fetched into a folder,
can be added.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa

from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings

PAGE: Final = 1_000
"""Objects checked between two records; after an interruption, at most this many are checked again."""
_KEY: Final = ('bucket', 'key')
_DESCRIPTION: Final = (*_KEY, 'bytes', 'sha256')


def rows(source: Bucket, findings: Findings, **flags: Any) -> Rows:
    """The rows of one store; ``flags`` are those of ``lake.objects``. Raises SettingError, LakeError, StoreError."""
    return Rows(query.objects(source, findings=findings, columns=_DESCRIPTION, distinct=True, **flags))


@dataclass(frozen=True, slots=True)
class Rows:
    """Objects as described by their rows, ordered by key: about 200 bytes of memory each.

    An object with two contradicting rows is checked against both.
    """

    table: pa.Table
    """Bucket, key, bytes and sha256, without duplicates."""

    def __len__(self) -> int:
        return len(self.table)

    def pages(self) -> Iterator[list[ObjectInfo]]:
        """All objects, some at a time."""
        ordered = self.table.sort_by([(name, 'ascending') for name in _KEY])
        for start in range(0, len(ordered), PAGE):
            yield _infos(ordered.slice(start, PAGE))

    def unverified(self) -> int:
        """The number of objects without a SHA-256: only their sizes are compared."""
        return int(self.table['sha256'].null_count)

    def joined(self, other: Rows) -> Rows:
        """The union of the rows of both."""
        columns = list(_DESCRIPTION)
        return Rows(pa.concat_tables([self.table, other.table]).group_by(columns).aggregate([]).select(columns))

    def lacking(self, other: Rows) -> list[ObjectInfo]:
        """The objects that have no row in the other."""
        left = self.table.join(other.table.select(_KEY), keys=list(_KEY), join_type='left anti')
        return _infos(left.sort_by([(name, 'ascending') for name in _KEY]))


def _infos(table: pa.Table) -> list[ObjectInfo]:
    return [ObjectInfo(*row) for row in zip(*(table[name].to_pylist() for name in _DESCRIPTION), strict=True)]
