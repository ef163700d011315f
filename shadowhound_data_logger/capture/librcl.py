"""What librcl knows of a subscription and rclpy of this distribution does not tell: asked by ctypes, on rclpy's own handle.

Whoever calls holds the handle (``with handle``) and hands in its address (``handle.pointer``). Source: rcl/subscription.h.
"""

from __future__ import annotations

import ctypes
from functools import cache


@cache
def library() -> ctypes.PyDLL:
    """The librcl that rclpy has loaded. Its calls keep the interpreter's lock, as those of rclpy do."""
    return ctypes.PyDLL('librcl.so')


def publisher_count(pointer: int) -> int:
    """Number of publishers that the subscription is matched with; rclpy has it since 4.0 (Iron). Raises OSError."""
    count = ctypes.c_size_t()
    code = library().rcl_subscription_get_publisher_count(ctypes.c_void_p(pointer), ctypes.byref(count))
    if code:
        library().rcutils_reset_error()
        raise OSError(f'rcl_subscription_get_publisher_count returned {code}')
    return count.value
