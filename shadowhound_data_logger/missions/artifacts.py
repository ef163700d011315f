"""The artifacts of a mission's run, and their names.

trajectories/trajectory.csv   camera/frame_NNNNNN.jpg (a sample)   the files that the agent passed to log_artifact
summary.json   camera_summary.jpg   trajectory.png   battery.png   events.jsonl   mission_command.txt
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.pictures import NAMES
from shadowhound_data_logger.missions.state import MissionState
from shadowhound_data_logger.missions.values import MAX_PARAM


class Artifact(NamedTuple):
    """A file in the mission's folder, and its name among the run's artifacts."""

    path: Path
    name: str
    folder: str = ''


def artifacts_of(record: Mapping[str, Any], folder: MissionFolder, state: MissionState) -> Iterator[Artifact]:
    """The artifacts of one record of the journal, in sending order, the summary last. Raises OSError."""
    kind, files = record.get('k'), folder.files
    if kind == 'start' and len(record['command']) > MAX_PARAM:
        path = files / 'command'
        path.write_text(record['command'], encoding='utf-8')
        yield Artifact(path, 'mission_command.txt')
    elif kind == 'frame' and record.get('artifact'):
        yield Artifact(files / record['file'], f'frame_{record["id"]:06d}.jpg', 'camera')
    elif kind == 'trajectory':
        yield Artifact(files / record['file'], 'trajectory.csv', 'trajectories')
    elif kind == 'artifact':
        yield Artifact(files / record['file'], record['name'], record['folder'])
    elif kind == 'end':
        if state.counts['event']:
            yield Artifact(_write_events(folder), 'events.jsonl')
        if folder.trajectory.exists():
            yield Artifact(folder.trajectory, 'trajectory.csv', 'trajectories')
        yield from (Artifact(folder.files / name, name) for name in NAMES if (folder.files / name).exists())
        yield Artifact(folder.summary, 'summary.json')


def staged_file(folder: MissionFolder, artifact: Artifact) -> Path:
    """A link to the file with the artifact's name, because MLflow uploads a file under its own name.

    Raises FileNotFoundError if the file was deleted.
    """
    staging = folder.files / 'sending'
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(mode=0o700)
    try:
        os.link(artifact.path, staging / artifact.name)
    except FileNotFoundError:
        raise
    except OSError:  # a file system without hard links
        shutil.copyfile(artifact.path, staging / artifact.name)
    return staging / artifact.name


def _write_events(folder: MissionFolder) -> Path:
    """All events of the mission, one per line."""
    path = folder.files / 'events'
    with path.open('w', encoding='utf-8') as file:
        for line in folder.lines():
            if line.record and line.record.get('k') == 'event':
                file.write(json.dumps({name: line.record[name] for name in ('t', 'name', 'data')}) + '\n')
    return path
