"""How far missions have come, as anybody can read it from their folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MissionFolder, read_json

STATE: Final = 'replay.json'
"""Beside the missions: what the replayer says of itself."""


@dataclass(frozen=True, slots=True)
class Report:
    """How far one mission has come."""

    mission_id: str
    run_id: str | None
    sent: int
    """Records of its journal that the run has."""
    unsent: int
    complete: bool
    """Whether everything has arrived: metrics and artifacts in the run, objects in the spool."""
    missing: int = 0
    """Frames and trajectories whose file was gone before it was handed on."""
    last_error: str = ''
    """What holds it up now, or was refused for ever; empty when nothing."""
    remedy: str = ''


def report(folder: MissionFolder) -> Report:
    """Reads the whole journal; it is there for as long as the mission is not complete."""
    sent, run = folder.sent(), folder.run()
    try:
        ends = [line.end for line in journal.read(folder.journal)]
    except FileNotFoundError:
        ends = []
    unsent = sum(end > sent.metrics for end in ends)
    error, remedy = sent.error, ''
    if not sent.complete and not error:
        for one in errors(folder.path.parent).values():
            error, remedy = one
            break
    run_id = run.run_id if run else None
    return Report(folder.mission_id, run_id, len(ends) - unsent, unsent, sent.complete, sent.missing, error, remedy)


def has_arrived(folder: MissionFolder, *, is_active: bool) -> bool:
    """Whether everything is sent that can be: of an active mission, what was journalled so far."""
    sent = folder.sent()
    if not is_active:
        return sent.complete
    try:
        size = folder.journal.stat().st_size
    except FileNotFoundError:
        return True
    return min(sent.metrics, sent.artifacts, sent.objects) >= size


def errors(missions: Path) -> dict[str, tuple[str, str]]:
    """What holds the replayer of this folder up now: receiver -> (error, remedy)."""
    found = read_json(missions / STATE).get('errors')
    if not isinstance(found, dict):
        return {}
    return {name: (str(one.get('error', '')), str(one.get('remedy', ''))) for name, one in found.items() if isinstance(one, dict)}
