"""What a mission's journal tells as a whole: its first and last values, its counts, and what the run ends with.

The records of a journal, by their ``k``: ``start`` (type, command, robot), ``metrics`` (m: key -> value, s: step), ``frame``,
``trajectory`` and ``artifact`` (file: a copy in files/), ``event``, ``refused`` (reason), ``end`` (status, what the agent
stated), and of the node ``poses``. Every record has ``t``, ns since 1970 UTC.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.clock import SECOND, iso, utc
from shadowhound_data_logger.missions.values import MAX_PARAM

MS: Final = 1_000_000
BATTERY, TEMPERATURE, DISTANCE, FRAMES = 'battery_pct', 'temperature_c', 'distance_traveled_m', 'camera_frames'
KILLED, FAILED, FINISHED = 'KILLED', 'FAILED', 'FINISHED'
MOST_ERRORS: Final = 20
BUCKET: Final = 'sensor-data'
TRAJECTORIES: Final = 'trajectories'


class Point(NamedTuple):
    """One metric point."""

    key: str
    value: float
    time_ms: int
    step: int


@dataclass(slots=True)
class Story:
    """A fold over the records, in their order; the same journal always gives the same story."""

    start: Mapping[str, Any] = field(default_factory=dict)
    end: Mapping[str, Any] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    errors: list[dict[str, Any]] = field(default_factory=list)
    first: dict[str, float] = field(default_factory=dict)
    last: dict[str, float] = field(default_factory=dict)
    steps: dict[str, int] = field(default_factory=dict)
    """The greatest step of each key: MLflow takes the point of the greatest step for the newest."""
    last_ns: int = 0
    node: Story | None = None
    """What the node measured beside the agent; where both state the same, the agent's stands."""

    def add(self, record: Mapping[str, Any] | None) -> list[Point]:
        """Take the next record (None: a damaged one); returns the metric points it stands for."""
        if record is None:
            self.counts['damaged'] += 1
            return []
        kind, time_ns = str(record.get('k')), int(record.get('t', 0))
        self.counts[kind] += 1
        self.last_ns = max(self.last_ns, time_ns)
        if kind == 'start':
            self.start = record
            return [Point(DISTANCE, 0.0, time_ns // MS, 0)]  # so that every run has one, whatever becomes of it
        if kind == 'metrics':
            step = int(record['s'])
            for key, value in record['m'].items():
                self._note(key, value, step)
            self.counts['points'] += len(record['m'])
            return [Point(key, value, time_ns // MS, step) for key, value in record['m'].items()]
        if kind == 'frame':
            number = int(record['id'])
            return [Point(f'camera_frame_{number}', 1.0, time_ns // MS, max(number, 0)),
                    Point(FRAMES, float(self.counts['frame']), time_ns // MS, self.counts['frame'])]  # fmt: skip
        if kind == 'refused':
            self.refused[str(record['reason'])] += 1
        elif kind == 'event' and record.get('name') in {'error', 'exception'}:
            self.errors = [*self.errors, {'time': iso(time_ns), **record.get('data', {})}][:MOST_ERRORS]
        elif kind == 'end':
            self.end = record
            return self._final(time_ns // MS)
        return []

    @property
    def battery_consumed_pct(self) -> float | None:
        """First minus last; None where nobody said."""
        if BATTERY in self.first:
            return self.first[BATTERY] - self.last[BATTERY]
        return self.node.battery_consumed_pct if self.node else None

    @property
    def distance_m(self) -> float | None:
        """What the agent states when it is positive, else what was measured, else what it states (0, say)."""
        stated = self.end.get('distance_m')
        return stated if stated is not None and stated > 0 else self.newest.get(DISTANCE) or stated

    @property
    def newest(self) -> dict[str, float]:
        """The last value of each metric, the agent's where it logged any."""
        return {**(self.node.last if self.node else {}), **self.last}

    @property
    def duration_s(self) -> float:
        """What the agent states when it is positive, else the time from start to end."""
        stated = self.end.get('duration_s')
        return float(stated) if stated is not None and stated > 0 else self.measured_s

    @property
    def measured_s(self) -> float:
        return max(0, int(self.end.get('t', self.last_ns)) - int(self.start.get('t', 0))) / SECOND

    @property
    def has_trajectory(self) -> bool:
        return bool(self.counts['trajectory'] or (self.node and self.node.counts['poses']))

    @property
    def frames(self) -> int:
        """Of agent and node."""
        return self.counts['frame'] + (self.node.counts['frame'] if self.node else 0)

    @property
    def success(self) -> bool:
        return bool(self.end.get('success'))

    def params(self) -> dict[str, str]:
        """What the run begins with."""
        return {
            'mission_type': self.start['type'][:MAX_PARAM],
            'mission_command': self.start['command'][:MAX_PARAM],
            'robot': self.start['robot'],
            'timestamp': utc(int(self.start['t'])).isoformat(),
        }

    def final_params(self) -> dict[str, str]:
        return {'duration_s': f'{self.duration_s:.3f}'}

    def _note(self, key: str, value: float, step: int) -> None:
        self.first.setdefault(key, value)
        self.last[key] = value
        self.steps[key] = max(step, self.steps.get(key, 0))

    def _final(self, time_ms: int) -> list[Point]:
        points = [Point('success', float(self.success), time_ms, 0), Point('duration_s', self.duration_s, time_ms, 0)]
        if self.distance_m is not None:
            points += [Point('distance_m', self.distance_m, time_ms, 0),
                       Point(DISTANCE, self.distance_m, time_ms, self._next_step(DISTANCE))]  # fmt: skip
        if self.battery_consumed_pct is not None:
            points.append(Point('battery_consumed_pct', self.battery_consumed_pct, time_ms, 0))
        if self.node and self.node.counts['frame'] and self.counts['frame']:
            points.append(Point(FRAMES, float(self.frames), time_ms, max(self.counts['frame'], self.node.counts['frame']) + 1))
        both = set(self.last).intersection(self.node.last if self.node else ()) - {DISTANCE}
        return points + [Point(key, self.last[key], time_ms, self._next_step(key)) for key in sorted(both)]

    def _next_step(self, key: str) -> int:
        """Beyond those of agent and node, for what shall be the newest."""
        return max(self.steps.get(key, 0), self.node.steps.get(key, 0) if self.node else 0) + 1
