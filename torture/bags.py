"""Kills the node repeatedly with SIGKILL at random points while it records a bag of the simulated Go2 at full rate.

Afterwards every slice of every bag in the store is opened with other readers and compared with a witness; missing messages must
belong to a kill and be within the promised limit, and the ledger must list them.
"""

from __future__ import annotations

import itertools
import random
import signal
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from e2e.bag_reading import Bag, bags
from e2e.processes import Node, Processes, published
from e2e.reading import TYPES
from e2e.witness import Heard, recorded
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop
from torture._kill_audit import HEADERLESS
from torture.kills import ROBOT, running

KILLS: Final = 50
SHORT_KILLS: Final = 3
UP_S: Final = (0.5, 4.0)
AT_THE_START: Final = 0.15
"""Share of the nodes that are killed during their imports, their recovery, or as they start to record."""
START_S: Final = (0.1, 2.0)
LOSS_S: Final = 1.0
"""Maximum loss per kill besides the restart ..."""
CHUNK_S: Final = 0.25
"""... and a chunk of one MiB at 4.5 MB/s. Delays of the machine, as seen by the witness, are added."""
DELIVER_S: Final = 300.0
SECOND: Final = 10**9
BEST_EFFORT: Final = ('/point_cloud2', '/camera/camera_info')
PARAMETERS: Final[dict[str, Any]] = {'bag.record': 'always', 'bag.slice_s': 3.0}


@dataclass(slots=True)
class Found:
    """The result of the audit."""

    kills: int = 0
    bags: int = 0
    slices: int = 0
    messages: int = 0
    lost_ms: list[int] = field(default_factory=list)
    """For each kill: time between the newest recorded message and the kill."""
    allowed_ms: list[int] = field(default_factory=list)
    wrong: dict[str, list[str]] = field(default_factory=dict)

    def fail(self, what: str, text: str) -> None:
        self.wrong.setdefault(what, []).append(text)

    def bars(self) -> Iterator[Check]:
        late = [(lost, allowed) for lost, allowed in zip(self.lost_ms, self.allowed_ms, strict=True) if lost > allowed]
        yield Check('loss per kill at most 1 s and a chunk', not late, f'worst {max(self.lost_ms, default=0)} ms {late or ""}')
        for what in ('slices open in other readers', 'equal bytes in the same order', 'nothing is twice', 'the ledger knows all'):
            yield Check(what, not self.wrong.get(what), '; '.join(self.wrong.get(what, [])[:3]))


@dataclass(frozen=True, slots=True)
class Run:
    """What happened, before the data is audited."""

    deaths: list[tuple[float, bool]]
    """Time of each kill, s since 1970, and whether that node had listened."""
    node: Node
    """The last one."""
    heard: Path
    published: dict[str, int]


def run(processes: Processes, environ: dict[str, str], kills: int, rng: random.Random) -> Run:
    """One robot, one witness, one node after the other."""
    recording, deaths = processes.folder / 'witness', list[tuple[float, bool]]()
    node = processes.node(environ, PARAMETERS)
    witness = processes.witness(TYPES, recording, best_effort=BEST_EFFORT)
    sim = processes.sim('image_raw:=false')
    node.received('/imu', 50)
    for number in range(1, kills + 1):
        if number > 1 and rng.random() < AT_THE_START:
            time.sleep(rng.uniform(*START_S))  # a random life span, not a wait for a condition
        else:
            node.await_log('logging ')
            time.sleep(rng.uniform(*UP_S))
        deaths.append((time.time(), 'logging ' in node.log))
        node.kill()
        assert ledger.imbalances(ledger.read(node.home / 'spool', ROBOT)) == []
        node = processes.node(environ, PARAMETERS, ready=False)
        if number % 10 == 0:
            progress(f'{number} kills')
    node.await_log('logging ')
    node.received('/imu', node.topic('/imu')['received'] + 100)
    sim.signal(signal.SIGINT)
    reported = published(sim)
    node.delivered(1, DELIVER_S)
    node.stop(seconds=60.0)
    witness.signal(signal.SIGTERM)
    witness.wait()
    return Run(deaths, node, recording, reported)


