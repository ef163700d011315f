"""Missions against every supported kind of MLflow server, each a real one."""

from __future__ import annotations

import json
import os
import pwd
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Final

import pytest
from e2e.wire import HANG, PASS, REFUSE
from missions.agent import FRAME_EVERY, jpeg
from missions.server import FOREIGN, Server, complete, until
from missions.voyage import POINTS as VOYAGE_POINTS
from shadowhound_tower.servers import Ports
from shadowhound_tower.servers import Server as TrackingServer

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.missions.folder import MISSIONS, Run, missions, read_json
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.state import Point
from shadowhound_data_logger.missions.tracking import DUPLICATE_TAG, MISSION_TAG, MlflowTracking

POINTS = [Point('battery_pct', 90.0 - number, 1_760_788_800_000 + number, number) for number in range(5)]


@pytest.fixture(scope='module')
def database(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A SQLite file, with tables that take a second to create; each test has a separate experiment in it."""
    return f'sqlite:///{tmp_path_factory.mktemp("local")}/mlflow.db'


def run_of(tracking: MlflowTracking) -> Run:
    return tracking.run_of('patrol_1', 'patrol', 1_760_788_800_000, {'mlflow.user': 'thor'})


@pytest.fixture(params=[pytest.param('sqlite', marks=pytest.mark.long('makes a database of MLflow')), 'file'])
def tracking(request: pytest.FixtureRequest, database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MlflowTracking:
    monkeypatch.setenv('MLFLOW_ALLOW_FILE_STORE', 'true')
    monkeypatch.setenv('MLFLOW_DISABLE_TELEMETRY', 'true')
    uri = database if request.param == 'sqlite' else (tmp_path / 'mlruns').as_uri()
    return MlflowTracking(uri, 'thor_missions', tmp_path / 'artifacts')


@pytest.mark.filterwarnings('ignore')
def test_a_mission_sent_twice_is_there_once(tracking: MlflowTracking, tmp_path: Path) -> None:
    """A second replayer finds the run; points, params and artifacts are unchanged. A plain folder stores a point twice."""
    artifact = tmp_path / 'summary.json'
    artifact.write_text('{}')
    again = MlflowTracking(tracking._uri, 'thor_missions', tmp_path / 'artifacts')
    for one in (tracking, again):
        run = run_of(one)
        one.log(run.run_id, POINTS, {'robot': 'thor'}, {'a': 'b'})
        one.artifact(run, artifact, 'x')
        one.finish(run.run_id, 'patrol_1', 'KILLED', 1_760_788_900_000)
    client = tracking._client
    (found,) = client.search_runs([run.experiment_id])
    assert (found.info.status, found.info.start_time, found.info.end_time) == ('KILLED', 1_760_788_800_000, 1_760_788_900_000)
    assert found.data.params == {'robot': 'thor'}
    assert found.data.tags[MISSION_TAG] == 'patrol_1'
    assert [item.path for item in client.list_artifacts(run.run_id, 'x')] == ['x/summary.json']
    assert str(tmp_path / 'artifacts') in run.artifact_uri
    times = 1 if tracking.where.startswith('sqlite') else 2
    assert len(client.get_metric_history(run.run_id, 'battery_pct')) == times * len(POINTS)


@pytest.mark.parametrize('uri', ['nosuch://tower', 'tower:5001'])
def test_an_address_that_this_mlflow_does_not_support_is_waited_for(uri: str) -> None:
    """For example sqlite: with mlflow-skinny. The mission is not refused: the sender keeps running, and reports the setting."""
    with pytest.raises(TrackingUnavailable, match='set MLFLOW_TRACKING_URI to a server'):
        MlflowTracking(uri, 'thor_missions').open()


@pytest.mark.long('a second of CPU or more')
@pytest.mark.filterwarnings('ignore')
def test_a_duplicate_is_closed(database: str, tmp_path: Path) -> None:
    """A run that a lost request created after all is deleted when the mission ends, and names the original."""
    tracking = MlflowTracking(database, 'duplicates', tmp_path / 'artifacts')
    run = run_of(tracking)
    twin = tracking._client.create_run(run.experiment_id, start_time=1_760_788_800_001, tags={MISSION_TAG: 'patrol_1'})
    assert run_of(tracking) == run
    tracking.finish(run.run_id, 'patrol_1', 'FINISHED', 1_760_788_900_000)
    assert [found.info.run_id for found in tracking._client.search_runs([run.experiment_id])] == [run.run_id]
    assert tracking._client.get_run(twin.info.run_id).data.tags['shadowhound.duplicate_of'] == run.run_id


def fly(logger: MissionDataLogger, command: str, tmp_path: Path) -> str:
    """A short mission, with the calls of the guide."""
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
    """Everything from ``fly`` is in MLflow and in the store, with its times."""
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


@pytest.mark.seaweedfs
def test_a_mission_is_in_mlflow_and_in_the_store(server: Server, warm_home: Path, tmp_path: Path) -> None:
    """Completely, and the id from start_mission is the run's."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    given = fly(logger, 'whole', tmp_path)
    report = logger.close(60.0)
    assert (report.complete, report.unsent, report.last_error) == (True, 0, '')
    assert given == report.run_id == server.run('whole').info.run_id
    until(lambda: len(server.keys(f'thor/missions/{given}')) == 4, 'the objects are delivered')
    check(server, 'whole', warm_home)


@pytest.mark.seaweedfs
@pytest.mark.long('seconds of a heartbeat')
def test_a_run_is_running_while_its_mission_is(server: Server, warm_home: Path) -> None:
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


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('a kill')
def test_a_mission_arrives_although_tower_was_unreachable_throughout(server: Server, home: Path, tmp_path: Path) -> None:
    """No call waits for it; once it is reachable again, after a restart of the robot, the run is complete with original times."""
    server.wire.set(HANG)
    logger = MissionDataLogger(home=home, start_timeout_s=0.3)
    began = time.monotonic()
    given = fly(logger, 'away', tmp_path)
    logger.close()
    assert time.monotonic() - began < 5.0
    assert (home / MISSIONS / given / 'journal').is_file()
    until(lambda: read_json(home / MISSIONS / 'replay.json').get('errors'), 'the sender reports the error')
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


@pytest.mark.seaweedfs
@pytest.mark.long('a kill')
def test_a_killed_agents_mission_is_complete_and_killed(server: Server, home: Path, tmp_path: Path) -> None:
    """One run, KILLED at its last record; each point and frame of a call that returned is there, once."""
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
    reports = [line.record for line in read(folder.journal) if line.record]
    assert (run.info.status, run.info.end_time) == ('KILLED', reports[-1]['t'] // 1_000_000)
    steps = [point.step for point in server.history(run.info.run_id, 'battery_pct')]
    assert steps == list(range(len(steps)))
    assert len(steps) > 300
    frames = {record['id'] for record in reports if record['k'] == 'frame'}
    assert frames >= set(range(0, 301, FRAME_EVERY))
    wanted = {f'camera/frame_{number:06d}.jpg' for number in frames}
    wanted |= {'summary.json', 'trajectories/trajectory.csv', 'battery.png'}
    assert server.artifacts(run.info.run_id) == wanted
    prefix = f'thor/missions/{run.info.run_id}/camera/'
    until(lambda: len(server.keys(prefix)) == len(frames), 'the frames are delivered')
    assert server.keys(prefix) == {f'{prefix}frame_{number:06d}.jpg': 1 for number in frames}


@pytest.mark.seaweedfs
@pytest.mark.long('an outage of some seconds')
def test_a_wrong_password_costs_no_mission(server: Server, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mission waits, and reports the reason; once ~/.mlflow/credentials has the correct one it is sent, without a restart."""
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
        wrong = until(lambda: read_json(home / MISSIONS / 'replay.json').get('errors'), 'the sender reports the error')
        assert 'MLFLOW_TRACKING_PASSWORD' in wrong['tracking']['remedy']
        assert 'mistyped' not in str(wrong) + (home / MISSIONS / 'replay.log').read_text()
        assert not complete(home)
        put(password)
        until(lambda: complete(home), 'it is sent')
    assert server.run('with a wrong password').data.metrics['a'] == 1.0


@pytest.mark.seaweedfs
def test_a_second_run_is_closed_where_it_may_not_be_deleted(server: Server) -> None:
    """A robot has no permission to delete on a Tower with passwords: the run stays, ended and tagged, and is not used."""
    tracking = MlflowTracking(server.wire.url, 'thor_missions')
    run = tracking.run_of('twice', 'patrol', 1, {})
    second = server.client.create_run(run.experiment_id, start_time=0, tags={MISSION_TAG: 'twice'})
    tracking.finish(run.run_id, 'twice', 'FINISHED', 2)
    closed = server.client.get_run(second.info.run_id)
    assert (closed.info.status, closed.data.tags[DUPLICATE_TAG]) == ('KILLED', run.run_id)
    assert tracking.run_of('twice', 'patrol', 1, {}) == run


@pytest.mark.seaweedfs
def test_an_experiment_that_a_robot_may_not_create_is_named(server: Server) -> None:
    """The mission waits for it, and the remedy names the role that creates it."""
    with pytest.raises(TrackingUnavailable, match=r'^there is no experiment of_another') as caught:
        MlflowTracking(server.wire.url, 'of_another').run_of('patrol_1', 'patrol', 1, {})
    assert 'make tower-secrets' in caught.value.remedy


@pytest.mark.seaweedfs
def test_artifacts_in_s3_need_an_endpoint(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If artifacts are in S3, the error names the missing variable, and with it they arrive."""
    uri = f'file://{tmp_path}/mlruns'  # a Tower does not allow this
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


@pytest.mark.seaweedfs
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


@pytest.mark.seaweedfs
@pytest.mark.parametrize('mode', [REFUSE, HANG, (200, 'Portal'), (403, 'Forbidden'), (500, 'Broken'), (404, 'Elsewhere')])
def test_an_invalid_server_is_retried(server: Server, mode: str | tuple[int, str]) -> None:
    """Whatever it responds, if at all: the mission waits, and the error has a remedy and no password."""
    server.wire.set(mode)
    tracking = MlflowTracking(server.wire.url.replace('//', '//thor:very@secret@'), 'thor_missions')
    with pytest.raises(TrackingUnavailable) as caught:
        tracking.run_of('patrol_1', 'patrol', 0, {})
    assert 'MLFLOW_TRACKING_' in caught.value.remedy
    assert 'secret' not in str(caught.value)


TWO: Final = os.environ.get('SHADOWHOUND_MLFLOW2', '')
POSTGRES: Final = shutil.which('postgres')
READY_S: Final = 120.0
HERE: Final = Path(sys.executable).parent
needs_two = pytest.mark.skipif(not TWO, reason='SHADOWHOUND_MLFLOW2 names no environment with MLflow 2')
needs_postgres = pytest.mark.skipif(not POSTGRES, reason='PostgreSQL is not installed: apt install postgresql')


@pytest.fixture
def running() -> Iterator[ExitStack]:
    """Stops the processes that a test starts."""
    with ExitStack() as stack:
        yield stack


def clean() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith((*FOREIGN, 'PG'))}


def postgres_uri(running: ExitStack) -> str:
    """The URI of an empty PostgreSQL, which refuses to run as root and so may need another user's folder."""
    assert POSTGRES
    folder = Path(running.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
    programs, as_user = Path(POSTGRES).resolve().parent, ()
    if not os.geteuid():
        user = pwd.getpwnam('postgres')
        shutil.chown(folder, user.pw_uid, user.pw_gid)
        as_user = ('setpriv', f'--reuid={user.pw_uid}', f'--regid={user.pw_gid}', '--clear-groups', '--')  # type: ignore[assignment]
    data = folder / 'data'
    made = [*as_user, programs / 'initdb', '-D', data, '-U', 'mlflow', '--auth=trust', '--encoding=UTF8', '--no-sync']
    subprocess.run(made, check=True, cwd='/', env={**clean(), 'LC_ALL': 'C.UTF-8'}, stdout=subprocess.DEVNULL)
    command = [*as_user, str(programs / 'postgres'), '-D', str(data), '-c', 'listen_addresses=', '-k', str(folder)]
    server = TrackingServer('PostgreSQL', command, log=folder / 'log', environ=clean())
    running.callback(server.stop)
    server.start()
    ask = [str(programs / 'pg_isready'), '-q', '-h', str(folder)]
    server.wait(lambda: not subprocess.run(ask, check=False).returncode, READY_S)
    return f'postgresql+psycopg2://mlflow@/postgres?host={folder}'


def served(running: ExitStack, folder: Path, programs: Path, backend: str) -> str:
    """The address of an MLflow server."""
    ports = Ports('127.0.0.1')
    running.callback(ports.release)
    url = f'http://127.0.0.1:{ports.take()}'
    command = [
        str(programs / 'mlflow'), 'server', '--host', '127.0.0.1', '--port', url.rpartition(':')[2], '--workers', '1',
        '--backend-store-uri', backend, '--artifacts-destination', str(folder / 'artifacts'),
    ]  # fmt: skip
    environ = clean() | {'MLFLOW_SERVER_ENABLE_JOB_EXECUTION': 'false', 'MLFLOW_DISABLE_TELEMETRY': 'true'}
    server = TrackingServer('MLflow', command, log=folder / 'mlflow.log', environ=environ)
    running.callback(server.stop)
    server.start()

    def answers() -> bool:
        try:
            with urllib.request.urlopen(f'{url}/health', timeout=30.0) as answer:  # noqa: S310 - http, by us
                return bool(answer.status == 200)
        except OSError:
            return False

    server.wait(answers, READY_S)
    return url


def voyage(folder: Path, programs: Path, uri: str) -> dict[str, Any]:
    """The server's data of a mission that was sent twice by this environment's MLflow."""
    tests = str(Path(__file__).parents[1])
    path = os.pathsep.join((tests, str(Path(tests).parent), os.environ.get('PYTHONPATH', '')))
    environ = clean() | {
        'MLFLOW_TRACKING_URI': uri, 'MLFLOW_HTTP_REQUEST_TIMEOUT': '120',
        'PYTHONPATH': path if programs == HERE else path.rpartition(os.pathsep)[0],
    }  # fmt: skip
    (folder / 'home').mkdir()
    command = [str(programs / 'python'), '-m', 'missions.voyage', str(folder / 'home')]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300, check=False)
    assert not done.returncode, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def check_voyage(found: dict[str, Any]) -> None:
    """One run, each point once, texts complete except for characters that no database accepts."""
    assert found['status'] == 'FINISHED'
    assert found['steps'] == list(range(VOYAGE_POINTS))
    assert found['params'] == {
        'mission_type': 'patrol', 'robot': 'thor', 'duration_s': '60.000',
        'mission_command': ('Küche\N{REPLACEMENT CHARACTER} \N{DOG FACE} ' + 'x' * 7000)[:6000],
    }  # fmt: skip
    assert (found['metrics']['success'], found['metrics']['big/one'], found['metrics']['distance_m']) == (1.0, 1.5e300, 12.5)
    assert found['artifacts'] == ['camera', 'camera/frame_000000.jpg', 'mission_command.txt', 'summary.json']


@pytest.mark.slow
@pytest.mark.long('half a minute each, with servers of its own')
@needs_postgres
def test_missions_arrive_at_a_server_with_postgresql(running: ExitStack, tmp_path: Path) -> None:
    """As on a Tower."""
    check_voyage(voyage(tmp_path, HERE, served(running, tmp_path, HERE, postgres_uri(running))))


@pytest.mark.slow
@pytest.mark.long('half a minute each, with servers of its own')
@needs_two
def test_missions_arrive_at_a_server_of_version_2(running: ExitStack, tmp_path: Path) -> None:
    """Our client, and an older server."""
    check_voyage(voyage(tmp_path, HERE, served(running, tmp_path, Path(TWO) / 'bin', f'sqlite:///{tmp_path}/mlflow.db')))


@pytest.mark.slow
@pytest.mark.long('half a minute each, with servers of its own')
@needs_two
def test_missions_arrive_from_a_client_of_version_2(running: ExitStack, tmp_path: Path) -> None:
    """A robot with an older client, and our server."""
    check_voyage(voyage(tmp_path, Path(TWO) / 'bin', served(running, tmp_path, HERE, f'sqlite:///{tmp_path}/mlflow.db')))


@pytest.mark.slow
@pytest.mark.long('half a minute each, with servers of its own')
@needs_two
@needs_postgres
def test_missions_arrive_with_version_2_on_both_sides(running: ExitStack, tmp_path: Path) -> None:
    """An old Tower with an old robot."""
    check_voyage(voyage(tmp_path, Path(TWO) / 'bin', served(running, tmp_path, Path(TWO) / 'bin', postgres_uri(running))))


@pytest.mark.slow
@pytest.mark.long('half a minute each, with servers of its own')
@needs_two
def test_missions_arrive_in_a_local_file_of_version_2(tmp_path: Path) -> None:
    check_voyage(voyage(tmp_path, Path(TWO) / 'bin', f'sqlite:///{tmp_path}/mlflow.db'))
