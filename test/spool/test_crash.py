"""The spool and the ledger under ``kill -9``: what commit returned stays, nothing is half there, and the ledger closes."""

from __future__ import annotations

import hashlib
import json
import random
import time
from pathlib import Path
from typing import Any

import pytest
from profiles import LONG
from spool.child import started
from spool.conftest import Moments, Open
from spool.making import BUCKET, abandon, assert_whole, files, make, new_spool, put, receive, rows, settle

from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.spool.spool import Spool


def reopened(root: Path) -> Spool:
    spool = new_spool(root)
    spool.open()
    return spool


def test_death_at_any_moment_of_a_commit(root: Path, moments: Moments) -> None:
    """Objects, deliveries and accounts are there as a whole (from the transaction on) or not at all, and can be used."""
    spool = reopened(root)
    put(spool, make('old', b'old'), make('refused', b'refused'))
    spool.close()

    def work() -> None:
        spool = reopened(root)
        old, refused = sorted(spool.pending(9), key=lambda item: item.key)
        receive(spool, 4)
        spool.commit([make('new/0', b'new'), make('new/1', b'new'), make('new/held', b'new', held='clock')],
                     [Outcome(old, State.DELIVERED), Outcome(refused, State.QUARANTINED, 'refused')])  # fmt: skip
        spool.close()

    seen: list[tuple[bool, str]] = []
    for copy in moments(work):
        spool = reopened(copy)
        topic = assert_whole(copy)['topics']['/camera']
        state = {row['key']: row['state'] for row in rows(copy)}
        committed = 'new/0' in state
        if committed:
            assert state['old'] == 'delivered'
            assert state['refused'] in {'quarantined', 'pending'}, 'at the worst it is tried once more'
            assert (state['new/0'], state['new/1'], state['new/held']) == ('pending', 'pending', 'held')
            assert (topic['received'], topic['stored'], sum(topic['dropped'].values())) == (6, 5, 1)
        else:
            assert state == {'old': 'pending', 'refused': 'pending'}
            assert (topic['received'], topic['stored'], topic['dropped']) == (2, 2, {})
        assert topic['open'] == 0
        seen.append((committed, next(iter(topic['dropped']), '')))
        goes_on(spool, copy, committed=committed)
        spool.close()
    assert [committed for committed, _ in seen] == sorted(committed for committed, _ in seen)
    assert set(seen) == {(False, ''), (True, 'restart'), (True, 'shutdown')}


def goes_on(spool: Spool, root: Path, *, committed: bool) -> None:
    """What is left can be delivered, new objects get keys of their own, and a gap in the numbers is the restart's."""
    for item in spool.pending(9):
        assert hashlib.sha256(item.path.read_bytes()).hexdigest() == item.sha256
        settle(spool, item, State.DELIVERED)
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 10)
    assert spool.commit([make('new/0')])[0].key == ('new/0_1' if committed else 'new/0')
    assert assert_whole(root)['topics']['/camera']['missed_by'] == {'restart': 3 if committed else 7}


@pytest.mark.long('a death after each step')
def test_death_at_any_moment_of_an_eviction(root: Path, moments: Moments) -> None:
    """Whatever was evicted is so in the ledger and has no file; the object that needed the room is there or not."""
    spool = new_spool(root, max_bytes=1 << 20)
    spool.open()
    put(spool, *(make(f'{number}', bytes(200_000)) for number in range(4)))
    spool.close()

    def work() -> None:
        spool = new_spool(root, max_bytes=1 << 20)
        spool.open()
        put(spool, make('more', bytes(500_000)))
        spool.close()

    seen = set()
    for copy in moments(work):
        spool = reopened(copy)
        assert_whole(copy)
        states = {row['key']: row['state'] for row in rows(copy)}
        evicted = sum(state == 'evicted' for state in states.values())
        assert evicted in {0, 2}
        assert 'more' not in states or evicted == 2
        seen.add((evicted, 'more' in states, spool.recovery.counts['delivered files removed']))
        spool.close()
    assert {(0, False, 0), (2, False, 2), (2, False, 1), (2, False, 0), (2, True, 0)} <= seen


