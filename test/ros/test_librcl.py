"""Values read from librcl directly are correct."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from e2e.processes import until
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rclpy.utilities import get_rmw_implementation_identifier
from std_msgs.msg import String

from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.ros import librcl, reader
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, SubscriptionRefused

pytestmark = pytest.mark.ros


@pytest.fixture
def node(domain: int) -> Iterator[Any]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('asking', context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_the_publishers_of_a_subscription_are_counted(node: Any) -> None:
    """While they come and go, also if rclpy does not count them."""
    found = read(node, '/counted')
    handle = found._subscription.handle
    assert found.matched() == librcl.publisher_count(handle.pointer) == 0
    publishers = [node.create_publisher(String, '/counted', 10) for _ in range(2)]
    until(lambda: librcl.publisher_count(handle.pointer) == 2, 'both publishers are matched')
    assert found.matched() == 2
    node.destroy_publisher(publishers.pop())
    until(lambda: librcl.publisher_count(handle.pointer) == 1, 'one of them is left')
    found.close()


SIZES = (0, 1, 100, 3_000, 500_000, 7, 2_000_000, 20_000, 3)
"""For consecutive messages: the buffer must grow, and not return what a longer one left in it."""
needs_fast_dds = pytest.mark.skipif(get_rmw_implementation_identifier() not in reader.FAST_DDS, reason='needs numbers')


@pytest.fixture
def through_librcl(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this rclpy provides."""
    monkeypatch.setattr(reader, 'REPORTS_PUBLISHERS', (99,))
    monkeypatch.setattr(reader, '_VERIFIED', {})


def read(node: Any, topic: str, depth: int = 100, *, latched: bool = False) -> Reader:
    return Reader(node, Plan(topic, 'std_msgs/msg/String', reliable=True, transient_local=latched, depth=depth), PolledGroup())


def drained(found: Reader, count: int) -> list[Taken]:
    taken: list[Taken] = []
    until(lambda: taken.extend(found.drain()) or len(taken) >= count, lambda: f'{count} messages, here {len(taken)}')
    return taken


@needs_fast_dds
@pytest.mark.parametrize('latched', [False, True])
def test_librcl_and_rclpy_agree(node: Any, monkeypatch: pytest.MonkeyPatch, *, latched: bool) -> None:
    """For each message of two publishers, small, large and small again: bytes, times, and the sender that rclpy reports."""
    monkeypatch.setattr(reader, 'REPORTS_PUBLISHERS', ())
    by_rclpy = read(node, '/both', latched=latched)
    monkeypatch.setattr(reader, 'REPORTS_PUBLISHERS', (99,))
    by_librcl = read(node, '/both', latched=latched)
    assert (by_rclpy._taker, by_librcl._taker is None) == (None, False)
    quality = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)
    publishers = [node.create_publisher(String, '/both', quality) for _ in range(2)]
    until(lambda: by_rclpy.matched() == by_librcl.matched() == 2, 'both are matched')
    until(lambda: len(reader.endpoints(node, '/both')) == 2, 'both are in the graph')
    gids = [endpoint.gid for endpoint in reader.endpoints(node, '/both')]
    sent = []
    for number, size in enumerate(SIZES, start=1):
        for place, publisher in enumerate(publishers):
            sent.append((cdr := serialize_message(String(data=f'{place}' * size)), number))
            publisher.publish(cdr)
    both = (sorted(drained(each, len(sent)), key=attrgetter('source_ns')) for each in (by_rclpy, by_librcl))
    pairs = list(zip(*both, strict=True))
    assert [(report.cdr, report.number) for _, report in pairs] == sent
    assert {report.publisher for _, report in pairs} == set(gids)
    for known, report in pairs:
        assert report.cdr == known.cdr
        assert report.source_ns == known.source_ns
        assert known.number in {None, report.number}
        assert known.publisher in {None, report.publisher}
        assert abs(report.received_ns - known.received_ns) < 10 * 10**9
    for each in (by_rclpy, by_librcl):
        each.close()


