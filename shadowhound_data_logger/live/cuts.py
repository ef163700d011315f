"""Pieces of bags for a browser: cut by ``shadowhound-data bag cut`` in a separate process, and kept for a few minutes.

The URL of a piece has a random name of 128 bits, so it can be opened in Foxglove or Lichtblick, which cannot sign in here.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.live.answers import answer, body_of, is_ms, problem
from shadowhound_data_logger.live.auth import Auth
from shadowhound_data_logger.spool.files import Tree

log = logging.getLogger(__name__)

MAX_CUT_MS: Final = 600_000
"""Maximum length of a piece, which is stored on this machine's disk."""
MAX_KEPT: Final = 4
KEPT_S: Final = 900.0
CUT_S: Final = 300.0
MIN_FREE_BYTES: Final = 1 << 30
FOLDER: Final = 'cuts-'
SHARED: Final = {
    'Access-Control-Allow-Origin': '*', 'Access-Control-Allow-Headers': 'Range', 'Access-Control-Allow-Private-Network': 'true',
    'Access-Control-Expose-Headers': 'Accept-Ranges, Content-Length, Content-Range, ETag',
    'Cross-Origin-Resource-Policy': 'cross-origin', 'Cache-Control': 'no-store',
}  # fmt: skip
"""Headers of answers that viewers on other sites may read."""


@dataclass(frozen=True, slots=True)
class _Piece:
    path: Path
    made_s: float


class Cuts:
    """Cuts pieces, one at a time, and serves them. Used by one event loop. Close it once."""

    def __init__(self, auth: Auth, folder: Path, spool: Path | None) -> None:
        """``folder`` holds the pieces; ``spool`` is the robot's own, which may have slices that the store lacks."""
        self._auth, self._parent, self._spool = auth, folder, spool
        self._folder: Path | None = None
        self._cutting = asyncio.Lock()
        self._pieces: dict[str, _Piece] = {}
        for old in folder.glob(f'{FOLDER}*'):  # from a page that was killed
            if time.time() - old.stat().st_mtime > 2 * KEPT_S:
                shutil.rmtree(old, ignore_errors=True)

    def routes(self) -> list[web.RouteDef]:
        return [
            web.post('/api/cut', self._cut), web.get('/cut/{name:[A-Za-z0-9_-]+}.mcap', self._piece),
            web.options('/cut/{name:[A-Za-z0-9_-]+}.mcap', self._may_read),
        ]  # fmt: skip

    def close(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    async def _cut(self, request: web.Request) -> web.StreamResponse:
        """Cut a piece of a bag; the answer has its URL."""
        who = self._auth.who(request)
        if who.csrf and not self._auth.access.is_csrf(who, request.headers.get('X-CSRF-Token', '')):
            return problem(403, 'the request does not come from this page')
        given = await body_of(request)
        robot, bag, begin, end = (given.get(name) for name in ('robot', 'bag', 'from', 'to'))
        if not isinstance(robot, str) or not isinstance(bag, str) or not is_name(robot) or not is_name(bag):
            return problem(400, 'a piece has a robot and a bag')
        if (
            type(begin) is not int
            or type(end) is not int
            or not is_ms(begin)
            or not is_ms(end)
            or not 0 < end - begin <= MAX_CUT_MS
        ):
            return problem(400, f'select at most {MAX_CUT_MS // 60_000} minutes: longer pieces are for the command line')
        if self._cutting.locked():
            return problem(503, 'another piece is being cut: try again in a moment', {'Retry-After': '5'})
        async with self._cutting:
            self._forget(MAX_KEPT - 1)
            self._folder = self._folder or Path(tempfile.mkdtemp(prefix=FOLDER, dir=self._parent))
            if shutil.disk_usage(self._folder).free < MIN_FREE_BYTES:
                return problem(507, 'the disk of this machine is nearly full: cut on another one, with the command below')
            log.info('%s cuts bag %s of %s', request.remote, bag, robot)
            return await self._made(self._folder, robot, bag, begin, end)

    async def _made(self, folder: Path, robot: str, bag: str, begin_ms: int, end_ms: int) -> web.StreamResponse:
        name = secrets.token_urlsafe(16)
        folder = folder / name
        sources = [bag]
        if self._spool is not None:
            local = Tree(self._spool).path(State.PENDING, None, BUCKET, f'{robot}/rosbags/{bag}')
            sources += [str(local)] if await asyncio.to_thread(local.is_dir) else []
        result: dict[str, Any] = {}
        for source in sources:
            result = await self._run(robot, source, begin_ms, end_ms, folder / 'cut')
            if 'error' not in result:
                break
        files = await asyncio.to_thread(lambda: sorted((folder / 'cut').glob('*.mcap')))
        if 'error' in result or len(files) != 1:
            await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
            return problem(503, result.get('error', 'nothing was cut'))
        self._pieces[name] = _Piece(files[0], time.monotonic())
        asyncio.get_running_loop().call_later(KEPT_S + 1, self._forget)
        seconds = (result['t_end_ns'] - result['t_start_ns']) / SECOND
        return answer({'path': f'/cut/{name}.mcap', 'bytes': result['bytes'], 'messages': result['messages'], 'seconds': seconds,
                       'kept_s': KEPT_S})  # fmt: skip

    async def _run(self, robot: str, source: str, begin_ms: int, end_ms: int, out: Path) -> dict[str, Any]:
        """The output of ``bag cut --json``, or ``error``."""
        times = [f'{utc(at_ms * (SECOND // 1000)):%Y-%m-%dT%H:%M:%S.%f}Z' for at_ms in (begin_ms, end_ms)]
        await asyncio.to_thread(out.parent.mkdir, mode=0o700, exist_ok=True)
        process = await asyncio.create_subprocess_exec(
            'nice', sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'bag', 'cut', '--json', '--robot', robot,
            '--start', times[0], '--end', times[1], '--to', str(out), '--', source, stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, env=dict(os.environ),
        )  # fmt: skip
        try:
            output, wrong = await asyncio.wait_for(process.communicate(), CUT_S)
            return dict(json.loads(output))
        except (asyncio.TimeoutError, asyncio.CancelledError) as error:
            process.kill()
            await process.wait()
            if isinstance(error, asyncio.CancelledError):
                raise
            return {'error': f'cutting took longer than {CUT_S:g} s: select less'}
        except ValueError:
            return {'error': visible(wrong.decode(errors='replace').strip()[-400:]) or 'nothing was cut'}

    def _forget(self, most: int = MAX_KEPT) -> None:
        """Delete old pieces, and the oldest ones beyond the limit."""
        now_s = time.monotonic()
        for name, piece in list(self._pieces.items()):
            if now_s - piece.made_s >= KEPT_S or len(self._pieces) > most:
                del self._pieces[name]
                shutil.rmtree(piece.path.parent.parent, ignore_errors=True)

    async def _piece(self, request: web.Request) -> web.StreamResponse:
        piece = self._pieces.get(request.match_info['name'])
        if piece is None:
            return problem(404, 'this piece was deleted: cut it again')
        headers = {
            **SHARED,
            'Content-Type': 'application/octet-stream',
            'Content-Disposition': f'attachment; filename="{piece.path.name}"',
        }
        return web.FileResponse(piece.path, headers=headers)

    async def _may_read(self, _: web.Request) -> web.StreamResponse:
        return web.Response(status=204, headers=SHARED)
