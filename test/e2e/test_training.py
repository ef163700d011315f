"""From missions to a model: exported, trained on for an epoch, the digest in a real MLflow server, and found by ``where``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pyarrow.parquet as pq
import pytest
from datasets.recorded import House, Mission

from shadowhound_data_logger.datasets.export import export, remember
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import SOURCE_TABLE

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

ROOT: Final = Path(__file__).parents[2]
PYTHON: Final = Path(os.environ.get('SHADOWHOUND_TRAIN', '~/.cache/shadowhound/train/bin/python')).expanduser()
MAIN: Final = [sys.executable, '-m', 'shadowhound_data_logger.cli.main']
LOG: Final = """
import sys, mlflow
from shadowhound_data_logger import lake
mlflow.set_experiment('navigation_policy_training')
with mlflow.start_run() as run:
    lake.log_dataset(run, sys.argv[1])
print(run.info.run_id)
"""


@pytest.mark.slow
@pytest.mark.long('trains with torch, and starts an MLflow server')
@pytest.mark.timeout(900)
@pytest.mark.skipif(not PYTHON.is_file(), reason=f'there is no torch at {PYTHON} (docs/development.md)')
def test_a_model_is_found_by_what_it_was_trained_on(tmp_path: Path, tower: Tower) -> None:
    """By any object that contributed a value to its frames, and by no other."""
    house = House(tmp_path)
    for number in range(2):
        house.record(Mission(f'm{number}', begin_s=100 * number, seconds=3, sensors=('camera', 'odom')))
    environ = {
        **os.environ,
        **tower.tracking('spark'),
        'SHADOWHOUND_HOME': str(tmp_path),
        'AWS_ENDPOINT_URL': '',
        'PYTHONPATH': str(ROOT),
    }

    def run(*command: str) -> str:
        ran = subprocess.run(command, env=environ, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600)
        assert ran.returncode == 0, ran.stderr[-3000:]
        return ran.stdout

    run(*MAIN, 'export', 'lerobot', 'patrols', '--mission-type', 'patrol')
    text = run(str(PYTHON), str(ROOT / 'examples/train_navigation_policy.py'), '--export', 'patrols', '--epochs', '1')
    key = pq.read_table(tmp_path / 'patrols' / SOURCE_TABLE)['key'][0].as_py()
    found = json.loads(run(*MAIN, 'export', 'where', key, '--json'))
    assert [(each['where'], each['missions']) for each in found] == [(str(tmp_path / 'patrols'), ['m0'])]
    (trained,) = found[0]['runs']
    assert f'run {trained} in navigation_policy_training' in text
    assert json.loads(run(*MAIN, 'export', 'where', 'thor/camera/20261028/none.tar', '--json')) == []


@pytest.mark.slow
@pytest.mark.long('starts an MLflow server')
@pytest.mark.timeout(600)
def test_a_run_is_found_while_the_mission_was_in_its_data(tmp_path: Path, tower: Tower) -> None:
    """By each digest that the dataset had then: a run trained before the mission was added is not among them."""
    house = House(tmp_path)
    environ = {**os.environ, **tower.tracking('spark'), 'SHADOWHOUND_HOME': str(tmp_path), 'AWS_ENDPOINT_URL': '',
               'PYTHONPATH': str(ROOT)}  # fmt: skip
    runs = []
    for number in range(3):
        house.record(Mission(f'm{number}', begin_s=100 * number, seconds=2, sensors=('camera', 'odom')))
        export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())
        logged = subprocess.run([sys.executable, '-c', LOG, str(tmp_path / 'set')], env=environ, capture_output=True, text=True,
                                check=True, timeout=200)  # fmt: skip
        runs.append(logged.stdout.split()[-1])
    remember(tmp_path, tmp_path / 'set')
    sources = pq.read_table(tmp_path / 'set' / SOURCE_TABLE).to_pylist()
    key = next(row['key'] for row in sources if row['episode_mission'] == 'm1')
    asked = subprocess.run([*MAIN, 'export', 'where', key, '--json'], env=environ, capture_output=True, text=True, check=True,
                           timeout=200)  # fmt: skip
    (found,) = json.loads(asked.stdout)
    assert (found['missions'], found['runs']) == (['m1'], sorted(runs[1:]))
