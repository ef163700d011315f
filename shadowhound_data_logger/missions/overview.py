"""The state of missions and how far they are sent, read from their folders, without MLflow and ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.dataclass_json import as_plain, fields_of, parse
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MissionFolder, MissionSent, missions, read_json
from shadowhound_data_logger.missions.state import MissionState, Point

NO_DATE: Final = 'the clock of this machine was not set when the mission started: it is sent once the clock is set'
REMEDY: Final = 'check with `timedatectl` that this machine reaches a time server'

ACTIVE, UNFINISHED = 'active', 'unfinished'
"""Results of missions without an end: the agent is running; or it was killed, and no sender has closed the mission yet."""
FILES: Final = frozenset({'frame', 'trajectory', 'artifact'})
"""Kinds of records that have a file."""
STATE: Final = 'replay.json'
"""Next to the missions: the state of the sender."""
LOCK: Final = 'replay.lock'
"""Next to the missions: its owner sends them."""


@dataclass(frozen=True, slots=True)
class MissionBrief:
    """A mission in a list; the field names are those of ``missions list --json``."""

    mission_id: str
    run_id: str | None
    type: str
    command: str
    robot: str
    started: str
    ended: str | None
    duration_s: float
    result: str
    """``FINISHED``, ``FAILED``, ``KILLED``, ``active`` or ``unfinished``."""
    errors: tuple[Any, ...]
    distance_m: float | None
    battery_consumed_pct: float | None
    complete: bool
    """Whether it is completely sent."""
    unsent: Mapping[str, int]
    """``records`` not yet in the run, ``artifacts`` not yet attached to it, ``objects`` not yet in the spool."""
    refused_by_server: int
    last_error: str
    remedy: str
    folder: str


@dataclass(frozen=True, slots=True)
class MissionOverview(MissionBrief):
    """Everything about a mission, as ``missions show --json`` prints it."""

    policies: str | None
    last: Mapping[str, float]
    """The last value of each metric."""
    counts: Mapping[str, int]
    refused: Mapping[str, int]
    """How often data could not be logged, by reason."""


def overviews(home: Path) -> list[MissionBrief]:
    """All missions of a home, in order of their start. Raises OSError."""
    found = [_summarized(folder) or _brief(folder, state_of(folder)) for folder in missions(home)]
    return sorted((each for each in found if each is not None), key=lambda each: each.started)


def find(home: Path, wanted: str) -> list[MissionFolder]:
    """The missions whose mission id or run id starts with ``wanted``; only the exact match if there is one. Raises OSError."""
    names = {folder: (folder.mission_id, run.run_id if (run := folder.run()) else '') for folder in missions(home)}
    exact = [folder for folder, ids in names.items() if wanted in ids]
    return exact or [folder for folder, ids in names.items() if any(name.startswith(wanted) for name in ids)]


def overview(folder: MissionFolder) -> MissionOverview | None:
    """Everything about a mission; None for a folder without a first record. Raises OSError."""
    state = state_of(folder)
    brief = _brief(folder, state)
    if brief is None:
        return None
    return MissionOverview(
        **fields_of(brief), policies=state.policy_names or None, last=dict(sorted(state.newest.items())), counts=_counts(state),
        refused=dict(state.refused),
    )  # fmt: skip


def _brief(folder: MissionFolder, state: MissionState) -> MissionBrief | None:
    if not state.start:
        return None
    sent, run, far = folder.sent(), folder.run(), report(folder)
    return MissionBrief(
        mission_id=folder.mission_id, run_id=run.run_id if run else None, type=state.start['type'],
        command=state.start['command'], robot=state.start['robot'], started=iso(int(state.start['t'])),
        ended=iso(int(state.end['t'])) if state.end else None, duration_s=round(state.duration_s, 3),
        result=state.end.get('status') or (ACTIVE if _is_locked(folder) else UNFINISHED),
        errors=(*state.errors, *([state.end['error']] if state.end.get('error') else [])),
        distance_m=state.distance_m, battery_consumed_pct=state.battery_consumed_pct,
        complete=sent.complete, unsent=_unsent(folder, sent), refused_by_server=sent.refused,
        last_error=far.last_error, remedy=far.remedy, folder=str(folder.path),
    )  # fmt: skip


def _summarized(folder: MissionFolder) -> MissionBrief | None:
    """Reads the summary, because a journal may be long; None for a mission that is not completely sent."""
    sent, summary = folder.sent(), read_json(folder.summary)
    if not sent.complete:
        return None
    try:
        return parse(MissionBrief, {
            **summary, 'type': summary['mission_type'], 'command': summary['mission_command'], 'started': summary['start'],
            'ended': summary['end'], 'complete': True, 'unsent': _unsent(folder, sent), 'refused_by_server': sent.refused,
            'last_error': sent.error, 'remedy': '', 'folder': str(folder.path),
        })  # fmt: skip
    except (KeyError, ValueError):
        return None


def state_of(folder: MissionFolder) -> MissionState:
    """The state of a mission, computed from both journals."""
    state = MissionState(node=MissionState())
    for source, record in records(folder):
        (state if source == 'agent' else state.node or state).add(record)
    return state


def records(folder: MissionFolder) -> Iterator[tuple[str, Mapping[str, Any] | None]]:
    """The records of both journals with their source, ``node`` or ``agent``; the agent's last, because its end uses both."""
    for source, lines in (('node', folder.node_lines), ('agent', folder.lines)):
        if source == 'node' or folder.journal.exists():
            yield from ((source, line.record) for line in lines())


