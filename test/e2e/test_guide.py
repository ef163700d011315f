"""The verbatim code of the integration guide, against this package and a real MLflow server."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest
from missions.agent import jpeg
from missions.server import Server, complete, until

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores import open_store

pytestmark = pytest.mark.seaweedfs

EXECUTOR: Final = """
class MissionExecutor:
    def __init__(self, config, logger=None):
        # ...existing init...
        self.data_logger = MissionDataLogger()  # New

    def execute_mission(self, command: str):
        # Start logging
        mission_type = self._infer_mission_type(command)  # "patrol", "explore", etc.
        run_id = self.data_logger.start_mission(mission_type, command)

        try:
            # Execute mission (existing code)
            result = self.agent.prompt(command, ...)

            # Log mission data
            if self._latest_camera_frame is not None:
                self.data_logger.log_camera_frame(
                    self._encode_frame_as_jpeg(self._latest_camera_frame),
                    frame_id=0
                )

            # Log robot state (if available)
            robot_state = self.robot.get_state()  # From DIMOS
            self.data_logger.log_robot_state(
                battery_pct=robot_state.battery_percentage,
                temperature_c=robot_state.temperature,
                step=0
            )

            # Log trajectory (if mission involved navigation)
            if mission_type in ["patrol", "explore"]:
                trajectory_path = "/tmp/trajectory.csv"
                self._save_trajectory_csv(trajectory_path)
                self.data_logger.log_trajectory(trajectory_path)

            # Calculate metrics
            distance_m = self._calculate_distance_traveled()
            duration_s = self._calculate_mission_duration()

            # End logging
            self.data_logger.end_mission(
                success=True,
                distance_m=distance_m,
                duration_s=duration_s
            )

            return result, timing

        except Exception as e:
            self.data_logger.end_mission(success=False, distance_m=0, duration_s=0)
            raise
"""
LOGGER: Final = '''
# mission_data_logger.py (integrated with mission_agent)
import mlflow
import boto3
import os
from datetime import datetime

class MissionDataLogger:
    """Logs mission data to Tower MLflow + MinIO."""

    def __init__(self):
        # Configure MLflow
        mlflow.set_tracking_uri(os.getenv('MLFLOW_TRACKING_URI'))  # http://TOWER_IP:5001

        # Configure S3 for MLflow artifacts
        os.environ['MLFLOW_S3_ENDPOINT_URL'] = os.getenv('AWS_ENDPOINT_URL')

        self.s3 = boto3.client(
            's3',
            endpoint_url=os.getenv('AWS_ENDPOINT_URL'),
            aws_access_key_id=os.getenv('AWS_ACCESS_KEY_ID'),
            aws_secret_access_key=os.getenv('AWS_SECRET_ACCESS_KEY')
        )

        self.current_run = None

    def start_mission(self, mission_type: str, mission_command: str):
        """Start logging a new mission."""
        experiment_name = "thor_missions"

        # Get or create experiment
        try:
            experiment = mlflow.get_experiment_by_name(experiment_name)
            experiment_id = experiment.experiment_id
        except:
            experiment_id = mlflow.create_experiment(experiment_name)

        # Start MLflow run
        run_name = f"{mission_type}_{datetime.now().strftime('%Y%m%d_%H%M%S')}"
        self.current_run = mlflow.start_run(
            experiment_id=experiment_id,
            run_name=run_name
        )

        # Log mission parameters
        mlflow.log_param("mission_type", mission_type)
        mlflow.log_param("mission_command", mission_command)
        mlflow.log_param("robot", "thor")
        mlflow.log_param("timestamp", datetime.now().isoformat())

        return self.current_run.info.run_id

    def log_camera_frame(self, frame_data: bytes, frame_id: int):
        """Log camera frame to MinIO and reference in MLflow."""
        if not self.current_run:
            return

        # Upload to MinIO
        s3_key = f"thor/missions/{self.current_run.info.run_id}/camera/frame_{frame_id:06d}.jpg"
        self.s3.put_object(
            Bucket='sensor-data',
            Key=s3_key,
            Body=frame_data,
            ContentType='image/jpeg'
        )

        # Log artifact path in MLflow
        mlflow.log_metric(f"camera_frame_{frame_id}", 1.0, step=frame_id)

    def log_robot_state(self, battery_pct: float, temperature_c: float, step: int):
        """Log robot state metrics to MLflow."""
        if not self.current_run:
            return

        mlflow.log_metric("battery_pct", battery_pct, step=step)
        mlflow.log_metric("temperature_c", temperature_c, step=step)

    def log_trajectory(self, trajectory_csv_path: str):
        """Upload trajectory CSV as MLflow artifact."""
        if not self.current_run:
            return

        mlflow.log_artifact(trajectory_csv_path, artifact_path="trajectories")

    def end_mission(self, success: bool, distance_m: float, duration_s: float):
        """End mission logging."""
        if not self.current_run:
            return

        # Log final metrics
        mlflow.log_metric("success", 1.0 if success else 0.0)
        mlflow.log_metric("distance_traveled_m", distance_m)
        mlflow.log_metric("duration_s", duration_s)

        # End MLflow run
        mlflow.end_run()
        self.current_run = None
'''
TRAINING: Final = """
# train_navigation_policy.py (on Spark DGX)
import boto3
import mlflow
import torch
import os

