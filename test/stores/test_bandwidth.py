"""The cap: how fast pieces are sent, and in which order."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator

import pytest
from shipping.fakes import until

from shadowhound_data_logger.stores.bandwidth import BYTES_PER_MEGABIT, LARGEST_PIECE, LATE_S, Pace

QUICK_S = 60.0
"""Immediate operations take much less, delayed ones more."""


class Sender(threading.Thread):
    """Reads a body to its end, or until it is cancelled."""

    def __init__(self, pieces: Iterator[bytes], log: list[str], name: str = '') -> None:
        super().__init__(name=name, daemon=True)
        self._pieces = pieces
        self._log = log
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            for _ in self._pieces:
                self._log.append(self.name)
        except ConnectionAbortedError as error:
            self.error = error


def test_without_a_limit_a_body_is_sent_in_large_pieces() -> None:
    """It is unchanged, and counted."""
    pace, body = Pace(), bytes(range(256)) * 1000
    pieces = list(pace.pieces(body, 5))
    assert b''.join(pieces) == body
    assert {len(piece) for piece in pieces[:-1]} == {LARGEST_PIECE}
    assert pace.sent_bytes == len(body)


def test_a_file_is_sent_completely_from_any_position() -> None:
    """A signature reads the body first."""
    file = io.BytesIO(b'0123456789' * 1000)
    file.seek(0, io.SEEK_END)
    assert b''.join(Pace(800.0).pieces(file, 5)) == file.getvalue()


def test_a_limited_body_is_sent_evenly() -> None:
    """In any interval at most what the cap allows, except for one piece and what a thread that woke up late catches up."""
    pace = Pace(4.0)
    rate = 4.0 * BYTES_PER_MEGABIT
    left = [(time.monotonic(), len(piece)) for piece in pace.pieces(bytes(200_000), 5)]
    times = [moment for moment, _ in left]
    largest = max(size for _, size in left)
    assert largest <= rate * 0.021
    for first in range(len(left)):
        total = 0
        for last in range(first + 1, len(left)):
            total += left[last][1]
            assert total <= rate * (times[last] - times[first] + LATE_S) + largest
    assert times[-1] - times[0] >= 200_000 / rate - LATE_S - 0.04


def test_a_cap_holds_for_all_bodies_together() -> None:
    """Four at the same time take as long as one after the other."""
    pace = Pace(8.0)
    senders = [Sender(pace.pieces(bytes(100_000), 5), []) for _ in range(4)]
    began = time.monotonic()
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join(QUICK_S)
    assert time.monotonic() - began >= 400_000 / (8.0 * BYTES_PER_MEGABIT) - LATE_S - 0.04
    assert pace.sent_bytes == 400_000


def test_priority_decides_without_starvation() -> None:
    """While it is sent, the others together get about every fourth piece: with less, their servers would time out."""
    pace, log = Pace(4.0), list[str]()
    others = [Sender(pace.pieces(bytes(2_000_000), 9), log, 'other') for _ in range(3)]
    for other in others:
        other.start()
    until(lambda: log)
    important = Sender(pace.pieces(bytes(300_000), 0), log, 'important')
    important.start()
    important.join(QUICK_S)
    pace.abandon()
    for other in others:
        other.join(QUICK_S)
    span = log[log.index('important') :]
    share = span[: len(span) - span[::-1].index('important')].count('other') / span.count('important')
    assert 0.2 < share < 0.8


def test_a_yielding_body_is_sent_after_its_equals() -> None:
    """A part of a slice that started earlier gets only every fourth piece while a live object is sent."""
    pace, log = Pace(4.0), list[str]()
    part = Sender(pace.pieces(bytes(2_000_000), 5, is_background=True), log, 'part')
    part.start()
    until(lambda: log)
    live = Sender(pace.pieces(bytes(300_000), 5), log, 'live')
    live.start()
    live.join(QUICK_S)
    pace.abandon()
    part.join(QUICK_S)
    span = log[log.index('live') :]
    assert span[: len(span) - span[::-1].index('live')].count('part') / span.count('live') < 0.8


def test_of_equal_bodies_the_first_is_finished_first() -> None:
    """Sharing would delay all of them."""
    pace, log = Pace(4.0), list[str]()
    first, second = (Sender(pace.pieces(bytes(150_000), 5), log, name) for name in ('first', 'second'))
    first.start()
    second.start()
    first.join(QUICK_S)
    second.join(QUICK_S)
    until_first_ended = log[: len(log) - log[::-1].index('first')]
    assert until_first_ended.count('second') < 0.8 * until_first_ended.count('first')


def test_a_new_limit_applies_immediately() -> None:
    """Also for a body that waits because of the old one."""
    pace = Pace(0.001)
    sender = Sender(pace.pieces(bytes(100_000), 5), [])
    sender.start()
    until(lambda: pace.sent_bytes)
    pace.set(0.0)
    sender.join(QUICK_S)
    assert not sender.is_alive()
    assert pace.sent_bytes == 100_000


def test_cancelled_bodies_end_immediately() -> None:
    """A stop does not wait for the cap; another drain of the same store is not affected."""
    pace = Pace(0.001)
    senders = [Sender(pace.pieces(bytes(100_000), 5), []) for _ in range(3)]
    for sender in senders:
        sender.start()
    until(lambda: pace.sent_bytes)
    pace.abandon()
    for sender in senders:
        sender.join(QUICK_S)
    assert all(isinstance(sender.error, ConnectionAbortedError) for sender in senders)
    pace.set(0.0)
    assert b''.join(pace.pieces(b'later', 5)) == b'later'


def test_recent_throughput_is_measured() -> None:
    """There is always a number."""
    pace = Pace()
    assert pace.bytes_in(0.5) == float('inf')
    pace.set(8.0)
    assert pace.bytes_in(0.5) == 500_000


@pytest.mark.parametrize('cap', [-1.0, float('inf'), float('nan')])
def test_an_invalid_cap_is_refused(cap: float) -> None:
    """The old cap stays in effect."""
    pace = Pace(3.0)
    with pytest.raises(ValueError, match='not a cap'):
        pace.set(cap)
    assert pace.max_mbps == 3.0
    assert repr(pace) == 'Pace(3 Mbit/s)'


def test_a_yielding_limit_expires() -> None:
    """Until then the lower of the two applies, also to current bodies; then the original cap applies again."""
    now = [100.0]
    pace = Pace(8.0, lambda: now[0])
    pace.yield_to(2.0, 5.0)
    assert pace.max_mbps == 2.0
    assert pace.bytes_in(1.0) == 2.0 * BYTES_PER_MEGABIT
    now[0] += 4.0
    pace.yield_to(20.0, 5.0)
    assert pace.max_mbps == 8.0
    pace.yield_to(2.0, 5.0)
    now[0] += 5.0
    assert pace.max_mbps == 8.0
    pace.set(0.0)
    pace.yield_to(2.0, 5.0)
    assert pace.max_mbps == 2.0
    now[0] += 5.0
    assert pace.bytes_in(1.0) == float('inf')
    for wrong in (0.0, -1.0, float('inf'), float('nan')):
        with pytest.raises(ValueError, match='not a cap'):
            pace.yield_to(wrong, 5.0)
