"""``shadowhound-data ledger --verify`` on spools and folders made here: what it prints, where it goes on, its exit codes."""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from spool.making import abandon, make, new_spool, put, settle

from shadowhound_data_logger.cli.ledger import ledger
from shadowhound_data_logger.cli.main import main
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.stores.directory import DirectoryStore

SECRET = 'a-Secret-that-nobody-may-see'


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home whose spool has delivered three objects to its folder, and holds one more."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    store = DirectoryStore(tmp_path / 'store')
    items = put(spool, *(make(f'thor/{name}', name.encode()) for name in ('a', 'b', 'c', 'pending')))
    for item in items[:3]:
        store.put(item)
        settle(spool, item, State.DELIVERED)
    abandon(spool)  # without its end, as when it runs
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(ledger, arguments, standalone_mode=False)


def as_json(*arguments: str) -> dict[str, Any]:
    answer = run(*arguments, '--json')
    said: dict[str, Any] = json.loads(answer.stdout)
    assert answer.return_value == (0 if said['ok'] else 1)
    return said


@pytest.mark.parametrize('option', ['--verify', '--deep'])
def test_all_is_there(home: Path, option: str) -> None:
    """Exit code 0, how many were asked for, where, and since when they are remembered."""
    answer = run(option)
    assert answer.return_value == 0
    text = ' '.join(answer.stdout.split())
    assert f'the folder {home}/store was checked for 3 of 3 delivered objects, those since 2025-10-18 12:00:00 UTC.' in text
    assert 'All of them are there' in text
    assert not answer.stderr


def test_what_is_not_there_is_listed(home: Path) -> None:
    """Exit code 1, each kind with its keys, and the same as JSON."""
    (home / 'store/sensor-data/thor/a').unlink()
    (home / 'store/sensor-data/thor/b').write_bytes(b'longer')
    text = run('--verify')
    assert text.return_value == 1
    assert 'sensor-data/thor/a: 1 bytes were delivered' in text.stdout
    assert '2 are not what was delivered' in text.stdout
    said = as_json('--verify')
    assert {kind: [one['key'] for one in piled['first']] for kind, piled in said['findings'].items()} == {
        'missing': ['thor/a'], 'size': ['thor/b'],
    }  # fmt: skip
    assert (said['asked'], said['sound'], said['known'], said['forgotten']) == (3, 1, 3, 0)


def test_another_store_than_the_node_had(home: Path) -> None:
    """Where objects are missing and the node named another store, the report says so; where it named this one, not."""
    status = home / 'spool' / 'status-thor.json'
    for path in (home / 'store').rglob('*'):
        if path.is_file():
            path.unlink()
    for target, is_told in (('the S3 server at http://10.0.0.5:9000', True), (f'the folder {home}/store', False)):
        status.write_text(json.dumps({'robot': 'thor', 'store': {'target': target}}))
        text = ' '.join(run('--verify').stdout.split())
        assert '3 not in the store' in text
        assert (f'But the node delivered to {target}: is AWS_ENDPOINT_URL set here' in text) is is_told
        assert as_json('--verify')['delivered_to'] == [target]


def test_forgotten_objects_are_reported(home: Path) -> None:
    """The report says how many it cannot ask for."""
    with closing(sqlite3.connect(home / 'spool/index.db')) as index:
        index.execute("DELETE FROM objects WHERE key = 'thor/a'")
        index.commit()
    assert '1 older ones are not remembered' in ' '.join(run('--verify').stdout.split())


def test_the_catalog_is_not_called_forgotten(home: Path) -> None:
    """Its parts are not asked for, others stand for them in time; but they are not objects that the index forgot."""
    with closing(sqlite3.connect(home / 'spool/index.db')) as index:
        index.execute("UPDATE objects SET sensor = '_catalog' WHERE key = 'thor/a'")
        index.commit()
    said = as_json('--verify')
    assert (said['known'], said['forgotten']) == (2, 0)


def test_an_unreachable_store(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 1, no object is called missing, how far it came, and no secret; then the folder is another store."""
    monkeypatch.setenv('AWS_ENDPOINT_URL', 'http://127.0.0.1:9')
    monkeypatch.setenv('AWS_ACCESS_KEY_ID', 'KEYID')
    monkeypatch.setenv('AWS_SECRET_ACCESS_KEY', SECRET)
    monkeypatch.setattr('shadowhound_data_logger.core.retry.TRIES', 1)
    answer = run('--verify')
    assert answer.return_value == 1
    text = ' '.join(answer.output.split())
    assert 'The store cannot be reached' in text
    assert '3 objects are not checked yet' in text
    assert SECRET not in text
    said = as_json('--deep')
    assert (said['findings'], said['asked'], bool(said['unreachable'])) == ({}, 0, True)
    monkeypatch.delenv('AWS_ENDPOINT_URL')
    assert as_json('--verify')['asked'] == 3


def test_an_interrupted_run_resumes(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an earlier run found sound is not asked for again, unless that is asked for."""
    heads = DirectoryStore.head

    def interrupted(self: DirectoryStore, bucket: str, key: str) -> Any:
        if key == 'thor/c':
            raise KeyboardInterrupt
        return heads(self, bucket, key)

    for option, asked in (('--verify', 1), ('--again', 3)):
        with monkeypatch.context() as patched:
            patched.setattr(DirectoryStore, 'head', interrupted)
            with pytest.raises(click.Abort):
                CliRunner().invoke(ledger, ['--verify'], standalone_mode=False, catch_exceptions=False)
        said = as_json('--verify', option)
        assert (said['asked'], said['asked_earlier'], said['sound']) == (asked, 3 - asked, 3)


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['--again'], 2, '--again is for --verify'),
    (['--verify', '--spool', '/nonexistent'], 1, 'there is no spool'),
])  # fmt: skip
def test_bad_usage(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    """Code 2 for options that do not fit, 1 for a spool that is not there."""
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'ledger', *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == code
    assert words in capsys.readouterr().err


def test_the_folder_of_a_rescued_disk(home: Path) -> None:
    """A spool that was copied is verified as the one it was."""
    shutil.copytree(home / 'spool', home / 'rescued')
    assert as_json('--verify', '--spool', str(home / 'rescued'))['asked'] == 3
