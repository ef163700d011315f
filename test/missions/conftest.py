"""A real MLflow server behind a wire that can be cut, and its contents."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from e2e.wire import Wire
from missions.server import FOREIGN, Server, end_replayers, until
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.folder import MISSIONS, read_json


@pytest.fixture
def server(tower: Tower, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """The session's Tower, its MLflow behind a separate wire for this test, as the environment of the logger."""
    for name in [name for name in os.environ if name.startswith(FOREIGN)]:
        monkeypatch.delenv(name)
    with Wire(tower.tracking_uri) as wire:
        environ = tower.environment() | {'MLFLOW_TRACKING_URI': wire.url, 'MLFLOW_HTTP_REQUEST_TIMEOUT': '2'}
        for name, value in environ.items():
            monkeypatch.setenv(name, value)
        yield Server(tower, wire)


@pytest.fixture(scope='session')
def warm_home(tower: Tower, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home with a running sender that has loaded MLflow, for all tests that do nothing to it; without a wire."""
    home = tmp_path_factory.mktemp('warm')
    with pytest.MonkeyPatch.context() as patched:
        for name in [name for name in os.environ if name.startswith(FOREIGN)]:
            patched.delenv(name)
        for name, value in tower.environment().items():
            patched.setenv(name, value)
        keeper = MissionDataLogger(home=home)
    # The sender of a test's own logger must not be the first: it has that test's wire.
    until(lambda: read_json(home / MISSIONS / 'replay.json').get('pid'), 'the sender is there')
    yield home
    keeper.close()
    end_replayers(home)


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """The logger's home; its sender stops with the test."""
    yield tmp_path / 'home'
    end_replayers(tmp_path / 'home')
