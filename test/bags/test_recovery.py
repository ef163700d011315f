"""Recovery at startup: after a lost index, with foreign files in the folder, and for bags that wait for the clock."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
from bags.eventing import buffer, until
from bags.recording import ROBOT, STRING, Desk, batch, desk, manifest, mission, numbers, start
from bags.slices import closed, fill, messages
from bags.test_recorder import kill, lose_index
from clocks import NOON_NS, Clocks
from mcap.reader import make_reader
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.naming import slice_file, slice_number
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.state import RECORD, BagState
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.keys import unsynced
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.spool.topic_account import BAG as BAG_SINK

BAG = 'patrol_20251018_120000'


def foreign(path: Path, bag: str, robot: str, owner: str) -> None:
    """A slice at ``path`` with the record of another recording."""
    other = BagState(Path('/nowhere') / bag, bag, robot)
    other.add_slice(replace(closed(path.with_name('tmp.mcap'), 4)[0], path=other.folder / slice_file(bag, 0)))
    path.with_name('tmp.mcap').unlink()
    writer = SliceWriter(path)
    writer.add_metadata(RECORD, other.record(owner, 1))
    fill(writer, messages(3))
    writer.close()


def test_a_slice_of_another_recording_is_ignored(tmp_path: Path) -> None:
    """It is spooled as a slice of the folder in which it is, or set aside; the bag keeps its name."""
    folder = tmp_path / 'bags' / ROBOT / BAG
    folder.mkdir(parents=True)
    closed(folder / f'{BAG}_0.mcap', 10)
    foreign(folder / f'{BAG}_1.mcap', 'secret_20250101_000000', 'other', 'other')
    with desk(tmp_path) as it:
        is_whole(it)
        assert {key.partition('/')[0] for key in it.objects()} == {BAG}


def test_without_the_index_messages_dropped_after_the_last_slice_are_missing(tmp_path: Path) -> None:
    """The last slice describes it, so the manifest is the same with and without the index."""
    clock = Clocks()
    home = tmp_path / 'home'
    with desk(home, clock, queue_bytes=1000) as it:
        start(it.recorder)
        hear(it, clock, range(3))
        it.recorder.split()
        assert it.queue.put(batch(range(3, 8), size=1000)) == 5
        it.recorder.stop()
        assert it.writer.flush(60)
        left, lost = kill(home), kill(home, 1)
    lose_index(lost)
    states = []
    for each in (left, lost):
        now = Clocks()
        now.set(NOON_NS)
        with desk(each, now) as it:
            is_whole(it)
            written = manifest(it.objects(), 'recording_20251018_120000')
            states.append((written['state'], sum(one['messages'] or 0 for one in written['missing'])))
    assert states == [('gaps', 5), ('gaps', 5)]


def killed(home: Path) -> tuple[str, Path]:
    """The name of a bag with a complete and an open slice, and what remains of its home after a kill."""
    with desk(home, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(10))
        it.recorder.split()
        it.hear(range(10, 20))
        assert it.writer.flush(60)
        return name, kill(home)


def test_a_folder_that_became_a_link_is_not_followed(tmp_path: Path) -> None:
    """Its target is neither read, moved nor removed."""
    home, outside = tmp_path / 'home', tmp_path / 'outside'
    name, left = killed(home)
    folder = left / 'bags' / ROBOT / name
    shutil.rmtree(folder)
    outside.mkdir()
    closed(outside / f'{name}_7.mcap', 5)
    (outside / 'x.mcap.open').write_bytes(b'precious')
    before = sorted(path.name for path in outside.iterdir())
    folder.symlink_to(outside)
    with desk(left) as it:
        it.recorder._recovery.worker.join(60)
        assert it.recorder._recovery.worker.failures == 0
        assert sorted(path.name for path in outside.iterdir()) == before


def test_a_row_without_a_folder_is_removed(tmp_path: Path) -> None:
    """Delivered slices are listed, others are unknown, and the row is removed."""
    home = tmp_path / 'home'
    name, left = killed(home)
    shutil.rmtree(left / 'bags' / ROBOT / name)
    with desk(left) as it:
        is_whole(it)
        written = manifest(it.objects(), name)
        assert (written['state'], [one['messages'] for one in written['slices']]) == ('recovered', [10])
        assert it.spool.reading.recordings.rows('thor') == []


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of an interrupted bag: a complete slice, and an open one, each with ten messages."""
    made = tmp_path / 'home' / 'bags' / ROBOT / BAG
    made.mkdir(parents=True)
    closed(made / f'{BAG}_0.mcap', 10)
    writer = SliceWriter(made / f'{BAG}_1.mcap')
    fill(writer, messages(10))
    writer.sync()
    writer.abort()
    return made


