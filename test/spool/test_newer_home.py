"""A home that a newer program wrote is refused and not changed."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
from bags.recording import desk
from clocks import Clocks
from spool.making import make, new_spool, put

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.shipping.audit import Deliveries
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.listing import retry
from shadowhound_data_logger.spool.schema import SCHEMA_VERSION


@pytest.mark.parametrize('killed', [False, True])
def test_a_newer_home_is_left_alone(tmp_path: Path, killed: bool) -> None:
    """Every way to open it raises an error that names both versions, and no byte changes, nor in the log of a killed node."""
    home = tmp_path / 'home'
    clocks = Clocks()
    clocks.set()
    with desk(home, clocks) as it:
        put(it.spool, make('a', b'a'), make('b', b'b', held='clock'))
        left = Path(shutil.copytree(home, tmp_path / 'killed')) if killed else home
    root = left / 'spool'
    db = sqlite3.connect(root / 'index.db', isolation_level=None)
    db.execute('CREATE TABLE newer (id)')
    db.execute(f'PRAGMA user_version = {SCHEMA_VERSION + 1}')
    if killed:  # before a checkpoint: the changes are in the log alone
        root = Path(shutil.copytree(root, tmp_path / 'newer'))
        assert (root / 'index.db-wal').stat().st_size
    db.close()
    before = contents(root)
    refusals = [
        lambda: new_spool(root).open(), lambda: ledger.read(root, 'thor'), lambda: retry(root),
        lambda: Deliveries(root).open(),
    ]  # fmt: skip
    for opening in refusals:
        with pytest.raises(SpoolError, match=rf'version {SCHEMA_VERSION + 1}.*update shadowhound_data_logger'):
            opening()
        assert contents(root) == before


def contents(root: Path) -> dict[str, bytes]:
    """Of all files but locks, which are empty, and what SQLite keeps beside an index for those that read it."""
    found = {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.rglob('*')) if path.is_file()}
    return {name: body for name, body in found.items() if body and not name.endswith('-shm')}
