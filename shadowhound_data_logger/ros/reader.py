"""A subscription that is polled instead of called back; the only interface to each distribution's rclpy.

If rclpy reports less about a message than its RMW knows (Humble: neither number nor publisher; Jazzy and the first Kilted: no
publisher), messages are taken through librcl, after that was verified with messages of the node to itself.

What it needs beyond rclpy's documented interface, from the sources of rclpy 8.0.0 (Rolling, ``ba72a017``) and rmw (``33118c9d``);
``test/ros/test_reader.py`` checks each on the installed rclpy:

- ``Subscription.handle``, a context manager with ``take_message(type, raw)`` and ``pointer``: without it nothing is taken
- keys of the information about a message: ``source_timestamp``, ``received_timestamp`` and, where the distribution has them,
  ``publication_sequence_number`` and ``publisher_gid`` (since 10.0.0 and 9.1.1): otherwise not numbered, or without a publisher
- ``handle.get_publisher_count``: otherwise librcl is asked
- ``CallbackGroup.entities``, ``add_entity``, ``can_execute``, ``beginning_execution``, ``ending_execution``: otherwise a
  subscription is put into a wait set
- ``SubscriptionEventCallbacks(use_default_callbacks=False)``: otherwise events spin the executor (docs/decisions/0002)
- in librcl the layouts of ``rmw_message_info_t``, ``rcutils_uint8_array_t`` and ``rcutils_allocator_t``: otherwise the
  verification fails, and messages are taken through rclpy
"""

from __future__ import annotations

import ctypes
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib import import_module, metadata
from importlib.machinery import PathFinder
from importlib.util import find_spec
from itertools import islice
from types import ModuleType
from typing import Any, Final, TypeVar
from uuid import uuid4

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidTopicNameException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.type_support import NoTypeSupportImportedException, check_for_type_support
from rclpy.utilities import get_rmw_implementation_identifier
from rosidl_generator_py.import_type_support_impl import UnsupportedTypeSupport
from std_msgs.msg import String

from shadowhound_data_logger.core.clock import MAX_AGE_NS
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.ros import librcl
from shadowhound_data_logger.ros.endpoints import Endpoint, Plan

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks

log = logging.getLogger(__name__)
T = TypeVar('T')

MAX_TAKES: Final = 20_000
"""Maximum takes per drain: then the other topics have their turn."""
FAST_DDS: Final = ('rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')
"""The RMWs that report number and publisher of each message (the number since rmw_fastrtps 6.2.1)."""
REPORTS_PUBLISHERS: Final = (9, 1, 1)
"""The first rclpy that reports everything needed, weeks after Kilted's 9.1.0; numbers came with 4.0. Source: rclpy, pull requests
1466 (10.0.0) and 1468. Rolling's 9.2.0, older than 9.1.1, is the exception.
"""
VERIFY_S: Final = 3.0
"""Timeout for messages of the node to itself; they take milliseconds."""
_VERIFIED: Final[dict[str, bool]] = {}
"""By RMW, whether takes through librcl were verified in this process."""


class PolledGroup(CallbackGroup):  # type: ignore[misc]  # rclpy has no types
    """Keeps its entities out of every wait set.

    That includes event handlers: in rmw_fastrtps a reader's events and its data share one condition, so a wait set with an
    event of an undrained subscription returns immediately, forever (a full core, measured on Kilted).
    """

    def add_entity(self, entity: Any) -> None:
        """Add an entity and remove destroyed ones, which rclpy does not do."""
        self.entities: set[Any] = {known for known in self.entities if known() is not None}
        super().add_entity(entity)

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002 - the base class's arguments
        return False

    def beginning_execution(self, entity: Any) -> bool:  # noqa: ARG002
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


_TYPE: Final = re.compile(
    r'([a-z][a-z0-9_]*)/(?:(msg)/([A-Z][A-Za-z0-9]*)|(srv|action)/([A-Z][A-Za-z0-9]*)_([A-Z][A-Za-z_]*))', re.ASCII
)
"""https://design.ros2.org/articles/interface_definition.html; for services and actions the parts that are messages."""
_KINDS: Final = {'msg': 'messages', 'srv': 'services', 'action': 'actions'}
SHIPPED: Final = frozenset({'go2_interfaces', 'unitree_go', 'unitree_hg'})
"""Message packages in ``interfaces/``."""
MAX_PUBLISHERS: Final = 1000
"""Maximum publishers that a subscription names at a time."""
UNKNOWN_NODES: Final = frozenset({'_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_'})
"""rmw's names for the node of a publisher without ROS, or of one that it does not know yet."""


class TypeUnavailable(LookupError):
    """Messages of a type cannot be received here; the text is the reason, a sentence without its period."""


