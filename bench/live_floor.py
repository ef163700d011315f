#!/usr/bin/env python3
"""The minimum cost of the live page: a process that subscribes as the page does, and takes the messages or does not.

    scripts/with-env python bench/live_floor.py join|hear|take [TOPIC ...]

``join``: only the node; ``hear``: subscribed to the topics without taking messages; ``take``: takes all messages 30 times a
second, and discards them. It reports that it is ready, and runs until it is stopped. ``bench/live.py --floor`` measures it next
to the page.
"""

from __future__ import annotations

import os
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from shadowhound_data_logger.core import heap
from shadowhound_data_logger.live.topics import _Watched
from shadowhound_data_logger.ros.fast_dds_profile import without_our_profile

DISCOVERY_S = 2.0
TAKE_S = 1 / 30
"""As often as a camera has frames, whatever the page does."""


def main() -> None:
    do, topics = sys.argv[1], set(sys.argv[2:])
    heap.keep_free_blocks()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with without_our_profile(os.environ):
        node = Node('live_floor', start_parameter_services=False, enable_rosout=False)
    time.sleep(DISCOVERY_S)
    known = {topic: types[0] for topic, types in node.get_topic_names_and_types() if topic in topics and do != 'join'}
    watched = [_Watched(node, topic, name, [topic]) for topic, name in known.items()]
    print('ready', len(watched), flush=True)
    next_s = time.monotonic()
    while True:
        next_s += TAKE_S if do == 'take' else 1.0
        time.sleep(max(0.0, next_s - time.monotonic()))
        now_s = time.monotonic()
        for one in watched if do == 'take' else ():
            if one.is_due(now_s):
                one.views[one.reader.plan.topic].shown(one.reader.drain(one.most), now_s)


if __name__ == '__main__':
    main()
