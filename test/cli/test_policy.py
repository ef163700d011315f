"""The policy verbs for signing, and what a robot reports when its signed metadata has expired."""

from __future__ import annotations

import json
import shutil
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from policies.models import Scene
from tuf.api.metadata import Metadata, Root, Timestamp

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.policies import sync, trust
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.repository import Repository
from shadowhound_data_logger.policies.signed_metadata import SignedMetadata
from shadowhound_data_logger.policies.smoke import SANDBOX, SmokeRun
from shadowhound_data_logger.stores import open_store


class Team:
    """A home with a folder of keys and a store, and the verbs."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.keys = home / 'policy-keys'
        self.store = open_store(StoreSettings(directory=home / 'store'), UploadSettings())

    def run(self, *arguments: object, code: int = 0, **environ: str) -> str:
        """Returns the output, or the text of an error."""
        runner = CliRunner(env={'SHADOWHOUND_HOME': str(self.home), 'COLUMNS': '200', **environ})
        done = runner.invoke(cli, ['policy', *map(str, arguments)], standalone_mode=False)
        if isinstance(done.exception, DataLoggerError):
            assert code == 1, done.exception
            return f'{done.exception}'
        assert (done.exception, done.return_value or 0) == (None, code), done.output
        return done.output

    def publish(self, path: str, key: Path | None = None) -> bool:
        return Repository(self.keys, self.store, lambda _: '').publish({path: b'{}'}, key)

    def root(self) -> Root:
        return Metadata[Root].from_bytes((self.keys / 'root.json').read_bytes()).signed

    def robot(self, name: str) -> PolicyFolder:
        """A robot that trusts the current root."""
        folder = PolicyFolder(self.home / name)
        folder.make()
        (folder.path / 'root.json').write_bytes((self.keys / 'root.json').read_bytes())
        return folder

    def listed(self, robot: PolicyFolder, path: str) -> bool:
        """Whether the robot may run it."""
        return trust.refresh(robot.path, self.store, lambda _: None, lambda _: None).listed(path) is not None


@pytest.fixture
def team(tmp_path: Path) -> Team:
    return Team(tmp_path)


def test_a_team_of_one_has_its_keys_with_one_command(team: Team) -> None:
    """One command makes four files that only the owner can read and prints where each belongs; it never overwrites them."""
    output = team.run('keys')
    for name, word in (('root.key', 'offline'), ('targets.key', 'stays'), ('online.key', 'refresh'), ('root.json', 'each robot')):
        assert any(name in line and word in line for line in output.splitlines()), (name, output)
    assert {path.stat().st_mode & 0o777 for path in team.keys.glob('*.key')} == {0o600}
    assert team.keys.stat().st_mode & 0o777 == 0o700
    before = {path: path.read_bytes() for path in team.keys.iterdir()}
    assert 'already exists' in team.run('keys', code=1)
    assert {path: path.read_bytes() for path in team.keys.iterdir()} == before


def test_keys_with_a_passphrase_are_encrypted(team: Team) -> None:
    """They cannot be used without it; online.key is not encrypted, so that cron can use it."""
    team.run('keys', '--encrypt', SHADOWHOUND_KEY_PASSPHRASE='correct horse')
    assert [b'ENCRYPTED' in (team.keys / f'{name}.key').read_bytes() for name in ('root', 'targets', 'online')] == [
        True,
        True,
        False,
    ]
    team.run('refresh', SHADOWHOUND_KEY_PASSPHRASE='correct horse')
    assert 'the passphrase is wrong' in team.run('rotate', code=1, SHADOWHOUND_KEY_PASSPHRASE='wrong')
    assert team.root().version == 1
    assert 'version 2 is in force' in team.run('rotate', '--encrypt', SHADOWHOUND_KEY_PASSPHRASE='correct horse')
    assert b'ENCRYPTED' in (team.keys / 'targets.key').read_bytes()
    team.run('refresh')


def test_a_root_with_a_threshold_of_two_needs_two_signatures(team: Team) -> None:
    """One signature of three is not enough to sign or rotate; a robot follows every root from the first to the last."""
    people = {name: team.home / 'people' / f'{name}.key' for name in ('alice', 'bob', 'carol')}
    for name in people:
        team.run('keys', '--person', name, '--keys', team.home / 'people')
    publics = [part for key in people.values() for part in ('--root-key', key.with_suffix('.pub'))]
    assert 'the threshold 4' in team.run('keys', '--threshold', 4, *publics, code=1)
    assert 'lacks 2 signatures' in team.run('keys', '--threshold', 2, *publics)
    assert not (team.keys / 'root.key').exists()
    assert 'lacks 2 signatures' in team.run('refresh', code=1)
    root = team.keys / 'root.json'
    output = team.run('sign-root', root, '--key', people['alice'])
    assert 'root: 2 of' in output
    assert '1 missing' in output
    assert '1 missing' in team.run('sign-root', root, '--key', people['alice']), 'the same signature counts once'
    assert 'complete' in team.run('sign-root', root, '--key', people['bob'])
    robot = team.robot('thor')
    assert team.publish('go2/go2_patrol/1')
    assert team.listed(robot, 'go2/go2_patrol/1')

    assert 'lacks 1 signatures' in team.run('rotate', '--key', people['alice'])
    assert team.publish('go2/go2_patrol/2'), 'the old keys are in force until then'
    assert 'complete' in team.run('sign-root', team.keys / 'root.next.json', '--key', people['carol'])
    assert json.loads(team.run('refresh', '--json'))['listed'] == ['go2/go2_patrol/1', 'go2/go2_patrol/2']
    assert team.root().version == 2
    assert team.listed(robot, 'go2/go2_patrol/2')
    assert sorted(path.name for path in team.keys.glob('*.next.*')) == []


def test_an_interrupted_rotation_is_completed(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it was interrupted, the next verb completes it with the new root."""
    team.run('keys')
    robot = team.robot('thor')
    team.publish('go2/go2_patrol/1')
    for version, step in enumerate(('upload', '_newest_root', 'sign', '_put'), 2):
        with monkeypatch.context() as patch:
            after = {'_newest_root': 1, '_put': 2}.get(step, 0)
            patch.setattr(SignedMetadata, step, _failing(getattr(SignedMetadata, step), after=after))
            with pytest.raises(ZeroDivisionError):
                Repository(team.keys, team.store, lambda _: '').rotate(('targets', 'online'))
        assert json.loads(team.run('refresh', '--json'))['listed'] == ['go2/go2_patrol/1'], step
        assert team.root().version == version, step
        assert team.listed(robot, 'go2/go2_patrol/1'), step
        assert list(team.keys.glob('*.next*')) == []


