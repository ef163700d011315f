"""Access control of the page: tokens, sign-ins, and the check that a request comes from this page.

Each of the two roles has a token, in files of mode 0600 next to the spool. A sign-in is a cookie signed with the token
(HMAC-SHA256), so it survives a restart, and ends when the token's file is replaced or becomes readable by others. Another file
lists the sign-ins that were signed out. A token is never in a URL.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import os
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from shadowhound_data_logger.core.durable_files import flock, replacing, sync
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.untrusted import check_size

log = logging.getLogger(__name__)

VIEWER, OPERATOR = 'viewer', 'operator'
ROLES: Final = (OPERATOR, VIEWER)
RTSP_FILE: Final = 'rtsp.password'
SIGN_OUTS_FILE: Final = 'ended'
COOKIE: Final = 'shadowhound_live'
LASTS_S: Final = 12 * 3600
"""Lifetime of a sign-in."""
MAX_FAILURES: Final = 5
FAILURES_S: Final = 60.0
"""After this many wrong tokens within this time an address must wait. There is no limit across all addresses: it would let any
host in the network lock out the operator, and our tokens, with 192 random bits, cannot be guessed.
"""
MAX_ADDRESSES: Final = 1000
"""Maximum number of addresses with wrong tokens; beyond it the one with the oldest failure is dropped."""
MIN_TOKEN: Final = 16
"""Minimum letters of a token that an operator wrote into the file."""
MAX_SIGN_OUTS: Final = 1000
"""Maximum sign-outs per role that are remembered one by one, in 28 bytes each."""
MAX_BYTES: Final = 100_000
"""Maximum size of the file with these."""


class TokenRefused(DataLoggerError):
    """A token file cannot be used."""

    DEFAULT_REMEDY = 'remove it: the next start writes a new one'


@dataclass(frozen=True, slots=True)
class SignIn:
    """The role of a client."""

    role: str
    nonce: str = ''
    """From the cookie; empty for a client on this machine without one."""
    expires: int = 0
    """From the cookie, Unix seconds."""
    csrf: str = ''
    """The header value that every request which acts must contain."""

    @property
    def may_act(self) -> bool:
        return self.role == OPERATOR


def make_tokens(folder: Path, *, replace: bool = False) -> dict[str, Path]:
    """The token file of each role, created if missing. Raises TokenRefused."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    paths = {role: folder / f'{role}.token' for role in ROLES}
    for path in (*paths.values(), folder / RTSP_FILE) if replace else paths.values():
        _make_token(path, replace=replace)
    for role in ROLES if replace else ():  # no earlier cookie is valid any more
        (folder / f'{role}.{SIGN_OUTS_FILE}').unlink(missing_ok=True)
    return paths


def rtsp_password(folder: Path) -> str:
    """The password of RTSP, created if missing; not a token, because players may store it anywhere. Raises TokenRefused."""
    path = folder / RTSP_FILE
    _make_token(path)
    return read_token(path)


def _make_token(path: Path, *, replace: bool = False) -> None:
    if replace:
        path.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), 'w', encoding='ascii') as file:
            file.write(f'{secrets.token_urlsafe(24)}\n')
    except FileExistsError:
        read_token(path)


def read_token(path: Path) -> str:
    """Raises TokenRefused for a file that others can read, or without a token."""
    try:
        with path.open(encoding='utf-8') as file:
            mode = os.fstat(file.fileno()).st_mode
            token = file.read(1000).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TokenRefused(f'{path} cannot be read: {error}') from error
    if mode & 0o077:
        raise TokenRefused(f'{path} is not restricted to its owner (mode {mode & 0o777:04o})', remedy=f'chmod 600 {path}')
    if len(token) < MIN_TOKEN:
        raise TokenRefused(f'{path} contains no token of at least {MIN_TOKEN} letters')
    return token


