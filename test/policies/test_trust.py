"""What an attacker with stolen keys or access to the store can do to a robot: the attacks of The Update Framework, and more.

https://theupdateframework.github.io/specification/latest/#goals-to-protect-against-specific-attacks
"""

from __future__ import annotations

import hashlib
import shutil
import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from copy import deepcopy
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import pytest
from policies.models import Aliases, Spark, bucket_of, linear, refused
from shadowhound_tower.embedded import Tower
from tuf.api.metadata import DelegatedRole, Delegations, Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp

from shadowhound_data_logger.core.errors import DataLoggerError, PolicyError, PolicyRefused
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.policies import roots, sync
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.keys import load_key, load_public, make_key
from shadowhound_data_logger.policies.manifest import MANIFEST, parse_manifest
from shadowhound_data_logger.policies.registry import BUCKET
from shadowhound_data_logger.policies.smoke import SANDBOX, SmokeRun
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync
from shadowhound_data_logger.policies.trust import METADATA, SIGNED_AT, target_of, why_stale
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

FAR: Final = 1 << 53
EVIL: Final = 66
DAY_NS: Final = 86_400 * 10**9


class Battle:
    """A team with one key each, its store, a robot that trusts it, and a thief who can write to the store and the registry."""

    def __init__(self, path: Path, store: ObjectStore) -> None:
        self.path = path
        self.store = store
        self.spark = Spark(path / 'spark')
        self.registry = Aliases()
        self.folder = PolicyFolder(path / 'thor')
        self.spark.trusted_by(self.folder)
        settings = PolicySettings(name='go2_patrol', robot='thor', min_free_bytes=0)
        self.robot = PolicySync(self.folder, store, self.registry, settings, pause=lambda _: None)

    # -- the store, with full access ---------------------------------------------------------------------------------

    def read(self, name: str) -> bytes:
        return self.store.get(BUCKET, f'{METADATA}/{name}')

    def write(self, name: str, body: bytes, folder: str = METADATA) -> None:
        """Replace an object."""
        path = self.path / 'body'
        path.write_bytes(body)
        key = f'{folder}/{name}'
        self.store.delete(BUCKET, key)
        sha256 = hashlib.sha256(body).hexdigest()
        self.store.put(SpooledObject(1, BUCKET, key, path, len(body), sha256, 'application/json', {}, 5, 0))

    def saved(self) -> dict[str, bytes]:
        """Returns all current metadata."""
        found = [info.key for info in self.store.list(BUCKET, f'{METADATA}/')]
        return {key.rpartition('/')[2]: self.store.get(BUCKET, key) for key in found}

    def newest(self, role: str) -> int:
        """The highest version of a role's files."""
        numbers = (int(name.partition('.')[0]) for name in self.saved() if name.endswith(f'.{role}.json'))
        return max(number for number in numbers if number < FAR)

    # -- the team ----------------------------------------------------------------------------------------------------

    def upload(self, version: int, spark: Spark | None = None) -> bytes:
        """Upload the files of a version, by any author, to a location that a registry may name; returns its manifest."""
        packed, _ = (spark or self.spark).packed(version, linear(0.01 * version))
        for path in packed.rglob('*'):
            if path.is_file():
                self.write(path.relative_to(packed).as_posix(), path.read_bytes(), f'policies/go2/go2_patrol_v{version}')
        return (packed / MANIFEST).read_bytes()

    def publish(self, version: int, **given: Any) -> str:
        """Publish a version as its team does; returns its id."""
        content = self.upload(version)
        self.spark.signing(self.store).publish({target_of('go2', 'go2_patrol', version): content}, **given)
        self.registry.set_alias('champion', version)
        return parse_manifest(content).id

    def stolen(self) -> Thief:
        """A thief with a copy of the key folder, without the root key, which was offline."""
        shutil.copytree(self.spark.keys, self.path / 'stolen')
        root = self.spark.keys / 'root.key'
        if root.exists():
            root.replace(self.path / 'root.key')
            (self.path / 'stolen' / 'root.key').unlink()
        return Thief(self, self.path / 'stolen')

    def rotate(self, *roles: str) -> None:
        self.spark.signing(self.store).rotate(roles or ('targets', 'online'), [self.path / 'root.key'])

    # -- the robot ---------------------------------------------------------------------------------------------------

    def refused(self) -> str:
        return refused(self.robot)

    def taken(self) -> str | None:
        """The active version after a sync."""
        return self.robot.run().active


