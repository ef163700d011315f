"""Publishes serialized sensor_msgs/Imu messages at a steady rate, on request.

Each line of standard input is a request, answered with a line of JSON: ``{"subscribers": 2}`` waits for this many,
``{"count": 10000, "rate_hz": 2000}`` publishes. Messages are serialized once; only the stamp of the header is updated in each, to
the time of its publication. RELIABLE, so nothing is lost silently.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
import time
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu

DEPTH = 2000
MIN_NAP_S = 0.0002
"""Minimum sleep until the next message is due: up to 5,000 per second are sent one by one, faster ones in small groups."""
STAMP = struct.Struct('<iI')
STAMP_AT = 4
"""Offset in a little-endian CDR whose first field is a header: after the encapsulation."""
MATCH_S = 30.0
ACK = Duration(seconds=5)


def template() -> bytearray:
    message = Imu()
    message.header.frame_id = 'imu'
    message.orientation.w = 1.0
    message.linear_acceleration.z = 9.81
    return bytearray(serialize_message(message))


def publish(publisher: Any, message: bytearray, count: int, rate_hz: float) -> dict[str, float]:
    """Publish each message when it is due; returns the duration and the CPU.

    It ends early if the middleware accepts no more messages (its history is full of unacknowledged ones).
    """
    start, cpu, sent = time.monotonic(), time.process_time(), 0
    try:
        while sent < count:
            due = min(count, int((time.monotonic() - start) * rate_hz) + 1)
            while sent < due:
                STAMP.pack_into(message, STAMP_AT, *divmod(time.time_ns(), 1_000_000_000))
                publisher.publish(bytes(message))
                sent += 1
            time.sleep(max(MIN_NAP_S, start + sent / rate_hz - time.monotonic()))
    except RuntimeError as error:  # RCLError, which rclpy does not export
        print(f'stopped after {sent} messages: {error}', file=sys.stderr)
    seconds = time.monotonic() - start
    publisher.wait_for_all_acked(ACK)
    return {'published': sent, 'seconds': seconds, 'cpu_s': time.process_time() - cpu}


def matched(publisher: Any, wanted: int) -> dict[str, int]:
    end = time.monotonic() + MATCH_S
    while (found := publisher.get_subscription_count()) < wanted and time.monotonic() < end:
        time.sleep(0.01)
    return {'subscribers': found}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--topic', default='/imu')
    options = parser.parse_args()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node('imu_publisher', start_parameter_services=False, enable_rosout=False)
    publisher = node.create_publisher(Imu, options.topic, QoSProfile(depth=DEPTH))
    message = template()
    for line in sys.stdin:
        order = json.loads(line)
        if 'subscribers' in order:
            answer: dict[str, Any] = matched(publisher, order['subscribers'])
        else:
            answer = publish(publisher, message, order['count'], order['rate_hz'])
        print(json.dumps(answer), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
