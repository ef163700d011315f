"""The objects that a store must have, which ``shipping/audit.py`` checks: every object with a row.

If a store lost rows, it is unknown which objects it lost with them. Therefore the rows of another store, fetched into a folder,
can be added.

An audit that was interrupted by a kill or an unreachable store continues where it stopped: a file records the valid objects.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final

import pyarrow as pa

from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings

if TYPE_CHECKING:
    from typing_extensions import Self

log = logging.getLogger(__name__)

PAGE: Final = 1_000
"""Objects checked between two records; after an interruption, at most this many are checked again."""
DIGEST_BYTES: Final = 16
KEEP_S: Final = 7 * 86_400.0
"""How long an interrupted audit can be continued."""
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

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        ordered = self.table.sort_by([(name, 'ascending') for name in _KEY])
        for start in range(0, len(ordered), PAGE):
            yield list(enumerate(_infos(ordered.slice(start, PAGE)), start))

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


class Unfinished:
    """The rows of objects that no earlier run of the same query found valid. A file records the valid ones, 16 bytes per row.

    Lifecycle: enter once; read by one thread; ``finish`` when all are checked; exit once. Without a writable folder nothing is
    recorded.
    """

    def __init__(self, rows: Rows, folder: Path, question: str, *, again: bool = False) -> None:
        """``question`` identifies the store and the query; ``again`` discards the results of an earlier run."""
        self._rows = rows
        self._path = folder / f'{hashlib.sha256(question.encode()).hexdigest()[:32]}.sound'
        self._again = again
        self._file: IO[bytes] | None = None
        self._known: frozenset[bytes] = frozenset()
        self._page: dict[int, bytes] = {}

    def __enter__(self) -> Self:
        """Raises LakeError if another process runs the same query."""
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            for path in self._path.parent.glob('*.sound'):
                if (path == self._path and self._again) or time.time() - path.stat().st_mtime > KEEP_S:
                    path.unlink()
            file = self._path.open('a+b', buffering=0)
        except OSError as error:
            log.warning('after an interruption all objects will be checked again: %s', error)
            return self
        if not lock(file, wait=False):
            file.close()
            raise LakeError('another process is verifying the same objects', remedy='wait until it has finished')
        self._file = file
        file.seek(0)
        found = file.read()
        whole = len(found) - len(found) % DIGEST_BYTES
        file.truncate(whole)
        self._known = frozenset(found[place : place + DIGEST_BYTES] for place in range(0, whole, DIGEST_BYTES))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._file is not None:
            self._file.close()

    def earlier(self) -> int:
        """The number of rows that an earlier run found valid."""
        return sum(_digest(info) in self._known for page in self._rows.pages() for _, info in page) if self._known else 0

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        for page in self._rows.pages():
            self._page = {number: _digest(info) for number, info in page}
            if left := [one for one in page if self._page[one[0]] not in self._known]:
                yield left

    def set_verified(self, ids: Iterable[int]) -> None:
        """Record that these objects are valid."""
        if self._file is not None:
            try:
                self._file.write(b''.join(self._page[number] for number in ids))
            except OSError as error:
                log.warning('after an interruption the objects from here on will be checked again: %s', error)
                self._file.close()
                self._file = None

    def finish(self) -> None:
        """Record that the audit is complete, so that the next one starts from the beginning."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)


def _digest(info: ObjectInfo) -> bytes:
    description = json.dumps((info.bucket, info.key, info.size, info.sha256))
    return hashlib.blake2b(description.encode(), digest_size=DIGEST_BYTES).digest()


def _infos(table: pa.Table) -> list[ObjectInfo]:
    return [ObjectInfo(*row) for row in zip(*(table[name].to_pylist() for name in _DESCRIPTION), strict=True)]
