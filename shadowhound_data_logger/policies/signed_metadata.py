"""Reads and writes signed metadata in the store; nothing from the store is used before it was verified."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from securesystemslib.signer import CryptoSigner
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, Root, Signed, Snapshot, Targets, Timestamp

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import ForeignObject, ObjectRefused, PolicyError
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.policies.keys import SIGNED_DAYS, in_days
from shadowhound_data_logger.policies.manifest import BUCKET
from shadowhound_data_logger.policies.roots import NEXT, ONLINE, PENDING, ROOT_ROLE, TARGETS, next_root, read_root, signatures
from shadowhound_data_logger.policies.trust import FRESH_DAYS, MAX_METADATA_BYTES, METADATA, ROOT
from shadowhound_data_logger.stores.base import ObjectStore

RENEW_DAYS: Final = 60
"""How many days in advance a warning names the root or list that will expire."""
MAX_STEPS: Final = 10_000
"""Versions of a role between the one in the folder and the newest in the store."""
_RETRY: Final = 'run the command again'


@dataclass(slots=True)
class InForce:
    """The metadata in force, verified."""

    root: Metadata[Root]
    lists: dict[str, Metadata[Targets]]
    """Role -> its list of versions: ``targets``, and the roles that it delegates to."""
    snapshot: Metadata[Snapshot] | None
    timestamp: Metadata[Timestamp] | None
    timestamp_etag: str
    """ETag of the timestamp object in the store, valid or not; empty if it does not exist."""

    @property
    def expires(self) -> datetime:
        """When robots that receive nothing newer stop accepting new versions."""
        return min(each.signed.expires for each in (self.root, self.snapshot, self.timestamp, *self.lists.values()) if each)

    def expiring(self) -> Iterator[str]:
        """What expires soon and is not renewed by ``refresh``, with the command that renews it."""
        before = in_days(RENEW_DAYS)
        if self.root.signed.expires < before:
            yield f'the root expires on {self.root.signed.expires:%Y-%m-%d}: policy rotate creates a new one'
        for role, listed in self.lists.items():
            if listed.signed.expires < before:
                yield f'the list of {role} expires on {listed.signed.expires:%Y-%m-%d}: policy publish with its key renews it'


class SignedMetadata:
    """The signed metadata of one signer: the copies in the signer's folder, and the store.

    A holder of the store's credentials can neither forge entries nor make a signer sign old ones again, because everything from
    the store is verified against the root and the metadata that were signed here before. One thread.
    """

    def __init__(self, folder: Path, store: ObjectStore, *, days: float = FRESH_DAYS) -> None:
        """Snapshot and timestamp are signed for ``days``."""
        self._folder = folder
        self._store = store
        self._days = days

    # -- reading ---------------------------------------------------------------------------------------------------

    def load(self) -> InForce:
        """The metadata in force. Raises PolicyError if the folder has no completely signed root, and StoreError."""
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

    def stored_list(self, role: str, listed: Metadata[Targets], delegator: Metadata[Any]) -> bytes:
        """The bytes of a list in the store. Uploads the list again if the store has an invalid object in its place."""
        version = listed.signed.version
        body = self._get(f'{version}.{role}.json') or b''
        if _verified(body, delegator, role, version) is not None:
            return body
        self.upload(listed, role)
        return listed.to_bytes()

    def last_signed(self, role: str) -> Metadata[Any] | None:
        """The metadata that was last signed in this folder, without verification."""
        path = self._path(role)
        return Metadata.from_bytes(path.read_bytes()) if path.is_file() else None

    def _root(self) -> Metadata[Root]:
        """The newest root, following the chain from the one in the folder. Uploads a root that the store does not have."""
        root: Metadata[Root] = read_root(self._folder / ROOT)
        if missing := signatures(root).missing:
            remedy = f'policy sign-root {self._folder / ROOT} --key KEY, by each holder of a root key'
            raise PolicyError(f'{self._folder / ROOT} lacks {missing} signatures', remedy=remedy)
        root = self._newest_root(root)
        pending = self._folder / PENDING
        if pending.is_file():
            following = read_root(pending)
            if following.signed.version == root.signed.version + 1 and not signatures(following, root).missing:
                self.upload(following, ROOT_ROLE, lambda body: next_root(root, body) is not None)
                root = self._newest_root(root)
            if following.signed.version <= root.signed.version:
                is_ours = following.to_bytes() == root.to_bytes()
                for path in self._folder.glob(f'*{NEXT}*'):  # the new root and its new keys
                    if is_ours and path != pending:
                        path.replace(path.with_name(path.name.replace(NEXT, '')))
                    else:
                        path.unlink()
        if root.signed.version > 1:
            self.upload(root, ROOT_ROLE, lambda body: body == root.to_bytes())
        return root

    def _newest_root(self, root: Metadata[Root]) -> Metadata[Root]:
        """The last root in the store that follows from this one; the folder keeps it."""
        for _ in range(MAX_STEPS):
            name = f'{root.signed.version + 1}.{ROOT_ROLE}.json'
            body = self._get(name)
            if body is None:
                break
            if (found := next_root(root, body)) is None:  # robots could not get past it
                self._store.delete(BUCKET, f'{METADATA}/{name}')
                break
            root = found
            with durable_files.replacing(self._folder / ROOT, is_synced=True, mode=0o644) as file:
                file.write(root.to_bytes())
        return root

    def _timestamp(self, root: Metadata[Root]) -> tuple[Metadata[Timestamp] | None, str]:
        """The newer timestamp of the store's and this folder's, and the ETag of the object in the store."""
        body, etag = self._get_object('timestamp.json')
        found = [each for each in (_verified(body, root, 'timestamp'), self._kept('timestamp', root)) if each]
        if etag and not found and root.signed.version == 1 and not (self._folder / 'metadata').exists():
            raise PolicyError(f'{BUCKET}/{METADATA} was signed with other keys than those in {self._folder}',
                              remedy='use those keys, or delete the metadata: robots then need the new root')  # fmt: skip
        return max(found, key=lambda each: each.signed.version, default=None), etag

    def _snapshot(self, root: Metadata[Root], timestamp: Metadata[Timestamp] | None) -> Metadata[Snapshot] | None:
        found = self._kept('snapshot', root)
        version = timestamp.signed.snapshot_meta.version if timestamp else 0
        if found is not None and found.signed.version >= version:
            return found
        body = self._get(f'{version}.snapshot.json') if version else None
        return _verified(body or b'', root, 'snapshot') or found

    def _list(self, role: str, delegator: Metadata[Any], snapshot: Metadata[Snapshot] | None) -> Metadata[Targets] | None:
        """The newest list of a role: follows the versions from the last one in this folder, otherwise from the snapshot's.

        An invalid version ends the sequence.
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

    def _get_object(self, name: str) -> tuple[bytes, str]:
        """Content and ETag of an object, empty if it does not exist. An object larger than any metadata is deleted."""
        try:
            return with_retries(lambda: self._store.changed(BUCKET, f'{METADATA}/{name}', '', MAX_METADATA_BYTES)) or (b'', '')
        except ObjectRefused as error:
            if error.data.get('reason') == 'size':
                self._store.delete(BUCKET, f'{METADATA}/{name}')
            elif error.data.get('reason') != 'missing':
                raise
            return b'', ''

    def _get(self, name: str) -> bytes | None:
        """The content of an object; None if it does not exist, empty if it is too large."""
        try:
            return with_retries(lambda: self._store.get(BUCKET, f'{METADATA}/{name}', MAX_METADATA_BYTES))
        except ObjectRefused as error:
            return None if error.data.get('reason') == 'missing' else b''

    def _kept(self, role: str, delegator: Metadata[Any]) -> Metadata[Any] | None:
        path = self._path(role)
        return _verified(path.read_bytes(), delegator, role) if path.is_file() else None

    def _path(self, role: str) -> Path:
        return self._folder / 'metadata' / f'{role}.json'

    # -- writing ---------------------------------------------------------------------------------------------------

    def sign(self, role: str, metadata: Metadata[Any], signer: CryptoSigner, delegator: Metadata[Any], etag: str = '') -> None:
        """Sign metadata with the next version and a new expiry date, upload it, and keep a copy in the folder.

        ``etag`` is that of the timestamp that is replaced. Raises PolicyError if another process signed at the same time.
        """
        metadata.signed.version += 1
        metadata.signed.expires = in_days(self._days if role in ONLINE else SIGNED_DAYS)
        metadata.sign(signer)
        delegator.signed.verify_delegate(role, metadata.signed_bytes, metadata.signatures)
        if role == 'timestamp':
            if not self._put('timestamp.json', metadata.to_bytes(), etag):
                raise PolicyError('another process signed the timestamp at the same time', remedy=_RETRY)
        else:
            version = metadata.signed.version
            self.upload(metadata, role, lambda body: _verified(body, delegator, role, version) is not None)
        self.keep(role, metadata)

    def keep(self, role: str, metadata: Metadata[Any]) -> None:
        """Save a copy in the folder."""
        path = self._path(role)
        path.parent.mkdir(mode=0o700, exist_ok=True)
        with durable_files.replacing(path, is_synced=True, mode=0o600) as file:
            file.write(metadata.to_bytes())

    def upload(self, metadata: Metadata[Any], role: str, is_valid: Callable[[bytes], bool] = lambda _: False) -> None:
        """Upload metadata under its version number, replacing an invalid object.

        Raises PolicyError if the store has a different valid object: another process signed this version at the same time.
        """
        name, body = f'{metadata.signed.version}.{role}.json', metadata.to_bytes()
        stored, etag = self._get_object(name)
        if stored != body and (is_valid(stored) or not self._put(name, body, etag)):
            raise PolicyError(f'another process signed {name} at the same time', remedy=_RETRY)

    def _put(self, name: str, body: bytes, etag: str) -> bool:
        """Replace the object with this ETag, or create it if the ETag is empty; False if the store has another one by now."""
        if etag:
            return self._store.replace(BUCKET, f'{METADATA}/{name}', body, etag)
        path = self._folder / f'.{name}.part'
        path.write_bytes(body)
        item = SpooledObject(id=0, bucket=BUCKET, key=f'{METADATA}/{name}', path=path, size=len(body),
                             sha256=hashlib.sha256(body).hexdigest(), content_type='application/json', metadata={}, priority=5,
                             created_ns=time.time_ns())  # fmt: skip
        try:
            with_retries(lambda: self._store.put(item))
        except ForeignObject:
            return False
        finally:
            path.unlink()
        return True


def delegated(targets: Targets) -> Sequence[str]:
    """The roles that a list delegates to."""
    return [*targets.delegations.roles] if targets.delegations and targets.delegations.roles else []


def unsigned(signed: Signed) -> Metadata[Any]:
    """The metadata of a role before its version 1."""
    signed.version = 0
    return Metadata(signed)


def _is_harmless(listed: Targets) -> bool:
    """Whether a delegated list cannot block other keys with the same paths, as one that expires soon or delegates would."""
    return listed.delegations is None and listed.expires > in_days(RENEW_DAYS)


def _verified(body: bytes, delegator: Metadata[Any], role: str, version: int | None = None) -> Metadata[Any] | None:
    """Metadata of this version, signed by the keys that the delegator names for the role; None for anything else."""
    with suppress(RepositoryError, ValueError, TypeError, KeyError):
        found: Metadata[Any] = Metadata.from_bytes(body)
        delegator.signed.verify_delegate(role, found.signed_bytes, found.signatures)
        if found.signed.type == (role if role in {*ONLINE, ROOT_ROLE} else TARGETS) and version in {None, found.signed.version}:
            return found
    return None
