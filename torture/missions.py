"""Kills the mission agent repeatedly with SIGKILL during its missions, with Tower up and down.

Half of the time the sending process is killed with it. Afterwards each mission must be one run in a real MLflow server, ended as
KILLED at its last record, with every point and frame whose call had returned, each once; the same in the store.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from e2e.processes import until
from e2e.wire import HANG, PASS, REFUSE, Wire
from missions.agent import FRAME_EVERY, jpeg
from missions.server import Server
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, missions, read_json
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop

KILLS: Final = 50
SHORT_KILLS: Final = 5
LIVE_S: Final = (0.05, 4.0)
SENDER_TOO: Final = 0.5
"""How often the replayer is killed with its agent, as in a power cut."""
DELIVER_S: Final = 600.0
COMMAND: Final = 'torture'


@dataclass(slots=True)
class Agent:
    """What an agent's calls had returned for when it was killed."""

    mission_id: str
    acknowledged: int


@dataclass(slots=True)
class Found:
    """Violations, by bar; and how much was checked."""

    wrong: dict[str, list[str]] = field(default_factory=lambda: {'runs': [], 'points': [], 'artifacts': [], 'store': []})
    points: int = 0
    frames: int = 0


class Killer:
    """One agent after the other in one home. Lifecycle: New; run once."""

    def __init__(self, folder: Path, wire: Wire, environ: dict[str, str], rng: random.Random) -> None:
        self._home, self._wire, self._rng = folder / 'home', wire, rng
        self._csv = folder / 'trajectory.csv'
        self._csv.write_text('timestamp,x,y,yaw\n')
        test = Path(__file__).parents[1] / 'test'
        path = os.pathsep.join(filter(None, (os.environ.get('PYTHONPATH'), str(test))))
        self._environ = {**os.environ, **environ, 'PYTHONPATH': path}

    def run(self, kills: int) -> list[Agent]:
        agents: list[Agent] = []
        began = time.monotonic()
        for number in range(1, kills + 1):
            self._wire.set(self._rng.choice((PASS, PASS, REFUSE, HANG)))
            agents.append(self._live())
            if self._rng.random() < SENDER_TOO:
                self._kill_sender()
            if number % 10 == 0:
                progress(f'{number} kills in {time.monotonic() - began:.0f} s')
        self._kill_sender()
        self._wire.set(PASS)
        return agents

    def _live(self) -> Agent:
        command = [sys.executable, '-m', 'missions.agent', str(self._home), COMMAND, str(self._csv)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=self._environ) as agent:
            assert agent.stdout is not None
            reported = agent.stdout.readline()
            time.sleep(self._rng.uniform(*LIVE_S))  # a random life span, not a wait for a condition
            agent.kill()
            lines = (reported + agent.stdout.read()).decode().splitlines()
        given = lines[0]
        acknowledged = int(lines[-1]) if len(lines) > 1 else -1
        return Agent(next(folder.mission_id for folder in missions(self._home) if given in _ids(folder)), acknowledged)

    def _kill_sender(self) -> None:
        pid = read_json(self._home / MISSIONS / 'replay.json').get('pid')
        if pid:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def _ids(folder: MissionFolder) -> tuple[str, str]:
    run = folder.run()
    return folder.mission_id, run.run_id if run else ''


def audit(server: Server, home: Path, agents: Sequence[Agent], objects: Counter[str]) -> Found:
    """Compare MLflow and the store with the agents' returned calls and the journals."""
    found = Found()
    by_mission: dict[str, list[Any]] = {}
    for run in server.runs(COMMAND):
        by_mission.setdefault(run.data.tags['shadowhound.mission_id'], []).append(run)
    for agent in agents:
        runs = by_mission.get(agent.mission_id, [])
        folder = MissionFolder(home / MISSIONS / agent.mission_id)
        reported = [line.record for line in read(folder.journal) if line.record]
        if len(runs) != 1 or runs[0].info.status != 'KILLED' or runs[0].info.end_time != reported[-1]['t'] // 1_000_000:
            found.wrong['runs'].append(f'{agent.mission_id}: {[(run.info.run_id, run.info.status) for run in runs]}')
            continue
        _audit(found, server, agent, reported, runs[0].info.run_id, objects)
    return found