class _SignOuts:
    """Sign-outs of a role, in a file that survives restarts as the cookies do.

    Its lines: the SHA-256 of the rest, a time ``until``, and for each sign-in the expiry of its cookie and its nonce. Sign-ins
    that expire no later than ``until`` count as signed out. So an entry can be dropped, once it has expired or when there are
    too many, without becoming valid again, even if the clock is set back.

    A damaged file could have contained any sign-in: all earlier sign-ins then count as signed out, which is logged, and users
    sign in again. A missing file contains none: the first sign-out creates it.

    ``keep`` waits for the disk and can be called from any thread, everything else from the event loop; ``_lock`` guards changes.
    Several pages that share the tokens share the file too.
    """

    def __init__(self, path: Path, now: Callable[[], float]) -> None:
        self._path = path
        self._now = now
        self._lock = threading.Lock()
        self._seen: tuple[int, ...] = ()
        self._known: dict[str, int] = {}
        self._until = 0

    def has(self, nonce: str, expires: int) -> bool:
        """Whether the sign-in with this expiry was signed out."""
        self._refresh()
        return nonce in self._known or expires <= self._until  # in this order: an entry is dropped once ``_until`` covers it

    def expiry(self) -> int:
        """The expiry of a new sign-in. Raises TokenRefused if the clock was far ahead when sign-ins were ended."""
        self._refresh()
        now = int(self._now())
        if self._until > now + 2 * LASTS_S:
            raise TokenRefused(f'{self._path} ends all sign-ins until {time.ctime(self._until)}: the clock was ahead',
                               remedy='set the clock, or create new tokens (--new-tokens)')  # fmt: skip
        return max(now + LASTS_S, self._until + 1)

    def add(self, nonce: str, expires: int) -> None:
        """In this process immediately; ``keep`` makes it durable."""
        self._merge({nonce: expires})

    def keep(self) -> None:
        """Write everything known here and in the file. Raises OSError."""
        with flock(self._path.with_name(f'{self._path.name}.lock')):
            self._refresh_if_changed()
            with self._lock:
                lines = [str(self._until), *(f'{expires} {nonce}' for nonce, expires in self._known.items())]
            body = '\n'.join(lines).encode()
            with replacing(self._path, is_synced=True, mode=0o600) as file:
                file.write(sha256(body).hexdigest().encode() + b'\n' + body)
            sync(self._path.parent)

    def _refresh(self) -> None:
        """Read the file; replace a damaged one."""
        if self._refresh_if_changed():
            try:
                self.keep()
            except OSError as error:
                log.error('%s cannot be written: %s', self._path, error)  # noqa: TRY400 - an operator's matter

    def _refresh_if_changed(self) -> bool:
        """Read the file if it changed; return whether it is damaged."""
        seen: tuple[int, ...] = ()
        with suppress(OSError):
            about = self._path.stat()
            seen = about.st_ino, about.st_mtime_ns, about.st_size
        if seen == self._seen:
            return False
        known, until, is_damaged = dict[str, int](), 0, False
        try:
            with self._path.open('rb') as file:
                until, known = _parse_sign_outs(file.read(MAX_BYTES + 1))
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            log.warning('%s is damaged (%s): all sign-ins until now have ended; sign in again with the token',
                        self._path, error)  # fmt: skip
            until, is_damaged = int(self._now()) + LASTS_S, True
        self._merge(known, until)
        self._seen = seen
        return is_damaged

    def _merge(self, known: Mapping[str, int], until: int = 0) -> None:
        with self._lock:
            self._until = max(self._until, until)
            self._known |= known
            now = self._now()
            for nonce, expires in sorted(self._known.items(), key=lambda each: each[1]):
                if expires > now and len(self._known) <= MAX_SIGN_OUTS:
                    break
                self._until = max(self._until, expires)
                del self._known[nonce]


def _parse_sign_outs(content: bytes) -> tuple[int, dict[str, int]]:
    """Raises ValueError for a file that ``_SignOuts`` did not write."""
    check_size(len(content), MAX_BYTES)
    digest, _, body = content.partition(b'\n')
    if sha256(body).hexdigest().encode() != digest:
        raise ValueError('its hash does not match')
    until, *lines = body.decode().split('\n')
    entries = [line.split(' ') for line in lines]
    return int(until), {nonce: int(expires) for expires, nonce in entries}


