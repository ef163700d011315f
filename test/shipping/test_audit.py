"""An audit of every store checks each delivered object, and finds any change since its delivery."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from spool.making import make, new_spool, put, settle
from stores.memory import MemoryStore

from shadowhound_data_logger.core.errors import AccessDenied, CredentialsRejected, StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject, State
from shadowhound_data_logger.shipping import audit as audit_module
from shadowhound_data_logger.shipping.audit import KEYS, Audit, AuditProgress, Deliveries, audit
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.base import Content, ObjectStore
from shadowhound_data_logger.stores.directory import DirectoryStore, metadata_path
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_obstore import ObstoreStore


@pytest.fixture
def spooled(tmp_path: Path) -> Iterator[Spool]:
    """An open spool, as a node has it."""
    opened = new_spool(tmp_path / 'spool')
    opened.open()
    yield opened
    opened.close()


def deliver(spool: Spool, store: ObjectStore, bucket: str, *names: str) -> list[SpooledObject]:
    items = put(spool, *(make(f'thor/{name}', f'content of {name}'.encode(), bucket=bucket) for name in names))
    for item in items:
        store.put(item)
        settle(spool, item, State.DELIVERED)
    return items


def verify(spool: Spool, store: Any, *, deep: bool = False, again: bool = False) -> Audit:
    with closing(Deliveries(spool.root)) as deliveries, AuditProgress(spool.root / 'verify', str(deep), again=again) as progress:
        deliveries.open()
        return audit(deliveries.pages(), progress, store, deep=deep, pause=lambda _: None)


def remove(store: ObjectStore, item: SpooledObject) -> None:
    store.delete(item.bucket, item.key)


def overwrite(store: ObjectStore, item: SpooledObject, body: bytes, *, metadata: bool = True) -> None:
    """Put other content under the key, with the metadata of the object or without any."""
    fields = dict(item.metadata) if metadata else {}
    if isinstance(store, MemoryStore):
        info = ObjectInfo(item.bucket, item.key, len(body), fields.get('sha256'), fields)
        store._objects[item.bucket, item.key] = info, body
    elif isinstance(store, DirectoryStore):
        store._path(item.bucket, item.key).write_bytes(body)
        if not metadata:
            metadata_path(store._directory, item.bucket, item.key).unlink()
    else:
        plain = store._s3 if isinstance(store, ObstoreStore) else store
        assert isinstance(plain, S3Store)
        plain._client._client.put_object(Bucket=item.bucket, Key=item.key, Body=body, Metadata=fields)


def kinds(found: Audit) -> dict[str, list[str]]:
    return {kind: [finding.key for finding in findings] for kind, findings in found.first.items()}


def test_delivered_objects_are_found(store: ObjectStore, spooled: Spool, bucket: str) -> None:
    """Without changes there are no findings; undelivered objects are not checked, and no state is left behind."""
    items = deliver(spooled, store, bucket, 'a', 'b', 'c')
    pending, evicted, twin = put(spooled, *(make(f'thor/{name}', bucket=bucket) for name in ('p', 'e', 't')))
    settle(spooled, evicted, State.EVICTED, 'disk')
    settle(spooled, twin, State.DEDUPLICATED)
    for deep in (False, True):
        found = verify(spooled, store, deep=deep)
        assert (found.asked, found.sound, found.counts, found.away) == (len(items), len(items), {}, None)
    assert pending.path.exists()
    assert not list(spooled.root.glob('verify/*'))


def test_an_audit_skips_parts_of_the_catalog(spooled: Spool) -> None:
    """Catalog parts are removed once a larger part replaces them: a missing one is not a finding, and none is counted."""
    store = MemoryStore()
    part = replace(make('thor/_catalog/date=2026-11-21/a.parquet'), sensor='_catalog', topic=None, samples=0)
    settle(spooled, *put(spooled, part), State.DELIVERED)
    deliver(spooled, store, 'sensor-data', 'a')
    assert (verify(spooled, store).asked, verify(spooled, store).counts) == (1, {})


def test_every_change_of_an_object_is_found(store: ObjectStore, spooled: Spool, bucket: str) -> None:
    """Deleted, truncated, replaced by other content or by another program: each has its finding."""
    names = ('deleted', 'cut', 'changed', 'foreign', 'same', 'good')
    deleted, cut, changed, foreign, same, _ = deliver(spooled, store, bucket, *names)
    remove(store, deleted)
    overwrite(store, cut, b'content')
    overwrite(store, changed, b'CONTENT OF CHANGED')
    overwrite(store, foreign, b'CONTENT OF FOREIGN', metadata=False)
    overwrite(store, same, b'content of same', metadata=False)
    found = verify(spooled, store)
    assert kinds(found) == {'missing': [deleted.key], 'size': [cut.key], 'foreign': [foreign.key, same.key]}
    assert (found.asked, found.sound) == (6, 2)
    found = verify(spooled, store, deep=True)
    assert kinds(found) == {'missing': [deleted.key], 'size': [cut.key], 'checksum': [changed.key, foreign.key]}
    assert (found.asked, found.sound) == (6, 2)


class Failing(MemoryStore):
    """A memory store that serves this many requests and then fails."""

    def __init__(self, store: MemoryStore, answers: int, error: StoreError) -> None:
        super().__init__()
        self._store, self._answers, self._error = store, answers, error
        self.asked: list[str] = []

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        self.probe()
        self.asked.append(key)
        return self._store.head(bucket, key)

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        return self._store.content(bucket, key, start)

    def probe(self) -> None:
        self._answers -= 1
        if self._answers < 0:
            raise self._error


@pytest.fixture
def paged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_module, 'PAGE', 10)


@pytest.mark.usefixtures('paged')
@pytest.mark.parametrize('error', [StoreUnavailable('away'), CredentialsRejected('wrong key')])
def test_an_interrupted_audit_resumes(spooled: Spool, error: StoreError) -> None:
    """An unreachable store is not a finding; the next run checks the rest, new objects, and earlier findings."""
    store = MemoryStore()
    items = deliver(spooled, store, 'bucket', *(f'{number:02d}' for number in range(45)))
    remove(store, items[3])
    first = verify(spooled, Failing(store, 34, error))
    assert first.away is error
    assert kinds(first) == {'missing': [items[3].key]}
    later = deliver(spooled, store, 'bucket', 'later')
    second = Failing(store, 1000, error)
    found = verify(spooled, second)
    assert found.away is None
    assert kinds(found) == {'missing': [items[3].key]}
    assert first.sound + found.sound == 45
    assert set(second.asked) >= {items[3].key, items[44].key, later[0].key}
    assert len(second.asked) <= 46 - 29
    assert verify(spooled, store).asked == 46, 'a completed audit starts again'


@pytest.mark.usefixtures('paged')
def test_another_audit_starts_again(spooled: Spool) -> None:
    """An interrupted one is discarded on request, and by an audit with other options."""
    store = MemoryStore()
    deliver(spooled, store, 'bucket', *(f'{number:02d}' for number in range(30)))
    for options in ({'again': True}, {'deep': True}):
        assert verify(spooled, Failing(store, 15, StoreUnavailable('away'))).sound >= 10
        assert verify(spooled, store, **options).asked == 30


def test_a_transient_failure_of_the_store_is_retried(spooled: Spool) -> None:
    """A request that is throttled occasionally does not end the audit."""
    store = MemoryStore()
    deliver(spooled, store, 'bucket', *(f'{number:02d}' for number in range(30)))
    asked = iter(range(1000))

    class Throttled(Failing):
        def probe(self) -> None:
            if next(asked) % 5 == 0:
                raise StoreUnavailable('slow down')

    assert verify(spooled, Throttled(store, 0, StoreUnavailable('x'))).sound == 30


def test_an_answer_of_another_server_is_not_a_finding(spooled: Spool) -> None:
    """If another server responds that the object does not exist, the probe detects it, and there is no finding for the object."""
    store = MemoryStore(lambda item: None if item else StoreUnavailable('does not answer like an S3 server'))
    items = deliver(spooled, store, 'bucket', 'a', 'b')
    remove(store, items[0])
    found = verify(spooled, store)
    assert (found.counts, str(found.away)) == ({}, 'does not answer like an S3 server')


def test_an_object_that_is_denied_is_a_finding(spooled: Spool) -> None:
    """Without the right to list, a server also denies missing objects: the object is listed, and the others are checked."""
    store = MemoryStore()
    deliver(spooled, store, 'bucket', 'a', 'b')

    class Closed(Failing):
        def head(self, bucket: str, key: str) -> ObjectInfo | None:
            if key == 'thor/a':
                raise AccessDenied('no')
            return super().head(bucket, key)

    found = verify(spooled, Closed(store, 100, StoreUnavailable('x')))
    assert (kinds(found), found.sound) == ({'denied': ['thor/a']}, 1)


def test_all_findings_are_counted_and_the_first_are_listed(spooled: Spool) -> None:
    """A lost bucket fills neither the memory nor the screen."""
    store = MemoryStore()
    for item in deliver(spooled, store, 'bucket', *(f'{number:02d}' for number in range(KEYS + 5))):
        remove(store, item)
    found = verify(spooled, store)
    assert found.counts == {'missing': KEYS + 5}
    assert [finding.key for finding in found.first['missing']] == [f'thor/{number:02d}' for number in range(KEYS)]


def test_metadata_that_was_changed_is_found(spooled: Spool) -> None:
    """A checksum that is not the delivered one is found, whatever the content."""
    store = MemoryStore()
    (item,) = deliver(spooled, store, 'bucket', 'a')
    info, body = store._objects[item.bucket, item.key]
    store._objects[item.bucket, item.key] = replace(info, sha256='0' * 64), body
    for deep in (False, True):
        assert kinds(verify(spooled, store, deep=deep)) == {'checksum': [item.key]}