def _failing(act: Any, after: int) -> Any:
    """``act``, which fails after that many calls."""
    calls = []

    def fails(*given: Any, **named: Any) -> Any:
        calls.append(given)
        return act(*given, **named) if len(calls) <= after else 1 // 0

    return fails


def test_new_keys_are_made_with_the_root_alone(team: Team) -> None:
    """Lists signed here stay valid; versions that others signed with a copy of the key are dropped and reported."""
    team.run('keys')
    robot = team.robot('thor')
    shutil.copytree(team.keys, team.home / 'copy')
    team.publish('go2/go2_patrol/1')
    vault = team.home / 'vault'
    vault.mkdir()
    (team.keys / 'root.key').rename(vault / 'root.key')
    shutil.copy(team.keys / 'root.json', vault)
    assert 'has no root.key' in team.run('rotate', code=1)
    output = team.run('rotate', '--keys', vault)
    assert 'listed are: go2/go2_patrol/1' in output
    assert 'copy' in output
    assert team.listed(robot, 'go2/go2_patrol/1')
    Repository(team.home / 'copy', team.store, lambda _: '').load()  # it follows the root
    with pytest.raises(DataLoggerError, match='nothing is delegated'):
        Repository(team.home / 'copy', team.store, lambda _: '').publish({'go2/go2_patrol/2': b'{}'})
    shutil.copytree(vault, team.home / 'third')
    Repository(team.home / 'third', team.store, lambda _: '').publish({'go2/go2_patrol/3': b'{}'})
    output = team.run('rotate', '--keys', vault)
    assert 'no longer listed: go2/go2_patrol/3' in output