class NotInstalled(TypeUnavailable):
    """The message package of a type is not installed here, or not for this Python."""


class SubscriptionRefused(RuntimeError):
    """The middleware rejects the subscription: this node has the topic with another type, or the name is invalid in ROS.

    Or a publisher has another definition of the type than the one that its class was made from.
    """


@lru_cache
def message_class(type_name: str) -> type:
    """The class to subscribe with to ``package/msg/Name``, ``package/srv/Name_Event`` or ``package/action/Name_FeedbackMessage``.

    If its package is not installed and its definition is known, it is one that is made from that. Raises TypeUnavailable.
    """
    try:
        return installed_class(type_name)
    except NotInstalled as missing:
        from shadowhound_data_logger.ros import type_support  # noqa: PLC0415 - half a second, needed only here

        try:
            return type_support.make(type_name)
        except Rejected:  # no definition either
            raise missing from None
        except type_support.Unsupported as error:
            raise TypeUnavailable(f'{missing}, and it cannot be received without it ({error})') from error


def installed_class(type_name: str) -> type:
    """The class in the message package of a type. Raises TypeUnavailable.

    The name may come from any machine in the network: a package is imported only if it has interfaces of this kind, because an
    import executes its code.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise TypeUnavailable(f'{type_name} is not the name of a message type')
    package, kind = match[1], match[2] or match[4]
    if not _is_installed(package, kind):
        text = f'its message package is not installed here ({type_name}: no package {package} with {_KINDS[kind]})'
        raise NotInstalled(text)
    try:
        module = import_module(f'{package}.{kind}')
        found: type = getattr(module, match[3]) if match[3] else _part(module, match[5], match[6])
        check_for_type_support(found)
    except UnsupportedTypeSupport as error:  # not an ImportError, although an import failed
        text = f'{type_name}: a library of {package} does not load: is its workspace sourced, and built for this Python?'
        raise NotInstalled(text) from error
    except AttributeError as error:
        raise TypeUnavailable(f'the package {package} that is installed here has no {type_name}') from error
    except (ImportError, ValueError, TypeError, NoTypeSupportImportedException) as error:
        raise TypeUnavailable(f'{type_name}: {error}') from error
    return found


def _part(module: ModuleType, name: str, part: str) -> type:
    """The message class of a service or an action: an attribute of the module, or of the class (all of Humble's actions)."""
    found: type | None = getattr(module, f'{name}_{part}', None)
    if found is None:
        interface = getattr(module, name)
        found = getattr(getattr(interface, 'Impl', interface), part)
    return found


def _is_installed(package: str, kind: str) -> bool:
    """Whether a package has interfaces of this kind; found without executing anything."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        return False
    return spec is not None and PathFinder.find_spec(f'{package}.{kind}', spec.submodule_search_locations or ()) is not None


def install_hint(type_name: str) -> str:
    """How to install the package of a type, to follow the reason why it is unavailable."""
    package = type_name.partition('/')[0]
    if package in SHIPPED:
        return f'; build it from interfaces/ of shadowhound_data_logger: colcon build --base-paths interfaces/{package}'
    distro = os.environ.get('ROS_DISTRO', '$ROS_DISTRO')
    return f'; sudo apt install ros-{distro}-{package.replace("_", "-")}, or source the workspace that has it'


@lru_cache
def unavailable(type_name: str) -> str:
    """Why messages of a type cannot be received here; empty if they can."""
    try:
        message_class(type_name)
    except TypeUnavailable as error:
        return str(error)
    return ''


@lru_cache
def is_installed(type_name: str) -> bool:
    """Whether the message package of a type is installed."""
    try:
        installed_class(type_name)
    except TypeUnavailable:
        return False
    return True


def other_definition(node: Node, topic: str, type_name: str) -> str:
    """Which publisher has another definition of a type than the one its class was made from, as a sentence; empty if none has.

    ROS nodes announce the hash of their definition since Iron; programs without ROS do not.
    """
    made = getattr(message_class(type_name), 'HASH', '')
    for info in node.get_publishers_info_by_topic(topic) if made else ():
        theirs = str(info.topic_type_hash)
        if info.topic_type == type_name and theirs.startswith('RIHS') and theirs != made:
            whose = printable(f'{info.node_namespace.rstrip("/")}/{info.node_name}')
            return f'{type_name} is defined differently by {whose}: source the workspace of its publisher'
    return ''


def endpoints(node: Node, topic: str) -> list[Endpoint]:
    """The publishers of a resolved topic in the graph."""
    return [
        Endpoint(
            gid=bytes(info.endpoint_gid[: librcl.GID_BYTES]).hex(),
            type=printable(info.topic_type),
            reliable=info.qos_profile.reliability is ReliabilityPolicy.RELIABLE,
            transient_local=info.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL,
            node='' if info.node_name in UNKNOWN_NODES else printable(f'{info.node_namespace.rstrip("/")}/{info.node_name}'),
        )
        for info in node.get_publishers_info_by_topic(topic)
    ]


def node_of(node: Node, topic: str, publisher: str) -> str:
    """The full name of the node of a topic's publisher; '' if unknown, as for a program without ROS."""
    gid = publisher.partition('.')[0]  # a suffix counts the successors of a publisher
    return next((each.node for each in endpoints(node, topic) if each.gid == gid), '')


class Reader:
    """A live subscription. Created, drained and closed by a single thread: a take after a destroy raises."""

    def __init__(self, node: Node, plan: Plan, group: PolledGroup) -> None:
        """Raises TypeUnavailable if the type is neither installed nor known, SubscriptionRefused if the middleware rejects it."""
        self.plan = plan
        self.drained_s: float | None = None
        """Time of the last drain, by the monotonic clock."""
        self._node = node
        self._group = group
        self._class = message_class(plan.type)
        if why := other_definition(node, plan.topic, plan.type):
            raise SubscriptionRefused(why)
        self._names: dict[bytes, str] = {}
        self._is_stuck = self._has_warned = False
        self._subscription = self._subscribe()
        self._taker = librcl.Taker() if takes_through_librcl(node) else None

    def _subscribe(self) -> Any:
        plan = self.plan
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=plan.depth,
            reliability=ReliabilityPolicy.RELIABLE if plan.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if plan.transient_local else DurabilityPolicy.VOLATILE,
        )
        try:
            return self._node.create_subscription(
                self._class, plan.topic, _never_called, profile, callback_group=self._group, raw=True,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )  # fmt: skip
        except (rclpy_implementation.RCLError, InvalidTopicNameException) as error:
            raise SubscriptionRefused(f'no subscription of type {plan.type} can be made ({error})') from error

    def matched(self) -> int:
        """Number of matched publishers."""
        handle = self._subscription.handle
        with handle:
            if hasattr(handle, 'get_publisher_count'):
                return int(handle.get_publisher_count())
            return librcl.publisher_count(handle.pointer)  # Humble

    def drain(self, max_takes: int = MAX_TAKES) -> list[Taken]:
        """Take everything that waits, oldest first, up to ``max_takes``."""
        handle = self._subscription.handle
        with handle:
            waiting = self._through_rclpy(handle) if self._taker is None else self._through_librcl(handle, self._taker)
            taken = list(islice(waiting, max_takes))
        if self._is_stuck:
            self._renew()
        return taken

    def _renew(self) -> None:
        """Replace the subscription: this one returns an empty message repeatedly, and nothing behind it.

        Fast DDS (2.6 to 3.6) drops a partly received message when its RELIABLE publisher can no longer resend its fragments, and
        leaves it in the list of messages to be taken (ReaderHistory::remove_fragmented_changes_until; Fast-DDS pull request
        2239).
        """
        stuck = self._subscription
        try:
            self._subscription = self._subscribe()
        except SubscriptionRefused as error:  # messages taken so far count; the next drain tries again
            log.warning('%s', error)
            return
        self._node.destroy_subscription(stuck)
        self._is_stuck = False
        if not self._has_warned:
            log.warning('%s: subscribing again: the middleware gave no messages after a part of one was lost', self.plan.topic)
            self._has_warned = True

    def _through_rclpy(self, handle: Any) -> Iterator[Taken]:
        take, message_type, empty = handle.take_message, self._class, 0
        while (taken := take(message_type, True)) is not None:
            cdr, info = taken
            if not cdr:
                empty += 1
                if self._is_endless(empty):
                    return
                continue
            gid = info.get('publisher_gid')  # Jazzy and older do not report it
            yield Taken(
                cdr, info['source_timestamp'], None if gid is None else self._name(gid['data']),
                info.get('publication_sequence_number'), info['received_timestamp'] or _received_ns(info['source_timestamp']),
            )  # fmt: skip

    def _through_librcl(self, handle: Any, taker: librcl.Taker) -> Iterator[Taken]:
        take, pointer, empty = taker.take, ctypes.c_void_p(handle.pointer), 0
        while (taken := take(pointer)) is not None:
            cdr, source_ns, received_ns, number, gid, _ = taken
            if not cdr:
                empty += 1
                if self._is_endless(empty):
                    return
                continue
            yield Taken(cdr, source_ns, self._name(gid), number, received_ns or _received_ns(source_ns))

    def _is_endless(self, empty: int) -> bool:
        """Whether a drain returned more empty messages than can wait: a few may be real, and are skipped."""
        self._is_stuck = empty > self.plan.depth
        return self._is_stuck

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)
        if self._taker is not None:
            self._taker.close()
            self._taker = None

    def _name(self, gid: bytes) -> str:
        """The publisher's gid in hex, as in the graph."""
        name = self._names.get(gid)
        if name is None:
            if len(self._names) >= MAX_PUBLISHERS:
                self._names.clear()
            name = self._names[gid] = bytes(gid[: librcl.GID_BYTES]).hex()
        return name


