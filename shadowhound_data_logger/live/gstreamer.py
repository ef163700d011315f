"""Runs scripts that need GStreamer: Debian and Ubuntu build its bindings for the system's Python, so a process of that runs them.

A script is fed with records: two uint32 (little-endian) with the lengths of a head in JSON and of a body, and these.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

PYTHON: Final = Path('/usr/bin/python3')
"""Of the system."""
MOST_WAITING: Final = 4 << 20
"""Bytes for a process that does not read; records with a body beyond it are left out."""
END_S: Final = 5.0


class GstProcess:
    """A process of a script, which ends with its input. Used by one event loop. Start it again only after ``end``; end it."""

    def __init__(self, script: Path) -> None:
        self._script = script
        self._process: asyncio.subprocess.Process | None = None

    @property
    def output(self) -> asyncio.StreamReader:
        """What it says, from its start until ``end``."""
        assert self._process is not None
        assert self._process.stdout is not None
        return self._process.stdout

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        return None if self._process is None else self._process.pid

    async def start(self, first: Mapping[str, Any]) -> None:
        """``first`` is its first record; the command line is something that everybody can read. Raises OSError."""
        self._process = await asyncio.create_subprocess_exec(
            str(PYTHON),
            '-I',
            str(self._script),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for who feeds it
        )
        self.tell(first)

    def tell(self, head: Mapping[str, Any], body: bytes = b'') -> None:
        if self._process is None or (stdin := self._process.stdin) is None or stdin.is_closing():
            return
        if not body or stdin.transport.get_write_buffer_size() < MOST_WAITING:
            text = json.dumps(head).encode()
            stdin.write(struct.pack('<II', len(text), len(body)) + text + body)

    async def end(self) -> None:
        """Also where an earlier one was cancelled."""
        if (process := self._process) is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            await asyncio.wait_for(_over(process), END_S)
        except asyncio.TimeoutError:
            with suppress(ProcessLookupError):
                process.kill()
            await _over(process)
        if self._process is process:
            self._process = None


async def _over(process: asyncio.subprocess.Process) -> None:
    """Wait until it has ended. What it still says is thrown away: the end of one whose pipe is full is not seen."""
    assert process.stdout is not None
    while await process.stdout.read(1 << 16):
        pass
    await process.wait()
