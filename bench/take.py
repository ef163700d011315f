"""CPU of a take through librcl, which reports number and publisher of each message, relative to rclpy's own on the same machine.

Two subscriptions of one process receive from the same publisher; each round drains both, in turns, and every message counts. It
needs Fast DDS.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

import rclpy
from _report import Bar, Report, main, progress, ratio
from rclpy.context import Context
from rclpy.serialization import serialize_message
from shadowhound_sim.demo_processes import THIS_MACHINE, free_domain
from std_msgs.msg import String

from shadowhound_data_logger.ros import reader
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.reader import PolledGroup, Reader

SIZES = {'small': (324, 2.0), 'large': (20_000, 2.0)}
"""Bytes, and the maximum cost relative to rclpy: a robot's LowState and a JPEG."""
MESSAGES = 500
"""Per round: less than the history holds."""
ROUND_S = 0.4
"""Approximate duration of a round."""


def drained_us(one: Reader, count: int) -> float:
    """CPU microseconds per message that already waits."""
    received, used_s, end_s = 0, 0.0, time.monotonic() + 20.0
    while received < count and time.monotonic() < end_s:
        before_s = time.thread_time()
        taken = len(one.drain())
        if taken:
            used_s += time.thread_time() - before_s
        received += taken
        time.sleep(0.001)
    assert received == count, f'{received} of {count} messages came'
    return 1e6 * used_s / count


def pair(node: Any, topic: str) -> tuple[Reader, Reader]:
    """One that takes through rclpy, and one through librcl."""
    plan = Plan(topic, 'std_msgs/msg/String', reliable=True, transient_local=False, depth=2 * MESSAGES)
    readers = []
    for enough in ((), (99,)):
        reader.REPORTS_PUBLISHERS = enough  # type: ignore[misc]
        readers.append(Reader(node, plan, PolledGroup()))
    assert [one._taker is None for one in readers] == [True, False], 'takes through librcl are not verified here'
    return readers[0], readers[1]


def measured(node: Any, size: int, rounds: int) -> tuple[list[float], list[float]]:
    """Microseconds per take of both, by rounds."""
    topic = f'/take_{size}'
    both = pair(node, topic)
    publisher = node.create_publisher(String, topic, 2 * MESSAGES)
    while not all(one.matched() for one in both):
        time.sleep(0.01)
    cdr = serialize_message(String(data='x' * (size - 9)))
    found: tuple[list[float], list[float]] = ([], [])
    for number in range(rounds):
        for _ in range(MESSAGES):
            publisher.publish(cdr)
        time.sleep(0.1)
        for which in ((0, 1), (1, 0))[number % 2]:
            found[which].append(drained_us(both[which], MESSAGES))
    for one in both:
        one.close()
    return found


def measure(options: argparse.Namespace) -> Report:
    context = Context()
    rclpy.init(context=context, domain_id=free_domain())
    node = rclpy.create_node('take', context=context)
    bars, figures = [], {}
    for name, (size, most) in SIZES.items():
        rounds = max(4, round(options.seconds / len(SIZES) / ROUND_S))
        progress(f'{size:,} bytes, {rounds} rounds of {MESSAGES} messages')
        theirs, ours = measured(node, size, rounds)
        value, ratios = ratio(ours, theirs)
        bars.append(Bar(f'CPU of a take of {size:,} bytes through librcl, against rclpy', f'at most {most}', value, 'of rclpy',
                        value <= most, ratios))  # fmt: skip
        figures[name] = {'bytes': size, 'rclpy_us': theirs, 'librcl_us': ours}
    node.destroy_node()
    rclpy.shutdown(context=context)
    return Report(tuple(bars), figures)


if __name__ == '__main__':
    os.environ.update(THIS_MACHINE)
    main(__doc__, measure, seconds=20.0)