def recovered(home: Path) -> dict[str, Path]:
    """The contents of the spool after a start."""
    with desk(home) as it:
        it.recorder._recovery.worker.join(60)
        assert it.recorder._recovery.worker.failures == 0
        return dict(it.objects())


def counts(found: dict[str, Path], home: Path) -> dict[str, int]:
    """Slice -> messages, according to the manifest."""
    (path,) = home.glob(f'spool/ready/*/{ROBOT}/rosbags/{BAG}/manifest.json')
    return {entry['file'].removeprefix(f'{BAG}_'): entry['messages'] for entry in json.loads(path.read_bytes())['slices']}


WHOLE = {'0.mcap': 10, '1.mcap': 10}


def test_links_are_not_followed(folder: Path, tmp_path: Path) -> None:
    """For a slice, an open one and a bag: the target of a link is unchanged, and the link is set aside."""
    home, precious = tmp_path / 'home', tmp_path / 'precious.mcap.open'
    closed(tmp_path / 'other.mcap', 5)
    precious.write_bytes(b'precious')
    before = {path: path.read_bytes() for path in (precious, tmp_path / 'other.mcap')}
    (folder / f'{BAG}_2.mcap.open').symlink_to(precious)
    (folder / f'{BAG}_3.mcap').symlink_to(tmp_path / 'other.mcap')
    (folder.parent / 'linked_20251018_120000').symlink_to(tmp_path)
    assert counts(recovered(home), home) == WHOLE
    assert {path: path.read_bytes() for path in before} == before
    aside = home / 'bags' / f'{ROBOT}.damaged' / BAG
    assert sorted(path.name for path in aside.iterdir()) == [f'{BAG}_2.mcap.open', f'{BAG}_3.mcap']
    assert all(path.is_symlink() for path in aside.iterdir())


def test_files_that_are_not_slices_are_set_aside(folder: Path, tmp_path: Path) -> None:
    """A folder, a slice of another bag, a name without a number; also two with the same name."""
    home = tmp_path / 'home'
    (folder / f'{BAG}_5.mcap').mkdir()
    (folder / 'other_20251018_120000_0.mcap').write_bytes(b'')
    (folder / 'x.mcap.open').write_bytes(b'x')
    aside = home / 'bags' / f'{ROBOT}.damaged' / BAG
    aside.mkdir(parents=True)
    (aside / 'x.mcap.open').write_bytes(b'before')
    assert counts(recovered(home), home) == WHOLE
    assert sorted(path.name for path in aside.iterdir()) == [
        'other_20251018_120000_0.mcap', f'{BAG}_5.mcap', 'x.mcap.open', 'x.mcap.open.1',
    ]  # fmt: skip
    assert (aside / 'x.mcap.open').read_bytes() == b'before'


def test_a_broken_bag_does_not_block_others(folder: Path, tmp_path: Path) -> None:
    """It is retried; later bags are completed during that time, and the node records."""
    later = folder.with_name('patrol_20251018_130000')
    later.mkdir()
    closed(later / f'{later.name}_0.mcap', 7)
    (folder / f'{BAG}_1.mcap').write_bytes(b'in the way of the open slice')
    with desk(tmp_path / 'home') as it:
        for _ in range(200):
            if f'{later.name}/manifest.json' in it.objects():
                break
            it.recorder._recovery.worker.join(0.05)
        assert numbers_of(it.objects(), later.name) == 7
        assert it.recorder._recovery.is_busy
        assert it.recorder.start()[0]


def numbers_of(found: dict[str, Path], bag: str) -> int:
    return sum(entry['messages'] for entry in manifest(found, bag)['slices'])


UNSET = 'recording_unsynced_this-boot_00000060'


