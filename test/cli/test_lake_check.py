"""``shadowhound-data lake verify``: its reports on a store that lost objects, and its exit codes."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from lake.making import NOON_NS, SENSORS, add, add_objects, add_part, folder_store, row

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.lake import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import StoreError, StoreUnavailable
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import verify
from shadowhound_data_logger.shipping.audit import DIGEST_BYTES, AuditProgress
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.verify import check_object

TIMES = [NOON_NS + second * SECOND for second in range(5)]
KEYS = sorted(row(sensor, stamp_ns)['key'] for sensor in SENSORS for stamp_ns in TIMES)
PATH = 'thor/patrol_20261028_120000.csv'


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Ten objects, one in another bucket, and three parts of the catalog."""
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        add_objects(store, TIMES, tmp_path / 'tmp')
        add(store, tmp_path / 'tmp', PATH, b'x,y', bucket='trajectories')
        path = catalog.row_of('trajectories', PATH, 3, 'text/csv', {'t_start_ns': str(NOON_NS)})
        add_part(store, [path], 'path', tmp_path / 'tmp')
    return tmp_path


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '300', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(lake, ['verify', *arguments], env=env, standalone_mode=False)


def as_json(home: Path, *arguments: str) -> dict[str, Any]:
    answer = run(home, *arguments, '--json')
    report: dict[str, Any] = json.loads(answer.stdout)
    assert answer.return_value == (0 if report['ok'] else 1)
    return report


def found(report: dict[str, Any]) -> dict[str, list[str]]:
    return {kind: [one['key'] for one in group['first']] for kind, group in report['findings'].items()}


def file(home: Path, key: str) -> Path:
    return home / 'store' / catalog.BUCKET / key


@pytest.mark.parametrize('deep', [[], ['--deep']])
def test_a_complete_store_has_no_finding(home: Path, deep: list[str]) -> None:
    """Exit code 0; every bucket is checked, and objects without a checksum in the catalog are counted."""
    answer = run(home, *deep)
    assert answer.return_value == 0
    assert 'checked for 11 of the 11 objects of its own catalog' in answer.stdout
    assert 'Of 1 no checksum is known' in answer.stdout
    assert 'All of them are there' in answer.stdout
    assert as_json(home, *deep, '--sensor', 'camera', '--since', '2026-10-28T12:00:02')['asked'] == 3


def test_each_loss_is_named(home: Path) -> None:
    """Deleted, truncated or changed; a change that keeps size and metadata is found by reading the object."""
    gone, cut, changed, foreign = KEYS[:4]
    file(home, gone).unlink()
    file(home, cut).write_bytes(b'cut')
    file(home, changed).write_bytes(file(home, changed).read_bytes()[::-1])
    (home / 'store' / '.metadata' / catalog.BUCKET / f'{foreign}.json').unlink()
    assert found(as_json(home)) == {'missing': [gone], 'size': [cut], 'foreign': [foreign]}
    assert found(as_json(home, '--deep')) == {'missing': [gone], 'size': [cut], 'checksum': [changed]}
    text = run(home)
    assert f'sensor-data/{gone}: ' in text.stdout
    assert '3 are not as the catalog says' in text.stdout


def test_all_keys_are_in_the_json(home: Path) -> None:
    """The text lists only the first ones."""
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        lost = [row('camera', NOON_NS + (60 + number) * SECOND) for number in range(50)]
        add_part(store, lost, 'lost', home / 'tmp')
    assert found(as_json(home)) == {'missing': sorted(each['key'] for each in lost)}
    assert '... and 30 more' in run(home).stdout


def test_the_catalog_of_another_store_counts_as_well(home: Path, tmp_path: Path) -> None:
    """A copy of the catalog from another store shows which rows, and which of their objects, the store lost."""
    old = tmp_path / 'old'
    shutil.copytree(file(home, 'thor/_catalog'), old / 'thor' / '_catalog')
    assert as_json(home, '--catalog', str(old))['ok']
    for part in file(home, 'thor/_catalog').rglob('*_camera.jsonl.zst'):
        part.unlink()
    cameras = [key for key in KEYS if '/camera/' in key]
    file(home, cameras[0]).unlink()
    own = as_json(home)
    assert (own['ok'], own['asked']) == (True, 6)
    report = as_json(home, '--catalog', str(old))
    assert report['asked'] == 11
    assert found(report) == {'missing': [cameras[0]], 'unlisted': cameras}
    text = run(home, '--catalog', str(old)).stdout
    assert '5 are not as the catalog says' in text
    assert 'lake reindex' in text


@pytest.mark.parametrize(('arguments', 'remedy'), [
    (['--sensor', 'camra'], "is it 'camera'?"), (['--robot', 'thro'], "is it 'thor'?"),
])  # fmt: skip
def test_a_name_that_nothing_has_is_wrong_usage(home: Path, arguments: list[str], remedy: str) -> None:
    """It does not count as an empty selection; the nearest names are suggested."""
    found = run(home, *arguments)
    assert isinstance(found.exception, BadUsage)
    assert found.exception.remedy == remedy


def test_an_empty_selection_is_not_a_success(home: Path) -> None:
    """A missing catalog proves nothing."""
    answer = run(home, '--sensor', 'lidar')
    assert answer.return_value == 1
    assert 'Nothing is verified' in answer.stdout


def test_an_interrupted_run_resumes(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It checks the rest and keeps its findings, even if a kill truncated its notes; after a complete run it starts over."""
    file(home, KEYS[0]).unlink()
    answered: list[Any] = []

    def judge(*arguments: Any, **options: Any) -> Any:
        if len(answered) == 5:
            raise StoreUnavailable('the store is away')
        answered.append(check_object(*arguments, **options))
        return answered[-1]

    monkeypatch.setattr(verify, 'PAGE', 2)
    monkeypatch.setattr('shadowhound_data_logger.cli.lake_check.THREADS', 1)
    with monkeypatch.context() as patched:
        patched.setattr('shadowhound_data_logger.shipping.audit.check_object', judge)
        assert as_json(home)['unreachable']
    (notes,) = (home / 'verify').iterdir()
    assert notes.stat().st_size == 4 * DIGEST_BYTES
    with notes.open('ab') as torn:
        torn.write(b'half')
    assert as_json(home, '--sensor', 'camera')['asked'] == 5  # another question
    report = as_json(home)
    assert (report['asked'], report['asked_earlier'], report['sound']) == (7, 4, 10)
    assert found(report) == {'missing': KEYS[:1]}
    assert list((home / 'verify').iterdir()) == []
    assert as_json(home)['asked'] == 11


def test_only_one_process_verifies_the_same_selection(home: Path, tmp_path: Path) -> None:
    """A second one gets an error; old notes are deleted; a home that is read-only is verified anyway."""
    with AuditProgress(tmp_path / 'verify', 'x'):
        with pytest.raises(StoreError, match='another process'), AuditProgress(tmp_path / 'verify', 'x'):
            pass
        (old,) = (tmp_path / 'verify').iterdir()
        os.utime(old, (0, 0))
    with AuditProgress(tmp_path / 'verify', 'y'):
        assert not old.exists()
    shutil.rmtree(home / 'verify', ignore_errors=True)
    (home / 'verify').write_text('')
    assert as_json(home)['asked'] == 11


def test_wrong_usage_is_refused(home: Path) -> None:
    """A folder without a catalog, a filter that needs the store's tables, an invalid time."""
    for wrong in (['--catalog', str(home / 'tmp')], ['--catalog', str(home), '--failed'], ['--since', 'soon']):
        assert isinstance(run(home, *wrong).exception, click.UsageError)