# Configure Tower access
os.environ['MLFLOW_TRACKING_URI'] = 'http://TOWER_IP:5001'
os.environ['AWS_ENDPOINT_URL'] = 'http://TOWER_IP:9000'

# Download training data from MinIO
s3 = boto3.client(
    's3',
    endpoint_url=os.getenv('AWS_ENDPOINT_URL'),
    aws_access_key_id=os.getenv('AWS_ACCESS_KEY_ID'),
    aws_secret_access_key=os.getenv('AWS_SECRET_ACCESS_KEY')
)

# Download all camera images from thor missions
paginator = s3.get_paginator('list_objects_v2')
for page in paginator.paginate(Bucket='sensor-data', Prefix='thor/camera/'):
    for obj in page.get('Contents', []):
        s3.download_file('sensor-data', obj['Key'], f"/data/{obj['Key']}")

# Train model
mlflow.set_experiment("navigation_policy_training")
with mlflow.start_run(run_name="resnet50_v1"):
    mlflow.log_param("architecture", "resnet50")
    mlflow.log_param("dataset", "thor_camera_20251018")

    model = train_model()  # Your training code

    # Save checkpoint
    torch.save(model.state_dict(), "checkpoint_1000.pth")
    mlflow.log_artifact("checkpoint_1000.pth", artifact_path="checkpoints")

    mlflow.log_metric("train_loss", 0.032)
    mlflow.log_metric("val_accuracy", 0.94)
"""
QUERY: Final = """
import mlflow

mlflow.set_tracking_uri("http://TOWER_IP:5001")

# Get all patrol missions
client = mlflow.tracking.MlflowClient()
experiment = client.get_experiment_by_name("thor_missions")

runs = client.search_runs(
    experiment_ids=[experiment.experiment_id],
    filter_string="params.mission_type = 'patrol'"
)

for run in runs:
    print(f"Run ID: {run.info.run_id}")
    print(f"  Command: {run.data.params['mission_command']}")
    print(f"  Distance: {run.data.metrics['distance_traveled_m']} m")
    print(f"  Success: {run.data.metrics['success']}")
