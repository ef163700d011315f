"""A control socket without a node: a thread of the test executes requests as the node's main thread does."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from shadowhound_data_logger.node.reporting.control import ControlSocket

Do = Callable[[Mapping[str, Any]], dict[str, Any]]


class Serving:
    """Open from the start; ``close`` any number of times. ``asked`` lists the requests, ``hold`` delays their execution."""

    def __init__(self, spool: Path, robot: str = 'thor', do: Do | None = None, **limits: float) -> None:
        spool.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.spool, self.robot = spool, robot
        self.asked: list[Mapping[str, Any]] = []
        self.hold = threading.Lock()
        self._do = do or self._echo
        self._wake, self._over = threading.Event(), False
        self.control = ControlSocket(spool, robot, self._wake.set, **limits)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.control.open()

    def close(self) -> None:
        if not self._over:
            self.control.close()
            self._over = True
            self._wake.set()
            self._thread.join()

    def _run(self) -> None:
        while not self._over:
            self._wake.wait()
            self._wake.clear()
            with self.hold:
                self.control.handle_requests(self._done)

    def _done(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self.asked.append(request)
        return self._do(request)

    def _echo(self, request: Mapping[str, Any]) -> dict[str, Any]:
        return {'ok': True, 'robot': self.robot, 'message': f'{request.get("do")} is done', 'long': 'x' * request.get('long', 0)}
