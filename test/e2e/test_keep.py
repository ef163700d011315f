"""The example of docs/keep.md: a robot keeps everything, and the page's commands turn requested data into a dataset."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tarfile
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import boto3
import pytest
import yaml
from e2e.processes import GENTLE, Node, Processes, until
from live.test_history import items
from missions.server import complete
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.lake.dataset import MissionDataset
from shadowhound_data_logger.live.history import PastReader
from shadowhound_data_logger.live.kept import StoreKept
from shadowhound_data_logger.live.past import StorePast

ROOT: Final = Path(__file__).parents[2]
MAIN: Final = [sys.executable, '-m', 'shadowhound_data_logger.cli.main']
PAGE: Final = (ROOT / 'docs/keep.md').read_text(encoding='utf-8')
NEAR: Final = '--near=-0.6,3.1,2'
"""The position of the page's door."""
FRAMES: Final = 200


def settings() -> dict[str, Any]:
    """Those on the page, as flat parameters."""
    block = re.search(r'```yaml\n(.*?)```', PAGE, re.DOTALL)
    assert block
    found: dict[str, Any] = {}
    for name, value in yaml.safe_load(block[1])['sensor_logger_node']['ros__parameters'].items():
        found |= {f'{name}.{field}': each for field, each in value.items()}
    return found


def commands() -> list[list[str]]:
    """Those of the patrol, in order."""
    report = PAGE.partition('## A patrol')[2].partition('\n## ')[0]
    return [shlex.split(line) for line in re.findall(r'`shadowhound-data ([^`]+)`', report.replace('\n   ', ' '))]


def patrols(processes: Processes, node: Node) -> None:
    """A mission with enough kept data."""
    logger = MissionDataLogger(home=node.home, robot=processes.robot, experiment='thor_missions', start_timeout_s=30.0)
    try:
        logger.start_mission('patrol', f'look after the door with {processes.robot}')
        until(lambda: node.topic('/camera/compressed').get('stored', 0) >= FRAMES, 'pictures are kept')
        logger.end_mission(True, 0.0, 0.0)
        until(lambda: complete(node.home, 1), lambda: f'all is sent: {logger.flush(0.0)}')
    finally:
        logger.close()


@pytest.mark.slow
@pytest.mark.long('a robot, a node, a Tower with MLflow, and half a dozen commands')
@pytest.mark.timeout(900)
def test_the_commands_of_the_page_on_keeping_data_work(  # noqa: PLR0915 - one story
    processes: Processes, tower: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the page's settings its commands do what they should, in order."""
    environ = {**tower.environment(), 'SHADOWHOUND_HOME': str(tmp_path / 'spark'), 'SHADOWHOUND_ROBOT': processes.robot}
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    client = boto3.client('s3', endpoint_url=tower.endpoint_url, region_name='us-east-1',
                          aws_access_key_id=environ['AWS_ACCESS_KEY_ID'],
                          aws_secret_access_key=environ['AWS_SECRET_ACCESS_KEY'])  # fmt: skip
    if 'lerobot' not in {bucket['Name'] for bucket in client.list_buckets()['Buckets']}:
        client.create_bucket(Bucket='lerobot')
    spark = {**os.environ, **environ, **tower.tracking('spark'), 'PYTHONPATH': str(ROOT)}

    def run(command: list[str], *more: str) -> Any:
        given = [*command, '--robot', processes.robot, *more]
        ran = subprocess.run([*MAIN, *given], env=spark, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f'{shlex.join(given)}: {ran.stdout[-2000:]}{ran.stderr[-3000:]}'
        return json.loads(ran.stdout) if '--json' in more else ran.stdout

    node = processes.node(tower.environment(), {**settings(), 'keep.poll_s': 1.0})
    processes.sim('image_raw:=false', GENTLE)
    patrols(processes, node)
    poll, sheet, ask, fetch, export = commands()
    # The kept data is known within seconds, while none of it has been sent.
    until(lambda: run(poll, '--json')['objects'] > 5, 'the rows have arrived')
    offer = run(poll, '--json')
    assert offer['lost'] == {}
    found = run(['query', '--sensor', 'camera', '--since', 'today'], '--json')
    assert found == []
    # Its previews, as a sheet, on a map, and on the live page.
    previews = run(['query', '--sensor', 'camera_previews', '--since', 'today'], '--json')
    run(sheet)
    assert (tmp_path / 'day.jpg').read_bytes()[:2] == b'\xff\xd8'
    assert (tmp_path / 'day.png').is_file()
    with closing(PastReader(StorePast(), StoreKept())) as page:
        head, body = page.answer({'do': 'moment', 'robot': processes.robot, 'at': previews[-1]['t_start_ns'] // 1_000_000 + 1})
    assert 'camera_previews' in {topic for topic, kind, *_ in head['shown'] if kind == 'camera'}
    assert items(body)['camera_previews'][1][:2] == b'\xff\xd8'
    # The door.
    middle = previews[len(previews) // 2]
    here = f'--near={middle["x"]:.2f},{middle["y"]:.2f},0.3'
    assert NEAR in ask
    assert NEAR in fetch
    answer = run([here if word == NEAR else word for word in ask], '--json')
    assert (answer['answer']['state'], answer['answer']['lost']) == ('done', [])
    assert 0 < answer['objects'] < offer['objects']
    run([here if word == NEAR else word for word in fetch])
    archives = [*(tmp_path / 'door').rglob('*.tar')]
    assert len(archives) == answer['objects']
    with tarfile.open(archives[0]) as one:
        assert len([name for name in one.getnames() if name.endswith('.jpg')]) > 1
    # Train.
    run(export)
    data = json.loads((tmp_path / 'go2_patrol/meta/info.json').read_bytes())
    assert data['total_episodes'] == 1
    assert run([*poll, '--mission-type', 'patrol'], '--json')['objects'] == 0
    flags = {'robot': processes.robot, 'mission_type': 'patrol', 'since': 'today'}
    made = MissionDataset(**flags, pull=True)
    assert len(made) >= FRAMES
