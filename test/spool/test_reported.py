"""The ledger of topics whose losses the middleware reports: it closes like one with numbers, over several sessions too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool

TOPIC = '/odom'


def session(opened: Callable[..., Spool], received: int, lost: int | None, number: int | None = None) -> None:
    """A session in which as many messages come, and it is reported (or not known) what was lost."""
    spool = opened()
    with spool.accounts.entry(TOPIC) as account:
        for offset in range(received):
            account.receive('p' if number else None, number and number + offset, reported=lost is not None)
            account.skipped += 1
        account.lose(lost)
    spool.close()


def row(root: Path) -> dict[str, Any]:
    found = ledger.read(root, 'thor')
    assert ledger.imbalances(found) == []
    topic: dict[str, Any] = found['topics'][TOPIC]
    return topic


def test_what_was_reported_is_missed(opened: Callable[..., Spool], root: Path) -> None:
    """Published is what was received and what is reported as lost; over sessions they add up."""
    session(opened, 10, 3)
    session(opened, 5, 0)
    found = row(root)
    assert (found['accounting'], found['published'], found['received']) == ('reported', 18, 15)
    assert (found['missed'], found['missed_by']) == (3, {'transport': 3})


def test_an_exact_session_among_them(opened: Callable[..., Spool], root: Path) -> None:
    """What one session knows by numbers and another one by reports adds up as well; the topic is as good as the worse."""
    session(opened, 10, None, number=1)
    session(opened, 10, 4)
    found = row(root)
    assert (found['accounting'], found['published'], found['missed']) == ('reported', 24, 4)


def test_one_session_of_which_nothing_is_known(opened: Callable[..., Spool], root: Path) -> None:
    """Then nothing is claimed of the topic at all: unknown is None, never 0."""
    session(opened, 10, 4)
    session(opened, 10, None)
    found = row(root)
    assert (found['accounting'], found['published'], found['missed'], found['missed_by']) == ('received-only', None, None, {})
    assert found['received'] == 20
