"""The sender's rounds: outages, many missions, their order, and when it exits."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from missions.fakes import FakePictures, FakeSpooler, FakeTracking, journalling
from missions.server import until

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, Run, missions, read_json
from shadowhound_data_logger.missions.overview import report
from shadowhound_data_logger.missions.replay import (
    LINGER_S,
    RETENTION_S,
    AgentProcess,
    Replay,
    RetryGate,
    SuccessorWatch,
    open_tracking,
    run,
)


class Now:
    """A clock that the test advances."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def new_replay(home: Path, tracking: FakeTracking, now: Now | None = None) -> Replay:
    (home / MISSIONS).mkdir(parents=True, exist_ok=True)
    return Replay(home, tracking, FakeSpooler(), FakePictures(), monotonic=now or Now(), rng=random.Random(1))  # type: ignore[arg-type]


def fly(home: Path, mission_type: str = 'patrol') -> str:
    with journalling(home) as logger:
        mission_id = logger.start_mission(mission_type, '')
        logger.log_metric('a', 1.0)
        logger.end_mission(True, 1.0, 1.0)
    return mission_id


def test_all_missions_are_sent(tmp_path: Path) -> None:
    """Those of every agent that ever logged here; then there is nothing to do."""
    for _ in range(3):
        fly(tmp_path)
    tracking = FakeTracking()
    replay = new_replay(tmp_path, tracking)
    while replay.step():
        pass
    assert [folder.sent().complete for folder in missions(tmp_path)] == [True] * 3
    assert (len(tracking.runs), replay.has_unsent) == (3, False)


@pytest.mark.long('an hour of a simulated outage')
def test_an_outage_is_probed_less_and_less_often(tmp_path: Path) -> None:
    """At most one request per round, pauses up to a minute; the state has the error and the remedy, until it ends."""
    for _ in range(5):
        fly(tmp_path)
    asked: list[float] = []
    now, away = Now(), True
    tracking = FakeTracking(fail=lambda _: bool(asked.append(now())) or away)
    replay = new_replay(tmp_path, tracking, now)
    while now() < 3600:
        replay.step()
        now.seconds += 1.0
    assert 60 < len(asked) < 300
    assert max(later - sooner for sooner, later in pairwise(asked)) <= 61
    assert replay.has_unsent
    newest = max(missions(tmp_path), key=lambda folder: folder.mission_id)
    assert (report(newest).last_error, report(newest).remedy) == ('away (wait)', 'wait')
    away = False
    replay.retry_now()
    while replay.step():
        pass
    assert not replay.has_unsent
    assert read_json(tmp_path / MISSIONS / 'replay.json')['errors'] == {}
    assert report(newest).complete


def test_a_mission_that_begins_ends_a_pause(tmp_path: Path) -> None:
    """Its agent waits two seconds for the run's id, and an outage's pause may take a minute."""
    fly(tmp_path)
    now, away = Now(), True
    tracking = FakeTracking(fail=lambda _: away)
    replay = new_replay(tmp_path, tracking, now)
    for _ in range(20):
        replay.retry_now()
        replay.step()
    away = False
    assert not replay.step()
    assert tracking.runs == {}
    begun = fly(tmp_path)
    replay.step()
    assert begun in tracking.runs


def test_the_newest_mission_comes_first(tmp_path: Path) -> None:
    """An agent that starts does not wait for the backlog of others, whatever its mission is called."""
    old = tmp_path / MISSIONS / fly(tmp_path, 'zzz')
    old.rename(old.with_name('zzz_20200101_000000_00000000'))
    newest = fly(tmp_path, 'aaa')
    tracking = FakeTracking()
    new_replay(tmp_path, tracking).step()
    assert next(iter(tracking.runs)) == newest


