"""Spools to ship from, and a check that no upload thread is still running after its test."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from shipping.drive import Drive
from shipping.fakes import FakeSpool, Time, until
from spool.conftest import moments, root  # noqa: F401 - fixtures of test_thinning.py
from stores.conftest import bucket, moto, owner, store  # noqa: F401 - fixtures of test_audit.py


@pytest.fixture
def spool(tmp_path: Path) -> FakeSpool:
    folder = tmp_path / 'ready'
    folder.mkdir()
    return FakeSpool(folder)


@pytest.fixture
def clock() -> Time:
    return Time()


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    until(lambda: not [thread for thread in threading.enumerate() if thread.name.startswith('upload-')])


@pytest.fixture
def drive(spool: FakeSpool, clock: Time) -> Drive:
    """A schedule with a spool and a clock controlled by the test."""
    return Drive(spool, clock)
