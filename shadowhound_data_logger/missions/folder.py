"""The folder of a mission, ``$SHADOWHOUND_HOME/missions/<mission id>/``, with everything about it.

    journal        the agent's journal (journal.py)
    files/         copies of frames, trajectories and artifacts, until they are sent
    run.json       the MLflow run, once it exists
    sent.json      how far the mission is sent
    summary.json   the summary, once the mission has ended
    pictures.json  notes about the mission's pictures
    clock.json     the offset to add to times from before the clock was set (``assign_date``)
    floor.npy      x and y (m) of lidar points, one row each, if the node received any: the floor plan under the trajectory's plot
    trajectory.csv computed by the node from odometry after the mission has ended, if the agent logged no trajectory
    node/          the node's journal, files/ and sent.json

A mission is found by either id: the folder is named by the mission id, and ``run.json`` has the run id.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, utc
from shadowhound_data_logger.core.clock_watch import UtcOffsets
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import MAX_NAME_BYTES, check_name
from shadowhound_data_logger.missions.journal import Line, dated, first, read

MISSIONS: Final = 'missions'
UNIQUE_BYTES: Final = 4
"""Length of the random suffix of a mission id: another robot may start a patrol in the same second."""
_UNSAFE: Final = re.compile(r'[^A-Za-z0-9_.-]+')


@dataclass(frozen=True, slots=True)
class Run:
    """The MLflow run of a mission."""

    run_id: str
    experiment_id: str
    artifact_uri: str


@dataclass(frozen=True, slots=True)
class MissionSent:
    """How far a mission is sent: for each receiver, the offset in the journal up to which it has everything."""

    metrics: int = 0
    artifacts: int = 0
    objects: int = 0
    held: bool = False
    """Whether the spool may hold some of the mission's objects until the run exists."""
    ended: bool = False
    """Whether the run has its final state."""
    complete: bool = False
    refused: int = 0
    """Points, params and tags that the tracking server refused permanently."""
    unattached: int = 0
    """Artifacts that the server refused permanently, or whose file was deleted."""
    missing: int = 0
    """Frames and trajectories whose file was deleted before it was spooled."""
    error: str = ''
    """The last refusal."""


@dataclass(frozen=True, slots=True)
class MissionFolder:
    """Paths and small files of one mission; stateless."""

    path: Path

    @property
    def mission_id(self) -> str:
        return self.path.name

    @property
    def journal(self) -> Path:
        return self.path / 'journal'

    @property
    def files(self) -> Path:
        return self.path / 'files'

    @property
    def summary(self) -> Path:
        return self.path / 'summary.json'

    @property
    def pictures(self) -> Path:
        return self.path / 'pictures.json'

    @property
    def floor(self) -> Path:
        return self.path / 'floor.npy'

    @property
    def trajectory(self) -> Path:
        return self.path / 'trajectory.csv'

    @property
    def node(self) -> MissionFolder:
        """The folder of the node's journal."""
        return MissionFolder(self.path / 'node')

    def lines(self, offset: int = 0) -> Iterator[Line]:
        """The lines of the agent's journal from ``offset``, with times corrected by ``clock.json``. Raises OSError."""
        return dated(read(self.journal, offset), self.clock_offset_ns() or 0)

    def node_lines(self, offset: int = 0) -> Iterator[Line]:
        """The same for the node's journal; empty if it does not exist. Raises OSError."""
        journal = self.node.journal
        return dated(read(journal, offset), self.clock_offset_ns() or 0) if journal.exists() else iter(())

    def clock_offset_ns(self) -> int | None:
        """The offset to add to times from before the clock was set; None until it is known."""
        found = read_json(self.path / 'clock.json').get('offset_ns')
        return found if isinstance(found, int) else None

    def set_clock_offset_ns(self, offset_ns: int) -> None:
        """Set the offset, only once: points that are sent again after a crash must have the same times as before."""
        write_json(self.path / 'clock.json', {'offset_ns': offset_ns}, durable=True)

    def run(self) -> Run | None:
        """The run; None until it was created."""
        found = read_json(self.path / 'run.json')
        try:
            return Run(**{spec.name: str(found[spec.name]) for spec in fields(Run)})
        except KeyError:
            return None

    def set_run(self, run: Run) -> None:
        write_json(self.path / 'run.json', {**asdict(run), 'mission_id': self.mission_id}, durable=True)

    def is_undated(self) -> bool:
        """Whether the clock was not set when the mission started, and it has no date yet. Raises OSError."""
        return int(first(self.journal).get('t', EARLIEST_SANE_NS)) < EARLIEST_SANE_NS and self.clock_offset_ns() is None

    def assign_date(self, offsets: UtcOffsets) -> bool:
        """Date the mission if possible; returns whether its times are final. Raises OSError.

        Until the clock is set, records have the time of the boot clock. The mission is held until then, because the date of a run
        or a key cannot be changed later. The offset is then written once, and readers of the journal add it.
        """
        if not self.is_undated():
            return True
        start = first(self.journal)
        offset_ns = offsets.of(str(start.get('boot_id')), int(start['t']))
        if offset_ns is not None:
            self.set_clock_offset_ns(offset_ns)
        return offset_ns is not None

    def sent(self) -> MissionSent:
        """How far the mission is sent; all zero if the file is missing or unreadable, because sending again is harmless."""
        found = read_json(self.path / 'sent.json')
        try:
            return MissionSent(**found)
        except TypeError:
            return MissionSent()

    def age_s(self) -> float:
        """Time since anything was last sent. Raises OSError if nothing was."""
        return time.time() - (self.path / 'sent.json').stat().st_mtime

    def set_sent(self, sent: MissionSent, *, durable: bool = False) -> None:
        write_json(self.path / 'sent.json', asdict(sent), durable=durable)


