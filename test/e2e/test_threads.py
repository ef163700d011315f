"""Any thread of the real node fails or exits: detected within a second, restarted and counted; nothing is lost."""

from __future__ import annotations

import os
import shutil
import statistics
from dataclasses import dataclass
from pathlib import Path

import pytest
from e2e.processes import HERE, Node, Processes, Publisher, until
from e2e.reading import STRING, texts

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.status import WorkerStatus
from shadowhound_data_logger.spool import status

WORKERS = ('intake', 'encode-0', 'spool-writer', 'upload-0')
PARAMETERS = {
    'sensors': ['talk'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 0.2,
    'upload.threads': 1,
}  # fmt: skip
GROUP = 50


@dataclass(frozen=True, slots=True)
class Mortal:
    """A node with threads that crash on request, and a publisher."""

    node: Node
    publisher: Publisher
    orders: Path

    def worker(self, name: str) -> tuple[int, WorkerStatus]:
        """The boot clock of the status, ns, and its entry for the thread."""
        node = status.read(self.node.home / 'spool', self.node.robot, SystemClock.of_this_machine()).node
        return node.boot_ns, node.workers.get(name, WorkerStatus())

    def order(self, name: str, way: str) -> None:
        (self.orders / f'{name}.{way}').touch()

    def seen_after_s(self, name: str, way: str, failures: int) -> float:
        """The time from the crash until the status reports it."""
        boot_ns, row = until(lambda: found if (found := self.worker(name))[1].failures >= failures else None,
                             f'{name} is seen to die')  # fmt: skip
        died_ns = int((self.orders / f'{name}.{way}.done').read_text())
        assert row.failures == failures
        assert f'on order of {name}' in row.last_error
        return float(boot_ns - died_ns) / SECOND


@pytest.fixture
def mortal(processes: Processes, tmp_path: Path) -> Mortal:
    """The thread of the drain lock crashes in its first round: it has no second one."""
    folder, orders = tmp_path / 'mortal', tmp_path / 'orders'
    folder.mkdir()
    orders.mkdir()
    shutil.copy(HERE / 'mortal.py', folder / 'sitecustomize.py')
    (orders / 'upload-lock.thread').touch()
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get('PYTHONPATH'))))
    node = processes.node(None, PARAMETERS, environ={'PYTHONPATH': path, 'ORDERS': str(orders)})
    publisher = processes.publisher()
    publisher.create('/talk', STRING)
    publisher.matched('/talk')
    return Mortal(node, publisher, orders)


@pytest.mark.long('kills threads')
def test_nothing_is_lost_when_any_thread_fails(mortal: Mortal) -> None:
    """Twice each: in its round, and in its bookkeeping; in the end every message is delivered."""
    sent, seen_s = 0, [mortal.seen_after_s('upload-lock', 'thread', 1)]
    for failures, way in enumerate(('round', 'thread'), 1):
        for name in WORKERS:
            mortal.order(name, way)
            mortal.publisher.publish('/talk', texts(range(sent, sent + GROUP)))
            sent += GROUP
            seen_s.append(mortal.seen_after_s(name, way, failures))
    row = mortal.node.settled('/talk', sent)
    assert (row['received'], row['stored'], row['missed'], row['rejected'], row['dropped']) == (sent, sent, 0, {}, {})
    for name in WORKERS:
        until(lambda name=name: not mortal.worker(name)[1].failing, f'{name} works again')  # type: ignore[misc]
        _, last = mortal.worker(name)
        assert (last.alive, last.failures, last.deaths) == (True, 2, 1)
        assert f'{name} died (2 times so far) and tries again' in mortal.node.log
    assert statistics.median(seen_s) < 1.0, seen_s
    assert max(seen_s) < 5.0, seen_s  # a busy machine
    mortal.node.stop()


@pytest.mark.long('kills threads')
def test_a_failure_of_the_main_loop_ends_the_node(mortal: Mortal) -> None:
    """The node exits without it: it makes everything durable, reports the reason and exits with 1; its service restarts it."""
    mortal.publisher.publish('/talk', texts(range(GROUP)))
    mortal.node.received('/talk', GROUP)
    mortal.order('main', 'round')
    assert mortal.node.wait() == 1
    assert 'the node exits: SystemExit: 0' in mortal.node.log
    row = mortal.node.topic('/talk')
    assert (row['received'], row['stored'], row['open']) == (GROUP, GROUP, 0)
