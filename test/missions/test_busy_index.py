"""A spool whose index another process locks for seconds: this delays only the delivery, not the calls of an agent."""

from __future__ import annotations

import random
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from statistics import median

import pytest
from missions.fakes import FakePictures, FakeTracking
from spool.making import rows

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.missions.folder import missions
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.replay import OBJECTS, Replay
from shadowhound_data_logger.spool.spool import Spool

CALLS = 100
FRAME = b'\xff\xd8' + bytes(50_000) + b'\xff\xd9'


@contextmanager
def held(home: Path) -> Iterator[None]:
    """A transaction of another process that does not end."""
    with closing(sqlite3.connect(home / 'spool/index.db', isolation_level=None)) as other:
        other.execute('BEGIN IMMEDIATE')
        yield
        other.execute('ROLLBACK')


def log(logger: MissionDataLogger, first: int) -> list[float]:
    """Seconds that each call took."""
    took: list[float] = []
    for number in range(first, first + CALLS):
        calls: tuple[Callable[[], object], ...] = (
            lambda number=number: logger.log_metric('a', number), lambda number=number: logger.log_camera_frame(FRAME, number),
            lambda number=number: logger.log_robot_state(50.0, 30.0, number),
        )  # fmt: skip
        for call in calls:
            began_s = time.perf_counter()
            call()
            took.append(time.perf_counter() - began_s)
    return took


@pytest.mark.long('a second of CPU or more')
def test_a_busy_index_delays_the_delivery_and_no_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All calls return as fast as usual while it is locked; the sender waits, and continues when it is free."""
    settings = Settings.load({'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path)})
    clock = SystemClock.of_this_machine()
    with closing(Spool(settings.spool_path, settings.spool, clock, 'thor')) as spool:
        spool.open()
    now_s = [0.0]
    replay = Replay(tmp_path, FakeTracking(), Spooler(settings, clock), FakePictures(), monotonic=lambda: now_s[0],
                    rng=random.Random(1))  # type: ignore[arg-type]  # fmt: skip
    with closing(MissionDataLogger(home=tmp_path, replay=False, start_timeout_s=0.0)) as logger:
        logger.start_mission('patrol', '')
        free_s = log(logger, 0)
        with held(tmp_path):
            began_s = time.perf_counter()
            monkeypatch.setattr('shadowhound_data_logger.spool.index.BUSY_TIMEOUT_S', 0.5)
            busy_s = log(logger, CALLS)
            while replay.gates[OBJECTS].error is None:
                assert replay.step(), 'nothing is left to do, and the spool took it'
            assert time.perf_counter() - began_s > 0.5, 'the sender has waited for the index'
            assert not spooled(tmp_path)
            logger.end_mission(True, 1.0, 1.0)
        assert median(busy_s) < 5 * median(free_s) + 0.001
        assert max(busy_s) < max(0.5, 5 * max(free_s)), 'no call has waited for it'
    while any(gate.error for gate in replay.gates.values()) or replay.step():
        now_s[0] += 100.0
        replay.step()
    replay.close()
    assert next(missions(tmp_path)).sent().complete
    assert spooled(tmp_path) == 2 * CALLS


def spooled(home: Path) -> int:
    """How many frames."""
    return sum(row['key'].endswith('.jpg') for row in rows(home / 'spool'))
