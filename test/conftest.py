"""Shared by tests of several folders: the embedded Tower, ROS domains, and which tests may run at the same time."""

from __future__ import annotations

import faulthandler
import gc
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import botocore.session
import profiles
import pytest
from botocore.loaders import create_loader
from domains import free_domain
from shadowhound_sim.demo_processes import THIS_MACHINE

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower
    from tls_front import Authority


ENDING_S = 60.0
"""More than enough for threads that were asked to stop and not joined."""
SERVERS = ('process_request_thread', '_server_entry')
"""Threads of the fake servers (http.server, moto), which end with their clients or the session."""
ENGINE = ('DaftBackgroundEventLoop', 'Dummy-')
"""Daft's threads, which a process keeps; Dummy is Python's name for threads of other languages."""
MAX_WORKERS = 5
"""Each collects all tests, loads all libraries and forks programs, which takes 15 s of CPU time; many tests wait."""
ONE_ROBOT_AT_A_TIME = (
    'test/e2e/test_bag.py', 'test/e2e/test_catalog.py', 'test/e2e/test_go2_profile.py', 'test/e2e/test_killed.py',
    'test/e2e/test_raw_camera.py', 'test/sim/test_demo.py', 'test/sim/test_sim_go2_node.py',
)  # fmt: skip
"""Files with robots at full rate, which must lose no message: they run first, one after the other, and others yield to them."""
ONE_SENDER = ('test/e2e/test_guide.py', 'test/missions/test_tracking.py')
"""Files whose missions are sent by one process, which has loaded MLflow."""
ONE_TEAM = (
    'test/e2e/test_closed_loop.py', 'test/policies/test_trust.py', 'test/e2e/test_policies.py',
    'test/policies/test_sync.py', 'test/e2e/test_policies.py',
)  # fmt: skip
"""Files that sign policies on a shared Tower, which has one team at a time."""
WAITING = ('test/doctor/', 'test/e2e/', 'test/missions/', 'test/sim/', 'test/tower/')
"""Folders whose tests mostly wait for other processes."""
NICENESS = os.nice(0) + 10
"""Of the other workers."""
MEMORY = Path('/dev/shm')  # noqa: S108 - pytest makes a private folder in it
MEMORY_BYTES = 8 << 30
"""Free in it, for the folders of tests in ``make test``; otherwise they are on the disk, as in ``make test-long``."""
HUNG_S = 60.0
"""After a test's timeout, until its process is ended: nothing else ends a test that waits in a library for a lock."""
STDERR = pytest.StashKey[int]()
"""A copy of standard error, which pytest captures while a test runs."""


def pytest_configure(config: pytest.Config) -> None:
    """A process in the background of a shell ignores SIGINT, and so would the programs that tests stop with it.

    Nodes of the tests, in this process and in others, see only this machine. In a fresh clone each worker starts to compile the
    tests at another folder, and finds the rest compiled; ``pytest_collection_modifyitems`` restores the common order.
    """
    if hasattr(config, 'workerinput') and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        root = Path(__file__).parent
        found = sorted({str(root / path.relative_to(root).parts[0]) for path in root.rglob('test_*.py')})
        first = len(found) * int(config.workerinput['workerid'].removeprefix('gw')) // config.workerinput['workercount']
        config.args = found[first:] + found[:first]
    config.stash[STDERR] = os.dup(2)
    os.environ.update(THIS_MACHINE)
    if not profiles.LONG and MEMORY.is_dir() and shutil.disk_usage(MEMORY).free >= MEMORY_BYTES:
        os.environ.setdefault('PYTEST_DEBUG_TEMPROOT', str(MEMORY))  # syncs to the disk take CPU time
    gc.disable()
    botocore.session.create_loader = lru_cache(create_loader)  # each store would read the description of S3
    profiles.load()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist, which may not be installed
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Several per core, because many tests wait; none for files given by name, which are faster without."""
    names = [Path(argument.partition('::')[0]) for argument in config.args]
    if config.args_source is pytest.Config.ArgsSource.ARGS and all(name.is_file() for name in names):
        return 0
    return min(3 * len(os.sched_getaffinity(0)), MAX_WORKERS)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """A worker takes whole files, because their tests share fixtures."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            if nodeid.startswith(ONE_SENDER):
                return 'sender'
            if nodeid.startswith(ONE_TEAM):
                return 'team'
            return 'robots' if has_robot(nodeid) else str(super()._split_scope(nodeid))

        def remove_node(self, node: Any) -> str | None:
            """The test that ended a worker is not run again: it would end all workers."""
            units = self.assigned_work[node].values()
            crashed = next(((unit, test) for unit in units for test, is_done in unit.items() if not is_done), None)
            if crashed is not None:
                crashed[0][crashed[1]] = True
            super().remove_node(node)
            return crashed[1] if crashed is not None else None

    return Scheduling(config, log)


