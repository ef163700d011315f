from __future__ import annotations

import json
import sqlite3
from dataclasses import asdict
from pathlib import Path

import pytest
from spool.child import started
from spool.conftest import Open
from spool.making import assert_whole, make, put, rows, settle

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.stamps import StampReport
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Outcome, Spool

LATE = StampReport('p', 'offset', 146.0, 0.1, 1, 'clock')


def run_sql(root: Path, *statements: str) -> None:
    """Change the index as a bug or a bad disk would."""
    connection = sqlite3.connect(root / 'index.db')
    with connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


def test_the_ledger_has_every_account(spool: Spool, root: Path) -> None:
    """Every number of the ledger's contract, from one session of two topics."""
    with spool.accounts.entry('/camera') as account:
        account.type = 'sensor_msgs/msg/CompressedImage'
        for number in (*range(1, 9), 11):
            account.receive('p', number)
        account.skipped += 3
        account.by_arrival['stamp_too_old'] += 2
        account.corrected['row_step'] += 2
        account.stamps = LATE
    spool.accounts.reject('/camera', {'truncated': 1})
    spool.accounts.drop('/camera', 'queue_full', 1)
    with spool.accounts.entry('/imu') as account:
        for _ in range(5):
            account.receive(None, None)
    one, two, _ = spool.commit(
        [make('a', b'12345'), make('b', b'123'), make('c', b'1'), make('d', b'', held='clock', topic=None)]
    )
    spool.commit(outcomes=[Outcome(one, State.DELIVERED), Outcome(two, State.QUARANTINED, 'refused')])
    assert ledger.read(root, 'thor') == {
        'robot': 'thor',
        'balanced': True,
        'topics': {
            '/camera': {
                'type': 'sensor_msgs/msg/CompressedImage', 'accounting': 'exact', 'published': 11, 'received': 9, 'missed': 2,
                'published_estimated': None, 'missed_estimated': None, 'missed_by': {'transport': 2},
                'by_grade': {'exact': {'published': 11, 'published_estimated': None, 'received': 9, 'missed': 2,
                                       'missed_estimated': None, 'missed_by': {'transport': 2}}},
                'skipped': 3, 'rejected': {'truncated': 1}, 'dropped': {'queue_full': 1},
                'gaps': {'missed': {'transport': 2}, 'rejected': {'truncated': 1}, 'dropped': {'queue_full': 1},
                         'quarantined': {'refused': 1}},
                'other_types': {}, 'by_arrival': {'stamp_too_old': 2}, 'corrected': {'row_step': 2}, 'stamps': asdict(LATE),
                'stored': 3, 'open': 1, 'stored_in': {
                    'delivered': 1, 'pending': 1, 'held': 0, 'evicted': 0, 'quarantined': 1, 'deduplicated': 0, 'kept': 0,
                },
            },
            '/imu': {
                'type': '', 'accounting': 'received-only', 'published': None, 'received': 5, 'missed': None, 'missed_by': {},
                'published_estimated': None, 'missed_estimated': None, 'by_grade': {
                    'received-only': {'published': None, 'published_estimated': None, 'received': 5, 'missed': None,
                                      'missed_estimated': None, 'missed_by': {}}},
                'skipped': 0, 'rejected': {}, 'dropped': {}, 'gaps': {}, 'other_types': {}, 'by_arrival': {}, 'corrected': {},
                'stamps': None,
                'stored': 0, 'open': 5, 'stored_in': {
                    'delivered': 0, 'pending': 0, 'held': 0, 'evicted': 0, 'quarantined': 0, 'deduplicated': 0, 'kept': 0,
                },
            },
        },
        'bags': {},
        'events': {},
        'objects': {
            'spooled': 4, 'delivered': 1, 'pending': 1, 'held': 1, 'evicted': 0, 'quarantined': 1, 'deduplicated': 0, 'kept': 0,
        },
        'bytes': {
            'spooled': 9, 'delivered': 5, 'pending': 1, 'held': 0, 'evicted': 0, 'quarantined': 3, 'deduplicated': 0, 'kept': 0,
        },
        'clock': {'is_set': None, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'held': 1},
        'operator_requests': [],
    }  # fmt: skip
    assert json.loads(json.dumps(ledger.read(root, 'thor'))) == ledger.read(root, 'thor')


def test_sessions_add_up(opened: Open, root: Path) -> None:
    """Totals cover all sessions, and are no more exact than the worst of them; the grade is that of the newest."""
    for number in (1, None, 5):
        spool = opened()
        with spool.accounts.entry('/camera') as account:
            account.receive('p', number)
        spool.commit([make()])
        spool.close()
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['received'], topic['stored'], topic['accounting'], topic['published']) == (3, 3, 'exact', None)
    assert {grade: (part['published'], part['received'], part['missed']) for grade, part in topic['by_grade'].items()} == {
        'exact': (2, 2, 0), 'received-only': (None, 1, None),
    }  # fmt: skip


