"""The child process that reads the past (``history.py``): started on the first request, ended after an idle minute."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from shadowhound_data_logger.core.errors import DataLoggerError

IDLE_S: Final = 60.0
ANSWER_S: Final = 45.0
"""A slower request ends the process."""
MAX_WAITING: Final = 8
"""Maximum waiting requests; more are rejected."""
MAX_ANSWER: Final = 96 << 20


class PastUnavailable(DataLoggerError):
    """The past cannot be read now."""

    DEFAULT_REMEDY = 'try again in a moment'


class HistoryProcess:
    """Sends requests to the child, one at a time. Used by one event loop; close once.

    ``arguments`` are those of ``history.main``.
    """

    def __init__(self, arguments: Sequence[str], *, idle_s: float = IDLE_S, answer_s: float = ANSWER_S) -> None:
        self._arguments, self._idle_s, self._answer_s = tuple(arguments), idle_s, answer_s
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self._waiting = 0
        self._used_s = 0.0
        self._ender: asyncio.Task[None] | None = None

    @property
    def pid(self) -> int | None:
        """The pid of the process, while there is one."""
        return self._process.pid if self._process is not None and self._process.returncode is None else None

    async def ask(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Head and body of the answer. Raises PastUnavailable."""
        if self._waiting >= MAX_WAITING:
            raise PastUnavailable('too many requests for the past at the same time')
        self._waiting += 1
        try:
            async with self._turn:
                try:
                    return await asyncio.wait_for(self._ask(request), self._answer_s)
                except (asyncio.TimeoutError, asyncio.IncompleteReadError, OSError, ValueError) as error:
                    await self._end()
                    raise PastUnavailable(f'the past could not be read: {type(error).__name__}') from error
                except asyncio.CancelledError:
                    await asyncio.shield(self._end())  # its answer would be taken for the next one's
                    raise
                finally:
                    self._used_s = time.monotonic()
        finally:
            self._waiting -= 1

    async def close(self) -> None:
        if self._ender is not None:
            self._ender.cancel()
            with suppress(asyncio.CancelledError):
                await self._ender
        await self._end()

    async def _ask(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        process = self._process
        if process is None or process.returncode is not None:
            process = self._process = await asyncio.create_subprocess_exec(
                sys.executable, '-m', 'shadowhound_data_logger.live.history', *self._arguments, stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE, env=dict(os.environ),
            )  # fmt: skip
            self._used_s = time.monotonic()
            if self._ender is None or self._ender.done():
                self._ender = asyncio.create_task(self._end_when_idle())
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(dict(request)).encode() + b'\n')
        await process.stdin.drain()
        sizes = await process.stdout.readexactly(8)
        head_size, body_size = int.from_bytes(sizes[:4], 'little'), int.from_bytes(sizes[4:], 'little')
        if head_size + body_size > MAX_ANSWER:
            raise ValueError('the answer is too large')
        return json.loads(await process.stdout.readexactly(head_size)), await process.stdout.readexactly(body_size)

    async def _end_when_idle(self) -> None:
        while self._process is not None:
            await asyncio.sleep(max(0.05, self._used_s + self._idle_s - time.monotonic()))
            if not self._turn.locked() and time.monotonic() - self._used_s >= self._idle_s:
                await self._end()

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
