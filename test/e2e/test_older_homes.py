"""Homes that older versions left when node and agent were killed half-way: this version goes on with all that is in them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from e2e.bag_reading import bags
from e2e.processes import Processes, until
from missions.server import Server, complete, end_replayers

from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.missions.folder import missions
from shadowhound_data_logger.sim.tower import Tower
from shadowhound_data_logger.stores.s3 import S3Store

HOMES = sorted((Path(__file__).parent / 'homes').glob('version_*.tar.xz'))
"""Made by homes/make_home.py."""
ROBOT = 'thor'
XATTR = 'SCHILY.xattr.'
SENT_S = 120.0
"""MLflow is slow to load beside other tests."""


def unpack(archive: Path, home: Path) -> dict[str, Any]:
    """The home as it was, with its extended attributes where the file system has some; what its ledger said."""
    with tarfile.open(archive) as tar:
        for entry in tar:
            tar.extract(entry, home)
            for name in entry.pax_headers:
                if name.startswith(XATTR):
                    with suppress(OSError):
                        os.setxattr(home / entry.name, name.removeprefix(XATTR), entry.pax_headers[name].encode())
    said = home / 'ledger.json'
    found: dict[str, Any] = json.loads(said.read_bytes())
    said.unlink()
    return found


def left(ledger: dict[str, Any]) -> dict[str, int]:
    """What is neither stored nor given up yet."""
    rows = [*ledger['topics'].values(), *ledger['bags'].values()]
    return {'open': sum(row['open'] for row in rows), **{state: ledger['objects'][state] for state in ('pending', 'held')}}


@pytest.mark.long('what another version left to deliver')
@pytest.mark.parametrize('archive', HOMES, ids=lambda path: path.name.partition('.')[0])
def test_a_home_half_way_is_finished(
    archive: Path, processes: Processes, tower: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects, bag and missions all arrive, nothing that was counted is lost, and the ledger balances."""
    home = processes.folder / 'home'
    before = unpack(archive, home)
    environ = tower.environment()
    for name, value in environ.items():
        monkeypatch.setenv(name, value)  # for MLflow's client here
    node = processes.node(environ, robot=ROBOT)
    resume = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'missions', 'resume', '--deadline', str(SENT_S)]
    told = {**processes.environ, **environ, 'SHADOWHOUND_HOME': str(home)}
    try:
        subprocess.run(resume, env=told, check=True, timeout=2 * SENT_S)
        until(lambda: complete(home, 2), 'both missions are sent')
        until(lambda: not any(left(node.ledger()).values()), lambda: f'all is delivered: {node.ledger()}')
    finally:
        end_replayers(home)
    after = node.stop()

    for sink in ('topics', 'bags'):
        for topic, row in before[sink].items():
            now = after[sink][topic]
            assert now['received'] == row['received']
            assert not row['received'] or (now['published'], now['missed']) == (row['published'], row['missed'])
            assert sum(now['dropped'].values()) - sum(row['dropped'].values()) + now['stored'] - row['stored'] == row['open']
            assert now['stored_in']['delivered'] == now['stored'] >= row['stored']
    assert after['objects']['quarantined'] == after['objects']['evicted'] == 0
    with closing(S3Store(tower.store_settings(), UploadSettings())) as store:
        store.open()
        found = bags(store, ROBOT, tmp_path / 'bags')
    assert sorted(bag.manifest['state'] for bag in found) == ['complete', 'recovered']
    assert sum((bag.check() for bag in found), Counter()) == {
        topic: row['stored'] for topic, row in after['bags'].items() if row['stored']
    }
    ended, killed = sorted(missions(home), key=lambda folder: folder.mission_id)
    server = Server(tower, None)  # type: ignore[arg-type]  # no wire
    runs = [server.client.get_run(run.run_id) for folder in (ended, killed) if (run := folder.run())]
    assert [run.info.status for run in runs] == ['FINISHED', 'KILLED']
    assert all('battery_pct' in run.data.metrics for run in runs)
