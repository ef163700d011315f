"""The check of a large index while it is in use: before that, it would delay the start by 10 us per row, 5 s per day of logging.

A damaged index is marked as suspected, so that the next startup checks it first and rebuilds it from the files.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool.index import Index

log = logging.getLogger(__name__)

NICE: Final = 10
CLOSE_S: Final = 1.0
INTERRUPT_S: Final = 0.05


class IndexCheck:
    """Checks the index of a spool once, on its own thread and connection.

    Lifecycle: new; open once; close once.
    """

    def __init__(self, root: Path, damaged: Callable[[], None]) -> None:
        """``damaged`` is called on that thread if the index is damaged."""
        self._index = Index(root / 'index.db', read_only=True)
        self._root = root
        self._damaged = damaged
        self._thread = threading.Thread(target=self._run, name='index-check', daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """End an unfinished check: the next startup begins it again."""
        end_s = time.monotonic() + CLOSE_S
        while self._thread.is_alive() and time.monotonic() < end_s:
            self._index.interrupt()  # without effect between two statements
            self._thread.join(INTERRUPT_S)

    def _run(self) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)  # of this thread alone, on Linux
        try:
            with closing(self._index) as index:
                index.open()
                index.check()
        except (sqlite3.OperationalError, SpoolError) as error:
            log.info('the index of the spool %s was not checked completely: %s', self._root, error)
        except sqlite3.DatabaseError:
            log.exception('the index of the spool %s is damaged', self._root)
            self._index.suspect()
            self._damaged()
