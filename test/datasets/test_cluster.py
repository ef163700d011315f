"""Missions exported in parallel by Ray's workers are byte-identical to a local export, whichever worker is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest
from datasets.recorded import House, Mission
from datasets.test_export import contents

from shadowhound_data_logger.datasets.lerobot import Lerobot
from shadowhound_data_logger.lake.training import INFO

ROOT: Final = Path(__file__).parents[2]
PYTHON: Final = Path(os.environ.get('SHADOWHOUND_RAY', '~/.cache/shadowhound/ray/bin/python')).expanduser()
MAIN: Final = [str(PYTHON), '-m', 'shadowhound_data_logger.cli.main']
PATROLS: Final = ['export', 'lerobot', 'patrols', '--mission-type', 'patrol']
ON_RAY: Final = ['--ray', 'auto', '--workers', '2']
SHORT: Final = TemporaryDirectory(prefix='ray', ignore_cleanup_errors=True)
"""Ray's sockets need a short path."""
BUILDS: Final = b'ray::Builder.build'
"""The process title of a worker while it builds an episode."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.long('starts Ray'),
    pytest.mark.timeout(900),
    pytest.mark.skipif(not PYTHON.is_file(), reason=f'there is no ray at {PYTHON} (docs/development.md)'),
]


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    environ = {name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'RAY_', 'MLFLOW_'))}
    environ |= {'SHADOWHOUND_HOME': str(folder), 'PYTHONPATH': str(ROOT), 'TMPDIR': str(folder)}
    environ |= {'RAY_ADDRESS': 'local', 'RAY_TMPDIR': SHORT.name}
    command = [*MAIN, *PATROLS, *arguments]
    return subprocess.Popen(command, env=environ, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen[str], code: int = 0) -> tuple[str, str]:
    """Its output on standard output and standard error."""
    out, err = process.communicate(timeout=600)
    assert process.returncode == code, err[-3000:]
    return out, err


def builders(of: int) -> Iterator[int]:
    """Process ids of the workers that build episodes, among the descendants of a process."""
    parents, titles = dict[int, int](), dict[int, bytes]()
    for folder in Path('/proc').iterdir():
        if folder.name.isdigit():
            try:
                parents[int(folder.name)] = int((folder / 'stat').read_text().rpartition(')')[2].split()[1])
                titles[int(folder.name)] = (folder / 'cmdline').read_bytes()
            except OSError:
                continue
    for pid, title in titles.items():
        above = pid
        while above in parents and above != of:
            above = parents[above]
        if above == of and title.startswith(BUILDS):
            yield pid


def kill_builders(process: subprocess.Popen[str], most: int) -> int:
    """Kill this many, or all until the program ends, with SIGKILL as soon as they build an episode; returns their number."""
    killed = set[int]()
    while process.poll() is None and len(killed) < most:
        for pid in {*builders(process.pid)} - killed:
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
            if len(killed) == most:
                break
        time.sleep(0.02)  # between two polls
    return len(killed)


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(3):
        made.record(Mission(f'm{number}', begin_s=200 * number, seconds=60, sensors=('camera', 'odom')))
    return made


@pytest.fixture(scope='module')
def wanted(house: House) -> dict[str, bytes]:
    """The files of the dataset that this machine creates alone, one episode after the other."""
    finished(start(house.folder, '--to', 'alone'))
    found = contents(house.folder / 'alone')
    assert len(Lerobot(house.folder / 'alone').mission_ids) == 3
    return found


def test_two_workers_write_what_this_machine_writes(house: House, wanted: dict[str, bytes]) -> None:
    """Every file; and the workers leave nothing behind."""
    finished(start(house.folder, '--to', 'whole', *ON_RAY))
    assert contents(house.folder / 'whole') == wanted
    assert [*house.folder.glob('shadowhound-export-*')] == []


def test_the_mission_of_a_killed_worker_is_given_to_another_one(house: House, wanted: dict[str, bytes]) -> None:
    """It starts again, and the files are the same."""
    process = start(house.folder, '--to', 'killed', '--json', *ON_RAY)
    assert kill_builders(process, 1) == 1
    report, _ = finished(process)
    assert len(json.loads(report)['added']) == 3
    assert contents(house.folder / 'killed') == wanted


def test_a_mission_that_no_worker_survives_is_named(house: House, wanted: dict[str, bytes]) -> None:
    """Nothing was added, in whatever order workers were killed; the next run gives the same files."""
    process = start(house.folder, '--to', 'dying', *ON_RAY)
    assert kill_builders(process, 100) >= 9
    _, report = finished(process, 1)
    assert all(f'm{number}: its worker was killed' in report for number in range(3))
    assert not (house.folder / 'dying' / INFO).exists()
    finished(start(house.folder, '--to', 'dying', *ON_RAY))
    assert contents(house.folder / 'dying') == wanted
