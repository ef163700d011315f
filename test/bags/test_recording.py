"""A disk that accepts no writes costs the messages of that time, with a reason; then the bag continues."""

from __future__ import annotations

import errno
import os
import threading
from collections import Counter
from pathlib import Path

import pytest
from bags.recording import ROBOT, Desk, desk, journaled, manifest, missing, numbers, start, write_out
from clocks import Clocks
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.naming import BUCKET
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool import ledger


def fill_disk(it: Desk) -> str:
    """Record five messages, then fill the disk; returns the bag's name."""
    name = start(it.recorder)
    it.hear(range(5))
    write_out(it)
    it.room[0] = False
    write_out(it)
    return name


def test_a_full_disk_loses_only_messages_of_that_time(tmp_path: Path) -> None:
    """The slice is closed and spooled, messages are dropped as no_room, and the recording continues once there is room."""
    with desk(tmp_path) as it:
        name = fill_disk(it)
        assert it.recorder.status().refused == 'no_room'
        it.hear(range(5, 10))
        it.room[0] = True
        _retry(it)
        it.hear(range(10, 15))
        it.recorder.stop()
        found = it.objects()
        assert [numbers(found[f'{name}/{name}_{number}.mcap']) for number in range(2)] == [[*range(5)], [*range(10, 15)]]
        assert it.row()['dropped'] == {'no_room': 5}


@pytest.mark.long('a second of CPU or more')
def test_manifest_and_gap_parts_agree(tmp_path: Path) -> None:
    """Messages dropped because of a full disk: the same counts by topic and reason in both."""
    with desk(tmp_path) as it:
        name = fill_disk(it)
        it.hear(range(5, 10))
        it.hear(range(3), topic='/other')
        it.room[0] = True
        _retry(it)
        it.hear(range(10, 20))
        it.recorder.stop()
        it.row()
        bag = manifest(it.objects(), name)
        report = Counter[tuple[str, str]]()
        for part in CatalogWriter(it.spool.root, CatalogSettings(), ROBOT, Clocks()).parts():
            assert isinstance(part.body, bytes)
            for row in read_rows(part.body, part.key.partition('/')[0]).rows['_gaps'] if '/_gaps/' in part.key else ():
                if row['what'] == 'gap':
                    assert (row['sink'], row['kind']) == ('bags', 'dropped')
                    report[row['topic'], row['cause']] += row['count']
        assert report == missing(bag) == {('/talk', 'no_room'): 5, ('/other', 'no_room'): 3}


def _retry(it: Desk) -> None:
    """As if the time until the next try had passed, after everything pending."""
    done = threading.Event()

    def again() -> None:
        assert it.recorder._writing is not None
        it.recorder._writing._retry_at_s = 0.0
        done.set()

    it.queue.mark(again)
    assert done.wait(60)


