"""Missions against a real MLflow server and a real S3 server, through the process that sends them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from e2e.wire import HANG, PASS, REFUSE
from missions.agent import FRAME_EVERY, jpeg
from missions.server import Server, complete, until

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.missions.folder import MISSIONS, missions, read_json
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.tracking import DUPLICATE_TAG, MISSION_TAG, MlflowTracking

pytestmark = pytest.mark.seaweedfs


def fly(logger: MissionDataLogger, command: str, tmp_path: Path) -> str:
    """A short mission, by the guide's calls."""
    csv = tmp_path / 'trajectory.csv'
    csv.write_text('timestamp,x,y,yaw\n1,2,3,4\n')
    given = logger.start_mission('patrol', command)
    for number in range(20):
        logger.log_robot_state(90.0 - number, 40.0 + number, number)
    logger.log_camera_frame(jpeg(0), 0)
    logger.log_camera_frame(jpeg(1), 1)
    logger.log_trajectory(str(csv))
    logger.end_mission(True, 12.5, 60.0)
    return given


def check(server: Server, command: str, home: Path) -> None:
    """All of ``fly`` is in MLflow and in the store, with its own times."""
    run = server.run(command)
    (folder,) = [folder for folder in missions(home) if (found := folder.run()) and found.run_id == run.info.run_id]
    times = [line.record['t'] // 1_000_000 for line in read(folder.journal) if line.record]
    assert (run.info.status, run.info.start_time, run.info.end_time) == ('FINISHED', times[0], times[-1])
    assert run.info.run_name == folder.mission_id.rpartition('_')[0]
    assert run.data.tags['shadowhound.mission_id'] == folder.mission_id
    assert run.data.params == {'mission_type': 'patrol', 'mission_command': command, 'robot': 'thor',
                               'timestamp': run.data.params['timestamp'], 'duration_s': '60.000'}  # fmt: skip
    assert run.data.metrics == {
        'battery_pct': 71.0, 'temperature_c': 59.0, 'camera_frame_0': 1.0, 'camera_frame_1': 1.0, 'camera_frames': 2.0,
        'success': 1.0, 'distance_m': 12.5, 'distance_traveled_m': 12.5, 'duration_s': 60.0, 'battery_consumed_pct': 19.0,
    }  # fmt: skip
    battery = server.history(run.info.run_id, 'battery_pct')
    assert [(point.step, point.value, point.timestamp) for point in battery] == [(n, 90.0 - n, times[n + 1]) for n in range(20)]
    artifacts = {'camera/frame_000000.jpg', 'trajectories/trajectory.csv', 'summary.json', 'battery.png'}
    assert server.artifacts(run.info.run_id) == artifacts
    prefix = f'thor/missions/{run.info.run_id}'
    assert server.keys(prefix) == {f'{prefix}/{name}': 1 for name in (
        'camera/frame_000000.jpg', 'camera/frame_000001.jpg', 'trajectory.csv', 'summary.json')}  # fmt: skip
    assert server.keys(f'thor/{run.info.run_name}', 'trajectories') == {f'thor/{run.info.run_name}.csv': 1}


def test_a_mission_is_in_mlflow_and_in_the_store(server: Server, warm_home: Path, tmp_path: Path) -> None:
    """All of it, and the id that start_mission gave is the run's."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    given = fly(logger, 'whole', tmp_path)
    report = logger.close(60.0)
    assert (report.complete, report.unsent, report.last_error) == (True, 0, '')
    assert given == report.run_id == server.run('whole').info.run_id
    until(lambda: len(server.keys(f'thor/missions/{given}')) == 4, 'the objects are delivered')
    check(server, 'whole', warm_home)


@pytest.mark.long('seconds of a heartbeat')
def test_a_run_lives_while_its_mission_does(server: Server, warm_home: Path) -> None:
    """What was logged is in the run before the mission ends, and a mission of another logger has a separate run."""
    one, two = (MissionDataLogger(home=warm_home, start_timeout_s=60.0) for _ in range(2))
    try:
        first, second = one.start_mission('patrol', 'live 1'), two.start_mission('patrol', 'live 2')
        one.log_metric('a', 1.5, step=3)
        two.log_metric('a', 2.5, step=4)
        assert one.flush(60.0).unsent == two.flush(60.0).unsent == 0
        assert [server.run(f'live {n}').data.metrics['a'] for n in (1, 2)] == [1.5, 2.5]
        assert server.run('live 1').info.status == 'RUNNING'
        assert {first, second} == {server.run(f'live {n}').info.run_id for n in (1, 2)}
    finally:
        for logger in (one, two):
            logger.end_mission(True, 0, 0)
            logger.close()
    until(lambda: complete(warm_home, 2), 'both are sent')


@pytest.mark.slow
@pytest.mark.long('a kill')
def test_tower_unreachable_for_the_whole_mission(server: Server, home: Path, tmp_path: Path) -> None:
    """No call waits for it; when it is back, after the robot's next start, the run is whole with the original times."""
    server.wire.set(HANG)
    logger = MissionDataLogger(home=home, start_timeout_s=0.3)
    began = time.monotonic()
    given = fly(logger, 'away', tmp_path)
    logger.close()
    assert time.monotonic() - began < 5.0
    assert (home / MISSIONS / given / 'journal').is_file()
    until(lambda: read_json(home / MISSIONS / 'replay.json').get('errors'), 'the replayer says what is wrong')
    os.kill(read_json(home / MISSIONS / 'replay.json')['pid'], signal.SIGKILL)  # the robot is switched off
    server.wire.set(PASS)
    again = MissionDataLogger(home=home)
    until(lambda: complete(home), 'it is sent')
    again.close()
    run_id = server.run('away').info.run_id
    assert read_json(home / MISSIONS / given / 'run.json')['run_id'] == run_id
    until(lambda: len(server.keys(f'thor/missions/{run_id}')) == 4, 'the objects are delivered')
    check(server, 'away', home)
    until(lambda: not read_json(home / MISSIONS / 'replay.json')['pid'], 'the sender ends after its agent')


@pytest.mark.long('a kill')
def test_a_killed_agent_s_mission(server: Server, home: Path, tmp_path: Path) -> None:
    """One run, KILLED at its last record; each point and frame that a call had returned for is there, and once."""
    csv = tmp_path / 'trajectory.csv'
    csv.write_text('timestamp,x,y,yaw\n')
    server.wire.set(REFUSE)
    command = 'killed'
    agent = subprocess.Popen(
        [sys.executable, '-m', 'missions.agent', str(home), command, str(csv)], stdout=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(Path(__file__).parents[1])},
    )  # fmt: skip
    assert agent.stdout is not None
    for line in agent.stdout:
        if line.strip() == '300':
            agent.kill()
    agent.wait()
    agent.stdout.close()
    server.wire.set(PASS)
    until(lambda: complete(home), 'its replayer sends it')
    run = server.run(command)
    (folder,) = missions(home)
    said = [line.record for line in read(folder.journal) if line.record]
    assert (run.info.status, run.info.end_time) == ('KILLED', said[-1]['t'] // 1_000_000)
    steps = [point.step for point in server.history(run.info.run_id, 'battery_pct')]
    assert steps == list(range(len(steps)))
    assert len(steps) > 300
    frames = {record['id'] for record in said if record['k'] == 'frame'}
    assert frames >= set(range(0, 301, FRAME_EVERY))
    wanted = {f'camera/frame_{number:06d}.jpg' for number in frames}
    wanted |= {'summary.json', 'trajectories/trajectory.csv', 'battery.png'}
    assert server.artifacts(run.info.run_id) == wanted
    prefix = f'thor/missions/{run.info.run_id}/camera/'
    until(lambda: len(server.keys(prefix)) == len(frames), 'the frames are delivered')
    assert server.keys(prefix) == {f'{prefix}frame_{number:06d}.jpg': 1 for number in frames}


@pytest.mark.long('an outage of some seconds')
def test_a_wrong_password_costs_no_mission(server: Server, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mission waits, and reports the reason; once the right one is in ~/.mlflow/credentials it is sent, without a restart."""
    user, password = (os.environ[name] for name in ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'))
    for name in ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'):
        monkeypatch.delenv(name)
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / '.mlflow').mkdir()

    def put(word: str) -> None:
        part = tmp_path / 'part'
        part.write_text(f'[mlflow]\nmlflow_tracking_username = {user}\nmlflow_tracking_password = {word}\n')
        part.replace(tmp_path / '.mlflow/credentials')

    put('mistyped')
    with closing(MissionDataLogger(home=home)) as logger:
        logger.start_mission('patrol', 'with a wrong password')
        logger.log_metric('a', 1.0, step=0)
        logger.end_mission(True, 1.0, 1.0)
        wrong = until(lambda: read_json(home / MISSIONS / 'replay.json').get('errors'), 'the sender says what is wrong')
        assert 'MLFLOW_TRACKING_PASSWORD' in wrong['tracking']['remedy']
        assert 'mistyped' not in str(wrong) + (home / MISSIONS / 'replay.log').read_text()
        assert not complete(home)
        put(password)
        until(lambda: complete(home), 'it is sent')
    assert server.run('with a wrong password').data.metrics['a'] == 1.0


def test_a_second_run_is_closed_where_it_may_not_be_deleted(server: Server) -> None:
    """A robot deletes nothing on a Tower with passwords: the run stays, ended and tagged, and is not taken for the mission's."""
    tracking = MlflowTracking(server.wire.url, 'thor_missions')
    run = tracking.run_of('twice', 'patrol', 1, {})
    second = server.client.create_run(run.experiment_id, start_time=0, tags={MISSION_TAG: 'twice'})
    tracking.finish(run.run_id, 'twice', 'FINISHED', 2)
    closed = server.client.get_run(second.info.run_id)
    assert (closed.info.status, closed.data.tags[DUPLICATE_TAG]) == ('KILLED', run.run_id)
    assert tracking.run_of('twice', 'patrol', 1, {}) == run


def test_an_experiment_that_a_robot_may_not_make(server: Server) -> None:
    """The mission waits for it, and the remedy names who creates it."""
    with pytest.raises(TrackingUnavailable, match=r'^there is no experiment of_another') as caught:
        MlflowTracking(server.wire.url, 'of_another').run_of('patrol_1', 'patrol', 1, {})
    assert 'make tower-secrets' in caught.value.remedy


def test_artifacts_in_s3(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If artifacts are in S3, the error names the missing variable, and with it they arrive."""
    uri = f'file://{tmp_path}/mlruns'  # a Tower's own server does not allow this
    MlflowTracking(uri, '').open()
    type(server.client)(uri).create_experiment('in s3', artifact_location='s3://sensor-data/mlflow')
    tracking = MlflowTracking(uri, 'in s3')
    run = tracking.run_of('patrol_1', 'patrol', 1, {})
    path = tmp_path / 'frame_000000.jpg'
    path.write_bytes(jpeg(0))
    for name in ('MLFLOW_S3_ENDPOINT_URL', 'AWS_ENDPOINT_URL'):
        monkeypatch.delenv(name)
    with pytest.raises(TrackingUnavailable, match='MLFLOW_S3_ENDPOINT_URL') as caught:
        tracking.artifact(run, path, 'camera')
    assert 'MLFLOW_S3_ENDPOINT_URL' in caught.value.remedy
    monkeypatch.setenv('MLFLOW_S3_ENDPOINT_URL', server.tower.endpoint_url)
    tracking.artifact(run, path, 'camera')
    key = f'mlflow/{run.run_id}/artifacts/camera/frame_000000.jpg'
    assert server.keys('mlflow/') == {key: 1}
    monkeypatch.setenv('MLFLOW_S3_ENDPOINT_URL', 'http://127.0.0.1:9')
    with pytest.raises(TrackingUnavailable, match='s3://sensor-data/mlflow') as caught:
        MlflowTracking(uri, 'in s3').artifact(run, path, 'camera')
    assert 'MLFLOW_S3_ENDPOINT_URL' in caught.value.remedy


def test_a_file_that_a_proxy_never_takes_is_refused(server: Server, tmp_path: Path) -> None:
    """If it were retried indefinitely, it would block everything after it."""
    tracking = MlflowTracking(server.wire.url, 'thor_missions')
    run = tracking.run_of('patrol_1', 'patrol', 1, {})
    path = tmp_path / 'map.png'
    path.write_bytes(jpeg(0))
    tracking.artifact(run, path, '')
    server.wire.set((413, 'Request Entity Too Large'))
    with pytest.raises(TrackingRefused, match='413'):
        tracking.artifact(run, path, '')


@pytest.mark.parametrize('mode', [REFUSE, HANG, (200, 'Portal'), (403, 'Forbidden'), (500, 'Broken'), (404, 'Elsewhere')])
def test_an_invalid_server_is_retried(server: Server, mode: str | tuple[int, str]) -> None:
    """Whatever answers, or does not: the mission waits, and the error has a remedy and no password."""
    server.wire.set(mode)
    tracking = MlflowTracking(server.wire.url.replace('//', '//thor:very@secret@'), 'thor_missions')
    with pytest.raises(TrackingUnavailable) as caught:
        tracking.run_of('patrol_1', 'patrol', 0, {})
    assert 'MLFLOW_TRACKING_' in caught.value.remedy
    assert 'secret' not in str(caught.value)