def export(folder: MissionFolder) -> dict[str, Any]:
    """Everything that was logged: parameters, all metric points with their source (``agent`` or ``node``), and events."""
    state = MissionState(node=MissionState())
    points: list[dict[str, Any]] = []
    events: list[dict[str, Any]] = []
    for source, record in records(folder):
        found: list[Point] = (state if source == 'agent' else state.node or state).add(record)
        points += [{**point._asdict(), 'source': source} for point in found]
        if record and record.get('k') == 'event':
            events.append({'time': iso(int(record['t'])), 'name': record['name'], 'data': record['data']})
    points.sort(key=lambda point: point['time_ms'])
    params = state.params() | (state.final_params() if state.end else {}) if state.start else {}
    return {'mission': as_plain(overview(folder)), 'params': params, 'points': points, 'events': events,
            'summary': read_json(folder.summary) or None}  # fmt: skip


def _counts(state: MissionState) -> dict[str, int]:
    node = state.node.counts if state.node else state.counts
    return {
        'metric_points': state.counts['points'] + node['points'], 'camera_frames': state.frames,
        'trajectories': state.counts['trajectory'] or int(node['poses'] > 0),
        'artifacts': state.counts['artifact'], 'events': state.counts['event'],
    }  # fmt: skip


def _unsent(folder: MissionFolder, sent: MissionSent) -> dict[str, int]:
    """The records not yet in the run, and the files not yet among its artifacts or not yet in the spool."""
    count = {'records': 0, 'artifacts': 0, 'objects': 0}
    if sent.complete:
        return count
    for path, place in ((folder.journal, sent), (folder.node.journal, folder.node.sent())):
        for line in journal.read(path) if path.exists() else ():
            record = line.record or {}
            kind = record.get('k')
            count['records'] += line.end > place.metrics
            count['artifacts'] += (
                kind in FILES and (kind != 'frame' or bool(record.get('artifact'))) and line.end > place.artifacts
            )
            count['objects'] += kind in FILES - {'artifact'} and line.end > place.objects
    return count


def _is_locked(folder: MissionFolder) -> bool:
    try:
        return journal.is_locked(folder.journal)
    except FileNotFoundError:
        return False