"""


def executor(command_fails: bool) -> Any:
    """The guide's class, with stand-ins for the agent's existing code."""
    names: dict[str, Any] = {'MissionDataLogger': MissionDataLogger, 'timing': {}}
    exec(EXECUTOR, names)  # noqa: S102 - the guide's text is what is tested

    def prompt(command: str, _: object) -> str:
        if command_fails:
            raise RuntimeError('the robot fell over')
        return f'done: {command}'

    class Existing(names['MissionExecutor']):  # type: ignore[misc]
        agent = SimpleNamespace(prompt=prompt)
        robot = SimpleNamespace(get_state=lambda: SimpleNamespace(battery_percentage=87, temperature=41.5))
        _latest_camera_frame = jpeg(0)

        def _infer_mission_type(self, command: str) -> str:
            return command.split(maxsplit=1)[0]

        def _encode_frame_as_jpeg(self, frame: bytes) -> bytes:
            return frame

        def _save_trajectory_csv(self, path: str) -> None:
            Path(path).write_text('timestamp,x,y,yaw\n1.0,0.0,0.0,0.0\n2.0,1.0,0.0,0.0\n')

        def _calculate_distance_traveled(self) -> float:
            return 12.5

        def _calculate_mission_duration(self) -> float:
            return 60.0

    return Existing(config={})


@pytest.mark.long('a second of CPU or more')
def test_the_guides_executor_and_query_run_unchanged(
    server: Server, warm_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its MissionExecutor logs a successful and a failed mission, and its query finds and prints both."""
    import mlflow  # takes a second, not needed to collect tests

    monkeypatch.setenv('SHADOWHOUND_HOME', str(warm_home))
    good, bad = executor(command_fails=False), executor(command_fails=True)
    assert good.execute_mission('patrol by the guide') == ('done: patrol by the guide', {})
    with pytest.raises(RuntimeError, match='fell over'):
        bad.execute_mission('patrol into the pond')
    for each in (good, bad):
        each.data_logger.close()
    until(lambda: complete(warm_home, 2), 'both are sent')
    try:
        exec(QUERY.replace('http://TOWER_IP:5001', server.tower.tracking_uri), {})  # noqa: S102
    finally:
        mlflow.set_tracking_uri('')
    captured = capsys.readouterr().out
    for command, distance, success in (('patrol by the guide', 12.5, 1.0), ('patrol into the pond', 0.0, 0.0)):
        run_id = server.run(command).info.run_id
        assert f'Run ID: {run_id}\n  Command: {command}\n  Distance: {distance} m\n  Success: {success}\n' in captured
    run_id = server.run('patrol by the guide').info.run_id
    assert {'camera/frame_000000.jpg', 'trajectories/trajectory.csv', 'trajectory.png'} <= server.artifacts(run_id)


RUN_LOGGER: Final = """
import io, sys
from pathlib import Path
names = {}
exec(sys.argv[1], names)
logger = names['MissionDataLogger']()
run_id = logger.start_mission('patrol', sys.argv[2])
logger.log_camera_frame(b'a frame', 7)
logger.log_robot_state(88.0, 41.5, 0)
Path('trajectory.csv').write_text('timestamp,x,y,yaw')
logger.log_trajectory('trajectory.csv')
logger.end_mission(True, 12.5, 60.0)
print(run_id)
"""
"""Calls the guide's sketch, in a separate process: MLflow's fluent client leaves threads behind."""
RUN_TRAINING: Final = """
import sys, types
torch = types.ModuleType('torch')
torch.save = lambda state, path: open(path, 'w').write(state)
sys.modules['torch'] = torch
model = types.SimpleNamespace(state_dict=lambda: 'weights')
exec(sys.argv[1], {'train_model': lambda: model})
"""
"""The training is replaced: a fake torch provides its only call."""


def in_a_process(program: str, *arguments: str, folder: Path, **environ: str) -> subprocess.CompletedProcess[str]:
    command, env = [sys.executable, '-c', program, *arguments], {**os.environ, **environ}
    return subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def store(server: Server, folder: Path, objects: Mapping[str, bytes]) -> None:
    """Put them into the bucket of the robot's data, which is created if missing."""
    with closing(open_store(server.tower.store_settings(), UploadSettings())) as opened:
        for number, (key, content) in enumerate(objects.items()):
            path, sha256 = folder / f'{number}.jpg', hashlib.sha256(content).hexdigest()
            path.write_bytes(content)
            opened.put(SpooledObject(id=number, bucket='sensor-data', key=key, path=path, size=len(content), sha256=sha256,
                                     content_type='image/jpeg', metadata={}, priority=1, created_ns=0))  # fmt: skip


