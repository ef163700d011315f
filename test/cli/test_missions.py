"""``shadowhound-data missions``: output and exit codes, and sending records that were not sent yet."""

from __future__ import annotations

import csv
import io
import json
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from missions.fakes import FakeSpooler, FakeTracking, journalling

from shadowhound_data_logger.cli.main import main
from shadowhound_data_logger.cli.missions import missions
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions.child import Replayer
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, write_json
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.overview import LOCK, MissionBrief, overview, overviews


def run(home: Path, *arguments: str) -> Result:
    return CliRunner().invoke(missions, arguments, env={'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150'}, standalone_mode=False)


def fly(home: Path, mission_type: str = 'patrol') -> str:
    with journalling(home) as logger:
        mission_id = logger.start_mission(mission_type, 'go round')
        logger.log_metric('people_met', 2.0, step=3)
        logger.log_event('door', state='open')
        logger.log_camera_frame(b'\xff\xd8 a picture \xff\xd9', 0)
        logger.end_mission(True, 12.5, 60.0)
    return mission_id


def see(home: Path, mission_id: str) -> None:
    """Add what a node logs next to the agent."""
    node = MissionFolder(home / MISSIONS / mission_id).node
    node.files.mkdir(parents=True)
    writer = Journal(node.journal)
    writer.create()
    writer.append({'k': 'metrics', 't': 1_760_788_800 * 10**9, 'm': {'battery_pct': 77.0}, 's': 1})
    writer.close()


def deliver(home: Path, mission_id: str) -> None:
    delivery = Delivery(MissionFolder(home / MISSIONS / mission_id), FakeTracking(), FakeSpooler())  # type: ignore[arg-type]
    while not delivery.complete():
        delivery.track()
        delivery.attach()
        delivery.spool()


def test_without_a_mission_the_searched_folder_is_named(tmp_path: Path) -> None:
    """It is not an error."""
    found = run(tmp_path, 'list')
    assert found.return_value == 0
    assert f'No mission has been logged in {tmp_path / MISSIONS} yet' in found.output
    assert json.loads(run(tmp_path, 'list', '--json').output) == []


def test_the_list_shows_unsent_records(tmp_path: Path) -> None:
    """For a finished mission that is not sent the exit code is 1; for a sent or active one it is 0."""
    mission_id = fly(tmp_path)
    found = run(tmp_path, 'list')
    assert found.return_value == 1
    for text in (mission_id, 'FINISHED', '1 min', 'missions resume', '5 records, 1 artifacts, 1 objects'):
        assert text in found.output
    deliver(tmp_path, mission_id)
    assert run(tmp_path, 'list').return_value == 0
    with journalling(tmp_path) as logger:
        logger.start_mission('inspection', '')
        found = run(tmp_path, 'list', '--json')
        assert found.return_value == 0
        assert [each['result'] for each in json.loads(found.output)] == ['FINISHED', 'active']


def test_a_mission_being_sent_needs_no_resume(tmp_path: Path) -> None:
    """While an agent's sender is running, the list shows that and suggests nothing."""
    fly(tmp_path)
    with flock(tmp_path / MISSIONS / LOCK):
        text = run(tmp_path, 'list').output
    assert '1 not completely sent: being sent' in text
    assert 'resume' not in text


def test_the_list_does_not_read_sent_records(tmp_path: Path) -> None:
    """The brief of a completely sent mission comes from its summary and equals the one from its journal."""
    mission_id = fly(tmp_path)
    deliver(tmp_path, mission_id)
    (before,) = overviews(tmp_path)
    whole = overview(MissionFolder(tmp_path / MISSIONS / mission_id))
    assert whole is not None
    assert before == MissionBrief(**{field.name: getattr(whole, field.name) for field in fields(MissionBrief)})
    (tmp_path / MISSIONS / mission_id / 'journal').unlink()
    assert overviews(tmp_path) == [before]


