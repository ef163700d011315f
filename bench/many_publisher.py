"""Publishes on many topics, or large images on one, at a steady rate, as ``bench/growth.py`` orders it.

Each line of standard input is an order, each is answered with a line of JSON: ``{"subscribers": 1}`` waits until every topic has
so many, ``{"seconds": 10, "rate_hz": 30}`` publishes on every topic. Messages are serialized once; only the stamp in the header
is changed, to the time of publication. RELIABLE, as most drivers publish.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from array import array
from typing import Any

import rclpy
from imu_publisher import ACK, MATCH_S, STAMP, STAMP_AT, template
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image, Imu

DEPTH = 30
WIDTH = 1000


def image(size: int) -> bytearray:
    """A gray image of about ``size`` bytes."""
    height = max(1, size // WIDTH)
    message = Image(height=height, width=WIDTH, step=WIDTH, encoding='mono8', data=array('B', bytes(height * WIDTH)))
    return bytearray(serialize_message(message))


def publish(publishers: list[Any], message: bytearray, rate_hz: float, seconds: float) -> dict[str, float]:
    """Publish a round on all topics when it is due, evenly spread over the period."""
    total, start, cpu = round(seconds * rate_hz) * len(publishers), time.monotonic(), time.process_time()
    pause_s = 1 / rate_hz / len(publishers)
    for number in range(total):
        time.sleep(max(0.0, start + number * pause_s - time.monotonic()))
        STAMP.pack_into(message, STAMP_AT, *divmod(time.time_ns(), 1_000_000_000))
        publishers[number % len(publishers)].publish(bytes(message))
    took_s = time.monotonic() - start
    for publisher in publishers:
        publisher.wait_for_all_acked(ACK)
    return {'published': total, 'seconds': took_s, 'cpu_s': time.process_time() - cpu}


def matched(publishers: list[Any], wanted: int) -> dict[str, bool]:
    end = time.monotonic() + MATCH_S
    while not (all_have := all(each.get_subscription_count() >= wanted for each in publishers)) and time.monotonic() < end:
        time.sleep(0.05)
    return {'matched': all_have}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--topics', type=int, default=1)
    parser.add_argument('--image-bytes', type=int, default=0, help='publish images of this size instead of Imu')
    options = parser.parse_args()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('many_publisher', start_parameter_services=False, enable_rosout=False)
    kind, message = (Image, image(options.image_bytes)) if options.image_bytes else (Imu, template())
    publishers = [node.create_publisher(kind, f'/grown/t{number}', QoSProfile(depth=DEPTH)) for number in range(options.topics)]
    for line in sys.stdin:
        order = json.loads(line)
        answer = matched(publishers, order['subscribers']) if 'subscribers' in order else publish(publishers, message, **order)
        print(json.dumps(answer), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
