"""Damages the index of a spool in ways that SQLite accepts: cells, rows and tables; used by ``python -m torture.fuzz``."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from spool.making import new_spool
from spool.rotting import ship, used

from shadowhound_data_logger.spool import ledger

VALUES: Final = (None, 0, 1, -1, 7, 2**31, 2**63 - 1, -(2**63), 1.5, '', 'x', 'pending', 'delivered', 'held', '../../etc/passwd',
                 'a/b', '{}', '[]', '{"sha256": 1}', '\N{SNOWMAN}', 'x' * 3000, b'', b'\xff\xfe')  # fmt: skip


def edit(base: Path, root: Path, rng: random.Random) -> list[str]:
    """Copy the spool and make one to four changes to its index; returns a description of them."""
    shutil.copytree(base, root)
    done: list[str] = []
    db = sqlite3.connect(root / 'index.db')
    try:
        for _ in range(rng.choice((1, 1, 2, 4))):
            tables = sorted(name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'"))
            done += _change(db, rng.choice(tables), rng)
        db.commit()
    finally:
        db.close()
    return done


def _change(db: sqlite3.Connection, table: str, rng: random.Random) -> list[str]:
    """Change one cell, one row, or all rows; does nothing if a constraint forbids it."""
    columns = [row[1] for row in db.execute(f'PRAGMA table_info({table})')]
    rows = [row[0] for row in db.execute(f'SELECT {columns[0]} FROM {table}')]  # noqa: S608 - own names only
    kind = rng.random()
    try:
        if kind < 0.05:
            db.execute(f'DROP TABLE {table}')
            return [f'dropped {table}']
        if not rows:
            return []
        row = rng.choice(rows)
        if kind < 0.2:
            db.execute(f'DELETE FROM {table} WHERE {columns[0]} IS ?', (row,))  # noqa: S608
            return [f'deleted {table} {row!r}']
        column, value = rng.choice(columns), rng.choice(VALUES)
        db.execute(f'UPDATE {table} SET {column} = ? WHERE {columns[0]} IS ?', (value, row))  # noqa: S608
    except sqlite3.DatabaseError:
        return []
    return [f'{table} {row!r}: {column} = {value!r:.40}']


def check(root: Path, bodies: Mapping[str, bytes]) -> dict[str, int]:
    """The spool opens, ships only what was spooled, and its ledger balances or reports that it does not; returns what it did."""
    spool = used(root)
    done = dict(+spool.recovery.counts)
    sent = ship(spool)
    whole = set(bodies.values())
    assert set(sent.values()) <= whole, 'something was shipped that was never spooled'
    report = any('ledger' in what or 'index' in what for what in done)
    assert report or ledger.imbalances(ledger.read(root, 'thor')) == [], 'the ledger does not balance, and no finding reports it'
    spool.close()
    again = new_spool(root)
    again.open()
    again.close()
    return done
