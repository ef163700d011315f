"""The state of a mission, computed from its journals: first and last values, counts, and the values of its run and summary.

The kinds of records of a journal (``k``): ``start`` (type, command, robot, policy), ``metrics`` (m: key -> value, s: step),
``frame``, ``trajectory`` and ``artifact`` (file: a copy in files/), ``event``, ``policy`` (active from then on; null for none),
``refused`` (reason), ``end`` (status, the agent's values, elapsed_s: the duration by a clock that never steps), and ``poses``
(only the node). Every record has ``t``, ns since 1970 UTC. ``summary_of`` computes ``summary.json``, which is identical in the
run, in the store and in the mission's folder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND, iso, utc
from shadowhound_data_logger.missions.folder import MissionSent, Run, run_name, timestamped_name
from shadowhound_data_logger.missions.values import MAX_PARAM, MAX_STEP

MS: Final = 1_000_000
BATTERY, TEMPERATURE, DISTANCE, FRAMES = 'battery_pct', 'temperature_c', 'distance_traveled_m', 'camera_frames'
KILLED, FAILED, FINISHED = 'KILLED', 'FAILED', 'FINISHED'
MAX_ERRORS: Final = 20
MAX_EVENTS: Final = 200
MAX_EVENT_CHARACTERS: Final = 2000
"""Longest event in the summary; the run's ``events.jsonl`` also has longer ones."""
MAX_POLICIES: Final = 100
MAX_RENAMED: Final = 1000
BUCKET: Final = 'sensor-data'
TRAJECTORIES: Final = 'trajectories'


class Point(NamedTuple):
    """One metric point."""

    key: str
    value: float
    time_ms: int
    step: int