class Thief:
    """Signs with stolen keys through the metadata API, as our tools would refuse most of it."""

    def __init__(self, battle: Battle, keys: Path) -> None:
        self.battle = battle
        self.keys = keys

    def signed(self, signed: Any, *names: str) -> bytes:
        metadata = Metadata(signed)
        for name in names:
            metadata.sign(load_key(self.keys / f'{name}.key', lambda _: ''), append=True)
        return metadata.to_bytes()

    def targets(self, version: int, evil: bytes) -> bytes:
        """A list with all current versions and an evil one."""
        lists = self.battle.spark.signing(self.battle.store).load().lists
        listed = deepcopy(lists['targets'].signed)
        listed.version = version
        path = target_of('go2', 'go2_patrol', EVIL)
        listed.targets[path] = TargetFile.from_data(path, evil, ['sha256'])
        return self.signed(listed, 'targets')

    def online(self, version: int, targets: bytes, number: int, name: str = 'online') -> None:
        """Write a snapshot and a timestamp for a list."""
        until = datetime.now(timezone.utc) + timedelta(days=1000)
        old = Metadata[Snapshot].from_bytes(self.battle.read(self.snapshot())).signed
        meta = {**old.meta, 'targets.json': MetaFile.from_data(number, targets, ['sha256'])}
        snapshot = self.signed(Snapshot(version=version, expires=until, meta=meta), name)
        timestamp = Timestamp(version=version, expires=until, snapshot_meta=MetaFile.from_data(version, snapshot, ['sha256']))
        self.battle.write(f'{number}.targets.json', targets)
        self.battle.write(f'{version}.snapshot.json', snapshot)
        self.battle.write('timestamp.json', self.signed(timestamp, name))

    def snapshot(self) -> str:
        timestamp = Metadata[Timestamp].from_bytes(self.battle.read('timestamp.json')).signed
        return f'{timestamp.snapshot_meta.version}.snapshot.json'

    def evil(self) -> bytes:
        """The manifest of a version that no team member created; all its files are in the store, and the registry names it."""
        content = self.battle.upload(EVIL, Spark(self.battle.path / 'evil'))
        self.battle.registry.set_alias('champion', EVIL)
        return content


