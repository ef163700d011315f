"""What an operator does from the page: requests to the node, labels, pulls; and the doctor, for everybody."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from shadowhound_data_logger.core.errors import NodeUnavailable
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.live.answers import answer, body_of, is_ms, problem
from shadowhound_data_logger.live.auth import Auth
from shadowhound_data_logger.live.past_routes import PastRoutes
from shadowhound_data_logger.spool.control import connect

log = logging.getLogger(__name__)

DOCTOR_S: Final = 60.0
"""The doctor's answer is repeated for this long, however many request it."""
ACTS: Final[Mapping[str, tuple[str, ...]]] = {
    'flush': (), 'pause': (), 'resume': (), 'bag start': (), 'bag stop': (), 'bag split': (), 'event': ('name', 'note'),
}  # fmt: skip
"""What an operator may request of the node, and the arguments of each."""


class Acts:
    """The routes of operators. Used by one event loop."""

    def __init__(self, auth: Auth, past: PastRoutes, pool: Executor, spool: Path, robot: str, *, is_of_store: bool) -> None:
        self._auth, self._past, self._pool = auth, past, pool
        self._spool, self._robot, self._is_of_store = spool, robot, is_of_store
        self._node_lock = asyncio.Lock()
        self._doctor: tuple[float, dict[str, Any]] | None = None
        self._examining = asyncio.Lock()

    def routes(self) -> list[web.RouteDef]:
        return [
            web.post('/api/act', self._act), web.post('/api/label', self._label), web.post('/api/pull', self._pull),
            web.get('/api/doctor', self._examine),
        ]  # fmt: skip

    def lease(self, max_mbps: float) -> None:
        """Let uploads yield for some seconds; without a node nothing is uploaded. Blocks: for a thread."""
        with suppress(NodeUnavailable), closing(connect(self._spool, self._robot, 5.0)) as connection:
            connection.ask('yield', max_mbps=max_mbps)

    async def _act(self, request: web.Request) -> web.StreamResponse:
        """A request to the node, with the node's answer."""
        if (refused := self._auth.refused(request)) is not None:
            return refused
        if self._is_of_store:
            return problem(404, "there is no node here: the buttons are on the robot's own page")
        given = await body_of(request)
        do = given.pop('do', None)
        takes = ACTS.get(do) if isinstance(do, str) else None
        if takes is None or not all(name in takes and isinstance(value, str) for name, value in given.items()):
            return problem(400, f'"do" is one of {", ".join(ACTS)}')
        async with self._node_lock:
            asked = partial(self._ask, str(do), request.remote or '', given)
            return answer(await asyncio.get_running_loop().run_in_executor(self._pool, asked))

    def _ask(self, do: str, address: str, given: Mapping[str, str]) -> dict[str, Any]:
        try:
            with closing(connect(self._spool, self._robot)) as connection:
                by = {'by': 'page'} if do == 'event' else {}
                return connection.ask(do, who=f'operator at {address}', **given, **by)
        except NodeUnavailable as error:
            return {'ok': False, 'robot': self._robot, 'error': str(error)}

    async def _label(self, request: web.Request) -> web.StreamResponse:
        """Label a time range in the store."""
        if (refused := self._auth.refused(request)) is not None:
            return refused
        given = await body_of(request)
        robot, label, note = given.get('robot'), given.get('label'), given.get('note', '')
        times = [given.get(name) for name in ('from', 'to')]
        if not all(isinstance(each, str) for each in (robot, label, note)) or not is_name(str(robot)):
            return problem(400, 'a label has a robot, a label, a note, from and to')
        if not all(map(is_ms, times)):
            return problem(400, 'from and to are times in UTC, in ms')
        address = request.remote or ''
        log.info('operator at %s labels %s', address, robot)
        query = {'label': label, 'note': note, 'by': f'operator at {address}', 'from': times[0], 'to': times[1]}
        return await self._past.ask('label', str(robot), query)

    async def _pull(self, request: web.Request) -> web.StreamResponse:
        """Request a sensor's objects of a time range from a robot, or cancel such a request."""
        if (refused := self._auth.refused(request)) is not None:
            return refused
        given = await body_of(request)
        robot, cancel, sensor = given.get('robot'), given.get('cancel'), given.get('sensor')
        times = [given.get(name) for name in ('from', 'to')]
        if not isinstance(robot, str) or not is_name(robot):
            return problem(400, 'a request names a robot')
        query: dict[str, Any] = {'by': f'operator_{request.remote or ""}'}
        if isinstance(cancel, str):
            query['cancel'] = cancel
        elif isinstance(sensor, str) and all(map(is_ms, times)):
            query |= {'sensor': sensor, 'from': times[0], 'to': times[1]}
        else:
            return problem(400, 'a request has a robot, a sensor, from and to, which are times in UTC, in ms; or cancel, an id')
        log.info('operator at %s %s of %s', request.remote, 'cancels a request' if 'cancel' in query else 'requests data', robot)
        return await self._past.ask('pull', robot, query)

    async def _examine(self, _: web.Request) -> web.StreamResponse:
        async with self._examining:
            if self._doctor is None or time.monotonic() - self._doctor[0] > DOCTOR_S:
                self._doctor = time.monotonic(), await _doctor(self._spool.absolute(), self._robot)
        return answer(self._doctor[1])


async def _doctor(spool: Path, robot: str) -> dict[str, Any]:
    """What ``shadowhound-data doctor --json`` reports about the node with this spool, from a separate process."""
    if spool.name != 'spool':
        return {'error': f'the doctor examines a node, which has its spool in SHADOWHOUND_HOME/spool, and not {spool}'}
    process = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'doctor', '--json', stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, 'SHADOWHOUND_HOME': str(spool.parent), 'SHADOWHOUND_ROBOT': robot},
    )  # fmt: skip
    try:
        out, _ = await asyncio.wait_for(process.communicate(), 60.0)
        return {'doctor': json.loads(out)}
    except (asyncio.TimeoutError, ValueError) as error:
        if process.returncode is None:
            process.kill()
            await process.wait()
        return {'error': f'the doctor did not answer: {type(error).__name__}'}