def missions(home: Path) -> Iterator[MissionFolder]:
    """All missions of a home, by name, so that the newest of a type comes last. Raises OSError, but not for a missing folder."""
    try:
        names = sorted(entry.name for entry in os.scandir(home / MISSIONS) if entry.is_dir() and not entry.name.startswith('.'))
    except FileNotFoundError:
        return
    yield from (MissionFolder(home / MISSIONS / name) for name in names)


def safe_type(mission_type: str) -> str:
    """The mission type for keys and file names: unchanged if valid, otherwise with invalid characters replaced.

    Two types may get the same name. Everywhere else a type keeps the spelling that the agent passed.
    """
    try:
        return check_name(mission_type, 'the mission type')
    except NameRefused:
        return _UNSAFE.sub('_', mission_type).strip('_.-')[:MAX_NAME_BYTES].replace('..', '_') or 'mission'


def timestamped_name(mission_type: str, start_ns: int) -> str:
    """``<mission type>_YYYYMMDD_HHMMSS`` (UTC), for keys and file names."""
    return run_name(safe_type(mission_type), start_ns)


def run_name(mission_type: str, start_ns: int) -> str:
    """The run's name in MLflow: like ``timestamped_name``, but with the type as the agent spelled it."""
    return f'{mission_type or "mission"}_{utc(start_ns):%Y%m%d_%H%M%S}'


def new_folder(home: Path, mission_type: str, start_ns: int) -> MissionFolder:
    """Create the folder of a new mission, readable only by its owner. Raises OSError."""
    (home / MISSIONS).mkdir(mode=0o700, parents=True, exist_ok=True)
    while True:
        folder = MissionFolder(home / MISSIONS / f'{timestamped_name(mission_type, start_ns)}_{secrets.token_hex(UNIQUE_BYTES)}')
        try:
            folder.path.mkdir(mode=0o700)
        except FileExistsError:
            continue
        folder.files.mkdir(mode=0o700)
        return folder


def read_json(path: Path) -> dict[str, Any]:
    """Empty if the file is missing or incomplete."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_json(path: Path, content: Mapping[str, Any], *, durable: bool = False) -> None:
    """Replace a file atomically: a reader sees the old or the new content. Raises OSError."""
    with replacing(path, is_synced=durable, mode=0o600) as file:
        file.write(json.dumps(content, indent=1).encode())