def leave_a_mess(root: Path) -> None:
    """A spool of a process that died, with all that a start has to repair."""
    spool = reopened(root)
    items = put(spool, *(make(f'a/{number}', b'%d' % number) for number in range(7)))
    settle(spool, items[0], State.DELIVERED)
    settle(spool, items[1], State.QUARANTINED, 'refused')
    receive(spool, 3)
    spool.commit()
    abandon(spool)
    ready = root / 'ready' / BUCKET / 'a'
    (ready / '0').write_bytes(b'0')  # delivered, not removed
    (root / f'quarantine/refused/{BUCKET}/a/1').rename(ready / '1')  # quarantined by the index, the file not there yet
    (ready / '2').rename(root / f'incoming/{items[2].id}.part')
    (ready / '3').unlink()
    (ready / '4').write_bytes(b'cut')
    (root / 'incoming/99.part').write_bytes(b'never committed')
    (ready / 'a b').write_bytes(b'foreign')
    (ready / 'copied').write_bytes(b'copied')


def settled(root: Path) -> dict[str, Any]:
    """What a spool comes to at the end of a start."""
    found = assert_whole(root)
    return {'rows': {(row['key'], row['state'], row['reason'], row['sha256']) for row in rows(root)}, 'files': files(root),
            'topics': found['topics'], 'objects': found['objects']}  # fmt: skip


@pytest.mark.parametrize('index', ['whole', 'lost'])
@pytest.mark.long('a death after each step')
def test_death_at_any_moment_of_a_start(root: Path, moments: Moments, index: str) -> None:
    """A start that died half-way is completed by the next one, as if it had been the first, also when it rebuilt the index."""
    leave_a_mess(root)
    if index == 'lost':
        for name in ('index.db-wal', 'index.db-shm'):
            (root / name).unlink(missing_ok=True)
        (root / 'index.db').write_bytes(b'garbage' * 1000)
    *died, lived = moments(lambda: reopened(root).close())
    reopened(lived).close()
    expected = settled(lived)
    assert {name.split('/')[0] for name in expected['files']} >= {'ready', 'foreign'}
    for copy in died:
        reopened(copy).close()
        assert settled(copy) == expected, copy.name


@pytest.mark.long('kills')
@pytest.mark.sampled
def test_death_at_any_time(opened: Open, root: Path) -> None:
    """Killed at random moments again and again: what was told as durable is there, whole, once, and the ledger closes."""
    rng = random.Random(11)
    durable: dict[str, str] = {}
    delivered: set[str] = set()
    kills = 0
    while kills < (24 if LONG else 6) or len(durable) <= 50:  # a busy machine has done little when it is killed so soon
        kills += 1
        with started('load', root) as child:
            assert child.stdout is not None
            lines = [child.stdout.readline()]
            time.sleep(rng.uniform(0.0, 0.12))  # the moment of death, not a wait for anything
            child.kill()
            lines += child.stdout.readlines()
        for said in map(json.loads, lines):
            durable.update(said.get('committed', []))
            delivered.update(said.get('settled', []))
        spool = opened()
        check(root, durable, delivered)
        spool.close()
    topic = assert_whole(root)['topics']['/camera']
    assert topic['open'] == 0
    assert topic['accounting'] == 'exact'


def check(root: Path, durable: dict[str, str], delivered: set[str]) -> None:
    """What was told is true, and the spool whole."""
    assert_whole(root)
    table: dict[str, dict[str, Any]] = {row['key']: row for row in rows(root)}
    assert {key: table[key]['sha256'] for key in durable} == durable
    assert {table[key]['state'] for key in delivered} <= {'delivered', 'quarantined'}


def test_a_live_session_is_not_settled(opened: Open, root: Path) -> None:
    """A second process that opens the spool leaves what is open in the first one open."""
    one = opened()
    put(one, make())
    with one.accounts.entry('/camera') as account:
        account.receive('p', 2)
    one.commit()
    assert opened().recovery.describe() == ''
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['open'], topic['dropped']) == (1, {})
    assert len(files(root)) == 1
