"""``shadowhound-data query`` on a small lake: its output in each format, its images, and its exit codes."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from lake.making import FAILED, NOON_NS, add, add_part, fill, folder_store, row
from PIL import Image

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores import open_store


@pytest.fixture(scope='module')
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One hour of one day, and two of its images."""
    home = tmp_path_factory.mktemp('home')
    fill(folder_store(home), home / 'tmp', days=(0,), hours=(12,))
    picture = io.BytesIO()
    Image.new('RGB', (64, 48), 'teal').save(picture, 'JPEG')
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        for second in (0, 15):
            add(store, home / 'tmp', row('camera', NOON_NS + second * SECOND)['key'], picture.getvalue())
    return home


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    return CliRunner().invoke(query, arguments, env=env, standalone_mode=True)


def test_a_table_fits_the_terminal(home: Path) -> None:
    """The earliest first; below it the number of objects and that only the first are shown."""
    found = run(home, '--sensor', 'odom')
    assert '2026-10-28 12:00:00  odom' in found.output
    assert '48 objects' in found.output
    assert 'the first 30 are shown' in found.output
    assert f'No objects in the bucket sensor-data in the folder {home}' in run(home, '--sensor', 'lidar').output.replace(
        '\n', ' '
    )


def test_json_and_csv_are_complete(home: Path) -> None:
    """Every column of every row, times as ISO in UTC."""
    answer = json.loads(run(home, '--sensor', 'odom', '--json').output)
    assert len(answer) == 48
    assert answer[0]['t_start'] == '2026-10-28T12:00:00.000000Z'
    assert json.loads(run(home, '--sensor', 'odom', '--format', 'json').output) == answer
    rows = list(csv.DictReader(io.StringIO(run(home, '--sensor', 'odom', '--format', 'csv').output)))
    assert [one['key'] for one in rows] == [one['key'] for one in answer]
    assert rows[0]['t_start'] == answer[0]['t_start']


def test_keys_are_for_other_programs(home: Path) -> None:
    """One per line with its bucket, in the requested order."""
    found = run(home, '--failed', '--sensor', 'camera', '--format', 'keys', '--order', 't_start desc', '--limit', '2')
    assert found.output.splitlines() == [
        'sensor-data/thor/camera/20261028/121545_x.jpg', 'sensor-data/thor/camera/20261028/121530_x.jpg',
    ]  # fmt: skip


def test_flags_restrict_sql(home: Path) -> None:
    """Flags also filter the views that SQL reads."""
    found = run(home, 'SELECT mission_id, result, objects FROM missions', '--failed', '--json')
    assert json.loads(found.output) == [{'mission_id': FAILED, 'result': 'FAILED', 'objects': 16}]
    assert '2 rows' in run(home, 'SELECT sensor, count(*) AS n FROM objects GROUP BY sensor').output


@pytest.mark.long('a second of CPU or more')
def test_a_contact_sheet_is_made_of_the_answer(home: Path, tmp_path: Path) -> None:
    """--sheet draws the readable images, --map the positions on the ground."""
    sheet, ground = tmp_path / 'sheet.jpg', tmp_path / 'map.png'
    asked = ('--sensor', 'camera', '--until', '2026-10-28T12:00:30', '--near', '0,0,9')
    found = run(home, *asked, '--sheet', str(sheet), '--map', str(ground))
    assert found.exit_code == 0, found.output
    with Image.open(sheet) as image:
        assert image.width == 800
        colors = [image.convert('RGB').getpixel((x, 100)) for x in range(image.width)]
        assert sum(color[0] < 20 and 110 < color[1] < 140 for color in colors) > 400  # type: ignore[index, operator]
    with Image.open(ground) as image:
        assert image.width == 800
    assert 'no image' in run(home, '--sensor', 'odom', '--sheet', str(sheet)).output
    for flag in ('--sheet', '--map'):
        refused = run(home, *asked, flag, str(tmp_path / 'nowhere' / 'x.png'))
        assert (refused.exit_code, 'x.png cannot be written: ' in refused.output) == (2, True)


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        (['SELEC'], 'cannot be answered'), (['--where', 'nope < 3'], 'nope'), (['--since', 'tomorrow'], 'since'),
        (['--near', '1,2'], 'near'), (['--order', 'a b c'], '--order'), (['--order', 'nope'], 'nope'),
        (['SELECT sensor FROM objects', '--format', 'keys'], 'bucket and key'), (['--limit', '0'], 'limit'),
    ],
)  # fmt: skip
def test_an_invalid_query_is_wrong_usage(home: Path, arguments: list[str], expected: str) -> None:
    """Exit code 2, and the invalid part is named."""
    found = run(home, *arguments)
    assert found.exit_code == 2
    assert expected in found.output


