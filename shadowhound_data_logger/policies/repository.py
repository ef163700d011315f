"""The signed metadata in the store, as signers change them: who may sign what, which versions they list, and until when.

A signer works in a separate folder: ``root.json``, which is trusted as on robots, private keys, and ``metadata`` with what was
signed there. Nothing from the store is built upon before it was verified against that: whoever holds the store can neither have
entries signed, nor older ones signed again. Everything is written with the metadata API of python-tuf.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from securesystemslib.signer import CryptoSigner, SSlibKey
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import (
    DelegatedRole,
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Signed,
    Snapshot,
    TargetFile,
    Targets,
    Timestamp,
)

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import ForeignObject, ObjectRefused, PolicyError
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.policies import keys
from shadowhound_data_logger.policies.keys import PRIVATE, SIGNED_DAYS, Passphrase, PublicKey, in_days
from shadowhound_data_logger.policies.manifest import BUCKET
from shadowhound_data_logger.policies.trust import FRESH_DAYS, MAX_METADATA_BYTES, METADATA, ROOT, SIGNED_AT
from shadowhound_data_logger.stores.base import ObjectStore

ROOT_DAYS: Final = 730
RENEW_DAYS: Final = 60
"""So long before is said that a root or a list will expire."""
ROOT_KEY, TARGETS_KEY, ONLINE_KEY = (f'{name}{PRIVATE}' for name in ('root', 'targets', 'online'))
NEXT: Final = '.next'
"""In the names of files that take effect with the next root."""
PENDING: Final = f'root{NEXT}.json'
"""A root that has too few signatures yet."""
ROOT_ROLE, TARGETS = 'root', 'targets'
ONLINE: Final = ('snapshot', 'timestamp')
_STOLEN: Final = 'was a key stolen? policy rotate makes new ones, and robots forget what the old ones signed'
MAX_STEPS: Final = 10_000
"""Versions of a role between what a folder knows and what the store has."""


@dataclass(frozen=True, slots=True)
class Signatures:
    """Of a root: how far it is signed."""

    version: int
    signed: int
    missing: int
    """By the keys that it names itself, and by those of the root before it."""


@dataclass(slots=True)
class InForce:
    """What is in force, verified."""

    root: Metadata[Root]
    lists: dict[str, Metadata[Targets]]
    """Role -> what it lists: ``targets`` and those that it delegates to."""
    snapshot: Metadata[Snapshot] | None
    timestamp: Metadata[Timestamp] | None
    timestamp_etag: str
    """Of what is in the store, whatever that is; empty for nothing."""

    @property
    def expires(self) -> datetime:
        """When robots that receive nothing newer take no new version."""
        return min(each.signed.expires for each in (self.root, self.snapshot, self.timestamp, *self.lists.values()) if each)

    def soon(self) -> Iterator[str]:
        """What expires next that no ``refresh`` renews, and what does."""
        before = in_days(RENEW_DAYS)
        if self.root.signed.expires < before:
            yield f'the root expires on {self.root.signed.expires:%Y-%m-%d}: policy rotate makes another one'
        for role, listed in self.lists.items():
            if listed.signed.expires < before:
                yield f'what {role} lists expires on {listed.signed.expires:%Y-%m-%d}: policy publish with its key signs it again'


class Repository:
    """Life: New; any number of changes, each of which begins with a look at the store. One thread."""

    def __init__(self, folder: Path, store: ObjectStore, passphrase: Passphrase, *, days: float = FRESH_DAYS) -> None:
        self._folder = folder
        self._store = store
        self._passphrase = passphrase
        self._days = days

    # -- what is in force ------------------------------------------------------------------------------------------

    def load(self) -> InForce:
        """Raises PolicyError where this folder has no complete root, and StoreError."""
        root = self._root()
        timestamp, etag = self._timestamp(root)
        snapshot = self._snapshot(root, timestamp)
        lists: dict[str, Metadata[Targets]] = {}
        if targets := self._list(TARGETS, root, snapshot):
            lists[TARGETS] = targets
            for role in delegated(targets.signed):
                if found := self._list(role, targets, snapshot):
                    lists[role] = found
        return InForce(root, lists, snapshot, timestamp, etag)

    def _root(self) -> Metadata[Root]:
        """The newest one: each is signed by the keys of the one before. One that only this folder has is uploaded."""
        root: Metadata[Root] = read_root(self._folder / ROOT)
        if missing := signatures(root).missing:
            remedy = f'policy sign-root {self._folder / ROOT} --key KEY, by each who keeps a root key'
            raise PolicyError(f'{self._folder / ROOT} lacks {missing} signatures', remedy=remedy)
        root = self._newest(root)
        pending = self._folder / PENDING
        if pending.is_file():
            following = read_root(pending)
            if following.signed.version == root.signed.version + 1 and not signatures(following, root).missing:
                self._place(following, ROOT_ROLE, lambda body: _follows(root, body) is not None)
                root = self._newest(root)
            if following.signed.version <= root.signed.version:
                is_ours = following.to_bytes() == root.to_bytes()
                for path in self._folder.glob(f'*{NEXT}*'):  # keys that it names, and itself
                    if is_ours and path != pending:
                        path.replace(path.with_name(path.name.replace(NEXT, '')))
                    else:
                        path.unlink()
        if root.signed.version > 1:
            self._place(root, ROOT_ROLE, lambda body: body == root.to_bytes())
        return root

    def _newest(self, root: Metadata[Root]) -> Metadata[Root]:
        """The last root in the store that follows from this one, which is kept."""
        for _ in range(MAX_STEPS):
            name = f'{root.signed.version + 1}.{ROOT_ROLE}.json'
            body = self._get(name)
            if body is None:
                break
            if (found := _follows(root, body)) is None:  # as long as it is there, no robot goes on
                self._store.delete(BUCKET, f'{METADATA}/{name}')
                break
            root = found
            with durable_files.replacing(self._folder / ROOT, is_synced=True, mode=0o644) as file:
                file.write(root.to_bytes())
        return root

    def _timestamp(self, root: Metadata[Root]) -> tuple[Metadata[Timestamp] | None, str]:
        """The newer one of those of the store and of this folder, and the version of the object."""
        body, etag = self._there('timestamp.json')
        found = [each for each in (_verified(body, root, 'timestamp'), self._kept('timestamp', root)) if each]
        if etag and not found and root.signed.version == 1 and not (self._folder / 'metadata').exists():
            raise PolicyError(f'{BUCKET}/{METADATA} was signed with other keys than those of {self._folder}',
                              remedy='use those keys, or remove what they signed: robots then need the new root')  # fmt: skip
        return max(found, key=lambda each: each.signed.version, default=None), etag

    def _snapshot(self, root: Metadata[Root], timestamp: Metadata[Timestamp] | None) -> Metadata[Snapshot] | None:
        found = self._kept('snapshot', root)
        version = timestamp.signed.snapshot_meta.version if timestamp else 0
        if found is not None and found.signed.version >= version:
            return found
        body = self._get(f'{version}.snapshot.json') if version else None
        return _verified(body or b'', root, 'snapshot') or found

    def _list(self, role: str, delegator: Metadata[Any], snapshot: Metadata[Snapshot] | None) -> Metadata[Targets] | None:
        """The newest list of a role: from the last one of this folder, one after another, or at first from that of the snapshot.

        Junk in between ends that, and nobody counts ahead of it.
        """
        found: Metadata[Targets] | None = self._kept(role, delegator)
        known = snapshot.signed.meta.get(f'{role}.json') if snapshot else None
        if known is not None and found is None:
            found = _verified(self._get(f'{known.version}.{role}.json') or b'', delegator, role, known.version)
        for _ in range(MAX_STEPS):
            version = found.signed.version + 1 if found else 1
            following: Metadata[Targets] | None = _verified(self._get(f'{version}.{role}.json') or b'', delegator, role, version)
            if following is None or (role != TARGETS and not _is_harmless(following.signed)):
                break
            found = following
        return found

    def _there(self, name: str) -> tuple[bytes, str]:
        """What has a name in the store, and its version: empty for nothing. What is larger than any metadata is removed."""
        try:
            return steadily(lambda: self._store.changed(BUCKET, f'{METADATA}/{name}', '', MAX_METADATA_BYTES)) or (b'', '')
        except ObjectRefused as error:
            if error.data.get('reason') == 'size':
                self._store.delete(BUCKET, f'{METADATA}/{name}')
            elif error.data.get('reason') != 'missing':
                raise
            return b'', ''

    def _get(self, name: str) -> bytes | None:
        try:
            return steadily(lambda: self._store.get(BUCKET, f'{METADATA}/{name}', MAX_METADATA_BYTES))
        except ObjectRefused as error:
            return None if error.data.get('reason') == 'missing' else b''  # which is larger than any

    def _kept(self, role: str, delegator: Metadata[Any]) -> Metadata[Any] | None:
        path = self._folder / 'metadata' / f'{role}.json'
        return _verified(path.read_bytes(), delegator, role) if path.is_file() else None

    def listed(self) -> list[str]:
        """The paths of all versions that robots may run."""
        return sorted({path for each in self.load().lists.values() for path in each.signed.targets})

    # -- what is changed -------------------------------------------------------------------------------------------

    def publish(self, targets: Mapping[str, bytes], key: Path | None = None) -> bool:
        """List these manifests (path -> content); whether robots are told already, or ``refresh`` has to do that elsewhere."""
        with self._changing(key) as (role, listed, may_sign):
            for path, content in targets.items():
                if not may_sign(path):
                    raise PolicyError(f'{role} may not sign {path}', remedy='policy delegate says which policies a key may sign')
                listed.targets[path] = TargetFile.from_data(path, content, ['sha256'])
        return self._refresh_if_here()

    def withdraw(self, paths: Collection[str], key: Path | None = None) -> bool:
        """No longer list these; raises PolicyError where none was."""
        with self._changing(key) as (role, listed, _):
            gone = [path for path in paths if listed.targets.pop(path, None)]
            if not gone:
                raise PolicyError(
                    f'{role} does not list {", ".join(sorted(paths))}', remedy='who does? policy delegate NAME --revoke'
                )
        return self._refresh_if_here()

    def delegate(self, public: PublicKey, paths: Sequence[str], key: Path | None = None) -> str:
        """Let another key list versions at these paths, such as ``go2/go2_patrol/*``. Returns the name of the role."""
        role = f'{public.name}-{public.key.keyid[:8]}'  # another key is another role, whose versions begin anew
        for path in paths:
            if path.count('/') != 2 or not all(path.split('/')) or '..' in path:
                raise PolicyError(
                    f'{path!r} is not a pattern of policies', remedy="name robots, policy and versions: 'go2/go2_patrol/*'"
                )
        with self._changing(key, top=True) as (_, listed, _):
            given = listed.delegations or Delegations({}, {})
            assert given.roles is not None
            given.roles[role] = DelegatedRole(role, [public.key.keyid], 1, terminating=False, paths=list(paths))
            given.keys[public.key.keyid] = public.key
            listed.delegations = given
            self._place(Metadata.from_bytes(public.empty), role, lambda _: False)
        self._refresh_if_here()
        return role

    def end_delegation(self, name: str, key: Path | None = None) -> Sequence[str]:
        """Take its rights from a role, by the name of its key or its own: what it listed may run nowhere from then on."""
        with self._changing(key, top=True) as (_, listed, _):
            found = [role for role in delegated(listed) if role == name or role.rpartition('-')[0] == name]
            if not found:
                raise PolicyError(
                    f'nothing is delegated to {name!r}', remedy=f'known are: {", ".join(delegated(listed)) or "none"}'
                )
            for role in found:
                listed.revoke_key(listed.delegations.roles[role].keyids[0], role)  # type: ignore[union-attr, index]
                del listed.delegations.roles[role]  # type: ignore[union-attr]
        self._refresh_if_here()
        return found

    @contextmanager
    def _changing(self, key: Path | None, *, top: bool = False) -> Iterator[tuple[str, Targets, Callable[[str], bool]]]:
        """The list that a key signs, to be changed; signed, kept and uploaded then."""
        state = self._with_lists(self.load())
        signer = keys.load_key(key or self._own_key(), self._passphrase)
        role = self._role(state, signer.public_key.keyid)
        if top and role != TARGETS:
            raise PolicyError(f'the key of {role} may not delegate', remedy=f'name {TARGETS_KEY} by --key')
        metadata = deepcopy(state.lists[role])
        given = None if role == TARGETS else state.lists[TARGETS].signed.get_delegated_role(role)
        yield role, metadata.signed, lambda path: given is None or given.is_delegated_path(path)  # type: ignore[attr-defined]
        self._sign(role, metadata, signer, state.root if role == TARGETS else state.lists[TARGETS])

    def _own_key(self) -> Path:
        found = self._folder / TARGETS_KEY
        if found.is_file():
            return found
        others = [
            path for path in self._folder.glob(f'*{PRIVATE}') if path.name not in {ROOT_KEY, ONLINE_KEY} and NEXT not in path.name
        ]
        if len(others) != 1:
            raise PolicyError(f'there is no {TARGETS_KEY} in {self._folder}', remedy='name the key to sign with by --key')
        return others[0]

    def _role(self, state: InForce, keyid: str) -> str:
        if keyid in state.root.signed.roles[TARGETS].keyids:
            return TARGETS
        targets = state.lists[TARGETS].signed
        found = [role for role in delegated(targets) if keyid in targets.get_delegated_role(role).keyids]
        if not found:
            raise PolicyError(f'nothing is delegated to the key {keyid[:16]}',
                              remedy='policy delegate, by who has targets.key, changes that')  # fmt: skip
        return found[0]

    def _with_lists(self, state: InForce) -> InForce:
        """The same with a list of ``targets``, signed now: empty at first, the last one of this folder after a rotation."""
        if TARGETS in state.lists:
            return state
        if not (self._folder / TARGETS_KEY).is_file():
            raise PolicyError(f'nothing is signed in {METADATA} that the keys of {self._folder / ROOT} may sign',
                              remedy=f'policy refresh, where {TARGETS_KEY} is')  # fmt: skip
        path = self._folder / 'metadata' / f'{TARGETS}.json'
        earlier = Metadata.from_bytes(path.read_bytes()) if path.is_file() else _unsigned(Targets())
        signer = keys.load_key(self._folder / TARGETS_KEY, self._passphrase)
        self._sign(TARGETS, earlier, signer, state.root)
        return self.load()

    # -- keys ------------------------------------------------------------------------------------------------------

    def rotate(self, roles: Collection[str], root_keys: Sequence[Path] = (), new_root: Sequence[PublicKey] = (),
               threshold: int | None = None, passphrase: str = '') -> Signatures:  # fmt: skip
        """A root with new keys for these roles (``root``, ``targets``, ``online``), signed with these keys of the root so far.

        New keys of ``targets`` take those of ``online`` with them: robots then forget how far the old ones had counted. What
        ``targets`` lists then is what was signed in this folder, if anything was. A root with all signatures is in force when
        this returns; otherwise others sign it, and ``refresh`` puts it in force.
        """
        state = self.load()
        root = state.root
        following = deepcopy(root)
        signed = following.signed
        signed.version += 1
        signed.expires = in_days(ROOT_DAYS)
        following.signatures.clear()
        signers = self._root_signers(root_keys, root.signed)
        for path in self._folder.glob(f'*{NEXT}*'):
            path.unlink()
        if ROOT_ROLE in roles:
            publics = [public.key for public in new_root]
            if not publics:
                signers.append(keys.make_key(self._folder / f'root{NEXT}{PRIVATE}', passphrase))
                publics = [signers[-1].public_key]
            _set_keys(signed, ROOT_ROLE, publics, threshold or signed.roles[ROOT_ROLE].threshold)
        if TARGETS in roles:
            if TARGETS in state.lists and not (self._folder / 'metadata' / f'{TARGETS}.json').exists():
                self._keep(TARGETS, state.lists[TARGETS])  # nothing was signed here: what is in force goes on
            made = keys.make_key(self._folder / f'targets{NEXT}{PRIVATE}', passphrase)
            _set_keys(signed, TARGETS, [made.public_key])
        if {TARGETS, 'online'} & {*roles}:
            made = keys.make_key(self._folder / f'online{NEXT}{PRIVATE}')
            for role in ONLINE:
                _set_keys(signed, role, [made.public_key])
        for signer in signers:
            following.sign(signer, append=True)
        (self._folder / PENDING).write_bytes(following.to_bytes())
        found = signatures(following, root)
        if not found.missing:
            self.load()  # which puts it in force, also where somebody else has online.key
            self._refresh_if_here()
        return found

    def _root_signers(self, paths: Sequence[Path], root: Root) -> list[CryptoSigner]:
        """The keys of the root that sign the next one: these, or the one in this folder. Raises PolicyError."""
        if not paths and not (self._folder / ROOT_KEY).is_file():
            raise PolicyError(f'a new root is signed with the keys of the one before, and {ROOT_KEY} is not in {self._folder}',
                              remedy='name them, wherever they are: --key /media/usb/root.key')  # fmt: skip
        signers = [keys.load_key(path, self._passphrase) for path in paths or [self._folder / ROOT_KEY]]
        for path, signer in zip(paths, signers, strict=False):
            if signer.public_key.keyid not in root.roles[ROOT_ROLE].keyids:
                raise PolicyError(f'{path} is not a key of the root of version {root.version}')
        return signers

    # -- what expires ----------------------------------------------------------------------------------------------

    def refresh(self) -> InForce:
        """Sign the timestamp again, and a snapshot of all lists where one is new. Needs the key of both."""
        state = self._with_lists(self.load())
        signer = keys.load_key(self._folder / ONLINE_KEY, self._passphrase)
        if signer.public_key.keyid not in state.root.signed.roles['timestamp'].keyids:
            raise PolicyError(f'{self._folder / ONLINE_KEY} is not the key of root version {state.root.signed.version}',
                              remedy='copy the online.key of the last policy rotate here')  # fmt: skip
        snapshot = state.snapshot or _unsigned(Snapshot(meta={}))
        for role, listed in state.lists.items():
            before = snapshot.signed.meta.get(f'{role}.json')
            if before is not None and before.version > listed.signed.version:
                raise PolicyError(f'a snapshot names version {before.version} of {role}, and the newest that can be verified is '
                                  f'{listed.signed.version}', remedy=_STOLEN)  # fmt: skip
            body = self._uploaded(role, listed, state.root if role == TARGETS else state.lists[TARGETS])
            snapshot.signed.meta[f'{role}.json'] = MetaFile.from_data(listed.signed.version, body, ['sha256'])
        self._sign('snapshot', snapshot, signer, state.root)
        timestamp = state.timestamp or _unsigned(Timestamp())
        timestamp.signed.snapshot_meta = MetaFile.from_data(snapshot.signed.version, snapshot.to_bytes(), ['sha256'])
        timestamp.signed.unrecognized_fields[SIGNED_AT] = f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}'
        self._sign('timestamp', timestamp, signer, state.root, etag=state.timestamp_etag)
        state.snapshot, state.timestamp = snapshot, timestamp
        return state

    def _uploaded(self, role: str, listed: Metadata[Targets], delegator: Metadata[Any]) -> bytes:
        """A list as it is in the store, where it is put again if junk is in its place."""
        version = listed.signed.version
        body = self._get(f'{version}.{role}.json') or b''
        if _verified(body, delegator, role, version) is not None:
            return body
        self._place(listed, role, lambda _: False)
        return listed.to_bytes()

    def _refresh_if_here(self) -> bool:
        if not (self._folder / ONLINE_KEY).is_file():
            return False
        self.refresh()
        return True

    def _sign(self, role: str, metadata: Metadata[Any], signer: CryptoSigner, delegator: Metadata[Any], etag: str = '') -> None:
        """Number, date and sign it, keep it in the folder, and upload it."""
        metadata.signed.version += 1
        metadata.signed.expires = in_days(self._days if role in ONLINE else SIGNED_DAYS)
        metadata.sign(signer)
        delegator.signed.verify_delegate(role, metadata.signed_bytes, metadata.signatures)
        if role == 'timestamp':
            if not self._put('timestamp.json', metadata.to_bytes(), etag):
                raise PolicyError('the timestamp was signed by somebody else meanwhile', remedy='do it once more')
        else:
            version = metadata.signed.version
            self._place(metadata, role, lambda body: _verified(body, delegator, role, version) is not None)
        self._keep(role, metadata)

    def _keep(self, role: str, metadata: Metadata[Any]) -> None:
        kept = self._folder / 'metadata'
        kept.mkdir(mode=0o700, exist_ok=True)
        with durable_files.replacing(kept / f'{role}.json', is_synced=True, mode=0o600) as file:
            file.write(metadata.to_bytes())

    def _place(self, metadata: Metadata[Any], role: str, is_valid: Callable[[bytes], bool]) -> None:
        """Upload it under its number. What is there already gives way, unless it is valid: then somebody else was faster."""
        name, body = f'{metadata.signed.version}.{role}.json', metadata.to_bytes()
        there, etag = self._there(name)
        if there != body and (is_valid(there) or not self._put(name, body, etag)):
            raise PolicyError(f'{name} was signed by somebody else meanwhile', remedy='do it once more')

    def _put(self, name: str, body: bytes, etag: str) -> bool:
        """Whether it is there now, in the place of what had this version; False where that is another one by now."""
        if etag:
            return self._store.replace(BUCKET, f'{METADATA}/{name}', body, etag)
        path = self._folder / f'.{name}.part'
        path.write_bytes(body)
        item = SpooledObject(id=0, bucket=BUCKET, key=f'{METADATA}/{name}', path=path, size=len(body),
                             sha256=hashlib.sha256(body).hexdigest(), content_type='application/json', metadata={}, priority=5,
                             created_ns=time.time_ns())  # fmt: skip
        try:
            steadily(lambda: self._store.put(item))
        except ForeignObject:
            return False
        finally:
            path.unlink()
        return True


def _is_harmless(listed: Targets) -> bool:
    """Whether a delegated list hinders none of another key at the same paths: as one that expires soon, or delegates, would."""
    return listed.delegations is None and listed.expires > in_days(RENEW_DAYS)


def delegated(targets: Targets) -> Sequence[str]:
    """The roles that a list delegates to."""
    return [*targets.delegations.roles] if targets.delegations and targets.delegations.roles else []


# -- roots ---------------------------------------------------------------------------------------------------------------------


def create(folder: Path, root_keys: Sequence[PublicKey] = (), threshold: int = 1, passphrase: str = '') -> Signatures:
    """A folder for signers: a root of version 1, and keys for ``targets`` and ``online``; ``root.key`` if no others are given.

    Raises PolicyError for a folder that has a root, and for a threshold that its keys cannot reach.
    """
    if (folder / ROOT).exists():
        raise PolicyError(f'{folder / ROOT} exists already', remedy='policy rotate replaces keys; another folder is another team')
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    root = Root(expires=in_days(ROOT_DAYS), consistent_snapshot=True)
    own = [] if root_keys else [keys.make_key(folder / ROOT_KEY, passphrase)]
    _set_keys(root, ROOT_ROLE, [*(public.key for public in root_keys), *(signer.public_key for signer in own)], threshold)
    _set_keys(root, TARGETS, [keys.make_key(folder / TARGETS_KEY, passphrase).public_key])
    online = keys.make_key(folder / ONLINE_KEY).public_key  # without a passphrase: cron signs with it
    for role in ONLINE:
        _set_keys(root, role, [online])
    metadata = Metadata(root)
    for signer in own:
        metadata.sign(signer, append=True)
    (folder / ROOT).write_bytes(metadata.to_bytes())
    return signatures(metadata)


def sign_root(path: Path, key: Path, passphrase: Passphrase) -> Signatures:
    """Add a signature to a root. Raises PolicyError for a key that neither it nor the root before it names."""
    root = read_root(path)
    before = read_root(path.parent / ROOT) if path.name != ROOT and (path.parent / ROOT).is_file() else None
    signer = keys.load_key(key, passphrase)
    named = {keyid for each in (root, before) if each for keyid in each.signed.roles[ROOT_ROLE].keyids}
    if signer.public_key.keyid not in named:
        raise PolicyError(f'{key} is not a key of {path}', remedy='it names: ' + ', '.join(keyid[:16] for keyid in sorted(named)))
    root.sign(signer, append=True)
    with durable_files.replacing(path, is_synced=True, mode=0o644) as file:
        file.write(root.to_bytes())
    return signatures(root, before)


def described(path: Path) -> Iterator[str]:
    """What whoever signs a root should look at."""
    root = read_root(path).signed
    yield f'root version {root.version}, valid until {root.expires:%Y-%m-%d}'
    for name, role in root.roles.items():
        yield f'{name}: {role.threshold} of {", ".join(sorted(keyid[:16] for keyid in role.keyids))}'


def read_root(path: Path) -> Metadata[Root]:
    """Raises PolicyError for a file that is not a root."""
    try:
        root: Metadata[Root] = Metadata.from_bytes(path.read_bytes())
    except FileNotFoundError as error:
        raise PolicyError(f'there is no {path}', remedy='policy keys makes it') from error
    except RepositoryError as error:
        raise PolicyError(f'{path} is damaged: {error}') from error
    if not isinstance(root.signed, Root):
        raise PolicyError(f'{path} is not a root')
    return root


def signatures(root: Metadata[Root], before: Metadata[Root] | None = None) -> Signatures:
    """How far a root is signed; ``before`` is the one that is in force, whose keys must sign it too."""
    found = root.signed.get_root_verification_result(before.signed if before else None, root.signed_bytes, root.signatures)
    return Signatures(root.signed.version, len(found.signed), max(found.first.missing, found.second.missing))


def _set_keys(root: Root, role: str, given: Sequence[SSlibKey], threshold: int = 1) -> None:
    if not 1 <= threshold <= len({key.keyid for key in given}):
        raise PolicyError(
            f'{threshold} of {len(given)} keys of {role} cannot sign', remedy='name more keys, or a lower threshold'
        )
    for keyid in [*root.roles[role].keyids]:
        root.revoke_key(keyid, role)
    for key in given:
        root.add_key(key, role)
    root.roles[role].threshold = threshold


def _follows(root: Metadata[Root], body: bytes) -> Metadata[Root] | None:
    """The next root, where it is one: signed by the keys of this one and by its own."""
    with suppress(RepositoryError, ValueError, TypeError, KeyError):
        found: Metadata[Root] = Metadata.from_bytes(body)
        is_next = found.signed.type == ROOT_ROLE and found.signed.version == root.signed.version + 1
        if is_next and not signatures(found, root).missing:
            return found
    return None


def _verified(body: bytes, delegator: Metadata[Any], role: str, version: int | None = None) -> Metadata[Any] | None:
    """What is signed by the keys that the delegator names for the role, and of this version; None for anything else."""
    with suppress(RepositoryError, ValueError, TypeError, KeyError):
        found: Metadata[Any] = Metadata.from_bytes(body)
        delegator.signed.verify_delegate(role, found.signed_bytes, found.signatures)
        if found.signed.type == (role if role in {*ONLINE, ROOT_ROLE} else TARGETS) and version in {None, found.signed.version}:
            return found
    return None


def _unsigned(signed: Signed) -> Metadata[Any]:
    """The metadata of a role before its version 1."""
    signed.version = 0
    return Metadata(signed)
