"""The content of a real MLflow server and a real S3 server for a mission."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from e2e.wire import Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.missions.folder import MISSIONS, missions, read_json
from shadowhound_data_logger.missions.tracking import ENVIRONMENT
from shadowhound_data_logger.stores.s3 import S3Store

FOREIGN: Final = ('AWS_', 'MLFLOW_', 'SHADOWHOUND_')


def until(found: Callable[[], Any], what: str, seconds: float = 120.0) -> Any:
    """The first true result; fails after a deadline."""
    end = time.monotonic() + seconds
    while not (answer := found()):
        assert time.monotonic() < end, f'not within {seconds:g} s: {what}'
        time.sleep(0.05)
    return answer


def complete(home: Path, count: int = 1) -> bool:
    """Whether there are this many missions and all are sent."""
    found = [folder.sent().complete for folder in missions(home)]
    return len(found) >= count and all(found)


def end_replayers(home: Path) -> None:
    """Kill the replayer of a home that a test leaves running."""
    pid = read_json(home / MISSIONS / 'replay.json').get('pid')
    if pid and Path(f'/proc/{pid}').exists() and str(home) in Path(f'/proc/{pid}/cmdline').read_text():
        os.kill(pid, signal.SIGKILL)


@dataclass
class Server:
    """The Tower of the session, and this test's wire to its MLflow."""

    tower: Tower
    wire: Wire

    @cached_property
    def client(self) -> Any:
        """Without the wire."""
        os.environ |= ENVIRONMENT
        from mlflow import MlflowClient

        return MlflowClient(self.tower.tracking_uri)

    def runs(self, command: str) -> list[Any]:
        """The runs with this command, which is unique to each test."""
        experiment = self.client.get_experiment_by_name('thor_missions')
        if experiment is None:
            return []
        return list(self.client.search_runs([experiment.experiment_id], f"params.mission_command = '{command}'"))

    def run(self, command: str) -> Any:
        """The only run."""
        (found,) = self.runs(command)
        return found

    def history(self, run_id: str, key: str) -> list[Any]:
        return list(self.client.get_metric_history(run_id, key))

    def artifacts(self, run_id: str, folder: str | None = None) -> set[str]:
        found: set[str] = set()
        for item in self.client.list_artifacts(run_id, folder):
            found |= self.artifacts(run_id, item.path) if item.is_dir else {item.path}
        return found

    def keys(self, prefix: str, bucket: str = 'sensor-data') -> Counter[str]:
        """The keys in the store below a prefix."""
        store = S3Store(self.tower.store_settings(), UploadSettings())
        store.open()
        try:
            return Counter(item.key for item in store.list(bucket, prefix))
        finally:
            store.close()
