"""The values in ``end_mission`` are those that MLflow shows for the run, whatever was logged under the same names before.

Missions also record the policies that were active, in order.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from missions.fakes import FakeSpooler, FakeTracking, journalling, journals
from missions.server import Server
from PIL import Image

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, MissionSent, Run, missions
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.pictures import make
from shadowhound_data_logger.missions.state import MAX_POLICIES, MissionState, summary_of
from shadowhound_data_logger.missions.tracking import MlflowTracking
from shadowhound_data_logger.missions.values import MAX_STEP
from shadowhound_data_logger.policies.folder import PolicyFolder

KEYS = ('success', 'duration_s', 'distance_m', 'distance_traveled_m', 'battery_consumed_pct')
STEPS = (0, 1, 5, -3, 1 << 31, (1 << 31) + 1, MAX_STEP - 1, MAX_STEP, -MAX_STEP)
EXPECTED = {'success': 1.0, 'duration_s': 600.0, 'distance_m': 42.0, 'distance_traveled_m': 42.0, 'battery_consumed_pct': 20.0}


def log(logger: MissionDataLogger, step: int) -> None:
    """Values logged by the agent, larger than those in its statement, at one step and once more at the same."""
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
def test_a_local_store_shows_the_stated_values(tmp_path: Path, store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At every step that MLflow accepts."""
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
def test_a_server_shows_the_stated_values(server: Server, warm_home: Path) -> None:
    """Also in its list of runs, which can be sorted by them."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    logger.start_mission('patrol', 'stated')
    log(logger, 7)
    assert logger.close(60.0).complete
    shown = server.run('stated').data.metrics
    assert {key: shown[key] for key in KEYS} == EXPECTED


def test_stated_values_are_the_newest_after_the_clock_was_set_back(tmp_path: Path) -> None:
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
    """In MLflow and in ``summary.json``."""
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


OLD, NEW = 'go2_patrol@6#fedcba9876543210', 'go2_patrol@7#0123456789abcdef'


@pytest.fixture
def logger(tmp_path: Path) -> Iterator[MissionDataLogger]:
    PolicyFolder(tmp_path).make()
    made = MissionDataLogger(home=tmp_path, robot='thor', replay=False, start_timeout_s=0.0)
    yield made
    made.close()


def activate(home: Path, name: str | None) -> None:
    """As a rollback does; the version need not exist."""
    PolicyFolder(home)._link(name)


def told_of(home: Path) -> list[tuple[MissionState, dict[str, Any]]]:
    """The policy history and the summary of each mission, the first one first."""
    stories = []
    for records in journals(home):
        story = MissionState()
        for record in records:
            story.add(record)
        stories.append((story, summary_of(story, 'mission', Run('run', '1', ''), MissionSent(), {})))
    return sorted(stories, key=lambda told: told[1]['start_ns'])


def test_a_mission_records_the_active_policy(tmp_path: Path, logger: MissionDataLogger) -> None:
    """In the params of its run and in its summary; without a policy there is no entry."""
    for name in (None, NEW):
        activate(tmp_path, name)
        logger.start_mission(f'patrol_{name is not None}', 'go round')
        logger.end_mission(True, 1.0, 2.0)
    reports = [(story.params().get('policy'), story.final_params().get('policies'), summary['policy'], summary['policies'],
             summary['policy_changes']) for story, summary in told_of(tmp_path)]  # fmt: skip
    assert reports == [(None, None, None, None, []), (NEW, None, NEW, NEW, [])]


def test_a_rollback_during_a_mission_is_recorded(tmp_path: Path, logger: MissionDataLogger) -> None:
    """Both policies in order with the time; also if the agent logs nothing after it, and if none is active afterwards."""
    activate(tmp_path, NEW)
    logger.start_mission('patrol', 'go round')
    picture = io.BytesIO()
    Image.new('RGB', (64, 48), 'teal').save(picture, 'JPEG')
    logger.log_camera_frame(picture.getvalue(), 1)
    mission = logger._mission
    assert mission is not None
    for name in (OLD, None):
        activate(tmp_path, name)
        mission.sync()  # as the logger's thread does ten times per second
        mission.sync()
    activate(tmp_path, OLD)
    logger.end_mission(False, 1.0, 2.0)
    every = f'{NEW}, {OLD}, none, {OLD}'
    ((story, summary),) = told_of(tmp_path)
    assert (story.params()['policy'], story.final_params()['policies']) == (NEW, every)
    assert (summary['policy'], summary['policies']) == (NEW, every)
    assert [change['policy'] for change in summary['policy_changes']] == [OLD, None, OLD]
    times = [summary['start'], *(change['time'] for change in summary['policy_changes']), summary['end']]
    assert times == sorted(times)
    (folder,) = missions(tmp_path)
    run = CliRunner(env={'SHADOWHOUND_HOME': str(tmp_path), 'COLUMNS': '200'})
    assert every in run.invoke(cli, ['missions', 'show', folder.mission_id]).output
    assert json.loads(run.invoke(cli, ['missions', 'show', folder.mission_id, '--json']).output)['policies'] == every
    heights = []
    for is_told in (True, False):
        assert make(folder, 'patrol')['camera_summary.jpg'] == ''
        with Image.open(folder.files / 'camera_summary.jpg') as sheet:
            heights.append(sheet.height)
        if is_told:
            folder.journal.write_bytes(b''.join(
                line for line in folder.journal.read_bytes().splitlines(keepends=True) if b'"policy"' not in line))  # fmt: skip
    assert heights[0] > heights[1], 'the sheet has a line for them'


def test_a_policy_that_keeps_changing_is_bounded(tmp_path: Path) -> None:
    story = MissionState()
    story.add({'k': 'start', 't': 0, 'type': 'patrol', 'command': '', 'robot': 'thor', 'policy': NEW})
    for number in range(10 * MAX_POLICIES):
        story.add({'k': 'policy', 't': number, 'policy': (OLD, NEW)[number % 2]})
    assert len(story.policies) == MAX_POLICIES
    assert story.final_params()['policies'].startswith(f'{NEW}, {OLD}, {NEW}')


def test_a_full_disk_delays_the_record_of_policies(
    tmp_path: Path, logger: MissionDataLogger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is recorded as soon as there is free space, and does not count as lost."""
    activate(tmp_path, NEW)
    logger.start_mission('patrol', 'go round')
    mission = logger._mission
    assert mission is not None

    def full(_: object) -> None:
        raise OSError(28, 'No space left on device')

    with monkeypatch.context() as patch:
        patch.setattr(mission._recorder._journal, 'append', full)
        activate(tmp_path, OLD)
        mission.sync()
    logger.end_mission(True, 1.0, 2.0)
    ((story, summary),) = told_of(tmp_path)
    assert summary['policies'] == f'{NEW}, {OLD}'
    assert story.end['lost'] == 0
