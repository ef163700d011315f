"""Bags start and end on request, and every received message is in one of them, or the ledger has the reason."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from bags.eventing import until
from bags.recording import ROBOT, STRING, Desk, batch, desk, journaled, manifest, mission, numbers, start, write_out
from clocks import Clocks
from mcap.reader import make_reader

from shadowhound_data_logger.bags.recording import Recording
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core.model import Outcome, State


def test_a_bag_is_recorded_from_start_to_stop(tmp_path: Path) -> None:
    """Its slices, metadata and manifest are in the spool under the bag's name, its folder is gone, the accounts are closed."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        it.hear(range(1, 11))
        assert it.recorder.split()[0]
        it.hear(range(11, 16))
        assert it.recorder.stop() == (True, f'{name}: 15 messages in 2 slices')
        found = it.objects()
        assert sorted(found) == [
            f'{name}/{file}' for file in ('manifest.json', 'metadata.yaml', f'{name}_0.mcap', f'{name}_1.mcap')
        ]
        assert numbers(found[f'{name}/{name}_0.mcap']) + numbers(found[f'{name}/{name}_1.mcap']) == list(range(1, 16))
        written = manifest(found, name)
        assert (written['state'], written['missing'], written['mission'], written['robot']) == ('complete', [], None, ROBOT)
        assert [entry['messages'] for entry in written['slices']] == [10, 5]
        assert (it.row()['stored'], it.row()['open'], it.row()['stored_in']['pending']) == (15, 0, 15)
        assert it.listening == [True, False]
        assert not list(it.root.iterdir())


def test_both_stamps_and_the_number_are_kept(tmp_path: Path) -> None:
    """Log time is the arrival, publish time the time of sending, sequence the publisher's number."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        it.hear(range(7, 8))
        it.recorder.stop()
        with it.objects()[f'{name}/{name}_0.mcap'].open('rb') as file:
            ((schema, channel, message),) = make_reader(file).iter_messages()
        (sent,) = batch(range(7, 8)).messages
        assert (message.log_time, message.publish_time, message.sequence) == (sent.received_ns, sent.source_ns, 7)
        assert (channel.topic, message.data) == ('/talk', sent.cdr)
        assert schema is not None
        assert schema.name == STRING


def test_messages_without_a_number_get_their_position_in_the_bag(tmp_path: Path) -> None:
    """From 1 for each topic, in any drain and in any slice: no sequence number repeats."""
    with desk(tmp_path) as it:
        name = start(it.recorder)
        for numbers in (range(1, 6), range(6, 8)):
            it.hear(numbers, numbered=False)
            it.hear(numbers, '/other', numbered=False)
        assert it.recorder.split()[0]
        it.hear(range(8, 11), numbered=False)
        it.recorder.stop()
        found: dict[str, list[int]] = {'/talk': [], '/other': []}
        for slice_number in (0, 1):
            with it.objects()[f'{name}/{name}_{slice_number}.mcap'].open('rb') as file:
                for _, channel, message in make_reader(file).iter_messages():
                    found[channel.topic].append(message.sequence)
        assert found == {'/talk': list(range(1, 11)), '/other': list(range(1, 8))}


def test_requests_in_the_wrong_order_are_refused(tmp_path: Path) -> None:
    """One bag at a time; without one, stop, split and pause are refused."""
    with desk(tmp_path) as it:
        for ask in (it.recorder.stop, it.recorder.split, lambda: it.recorder.pause(paused=True)):
            assert ask() == (False, 'nothing is recorded')
        name = start(it.recorder)
        assert it.recorder.start() == (False, f'{name} is being recorded already')


def test_bags_that_start_in_the_same_second_have_different_names(tmp_path: Path) -> None:
    """Also when the first one has left this disk; and one without messages leaves no file."""
    with desk(tmp_path) as it:
        names = []
        for number in range(3):
            names.append(start(it.recorder))
            it.hear(range(number, number + 1))
            it.recorder.stop()
        assert names == [names[0], f'{names[0]}_1', f'{names[0]}_2']
        before = it.objects()
        start(it.recorder)
        it.recorder.stop()
        assert it.objects() == before


def test_slices_end_by_size(tmp_path: Path) -> None:
    """None is much larger than the limit, and all are in the bag in order."""
    with desk(tmp_path, slice_bytes=1 << 20) as it:
        name = start(it.recorder)
        for first in range(0, 50, 10):
            it.hear(range(first, first + 10), size=100_000)
        it.recorder.stop()
        found = it.objects()
        slices = [found[f'{name}/{name}_{number}.mcap'] for number in range(len(found) - 2)]
        assert len(slices) >= 3
        assert all(path.stat().st_size < 2_500_000 for path in slices)
        assert [number for path in slices for number in numbers(path)] == list(range(50))


def test_a_full_queue_is_a_loss_with_a_reason(tmp_path: Path) -> None:
    """Messages that do not fit into the queue are dropped, the newest first, and counted; the rest is recorded."""
    with desk(tmp_path, queue_bytes=1 << 20) as it:
        name = start(it.recorder)
        it.hear(range(20), size=100_000)
        it.recorder.stop()
        assert it.row()['dropped'] == {'queue_full': 10}
        assert numbers(it.objects()[f'{name}/{name}_0.mcap']) == list(range(10))


def test_a_bag_follows_its_mission(tmp_path: Path) -> None:
    """The bag starts and ends with the mission, is named after its type, and has its ids, even if the run's arrived later."""
    with desk(tmp_path, record='mission') as it:
        it.recorder.on_mission(None)
        assert not it.recorder.status().recording
        it.recorder.on_mission(mission())
        bag = it.recorder.status().bag
        assert bag.startswith('patrol_2025')
        it.hear(range(3))
        it.recorder.on_mission(mission(run_id='r1'))
        it.recorder.on_mission(None)
        written = manifest(it.objects(), bag)
        assert written['mission'] == {'type': 'patrol', 'mission_id': 'patrol_1', 'run_id': 'r1'}
        assert not it.recorder.status().recording