def test_the_ledger_is_read_while_the_node_runs(root: Path) -> None:
    """Every ledger read while another process writes is a consistent snapshot and balances."""
    with started('load', root) as child:
        assert child.stdout is not None
        seen = set()
        for _ in range(80):
            assert child.stdout.readline()  # it is still running: two lines for four messages
            found = ledger.read(root, 'thor')
            assert ledger.imbalances(found) == []
            seen.add(found['topics']['/camera']['received'])
    assert len(seen) > 20


def test_the_ledger_of_an_empty_spool_balances(spool: Spool, root: Path) -> None:
    found = assert_whole(root)
    assert (found['topics'], found['objects']['spooled']) == ({}, 0)


def test_a_missing_spool_is_an_error(tmp_path: Path) -> None:
    """Without a spool the error names the folder, and no spool is created."""
    with pytest.raises(SpoolError, match=r'no spool in .*elsewhere.*SHADOWHOUND_HOME'):
        ledger.read(tmp_path / 'elsewhere', 'thor')
    assert not (tmp_path / 'elsewhere').exists()


@pytest.mark.parametrize('content', [b'', b'garbage' * 1000, None])
def test_an_unreadable_index_is_an_error(opened: Open, root: Path, content: bytes | None) -> None:
    """A damaged index, or one with invalid values, is an error with a remedy."""
    spool = opened()
    put(spool, make())
    spool.close()
    if content is None:
        run_sql(root, "UPDATE accounts SET rejected = '{'")
    else:
        (root / 'index.db').write_bytes(content)
    with pytest.raises(SpoolError, match=r'cannot be read: .*rebuilds'):
        ledger.read(root, 'thor')


IMBALANCES = {
    'received': ('UPDATE accounts SET received = received + 1', '/camera: published 2, but received + missed = 3'),
    'open below zero': ('UPDATE accounts SET received = 0', '/camera: received 0, but skipped'),
    'skipped': ('UPDATE accounts SET skipped = 5', '/camera: received 2, but skipped'),
    'published': ('UPDATE publishers SET published = 77', '/camera: published 77, but received + missed = 2'),
    'missed': ("""UPDATE publishers SET missed = '{"transport": 4}'""", '/camera: published 2, but received + missed = 6'),
    'stored': ('UPDATE accounts SET stored = 1', '/camera: stored 1, but in objects there are 2'),
    'samples': ("UPDATE tally SET samples = 9 WHERE state = 'pending'", '/camera: stored 2, but in objects there are 10'),
    'objects': ("UPDATE tally SET objects = 9 WHERE state = 'spooled'", 'objects: spooled 9, but by state 2'),
    'bytes': ("DELETE FROM tally WHERE state = 'delivered'", 'bytes: spooled 14, but by state 7'),
    'below zero': (
        "UPDATE tally SET objects = CASE state WHEN 'pending' THEN 3 WHEN 'delivered' THEN -1 ELSE objects END",
        'objects: spooled 2, but by state 2',
    ),
    'topic': ('DELETE FROM accounts', '/camera: stored 0, but in objects there are 2'),
}


@pytest.mark.parametrize(('statement', 'sentence'), IMBALANCES.values(), ids=IMBALANCES)
def test_an_imbalance_is_found(spool: Spool, root: Path, statement: str, sentence: str) -> None:
    """Each identity that does not hold is named."""
    one, _ = put(spool, make('a'), make('b'))
    settle(spool, one, State.DELIVERED)
    assert_whole(root)
    run_sql(root, statement)
    found = ledger.read(root, 'thor')
    problems = ledger.imbalances(found)
    assert any(problem.startswith(sentence) for problem in problems), problems
    assert found['balanced'] is False


def test_missed_is_split_by_cause(spool: Spool, root: Path) -> None:
    """A ledger in which the causes do not add up to missed is reported, wherever it came from."""
    put(spool, make())
    found = assert_whole(root)
    found['topics']['/camera']['missed_by'] = {'restart': 1}
    assert '/camera: missed 0, but by cause 1' in ledger.imbalances(found)


def test_totals_are_those_of_the_rows(spool: Spool, root: Path) -> None:
    """The totals kept by triggers equal a count of the rows."""
    items = put(spool, *(make(f'{number}', bytes(number), topic=f'/{number % 3}') for number in range(30)))
    for item, state in zip(items, [State.DELIVERED, State.QUARANTINED, State.DEDUPLICATED] * 5, strict=False):
        settle(spool, item, state)
    found = assert_whole(root)
    for state in State:
        of_state = [row for row in rows(root) if row['state'] == state.value]
        assert found['objects'][state.value] == len(of_state)
        assert found['bytes'][state.value] == sum(row['bytes'] for row in of_state)