class Access:
    """Decides which requests are allowed. Used by the event loop only, except ``keep``.

    ``is_open``: every client may watch, for a page that only listens on loopback.
    """

    def __init__(self, tokens: dict[str, Path], *, is_open: bool, now: Callable[[], float] = time.time,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._paths = tokens
        self._is_open = is_open
        self._now = now
        self._monotonic = monotonic
        self._failures: dict[str, deque[float]] = {}
        self._refused: dict[str, str] = {}
        # Separate lists: a viewer who signs out repeatedly cannot end an operator's sign-in.
        self._sign_outs = {role: _SignOuts(path.with_name(f'{role}.{SIGN_OUTS_FILE}'), now) for role, path in tokens.items()}

    def sign_in(self, token: str, address: str, over: SignIn | None = None) -> tuple[SignIn, str] | None:
        """Sign in with a token: returns the sign-in and its cookie; None for a wrong token. Raises TokenRefused if that is
        impossible.

        It replaces ``over``, whose cookie came with the token and which is signed out; ``keep`` makes that durable.
        """
        given = _bytes(token)
        for role in ROLES:
            try:
                token = self._token(role)
            except TokenRefused:  # the other role's file may be valid
                continue
            if hmac.compare_digest(given, token.encode()):
                nonce, expires = secrets.token_urlsafe(12), self._sign_outs[role].expiry()  # which may refuse
                if over is not None:
                    self.sign_out(over)
                    expires = self._sign_outs[role].expiry()  # if the list is full, this expires later than the dropped ones
                text = f'{role}.{expires}.{nonce}'
                self._failures.pop(network_of(address), None)
                return self._sign_in_of(role, nonce, expires), f'{text}.{self._sign(role, text)}'
        self._fail(address)
        return None

    def wait_s(self, address: str) -> float:
        """How long this address must wait before its next token; 0 if it need not."""
        known = self._failures.get(network_of(address))
        if known is None or len(known) < MAX_FAILURES:
            return 0.0
        left_s = known[0] + FAILURES_S - self._monotonic()
        return max(1.0, left_s) if left_s > 0 else 0.0

    def who(self, cookie: str | None) -> SignIn | None:
        """The sign-in of a cookie; None without a valid cookie, unless the page is open."""
        parts = (cookie or '').split('.')
        if len(parts) == 4:
            role, until, nonce, signature = parts
            with suppress(TokenRefused):
                if self._is_valid(role, until, nonce, f'{role}.{until}.{nonce}', signature):
                    return self._sign_in_of(role, nonce, int(until))
        return SignIn(VIEWER) if self._is_open else None

    def sign_out(self, who: SignIn) -> None:
        """Its cookie is invalid from now on; ``keep`` makes that durable."""
        if who.nonce:
            self._sign_outs[who.role].add(who.nonce, who.expires)

    def keep(self, role: str) -> None:
        """Write the sign-outs of a role to the disk; any thread. Raises OSError."""
        self._sign_outs[role].keep()

    def is_csrf(self, who: SignIn, given: str) -> bool:
        """Whether a request that acts comes from the page itself."""
        return bool(who.csrf) and hmac.compare_digest(who.csrf.encode(), _bytes(given))

    def _is_valid(self, role: str, until: str, nonce: str, text: str, signature: str) -> bool:
        """Whether the token of the role signed this text, and it neither expired nor was signed out. Raises TokenRefused."""
        if role not in ROLES or not until.isdecimal() or len(until) >= 12:
            return False
        is_signed = hmac.compare_digest(_bytes(signature), self._sign(role, text).encode())
        return is_signed and int(until) > self._now() and not self._sign_outs[role].has(nonce, int(until))

    def _sign_in_of(self, role: str, nonce: str, expires: int) -> SignIn:
        return SignIn(role, nonce, expires, self._sign(role, f'csrf.{nonce}'))

    def _sign(self, role: str, text: str) -> str:
        return hmac.new(self._token(role).encode(), _bytes(text), sha256).hexdigest()

    def _token(self, role: str) -> str:
        """Read again each time: replacing the file ends all sign-ins. Raises TokenRefused, which is logged once."""
        try:
            token = read_token(self._paths[role])
        except TokenRefused as error:
            if self._refused.get(role) != str(error):
                self._refused[role] = str(error)
                log.warning('all sign-ins as %s have ended: %s', role, error)
            raise
        self._refused.pop(role, None)
        return token

    def _fail(self, address: str) -> None:
        network = network_of(address)
        known = self._failures.pop(network, None) or deque(maxlen=MAX_FAILURES)
        known.append(self._monotonic())
        self._failures[network] = known  # the last one now
        if len(self._failures) > MAX_ADDRESSES:
            del self._failures[next(iter(self._failures))]


class OwnNames:
    """Host names of the page: a request with another name for this address is an attack (DNS rebinding)."""

    def __init__(self, bind: str, more: Iterable[str] = ()) -> None:
        host = socket.gethostname().lower()
        self._names = {'localhost', host, f'{host.partition(".")[0]}.local', bind.lower(), *(name.lower() for name in more)}

    def has(self, host: str, own_address: str) -> bool:
        """Whether a request with this Host header, at this address of ours, is for this page."""
        name = _host(f'//{host}')
        if name in self._names:
            return True
        try:
            return _address(name) == _address(own_address)
        except ValueError:
            return False


def is_same_origin(origin: str | None, host: str, scheme: str) -> bool:
    """Whether a request's Origin header names this page."""
    return origin is not None and origin.lower() == f'{scheme}://{host}'.lower()


def _bytes(text: str) -> bytes:
    """Text from a client, which may contain an unpaired surrogate."""
    return text.encode(errors='surrogatepass')


def _host(url: str) -> str:
    try:
        return (urlsplit(url).hostname or '').lower()
    except ValueError:
        return ''


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Without zone, and IPv4-mapped IPv6 as IPv4. Raises ValueError."""
    found = ipaddress.ip_address(text.partition('%')[0])
    return getattr(found, 'ipv4_mapped', None) or found


def network_of(address: str) -> str:
    """The address, or for IPv6 its /64: a host there may use any address in it."""
    try:
        found = _address(address)
    except ValueError:
        return address
    return str(found) if found.version == 4 else str(ipaddress.ip_network((found, 64), strict=False))


def is_loopback(address: str) -> bool:
    """Whether it is reachable only from this machine."""
    try:
        return _address(address).is_loopback
    except ValueError:
        return address == 'localhost'
