"""A disk that takes nothing costs what comes meanwhile, with a reason, and the bag goes on as soon as it takes something."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

import pytest
from bags.recording import ROBOT, Desk, desk, manifest, numbers, start, write_out

from shadowhound_data_logger.bags.slice_writer import SliceWriter
from shadowhound_data_logger.spool import ledger


def test_a_disk_without_room_costs_what_comes_meanwhile(tmp_path: Path) -> None:
    """The slice is closed and spooled, what comes is dropped as no_room, and the recording goes on once there is room."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        it.hear(range(5))
        write_out(it)
        it.room[0] = False
        write_out(it)
        assert it.recorder.status().refused == 'no_room'
        it.hear(range(5, 10))
        it.room[0] = True
        _retry(it)
        it.hear(range(10, 15))
        it.recorder.stop()
        found = it.objects()
        assert [numbers(found[f'{name}/{name}_{number}.mcap']) for number in range(2)] == [[*range(5)], [*range(10, 15)]]
        assert it.row()['dropped'] == {'no_room': 5}


def _retry(it: Desk) -> None:
    """As if the time until the next try were over, after all that waits."""
    done = threading.Event()

    def again() -> None:
        assert it.recorder._writing is not None
        it.recorder._writing._again_s = 0.0
        done.set()

    it.queue.mark(again)
    assert done.wait(10.0)


@pytest.mark.parametrize('where', ['write', 'sync', 'close'])
def test_a_disk_that_refuses_costs_what_it_did_not_take(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """The broken slice is saved as far as it goes, the rest is dropped as unwritable, and the bag goes on."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        it.hear(range(5))
        write_out(it)

        def refuse(*_: object) -> None:
            raise OSError(28, 'No space left on device')

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
        assert set(row['dropped']) == {'unwritable'}
        assert kept[:5] + kept[-5:] == [*range(5), *range(15, 20)]
        said = manifest(found, name)
        assert said['state'] == ('gaps' if said['missing'] else 'complete')
        assert sum(each['messages'] for each in said['missing']) == 20 - len(kept)
        assert all((each['topic'], each['reason']) == ('/talk', 'unwritable') for each in said['missing'])
        assert ledger.imbalances(ledger.read(it.spool.root, ROBOT)) == []


def test_what_did_not_get_in_is_in_the_manifest(tmp_path: Path) -> None:
    """A bag that ended by itself without some messages has gaps, by topic and reason, as in the ledger; the next has none."""
    with desk(tmp_path, queue_bytes=100) as it:
        name = start(it.recorder)
        it.hear(range(2))
        write_out(it)
        it.hear(range(2, 4), '/large', size=200)
        it.queue.leave_out('/talk', 'paused', 3)
        it.room[0] = False
        write_out(it)
        it.hear(range(5, 7))
        write_out(it)
        it.recorder.stop()
        said = manifest(it.objects(), name)
        found = Counter({(each['topic'], each['reason']): each['messages'] for each in said['missing']})
        assert (said['state'], len(found)) == ('gaps', len(said['missing']))
        assert found == {('/large', 'queue_full'): 2, ('/talk', 'paused'): 3, ('/talk', 'no_room'): 2}
        assert it.row()['dropped'] == {'no_room': 2}
        assert it.row('/large')['dropped'] == {'queue_full': 2}
        it.room[0] = True
        name = start(it.recorder)
        it.hear(range(7, 9))
        it.recorder.stop()
        said = manifest(it.objects(), name)
        assert (said['state'], said['missing']) == ('complete', [])