def has_robot(nodeid: str) -> bool:
    return nodeid.startswith(ONE_ROBOT_AT_A_TIME)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The group with robots first, on a worker that is not nice yet; then files that wait between files that compute.

    Long tests are skipped unless requested.
    """
    for item in items:
        if profiles.LONG:
            by_hypothesis = getattr(getattr(item, 'function', None), 'is_hypothesis_test', False)
            if by_hypothesis or item.get_closest_marker('sampled'):
                item.add_marker(pytest.mark.long('all examples'))
        elif marker := item.get_closest_marker('long'):
            item.add_marker(pytest.mark.skip(reason=f'{marker.args[0]}: set SHADOWHOUND_TEST_LONG=1'))
    if hasattr(config, 'workerinput'):
        items.sort(key=lambda item: item.nodeid.partition('::')[0])
        place = places(item.nodeid.partition('::')[0] for item in items)
        items.sort(key=lambda item: (not has_robot(item.nodeid), place[item.nodeid.partition('::')[0]]))


def places(names: Iterable[str]) -> dict[str, float]:
    """The position of each file, 0 to 1: files that wait and files that compute are spread evenly, each kind in its order."""
    found: dict[str, float] = {}
    files = list(dict.fromkeys(names))
    for kind in (True, False):
        of_kind = [name for name in files if name.startswith(WAITING) is kind]
        found |= {name: number / len(of_kind) for number, name in enumerate(of_kind)}
    return found


def pytest_collection_finish() -> None:
    """All tests and their imports stay in memory: collecting that garbage repeatedly would take seconds."""
    gc.enable()
    gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """pytest-timeout interrupts Python; if that does not help, the process prints the stack of each thread and exits.

    Then the test has failed, and pytest-xdist starts another worker.
    """
    marker = item.get_closest_marker('timeout')
    seconds = float(marker.args[0] if marker else item.config.getini('timeout'))
    faulthandler.dump_traceback_later(seconds + HUNG_S, exit=True, file=item.config.stash[STDERR])
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that run next to a robot, with their servers and children, yield to it."""
    if hasattr(item.config, 'workerinput') and not has_robot(item.nodeid) and (more := NICENESS - os.nice(0)) > 0:
        os.nice(more)


@pytest.fixture(autouse=True)
def tables_are_in_a_temporary_home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Queries keep their tables out of the user's home."""
    if 'SHADOWHOUND_HOME' not in os.environ:
        monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path_factory.getbasetemp() / 'home'))


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    """A thread that a test started ends with it."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + ENDING_S
    while left := [
        thread.name for thread in set(threading.enumerate()) - before if not any(name in thread.name for name in SERVERS + ENGINE)
    ]:
        assert time.monotonic() < end, f'threads that are still running: {left}'
        time.sleep(0.01)


def of_this_run(factory: pytest.TempPathFactory, name: str, users: Mapping[str, Sequence[str]], *, mlflow: bool = False) -> Tower:
    """A Tower that all workers of the run share; without workers it runs as long as this process."""
    from shared_tower import shared_tower

    worker = os.environ.get('PYTEST_XDIST_WORKER')
    base = factory.getbasetemp()
    owner = os.getppid() if worker else os.getpid()
    shared = shared_tower((base.parent if worker else base) / name, users, owner, mlflow=mlflow)
    return cast('Tower', shared)  # with the attributes that tests use


@pytest.fixture(scope='session')
def seaweed(tmp_path_factory: pytest.TempPathFactory) -> Tower:
    """A running Tower with the S3 server only; ``limited`` may use the buckets ``allowed`` and ``later``, not create them."""
    actions = [f'{action}:{bucket}' for bucket in ('allowed', 'later') for action in ('Read', 'Write', 'List')]
    return of_this_run(tmp_path_factory, 'seaweed', {'limited': actions})


@pytest.fixture(scope='session')
def tower(tmp_path_factory: pytest.TempPathFactory) -> Tower:
    """A running Tower with S3 and MLflow, which takes some ten seconds to start."""
    from shared_tower import USERS

    return of_this_run(tmp_path_factory, 'tower', USERS, mlflow=True)


@pytest.fixture
def domain() -> Iterator[int]:
    """An unused ROS domain, locked against other tests."""
    with free_domain() as number:
        yield number


@pytest.fixture(scope='module')
def authorities(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Authority]:
    """A trusted and an unknown one."""
    from tls_front import Authority

    folder = tmp_path_factory.mktemp('tls')
    return {name: Authority(folder, name) for name in ('authority', 'stranger')}