def hear(it: Desk, clock: Clocks, numbers: range) -> None:
    """Messages received just now, by this machine's clock."""
    came_ns = clock.wall_ns()
    received = [Taken(b'\0\1\0\0%08d' % number, came_ns, 'p', number, came_ns + number * 1000) for number in numbers]
    with it.spool.accounts.entry(f'{BAG_SINK}/talk') as account:
        for message in received:
            assert account.receive(message.publisher, message.number)
    it.queue.put(MessageBatch('/talk', STRING, '', received))


def log_times(path: Path) -> list[int]:
    with path.open('rb') as file:
        return [message.log_time for *_, message in make_reader(file).iter_messages()]


def bags_of(found: dict[str, Path]) -> dict[str, list[int]]:
    """Bag -> the numbers of its messages, in slice order."""
    names = sorted({key.partition('/')[0] for key in found})
    slices = {bag: [key for key in found if key.startswith(f'{bag}/') and key.endswith('.mcap')] for bag in names}
    order = {bag: sorted(keys, key=lambda key: slice_number(bag, key.partition('/')[2]) or 0) for bag, keys in slices.items()}
    return {bag: [number for key in keys for number in numbers(found[key])] for bag, keys in order.items()}


def is_whole(it: Desk) -> None:
    it.recorder._recovery.worker.join(60)
    assert not it.recorder._recovery.is_busy


def test_a_bag_never_spans_the_moment_in_which_the_clock_is_set(tmp_path: Path) -> None:
    """It ends then and is delivered with its start date; the next one follows without losing a message."""
    clock = Clocks()
    with desk(tmp_path, clock, record='always') as it:
        assert it.recorder.status().bag == UNSET
        hear(it, clock, range(5))
        it.recorder.split()
        it.recorder.check_clock()
        hear(it, clock, range(5, 10))
        assert it.objects() == {}
        clock.wait(30.0)
        clock.set(NOON_NS)
        hear(it, clock, range(10, 12))
        it.recorder.check_clock()
        it.recorder.check_clock()
        hear(it, clock, range(12, 15))
        it.recorder.stop()
        found = it.objects()
        first, second = 'recording_20251018_115930', 'recording_20251018_120000'
        assert bags_of(found) == {first: [*range(12)], second: [12, 13, 14]}
        written = manifest(found, first)
        assert (written['bag'], written['state'], written['missing']) == (first, 'complete', [])
        offset_ns = NOON_NS - 30 * SECOND - 70 * SECOND
        assert written['clock'] == {
            'known': 'set_later', 'boot_id': 'this-boot', 'boot_ns': 60 * SECOND, 'wall_ns': 70 * SECOND, 'offset_ns': offset_ns,
        }  # fmt: skip
        assert [entry['file'] for entry in written['slices']] == [f'{first}_0.mcap', f'{first}_1.mcap']
        assert manifest(found, second)['clock'] is None
        assert f'{first}_1.mcap' in found[f'{first}/metadata.yaml'].read_text()
        assert f'clock_offset_ns: "{offset_ns}"' in found[f'{first}/metadata.yaml'].read_text()
        times = [time for file in (0, 1) for time in log_times(found[f'{first}/{first}_{file}.mcap'])]
        assert times[-1] - times[0] == pytest.approx(30 * SECOND, abs=SECOND)
        assert times[-1] + offset_ns == pytest.approx(NOON_NS, abs=SECOND)
        assert (it.row()['stored'], it.row()['open'], it.row()['dropped']) == (15, 0, {})


def test_messages_received_before_the_clock_was_set_have_correct_times_in_a_later_bag(tmp_path: Path) -> None:
    """It waited in the queue: its time is converted to the clock of its bag."""
    clock = Clocks()
    with desk(tmp_path, clock) as it:
        early = Clocks()
        clock.set(NOON_NS)
        name = start(it.recorder)
        hear(it, early, range(1))
        hear(it, clock, range(1, 2))
        it.recorder.stop()
        assert log_times(it.objects()[f'{name}/{name}_0.mcap']) == [NOON_NS, NOON_NS + 1000]


