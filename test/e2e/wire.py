"""A wire to a server that can be cut, hung or made to return errors while a node uses it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from typing_extensions import Self

PASS: Final = 'pass'
REFUSE: Final = 'refuse'
HANG: Final = 'hang'


class Wire:
    """A TCP proxy on 127.0.0.1; ``set`` takes PASS, REFUSE, HANG or an S3 error as ``(status, code)``. It owns one thread."""

    def __init__(self, url: str, heard: Callable[[bytes], None] = lambda _: None) -> None:
        """``heard`` gets the data sent to the server, unchanged."""
        self._heard = heard
        self._target = (urlsplit(url).hostname, urlsplit(url).port)
        self._mode: str | tuple[int, str] = PASS
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._loop = asyncio.new_event_loop()
        with socket.socket() as free:
            free.bind(('127.0.0.1', 0))
            self._port = int(free.getsockname()[1])
        self._thread = threading.Thread(target=self._loop.run_forever, name='wire')

    @property
    def url(self) -> str:
        return f'http://127.0.0.1:{self._port}'

    def set(self, mode: str | tuple[int, str]) -> None:
        """End all connections and handle new ones in the new mode."""
        asyncio.run_coroutine_threadsafe(self._set(mode), self._loop).result(60)

    def __enter__(self) -> Self:
        self._thread.start()
        self.set(PASS)
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(60)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _set(self, mode: str | tuple[int, str]) -> None:
        self._mode = mode
        if self._server is not None:
            for listening in self._server.sockets:
                self._loop.remove_reader(listening.fileno())
            # The server learns of an accepted connection one iteration later; Python 3.12 never closes one after close().
            await asyncio.sleep(0)
            self._server.close()
            self._server = None
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if mode != REFUSE:
            self._server = await asyncio.start_server(self._accept, '127.0.0.1', self._port, reuse_address=True)

    async def _end(self) -> None:
        """A connection accepted just now has a task that has not started: it is closed here."""
        await self._set(REFUSE)
        while others := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(others)
        await asyncio.sleep(0)  # transports close one loop iteration later

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
                await self._serve(reader, writer)
        finally:
            self._tasks.discard(task)
            writer.transport.abort() if self._mode == HANG else writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._mode == REFUSE:
            return
        if self._mode == HANG:
            await asyncio.Event().wait()
        elif isinstance(self._mode, tuple):
            await self._answer(reader, writer, *self._mode)
        else:
            opening = asyncio.ensure_future(asyncio.open_connection(*self._target))
            try:
                there, back = await asyncio.shield(opening)
            except asyncio.CancelledError:
                (await opening)[1].close()
                raise
            pumps = [asyncio.create_task(_pump(reader, back, self._heard)), asyncio.create_task(_pump(there, writer))]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                back.close()
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)

    @staticmethod
    async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, status: int, code: str) -> None:
        """The S3 error, for any request."""
        while True:
            head = (await reader.readuntil(b'\r\n\r\n')).decode('latin-1').lower()
            lines = dict(line.split(': ', 1) for line in head.splitlines()[1:] if ': ' in line)
            if 'expect' not in lines:
                await reader.readexactly(int(lines.get('content-length', '0')))
            body = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>no</Message></Error>'.encode()
            body = b'' if head.startswith('head') else body
            headers = f'Content-Type: application/xml\r\nContent-Length: {len(body)}\r\n'
            writer.write(f'HTTP/1.1 {status} no\r\n{headers}\r\n'.encode() + body)
            await writer.drain()


async def _pump(source: asyncio.StreamReader, target: asyncio.StreamWriter,
                heard: Callable[[bytes], None] = lambda _: None) -> None:  # fmt: skip
    with contextlib.suppress(OSError):
        while data := await source.read(65536):
            heard(data)
            target.write(data)
            await target.drain()
