"""The store for tests fails exactly when it is told to."""

from __future__ import annotations

import pytest
from stores.memory import MemoryStore
from stores.spooled import Spool

from shadowhound_data_logger.core.errors import StoreUnavailable
from shadowhound_data_logger.core.model import Put


def test_it_fails_on_request_and_recovers(spool: Spool, bucket: str) -> None:
    """The hook sees the item of a put and None for a probe; nothing is stored by a put that failed."""
    away = StoreUnavailable('away')
    store = MemoryStore(fail=lambda item: away if item is None or item.key == 'a' else None)
    with pytest.raises(StoreUnavailable):
        store.probe()
    with pytest.raises(StoreUnavailable):
        store.put(spool('a', b'x'))
    assert store.put(spool('b', b'x')) is Put.CREATED
    assert [info.key for info in store.list(bucket)] == ['b']
    store.fail = None
    store.probe()
    assert store.put(spool('a', b'x')) is Put.CREATED
