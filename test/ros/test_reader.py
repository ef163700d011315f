"""The reader of topics, and its use of rclpy beyond the documented interface (the list in ros/reader.py)."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from e2e.processes import until
from node.participants import Participant
from rclpy.callback_groups import CallbackGroup
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from shadowhound_data_logger.ros.reader import (
    PolledGroup,
    SubscriptionEventCallbacks,
    TypeUnavailable,
    message_class,
    unavailable,
    verify_librcl,
)

BROKEN = """
class Meta(type):
    _TYPE_SUPPORT = None

    @classmethod
    def __import_type_support__(cls):
        from rosidl_generator_py import import_type_support
        import_type_support('broken_interfaces')

class IMU(metaclass=Meta):
    pass
"""
"""As rosidl generates it, next to a missing library: PYTHONPATH is set, LD_LIBRARY_PATH is not."""


def test_a_package_without_its_library_is_unavailable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Like one that is not installed; rosidl's exception is not an ImportError and would end the intake."""
    (tmp_path / 'broken_interfaces').mkdir()
    (tmp_path / 'broken_interfaces/msg.py').write_text(BROKEN)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(TypeUnavailable, match='a library of broken_interfaces does not load: is its workspace sourced'):
        message_class('broken_interfaces/msg/IMU')
    sys.modules.pop('broken_interfaces.msg')


@pytest.mark.parametrize('layout', ['careless.py', 'careless/__init__.py'])
def test_a_package_without_messages_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str) -> None:
    """Otherwise any participant could make the node import an installed package by publishing a type with that name."""
    path = tmp_path / layout
    path.parent.mkdir(exist_ok=True)
    path.write_text('raise SystemExit("it was run")')
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(TypeUnavailable, match='no package careless with messages'):
        message_class('careless/msg/Thing')
    assert 'careless' not in sys.modules


@pytest.mark.parametrize(
    'name',
    [
        'no_such_package/msg/X',
        'std_msgs/msg/NoSuchName',
        'std_msgs',
        'os/msg/X',
        'os.path/msg/X',
        '/msg/X',
        'std_msgs/msg/__doc__',
        'std_srvs/srv/Trigger',
        'std_srvs/msg/Trigger_Event',
        'std_msgs/srv/Trigger_Event',
        'std_srvs/srv/NoSuchName_Event',
        'no_such_package/action/X_FeedbackMessage',
        'os/action/X_FeedbackMessage',
        'std_srvs/idl/Trigger_Event',
    ],
)
def test_an_invalid_type_is_reported_as_missing(name: str) -> None:
    """Each is reported as the missing package, whatever the import raised."""
    with pytest.raises(TypeUnavailable, match=name):
        message_class(name)


@pytest.mark.parametrize(('name', 'why'), [
    ('nav2_none/action/Go_FeedbackMessage', 'its message package is not installed here .*no package nav2_none with actions'),
    ('std_msgs/srv/Trigger_Event', 'no package std_msgs with services'),
    ('std_srvs/srv/NoSuchName_Event', 'the package std_srvs that is installed here has no std_srvs/srv/NoSuchName_Event'),
    ('std_msgs/msg/NoSuchName', 'the package std_msgs that is installed here has no std_msgs/msg/NoSuchName'),
    ('std_srvs/srv/Trigger', 'is not the name of a message type'),
])  # fmt: skip
def test_the_reported_reason_is_correct(name: str, why: str) -> None:
    """A type that is missing in an installed package is not reported as a missing package."""
    assert re.search(why, unavailable(name))


@pytest.mark.parametrize('name', [
    'std_srvs/srv/Trigger_Event', 'std_srvs/srv/Trigger_Request', 'action_msgs/msg/GoalStatusArray',
    'action_msgs/srv/CancelGoal_Event', 'test_msgs/action/Fibonacci_FeedbackMessage', 'test_msgs/action/Fibonacci_SendGoal_Event',
    'test_msgs/action/NestedMessage_GetResult_Event',
])  # fmt: skip
def test_parts_of_services_and_actions_can_be_received(name: str) -> None:
    """Messages of services and actions can be received where their package is installed."""
    pytest.importorskip(name.partition('/')[0])
    if name.endswith('_Event'):
        pytest.importorskip('service_msgs', reason='Humble has no service events')
    assert message_class(name).__name__ == name.rpartition('/')[2]
    assert not unavailable(name)


pytest.importorskip('rclpy')
TOLD = {'source_timestamp', 'received_timestamp'}


@pytest.fixture
def node(domain: int) -> Iterator[Any]:
    participant = Participant('asking', domain)
    yield participant.node
    participant.end()


def never(_: bytes) -> None:
    raise AssertionError('a polled subscription was executed')


@pytest.mark.ros
def test_messages_are_taken_from_a_subscription(node: Any) -> None:
    """Its handle is acquired, taken from by type and raw, has an address, and reports when the message was sent and received."""
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
        cdr, report = until(lambda: handle.take_message(String, True), 'it is taken')
        assert handle.take_message(String, True) is None
    assert cdr[:4] == b'\0\1\0\0'
    assert set(report) >= TOLD
    node.destroy_subscription(subscription)


@pytest.mark.ros
def test_event_handlers_are_off_by_default(node: Any) -> None:
    """A subscription without any has none: they would be in the wait set."""
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    subscription = node.create_subscription(String, '/silent', never, 5, callback_group=PolledGroup(), event_callbacks=silent)
    assert list(getattr(subscription, 'event_handlers', [])) == []
    node.destroy_subscription(subscription)


@pytest.mark.ros
def test_a_callback_group_has_everything_that_an_executor_uses(node: Any) -> None:
    """The group of rclpy has these methods and no others, with as many arguments as ours; ours keeps its contents."""
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


@pytest.mark.ros
@pytest.mark.skipif(rclpy.get_rmw_implementation_identifier() != 'rmw_fastrtps_cpp', reason='the layout is used with Fast DDS')
def test_librcl_is_verified_on_this_distribution(node: Any) -> None:
    """The check at startup succeeds on this distribution, also if rclpy reports everything."""
    assert verify_librcl(node) == ''
