"""Who says that a policy may run: Ed25519 keys, signatures over manifests, and signed lists of keys that are revoked.

A robot trusts the public keys (``*.pub``) in a folder; two of them are a rotation. What is signed begins with a word for what it
is, so that no signature of one thing serves for another.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shadowhound_data_logger.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.untrusted import from_strict_json

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

FOR_POLICY: Final = b'shadowhound policy 1\n'
FOR_REVOCATION: Final = b'shadowhound revocation 1\n'
MOST_SIGNATURE_BYTES: Final = 4 << 10
MOST_REVOCATION_BYTES: Final = 64 << 10
MOST_KEYS: Final = 64
KEY_BYTES: Final = 32
_KEY_ID: Final = re.compile(r'[0-9a-f]{16}')
REMEDY: Final = "install the extra: pip install 'shadowhound_data_logger[policies]'"

Trusted = Mapping[str, 'Ed25519PublicKey']
"""Key id -> key."""


def keygen(path: Path) -> str:
    """A new private key at ``path`` (mode 600) and its public one at ``<path>.pub``; returns its id. Overwrites nothing."""
    ed25519, serialization = _library()
    key = ed25519.Ed25519PrivateKey.generate()
    body = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), 'wb') as file:
        file.write(body)
    raw = key.public_key().public_bytes_raw()
    public = path.with_name(f'{path.name}.pub')
    with public.open('x', encoding='ascii') as file:
        file.write(base64.b64encode(raw).decode() + '\n')
    public.chmod(0o644)  # a robot takes none that others may write, and copies keep the mode
    return key_id(raw)


def load_key(path: Path) -> Ed25519PrivateKey:
    """Raises PolicyError for what is no private key of ``keygen``."""
    ed25519, serialization = _library()
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise PolicyError(f'{path} is no private key', remedy='policy keygen makes one') from error
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise PolicyError(f'{path} is no Ed25519 key', remedy='policy keygen makes one')
    return key  # type: ignore[no-any-return] # the classes are loaded late


def trusted(folder: Path) -> Trusted:
    """The public keys of a folder. Raises PolicyError for a file that is none."""
    ed25519, _ = _library()
    found: dict[str, Ed25519PublicKey] = {}
    for path in sorted(folder.glob('*.pub'))[:MOST_KEYS]:
        try:
            raw = base64.b64decode(path.read_bytes()[:200].strip(), validate=True)
            found[key_id(raw)] = ed25519.Ed25519PublicKey.from_public_bytes(raw)
        except ValueError as error:
            raise PolicyError(f'{path} is no public key', remedy='policy keygen writes one beside the private key') from error
    return found


def key_id(public: bytes) -> str:
    """The name of a key: the first digits of its SHA-256."""
    return hashlib.sha256(public).hexdigest()[:16]


def sign(key: Ed25519PrivateKey, purpose: bytes, content: bytes) -> bytes:
    """The signature as a file."""
    told = {'key': key_id(key.public_key().public_bytes_raw()),
            'signature': base64.b64encode(key.sign(purpose + content)).decode()}  # fmt: skip
    return json.dumps(told).encode() + b'\n'


def check_signature(content: bytes, signature: bytes, purpose: bytes, keys: Trusted, revoked: Collection[str]) -> str:
    """The id of the key that signed the content. Raises PolicyRefused: ``signature``, ``unknown_key`` or ``revoked``."""
    try:
        told: Any = from_strict_json(signature, MOST_SIGNATURE_BYTES)
        name, value = str(told['key']), base64.b64decode(str(told['signature']), validate=True)
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyRefused('signature', 'the signature is not one of policy sign') from error
    if name in revoked:
        raise PolicyRefused('revoked', f'it is signed with the key {name[:40]!r}, which was revoked')
    key = keys.get(name)
    if key is None:
        remedy = 'copy its .pub file into policies/keys of SHADOWHOUND_HOME, if it is one of yours'
        text = f'it is signed with the key {name[:40]!r}, which this robot does not trust'
        raise PolicyRefused('unknown_key', text, remedy=remedy)
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - of the extra

    try:
        key.verify(value, purpose + content)
    except InvalidSignature as error:
        raise PolicyRefused('signature', f'the signature is not one of the key {name} over this content') from error
    return name


def revocation(key: Ed25519PrivateKey, number: int, keys: Collection[str]) -> bytes:
    """A list of revoked keys, signed: the ``number``-th, of 1, 2, ... Raises PolicyError for one that counts for nothing."""
    for name in keys:
        if not _KEY_ID.fullmatch(name):
            raise PolicyError(f'{name[:100]!r} is no id of a key', remedy='policy keygen said it, and policy sign says it again')
    if key_id(key.public_key().public_bytes_raw()) in keys:
        raise PolicyError(
            'robots take no list by a key that it revokes itself', remedy='sign it with another key that they trust'
        )
    if len(keys) > MOST_KEYS:
        raise PolicyError(f'robots take no list of more than {MOST_KEYS} keys', remedy='make two lists of it')
    body = json.dumps({'format': 1, 'number': number, 'revoked': sorted(keys)})
    return json.dumps({'list': body, 'signature': sign(key, FOR_REVOCATION, body.encode()).decode()}).encode()


def read_revocation(content: bytes, number: int, keys: Trusted, revoked: Collection[str]) -> frozenset[str]:
    """The keys that a list revokes. Raises PolicyRefused.

    A list by a key that was revoked, or that it revokes itself, counts for nothing.
    """
    try:
        told = from_strict_json(content, MOST_REVOCATION_BYTES)
        body, signature = str(told['list']).encode(), str(told['signature']).encode()
        said = from_strict_json(body, MOST_REVOCATION_BYTES)
        found = frozenset(map(str, said['revoked']))
        is_right = said['number'] == number and len(found) <= MOST_KEYS and all(map(_KEY_ID.fullmatch, found))
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyRefused('revocation', f'the list {number} of revoked keys is damaged') from error
    check_signature(body, signature, FOR_REVOCATION, keys, {*revoked, *found})
    if not is_right:
        raise PolicyRefused('revocation', f'the list {number} of revoked keys is another one')
    return found


def _library() -> tuple[Any, Any]:
    try:
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - of the extra
        from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
    except ImportError as error:
        raise PolicyError(f'signatures need the package cryptography: {error}', remedy=REMEDY) from error
    return ed25519, serialization