def test_a_bag_that_ends_before_the_clock_is_set_waits_for_it(tmp_path: Path) -> None:
    """It stays in its folder, as the stop reports; it is complete in the spool with its date as soon as that is known."""
    clock = Clocks()
    with desk(tmp_path, clock) as it:
        it.recorder.on_mission(mission())
        name = start(it.recorder)
        hear(it, clock, range(3))
        done, text = it.recorder.stop()
        assert (done, text) == (True, f'{name}: 3 messages in 1 slices; it waits until the clock of this machine is set')
        assert it.recorder._recovery.is_busy
        assert it.objects() == {}
        assert it.row()['open'] == 3
        (row,) = bag_overview(MemoryStore(), ROBOT, it.home)
        assert (row.bag, row.where) == (name, {'recording': 1})
        clock.set(NOON_NS)
        is_whole(it)
        found = it.objects()
        assert bags_of(found) == {'patrol_20251018_120000': [0, 1, 2]}
        assert manifest(found, 'patrol_20251018_120000')['state'] == 'complete'
        (row,) = bag_overview(MemoryStore(), ROBOT, it.home)
        assert row.t_start_ns == pytest.approx(NOON_NS, abs=SECOND)
        assert (it.row()['stored'], it.row()['received'], it.row()['open']) == (3, 3, 0)
        assert not list(it.root.iterdir())


def test_a_bag_gets_a_name_without_a_date_when_the_clock_is_not_set_in_time(tmp_path: Path) -> None:
    """Bags from before are named after their boot, like objects, with a note that the date is unknown."""
    clock = Clocks()
    with desk(tmp_path, clock, record='always') as it:
        hear(it, clock, range(3))
        clock.wait(601.0)
        it.recorder.check_clock()
        hear(it, clock, range(3, 5))
        assert it.recorder.status().bag == 'recording_unsynced_this-boot_00000661'
        it.recorder.split()
        found = it.objects()
        assert bags_of(found) == {UNSET: [0, 1, 2]}
        written = manifest(found, UNSET)['clock']
        assert (written['known'], written['offset_ns']) == ('unset', None)
        (row,) = [row for row in bag_overview(MemoryStore(), ROBOT, it.home) if row.bag == UNSET]
        assert (row.state, row.messages, row.t_start_ns) == ('complete', 3, None)
        item = next(item for item in it.spool.pending(10) if item.key.endswith('.mcap'))
        assert {name: item.metadata[name] for name in ('clock', 'boot_id', 'boot_start_ns', 'boot_end_ns')} == {
            'clock': 'unset', 'boot_id': 'this-boot', 'boot_start_ns': str(60 * SECOND), 'boot_end_ns': str(60 * SECOND + 2000),
        }  # fmt: skip
        assert 't_start_ns' not in item.metadata
        boot, seconds = unsynced(ROBOT, 'this-boot', 'camera', 60 * SECOND, 'x.jpg').split('/')[2:5:2]
        assert f'recording_unsynced_{boot}_{seconds.partition("_")[0]}' == UNSET


def left_in_1970(home: Path, boot_id: str = 'this-boot') -> Path:
    """A home with a node that was killed during a recording, before the clock was set."""
    clock = Clocks(boot_id=boot_id)
    with desk(home, clock, record='always') as it:
        hear(it, clock, range(5))
        it.recorder.split()
        assert it.row()['open'] == 5
        return kill(home)


@pytest.mark.parametrize('index', ['there', 'lost'])
def test_after_a_restart_in_the_same_boot_a_bag_still_waits_for_the_clock(tmp_path: Path, index: str) -> None:
    """A killed node's bag is dated once the clock is set, with a note that it was interrupted."""
    left = left_in_1970(tmp_path / 'home')
    if index == 'lost':
        lose_index(left)
    clock = Clocks()
    with desk(left, clock) as it:
        assert it.recorder._recovery.is_busy
        assert it.objects() == {}
        clock.set(NOON_NS)
        is_whole(it)
        found = it.objects()
        assert bags_of(found) == {'recording_20251018_120000': [*range(5)]}
        written = manifest(found, 'recording_20251018_120000')
        assert (written['state'], written['clock']['known']) == ('recovered', 'set_later')
        assert written['missing'][0]['file'] == 'recording_20251018_120000_0.mcap'
        assert (it.row()['stored'], it.row()['open'], it.row()['dropped']) == (5, 0, {})


@pytest.mark.parametrize('offset_ns', [None, NOON_NS - 60 * SECOND])
def test_after_a_reboot_a_bag_is_named_by_what_its_boot_recorded(tmp_path: Path, offset_ns: int | None) -> None:
    """It is shipped immediately: with the date if that boot's clock was set after all, otherwise named after that boot."""
    left = left_in_1970(tmp_path / 'home')
    clock = Clocks(boot_id='next-boot')
    with desk(left, clock, offsets={'this-boot': offset_ns} if offset_ns else {}, record='always') as it:
        is_whole(it)
        (bag,) = bags_of(it.objects())
        assert bag == (UNSET if offset_ns is None else 'recording_20251018_120000')
        assert it.recorder.status().bag == 'recording_unsynced_next-boot_00000060'


