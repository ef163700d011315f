"""Root metadata: the keys of all roles, signed by the keys of the root before it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from securesystemslib.signer import SSlibKey
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, Root

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import keys
from shadowhound_data_logger.policies.keys import PRIVATE, Passphrase, PublicKey, in_days
from shadowhound_data_logger.policies.trust import ROOT

ROOT_DAYS: Final = 730
ROOT_KEY, TARGETS_KEY, ONLINE_KEY = (f'{name}{PRIVATE}' for name in ('root', 'targets', 'online'))
NEXT: Final = '.next'
"""Part of the names of files that take effect with the next root."""
PENDING: Final = f'root{NEXT}.json'
"""A root that does not have enough signatures yet."""
ROOT_ROLE, TARGETS = 'root', 'targets'
ONLINE: Final = ('snapshot', 'timestamp')
"""The roles of the online key."""


@dataclass(frozen=True, slots=True)
class Signatures:
    """How far a root is signed."""

    version: int
    signed: int
    missing: int
    """Missing signatures, by the keys that this root names or by those that the root before it names."""


def create(folder: Path, root_keys: Sequence[PublicKey] = (), threshold: int = 1, passphrase: str = '') -> Signatures:
    """Create a folder for signers: a root of version 1, and keys for ``targets`` and ``online``.

    Creates ``root.key`` if no ``root_keys`` are given. Raises PolicyError for a folder that already has a root, and for a
    threshold that is higher than the number of keys.
    """
    if (folder / ROOT).exists():
        raise PolicyError(
            f'{folder / ROOT} already exists', remedy='policy rotate replaces keys; use another folder for another team'
        )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    root = Root(expires=in_days(ROOT_DAYS), consistent_snapshot=True)
    own = [] if root_keys else [keys.make_key(folder / ROOT_KEY, passphrase)]
    set_keys(root, ROOT_ROLE, [*(public.key for public in root_keys), *(signer.public_key for signer in own)], threshold)
    set_keys(root, TARGETS, [keys.make_key(folder / TARGETS_KEY, passphrase).public_key])
    online = keys.make_key(folder / ONLINE_KEY).public_key  # without a passphrase: cron signs with it
    for role in ONLINE:
        set_keys(root, role, [online])
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
    known = {keyid for each in (root, before) if each for keyid in each.signed.roles[ROOT_ROLE].keyids}
    if signer.public_key.keyid not in known:
        remedy = 'sign with one of its keys: ' + ', '.join(keyid[:16] for keyid in sorted(known))
        raise PolicyError(f'{key} is not a key of {path}', remedy=remedy)
    root.sign(signer, append=True)
    with durable_files.replacing(path, is_synced=True, mode=0o644) as file:
        file.write(root.to_bytes())
    return signatures(root, before)


def described(path: Path) -> Iterator[str]:
    """What a person should check before signing a root."""
    root = read_root(path).signed
    yield f'root version {root.version}, valid until {root.expires:%Y-%m-%d}'
    for name, role in root.roles.items():
        yield f'{name}: {role.threshold} of {", ".join(sorted(keyid[:16] for keyid in role.keyids))}'


def read_root(path: Path) -> Metadata[Root]:
    """Read root metadata. Raises PolicyError for a file that is not a root."""
    try:
        root: Metadata[Root] = Metadata.from_bytes(path.read_bytes())
    except FileNotFoundError as error:
        raise PolicyError(f'{path} does not exist', remedy='policy keys creates it') from error
    except RepositoryError as error:
        raise PolicyError(f'{path} is damaged: {error}') from error
    if not isinstance(root.signed, Root):
        raise PolicyError(f'{path} is not a root')
    return root


def signatures(root: Metadata[Root], before: Metadata[Root] | None = None) -> Signatures:
    """How far a root is signed; ``before`` is the root in force, whose keys must sign it, too."""
    found = root.signed.get_root_verification_result(before.signed if before else None, root.signed_bytes, root.signatures)
    return Signatures(root.signed.version, len(found.signed), max(found.first.missing, found.second.missing))


def set_keys(root: Root, role: str, given: Sequence[SSlibKey], threshold: int = 1) -> None:
    """Replace the keys of a role. Raises PolicyError for a threshold that they cannot reach."""
    if not 1 <= threshold <= len({key.keyid for key in given}):
        problem = f'the threshold {threshold} is not between 1 and the number of {role} keys, {len(given)}'
        raise PolicyError(problem, remedy='name more keys, or a lower threshold')
    for keyid in [*root.roles[role].keyids]:
        root.revoke_key(keyid, role)
    for key in given:
        root.add_key(key, role)
    root.roles[role].threshold = threshold


def next_root(root: Metadata[Root], body: bytes) -> Metadata[Root] | None:
    """The root in ``body`` if it follows ``root``: the next version, signed by the keys of both. None for anything else."""
    with suppress(RepositoryError, ValueError, TypeError, KeyError):
        found: Metadata[Root] = Metadata.from_bytes(body)
        is_next = found.signed.type == ROOT_ROLE and found.signed.version == root.signed.version + 1
        if is_next and not signatures(found, root).missing:
            return found
    return None
