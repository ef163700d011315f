"""What a disk that hangs or is full, a folder that cannot be made, and a kill cost an event: as little as can be, and counted."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from bags.eventing import Buffer, buffer, in_bag, only_bag, until
from bags.recording import WAIT_S, journaled, manifest, missing
from bags.test_recorder import kill
from clocks import Clocks

from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recording import Recording


class Disk:
    """Takes nothing while it hangs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.works = threading.Event()
        self.works.set()
        write = Recording.write

        def waiting(recording: Recording, batch: MessageBatch) -> None:
            assert self.works.wait(WAIT_S)
            write(recording, batch)

        monkeypatch.setattr(Recording, 'write', waiting)


def test_what_had_to_go_before_it_was_written_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hung disk costs the oldest claimed messages, which are counted; the ring does not exceed its limit."""
    disk = Disk(monkeypatch)
    with buffer(tmp_path, max_bytes=1 << 20) as it:
        disk.works.clear()
        it.hear(range(5), size=50_000)
        it.events.trigger('slow', 'service')
        it.taken()
        for number in range(5, 35):
            it.hear(range(number, number + 1), size=50_000)
        assert it.ring.bytes <= 1 << 20
        disk.works.set()
        it.pass_s(5.0)
        it.written()
        row = it.rows()['/talk']
        assert (row['received'], row['stored'], row['dropped'], row['missed']) == (35, 25, {'ring_full': 10}, 0)
        assert in_bag(it, only_bag(it)) == [*range(5), *range(15, 35)]
        said = manifest(it.objects(), only_bag(it))
        assert missing(said) == journaled(it.spool.root, 'events') == {('/talk', 'ring_full'): 10}


def test_it_takes_from_the_ring_what_it_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no second copy of the ring: what is on its way to the disk is one piece, and the rest still in the ring."""
    disk = Disk(monkeypatch)
    with buffer(tmp_path, max_bytes=16 << 20) as it:
        for number in range(15):
            it.hear(range(number, number + 1), size=1 << 20)
        before = it.ring.bytes
        disk.works.clear()
        it.events.trigger('large', 'service')
        until(lambda: it.ring.bytes < before, 'it begins')
        assert before - it.ring.bytes < 1.1 * (1 << 20)
        disk.works.set()
        it.pass_s(5.0)
        it.written()
        assert len(in_bag(it, only_bag(it))) == 15


def test_a_full_disk_loses_only_the_event(tmp_path: Path) -> None:
    """What it takes nothing of is dropped and counted, and the next event is whole."""
    with buffer(tmp_path) as it:
        it.room[0] = False
        it.hear(range(5))
        it.events.trigger('lost', 'service')
        it.pass_s(5.0)
        it.written()
        assert it.rows()['/talk']['dropped'] == {'no_room': 5}
        it.room[0] = True
        it.hear(range(5, 10))
        it.events.trigger('kept', 'service')
        it.pass_s(5.0)
        it.written(2)
        kept, lost = it.bags()
        assert in_bag(it, kept) == list(range(5, 10))
        assert missing(manifest(it.objects(), lost)) == journaled(it.spool.root, 'events') == {('/talk', 'no_room'): 5}


def test_a_folder_that_cannot_be_made_costs_the_event(tmp_path: Path) -> None:
    """It is tried again until the event is over, then its messages are dropped; nothing stays claimed."""
    with buffer(tmp_path) as it:
        it.root.parent.mkdir(parents=True)
        it.root.write_text('in the way')
        it.hear(range(5))
        it.events.trigger('lost', 'service')
        until(lambda: it.events.status().refused, 'it is refused')
        it.pass_s(5.0)
        until(lambda: not it.events.status().bag, 'the event is over')
        assert it.rows()['/talk']['dropped'] == {'unwritable': 5}
        assert not it.ring.claimed
        it.root.unlink()


def killed(home: Path, it: Buffer) -> Path:
    """What the next start would find had the node been killed now, with the accounts that were committed last."""
    it.rows()
    return kill(home)


def test_the_next_start_completes_a_killed_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What reached the disk is in the event's bag, which says that the rest is missing; the ledger closes."""
    monkeypatch.setattr('shadowhound_data_logger.bags.events.SYNC_S', 3600.0)  # the second trigger syncs
    home = tmp_path / 'home'
    with buffer(home) as it:
        it.hear(range(10), size=2000)
        it.events.trigger('fall', 'service', 'leg 2')
        it.taken()
        it.pass_s(1.0)
        it.events.trigger('low_battery', 'condition')
        until(lambda: any(b'low_battery' in path.read_bytes() for path in it.root.glob('*/*.open')), 'the slice knows of it')
        until(lambda: any(path.stat().st_size > 20_000 for path in it.root.glob('*/*.open')), 'it is synced')
        it.hear(range(10, 15), size=2000)
        it.taken()
        assert it.rows()['/talk']['open'] == 15
        left = killed(home, it)
    clock = Clocks()
    clock.set()
    clock.wait(60.0)
    with buffer(left, clock) as it:
        bag = only_bag(it)
        assert in_bag(it, bag) == list(range(10))
        said = manifest(it.objects(), bag)
        assert said['state'] == 'recovered'
        assert said['missing'][-1]['what'].startswith('messages in memory')
        assert [one['name'] for one in said['event']['triggers']] == ['fall', 'low_battery']
        row = it.rows()['/talk']
        assert (row['received'], row['stored'], row['open'], row['dropped']) == (15, 10, 0, {'restart': 5})
        assert said['missing'][-1]['messages'] is None  # how many is known of all its topics, not of the bag
        assert journaled(it.spool.root, 'events') == {('/talk', 'restart'): 5}
        assert not list(it.root.iterdir())
        it.hear(range(20, 25))
        it.events.trigger('after', 'service')
        it.pass_s(5.0)
        it.written()
        assert it.rows()['/talk']['missed'] == 0
