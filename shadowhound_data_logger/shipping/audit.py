"""Checks whether the store still has the objects that it confirmed: requests each by name, so no right to list is needed.

A finding is about one object. If the store does not answer, the audit ends early, reports that, and continues from there the
next time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Final, TypeVar

from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.errors import AccessDenied, SpoolError, StoreError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.verify import Finding, check_object

if TYPE_CHECKING:
    from typing_extensions import Self

log = logging.getLogger(__name__)

THREADS: Final = 8
KEYS: Final = 20
"""Keys listed of each kind of finding; all are counted."""
DIGEST_BYTES: Final = 16
SUFFIX: Final = '.valid'
KEEP_S: Final = 7 * 86_400.0
"""How long an interrupted audit can be continued."""


PAGE: Final = 256
"""Objects read from the index at a time: an interruption loses at most the results of so many."""

_Answer = TypeVar('_Answer')


class Deliveries:
    """The delivered objects of a spool's index, which is only read: a node may deliver at the same time.

    Lifecycle: new; open once; use from one thread; close once. Raises SpoolError, which names the file and what to do.
    """

    def __init__(self, spool: Path) -> None:
        self._path = spool / 'index.db'
        self._index = Index(self._path, read_only=True)

    def open(self) -> None:
        if not self._path.is_file():
            raise SpoolError(f'there is no spool in {self._path.parent}',
                             remedy='has the node run here? set SHADOWHOUND_HOME to its folder')  # fmt: skip
        self._read(self._index.open)

    def close(self) -> None:
        self._index.close()

    def pages(self) -> Iterator[list[ObjectInfo]]:
        """Delivered objects, as the store must describe them, some at a time."""
        last = 0
        while page := self._read(partial(self._index.history.delivered, last, PAGE)):
            last = page[-1][0]
            yield [item for _, item in page]

    def known(self) -> int:
        """Delivered objects that the index remembers; it forgets them after ``spool.remember_days``."""
        return self._read(self._index.history.delivered_count)

    def forgotten(self) -> int:
        """Earlier deliveries, which the index counts but can no longer name; including parts of the catalog."""
        return self._read(self._index.history.forgotten_count)

    def since_ns(self) -> int | None:
        """When the first remembered object was delivered; None if there is none."""
        return self._read(self._index.history.delivered_since_ns)

    def first_session(self) -> str:
        """Identifies the index, also a copy of it."""
        return str(self._read(self._index.accounts.first_session))

    def _read(self, read: Callable[[], _Answer]) -> _Answer:
        try:
            return read()
        except sqlite3.Error as error:
            raise SpoolError(f'{self._path} cannot be read: {error}', remedy='may this user read the folder?') from error


class AuditProgress:
    """What an interrupted audit found valid, which the next run of the same audit skips: a file with 16 bytes per object.

    Lifecycle: enter once; used by one audit; ``finish`` when all is checked; exit once. Without a writable folder nothing is
    recorded.
    """

    def __init__(self, folder: Path, question: str, *, again: bool = False) -> None:
        """``question`` identifies the store and the objects; ``again`` discards the results of an earlier run."""
        self._path = folder / f'{hashlib.sha256(question.encode()).hexdigest()[:32]}{SUFFIX}'
        self._again = again
        self._file: IO[bytes] | None = None
        self._known: frozenset[bytes] = frozenset()

    def __enter__(self) -> Self:
        """Raises StoreError if another process asks the same question."""
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            for path in self._path.parent.glob(f'*{SUFFIX}'):
                if (path == self._path and self._again) or time.time() - path.stat().st_mtime > KEEP_S:
                    path.unlink()
            file = self._path.open('a+b', buffering=0)
        except OSError as error:
            log.warning('after an interruption all objects will be checked again: %s', error)
            return self
        if not lock(file, wait=False):
            file.close()
            raise StoreError('another process is verifying the same objects', remedy='wait until it has finished')
        self._file = file
        file.seek(0)
        found = file.read()
        whole = len(found) - len(found) % DIGEST_BYTES
        file.truncate(whole)
        self._known = frozenset(found[index : index + DIGEST_BYTES] for index in range(0, whole, DIGEST_BYTES))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._file is not None:
            self._file.close()

    def unverified(self, page: Sequence[ObjectInfo]) -> Sequence[ObjectInfo]:
        """The objects that no earlier run found valid."""
        return [one for one in page if _digest(one) not in self._known] if self._known else page

    def add(self, valid: Sequence[ObjectInfo]) -> None:
        """Record that these objects are valid."""
        if self._file is not None:
            try:
                self._file.write(b''.join(map(_digest, valid)))
            except OSError as error:
                log.warning('after an interruption the objects from here on will be checked again: %s', error)
                self._file.close()
                self._file = None

    def finish(self) -> None:
        """Record that the audit is complete, so that the next one starts from the beginning."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)


