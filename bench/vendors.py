"""CPU and memory of a node that listens to Cyclone DDS through Fast DDS, relative to one on Fast DDS, and to the robot's own RMW.

Each node has a separate domain and publisher, all run at the same time, and rounds take turns: one publisher sends, and the CPU
of its node is counted. The nodes keep almost nothing. A node in rmw_cyclonedds_cpp is included if that is installed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import _proc
from _report import Bar, Report, main, progress, ratio
from _world import lost
from shadowhound_sim.demo_processes import free_domain

from shadowhound_data_logger.node.intake.middleware import choose

sys.path.append(str(Path(__file__).parents[1] / 'test'))
from e2e.numbered import message
from e2e.processes import Node, Processes, Publisher

ROBOT: Final = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
KINDS: Final = {'small': (324, 500.0), 'large': (300_000, 30.0)}
"""Bytes, and rate per second: a robot's LowState and a cloud."""
STRING: Final = 'std_msgs/msg/String'
ROUNDS: Final = 5
BAR: Final = {'small': 1.25, 'large': 2.0}
"""A cloud from Fast DDS arrives through shared memory, one from Cyclone DDS in many UDP packets."""
MEMORY_BAR: Final = 1.1


@dataclass(slots=True)
class Side:
    """A node and its publisher."""

    node: Node
    publisher: Publisher
    used_us: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    """CPU of the node per message, by rounds."""

    def round(self, kind: str, seconds: float) -> None:
        size, rate_hz = KINDS[kind]
        count = round(seconds * rate_hz)
        before = self.node.topic(f'/{kind}')['received']
        cpu_s = _proc.cpu_s(self.node.popen.pid)
        self.publisher.again(f'/{kind}', message('bench', 0, size), count, 1 / rate_hz)
        self.node.received(f'/{kind}', before + 1)
        received = self.node.topic(f'/{kind}')['received'] - before
        self.used_us[kind].append(1e6 * (_proc.cpu_s(self.node.popen.pid) - cpu_s) / received)


def side(stack: ExitStack, folder: Path, *, cyclone: bool, rmw: str = 'auto') -> Side:
    """Once both topics are received."""
    folder.mkdir()
    processes = Processes(folder, free_domain(), 'bench')
    stack.callback(processes.end)
    parameters: dict[str, Any] = {'sensors': list(KINDS), 'capture.rmw': rmw}
    for kind in KINDS:
        parameters |= {f'{kind}.topics': [kind], f'{kind}.types': [STRING], f'{kind}.rate_hz': 0.0001, f'{kind}.batch_s': 0.0}
    node = processes.node(None, parameters, environ=ROBOT if cyclone else {})
    publisher = processes.publisher(cyclone=cyclone)
    for kind, (size, _) in KINDS.items():
        publisher.create(f'/{kind}', STRING, reliable=False, depth=10)
        publisher.heard(f'/{kind}', node, message('bench', 0, size))
    return Side(node, publisher)


def measure(options: argparse.Namespace) -> Report:
    options.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=options.folder, prefix='bench-')))
        sides = {'fast': side(stack, folder / 'fast', cyclone=False), 'cyclone': side(stack, folder / 'cyclone', cyclone=True)}
        if choose('auto', {**os.environ, **ROBOT}).has_robot:
            sides['robot'] = side(stack, folder / 'robot', cyclone=True, rmw='robot')
        for number in range(ROUNDS):
            progress(f'round {number + 1} of {ROUNDS}: {", ".join(sides)}')
            for each in sides.values():
                for kind in KINDS:
                    each.round(kind, options.seconds / ROUNDS / len(KINDS) / len(sides))
        time.sleep(1.0)
        memory = {name: _proc.memory(each.node.popen.pid)._asdict() for name, each in sides.items()}
        ledgers = {name: each.node.stop() for name, each in sides.items()}
    gone = {name: lost(ledger['topics'].values()) for name, ledger in ledgers.items() if name != 'robot'}
    figures = {
        'bytes': {kind: size for kind, (size, _) in KINDS.items()},
        'us': {name: each.used_us for name, each in sides.items()},
        'memory': memory,
        'lost': gone,
    }
    return Report(tuple(_bars(sides, memory)), figures)


def _bars(sides: dict[str, Side], memory: dict[str, dict[str, float]]) -> list[Bar]:
    bars = []
    for name, other in (('fast', 'that hears Fast DDS'), ('robot', "in the robot's own RMW")):
        if name not in sides:
            continue
        for kind, most in BAR.items():
            value, rounds = ratio(sides['cyclone'].used_us[kind], sides[name].used_us[kind])
            what = f'CPU a message of {KINDS[kind][0]:,} bytes of the node that hears Cyclone DDS, against one {other}'
            bars.append(Bar(what, f'at most {most}', value, 'of it', value <= most, rounds))
        value = sum(memory['cyclone'].values()) / sum(memory[name].values())
        what = f'resident memory of the node that hears Cyclone DDS, against one {other}'
        bars.append(Bar(what, f'at most {MEMORY_BAR}', value, 'of it', value <= MEMORY_BAR))
    return bars


if __name__ == '__main__':
    main(__doc__, measure, seconds=60.0)
