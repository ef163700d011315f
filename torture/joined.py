"""Kills the node, the mission agent and the sending process, each at random, with MLflow and the store up and down.

The simulated Go2 walks all the time. Afterwards each mission must be one run with every point and frame that agent and node have
journaled, each once; the same in the store; and every object of the robot must name the mission of its time, and no other.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from e2e.processes import Node, Processes, published, until
from e2e.wire import HANG, PASS, REFUSE, Wire
from missions.agent import FRAME_EVERY, NO_CSV
from missions.server import Server, complete
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, missions, read_json
from shadowhound_data_logger.missions.pictures import NAMES
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop
from torture.kills import ROBOT, running

KILLS: Final = 50
SHORT_KILLS: Final = 6
COMMAND: Final = 'joined'
NODE, AGENT, SENDER = 'node', 'agent', 'sender'
UP_S: Final = (0.3, 8.0)
"""A pose waits for two seconds before it is journaled."""
AT_THE_START: Final = 0.2
"""Share of the kills that do not wait until the node listens."""
AGENT_PERIOD_S: Final = 0.02
DELIVER_S: Final = 600.0
NOTICED_NS: Final = 2 * SECOND
"""Maximum delay of a node on a loaded machine in detecting a mission's start or end."""
LAST_NS: Final = SECOND
"""Messages published this shortly before the agent is killed may reach the node after it knows of the end."""
PARAMETERS: Final[dict[str, Any]] = {
    'mission.frame_every_s': 1.0, 'lowstate.batch_s': 1.0,
    'upload.read_timeout_s': 3.0, 'upload.max_backoff_s': 2.0,
}  # fmt: skip


WHAT: Final[dict[str, str]] = {
    'runs': 'each mission is one run, KILLED at its last record', 'agent': 'each call of the agent is in the run once',
    'node': 'each point of the node is in the run once', 'artifacts': 'each artifact is there',
    'store': 'each object of a mission is in the store once', 'marks': 'objects name the mission of their time, and no other',
}  # fmt: skip


@dataclass(slots=True)
class Flight:
    """A mission, and the last call that had returned to its agent."""

    folder: MissionFolder
    acknowledged: int

    @property
    def span_ns(self) -> tuple[int, int]:
        times = [int(line.record['t']) for line in self.folder.lines() if line.record]
        return times[0], times[-1]

    def logged(self, kind: str) -> list[tuple[str, Mapping[str, Any]]]:
        """``agent`` or ``node``, and its records of this kind."""
        sources = (('agent', self.folder.lines()), ('node', self.folder.node_lines()))
        return [(name, line.record) for name, lines in sources for line in lines if line.record and line.record['k'] == kind]


class Killer:
    """One robot, and agents and nodes one after the other in one home. Lifecycle: New; run once."""

    def __init__(self, processes: Processes, wires: Sequence[Wire], environ: dict[str, str], rng: random.Random,
                 agent_period_s: float = AGENT_PERIOD_S) -> None:  # fmt: skip
        self._processes, self._wires, self._environ, self._rng = processes, wires, environ, rng
        self._agent_period_s = agent_period_s
        self.home = processes.folder / 'home'
        self._csv = processes.folder / 'trajectory.csv'
        self._csv.write_text('timestamp,x,y,yaw\n')
        self._agent: subprocess.Popen[bytes] | None = None
        self._reported = processes.folder / 'agent'
        self.node = self._start_node()
        self.counts: Counter[str] = Counter()
        self.flights: list[Flight] = []
        self.ready_ns: list[int] = []

    def run(self, kills: int) -> None:
        sim = self._processes.sim('image_raw:=false')
        self.node.await_log('logging ')
        self._start_agent()
        for number in range(1, kills + 1):
            for wire in self._wires:
                wire.set(self._rng.choice((PASS, PASS, REFUSE, HANG)))
            if self._rng.random() > AT_THE_START:
                self.node.await_log('logging ')
            time.sleep(self._rng.uniform(*UP_S))  # a random life span, not a wait for a condition
            self._kill(self._rng.choice((NODE, AGENT, AGENT, SENDER)))
            if number % 10 == 0:
                progress(f'{number} kills: {dict(self.counts)}')
        for wire in self._wires:
            wire.set(PASS)
        self.node.await_log('logging ')
        self._kill_agent()
        sim.signal(signal.SIGINT)
        published(sim)

    def _kill(self, what: str) -> None:
        self.counts[what] += 1
        if what == NODE:
            self.node.kill()
            self.node = self._start_node()
        elif what == AGENT:
            self._kill_agent()
            self._start_agent()
        elif pid := read_json(self.home / MISSIONS / 'replay.json').get('pid'):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _start_node(self) -> Node:
        return self._processes.node(self._environ, PARAMETERS, ready=False)

    def _start_agent(self) -> None:
        """Half of them log no trajectory, so that the mission has the node's."""
        csv = self._rng.choice((str(self._csv), NO_CSV))
        command = [sys.executable, '-m', 'missions.agent', str(self.home), COMMAND, csv, str(self._agent_period_s)]
        test = str(Path(__file__).parents[1] / 'test')
        path = os.pathsep.join(filter(None, (test, os.environ.get('PYTHONPATH'))))
        environ = {**os.environ, **self._environ, 'SHADOWHOUND_ROBOT': ROBOT, 'PYTHONPATH': path}
        with self._reported.open('wb') as output:
            self._agent = subprocess.Popen(command, stdout=output, env=environ)
        until(lambda: b'\n' in self._reported.read_bytes(), 'the agent has begun its mission')

    def _kill_agent(self) -> None:
        assert self._agent is not None
        self._agent.kill()
        self._agent.wait()
        lines = self._reported.read_text().splitlines()
        known = {flight.folder.mission_id for flight in self.flights}
        (folder,) = [each for each in missions(self.home) if each.mission_id not in known]
        self.flights.append(Flight(folder, int(lines[-1]) if len(lines) > 1 else -1))


