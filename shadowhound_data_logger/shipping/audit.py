"""Checks whether the store still has the objects that it confirmed: requests each by name, so no right to list is needed.

A finding is about one object. If the store does not answer, the audit ends early, reports that, and continues from there the
next time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final, Protocol

from shadowhound_data_logger.core.errors import AccessDenied, StoreError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.verify import Finding, check_object

THREADS: Final = 8
KEYS: Final = 20
"""Keys listed of each kind of finding; all are counted."""


class Delivered(Protocol):
    """What an audit asks for, and where it notes how far it came."""

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]: ...

    def set_verified(self, ids: Iterable[int]) -> None: ...


@dataclass(slots=True)
class Audit:
    """What an audit found."""

    asked: int = 0
    sound: int = 0
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


def audit(source: Delivered, store: ObjectStore, *, deep: bool = False, threads: int = THREADS, keys: int | None = KEYS,
          tell: Callable[[], None] = lambda: None, pause: Callable[[float], object] = time.sleep) -> Audit:  # fmt: skip
    """Check every object of ``source``; ``deep`` also reads their content. The callback is called after each one.

    Of an object without a known SHA-256 only the size is compared. Intact objects are noted; findings are not, so an audit that
    ended early checks those again.
    """
    found = Audit(keys=keys)

    def check(expected: ObjectInfo) -> Finding | None:
        return check_object(store, expected.bucket, expected.key, expected.size, expected.sha256, deep=deep, pause=pause)

    pool = ThreadPoolExecutor(threads, 'verify')
    try:
        for page in source.pages():
            _audit_page(page, pool, check, source, store, found, tell)
    except StoreError as error:
        found.away = error
    finally:
        pool.shutdown(cancel_futures=True)
    return found


def _audit_page(page: Sequence[tuple[int, ObjectInfo]], pool: ThreadPoolExecutor, check: Callable[[ObjectInfo], Finding | None],
                source: Delivered, store: ObjectStore, found: Audit, tell: Callable[[], None]) -> None:  # fmt: skip
    sound: list[int] = []
    findings: list[Finding] = []
    answers = pool.map(check, [expected for _, expected in page])
    try:
        for (number, _), finding in zip(page, answers, strict=True):
            if finding is None:
                sound.append(number)
            else:
                findings.append(finding)
            tell()
    finally:
        source.set_verified(sound)
        found.sound += len(sound)
        found.asked += len(sound)
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