@needs_fast_dds
@pytest.mark.usefixtures('through_librcl')
def test_takes_through_librcl_are_verified_once(node: Any, caplog: pytest.LogCaptureFixture) -> None:
    """With the node's messages to itself, on a topic that is removed afterwards, and one log line."""
    caplog.set_level('INFO')
    readers = [read(node, f'/proved{number}') for number in range(3)]
    assert all(each._taker is not None for each in readers)
    assert [record.levelname for record in caplog.records] == ['INFO']
    until(lambda: not [name for name, _ in node.get_topic_names_and_types() if '_take_' in name], 'the topic is gone')
    for each in readers:
        each.close()


@needs_fast_dds
@pytest.mark.parametrize(
    ('version', 'needs_librcl'),
    [((3, 3, 15), True), ((7, 1, 6), True), ((9, 1, 0), True), ((9, 1, 1), False), ((9, 1, 2), False), ((10, 0, 0), False)],
)
def test_librcl_is_used_where_rclpy_lacks_information(
    node: Any, monkeypatch: pytest.MonkeyPatch, version: tuple[int, ...], *, needs_librcl: bool
) -> None:
    """Humble, Jazzy, and early Kilted: their rclpy does not report the sender of a message."""
    monkeypatch.setattr(reader, 'rclpy_version', lambda: version)
    monkeypatch.setattr(reader, '_VERIFIED', {})
    assert reader.takes_through_librcl(node) is needs_librcl


