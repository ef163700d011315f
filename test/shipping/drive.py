"""A Schedule driven by the test, in place of the threads."""

from __future__ import annotations

import random

from shipping.fakes import FakeSpool, Time

from shadowhound_data_logger.core.errors import StoreError
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.ahead import IMPORTANT, OLDEST
from shadowhound_data_logger.shipping.failures import Notice, Verdict
from shadowhound_data_logger.shipping.schedule import Look, Rest, Schedule, Ship

CAP_S = 60.0


class Drive:
    """Acts as the threads: polls when the schedule requires it, and returns the objects it would ship."""

    def __init__(self, spool: FakeSpool, clock: Time, threads: int = 2) -> None:
        self.spool = spool
        self.clock = clock
        self.schedule = Schedule(threads, CAP_S, clock, random.Random(3))
        self.schedule.activate(True)
        self.notices: list[Notice] = []

    def poll(self, poll: Look) -> None:
        pending = self.spool.pending
        self.schedule.found(pending(IMPORTANT, exclude=poll.exclude, without=poll.without),
                            pending(OLDEST, exclude=poll.exclude, without=poll.without, oldest=True))  # fmt: skip

    def next(self) -> SpooledObject | None:
        """The object shipped now; None if the threads only wait."""
        for _ in range(10):
            step = self.schedule.step()
            if isinstance(step, Ship):
                return step.item
            if not isinstance(step, Look):
                return None
            self.poll(step)
        raise AssertionError('it looks again and again')

    def wait(self) -> SpooledObject:
        """The object shipped next, advancing the clock as needed."""
        for _ in range(1000):
            if item := self.next():
                return item
            rest = self.schedule.step()
            assert isinstance(rest, Rest)
            self.clock.now += rest.seconds
        raise AssertionError('nothing is shipped any more')

    def deliver(self, item: SpooledObject) -> None:
        self.notices += self.schedule.delivered(item)
        self.spool.items.pop(item.id)
        self.schedule.settled([item.id])

    def fail(self, item: SpooledObject, error: StoreError) -> str | None:
        ruling = self.schedule.failed(item, error)
        self.notices += ruling.notices
        if ruling.quarantine:
            self.spool.items.pop(item.id)
            self.schedule.settled([item.id])
        return ruling.quarantine

    def said(self) -> list[tuple[Verdict, str | None, bool]]:
        """(what, bucket, whether it has ended) of each notice."""
        return [(notice.verdict, notice.bucket, notice.lasted_s is not None) for notice in self.notices]
