"""The ring keeps the last seconds within its bytes, and knows what an event asked for of what has to go."""

from __future__ import annotations

import subprocess
import sys

import pytest
from bags.recording import lot, messages

from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.ring import MESSAGE_BYTES, PIECE_BYTES, Held, Ring

KEEP_S = 10.0


def kept(ring: Ring) -> list[int]:
    """The numbers of the messages in it, oldest first; it is empty then."""
    ring.claim(float('-inf'))
    return [number for held in iter(lambda: ring.next(float('inf')), None) for number in told(held)]


def told(held: Held) -> list[int]:
    return [message.number for message in held.lot.messages if message.number is not None]


def test_what_is_too_old_goes() -> None:
    """Of what nobody asked for the last seconds are kept, in the order of arrival."""
    ring = Ring(1 << 20, KEEP_S)
    for second in range(30):
        assert ring.put(lot(range(second, second + 1)), None, float(second)) == []
    assert ring.seconds == KEEP_S
    assert kept(ring) == list(range(19, 30))
    assert ring.bytes == 0


def test_what_is_too_much_goes_the_oldest_first() -> None:
    """Whatever the time: the bytes count, with what Python needs for each message."""
    ring = Ring(10 * (12 + MESSAGE_BYTES), KEEP_S)
    for number in range(25):
        assert ring.put(lot(range(number, number + 1)), None, 0.0) == []
        assert ring.bytes <= ring.max_bytes
    assert kept(ring) == list(range(15, 25))


def test_a_large_lot_goes_in_pieces() -> None:
    """One drain of a fast camera does not push out a whole second; what was lost with it belongs to its end."""
    ring = Ring(8 * PIECE_BYTES, KEEP_S)
    ring.put(lot(range(10), size=PIECE_BYTES // 2), 3, 0.0)
    ring.claim(0.0)
    pieces = list(iter(lambda: ring.next(0.0), None))
    assert [told(piece) for piece in pieces] == [[number] for number in range(10)]
    assert [piece.lost for piece in pieces] == [0] * 9 + [3]


def test_a_message_that_is_larger_than_the_ring_is_not_kept() -> None:
    """Nor does it leave anything else there."""
    ring = Ring(1 << 20, KEEP_S)
    ring.put(lot(range(3)), None, 0.0)
    ring.put(lot(range(3, 4), size=2 << 20), None, 0.0)
    assert (kept(ring), ring.bytes) == ([], 0)


def test_messages_are_not_copied() -> None:
    """What comes out is what went in, the very same bytes."""
    ring, taken = Ring(1 << 20, KEEP_S), messages(range(5), 100)
    ring.put(Lot('/talk', 'std_msgs/msg/String', '', taken), None, 0.0)
    ring.claim(0.0)
    held = ring.next(0.0)
    assert held is not None
    assert all(out.cdr is given.cdr for out, given in zip(held.lot.messages, taken, strict=True))


def test_while_it_is_claimed_nothing_grows_old() -> None:
    """What an event asked for waits for it, until it is taken or somebody else needs its place, which is told."""
    ring = Ring(5 * (12 + MESSAGE_BYTES), KEEP_S)
    for second in range(3):
        ring.put(lot(range(second, second + 1)), None, float(second))
    assert ring.claim(1.0) == 1.0
    assert ring.claimed
    assert ring.put(lot(range(3, 6)), None, 100.0) == []
    gone = ring.put(lot(range(6, 8)), None, 101.0)
    assert [told(held) for held in gone] == [[1], [2]]
    held = ring.next(100.0)
    assert held is not None
    assert told(held) == [3, 4, 5]
    assert ring.next(100.0) is None
    ring.release()
    assert ring.put(lot(range(8, 9)), None, 120.0) == []
    assert kept(ring) == [8]


PROGRAM = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(__file__).rpartition('/test/')[0] + '/test'!r})
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.ring import Ring
from shadowhound_data_logger.model import Taken
size, limit = int(sys.argv[1]), 32 << 20
def rss():
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096
def lot(first, count):
    made = [Taken(bytes(size), 10**18 + n, 'p', 10**6 + n, 10**18 + n) for n in range(first, first + count)]
    return Lot('/t', 'T', '', made)
ring, count, at = Ring(limit, 1e9), max(1, 200_000 // (size + 200)), 0
before = rss()
for turn in range(4 * limit // (count * (size + 256))):
    ring.put(lot(at, count), None, float(turn))
    at += count
print((rss() - before) / limit, ring.bytes / limit)
"""


@pytest.mark.parametrize('size', [20, 300, 50_000, 921_600])
def test_memory_is_bounded_by_the_limit_of_bytes(size: int) -> None:
    """Filled four times over, the process grew by the limit and a tenth at most, whether messages are small or large."""
    ran = subprocess.run([sys.executable, '-c', PROGRAM, str(size)], capture_output=True, text=True, check=True, timeout=60)
    grown, used = map(float, ran.stdout.split())
    assert 0.9 < used <= 1.0
    assert grown <= 1.1
