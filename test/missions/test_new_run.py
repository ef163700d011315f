"""A new mission has its run before MLflow is loaded: created by the agent over REST, once, whatever fails."""

from __future__ import annotations

import os
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from e2e.wire import HANG, PASS, REFUSE, Wire
from missions.fakes import FakePictures, FakeSpooler, FakeTracking, journalling
from missions.server import Server, complete, until
from tls_front import Authority, behind_tls

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions import journal, mission, new_run
from shadowhound_data_logger.missions.child import Replayer
from shadowhound_data_logger.missions.delivery import RUN_CREATION_TIMEOUT_S, Delivery
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, Run, missions, read_json
from shadowhound_data_logger.missions.new_run import NewRun, RunRequests
from shadowhound_data_logger.missions.replay import Replay
from shadowhound_data_logger.missions.tracking import MISSION_TAG

RUN = Run('0123456789abcdef0123456789abcdef', '1', 'mlflow-artifacts:/1/0123/artifacts')
PATIENCE_S = 30.0
"""For a server on a machine that is busy with other tests."""


def ended(logger: MissionDataLogger) -> None:
    logger.end_mission(True, 1.0, 1.0)
    logger.close()


@pytest.mark.seaweedfs
def test_a_mission_has_its_run_before_mlflow_is_loaded(server: Server, home: Path) -> None:
    """Right after the constructor; the sender, which starts at the same time, creates no second one, and sends everything."""
    logger = MissionDataLogger(home=home, start_timeout_s=PATIENCE_S)
    given = logger.start_mission('patrol', 'before MLflow')
    assert not (home / MISSIONS / 'replay.json').exists(), 'the sender is there already'
    run = server.run('before MLflow') if server.runs('before MLflow') else server.client.get_run(given)
    assert run.info.run_id == given
    (folder,) = missions(home)
    start = journal.first(folder.journal)
    assert (run.info.run_name, run.info.start_time) == (folder.mission_id.rpartition('_')[0], start['t'] // 1_000_000)
    assert {name: run.data.tags[name] for name in (MISSION_TAG, 'mlflow.user', 'mlflow.source.name')} == {
        MISSION_TAG: folder.mission_id, 'mlflow.user': 'thor', 'mlflow.source.name': 'shadowhound_data_logger',
    }  # fmt: skip
    logger.log_artifact(__file__)
    logger.end_mission(True, 1.0, 1.0)
    assert logger.close(120.0).complete
    assert server.run('before MLflow').info.run_id == given
    assert server.artifacts(given) >= {'test_new_run.py', 'summary.json'}


@pytest.mark.seaweedfs
def test_starting_a_mission_costs_one_request(server: Server, warm_home: Path) -> None:
    """The experiment is looked up by the constructor, and both take little CPU; bench/mission_calls.py measures the time."""
    received = bytearray()
    with Wire(server.tower.tracking_uri, received.extend) as wire:
        logger = MissionDataLogger(home=warm_home, start_timeout_s=PATIENCE_S, tracking_uri=wire.url)
        began_s = time.process_time()
        first = logger.start_mission('patrol', 'a request 1')
        second = logger.start_mission('patrol', 'a request 2')
        took_s = time.process_time() - began_s
        ended(logger)
    assert re.findall(rb'(?:GET|POST) /api/2.0/mlflow/([a-z-]+/[a-z-]+)', bytes(received)) == [
        b'experiments/get-by-name', b'runs/create', b'runs/create',
    ]  # fmt: skip
    assert took_s < 0.2
    until(lambda: complete(warm_home, 2), 'both are sent')
    assert [server.run(f'a request {number}').info.run_id for number in (1, 2)] == [first, second]


def test_the_sender_is_woken_after_the_request(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that loading MLflow takes no CPU from it."""
    events: list[str] = []

    def settle(_: RunRequests, new: NewRun, __: object) -> None:
        new.settle(RUN)
        events.append('settled')

    monkeypatch.setattr(RunRequests, 'prepare', lambda _: None)
    monkeypatch.setattr(RunRequests, 'create', settle)
    monkeypatch.setattr(Replayer, 'start', lambda _: None)
    monkeypatch.setattr(Replayer, 'wake', lambda _: events.append('woken'))
    logger = MissionDataLogger(home=home, tracking_uri='http://127.0.0.1:9')
    assert events == []
    assert logger.start_mission('patrol', '') == RUN.run_id
    assert events == ['settled', 'woken']
    ended(logger)


@pytest.mark.seaweedfs
def test_many_missions_in_a_row_have_a_run_each(server: Server, warm_home: Path) -> None:
    """The agent and the sender process the same missions at the same time."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=PATIENCE_S)
    given = []
    for number in range(10):
        given.append(logger.start_mission('patrol', f'in a row {number}'))
        logger.end_mission(True, 1.0, 1.0)
    logger.close()
    until(lambda: complete(warm_home, 10), 'all are sent')
    assert [server.run(f'in a row {number}').info.run_id for number in range(10)] == given


@pytest.mark.seaweedfs
@pytest.mark.long('four senders')
def test_an_experiment_is_created_once(server: Server, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the first of several loggers; the others use it. A user in the URL is recorded."""
    login, experiment = server.tower.tracking('tower'), f'once {tmp_path.name}'
    address = f'//{login["MLFLOW_TRACKING_USERNAME"]}:{login["MLFLOW_TRACKING_PASSWORD"]}@'
    options = {'home': home, 'tracking_uri': server.wire.url.replace('//', address) + '/', 'experiment': experiment}
    with monkeypatch.context() as patched:
        for name in ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'):
            patched.delenv(name)
        loggers = [MissionDataLogger(start_timeout_s=PATIENCE_S, **options) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: each.start_mission('patrol', experiment), loggers))
    for each in loggers:
        ended(each)
    for name, value in login.items():
        monkeypatch.setenv(name, value)
    experiments = {server.client.get_run(run_id).info.experiment_id for run_id in found}
    assert len(experiments) == 1
    assert server.client.get_experiment(experiments.pop()).name == experiment


@pytest.mark.seaweedfs
@pytest.mark.parametrize('mode', [REFUSE, (200, 'Portal'), (503, 'Broken')])
def test_without_a_server_the_mission_starts_immediately(server: Server, home: Path, mode: str | tuple[int, str]) -> None:
    """It has its own id, and starts as soon as the server is known to be unreachable."""
    server.wire.set(mode)
    logger = MissionDataLogger(home=home, start_timeout_s=1.0)
    began = time.monotonic()
    assert logger.start_mission('patrol', 'no server').startswith('patrol_')
    assert time.monotonic() - began < 5.0
    ended(logger)
    until(lambda: read_json(home / MISSIONS / 'replay.json').get('pid'), 'the sender is there, which the test must end')


@pytest.mark.seaweedfs
@pytest.mark.long('a request that is given up')
def test_a_server_that_hangs_blocks_no_mission(server: Server, home: Path) -> None:
    """The call takes no longer than its timeout; the run is created once, when the server responds again."""
    server.wire.set(HANG)
    logger = MissionDataLogger(home=home, start_timeout_s=0.3)
    began = time.monotonic()
    given = logger.start_mission('patrol', 'hung')
    assert 0.25 < time.monotonic() - began < 3.0
    server.wire.set(PASS)
    logger.end_mission(True, 1.0, 1.0)
    assert logger.close(120.0).complete
    assert server.run('hung').data.tags[MISSION_TAG] == given


@pytest.mark.seaweedfs
def test_a_run_that_was_not_saved_is_found(server: Server, warm_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after a kill between the server's answer and the disk: the sender finds it by the mission's id."""
    monkeypatch.setattr(MissionFolder, 'set_run', lambda *_: None)
    logger = MissionDataLogger(home=warm_home, start_timeout_s=PATIENCE_S)
    given = logger.start_mission('patrol', 'not noted')
    ended(logger)
    until(lambda: complete(warm_home), 'it is sent')
    assert server.run('not noted').info.run_id == given


@pytest.mark.seaweedfs
@pytest.mark.long('a sender of its own')
def test_a_run_is_created_behind_tls(server: Server, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a CA file relative to the agent's folder: for the run, and for everything that the sender sends."""
    authority = Authority(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('MLFLOW_TRACKING_SERVER_CERT_PATH', authority.path.name)
    with behind_tls(server.tower.tracking_uri, authority.sign('tower')) as front:
        logger = MissionDataLogger(home=home, start_timeout_s=PATIENCE_S, tracking_uri=front.url)
        given = logger.start_mission('patrol', 'behind TLS')
        monkeypatch.chdir('/')
        logger.log_artifact(__file__)
        logger.end_mission(True, 1.0, 1.0)
        report = logger.close(120.0)
    assert report.complete, report
    assert server.run('behind TLS').info.run_id == given


# -- the lock ------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> MissionFolder:
    """A mission that has ended."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_metric('a', 1.0)
    return next(missions(tmp_path))


class Clock:
    """A monotonic clock set by the test."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def test_the_sender_waits_for_the_agents_request(folder: MissionFolder) -> None:
    """Until then it sends and creates nothing, and then uses the agent's run."""
    new, tracking = NewRun(folder), FakeTracking()
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    for _ in range(3):
        assert not delivery.track()
    new.settle(RUN)
    while not delivery.complete():
        for work in (delivery.track, delivery.attach, delivery.spool):
            work()
    assert (tracking.runs, delivery.run, [run_id for run_id, *_ in tracking.finished]) == ({}, RUN, [RUN.run_id])


@pytest.mark.parametrize('how', ['failed', 'killed', 'hung'])
def test_the_sender_creates_the_run_when_the_agent_could_not(folder: MissionFolder, how: str) -> None:
    """After a failure, the agent's exit, or 30 seconds."""
    new, tracking, clock = NewRun(folder), FakeTracking(), Clock()
    delivery = Delivery(folder, tracking, FakeSpooler(), monotonic=clock)  # type: ignore[arg-type]
    assert not delivery.track()
    if how == 'failed':
        new.settle()
    elif how == 'killed':
        os.close(new._descriptor)
    else:
        clock.seconds = RUN_CREATION_TIMEOUT_S + 1.0
    assert delivery.track()
    assert list(tracking.runs) == [folder.mission_id]
    if how == 'hung':
        new.settle()


def test_the_sender_keeps_running_for_the_agents_request(tmp_path: Path, folder: MissionFolder) -> None:
    """Even if the agent has closed its logger before its request ends, the mission is still sent."""
    new, tracking = NewRun(folder), FakeTracking()
    replay = Replay(tmp_path, tracking, FakeSpooler(), FakePictures())  # type: ignore[arg-type]
    replay.step()
    assert replay.has_unsent
    new.settle()
    while replay.step():
        pass
    assert not replay.has_unsent
    assert folder.sent().complete


def test_a_file_system_without_folder_locks_is_supported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Missions are logged and sent as if there were no shortcut."""
    is_locked = journal.is_locked

    def refuse(where: Path | int, **_: object) -> bool:
        if isinstance(where, int) or where.is_dir():
            raise OSError(9, 'Bad file descriptor')
        return is_locked(where)

    monkeypatch.setattr(Replayer, 'start', lambda _: None)
    monkeypatch.setattr(new_run, 'lock', refuse)
    monkeypatch.setattr(journal, 'is_locked', refuse)
    logger = MissionDataLogger(home=tmp_path, start_timeout_s=0.0, tracking_uri='http://127.0.0.1:9', replay=True)
    logger.start_mission('patrol', '')
    ended(logger)
    (found,) = missions(tmp_path)
    assert [(line.record or {})['k'] for line in found.lines()] == ['start', 'end']
    delivery = Delivery(found, FakeTracking(), FakeSpooler())  # type: ignore[arg-type]
    assert not delivery._agent_creates_run()


def test_a_fork_does_not_keep_the_mission_open(folder: MissionFolder) -> None:
    """A process that was forked during the request has a copy of the lock, which ends with the request."""
    new = NewRun(folder)
    copy = os.dup(new._descriptor)  # as in a forked process
    try:
        new.settle()
        assert not journal.is_locked(folder.path)
    finally:
        os.close(copy)


def test_a_mission_without_a_date_has_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run's start cannot be changed later: it is created once the clock is set."""
    asked: list[object] = []
    monkeypatch.setattr(RunRequests, 'prepare', lambda _: None)
    monkeypatch.setattr(RunRequests, 'create', lambda *arguments: asked.append(arguments))
    monkeypatch.setattr(mission, 'now_ns', lambda _: 10**9)
    monkeypatch.setattr(Replayer, 'start', lambda _: None)
    logger = MissionDataLogger(home=tmp_path, start_timeout_s=0.0, tracking_uri='http://127.0.0.1:9')
    logger.start_mission('patrol', '')
    logger.close()
    assert asked == []


@pytest.mark.parametrize(('environ', 'can'), [
    ({}, False), ({'MLFLOW_TRACKING_URI': 'sqlite:///a.db'}, False), ({'MLFLOW_TRACKING_URI': './mlruns'}, False),
    ({'MLFLOW_TRACKING_URI': 'databricks'}, False), ({'MLFLOW_TRACKING_URI': 'http://tower:5001'}, True),
    ({'MLFLOW_TRACKING_URI': 'https://tower', 'MLFLOW_TRACKING_AWS_SIGV4': 'true'}, False),
    ({'MLFLOW_TRACKING_URI': 'https://tower', 'MLFLOW_TRACKING_AWS_SIGV4': 'false'}, True),
    ({'MLFLOW_TRACKING_URI': 'https://tower', 'MLFLOW_TRACKING_AUTH': 'kubernetes'}, False),
])  # fmt: skip
def test_only_servers_that_take_plain_requests_are_asked(environ: dict[str, str], can: bool) -> None:
    """Others are left to MLflow's client."""
    assert RunRequests.is_supported(environ) is can
