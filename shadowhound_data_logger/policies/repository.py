"""What signers do: list versions of policies, delegate, rotate keys, and renew signatures before they expire.

A signer works in a separate folder: ``root.json``, trusted as on robots; private keys; and ``metadata``, copies of the metadata
signed there. All metadata is written with the metadata API of python-tuf.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import DelegatedRole, Delegations, Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp

from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import keys
from shadowhound_data_logger.policies.keys import PRIVATE, Passphrase, PublicKey, in_days
from shadowhound_data_logger.policies.roots import (
    NEXT,
    ONLINE,
    ONLINE_KEY,
    PENDING,
    ROOT_DAYS,
    ROOT_KEY,
    ROOT_ROLE,
    TARGETS,
    TARGETS_KEY,
    Signatures,
    set_keys,
    signatures,
)
from shadowhound_data_logger.policies.signed_metadata import InForce, SignedMetadata, delegated, unsigned
from shadowhound_data_logger.policies.trust import FRESH_DAYS, METADATA, ROOT, SIGNED_AT
from shadowhound_data_logger.stores.base import ObjectStore

_STOLEN: Final = 'if a key was stolen, policy rotate creates new ones, and robots forget what the old ones signed'


class Repository:
    """Changes the signed metadata in the store.

    Lifecycle: New; any number of changes. Each change starts by reading the store. One thread.
    """

    def __init__(self, folder: Path, store: ObjectStore, passphrase: Passphrase, *, days: float = FRESH_DAYS) -> None:
        """Robots accept new versions for ``days`` after a ``refresh``."""
        self._folder = folder
        self._passphrase = passphrase
        self._metadata = SignedMetadata(folder, store, days=days)

    def load(self) -> InForce:
        """The metadata in force. Raises PolicyError if the folder has no completely signed root, and StoreError."""
        return self._metadata.load()

    def listed(self) -> list[str]:
        """The paths of all versions that robots may run."""
        return sorted({path for each in self.load().lists.values() for path in each.signed.targets})

    # -- lists -----------------------------------------------------------------------------------------------------

    def publish(self, targets: Mapping[str, bytes], key: Path | None = None) -> bool:
        """List manifests (path -> content). Returns whether robots see them now; otherwise ``refresh`` must run elsewhere."""
        with self._changing(key) as (role, listed, may_sign):
            for path, content in targets.items():
                if not may_sign(path):
                    raise PolicyError(
                        f'{role} may not sign {path}', remedy='policy delegate defines which policies a key may sign'
                    )
                listed.targets[path] = TargetFile.from_data(path, content, ['sha256'])
        return self._refresh_if_here()

    def withdraw(self, paths: Collection[str], key: Path | None = None) -> bool:
        """Remove versions from the list; raises PolicyError if none of them was listed. Returns the same as ``publish``."""
        with self._changing(key) as (role, listed, _):
            removed = [path for path in paths if listed.targets.pop(path, None)]
            if not removed:
                remedy = 'use the key that listed them, or end its delegation: policy delegate NAME --revoke'
                raise PolicyError(f'{role} does not list {", ".join(sorted(paths))}', remedy=remedy)
        return self._refresh_if_here()

    def delegate(self, public: PublicKey, paths: Sequence[str], key: Path | None = None) -> str:
        """Allow another key to list versions at these paths, such as ``go2/go2_patrol/*``. Returns the name of the role."""
        role = f'{public.name}-{public.key.keyid[:8]}'  # each key has a separate role, whose versions start at 1
        for path in paths:
            if path.count('/') != 2 or not all(path.split('/')) or '..' in path:
                remedy = "give robot type, policy and versions: 'go2/go2_patrol/*'"
                raise PolicyError(f'{path!r} is not a pattern of policies', remedy=remedy)
        with self._changing(key, top=True) as (_, listed, _):
            delegations = listed.delegations or Delegations({}, {})
            assert delegations.roles is not None
            delegations.roles[role] = DelegatedRole(role, [public.key.keyid], 1, terminating=False, paths=list(paths))
            delegations.keys[public.key.keyid] = public.key
            listed.delegations = delegations
            self._metadata.upload(Metadata.from_bytes(public.empty), role)
        self._refresh_if_here()
        return role

    def end_delegation(self, name: str, key: Path | None = None) -> Sequence[str]:
        """Revoke the rights of a role, given by its name or that of its key: versions that only it listed must not run."""
        with self._changing(key, top=True) as (_, listed, _):
            found = [role for role in delegated(listed) if role == name or role.rpartition('-')[0] == name]
            if not found:
                remedy = f'known roles: {", ".join(delegated(listed)) or "none"}'
                raise PolicyError(f'nothing is delegated to {name!r}', remedy=remedy)
            for role in found:
                listed.revoke_key(listed.delegations.roles[role].keyids[0], role)  # type: ignore[union-attr, index]
                del listed.delegations.roles[role]  # type: ignore[union-attr]
        self._refresh_if_here()
        return found

    @contextmanager
    def _changing(self, key: Path | None, *, top: bool = False) -> Iterator[tuple[str, Targets, Callable[[str], bool]]]:
        """Yield the list that a key signs, to be changed, and sign and upload it afterwards. ``top``: only ``targets``."""
        state = self._with_lists(self.load())
        signer = keys.load_key(key or self._own_key(), self._passphrase)
        role = _role_of(state, signer.public_key.keyid)
        if top and role != TARGETS:
            raise PolicyError(f'the key of {role} may not delegate', remedy=f'pass {TARGETS_KEY} with --key')
        metadata = deepcopy(state.lists[role])
        given = None if role == TARGETS else state.lists[TARGETS].signed.get_delegated_role(role)
        yield role, metadata.signed, lambda path: given is None or given.is_delegated_path(path)  # type: ignore[attr-defined]
        self._metadata.sign(role, metadata, signer, state.root if role == TARGETS else state.lists[TARGETS])

    def _own_key(self) -> Path:
        found = self._folder / TARGETS_KEY
        if found.is_file():
            return found
        others = [
            path for path in self._folder.glob(f'*{PRIVATE}') if path.name not in {ROOT_KEY, ONLINE_KEY} and NEXT not in path.name
        ]
        if len(others) != 1:
            raise PolicyError(f'{self._folder} has no {TARGETS_KEY}', remedy='pass the key to sign with as --key')
        return others[0]

    def _with_lists(self, state: InForce) -> InForce:
        """Sign the first list of ``targets`` if missing: an empty one, or after a rotation the last one of this folder."""
        if TARGETS in state.lists:
            return state
        if not (self._folder / TARGETS_KEY).is_file():
            raise PolicyError(f'{METADATA} has nothing that was signed with keys of {self._folder / ROOT}',
                              remedy=f'run policy refresh where {TARGETS_KEY} is')  # fmt: skip
        earlier = self._metadata.last_signed(TARGETS) or unsigned(Targets())
        signer = keys.load_key(self._folder / TARGETS_KEY, self._passphrase)
        self._metadata.sign(TARGETS, earlier, signer, state.root)
        return self.load()

    # -- keys ------------------------------------------------------------------------------------------------------

    def rotate(self, roles: Collection[str], root_keys: Sequence[Path] = (), new_root: Sequence[PublicKey] = (),
               threshold: int | None = None, passphrase: str = '') -> Signatures:  # fmt: skip
        """Create a root with new keys for these roles (``root``, ``targets``, ``online``), signed with ``root_keys``.

        New keys of ``targets`` also replace those of ``online``, so that robots forget the version numbers that the old ones
        signed; the new list of ``targets`` is the last one signed in this folder, if any. If the new root has all signatures, it
        is in force when this returns; otherwise other people must sign it, and ``refresh`` puts it in force.
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
            set_keys(signed, ROOT_ROLE, publics, threshold or signed.roles[ROOT_ROLE].threshold)
        if TARGETS in roles:
            if TARGETS in state.lists and self._metadata.last_signed(TARGETS) is None:
                self._metadata.keep(TARGETS, state.lists[TARGETS])  # nothing was signed here: continue with the list in force
            made = keys.make_key(self._folder / f'targets{NEXT}{PRIVATE}', passphrase)
            set_keys(signed, TARGETS, [made.public_key])
        if {TARGETS, 'online'} & {*roles}:
            made = keys.make_key(self._folder / f'online{NEXT}{PRIVATE}')
            for role in ONLINE:
                set_keys(signed, role, [made.public_key])
        for signer in signers:
            following.sign(signer, append=True)
        (self._folder / PENDING).write_bytes(following.to_bytes())
        found = signatures(following, root)
        if not found.missing:
            self.load()  # puts it in force, even if online.key is on another machine
            self._refresh_if_here()
        return found

    def _root_signers(self, paths: Sequence[Path], root: Root) -> list[CryptoSigner]:
        """The root keys that sign the next root: those given, or the one in this folder. Raises PolicyError."""
        if not paths and not (self._folder / ROOT_KEY).is_file():
            raise PolicyError(f'a new root must be signed with the keys of the current one, but {self._folder} has no {ROOT_KEY}',
                              remedy='pass their paths: --key /media/usb/root.key')  # fmt: skip
        signers = [keys.load_key(path, self._passphrase) for path in paths or [self._folder / ROOT_KEY]]
        for path, signer in zip(paths, signers, strict=False):
            if signer.public_key.keyid not in root.roles[ROOT_ROLE].keyids:
                raise PolicyError(f'{path} is not a key of root version {root.version}')
        return signers

    # -- renewal ---------------------------------------------------------------------------------------------------

    def refresh(self) -> InForce:
        """Sign a new timestamp, and a new snapshot of all lists. Requires online.key."""
        state = self._with_lists(self.load())
        signer = keys.load_key(self._folder / ONLINE_KEY, self._passphrase)
        if signer.public_key.keyid not in state.root.signed.roles['timestamp'].keyids:
            raise PolicyError(f'{self._folder / ONLINE_KEY} is not a key of root version {state.root.signed.version}',
                              remedy='copy the online.key of the last policy rotate to this folder')  # fmt: skip
        snapshot = state.snapshot or unsigned(Snapshot(meta={}))
        for role, listed in state.lists.items():
            before = snapshot.signed.meta.get(f'{role}.json')
            if before is not None and before.version > listed.signed.version:
                raise PolicyError(f'a snapshot names version {before.version} of {role}, but the newest valid one is '
                                  f'{listed.signed.version}', remedy=_STOLEN)  # fmt: skip
            body = self._metadata.stored_list(role, listed, state.root if role == TARGETS else state.lists[TARGETS])
            snapshot.signed.meta[f'{role}.json'] = MetaFile.from_data(listed.signed.version, body, ['sha256'])
        self._metadata.sign('snapshot', snapshot, signer, state.root)
        timestamp = state.timestamp or unsigned(Timestamp())
        timestamp.signed.snapshot_meta = MetaFile.from_data(snapshot.signed.version, snapshot.to_bytes(), ['sha256'])
        timestamp.signed.unrecognized_fields[SIGNED_AT] = f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}'
        self._metadata.sign('timestamp', timestamp, signer, state.root, etag=state.timestamp_etag)
        state.snapshot, state.timestamp = snapshot, timestamp
        return state

    def _refresh_if_here(self) -> bool:
        """Refresh if online.key is in this folder; returns whether it is."""
        if not (self._folder / ONLINE_KEY).is_file():
            return False
        self.refresh()
        return True


def _role_of(state: InForce, keyid: str) -> str:
    if keyid in state.root.signed.roles[TARGETS].keyids:
        return TARGETS
    targets = state.lists[TARGETS].signed
    found = [role for role in delegated(targets) if keyid in targets.get_delegated_role(role).keyids]
    if not found:
        raise PolicyError(f'nothing is delegated to the key {keyid[:16]}',
                          remedy='the holder of targets.key can change that with policy delegate')  # fmt: skip
    return found[0]