@needs_fast_dds
def test_rclpy_reports_what_its_version_should(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether its take reports the publisher, on which the version limit is based."""
    with monkeypatch.context() as patch:
        patch.setattr(reader, 'REPORTS_PUBLISHERS', ())
        found = read(node, '/told')
    publisher = node.create_publisher(String, '/told', 10)
    until(lambda: found.matched() == 1, 'it is matched')
    publisher.publish(String(data='x'))
    (report,) = drained(found, 1)
    assert (report.publisher is not None) is (reader.rclpy_version() >= reader.REPORTS_PUBLISHERS)
    found.close()


@needs_fast_dds
@pytest.mark.parametrize('version', [(), (99,)])
def test_an_empty_message_is_skipped(
    node: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, version: tuple[int, ...]
) -> None:
    """Fast DDS returns endless ones if it lost its position: the reader switches to another subscription, and logs it once."""
    monkeypatch.setattr(reader, 'REPORTS_PUBLISHERS', version)
    found = read(node, '/stuck')
    publisher = node.create_publisher(String, '/stuck', 10)
    for turn in range(2):
        until(lambda: found.matched() == 1, 'it is matched')
        publisher.publish(cdr := serialize_message(String(data=str(turn))))
        assert [taken.cdr for taken in drained(found, 1)] == [cdr]
        stuck = found._subscription
        with monkeypatch.context() as patch:
            patch.setattr(librcl.Taker, 'take', lambda *_: (b'', 0, 0, 0, bytes(16), 0))
            found._subscription = SimpleNamespace(handle=EmptyHandle())
            assert found.drain() == []
        assert found._subscription.handle.pointer
        node.destroy_subscription(stuck)
    assert [record.levelname for record in caplog.records].count('WARNING') == 1
    found.close()


def test_messages_before_an_empty_message_are_taken(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if no other subscription can be created, which the next drain retries."""
    found = read(node, '/refused')
    kept = found._subscription
    waiting = [Taken(b'cdr', 1, None, None, 1)]

    def stuck(_: object, *__: object) -> Iterator[Taken]:
        found._is_stuck = True
        yield from waiting

    def refused() -> None:
        raise SubscriptionRefused('not now')

    monkeypatch.setattr(found, '_through_rclpy', stuck)
    monkeypatch.setattr(found, '_through_librcl', stuck)
    with monkeypatch.context() as patch:
        patch.setattr(found, '_subscribe', refused)
        assert found.drain() == waiting
        assert found._subscription is kept
    assert found.drain() == waiting
    assert found._subscription is not kept
    found.close()


@needs_fast_dds
@pytest.mark.parametrize('version', [(), (99,)])
def test_messages_after_an_empty_message_are_taken(node: Any, monkeypatch: pytest.MonkeyPatch, version: tuple[int, ...]) -> None:
    """Any participant may send some: they cost neither the messages after them nor the subscription."""
    monkeypatch.setattr(reader, 'REPORTS_PUBLISHERS', version)
    found = read(node, '/hollow')
    before = found._subscription
    publisher = node.create_publisher(String, '/hollow', 10)
    until(lambda: found.matched() == 1, 'it is matched')
    sent = [b'', serialize_message(String(data='1')), b'', b'', serialize_message(String(data='2'))]
    for cdr in sent:
        publisher.publish(cdr)
    assert [taken.cdr for taken in drained(found, 2)] == list(filter(None, sent))
    assert found._subscription is before
    found.close()


class EmptyHandle:
    """The handle of a stuck subscription."""

    pointer = 1

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def take_message(self, *_: object) -> tuple[bytes, dict[str, Any]]:
        return b'', {'source_timestamp': 0, 'received_timestamp': 1, 'publication_sequence_number': 0}


WRONG = {
    'number': lambda told: told._replace(number=(told.number or 0) + 1),
    'no number': lambda told: told._replace(number=None),
    'publisher': lambda told: told._replace(gid=bytes(16)),
    'time of sending': lambda told: told._replace(source_ns=told.source_ns + 10**12),
    'bytes': lambda told: told._replace(cdr=told.cdr[:-1]),
    'layout': lambda told: told._replace(implementation=told.implementation + 8),
}


@needs_fast_dds
@pytest.mark.usefixtures('through_librcl')
@pytest.mark.parametrize('what', WRONG)
def test_incorrect_message_info_is_not_trusted(
    node: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Messages are taken through rclpy then, and one warning has the reason."""
    take = librcl.Taker.take
    monkeypatch.setattr(librcl.Taker, 'take', lambda *given: (report := take(*given)) and WRONG[what](librcl.RclMessage(*report)))
    readers = [read(node, f'/wrong{number}') for number in range(2)]
    assert [each._taker for each in readers] == [None, None]
    (record,) = caplog.records
    assert record.levelname == 'WARNING'
    assert 'is reported as RclMessage(' in record.getMessage()
    publisher = node.create_publisher(String, '/wrong0', 10)
    until(lambda: readers[0].matched() == 1, 'it is matched')
    publisher.publish(String(data='still'))
    assert drained(readers[0], 1)[0].cdr == serialize_message(String(data='still'))
    for each in readers:
        each.close()


@pytest.mark.usefixtures('through_librcl')
def test_a_librcl_without_the_functions_is_not_used(
    node: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one of a future distribution; with Cyclone DDS it is not called at all, since there are no numbers."""

    def missing() -> None:
        raise AttributeError('undefined symbol: rcutils_get_default_allocator')

    monkeypatch.setattr(librcl, 'Taker', missing)
    found = read(node, '/missing')
    assert found._taker is None
    has_numbers = get_rmw_implementation_identifier() in reader.FAST_DDS
    assert [record.levelname for record in caplog.records] == ['WARNING'] * has_numbers
    found.close()


@needs_fast_dds
@pytest.mark.usefixtures('through_librcl')
def test_overwritten_messages_are_a_gap_in_the_numbers(node: Any) -> None:
    """Of those published during a pause, the last messages arrive, with their numbers."""
    found = read(node, '/full', depth=5)
    publisher = node.create_publisher(String, '/full', 100)
    until(lambda: found.matched() == 1, 'it is matched')
    for number in range(20):
        publisher.publish(String(data=f'{number}'))
    numbers = [taken.number for taken in drained(found, 5)]
    assert numbers[-1] == 20
    assert numbers == sorted(set(numbers))
    found.close()


def test_an_invalid_subscription_is_an_error() -> None:
    """Not a count."""
    nothing = ctypes.create_string_buffer(64)
    for _ in range(2):
        with pytest.raises(OSError, match='rcl_subscription_get_publisher_count'):
            librcl.publisher_count(ctypes.addressof(nothing))
