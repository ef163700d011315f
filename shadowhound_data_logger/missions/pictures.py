"""The pictures of a mission that has ended, made from its folder by a child process of the sender.

    camera_summary.jpg   trajectory.png   battery.png

``python -m shadowhound_data_logger.missions.pictures FOLDER TITLE`` writes them to files/, and then pictures.json: each name with
'' or a note about it. A picture that cannot be made does not affect the others. matplotlib's second and 60 MB, and whatever a
hostile file does to a decoder, stay in that process: the sender continues with other missions and polls it.
"""

from __future__ import annotations

import csv
import logging
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.untrusted import check_commas, csv_encoding
from shadowhound_data_logger.missions.folder import MissionFolder, read_json, write_json
from shadowhound_data_logger.missions.state import BATTERY, TEMPERATURE, named

log = logging.getLogger(__name__)

NS_SECONDS: Final = 1e17
"""A timestamp above it is in nanoseconds: in seconds it would be three billion years from now."""
MOST_STATES: Final = 20_000
SHEET, TRAJECTORY, CHARGE = NAMES = ('camera_summary.jpg', 'trajectory.png', 'battery.png')
PROGRAM: Final = 'shadowhound_data_logger.missions.pictures'
DEADLINE_S: Final = 60.0
"""After it the process is killed."""
Pictures = Callable[[MissionFolder, str], 'Mapping[str, str] | None']
"""Notes about the pictures of a mission with this title; None while they are being made."""


class Drawing:
    """Has the pictures of missions made by a child process, one mission at a time.

    Lifecycle: New; ``of`` any number of times; close once. Not thread-safe.
    """

    def __init__(self, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._monotonic = monotonic
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: MissionFolder | None = None
        self._end_s = 0.0

    @property
    def busy(self) -> bool:
        return self._process is not None

    def of(self, folder: MissionFolder, title: str) -> Mapping[str, str] | None:
        """Notes about a mission's pictures, None while they are being made. Raises OSError if no process can be started."""
        if self._process is None:
            if notes := _notes(folder):
                return notes
            self._start(folder, title)
            return None
        ended = self._process.poll() is not None
        if not ended and self._monotonic() > self._end_s:
            self._process.kill()
            self._process.wait()
            ended = True
        if not ended or self._folder is None:
            return None
        code, self._process = self._process.returncode, None
        if not _notes(self._folder):
            write_json(self._folder.pictures, dict.fromkeys(NAMES, f'the process that makes them exited with {code}'))
        return _notes(folder) if folder == self._folder else None

    def close(self) -> None:
        """A running process finishes on its own."""
        if self._process is not None:
            self._process.poll()
            self._process = None

    def _start(self, folder: MissionFolder, title: str) -> None:
        command = [sys.executable, '-m', PROGRAM, str(folder.path), title]
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, cwd=folder.path)  # where no module is found
        self._folder, self._end_s = folder, self._monotonic() + DEADLINE_S


def nothing(folder: MissionFolder, title: str) -> Mapping[str, str]:  # noqa: ARG001 - the place of Drawing.of
    """No pictures at all."""
    return {}


def _notes(folder: MissionFolder) -> dict[str, str]:
    return {name: str(note) for name, note in read_json(folder.pictures).items() if name in NAMES}


@dataclass(slots=True)
class Material:
    """The data for the pictures."""

    start_ns: int = 0
    frames: list[tuple[int, int, Path]] = field(default_factory=list)
    states: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {BATTERY: [], TEMPERATURE: []})
    """For each metric: seconds since the start, and the value."""
    trajectory: Path | None = None
    policies: list[str | None] = field(default_factory=list)

    def add(self, record: Mapping[str, Any], files: Path) -> None:
        kind, time_ns = record.get('k'), int(record.get('t', 0))
        if kind == 'start':
            self.start_ns = self.start_ns or time_ns
            self.policies.append(record.get('policy'))
        elif kind == 'policy':
            self.policies.append(record.get('policy'))
        elif kind == 'frame' and record.get('artifact'):
            self.frames.append((time_ns, int(record['id']), files / record['file']))
        elif kind == 'trajectory':
            self.trajectory = files / record['file']
        elif kind == 'metrics':
            for key in self.states.keys() & record['m'].keys():
                self.states[key].append(((time_ns - self.start_ns) / SECOND, record['m'][key]))


