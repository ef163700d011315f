"""Calls librcl through ctypes on rclpy's subscription handle, for information that this distribution's rclpy lacks.

The caller holds the handle (``with handle``) and passes its address (``handle.pointer``). Sources: rcl/subscription.h,
rmw/types.h (``rmw_message_info_t``), rcutils/types/uint8_array.h and rcutils/allocator.h. The parts read here are the same from
Humble to Kilted; the difference, the length of a gid, comes after them.
"""

from __future__ import annotations

import ctypes
import struct
from functools import cache
from typing import Final, NamedTuple

TAKE_FAILED: Final = 401
"""RCL_RET_SUBSCRIPTION_TAKE_FAILED: there is no message."""
UNSUPPORTED: Final = (1 << 64) - 1
"""RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED."""
FIRST_BYTES: Final = 4096
"""Initial size of a take's buffer; it grows with the messages."""
INFO_BYTES: Final = 256
"""More than the size of ``rmw_message_info_t`` (64, on Humble 72), in case it grows."""
GID_BYTES: Final = 16
"""The bytes of a gid that are not padding: an RTPS GUID."""
_INFO: Final = struct.Struct(f'=qqQQQ{GID_BYTES}s')
"""source_timestamp, received_timestamp, publication_sequence_number, reception_sequence_number, and from publisher_gid the
implementation_identifier and the data.
"""


class Allocator(ctypes.Structure):
    """``rcutils_allocator_t``."""

    _fields_ = [(name, ctypes.c_void_p) for name in ('allocate', 'deallocate', 'reallocate', 'zero_allocate', 'state')]


class Bytes(ctypes.Structure):
    """``rcutils_uint8_array_t``, which is also ``rcl_serialized_message_t``."""

    _fields_ = [
        ('buffer', ctypes.c_void_p),
        ('buffer_length', ctypes.c_size_t),
        ('buffer_capacity', ctypes.c_size_t),
        ('allocator', Allocator),
    ]


class RclMessage(NamedTuple):
    """A serialized message with all information from rmw."""

    cdr: bytes
    source_ns: int
    received_ns: int
    number: int | None
    """None if the middleware has no sequence numbers."""
    gid: bytes
    implementation: int
    """Address of the name of the RMW that filled this in."""


@cache
def library() -> ctypes.PyDLL:
    """The library that rclpy has loaded, with its dependencies. Calls keep the GIL, as rclpy's do."""
    return ctypes.PyDLL('librcl.so')


def publisher_count(pointer: int) -> int:
    """Number of matched publishers; rclpy has it since 4.0 (Iron). Raises OSError."""
    count = ctypes.c_size_t()
    _check('rcl_subscription_get_publisher_count', ctypes.c_void_p(pointer), ctypes.byref(count))
    return count.value


def implementation() -> int:
    """Address of the name of the RMW in use, as in ``RclMessage.implementation``. Raises AttributeError if there is none."""
    function = library().rmw_get_implementation_identifier
    function.restype = ctypes.c_void_p
    return int(function() or 0)


class Taker:
    """Takes messages of one subscription, one thread at a time, into a buffer that grows to the largest; ``close`` once."""

    def __init__(self) -> None:
        """Raises OSError or AttributeError if librcl is not as expected."""
        rcl = library()
        self._take = rcl.rcl_take_serialized_message
        default = rcl.rcutils_get_default_allocator
        default.restype = Allocator
        allocator = default()
        self._message, self._info = Bytes(), ctypes.create_string_buffer(INFO_BYTES)
        _check('rcutils_uint8_array_init', ctypes.byref(self._message), ctypes.c_size_t(FIRST_BYTES), ctypes.byref(allocator))
        self._places = ctypes.c_void_p(ctypes.addressof(self._message)), ctypes.c_void_p(ctypes.addressof(self._info))

    def take(self, pointer: ctypes.c_void_p) -> tuple[bytes, int, int, int | None, bytes, int] | None:
        """The oldest waiting message, as the fields of an ``RclMessage``; None if there is none. Raises OSError."""
        message, info = self._places
        code = self._take(pointer, message, info, None)
        if code == TAKE_FAILED:
            return None
        if code:
            raise _failure('rcl_take_serialized_message', code)
        source_ns, received_ns, number, _, implementation, gid = _INFO.unpack_from(self._info)
        taken = self._message
        cdr = ctypes.string_at(taken.buffer, taken.buffer_length)
        return cdr, source_ns, received_ns, None if number == UNSUPPORTED else number, gid, implementation

    def close(self) -> None:
        """Free the buffer."""
        library().rcutils_uint8_array_fini(self._places[0])


def _check(name: str, *arguments: object) -> None:
    code = library()[name](*arguments)
    if code:
        raise _failure(name, code)


def _failure(name: str, code: int) -> OSError:
    """Resets librcl's error state, so that it is not reported with the next error."""
    library().rcutils_reset_error()
    return OSError(f'{name} returned {code}')
