"""Authentication of requests: the guard of every route, sign-in and sign-out (``access.py`` has tokens and cookies)."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final
from urllib.parse import urlsplit

from aiohttp import web

from shadowhound_data_logger.live.access import COOKIE, LASTS_S, Access, OwnNames, SignIn, TokenRefused, is_same_origin
from shadowhound_data_logger.live.answers import answer, body_of, problem

log = logging.getLogger(__name__)

MAX_BODY: Final = 4096
"""Maximum size of a request, bytes."""
IMAGES: Final = "img-src 'self';"
SECURITY: Final[Mapping[str, str]] = {
    'Content-Security-Policy': f"default-src 'none'; script-src 'self'; style-src 'self'; {IMAGES}"
                               " connect-src 'self'; font-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self';"
                               " frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY', 'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Opener-Policy': 'same-origin', 'Cross-Origin-Resource-Policy': 'same-origin',
}  # fmt: skip
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Auth:
    """Guards the routes of a page. Used by one event loop."""

    def __init__(self, access: Access, names: OwnNames, scheme: str, about: Callable[[], Mapping[str, Any]],
                 end: Callable[[str], None], tiles: str = '') -> None:  # fmt: skip
        """``about`` is what a signed-in page gets besides its role; ``end`` closes the connections of a sign-in's nonce.

        ``tiles``: a URL whose origin the page may load images from.
        """
        self.access = access
        origin = urlsplit(tiles)
        image_sources = f"img-src 'self' {origin.scheme}://{origin.netloc};" if tiles else IMAGES
        self._security = {name: value.replace(IMAGES, image_sources) for name, value in SECURITY.items()}
        self._names, self._scheme, self._about, self._end = names, scheme, about, end

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get('/api/session', self._session), web.post('/api/session', self._sign_in),
            web.post('/api/sign-out', self._sign_out),
        ]  # fmt: skip

    def who(self, request: web.Request) -> SignIn:
        """The sign-in of a request that passed the guard."""
        who = self.access.who(request.cookies.get(COOKIE))
        assert who is not None
        return who

    def refused(self, request: web.Request) -> web.StreamResponse | None:
        """The answer to a request that acts, unless it comes from an operator at this page."""
        who = self.who(request)
        if not who.may_act:
            return problem(403, 'only an operator may do that: sign in with the token of the operator')
        if not self.access.is_csrf(who, request.headers.get('X-CSRF-Token', '')):
            return problem(403, 'the request does not come from this page')
        return None

    async def guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check the name, the origin, the size and the sign-in of a request; add the security headers to its answer."""
        try:
            response = self._problem(request) or await handler(request)
        except web.HTTPException as error:
            response = problem(error.status, error.text or error.reason)
        if not response.prepared:
            response.headers.update({name: value for name, value in self._security.items() if name not in response.headers})
        return response

    def _problem(self, request: web.Request) -> web.StreamResponse | None:
        own = request.transport.get_extra_info('sockname') if request.transport is not None else None
        if not self._names.has(request.host, own[0] if own else ''):
            return problem(403, f'this page is not called {request.host[:100]!r}: see --hostname')
        is_ws = request.path == '/ws'
        if is_ws or request.method not in ('GET', 'HEAD', 'OPTIONS'):
            if not is_same_origin(request.headers.get('Origin'), request.host, self._scheme):
                return problem(403, 'the request does not come from this page')
            if (request.content_length or 0) > MAX_BODY:
                return problem(413, f'a request has at most {MAX_BODY} bytes')
        if is_ws or request.path.startswith('/api/'):
            is_known = self.access.who(request.cookies.get(COOKIE)) is not None
            if not is_known and (request.method, request.path) != ('POST', '/api/session'):
                return problem(401, 'sign in first')
        return None

    async def _session(self, request: web.Request) -> web.StreamResponse:
        who = self.who(request)
        return answer({'role': who.role, 'csrf': who.csrf, 'signed_in': bool(who.nonce), **self._about()})

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        address = request.remote or ''
        if wait_s := self.access.wait_s(address):
            return problem(429, 'too many wrong tokens', {'Retry-After': str(round(wait_s))})
        token = (await body_of(request)).get('token')
        before = self.access.who(request.cookies.get(COOKIE))
        try:
            found = self.access.sign_in(token, address, before) if isinstance(token, str) else None
        except TokenRefused as error:
            log.warning('sign-in is impossible: %s', error)
            return problem(503, str(error))
        if found is None:
            log.warning('a wrong token from %s', address)
            return problem(401, 'this is not the token of a viewer or operator')
        who, cookie = found
        if before is not None and before.nonce:
            await self._keep_sign_outs(before.role)
        log.info('%s signed in from %s', who.role, address)
        response = answer({'role': who.role, 'csrf': who.csrf, 'signed_in': True, **self._about()})
        response.set_cookie(COOKIE, cookie, max_age=LASTS_S, httponly=True, samesite='Strict', secure=self._scheme == 'https')
        return response

    async def _sign_out(self, request: web.Request) -> web.StreamResponse:
        who = self.who(request)
        if not self.access.is_csrf(who, request.headers.get('X-CSRF-Token', '')):
            return problem(403, 'the request does not come from this page')
        self.access.sign_out(who)
        self._end(who.nonce)
        if await self._keep_sign_outs(who.role):
            response = answer({})
        else:
            response = problem(503, 'signed out until this page restarts: the disk refused it; --new-tokens ends it permanently')
        response.del_cookie(COOKIE)
        return response

    async def _keep_sign_outs(self, role: str) -> bool:
        try:
            await asyncio.to_thread(self.access.keep, role)
        except OSError as error:
            log.error('a sign-out is forgotten when this page restarts: %s', error)  # noqa: TRY400 - an operator's matter
            return False
        return True
