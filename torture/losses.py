"""Loses messages on purpose and holds the ledger to what was sent, message by message, on Fast DDS and on Cyclone DDS.

Publishers of both, alone and several on a topic, RELIABLE and BEST_EFFORT, small and large, number what they send.
Meanwhile the node is stopped for seconds, starved, and killed and started again, and a publisher is killed and replaced. Every
message that arrives is stored, so the numbers in the store are what was received. Where the ledger says ``exact``, published,
received and missed are those of the numbers; a second node that is told no numbers must not claim that nothing was lost.

What a publisher sends at its very end, after which nothing of it arrives, is in no gap and in no ledger: it is told here.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.numbered import told
from e2e.processes import Node, Processes, Publisher, until

from shadowhound_data_logger.spool.accounts import ESTIMATED, EXACT
from torture._command import Bar, parser, progress, verdict, workshop

ROUNDS: Final = 10
SHORT_ROUNDS: Final = 1
ROBOT: Final = 'torture'
STRING: Final = 'std_msgs/msg/String'
CYCLONE: Final = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
LEAVE_OUT: Final = """
from shadowhound_data_logger import model
from shadowhound_data_logger.capture import reader
reader.Taken = lambda cdr, source_ns, publisher, number, received_ns: model.Taken(cdr, source_ns, None, None, received_ns)
"""
"""What a node sees of messages that nobody numbers."""
STOPPED_S: Final = 3.0
STARVED_S: Final = 3.0
STARVED_TURN_S: Final = 0.03
"""A starved node has so long of each half second."""
KILLED_S: Final = 1.0
STEADY_S: Final = 2.0
"""Between two disturbances; at the beginning the rhythm of a topic has to be learned, 200 intervals of it."""
LEARN_S: Final = 6.0
CLOSING: Final = 5
"""Messages at the end, so far apart that each arrives: what was lost before them is in a gap then."""
CLOSING_S: Final = 0.3
ESTIMATE: Final = 0.05
"""How far an estimate may be off, and so many messages for each disturbance besides."""
ESTIMATE_SLACK: Final = 3


Sent = dict[tuple[str, str], 'int | None']
"""(topic, name of the publisher) -> how many messages it sent; None where it was killed: that is not known then."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic."""

    topic: str
    reliable: bool
    size: int
    period_s: float
    by: tuple[str, ...]
    """Who publishes on it: keys of ``Robot.publishers``."""


KINDS: Final = {'small': (40, 0.02), 'large': (60_000, 0.1)}
STREAMS: Final = tuple(
    Stream(f'/{who}_{size}_{"reliable" if reliable else "best_effort"}', reliable, *KINDS[size], by)
    for who, by in (('fast', ('fast',)), ('cyclone', ('cyclone',)), ('several', ('fast', 'cyclone', 'mortal')))
    for size in KINDS
    for reliable in (True, False)
)


@dataclass(slots=True)
class Robot:
    """Its publishers, and what they have sent."""

    processes: Processes
    publishers: dict[str, Publisher] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    sent: Sent = field(default_factory=dict)

    def start(self, who: str, generation: int = 0) -> None:
        publisher = self.publishers[who] = self.processes.publisher(cyclone=who != 'fast')
        self.names[who] = f'{who}{generation}'
        for stream in self.of(who):
            publisher.create(stream.topic, STRING, reliable=stream.reliable, depth=10)
        for stream in self.of(who):
            publisher.matched(stream.topic)
        self.begin(who)

    def begin(self, who: str) -> None:
        for stream in self.of(who):
            self.publishers[who].begin_numbered(stream.topic, self.names[who], stream.size, stream.period_s)

    def replace(self, who: str, generation: int) -> None:
        """Kill it in the middle of what it does, and start another one."""
        self.publishers[who].kill()
        for stream in self.of(who):
            self.sent[stream.topic, self.names[who]] = None
        self.start(who, generation)

    def close(self) -> None:
        """All they had to say, then a few more so far apart that each arrives."""
        for who in self.publishers:
            for stream in self.of(who):
                self.publishers[who].halt_numbered(stream.topic)
        time.sleep(STEADY_S)  # what is on its way comes first, or finds no room
        for who, publisher in self.publishers.items():
            for stream in self.of(who):
                publisher.begin_numbered(stream.topic, self.names[who], stream.size, CLOSING_S)
        time.sleep(CLOSING * CLOSING_S)
        for who, publisher in self.publishers.items():
            for stream in self.of(who):
                self.sent[stream.topic, self.names[who]] = publisher.halt_numbered(stream.topic)

    @staticmethod
    def of(who: str) -> list[Stream]:
        return [stream for stream in STREAMS if who in stream.by]