@dataclass(slots=True)
class Found:
    """Violations, by bar; and how much was checked."""

    wrong: dict[str, list[str]] = field(default_factory=lambda: {name: [] for name in WHAT})
    looked: Counter[str] = field(default_factory=Counter)


def audit(found: Found, server: Server, flight: Flight, objects: Mapping[str, ObjectInfo]) -> None:
    """Compare one mission's journals with the run and the store."""
    name = flight.folder.mission_id
    runs = [run for run in server.runs(COMMAND) if run.data.tags['shadowhound.mission_id'] == name]
    end_ms = flight.span_ns[1] // 1_000_000
    if [(run.info.status, run.info.end_time) for run in runs] != [('KILLED', end_ms)]:
        found.wrong['runs'].append(f'{name}: {[(run.info.run_id, run.info.status, run.info.end_time) for run in runs]}')
        return
    run_id = runs[0].info.run_id
    logged = [record['s'] for source, record in flight.logged('metrics') if source == AGENT]
    steps = [point.step for point in server.history(run_id, 'battery_pct')] if logged else []
    found.looked['points'] += len(steps)
    is_whole = logged == list(range(len(logged))) and len(logged) > flight.acknowledged
    if not is_whole or steps[: len(logged)] != logged or len(steps) - len(logged) > _both(flight):
        found.wrong['agent'].append(f'{name}: {len(steps)} points of {len(logged)}, {flight.acknowledged + 1} acknowledged')
    wanted = Counter((int(record['t']) // 1_000_000, record['s'], record['m']['pose_x'])
                     for _, record in flight.logged('metrics') if 'pose_x' in record['m'])  # fmt: skip
    there = Counter((point.timestamp, point.step, point.value) for point in server.history(run_id, 'pose_x'))
    found.looked['poses'] += sum(there.values())
    if there != Counter(set(wanted)):
        found.wrong['node'].append(f'{name}: {len(wanted)} journaled, {len(there)} in the run')
    audit_files(found, server, flight, run_id, objects)


def _both(flight: Flight) -> bool:
    """Whether the node has logged the battery as well: then the agent's last value is logged once more, as the newest."""
    return any(name == NODE and 'battery_pct' in record['m'] for name, record in flight.logged('metrics'))


def audit_files(found: Found, server: Server, flight: Flight, run_id: str, objects: Mapping[str, ObjectInfo]) -> None:
    """Frames, trajectory and summary, in the run and in the store."""
    name, frames = flight.folder.mission_id, [record['id'] for _, record in flight.logged('frame')]
    attached = {record['id'] for _, record in flight.logged('frame') if record.get('artifact')}
    found.looked['frames'] += len(frames)
    found.looked['node frames'] += sum(source == NODE for source, _ in flight.logged('frame'))
    if len(set(frames)) != len(frames) or not set(frames) >= set(range(0, flight.acknowledged + 1, FRAME_EVERY)):
        found.wrong['agent'].append(f'{name}: frames {sorted(frames)[:5]}...')
    walked = {'trajectories/trajectory.csv'} if flight.logged('trajectory') or flight.logged('poses') else set()
    wanted = {f'camera/frame_{number:06d}.jpg' for number in attached} | {'summary.json'} | walked
    there = server.artifacts(run_id)
    if not (wanted <= there <= wanted | set(NAMES)):
        found.wrong['artifacts'].append(f'{name}: {sorted(wanted ^ there)[:5]}')
    prefix = f'{ROBOT}/missions/{run_id}/'
    stored = {key for key in objects if key.startswith(prefix)}
    names = {f'camera/frame_{number:06d}.jpg' for number in frames} | {'summary.json'}
    names |= {'trajectory.csv'} if walked else set()
    if stored != {prefix + each for each in names}:
        found.wrong['store'].append(f'{name}: {sorted(stored ^ {prefix + each for each in names})[:5]}')


def audit_marks(found: Found, flights: Sequence[Flight], objects: Mapping[str, ObjectInfo]) -> None:
    """Check the sensors' objects, whose folders do not start with ``_``. At both ends the node may be late by ``NOTICED_NS``.

    Objects of the last ``LAST_NS`` of a mission may have no mission.
    """
    spans = {flight.folder.mission_id: flight.span_ns for flight in flights}
    runs = {flight.folder.mission_id: run.run_id for flight in flights if (run := flight.folder.run())}
    for key, info in objects.items():
        folder = key.split('/')[1]
        if folder == 'missions' or folder.startswith('_') or 't_start_ns' not in info.metadata:
            continue
        at_ns, reported = int(info.metadata['t_start_ns']), info.metadata.get('mission_id')
        found.looked['marked' if reported else 'unmarked'] += 1
        inside = {name for name, (start, end) in spans.items() if start + NOTICED_NS <= at_ns <= end - LAST_NS}
        near = {name for name, (start, end) in spans.items() if start <= at_ns <= end + NOTICED_NS}
        is_right = reported in near if reported else not inside
        if not is_right or (reported and info.metadata.get('run_id', runs.get(reported)) != runs.get(reported)):
            found.wrong['marks'].append(f'{key} says {reported}')


def stored(tower: Tower) -> dict[str, ObjectInfo]:
    """The complete bucket."""
    store = S3Store(tower.store_settings(), UploadSettings())
    store.open()
    try:
        infos = {item.key: store.head('sensor-data', item.key) for item in store.list('sensor-data', f'{ROBOT}/')}
    finally:
        store.close()
    return {key: info for key, info in infos.items() if info}


def campaign(folder: Path, kills: int, seed: int) -> tuple[Found, Counter[str]]:
    """Run and audit."""
    found = Found()
    with Tower(folder / 'tower', mlflow=True) as tower, Wire(tower.tracking_uri) as mlflow, Wire(tower.endpoint_url) as s3:
        environ = tower.environment() | {
            'MLFLOW_TRACKING_URI': mlflow.url, 'AWS_ENDPOINT_URL': s3.url, 'MLFLOW_HTTP_REQUEST_TIMEOUT': '3',
        }  # fmt: skip
        with running(folder) as processes:
            killer = Killer(processes, (mlflow, s3), environ, random.Random(seed))
            killer.run(kills)
            progress('the last one lives and sends what is left')
            os.environ |= environ | {'SHADOWHOUND_ROBOT': ROBOT}
            logger = MissionDataLogger(home=killer.home)
            try:
                until(lambda: complete(killer.home, len(killer.flights)), 'every mission is sent', DELIVER_S)
            finally:
                logger.close()
            killer.node.delivered(1, DELIVER_S)
            killer.node.stop(seconds=60.0)
        progress('every run and object is read back')
        objects, server = stored(tower), Server(tower, mlflow)
        for flight in killer.flights:
            audit(found, server, flight, objects)
        audit_marks(found, killer.flights, objects)
    return found, killer.counts


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parse_kills(parser('joined', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    with workshop(given) as shop:
        found, counts = campaign(shop.folder, given.kills, given.seed)
        bars = [Check(text, not found.wrong[name], '; '.join(found.wrong[name][:3])) for name, text in WHAT.items()]
        looked = {name: found.looked[name] for name in ('points', 'poses', 'frames', 'node frames', 'marked')}
        bars.append(Check('there was something to look at', all(looked.values()), str(dict(found.looked))))
        shop.passed = all(bar.holds for bar in bars)
    return verdict({'seed': given.seed, 'kills': dict(counts), 'looked': dict(found.looked)}, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
