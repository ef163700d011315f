"""Another process that uses a spool, run as ``python -m spool.child VERB ROOT ...``; it says on standard output what it did."""

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

from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Outcome, Spool

TEST = Path(__file__).parents[1]


@contextmanager
def started(verb: str, root: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A running child; killed at the end if it has not ended."""
    path = os.pathsep.join((str(TEST), str(TEST.parent), os.environ.get('PYTHONPATH', '')))
    command = [sys.executable, '-m', 'spool.child', verb, str(root), *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, 'PYTHONPATH': path}) as process:
        try:
            yield process
        finally:
            process.kill()


def say(**said: Any) -> None:
    """One JSON line to the parent; a single write, so that a kill cuts no line of what is told."""
    os.write(1, (json.dumps(said) + '\n').encode())


def hold(root: Path) -> None:
    """Take the drain lock and wait for the end."""
    spool = new_spool(root)
    spool.open()
    with spool.drain_lock() as mine:
        say(mine=mine)
        signal.pause()


def add(root: Path, name: str, number: str) -> None:
    """Commit objects that want keys which others want, too."""
    spool = new_spool(root)
    spool.open()
    say(opened=True)
    for index in range(int(number)):
        put(spool, make(f'thor/{index}.jpg', name.encode(), topic=f'/{name}'))
    spool.close()


def load(root: Path) -> None:
    """Receive, commit and settle without end, and tell of everything that is durable."""
    spool = new_spool(root)
    spool.open()
    for number in count():
        receive(spool, 4)
        with spool.accounts.entry('/camera') as account:
            account.skipped += 1
        items = spool.commit([make(f'thor/{os.getpid()}/{number % 7}/{index}.jpg', os.urandom(2000)) for index in range(2)])
        say(committed=[[item.key, item.sha256] for item in items])
        outcomes = [Outcome(items[0], State.DELIVERED)]
        if number % 5 == 0:
            outcomes.append(Outcome(items[1], State.QUARANTINED, 'refused'))
        spool.commit(outcomes=outcomes)
        say(settled=[outcome.item.key for outcome in outcomes])


def die(*_: Any, **__: Any) -> None:
    """End as a power cut does: at once."""
    os.kill(os.getpid(), signal.SIGKILL)


def after(times: int, original: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with death at the end of its ``times``-th call."""
    calls = count(1)

    def called(*arguments: Any, **named: Any) -> Any:
        result = original(*arguments, **named)
        if next(calls) >= times:
            die()
        return result

    return called


def crash(root: Path, step: str) -> None:
    """Commit ``old``, and die at a step of a commit of three objects and the delivery of ``old``."""
    spool = new_spool(root)
    spool.open()
    old, refused = put(spool, make('old', b'old'), make('refused', b'refused'))
    receive(spool, 4)
    say(committed=True)
    if step == 'after two parts':
        Tree.write_part = after(2, Tree.write_part)  # type: ignore[method-assign]
    elif step == 'before the transaction':
        Tree.sync_incoming = die  # type: ignore[method-assign]
    elif step == 'after the accounts':
        Index.write = after(1, Index.write)  # type: ignore[method-assign]
    elif step == 'before the renames':
        Spool._place = die  # type: ignore[method-assign, assignment]
    elif step == 'after two renames':
        Tree.place = after(2, Tree.place)  # type: ignore[method-assign]
    elif step == 'before the outcomes':
        Spool._settle = die  # type: ignore[method-assign]
    elif step == 'after one outcome':
        Tree.remove = after(1, Tree.remove)  # type: ignore[method-assign]
    spool.commit([make(f'new/{number}', b'new') for number in range(3)],
                 [Outcome(old, State.DELIVERED), Outcome(refused, State.QUARANTINED, 'refused')])  # fmt: skip


def evict(root: Path) -> None:
    """Die after an eviction is committed and before its files go."""
    spool = new_spool(root, max_bytes=1 << 20)
    spool.open()
    put(spool, *(make(f'{number}', bytes(200_000)) for number in range(4)))
    say(committed=True)
    Tree.remove = die  # type: ignore[method-assign]
    put(spool, make('more', bytes(500_000)))


VERBS: dict[str, Callable[..., None]] = {'hold': hold, 'add': add, 'load': load, 'crash': crash, 'evict': evict}

if __name__ == '__main__':
    VERBS[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
