"""``shadowhound-data spool``: what it prints about a spool, what it delivers, and what it retries."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result
from shadowhound_tower.embedded import Tower
from spool.making import BUCKET, assert_whole, make, new_spool, put, rows, settle

from shadowhound_data_logger.cli import spool as drains
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.shipping.uploader import UploadStatus
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.listing import retry


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot's home with a spool of three pending objects, a quarantined one, and one that is held for the clock."""
    for name in ('AWS_ENDPOINT_URL', 'AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'SHADOWHOUND_ROBOT'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    spool = new_spool(tmp_path / 'spool', SystemClock.of_this_machine())  # type: ignore[arg-type]
    spool.open()
    for name in ('a', 'b', 'c'):
        put(spool, make(f'thor/camera/{name}.jpg', name.encode()))
    (refused,) = put(spool, make('thor/camera/d.jpg', b'd'))
    settle(spool, refused, State.QUARANTINED, 'access_denied')
    put(spool, make('thor/_unsynced/boot/e.jpg', b'e', held='clock'))
    spool.close()
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ['spool', *arguments], standalone_mode=False)


def as_json(*arguments: str) -> Any:
    return json.loads(run(*arguments, '--json').stdout)


def states(home: Path) -> dict[str, str]:
    """Key -> state, after checking that the files of pending objects exist and that the ledger balances."""
    found = rows(home / 'spool')
    for row in found:
        if row['state'] == 'pending':
            assert (home / 'spool/ready' / BUCKET / row['key']).is_file()
    assert ledger.imbalances(ledger.read(home / 'spool', 'thor')) == []
    return {row['key'].removeprefix('thor/camera/'): row['state'] for row in found}


def test_list_shows_the_spool(home: Path) -> None:
    """By sensor and state, with remedies; exit code 1 because an object is quarantined."""
    answer = run()
    assert answer.return_value == 1
    text = ' '.join(answer.stdout.split())
    assert f'In {home}/spool' in answer.stdout.replace('\n', '')
    assert 'camera pending 3 3 B' in text
    assert 'camera quarantined: access_denied 1 1 B' in text
    assert 'camera held: clock 1 1 B' in text
    assert 'No node runs here. Start one, or: shadowhound-data spool drain' in text
    assert 'shadowhound-data spool retry --reason access_denied' in text
    assert 'wait for their date' in text


def test_the_spool_is_listed_as_json(home: Path) -> None:
    """With the reason in a separate field."""
    found = as_json()
    assert (found['spool'], found['running'], found['quarantined']) == (f'{home}/spool', [], 1)
    heaps = {(heap['sensor'], heap['state'], heap['reason']): (heap['objects'], heap['bytes']) for heap in found['heaps']}
    assert heaps == {
        ('camera', 'pending', None): (3, 3), ('camera', 'quarantined', 'access_denied'): (1, 1),
        ('camera', 'held', 'clock'): (1, 1),
    }  # fmt: skip


def test_an_empty_spool_is_not_an_error(tmp_path: Path) -> None:
    """Exit code 0 and a sentence."""
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    spool.close()
    answer = run('--spool', str(tmp_path / 'spool'))
    assert answer.return_value == 0
    assert 'Nothing waits' in answer.stdout


@pytest.mark.parametrize('verb', [(), ('list',), ('drain',), ('retry',), ('resend-gaps',)])
def test_without_a_spool_every_verb_names_the_folder(tmp_path: Path, verb: tuple[str, ...]) -> None:
    """The error names the folder and SHADOWHOUND_HOME; no verb creates a spool."""
    answer = run('--spool', str(tmp_path / 'none'), *verb)
    assert isinstance(answer.exception, SpoolError)
    assert f'there is no spool in {tmp_path}/none' in str(answer.exception)
    assert 'SHADOWHOUND_HOME' in str(answer.exception)
    assert not (tmp_path / 'none').exists()


