"""The status of the node, from stages controlled by the test."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from spool.making import FakeClock, make, new_spool, put

pytest.importorskip('rclpy')

from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import QueueSettings, Settings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.status import BagStatus, EventStatus, MissionStatus, NodeStatus, WorkerStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.intake.middleware import FAST_DDS, Middleware
from shadowhound_data_logger.node.intake.subscriber import SubscriberStatus
from shadowhound_data_logger.node.reporting.status import Stages, Status
from shadowhound_data_logger.shipping.uploader import UploadStatus
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import file, read


class Sampler:
    """A failed consumer."""

    failures, last_error = 2, 'ValueError: x'


class Intake:
    """Subscribes to one topic; ``sources`` is what it reports about it."""

    def __init__(self) -> None:
        self.paused = False
        self.worker = Worker('intake', lambda: None)
        self.found = SimpleNamespace(not_logged={'/led': 'no rule'})
        self.consumers = [Sampler()]
        self.sources = [SubscriberStatus('imu', '/imu', enabled=True, publishers=1, received_s=None)]

    def status(self) -> list[SubscriberStatus]:
        return self.sources


class Threads:
    """An encode pool or a spool writer: only their threads are used."""

    def __init__(self, *names: str) -> None:
        self.workers = [Worker(name, lambda: None) for name in names]
        self.worker = self.workers[0]


class Missions(Threads):
    """No active mission."""

    def status(self) -> MissionStatus:
        return MissionStatus()


class Recorders(Threads):
    """No recording."""

    def status(self) -> BagStatus:
        return BagStatus()


class EventBuffers(Threads):
    """An empty event buffer."""

    consumers = ()

    @property
    def events(self) -> EventBuffers:
        return self

    def status(self) -> EventStatus:
        return EventStatus()


class Uploader:
    """Delivers as much as the test sets."""

    def __init__(self) -> None:
        self.told = UploadStatus('idle', '', 5, 0, 0, 0, 0)
        self.workers = Threads('upload-lock', 'upload-0').workers

    def status(self) -> UploadStatus:
        return self.told


class Setting:
    """A status for an open spool, with a clock controlled by the test."""

    def __init__(self, folder: Path) -> None:
        self.now_s = 100.0
        self.clock = FakeClock()
        self.spool: Spool = new_spool(folder / 'spool', self.clock)
        self.spool.open()
        self.intake, self.uploader = Intake(), Uploader()
        encoders: Any = Threads('encode-0')
        writer: Any = Threads('spool-writer')
        intake: Any = self.intake
        uploader: Any = self.uploader
        mission: Any = Missions('mission')
        self.queue = BatchQueue(QueueSettings())
        recorder: Any = Recorders('bag-writer')
        bags: Any = SimpleNamespace(left_out=0)
        event_buffer: Any = EventBuffers('event-writer')
        control: Any = Threads('control')
        middleware = Middleware('auto', FAST_DDS, FAST_DDS, "the robot's own")
        stages = Stages(self.spool, intake, self.queue, encoders, writer, uploader, mission, recorder, bags, event_buffer,
                        control, middleware)  # fmt: skip
        settings = replace(Settings.load({'robot': 'thor'}, {}), home=folder)
        self.status = Status(stages, settings, ClockWatch(self.clock, 600.0), 'a store', lambda: self.now_s)

    def poll(self, seconds: float = 1.0) -> NodeStatus:
        """Poll after this time."""
        self.now_s += seconds
        self.clock.now_ns += round(seconds * 1e9)
        found = self.status.poll()
        assert found
        return found

    def receive(self, messages: int, last: int = 0) -> None:
        with self.spool.accounts.entry('/imu') as account:
            for number in range(last + 1, last + 1 + messages):
                account.receive('p', number)
        self.intake.sources = [replace(self.intake.sources[0], received_s=self.now_s)]


@pytest.fixture
def setting(tmp_path: Path) -> Iterator[Setting]:
    made = Setting(tmp_path)
    yield made
    made.spool.close()


def test_a_topic_before_and_after_its_first_message(setting: Setting) -> None:
    """It is listed from the start; its age and its missed messages are unknown until a message arrives."""
    row = setting.poll().topics['/imu']
    assert (row.sensor, row.publishers, row.received, row.age_s, row.missed) == ('imu', 1, 0, None, None)
    setting.receive(50)
    row = setting.poll(0.5).topics['/imu']
    assert (row.received, row.open, row.age_s, row.missed, row.accounting) == (50, 50, 0.5, 0, 'exact')


def test_rates_are_those_of_the_last_seconds(setting: Setting) -> None:
    """Messages and sent bytes per second, averaged over some seconds; older ones do not count."""
    total = 0
    for second in range(20):
        setting.receive(100 if second < 10 else 10, total)
        total += 100 if second < 10 else 10
        setting.uploader.told = replace(setting.uploader.told, sent_bytes=250_000 * second)
        found = setting.poll()
    assert found.topics['/imu'].rate_hz == pytest.approx(10.0)
    assert found.store.mbps == pytest.approx(2.0)
    assert setting.status.earlier
    assert setting.status.earlier.topics['/imu'].received == total - 50


def test_the_status_has_the_state_of_the_spool(setting: Setting) -> None:
    """Pending objects and bytes, their age, and the free space."""
    put(setting.spool, make('thor/a.jpg', b'12345'), make('thor/b.jpg', b'123', held='clock'))
    spool = setting.poll(3.0).spool
    assert (spool.pending, spool.held, spool.bytes, spool.oldest_age_s) == (1, 1, 8, 3.0)
    assert spool.free_bytes
    assert spool.max_bytes == 20 << 30


def test_a_failing_worker_is_reported(setting: Setting) -> None:
    """Each thread has a row: whether it is alive and fails, how often it failed and crashed, and why."""
    worker = setting.intake.worker
    worker.failing, worker.last_error, worker.failures, worker.deaths = True, 'ValueError: x', 3, 1
    workers = setting.poll().workers
    assert workers['intake'] == WorkerStatus(alive=False, failing=True, failures=3, deaths=1, last_error='ValueError: x')
    others = {'encode-0', 'spool-writer', 'upload-lock', 'upload-0', 'mission', 'bag-writer', 'event-writer', 'control'}
    assert set(workers) == {'intake', *others}


def test_a_stall_is_reported(setting: Setting) -> None:
    """Findings of the watchdog are in the status: here a batch that is not taken from the queue."""
    setting.queue.put(Batch('imu', '/imu', 't', (Sample(1, b''),), 1), 5)
    assert setting.poll().stalls == {}
    assert 'no batch was encoded for 11 s' in setting.poll(11.0).stalls['encode']


def test_the_reader_finds_what_was_written(setting: Setting, tmp_path: Path) -> None:
    """The command line's reader finds a running node, with every value, and after the last status that it has stopped."""
    setting.receive(7)
    written = setting.poll()
    setting.status.write(written)
    found = read(tmp_path / 'spool', 'thor', setting.clock)
    assert found.running
    assert found.node == written
    ended = setting.status.poll(ended=True)
    assert ended
    setting.status.write(ended)
    assert read(tmp_path / 'spool', 'thor', setting.clock).state == 'not_running'
    path = file(tmp_path / 'spool', 'thor')
    assert path.stat().st_mode & 0o777 == 0o600
    assert [each.name for each in path.parent.glob('status-*')] == [path.name]


def test_a_write_error_is_logged_once(setting: Setting, caplog: pytest.LogCaptureFixture) -> None:
    """A status that cannot be written is logged once, and does not stop the node."""
    blocked = file(setting.spool.root, 'thor').with_name('status-thor.json.part')
    blocked.mkdir()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            setting.status.write(setting.poll())
    (record,) = caplog.records
    assert 'the status cannot be written' in record.message


def test_an_unreadable_spool_is_logged_once(setting: Setting, caplog: pytest.LogCaptureFixture) -> None:
    """Then no status is written, and the previous one remains, with increasing age."""
    setting.spool.usage = broken  # type: ignore[method-assign]
    with caplog.at_level(logging.WARNING):
        assert setting.status.poll() is None
        assert setting.status.poll() is None
    (record,) = caplog.records
    assert 'the status cannot be gathered' in record.message


def broken() -> Any:
    raise OSError(5, 'Input/output error')
