"""Tracking without a server: a SQLite file, which is the default, and a folder; what each keeps once."""

from __future__ import annotations

from pathlib import Path

import pytest

from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions.folder import Run
from shadowhound_data_logger.missions.state import Point
from shadowhound_data_logger.missions.tracking import MISSION_TAG, MlflowTracking

POINTS = [Point('battery_pct', 90.0 - number, 1_760_788_800_000 + number, number) for number in range(5)]


@pytest.fixture(scope='module')
def database(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A SQLite file, whose tables take a second to make; each test has a separate experiment in it."""
    return f'sqlite:///{tmp_path_factory.mktemp("local")}/mlflow.db'


def run_of(tracking: MlflowTracking) -> Run:
    return tracking.run_of('patrol_1', 'patrol', 1_760_788_800_000, {'mlflow.user': 'thor'})


@pytest.fixture(params=[pytest.param('sqlite', marks=pytest.mark.long('makes a database of MLflow')), 'file'])
def tracking(request: pytest.FixtureRequest, database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MlflowTracking:
    monkeypatch.setenv('MLFLOW_ALLOW_FILE_STORE', 'true')
    monkeypatch.setenv('MLFLOW_DISABLE_TELEMETRY', 'true')
    uri = database if request.param == 'sqlite' else (tmp_path / 'mlruns').as_uri()
    return MlflowTracking(uri, 'thor_missions', tmp_path / 'artifacts')


@pytest.mark.filterwarnings('ignore')
def test_a_mission_sent_twice_is_there_once(tracking: MlflowTracking, tmp_path: Path) -> None:
    """A second replayer finds the run; points, params and artifacts stay what they are. A folder alone keeps a point twice."""
    artifact = tmp_path / 'summary.json'
    artifact.write_text('{}')
    again = MlflowTracking(tracking._uri, 'thor_missions', tmp_path / 'artifacts')
    for one in (tracking, again):
        run = run_of(one)
        one.log(run.run_id, POINTS, {'robot': 'thor'}, {'a': 'b'})
        one.artifact(run, artifact, 'x')
        one.finish(run.run_id, 'patrol_1', 'KILLED', 1_760_788_900_000)
    client = tracking._client
    (found,) = client.search_runs([run.experiment_id])
    assert (found.info.status, found.info.start_time, found.info.end_time) == ('KILLED', 1_760_788_800_000, 1_760_788_900_000)
    assert found.data.params == {'robot': 'thor'}
    assert found.data.tags[MISSION_TAG] == 'patrol_1'
    assert [item.path for item in client.list_artifacts(run.run_id, 'x')] == ['x/summary.json']
    assert str(tmp_path / 'artifacts') in run.artifact_uri
    times = 1 if tracking.where.startswith('sqlite') else 2
    assert len(client.get_metric_history(run.run_id, 'battery_pct')) == times * len(POINTS)


@pytest.mark.parametrize('uri', ['nosuch://tower', 'tower:5001'])
def test_an_address_that_this_mlflow_cannot_do_with_is_waited_for(uri: str) -> None:
    """As sqlite: is for mlflow-skinny. It is not a refusal of a mission: the sender keeps running, and reports the setting."""
    with pytest.raises(TrackingUnavailable, match='set MLFLOW_TRACKING_URI to a server'):
        MlflowTracking(uri, 'thor_missions').open()


@pytest.mark.long('a second of CPU or more')
@pytest.mark.filterwarnings('ignore')
def test_a_duplicate_is_closed(database: str, tmp_path: Path) -> None:
    """A run that a lost request made after all goes when the mission ends, and says whose duplicate it was."""
    tracking = MlflowTracking(database, 'duplicates', tmp_path / 'artifacts')
    run = run_of(tracking)
    twin = tracking._client.create_run(run.experiment_id, start_time=1_760_788_800_001, tags={MISSION_TAG: 'patrol_1'})
    assert run_of(tracking) == run
    tracking.finish(run.run_id, 'patrol_1', 'FINISHED', 1_760_788_900_000)
    assert [found.info.run_id for found in tracking._client.search_runs([run.experiment_id])] == [run.run_id]
    assert tracking._client.get_run(twin.info.run_id).data.tags['shadowhound.duplicate_of'] == run.run_id