def audit(found: Found, stored: Sequence[Bag], happened: Run, reported: dict[str, Any]) -> None:
    """Compare the bags with the witness and with the ledger."""
    counts: Counter[str] = Counter()
    times: dict[str, list[int]] = {topic: [] for topic in TYPES}
    contents: dict[tuple[str, int], bytes] = {}
    for bag in stored:
        found.bags += 1
        try:
            counts += bag.check()
        except Exception as error:  # noqa: BLE001 - whatever a reader says of it is a finding
            found.fail('slices open in other readers', f'{bag.folder.name}: {type(error).__name__} {error}')
            continue
        found.slices += len(bag.slices)
        for message in bag.messages():
            times[message.topic].append(message.publish_ns)
            if contents.setdefault((message.topic, message.publish_ns), message.cdr) is not message.cdr:
                found.fail('nothing is twice', f'{message.topic} {message.publish_ns} in {bag.folder.name}')
    found.messages = counts.total()
    late_ns = _compare(found, happened.heard, times, contents)
    _audit_losses(found, times, happened.deaths, late_ns)
    for topic, row in reported['bags'].items():
        in_bags = counts[topic]
        if (row['stored'], row['open'], row['published']) != (in_bags, 0, happened.published[topic]):
            text = f'{topic}: {in_bags} in bags of {happened.published[topic]}, but {row}'
            found.fail('the ledger knows all', text)
    if not reported['balanced']:
        found.fail('the ledger knows all', str(ledger.imbalances(reported)))


def stamp_of(message: Heard) -> int:
    """The publish time in a bag: the stamp of the header, otherwise the time of sending."""
    if message.topic in HEADERLESS:
        return message.source_ns
    sec, nanosec = struct.unpack_from('<iI', message.cdr, 4)
    return int(sec * SECOND + nanosec)


def _compare(found: Found, heard_at: Path, times: dict[str, list[int]], contents: dict[tuple[str, int], bytes]) -> int:
    """Recorded messages must be published ones, in order; returns the maximum delay of the witness, ns."""
    order: dict[str, list[int]] = {topic: [] for topic in TYPES}
    gap_ns, before = 0, 0
    for message in recorded(heard_at):
        stamp_ns = stamp_of(message)
        cdr = contents.get((message.topic, stamp_ns))
        if cdr is not None:
            order[message.topic].append(stamp_ns)
            if cdr != message.cdr:
                found.fail('equal bytes in the same order', f'{message.topic} {stamp_ns} differs')
        if message.topic == '/imu':
            gap_ns, before = max(gap_ns, message.source_ns - before if before else 0), message.source_ns
    for topic, recorded_ns in times.items():
        if order[topic] != recorded_ns:
            found.fail('equal bytes in the same order', f'{topic} is in another order, or was not published')
    return gap_ns


def _audit_losses(found: Found, times: dict[str, list[int]], deaths: Sequence[tuple[float, bool]], late_ns: int) -> None:
    """Age of the newest recorded message at each kill of a node that had listened."""
    imu = times['/imu']
    starts = [0, *(round(when * SECOND) for when, _ in deaths)]
    for (before_ns, death_ns), (_, listened) in zip(itertools.pairwise(starts), deaths, strict=True):
        lived = [stamp for stamp in imu if before_ns < stamp <= death_ns]
        if listened and lived:
            found.lost_ms.append((death_ns - max(lived)) // 10**6)
            found.allowed_ms.append(round((LOSS_S + CHUNK_S) * 1000) + late_ns // 10**6)


def campaign(folder: Path, kills: int, seed: int) -> Found:
    """Run and audit; ``folder`` needs some 15 MB/s."""
    found = Found(kills)
    with Tower(folder / 'tower') as tower, running(folder) as processes:
        happened = run(processes, tower.environment(), kills, random.Random(seed))
        reported = ledger.read(happened.node.home / 'spool', ROBOT)
        progress('every bag is read back')
        store = S3Store(tower.store_settings(), UploadSettings())
        store.open()
        try:
            stored = bags(store, ROBOT, folder / 'bags')
        finally:
            store.close()
        audit(found, stored, happened, reported)
        left = list((happened.node.home / 'bags' / ROBOT).glob('*/*'))
        if left:
            found.fail('the ledger knows all', f'{len(left)} files are still in the folder of bags')
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parse_kills(parser('bags', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    with workshop(given) as shop:
        found = campaign(shop.folder, given.kills, given.seed)
        bars = list(found.bars())
        shop.passed = all(bar.holds for bar in bars)
    figures = {
        'seed': given.seed, 'kills': given.kills, 'bags': found.bags, 'slices': found.slices, 'messages': found.messages,
        'lost_ms': found.lost_ms,
    }  # fmt: skip
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
