"""Program of a test: a robot with Cyclone DDS, without ROS. It takes the commands of ``publisher.py``, and can subscribe as well.

Topics and types have the names that ROS gives them (``rt/imu``, ``sensor_msgs::msg::dds_::Imu_``), final types in XCDR1
(https://design.ros2.org/articles/topic_and_service_names.html); the definitions are those of rosbags.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cyclonedds._clayer import ddspy_take, ddspy_write  # raw bytes, as a driver in C++ has them
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from e2e.numbered import Numbered
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MATCH_S = 120.0
BLOCK_S = 1.0
"""As in rmw_cyclonedds_cpp: how long a RELIABLE writer waits for slow readers."""
TAKE_S = 0.002
NOT_READ = 0
INTERFACES = Path(__file__).parents[2] / 'interfaces'
SCALARS: dict[str, Any] = {
    'bool': bool, 'string': str, 'float32': idl.float32, 'float64': idl.float64, 'byte': idl.uint8, 'octet': idl.uint8,
    **{f'{sign}int{bits}': getattr(idl, f'{sign}int{bits}') for sign in ('', 'u') for bits in (8, 16, 32, 64)},
}  # fmt: skip


class Types:
    """IDL types by the names of ROS."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        for path in INTERFACES.glob('*/msg/*.msg'):
            self._store.register(get_types_from_msg(path.read_text(), f'{path.parts[-3]}/msg/{path.stem}'))
        self._made: dict[str, Any] = {}

    def of(self, name: str) -> Any:
        if name not in self._made:
            package, _, short = name.split('/')
            members = {member: self._member(*kind) for member, kind in self._store.fielddefs[name][1]}
            self._made[name] = final(make_idl_struct(f'{short}_', f'{package}.msg.dds_.{short}_', members))
        return self._made[name]

    def _member(self, kind: Nodetype, what: Any) -> Any:
        if kind is Nodetype.BASE:
            return SCALARS[what[0]]
        if kind is Nodetype.NAME:
            return self.of(what)
        inner, length = what
        return idl.array[self._member(*inner), length] if kind is Nodetype.ARRAY else idl.sequence[self._member(*inner)]


def as_ros_has_it(environ: Mapping[str, str]) -> str:
    """CYCLONEDDS_URI as rmw_cyclonedds_cpp completes it from the variables of ROS; AS_HUMBLE selects that of Humble.

    Source: ``check_create_domain`` of rmw_node.cpp, 1.3.4 and 4.0.
    """
    own = environ.get('CYCLONEDDS_URI', '')
    only = environ.get('ROS_LOCALHOST_ONLY') == '1'
    if environ.get('AS_HUMBLE'):
        lo = '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>'
        return f'<CycloneDDS><Domain>{lo}</Domain></CycloneDDS>,{own}' if only else own
    scope = 'LOCALHOST' if only else environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'SUBNET'
    peers = [] if only else [peer for peer in environ.get('ROS_STATIC_PEERS', '').split(';') if peer]
    if scope == 'SYSTEM_DEFAULT':
        return own
    general = '<General><AllowMulticast>false</AllowMulticast></General>' if scope in {'LOCALHOST', 'OFF'} else ''
    if scope == 'OFF':
        discovery = f'<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>'
    else:
        listed = ''.join(f'<Peer address="{peer}"/>' for peer in (['localhost'] * (scope == 'LOCALHOST') + peers))
        discovery = '<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>'
        discovery += f'<Peers>{listed}</Peers>' if listed else ''
    return f'<CycloneDDS><Domain>{general}<Discovery>{discovery}</Discovery></Domain></CycloneDDS>,{own}'


def qos(order: dict[str, Any]) -> Qos:
    reliable = Policy.Reliability.Reliable(duration(seconds=BLOCK_S)) if order['reliable'] else Policy.Reliability.BestEffort
    return Qos(
        reliable,
        Policy.Durability.TransientLocal if order['latched'] else Policy.Durability.Volatile,
        Policy.History.KeepLast(order['depth']),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


class Driver:
    """One participant, in the domain of these variables; a process has one domain of each number."""

    def __init__(self, environ: Mapping[str, str]) -> None:
        domain = int(environ.get('ROS_DOMAIN_ID', '0'))
        self._domain = Domain(domain, as_ros_has_it(environ))
        self._participant = DomainParticipant(domain)
        self._types = Types()
        self._topics: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._readers: dict[str, Any] = {}
        self._counts: dict[str, int] = {}
        self._numbered = Numbered(self._write_or_raise)
        self._lock = threading.Lock()

    def obey(self, order: dict[str, Any]) -> Any:
        topic = order.get('topic', '')
        if self._numbered.takes(order):
            return self._numbered.obey(order)
        match order['do']:
            case 'create':
                self._writers[topic] = DataWriter(self._participant, self._topic(order), qos(order))
            case 'listen':
                with self._lock:
                    self._counts[topic] = 0
                    self._readers[topic] = DataReader(self._participant, self._topic(order), qos(order))
            case 'count':
                with self._lock:
                    return self._counts[topic]
            case 'matched':
                self._wait_for(topic, order['count'])
            case 'publish':
                self._publish(topic, [bytes.fromhex(message) for message in order['messages']], order['period_s'])
            case 'again':
                self._publish(topic, [bytes.fromhex(order['message'])] * order['count'], order['period_s'])
            case 'destroy':
                del self._writers[topic]
        return None

    def take(self) -> None:
        """Count received messages in an endless loop."""
        while True:
            time.sleep(TAKE_S)
            self.poll()

    def poll(self) -> None:
        """Count the messages received since the last poll."""
        with self._lock:
            for topic, reader in self._readers.items():
                self._counts[topic] += sum(bool(info.valid_data) for _, info in ddspy_take(reader._ref, NOT_READ, 100))

    def close(self) -> None:
        """Leave the graph properly, so that others notice immediately."""
        with self._lock:
            for entities in (self._readers, self._writers, self._topics):
                entities.clear()
            del self._participant, self._domain
        gc.collect()

    def _topic(self, order: dict[str, Any]) -> Any:
        name = order['topic']
        if name not in self._topics:
            self._topics[name] = Topic(self._participant, f'rt{name}', self._types.of(order['type']), qos(order))
        return self._topics[name]

    def _wait_for(self, topic: str, count: int) -> None:
        end = time.monotonic() + MATCH_S
        while self._writers[topic].get_publication_matched_status().current_count < count:
            if time.monotonic() > end:
                raise TimeoutError(f'no subscription to {topic}')
            time.sleep(0.005)

    def _publish(self, topic: str, messages: list[bytes], period_s: float) -> None:
        due = time.monotonic()
        for message in messages:
            time.sleep(max(0.0, due - time.monotonic()))
            due += period_s
            self._write(topic, message)

    def _write(self, topic: str, message: bytes) -> int:
        """Less than 0 if it was not sent (dds/ddsrt/retcode.h)."""
        return int(ddspy_write(self._writers[topic]._ref, message))

    def _write_or_raise(self, topic: str, message: bytes) -> None:
        if self._write(topic, message) < 0:
            raise TimeoutError(topic)


def answer(value: Any = None) -> None:
    sys.stdout.write('done\n' if value is None else f'done {json.dumps(value)}\n')
    sys.stdout.flush()


def main() -> None:
    driver = Driver(os.environ)
    threading.Thread(target=driver.take, daemon=True).start()
    for line in sys.stdin:
        order = json.loads(line)
        if order['do'] == 'end':
            break
        answer(driver.obey(order))
    driver.close()
    answer()


if __name__ == '__main__':
    main()
