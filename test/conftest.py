"""What tests of several folders share: the embedded Tower, started once."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from shadowhound_data_logger.sim.tower import Tower


ENDING_S = 2.0
"""For threads that were told to end and are not waited for."""
SERVERS = ('process_request_thread', '_server_entry')
"""Threads of the stand-in servers (http.server, moto), which end with their clients or the session."""


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    """A thread that a test began ends with it."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + ENDING_S
    while left := [
        thread.name for thread in set(threading.enumerate()) - before if not any(name in thread.name for name in SERVERS)
    ]:
        assert time.monotonic() < end, f'threads that outlive their test: {left}'
        time.sleep(0.01)


@pytest.fixture(scope='session')
def seaweed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """A running Tower with the S3 server only; its user ``limited`` may use the bucket ``allowed``, not create it."""
    from shadowhound_data_logger.sim.tower import Tower

    actions = ('Read:allowed', 'Write:allowed', 'List:allowed')
    with Tower(tmp_path_factory.mktemp('seaweed'), users={'limited': actions}) as tower:
        yield tower


@pytest.fixture(scope='session')
def tower(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """A running Tower with S3 and MLflow; the latter takes some ten seconds to start."""
    from shadowhound_data_logger.sim.tower import Tower

    with Tower(tmp_path_factory.mktemp('tower'), mlflow=True) as tower:
        yield tower
