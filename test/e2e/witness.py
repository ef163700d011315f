"""Program of a test: subscribes to topics next to the node and writes every message, unchanged, to a file.

``python witness.py FILE '{"/imu": ["go2_interfaces/msg/IMU", true]}'``; true is RELIABLE. SIGTERM stops it. It does not use
the package under test. Each record is a line of JSON (topic, source_ns, bytes) followed by that many bytes.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

POLL_S = 0.02
DEPTH = 2000
LARGE_DEPTH = 60


class Heard(NamedTuple):
    """One message."""

    topic: str
    source_ns: int
    cdr: bytes


def recorded(path: Path) -> Iterator[Heard]:
    """The messages that a witness wrote."""
    with path.open('rb') as file:
        while line := file.readline():
            topic, source_ns, size = json.loads(line)
            yield Heard(topic, source_ns, file.read(size))


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def hear(subscription: Any, kind: Any, topic: str, file: BinaryIO) -> None:
    handle = subscription.handle
    with handle:
        while (taken := handle.take_message(kind, True)) is not None:
            cdr, info = taken
            file.write(json.dumps([topic, info['source_timestamp'], len(cdr)]).encode() + b'\n' + cdr)


def main(path: str, order: str) -> None:
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('witness', start_parameter_services=False, enable_rosout=False)
    subscriptions = []
    for topic, (type_name, reliable) in json.loads(order).items():
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=LARGE_DEPTH if type_name.startswith('sensor_msgs/msg/Point') else DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        )
        kind = message_class(type_name)
        subscriptions.append((node.create_subscription(kind, topic, lambda _: None, profile, raw=True), kind, topic))
    sys.stdout.write('ready\n')
    sys.stdout.flush()
    with Path(path).open('wb') as file:
        ended = False
        while not ended:
            ended = stop.wait(POLL_S)
            for subscription, kind, topic in subscriptions:
                hear(subscription, kind, topic, file)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(*sys.argv[1:])