@dataclass(frozen=True, slots=True)
class Report:
    """How far one mission is sent, as ``flush`` and ``close`` return it."""

    mission_id: str
    """Empty if the logger has not started a mission."""
    run_id: str | None
    """The id of the MLflow run; None until it is created."""
    sent: int
    """Records of the agent and of the node that are in the run."""
    unsent: int
    """Records that are not in the run yet."""
    complete: bool
    """Whether everything has arrived: metrics and artifacts in the run, objects in the spool."""
    missing: int = 0
    """Frames and trajectories whose file was deleted before it was spooled."""
    last_error: str = ''
    """What delays the mission now, otherwise the last refusal; empty if there is none."""
    remedy: str = ''
    """What to do about it."""
    refused: int = 0
    """Points, params and tags that the tracking server refused permanently."""
    unattached: int = 0
    """Artifacts that the server refused permanently, or whose file was deleted."""
    waiting_for: str = ''
    """What an incomplete mission still waits for."""


def report(folder: MissionFolder) -> Report:
    """How far a mission is sent. Reads both journals completely."""
    sent, run = folder.sent(), folder.run()
    count, unsent = map(sum, zip(_counted(folder.journal, sent), _counted(folder.node.journal, folder.node.sent()), strict=True))
    error, remedy = (NO_DATE, REMEDY) if folder.journal.exists() and folder.is_undated() else ('', '')
    waiting_for, wait_remedy = ('', '') if sent.complete else _waiting_for(folder, unsent)
    if not sent.complete and not error:
        error, remedy = next(iter(errors(folder.path.parent).values()), ('', ''))
    run_id = run.run_id if run else None
    return Report(
        folder.mission_id, run_id, count - unsent, unsent, sent.complete, sent.missing, last_error=error or sent.error,
        remedy=remedy or wait_remedy, refused=sent.refused, unattached=sent.unattached, waiting_for=waiting_for,
    )  # fmt: skip


def _waiting_for(folder: MissionFolder, unsent: int) -> tuple[str, str]:
    """What an incomplete mission waits for, and the remedy."""
    sent, node = folder.sent(), folder.node.sent()
    if not folder.journal.exists():
        return 'its journal, which is missing', 'check whether the folder of the mission was deleted'
    if _is_locked(folder):
        return 'its end: the mission is active', ''
    if not is_sending(folder.path.parent):
        return 'a sender', 'if none starts, run `shadowhound-data missions resume`'
    left = [f'{unsent} records to be in its run'] if unsent else []
    if _is_locked(folder.node):
        return ', '.join([*left, 'the node to finish its part']), 'this takes a second, at most 30 s; check that the node runs'
    files = _unsent(folder, sent)
    left += [f'{files["artifacts"]} artifacts to be in its run'] if files['artifacts'] else []
    left += [f'{files["objects"]} objects to be in the spool'] if files['objects'] else []
    if sent.metrics > sent.artifacts and not folder.summary.exists() and not unsent:
        left.append('its pictures and its summary, which are being created')
    elif not left and max(sent.metrics, node.metrics) > min(sent.artifacts, sent.objects):
        left.append('its last artifacts and its summary')
    if sent.held:
        left.append('its objects to get their final keys')
    return ', '.join(left) or 'its run to be closed', 'wait longer, with close(seconds); the sender continues in the background'


def _counted(path: Path, sent: MissionSent) -> tuple[int, int]:
    """The number of records in a journal, and of those that are not in the run yet."""
    try:
        ends = [line.end for line in journal.read(path)]
    except FileNotFoundError:
        ends = []
    return len(ends), sum(end > sent.metrics for end in ends)


def sizes(folder: MissionFolder) -> tuple[int, int]:
    """The sizes of the journals of agent and node; 0 if missing."""
    return _size(folder.journal), _size(folder.node.journal)


def has_arrived(folder: MissionFolder, sizes_: tuple[int, int] | None) -> bool:
    """Whether the journals are sent up to these sizes; if None, whether an ended mission has arrived completely."""
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
    """Whether a sender of this folder is running."""
    try:
        return journal.is_locked(missions / LOCK)
    except OSError:
        return False


def errors(missions: Path) -> dict[str, tuple[str, str]]:
    """The errors that delay the sender of this folder now: receiver -> (error, remedy)."""
    found = read_json(missions / STATE).get('errors')
    if not isinstance(found, dict):
        return {}
    return {name: (str(one.get('error', '')), str(one.get('remedy', ''))) for name, one in found.items() if isinstance(one, dict)}
