"""Objects stored before the clock was set are dated as soon as the offset is known, and none gets a wrong date."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from clocks import NOON_NS, Clocks
from spool.making import assert_whole, make, receive, rows

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import DataObject, SpooledObject
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.clock_record import BOOTS, ClockRecord, file
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.unsynced_objects import STEP, UnsyncedObjects

PATTERN = 'thor/camera/{date}/{time}_front.jpg'
FINAL = 'thor/camera/20251018/120000_front.jpg'


class Run:
    """A process of the node, limited to dating objects."""

    def __init__(self, root: Path, clocks: Clocks, hold_s: float = 600.0) -> None:
        self.record = ClockRecord(root, 'thor')
        self.watch = ClockWatch(clocks, hold_s, self.record.steps)
        self.spool = Spool(root, SpoolSettings(min_free_bytes=0), clocks, 'thor')
        self.spool.open()
        self.unsynced = UnsyncedObjects(self.spool, self.watch, self.record, 'thor')
        self.clocks = clocks

    def take(self, *fields: dict[str, Any]) -> list[SpooledObject]:
        """Objects with messages sent now, as the encoders create them."""
        items = [self.made(**each) for each in fields or ({},)]
        receive(self.spool, len(items))
        return self.spool.commit([self.unsynced.mark(item) for item in items])

    def made(self, key: str = 'thor/camera/19700101/000110_front.jpg', **fields: Any) -> DataObject:
        now_ns = self.watch.wall_ns() if self.watch.is_set else self.watch.boot_ns()
        metadata = {'t_start_ns': str(now_ns), 't_end_ns': str(now_ns + 1), 'sensor': 'camera'}
        values = {'t_start_ns': now_ns, 't_end_ns': now_ns + 1, 'key_pattern': PATTERN, 'metadata': metadata}
        return make(key, **{**values, **fields})


@pytest.fixture
def clocks() -> Clocks:
    """Clocks that are not set."""
    return Clocks()


@pytest.fixture
def started(root: Path, clocks: Clocks) -> Iterator[Callable[..., Run]]:
    """Starts processes, one after the other."""
    runs: list[Run] = []

    def start(**options: Any) -> Run:
        for run in runs:
            run.spool.close()
        runs.append(Run(root, clocks, **options))
        return runs[-1]

    yield start
    for run in runs:
        run.spool.close()


def metadata_of(root: Path) -> list[dict[str, Any]]:
    """The metadata of all objects."""
    return [json.loads(row['metadata']) for row in rows(root)]


def test_an_object_of_a_set_clock_is_not_held(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """It keeps its key and its date, and records its time by the boot clock."""
    clocks.set()
    (item,) = started().take({'key': FINAL})
    expected = {'boot_id': 'this-boot', 'boot_start_ns': str(60 * SECOND), 'boot_end_ns': str(60 * SECOND + 1), 'clock': 'set'}
    assert item.metadata.items() >= expected.items()
    assert (item.key, item.metadata['t_start_ns']) == (FINAL, str(NOON_NS))
    assert 'key_pattern' not in item.metadata


def test_an_object_waits_for_the_clock(started: Callable[..., Run], root: Path) -> None:
    """It is held, under a name by the boot clock, and nothing in it is dated 1970."""
    run = started()
    assert run.take() == []
    assert run.unsynced.step() == []
    (row,) = rows(root)
    assert (row['state'], row['reason']) == ('held', 'clock')
    assert row['key'] == 'thor/_unsynced/this-boot/camera/00000060_000_camera.jpg'
    (metadata,) = metadata_of(root)
    assert metadata['clock'] == 'unset'
    assert (metadata['key_pattern'], metadata['boot_start_ns']) == (PATTERN, str(60 * SECOND))
    assert not {'t_start_ns', 't_end_ns'} & metadata.keys()


@pytest.mark.parametrize('restart', [False, True])
def test_an_object_is_dated_when_the_clock_is_set(
    started: Callable[..., Run], root: Path, clocks: Clocks, *, restart: bool
) -> None:
    """Key, times and metadata are in UTC, also in a later process of the same boot; its bytes are unchanged."""
    run = started()
    run.take({'body': b'one'}, {'body': b'two'})
    run = started() if restart else run
    clocks.wait(30)
    clocks.set(NOON_NS + 30 * SECOND)
    items = run.unsynced.step()
    assert [item.key for item in items] == [FINAL, 'thor/camera/20251018/120000_front_1.jpg']
    assert [item.path.read_bytes() for item in items] == [b'one', b'two']
    row, metadata = rows(root)[0], metadata_of(root)[0]
    assert (row['t_start_ns'], row['t_end_ns']) == (NOON_NS, NOON_NS + 1)
    assert (metadata['t_start_ns'], metadata['t_end_ns'], metadata['clock']) == (str(NOON_NS), str(NOON_NS + 1), 'set_later')
    assert (metadata['boot_start_ns'], metadata['clock_offset_ns']) == (str(60 * SECOND), str(NOON_NS - 60 * SECOND))
    assert metadata['sensor'] == 'camera'
    assert 'key_pattern' not in metadata
    assert assert_whole(root)['objects']['pending'] == 2
    assert run.unsynced.step() == []


def test_objects_encoded_after_the_clock_was_set_are_dated_immediately(started: Callable[..., Run], clocks: Clocks) -> None:
    """A batch from before that is encoded after is never held."""
    run = started()
    item = run.made()
    clocks.set()
    dated = run.unsynced.mark(item)
    assert (dated.key, dated.held, dated.t_start_ns, dated.metadata['clock']) == (FINAL, None, NOON_NS, 'set_later')


def test_the_time_of_a_publisher_with_a_set_clock_is_used(started: Callable[..., Run], clocks: Clocks) -> None:
    """Its object is dated immediately, though our clock is not set; by the boot clock it was just now."""
    run = started()
    item = run.made(FINAL, t_start_ns=NOON_NS, t_end_ns=NOON_NS + SECOND)
    dated = run.unsynced.mark(item)
    assert (dated.key, dated.held, dated.metadata['clock']) == (FINAL, None, 'publisher')
    assert dated.metadata['boot_end_ns'] == str(clocks.boot_ns())
    assert dated.metadata['boot_start_ns'] == str(clocks.boot_ns() - SECOND)


def test_after_ten_minutes_objects_are_sent_without_a_date(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """Objects that are held and those after them keep their names by the boot clock, and record that they have no date."""
    run = started()
    run.take()
    clocks.wait(601)
    assert [item.key for item in run.unsynced.step()] == ['thor/_unsynced/this-boot/camera/00000060_000_camera.jpg']
    assert [item.key for item in run.take()] == ['thor/_unsynced/this-boot/camera/00000661_000_camera.jpg']
    assert [metadata['clock'] for metadata in metadata_of(root)] == ['unset', 'unset']
    assert not [metadata for metadata in metadata_of(root) if 't_start_ns' in metadata]
    clocks.set()
    assert run.unsynced.step() == []
    assert run.take()[0].metadata['clock'] == 'set'


def test_objects_of_an_earlier_boot_are_sent_without_a_date(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """Its clock was never set: no later clock can date it, and it is released immediately, whatever the clock shows now."""
    started().take()
    clocks.boot_id, clocks.up_ns = 'next-boot', 20 * SECOND
    run = started()
    run.take()
    assert [item.key for item in run.unsynced.step()] == ['thor/_unsynced/this-boot/camera/00000060_000_camera.jpg']
    clocks.set()
    assert [item.key for item in run.unsynced.step()] == [FINAL]


def test_objects_of_an_earlier_boot_are_dated_by_its_offset(started: Callable[..., Run], clocks: Clocks) -> None:
    """A process that ended before it could name them recorded the offset of its boot."""
    run = started()
    run.take()
    clocks.set()
    run.record.note(run.watch)
    clocks.boot_id, clocks.up_ns, clocks.offset_ns = 'next-boot', 20 * SECOND, 0
    assert [item.key for item in started().unsynced.step()] == [FINAL]


def test_dates_survive_the_loss_of_the_index(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """The data needed for it is stored with the file."""
    run = started()
    run.take()
    run.spool.close()
    for path in root.glob('index.db*'):
        path.unlink()
    run = started()
    assert run.spool.recovery.counts['files adopted'] == 1
    clocks.set()
    assert [item.key for item in run.unsynced.step()] == [FINAL]
    assert metadata_of(root)[0]['t_start_ns'] == str(NOON_NS)


@pytest.mark.parametrize('pattern', ['../{date}/{time}', 'thor/{date}', '', 'a' * 300])
def test_a_changed_key_pattern_does_not_stop_the_others(started: Callable[..., Run], pattern: str, clocks: Clocks) -> None:
    """An object with an invalid name does not block others: it is sent without a date, or under the valid part of its pattern."""
    run = started()
    run.take({}, {'key_pattern': 'x'})
    one = run.spool.reading.objects.held('clock')[0]
    broken = {**one.metadata, 'key_pattern': pattern}
    run.spool._connections.writing._db.execute('UPDATE objects SET metadata = ? WHERE id = ?', (json.dumps(broken), one.id))
    clocks.set()
    keys = [item.key for item in run.unsynced.step()]
    assert len(keys) == 2
    assert keys[0] in {one.key, 'thor/20251018'}
    assert keys[1] == 'x'


def test_many_objects_are_named_in_steps(started: Callable[..., Run], clocks: Clocks) -> None:
    """Each step is bounded, the oldest first, and in the end all have their names."""
    run = started()
    run.take(*({'body': b'%d' % number} for number in range(STEP + 5)))
    clocks.set()
    counts = [len(run.unsynced.step()) for _ in range(3)]
    assert counts == [STEP, 5, 0]


def test_the_ledger_names_the_state(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """Whether the clock is set, how often it stepped in all processes, and which objects wait for it."""
    run = started()
    run.take()
    run.unsynced.step()
    assert ledger.read(root, 'thor')['clock'] == {
        'is_set': False, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'held': 1,
    }  # fmt: skip
    clocks.set()
    run.unsynced.step()
    run = started()
    clocks.offset_ns -= 5 * SECOND
    run.unsynced.step()
    clock = ledger.read(root, 'thor')['clock']
    assert clock == {'is_set': True, 'steps': 2, 'last_step_s': -5.0, 'last_step_time': '2025-10-18T11:59:55.000000Z', 'held': 0}


@pytest.mark.parametrize('content', [b'', b'{}', b'[]', b'{"offsets": [], "is_set": 1, "steps": "x"}', b'\xff'])
def test_an_unreadable_record_is_ignored(started: Callable[..., Run], root: Path, content: bytes, clocks: Clocks) -> None:
    """A new record is started; nothing depends on the old one."""
    run = started()
    file(root, 'thor').write_bytes(content)
    run = started()
    run.take()
    clocks.set()
    assert len(run.unsynced.step()) == 1
    assert ledger.read(root, 'thor')['clock']['steps'] == 1


def test_a_record_that_cannot_be_written_stops_nothing(started: Callable[..., Run], root: Path, clocks: Clocks,
                                         caplog: pytest.LogCaptureFixture) -> None:  # fmt: skip
    """Objects are dated anyway."""
    run = started()
    run.take()
    file(root, 'thor').with_name('clock-thor.json.part').mkdir()
    clocks.set()
    with caplog.at_level(logging.WARNING):
        assert len(run.unsynced.step()) == 1
    assert 'cannot record' in caplog.text


def test_a_record_keeps_few_boots(root: Path, clocks: Clocks) -> None:
    """The newest ones."""
    root.mkdir()
    record = ClockRecord(root, 'thor')
    clocks.set()
    for number in range(BOOTS + 3):
        clocks.boot_id = f'boot-{number}'
        record.note(ClockWatch(clocks, 600.0))
    again = ClockRecord(root, 'thor')
    assert 'boot-2' not in again.offsets()
    assert again.offsets()[f'boot-{BOOTS + 2}'] == clocks.offset_ns


def test_a_held_object_with_a_date_is_released(started: Callable[..., Run], root: Path, clocks: Clocks) -> None:
    """It does not wait indefinitely: it is released unchanged once the clock is set."""
    run = started()
    run.take()
    run.spool._connections.writing._db.execute('UPDATE objects SET t_start_ns = ?', (NOON_NS,))
    assert run.unsynced.step() == []
    clocks.set()
    assert [item.key for item in run.unsynced.step()] == ['thor/_unsynced/this-boot/camera/00000060_000_camera.jpg']