@pytest.mark.parametrize(('where', 'number', 'reason'), [
    ('write', errno.ENOSPC, 'no_room'), ('sync', errno.EIO, 'unwritable'), ('sync', errno.EDQUOT, 'no_room'),
    ('close', errno.EROFS, 'unwritable'),
])  # fmt: skip
def test_a_disk_that_fails_costs_only_the_messages_it_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, number: int, reason: str
) -> None:
    """The intact part of the slice is kept, the rest is dropped with the disk's reason, and the bag continues."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        it.hear(range(5))
        write_out(it)

        def refuse(*_: object) -> None:
            raise OSError(number, os.strerror(number))

        with monkeypatch.context() as broken:
            broken.setattr(SliceWriter, where, refuse)
            it.hear(range(5, 10))
            write_out(it)
            if where == 'close':
                it.recorder.split()
            it.hear(range(10, 15))
            _retry(it)
        it.hear(range(15, 20))
        it.recorder.stop()
        found = it.objects()
        kept = [each for number in range(2) for each in numbers(found[f'{name}/{name}_{number}.mcap'])]
        row = it.row()
        assert (row['received'], row['stored'], row['open']) == (20, len(kept), 0)
        assert set(row['dropped']) == {reason}
        assert kept[:5] + kept[-5:] == [*range(5), *range(15, 20)]
        written = manifest(found, name)
        assert written['state'] == ('gaps' if written['missing'] else 'complete')
        assert sum(each['messages'] for each in written['missing']) == 20 - len(kept)
        assert all((each['topic'], each['reason']) == ('/talk', reason) for each in written['missing'])
        assert journaled(it.spool.root, 'bags') == missing(written)
        assert ledger.imbalances(ledger.read(it.spool.root, ROBOT)) == []


def test_the_manifest_lists_the_messages_that_were_not_recorded(tmp_path: Path) -> None:
    """A bag that ended normally without some messages has gaps, by topic and reason, as in the ledger; the next has none."""
    with desk(tmp_path, queue_bytes=100) as it:
        name = start(it.recorder)
        it.hear(range(2))
        write_out(it)
        it.hear(range(2, 4), '/large', size=200)
        it.queue.count_dropped('/talk', 'paused', 3)
        it.room[0] = False
        write_out(it)
        it.hear(range(5, 7))
        write_out(it)
        it.recorder.stop()
        written = manifest(it.objects(), name)
        found = Counter({(each['topic'], each['reason']): each['messages'] for each in written['missing']})
        assert (written['state'], len(found)) == ('gaps', len(written['missing']))
        assert found == {('/large', 'queue_full'): 2, ('/talk', 'paused'): 3, ('/talk', 'no_room'): 2}
        assert it.row()['dropped'] == {'no_room': 2}
        assert it.row('/large')['dropped'] == {'queue_full': 2}
        it.room[0] = True
        name = start(it.recorder)
        it.hear(range(7, 9))
        it.recorder.stop()
        written = manifest(it.objects(), name)
        assert (written['state'], written['missing']) == ('complete', [])


def test_the_manifest_lists_the_slices_that_a_full_spool_evicted(tmp_path: Path) -> None:
    """They are listed as missing, with messages and reason, and not among the slices, so no reader waits for them."""
    with desk(tmp_path, slice_bytes=1 << 20, spool={'max_bytes': 4 << 20}) as it:
        name = start(it.recorder)
        for first in range(0, 80, 10):
            it.hear(range(first, first + 10), size=100_000)
            write_out(it)
        it.recorder.stop()
        found = it.objects()
        written = manifest(found, name)
        lost = {each['file']: (each['messages'], each['topic'], each['reason']) for each in written['missing']}
        kept = {each['file'] for each in written['slices']}
        assert lost
        assert f'{name}_0.mcap' in lost
        assert kept == {key.partition('/')[2] for key in found if key.endswith('.mcap')}
        assert not kept & lost.keys()
        assert {(topic, reason) for _, topic, reason in lost.values()} == {(None, 'no_room')}
        assert sum(each['messages'] for each in written['slices']) + sum(count for count, *_ in lost.values()) == 80
        assert written['state'] == 'gaps'
        assert f'{name}_0.mcap' not in found[f'{name}/metadata.yaml'].read_text()
        row = it.row()
        assert (row['stored'], row['stored_in']['evicted']) == (80, sum(count for count, *_ in lost.values()))


def test_slices_evicted_after_the_end_are_reported_on_the_robot(tmp_path: Path) -> None:
    """Their manifest was already written: the list has the reason for their absence."""
    with desk(tmp_path, slice_bytes=1 << 20, spool={'max_bytes': 4 << 20}) as it:
        start(it.recorder)
        it.hear(range(20), size=100_000)
        it.recorder.stop()
        (row,) = bag_overview(MemoryStore(), ROBOT, it.home)
        assert (row.state, row.finding) == ('complete', '')
        more = DataObject(bucket=BUCKET, key='more', body=bytes(3 << 20), content_type='', sensor='imu', topic=None, type='',
                          samples=0, t_start_ns=0, t_end_ns=0, priority=1)  # fmt: skip
        it.spool.commit([more])
        (row,) = bag_overview(MemoryStore(), ROBOT, it.home)
        assert row.state == 'growing'
        assert row.finding == '1 of 1 slices are not available; the full spool of this machine evicted 1'