def test_one_bag_follows_the_other_without_a_gap(tmp_path: Path) -> None:
    """If recording is always on, a mission gets a separate bag; the intake keeps listening and is informed of each bag."""
    with desk(tmp_path, record='always') as it:
        names = [it.recorder.status().bag]
        for number, report in enumerate((None, mission(), mission(number=2), None)):
            it.recorder.on_mission(report)
            names.append(it.recorder.status().bag)
            it.hear(range(10 * number, 10 * number + 10))
        it.recorder.stop()
        found = it.objects()
        bags = list(dict.fromkeys(names))
        assert len(bags) == 4
        assert [numbers(found[f'{bag}/{bag}_0.mcap']) for bag in bags] == [
            list(range(10 * number, 10 * number + 10)) for number in range(4)
        ]
        assert it.listening == [True] * 4 + [False]


def test_messages_received_between_two_bags_are_in_one_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folder is synced to a disk that may be slow, and the intake keeps working."""
    begin = BagState.begin
    with desk(tmp_path, record='always') as it:

        def slowly(*given: Any, **named: Any) -> BagState:
            it.hear(range(10, 20))
            until(lambda: not it.queue.bytes, 'the thread has taken it')
            return begin(*given, **named)

        monkeypatch.setattr(BagState, 'begin', slowly)
        names = [it.recorder.status().bag]
        it.hear(range(10))
        it.recorder.on_mission(mission())
        names.append(it.recorder.status().bag)
        it.hear(range(20, 30))
        it.recorder.stop()
        found = it.objects()
        assert [n for bag in names for n in numbers(found[f'{bag}/{bag}_0.mcap'])] == list(range(30))
        assert it.row()['dropped'] == {}


def test_a_bag_that_cannot_end_does_not_prevent_the_next_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception at its end loses no message of the next one."""
    with desk(tmp_path, record='always') as it:
        it.hear(range(10))
        with monkeypatch.context() as patch:
            broken = Mock(side_effect=sqlite3.OperationalError('disk I/O error'))
            patch.setattr(Recording, 'close', broken)
            it.recorder.on_mission(mission())
            until(lambda: broken.called, 'the first one was to end')
        bag = it.recorder.status().bag
        it.hear(range(10, 20))
        it.recorder.stop()
        assert numbers(it.objects()[f'{bag}/{bag}_0.mcap']) == list(range(10, 20))
        assert it.row()['dropped'] == {}


def test_a_bag_started_by_the_operator_continues_after_missions(tmp_path: Path) -> None:
    """A bag started by a service ends by a service."""
    with desk(tmp_path, record='mission') as it:
        name = start(it.recorder)
        it.recorder.on_mission(mission())
        it.recorder.on_mission(None)
        assert it.recorder.status().bag == name


def test_a_stop_of_the_node_ends_the_bag(tmp_path: Path) -> None:
    """Everything passed on is then in the spool, as a complete bag."""
    with desk(tmp_path, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(100))
        assert it.recorder.close(60)
        assert manifest(it.objects(), name)['state'] == 'complete'
        assert it.row()['stored'] == 100


def kill(home: Path, number: int = 0) -> Path:
    """The state that the next start would find after a kill now."""
    copy = home.with_name(f'{home.name}-after-{number}')
    shutil.copytree(home, copy, copy_function=_copy)
    return copy


def _copy(source: str, target: str) -> None:
    """Delivered slices are no longer in the spool."""
    with suppress(FileNotFoundError):
        shutil.copy2(source, target)


