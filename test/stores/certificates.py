"""An authority of one's own and what it signs, made anew for each run of the tests."""

from __future__ import annotations

import datetime
import ipaddress
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

DAY = datetime.timedelta(days=1)
HERE = '127.0.0.1'
WRONG: dict[str, tuple[str, dict[str, Any], str, str]] = {
    'unknown': ('stranger', {}, 'is not trusted', 'AWS_CA_BUNDLE'),
    'expired': ('authority', {'begins': -2 * DAY, 'ends': datetime.timedelta(hours=-1)}, 'has expired', 'renew it'),
    'early': ('authority', {'begins': datetime.timedelta(hours=1)}, 'is not valid yet', 'timedatectl'),
    'host': ('authority', {'host': '10.0.0.1'}, 'is for another name', 'AWS_ENDPOINT_URL'),
}
"""What can be wrong with a certificate: who signed it and how, and words of the message and of its remedy."""


class Authority:
    """``path`` is its certificate, for those who are to trust it."""

    def __init__(self, folder: Path, name: str = 'authority') -> None:
        self.path = folder / f'{name}.pem'
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        signed = (
            _certificate(self._name, self._name, self._key.public_key(), -DAY, DAY)
            .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
            .sign(self._key, hashes.SHA256())
        )
        self.path.write_bytes(signed.public_bytes(serialization.Encoding.PEM))

    def sign(self, name: str, host: str = HERE, *, begins: datetime.timedelta = -DAY,
             ends: datetime.timedelta = DAY) -> tuple[Path, Path]:  # fmt: skip
        """A server's certificate and its key; times are relative to now."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))])
        signed = (
            _certificate(subject, self._name, key.public_key(), begins, ends)
            .add_extension(names, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        certificate = self._folder / f'{name}.crt'
        certificate.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        return certificate, self._write(name, key)

    def itself(self) -> tuple[Path, Path]:
        """Its own certificate and key, as if it were a server."""
        return self.path, self._write('itself', self._key)

    def _write(self, name: str, key: ec.EllipticCurvePrivateKey) -> Path:
        private = self._folder / f'{name}.key'
        private.write_bytes(key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ))  # fmt: skip
        return private


def _certificate(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begins: datetime.timedelta,
                 ends: datetime.timedelta) -> x509.CertificateBuilder:  # fmt: skip
    now = datetime.datetime.now(datetime.timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins)
        .not_valid_after(now + ends)
    )