def test_objects_are_listed(home: Path) -> None:
    """With their files; filtered by state, sensor or prefix; --limit shortens the list."""
    found = as_json('list')
    assert [one['key'] for one in found] == [
        'thor/camera/a.jpg', 'thor/camera/b.jpg', 'thor/camera/c.jpg', 'thor/camera/d.jpg', 'thor/_unsynced/boot/e.jpg',
    ]  # fmt: skip
    assert all((home / 'spool' / one['path']).read_bytes() for one in found)
    assert [one['reason'] for one in as_json('list', '--state', 'quarantined')] == ['access_denied']
    assert [one['key'] for one in as_json('list', f'{BUCKET}/thor/_')] == ['thor/_unsynced/boot/e.jpg']
    assert as_json('list', '--sensor', 'lidar') == []
    few = run('list', '--limit', '2')
    assert 'camera/b.jpg' in few.stdout
    assert 'camera/c.jpg' not in few.stdout
    assert 'more than 2' in few.stderr


def test_refused_objects_are_retried(home: Path) -> None:
    """By reason; pending objects and those with other reasons are unchanged."""
    assert as_json('retry', '--reason', 'foreign') == {'objects': 0, 'bytes': 0, 'gone': 0}
    assert states(home)['d.jpg'] == 'quarantined'
    answer = run('retry', '--reason', 'access_denied')
    assert (answer.return_value, answer.stdout) == (0, '1 object (1 B) will be tried again\n')
    assert states(home) == {'a.jpg': 'pending', 'b.jpg': 'pending', 'c.jpg': 'pending', 'd.jpg': 'pending',
                            'thor/_unsynced/boot/e.jpg': 'held'}  # fmt: skip


def test_one_object_is_retried(home: Path) -> None:
    """By name; for an object that is not quarantined the exit code is 1."""
    assert run('retry', f'{BUCKET}/thor/camera/a.jpg').return_value == 1
    assert run('retry', f'{BUCKET}/thor/camera/d.jpg').return_value == 0
    assert states(home)['d.jpg'] == 'pending'


def test_gaps_are_resent(home: Path) -> None:
    """With the next part of the gap journal."""
    assert as_json('resend-gaps') == {'rows': 1}
    answer = run('resend-gaps')
    assert (answer.return_value, answer.stdout) == (0, '1 row of the gap journal will be sent again with the next part\n')


def test_an_object_without_its_file_is_not_retried(home: Path) -> None:
    """The missing file is reported, and the object stays quarantined."""
    (home / 'spool/quarantine/access_denied' / BUCKET / 'thor/camera/d.jpg').unlink()
    answer = run('retry')
    assert answer.return_value == 1
    assert '1 file no longer there' in answer.stdout
    assert states(home)['d.jpg'] == 'quarantined'


