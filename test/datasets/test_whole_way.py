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

from shadowhound_data_logger.datasets.lerobot import SOURCE_TABLE

if TYPE_CHECKING:
    from shadowhound_data_logger.sim.tower import Tower

ROOT: Final = Path(__file__).parents[2]
PYTHON: Final = Path(os.environ.get('SHADOWHOUND_TRAIN', '~/.cache/shadowhound/train/bin/python')).expanduser()
MAIN: Final = [sys.executable, '-m', 'shadowhound_data_logger.cli.main']


@pytest.mark.slow
@pytest.mark.long('trains with torch, and starts an MLflow server')
@pytest.mark.timeout(900)
@pytest.mark.skipif(not PYTHON.is_file(), reason=f'there is no torch at {PYTHON} (docs/development.md)')
def test_a_model_is_found_by_what_it_was_trained_on(tmp_path: Path, tower: Tower) -> None:
    """By any object that a value of its frames came from, and by no other."""
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
    told = run(str(PYTHON), str(ROOT / 'examples/train_navigation_policy.py'), '--export', 'patrols', '--epochs', '1')
    key = pq.read_table(tmp_path / 'patrols' / SOURCE_TABLE)['key'][0].as_py()
    found = json.loads(run(*MAIN, 'export', 'where', key, '--json'))
    assert [(each['where'], each['missions']) for each in found] == [(str(tmp_path / 'patrols'), ['m0'])]
    (trained,) = found[0]['runs']
    assert f'run {trained} in navigation_policy_training' in told
    assert json.loads(run(*MAIN, 'export', 'where', 'thor/camera/20261028/none.tar', '--json')) == []
