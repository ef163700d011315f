"""The examples that researchers copy from run as they stand."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from lake.making import folder_store
from lake.training import Drive

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 200


def run(example: str, *arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    """In a separate folder if SHADOWHOUND_HOME names one: MLflow writes artifacts to the working directory."""
    return subprocess.run([sys.executable, str(ROOT / 'examples' / example), *arguments], env={**os.environ, **environ},
                          capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
                          cwd=environ.get('SHADOWHOUND_HOME'))  # fmt: skip


@pytest.mark.skipif(importlib.util.find_spec('torch') is None, reason='torch is not installed (the extra "train")')
def test_a_policy_is_trained_and_its_run_is_in_mlflow(tmp_path: Path) -> None:
    """Parameters, a loss for each epoch and a checkpoint, in the guide's experiment."""
    import mlflow

    home, uri = tmp_path / 'home', f'sqlite:///{tmp_path / "mlflow.db"}'
    home.mkdir()
    settings = type(folder_store(tmp_path))(directory=home / 'store')
    Drive(settings, tmp_path).record(24, without=['imu', 'joints', 'lidar', 'lowstate'])
    environ = {'SHADOWHOUND_HOME': str(home), 'MLFLOW_TRACKING_URI': uri, 'AWS_ENDPOINT_URL': ''}
    ran = run('train_navigation_policy.py', '--epochs', '2', **environ)
    assert ran.returncode == 0, ran.stderr
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name('navigation_policy_training')
    run_ = client.search_runs([experiment.experiment_id])[0]
    assert run_.info.status == 'FINISHED'
    assert (run_.data.params['frames'], run_.data.params['validation_frames']) == ('18', '5')
    assert len(client.get_metric_history(run_.info.run_id, 'train_loss')) == 2
    assert {'val_loss', 'frames_per_s', 'val_loss_of_the_mean'} < run_.data.metrics.keys()


@pytest.mark.seaweedfs
@pytest.mark.long('processes that import much')
def test_frames_are_judged_by_several_processes(tmp_path: Path, seaweed: Tower) -> None:
    """Every frame of the robot once, and no secret in what the processes say."""
    pytest.importorskip('daft')
    drive = Drive(seaweed.store_settings(), tmp_path, 'fleetrobot')
    drive.record(5, without=['imu', 'joints', 'lidar', 'lowstate', 'odom'])
    environ = seaweed.environment()
    ran = run(
        'fleet_frames.py', '--robot', 'fleetrobot', '--workers', '2', '--json', **environ, RUST_LOG='debug', DAFT_PROGRESS_BAR='0'
    )
    assert ran.returncode == 0, ran.stderr
    assert sorted(json.loads(ran.stdout)['keys']) == sorted(row['key'] for row in drive.rows)
    assert environ['AWS_SECRET_ACCESS_KEY'] not in ran.stdout + ran.stderr


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('example', ['train_navigation_policy.py', 'fleet_frames.py'])
def test_each_example_has_a_usage_line(example: str) -> None:
    """``--help`` names what it needs."""
    if example.startswith('train') and importlib.util.find_spec('torch') is None:
        pytest.skip('torch is not installed (the extra "train")')
    ran = run(example, '--help')
    assert ran.returncode == 0
    assert '--since' in ran.stdout