def material_of(folder: MissionFolder) -> Material:
    """From the agent's journal, and from the node's if the agent did not log it. Raises OSError."""
    found, node = Material(), Material()
    for line in folder.lines():
        found.add(line.record or {}, folder.files)
    node.start_ns = found.start_ns
    for line in folder.node_lines():
        node.add(line.record or {}, folder.node.files)
    found.frames = sorted(found.frames + node.frames)
    found.trajectory = found.trajectory or (folder.trajectory if folder.trajectory.exists() else None)
    found.states = {key: points or node.states[key] for key, points in found.states.items()}
    for key, points in found.states.items():
        points.sort()
        found.states[key] = points[:: 1 + len(points) // MOST_STATES]
    return found


def make(folder: MissionFolder, title: str) -> dict[str, str]:
    """Make the pictures; each name with '' or a note about it."""
    from shadowhound_data_logger.missions.contact_sheet import LoggedFrame, contact_sheet  # noqa: PLC0415 - the sender needs no Pillow

    material = material_of(folder)
    frames, start_ns, below = [LoggedFrame(*each) for each in material.frames], material.start_ns, named(material.policies)
    return {
        SHEET: _made(folder.files / SHEET, lambda target: contact_sheet(frames, title, start_ns, target, below=below)),
        TRAJECTORY: _made(folder.files / TRAJECTORY, lambda target: _trajectory(material, folder.floor, title, target)),
        CHARGE: _made(folder.files / CHARGE, lambda target: _battery(material, title, target)),
    }


def read_path(path: Path) -> list[tuple[float, float, float]]:
    """Time (s), x and y (m) of a CSV file with the columns timestamp, x and y; lines without such numbers are skipped.

    Raises OSError, or ValueError for a file without these columns.
    """
    found: list[tuple[float, float, float]] = []
    with path.open('rb') as file:
        encoding = csv_encoding(file.read(2))
    with path.open(encoding=encoding, errors='replace', newline='') as file:
        lines = csv.reader(line.replace('\0', '') for line in file)
        names = [name.strip().lower() for name in next(lines, [])]
        check_commas(','.join(names))
        places = [names.index(name) for name in ('timestamp', 'x', 'y')]
        for line in lines:
            try:
                pose = (_seconds(line[places[0]]), float(line[places[1]]), float(line[places[2]]))
            except (ValueError, IndexError):
                continue
            if all(map(math.isfinite, pose)):
                found.append(pose)
    return found


def _made(target: Path, draw: Callable[[Path], str | None]) -> str:
    """Draw a picture; returns a note about it. The file gets its name only when it is complete."""
    part = target.with_name(f'.{os.getpid()}.{target.name}')
    try:
        note = draw(part) or ''
        os.replace(part, target)
    except ValueError as error:  # there is nothing to draw
        note = f'not made: {error}'
    except ImportError as error:
        note = f'not made: {error} (pip install shadowhound_data_logger[missions])'
    except Exception as error:  # a decoder or a plot can raise anything, and the other pictures have nothing to do with it
        log.warning('%s', target, exc_info=error)
        note = f'not made: {type(error).__name__}: {error}'
    part.unlink(missing_ok=True)
    return note


def _trajectory(material: Material, floor: Path, title: str, target: Path) -> None:
    if material.trajectory is None:
        raise ValueError('no trajectory was logged')
    import numpy as np  # noqa: PLC0415 - unused elsewhere

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415 - a second, and not installed everywhere

    path = np.array(read_path(material.trajectory)).reshape(-1, 3)
    plots.trajectory(path, np.load(floor, allow_pickle=False) if floor.exists() else None, title, target)


def _battery(material: Material, title: str, target: Path) -> None:
    if max(map(len, material.states.values())) < 2:
        raise ValueError('neither battery nor temperature was logged twice')
    from shadowhound_data_logger.missions import plots  # noqa: PLC0415 - see _trajectory

    plots.battery(material.states, title, target)


def _seconds(text: str) -> float:
    """Seconds since 1970 of a number (seconds or nanoseconds) or an ISO time."""
    try:
        number = float(text)
    except ValueError:
        stamp = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=timezone.utc)).timestamp()
    return number / SECOND if abs(number) > NS_SECONDS else number


def main(arguments: Sequence[str]) -> int:
    """Make the pictures of the mission in the given folder."""
    folder = MissionFolder(Path(arguments[0]))
    write_json(folder.pictures, make(folder, arguments[1]))
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