def takes_through_librcl(node: Node) -> bool:
    """Whether readers take through librcl: if the RMW knows more about a message than rclpy reports, and it was verified; tried
    once.
    """
    rmw = get_rmw_implementation_identifier()
    if rmw not in FAST_DDS or rclpy_version() >= REPORTS_PUBLISHERS:
        return False
    if rmw not in _VERIFIED:
        problem = verify_librcl(node)
        _VERIFIED[rmw] = not problem
        if problem:
            log.warning('taking messages through rclpy, which does not report their publishers: through librcl %s', problem)
        else:
            log.info('taking messages through librcl, which reports their numbers and publishers; rclpy does not')
    return _VERIFIED[rmw]


def rclpy_version() -> tuple[int, ...]:
    """The version of the installed rclpy; () if its metadata is missing."""
    for name in ('rclpy', 'ros-rclpy'):  # as part of a distribution, and as a wheel
        try:
            return tuple(int(part) for part in metadata.version(name).split('.') if part.isdecimal())
        except metadata.PackageNotFoundError:
            continue
    return ()


def verify_librcl(node: Node) -> str:
    """Verify librcl with messages that the node sends itself on a private topic; the error, or empty if all is correct.

    Content, number, time of sending and publisher of each are known independently.
    """
    topic = f'{node.get_fully_qualified_name()}/_take_{uuid4().hex}'
    publisher = node.create_publisher(String, topic, 10, event_callbacks=PublisherEventCallbacks(use_default_callbacks=False))
    subscription = node.create_subscription(
        String, topic, _never_called, 10, callback_group=PolledGroup(), raw=True,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )  # fmt: skip
    try:
        with subscription.handle:
            return _verify_message(node, topic, publisher, ctypes.c_void_p(subscription.handle.pointer))
    except (OSError, AttributeError) as error:
        return f'they cannot be taken: {error}'
    finally:
        node.destroy_subscription(subscription)
        node.destroy_publisher(publisher)


