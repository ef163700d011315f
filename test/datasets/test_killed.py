"""Killed anywhere and run again, an export and a drop give the files that they would have given."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from datasets.recorded import House, Mission, kill_this_process

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.export import drop, export, resumed
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.lake.training import INFO

PATROLS = {'mission_type': 'patrol'}

pytestmark = pytest.mark.long('an export for each file that it writes')


DYING = """
import os, signal, sys
from pathlib import Path
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.core.options import StoreSettings

folder, store, at, real, done = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), os.replace, 0
def replace(*arguments, **more):
    global done
    done += 1
    if done == at:
        os.kill(os.getpid(), signal.SIGKILL)
    real(*arguments, **more)
os.replace = replace
export(folder, Bucket(StoreSettings(directory=store), BUCKET), {'mission_type': 'patrol'}, ExportOptions())
"""


class Killed(BaseException):
    """What no handler expects: as little happens afterwards as after a kill."""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for part in ('data', 'meta', 'videos')
            for path in sorted((folder / part).rglob('*')) if path.is_file() and path.suffix != '.part'}  # fmt: skip


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(2):
        made.record(Mission(f'm{number}', begin_s=100 * number, seconds=2, sensors=('camera', 'odom')))
    return made


def dying(patch: pytest.MonkeyPatch, at: int) -> None:
    """The process dies when it gives a file its name for the ``at``-th time."""
    real, done = os.replace, 0

    def replace(*arguments: Any, **more: Any) -> None:
        nonlocal done
        done += 1
        if done == at:
            raise Killed
        real(*arguments, **more)

    patch.setattr(os, 'replace', replace)


def test_a_killed_export_resumes(house: House, tmp_path: Path) -> None:
    """At every file that it writes: of an episode, of the dataset, the last one."""
    export(tmp_path / 'whole', house.source, PATROLS, ExportOptions())
    wanted = contents(tmp_path / 'whole')
    for at in range(1, 100):
        folder = tmp_path / f'set{at}'
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                export(folder, house.source, PATROLS, ExportOptions())
            except Killed:
                pass
            else:
                break
        export(folder, house.source, PATROLS, ExportOptions())
        assert contents(folder) == wanted, at
    assert at > 15


def test_a_process_that_was_killed_is_followed_by_another(house: House, tmp_path: Path) -> None:
    """With SIGKILL, in an episode and while the dataset is written: another process goes on."""
    export(tmp_path / 'whole', house.source, PATROLS, ExportOptions())
    wanted = contents(tmp_path / 'whole')
    for at in (1, 4, 12):
        folder = tmp_path / f'set{at}'
        arguments = [sys.executable, '-c', DYING, str(folder), str(house.settings.directory), str(at)]
        environ = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
        assert subprocess.run(arguments, env=environ, check=False, timeout=120).returncode == -signal.SIGKILL
        export(folder, house.source, PATROLS, ExportOptions())
        assert contents(folder) == wanted, at


def test_a_killed_worker_is_reported(house: House, tmp_path: Path) -> None:
    """Nothing was added then; the next run gives the same files."""
    export(tmp_path / 'whole', house.source, PATROLS, ExportOptions())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('shadowhound_data_logger.datasets.export.build', kill_this_process)
        with pytest.raises(LakeError, match='a process was killed while building episodes; m0 is not finished'):
            export(tmp_path / 'set', house.source, PATROLS, ExportOptions(), workers=2)
    assert not (tmp_path / 'set' / INFO).exists()
    export(tmp_path / 'set', house.source, PATROLS, ExportOptions(), workers=2)
    assert contents(tmp_path / 'set') == contents(tmp_path / 'whole')


def test_a_drop_that_was_killed_comes_to_its_end(house: House, tmp_path: Path) -> None:
    """Whoever looks at the dataset next finishes it: nothing of the mission is left."""
    export(tmp_path / 'whole', house.source, PATROLS, ExportOptions())
    drop(tmp_path / 'whole', 'm0')
    wanted = contents(tmp_path / 'whole')
    for at in range(1, 100):
        folder = tmp_path / f'set{at}'
        export(folder, house.source, PATROLS, ExportOptions())
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                drop(folder, 'm0')
            except Killed:
                pass
            else:
                break
        made = resumed(folder)
        if 'm0' in made.mission_ids:  # before it was noted that it has to go
            assert at == 1
            continue
        assert contents(folder) == wanted, at
    assert at > 5