def test_a_corrupt_mission_does_not_stop_the_others(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A mission whose first record is damaged is reported and skipped; the others are sent."""
    rotten = fly(tmp_path)
    path = tmp_path / MISSIONS / rotten / 'journal'
    path.write_bytes(b'X' + path.read_bytes()[1:])
    whole = fly(tmp_path)
    tracking = FakeTracking()
    replay = new_replay(tmp_path, tracking)
    while replay.step():
        pass
    assert list(tracking.runs) == [whole]
    assert rotten in caplog.text


def test_a_mission_that_arrived_long_ago_is_deleted(tmp_path: Path) -> None:
    """After a month, at the next start; a newer one, or one that has not arrived, stays."""
    old, young = fly(tmp_path), fly(tmp_path)
    replay = new_replay(tmp_path, FakeTracking())
    while replay.step():
        pass
    unsent = fly(tmp_path)
    (tmp_path / MISSIONS / unsent / 'sent.json').write_text('{}')
    for mission_id in (old, unsent):
        os.utime(tmp_path / MISSIONS / mission_id / 'sent.json', (0, time.time() - RETENTION_S - 60))
    new_replay(tmp_path, FakeTracking(fail=lambda _: True)).step()
    assert {folder.mission_id for folder in missions(tmp_path)} == {young, unsent}


def test_the_default_store_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the owner can read the database and the artifacts of a home, whatever the umask."""
    monkeypatch.delenv('MLFLOW_TRACKING_URI', raising=False)
    monkeypatch.setattr('shadowhound_data_logger.missions.replay.MlflowTracking.open', lambda _: None)
    before = os.umask(0)
    try:
        tracking = open_tracking(tmp_path, 'x')
    finally:
        os.umask(before)
    assert tracking.where == f'sqlite:///{tmp_path}/mlflow.db'
    assert [oct((tmp_path / name).stat().st_mode & 0o777) for name in ('mlflow.db', 'mlartifacts')] == ['0o600', '0o700']


def test_a_deleted_run_is_reported(tmp_path: Path) -> None:
    """Its mission is not changed, and the report has the reason."""
    mission_id = fly(tmp_path)
    replay = new_replay(tmp_path, FakeTracking(gone=True))
    while replay.step():
        pass
    (folder,) = missions(tmp_path)
    assert (folder.mission_id, folder.sent().complete) == (mission_id, False)
    assert 'deleted' in report(folder).last_error


def test_pauses_grow_to_a_minute_and_end_with_a_success() -> None:
    """Full jitter: between zero and the cap, which doubles."""
    now = Now()
    gate = RetryGate(now, random.Random(2))
    longest = 0.0
    for _ in range(200):
        gate.failed(OSError('away'))
        began = now()
        while not gate.is_open:
            now.seconds += 0.1
        longest = max(longest, now() - began)
    assert 50 < longest <= 60.2
    gate.worked()
    assert gate.is_open
    assert gate.error is None


def test_the_sender_exits_after_its_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Immediately when everything is sent; after ten minutes when nothing can be sent."""
    fly(tmp_path)
    now = Now()
    monkeypatch.setattr('shadowhound_data_logger.missions.replay.time.monotonic', now)
    monkeypatch.setattr(
        'shadowhound_data_logger.missions.replay.time.sleep', lambda seconds: setattr(now, 'seconds', now() + seconds)
    )
    reader, writer = os.pipe()
    os.close(writer)
    parent = AgentProcess(reader)
    parent.wait(0.0)
    assert parent.gone
    run(new_replay(tmp_path, FakeTracking(fail=lambda _: True), now), parent, lambda: False)
    assert LINGER_S <= now() <= LINGER_S + 60
    before = now()
    run(new_replay(tmp_path, FakeTracking(), now), parent, lambda: False)
    assert now() - before < 1.0
    os.close(reader)


def test_a_byte_wakes_the_sender() -> None:
    """And the end of its input means that the agent has exited."""
    reader, writer = os.pipe()
    parent = AgentProcess(reader)
    os.write(writer, b'\n')
    assert parent.wait(60.0)
    assert not parent.wait(0.0)
    os.close(writer)
    assert not parent.wait(5.0)
    assert parent.gone
    os.close(reader)


def test_a_second_sender_waits_and_exits_with_its_agent(tmp_path: Path) -> None:
    """One per home sends."""
    (tmp_path / MISSIONS).mkdir()
    with flock(tmp_path / MISSIONS / 'replay.lock', wait=False) as mine:
        assert mine
        command = [sys.executable, '-m', 'shadowhound_data_logger.missions.replay', '--home', str(tmp_path), '--experiment', 'x']
        waiting = subprocess.Popen(command, stdin=subprocess.PIPE)
        assert waiting.stdin is not None
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.wait(1.0)
        waiting.stdin.close()
        assert waiting.wait(60.0) == 0


def test_a_sender_whose_agent_has_exited_yields_to_another(tmp_path: Path) -> None:
    """It yields as soon as another sender waits, but not while its own agent runs; a hanging request ends with its process."""
    waiting, ends = tmp_path / 'replay.waiting', threading.Event()
    reader, writer = os.pipe()
    parent = AgentProcess(reader)
    successor = SuccessorWatch(waiting, parent, lambda _: ends.set())
    successor.start()
    try:
        with flock(waiting, shared=True):
            fly(tmp_path)
            replay, looks = new_replay(tmp_path, FakeTracking(fail=lambda _: True)), iter([False, False, True])
            run(replay, parent, lambda: successor.is_waiting or next(looks))
            assert not successor.is_waiting
            os.close(writer)
            run(replay, parent, lambda: successor.is_waiting)
            assert ends.wait(60.0)
    finally:
        successor.stop()
        os.close(reader)


@pytest.mark.long('two processes that load MLflow')
def test_a_corrected_address_is_used_although_an_earlier_sender_is_stuck(tmp_path: Path) -> None:
    """The address of an agent that was killed does not respond; the sender of the next agent takes over and sends the mission."""
    mission_id = fly(tmp_path)
    command = [sys.executable, '-m', 'shadowhound_data_logger.missions.replay', '--home', str(tmp_path), '--experiment', 'x']
    with socket.create_server(('127.0.0.1', 0)) as silent, ExitStack() as running:
        environ = {**os.environ, 'MLFLOW_TRACKING_URI': f'http://127.0.0.1:{silent.getsockname()[1]}'}
        first = running.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, env=environ))
        running.callback(first.kill)
        assert first.stdin is not None
        silent.settimeout(60.0)
        asked, _ = silent.accept()
        running.callback(asked.close)
        first.stdin.close()
        environ['MLFLOW_TRACKING_URI'] = f'sqlite:///{tmp_path}/mlflow.db'
        second = running.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, env=environ))
        running.callback(second.kill)
        assert first.wait(60.0) == 0
        until(lambda: MissionFolder(tmp_path / MISSIONS / mission_id).sent().complete, 'the mission is sent', 120.0)


def test_the_logger_restarts_the_sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sender that crashes is restarted after a pause, is never a zombie, and exits with its logger."""
    monkeypatch.setattr('shadowhound_data_logger.missions.child.RESTART_PAUSE_S', 0.1)
    monkeypatch.setattr('shadowhound_data_logger.missions.child.interpreter', lambda: '/bin/false')
    logger = MissionDataLogger(home=tmp_path, start_timeout_s=0.0)
    try:
        first = logger._replayer._process  # type: ignore[union-attr]
        until(lambda: logger._replayer._process is not first, 'another is started')  # type: ignore[union-attr]
        assert first is not None
        assert first.returncode == 1
    finally:
        logger.close()


@pytest.mark.parametrize('what', ['journal', 'artifact'])
def test_a_mission_that_always_fails_blocks_no_other(tmp_path: Path, what: str) -> None:
    """A journal that the disk cannot read, an artifact that the server never accepts: the older missions arrive."""
    for number in range(3):
        older = tmp_path / MISSIONS / fly(tmp_path)
        older.rename(older.with_name(f'patrol_20200101_00000{number}_00000000'))
    stuck = tmp_path / MISSIONS / fly(tmp_path, 'stuck')
    now, tracking = Now(), FakeTracking()
    replay = new_replay(tmp_path, tracking, now)
    if what == 'journal':
        (stuck / 'journal').unlink()
        (stuck / 'journal').mkdir()
    else:
        send = tracking.artifact

        def artifact(run: Run, path: Path, folder: str) -> None:
            if run.run_id == tracking.runs[stuck.name].run_id:
                raise TrackingUnavailable('too large')
            send(run, path, folder)

        tracking.artifact = artifact  # type: ignore[method-assign]
    for _ in range(60):
        now.seconds += 61.0
        replay.step()
    assert [folder.sent().complete for folder in missions(tmp_path) if folder.path != stuck] == [True] * 3


def test_a_mission_that_cannot_be_sent_reports_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`missions list` shows the cause, not only the log."""
    broken = MissionFolder(tmp_path / MISSIONS / fly(tmp_path))
    monkeypatch.setattr(Delivery, 'track', lambda _: 1 / 0)
    replay = new_replay(tmp_path, FakeTracking(), Now())
    replay.step()
    assert broken.sent().error == 'ZeroDivisionError: division by zero'


def test_a_full_disk_does_not_end_the_sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It continues although it cannot write its state, because sending frees space."""
    fly(tmp_path)
    replay = new_replay(tmp_path, FakeTracking())

    def full(*_: object, **__: object) -> None:
        raise OSError(28, 'No space left on device')

    with monkeypatch.context() as patched:
        patched.setattr('shadowhound_data_logger.missions.replay.write_json', full)
        while replay.step():
            pass
    assert [folder.sent().complete for folder in missions(tmp_path)] == [True]
    replay.step()
    assert read_json(tmp_path / MISSIONS / 'replay.json')['errors'] == {}


def test_an_unreadable_mission_stops_no_other(tmp_path: Path) -> None:
    """If its disk fails or another process deletes it at that moment, the others are still sent."""
    rotten, whole = fly(tmp_path), fly(tmp_path)

    def settle(folder: MissionFolder) -> bool:
        if folder.mission_id == rotten:
            raise OSError(5, 'Input/output error')
        return True

    (tmp_path / MISSIONS).mkdir(exist_ok=True)
    replay = Replay(tmp_path, FakeTracking(), FakeSpooler(), FakePictures(), settle=settle)  # type: ignore[arg-type]
    while replay.step():
        pass
    assert {folder.mission_id: folder.sent().complete for folder in missions(tmp_path)} == {rotten: False, whole: True}
    assert replay.has_unsent
