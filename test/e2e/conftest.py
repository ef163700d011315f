"""The real node over real DDS against a real S3 server: each test has its own ROS domain and robot name."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from domains import free_domain
from e2e.processes import Processes
from e2e.reading import Objects
from e2e.session import Session
from e2e.station import Station
from live.conftest import browser  # noqa: F401 - a fixture
from missions.conftest import server, warm_home  # noqa: F401 - fixtures of test_guide.py and test_closed_loop.py
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores.s3 import S3Store

pytest.importorskip('rclpy')

LIVE: list[Processes] = []
"""The processes with logs that are shown when a test fails."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder need ROS and an S3 server."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.ros)
            item.add_marker(pytest.mark.seaweedfs)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:  # type: ignore[misc]  # its wrapped result is returned
    """Show the logs of running processes when a test fails."""
    report: pytest.TestReport = yield  # type: ignore[assignment, misc]
    if report.failed:
        report.sections += [section for started in LIVE for section in started.logs()]
    return report  # type: ignore[return-value]


@contextmanager
def running(folder: Path) -> Iterator[Processes]:
    """Processes in a separate domain; all are stopped at the end, whatever happens."""
    with free_domain() as domain:
        processes = Processes(folder, domain, f'r{secrets.token_hex(4)}', forked=True)
        LIVE.append(processes)
        try:
            yield processes
        finally:
            LIVE.remove(processes)
            processes.end()


@pytest.fixture(scope='module')
def store(seaweed: Tower) -> Iterator[S3Store]:
    """The server, as our programs read it."""
    opened = S3Store(seaweed.store_settings(), UploadSettings())
    opened.open()
    yield opened
    opened.close()


@pytest.fixture
def station(processes: Processes) -> Iterator[Station]:
    """Another node of the robot, which calls services and subscribes to topics."""
    made = Station(processes.environ)
    yield made
    made.close()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with running(tmp_path) as started:
        yield started


@pytest.fixture(scope='module')
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Processes shared by the tests of a module, each with separate topics."""
    with running(tmp_path_factory.mktemp('shared')) as started:
        yield started


@pytest.fixture(scope='session')
def session(tmp_path_factory: pytest.TempPathFactory, seaweed: Tower) -> Session:
    """A simulated Go2, for tests of its sensors and of its bag."""
    with (
        running(tmp_path_factory.mktemp('session')) as processes,
        closing(S3Store(seaweed.store_settings(), UploadSettings())) as store,
    ):
        store.open()
        return Session.of(processes, seaweed, store)


@pytest.fixture(scope='module')
def stored(seaweed: Tower) -> Iterator[Callable[..., Objects]]:
    """Reads the stored objects of a robot."""
    with ExitStack() as stack:
        store = S3Store(seaweed.store_settings(), UploadSettings())
        store.open()
        stack.callback(store.close)
        yield lambda robot, bucket='sensor-data': Objects.of(store, bucket, robot)
