"""What ``end_mission`` states is what MLflow shows of the run, whatever was logged under the same names before."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from missions.fakes import FakeSpooler, FakeTracking, journalling
from missions.server import Server

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, missions
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.tracking import MlflowTracking
from shadowhound_data_logger.missions.values import MAX_STEP

KEYS = ('success', 'duration_s', 'distance_m', 'distance_traveled_m', 'battery_consumed_pct')
STEPS = (0, 1, 5, -3, 1 << 31, (1 << 31) + 1, MAX_STEP - 1, MAX_STEP, -MAX_STEP)
EXPECTED = {'success': 1.0, 'duration_s': 600.0, 'distance_m': 42.0, 'distance_traveled_m': 42.0, 'battery_consumed_pct': 20.0}


def log(logger: MissionDataLogger, step: int) -> None:
    """Values of the agent's own, larger than those that it states, at one step and once more at the same."""
    for value in (1e6, 1e9):
        for key in KEYS:
            logger.log_metric(key, value, step)
    logger.log_metric('success', math.nan, step)
    logger.log_robot_state(90.0, 40.0, step)
    logger.log_robot_state(70.0, 40.0, step)
    logger.end_mission(success=True, distance_m=42.0, duration_s=600.0)


def deliver(folder: MissionFolder, tracking: MlflowTracking | FakeTracking) -> str:
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    while not delivery.complete():
        for work in (delivery.track, delivery.attach, delivery.spool):
            work()
    assert delivery.run is not None
    return delivery.run.run_id


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('store', ['sqlite', 'file'])
def test_what_is_stated_is_what_a_local_store_shows(tmp_path: Path, store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At every step that MLflow takes."""
    monkeypatch.setenv('MLFLOW_ALLOW_FILE_STORE', 'true')
    uri = f'sqlite:///{tmp_path}/mlflow.db' if store == 'sqlite' else f'file://{tmp_path}/mlruns'
    tracking = MlflowTracking(uri, 'final', tmp_path / 'artifacts')
    for number, step in enumerate(STEPS):
        home = tmp_path / str(number)
        with journalling(home) as logger:
            logger.start_mission('patrol', '')
            log(logger, step)
        run_id = deliver(next(missions(home)), tracking)
        shown = tracking._client.get_run(run_id).data.metrics
        assert {key: shown[key] for key in KEYS} == EXPECTED, step


@pytest.mark.seaweedfs
def test_what_is_stated_is_what_a_server_shows(server: Server, warm_home: Path) -> None:
    """Also in its list of runs, which can be sorted by it."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    logger.start_mission('patrol', 'stated')
    log(logger, 7)
    assert logger.close(60.0).complete
    shown = server.run('stated').data.metrics
    assert {key: shown[key] for key in KEYS} == EXPECTED


def test_the_clock_was_set_back(tmp_path: Path) -> None:
    """The last point is the newest by its step, though its time is before that of the others."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
    (folder,) = missions(tmp_path)
    start = next(folder.lines()).record
    assert start is not None
    folder.journal.unlink()
    journal = Journal(folder.journal)
    journal.create()
    journal.append(start)
    for step in (3, MAX_STEP):
        journal.append({'k': 'metrics', 't': start['t'] + 10**12, 'm': {'success': 0.5, f'a{step}': 1.0}, 's': step})
    journal.append({'k': 'end', 't': start['t'] + 1, 'status': 'FINISHED', 'success': True, 'lost': 0})
    journal.close()
    tracking = FakeTracking()
    deliver(folder, tracking)
    newest = max((point for point in tracking.points if point.key == 'success'), key=lambda point: (point.step, point.time_ms))
    assert newest.value == 1.0


@pytest.mark.parametrize(('stated', 'logged', 'expected'), [(None, 7.5, 7.5), (0.0, 7.5, 7.5), (9.0, 7.5, 9.0), (0.0, None, 0.0)])
def test_logged_values_are_used_if_none_are_stated(
    tmp_path: Path, stated: float | None, logged: float | None, expected: float
) -> None:
    """In MLflow and in ``summary.json`` alike."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        if logged is not None:
            logger.log_metric('distance_m', logged, 4)
        mission = logger._mission
        assert mission is not None
        mission.end(True, stated)
        logger._detach(mission)
    tracking = FakeTracking()
    deliver(next(missions(tmp_path)), tracking)
    newest = max((point for point in tracking.points if point.key == 'distance_m'), key=lambda point: (point.step, point.time_ms))
    assert newest.value == json.loads(tracking.artifacts['summary.json'])['distance_m'] == expected
