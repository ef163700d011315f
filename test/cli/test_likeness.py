"""``lake embed`` and ``query --like``: what they print, and their exit codes."""

from __future__ import annotations

import hashlib
import io
import json
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from lake.image_pairs import make_pair
from lake.making import NOON_NS, add, add_part, folder_store, row
from PIL import Image

from shadowhound_data_logger.cli.common import BadUsage, ExitCode
from shadowhound_data_logger.cli.likeness import lake_embed
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores import open_store


@pytest.fixture(scope='module')
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red and a blue image, and an invalid one."""
    home = tmp_path_factory.mktemp('home')
    make_pair(home / 'colors')
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        for place, color in enumerate(['red', 'blue', None]):
            out = io.BytesIO(b'no picture')
            if color:
                Image.new('RGB', (64, 48), color).save(out, 'PNG')
            if color == 'red':
                (home / 'red.png').write_bytes(out.getvalue())
            body = out.getvalue()
            entry = {**row('camera', NOON_NS + place * SECOND), 'bytes': len(body), 'sha256': hashlib.sha256(body).hexdigest()}
            add(store, home / 'tmp', str(entry['key']), body)
            add_part(store, [entry], str(place), home / 'tmp')
    return home


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': ''}
    command = {'embed': lake_embed, 'query': query}[arguments[0]]
    return CliRunner().invoke(command, arguments[1:], env=env, standalone_mode=arguments[0] == 'query')


def test_similar_images_are_found_after_embedding(home: Path) -> None:
    asked = run(home, 'query', '--like', str(home / 'red.png'), '--model', str(home / 'colors'))
    assert '3 of 3 pictures have no vector by the model colors' in asked.output
    assert f'shadowhound-data lake embed --model {home / "colors"} makes them' in asked.output
    made = run(home, 'embed', '--model', str(home / 'colors'))
    assert made.return_value == ExitCode.FINDING
    assert '2 vectors made by the model colors' in made.output
    assert '1 picture without one: no JPEG, PNG or TIFF' in made.output
    report = json.loads(run(home, 'embed', '--model', str(home / 'colors'), '--json').stdout)
    assert (report['pictures'], report['known'], report['made'], report['refused']) == (3, 2, 0, {'unreadable': 1})
    for question in (['--like', str(home / 'red.png')], ['--like-text', 'red']):
        found = run(home, 'query', *question, '--model', str(home / 'colors'), '--limit', '1', '--format', 'keys')
        assert 'sensor-data/thor/camera/20261028/120000_x.jpg' in found.output
    asked_with = ['--like-text', 'blue', '--model', str(home / 'colors'), '--sheet', str(home / 'sheet.jpg')]
    table = run(home, 'query', *asked_with)
    assert '1.000  2026-10-28 12:00:01  camera' in table.output
    assert (home / 'sheet.jpg').stat().st_size > 1000


def test_a_sensor_that_does_not_exist_is_wrong_usage(home: Path) -> None:
    """The nearest names are suggested."""
    found = run(home, 'embed', '--model', str(home / 'colors'), '--sensor', 'camra')
    assert isinstance(found.exception, BadUsage)
    assert found.exception.remedy == "is it 'camera'?"


@pytest.mark.parametrize(('arguments', 'says'), [
    (['--like-text', 'door'], 'images are compared by a model'),
    (['--like', 'red.png', '--like-text', 'door'], 'asks for pictures'), (['--model', '.'], 'asks for pictures'),
    (['--like', 'red.png', '--order', 'bytes'], 'asks for pictures'),
    (['--like', 'red.png', '--model', '.'], 'has no image model'),
    (['--like', 'notes.txt', '--model', 'colors'], 'cannot be compared'),
])  # fmt: skip
def test_an_invalid_question_is_wrong_usage(home: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str) -> None:
    monkeypatch.chdir(home)
    Path('notes.txt').write_text('no picture')
    found = run(home, 'query', *arguments)
    assert found.exit_code == 2
    assert says in found.output
