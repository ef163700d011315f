"""The keys of signers: a file with the private key, and ``NAME.pub`` with its public part.

The public file contains the public key and an empty list of policies signed with the private key. The signature proves to the
delegator that the owner has the private key, and robots find metadata of the new signer before it publishes a policy.
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
"""Lists of policies expire after a year, so that a signer who has left the team cannot be trusted for longer."""

Passphrase = Callable[[Path], str]
"""Returns the passphrase of a key file, usually by prompting for it."""


@dataclass(frozen=True, slots=True)
class PublicKey:
    """The content of ``NAME.pub``."""

    name: str
    key: SSlibKey
    empty: bytes
    """Metadata of a ``targets`` role, version 1, without policies, signed with the key."""


def make_key(path: Path, passphrase: str = '') -> CryptoSigner:
    """Create an Ed25519 key at ``path`` (mode 600, encrypted if there is a passphrase) and its public file.

    Raises PolicyError if the file exists.
    """
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
            f'{path} already exists', remedy='keys are not overwritten: move it away, or choose another name'
        ) from error
    path.with_suffix(PUBLIC).write_text(json.dumps(_public(path.stem, signer), indent=1) + '\n', encoding='ascii')
    return signer


def load_key(path: Path, passphrase: Passphrase) -> CryptoSigner:
    """Load a private key. Raises PolicyError for a file that is not one, or that the passphrase does not decrypt."""
    try:
        body = path.read_bytes()[:MAX_KEY_FILE_BYTES]
        password = passphrase(path).encode() if b'ENCRYPTED' in body else None
        return CryptoSigner(serialization.load_pem_private_key(body, password))
    except OSError as error:
        raise PolicyError(f'{path} cannot be read: {error.strerror}', remedy='policy keys creates keys') from error
    except (ValueError, TypeError) as error:
        raise PolicyError(
            f'{path} is not a private key, or the passphrase is wrong', remedy='policy keys creates keys'
        ) from error


def load_public(path: Path) -> PublicKey:
    """Load a public file. Raises PolicyError if ``make_key`` did not write it, or its writer did not have the private key."""
    try:
        given = from_strict_json(path.read_bytes()[: MAX_KEY_FILE_BYTES + 1], MAX_KEY_FILE_BYTES)
        name, empty = str(given['name']), json.dumps(given['metadata']).encode()
        # The id is derived from the key, so that a file cannot claim the id of another key.
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
    """The time so many days from now, at which metadata expires."""
    return datetime.now(timezone.utc) + timedelta(days=days)