def test_of_two_concurrent_rotations_one_is_valid(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only one of two roots with the same version is valid; the second rotation keeps none of its keys."""
    team.run('keys')
    team.publish('go2/go2_patrol/1')
    shutil.copytree(team.keys, team.home / 'other')
    other = Repository(team.home / 'other', team.store, lambda _: '')
    with pytest.raises(DataLoggerError, match='is not a key of root version'):
        other.rotate(('online',), [team.keys / 'targets.key'])
    with monkeypatch.context() as patch:
        patch.setattr(SignedMetadata, 'upload', _failing(SignedMetadata.upload, after=0))
        with pytest.raises(ZeroDivisionError):
            other.rotate(('online',))
    assert 'version 2 is in force' in team.run('rotate')
    with pytest.raises(DataLoggerError, match='is not a key of root version 2'):
        other.refresh()
    assert list((team.home / 'other').glob('*.next*')) == []
    assert 'version 3 is in force' in team.run('rotate', 'root', 'online')


def test_a_delegated_key_signs_some_policies(team: Team) -> None:
    """What it signs is listed after a refresh with online.key; when its delegation is revoked, robots no longer run it."""
    team.run('keys')
    robot = team.robot('thor')
    dora = team.home / 'dora'
    team.run('keys', '--person', 'dora', '--keys', dora)
    assert 'is not a pattern' in team.run('delegate', dora / 'dora.pub', '--for', 'go2_patrol', code=1)
    team.run('delegate', dora / 'dora.pub', '--for', 'go2/go2_patrol/*')
    (dora / 'root.json').write_bytes((team.keys / 'root.json').read_bytes())
    hers = Repository(dora, team.store, lambda _: '')
    assert not hers.publish({'go2/go2_patrol/1': b'{}'})
    assert not team.listed(robot, 'go2/go2_patrol/1')
    assert '1 versions are listed' in team.run('refresh')
    assert team.listed(robot, 'go2/go2_patrol/1')
    with pytest.raises(DataLoggerError, match='may not sign go2/stairs/1'):
        hers.publish({'go2/stairs/1': b'{}'})
    assert 'no longer may sign' in team.run('delegate', 'dora', '--revoke')
    assert not team.listed(robot, 'go2/go2_patrol/1')
    assert "nothing is delegated to 'dora'" in team.run('delegate', 'dora', '--revoke', code=1)


def test_a_public_key_must_be_proven_with_its_private_key(team: Team) -> None:
    """A file that was changed, or that names another key, is rejected."""
    team.run('keys')
    for name in ('eve', 'alice'):
        team.run('keys', '--person', name, '--keys', team.home / 'people')
    eve, alice = (json.loads((team.home / 'people' / f'{name}.pub').read_bytes()) for name in ('eve', 'alice'))
    changed = team.home / 'changed.pub'
    for change in (
        {'public': alice['public']},
        {'name': '../x'},
        {'metadata': {}},
        {'public': 'x'},
        {'metadata': alice['metadata']},
    ):
        changed.write_text(json.dumps({**eve, **change}))
        assert 'is not a public key' in team.run('delegate', changed, '--for', 'go2/*/*', code=1)
    assert team.run('delegate', team.home / 'people' / 'eve.pub', '--for', 'go2/*/*').startswith('eve-')


def test_a_version_is_withdrawn(team: Team) -> None:
    team.run('keys')
    robot = team.robot('thor')
    team.publish('go2/go2_patrol/7')
    assert team.listed(robot, 'go2/go2_patrol/7')
    assert team.run('withdraw', 'go2_patrol@7') == 'go2_patrol@7 is no longer listed\n'
    assert not team.listed(robot, 'go2/go2_patrol/7')
    assert 'does not list' in team.run('withdraw', 'go2_patrol@7', code=1)


def test_of_two_concurrent_signers_the_second_repeats(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second gets an error and tries again: neither change is lost."""
    team.run('keys')
    team.publish('go2/go2_patrol/1')
    one = Repository(team.keys, team.store, lambda _: '')
    load, is_first = one.load, [True]

    def and_another_signs() -> Any:
        state = load()
        if is_first.pop() if is_first else False:
            team.publish('go2/go2_patrol/2')
        return state

    monkeypatch.setattr(one, 'load', and_another_signs)
    with pytest.raises(DataLoggerError, match='another process signed'):
        one.publish({'go2/go2_patrol/3': b'{}'})
    one.publish({'go2/go2_patrol/3': b'{}'})
    assert one.listed() == [f'go2/go2_patrol/{number}' for number in (1, 2, 3)]


def test_stale_metadata_is_reported(team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``policy list``, status and the doctor report it; with a valid timestamp none of them does."""
    team.run('keys')
    robot = team.robot('.')
    team.run('refresh')
    assert team.listed(robot, 'go2/go2_patrol/1') is False

    def reported() -> list[bool]:
        status = CliRunner(env={'SHADOWHOUND_HOME': str(tmp_path)}).invoke(cli, ['status', '--json'], standalone_mode=False)
        doctor = CliRunner(env={'SHADOWHOUND_HOME': str(tmp_path)}).invoke(
            cli, ['doctor', '--role', 'robot', '--only', 'policies', '--json'], standalone_mode=False
        )
        texts = (team.run('list'), json.loads(team.run('list', '--json'))['stale'], status.output, doctor.output)
        return ['expired on' in text for text in texts]

    assert reported() == [False] * 4
    path = robot.path / 'metadata' / 'timestamp.json'
    old = Metadata[Timestamp].from_bytes(path.read_bytes())
    old.signed.expires = datetime.now(timezone.utc) - timedelta(days=1)
    path.write_bytes(old.to_bytes())  # the state of a fortnight ago
    assert reported() == [True] * 4


def test_signing_answers_in_json(team: Team) -> None:
    """Each verb that signs prints one JSON value."""

    def answer(*arguments: object) -> Any:
        return json.loads(team.run(*arguments, '--json'))

    people = team.home / 'people'
    for name in ('alice', 'bob'):
        answer('keys', '--person', name, '--keys', people)
    publics = [part for name in ('alice', 'bob') for part in ('--root-key', people / f'{name}.pub')]
    assert answer('keys', '--threshold', 2, *publics)['missing_signatures'] == 2
    root = team.keys / 'root.json'
    assert answer('sign-root', root, '--key', people / 'alice.key')['missing_signatures'] == 1
    signed = answer('sign-root', root, '--key', people / 'bob.key')
    assert (signed['root'], signed['signatures'], signed['missing_signatures']) == (str(root), 2, 0)
    team.publish('go2/go2_patrol/7')
    (name,) = answer('delegate', people / 'alice.pub', '--for', 'go2/stairs/*')['names']
    assert name.startswith('alice-')
    assert answer('delegate', 'alice', '--revoke') == {'names': [name], 'may_sign': []}
    assert answer('withdraw', 'go2_patrol@7') == {'withdrawn': 'go2_patrol@7', 'robot_types': ['go2'], 'refreshed': True}
    team.publish('go2/go2_patrol/8')
    begun = answer('rotate', '--key', people / 'alice.key')
    assert (begun['root_version'], begun['missing_signatures'], begun['listed']) == (2, 1, ['go2/go2_patrol/8'])
    ended = answer('rotate', *(part for name in ('alice', 'bob') for part in ('--key', people / f'{name}.key')))
    assert (ended['missing_signatures'], ended['listed'], ended['no_longer_listed']) == (0, ['go2/go2_patrol/8'], [])


def test_a_robot_answers_in_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The verbs that select the active version, and a report that rolls back (exit code 1)."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    scene = Scene(tmp_path)
    ids = [(scene.publish(version), scene.robot.run())[0] for version in (1, 2)]
    scene.store.close()
    robot = Team(tmp_path / 'thor')

    def answer(*arguments: object, code: int = 0) -> Any:
        return json.loads(robot.run(*arguments, '--json', code=code))

    assert answer('pin') == {'pinned': ids[1]}
    assert answer('unpin') == {'pinned': None}
    assert answer('rollback') == {'active': ids[0]}
    assert answer('use', 'go2_patrol@2') == {'active': ids[1], 'pinned': ids[1]}
    assert answer('report', '--failures', 0) == {'policy': ids[1], 'rolled_back': False, 'active': ids[1]}
    assert answer('report', '--failures', 100, code=1) == {'policy': ids[1], 'rolled_back': True, 'active': ids[0]}
