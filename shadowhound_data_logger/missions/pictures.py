"""Creates the pictures of a mission that has ended, in a child process of the sender.

    camera_summary.jpg   trajectory.png   battery.png

``python -m shadowhound_data_logger.missions.pictures FOLDER TITLE`` writes them to files/, then pictures.json: each name with ''
or a note, such as why it was not created. A failure of one picture does not affect the others. matplotlib takes a second and
60 MB, and a hostile file may crash a decoder: both stay in that process, which the sender polls while it sends other missions.
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
from shadowhound_data_logger.core.untrusted import check_separator, csv_encoding
from shadowhound_data_logger.missions.folder import MissionFolder, read_json, write_json
from shadowhound_data_logger.missions.state import BATTERY, TEMPERATURE, policy_list

log = logging.getLogger(__name__)

NS_SECONDS: Final = 1e17
"""A larger timestamp is in nanoseconds: in seconds it would be three billion years from now."""
MAX_STATES: Final = 20_000
SHEET, TRAJECTORY, CHARGE = NAMES = ('camera_summary.jpg', 'trajectory.png', 'battery.png')
PROGRAM: Final = 'shadowhound_data_logger.missions.pictures'
DEADLINE_S: Final = 60.0
"""The process is killed after this time."""
MakePictures = Callable[[MissionFolder, str], 'Mapping[str, str] | None']
"""Returns notes about the pictures of a mission with this title; None while they are being created."""


class PictureProcess:
    """Creates the pictures of missions in a child process, one mission at a time.

    Lifecycle: New; ``make`` any number of times; close once. Not thread-safe.
    """

    def __init__(self, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._monotonic = monotonic
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: MissionFolder | None = None
        self._end_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether the process is running."""
        return self._process is not None

    def make(self, folder: MissionFolder, title: str) -> Mapping[str, str] | None:
        """Notes about a mission's pictures; None while they are being created. Raises OSError if no process can be started."""
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
            write_json(
                self._folder.pictures, dict.fromkeys(NAMES, f'not made: the process that creates the pictures exited with {code}')
            )
        return _notes(folder) if folder == self._folder else None

    def close(self) -> None:
        """A running process finishes on its own."""
        if self._process is not None:
            self._process.poll()
            self._process = None

    def _start(self, folder: MissionFolder, title: str) -> None:
        command = [sys.executable, '-m', PROGRAM, str(folder.path), title]
        # That folder contains no Python module that the process could import by mistake.
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, cwd=folder.path)
        self._folder, self._end_s = folder, self._monotonic() + DEADLINE_S


def no_pictures(folder: MissionFolder, title: str) -> Mapping[str, str]:  # noqa: ARG001 - replaces PictureProcess.make
    """Create no pictures."""
    return {}


def _notes(folder: MissionFolder) -> dict[str, str]:
    return {name: str(note) for name, note in read_json(folder.pictures).items() if name in NAMES}


@dataclass(slots=True)
class PictureData:
    """The data that the pictures show."""

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


def picture_data(folder: MissionFolder) -> PictureData:
    """Read the agent's journal, and the node's for data that the agent did not log. Raises OSError."""
    found, node = PictureData(), PictureData()
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
        found.states[key] = points[:: 1 + len(points) // MAX_STATES]
    return found


def make(folder: MissionFolder, title: str) -> dict[str, str]:
    """Create the pictures; returns each name with '' or a note."""
    from shadowhound_data_logger.missions.contact_sheet import LoggedFrame, contact_sheet  # noqa: PLC0415 - the sender needs no Pillow

    data = picture_data(folder)
    frames, below = [LoggedFrame(*each) for each in data.frames], policy_list(data.policies)
    return {
        SHEET: _draw(folder.files / SHEET, lambda target: contact_sheet(frames, title, data.start_ns, target, below=below)),
        TRAJECTORY: _draw(folder.files / TRAJECTORY, lambda target: _trajectory(data, folder.floor, title, target)),
        CHARGE: _draw(folder.files / CHARGE, lambda target: _battery(data, title, target)),
    }


def read_path(path: Path) -> list[tuple[float, float, float]]:
    """Read time (s), x and y (m) from a CSV file with the columns timestamp, x and y; lines without valid numbers are skipped.

    Raises OSError, or ValueError for a file without these columns.
    """
    found: list[tuple[float, float, float]] = []
    with path.open('rb') as file:
        encoding = csv_encoding(file.read(2))
    with path.open(encoding=encoding, errors='replace', newline='') as file:
        lines = csv.reader(line.replace('\0', '') for line in file)
        names = [name.strip().lower() for name in next(lines, [])]
        check_separator(','.join(names))
        places = [names.index(name) for name in ('timestamp', 'x', 'y')]
        for line in lines:
            try:
                pose = (_seconds(line[places[0]]), float(line[places[1]]), float(line[places[2]]))
            except (ValueError, IndexError):
                continue
            if all(map(math.isfinite, pose)):
                found.append(pose)
    return found


def _draw(target: Path, draw: Callable[[Path], str | None]) -> str:
    """Draw a picture; returns a note, or ''. The file gets its name only when it is complete."""
    part = target.with_name(f'.{os.getpid()}.{target.name}')
    try:
        note = draw(part) or ''
        os.replace(part, target)
    except ValueError as error:  # there is nothing to draw
        note = f'not made: {error}'
    except ImportError as error:
        note = f'not made: {error} (pip install shadowhound_data_logger[missions])'
    except Exception as error:  # a decoder or a plot can raise anything, which must not affect the other pictures
        log.warning('%s', target, exc_info=error)
        note = f'not made: {type(error).__name__}: {error}'
    part.unlink(missing_ok=True)
    return note


def _trajectory(data: PictureData, floor: Path, title: str, target: Path) -> None:
    if data.trajectory is None:
        raise ValueError('no trajectory was logged')
    import numpy as np  # noqa: PLC0415 - unused elsewhere

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415 - takes a second, and is not installed everywhere

    path = np.array(read_path(data.trajectory)).reshape(-1, 3)
    plots.trajectory(path, np.load(floor, allow_pickle=False) if floor.exists() else None, title, target)


def _battery(data: PictureData, title: str, target: Path) -> None:
    if max(map(len, data.states.values())) < 2:
        raise ValueError('neither battery nor temperature was logged twice')
    from shadowhound_data_logger.missions import plots  # noqa: PLC0415 - see _trajectory

    plots.battery(data.states, title, target)


def _seconds(text: str) -> float:
    """Seconds since 1970, from a number (seconds or nanoseconds) or an ISO 8601 time."""
    try:
        number = float(text)
    except ValueError:
        stamp = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=timezone.utc)).timestamp()
    return number / SECOND if abs(number) > NS_SECONDS else number


def main(arguments: Sequence[str]) -> int:
    """Create the pictures of the mission in the given folder."""
    folder = MissionFolder(Path(arguments[0]))
    write_json(folder.pictures, make(folder, arguments[1]))
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
