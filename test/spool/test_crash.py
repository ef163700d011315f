"""D5 and D10 under ``kill -9``: what commit returned stays, nothing is half there, and the ledger closes."""

from __future__ import annotations

import hashlib
import json
import random
import time
from pathlib import Path
from typing import Any

import pytest
from spool.child import started
from spool.conftest import Open
from spool.making import assert_whole, files, make, put, rows, settle

from shadowhound_data_logger.model import State

SOONER = ('after two parts', 'before the transaction', 'after the accounts')
LATER = ('before the renames', 'after two renames', 'before the outcomes', 'after one outcome')


@pytest.mark.parametrize('step', SOONER + LATER)
def test_death_at_a_step_of_a_commit(opened: Open, root: Path, step: str) -> None:
    """A commit is there as a whole (from its transaction on) or not at all, deliveries and accounts included."""
    with started('crash', root, step) as child:
        output, _ = child.communicate(timeout=20)
    assert (child.returncode, output.count('\n')) == (-9, 1)
    spool = opened()
    topic = assert_whole(root)['topics']['/camera']
    new = {row['key']: row['state'] for row in rows(root)}
    if step in SOONER:
        assert new == {'old': 'pending', 'refused': 'pending'}
        assert (topic['received'], topic['stored'], topic['dropped']) == (2, 2, {})
    else:
        # The refused one was not moved to quarantine yet: it is tried once more.
        assert new == {'old': 'delivered', 'refused': 'pending', **{f'new/{number}': 'pending' for number in range(3)}}
        assert (topic['received'], topic['stored'], topic['dropped']) == (6, 5, {'restart': 1})
    assert topic['open'] == 0
    for item in spool.pending(9):
        assert hashlib.sha256(item.path.read_bytes()).hexdigest() == item.sha256
        settle(spool, item, State.DELIVERED)
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 10)
    put_key = spool.commit([make('new/0')])[0].key
    assert put_key == ('new/0' if step in SOONER else 'new/0_1')
    missed = assert_whole(root)['topics']['/camera']['missed_by']
    assert missed == {'restart': 7 if step in SOONER else 3}


def test_death_between_an_eviction_and_its_files(opened: Open, root: Path) -> None:
    """Files of evicted objects that were not removed in time are removed at the next start."""
    with started('evict', root) as child:
        child.communicate(timeout=20)
    assert child.returncode == -9
    assert opened().recovery.counts['delivered files removed'] > 0
    assert assert_whole(root)['objects']['evicted'] > 0


def test_death_at_any_moment(opened: Open, root: Path) -> None:
    """Killed at random moments again and again: what was told as durable is there, whole, once, and the ledger closes."""
    rng = random.Random(11)
    durable: dict[str, str] = {}
    settled: set[str] = set()
    for _ in range(12):
        with started('load', root) as child:
            assert child.stdout is not None
            lines = [child.stdout.readline()]
            time.sleep(rng.uniform(0.0, 0.12))  # the moment of death, not a wait for anything
            child.kill()
            lines += child.stdout.readlines()
        for said in map(json.loads, lines):
            durable.update(said.get('committed', []))
            settled.update(said.get('settled', []))
        spool = opened()
        check(root, durable, settled)
        spool.close()
    assert len(durable) > 50
    topic = assert_whole(root)['topics']['/camera']
    assert topic['open'] == 0
    assert topic['accounting'] == 'exact'


def check(root: Path, durable: dict[str, str], settled: set[str]) -> None:
    """What was told is true, and the spool whole."""
    assert_whole(root)
    table: dict[str, dict[str, Any]] = {row['key']: row for row in rows(root)}
    assert {key: table[key]['sha256'] for key in durable} == durable
    assert {table[key]['state'] for key in settled} <= {'delivered', 'quarantined'}


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
