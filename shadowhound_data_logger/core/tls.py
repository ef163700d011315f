"""Explains to the operator why a server's certificate is not trusted: its issuer, its validity, or its name."""

from __future__ import annotations

import re
import ssl
from collections.abc import Iterator
from typing import Any, Final

_NOT_YET, _EXPIRED, _HOST, _ADDRESS = 9, 10, 62, 64
"""X509_V_ERR_CERT_NOT_YET_VALID, _CERT_HAS_EXPIRED, _HOSTNAME_MISMATCH, _IP_ADDRESS_MISMATCH of OpenSSL's x509_vfy.h."""
_OTHER_NAME: Final = (
    'the certificate of {server} is for another name',
    'use a name that is in it (subjectAltName) in {address}, or create one on the server with this name',
)
_REASONS: Final = {
    _NOT_YET: ('the certificate of {server} is not valid yet', 'set the clock of this machine: `timedatectl`'),
    _EXPIRED: ('the certificate of {server} has expired', 'renew it on the server, unless this machine is ahead: `date`'),
    _HOST: _OTHER_NAME,
    _ADDRESS: _OTHER_NAME,
}
_RUSTLS: Final = {'Expired': _EXPIRED, 'NotValidYet': _NOT_YET, 'NotValidForName': _HOST}
"""What rustls calls these, some followed by ``Context`` (https://docs.rs/rustls/latest/rustls/enum.CertificateError.html)."""
_RUSTLS_ERROR: Final = re.compile(r'InvalidCertificate\(\s*(\w+?)(?:Context)?\b')
_AUTHORITY: Final = (
    'the certificate of {server} is a CA certificate, which rustls does not accept from a server',
    'create one on the server that the authority signs',
)
_UNKNOWN: Final = (
    'the certificate of {server} is not trusted',
    'set {bundle} to the certificate of the authority that signed it',
)


def certificate_problem(error: BaseException, server: str, *, bundle: str, address: str) -> tuple[str, str] | None:
    """What is wrong with the server's certificate and what to do; None if the error has another cause.

    ``bundle`` and ``address`` are the variables that name the trusted authorities and the server.
    """
    for cause in causes(error):
        if type(cause).__name__ == 'CertificateError':  # urllib3's own, before 2.0: it compares names itself
            found = _OTHER_NAME
        elif isinstance(cause, ssl.SSLCertVerificationError):
            found = _REASONS.get(getattr(cause, 'verify_code', 0), _UNKNOWN)
        else:
            continue
        return _format(found, server, bundle, address)
    return None


def rustls_certificate_problem(text: str, server: str, *, bundle: str, address: str) -> tuple[str, str] | None:
    """The same for an error of rustls, which is only a text: ``InvalidCertificate(UnknownIssuer)``."""
    found = _RUSTLS_ERROR.search(text)
    if found is None:
        return None
    if 'CaUsedAsEndEntity' in text:
        return _format(_AUTHORITY, server, bundle, address)
    return _format(_REASONS.get(_RUSTLS.get(found[1], 0), _UNKNOWN), server, bundle, address)


def _format(found: tuple[str, str], server: str, bundle: str, address: str) -> tuple[str, str]:
    what, remedy = (text.format(server=server, bundle=bundle, address=address) for text in found)
    return what, remedy


def causes(error: BaseException) -> Iterator[BaseException]:
    """The chain of causes of an error, the root cause last; urllib3 hides some in ``args`` and botocore in ``kwargs``."""
    seen: list[BaseException | None] = [None]
    waiting: list[Any] = [error]
    while waiting:
        cause = waiting.pop(0)
        if isinstance(cause, BaseException) and cause not in seen:
            seen.append(cause)
            yield cause
            inner = getattr(cause, 'kwargs', {})
            waiting += [*cause.args, getattr(cause, 'reason', None), cause.__cause__, cause.__context__, inner.get('error')]
