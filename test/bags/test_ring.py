"""The ring keeps the last seconds within its bytes, and counts the messages claimed by an event that it had to discard."""

from __future__ import annotations

import subprocess
import sys

import pytest
from bags.recording import batch, messages

from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.ring import MESSAGE_BYTES, PIECE_BYTES, Ring, RingItem

KEEP_S = 10.0


def kept(ring: Ring) -> list[int]:
    """The numbers of the messages in it, oldest first; it is empty afterwards."""
    ring.claim(float('-inf'))
    return [number for held in iter(lambda: ring.next(float('inf')), None) for number in numbers_of(held)]


def numbers_of(held: RingItem) -> list[int]:
    return [message.number for message in held.batch.messages if message.number is not None]


def test_messages_that_are_too_old_are_discarded() -> None:
    """Of unclaimed messages, the last seconds are kept, in order of arrival."""
    ring = Ring(1 << 20, KEEP_S)
    for second in range(30):
        assert ring.put(batch(range(second, second + 1)), None, float(second)) == []
    assert ring.seconds == KEEP_S
    assert kept(ring) == list(range(19, 30))
    assert ring.bytes == 0


def test_the_oldest_messages_are_discarded_when_the_ring_is_full() -> None:
    """At any age: the bytes count, including Python's overhead for each message."""
    ring = Ring(10 * (12 + MESSAGE_BYTES), KEEP_S)
    for number in range(25):
        assert ring.put(batch(range(number, number + 1)), None, 0.0) == []
        assert ring.bytes <= ring.max_bytes
    assert kept(ring) == list(range(15, 25))


def test_a_large_claim_is_written_in_pieces() -> None:
    """One drain of a fast camera does not displace a full second; messages lost with it belong to its end."""
    ring = Ring(8 * PIECE_BYTES, KEEP_S)
    ring.put(batch(range(10), size=PIECE_BYTES // 2), {'transport': 3}, 0.0)
    ring.claim(0.0)
    pieces = list(iter(lambda: ring.next(0.0), None))
    assert [numbers_of(piece) for piece in pieces] == [[number] for number in range(10)]
    assert [piece.lost for piece in pieces] == [{}] * 9 + [{'transport': 3}]


def test_a_message_that_is_larger_than_the_ring_is_not_kept() -> None:
    """Nor is any other message displaced."""
    ring = Ring(1 << 20, KEEP_S)
    ring.put(batch(range(3)), None, 0.0)
    ring.put(batch(range(3, 4), size=2 << 20), None, 0.0)
    assert (kept(ring), ring.bytes) == ([], 0)


def test_messages_are_not_copied() -> None:
    """The same bytes objects are returned."""
    ring, taken = Ring(1 << 20, KEEP_S), messages(range(5), 100)
    ring.put(MessageBatch('/talk', 'std_msgs/msg/String', '', taken), None, 0.0)
    ring.claim(0.0)
    held = ring.next(0.0)
    assert held is not None
    assert all(out.cdr is given.cdr for out, given in zip(held.batch.messages, taken, strict=True))


def test_claimed_messages_do_not_expire() -> None:
    """Claimed messages wait until the event takes them or newer ones need the room, which is reported."""
    ring = Ring(5 * (12 + MESSAGE_BYTES), KEEP_S)
    for second in range(3):
        ring.put(batch(range(second, second + 1)), None, float(second))
    assert ring.claim(1.0) == 1.0
    assert ring.claimed
    assert ring.put(batch(range(3, 6)), None, 100.0) == []
    gone = ring.put(batch(range(6, 8)), None, 101.0)
    assert [numbers_of(held) for held in gone] == [[1], [2]]
    held = ring.next(100.0)
    assert held is not None
    assert numbers_of(held) == [3, 4, 5]
    assert ring.next(100.0) is None
    ring.release()
    assert ring.put(batch(range(8, 9)), None, 120.0) == []
    assert kept(ring) == [8]


PROGRAM = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(__file__).rpartition('/test/')[0] + '/test'!r})
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.ring import Ring
from shadowhound_data_logger.core.model import Taken
size, limit = int(sys.argv[1]), 32 << 20
def rss():
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096
def batch(first, count):
    made = [Taken(bytes(size), 10**18 + n, 'p', 10**6 + n, 10**18 + n) for n in range(first, first + count)]
    return MessageBatch('/t', 'T', '', made)
