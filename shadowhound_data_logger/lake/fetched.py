"""A folder of fetched objects: verified files, which a second run skips, and their rows.

``DIR/.fetch/`` contains a SQLite file, a lock that allows one fetch at a time, and incomplete files. The row files have the same
paths as in the bucket, so the folder can be queried like a store: ``MissionDataset('DIR')``.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.errors import LakeError

if TYPE_CHECKING:
    from typing_extensions import Self

from collections.abc import Mapping, Sequence
from typing import Any

from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import COLUMNS
from shadowhound_data_logger.lake.row_files import backfilled_key

FOLDER: Final = '.fetch'
UNWRITABLE: Final = 'choose a folder that you can write to, on a disk with free space'
PARTS: Final = f'{FOLDER}/parts'
"""The folder of incomplete files."""
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS files (
    key TEXT PRIMARY KEY, bucket TEXT NOT NULL, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, sha256 TEXT NOT NULL,
    etag TEXT NOT NULL, boot TEXT NOT NULL
) WITHOUT ROWID
"""


@dataclass(frozen=True, slots=True)
class Verified:
    """A file whose content was compared with the checksum of the object."""

    key: str
    bucket: str
    size: int
    mtime_ns: int
    sha256: str
    etag: str


class Fetched:
    """Records which files of a folder are complete.

    Lifecycle: enter once, exit once, on one thread. A file whose size or time differs from its record counts as unknown.

    Files are not synced one by one, which would take longer than downloading them. If the process is killed before they are
    synced, their records are trusted until the next boot; then the files are read again, because a power cut may damage them.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts = folder / PARTS
        self._boot = SystemClock.of_this_machine().boot_id
        self._lock: IO[bytes] | None = None
        self._known: dict[str, Verified] = {}
        self._db: sqlite3.Connection | None = None

    def __enter__(self) -> Self:
        """Raises LakeError if another fetch is running or the folder cannot be written."""
        home = self.folder / FOLDER
        try:
            home.mkdir(parents=True, exist_ok=True)
            self._lock = (home / 'lock').open('ab')
            self._claim(self._lock)
            shutil.rmtree(self.parts, ignore_errors=True)
            self.parts.mkdir()
            self._db = self._opened(home / 'files.db')
        except LakeError:
            self._release()
            raise
        except (OSError, sqlite3.Error) as error:
            self._release()
            raise LakeError(
                f'{self.folder} cannot be written: {getattr(error, "strerror", None) or error}',
                remedy=UNWRITABLE,
                folder=str(self.folder),
            ) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._db is not None:
            os.sync()
            with self._db:
                self._db.execute("UPDATE files SET boot = '' WHERE boot != ''")
            self._db.close()
        self._release()

    def _claim(self, file: IO[bytes]) -> None:
        if not lock(file, wait=False):
            raise LakeError(f'another fetch is writing to {self.folder}', remedy='wait for it, or choose another folder')

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()

    def path(self, key: str) -> Path:
        return self.folder / key

    def verified(self, key: str) -> Verified | None:
        """The record of this key's file, if the file has not changed since."""
        known = self._known.get(key)
        if known is None:
            return None
        try:
            seen = self.path(key).stat()
        except OSError:
            return None
        return known if (seen.st_size, seen.st_mtime_ns) == (known.size, known.mtime_ns) else None

    def record(self, files: Iterable[Verified]) -> None:
        """Record that these files are complete."""
        assert self._db is not None
        rows = [(file.key, file.bucket, file.size, file.mtime_ns, file.sha256, file.etag, self._boot) for file in files]
        with self._db:
            self._db.executemany('INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?, ?)', rows)

    def _opened(self, path: Path) -> sqlite3.Connection:
        """Open the records; a file that SQLite cannot read is replaced, because it is only a cache."""
        for attempt in range(2):
            db = sqlite3.connect(path)
            try:
                db.execute('PRAGMA journal_mode = WAL')
                db.execute('PRAGMA synchronous = NORMAL')
                db.execute(_SCHEMA)
                rows = db.execute(
                    "SELECT key, bucket, size, mtime_ns, sha256, etag FROM files WHERE boot IN ('', ?)", (self._boot,)
                )
                self._known = {row[0]: Verified(*row) for row in rows}
                return db
            except sqlite3.DatabaseError:
                db.close()
                if attempt:
                    raise
                path.unlink(missing_ok=True)
        raise AssertionError('unreachable')


def keep_rows(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write one row file per robot and date. Raises LakeError if that fails.

    Rows whose robot is not a valid name are skipped, because the name becomes that of a folder.
    """
    plain = [
        {**{name: row[name] for name in COLUMNS}, **{name: _micros(row, name) for name in ('t_start', 't_end')}} for row in rows
    ]
    for robot, date, found in parts.by_folder(enumerate(plain)):
        if robot is None or not is_name(robot):
            continue
        ours = [row for _, row in found]
        path = folder / backfilled_key(robot, date, [f'{row["bucket"]}/{row["key"]} {row["t_start_ns"]}' for row in ours])
        if path.is_file():
            continue
        try:
            part = folder / PARTS / f'rows-{os.getpid()}'  # after a kill, the next fetch deletes it
            for place in (part.parent, path.parent):
                place.mkdir(parents=True, exist_ok=True)
            with replacing(path, part=part) as file:
                file.write(parts.encode(ours))
        except OSError as error:
            raise LakeError(f'{path} cannot be written: {error.strerror}', remedy=UNWRITABLE, folder=str(folder)) from error


def _micros(row: Mapping[str, Any], name: str) -> int | None:
    """A time in microseconds, as in row files; None for an object without a date."""
    return None if row[name] is None else int(row[f'{name}_ns']) // 1000
