"""Loses messages on purpose and compares the ledger with what was sent, message by message, on Fast DDS and on Cyclone DDS.

Publishers of both, one and several per topic, RELIABLE and BEST_EFFORT, small and large, number their messages. The node is
stopped for seconds, starved, and killed and restarted, and a publisher is killed and replaced, once while the node is not
running. Every message that the node keeps is stored, so a gap in the numbers of the store is what was missed, or what a kill
took from open batches (``dropped: restart``). If the ledger is ``exact``, all its counts must be those of the numbers. A second
node gets no numbers: it must not claim that nothing was lost, and its estimates must be close.

Messages that a publisher sends at its very end, after which none arrives, are in no gap and in no ledger: they are reported here.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.numbered import parse_numbered
from e2e.processes import Node, Processes, Publisher, until

from shadowhound_data_logger.spool.estimator import RESTART
from shadowhound_data_logger.spool.gaps import EXACT
from torture._command import Check, parser, progress, verdict, workshop

ROUNDS: Final = 10
SHORT_ROUNDS: Final = 1
ROBOT: Final = 'torture'
STRING: Final = 'std_msgs/msg/String'
CYCLONE: Final = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
LEAVE_OUT: Final = """
from shadowhound_data_logger.core import model
class Taken(model.Taken):
    def __new__(cls, cdr, source_ns, publisher, number, *times):
        return super().__new__(cls, cdr, source_ns, None, None, *times)
model.Taken = Taken
"""
"""A node without message numbers; rclpy is not imported before the node has chosen a middleware."""
STOPPED_S: Final = 3.0
STARVED_S: Final = 4.5
STARVED_TURN_S: Final = 0.05
STARVED_EACH_S: Final = 1.5
"""A starved node runs so rarely that more messages arrive in between than buffers hold."""
KILLED_S: Final = 1.0
STEADY_S: Final = 2.0
"""Between two disturbances; at the start a topic's rate must be learned, 200 intervals of it."""
LEARN_S: Final = 25.0
SHORT_LEARN_S: Final = 6.0
"""Enough for small messages: large ones have a fifth of their rate."""
BATCH_S: Final = 0.5
OPEN_S: Final = BATCH_S + 1.5
"""Maximum age of messages lost in a kill; 0.3 s beyond the batch on an idle machine."""
ESTIMATE: Final = 0.05
"""Maximum relative error of an estimate, plus this many messages for each disturbance."""
ESTIMATE_SLACK: Final = 1


Sent = dict[tuple[str, str], 'int | None']
"""(topic, name of the publisher) -> number of messages sent; None if it was killed, because that is unknown then."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic."""

    topic: str
    reliable: bool
    size: int
    period_s: float
    by: tuple[str, ...]
    """Its publishers: keys of ``Robot.publishers``."""


