"""``shadowhound-data export`` on two machines that share a store: no episode is lost, and a dropped one is deleted."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from datasets.recorded import House, Mission

from shadowhound_data_logger.cli.common import BadUsage, ExitCode
from shadowhound_data_logger.cli.export import export
from shadowhound_data_logger.cli.fetch import fetch
from shadowhound_data_logger.core.errors import LakeError, TrackingUnavailable
from shadowhound_data_logger.datasets import transfer
from shadowhound_data_logger.datasets.lerobot import REPORT, SOURCE_TABLE, Lerobot

URL = 's3://lerobot/datasets/go2/patrols'
pytestmark = pytest.mark.long('exports again and again')


class Machine:
    """A machine with a separate home and the shared store."""

    def __init__(self, folder: Path, store: Path) -> None:
        self.home = folder
        folder.mkdir()
        (folder / 'store').symlink_to(store)
        self._env = {'SHADOWHOUND_HOME': str(folder), 'AWS_ENDPOINT_URL': None}

    def ask(self, *arguments: str, code: ExitCode = ExitCode.FINE) -> Any:
        ran = CliRunner(env=self._env).invoke(export, [*arguments, '--json'], standalone_mode=False, catch_exceptions=False)
        assert ran.return_value == code, ran.output
        return json.loads(ran.stdout)

    def add(self, mission: str, to: str = URL, code: ExitCode = ExitCode.FINE) -> list[str]:
        """Export; returns the missions that were added."""
        return [
            each['mission_id'] for each in self.ask('lerobot', 'patrols', '--mission', mission, '--to', to, code=code)['added']
        ]

    def fetch(self, to: Path) -> Lerobot:
        CliRunner(env=self._env).invoke(fetch, [URL, '--to', str(to)], standalone_mode=False, catch_exceptions=False)
        return Lerobot(to)

    def where(self, key: str) -> dict[str, list[str]]:
        return {each['where']: each['missions'] for each in self.ask('where', key)}


@pytest.fixture
def machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Machine, Machine]:
    monkeypatch.setattr('shadowhound_data_logger.lake.training.runs_trained_on', lambda _: defaultdict(list))  # test_whole_way.py
    house = House(tmp_path / 'house')
    for number, name in enumerate(('one', 'two', 'three')):
        house.record(Mission(name, begin_s=100 * number, seconds=2, sensors=('camera', 'odom')))
    return Machine(tmp_path / 'a', house.settings.directory), Machine(tmp_path / 'b', house.settings.directory)


def test_two_machines_add_to_one_dataset(machines: tuple[Machine, Machine], tmp_path: Path) -> None:
    """Episodes of the other machine keep their place."""
    a, b = machines
    assert a.add('one') == ['one']
    assert b.add('two') == ['two']
    assert a.add('three') == ['three']
    assert b.fetch(tmp_path / 'back').mission_ids == ['one', 'two', 'three']
    assert a.ask('verify', URL, '--all')['wrong'] == []


def test_an_episode_is_taken_out_everywhere(machines: tuple[Machine, Machine], tmp_path: Path) -> None:
    """From the store, from a folder, and from a fetched copy; no later export adds it again."""
    a, b = machines
    a.add('one')
    a.add('two')
    a.add('one', to=str(tmp_path / 'folder'))
    a.add('two', to=str(tmp_path / 'folder'))
    a.fetch(tmp_path / 'fetched')
    first = pq.read_table(tmp_path / 'folder' / SOURCE_TABLE)['key'][0].as_py()
    everywhere = {URL, str(tmp_path / 'folder'), str(tmp_path / 'fetched')}
    assert a.where(first) == {place: ['one'] for place in everywhere}
    assert b.where(first) == {URL: ['one']}
    assert {*b.ask('drop', 'one')} == {URL}
    assert {*a.ask('drop', 'one')} == everywhere - {URL}
    assert a.where(first) == {}
    for to in everywhere - {str(tmp_path / 'fetched')}:
        assert a.add('one', to=to) == []
    a.add('three')
    made = b.fetch(tmp_path / 'back')
    assert made.mission_ids == ['two', 'three']
    assert 'one' not in json.dumps(json.loads((made.folder / REPORT).read_text())['episodes'])
    assert a.ask('verify', URL, '--all')['wrong'] == []
    a.ask('drop', 'one', code=ExitCode.FINDING)


class CutOffError(Exception):
    """Stands for a machine that is switched off."""


@pytest.fixture
def cutting(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Interrupts uploads after a number of files."""
    real, left = transfer._put, [1000]

    def put(*arguments: Any) -> int:
        left[0] -= 1
        if left[0] < 0:
            raise CutOffError
        return real(*arguments)

    monkeypatch.setattr(transfer, '_put', put)
    return lambda most: left.__setitem__(0, most)


