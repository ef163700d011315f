"""Who may see the page and who may act: tokens, sign-ins, and which requests are this page's own.

Two roles have a token each, in files of mode 0600 beside the spool. A sign-in is a cookie that the token signs (HMAC-SHA256), so
it outlives the process, and ends when the token's file is replaced or may be read by others. A file beside the tokens says what
was signed out. No token is ever in a URL.
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
ENDED_FILE: Final = 'ended'
COOKIE: Final = 'shadowhound_live'
LASTS_S: Final = 12 * 3600
"""A sign-in."""
MAX_FAILURES: Final = 5
FAILURES_S: Final = 60.0
"""After this many wrong tokens within this time an address must wait. There is no limit for all addresses together: it would
let any host in the network lock out the operator, and nobody guesses one of our tokens, which have 192 random bits."""
MAX_ADDRESSES: Final = 1000
"""Addresses whose wrong tokens are remembered; beyond it the one that failed least recently is forgotten."""
MIN_TOKEN: Final = 16
"""Letters of a token that somebody wrote into the file."""
MAX_ENDED: Final = 1000
"""Sign-ins of a role that were signed out and are remembered one by one, in 28 bytes each."""
MAX_BYTES: Final = 100_000
"""Of the file with these."""


class TokenRefused(DataLoggerError):
    """A file with a token cannot be used."""

    DEFAULT_REMEDY = 'remove it: the next start writes a new one'


@dataclass(frozen=True, slots=True)
class SignIn:
    """The role of somebody who sends requests."""

    role: str
    nonce: str = ''
    """Of the cookie; empty for somebody of this machine who has none."""
    expires: int = 0
    """Of the cookie, Unix seconds."""
    csrf: str = ''
    """What a request that acts has to bring along in a header."""

    @property
    def may_act(self) -> bool:
        return self.role == OPERATOR


def make_tokens(folder: Path, *, anew: bool = False) -> dict[str, Path]:
    """The file with the token of each role, created where there is none. Raises TokenRefused."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    paths = {role: folder / f'{role}.token' for role in ROLES}
    for path in (*paths.values(), folder / RTSP_FILE) if anew else paths.values():
        _make_token(path, anew=anew)
    for role in ROLES if anew else ():  # no cookie of before is good any more
        (folder / f'{role}.{ENDED_FILE}').unlink(missing_ok=True)
    return paths


def rtsp_password(folder: Path) -> str:
    """The password of RTSP, made where there is none; no token, because players may store it anywhere. Raises TokenRefused."""
    path = folder / RTSP_FILE
    _make_token(path)
    return token_of(path)


def _make_token(path: Path, *, anew: bool = False) -> None:
    if anew:
        path.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), 'w', encoding='ascii') as file:
            file.write(f'{secrets.token_urlsafe(24)}\n')
    except FileExistsError:
        token_of(path)


def token_of(path: Path) -> str:
    """Raises TokenRefused for a file that others may read, or that holds no token."""
    try:
        with path.open(encoding='utf-8') as file:
            mode = os.fstat(file.fileno()).st_mode
            token = file.read(1000).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TokenRefused(f'{path} cannot be read: {error}') from error
    if mode & 0o077:
        raise TokenRefused(f'{path} is not for its owner alone (mode {mode & 0o777:04o})', remedy=f'chmod 600 {path}')
    if len(token) < MIN_TOKEN:
        raise TokenRefused(f'{path} holds no token of at least {MIN_TOKEN} letters')
    return token


