"""CPU per message of intake with the keep decision, no encoding, relative to an rclpy subscriber with a raw callback.

Both receive from the same publisher at the same time: sensor_msgs/Imu at 2,000 messages per second. Ours is the complete node
with one sensor that keeps almost nothing (minimum ``rate_hz``), including its commits of the accounts, its checks of the graph
and its status. The other is the minimal rclpy subscriber (callback_subscriber.py): it only counts.
"""

from __future__ import annotations

import argparse
import time

from _report import Bar, Report, main, progress, ratio
from _world import Program, World, until

RATE_HZ = 2000
ROUNDS = 5
TOPIC = '/imu'
PARAMETERS = {
    'sensors': ['imu'], 'imu.topics': [TOPIC], 'imu.types': ['sensor_msgs/msg/Imu'], 'imu.rate_hz': 0.0001, 'imu.batch_s': 0.0,
}  # fmt: skip
WARM = RATE_HZ
QUIET_S = 1.5
"""Longer than the node needs to make its accounts durable, short enough that idling does not matter."""


def settled(world: World, subscriber: Program, sent: int) -> tuple[int, int]:
    """What both have received of the sent messages, after some time."""
    time.sleep(QUIET_S)
    until(lambda: world.received(TOPIC) >= sent, 'the node to account for all messages', seconds=10.0)
    return world.received(TOPIC), int(subscriber.ask()['received'])


def measure(options: argparse.Namespace) -> Report:
    progress(f'intake at {RATE_HZ} messages a second, {options.seconds:g} s')
    count = round(RATE_HZ * options.seconds / ROUNDS)
    ours: list[float] = []
    theirs: list[float] = []
    figures: dict[str, object] = {'rate_hz': RATE_HZ, 'messages_a_round': count}
    with World(options.folder) as world:
        node = world.node(PARAMETERS)
        subscriber = world.program('callback_subscriber', 'callback_subscriber.py', '--topic', TOPIC)
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        publisher.ask(subscribers=2)
        time.sleep(1.0)
        publisher.ask(count=WARM, rate_hz=RATE_HZ)
        time.sleep(QUIET_S)
        received, heard = world.received(TOPIC), int(subscriber.ask()['received'])
        publishing: list[float] = []
        lost = [0, 0]
        for _ in range(ROUNDS):
            before = node.cpu_s(), subscriber.cpu_s()
            publishing.append(publisher.ask(count=count, rate_hz=RATE_HZ)['cpu_s'])
            last = received, heard
            received, heard = settled(world, subscriber, received + count)
            ours.append(1e6 * (node.cpu_s() - before[0]) / (received - last[0]))
            theirs.append(1e6 * (subscriber.cpu_s() - before[1]) / (heard - last[1]))
            lost = [lost[0] + count - received + last[0], lost[1] + count - heard + last[1]]
        value, rounds = ratio(ours, theirs)
        row = world.topic(TOPIC)
    figures |= {'node_us': ours, 'callback_us': theirs, 'node_lost': lost[0], 'callback_lost': lost[1],
                'publisher_us': [1e6 * used / count for used in publishing], 'ratio': value, 'ratios': rounds,
                'accounting': row['accounting'], 'stored': row['stored']}  # fmt: skip
    what = 'CPU a message of intake with the keep decision, Imu at 2,000 msg/s, against an rclpy raw callback subscriber'
    return Report((Bar(what, 'at most 0.25', value, 'of the callback', value <= 0.25, rounds),), figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=20.0)