@dataclass(slots=True)
class MissionState:
    """The state of a mission: a pure function of its journal's records, added in order."""

    start: Mapping[str, Any] = field(default_factory=dict)
    end: Mapping[str, Any] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    errors: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    renamed: dict[str, str] = field(default_factory=dict)
    """Artifacts whose names MLflow does not accept: path in the run -> path that the agent passed."""
    policies: list[tuple[str | None, int]] = field(default_factory=list)
    """The active policies in order, each with the time from which it was active; None if no policy was active."""
    first: dict[str, float] = field(default_factory=dict)
    last: dict[str, float] = field(default_factory=dict)
    latest: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Step and time (ms) of the point that MLflow shows for each key: the one with the highest step, then the latest time."""
    last_ns: int = 0
    node: MissionState | None = None
    """The state of the node's journal; if both have a value, the agent's is used."""

    def add(self, record: Mapping[str, Any] | None) -> list[Point]:
        """Add the next record (None: a damaged one); returns its metric points."""
        if record is None:
            self.counts['damaged'] += 1
            return []
        kind, time_ns = str(record.get('k')), int(record.get('t', 0))
        self.counts[kind] += 1
        self.last_ns = max(self.last_ns, time_ns)
        if kind == 'start':
            self.start = record
            self.policies = [(record.get('policy'), time_ns)]
            self._update_latest(DISTANCE, 0, time_ns)
            return [Point(DISTANCE, 0.0, time_ns // MS, 0)]  # so that every run has one, however it ends
        if kind == 'metrics':
            step = int(record['s'])
            for key, value in record['m'].items():
                self.first.setdefault(key, value)
                self.last[key] = value
                self._update_latest(key, step, time_ns)
            self.counts['points'] += len(record['m'])
            return [Point(key, value, time_ns // MS, step) for key, value in record['m'].items()]
        if kind == 'frame':
            number = int(record['id'])
            self._update_latest(FRAMES, self.counts['frame'], time_ns)
            return [Point(f'camera_frame_{number}', 1.0, time_ns // MS, max(number, 0)),
                    Point(FRAMES, float(self.counts['frame']), time_ns // MS, self.counts['frame'])]  # fmt: skip
        if kind == 'event':
            self._keep_event(record, time_ns)
        if kind == 'policy' and len(self.policies) < MAX_POLICIES:
            self.policies.append((record.get('policy'), time_ns))
        if kind == 'artifact' and 'given' in record and len(self.renamed) < MAX_RENAMED:
            self.renamed['/'.join(filter(None, (record['folder'], record['name'])))] = record['given']
        if kind == 'refused':
            self.refused[str(record['reason'])] += 1
        elif kind == 'event' and record.get('name') in {'error', 'exception'}:
            self.errors = [*self.errors, {'time': iso(time_ns), **record.get('data', {})}][:MAX_ERRORS]
        elif kind == 'end':
            self.end = record
            return self._final(time_ns // MS)
        return []

    @property
    def battery_consumed_pct(self) -> float | None:
        """The first minus the last battery charge; None if unknown."""
        if BATTERY in self.first:
            return self.first[BATTERY] - self.last[BATTERY]
        return self.node.battery_consumed_pct if self.node else None

    @property
    def distance_m(self) -> float | None:
        """The distance that the agent stated at the end if positive, otherwise logged, otherwise measured by the node."""
        stated = self.end.get('distance_m')
        return stated if stated is not None and stated > 0 else self.last.get('distance_m') or self.newest.get(DISTANCE) or stated

    @property
    def newest(self) -> dict[str, float]:
        """The last value of each metric; if both logged it, the agent's."""
        return {**(self.node.last if self.node else {}), **self.last}

    @property
    def duration_s(self) -> float:
        """The duration that the agent stated at the end if positive, otherwise logged, otherwise measured."""
        stated = self.end.get('duration_s')
        return float(stated) if stated is not None and stated > 0 else self.last.get('duration_s') or self.measured_s

    @property
    def measured_s(self) -> float:
        """The time from start to end by a clock that never steps; for a killed agent, by the times of its records."""
        elapsed_s = self.end.get('elapsed_s')
        if elapsed_s is not None:
            return float(elapsed_s)
        return max(0, int(self.end.get('t', self.last_ns)) - int(self.start.get('t', 0))) / SECOND

    @property
    def has_trajectory(self) -> bool:
        return bool(self.counts['trajectory'] or (self.node and self.node.counts['poses']))

    @property
    def frames(self) -> int:
        """The number of frames of agent and node."""
        return self.counts['frame'] + (self.node.counts['frame'] if self.node else 0)

    @property
    def success(self) -> bool:
        return bool(self.end.get('success'))

    @property
    def policy_names(self) -> str:
        """All policies in order; empty if none was ever active."""
        return policy_list(name for name, _ in self.policies)

    def params(self) -> dict[str, str]:
        """The parameters that the run gets at its start."""
        return {
            'mission_type': self.start['type'],
            'mission_command': self.start['command'][:MAX_PARAM],
            'robot': self.start['robot'],
            'timestamp': utc(int(self.start['t'])).isoformat(),
            **({'policy': self.start['policy']} if 'policy' in self.start else {}),
        }

    def final_params(self) -> dict[str, str]:
        """The parameters that the run gets at its end."""
        changed = {'policies': self.policy_names[:MAX_PARAM]} if len(self.policies) > 1 else {}
        return {'duration_s': f'{self.duration_s:.3f}', **changed}

    def _keep_event(self, record: Mapping[str, Any], time_ns: int) -> None:
        """Keep the first events, if short, for the summary."""
        event = {'time': iso(time_ns), 'name': record.get('name'), **record.get('data', {})}
        if len(self.events) < MAX_EVENTS and len(str(event)) <= MAX_EVENT_CHARACTERS:
            self.events.append(event)

    def _update_latest(self, key: str, step: int, time_ns: int) -> None:
        self.latest[key] = max((step, time_ns // MS), self.latest.get(key, (-MAX_STEP, 0)))

    def _final(self, time_ms: int) -> list[Point]:
        """Points that make MLflow show the values of ``summary.json`` for an ended run."""
        stated: dict[str, float | None] = {
            'success': float(self.success), 'duration_s': self.duration_s, 'distance_m': self.distance_m,
            DISTANCE: self.distance_m, 'battery_consumed_pct': self.battery_consumed_pct,
        }  # fmt: skip
        if self.node and self.node.counts['frame'] and self.counts['frame']:
            stated[FRAMES] = float(self.frames)
        both = set(self.last).intersection(self.node.last if self.node else ()) - set(stated)
        stated |= {key: self.last[key] for key in sorted(both)}
        return [self._newest(key, value, time_ms) for key, value in stated.items() if value is not None]

    def _newest(self, key: str, value: float, time_ms: int) -> Point:
        """A point that MLflow shows instead of all points that agent and node have logged under this key."""
        logged = [state.latest[key] for state in (self, self.node) if state is not None and key in state.latest]
        step, last_ms = max(logged, default=(-1, 0))
        if step < MAX_STEP:
            return Point(key, value, time_ms, max(step + 1, 0))
        return Point(key, value, max(time_ms, last_ms + 1), MAX_STEP)


def run_request(start: Mapping[str, Any]) -> tuple[str, int, dict[str, str]]:
    """Name, start (ms) and tags of a mission's run, from the first record of its journal."""
    tags = {'mlflow.user': start['robot'], 'mlflow.source.name': 'shadowhound_data_logger'}
    return run_name(start['type'], int(start['t'])), int(start['t']) // MS, tags


def policy_list(policies: Iterable[str | None]) -> str:
    """``go2_patrol@7#..., none, go2_patrol@6#...``; empty if none was ever active."""
    names = [*policies]
    return ', '.join(name or 'none' for name in names) if any(names) else ''


def summary_of(state: MissionState, mission_id: str, run: Run, sent: MissionSent, pictures: Mapping[str, str]) -> dict[str, Any]:
    """The content of ``summary.json``, computed after the mission's points and files were sent."""
    start, end = state.start, state.end
    node = state.node or MissionState()
    return {
        'mission_id': mission_id, 'run_id': run.run_id, 'run_name': run_name(start['type'], int(start['t'])),
        'robot': start['robot'], 'mission_type': start['type'], 'mission_command': start['command'],
        'policy': start.get('policy'), 'policies': state.policy_names or None,
        'policy_changes': [{'policy': name, 'time': iso(time_ns)} for name, time_ns in state.policies[1:]],
        'start': iso(int(start['t'])), 'end': iso(int(end['t'])), 'start_ns': int(start['t']), 'end_ns': int(end['t']),
        'result': end['status'], 'success': state.success, 'ended_by': end.get('by', 'agent'),
        'errors': [*state.errors, *([end['error']] if end.get('error') else [])],
        'events': state.events,
        'distance_m': state.distance_m, 'duration_s': state.duration_s, 'battery_consumed_pct': state.battery_consumed_pct,
        'stated': {name: end.get(name) for name in ('success', 'distance_m', 'duration_s')},
        'measured': {'distance_m': state.newest.get(DISTANCE), 'duration_s': state.measured_s},
        'by_node': dict(sorted(node.last.items())),
        'last': dict(sorted(state.newest.items())),
        'counts': {
            'metric_points': state.counts['points'], 'camera_frames': state.frames,
            'trajectories': state.counts['trajectory'], 'artifacts': state.counts['artifact'], 'events': state.counts['event'],
        },
        'ledger': _ledger(state, sent),
        'renamed_artifacts': dict(state.renamed),
        'pictures': dict(pictures),
        'data': _places(state, run),
    }  # fmt: skip


def _ledger(state: MissionState, sent: MissionSent) -> dict[str, Any]:
    """Accounts for everything that the agent logged: each ``logged`` is the sum of the values after it.

    ``not_logged`` counts the calls that could not be logged, by reason; ``disk_full`` is null (unknown) if the agent was killed.
    """
    points, files = state.counts['points'], state.counts['frame'] + state.counts['trajectory']
    refused, missing = min(points, sent.refused), min(files, sent.missing)
    return {
        'metric_points': {'logged': points, 'in_run': points - refused, 'refused_by_server': refused},
        'files': {'logged': files, 'spooled': files - missing, 'missing': missing},
        'not_logged': {**state.refused, 'disk_full': state.end.get('lost')},
        'damaged_records': state.counts['damaged'],
    }


def _places(state: MissionState, run: Run) -> dict[str, Any]:
    """Buckets and prefixes of the mission's data. The node's objects of that time have the mission's id in their metadata."""
    robot, start, end = state.start['robot'], utc(int(state.start['t'])), utc(int(state.end['t']))
    name = timestamped_name(state.start['type'], int(state.start['t']))
    return {
        'mission': f'{BUCKET}/{robot}/missions/{run.run_id}/',
        'trajectory': f'{TRAJECTORIES}/{robot}/{name}.csv' if state.has_trajectory else None,
        'sensors': {
            'prefix': f'{BUCKET}/{robot}/',
            'days': [f'{start + timedelta(days=day):%Y%m%d}' for day in range((end.date() - start.date()).days + 1)],
            'from': f'{start:%H%M%S}', 'to': f'{end:%H%M%S}',
        },
    }  # fmt: skip
