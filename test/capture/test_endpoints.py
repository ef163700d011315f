"""Which subscriptions a topic gets, from what its publishers offer."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.capture.endpoints import Endpoint, Plan, depth, logged_type, plans
from shadowhound_data_logger.capture.stream import Senders
from shadowhound_data_logger.config import IntakeSettings

TYPE, OTHER = 'std_msgs/msg/String', 'std_msgs/msg/Int32'
SETTINGS = IntakeSettings()
RELIABLE, BEST_EFFORT, LATCHED = (True, False), (False, False), (True, True)


def planned(*publishers: tuple[bool, bool]) -> list[tuple[bool, bool]]:
    """(reliable, transient_local) of the subscriptions to publishers of these qualities."""
    found = [Endpoint(str(number), TYPE, *quality) for number, quality in enumerate(publishers)]
    return [(plan.reliable, plan.transient_local) for plan in plans('/topic', TYPE, found, SETTINGS)]


@pytest.mark.parametrize(
    ('publishers', 'subscriptions'),
    [
        ([RELIABLE], [RELIABLE]),
        ([BEST_EFFORT], [BEST_EFFORT]),
        ([LATCHED], [LATCHED]),
        ([BEST_EFFORT, RELIABLE], [RELIABLE, BEST_EFFORT]),
        ([LATCHED, RELIABLE], [LATCHED, RELIABLE]),  # one that asks for TRANSIENT_LOCAL does not hear the other
        ([LATCHED, RELIABLE, BEST_EFFORT], [LATCHED, RELIABLE, BEST_EFFORT]),
        ([LATCHED, BEST_EFFORT], [LATCHED, BEST_EFFORT]),
        ([(False, True)], [BEST_EFFORT]),  # there is nothing to repeat a history with
    ],
)
def test_every_publisher_can_serve_one(publishers: list[tuple[bool, bool]], subscriptions: list[tuple[bool, bool]]) -> None:
    """There is one subscription for each kind of publisher, asking for no more than it offers."""
    assert planned(*publishers) == subscriptions


def test_an_expected_topic_is_listened_to_both_ways() -> None:
    """Before there is a publisher, whatever comes is matched from its first message on."""
    assert planned() == [RELIABLE, BEST_EFFORT]


@pytest.mark.parametrize(
    ('named', 'current', 'published', 'logged'),
    [
        ('', '', [], ''),  # nothing to subscribe with
        (TYPE, '', [], TYPE),
        (TYPE, '', [OTHER, OTHER], TYPE),
        (TYPE, OTHER, [OTHER], TYPE),
        ('', '', [OTHER, TYPE, TYPE], TYPE),
        ('', OTHER, [OTHER, TYPE, TYPE], OTHER),
        ('', OTHER, [TYPE], TYPE),
    ],
)
def test_one_type_of_a_topic_is_logged(named: str, current: str, published: list[str], logged: str) -> None:
    """The one that is named, whoever publishes what; else the one that is heard already, while it has a publisher."""
    publishers = [Endpoint(str(number), name, *RELIABLE) for number, name in enumerate(published)]
    assert logged_type(publishers, named, current) == logged


@pytest.mark.parametrize(
    ('type_name', 'settings', 'messages'),
    [
        (TYPE, IntakeSettings(), 4000),  # 2000 Hz for two seconds
        (TYPE, IntakeSettings(max_rate_hz=1.0), 10),
        ('sensor_msgs/msg/CompressedImage', IntakeSettings(), 120),
        ('sensor_msgs/msg/Image', IntakeSettings(), 16),
        ('sensor_msgs/msg/CompressedImage', IntakeSettings(poll_s=1.0, history_bytes=128 << 20), 240),  # four polls
        ('sensor_msgs/msg/Image', IntakeSettings(history_bytes=4 << 20), 2),
        ('sensor_msgs/msg/Image', IntakeSettings(history_bytes=1 << 20), 1),
        (TYPE, IntakeSettings(poll_s=1.0, max_rate_hz=1e5), (32 << 20) // 4096),
    ],
)
def test_the_history_covers_a_stall(type_name: str, settings: IntakeSettings, messages: int) -> None:
    """Two seconds of messages, at least four polls, within the bytes allowed, never 0."""
    assert depth(type_name, settings) == messages


def test_a_plan_in_words() -> None:
    """The log says how a topic is listened to."""
    assert (
        Plan('/odom', TYPE, reliable=True, transient_local=False, depth=400).describe() == f'/odom ({TYPE}, RELIABLE, depth 400)'
    )
    latched = Plan('/map', TYPE, reliable=True, transient_local=True, depth=10)
    assert latched.describe() == f'/map ({TYPE}, RELIABLE, TRANSIENT_LOCAL, depth 10)'
    assert 'BEST_EFFORT' in Plan('/c', TYPE, reliable=False, transient_local=False, depth=1).describe()


def test_a_single_publisher_is_the_sender() -> None:
    """Where the middleware does not name the sender, the only publisher is it; of two nobody knows."""
    senders = Senders()
    assert senders.name(1, 10) is None
    senders.look(['a'])
    assert senders.name(2, 20) == senders.name(3, 30) is not None
    senders.look(['a', 'b'])
    assert senders.name(4, 40) is None
    assert senders.name(None, 50) is None


def test_a_successor_is_told_from_its_predecessor() -> None:
    """Numbers that begin anew while time goes on are another publisher's, though the graph does not show it yet."""
    senders = Senders()
    senders.look(['a'])
    first = [senders.name(number, number * 10) for number in (1, 2, 3)]
    second = [senders.name(number, 100 + number) for number in (1, 2)]
    assert len({*first}) == len({*second}) == 1
    assert first[0] != second[0]


def test_two_that_the_graph_does_not_show_yet_are_not_taken_for_a_gap() -> None:
    """Numbers that begin anew and then go on where the old ones were come from two publishers: nobody's, and no loss of one."""
    senders = Senders()
    senders.look(['a'])
    assert None not in {senders.name(number, number * 10) for number in (1, 2, 3, 4, 5)}
    assert None not in {senders.name(number, 100 + number) for number in (1, 2)}
    assert senders.name(6, 200) is None


def test_a_successor_that_overtakes_its_predecessor_is_one() -> None:
    """It is told apart for as long as it publishes, also when it loses a message after that."""
    senders = Senders()
    senders.look(['a'])
    first = {senders.name(number, number * 10) for number in (1, 2, 3)}
    second = {senders.name(number, 100 + number) for number in (1, 2, 3, 4, 5, 8)}
    assert len(first) == len(second) == 1
    assert None not in first | second
    assert not first & second