@dataclass(slots=True)
class Nodes:
    """The node, and one that is told no numbers; each disturbance is for both."""

    processes: Processes
    start: Mapping[str, Callable[[], Node]]
    running: dict[str, Node] = field(default_factory=dict)

    def open(self) -> None:
        self.running = {name: start() for name, start in self.start.items()}

    def stopped(self) -> None:
        self._signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        self._signal(signal.SIGCONT)

    def starved(self) -> None:
        """As by others that have all of the cores: a turn now and then."""
        end = time.monotonic() + STARVED_S
        while time.monotonic() < end:
            self._signal(signal.SIGSTOP)
            time.sleep(0.5 - STARVED_TURN_S)
            self._signal(signal.SIGCONT)
            time.sleep(STARVED_TURN_S)

    def killed(self) -> None:
        for node in self.running.values():
            node.kill()
        time.sleep(KILLED_S)
        self.open()

    def _signal(self, number: int) -> None:
        for node in self.running.values():
            node.signal(number)


@dataclass(slots=True)
class Truth:
    """What the numbers in the store of a node say of a topic."""

    received: int = 0
    missed: int = 0
    twice: int = 0
    at_the_end: int = 0
    """Sent by publishers that lived, after the last one that came."""
    gaps: int = 0


def truth(home: Path, sent: Sent) -> dict[str, Truth]:
    """By topic."""
    numbers: dict[tuple[str, str], list[int]] = {}
    for path in (home / 'store' / 'sensor-data' / ROBOT).rglob('*.json'):
        if '_ledger' not in path.parts:
            document = json.loads(path.read_bytes())
            for sample in document['samples']:
                name, number = told(sample['data'])
                numbers.setdefault((document['topic'], name), []).append(number)
    found = {stream.topic: Truth() for stream in STREAMS}
    for (topic, name), came in numbers.items():
        came.sort()
        row, kept = found[topic], sorted(set(came))
        row.received += len(kept)
        row.twice += len(came) - len(kept)
        row.missed += kept[-1] - kept[0] + 1 - len(kept)
        row.gaps += sum(after != before + 1 for before, after in pairwise(kept))
        total = sent.get((topic, name))
        row.at_the_end += total - 1 - kept[-1] if total is not None else 0
    return found


@dataclass(slots=True)
class Found:
    """What the audit says; ``wrong`` by bar."""

    wrong: dict[str, list[str]] = field(default_factory=dict)
    grades: dict[str, Counter[str]] = field(default_factory=dict)
    truths: dict[str, dict[str, Truth]] = field(default_factory=dict)

    def say(self, bar: str, text: str, *, holds: bool) -> None:
        self.wrong.setdefault(bar, [])
        if not holds:
            self.wrong[bar].append(text)

    def bars(self) -> list[Bar]:
        return [Bar(what, not said, '; '.join(said[:3])) for what, said in self.wrong.items()]


def audit(found: Found, who: str, ledger: Mapping[str, Any], truths: Mapping[str, Truth], *, disturbances: int) -> None:
    """One node's ledger against the numbers in its store."""
    found.truths[who] = dict(truths)
    grades = found.grades.setdefault(who, Counter())
    for topic, real in truths.items():
        row = ledger['topics'].get(topic)
        found.say('every topic was heard', f'{who} {topic}', holds=row is not None and real.received > 0)
        if row is None:
            continue
        grades[row['accounting']] += 1
        said = {name: row[name] for name in ('accounting', 'published', 'received', 'missed', 'missed_estimated', 'missed_by')}
        text = f'{who} {topic}: in truth {real}, said {said}'
        found.say('nothing was stored twice', text, holds=not real.twice)
        found.say('received is what came', text, holds=row['received'] == real.received and not row['dropped'])
        if row['accounting'] == EXACT:
            found.say('exact: missed is what was sent and did not come', text, holds=row['missed'] == real.missed)
            found.say('exact: published = received + missed', text, holds=row['published'] == real.received + real.missed)
        else:
            found.say('without numbers nobody says "missed 0"', text, holds=row['missed'] is None)
        if row['accounting'] == ESTIMATED:
            room = ESTIMATE * real.missed + ESTIMATE_SLACK * disturbances
            close = row['missed_estimated'] is not None and abs(row['missed_estimated'] - real.missed) <= room
            found.say(f'estimated: within {ESTIMATE:.0%}', text, holds=close)


