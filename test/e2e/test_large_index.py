"""A node with a large damaged index finds the damage while it logs, exits, and logs with a rebuilt one after its restart."""

from __future__ import annotations

from e2e.processes import Processes
from spool.making import damage_old_rows, fill, make, new_spool, put, settle

from shadowhound_data_logger.core.model import State


def test_a_damaged_large_index(processes: Processes) -> None:
    root = processes.folder / 'home' / 'spool'
    spool = new_spool(root, robot=processes.robot)
    spool.open()
    settle(spool, put(spool, make())[0], State.DELIVERED)
    spool.close()
    fill(root, 15_000)
    assert (root / 'index.db').stat().st_size > 8 << 20
    damage_old_rows(root)
    node = processes.node()
    assert node.wait() == 1
    assert 'is damaged' in node.log
    again = processes.node()
    assert '1 damaged index rebuilt' in again.log
    again.stop()
