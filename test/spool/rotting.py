"""Damages a spool at random, and checks how startup handles it; used by test_rot.py and by ``python -m torture.rot``."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from spool.making import BUCKET, READY, abandon, make, new_spool, put, receive, rows, settle
from stores.memory import MemoryStore

from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool

Damage = Callable[[random.Random, Path], None]


def new_base(root: Path) -> dict[str, bytes]:
    """The spool of a process killed at a bad moment, with objects in every state; and the content of each by its key."""
    bodies = {f'thor/a/{number}.jpg': random.Random(number).randbytes(500 + number) for number in range(10)}
    bodies |= {'thor/held.jpg': b'held' * 50, 'thor/book.json': b'{}' * 50, 'thor/part.jpg': b'part' * 50}
    spool = new_spool(root)
    spool.open()
    items = put(spool, *(make(f'thor/a/{number}.jpg', bodies[f'thor/a/{number}.jpg']) for number in range(10)))
    put(spool, make('thor/held.jpg', bodies['thor/held.jpg'], held='clock'))
    put(spool, make('thor/book.json', bodies['thor/book.json'], topic=None, protected=True))
    settle(spool, items[0], State.DELIVERED)
    settle(spool, items[1], State.QUARANTINED, 'refused')
    spool._connections.writing._db.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    (part,) = put(spool, make('thor/part.jpg', bodies['thor/part.jpg']))
    os.replace(part.path, root / 'incoming' / f'{part.id}.part')  # not renamed yet
    (root / 'incoming/99.part').write_bytes(b'never committed')
    receive(spool, 2)
    spool.commit()
    # A closing connection would delete the log: a copy made while it is open is what a kill leaves.
    for name in ('index.db', 'index.db-wal'):
        shutil.copy(root / name, root / f'{name}.kept')
    abandon(spool)
    for name in ('index.db', 'index.db-wal'):
        os.replace(root / f'{name}.kept', root / name)
    return bodies


def _cut(rng: random.Random, path: Path) -> None:
    os.truncate(path, rng.randrange(path.stat().st_size + 1))


def _flip(rng: random.Random, path: Path) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 1, 3, 30))):
        if content:
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def _blank(rng: random.Random, path: Path) -> None:
    """A block of zeros, as file systems leave after a power cut."""
    content = path.read_bytes()
    start = rng.randrange(len(content) // 4096 + 1) * 4096
    path.write_bytes(content[:start] + bytes(len(content[start : start + 4096])) + content[start + 4096 :])


def _append(rng: random.Random, path: Path) -> None:
    path.write_bytes(path.read_bytes() + rng.randbytes(rng.choice((1, 100, 5000))))


def _delete(_: random.Random, path: Path) -> None:
    path.unlink()


def _empty_folder(_: random.Random, path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: tuple[Damage, ...] = (_cut, _flip, _flip, _blank, _append, _delete)
LOSSES = (('ready',), ('incoming',), ('held', 'quarantine'), ('sessions',), ('index.db-wal', 'index.db'), ('index.db-wal',))
INDEX = ('index.db', 'index.db', 'index.db-wal')


@dataclass(slots=True)
class Rotten:
    """A damaged copy of a spool."""

    root: Path
    done: list[str]
    """The damage done to it."""
    planted: set[bytes]
    """Contents of foreign files placed there."""
    touched: set[str]
    """Keys whose file was damaged."""


def rot(base: Path, root: Path, rng: random.Random) -> Rotten:
    """Copy the spool and damage one to four of its files, or entire folders."""
    shutil.copytree(base, root)
    rotten = Rotten(root, [], set(), set())
    for _ in range(rng.choice((1, 1, 2, 4))):
        kind = rng.random()
        if kind < 0.35:
            _damage(rotten, root / rng.choice(INDEX), rng)
        elif kind < 0.75:
            _damage(rotten, rng.choice(_payloads(root)), rng)
        elif kind < 0.85:
            _plant(rotten, rng)
        else:
            _lose(rotten, rng)
    return rotten


def _payloads(root: Path) -> list[Path]:
    folders = ('incoming', 'ready', 'held', 'quarantine')
    found = [path for name in folders for path in (root / name).rglob('*') if path.is_file()]
    return sorted(found) or [root / 'index.db']


def _damage(rotten: Rotten, path: Path, rng: random.Random) -> None:
    if not path.is_file():
        return
    payload = not path.name.startswith('index')
    damage = rng.choice((*DAMAGES, _empty_folder) if payload else DAMAGES)
    if path.name == 'index.db-wal' and damage is not _delete:  # or nothing shows this commit
        rotten.touched.add('thor/part.jpg')
    before = path.read_bytes()
    damage(rng, path)
    if before in rotten.planted:
        rotten.planted.remove(before)
        rotten.planted |= {path.read_bytes()} if path.is_file() else set()
    rotten.done.append(f'{damage.__name__} {path.relative_to(rotten.root)}')
    if payload:
        rotten.touched.add(_key(path))


def _key(path: Path) -> str:
    """The key that a file belongs to."""
    return 'thor/part.jpg' if path.suffix == '.part' else path.as_posix().rpartition(f'{BUCKET}/')[2]


def _plant(rotten: Rotten, rng: random.Random) -> None:
    """Add a file that does not belong to the spool."""
    content = rng.randbytes(50)
    folder = rng.choice((READY, f'{READY}/thor/a', f'held/clock/{BUCKET}', f'quarantine/odd/{BUCKET}', 'incoming'))
    path = rotten.root / folder / rng.choice(('new.jpg', 'a b', '..x', 'x.part', '\N{SNOWMAN}'))
    if path.parent.is_dir() and not path.exists():
        path.write_bytes(content)
        rotten.planted.add(content)
        rotten.done.append(f'planted {path.relative_to(rotten.root)}')


def _lose(rotten: Rotten, rng: random.Random) -> None:
    """Delete entire folders, the whole index, or every record of the sessions."""
    for name in rng.choice(LOSSES):
        path = rotten.root / name
        if path.is_dir():
            rotten.touched |= {_key(found) for found in path.rglob('*')}
            rotten.planted -= {found.read_bytes() for found in path.rglob('*') if found.is_file()}
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        rotten.done.append(f'lost {name}')


def used(root: Path) -> Spool:
    """Start, add and deliver; damage that only shows in use ends the process, and the next start checks more thoroughly."""
    for attempt in range(2):
        spool = new_spool(root)
        spool.open()
        try:
            (item,) = put(spool, make('thor/after.jpg', b'after', topic='/other'))
            settle(spool, item, State.DELIVERED)
            return spool
        except sqlite3.DatabaseError:
            abandon(spool)
            assert attempt == 0, 'the second start did not find the damage either'
    raise AssertionError


def ship(spool: Spool) -> dict[str, bytes]:
    """Deliver everything pending, as the uploader does; returns the contents of the store afterwards."""
    store = MemoryStore()
    outcomes = []
    for item in spool.pending(1000):
        try:
            store.put(item)
        except ObjectRefused as error:
            outcomes.append(Outcome(item, State.QUARANTINED, error.data['reason']))
        else:
            outcomes.append(Outcome(item, State.DELIVERED))
    spool.commit(outcomes=outcomes)
    assert spool.pending(1) == []
    buckets = {outcome.item.bucket for outcome in outcomes}
    return {info.key: store.get(bucket, info.key) for bucket in buckets for info in store.list(bucket)}


def check(rotten: Rotten, bodies: Mapping[str, bytes]) -> dict[str, int]:
    """Check the invariants of a spool after any damage; returns what recovery did."""
    spool = used(rotten.root)
    done = dict(+spool.recovery.counts)
    sent = ship(spool)
    whole = set(bodies.values()) | rotten.planted
    assert all(body in whole for body in sent.values()), 'a damaged object was shipped as intact'
    quarantined = [row for row in rows(rotten.root) if row['state'] == 'quarantined']
    assert all(row['reason'] for row in quarantined)
    lying = {path.read_bytes() for path in rotten.root.rglob('*') if path.is_file()}
    for key, body in bodies.items():
        if key not in rotten.touched and key != 'thor/a/0.jpg':  # it was delivered before
            assert body in sent.values() or body in lying, f'{key} is lost'
    assert rotten.planted <= set(sent.values()) | lying
    report = any('ledger' in what for what in done)
    assert report or ledger.imbalances(ledger.read(rotten.root, 'thor')) == []
    spool.close()
    again = new_spool(rotten.root)
    again.open()
    left = {what for what in again.recovery.counts if 'ledger' not in what}
    assert not left, f'a second start found more to repair: {left}'
    again.close()
    return done
