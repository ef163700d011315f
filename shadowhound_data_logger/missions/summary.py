"""``summary.json``: what a mission was, in one file, the same in the run, in the store and in the mission's folder."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from shadowhound_data_logger.clock import iso, utc
from shadowhound_data_logger.missions.folder import MissionSent, Run, stamped
from shadowhound_data_logger.missions.story import BUCKET, DISTANCE, TRAJECTORIES, Story


def summary_of(story: Story, mission_id: str, run: Run, sent: MissionSent, pictures: Mapping[str, str]) -> dict[str, Any]:
    """Of a mission that is over and whose points and files are handed on."""
    start, end = story.start, story.end
    node = story.node or Story()
    return {
        'mission_id': mission_id, 'run_id': run.run_id, 'run_name': stamped(start['type'], int(start['t'])),
        'robot': start['robot'], 'mission_type': start['type'], 'mission_command': start['command'],
        'start': iso(int(start['t'])), 'end': iso(int(end['t'])), 'start_ns': int(start['t']), 'end_ns': int(end['t']),
        'result': end['status'], 'success': story.success, 'ended_by': end.get('by', 'agent'),
        'errors': [*story.errors, *([end['error']] if end.get('error') else [])],
        'distance_m': story.distance_m, 'duration_s': story.duration_s, 'battery_consumed_pct': story.battery_consumed_pct,
        'stated': {name: end.get(name) for name in ('success', 'distance_m', 'duration_s')},
        'measured': {'distance_m': story.newest.get(DISTANCE), 'duration_s': story.measured_s},
        'by_node': dict(sorted(node.last.items())),
        'last': dict(sorted(story.newest.items())),
        'counts': {
            'metric_points': story.counts['points'], 'camera_frames': story.frames,
            'trajectories': story.counts['trajectory'], 'artifacts': story.counts['artifact'], 'events': story.counts['event'],
        },
        'ledger': _ledger(story, sent),
        'pictures': dict(pictures),
        'data': _places(story, run),
    }  # fmt: skip


def _ledger(story: Story, sent: MissionSent) -> dict[str, Any]:
    """What became of all that the agent logged: each ``logged`` is the sum of what follows it.

    ``not_logged`` is what could not be taken, by reason; ``disk_full`` is not known (null) of an agent that died.
    """
    points, files = story.counts['points'], story.counts['frame'] + story.counts['trajectory']
    refused, missing = min(points, sent.refused), min(files, sent.missing)
    return {
        'metric_points': {'logged': points, 'in_run': points - refused, 'refused_by_server': refused},
        'files': {'logged': files, 'spooled': files - missing, 'missing': missing},
        'not_logged': {**story.refused, 'disk_full': story.end.get('lost')},
        'damaged_records': story.counts['damaged'],
    }


def _places(story: Story, run: Run) -> dict[str, Any]:
    """Where its data are: buckets and prefixes; the node's objects of that time carry the mission's id as metadata."""
    robot, start, end = story.start['robot'], utc(int(story.start['t'])), utc(int(story.end['t']))
    name = stamped(story.start['type'], int(story.start['t']))
    return {
        'mission': f'{BUCKET}/{robot}/missions/{run.run_id}/',
        'trajectory': f'{TRAJECTORIES}/{robot}/{name}.csv' if story.has_trajectory else None,
        'sensors': {
            'prefix': f'{BUCKET}/{robot}/',
            'days': [f'{start + timedelta(days=day):%Y%m%d}' for day in range((end.date() - start.date()).days + 1)],
            'from': f'{start:%H%M%S}', 'to': f'{end:%H%M%S}',
        },
    }  # fmt: skip
