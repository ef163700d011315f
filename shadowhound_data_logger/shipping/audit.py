"""Checks whether the store still holds what it confirmed: asks for each delivered object by name; no right to list is needed.

A finding is what the store itself says of an object. A store that does not answer is none: the audit then ends early, says
so, and goes on from there the next time.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Protocol

from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, ObjectRefused, StoreError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.stores.base import ObjectStore

THREADS: Final = 8
KEYS: Final = 20
"""Keys listed of each kind of finding; all are counted."""
MISSING: Final = 'missing'
SIZE: Final = 'size'
CHECKSUM: Final = 'checksum'
FOREIGN: Final = 'foreign'
DENIED: Final = 'denied'
UNREADABLE: Final = 'unreadable'
KINDS: Final = {
    MISSING: 'not in the store',
    SIZE: 'of another size',
    CHECKSUM: 'of other content',
    FOREIGN: 'without a checksum, so written by somebody else; --deep compares the content',
    DENIED: 'denied by the store: it may be there or not',
    UNREADABLE: 'refused by the store, such as an object that a client encrypted with its own key (SSE-C)',
}
"""What can be found, in words."""


class Delivered(Protocol):
    """What an audit asks for, and where it notes how far it came."""

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]: ...

    def note(self, ids: Iterable[int]) -> None: ...


@dataclass(frozen=True, slots=True)
class Finding:
    """One object that is not what was delivered."""

    kind: str
    bucket: str
    key: str
    detail: str


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
    """Ask for everything that ``source`` has; ``deep`` reads each object back as well. ``tell`` is called after each one.

    An object of which no SHA-256 is known is sound when its size is right.

    What is found sound is noted; findings are not, so that the next run of an audit that ended early looks again.
    """
    found = Audit(keys=keys)
    judge = partial(_judge, store, deep=deep, pause=pause)
    pool = ThreadPoolExecutor(threads, 'verify')
    try:
        for page in source.pages():
            _audit_page(page, pool, judge, source, store, found, tell)
    except StoreError as error:
        found.away = error
    finally:
        pool.shutdown(cancel_futures=True)
    return found


def _audit_page(page: Sequence[tuple[int, ObjectInfo]], pool: ThreadPoolExecutor, judge: Callable[[ObjectInfo], Finding | None],
                source: Delivered, store: ObjectStore, found: Audit, tell: Callable[[], None]) -> None:  # fmt: skip
    sound: list[int] = []
    findings: list[Finding] = []
    answers = pool.map(judge, [expected for _, expected in page])
    try:
        for (number, _), finding in zip(page, answers, strict=True):
            if finding is None:
                sound.append(number)
            else:
                findings.append(finding)
            tell()
    finally:
        source.note(sound)
        found.sound += len(sound)
        found.asked += len(sound)
    if findings:
        _confirm_store(store)
    found.asked += len(findings)
    for finding in findings:
        found.add(finding)


def _confirm_store(store: ObjectStore) -> None:
    """Raises StoreError unless it is the store that said so: a hotel's network also answers that there is no such thing."""
    try:
        store.probe()
    except AccessDenied:
        return  # whoever may only read is answered all the same


def _judge(store: ObjectStore, expected: ObjectInfo, *, deep: bool, pause: Callable[[float], object]) -> Finding | None:
    """None when the store has it as it was delivered. Raises StoreError when that cannot be found out."""
    make = partial(Finding, bucket=expected.bucket, key=expected.key)
    try:
        held = steadily(lambda: store.head(expected.bucket, expected.key), pause=pause)
        if held is None:
            return make(MISSING, detail=f'{expected.size} bytes were delivered')
        if held.size != expected.size:
            return make(SIZE, detail=f'{held.size} bytes, {expected.size} were delivered')
        if deep and expected.sha256 is not None:
            content = steadily(lambda: _sha256(store, expected), pause=pause)
            if content != expected.sha256:
                return make(CHECKSUM, detail=f'SHA-256 {content}, {expected.sha256} was delivered')
    except (BucketMissing, ObjectRefused) as error:
        is_missing = isinstance(error, BucketMissing) or error.data.get('reason') == 'missing'
        return make(MISSING if is_missing else UNREADABLE, detail=str(error))
    except AccessDenied as error:
        return make(DENIED, detail=str(error))
    if expected.sha256 in {None, held.sha256} or (deep and held.sha256 is None):
        return None
    if held.sha256 is None:
        return make(FOREIGN, detail='no sha256 in its metadata')
    return make(CHECKSUM, detail=f'sha256 {held.sha256} in its metadata, {expected.sha256} was delivered')


def _sha256(store: ObjectStore, expected: ObjectInfo) -> str:
    """Of the content, in bounded memory: a slice has hundreds of megabytes."""
    digest = hashlib.sha256()
    for piece in store.content(expected.bucket, expected.key):
        digest.update(piece)
    return digest.hexdigest()