class _Ended:
    """Sign-ins of a role that were signed out, in a file that outlives the process as their cookies do.

    Its lines: the SHA-256 of the rest, a time ``until``, and for each sign-in when its cookie expires and its nonce. Whatever
    expires no later than ``until`` counts as signed out. So an entry may leave, once it has expired or when there are too many,
    and lets nobody in again, not even when the clock is set back.

    A damaged file could have named anybody: all sign-ins of before count as signed out then, the log says so, and whoever has a
    token signs in again. A file that is missing names nobody: the first sign-out makes it.

    ``keep`` waits for the disk and is for any thread, all else for the event loop; ``_lock`` guards changes of what is known.
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
        """Whether the sign-in that expires then was signed out."""
        self._refresh()
        return nonce in self._known or expires <= self._until  # in this order: an entry leaves once ``_until`` counts it

    def expiry(self) -> int:
        """When a sign-in of now expires. Raises TokenRefused where the clock was far ahead when sign-ins were ended."""
        self._refresh()
        now = int(self._now())
        if self._until > now + 2 * LASTS_S:
            raise TokenRefused(f'{self._path} ends all sign-ins until {time.ctime(self._until)}: the clock was ahead',
                               remedy='set the clock, or make new tokens (--new-tokens)')  # fmt: skip
        return max(now + LASTS_S, self._until + 1)

    def add(self, nonce: str, expires: int) -> None:
        """In this process at once; ``keep`` makes it last."""
        self._merge({nonce: expires})

    def keep(self) -> None:
        """Write all that is known here and in the file. Raises OSError."""
        with flock(self._path.with_name(f'{self._path.name}.lock')):
            self._look()
            with self._lock:
                lines = [str(self._until), *(f'{expires} {nonce}' for nonce, expires in self._known.items())]
            body = '\n'.join(lines).encode()
            with replacing(self._path, is_synced=True, mode=0o600) as file:
                file.write(sha256(body).hexdigest().encode() + b'\n' + body)
            sync(self._path.parent)

    def _refresh(self) -> None:
        """Know what the file says; put a good one in the place of a damaged one."""
        if self._look():
            try:
                self.keep()
            except OSError as error:
                log.error('%s cannot be written: %s', self._path, error)  # noqa: TRY400 - an operator's matter

    def _look(self) -> bool:
        """Take in what the file says, if it is another one than before; whether it is damaged."""
        seen: tuple[int, ...] = ()
        with suppress(OSError):
            about = self._path.stat()
            seen = about.st_ino, about.st_mtime_ns, about.st_size
        if seen == self._seen:
            return False
        known, until, is_damaged = dict[str, int](), 0, False
        try:
            with self._path.open('rb') as file:
                until, known = _ended_in(file.read(MAX_BYTES + 1))
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            log.warning('%s is damaged (%s): all sign-ins until now have ended, and whoever has a token signs in again',
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
                if expires > now and len(self._known) <= MAX_ENDED:
                    break
                self._until = max(self._until, expires)
                del self._known[nonce]


def _ended_in(content: bytes) -> tuple[int, dict[str, int]]:
    """Raises ValueError for what ``_Ended`` did not write."""
    check_size(len(content), MAX_BYTES)
    digest, _, body = content.partition(b'\n')
    if sha256(body).hexdigest().encode() != digest:
        raise ValueError('its hash does not fit')
    until, *lines = body.decode().split('\n')
    entries = [line.split(' ') for line in lines]
    return int(until), {nonce: int(expires) for expires, nonce in entries}


class Access:
    """Decides who may do what. Used by the event loop alone, but for ``keep``.

    ``is_open``: whoever reaches the page may watch, which holds for a page that listens on the loopback alone.
    """

    def __init__(self, tokens: dict[str, Path], *, is_open: bool, now: Callable[[], float] = time.time,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._paths = tokens
        self._is_open = is_open
        self._now = now
        self._monotonic = monotonic
        self._failures: dict[str, deque[float]] = {}
        self._refused: dict[str, str] = {}
        # One each: a viewer who signs out again and again ends no operator's sign-in.
        self._ended = {role: _Ended(path.with_name(f'{role}.{ENDED_FILE}'), now) for role, path in tokens.items()}

    def sign_in(self, token: str, address: str, over: SignIn | None = None) -> tuple[SignIn, str] | None:
        """Of whoever knows a token, with the cookie; None for a wrong one. Raises TokenRefused where nobody can sign in.

        It takes the place of ``over``, whose cookie came with the token: that is signed out; ``keep`` makes it last.
        """
        given = _bytes(token)
        for role in ROLES:
            try:
                token = self._token(role)
            except TokenRefused:  # the other role's may be good
                continue
            if hmac.compare_digest(given, token.encode()):
                nonce, expires = secrets.token_urlsafe(12), self._ended[role].expiry()  # which may refuse
                if over is not None:
                    self.sign_out(over)
                    expires = self._ended[role].expiry()  # where the list is full, it is later than what that has ended
                text = f'{role}.{expires}.{nonce}'
                self._failures.pop(network_of(address), None)
                return self._of(role, nonce, expires), f'{text}.{self._sign(role, text)}'
        self._fail(address)
        return None

    def wait_s(self, address: str) -> float:
        """How long this address must wait before it may try another token; 0 where it need not."""
        known = self._failures.get(network_of(address))
        if known is None or len(known) < MAX_FAILURES:
            return 0.0
        left_s = known[0] + FAILURES_S - self._monotonic()
        return max(1.0, left_s) if left_s > 0 else 0.0

    def who(self, cookie: str | None) -> SignIn | None:
        """Who has this cookie; None where nobody may watch who has none."""
        parts = (cookie or '').split('.')
        if len(parts) == 4:
            role, until, nonce, signature = parts
            with suppress(TokenRefused):
                if self._is_good(role, until, nonce, f'{role}.{until}.{nonce}', signature):
                    return self._of(role, nonce, int(until))
        return SignIn(VIEWER) if self._is_open else None

    def sign_out(self, who: SignIn) -> None:
        """Its cookie is invalid from now on; ``keep`` makes that last."""
        if who.nonce:
            self._ended[who.role].add(who.nonce, who.expires)

    def keep(self, role: str) -> None:
        """Write down who of a role was signed out; waits for the disk, in any thread. Raises OSError."""
        self._ended[role].keep()

    def is_csrf(self, who: SignIn, given: str) -> bool:
        """Whether a request that acts comes from the page itself."""
        return bool(who.csrf) and hmac.compare_digest(who.csrf.encode(), _bytes(given))

    def _is_good(self, role: str, until: str, nonce: str, text: str, signature: str) -> bool:
        """Whether the token of the role signed this text, which has not expired and was not signed out. Raises TokenRefused."""
        if role not in ROLES or not until.isdecimal() or len(until) >= 12:
            return False
        is_signed = hmac.compare_digest(_bytes(signature), self._sign(role, text).encode())
        return is_signed and int(until) > self._now() and not self._ended[role].has(nonce, int(until))

    def _of(self, role: str, nonce: str, expires: int) -> SignIn:
        return SignIn(role, nonce, expires, self._sign(role, f'csrf.{nonce}'))

    def _sign(self, role: str, text: str) -> str:
        return hmac.new(self._token(role).encode(), _bytes(text), sha256).hexdigest()

    def _token(self, role: str) -> str:
        """Read anew each time: whoever replaces the file ends all sign-ins. Raises TokenRefused, which the log says once."""
        try:
            token = token_of(self._paths[role])
        except TokenRefused as error:
            if self._refused.get(role) != str(error):
                self._refused[role] = str(error)
                log.warning('nobody is signed in as %s any more: %s', role, error)
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
    """Names under which the page may be asked for: a foreign name that leads here is an attack (DNS rebinding)."""

    def __init__(self, bind: str, more: Iterable[str] = ()) -> None:
        host = socket.gethostname().lower()
        self._names = {'localhost', host, f'{host.partition(".")[0]}.local', bind.lower(), *(name.lower() for name in more)}

    def has(self, host: str, own_address: str) -> bool:
        """Whether a request with this Host header, at this address of ours, is for us."""
        name = _host(f'//{host}')
        if name in self._names:
            return True
        try:
            return _address(name) == _address(own_address)
        except ValueError:
            return False


def is_same_origin(origin: str | None, host: str, scheme: str) -> bool:
    """Whether a request's Origin header is the page itself."""
    return origin is not None and origin.lower() == f'{scheme}://{host}'.lower()


def _bytes(text: str) -> bytes:
    """Of what somebody sent, which may be half a surrogate pair."""
    return text.encode(errors='surrogatepass')


def _host(url: str) -> str:
    try:
        return (urlsplit(url).hostname or '').lower()
    except ValueError:
        return ''


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Without zone, and without the form that IPv4 has on a socket of IPv6. Raises ValueError."""
    found = ipaddress.ip_address(text.partition('%')[0])
    return getattr(found, 'ipv4_mapped', None) or found


def network_of(address: str) -> str:
    """The address, or of IPv6 its /64: a host there may have any address of it."""
    try:
        found = _address(address)
    except ValueError:
        return address
    return str(found) if found.version == 4 else str(ipaddress.ip_network((found, 64), strict=False))


def is_loopback(address: str) -> bool:
    """Whether it can be reached from this machine alone."""
    try:
        return _address(address).is_loopback
    except ValueError:
        return address == 'localhost'
