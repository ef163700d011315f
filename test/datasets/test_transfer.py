"""A dataset transferred to SeaweedFS and back, killed and restarted: complete or missing, and nothing is sent twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from datasets.recorded import House, Mission

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.transfer import DatasetPlace, fetch_dataset, upload
from shadowhound_data_logger.stores import open_reader, open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

pytestmark = [pytest.mark.seaweedfs, pytest.mark.long('starts a process for each kill')]
DYING = """
import os, signal, sys
from pathlib import Path
from shadowhound_data_logger.core.config import UploadSettings, store_settings
from shadowhound_data_logger.datasets import transfer
from shadowhound_data_logger.stores import open_store

what, at, folder, url = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]), sys.argv[4]
transfer.THREADS, done, real = 1, 0, getattr(transfer, what)
def dying(*arguments):
    global done
    done += 1
    if done == at:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments)
setattr(transfer, what, dying)
store = open_store(store_settings(os.environ, Path(os.environ['SHADOWHOUND_HOME'])), UploadSettings())
{'_put': transfer.upload, 'download': lambda a, b, c: transfer.fetch_dataset(b, a, c)}[what](
    folder, transfer.DatasetPlace.of(url), store)
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for part in ('data', 'meta', 'videos')
            for path in sorted((folder / part).rglob('*')) if path.is_file() and path.suffix != '.part'}  # fmt: skip


def die(what: str, at: int, folder: Path, url: str, environ: dict[str, str]) -> int:
    arguments = [sys.executable, '-c', DYING, what, str(at), str(folder), url]
    return subprocess.run(arguments, env={**os.environ, **environ}, check=False, timeout=120).returncode


def test_a_dataset_is_complete_or_missing(tmp_path: Path, seaweed: Tower) -> None:
    """Killed at the first file, in the middle and before ``info.json``; then only missing files are transferred."""
    house = House(tmp_path)
    house.record(Mission('only', seconds=2, sensors=('camera', 'odom')))
    made = tmp_path / 'set'
    export(made, house.source, {'mission_type': 'patrol'}, ExportOptions())
    place = DatasetPlace.of('s3://lerobot/datasets/go2/killed')
    environ = {**seaweed.environment(), 'SHADOWHOUND_HOME': str(tmp_path / 'home')}
    count = len(contents(made))
    settings = seaweed.store_settings()
    with closing(open_store(settings, UploadSettings())) as store:
        for at in (1, 4, count - 3):
            assert die('_put', at, made, str(place), environ) == -signal.SIGKILL
            there = [info.key for info in store.list(place.bucket, place.prefix)]
            assert f'{place.prefix}meta/info.json' not in there
        assert len(there) == count - 1
        assert upload(made, place, store).files == 1
    back = tmp_path / 'back'
    with closing(open_reader(settings)) as store:
        for at in (2, count - 1):
            assert die('download', at, back, str(place), environ) == -signal.SIGKILL
            assert not (back / 'meta/info.json').exists()
        assert fetch_dataset(place, back, store).files == 1
    assert contents(back) == contents(made)
