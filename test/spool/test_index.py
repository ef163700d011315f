"""The index: the cost of a query over a long backlog, and recordings."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from spool.conftest import Open
from spool.making import NOON_NS, FakeClock, make

from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import MissingRow, RecordingRows, SliceRow, State
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.recording_table import RecordingTable
from shadowhound_data_logger.spool.spool import Spool

FEW, MANY = 300, 15_000
STEP = 20


@pytest.fixture
def index(tmp_path: Path) -> Iterator[Index]:
    """An empty index."""
    opened = Index(tmp_path / 'index.db')
    opened.open()
    yield opened
    opened.close()


def add(index: Index, numbers: range, bucket: str) -> None:
    with index.transaction():
        for number in numbers:
            item = make(f'{number}', bucket=bucket, priority=number % 9)
            index.states.insert(item, item.key, '0' * 64, State.PENDING, None, {}, NOON_NS + number)


def work(index: Index, *, oldest: bool, without: tuple[str, ...]) -> int:
    """SQLite virtual machine steps of one query: its cost, independent of the load of the computer."""
    steps = 0

    def count() -> int:
        nonlocal steps
        steps += STEP
        return 0

    index._db.set_progress_handler(count, STEP)
    found = index.objects.pending(40, oldest=oldest, without=without)
    index._db.set_progress_handler(None, STEP)
    assert len(found) == (20 if without else 40)
    return steps


@pytest.mark.long('a second of CPU or more')
def test_a_query_costs_the_same_whatever_the_backlog(index: Index) -> None:
    """In both orders, also while the bucket of the backlog accepts nothing."""
    add(index, range(20), 'b')
    add(index, range(FEW), 'a')
    ways = [{'oldest': oldest, 'without': without} for oldest in (False, True) for without in ((), ('a',))]
    few = [work(index, **way) for way in ways]
    add(index, range(FEW, MANY), 'a')
    for way, before in zip(ways, few, strict=True):
        assert work(index, **way) < 1.2 * before, way


@pytest.mark.parametrize('oldest', [False, True])
def test_the_order_holds_across_buckets(index: Index, oldest: bool) -> None:
    """Objects of several buckets are ordered as if they were in one."""
    for place in range(30):
        add(index, range(place, place + 1), 'abc'[place % 3])
    found = [(row['priority'], row['id']) for row in index.objects.pending(20, oldest=oldest, without=('c',))]
    expected = [(place % 9, place + 1) for place in range(30) if place % 3 != 2]
    assert found == (expected if oldest else sorted(expected))[:20]
    assert index.objects.oldest_pending_ns() == NOON_NS


SLICE = SliceRow(0, 10, 'ab', 1, 2, 3, '[3]')
MISSING = MissingRow(0, 'b_0.mcap', 'why', None, None, None)


def test_recordings_are_kept_by_owner(root: Path) -> None:
    """A duplicate is stored once; the end of one bag does not affect other bags, of this owner or of another."""
    node, by_hand = (Spool(root, SpoolSettings(min_free_bytes=0), FakeClock(), owner) for owner in ('thor', 'thor records'))
    node.open()
    by_hand.open()
    one = RecordingRows('a', '{}', '[]', (SLICE,), (MISSING,))
    node.commit(rows=[RecordingRows('a', '{}', '[]'), one, one, replace(one, folder='b')])
    by_hand.commit(rows=[replace(one, facts='{"by": "hand"}')])
    node.commit(rows=[RecordingRows('b', is_whole=True)])
    assert node.reading.recordings.rows(node.robot) == [one]
    assert by_hand.reading.recordings.rows(by_hand.robot) == [replace(one, facts='{"by": "hand"}')]
    node.commit(rows=[RecordingRows('a', is_whole=True)])
    assert (node.reading.recordings.rows(node.robot), len(by_hand.reading.recordings.rows(by_hand.robot))) == ([], 1)
    node.close()
    by_hand.close()


def test_a_slice_and_its_row_are_one_transaction(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """If one cannot be written, the other is not written either."""
    spool = opened()
    with monkeypatch.context() as patch:
        patch.setattr(RecordingTable, 'write', Mock(side_effect=sqlite3.OperationalError('disk I/O error')))
        with pytest.raises(sqlite3.OperationalError):
            spool.commit([make('one')], rows=[RecordingRows('a', '{}', '[]', (SLICE,))])
    assert (spool.pending(1), spool.reading.recordings.rows('thor')) == ([], [])
    spool.commit([make('one')], rows=[RecordingRows('a', '{}', '[]', (SLICE,))])
    assert (len(spool.pending(1)), len(spool.reading.recordings.rows('thor'))) == (1, 1)