@pytest.fixture(scope='module')
def unicode_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One object of a mission whose command and type are not ASCII."""
    home = tmp_path_factory.mktemp('spoken')
    summary = {'mission_id': 'm', 'mission_type': '巡逻', 'mission_command': '去厨房 café', 'success': True}
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        add(store, home / 'tmp', 'thor/missions/run/summary.json', json.dumps(summary).encode())
        found = {**row('camera', NOON_NS), 'mission_id': 'm', 'run_id': 'run', 'mission_type': '巡逻'}
        add_part(store, [found], '1', home / 'tmp')
    return home


@pytest.mark.parametrize(('encoding', 'cells'), [
    ('latin-1', b'\\u53bb\\u53a8\\u623f caf\xe9,\\u5de1\\u903b'), ('utf-8', '去厨房 café,巡逻'.encode()),
])  # fmt: skip
def test_csv_is_utf_8_whatever_the_locale(unicode_home: Path, encoding: str, cells: bytes) -> None:
    """Other encodings escape what they lack; an argument that the locale cannot decode is an error without a traceback."""
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'query']
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(unicode_home), 'AWS_ENDPOINT_URL': '', 'PYTHONIOENCODING': encoding,
               'PYTHONUTF8': '0', 'LC_ALL': 'C'}  # fmt: skip
    sql = 'SELECT command, mission_type FROM missions'
    found = subprocess.run([*command, sql, '--format', 'csv'], env=environ, capture_output=True, check=False)
    assert (found.returncode, found.stderr, found.stdout) == (0, b'', b'command,mission_type\n' + cells + b'\n')
    found = subprocess.run([*command, '--mission-type', '巡逻'], env=environ, capture_output=True, check=False)
    assert found.returncode == 2
    assert b'LC_ALL=C.UTF-8' in found.stderr
    assert b'Traceback' not in found.stderr


@pytest.mark.long('a process of its own')
def test_a_missing_library_has_a_remedy(home: Path, tmp_path: Path) -> None:
    """Without deltalake the error names the extra to install, with exit code 2."""
    (tmp_path / 'deltalake.py').write_text("raise ModuleNotFoundError('no', name='deltalake')\n", encoding='utf-8')
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'query']
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(home), 'PYTHONPATH': f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}'}
    ran = subprocess.run(command, env=environ, capture_output=True, text=True, check=False, timeout=60)
    assert ran.returncode == 2
    assert 'shadowhound_data_logger[lake]' in ran.stderr


@pytest.mark.parametrize(
    ('arguments', 'what', 'remedy'),
    [(['--sensor', 'camra'], "no sensor 'camra'", "is it 'camera'"),
     (['--sensor', 'Camera'], "no sensor 'Camera'", "is it 'camera'"),
     (['--robot', 'thro'], "no robot 'thro'", "is it 'thor'?"),
     (['--topic', '/odm'], "no topic '/odm'", "is it '/odom'"),
     (['--mission-type', 'patrl'], "no mission type 'patrl'", "is it 'patrol'?"),
     (['--mission', 'mfial'], "no mission 'mfial'", "is it 'mfailed'?"),
     (['--policy', 'x'], '', ''),
     (['--sensor', 'lidar'], '', ''),
     (['--sensor', 'zzz'], "no sensor 'zzz'", 'there are camera, odom'),
     (['SELECT count(*) FROM objects', '--sensor', 'camra'], "no sensor 'camra'", "is it 'camera'"),
     (['--when', 'camra.x > 1'], "no sensor 'camra'", "is it 'camera'"),
     (['--where', 'imu.accelerometer.2 > 15'], 'cannot be answered', "--when 'imu.accelerometer.2 > 15'"),
     (['--where', 'zzzz > 1'], 'cannot be answered', 'examples'),
     (['--where', 'batery_pct < 30'], 'cannot be answered', "is 'batery_pct' 'battery_pct'?"),
     (['--where', "sensr = 'camera' and bytes > 1"], 'cannot be answered', "is 'sensr' 'sensor'"),
     (['--order', 't_strt'], 'cannot be answered', "is 't_strt' 't_start'"),
     (['SELECT sensr FROM objects'], 'cannot be answered', "is 'sensr' 'sensor'"),
     (['SELECT o.t_strt FROM objects o ORDER BY sensor'], 'cannot be answered', "is 't_strt' 't_start'"),
     (['SELECT * FROM objcts'], 'cannot be answered', "is 'objcts' 'objects'?"),
     (['SELECT mission_tipe FROM missions'], 'cannot be answered', "is 'mission_tipe' 'mission_type'")],
)  # fmt: skip
def test_a_name_that_nothing_has_is_wrong_usage(home: Path, arguments: list[str], what: str, remedy: str) -> None:
    """Exit code 2 and the nearest names; if no name of a kind is known, any name is accepted."""
    env = {'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(query, [*arguments, '--format', 'json'], env=env, standalone_mode=False)
    if not what:
        assert (found.exception, found.return_value) == (None, 0)
        return
    assert isinstance(found.exception, BadUsage)
    assert what in found.exception.message
    assert remedy in found.exception.remedy
