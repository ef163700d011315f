"""The routes of the past: gaps, timelines and moments, read in a child process (``history_process.py``)."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any

from aiohttp import web

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.live.answers import answer, problem, query_ms
from shadowhound_data_logger.live.figures import DAY_NS, SpoolFigures
from shadowhound_data_logger.live.history_process import HistoryProcess, PastUnavailable


class PastRoutes:
    """Recordings and gaps, of the robot of the page and of others in a store. Used by one event loop. Close it once."""

    def __init__(self, history: HistoryProcess, figures: SpoolFigures, pool: Executor, reading: asyncio.Lock, robot: str, *,
                 is_of_store: bool) -> None:  # fmt: skip
        """``reading`` serializes reads of the spool."""
        self.history = history
        self._figures, self._pool, self._reading = figures, pool, reading
        self._robot, self._is_of_store = robot, is_of_store

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get('/api/gaps', self._gaps),
            web.get('/api/past/{do:robots|fleet|days|timeline|range|moment|recent|kept|requests}', self._past),
        ]  # fmt: skip

    async def close(self) -> None:
        await self.history.close()

    async def ask(self, do: str, robot: str, more: Mapping[str, Any]) -> web.StreamResponse:
        """The child's answer: JSON, or for a moment its head as JSON and its items, each after a uint32 with its length."""
        try:
            head, body = await self.history.ask({'do': do, 'robot': robot, **more})
        except PastUnavailable as error:
            return problem(503, str(error), {'Retry-After': '2'})
        if 'error' in head:
            return problem(400 if head.get('is_wrong') else 503, str(head['error']))
        if do in {'moment', 'recent'}:
            packed = json.dumps(head).encode()
            return web.Response(body=len(packed).to_bytes(4, 'little') + packed + body, headers={'Cache-Control': 'no-store'},
                                content_type='application/octet-stream')  # fmt: skip
        return answer(head, compress=True)

    async def _gaps(self, request: web.Request) -> web.StreamResponse:
        try:
            times = [
                None if given is None else given * SECOND // 1000 for given in map(partial(query_ms, request), ('from', 'to'))
            ]
        except ValueError as error:
            return problem(400, str(error))
        if self._is_of_store:
            return await self._store_gaps(times)
        try:
            async with self._reading:
                read = partial(self._figures.gaps, times[0], times[1])
                return answer(await asyncio.get_running_loop().run_in_executor(self._pool, read), compress=True)
        except DataLoggerError as error:
            return problem(503, str(error))

    async def _store_gaps(self, times: list[int | None]) -> web.StreamResponse:
        """The gaps of a robot whose spool is on another machine."""
        now_ns = time.time_ns()
        since_ns, until_ns = times[0] or now_ns - now_ns % DAY_NS, times[1] or now_ns
        return await self.ask('timeline', self._robot, {'from': since_ns // 1_000_000, 'to': until_ns // 1_000_000})

    async def _past(self, request: web.Request) -> web.StreamResponse:
        do, robot = request.match_info['do'], request.query.get('robot', self._robot)
        if do == 'recent' and self._is_of_store:
            return _nothing()  # its clock differs from the robot's
        takes = {'timeline': ('from', 'to'), 'range': ('from', 'to'), 'kept': ('from', 'to'), 'moment': ('at',)}.get(do, ())
        try:
            times = {name: query_ms(request, name) for name in takes}
        except ValueError as error:
            return problem(400, str(error))
        is_known = is_name(robot) or do in {'robots', 'fleet'} or (self._is_of_store and not robot)
        if not is_known or None in times.values():
            return problem(400, f'{do} takes {" and ".join(("robot", *takes))}')
        more = {name: request.query[name] for name in ('by', 'fit') if name in request.query}
        found = await self.ask(do, robot, {**times, **more})
        return _nothing() if do == 'recent' and found.status != 200 else found  # the live view then starts empty


def _nothing() -> web.Response:
    """A head without items."""
    return web.Response(body=b'\x02\0\0\0{}', content_type='application/octet-stream')
