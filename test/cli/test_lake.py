"""``shadowhound-data lake``: its verbs and what they print about the catalog."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from lake.gap_parts import IMU, lost, mark, tell
from lake.making import NOON_NS, fill, folder_store
from PIL import Image

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.label import label
from shadowhound_data_logger.cli.lake import lake
from shadowhound_data_logger.formats.rows.gaps import GAP, statement


@pytest.fixture
def home(tmp_path: Path) -> Path:
    fill(folder_store(tmp_path), tmp_path / 'tmp', hours=(12,))
    return tmp_path


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(lake, arguments, env=env, standalone_mode=True)


def test_status_counts_waiting_and_ingested_rows(home: Path) -> None:
    """Row files wait until they are ingested; rejected rows are counted."""
    (before,) = json.loads(run(home, 'status', '--json').output)
    assert (before['robot'], before['objects'], before['waiting'], before['first']) == ('thor', 0, 24, None)
    run(home, 'ingest')
    (after,) = json.loads(run(home, 'status', '--json').output)
    assert after == {'robot': 'thor', 'days': 2, 'first': '2026-10-28', 'last': '2026-10-29', 'objects': 192, 'rows': 194,
                     'waiting': 0, 'rejected': 0}  # fmt: skip
    assert 'thor' in run(home, 'status').output
    (home / 'store/sensor-data/thor/_catalog/date=2026-10-28/bad.jsonl.zst').write_bytes(b'hello')
    run(home, 'ingest')
    assert json.loads(run(home, 'status', '--robot', 'thor', '--json').output) == [{**after, 'rejected': 1}]


def test_ingest_adds_each_row_once_and_names_what_it_rejects(home: Path) -> None:
    """A second run finds nothing new; an invalid row file is named."""
    first = json.loads(run(home, 'ingest', '--json').output)
    assert (first['files'], first['rows'], first['repeated'], first['rejected']) == (24, 192, 0, 0)
    assert 'All row files are in the tables' in run(home, 'ingest').output
    (home / 'store/sensor-data/thor/_catalog/date=2026-10-28/bad.jsonl.zst').write_bytes(b'hello')
    bad = run(home, 'ingest')
    assert '1 row rejected' in bad.stdout
    assert 'bad.jsonl.zst is skipped' in bad.stderr


def test_an_empty_store_is_no_error(tmp_path: Path) -> None:
    """``status`` and ``ingest`` succeed."""
    assert 'no rows yet in the bucket sensor-data' in run(tmp_path, 'status').output
    assert run(tmp_path, 'ingest').exit_code == 0


def test_reindex_reports_its_result(home: Path) -> None:
    """Rows of deleted objects are counted; objects without a row get one."""
    report = json.loads(run(home, 'reindex', '--robot', 'thor', '--json').output)
    assert report == {'listed': 2, 'added': 2, 'parts': 1, 'gone': 192}
    again = run(home, 'reindex', '--robot', 'thor')
    assert '0 were not in the catalog' in again.output
    assert '192 rows name objects that are gone' in again.output


def ended(home: Path, *arguments: str) -> Result:
    """The result with the return value of the verb."""
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(lake, arguments, env=env, standalone_mode=False)


def test_prune_lists_deletions_and_confirms_a_complete_sensor(home: Path) -> None:
    """Without a terminal it deletes nothing; nor does a dry run; objects that a label refers to need --force."""
    rules = ('prune', '--keep', 'camera 2026-10-29, odom forever, lidar 1d')
    dry = ended(home, *rules, '--dry-run')
    assert dry.return_value == 0
    assert '48 objects' in dry.output
    assert 'There are no objects of lidar' in dry.output
    everything = ('prune', '--keep', 'camera 1d')
    asked = ended(home, *everything)
    assert asked.return_value == 1
    assert 'all 96 objects of camera' in asked.output
    assert 'Nothing is deleted' in asked.output
    assert json.loads(ended(home, *everything, '--dry-run', '--json').output)['going'] == 96
    env = {'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': ''}
    assert CliRunner().invoke(label, ['add', 'keep', '--robot', 'thor', '--since', '2026-10-28T12:00', '--until',
                                      '2026-10-28T12:00:20'], env=env).exit_code == 0  # fmt: skip
    forced = ended(home, *rules, '--force')
    assert forced.return_value == 1
    assert 'referred to: 2 by a label. By: label keep.' in forced.output
    assert '46 objects' in ended(home, *rules).output
    assert 'There is nothing to delete' in ended(home, *rules).output
    assert json.loads(ended(home, *rules, '--force', '--yes', '--json').output)['deleted'] == 2
    assert run(home, 'prune', '--keep', 'camera').exit_code == 2
    assert 'is not a size' in run(home, *rules, '--max-bytes', 'much').output
    assert ended(home, *rules, '--max-bytes', '1', '--dry-run').return_value == 1


@pytest.mark.parametrize(('arguments', 'remedy'), [
    (['--keep', 'camra 1d'], "is it 'camera' or 'camera_info'?"), (['--keep', 'odom 30d, bagz 1d'], "is it 'bags'?"),
    (['--keep', 'camera 1d', '--robot', 'thro'], "is it 'thor'?"),
])  # fmt: skip
def test_prune_takes_a_name_that_nothing_has_for_wrong_usage(home: Path, arguments: list[str], remedy: str) -> None:
    """Nothing is deleted, not even with --yes; the nearest names are suggested."""
    found = ended(home, 'prune', *arguments, '--yes')
    assert isinstance(found.exception, BadUsage)
    assert found.exception.remedy == remedy
    assert json.loads(ended(home, 'prune', '--keep', 'camera 1d', '--dry-run', '--json').output)['going'] == 96


def test_a_robot_is_required(home: Path) -> None:
    """``reindex`` without --robot is wrong usage."""
    assert run(home, 'reindex').exit_code == 2


@pytest.fixture
def gaps(tmp_path: Path) -> Path:
    """Two hours of two topics: one with two gaps, and one that is downsampled and has no report for the second hour."""
    hour = 3600
    rows = [mark(hour), mark(2 * hour, 2), lost('1', 600, 660), lost('2', 7000, 7010, cause='queue_full'),
            mark(hour, topic='/odom', skipped=7)]  # fmt: skip
    untimed = statement('thor', GAP, 'j/u', 1, **{**IMU, 'topic': '/odom'}, count=12)
    tell(folder_store(tmp_path), tmp_path, *rows, untimed)
    return tmp_path


TWO_HOURS = ('coverage', '--since', '2026-10-28T12:00', '--until', '2026-10-28T14:00')


def test_coverage_is_printed_as_a_table(gaps: Path) -> None:
    """One line per hour: stored, downsampled, lost with the cause, and unknown."""
    found = run(gaps, *TWO_HOURS)
    assert found.exit_code == 0
    lines = [line.split() for line in found.stdout.splitlines()]
    assert lines[1:5] == [
        ['thor', '/imu', '10-28', '12:00', '98.3', '%', '-', '1.7', '%', '-', 'transport', '1', 'min'],
        ['thor', '/imu', '10-28', '13:00', '99.7', '%', '-', '0.3', '%', '-', 'queue_full', '10', 's'],
        ['thor', '/odom', '10-28', '12:00', '-', '100', '%', '-', '-'],
        ['thor', '/odom', '10-28', '13:00', '-', '-', '-', '100', '%'],
    ]
    assert 'thor /odom: 12 messages were lost at unknown times.' in found.stdout


def test_coverage_is_printed_as_json(gaps: Path) -> None:
    """Seconds per hour, and up to when they are known."""
    (imu,) = json.loads(run(gaps, *TWO_HOURS, '--topic', '/imu', '--json').stdout)
    assert imu['hours'] == [
        {'begin': '2026-10-28T12:00Z', 'seconds': {'stored': 3540.0, 'transport': 60.0}},
        {'begin': '2026-10-28T13:00Z', 'seconds': {'queue_full': 10.0, 'stored': 3590.0}},
    ]
    assert (imu['complete_ns'], imu['gaps'], imu['untimed']) == (NOON_NS + 7200 * 10**9, 2, 0)


def test_coverage_is_drawn_as_an_image(gaps: Path, tmp_path: Path) -> None:
    """Blue for stored, red for lost, gray for unknown."""
    assert run(gaps, *TWO_HOURS, '--chart', str(tmp_path / 'coverage.png')).exit_code == 0
    with Image.open(tmp_path / 'coverage.png') as picture:
        colors = {color for _, color in picture.convert('RGB').getcolors(1 << 24) or ()}
    assert colors >= {(0x1F, 0x6F, 0xB2), (0xC0, 0x39, 0x2B), (0x9C, 0xC4, 0xE4), (0xC7, 0xCF, 0xD6)}


def test_coverage_without_gap_reports_is_unknown(gaps: Path) -> None:
    """A topic without reports is 100 % unknown; an invalid range is wrong usage."""
    assert '100 %' in run(gaps, *TWO_HOURS, '--robot', 'thor', '--topic', '/scan').stdout
    assert 'Nothing is known' in run(gaps, *TWO_HOURS, '--robot', 'tachi').stdout
    assert run(gaps, 'coverage', '--since', '2026-10-28', '--until', '2026-10-27').exit_code == 2
    assert run(gaps, 'coverage', '--since', '1971-01-01').exit_code == 2
