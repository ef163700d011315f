"""The delivered objects of an index, for an audit. It only reads the index, so a node may deliver at the same time."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.spool.index import Index

PAGE: Final = 256
"""Objects read at a time: an interruption loses at most the results of so many."""

_Answer = TypeVar('_Answer')


class Deliveries:
    """The deliveries that the store confirmed.

    Lifecycle: new; open once; use from one thread; close once. Raises SpoolError, which names the file and what to do.
    """

    def __init__(self, spool: Path) -> None:
        self._path = spool / 'index.db'
        self._index = Index(self._path, read_only=True)

    def open(self) -> None:
        if not self._path.is_file():
            raise SpoolError(f'there is no spool in {self._path.parent}',
                             remedy='has the node run here? set SHADOWHOUND_HOME to its folder')  # fmt: skip
        self._read(self._index.open)

    def close(self) -> None:
        self._index.close()

    def pages(self) -> Iterator[list[ObjectInfo]]:
        """Delivered objects, as the store must describe them, some at a time."""
        last = 0
        while page := self._read(partial(self._index.history.delivered, last, PAGE)):
            last = page[-1][0]
            yield [item for _, item in page]

    def known(self) -> int:
        """Delivered objects that the index remembers; it forgets them after ``spool.remember_days``."""
        return self._read(self._index.history.delivered_count)

    def forgotten(self) -> int:
        """Earlier deliveries, which the index counts but can no longer name; including parts of the catalog."""
        return self._read(self._index.history.forgotten_count)

    def since_ns(self) -> int | None:
        """When the first remembered object was delivered; None if there is none."""
        return self._read(self._index.history.delivered_since_ns)

    def first_session(self) -> str:
        """Identifies the index, also a copy of it."""
        return str(self._read(self._index.accounts.first_session))

    def _read(self, read: Callable[[], _Answer]) -> _Answer:
        try:
            return read()
        except sqlite3.Error as error:
            raise SpoolError(f'{self._path} cannot be read: {error}', remedy='may this user read the folder?') from error
