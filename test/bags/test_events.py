"""The bag of an event has the seconds before and after its trigger, each message once; the ledger lists what it lacks."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
from bags.eventing import Buffer, buffer, hear_each_second, in_bag, only_bag, until
from bags.recording import ROBOT, STRING, WAIT_S, journaled, manifest, messages, missing, mission
from bags.test_recorder import kill
from clocks import Clocks
from spool.making import NOON_NS

from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recording import Recording
from shadowhound_data_logger.core.model import DataObject, RecordingRows
from shadowhound_data_logger.core.options import EventSettings
from shadowhound_data_logger.core.status import EventStatus


def test_an_event_has_the_seconds_before_and_after_its_trigger(tmp_path: Path) -> None:
    """No more and no less; the manifest has the reason, complete and under the event's name."""
    with buffer(tmp_path) as it:
        hear_each_second(it, range(20))
        done, text = it.events.trigger('fall', 'log_event', 'leg 2')
        hear_each_second(it, range(20, 25))
        it.written()
        bag = only_bag(it)
        assert (done, text) == (True, f'{bag} starts')
        assert bag.startswith('event_fall_2025')
        assert in_bag(it, bag) == list(range(15, 23))
        written = manifest(it.objects(), bag)
        assert (written['state'], written['missing'], written['mission'], written['robot']) == ('complete', [], None, ROBOT)
        assert {name: written['event'][name] for name in ('name', 'pre_s', 'held_s', 'post_s')} == {
            'name': 'fall', 'pre_s': 5.0, 'held_s': 5.0, 'post_s': 2.0,
        }  # fmt: skip
        assert [(one['name'], one['by'], one['detail']) for one in written['event']['triggers']] == [
            ('fall', 'log_event', 'leg 2')
        ]
        row = it.rows()['/talk']
        assert (row['received'], row['stored'], row['open'], row['missed'], row['dropped']) == (8, 8, 0, 0, {})
        assert not list(it.root.iterdir())


def test_the_manifest_names_the_requester(tmp_path: Path) -> None:
    """Each trigger has the operator at the page, in addition to its time, if the operator is known."""
    with buffer(tmp_path) as it:
        hear_each_second(it, range(10))
        it.events.trigger('fall', 'page', 'on the stairs', who='operator at 192.0.2.7')
        hear_each_second(it, range(10, 11))
        it.events.trigger('low_battery', 'condition')
        hear_each_second(it, range(11, 15))
        it.written()
        first, second = manifest(it.objects(), only_bag(it))['event']['triggers']
        assert (first['by'], first['who'], second['who']) == ('page', 'operator at 192.0.2.7', None)
        assert first['at_ns'] == NOON_NS


def test_a_delayed_trigger_counts_from_when_it_happened(tmp_path: Path) -> None:
    """An agent's log_event is noticed late: the event's seconds are counted from the call."""
    with buffer(tmp_path) as it:
        hear_each_second(it, range(20))
        it.events.trigger('fall', 'log_event', None, 1.0)
        hear_each_second(it, range(20, 25))
        it.written()
        assert in_bag(it, only_bag(it)) == list(range(14, 22))


def test_triggers_that_overlap_are_one_event(tmp_path: Path) -> None:
    """A trigger within seconds of another one extends the bag, which lists all of them."""
    with buffer(tmp_path) as it:
        hear_each_second(it, range(10))
        it.events.trigger('fall', 'service')
        hear_each_second(it, range(10, 11))
        done, text = it.events.trigger('low_battery', 'condition', 'soc < 20: 19')
        hear_each_second(it, range(11, 15))
        it.written()
        bag = only_bag(it)
        assert (done, text) == (True, f'{bag} is extended')
        assert in_bag(it, bag) == list(range(5, 14))
        event = manifest(it.objects(), bag)['event']
        assert event['name'] == 'fall'
        assert [one['name'] for one in event['triggers']] == ['fall', 'low_battery']
        assert event['triggers'][1]['detail'] == 'soc < 20: 19'