def _verify_message(node: Node, topic: str, publisher: Any, pointer: ctypes.c_void_p) -> str:
    rmw, taker = librcl.implementation(), librcl.Taker()
    try:
        if not _within(VERIFY_S, lambda: librcl.publisher_count(pointer.value or 0) and endpoints(node, topic)):
            return 'messages of this node to itself do not arrive'
        gid = bytes.fromhex(endpoints(node, topic)[0].gid)
        for number, size in enumerate((1, librcl.FIRST_BYTES, 2), start=1):
            cdr = serialize_message(String(data='x' * size))
            before_ns = time.time_ns()
            publisher.publish(cdr)
            first_ns, last_ns = sorted((before_ns, time.time_ns()))  # the clock may have stepped
            taken = _within(VERIFY_S, lambda: taker.take(pointer))
            if taken is None:
                return 'a message of this node to itself does not arrive'
            found = librcl.RclMessage(*taken)
            known = librcl.RclMessage(cdr, found.source_ns, found.received_ns, number, gid, rmw)
            if found != known or not first_ns <= found.source_ns <= last_ns:
                reported = found._replace(cdr=found.cdr[:16])
                sent = f'message {number} of {gid.hex()}, {len(cdr)} bytes, sent from {first_ns} to {last_ns}'
                return f'{sent}, is reported as {reported}'
        return ''
    finally:
        taker.close()


def _within(seconds: float, ask: Callable[[], T]) -> T:
    """The first true answer, or the last one."""
    end_s = time.monotonic() + seconds
    while not (answer := ask()) and time.monotonic() < end_s:
        time.sleep(0.001)
    return answer


def _received_ns(sent_ns: int) -> int:
    """Arrival time if the middleware does not report it (Humble's Cyclone DDS): the time of sending, if that is recent.

    Source: rmw_cyclonedds_cpp, rmw_node.cpp; received_timestamp is 0 before its version 2.2.1 (Jazzy).
    """
    now_ns = time.time_ns()
    return sent_ns if 0 <= now_ns - sent_ns <= MAX_AGE_NS else now_ns


def _never_called(_: bytes) -> None:
    raise AssertionError('a polled subscription was executed')
