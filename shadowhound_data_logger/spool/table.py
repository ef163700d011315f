"""What the tables of the index share: the connection, and helpers for their statements."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable


class Table:
    """A part of the index. Methods that write must be called in one of its transactions, under the lock of the spool."""

    def __init__(self, connection: Callable[[], sqlite3.Connection]) -> None:
        """``connection`` raises SpoolError while the index is not open."""
        self._connection = connection

    @property
    def _db(self) -> sqlite3.Connection:
        return self._connection()


def after(prefix: str) -> str:
    """The first text after all texts that start with ``prefix``."""
    return f'{prefix[:-1]}{chr(ord(prefix[-1]) + 1)}' if prefix else '\U0010ffff'


def marks(count: int) -> str:
    """Placeholders for a statement."""
    return ', '.join('?' * count)