def _digest(one: ObjectInfo) -> bytes:
    description = json.dumps((one.bucket, one.key, one.size, one.sha256))
    return hashlib.blake2b(description.encode(), digest_size=DIGEST_BYTES).digest()


@dataclass(slots=True)
class Audit:
    """What an audit found."""

    asked: int = 0
    sound: int = 0
    earlier: int = 0
    """Objects that an earlier run found valid."""
    counts: dict[str, int] = field(default_factory=dict)
    """Kind -> findings."""
    first: dict[str, list[Finding]] = field(default_factory=dict)
    """Kind -> the first of them."""
    away: StoreError | None = None
    """Why it ended before its time."""
    keys: int | None = KEYS
    """So many of each kind are listed; None: all."""

    def add(self, finding: Finding) -> None:
        self.counts[finding.kind] = self.counts.get(finding.kind, 0) + 1
        listed = self.first.setdefault(finding.kind, [])
        if self.keys is None or len(listed) < self.keys:
            listed.append(finding)


def audit(pages: Iterable[Sequence[ObjectInfo]], progress: AuditProgress, store: ObjectStore, *, deep: bool = False,  # noqa: PLR0913 - as the verbs
          threads: int = THREADS, keys: int | None = KEYS, tell: Callable[[int], object] = lambda _: None,
          pause: Callable[[float], object] = time.sleep) -> Audit:  # fmt: skip
    """Check these objects; ``deep`` also reads their content. The callback receives how many more are done.

    Of an object without a known SHA-256 only the size is compared. Valid objects are recorded; findings are not, so an audit
    that ended early checks those again. One that checked everything finishes ``progress``.
    """
    found = Audit(keys=keys)

    def check(expected: ObjectInfo) -> Finding | None:
        return check_object(store, expected.bucket, expected.key, expected.size, expected.sha256, deep=deep, pause=pause)

    pool = ThreadPoolExecutor(threads, 'verify')
    try:
        for page in pages:
            left = progress.unverified(page)
            found.earlier += len(page) - len(left)
            tell(len(page) - len(left))
            _audit_page(left, pool.map(check, left), progress, store, found, tell)
        progress.finish()
    except StoreError as error:
        found.away = error
    finally:
        pool.shutdown(cancel_futures=True)
    return found


def _audit_page(page: Sequence[ObjectInfo], answers: Iterable[Finding | None], progress: AuditProgress, store: ObjectStore,
                found: Audit, tell: Callable[[int], object]) -> None:  # fmt: skip
    valid: list[ObjectInfo] = []
    findings: list[Finding] = []
    try:
        for one, finding in zip(page, answers, strict=True):
            if finding is None:
                valid.append(one)
            else:
                findings.append(finding)
            tell(1)
    finally:
        progress.add(valid)
        found.sound += len(valid)
        found.asked += len(valid)
    if findings:
        _confirm_store(store)
    found.asked += len(findings)
    for finding in findings:
        found.add(finding)


def _confirm_store(store: ObjectStore) -> None:
    """Raises StoreError unless the store itself answered: a hotel's network also answers that an object does not exist."""
    try:
        store.probe()
    except AccessDenied:
        return  # it is the store, and this key may only read
