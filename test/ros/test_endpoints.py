"""The subscriptions of a topic, from the QoS that its publishers offer."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.node.intake.stream import Senders
from shadowhound_data_logger.ros.endpoints import Endpoint, HistoryDepth, Plan, logged_type, plans

TYPE, OTHER = 'std_msgs/msg/String', 'std_msgs/msg/Int32'
DEPTH = 4000
RELIABLE, BEST_EFFORT, LATCHED = (True, False), (False, False), (True, True)


def planned(*publishers: tuple[bool, bool]) -> list[tuple[bool, bool]]:
    """(reliable, transient_local) of the subscriptions for publishers with this QoS."""
    found = [Endpoint(str(number), TYPE, *quality) for number, quality in enumerate(publishers)]
    return [(plan.reliable, plan.transient_local) for plan in plans('/topic', TYPE, found, DEPTH)]


@pytest.mark.parametrize(
    ('publishers', 'subscriptions'),
    [
        ([RELIABLE], [RELIABLE]),
        ([BEST_EFFORT], [BEST_EFFORT]),
        ([LATCHED], [LATCHED]),
        ([BEST_EFFORT, RELIABLE], [RELIABLE, BEST_EFFORT]),
        ([LATCHED, RELIABLE], [LATCHED, RELIABLE]),  # one with TRANSIENT_LOCAL does not match the other
        ([LATCHED, RELIABLE, BEST_EFFORT], [LATCHED, RELIABLE, BEST_EFFORT]),
        ([LATCHED, BEST_EFFORT], [LATCHED, BEST_EFFORT]),
        ([(False, True)], [BEST_EFFORT]),  # there is no history to repeat
    ],
)
def test_every_publisher_can_serve_one_of_the_subscriptions(
    publishers: list[tuple[bool, bool]], subscriptions: list[tuple[bool, bool]]
) -> None:
    """There is one subscription for each kind of publisher, requesting no more than it offers."""
    assert planned(*publishers) == subscriptions


def test_an_expected_topic_is_listened_to_both_ways() -> None:
    """Before there is a publisher, any kind is matched from its first message on."""
    assert planned() == [RELIABLE, BEST_EFFORT]


@pytest.mark.parametrize(
    ('named', 'current', 'published', 'logged'),
    [
        ('', '', [], ''),  # no type to subscribe with
        (TYPE, '', [], TYPE),
        (TYPE, '', [OTHER, OTHER], TYPE),
        (TYPE, OTHER, [OTHER], TYPE),
        ('', '', [OTHER, TYPE, TYPE], TYPE),
        ('', OTHER, [OTHER, TYPE, TYPE], OTHER),
        ('', OTHER, [TYPE], TYPE),
        (f'{TYPE}|{OTHER}', '', [], TYPE),
        (f'{TYPE}|{OTHER}', '', [OTHER], OTHER),
        (f'{TYPE}|{OTHER}', '', [OTHER, TYPE], TYPE),
        (f'{TYPE}|{OTHER}', OTHER, [OTHER, TYPE], OTHER),
        (f'{TYPE}|{OTHER}', OTHER, [TYPE], TYPE),
    ],
)
def test_one_type_of_a_topic_is_logged(named: str, current: str, published: list[str], logged: str) -> None:
    """The configured one, whatever is published; otherwise the one already received, while it has a publisher."""
    publishers = [Endpoint(str(number), name, *RELIABLE) for number, name in enumerate(published)]
    assert logged_type(publishers, named, current) == logged


@pytest.mark.parametrize(('type_name', 'messages'), [
    (TYPE, 4000), ('sensor_msgs/msg/CompressedImage', 120), ('sensor_msgs/msg/Image', 32), ('my_msgs/msg/Unknown', 4000),
])  # fmt: skip
def test_the_history_covers_a_stall(type_name: str, messages: int) -> None:
    """Before any message: two seconds at 2,000 Hz, of large messages at 60 Hz, within 32 MiB."""
    assert HistoryDepth(type_name).depth == messages


@pytest.mark.parametrize(('type_name', 'size', 'rate_hz', 'messages'), [
    (TYPE, 700, 50, 4000),  # unchanged
    (TYPE, 200, 5_000, 16_384), (TYPE, 40, 15_000, 32_768), (TYPE, 40, 1e6, 65_536),  # faster than most
    (TYPE, 4096, 15_000, 8192),  # faster, within 32 MiB
    (TYPE, 100_000, 10, 256),  # larger than most of its like
    ('sensor_msgs/msg/CompressedImage', 100_000, 30, 120),
    ('sensor_msgs/msg/CompressedImage', 2_000_000, 30, 16),
    ('sensor_msgs/msg/Image', 921_656, 30, 32), ('sensor_msgs/msg/Image', 6_220_856, 30, 16),
])  # fmt: skip
def test_the_history_is_sized_from_the_received_rate(type_name: str, size: int, rate_hz: float, messages: int) -> None:
    """Two seconds of messages at the received rate and size; it settles immediately and stays."""
    history = HistoryDepth(type_name)
    depths = []
    for _ in range(5):
        history.observe([size] * min(round(rate_hz / 5), history.depth), 0.2)
        depths.append(history.depth)
    assert depths[-1] == messages
    assert len(set(depths)) <= 5
    assert depths[1:] == sorted(depths[1:])


def test_a_full_history_grows() -> None:
    """It received more than its depth, so the loss is unknown: it grows until it is no longer full."""
    history = HistoryDepth(TYPE)
    history.observe([40] * 4000, 60.0)
    assert history.depth == 4096


def test_a_stall_does_not_count_as_a_rate() -> None:
    """Messages accumulated during it count for the time since the last drain; a first drain counts as at least one poll."""
    history = HistoryDepth(TYPE)
    history.observe([40] * 3000, 1.5)
    assert history.depth == 4000
    history.observe([40] * 100, 0.0)
    assert history.depth == 4000


def test_a_plan_is_logged_in_words() -> None:
    """The log describes the subscriptions of a topic."""
    assert (
        Plan('/odom', TYPE, reliable=True, transient_local=False, depth=400).describe() == f'/odom ({TYPE}, RELIABLE, depth 400)'
    )
    latched = Plan('/map', TYPE, reliable=True, transient_local=True, depth=10)
    assert latched.describe() == f'/map ({TYPE}, RELIABLE, TRANSIENT_LOCAL, depth 10)'
    assert 'BEST_EFFORT' in Plan('/c', TYPE, reliable=False, transient_local=False, depth=1).describe()


def test_a_single_publisher_is_the_sender() -> None:
    """If the middleware does not name the sender, the only publisher is it; with two it is unknown."""
    senders = Senders()
    assert senders.name(1, 10) is None
    senders.poll(['a'])
    assert senders.name(2, 20) == senders.name(3, 30) is not None
    senders.poll(['a', 'b'])
    assert senders.name(4, 40) is None
    assert senders.name(None, 50) is None


def test_a_successor_is_distinguished_from_its_predecessor() -> None:
    """Numbers that restart while time continues belong to another publisher, though the graph does not show it yet."""
    senders = Senders()
    senders.poll(['a'])
    first = [senders.name(number, number * 10) for number in (1, 2, 3)]
    second = [senders.name(number, 100 + number) for number in (1, 2)]
    assert len({*first}) == len({*second}) == 1
    assert first[0] != second[0]


def test_two_undiscovered_publishers_are_not_mistaken_for_a_gap() -> None:
    """Numbers that restart and later continue the old ones are from two publishers: no sender is known, and nothing is lost."""
    senders = Senders()
    senders.poll(['a'])
    assert None not in {senders.name(number, number * 10) for number in (1, 2, 3, 4, 5)}
    assert None not in {senders.name(number, 100 + number) for number in (1, 2)}
    assert senders.name(6, 200) is None


def test_a_successor_that_overtakes_its_predecessor_is_recognized() -> None:
    """It is distinguished while it publishes, also if it loses a message after that."""
    senders = Senders()
    senders.poll(['a'])
    first = {senders.name(number, number * 10) for number in (1, 2, 3)}
    second = {senders.name(number, 100 + number) for number in (1, 2, 3, 4, 5, 8)}
    assert len(first) == len(second) == 1
    assert None not in first | second
    assert not first & second
