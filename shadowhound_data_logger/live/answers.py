"""What the routes of the page share: answers, and the bodies and parameters of requests."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from typing import Any, Final

from aiohttp import web

REQUEST_S: Final = 10.0
"""The first request of a connection must be complete within this, and so must the body of each."""


def answer(content: Mapping[str, Any], *, compress: bool = False) -> web.Response:
    """JSON that must not be cached."""
    response = web.json_response(content, headers={'Cache-Control': 'no-store'})
    if compress:
        response.enable_compression()
    return response


def problem(status: int, text: str, headers: Mapping[str, str] | None = None) -> web.Response:
    """An error, with what to do about it."""
    return web.json_response({'error': text}, status=status, headers={'Cache-Control': 'no-store', **(headers or {})})


def parsed(text: str) -> dict[str, Any]:
    """A JSON object; empty for anything else."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


async def body_of(request: web.Request) -> dict[str, Any]:
    """The body as ``parsed``. Raises web.HTTPRequestTimeout."""
    try:
        return parsed((await asyncio.wait_for(request.read(), REQUEST_S)).decode())
    except UnicodeDecodeError:
        return {}
    except asyncio.TimeoutError as error:
        raise web.HTTPRequestTimeout(text=f'the request did not arrive within {REQUEST_S:g} s') from error


def query_ms(request: web.Request, name: str) -> int | None:
    """A time of a request, UTC in ms; None if it has none. Raises ValueError."""
    text = request.query.get(name, '')
    if text and not (text.isascii() and text.isdecimal() and len(text) < 15):
        raise ValueError(f'{name} is a time in UTC, in ms')
    return int(text) if text else None


def is_ms(value: Any) -> bool:
    """Whether a value of a body is such a time."""
    return type(value) is int and 0 <= value < 10**14