PUBLISHERS: Final = ('fast', 'cyclone', 'mortal')
KINDS: Final = {'small': (40, 0.02), 'large': (60_000, 0.1)}
STREAMS: Final = tuple(
    Stream(f'/{who}_{size}_{"reliable" if reliable else "best_effort"}', reliable, *KINDS[size], by)
    for who, by in (('fast', ('fast',)), ('cyclone', ('cyclone',)), ('several', PUBLISHERS))
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

    def start(self, who: str, generation: int, *, matched: bool = True) -> None:
        """With ``matched`` its first messages have a subscriber."""
        publisher = self.publishers[who] = self.processes.publisher(cyclone=who != 'fast')
        self.names[who] = f'{who}{generation}'
        for stream in self.of(who):
            publisher.create(stream.topic, STRING, reliable=stream.reliable, depth=10)
        for stream in self.of(who):
            if matched:
                publisher.matched(stream.topic)
            publisher.begin_numbered(stream.topic, self.names[who], stream.size, stream.period_s)

    def replace(self, who: str, generation: int) -> None:
        """Kill it at work, and start another one."""
        self.publishers[who].kill()
        for stream in self.of(who):
            self.sent[stream.topic, self.names[who]] = None
        self.start(who, generation)

    def stop(self, who: str) -> None:
        """What it has sent by now is all that it ever sends."""
        for stream in self.of(who):
            self.sent[stream.topic, self.names[who]] = self.publishers[who].halt_numbered(stream.topic)

    @staticmethod
    def of(who: str) -> list[Stream]:
        return [stream for stream in STREAMS if who in stream.by]


@dataclass(slots=True)
class Nodes:
    """The node, and one without message numbers; each disturbance affects both."""

    processes: Processes
    start: Mapping[str, Callable[[], Node]]
    running: dict[str, Node] = field(default_factory=dict)

    def open(self) -> None:
        """Start them; returns when each topic is received."""
        self.running = {name: start() for name, start in self.start.items()}
        self.await_received()

    def await_received(self) -> None:
        """Wait until more messages of each topic have arrived."""
        for node in self.running.values():
            before = {stream.topic: node.topic(stream.topic).get('received', 0) for stream in STREAMS}
            for topic, count in before.items():
                node.received(topic, count + 1)

    def stopped(self) -> None:
        self._signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        self._signal(signal.SIGCONT)

    def starved(self) -> None:
        """As if other processes used all cores: a time slice now and then."""
        end = time.monotonic() + STARVED_S
        while time.monotonic() < end:
            self._signal(signal.SIGSTOP)
            time.sleep(STARVED_EACH_S - STARVED_TURN_S)
            self._signal(signal.SIGCONT)
            time.sleep(STARVED_TURN_S)

    def killed(self) -> None:
        for node in self.running.values():
            node.kill()
        time.sleep(KILLED_S)
        self.open()

    def end(self) -> dict[str, Any]:
        """Stop them cleanly, which loses no received message; returns the ledger of each."""
        return {name: node.stop() for name, node in self.running.items()}

    def _signal(self, number: int) -> None:
        for node in self.running.values():
            node.signal(number)


@dataclass(slots=True)
class Truth:
    """The numbers of a topic in the store of a node."""

    stored: int = 0
    absent: int = 0
    """Between the first and the last one of a publisher."""
    gaps: int = 0
    twice: int = 0
    at_the_end: int = 0
    """After the last one, of publishers whose count is known."""

    @property
    def published(self) -> int:
        return self.stored + self.absent


def truth(home: Path, sent: Sent) -> dict[str, Truth]:
    """By topic."""
    numbers: dict[tuple[str, str], list[int]] = {}
    for path in (home / 'store' / 'sensor-data' / ROBOT).rglob('*.json'):
        if '_ledger' not in path.parts:
            document = json.loads(path.read_bytes())
            for sample in document['samples']:
                name, number = parse_numbered(sample['data'])
                numbers.setdefault((document['topic'], name), []).append(number)
    found = {stream.topic: Truth() for stream in STREAMS}
    for (topic, name), came in numbers.items():
        came.sort()
        row, kept = found[topic], sorted(set(came))
        row.stored += len(kept)
        row.twice += len(came) - len(kept)
        row.absent += kept[-1] - kept[0] + 1 - len(kept)
        row.gaps += sum(after != before + 1 for before, after in pairwise(kept))
        total = sent.get((topic, name))
        row.at_the_end += total - 1 - kept[-1] if total is not None else 0
    return found


@dataclass(slots=True)
class Found:
    """The result of the audit; ``wrong`` by bar."""

    done: Counter[str]
    """Disturbances."""
    wrong: dict[str, list[str]] = field(default_factory=dict)
    grades: dict[str, Counter[str]] = field(default_factory=dict)
    truths: dict[str, dict[str, Truth]] = field(default_factory=dict)
    estimates: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By topic, actual and estimated losses."""

    def fail(self, bar: str, text: str, *, holds: bool) -> None:
        self.wrong.setdefault(bar, [])
        if not holds:
            self.wrong[bar].append(text)

    def bars(self) -> list[Check]:
        return [Check(what, not reported, '; '.join(reported[:3])) for what, reported in self.wrong.items()]


def audit(found: Found, who: str, ledger: Mapping[str, Any], truths: Mapping[str, Truth], done: Counter[str]) -> None:
    """Compare one node's ledger with the numbers in its store."""
    found.truths[who] = dict(truths)
    grades = found.grades.setdefault(who, Counter())
    for stream in STREAMS:
        real, row = truths[stream.topic], ledger['topics'].get(stream.topic)
        found.fail('every topic was heard', f'{who} {stream.topic}', holds=row is not None and real.stored > 0)
        if row is None:
            continue
        grades[row['accounting']] += 1
        names = ('accounting', 'published', 'received', 'missed', 'missed_estimated', 'missed_by', 'dropped', 'by_grade')
        text = f'{who} {stream.topic}: in truth {real}, said { {name: row[name] for name in names} }'
        taken = row['dropped'].get(RESTART, 0)
        most = done['killed'] * len(stream.by) * OPEN_S / stream.period_s
        found.fail('nothing was stored twice', text, holds=not real.twice)
        found.fail('stored is what is in the store', text, holds=row['stored'] == real.stored)
        found.fail('received is stored, or what a kill took', text, holds=row['received'] == real.stored + taken)
        found.fail('a kill takes no more than what is open', text, holds=taken <= most)
        lost = real.absent - taken
        if row['accounting'] == EXACT:
            found.fail('exact: published is what was sent', text, holds=row['published'] == real.published)
            found.fail('exact: missed is what was sent and did not come', text, holds=row['missed'] == lost)
        else:
            found.fail('without numbers nobody says "missed 0"', text, holds=row['missed'] is None)
        if row['missed_estimated'] is not None:
            room = ESTIMATE * lost + ESTIMATE_SLACK * done.total()
            found.fail(f'estimated: within {ESTIMATE:.0%}', text, holds=abs(row['missed_estimated'] - lost) <= room)
            found.estimates[stream.topic] = lost, row['missed_estimated']


def parameters() -> dict[str, Any]:
    """Every message of each topic is stored."""
    given: dict[str, Any] = {'sensors': [stream.topic.strip('/') for stream in STREAMS], 'robot': ROBOT,
                             'queue.max_bytes': 256 << 20}  # fmt: skip
    for stream in STREAMS:
        name = stream.topic.strip('/')
        given |= {f'{name}.topics': [name], f'{name}.types': [STRING], f'{name}.rate_hz': 0.0, f'{name}.batch_s': BATCH_S}
    return given


def campaign(folder: Path, rounds: int, rng: random.Random, learn_s: float) -> Found:
    """Run and audit."""
    hidden = folder / 'hidden'
    hidden.mkdir(parents=True)
    (hidden / 'sitecustomize.py').write_text(LEAVE_OUT)
    path = os.pathsep.join(filter(None, (str(hidden), os.environ.get('PYTHONPATH', ''))))
    with free_domain() as domain:
        processes = Processes(folder, domain, ROBOT)
        nodes = Nodes(processes, {
            'numbered': lambda: processes.node(None, parameters(), environ=CYCLONE),
            'unnumbered': lambda: processes.node(None, parameters(), environ={**CYCLONE, 'PYTHONPATH': path}, home='unnumbered'),
        })  # fmt: skip
        robot = Robot(processes)
        try:
            done = _disturb(nodes, robot, rounds, rng, learn_s)
            ledgers = nodes.end()
        finally:
            processes.end()
    found = Found(done)
    for who, ledger in ledgers.items():
        audit(found, who, ledger, truth(nodes.running[who].home, robot.sent), done)
    exact = found.truths['numbered'].values()
    figures = {name: sum(getattr(real, name) for real in exact) for name in ('absent', 'at_the_end')}
    found.fail('messages were lost, also at the end of a publisher', f'{figures}', holds=min(figures.values()) > 0)
    found.fail('with numbers every topic is exact', f'{found.grades["numbered"]}', holds=set(found.grades['numbered']) == {EXACT})
    return found


def _disturb(nodes: Nodes, robot: Robot, rounds: int, rng: random.Random, learn_s: float) -> Counter[str]:
    """Counts the disturbances; at the end no message is in flight."""
    for who in PUBLISHERS:
        robot.start(who, 0, matched=False)
    nodes.open()
    time.sleep(learn_s)
    done = Counter[str]()

    def replaced() -> None:
        robot.replace('mortal', done.total() + 1)

    def departed() -> None:
        """The publisher exits while the node is not running."""
        nodes.end()
        time.sleep(KILLED_S)
        robot.stop('mortal')
        robot.publishers['mortal'].kill()
        robot.start('mortal', done.total() + 1, matched=False)
        nodes.open()

    disturbances = {
        'stopped': nodes.stopped, 'starved': nodes.starved, 'killed': nodes.killed, 'replaced': replaced, 'departed': departed,
    }  # fmt: skip
    for turn in range(rounds):
        for name in rng.sample(list(disturbances), len(disturbances)):
            progress(f'round {turn + 1}: {name}')
            disturbances[name]()
            time.sleep(STEADY_S)
            done[name] += 1
    nodes.await_received()
    time.sleep(STEADY_S)
    for who in PUBLISHERS:
        robot.stop(who)
    quiet(nodes.running.values())
    return done


def quiet(nodes: Collection[Node]) -> None:
    """Returns once they receive nothing any more."""
    seen: list[int] = []

    def is_quiet() -> bool:
        seen.append(sum(row['received'] for node in nodes for row in node.ledger()['topics'].values()))
        time.sleep(0.5)
        return len(seen) > 2 and seen[-1] == seen[-3]

    until(is_quiet, 'nothing is on its way any more')


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('losses', __doc__ or '')
    options.add_argument('--rounds', type=int, default=0, help=f'how many of all disturbances (default {ROUNDS})')
    given = options.parse_args(argv)
    rounds = given.rounds or (SHORT_ROUNDS if given.short else ROUNDS)
    progress(f'{rounds} rounds, seed {given.seed}')
    with workshop(given) as shop:
        found = campaign(shop.folder, rounds, random.Random(given.seed), SHORT_LEARN_S if given.short else LEARN_S)
        shop.passed = all(bar.holds for bar in found.bars())
    if not given.json:
        for topic, real in found.truths['numbered'].items():
            figures = f'sent {real.published:6}  absent {real.absent:6} in {real.gaps:4} gaps  at the end {real.at_the_end:5}'
            lost, estimate = found.estimates.get(topic, ('-', '-'))
            print(f'{topic:28} {figures}  without numbers: lost {lost:>6} estimated {estimate:>6}')
    rows = {who: {topic: asdict(real) for topic, real in each.items()} for who, each in found.truths.items()}
    told_all = {'seed': given.seed, 'disturbances': found.done, 'topics': rows, 'grades': found.grades,
                'estimates': found.estimates}  # fmt: skip
    return verdict(told_all, found.bars(), as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
