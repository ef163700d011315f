"""The journal of one mission: an append-only file. When a log call returns, its record is in the file.

One record per line: the CRC-32 of the JSON in eight hex digits, a space, then the JSON in ASCII. Such JSON contains no line
break, so a torn or corrupt line does not affect the others. The file is locked (flock) as long as its writer runs.
"""

from __future__ import annotations

import errno
import json
import os
import threading
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.durable_files import lock

CHUNK: Final = 1 << 20
TAIL_BYTES: Final = 64 << 10
"""Enough for the last record of a mission, which is short."""
MAX_LINE_BYTES: Final = 16 << 20
"""More bytes without a line break are damage: records are far shorter."""


class Line(NamedTuple):
    """One line of the journal."""

    end: int
    """Offset of the first byte after it, where reading continues."""
    record: Mapping[str, Any] | None
    """None for a damaged line."""


class Journal:
    """Writes the journal of a mission. Lifecycle: New; create once; append from any thread; sync from one; close once.

    ``_lock`` guards the descriptor, and ensures that a line is one write.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._descriptor = -1
        self._torn = False

    def create(self) -> None:
        """Create the file and lock it. Raises FileExistsError, or another OSError (a full disk, no permission)."""
        self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600)
        lock(self._descriptor)
        _open.add(self)

    def reopen(self) -> None:
        """Continue the journal of an earlier writer, or create one. Raises BlockingIOError while another writer runs, OSError."""
        descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        try:
            if not lock(descriptor, wait=False):
                raise BlockingIOError(errno.EAGAIN, 'another process is writing this journal', str(self.path))
        except OSError:
            os.close(descriptor)
            raise
        self._descriptor, self._torn = descriptor, os.fstat(descriptor).st_size > 0
        _open.add(self)

    def append(self, record: Mapping[str, Any]) -> None:
        """Write a record. It survives a kill of the process, and after ``sync`` a power cut. Raises OSError (a full disk)."""
        data = line_of(record)
        with self._lock:
            if self._descriptor < 0:
                return
            if self._torn:  # the previous record was cut off by a full disk: start a new line
                data = b'\n' + data
            torn, self._torn = self._torn, True
            try:
                self._torn = os.write(self._descriptor, data) != len(data)
            except OSError:
                self._torn = torn  # nothing was written
                raise
            torn = self._torn
        if torn:
            raise OSError(f'a record was only partly written to {self.path}')

    def sync(self) -> None:
        """Wait for the disk, while other threads append. Raises OSError."""
        with self._lock:
            if self._descriptor < 0:
                return
            descriptor = os.dup(self._descriptor)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def close(self) -> None:
        """Close the file and release its lock; idempotent."""
        with self._lock:
            descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def forget(self) -> None:
        """In a forked child: only the parent writes, and the child's copy of the lock must not hide the parent's exit."""
        self._lock = threading.Lock()
        with suppress(OSError):
            self.close()


_open: weakref.WeakSet[Journal] = weakref.WeakSet()


def _forget_all() -> None:
    for journal in tuple(_open):
        journal.forget()


os.register_at_fork(after_in_child=_forget_all)


def line_of(record: Mapping[str, Any]) -> bytes:
    """Encode a record as a line of the file."""
    text = json.dumps(record, separators=(',', ':'), allow_nan=False).encode('ascii')
    return b'%08x %s\n' % (zlib.crc32(text), text)


def read(path: Path, offset: int = 0) -> Iterator[Line]:
    """The complete lines from ``offset``, without a last line that is torn or still being written. Raises OSError."""
    with path.open('rb') as file:
        file.seek(offset)
        rest = b''
        while chunk := file.read(CHUNK):
            *lines, rest = (rest + chunk).split(b'\n')
            for line in lines:
                offset += len(line) + 1
                if line:
                    yield Line(offset, parse(line))
            if len(rest) > MAX_LINE_BYTES:
                return


def dated(lines: Iterable[Line], offset_ns: int) -> Iterator[Line]:
    """The same lines, with ``offset_ns`` added to the times of the boot clock: those before 2024."""
    for line in lines:
        record = line.record
        if offset_ns and record and int(record.get('t', 0)) < EARLIEST_SANE_NS:
            record = {**record, 't': int(record['t']) + offset_ns}
        if offset_ns and record and 'p' in record:
            record = {**record, 'p': [[ns + offset_ns * (ns < EARLIEST_SANE_NS), *pose] for ns, *pose in record['p']]}
        yield Line(line.end, record)


def parse(line: bytes) -> Mapping[str, Any] | None:
    """The record of a line; None if the checksum does not match."""
    try:
        if int(line[:8], 16) != zlib.crc32(line[9:]) or line[8:9] != b' ':
            return None
        found = json.loads(line[9:])
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def is_locked(path: Path) -> bool:
    """Whether the journal's writer is running. Raises OSError (FileNotFoundError)."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return not lock(descriptor, wait=False, shared=True)
    finally:
        os.close(descriptor)


def first(path: Path) -> Mapping[str, Any]:
    """The first record; empty if there is none yet. Raises OSError."""
    line = next(read(path), None)
    return (line and line.record) or {}


def last(path: Path) -> Mapping[str, Any]:
    """The last record; empty if it is damaged or too long to be an end. Raises OSError."""
    with path.open('rb') as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
        lines = file.read().split(b'\n')
    return (parse(lines[-2]) if len(lines) > 1 else None) or {}


@contextmanager
def abandoned(path: Path) -> Iterator[int | None]:
    """Open and lock the journal of a writer that exited, to finish it; None while the writer runs."""
    descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CLOEXEC)
    try:
        yield descriptor if lock(descriptor, wait=False) else None
    finally:
        os.close(descriptor)


def finish(path: Path, descriptor: int, end: int, record: Mapping[str, Any]) -> int:
    """Truncate a torn line after ``end`` and append the last record; returns the number of bytes removed. Raises OSError."""
    torn = path.stat().st_size - end
    os.ftruncate(descriptor, end)
    data = line_of(record)
    if os.write(descriptor, data) != len(data):
        os.ftruncate(descriptor, end)
        raise OSError(f'the disk is too full to finish {path}')
    os.fsync(descriptor)
    return torn
