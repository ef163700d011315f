"""A tracking server and a spooler in memory that fail on request."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.errors import TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.missions.folder import MissionFolder, Run, missions
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.mission_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.state import Point


@dataclass
class FakeTracking:
    """A server. ``fail`` decides by name whether a request fails, ``refuses`` whether a point is refused."""

    fail: Callable[[str], bool] = lambda _: False
    refuses: Callable[[Point], bool] = lambda _: False
    runs: dict[str, Run] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    points: list[Point] = field(default_factory=list)
    batches: list[int] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    artifacts: dict[str, bytes] = field(default_factory=dict)
    finished: list[tuple[str, str, int]] = field(default_factory=list)
    gone: bool = False

    def run_of(self, mission_id: str, name: str, start_ms: int, tags: Mapping[str, str]) -> Run:
        with self._request('run_of'):
            self.names[mission_id] = f'{name} {start_ms}'
            return self.runs.setdefault(mission_id, Run(f'run{len(self.runs)}', '1', 'mlflow-artifacts:/x'))

    def log(self, run_id: str, points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        with self._request('log'):
            if self.gone:
                raise TrackingRefused('it was deleted', code='RUN_GONE')
            if any(map(self.refuses, points)) or len(points) > 1000:
                raise TrackingRefused('no', code='INVALID_PARAMETER_VALUE')
            self.batches.append(len(points))
            self.points += points
            self.params |= params
            self.tags |= tags

    def artifact(self, run: Run, path: Path, folder: str) -> None:
        with self._request('artifact'):
            self.artifacts[f'{folder}/{path.name}'.lstrip('/')] = path.read_bytes()

    def finish(self, run_id: str, mission_id: str, status: str, end_ms: int) -> None:
        with self._request('finish'):
            self.finished.append((run_id, status, end_ms))

    @contextmanager
    def _request(self, name: str) -> Iterator[None]:
        if self.fail(name):
            raise TrackingUnavailable('away', remedy='wait')
        yield
        if self.fail(f'{name} answer'):
            raise TrackingUnavailable('away before it answered', remedy='wait')


@dataclass
class FakeSpooler:
    """The spooled objects, each content once, as the spool's index ensures."""

    objects: list[DataObject] = field(default_factory=list)
    has_unsent: bool = False

    def add(self, objects: Sequence[DataObject]) -> None:
        known = {(item.bucket, item.key, item.body) for item in self.objects}
        self.objects += [item for item in objects if (item.bucket, item.key, item.body) not in known]

    def bind(self, mission_id: str, run_id: str) -> bool:
        found = [item for item in self.objects if item.held == f'mission-{mission_id}']
        for item in found:
            key = item.key.replace(f'/missions/{mission_id}/', f'/missions/{run_id}/')
            self.objects[self.objects.index(item)] = replace(item, key=key, held=None)
        return bool(found)

    def pending(self) -> int:
        return 0

    def drain(self) -> None:
        pass

    def expedite(self) -> None:
        pass

    def close(self) -> None:
        pass

    def names(self) -> list[str]:
        return [f'{item.bucket}/{item.key}' for item in self.objects]


class FakePictures:
    """Creates no pictures, immediately."""

    busy = False

    def make(self, folder: MissionFolder, title: str) -> dict[str, str]:
        return {}

    def close(self) -> None:
        pass


@contextmanager
def journalling(home: Path, **options: object) -> Iterator[MissionDataLogger]:
    """A logger without a replayer."""
    logger = MissionDataLogger(home=home, replay=False, start_timeout_s=0.0, **options)  # type: ignore[arg-type]
    try:
        yield logger
    finally:
        logger.close()


def journals(home: Path) -> list[list[dict[str, Any]]]:
    """All missions' records."""
    return [[dict(line.record or {}) for line in read(folder.journal)] for folder in missions(home)]


def journal(home: Path) -> list[dict[str, Any]]:
    (found,) = journals(home)
    return found