@pytest.mark.parametrize('files', [0, 1, 5])
def test_a_drop_completes_an_interrupted_upload(machines: tuple[Machine, Machine], cutting: Callable[[int], None], files: int,
                                         tmp_path: Path) -> None:  # fmt: skip
    """The other machine waits instead of adding the mission again; the first one drops it when it is run again."""
    a, b = machines
    a.add('one')
    b.add('two')
    cutting(files)
    with pytest.raises(CutOffError):
        a.ask('drop', 'one')
    cutting(1000)
    if files:
        with pytest.raises(LakeError, match='another machine started to upload'):
            b.add('three')
    assert {*a.ask('drop', 'one')} == {URL}
    assert b.add('three') == ['three']
    assert b.fetch(tmp_path / 'back').mission_ids == ['two', 'three']
    assert a.add('one') == []


def test_an_export_completes_an_interrupted_upload(machines: tuple[Machine, Machine], cutting: Callable[[int], None]) -> None:
    """A mission is dropped from the local copy and from the uploaded part of it."""
    a, b = machines
    a.add('one')
    cutting(4)
    with pytest.raises(CutOffError):
        a.add('two')
    cutting(1000)
    with pytest.raises(LakeError, match='another machine started to upload'):
        b.add('three')
    assert {*a.ask('drop', 'two')} == {URL}
    assert b.add('three') == ['three']
    assert b.add('two') == []
    assert a.ask('verify', URL, '--all')['wrong'] == []


def test_the_last_episode_is_taken_out(machines: tuple[Machine, Machine]) -> None:
    """An empty dataset remains, which remembers the drop; the next mission becomes its first episode."""
    a, b = machines
    a.add('one')
    assert {*a.ask('drop', 'one')} == {URL}
    assert a.ask('verify', URL)['wrong'] == []
    assert b.add('one') == []
    assert b.add('two') == ['two']
    assert a.ask('verify', URL, '--all')['wrong'] == []


def test_datasets_are_named_without_mlflow(machines: tuple[Machine, Machine], monkeypatch: pytest.MonkeyPatch) -> None:
    """Their trained models are then unknown, which differs from an empty list."""
    a, _ = machines
    a.add('one')
    store = a.home / 'store/lerobot/datasets/go2/patrols'
    key = pq.read_table(store / SOURCE_TABLE)['key'][0].as_py()

    def away(_: object) -> None:
        raise TrackingUnavailable('MLflow is away')

    monkeypatch.setattr('shadowhound_data_logger.lake.training.runs_trained_on', away)
    (found,) = a.ask('where', key, code=ExitCode.FINDING)
    assert (found['where'], found['missions'], found['runs']) == (URL, ['one'], None)


@pytest.mark.parametrize('flags', [('--mission', 'onne'), ('--mission-type', 'patrl'), ('--label', 'x'), ('--robot', 'thro')])
def test_an_export_of_what_does_not_exist_is_wrong_usage(machines: tuple[Machine, Machine], flags: tuple[str, str]) -> None:
    """As for a query; if no labels exist at all, any label is accepted."""
    if flags[0] == '--label':
        assert machines[0].ask('lerobot', 'patrols', *flags, '--dry-run')['added'] == []
        return
    with pytest.raises(BadUsage, match=f'there is no .*{flags[1]}'):
        machines[0].ask('lerobot', 'patrols', *flags, '--dry-run')
