"""What the reader asks of rclpy beyond its documented interface is there (the list in ros/reader.py)."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip('rclpy')

import rclpy
from e2e.processes import until
from node.participants import Participant
from rclpy.callback_groups import CallbackGroup
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from shadowhound_data_logger.ros.reader import PolledGroup, SubscriptionEventCallbacks, verify_librcl

pytestmark = pytest.mark.ros
TOLD = {'source_timestamp', 'received_timestamp'}


@pytest.fixture
def node(domain: int) -> Iterator[Any]:
    participant = Participant('asking', domain)
    yield participant.node
    participant.end()


def never(_: bytes) -> None:
    raise AssertionError('a polled subscription was executed')


def test_a_subscription_is_taken_from(node: Any) -> None:
    """Its handle is held, taken from by type and raw, has an address, and tells when the message was sent and came."""
    group = PolledGroup()
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    subscription = node.create_subscription(
        String, '/taken', never, QoSProfile(depth=5), callback_group=group, raw=True, event_callbacks=silent
    )
    publisher = node.create_publisher(String, '/taken', 5)
    until(publisher.get_subscription_count, 'it is matched')
    publisher.publish(String(data='x'))
    handle = subscription.handle
    with handle:
        assert handle.pointer
        cdr, told = until(lambda: handle.take_message(String, True), 'it is taken')
        assert handle.take_message(String, True) is None
    assert cdr[:4] == b'\0\1\0\0'
    assert set(told) >= TOLD
    node.destroy_subscription(subscription)


def test_event_handlers_are_off_by_default(node: Any) -> None:
    """A subscription that wants none has none: they would be in the wait set."""
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    subscription = node.create_subscription(String, '/silent', never, 5, callback_group=PolledGroup(), event_callbacks=silent)
    assert list(getattr(subscription, 'event_handlers', [])) == []
    node.destroy_subscription(subscription)


def test_a_group_answers_all_that_an_executor_asks_of_it(node: Any) -> None:
    """Rclpy's group has these methods and no other, with as many arguments as ours; ours keeps what is in it."""
    group = PolledGroup()
    methods = {name for name, _ in inspect.getmembers(CallbackGroup, inspect.isfunction) if not name.startswith('_')}
    assert methods == {'add_entity', 'has_entity', 'can_execute', 'beginning_execution', 'ending_execution'}
    for name in methods:
        theirs, ours = (inspect.signature(getattr(kind, name)) for kind in (CallbackGroup, PolledGroup))
        assert len(theirs.parameters) == len(ours.parameters), name
    subscription = node.create_subscription(String, '/grouped', never, 5, callback_group=group)
    assert subscription in [known() for known in group.entities]
    assert not group.can_execute(subscription)
    node.destroy_subscription(subscription)


@pytest.mark.skipif(rclpy.get_rmw_implementation_identifier() != 'rmw_fastrtps_cpp', reason='the layout is used with Fast DDS')
def test_librcl_is_verified_on_this_distribution(node: Any) -> None:
    """The proof of the start holds on this distribution, also where rclpy tells all and nobody needs it."""
    assert verify_librcl(node) == ''
