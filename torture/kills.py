"""Kills the node repeatedly with SIGKILL at random points under full load, with the store up and down.

The simulated Go2 publishes at its full rates, everything is stored, a witness records what was published. Afterwards every
object of the store is compared with it, and missing messages must belong to a kill and be within the promised limit.
"""

from __future__ import annotations

import random
import re
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.processes import Node, Process, Processes, published, until
from e2e.reading import TYPES
from e2e.wire import HANG, PASS, REFUSE, Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop
from torture._kill_audit import BEST_EFFORT, Audit, Heard, Kill, audit

KILLS: Final = 100
SHORT_KILLS: Final = 5
ROBOT: Final = 'thor'
AT_THE_START: Final = 0.2
"""Share of the nodes that are killed before they listen or soon after: during imports, recovery, discovery."""
START_S: Final = (0.1, 2.5)
UP_S: Final = (0.3, 4.0)
STORE_CHANGES: Final = 0.4
"""How often the store changes between kills; half of the time it is up."""
DELIVER_S: Final = 300.0
PARAMETERS: Final[dict[str, Any]] = {
    **{f'{name}.rate_hz': 0.0 for name in ('camera', 'lidar', 'odom', 'lowstate')},
    'odom.batch_s': 1.0, 'lowstate.batch_s': 1.0,
    'upload.read_timeout_s': 3.0, 'upload.max_backoff_s': 2.0,
}  # fmt: skip
"""Every message is stored; and a store that is up again is detected within the life of a node."""
READY: Final = re.compile(r'\[(\d+\.\d+)\].*: logging ')


@dataclass(slots=True)
class Run:
    """What happened, before the data is audited."""

    kills: list[Kill]
    reported: dict[str, int]
    ledger: dict[str, Any]
    unbalanced: list[str]
    index: Path
    recording: Path


class Killer:
    """One robot, one witness, one node after the other. Lifecycle: New; run once."""

    def __init__(self, processes: Processes, wire: Wire, environ: dict[str, str], rng: random.Random) -> None:
        self._processes, self._wire, self._environ, self._rng = processes, wire, environ, rng
        self._kills: list[Kill] = []
        self._nodes: list[Node] = []
        self._unbalanced: list[str] = []

    def run(self, kills: int) -> Run:
        recording = self._processes.folder / 'witness'
        self._start().await_log('logging ')
        witness = self._processes.witness(TYPES, recording, best_effort=BEST_EFFORT)
        sim = self._processes.sim('image_raw:=false')
        until(lambda: self._nodes[0].topic('/imu').get('received'), 'the first messages are received')
        began = time.monotonic()
        for number in range(1, kills + 1):
            self._turn_store()
            self._live()
            self._kill()
            self._start()
            _publishes(sim, recording)
            if number % 10 == 0:
                progress(f'{number} kills in {time.monotonic() - began:.0f} s')
        self._wire.set(PASS)
        return self._finish(sim, witness, recording)

    def _finish(self, sim: Process, witness: Process, recording: Path) -> Run:
        """The last node runs, delivers everything and stops."""
        node = self._nodes[-1]
        node.await_log('logging ')
        before = node.topic('/imu')['received']
        node.received('/imu', before + 200, 30.0)
        sim.signal(signal.SIGINT)
        reported = published(sim)
        progress('all that is left is delivered')
        node.delivered(1, DELIVER_S)
        last_report = node.stop(seconds=60.0)
        witness.signal(signal.SIGTERM)
        witness.wait()
        ready = [_ready(node) for node in self._nodes[1:]]
        kills = [Kill(kill.at, when) for kill, when in zip(self._kills, ready, strict=True)]
        return Run(kills, reported, last_report, self._unbalanced, node.home / 'spool' / 'index.db', recording)

    def _start(self) -> Node:
        self._nodes.append(self._processes.node(self._environ, PARAMETERS, ready=False))
        return self._nodes[-1]

    def _live(self) -> None:
        """Let the node run for a random time."""
        node, rng = self._nodes[-1], self._rng
        if rng.random() < AT_THE_START and self._kills:
            time.sleep(rng.uniform(*START_S))  # a random life span, not a wait for a condition
        else:
            node.await_log('logging ')
            time.sleep(rng.uniform(*UP_S))

    def _kill(self) -> None:
        node = self._nodes[-1]
        self._kills.append(Kill(time.time(), float('inf')))
        node.kill()
        found = ledger.imbalances(ledger.read(node.home / 'spool', ROBOT))
        self._unbalanced += [f'after kill {len(self._kills)}: {line}' for line in found]

    def _turn_store(self) -> None:
        if self._rng.random() < STORE_CHANGES:
            self._wire.set(self._rng.choice((PASS, PASS, REFUSE, HANG)))


def _publishes(sim: Process, recording: Path) -> None:
    """Wait until the witness receives more from the robot: otherwise the next nodes would have nothing to lose."""
    before = recording.stat().st_size
    until(lambda: recording.stat().st_size > before,
          lambda: f'the witness hears the robot, whose exit code is {sim.popen.poll()}')  # fmt: skip


def _ready(node: Node) -> float:
    """When the node listened, by its own log, s since 1970."""
    found = READY.search(node.log)
    return float(found[1]) if found else float('inf')


@contextmanager
def running(folder: Path) -> Iterator[Processes]:
    """Processes in a separate domain; none keeps running, whatever happens."""
    with free_domain() as domain:
        processes = Processes(folder, domain, ROBOT)
        try:
            yield processes
        finally:
            processes.end()


def campaign(folder: Path, kills: int, seed: int) -> tuple[Run, Audit]:
    """Run and audit; ``folder`` needs some 10 MB/s."""
    with Tower(folder / 'tower') as tower:
        with Wire(tower.endpoint_url) as wire, running(folder) as processes:
            environ = tower.environment() | {'AWS_ENDPOINT_URL': wire.url}
            run = Killer(processes, wire, environ, random.Random(seed)).run(kills)
        progress('every object is read back')
        store = S3Store(tower.store_settings(), UploadSettings())
        store.open()
        try:
            found = audit(Heard(run.recording), run.reported, run.ledger, run.index, store, ROBOT, run.kills)
        finally:
            store.close()
    found.wrong['unbalanced'] += run.unbalanced
    return run, found


def print_losses(table: dict[str, dict[str, float]]) -> None:
    """A line for each topic."""
    print('lost per kill      gaps   of what was received: median  worst     with the restart: median  worst')
    for topic, row in table.items():
        cells = [
            f'{row[f"{what}_samples_{word}"]:6g} {row[f"{what}_ms_{word}"]:6g} ms'
            for what in ('received', 'all')
            for word in ('median', 'worst')
        ]
        print(f'{topic:18} {row["gaps"]:4g}  ', '   '.join(cells))


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parse_kills(parser('kills', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    began = time.monotonic()
    with workshop(given) as shop:
        run, found = campaign(shop.folder, given.kills, given.seed)
        bars = [Check('kills', len(run.kills) == given.kills, str(given.kills)), *found.bars()]
        shop.passed = all(bar.holds for bar in bars)
    losses = found.losses()
    if not given.json:
        print(f'{given.kills} kills in {time.monotonic() - began:.0f} s, seed {given.seed}:', found.objects, 'objects,',
              found.samples, 'samples')  # fmt: skip
        print_losses(losses)
    figures = {'seed': given.seed, 'kills': given.kills, 'objects': found.objects, 'samples': found.samples, 'losses': losses}
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
