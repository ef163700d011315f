"""What the node tells systemd when it is a service: that it is ready, that it lives, that it stops (sd_notify(3)).

Without systemd it tells nobody and costs nothing. No library: it is one datagram of text to a socket that the environment names.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import MutableMapping
from typing import Final

log = logging.getLogger(__name__)

PART: Final = 3
"""It says that it lives this many times within the time that systemd allows, so that one lost word is no death."""


class SystemdService:
    """New; ``ready`` once; ``alive`` from the main loop, as often as it turns; ``stopping`` once."""

    def __init__(self, environ: MutableMapping[str, str]) -> None:
        """Takes the variables out of the environment: they are this process's, and none of its children's."""
        self._address = environ.pop('NOTIFY_SOCKET', '')
        pid, interval_us = environ.pop('WATCHDOG_PID', ''), environ.pop('WATCHDOG_USEC', '')
        is_watched = bool(self._address) and interval_us.isdigit() and pid in {'', str(os.getpid())}
        self._pause_s = int(interval_us) / 1e6 / PART if is_watched else None
        self._due_s = 0.0
        self._told = False

    def ready(self, what: str) -> None:
        """It logs now; ``what`` is shown by ``systemctl status``."""
        self._tell(f'READY=1\nSTATUS={what}')

    def alive(self) -> None:
        """Its main loop turned; a loop that hangs lets systemd end it with SIGABRT and start it again."""
        if self._pause_s is not None and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._pause_s
            self._tell('WATCHDOG=1')

    def stopping(self) -> None:
        self._tell('STOPPING=1\nSTATUS=closing: open batches are finished and delivered')

    def _tell(self, text: str) -> None:
        """Never raises and never waits: systemd's silence is no reason to stop logging."""
        if not self._address:
            return
        name = '\0' + self._address[1:] if self._address.startswith('@') else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC) as sender:
                sender.sendto(text.encode(), name)
        except OSError as error:
            if not self._told:
                self._told = True
                log.warning('systemd is not told how the node is: %s', error)
