"""The pictures of a mission as the sender sees them: a separate process makes them, one mission at a time.

matplotlib's second and 60 MB, and whatever a hostile file does to a decoder, are that process's alone: the sender goes on with
other missions and looks now and then whether it is done.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final

from shadowhound_data_logger.missions.folder import MissionFolder, read_json, write_json

SHEET, TRAJECTORY, CHARGE = NAMES = ('camera_summary.jpg', 'trajectory.png', 'battery.png')
PROGRAM: Final = 'shadowhound_data_logger.missions.pictures'
DEADLINE_S: Final = 60.0
"""After it the process is killed."""
Pictures = Callable[[MissionFolder, str], 'Mapping[str, str] | None']
"""What became of the pictures of a mission with this title; None while they are being made."""


class Drawing:
    """Has the pictures of a mission made by a process, one at a time.

    Life: New; ``of`` any number; close once. Not thread-safe.
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
        """What became of a mission's pictures, None while they are being made. Raises OSError where no process can be started."""
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
        said, self._process = self._process.returncode, None
        if not _notes(self._folder):
            write_json(self._folder.pictures, dict.fromkeys(NAMES, f'the process that makes them ended with {said}'))
        return _notes(folder) if folder == self._folder else None

    def close(self) -> None:
        """What is being made is made to its end, by itself."""
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