@pytest.mark.parametrize('which', ['mission', 'run', 'beginning'])
def test_either_id_finds_a_mission(tmp_path: Path, which: str) -> None:
    """The mission's id, that of its run, or a prefix of either."""
    mission_id = fly(tmp_path)
    fly(tmp_path, 'inspection')
    deliver(tmp_path, mission_id)
    found = run(tmp_path, 'show', '--json', {'mission': mission_id, 'run': 'run0', 'beginning': 'patrol_2'}[which])
    assert found.return_value == 0
    page = json.loads(found.output)
    assert (page['mission_id'], page['run_id'], page['complete']) == (mission_id, 'run0', True)


@pytest.mark.parametrize('wanted', ['nobody', '', 'p'])
def test_an_unknown_or_ambiguous_id_is_a_usage_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], wanted: str
) -> None:
    """Exit code 2."""
    for mission_type in ('patrol', 'parade'):
        fly(tmp_path, mission_type)
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'missions', 'show', wanted])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert 'mission' in capsys.readouterr().err


def test_a_page_shows_why_a_record_is_unsent(tmp_path: Path) -> None:
    """With parameters, last values, counts, and the last error with its remedy."""
    mission_id = fly(tmp_path)
    see(tmp_path, mission_id)
    error = TrackingUnavailable('Tower is away', remedy='is it on?')
    write_json(tmp_path / MISSIONS / 'replay.json', {'errors': {'tracking': {'error': str(error), 'remedy': error.remedy}}})
    found = run(tmp_path, 'show', mission_id)
    assert found.return_value == 1
    for text in (
        'go round',
        '12.50 m',
        'people_met',
        'battery_pct',
        '77',
        'Tower is away (is it on?)',
        'not sent yet: 6 records',
    ):
        assert text in found.output


def test_an_export_has_all_that_was_logged(tmp_path: Path) -> None:
    """Params, metrics of agent and node, and events, as JSON or as CSV in a file."""
    mission_id = fly(tmp_path)
    see(tmp_path, mission_id)
    page = json.loads(run(tmp_path, 'export', mission_id).output)
    assert json.loads(run(tmp_path, 'export', '--json', mission_id).output) == page
    assert page['params']['mission_type'] == 'patrol'
    points = {(point['key'], point['value'], point['step'], point['source']) for point in page['points']}
    assert {('people_met', 2.0, 3, 'agent'), ('battery_pct', 77.0, 1, 'node'), ('distance_m', 12.5, 0, 'agent')} <= points
    assert [(event['name'], event['data']) for event in page['events']] == [('door', {'state': 'open'})]
    target = tmp_path / 'out.csv'
    assert run(tmp_path, 'export', '--format', 'csv', '--to', str(target), mission_id).return_value == 0
    rows = list(csv.DictReader(io.StringIO(target.read_text())))
    assert len(rows) == len(page['params']) + len(page['points']) + len(page['events'])
    assert ('metric', 'people_met', '2.0', '3') in {(row['kind'], row['key'], row['value'], row['step']) for row in rows}


def test_a_record_that_cannot_be_sent_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the timeout the exit code is 1, and unsent missions are listed."""
    monkeypatch.setattr(Replayer, 'start', lambda _: None)
    mission_id = fly(tmp_path)
    found = run(tmp_path, 'resume', '--timeout', '0.3')
    assert found.return_value == 1
    assert f'{mission_id}: not sent yet' in found.output
    assert '1 not sent within 0.3 s' in found.output
    found = run(tmp_path, 'resume', '--timeout', '0.3', '--json')
    assert (found.return_value, [each['mission_id'] for each in json.loads(found.stdout)['left']]) == (1, [mission_id])


def test_unsent_records_are_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``resume`` starts the sender only if there is something to send."""
    mission_id = fly(tmp_path)
    started: list[Replayer] = []

    def start(replayer: Replayer) -> None:
        started.append(replayer)
        deliver(tmp_path, mission_id)

    monkeypatch.setattr(Replayer, 'start', start)
    assert (run(tmp_path, 'resume').output, len(started)) == ('All is sent.\n', 1)
    assert (run(tmp_path, 'resume').output, len(started)) == ('Nothing is left to send.\n', 1)
    assert json.loads(run(tmp_path, 'resume', '--json').output) == {'left': []}