@pytest.fixture(params=['directory', pytest.param('seaweedfs', marks=[pytest.mark.seaweedfs, pytest.mark.long('a real store')])])
def battle(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Battle]:
    """Version 1 is active; smoke runs succeed."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    settings = StoreSettings(directory=tmp_path / 'store')
    if request.param == 'seaweedfs':
        tower: Tower = request.getfixturevalue('seaweed')
        client = bucket_of(tower)
        for entry in client.list_objects_v2(Bucket=BUCKET, Prefix='policies/').get('Contents', ()):
            client.delete_object(Bucket=BUCKET, Key=entry['Key'])
        settings = tower.store_settings()
    with closing(open_store(settings, UploadSettings())) as store:
        battle = Battle(tmp_path, store)
        first = battle.publish(1)
        assert battle.taken() == first
        yield battle


# -- an attacker with the store and no key ---------------------------------------------------------------------------------------


def test_unsigned_software_does_not_run(battle: Battle) -> None:
    """An unsigned version does not run, although its files are in the store and the registry names it."""
    thief = Thief(battle, battle.path / 'none')
    evil = thief.evil()
    assert battle.refused() == 'unlisted'
    thief.keys = battle.path
    make_key(battle.path / 'targets.key')
    make_key(battle.path / 'online.key')
    thief.online(9, thief.targets(2, evil), 2)
    assert battle.refused() == 'untrusted'


def test_older_metadata_is_refused(battle: Battle) -> None:
    """Neither robots nor signers accept older metadata, although its signatures are valid."""
    before = battle.saved()
    second = battle.publish(2)
    assert battle.taken() == second
    for name, body in before.items():
        battle.write(name, body)
    battle.registry.set_alias('champion', 1)
    assert battle.robot.run().stale
    battle.registry.set_alias('champion', 2)
    assert battle.robot.run().active == second
    battle.spark.signing(battle.store).refresh()
    assert battle.robot.run().stale == ''
    assert len(battle.spark.signing(battle.store).listed()) == 2
    versions = [
        Metadata[Timestamp].from_bytes(body).signed.version for body in (before['timestamp.json'], battle.read('timestamp.json'))
    ]
    assert versions[1] > versions[0] + 1, 'it counts on from what it signed, not from what is in the store'


def test_expired_metadata_is_reported_and_nothing_new_is_accepted(battle: Battle) -> None:
    """The robot keeps its policy and reports the expiry; after a refresh it accepts new versions again."""
    first, second = battle.folder.current(), battle.publish(2)
    battle.spark.signing(battle.store, days=0.0).refresh()
    assert battle.refused() == 'expired'
    battle.registry.set_alias('champion', 1)
    kept = battle.robot.run()
    assert (kept.active, kept.done) == (first, 'unchanged')
    assert 'has expired' in kept.stale
    assert why_stale(battle.folder.path, time.time_ns()) == ''
    assert 'expired on' in why_stale(battle.folder.path, time.time_ns() + 20 * DAY_NS)
    battle.spark.signing(battle.store).refresh()
    battle.registry.set_alias('champion', 2)
    assert battle.taken() == second


def test_metadata_of_different_times_is_not_combined(battle: Battle) -> None:
    """Correctly signed files from two different times are rejected together."""
    battle.publish(2)
    for role in ('targets', 'snapshot'):
        latest = battle.newest(role)
        battle.write(f'{latest}.{role}.json', battle.read(f'{latest - 1}.{role}.json'))
        assert battle.refused() == 'untrusted'


@pytest.mark.parametrize('role', ['timestamp', 'root', 'snapshot', 'targets'])
def test_endless_files_are_read_to_their_maximum_size_only(battle: Battle, role: str) -> None:
    """No role's file is read beyond its limit; the next refresh repairs the store."""
    battle.publish(2)
    name = {'timestamp': 'timestamp.json', 'root': '2.root.json'}.get(role) or f'{battle.newest(role)}.{role}.json'
    battle.write(name, bytes(40 << 20))
    tracemalloc.start()
    try:
        assert battle.refused() == 'untrusted'
        assert tracemalloc.get_traced_memory()[1] < 30 << 20
    finally:
        tracemalloc.stop()
    battle.spark.signing(battle.store).refresh()
    assert battle.robot.run().done == 'activated'


