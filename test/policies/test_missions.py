"""Who ran what: a mission says which policies were active, in their order."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from missions.fakes import journals
from PIL import Image

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.missions.folder import MissionSent, Run, missions
from shadowhound_data_logger.missions.pictures import make
from shadowhound_data_logger.missions.state import MAX_POLICIES, MissionState, summary_of
from shadowhound_data_logger.policies.folder import PolicyFolder

OLD, NEW = 'go2_patrol@6#fedcba9876543210', 'go2_patrol@7#0123456789abcdef'


@pytest.fixture
def logger(tmp_path: Path) -> Iterator[MissionDataLogger]:
    PolicyFolder(tmp_path).make()
    made = MissionDataLogger(home=tmp_path, robot='thor', replay=False, start_timeout_s=0.0)
    yield made
    made.close()


def activate(home: Path, name: str | None) -> None:
    """As a rollback does, of a version that need not be there."""
    PolicyFolder(home)._link(name)


def told_of(home: Path) -> list[tuple[MissionState, dict[str, Any]]]:
    """The story and the summary of each mission, the first one first."""
    stories = []
    for records in journals(home):
        story = MissionState()
        for record in records:
            story.add(record)
        stories.append((story, summary_of(story, 'mission', Run('run', '1', ''), MissionSent(), {})))
    return sorted(stories, key=lambda told: told[1]['start_ns'])


def test_a_mission_records_the_active_policy(tmp_path: Path, logger: MissionDataLogger) -> None:
    """In the params of its run and in its summary; one that had none says none."""
    for name in (None, NEW):
        activate(tmp_path, name)
        logger.start_mission(f'patrol_{name is not None}', 'go round')
        logger.end_mission(True, 1.0, 2.0)
    told = [(story.params().get('policy'), story.final_params().get('policies'), summary['policy'], summary['policies'],
             summary['policy_changes']) for story, summary in told_of(tmp_path)]  # fmt: skip
    assert told == [(None, None, None, None, []), (NEW, None, NEW, NEW, [])]


def test_a_rollback_during_a_mission_is_recorded(tmp_path: Path, logger: MissionDataLogger) -> None:
    """Both policies in their order and when it was; also where the agent logs nothing after it, and where none is left."""
    activate(tmp_path, NEW)
    logger.start_mission('patrol', 'go round')
    picture = io.BytesIO()
    Image.new('RGB', (64, 48), 'teal').save(picture, 'JPEG')
    logger.log_camera_frame(picture.getvalue(), 1)
    mission = logger._mission
    assert mission is not None
    for name in (OLD, None):
        activate(tmp_path, name)
        mission.sync()  # as the thread of the logger does ten times a second
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


def test_one_that_changes_without_end_is_bounded(tmp_path: Path) -> None:
    story = MissionState()
    story.add({'k': 'start', 't': 0, 'type': 'patrol', 'command': '', 'robot': 'thor', 'policy': NEW})
    for number in range(10 * MAX_POLICIES):
        story.add({'k': 'policy', 't': number, 'policy': (OLD, NEW)[number % 2]})
    assert len(story.policies) == MAX_POLICIES
    assert story.final_params()['policies'].startswith(f'{NEW}, {OLD}, {NEW}')


def test_a_full_disk_delays_what_is_noted(tmp_path: Path, logger: MissionDataLogger, monkeypatch: pytest.MonkeyPatch) -> None:
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
