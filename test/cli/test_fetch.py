"""``shadowhound-data fetch`` by prefix or by query: output and exit codes."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from lake.making import NOON_NS, add_objects, add_part, content, folder_store, row

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.lake import query, selecting
from shadowhound_data_logger.stores import open_store

TIMES = [NOON_NS + second * SECOND for second in range(5)]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A store with ten objects and their part of the catalog."""
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        add_objects(store, TIMES, tmp_path / 'tmp')
    return tmp_path


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(fetch, [*arguments, '--to', str(home / 'data')], env=env, standalone_mode=False)


def files(home: Path) -> list[str]:
    """The fetched files without the file of rows."""
    found = (str(path.relative_to(home / 'data')) for path in (home / 'data' / 'thor').rglob('*.*'))
    return sorted(name for name in found if '_catalog' not in name)


def test_objects_are_fetched_by_prefix(home: Path) -> None:
    """Each to DIR/KEY; a second run transfers nothing and reports that."""
    found = run(home, 'thor/camera/')
    assert found.return_value == 0
    assert '5 objects' in found.output
    assert files(home) == sorted(row('camera', stamp_ns)['key'] for stamp_ns in TIMES)
    report = json.loads(run(home, 'thor/camera/', '--json').output)
    assert (report['moved'], report['present'], report['bytes']) == (0, 5, 0)
    assert (home / 'data' / files(home)[0]).read_bytes() == content('camera', TIMES[0])


def test_objects_are_fetched_by_query(home: Path) -> None:
    """The selected objects; with --limit the earliest."""
    report = json.loads(run(home, '--sensor', 'odom', '--since', '2026-10-28T12:00:01', '--limit', '2', '--json').output)
    assert (report['asked'], report['moved']) == (2, 2)
    assert files(home) == sorted(row('odom', stamp_ns)['key'] for stamp_ns in TIMES[1:3])
    assert 'No objects in the bucket sensor-data' in run(home, '--sensor', 'lidar').output
    assert 'No objects under thor/lidar/ in the bucket x' in run(home, 'thor/lidar/', '--bucket', 'x').output


def test_an_object_that_cannot_be_fetched_is_a_finding(home: Path) -> None:
    """Exit code 1, with key and reason; the others are fetched."""
    gone = row('odom', TIMES[0])['key']
    (home / 'store' / 'sensor-data' / gone).unlink()
    found = run(home, '--sensor', 'odom')
    assert found.return_value == 1
    assert gone in found.output
    assert '1 could not be fetched' in found.output
    assert len(files(home)) == 4


def test_a_repeat_is_not_fetched_twice(home: Path) -> None:
    """A repeated object has two rows with one key: it is fetched once, and both rows are kept."""
    again = {**row('odom', TIMES[0]), **dict.fromkeys(('t_start_ns', 't_end_ns'), TIMES[4] + SECOND)}
    again |= {name: again[f'{name}_ns'] // 1000 for name in ('t_start', 't_end')}
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        add_part(store, [again], 'later', home / 'tmp')
    report = json.loads(run(home, '--sensor', 'odom', '--json').output)
    assert (report['asked'], report['moved'], report['failed']) == (5, 5, {})
    rows = query.objects(selecting.fetched(home / 'data')).to_pydict()['t_start_ns']
    assert sorted(rows) == sorted([*TIMES, again['t_start_ns']])


def test_a_prefix_or_a_query_is_required(home: Path) -> None:
    """Neither or both, or an invalid time, is wrong usage."""
    for arguments in ([], ['thor/', '--sensor', 'odom'], ['--since', 'soon']):
        assert isinstance(run(home, *arguments).exception, click.UsageError)


def test_objects_are_fetched_by_the_times_of_an_answer(home: Path) -> None:
    """Objects of the range's robot that overlap it."""
    times = [
        {'robot': 'thor', 'since_ns': TIMES[1], 'until_ns': TIMES[2]},
        {'robot': 'tachi', 'since_ns': 0, 'until_ns': TIMES[4]},
    ]
    file = home / 'times.json'
    file.write_text(json.dumps({'ranges': times}), encoding='utf-8')
    report = json.loads(run(home, '--sensor', 'odom', '--ranges', str(file), '--json').output)
    assert report['moved'] == 2
    assert files(home) == sorted(row('odom', stamp_ns)['key'] for stamp_ns in TIMES[1:3])


def test_a_sensor_that_does_not_exist_is_wrong_usage(home: Path, tmp_path: Path) -> None:
    """As for a query; nothing is fetched."""
    found = run(home, '--sensor', 'camra', '--to', str(tmp_path / 'data'))
    assert isinstance(found.exception, BadUsage)
    assert found.exception.message == "there is no sensor 'camra'"
    assert found.exception.remedy == "is it 'camera'?"
    assert not (tmp_path / 'data').exists()