@pytest.mark.seaweedfs
@pytest.mark.long('a real store')
def test_a_slow_store_delays_only_its_own_request(seaweed: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A store that sends single bytes blocks one sync, but neither a rollback nor the report of expired metadata.

    When the connection has ended, the next sync succeeds.
    """
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    bucket_of(seaweed)
    with closing(open_store(seaweed.store_settings(), UploadSettings())) as store:
        battle = Battle(tmp_path, store)
        first = battle.publish(1)
        assert battle.taken() == first
        second = battle.publish(2)
        settings = replace(seaweed.store_settings(), endpoint_url='')
        with closing(TricklingFront(urlsplit(seaweed.endpoint_url).port or 0)) as front:
            settings = replace(settings, endpoint_url=f'http://127.0.0.1:{front.port}')
            with closing(open_store(settings, UploadSettings(read_timeout_s=5.0))) as slow:
                robot = replace(battle.robot, store=slow)
                failed: list[BaseException] = []
                poll = threading.Thread(target=lambda: failed.extend(_raised(robot.run)))
                poll.start()
                assert front.is_slow.wait(60.0)
                assert poll.is_alive()
                assert battle.folder.roll_back() is None
                battle.folder.use(str(first))
                assert 'expired on' in why_stale(battle.folder.path, time.time_ns() + 20 * DAY_NS)
                with pytest.raises(PolicyError, match='another process'):
                    battle.robot.run()
                front.close()
                poll.join(60.0)
        assert not poll.is_alive()
        battle.folder.unpin()
        assert battle.taken() == second


def _raised(act: Callable[[], object]) -> list[BaseException]:
    try:
        act()
    except (DataLoggerError, OSError) as error:
        return [error]
    return []


class TricklingFront:
    """A proxy that sends answers in single bytes after the first 2 kB."""

    def __init__(self, to: int) -> None:
        self._to = to
        self._listener = socket.create_server(('127.0.0.1', 0))
        self.port: int = self._listener.getsockname()[1]
        self.is_slow = threading.Event()
        self._over = threading.Event()
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._serve)]
        self._threads[0].start()

    def close(self) -> None:
        if not self._over.is_set():
            self._over.set()
            socket.create_connection(('127.0.0.1', self.port)).close()
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(60.0)
        for one in (self._listener, *self._sockets):
            one.close()

    def _serve(self) -> None:
        while True:
            client, _ = self._listener.accept()
            if self._over.is_set():
                client.close()
                return
            server = socket.create_connection(('127.0.0.1', self._to))
            self._sockets += client, server
            for source, target, is_answer in ((client, server, False), (server, client, True)):
                self._threads.append(threading.Thread(target=self._pass, args=(source, target, is_answer)))
                self._threads[-1].start()

    def _pass(self, source: socket.socket, target: socket.socket, is_answer: bool) -> None:
        passed = 0
        with suppress(OSError):
            while content := source.recv(1 if passed > 2_000 else 4096):
                target.sendall(content)
                passed += len(content) if is_answer else 0
                if passed > 2_000:
                    self.is_slow.set()
                    self._over.wait(1.0)
        with suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def test_a_robot_of_another_team_accepts_nothing(battle: Battle) -> None:
    """Nor can another team sign in this store."""
    other = Spark(battle.path / 'other')
    folder = PolicyFolder(battle.path / 'tachi')
    other.trusted_by(folder)
    robot = replace(battle.robot, folder=folder)
    with pytest.raises(PolicyRefused) as raised:
        robot.run()
    assert raised.value.reason == 'untrusted'
    with pytest.raises(PolicyError, match='signed with other keys'):
        other.signing(battle.store).publish({})


def test_junk_in_the_place_of_the_next_root_is_removed_by_a_signer(battle: Battle) -> None:
    """The next signer removes invalid metadata that would block robots, and a new root can be published."""
    for number in range(2, 20):
        battle.write(f'{number}.root.json', b'{}' if number % 2 else b'[' * 50_000)
        battle.write(f'{number}.targets.json', b'junk')
    battle.stolen()
    second = battle.publish(2)
    assert battle.taken() == second
    battle.write('2.root.json', b'junk')
    battle.rotate()
    assert battle.robot.run().stale == ''
    assert battle.publish(3) == battle.taken()


# -- an attacker with a key ------------------------------------------------------------------------------------------------------


def test_a_stolen_online_key_lists_nothing(battle: Battle) -> None:
    """It can freeze a robot and raise versions to the maximum; a new key ends both."""
    thief = battle.stolen()
    number = battle.newest('targets')
    thief.online(FAR, battle.read(f'{number}.targets.json'), number)
    assert battle.robot.run().done == 'unchanged'
    evil = thief.evil()
    own = Metadata[Targets].from_bytes(thief.targets(number + 1, evil)).signed
    thief.online(FAR + 1, thief.signed(own, 'online'), number + 1)
    assert battle.refused() == 'untrusted'
    battle.rotate('online')
    assert battle.publish(2) == battle.taken()


def test_stolen_targets_and_online_keys_are_replaced_without_a_visit(battle: Battle) -> None:
    """The thief's version runs until the keys are replaced, which touches no robot; then the robot runs the team's version again.

    The thief has raised all versions to the maximum: those of the metadata and of the policy.
    """
    thief = battle.stolen()
    first, evil = battle.folder.current(), thief.evil()
    thief.online(FAR, thief.targets(FAR, evil), FAR)
    assert battle.taken() == parse_manifest(evil).id
    with pytest.raises(PolicyError, match='if a key was stolen'):
        battle.spark.signing(battle.store).refresh()
    battle.rotate()
    assert battle.robot.run().done == 'withdrawn'
    assert battle.folder.current() == first
    assert battle.refused() == 'withdrawn', 'the registry says it still'
    assert battle.publish(2) == battle.taken(), 'though a later one ran here'
    thief.online(FAR + 9, thief.targets(FAR + 9, evil), FAR + 9)
    assert battle.robot.run().stale, 'the old keys are worth nothing'
    battle.spark.signing(battle.store).refresh()
    assert battle.publish(3) == battle.taken()


def test_after_a_stolen_targets_key_is_replaced_only_the_teams_versions_are_listed(battle: Battle) -> None:
    """Robots accept the thief's signed version; new keys list only what was signed in the team's own folder."""
    thief = battle.stolen()
    first, evil = battle.folder.current(), thief.evil()
    number = battle.newest('targets') + 1
    battle.write(f'{number}.targets.json', thief.targets(number, evil))
    battle.spark.signing(battle.store).refresh()
    assert battle.taken() == parse_manifest(evil).id
    battle.rotate()
    assert battle.spark.signing(battle.store).listed() == ['go2/go2_patrol/1']
    assert battle.robot.run().done == 'withdrawn'
    assert battle.folder.current() == first


def test_a_stolen_delegated_key_signs_only_its_policies(battle: Battle) -> None:
    """It lists only versions of the delegated policies, and none after it was revoked; other delegations are unchanged."""
    battle.stolen()
    signing, people = battle.spark.signing(battle.store), battle.path / 'people'
    people.mkdir()
    for name in ('alice', 'bob'):
        make_key(people / f'{name}.key')
    signing.delegate(load_public(people / 'alice.pub'), ['go2/go2_patrol/*'])
    signing.delegate(load_public(people / 'bob.pub'), ['go2/stairs/*', 'soarm/*/*'])
    second = battle.publish(2, key=people / 'alice.key')
    assert battle.taken() == second
    with pytest.raises(PolicyError, match='may not sign'):
        battle.publish(3, key=people / 'bob.key')
    content = battle.upload(4)
    path = target_of('go2', 'go2_patrol', 4)
    lists = signing.load().lists
    bob = next(role for role in lists if role.startswith('bob-'))
    by_bob = Targets(
        version=2, expires=lists[bob].signed.expires, targets={path: TargetFile.from_data(path, content, ['sha256'])}
    )
    battle.write(f'2.{bob}.json', Thief(battle, people).signed(by_bob, 'bob'))
    signing.refresh()
    battle.registry.set_alias('champion', 4)
    assert battle.refused() == 'unlisted', 'it is signed by bob, who may not'
    signing.end_delegation('alice')
    assert battle.robot.run().done == 'withdrawn'
    assert battle.folder.current() == battle.folder.versions.find('go2_patrol@1')
    with pytest.raises(PolicyError, match='nothing is delegated'):
        battle.publish(5, key=people / 'alice.key')
    assert bob in signing.load().lists
    assert battle.publish(6) == battle.taken()


def test_no_key_but_the_root_revokes_another_key(battle: Battle) -> None:
    """A delegated key can revoke no other key, neither with a new root nor with a list that delegates."""
    thief = battle.stolen()
    signing, people = battle.spark.signing(battle.store), battle.path / 'people'
    people.mkdir()
    for name in ('a', 'b'):
        make_key(people / f'{name}.key')
        signing.delegate(load_public(people / f'{name}.pub'), ['go2/go2_patrol/*'])
    second = battle.publish(2, key=people / 'b.key')
    assert battle.taken() == second
    root = Metadata[Root].from_bytes(battle.spark.root.read_bytes()).signed
    root.version, a = 2, load_public(people / 'a.pub').key
    for role in ('root', 'targets', 'snapshot', 'timestamp'):
        root.revoke_key(root.roles[role].keyids[0], role)
        root.add_key(a, role)
    thief.keys = people
    battle.write('2.root.json', thief.signed(root, 'a'))
    assert battle.robot.run().stale
    signing.refresh()
    mine = next(role for role in signing.load().lists if role.startswith('a-'))
    own = Targets(version=2, expires=datetime.now(timezone.utc) + timedelta(days=9))
    own.delegations = Delegations({a.keyid: a}, {'x': DelegatedRole('x', [a.keyid], 1, terminating=True, paths=['go2/*/*'])})
    battle.write(f'2.{mine}.json', thief.signed(own, 'a'))
    signing.refresh()
    assert battle.publish(3, key=people / 'b.key') == battle.taken(), 'a list that delegates is not taken in'
    own.delegations = None
    own.expires = datetime.now(timezone.utc) + timedelta(hours=1)
    battle.write(f'2.{mine}.json', thief.signed(own, 'a'))
    assert battle.publish(4, key=people / 'b.key') == battle.taken(), 'nor is one that will hinder robots when it has expired'
    assert Metadata[Targets].from_bytes(battle.read(f'1.{mine}.json')).signed.expires == signing.load().lists[mine].signed.expires
    signing.end_delegation('a')
    assert battle.publish(5, key=people / 'b.key') == battle.taken()


def test_a_stolen_root_needs_a_visit_to_each_robot(battle: Battle) -> None:
    """With the new root on the robot, it accepts versions signed with the new keys and none signed with the old ones."""
    battle.spark.signing(battle.store).refresh()
    thief = battle.stolen()
    for entry in battle.saved():
        battle.store.delete(BUCKET, f'{METADATA}/{entry}')
    battle.spark = Spark(battle.path / 'new')
    battle.spark.trusted_by(battle.folder)
    second = battle.publish(2)
    assert battle.robot.run().done == 'withdrawn', 'what the old keys listed'
    assert battle.taken() == second
    thief.online(FAR, thief.targets(FAR, thief.evil()), FAR)
    assert battle.refused() == 'untrusted'


def test_a_root_below_its_threshold_changes_nothing(battle: Battle, tmp_path: Path) -> None:
    """One stolen root key of two required ones changes nothing; two honest ones replace it, and robots follow."""
    people = tmp_path / 'people'
    people.mkdir()
    for name in ('alice', 'bob', 'carol', 'dora'):
        make_key(people / f'{name}.key')
    publics = {path.stem: load_public(path) for path in people.glob('*.pub')}
    battle.stolen()
    keepers = [publics[name] for name in ('alice', 'bob', 'carol')]
    signing = battle.spark.signing(battle.store)
    found = signing.rotate(['root'], [battle.path / 'root.key'], keepers, 2)
    assert (found.version, found.missing) == (2, 2)
    pending = battle.spark.keys / roots.PENDING
    for name, missing in (('alice', 1), ('bob', 0)):
        assert roots.sign_root(pending, people / f'{name}.key', lambda _: '').missing == missing
    with pytest.raises(PolicyError, match='is not a key of'):
        roots.sign_root(pending, people / 'dora.key', lambda _: '')
    signing.refresh()
    assert battle.publish(2) == battle.taken()
    root = Metadata[Root].from_bytes(battle.read('2.root.json')).signed
    root.version = 3
    for role in ('targets', 'snapshot', 'timestamp'):
        root.revoke_key(root.roles[role].keyids[0], role)
        root.add_key(publics['dora'].key, role)
    thief = Thief(battle, people)
    battle.write('3.root.json', thief.signed(root, 'alice', 'dora'))
    assert battle.robot.run().stale
    assert battle.publish(3) == battle.taken()
    found = signing.rotate(['root', 'targets'], [people / 'bob.key', people / 'carol.key'], [publics['bob'], publics['carol']], 2)
    assert found.missing == 0
    assert battle.publish(4) == battle.taken()
    root = Metadata[Root].from_bytes(battle.read('3.root.json')).signed
    assert publics['alice'].key.keyid not in root.keys


# -- clocks ----------------------------------------------------------------------------------------------------------------------


def test_with_a_clock_that_was_never_set_nothing_new_is_accepted(battle: Battle) -> None:
    """In 1970 nothing seems expired: the robot accepts nothing new and reports the clock, but still drops withdrawn versions."""
    battle.robot.wall_ns = lambda: 10**9
    second = battle.publish(2)
    with pytest.raises(PolicyRefused, match='the clock of this robot is wrong: it shows 1970-01-01'):
        battle.robot.run()
    assert battle.refused() == 'clock'
    battle.robot.wall_ns = time.time_ns
    assert battle.taken() == second
    battle.robot.wall_ns = lambda: 10**9
    battle.spark.signing(battle.store).withdraw([target_of('go2', 'go2_patrol', 2)])
    assert battle.robot.run().done == 'withdrawn'
    assert battle.folder.current() == battle.folder.versions.find('go2_patrol@1')


def test_a_signer_whose_clock_is_ahead_is_corrected_by_the_next_signature(battle: Battle) -> None:
    """Robots report their own clocks as wrong until the next signature with a correct clock."""
    signing = battle.spark.signing(battle.store)
    state = signing.refresh()
    ahead = deepcopy(state.timestamp)
    assert ahead is not None
    ahead.signed.version += 1
    ahead.signed.unrecognized_fields[SIGNED_AT] = '2099-01-01T00:00:00Z'
    ahead.sign(load_key(battle.spark.keys / 'online.key', lambda _: ''))
    battle.write('timestamp.json', ahead.to_bytes())
    assert 'clock' in battle.robot.run().stale
    signing.refresh()
    assert battle.publish(2) == battle.taken()
