"""``shadowhound-data lake``: what it says of the catalogue, and that its verbs do what they say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from lake.making import fill, folder_store

from shadowhound_data_logger.cli.lake import lake


@pytest.fixture
def home(tmp_path: Path) -> Path:
    fill(folder_store(tmp_path), tmp_path / 'tmp', hours=(12,))
    return tmp_path


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(lake, arguments, env=env, standalone_mode=True)


def test_status_compact_status(home: Path) -> None:
    """Two days of twelve files become one each; what they were is deleted by a later run, or never."""
    assert json.loads(run(home, 'status', '--json').output)[0] == {
        'robot': 'thor', 'days': 2, 'first': '2026-10-28', 'last': '2026-10-29', 'files': 24, 'compacted': 0, 'open_days': 2,
        'covered': 0, 'size': json.loads(run(home, 'status', '--json').output)[0]['size'],
    }  # fmt: skip
    assert 'thor' in run(home, 'status').output
    merged = run(home, 'compact', '--before', '2026-10-30').output
    assert '24 files are 2 now, one a day' in merged
    assert '24 that are stood for' in merged
    assert 'There is nothing to merge' in run(home, 'compact', '--before', '2026-10-30', '--keep').output
    assert [row['covered'] for row in json.loads(run(home, 'status', '--json').output)] == [24]
    assert '24 that were merged earlier are deleted' in run(home, 'compact', '--before', '2026-10-30', '--grace', '0').output
    after = json.loads(run(home, 'status', '--json').output)[0]
    assert (after['files'], after['compacted'], after['open_days'], after['covered']) == (2, 2, 0, 0)


def test_an_empty_store_is_no_error(tmp_path: Path) -> None:
    """There is nothing to say and nothing to do."""
    assert 'no catalogue yet in the bucket sensor-data' in run(tmp_path, 'status').output
    assert run(tmp_path, 'compact').exit_code == 0


def test_reindex_says_what_it_found(home: Path) -> None:
    """Rows of objects that are gone are counted, objects without a row get one."""
    told = json.loads(run(home, 'reindex', '--robot', 'thor', '--json').output)
    assert told == {'listed': 2, 'added': 2, 'parts': 1, 'gone': 192}
    again = run(home, 'reindex', '--robot', 'thor')
    assert '0 were not in the catalogue' in again.output
    assert '192 rows name objects that are gone' in again.output


def test_bad_usage(home: Path) -> None:
    """A date that is none; no robot."""
    assert run(home, 'compact', '--before', 'soon').exit_code == 2
    assert run(home, 'compact', '--before', '3000d').exit_code == 0
    assert run(home, 'reindex').exit_code == 2
