"""What a catalogue says that a store holds: every object that has a row, for ``ship/audit.py`` to ask for.

A store that lost a part of its own catalogue does not know what else it lost. So the catalogue of another store, fetched into a
folder, can be laid beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa

from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.model import ObjectInfo

PAGE: Final = 10_000
_KEY: Final = ('bucket', 'key')
_SAID: Final = (*_KEY, 'bytes', 'sha256')


def rows(source: Bucket, findings: Findings, **flags: Any) -> Rows:
    """Of one catalogue; ``flags`` are those of ``lake.objects``. Raises SettingError, LakeError, StoreError."""
    with query.answering():
        found: pa.Table = query.objects(source, findings=findings, **flags).select(*_SAID).distinct().to_arrow()
    return Rows(found)


@dataclass(frozen=True, slots=True)
class Rows:
    """Objects as catalogues have them, in the order of their keys: some 200 bytes of memory each.

    An object of which two rows say different things is asked for as each of them says.
    """

    table: pa.Table
    """Bucket, key, bytes, sha256; no row twice."""

    def __len__(self) -> int:
        return len(self.table)

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        ordered = self.table.sort_by([(name, 'ascending') for name in _KEY])
        for start in range(0, len(ordered), PAGE):
            yield list(enumerate(_infos(ordered.slice(start, PAGE)), start))

    def note(self, ids: Iterable[int]) -> None:
        """Nowhere: an audit that was cut short starts again, or asks for fewer days."""

    def unproved(self) -> int:
        """Of how many no SHA-256 is known: of these the size alone is compared."""
        return int(self.table['sha256'].null_count)

    def joined(self, other: Rows) -> Rows:
        """What stands in either."""
        return Rows(pa.concat_tables([self.table, other.table]).group_by(list(_SAID)).aggregate([]).select(_SAID))

    def lacking(self, other: Rows) -> list[ObjectInfo]:
        """Those that have no row in the other."""
        left = self.table.join(other.table.select(_KEY), keys=list(_KEY), join_type='left anti')
        return _infos(left.sort_by([(name, 'ascending') for name in _KEY]))


def _infos(table: pa.Table) -> list[ObjectInfo]:
    return [ObjectInfo(*row) for row in zip(*(table[name].to_pylist() for name in _SAID), strict=True)]
