"""What events ask for, counted in accounts of their own (EVENT): received once it is asked for, and dropped where it is gone."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from typing import Final

from shadowhound_data_logger.bags.ring import Held
from shadowhound_data_logger.model import Taken
from shadowhound_data_logger.spool.accounts import EVENT, Accounts

RING_FULL: Final = 'ring_full'
"""Why messages are dropped that had to go from the ring before an event that asked for them could write them."""


class Claims:
    """New; from any thread."""

    def __init__(self, accounts: Accounts) -> None:
        self._accounts = accounts
        self._lost: deque[tuple[tuple[str, str], int]] = deque()

    def begin(self) -> None:
        """What was published since the last event was not asked for, and is not missed."""
        self._accounts.rebase_all(EVENT)

    def receive(self, held: Held) -> list[Taken]:
        """An event has it now; what is no repeat of it."""
        with self._accounts.entry(f'{EVENT}{held.lot.topic}') as account:
            account.type = held.lot.type
            if held.again:
                for each in held.lot.messages:
                    account.receive_again(each.publisher, each.number)
                return list(held.lot.messages)
            unknown = account.unknown
            fresh = [each for each in held.lot.messages if account.receive(each.publisher, each.number)]
            account.appraise(account.unknown - unknown, held.lost)
        return fresh

    def lose(self, held: Iterable[Held], reason: str = RING_FULL) -> None:
        """An event asked for it and cannot have it."""
        for each in held:
            count = len(self.receive(each))
            self._accounts.drop(f'{EVENT}{each.lot.topic}', reason, count)
            self._lost.append(((each.lot.topic, reason), count))

    def take_lost(self) -> Counter[tuple[str, str]]:
        """What was lost since the last call, by topic and reason."""
        found = Counter[tuple[str, str]]()
        while self._lost:
            what, count = self._lost.popleft()
            found[what] += count
        return found