def parameters() -> dict[str, Any]:
    """Every message of each topic is stored."""
    given: dict[str, Any] = {'sensors': [stream.topic.strip('/') for stream in STREAMS], 'robot': ROBOT,
                             'intake.history_bytes': 256 << 20, 'queue.max_bytes': 256 << 20}  # fmt: skip
    for stream in STREAMS:
        name = stream.topic.strip('/')
        given |= {f'{name}.topics': [name], f'{name}.types': [STRING], f'{name}.rate_hz': 0.0, f'{name}.batch_s': 0.5}
    return given


def campaign(folder: Path, rounds: int, rng: random.Random) -> tuple[Found, int]:
    """Run and judge; how many disturbances there were."""
    hidden = folder / 'hidden'
    hidden.mkdir(parents=True)
    (hidden / 'sitecustomize.py').write_text(LEAVE_OUT)
    path = os.pathsep.join(filter(None, (str(hidden), os.environ.get('PYTHONPATH', ''))))
    with free_domain() as domain:
        processes = Processes(folder, domain, ROBOT)
        nodes = Nodes(processes, {
            'numbered': lambda: processes.node(None, parameters(), environ=CYCLONE),
            'unnumbered': lambda: processes.node(None, parameters(), environ={'PYTHONPATH': path}, home='unnumbered'),
        })  # fmt: skip
        try:
            done, ledgers, sent = _run(nodes, Robot(processes), rounds, rng)
        finally:
            processes.end()
    found = Found()
    for who, ledger in ledgers.items():
        audit(found, who, ledger, truth(nodes.running[who].home, sent), disturbances=done)
    told_numbers = found.truths['numbered']
    lost = sum(real.missed for real in told_numbers.values())
    found.say('messages were lost, as they were meant to be', f'{lost}', holds=lost > 0)
    found.say('with numbers every topic is exact', f'{found.grades["numbered"]}', holds=set(found.grades['numbered']) == {EXACT})
    return found, done


def _run(nodes: Nodes, robot: Robot, rounds: int, rng: random.Random) -> tuple[int, dict[str, Any], Sent]:
    """How many disturbances there were, the last ledger of each node, and what was sent."""
    nodes.open()
    for who in ('fast', 'cyclone', 'mortal'):
        robot.start(who)
    for node in nodes.running.values():
        for stream in STREAMS:
            node.received(stream.topic, 1)
    time.sleep(LEARN_S)
    done = 0
    for turn in range(rounds):
        disturbances = {'stopped': nodes.stopped, 'starved': nodes.starved, 'killed': nodes.killed,
                        'replaced': lambda turn=turn: robot.replace('mortal', turn + 1)}  # fmt: skip
        for name in rng.sample(list(disturbances), len(disturbances)):
            progress(f'round {turn + 1}: {name}')
            disturbances[name]()
            time.sleep(STEADY_S)
            done += 1
    _heard_again(nodes)
    robot.close()
    return done, {who: _stopped(node) for who, node in nodes.running.items()}, robot.sent


def _heard_again(nodes: Nodes) -> None:
    """Every topic goes on to arrive."""
    for node in nodes.running.values():
        before = {stream.topic: node.topic(stream.topic).get('received', 0) for stream in STREAMS}
        for topic, count in before.items():
            node.received(topic, count + 1)


def _stopped(node: Node) -> dict[str, Any]:
    """Once nothing comes any more; its ledger."""
    seen: list[int] = []

    def quiet() -> bool:
        seen.append(sum(row['received'] for row in node.ledger()['topics'].values()))
        time.sleep(0.5)
        return len(seen) > 2 and seen[-1] == seen[-3]

    until(quiet, 'nothing is on its way any more')
    return node.stop()


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 when everything held."""
    options = parser('losses', __doc__ or '')
    options.add_argument('--rounds', type=int, default=0, help=f'how many of all disturbances, {ROUNDS} unless told')
    given = options.parse_args(argv)
    rounds = given.rounds or (SHORT_ROUNDS if given.short else ROUNDS)
    progress(f'{rounds} rounds, seed {given.seed}')
    with workshop(given) as shop:
        found, done = campaign(shop.folder, rounds, random.Random(given.seed))
        shop.passed = all(bar.holds for bar in found.bars())
    if not given.json:
        for topic, real in found.truths['numbered'].items():
            figures = f'received {real.received:6}  missed {real.missed:6} in {real.gaps:4} gaps  at the end {real.at_the_end}'
            print(f'{topic:28} {figures}')
    rows = {who: {topic: asdict(real) for topic, real in each.items()} for who, each in found.truths.items()}
    told_all = {'seed': given.seed, 'disturbances': done, 'topics': rows, 'grades': found.grades}
    return verdict(told_all, found.bars(), as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
