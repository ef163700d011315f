"""From the start of the node's process to the first message that it stores, next to a plain rclpy node with the same
subscription.

Messages published before that are lost with each restart. A simulated Go2 publishes; the node starts, stops and restarts on the
same spool, with an S3 server that answers. ``first`` is when the first message of ``/odom`` in the spool arrived, ``durable``
the commit with the first object, ``stop`` the time from SIGINT to the exit of the process.
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import statistics
import sys
import time
from contextlib import closing

from _report import Bar, Report, main, progress, ratio
from _world import World, until

TOPIC = '/odom'
ROUNDS = 6
FIRST_S, STOP_S = 1.2, 1.0
LISTENER = """
import sys, time, rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
rclpy.init()
node = rclpy.create_node('listener')
def take(message):
    print('{"first_ns": %d}' % time.time_ns(), flush=True)
    sys.exit()
node.create_subscription(Odometry, sys.argv[1], take, qos_profile_sensor_data)
rclpy.spin(node)
"""


def first_rows(world: World, since_ns: int) -> tuple[int, int] | None:
    """When the first message stored since then arrived, and when its object was committed; None before there is one."""
    query = """SELECT min(CAST(json_extract(metadata, '$.received_start_ns') AS INTEGER)), min(created_ns)
               FROM objects WHERE topic = ? AND created_ns > ?"""
    with closing(sqlite3.connect(f'{(world.spool / "index.db").as_uri()}?mode=ro', uri=True)) as db:
        arrived_ns, created_ns = db.execute(query, (TOPIC, since_ns)).fetchone()
    return None if arrived_ns is None else (arrived_ns, created_ns)


def measure(options: argparse.Namespace) -> Report:
    rounds = max(2, round(options.seconds))
    found: dict[str, list[float]] = {name: [] for name in ('first', 'durable', 'stop', 'plain')}
    with World(options.folder) as world:
        world.sim()
        time.sleep(3.0)  # until the robot publishes
        for number in range(rounds):
            progress(f'start {number + 1} of {rounds}')
            began_ns = time.time_ns()
            plain = world.command('listener', sys.executable, '-c', LISTENER, TOPIC)
            found['plain'].append((plain.line()['first_ns'] - began_ns) / 1e9)
            plain.stop()
            began_ns = time.time_ns()
            node = world.node({f'{TOPIC[1:]}.rate_hz': 0.0, f'{TOPIC[1:]}.batch_s': 0.2})
            rows = until_found(world, began_ns, node)
            found['first'].append((rows[0] - began_ns) / 1e9)
            found['durable'].append((rows[1] - began_ns) / 1e9)
            began_s = time.monotonic()
            node.stop()
            found['stop'].append(time.monotonic() - began_s)
    value, each = ratio(found['first'], found['plain'])
    first_s = statistics.median(found['first'])
    bars = (
        Bar('start of the node to the first message stored, median', f'at most {FIRST_S:g}', first_s, 's', first_s <= FIRST_S,
            tuple(found['first'])),
        Bar('the same against a plain rclpy node', 'for comparison', value, 'of its time', True, each),
        Bar('clean stop, median', f'at most {STOP_S:g}', statistics.median(found['stop']), 's',
            statistics.median(found['stop']) <= STOP_S, tuple(found['stop'])),
    )  # fmt: skip
    return Report(bars, {'s': found, 'load': os.getloadavg()})


def until_found(world: World, since_ns: int, node: object) -> tuple[int, int]:
    found: list[tuple[int, int]] = []

    def is_there() -> bool:
        rows = first_rows(world, since_ns)
        if rows is not None:
            found.append(rows)
        return bool(found)

    until(is_there, 'the first object', node)  # type: ignore[arg-type]
    return found[0]


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=ROUNDS)