def _audit(found: Found, server: Server, agent: Agent, reported: list[Any], run_id: str, objects: Counter[str]) -> None:
    steps = [point.step for point in server.history(run_id, 'battery_pct')]
    found.points += len(steps)
    if steps != list(range(len(steps))) or len(steps) <= agent.acknowledged:
        found.wrong['points'].append(f'{agent.mission_id}: {len(steps)} points, {agent.acknowledged + 1} acknowledged')
    frames = {record['id'] for record in reported if record['k'] == 'frame'}
    found.frames += len(frames)
    wanted = {f'camera/frame_{number:06d}.jpg' for number in frames} | {'summary.json'}
    wanted |= {'trajectories/trajectory.csv'} if any(record['k'] == 'trajectory' for record in reported) else set()
    there = server.artifacts(run_id)
    pictures = {'battery.png'} if len(steps) > 1 else set()  # frames are not images here, and the robot does not walk
    if wanted | pictures != there or not frames >= set(range(0, agent.acknowledged + 1, FRAME_EVERY)):
        found.wrong['artifacts'].append(f'{agent.mission_id}: {sorted((wanted | pictures) ^ there)[:5]}')
    prefix = f'thor/missions/{run_id}/'
    stored = Counter({key: count for key, count in objects.items() if key.startswith(prefix)})
    names = {prefix + name.replace('trajectories/', '') for name in wanted}
    if stored != Counter(names):
        found.wrong['store'].append(f'{agent.mission_id}: {sorted(set(stored) ^ names)[:5]}')


def stored(tower: Tower) -> Counter[str]:
    """All keys of the bucket; raises AssertionError for a frame with another frame's content."""
    store = S3Store(tower.store_settings(), UploadSettings())
    store.open()
    try:
        keys = Counter(item.key for item in store.list('sensor-data', 'thor/missions/'))
        for key in keys:
            if key.endswith('.jpg'):
                assert store.get('sensor-data', key) == jpeg(int(key[-10:-4])), key
    finally:
        store.close()
    return keys


def campaign(folder: Path, kills: int, seed: int) -> Found:
    """Run and audit."""
    with Tower(folder / 'tower', mlflow=True) as tower, Wire(tower.tracking_uri) as wire:
        environ = tower.environment() | {'MLFLOW_TRACKING_URI': wire.url, 'MLFLOW_HTTP_REQUEST_TIMEOUT': '3'}
        agents = Killer(folder, wire, environ, random.Random(seed)).run(kills)
        progress('the last one lives and sends what is left')
        os.environ |= environ
        home = folder / 'home'
        logger = MissionDataLogger(home=home)
        try:
            until(lambda: all(each.sent().complete for each in missions(home)), 'every mission is sent', DELIVER_S)
        finally:
            logger.close()
        until(lambda: not read_json(home / MISSIONS / 'replay.json').get('pid'), 'every object is delivered', DELIVER_S)
        progress('every run is read back')
        return audit(Server(tower, wire), home, agents, stored(tower))


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parse_kills(parser('missions', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    with workshop(given) as shop:
        found = campaign(shop.folder, given.kills, given.seed)
        what = {
            'runs': 'each mission is one run, KILLED at its last record', 'points': 'each point that was logged is there once',
            'artifacts': 'each artifact that was logged is there', 'store': 'each object is in the store once',
        }  # fmt: skip
        bars = [Check(text, not found.wrong[name], '; '.join(found.wrong[name][:3])) for name, text in what.items()]
        bars.append(
            Check('points and frames were looked at', found.points > 0 and found.frames > 0, f'{found.points}, {found.frames}')
        )
        shop.passed = all(bar.holds for bar in bars)
    figures = {'seed': given.seed, 'kills': given.kills, 'points': found.points, 'frames': found.frames}
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
