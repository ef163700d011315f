"""Recovery at startup if the index was lost or another program put files into the folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from bags.recording import ROBOT, batch, desk, manifest, start
from bags.slices import closed, fill, messages
from bags.test_recorder import kill, lose_index
from bags.test_wrong_clock import hear, is_whole
from clocks import NOON_NS, Clocks

from shadowhound_data_logger.bags.naming import slice_file
from shadowhound_data_logger.bags.state import RECORD, BagState
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

BAG = 'patrol_20251018_120000'


def foreign(path: Path, bag: str, robot: str, owner: str) -> None:
    """A slice at ``path`` whose record is of another recording."""
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


def test_what_was_dropped_after_the_last_slice_is_missing_without_the_index(tmp_path: Path) -> None:
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
            said = manifest(it.objects(), 'recording_20251018_120000')
            states.append((said['state'], sum(one['messages'] or 0 for one in said['missing'])))
    assert states == [('gaps', 5), ('gaps', 5)]


def test_a_folder_that_became_a_link_is_not_followed(tmp_path: Path) -> None:
    """Its target is neither read, moved nor removed."""
    home, outside = tmp_path / 'home', tmp_path / 'outside'
    with desk(home, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(10))
        it.recorder.split()
        it.hear(range(10, 20))
        assert it.writer.flush(60)
        left = kill(home)
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


def test_a_row_without_folder(tmp_path: Path) -> None:
    """What was delivered is listed, the rest is not known, and the row goes."""
    home = tmp_path / 'home'
    with desk(home, record='always') as it:
        name = it.recorder.status().bag
        it.hear(range(10))
        it.recorder.split()
        it.hear(range(10, 20))
        assert it.writer.flush(60)
        left = kill(home)
    shutil.rmtree(left / 'bags' / ROBOT / name)
    with desk(left) as it:
        is_whole(it)
        said = manifest(it.objects(), name)
        assert (said['state'], [one['messages'] for one in said['slices']]) == ('recovered', [10])
        assert it.spool.reading.recordings.rows('thor') == []