def test_a_chosen_name_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the clock does after a kill between two slices: a bag keeps its name."""
    left = left_in_1970(tmp_path / 'home')
    for hour in range(2):
        clock = Clocks()
        clock.set(NOON_NS + hour * 3600 * SECOND)
        broken = Mock(side_effect=OSError('the disk refuses'))
        with monkeypatch.context() as patch, desk(left, clock) as it:
            if not hour:
                patch.setattr(BagRecovery, '_spool_slice', broken)
                until(partial(getattr, broken, 'called'), 'the bag is named')
            else:
                is_whole(it)
                assert bags_of(it.objects()) == {'recording_20251018_120000': [*range(5)]}


def test_a_waiting_bag_survives_the_loss_of_the_index(tmp_path: Path) -> None:
    """It is complete, with its date, and with the mission in which it was recorded."""
    clock = Clocks()
    with desk(tmp_path / 'home', clock) as it:
        it.recorder.on_mission(mission(run_id='r'))
        start(it.recorder)
        hear(it, clock, range(3))
        it.recorder.stop()
        left = kill(tmp_path / 'home')
    lose_index(left)
    clock = Clocks()
    clock.set(NOON_NS)
    with desk(left, clock) as it:
        is_whole(it)
        written = manifest(it.objects(), 'patrol_20251018_120000')
        assert (written['state'], written['missing'], written['mission']['run_id']) == ('complete', [], 'r')
        assert written['clock']['offset_ns'] == NOON_NS - 70 * SECOND
        assert not list(it.root.iterdir())


def test_an_event_before_the_clock_is_set_waits_for_it(tmp_path: Path) -> None:
    """Like any bag; the seconds before the trigger, and its time, follow the clock of the event."""
    clock = Clocks()
    with buffer(tmp_path, clock) as it:
        came_ns = clock.wall_ns()
        it.ring.put(MessageBatch('/talk', STRING, '', [Taken(b'\0\1\0\0%08d' % 1, came_ns, 'p', 1, came_ns)]), None, it.now_s[0])
        text = it.events.trigger('fall', 'service')[1]
        assert text == 'event_fall_unsynced_this-boot_00000060 starts'
        it.taken()
        clock.set(NOON_NS)
        clock.wait(1.0)
        it.ring.put(
            MessageBatch('/talk', STRING, '', [Taken(b'\0\1\0\0%08d' % 2, 0, 'p', 2, clock.wall_ns())]), None, it.now_s[0]
        )
        it.events.trigger('again', 'service')
        it.pass_s(5.0)
        it.written()
        (bag,) = it.bags()
        assert bag == 'event_fall_20251018_120000'
        written = manifest(it.objects(), bag)
        times = log_times(it.objects()[f'{bag}/{bag}_0.mcap'])
        assert times == [70 * SECOND, 71 * SECOND]
        assert [trigger['at_ns'] for trigger in written['event']['triggers']] == [70 * SECOND, 71 * SECOND]
        assert written['clock']['offset_ns'] == NOON_NS - 70 * SECOND
        row = it.rows()['/talk']
        assert (row['received'], row['stored'], row['open']) == (2, 2, 0)


def test_two_events_wait_at_the_same_time(tmp_path: Path) -> None:
    """Both are delivered, each with its date."""
    clock = Clocks()
    with buffer(tmp_path, clock) as it:
        for number, name in enumerate(('one', 'two'), 1):
            taken = Taken(b'\0\1\0\0%08d' % number, 0, 'p', number, clock.wall_ns())
            it.ring.put(MessageBatch('/talk', STRING, '', [taken]), None, it.now_s[0])
            it.events.trigger(name, 'service')
            it.pass_s(5.0)
            clock.wait(5.0)
            it.written(number)
        assert it.bags() == []
        clock.set(NOON_NS)
        until(lambda: len(it.bags()) == 2, 'both leave')
        assert it.bags() == ['event_one_20251018_115950', 'event_two_20251018_115955']