def test_an_event_is_no_longer_than_it_may_be(tmp_path: Path) -> None:
    """Otherwise it would be too long: a second event starts where the first ended, with no message lost or in both."""
    with buffer(tmp_path, max_s=3.0) as it:
        hear_each_second(it, range(10))
        it.events.trigger('fall', 'service')
        hear_each_second(it, range(10, 12))
        done, text = it.events.trigger('again', 'service')
        first = it.events.status().bag
        assert (done, text) == (True, f'another event follows {first}, which has reached its maximum length')
        for second in range(12, 20):
            hear_each_second(it, range(second, second + 1))
            it.written(1)
        it.written(2)
        second_bag = next(bag for bag in it.bags() if bag != first)
        assert second_bag.startswith('event_again_')
        both = in_bag(it, first) + in_bag(it, second_bag)
        assert both == list(range(5, 5 + len(both)))
        assert len(both) > len(in_bag(it, first)) > 5
        assert manifest(it.objects(), second_bag)['event']['held_s'] == 0.0
        assert it.rows()['/talk']['missed'] == 0


def test_an_event_after_another_begins_where_that_ended(tmp_path: Path) -> None:
    """Messages of the first event are not in the second one, even if they are recent; unclaimed messages are not losses."""
    with buffer(tmp_path) as it:
        hear_each_second(it, range(10))
        it.events.trigger('one', 'service')
        hear_each_second(it, range(10, 14))
        it.written()
        it.events.trigger('two', 'service')
        hear_each_second(it, range(14, 18))
        it.written(2)
        it.pass_s(60.0)
        hear_each_second(it, range(100, 110))
        it.events.trigger('three', 'service')
        hear_each_second(it, range(110, 114))
        it.written(3)
        found = {bag.split('_')[1]: in_bag(it, bag) for bag in it.bags()}
        assert found == {'one': list(range(5, 13)), 'two': list(range(13, 17)), 'three': list(range(105, 113))}
        row = it.rows()['/talk']
        assert (row['published'], row['received'], row['missed']) == (20, 20, 0)


def test_a_gap_within_an_event_is_missed(tmp_path: Path) -> None:
    """As in other accounts, numbers that never arrived are reported as missed."""
    with buffer(tmp_path) as it:
        it.hear(range(5))
        it.hear(range(7, 10))
        it.hear(range(3), '/echo')
        it.events.trigger('gap', 'service')
        it.pass_s(5.0)
        it.written()
        row = it.rows()['/talk']
        assert (row['published'], row['received'], row['missed_by']) == (10, 8, {'transport': 2})
        assert it.rows()['/echo']['missed'] == 0


def test_repeats_are_in_an_event_once(tmp_path: Path) -> None:
    """A message delivered by two subscriptions is there once."""
    with buffer(tmp_path) as it:
        it.hear(range(5))
        it.hear(range(3, 8))
        it.events.trigger('again', 'service')
        it.pass_s(5.0)
        it.written()
        assert in_bag(it, only_bag(it)) == list(range(8))


def test_latched_messages_are_in_each_event(tmp_path: Path) -> None:
    """It arrived long before; each time it counts as received, and none of it is missed."""
    with buffer(tmp_path) as it:
        it.ring.put(MessageBatch('/tf_static', STRING, '', messages(range(40, 42)), 1), None, it.now_s[0])
        it.pass_s(60.0)
        for number, name in enumerate(('one', 'two'), 1):
            it.hear(range(number, number + 1))
            it.events.trigger(name, 'service')
            it.pass_s(5.0)
            it.written(number)
        assert [in_bag(it, bag) for bag in it.bags()] == [[41, 1], [41, 2]]
        row = it.rows()['/tf_static']
        assert (row['received'], row['stored'], row['missed'], row['published']) == (2, 2, 0, 2)


def test_an_event_is_uploaded_first_and_never_evicted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its slices are sent before the sensors' objects, and stay when the disk is full."""
    with buffer(tmp_path) as it:
        given: list[DataObject] = []
        put = it.writer.put

        def noting(*items: DataObject, rows: Sequence[RecordingRows] = (), wait: bool = True) -> None:
            given.extend(items)
            put(*items, rows=rows, wait=wait)

        monkeypatch.setattr(it.writer, 'put', noting)
        it.hear(range(5))
        it.events.trigger('fall', 'service')
        it.pass_s(5.0)
        it.written()
        assert [(item.priority, item.protected) for item in given] == [(1, True)] * 3
        assert {item.metadata['event'] for item in given} == {'fall'}


def test_the_manifest_names_the_mission(tmp_path: Path) -> None:
    """With the run's id, though it became known later."""
    with buffer(tmp_path) as it:
        it.events.on_mission(mission())
        it.hear(range(5))
        it.events.trigger('fall', 'service')
        it.taken()
        it.events.on_mission(mission(run_id='r1'))
        it.pass_s(5.0)
        it.written()
        assert manifest(it.objects(), only_bag(it))['mission'] == {'type': 'patrol', 'mission_id': 'patrol_1', 'run_id': 'r1'}


