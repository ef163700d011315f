"""Consecutive equal content: stored once, counted each time, and found again."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import BUCKET, NOON_NS, assert_whole, files, make, put, receive, rows, settle, uncataloged

from shadowhound_data_logger.core.metadata_keys import CONTENT_KEY
from shadowhound_data_logger.core.model import DataObject, State
from shadowhound_data_logger.spool.spool import Spool


def picture(second: int, body: bytes = b'the same', **fields: object) -> DataObject:
    """What a camera with ``dedup`` captures in a second."""
    at_ns = NOON_NS + second * 1_000_000_000
    given = {'dedup': True, 't_start_ns': at_ns, 't_end_ns': at_ns, **fields}
    return make(f'thor/camera/20251018/1200{second:02d}_front.jpg', body, **given)


def test_the_same_image_is_stored_once(spool: Spool, root: Path) -> None:
    """In one commit or in several; each is in the ledger, and names the key that holds it."""
    put(spool, picture(0), picture(1))
    assert put(spool, picture(2)) == []
    assert list(files(root)) == [f'ready/{BUCKET}/thor/camera/20251018/120000_front.jpg']
    first, *repeats = rows(root)
    assert [row['state'] for row in repeats] == ['deduplicated', 'deduplicated']
    assert all(f'"{CONTENT_KEY}": "{first["key"]}"' in row['metadata'] for row in repeats)
    found = assert_whole(root)
    assert found['objects'] == {**found['objects'], 'spooled': 3, 'pending': 1, 'deduplicated': 2}
    assert found['topics']['/camera']['stored'] == 3
    assert all(row['settled_ns'] for row in repeats), 'they are forgotten eventually'


def test_the_next_image_reports_the_repeats(spool: Spool) -> None:
    """A delivered object cannot be changed: the first object with different content has the count, the key and the end."""
    put(spool, picture(0))
    put(spool, picture(1), picture(2))
    (item,) = put(spool, picture(3, b'another'))
    fields = {name: value for name, value in item.metadata.items() if name.startswith('repeats')}
    assert fields == {'repeats': '2', 'repeats_of': picture(0).key, 'repeats_until_ns': str(picture(2).t_end_ns)}
    (item,) = put(spool, picture(4, b'a third'))
    assert not any(name.startswith('repeats') for name in item.metadata)


def test_only_consecutive_equal_content_is_a_repeat(spool: Spool) -> None:
    """An image that appears again later, from another sensor, topic or bucket, or without the setting, is stored."""
    put(spool, picture(0))
    assert len(put(spool, picture(1, b'another'), picture(2))) == 2
    others = [
        picture(3, sensor='rear'), picture(4, topic='/rear'), picture(5, bucket='trajectories'), picture(6, dedup=False),
    ]  # fmt: skip
    assert len(put(spool, *others)) == 4
    assert put(spool, picture(7)) == []


def test_delivered_content_counts_and_lost_content_does_not(opened: Open, root: Path) -> None:
    """A repeat of an evicted or quarantined object is stored: no other object has its content."""
    spool = opened()
    (item,) = put(spool, picture(0))
    settle(spool, item, State.DELIVERED)
    assert put(spool, picture(1)) == []
    (item,) = put(spool, picture(2, b'new'))
    settle(spool, item, State.QUARANTINED, 'refused')
    assert len(put(spool, picture(3, b'new'))) == 1
    assert_whole(root)


def test_an_object_without_a_date_is_not_a_repeat(spool: Spool) -> None:
    """Its key is provisional, so nothing can refer to it."""
    put(spool, picture(0, held='clock'), picture(1, held='clock'))
    assert len(spool.reading.objects.held('clock')) == 2
    assert len(put(spool, picture(2))) == 1


def test_a_failed_commit_does_not_count_as_stored_content(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When retried, the same objects have the same result."""
    receive(spool, 3)
    group = [picture(0), picture(1), picture(2, b'new')]
    with monkeypatch.context() as broken:
        broken.setattr(spool._tree, 'sync_incoming', lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            spool.commit(group)
    _, new = spool.commit(group)
    assert new.metadata['repeats'] == '1'
    assert [row['state'] for row in rows(root)] == ['pending', 'deduplicated', 'pending']
    assert_whole(root)


def test_an_object_with_repeats_is_never_evicted(opened: Open, root: Path) -> None:
    """An outage that fills the spool evicts objects without repeats first."""
    spool = opened(max_bytes=100_000)
    put(spool, picture(0, bytes(20_000)), picture(1, bytes(20_000)))
    for second in range(2, 12):
        put(spool, picture(second, bytes([second]) * 20_000))
    found = {row['key'][-12:-10]: row['state'] for row in rows(root)}
    assert (found['00'], found['01']) == ('pending', 'deduplicated')
    assert 'evicted' in found.values()
    assert_whole(root)


def test_a_restart_stores_the_image_again(opened: Open, root: Path) -> None:
    """Content stored by another process is unknown: one extra object, and none is lost."""
    spool = opened()
    put(spool, picture(0))
    spool.close()
    assert len(put(opened(), picture(1))) == 1
    assert_whole(root)


def test_the_catalog_has_a_row_for_each_repeat(spool: Spool, root: Path) -> None:
    """With its time and the key of its content, so that a query by time finds the image."""
    (item,) = put(spool, picture(0))
    put(spool, picture(1))
    settle(spool, item, State.DELIVERED)
    found = uncataloged(root, 9)
    assert [each.key for each in found] == [item.key, item.key]
    assert [each.metadata['t_start_ns'] for each in found] == [str(picture(0).t_start_ns), str(picture(1).t_start_ns)]


def test_a_repeat_cannot_be_requested(spool: Spool, root: Path) -> None:
    """``verify`` checks that delivered objects are in the store, and a repeat was never delivered."""
    (item,) = put(spool, picture(0))
    put(spool, picture(1))
    settle(spool, item, State.DELIVERED)
    with sqlite3.connect(root / 'index.db') as index:
        assert index.execute("SELECT count(*) FROM objects WHERE state = 'delivered'").fetchone() == (1,)
    assert spool.pending(9) == []
