"""What is asked of librcl directly agrees with what is so."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from e2e.processes import until
from rclpy.context import Context
from std_msgs.msg import String

from shadowhound_data_logger.capture import librcl
from shadowhound_data_logger.capture.endpoints import Plan
from shadowhound_data_logger.capture.reader import PolledGroup, Reader

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
    """As they come and go, also where rclpy does not count them."""
    reader = Reader(node, Plan('/counted', 'std_msgs/msg/String', reliable=True, transient_local=False, depth=10), PolledGroup())
    handle = reader._subscription.handle
    assert reader.matched() == librcl.publisher_count(handle.pointer) == 0
    publishers = [node.create_publisher(String, '/counted', 10) for _ in range(2)]
    until(lambda: librcl.publisher_count(handle.pointer) == 2, 'both publishers are matched')
    assert reader.matched() == 2
    node.destroy_publisher(publishers.pop())
    until(lambda: librcl.publisher_count(handle.pointer) == 1, 'one of them is left')
    reader.close()


def test_a_subscription_that_is_none_is_an_error() -> None:
    """Not a count."""
    nothing = ctypes.create_string_buffer(64)
    for _ in range(2):
        with pytest.raises(OSError, match='rcl_subscription_get_publisher_count'):
            librcl.publisher_count(ctypes.addressof(nothing))
