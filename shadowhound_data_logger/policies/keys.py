"""The keys of people who sign: a private key in a file, and what others need of it in ``NAME.pub``.

A public file holds the key and an empty list of policies that it signed: who delegates to it knows that its owner has the private
one, and robots find metadata of the new signer before the first policy is published.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, Final

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from securesystemslib.exceptions import UnverifiedSignatureError
from securesystemslib.signer import CryptoSigner, SSlibKey
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, Targets

from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.untrusted import from_strict_json

PRIVATE: Final = '.key'
PUBLIC: Final = '.pub'
MAX_KEY_FILE_BYTES: Final = 64 << 10
SIGNED_DAYS: Final = 365
"""Lists of policies expire after a year: a signer who has left ends that way at the latest."""

Passphrase = Callable[[Path], str]
"""Asks for the passphrase of a file."""


@dataclass(frozen=True, slots=True)
class PublicKey:
    """What ``NAME.pub`` holds."""

    name: str
    key: SSlibKey
    empty: bytes
    """Metadata of the role ``targets``, version 1, without any policy, signed with the key."""


def make_key(path: Path, passphrase: str = '') -> CryptoSigner:
    """A new Ed25519 key at ``path`` (mode 600, encrypted by the passphrase if any), and its public file. Overwrites nothing."""
    signer = CryptoSigner.generate_ed25519()
    body = signer.private_bytes
    if passphrase:
        key = serialization.load_pem_private_key(body, None)
        body = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
                                 serialization.BestAvailableEncryption(passphrase.encode()))  # fmt: skip
    if not is_name(path.stem):
        raise PolicyError(f'{path.stem!r} cannot be the name of a key', remedy='use letters, digits, "-", "_" and "."')
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), 'wb') as file:
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as error:
        raise PolicyError(
            f'{path} exists already', remedy='keys are not overwritten: move it away, or choose another name'
        ) from error
    path.with_suffix(PUBLIC).write_text(json.dumps(_public(path.stem, signer), indent=1) + '\n', encoding='ascii')
    return signer


def load_key(path: Path, passphrase: Passphrase) -> CryptoSigner:
    """Raises PolicyError for a file that is not a private key, or that this passphrase does not open."""
    try:
        body = path.read_bytes()[:MAX_KEY_FILE_BYTES]
        password = passphrase(path).encode() if b'ENCRYPTED' in body else None
        return CryptoSigner(serialization.load_pem_private_key(body, password))
    except OSError as error:
        raise PolicyError(f'{path} cannot be read: {error.strerror}', remedy='policy keys makes keys') from error
    except (ValueError, TypeError) as error:
        raise PolicyError(f'{path} is not a private key, or the passphrase is wrong', remedy='policy keys makes keys') from error


def load_public(path: Path) -> PublicKey:
    """Raises PolicyError for a file that ``make_key`` did not write, or whose writer does not have the private key."""
    try:
        given = from_strict_json(path.read_bytes()[: MAX_KEY_FILE_BYTES + 1], MAX_KEY_FILE_BYTES)
        name, empty = str(given['name']), json.dumps(given['metadata']).encode()
        # Its id is derived here: nobody chooses that of another key.
        key = SSlibKey.from_crypto(Ed25519PublicKey.from_public_bytes(bytes.fromhex(given['public'])))
        metadata: Metadata[Targets] = Metadata.from_bytes(empty)
        key.verify_signature(metadata.signatures[key.keyid], metadata.signed_bytes)
    except OSError as error:
        raise PolicyError(f'{path} cannot be read: {error.strerror}') from error
    except (ValueError, KeyError, TypeError, RepositoryError, UnverifiedSignatureError) as error:
        raise PolicyError(
            f'{path} is not a public key: {error}', remedy='policy keys writes one next to each private key'
        ) from error
    if not is_name(name) or metadata.signed.type != Targets.type or metadata.signed.targets or metadata.signed.delegations:
        raise PolicyError(f'{path} is not a public key that policy keys wrote')
    return PublicKey(name, key, empty)


def _public(name: str, signer: CryptoSigner) -> dict[str, Any]:

    empty = Metadata(Targets(version=1, expires=in_days(SIGNED_DAYS)))
    empty.sign(signer)
    return {'name': name, 'public': signer.public_key.keyval['public'], 'metadata': empty.to_dict()}


def in_days(days: float) -> datetime:
    """When something that is signed now expires."""
    return datetime.now(timezone.utc) + timedelta(days=days)
