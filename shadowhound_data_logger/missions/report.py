"""How far missions have come, as anybody can read it from their folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.dating import REMEDY, WAITS, waits
from shadowhound_data_logger.missions.folder import MissionFolder, MissionSent, read_json

STATE: Final = 'replay.json'
"""Beside the missions: what the replayer says of itself."""
LOCK: Final = 'replay.lock'
"""Beside the missions: who holds it sends them."""


@dataclass(frozen=True, slots=True)
class Report:
    """How far one mission has come."""

    mission_id: str
    run_id: str | None
    sent: int
    """Records that the run has: the agent's, and the node's where one joined in."""
    unsent: int
    complete: bool
    """Whether everything has arrived: metrics and artifacts in the run, objects in the spool."""
    missing: int = 0
    """Frames and trajectories whose file was gone before it was handed on."""
    last_error: str = ''
    """What holds it up now, or was refused for ever; empty when nothing."""
    remedy: str = ''


def report(folder: MissionFolder) -> Report:
    """Reads the whole journals; they are there for as long as the mission is not complete."""
    sent, run = folder.sent(), folder.run()
    count, unsent = map(sum, zip(_count(folder.journal, sent), _count(folder.node.journal, folder.node.sent()), strict=True))
    error, remedy = (WAITS, REMEDY) if folder.journal.exists() and waits(folder) else (sent.error, '')
    if not sent.complete and not error:
        for one in errors(folder.path.parent).values():
            error, remedy = one
            break
    run_id = run.run_id if run else None
    return Report(folder.mission_id, run_id, count - unsent, unsent, sent.complete, sent.missing, error, remedy)


def _count(path: Path, sent: MissionSent) -> tuple[int, int]:
    """Records of a journal, and those that the run has not."""
    try:
        ends = [line.end for line in journal.read(path)]
    except FileNotFoundError:
        ends = []
    return len(ends), sum(end > sent.metrics for end in ends)


def sizes(folder: MissionFolder) -> tuple[int, int]:
    """How long the journals of agent and node are; 0 for one that is not there."""
    return _size(folder.journal), _size(folder.node.journal)


def has_arrived(folder: MissionFolder, sizes_: tuple[int, int] | None) -> bool:
    """Whether the journals are sent as far as they had come then; with None, whether a mission that is over has arrived whole."""
    if sizes_ is None:
        return folder.sent().complete
    places = (folder.sent(), folder.node.sent())
    return all(min(sent.metrics, sent.artifacts, sent.objects) >= size for sent, size in zip(places, sizes_, strict=True))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def is_sending(missions: Path) -> bool:
    """Whether a replayer of this folder runs."""
    try:
        return journal.is_locked(missions / LOCK)
    except OSError:
        return False


def errors(missions: Path) -> dict[str, tuple[str, str]]:
    """What holds the replayer of this folder up now: receiver -> (error, remedy)."""
    found = read_json(missions / STATE).get('errors')
    if not isinstance(found, dict):
        return {}
    return {name: (str(one.get('error', '')), str(one.get('remedy', ''))) for name, one in found.items() if isinstance(one, dict)}