@pytest.mark.parametrize('name', ['../../etc', 'über den Berg', '', 'x' * 300])
def test_a_name_that_cannot_be_in_a_key_is_replaced(tmp_path: Path, name: str) -> None:
    """An agent may use any name; the manifest has the original."""
    with buffer(tmp_path) as it:
        it.hear(range(2))
        it.events.trigger(name or '?', 'log_event')
        it.pass_s(5.0)
        it.written()
        bag = only_bag(it)
        assert bag.isascii()
        assert '/' not in bag
        assert manifest(it.objects(), bag)['event']['triggers'][0]['name'] == (name or '?')


def test_an_empty_ring_makes_no_bag(tmp_path: Path) -> None:
    """A trigger before the first message leaves no file if no message arrives."""
    with buffer(tmp_path) as it:
        it.events.trigger('early', 'service')
        it.pass_s(5.0)
        it.written()
        assert it.objects() == {}
        assert not list(it.root.iterdir())


def test_a_close_ends_the_event(tmp_path: Path) -> None:
    """With the contents of the ring; later triggers have no effect."""
    with buffer(tmp_path) as it:
        it.hear(range(5))
        it.events.trigger('fall', 'service')
        it.hear(range(5, 8))
        assert it.events.close(WAIT_S)
        assert in_bag(it, only_bag(it)) == list(range(8))
        assert it.events.trigger('late', 'service') == (False, 'no event can start: the node is shutting down')


def test_without_topics_no_event_is_recorded(tmp_path: Path) -> None:
    """There is no thread and no ring, and a trigger returns the reason."""
    with buffer(tmp_path, topics=('',)) as it:
        assert list(it.events.workers) == []
        assert it.events.status() == EventStatus(enabled=False)
        assert it.events.trigger('x', 'service') == (
            False, 'no events: neither events.topics nor events.regex names a topic to keep'
        )  # fmt: skip


def test_changed_settings_apply_immediately(tmp_path: Path) -> None:
    """Those that can be changed at run time: time before, time after, and bytes."""
    with buffer(tmp_path) as it:
        it.events.update(EventSettings(topics=('/talk',), pre_s=2.0, post_s=1.0, max_s=10.0, max_bytes=2 << 20))
        hear_each_second(it, range(10))
        it.events.trigger('fall', 'service')
        hear_each_second(it, range(10, 15))
        it.written()
        assert in_bag(it, only_bag(it)) == list(range(8, 12))
        assert it.events.status().max_bytes == 2 << 20


class Disk:
    """Accepts no data while it hangs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.works = threading.Event()
        self.works.set()
        write = Recording.write

        def waiting(recording: Recording, batch: MessageBatch) -> None:
            assert self.works.wait(WAIT_S)
            write(recording, batch)

        monkeypatch.setattr(Recording, 'write', waiting)


def test_messages_evicted_from_the_ring_before_they_were_written_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        written = manifest(it.objects(), only_bag(it))
        assert missing(written) == journaled(it.spool.root, 'events') == {('/talk', 'ring_full'): 10}


def test_written_messages_leave_the_ring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no second copy of the ring: one piece is being written, and the rest is still in the ring."""
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
    """Messages that it does not accept are dropped and counted, and the next event is complete."""
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


def test_a_folder_that_cannot_be_created_costs_only_the_event(tmp_path: Path) -> None:
    """It is retried until the event is over, then its messages are dropped; none stays claimed."""
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
    """The state that the next start would find after a kill now, with the last committed accounts."""
    it.rows()
    return kill(home)


def test_the_next_start_completes_a_killed_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Data that reached the disk is in the event's bag, with a note that the rest is missing; the ledger balances."""
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
        written = manifest(it.objects(), bag)
        assert written['state'] == 'recovered'
        assert written['missing'][-1]['what'].startswith('messages in memory')
        assert [one['name'] for one in written['event']['triggers']] == ['fall', 'low_battery']
        row = it.rows()['/talk']
        assert (row['received'], row['stored'], row['open'], row['dropped']) == (15, 10, 0, {'restart': 5})
        assert written['missing'][-1]['messages'] is None  # the number is known for all its topics, not for the bag
        assert journaled(it.spool.root, 'events') == {('/talk', 'restart'): 5}
        assert not list(it.root.iterdir())
        it.hear(range(20, 25))
        it.events.trigger('after', 'service')
        it.pass_s(5.0)
        it.written()
        assert it.rows()['/talk']['missed'] == 0
