"""Grades belong to sessions: what each one counts and what it estimates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from spool.conftest import Open
from spool.making import abandon, new_spool

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.estimator import ArrivalContext, Expectation
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.topic_account import BAG

TOPIC = '/odom'
PERIOD_NS = SECOND // 100
ALONE = ArrivalContext(gid='a')


def session(opened: Callable[..., Spool], received: int, first: int | None = None, context: ArrivalContext = ALONE, *,
            at: int | None = None, died: bool = False) -> None:  # fmt: skip
    """Receive messages: numbered from ``first``, or sent in a rhythm from position ``at``, or neither."""
    spool = opened()
    with spool.accounts.entry(TOPIC) as account:
        for offset in range(received):
            account.receive('p' if first else None, first and first + offset)
        account.skipped += received
        if at is not None:
            account.observe({'': [PERIOD_NS * (at + offset) for offset in range(received)]}, context)
    if died:
        spool.commit()
        abandon(spool)
    else:
        spool.close()


def row(root: Path, topic: str = TOPIC) -> dict[str, Any]:
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    row: dict[str, Any] = found['topics'][topic]
    return row


def grades(root: Path) -> dict[str, tuple[Any, ...]]:
    """Grade -> published, received, missed; the first and the last are estimates if they are unknown."""
    return {
        grade: (part['published'] or part['published_estimated'], part['received'],
                part['missed'] if part['missed'] is not None else part['missed_estimated'])
        for grade, part in row(root)['by_grade'].items()
    }  # fmt: skip


def test_an_upgraded_robot_is_exact(opened: Open, root: Path) -> None:
    """The grade is that of the newest session; what was unknown in an earlier one stays unknown, and is listed separately."""
    session(opened, 10)
    session(opened, 5, first=1)
    found = row(root)
    assert (found['accounting'], found['published'], found['missed'], found['missed_estimated']) == ('exact', None, None, None)
    assert (found['received'], found['missed_by']) == (15, {})
    assert grades(root) == {'exact': (5, 5, 0), 'received-only': (None, 10, None)}


def test_exact_and_estimated_sessions_are_an_estimate(opened: Open, root: Path) -> None:
    """It is no better than the worse of them, and is not mixed with exact values."""
    session(opened, 10, first=1)
    session(opened, 300, at=0)
    session(opened, 300, at=310)
    found = row(root)
    assert (found['accounting'], found['published'], found['missed']) == ('estimated', None, None)
    assert (found['published_estimated'], found['missed_estimated'], found['missed_by']) == (620, 10, {'restart': 10})
    assert grades(root) == {'exact': (10, 10, 0), 'estimated': (610, 600, 10)}


def test_a_session_without_a_message_has_no_grade(opened: Open, root: Path) -> None:
    """It changes nothing; alone it is not called exact, and missed is unknown."""
    session(opened, 0)
    found = row(root)
    assert (found['accounting'], found['published'], found['missed'], found['by_grade']) == (None, None, None, {})
    session(opened, 10, first=1)
    session(opened, 0)
    assert (row(root)['accounting'], row(root)['missed']) == ('exact', 0)


def test_the_rhythm_survives_a_kill(opened: Open, root: Path) -> None:
    """A publisher that kept sending while the node was down is recognized by its name, and the gap is counted."""

    def mortal() -> Spool:
        spool = new_spool(root)
        spool.open()
        return spool

    session(mortal, 300, at=0, died=True)
    session(mortal, 20, at=400, died=True)
    session(opened, 20, at=430)
    assert row(root)['missed_by'] == {'restart': 110}


@pytest.mark.parametrize('context', [ALONE._replace(gid='b'), ALONE._replace(gid='', is_only=False)])
def test_a_gap_before_another_publisher_is_no_loss(opened: Open, root: Path, context: ArrivalContext) -> None:
    """Neither is one before several; the rhythm is still known."""
    session(opened, 300, at=0)
    session(opened, 20, context=context, at=400)
    found = row(root)
    assert (found['accounting'], found['missed_estimated'], found['missed_by']) == ('estimated', 0, {})


def test_numbered_messages_in_between_are_not_missed(opened: Open, root: Path) -> None:
    """Neither by the rhythm of an earlier session, nor by the numbers of the one before it."""
    session(opened, 300, at=0)
    session(opened, 10, first=1)
    session(opened, 300, at=400)
    session(opened, 10, first=500)
    assert grades(root) == {'exact': (20, 20, 0), 'estimated': (600, 600, 0)}


def test_another_declared_rate_starts_another_rhythm(opened: Open, root: Path) -> None:
    """A counter value is not a stamp."""
    session(opened, 300, at=0)
    spool = opened()
    with spool.accounts.entry(TOPIC) as account:
        account.estimate.expect(Expectation('counter:tick', 1.0, 1 << 32))
        account.receive(None, None)
        account.skipped += 1
        account.observe({'': [7]}, ALONE)
    spool.close()
    assert row(root)['missed_by'] == {}


def test_carried_messages_keep_their_grade(opened: Open, root: Path) -> None:
    """Messages of a bag that the next session accounts for stay unknown, or estimated, as before."""
    spool = opened()
    with spool.accounts.entry(f'{BAG}{TOPIC}') as account:
        for lost in (None, {'transport': 2}):
            for _ in range(5):
                account.receive(None, None)
            account.add_estimate(5, lost)
        account.stored += 0
        account.skipped += 4
    spool.close()
    spool = opened()
    spool.carry(BAG)
    spool.accounts.carried.drop_rest('restart')
    spool.close()
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    bag = found['bags'][TOPIC]
    assert {grade: part['received'] for grade, part in bag['by_grade'].items()} == {'estimated': 5, 'received-only': 5}
    assert (bag['skipped'], bag['dropped'], bag['open']) == (4, {'restart': 6}, 0)