ring, count, at = Ring(limit, 1e9), max(1, 200_000 // (size + 200)), 0
before = rss()
for turn in range(4 * limit // (count * (size + 256))):
    ring.put(batch(at, count), None, float(turn))
    at += count
print((rss() - before) / limit, ring.bytes / limit)
"""


MORE = [pytest.param(size, marks=pytest.mark.long('a process for each')) for size in (300, 921_600)]


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('size', [20, 50_000, *MORE])
def test_memory_is_bounded_by_the_limit_of_bytes(size: int) -> None:
    """Filled four times over, the process grew by the limit and a tenth at most, whether messages are small or large."""
    ran = subprocess.run([sys.executable, '-c', PROGRAM, str(size)], capture_output=True, text=True, check=True, timeout=60)
    grown, used = map(float, ran.stdout.split())
    assert 0.9 < used <= 1.0
    assert grown <= 1.1


def latched(*numbers: int, publisher: str | None = 'p', size: int = 0, publishers: int = 2) -> MessageBatch:
    found = batch(range(min(numbers), max(numbers) + 1), '/tf_static', size)
    return found._replace(messages=[each._replace(publisher=publisher) for each in found.messages], latched=publishers)


def of_event(ring: Ring) -> list[tuple[str, str | None, list[int], bool]]:
    """The contents of an event: topic, publisher, numbers, and whether a message is repeated."""
    found = list(iter(lambda: ring.next(float('inf')), None))
    return [(held.batch.topic, held.batch.messages[0].publisher, numbers_of(held), held.repeated) for held in found]


def test_latched_messages_are_at_the_start_of_each_event() -> None:
    """The last message of each publisher, however long ago it left the ring, with the time of the oldest one in it."""
    ring = Ring(1 << 20, KEEP_S)
    ring.put(latched(1, 2), None, 0.0)
    ring.put(latched(5, publisher='q'), None, 0.0)
    ring.put(batch(range(7, 8)), None, 50.0)
    for _ in range(2):
        ring.put(batch(range(8, 9)), None, 100.0)
        ring.claim(95.0)
        first = ring.next(100.0)
        assert first is not None
        assert (first.batch.messages[0].number, first.repeated) == (2, True)
        assert first.batch.messages[0].received_ns == messages(range(8, 9))[0].received_ns
        assert first.batch.messages[0].source_ns == messages(range(2, 3))[0].source_ns
        assert of_event(ring) == [('/tf_static', 'q', [5], True), ('/talk', 'p', [8], False)]
        ring.release()
    ring.put(latched(3), None, 100.0)
    ring.claim(95.0)
    assert of_event(ring) == [('/tf_static', 'p', [2], True), ('/tf_static', 'q', [5], True), ('/tf_static', 'p', [3], False)]
    ring.claim(95.0)
    assert of_event(ring) == [('/tf_static', 'q', [5], True), ('/tf_static', 'p', [3], True)]


def test_without_publisher_ids_one_message_is_latched_per_publisher() -> None:
    """If the middleware does not report the sender (Humble), the last ones are kept, as many as there are publishers."""
    ring = Ring(1 << 20, KEEP_S)
    ring.put(latched(1, 2, 3, publisher=None), None, 0.0)
    ring.put(latched(3, publisher=None), None, 0.0)
    ring.claim(50.0)
    assert of_event(ring) == [('/tf_static', None, [2], True), ('/tf_static', None, [3], True)]


def test_an_event_starts_with_latched_messages() -> None:
    """For the current event; a finished one leaves none for the next."""
    ring = Ring(1 << 20, KEEP_S)
    ring.put(latched(1), None, 0.0)
    for now_ns in (77, 78):
        assert ring.claim(50.0, now_ns) is None
        ring.release()
    ring.claim(50.0, 79)
    (held,) = iter(lambda: ring.next(60.0), None)
    assert held.batch.messages[0].received_ns == 79


def test_latched_messages_count_against_the_byte_limit() -> None:
    """They use at most half of the ring; when that is full, the oldest messages of the same topic are dropped."""
    ring = Ring(1 << 20, KEEP_S)
    for number in range(12):
        ring.put(latched(number, publisher=str(number), size=100_000), None, 0.0)
        assert ring.bytes <= ring.max_bytes
    ring.put(batch(range(3)), None, 50.0)
    assert 500_000 < ring.bytes < 600_000
    ring.claim(0.0)
    assert [numbers for topic, _, numbers, _ in of_event(ring) if topic == '/tf_static'] == [[7], [8], [9], [10], [11]]
