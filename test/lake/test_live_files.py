"""Whenever a folder is listed, whatever compactions were at work or died: each row is read from exactly one file."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.lake.live_files import Day, compacted_key, folder_of, is_compacted, live_files, name_of

NOW = datetime(2026, 10, 28, tzinfo=timezone.utc)
ROBOT, DATE = 'thor', '2026-10-27'
STEP = st.sampled_from(['part', 'begin', 'part', 'begin', 'wait', 0, 0, 1, -1, -9])
STEPS = st.lists(STEP, min_size=20, max_size=60)
"""0 and 1 end a compaction that is under way, negative numbers delete so many files."""


class Folder:
    """A model: what lies in it, which rows each file holds, and compactions that are under way."""

    def __init__(self) -> None:
        self.files: dict[str, datetime] = {}
        self.sources: dict[str, frozenset[str]] = {}
        self.written = 0
        self.now = NOW
        self.under_way: list[tuple[datetime, frozenset[str]]] = []

    def look(self) -> list[str]:
        """What a reader reads, as names of parts that robots wrote."""
        day = self.live_files()
        return sorted(source for entry in day.entries for source in self.sources.get(entry.key, {name_of(entry.key)}))

    def live_files(self) -> Day:
        return live_files(ROBOT, DATE, self.entries(), {key: self.sources[key] for key in self.files if is_compacted(key)})

    def entries(self) -> list[ObjectInfo]:
        return [ObjectInfo('sensor-data', key, 1, None, modified=modified) for key, modified in self.files.items()]

    def part(self) -> None:
        self.files[f'{folder_of(ROBOT, DATE)}thor_{self.written:04d}.parquet'] = self.now
        self.written += 1

    def begin(self) -> None:
        day = self.live_files()
        sources = frozenset(source for entry in day.entries for source in self.sources.get(entry.key, {name_of(entry.key)}))
        self.under_way.append((self.now, sources))

    def end(self, number: int) -> None:
        """The put of a compaction; it gives up after half the grace."""
        if number < len(self.under_way):
            begun, sources = self.under_way.pop(number)
            if sources and self.now - begun < timedelta(minutes=30):
                key = compacted_key(ROBOT, DATE, sources, is_backfilled=False)
                self.files.setdefault(key, self.now)
                self.sources[key] = sources

    def delete(self, most: int) -> None:
        """Delete some of the superseded files, in any order, then die."""
        day = self.live_files()
        if all(self.now - entry.modified >= timedelta(hours=1) for entry in day.entries if is_compacted(entry.key)):
            for entry in day.superseded[:most]:
                del self.files[entry.key]


@settings(deadline=None)
@given(STEPS)
def test_each_row_is_read_once_at_every_moment(steps: list[str | int]) -> None:
    """Parts come, compactions begin, end, die and overlap, superseded files are deleted: a reader sees all rows once."""
    folder = Folder()
    for step in steps:
        if step == 'part':
            folder.part()
        elif step == 'begin':
            folder.begin()
        elif step == 'wait':
            folder.now += timedelta(minutes=20)
        elif isinstance(step, int) and step >= 0:
            folder.end(step)
        elif isinstance(step, int):
            folder.delete(-step)
        assert folder.look() == [f'thor_{number:04d}.parquet' for number in range(folder.written)]


def test_a_part_that_comes_again_after_its_deletion_is_not_read_again() -> None:
    """A robot whose power went may put again what was delivered; the compacted part knows that it stands for it."""
    folder = Folder()
    for _ in range(3):
        folder.part()
    parts = dict(folder.files)
    folder.begin()
    folder.end(0)
    folder.now += timedelta(hours=2)
    folder.delete(9)
    assert len(folder.files) == 1
    folder.files |= parts
    assert folder.look() == [name_of(key) for key in parts]


def test_what_cannot_be_is_said_instead_of_losing_rows() -> None:
    """Two that overlap, and what only one of them has is gone: an error names the file and what to do."""
    keys = [compacted_key(ROBOT, DATE, names, is_backfilled=False) for names in ('abc', 'bcde')]
    entries = [ObjectInfo('sensor-data', key, 1, None, modified=NOW) for key in keys]
    sources = {keys[0]: frozenset('abc'), keys[1]: frozenset('bcde')}
    with pytest.raises(LakeError, match='contradict') as caught:
        live_files(ROBOT, DATE, entries, sources)
    assert caught.value.data['key'] == keys[0]
    assert 'reindex' in caught.value.remedy


def test_the_same_parts_make_the_same_name() -> None:
    """Two who compact the same write one object; others do not collide."""
    assert compacted_key(ROBOT, DATE, ['a', 'b'], is_backfilled=False) == compacted_key(
        ROBOT, DATE, ['b', 'a'], is_backfilled=False
    )
    assert compacted_key(ROBOT, DATE, ['a', 'b'], is_backfilled=False) != compacted_key(
        ROBOT, DATE, ['a', 'c'], is_backfilled=False
    )
