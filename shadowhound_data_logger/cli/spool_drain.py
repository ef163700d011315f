"""``shadowhound-data spool drain``: progress, patience, and a verdict."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import click
from rich.progress import Progress, TaskID

from shadowhound_data_logger.cli.tables import number
from shadowhound_data_logger.cli.verify import progress
from shadowhound_data_logger.clock import SystemClock
from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.lake.catalogue import Catalogue
from shadowhound_data_logger.ship.uploader import Uploader, UploadStatus
from shadowhound_data_logger.spool.delivering import delivering
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import limits
from shadowhound_data_logger.spool.writer import SpoolWriter

LOOK_S: Final = 0.2
CLOSE_S: Final = 5.0
OTHER: Final = 'another process delivers from this spool: look at it with shadowhound-data status'
"""What holds the drain lock is a node, or for a moment a mission agent."""


def drain_all(folder: Path, *, patience_s: float, as_json: bool) -> int:
    """The exit code."""
    settings, clock = Settings.load({}, os.environ), SystemClock.of_this_machine()
    # A robot of its own: its session is none of the node's, and what that left open is not for it to settle.
    spool = Spool(folder, limits(folder, settings.spool), clock, f'{settings.robot} drain')
    spool.open()
    catalogue = Catalogue(folder, settings.catalogue, settings.robot, clock)
    try:
        with closing(spool), delivering(spool, settings, CLOSE_S) as (uploader, writer), progress() as bar:
            _wait(spool, uploader, writer, catalogue, patience_s, (bar, bar.add_task('delivered', total=spool.pending_count())))
            writer.flush(CLOSE_S)
            said = _said(folder, spool, uploader.status())
    except (OSError, sqlite3.Error) as error:
        raise SpoolError(f'the spool {folder} cannot be used: {error}') from error
    click.echo(json.dumps(said, indent=2) if as_json else _told(said))
    return 0 if said['ok'] else 1


def _wait(spool: Spool, uploader: Uploader, writer: SpoolWriter, catalogue: Catalogue, patience_s: float,
          shown: tuple[Progress, TaskID]) -> None:  # fmt: skip
    """Until nothing waits that can be delivered, the catalogue's parts of it included; or nothing moves for so long."""
    bar, task = shown
    done, sent, retries, moved_s = -1, 0, 0, time.monotonic()
    while time.monotonic() - moved_s < patience_s:
        is_drained = uploader.drain(LOOK_S)
        status = uploader.status()
        if status.delivered + status.quarantined > done:
            done, retries, moved_s = status.delivered + status.quarantined, status.retries, time.monotonic()
        elif status.sent_bytes > sent and status.retries == retries:  # a large one is under way, and none is sent in vain
            moved_s = time.monotonic()
        sent = status.sent_bytes
        what = 'delivered' if status.state in {'idle', 'shipping'} else status.state.replace('_', ' ')
        bar.update(task, completed=status.delivered, total=status.delivered + spool.pending_count(), description=what)
        if not is_drained:
            time.sleep(LOOK_S)  # it returns at once where the store is away
            continue
        parts = catalogue.parts()
        for part in parts:
            writer.put(part)
        if not (parts and writer.flush(CLOSE_S)):
            return


def _said(folder: Path, spool: Spool, status: UploadStatus) -> dict[str, Any]:
    piles = spool.piles()
    why = OTHER if status.state == 'not_draining' else status.last_error
    return {
        'spool': str(folder), 'delivered': status.delivered, 'pending': piles.pending, 'held': piles.held,
        'quarantined': piles.quarantined, 'newly_quarantined': status.quarantined,
        'last_error': why if piles.pending or status.quarantined else '', 'ok': not piles.pending and not status.quarantined,
    }  # fmt: skip


def _told(said: dict[str, Any]) -> str:
    lines = [f'{number(said["delivered"])} objects delivered and confirmed']
    if said['pending']:
        lines.append(f'{number(said["pending"])} still wait: {said["last_error"] or "ask again later"}')
    if said['held']:
        lines.append(f'{number(said["held"])} have no name yet (shadowhound-data spool)')
    if said['quarantined']:
        lines.append(f'{number(said["quarantined"])} are quarantined (shadowhound-data spool)')
    return '\n'.join(lines)
