"""A mission's type has one spelling, the agent's, everywhere except in keys and file names."""

from __future__ import annotations

import json
import os
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from missions.fakes import FakeSpooler, FakeTracking, journalling
from missions.server import FOREIGN, complete, end_replayers, until
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings, UploadSettings
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.missions import mission, recorder
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, Run, missions, read_json
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.objects import Spooler, objects_of
from shadowhound_data_logger.stores import open_store

NOON_NS = 1_760_788_800 * 10**9
ROBOT = 'thor-types'
"""The shared store has objects of other tests as well."""
TYPES = ('巡逻', '探索', 'night patrol', 'night_patrol', 'ночь', 'a/b', '\N{DOG FACE}')


@pytest.fixture(params=['folder', pytest.param('s3', marks=pytest.mark.seaweedfs)])
def environ(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, str]:
    """A store for the missions of a home."""
    if request.param == 'folder':
        return {'SHADOWHOUND_HOME': str(tmp_path)}
    tower: Tower = request.getfixturevalue('tower')
    return {**tower.environment(), 'SHADOWHOUND_HOME': str(tmp_path)}


@pytest.fixture
def flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[MissionFolder]:
    """A mission of each type, all in the same second, each with a different trajectory."""
    for module in (mission, recorder):
        monkeypatch.setattr(module, 'now_ns', lambda _: NOON_NS)
    for given in TYPES:
        csv = tmp_path / 't.csv'
        csv.write_text(f'timestamp,x,y,yaw\n{given}\n')
        with journalling(tmp_path, robot=ROBOT) as logger:
            logger.start_mission(given, '')
            logger.log_trajectory(csv)
    return list(missions(tmp_path))


def first(folder: MissionFolder) -> dict[str, object]:
    return dict(next(read(folder.journal)).record or {})


def test_every_object_and_row_has_the_agents_spelling(
    environ: dict[str, str], tmp_path: Path, flown: list[MissionFolder]
) -> None:
    """Types with the same safe form get different keys, each with its own content; catalog and store have the spelling."""
    settings = Settings.load({'spool.min_free_bytes': 0, 'robot': ROBOT}, environ)
    with closing(Spooler(settings, SystemClock('boot'))) as spooler:
        for number, folder in enumerate(flown):
            records = [line.record or {} for line in read(folder.journal)]
            spooler.add([item.content for record in records[:-1]
                         for item in objects_of(record, records[0], folder, Run(f'run{number}', '1', 'x'))])  # fmt: skip
        for _ in range(20):
            spooler.drain()
        assert spooler.pending() == 0
    with closing(open_store(settings.store, UploadSettings())) as store:
        found = {}
        for entry in store.list('trajectories', f'{ROBOT}/'):
            info, content = store.head('trajectories', entry.key), store.get('trajectories', entry.key).decode()
            assert info is not None
            assert content == f'timestamp,x,y,yaw\n{info.metadata["mission_type"]}\n'
            found[check_key(entry.key)] = info.metadata['mission_type']
        assert sorted(found.values()) == sorted(TYPES)
        parts = [store.get('sensor-data', entry.key) for entry in store.list('sensor-data', f'{ROBOT}/_catalog/')]
    rows = [row for part in parts for row in read_rows(part, ROBOT).rows['_catalog']]
    types = {folder.mission_id: first(folder)['type'] for folder in flown}
    assert {(row['mission_id'], row['mission_type']) for row in rows if row['mission_id']} == set(types.items())


def test_the_run_and_the_summary_have_the_agents_spelling(flown: list[MissionFolder]) -> None:
    """The run's name, its params and ``summary.json``."""
    for folder in flown:
        given, tracking = first(folder)['type'], FakeTracking()
        delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
        while not delivery.complete():
            for work in (delivery.track, delivery.attach, delivery.spool):
                work()
        summary = json.loads(tracking.artifacts['summary.json'])
        assert tracking.params['mission_type'] == summary['mission_type'] == given
        assert tracking.names[folder.mission_id].rpartition(' ')[0] == summary['run_name'] == f'{given}_20251018_120000'


SEEN = ('巡逻', '探索', 'night patrol')


@pytest.mark.long('a sender that loads MLflow')
def test_every_verb_has_the_agents_spelling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From start_mission to query, search, export and missions; an unknown type is an error that suggests the nearest one."""
    for name in [name for name in os.environ if name.startswith(FOREIGN)]:
        monkeypatch.delenv(name)
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path / 'home'))
    ids: dict[str, str] = {}
    logger = MissionDataLogger(start_timeout_s=60.0)
    try:
        for given in SEEN:
            with logger.mission(given, 'look at the door') as mission:
                ids[given] = mission.id
        logger.close()
        state = tmp_path / 'home' / MISSIONS / 'replay.json'
        until(
            lambda: complete(tmp_path / 'home', len(SEEN)) and not read_json(state)['pid'], 'the sender has sent all and exited'
        )
    finally:
        end_replayers(tmp_path / 'home')

    monkeypatch.chdir(tmp_path)

    def json_of(*arguments: str, code: int = 0) -> Any:
        done = CliRunner().invoke(cli, [*arguments, '--json'], standalone_mode=False)
        assert (done.exception, done.return_value) == (None, code), done.output
        return json.loads(done.stdout)

    assert {each['type']: each['mission_id'] for each in json_of('missions', 'list')} == ids
    assert {json_of('missions', 'show', mission_id)['type'] for mission_id in ids.values()} == {*SEEN}
    counts = json_of('query', 'SELECT mission_type, count(*) AS n FROM missions GROUP BY mission_type')
    assert {row['mission_type']: row['n'] for row in counts} == dict.fromkeys(SEEN, 1)
    json_of('lake', 'index')
    for given, mission_id in ids.items():
        assert {row['mission_id'] for row in json_of('query', '--mission-type', given)} == {mission_id}
        assert [each['mission_id'] for each in json_of('search', 'door', '--mission-type', given)['found']] == [mission_id]
        chosen = json_of('export', 'lerobot', 'set', '--mission-type', given, '--dry-run', code=1)
        assert [*chosen['refused']] == [mission_id], 'it is chosen, and has no camera'
    for verb in (('query',), ('search', 'door'), ('export', 'lerobot', 'x', '--dry-run'), ('fetch', '--to', 'x')):
        done = CliRunner().invoke(cli, [*verb, '--mission-type', 'night_patrol'], standalone_mode=False)
        assert isinstance(done.exception, BadUsage), (verb, done.exception)
        assert done.exception.remedy == "is it 'night patrol'?"
