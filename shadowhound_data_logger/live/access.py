"""Who may see the page and who may act: tokens, sign-ins, and which requests are this page's own.

Two roles have a token each, in files of mode 0600 beside the spool. A sign-in is a cookie that the token signs (HMAC-SHA256), so
it outlives the process and ends when the token's file is replaced. No token is ever in a URL.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from shadowhound_data_logger.errors import DataLoggerError

VIEWER, OPERATOR = 'viewer', 'operator'
ROLES: Final = (OPERATOR, VIEWER)
RTSP_FILE: Final = 'rtsp.password'
COOKIE: Final = 'shadowhound_live'
LASTS_S: Final = 12 * 3600
"""A sign-in."""
MOST_FAILURES: Final = 5
FAILURES_S: Final = 60.0
"""So many wrong tokens of one address within this time, and it has to wait; of all addresses together, ten times as many."""
MOST_ADDRESSES: Final = 1000
LEAST_TOKEN: Final = 16
"""Letters of a token that somebody wrote into the file."""


class TokenRefused(DataLoggerError):
    """A file with a token cannot be used."""

    DEFAULT_REMEDY = 'remove it: the next start writes a new one'


@dataclass(frozen=True, slots=True)
class SignIn:
    """The role of somebody who sends requests."""

    role: str
    nonce: str = ''
    """Of the cookie; empty for somebody of this machine who has none."""
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
    return paths


def rtsp_password(folder: Path) -> str:
    """The password of RTSP, made where there is none; no token, because players keep it who knows where. Raises TokenRefused."""
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
    if len(token) < LEAST_TOKEN:
        raise TokenRefused(f'{path} holds no token of at least {LEAST_TOKEN} letters')
    return token


class Access:
    """Decides who may do what. Used by the event loop alone.

    ``is_open``: whoever reaches the page may watch, which holds for a page that listens on the loopback alone.
    """

    def __init__(self, tokens: dict[str, Path], *, is_open: bool, now: Callable[[], float] = time.time) -> None:
        self._paths = tokens
        self._is_open = is_open
        self._now = now
        self._failures: dict[str, deque[float]] = {}
        self._ended: dict[str, float] = {}

    def sign_in(self, token: str, address: str) -> tuple[SignIn, str] | None:
        """Of whoever knows a token, with the cookie; None for a wrong one."""
        given = _bytes(token)
        for role in ROLES:
            if hmac.compare_digest(given, self._token(role).encode()):
                nonce, until = secrets.token_urlsafe(12), int(self._now()) + LASTS_S
                text = f'{role}.{until}.{nonce}'
                self._failures.pop(address, None)
                return self._of(role, nonce), f'{text}.{self._sign(role, text)}'
        self._fail(address)
        return None

    def wait_s(self, address: str) -> float:
        """How long this address must wait before it may try another token; 0 where it need not."""
        now = self._now()
        for known, most in ((self._failures.get(address), MOST_FAILURES), (self._failures.get(''), 10 * MOST_FAILURES)):
            while known and known[0] < now - FAILURES_S:
                known.popleft()
            if known and len(known) >= most:
                return max(1.0, known[0] + FAILURES_S - now)
        return 0.0

    def who(self, cookie: str | None) -> SignIn | None:
        """Who has this cookie; None where nobody may watch who has none."""
        parts = (cookie or '').split('.')
        if len(parts) == 4 and parts[0] in ROLES and parts[1].isdecimal() and len(parts[1]) < 12:
            role, until, nonce, signature = parts
            is_signed = hmac.compare_digest(_bytes(signature), self._sign(role, f'{role}.{until}.{nonce}').encode())
            if is_signed and int(until) > self._now() and nonce not in self._ended:
                return self._of(role, nonce)
        return SignIn(VIEWER) if self._is_open else None

    def sign_out(self, who: SignIn) -> None:
        """Its cookie is worth nothing from now on."""
        now = self._now()
        self._ended = {nonce: until for nonce, until in self._ended.items() if until > now}
        if who.nonce:
            self._ended[who.nonce] = now + LASTS_S

    def ticket(self, who: SignIn, address: str) -> str:
        """What lets a program at this address watch, and nothing else, for as long as a sign-in lasts: it may stand in a URL."""
        text = f'{who.role}.{int(self._now()) + LASTS_S}.{who.nonce}'
        return f'{text}.{self._sign(who.role, f"ticket.{text}.{address}")}'

    def of_ticket(self, ticket: str, address: str) -> str | None:
        """The nonce of the sign-in that asked for this ticket; None for one that is worth nothing."""
        parts = ticket.split('.')
        if len(parts) != 4 or parts[0] not in ROLES or not parts[1].isdecimal() or len(parts[1]) >= 12:
            return None
        role, until, nonce, signature = parts
        expected = self._sign(role, f'ticket.{role}.{until}.{nonce}.{address}')
        is_signed = hmac.compare_digest(_bytes(signature), expected.encode())
        return nonce if is_signed and int(until) > self._now() and nonce not in self._ended else None

    def is_csrf(self, who: SignIn, given: str) -> bool:
        """Whether a request that acts comes from the page itself."""
        return bool(who.csrf) and hmac.compare_digest(who.csrf.encode(), _bytes(given))

    def _of(self, role: str, nonce: str) -> SignIn:
        return SignIn(role, nonce, self._sign(role, f'csrf.{nonce}'))

    def _sign(self, role: str, text: str) -> str:
        return hmac.new(self._token(role).encode(), _bytes(text), sha256).hexdigest()

    def _token(self, role: str) -> str:
        """Read anew each time: whoever replaces the file ends all sign-ins."""
        return token_of(self._paths[role])

    def _fail(self, address: str) -> None:
        if len(self._failures) > MOST_ADDRESSES:
            self._failures = {'': self._failures.get('', deque())}
        for known in (address, ''):
            self._failures.setdefault(known, deque(maxlen=10 * MOST_FAILURES)).append(self._now())


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
            return ipaddress.ip_address(name) == ipaddress.ip_address(own_address.partition('%')[0])
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


def is_loopback(address: str) -> bool:
    """Whether it can be reached from this machine alone."""
    try:
        return ipaddress.ip_address(address.partition('%')[0]).is_loopback
    except ValueError:
        return address == 'localhost'