def test_an_interrupted_retry_is_completed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If it was interrupted after the file was moved and before its row changed, the next startup completes it."""

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as dying:
        dying.setattr('shadowhound_data_logger.spool.object_table.ObjectStates.set_found', die)
        with pytest.raises(KeyboardInterrupt):
            retry(home / 'spool')
    spool = new_spool(home / 'spool')
    spool.open()
    spool.close()
    assert states(home)['d.jpg'] == 'pending'


@pytest.mark.parametrize('reopens', [False, True])
def test_an_object_is_retried_before_its_file_was_quarantined(
    home: Path, monkeypatch: pytest.MonkeyPatch, *, reopens: bool
) -> None:
    """If a retry or a startup comes between the row and the file, the file stays in ready/."""

    def interfere() -> None:
        if reopens:
            other = new_spool(home / 'spool')
            other.open()
            other.close()
        else:
            retry(home / 'spool', names={f'{BUCKET}/thor/camera/x.jpg'})

    spool = new_spool(home / 'spool')
    spool.open()
    (item,) = put(spool, make('thor/camera/x.jpg', b'x'))
    remove = spool.remove_files

    def remove_later(outcomes: Iterable[Outcome]) -> None:
        interfere()
        remove(outcomes)

    with monkeypatch.context() as patched:
        patched.setattr(spool, 'remove_files', remove_later)
        spool.commit(outcomes=[Outcome(item, State.QUARANTINED, 'access_denied')])
    assert states(home)['x.jpg'] == 'pending'
    assert_whole(home / 'spool')
    settle(spool, item, State.QUARANTINED, 'access_denied')
    assert_whole(home / 'spool')
    spool.close()


def test_a_shell_without_the_nodes_server_delivers_nothing(home: Path) -> None:
    """Otherwise objects for the server would be put into a folder and count as delivered."""
    status = {'store': {'target': 'Tower at http://10.0.0.2:8333'}}
    (home / 'spool' / 'status-thor.json').write_text(json.dumps(status))
    answer = run('drain')
    assert isinstance(answer.exception, SpoolError)
    assert 'delivers to Tower at http://10.0.0.2:8333' in str(answer.exception)
    assert states(home)['a.jpg'] == 'pending'


def test_all_is_delivered_without_a_node(home: Path, seaweed: Tower, monkeypatch: pytest.MonkeyPatch) -> None:
    """To a real server, each with a row in the catalog; held and quarantined objects stay in the spool and are counted."""
    for name, value in seaweed.environment().items():
        monkeypatch.setenv(name, value)
    answer = run('drain', '--json')
    found = json.loads(answer.stdout)
    assert answer.return_value == 0, found
    assert (found['delivered'], found['pending'], found['held'], found['quarantined']) == (5, 0, 1, 1)
    assert states(home)['a.jpg'] == 'delivered'
    books = [row['key'] for row in rows(home / 'spool') if row['sensor'] == '_catalog' and row['state'] == 'delivered']
    assert sorted(key.split('/')[1] for key in books) == ['_catalog', '_gaps'], 'what is quarantined is in the gap journal'
    with closing(sqlite3.connect(home / 'spool/index.db')) as db:
        assert db.execute('SELECT count(*) FROM uncataloged').fetchone() == (0,)
        assert db.execute("SELECT count(*) FROM sessions WHERE robot = 'thor'").fetchone() == (1,)
    assert run('retry').return_value == 0
    assert as_json('drain')['delivered'] == 3  # the object, its part of the catalog, and that it is not a gap any more


def test_an_unreachable_store_is_reported(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gives up after --idle-timeout and prints the reason; the objects stay in the spool."""
    monkeypatch.setenv('AWS_ENDPOINT_URL', 'http://127.0.0.1:9')
    monkeypatch.setenv('AWS_ACCESS_KEY_ID', 'KEYID')
    monkeypatch.setenv('AWS_SECRET_ACCESS_KEY', 'SECRET')
    answer = run('drain', '--idle-timeout', '1')
    assert answer.return_value == 1
    text = ' '.join(answer.stdout.split())
    assert '3 objects still waiting: the S3 server at http://127.0.0.1:9 refused the connection' in text
    assert 'SECRET' not in answer.output
    assert states(home)['a.jpg'] == 'pending'


def test_a_running_node_delivers_alone(home: Path) -> None:
    """The command reports that another process delivers, and changes nothing."""
    with flock(home / 'spool/drain.lock'):
        answer = run('drain', '--idle-timeout', '1')
    assert answer.return_value == 1
    assert 'another process delivers from this spool' in answer.stdout
    assert states(home)['a.jpg'] == 'pending'


@pytest.mark.parametrize(('retries', 'rounds'), [(0, 1000), (1, 0)])
def test_the_timeout_is_for_stalls(home: Path, monkeypatch: pytest.MonkeyPatch, retries: int, rounds: int) -> None:
    """It waits for a slice that takes minutes to send, but not for a store that accepts bytes and then rejects each object."""
    time = SimpleNamespace(now_s=0.0)
    time.monotonic = lambda: time.now_s
    sent = UploadStatus('shipping', '', 0, 1, 0, 0, 0)

    def drain(seconds: float) -> bool:
        nonlocal sent
        time.now_s += seconds
        sent = replace(sent, sent_bytes=sent.sent_bytes + 1, retries=sent.retries + retries)
        if sent.sent_bytes > 1000:
            sent = replace(sent, delivered=1)
        return sent.delivered == 1

    time.sleep = lambda _: None
    monkeypatch.setattr(drains, 'time', time)
    nothing = SimpleNamespace(parts=list, pending_count=lambda: 1)
    uploader = SimpleNamespace(drain=drain, status=lambda: sent)
    with progress() as bar:
        drains._wait(nothing, uploader, nothing, nothing, 1.0, bar)  # type: ignore[arg-type]
    assert sent.sent_bytes > rounds
    assert (sent.delivered == 1) is not bool(retries)
