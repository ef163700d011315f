"""Another process that uses a spool, run as ``python -m spool.child VERB ROOT ...``; prints its results to standard output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from spool.making import make, new_spool, put, receive

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import Binding, State
from shadowhound_data_logger.spool.estimator import ArrivalContext
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Outcome

PERIOD_NS = SECOND // 100
TEST = Path(__file__).parents[1]


@contextmanager
def started(verb: str, root: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A running child; killed at the end if it is still running."""
    path = os.pathsep.join((str(TEST), str(TEST.parent), os.environ.get('PYTHONPATH', '')))
    command = [sys.executable, '-m', 'spool.child', verb, str(root), *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, 'PYTHONPATH': path}) as process:
        try:
            yield process
        finally:
            process.kill()


def say(**said: Any) -> None:
    """Send one JSON line to the parent; a single write, so that a kill never truncates a line."""
    os.write(1, (json.dumps(said) + '\n').encode())


def hold(root: Path) -> None:
    """Take the drain lock and keep it until killed."""
    spool = new_spool(root)
    spool.open()
    with spool.drain_lock() as mine:
        say(mine=mine)
        signal.pause()


def add(root: Path, name: str, number: str) -> None:
    """Commit objects with keys that other processes request, too."""
    spool = new_spool(root)
    spool.open()
    say(opened=True)
    for index in range(int(number)):
        put(spool, make(f'thor/{index}.jpg', name.encode(), topic=f'/{name}'))
    spool.close()


def load(root: Path) -> None:
    """Receive, commit and settle in an endless loop, and report everything that is durable."""
    spool = new_spool(root)
    spool.open()
    for number in count():
        receive(spool, 4)
        with spool.accounts.entry('/camera') as account:
            account.skipped += 1
        with spool.accounts.entry('/unnumbered') as account:
            for _ in range(30):
                account.receive(None, None)
            stamps = [(40 * number + place) * PERIOD_NS for place in range(30)]  # every turn loses ten
            account.observe({'': stamps}, ArrivalContext(gid='p'))
            account.skipped += 30
        items = spool.commit([make(f'thor/{os.getpid()}/{number % 7}/{index}.jpg', os.urandom(2000)) for index in range(2)])
        say(committed=[[item.key, item.sha256] for item in items])
        outcomes = [Outcome(items[0], State.DELIVERED)]
        if number % 5 == 0:
            outcomes.append(Outcome(items[1], State.QUARANTINED, 'refused'))
        spool.commit(outcomes=outcomes)
        say(settled=[outcome.item.key for outcome in outcomes])


def die(root: Path, moment: str) -> None:
    """Exit without warning during a commit: before the transaction is durable, or before its files have their final names."""
    spool = new_spool(root)
    spool.open()
    put(spool, make('thor/whole.jpg', b'whole'))
    if moment == 'checkpointed':
        spool._connections.writing._db.execute('PRAGMA wal_checkpoint(PASSIVE)')
    step = 'sync_incoming' if moment == 'uncommitted' else 'move'
    setattr(Tree, step, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    put(spool, make('thor/a.jpg', b'a'), make('thor/b.jpg', b'b', held='clock'))


def bind(root: Path, moment: str) -> None:
    """Exit without warning while two held objects get their final names."""
    spool = new_spool(root)
    spool.open()
    put(spool, *(make(f'thor/provisional/{name}', name.encode(), held='clock') for name in 'ab'))
    owner, step = {'renamed': (Tree, 'sync_incoming'), 'synced': (Index, 'transaction'), 'bound': (Tree, 'place_pending')}[moment]
    work = getattr(owner, step)

    @contextmanager
    def to_the_end(index: Index, undo: Callable[[], None]) -> Iterator[object]:
        with work(index, undo) as db:
            yield db
            os.kill(os.getpid(), signal.SIGKILL)

    setattr(owner, step, to_the_end if moment == 'synced' else lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    held = spool.reading.objects.held('clock')
    spool.bind([Binding(item.id, f'thor/final/{item.key[-1]}', {'bound': 'yes'}, 5, 6) for item in held])


VERBS: dict[str, Callable[..., None]] = {'hold': hold, 'add': add, 'load': load, 'die': die, 'bind': bind}

if __name__ == '__main__':
    VERBS[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