@pytest.mark.long('a process that loads MLflow')
def test_the_guides_own_logger_works_next_to_this_package(server: Server, tmp_path: Path) -> None:
    """The sketch that this package replaces runs with the same Tower, and the guide's query finds its missions as well."""
    store(server, tmp_path, {'thor/camera/20251018/120000_front.jpg': jpeg(120000)})
    tracking = server.tower.tracking('thor')
    done = in_a_process(RUN_LOGGER, LOGGER, 'patrol by the sketch', folder=tmp_path, **tracking)
    assert not done.returncode, done.stderr
    run_id = done.stdout.split()[-1]
    run = server.run('patrol by the sketch')
    assert run.info.run_id == run_id
    assert {name: run.data.metrics[name] for name in ('success', 'distance_traveled_m', 'duration_s', 'camera_frame_7')} == {
        'success': 1.0, 'distance_traveled_m': 12.5, 'duration_s': 60.0, 'camera_frame_7': 1.0,
    }  # fmt: skip
    assert server.artifacts(run_id) == {'trajectories/trajectory.csv'}
    assert server.keys(f'thor/missions/{run_id}') == {f'thor/missions/{run_id}/camera/frame_000007.jpg': 1}
    done = in_a_process('import sys; exec(sys.argv[1])', QUERY.replace('http://TOWER_IP:5001', server.tower.tracking_uri),
                        folder=tmp_path, **tracking)  # fmt: skip
    assert not done.returncode, done.stderr
    assert f'Run ID: {run_id}\n  Command: patrol by the sketch\n  Distance: 12.5 m\n  Success: 1.0\n' in done.stdout


@pytest.mark.long('a process that loads MLflow')
def test_the_guides_training_script_runs_unchanged(server: Server, tmp_path: Path) -> None:
    """It downloads the robot's stored data into folders that must exist, and logs a run; docs/lake.md names the folders."""
    spark = {**server.tower.environment('spark'), **server.tower.tracking('spark')}
    frames = {f'thor/camera/20251018/{second:06d}_front.jpg': jpeg(second) for second in (120000, 120001)}
    store(server, tmp_path, frames)
    data, work = tmp_path / 'data', tmp_path / 'work'
    work.mkdir()
    script = TRAINING.replace('http://TOWER_IP:5001', server.tower.tracking_uri)
    script = script.replace('http://TOWER_IP:9000', server.tower.endpoint_url).replace('/data/', f'{data}/')
    done = in_a_process(RUN_TRAINING, script, folder=work, **spark)
    assert 'FileNotFoundError' in done.stderr, 'boto3 makes no folders'
    for key in server.keys('thor/camera/'):
        (data / key).parent.mkdir(parents=True, exist_ok=True)
    done = in_a_process(RUN_TRAINING, script, folder=work, **spark)
    assert not done.returncode, done.stderr
    assert {key: (data / key).read_bytes() for key in frames} == frames
    done = in_a_process(TRAINED, server.tower.tracking_uri, folder=work, **spark)
    assert done.stdout.split() == ['resnet50', '0.032', '0.94', 'checkpoints/checkpoint_1000.pth'], done.stderr


TRAINED: Final = """
import sys
from mlflow import MlflowClient
client = MlflowClient(sys.argv[1])
experiment = client.get_experiment_by_name('navigation_policy_training')
run = client.search_runs([experiment.experiment_id])[0]
(artifact,) = client.list_artifacts(run.info.run_id, 'checkpoints')
print(run.data.params['architecture'], run.data.metrics['train_loss'], run.data.metrics['val_accuracy'], artifact.path)
"""


@pytest.mark.long('a program of many imports that walks for seconds')
def test_the_example_runs_a_mission(server: Server, warm_home: Path) -> None:
    """examples/mission_executor.py runs a mission of its simulated robot, complete with all three images."""
    example = Path(__file__).parents[2] / 'examples' / 'mission_executor.py'
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(warm_home)}
    command = [sys.executable, str(example), 'patrol the example', '--seconds', '2']
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=120)
    assert re.search(r'run [0-9a-f]{32}, \d+ records sent, 0 not yet', done.stdout), done.stdout + done.stderr
    run = server.run('patrol the example')
    assert run.info.status == 'FINISHED'
    assert 0.5 < run.data.metrics['distance_m'] < 2.0
    pictures = {'camera_summary.jpg', 'trajectory.png', 'battery.png'}
    assert pictures <= server.artifacts(run.info.run_id)