@pytest.mark.parametrize('synced', [True, False])
def test_the_next_start_completes_a_killed_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, synced: bool) -> None:
    """Closed slices and the synced part of the open one are spooled; the rest is lost by restart, as in the manifest."""
    home = tmp_path / 'home'
    monkeypatch.setattr('shadowhound_data_logger.bags.recorder.SYNC_S', 3600.0)
    with desk(home, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(10))
        it.recorder.split()
        it.hear(range(10, 30))
        if synced:
            write_out(it)
        assert it.row()['open'] == 20
        left = kill(home)
    clock = Clocks()
    clock.set()
    clock.wait(60.0)
    with desk(left, clock) as it:
        it.recorder._recovery.worker.join(60)
        found = it.objects()
        slices = 2 if synced else 1
        assert sorted(found) == [f'{name}/{file}' for file in ('manifest.json', 'metadata.yaml')] + [
            f'{name}/{name}_{number}.mcap' for number in range(slices)
        ]
        written = manifest(found, name)
        assert written['state'] == 'recovered'
        assert written['missing'][-1]['what'].startswith('messages in memory')
        row = it.row()
        assert (row['stored'], row['open'], row['dropped']) == ((30, 0, {}) if synced else (10, 0, {'restart': 20}))
        assert journaled(it.spool.root, 'bags') == ({} if synced else {('/talk', 'restart'): 20})
        assert not list(it.root.iterdir())


def test_an_interrupted_startup_is_repeated(tmp_path: Path) -> None:
    """Whatever was spooled before a second kill, nothing is in the spool twice and the ledger balances."""
    home = tmp_path / 'home'
    with desk(home, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(10))
        write_out(it)
        assert it.row()['open'] == 10
        left = kill(home)
    with desk(left) as it:
        it.recorder._recovery.worker.join(60)
        shutil.copytree(home / 'bags', tmp_path / 'again')  # the folder as before, next to a spool that has the bag
        again = kill(left)
    shutil.rmtree(again / 'bags', ignore_errors=True)
    folder = again / 'bags' / ROBOT / name
    folder.mkdir(parents=True)
    shutil.copy(next(again.glob('spool/ready/*/*/rosbags/*/*_0.mcap')), folder / f'{name}_0.mcap')
    with desk(again) as it:
        it.recorder._recovery.worker.join(60)
        assert sorted(path for path in it.objects() if path.endswith('.mcap')) == [f'{name}/{name}_0.mcap']
        assert (it.row()['stored'], it.row()['received']) == (10, 10)


def deliver(it: Desk) -> None:
    """Deliver everything pending, as the uploader does."""
    assert it.writer.flush(60)
    it.writer.settle([Outcome(item, State.DELIVERED) for item in it.spool.pending(1000)])
    assert it.writer.flush(60)


def lose_index(home: Path) -> None:
    for path in (home / 'spool').glob('index.db*'):
        path.unlink()


@pytest.mark.parametrize('delivered', [0, 1, 2])
def test_the_state_of_a_bag_survives_the_loss_of_the_index(tmp_path: Path, delivered: int) -> None:
    """Its manifest is the same, whether all, some or none of the earlier slices are still on this robot."""
    home, ends = tmp_path / 'home', []
    with desk(home, record='mission', queue_bytes=1000) as it:
        it.recorder.on_mission(mission())
        name = it.recorder.status().bag
        for number in range(2):
            it.hear(range(10 * number, 10 * number + 10))
            it.hear(range(5 * number, 5 * number + 5), topic='/large', size=1000)
            write_out(it)
            if number:
                it.hear(range(3), topic='/late')
            assert it.recorder.split()[0]
            if number < delivered:
                deliver(it)
        it.hear(range(20, 25))
        it.recorder.on_mission(mission(run_id='r1'))
        write_out(it)
        assert it.writer.flush(60)
        left = [kill(home, number) for number in range(2)]
    lose_index(left[1])
    for copy in left:
        with desk(copy) as it:
            it.recorder._recovery.worker.join(60)
            found = it.objects()
            ends.append((manifest(found, name), found[f'{name}/metadata.yaml'].read_text()))
            assert not list(it.root.iterdir())
    (report, _), (again, _) = ends
    assert [(entry['file'], entry['counts']) for entry in report['slices']] == [
        (f'{name}_0.mcap', {'/talk': 10}), (f'{name}_1.mcap', {'/talk': 10, '/late': 3}), (f'{name}_2.mcap', {'/talk': 5}),
    ]  # fmt: skip
    assert (report['mission']['run_id'], report['state'], len(report['missing'])) == ('r1', 'recovered', 3)
    assert report == again
    assert ends[0] == ends[1]
