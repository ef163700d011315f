"""How many small messages per second the node stores without loss: sensor_msgs/Imu into JSON batches of a second, to S3.

From a publisher of serialized messages in another process; the S3 server runs on the same machine. Each rate has a separate
node and ledger. The ledger decides: all published, all received, all stored, nothing missed or dropped.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import _proc
from _report import Bar, Report, main, progress
from _world import World, lost

BAR_HZ = 5000
RATES_HZ = (5000, 10_000, 15_000, 20_000)
"""Tried in this order until one fails."""
TOPIC = '/imu'
PARAMETERS = {
    'sensors': ['imu'], 'imu.topics': [TOPIC], 'imu.types': ['sensor_msgs/msg/Imu'], 'imu.rate_hz': 0.0, 'imu.batch_s': 1.0,
}  # fmt: skip
KEPT_UP = 0.99
"""Share of the requested rate that the publisher must have reached."""
WARM_S = 1.0
SETTLE_S = 15.0


def run(folder: Path, rate_hz: int, seconds: float) -> dict[str, Any]:
    """One rate: published messages, the ledger, and the cost."""
    with World(folder) as world:
        # The history of a subscription is sized for 2,000 messages per second unless the node expects more.
        node = world.node(PARAMETERS)
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        publisher.ask(subscribers=1)
        time.sleep(1.0)
        warm = publisher.ask(count=round(rate_hz * WARM_S), rate_hz=rate_hz)['published']
        time.sleep(1.0)  # the node has found that one subscription is enough
        cpu, busy, start = node.cpu_s(), _proc.busy_s(), time.monotonic()
        report = publisher.ask(count=round(rate_hz * seconds), rate_hz=rate_hz)
        busy = (_proc.busy_s() - busy) / (time.monotonic() - start)
        settle(world, warm + report['published'])
        cpu = node.cpu_s() - cpu
        node.stop()
        found = world.ledger()
    row = found['topics'][TOPIC]
    gone = lost([row]) + sum(row['rejected'].values())
    reached = report['published'] / report['seconds']
    kept_up = report['published'] == round(rate_hz * seconds) and reached >= KEPT_UP * rate_hz
    closes = found['balanced'] and row['accounting'] == 'exact' and row['stored'] == row['received'] == row['published']
    return {
        'asked_hz': rate_hz, 'reached_hz': reached, 'seconds': report['seconds'], 'published': warm + report['published'],
        'received': row['received'], 'stored': row['stored'], 'lost': gone, 'balanced': found['balanced'],
        'accounting': row['accounting'], 'node_us': 1e6 * cpu / report['published'],
        'publisher_us': 1e6 * report['cpu_s'] / report['published'], 'cores_busy': busy,
        'mb_per_s': found['bytes']['delivered'] / 1e6 / (report['seconds'] + WARM_S),
        'holds': kept_up and closes and gone == 0,
    }  # fmt: skip


def settle(world: World, published: int) -> None:
    """Wait until every message is accounted for and every object delivered; at a rate that is too high some never are."""
    end = time.monotonic() + SETTLE_S
    while time.monotonic() < end:
        row = world.topic(TOPIC)
        if row and row['received'] + (row['missed'] or 0) >= published and not row['open'] and not row['stored_in']['pending']:
            return
        time.sleep(0.1)


def measure(options: argparse.Namespace) -> Report:
    runs = []
    for rate_hz in RATES_HZ:
        progress(f'small messages, {rate_hz} a second, {options.seconds:g} s')
        runs.append(run(options.folder, rate_hz, options.seconds))
        if not runs[-1]['holds']:
            break
    best = max((float(each['asked_hz']) for each in runs if each['holds']), default=0.0)
    bar = Bar('small messages sustained without loss, serialized publisher, into JSON batches', 'at least 5,000', best, 'msg/s',
              best >= BAR_HZ)  # fmt: skip
    return Report((bar,), {'runs': runs})


if __name__ == '__main__':
    main(__doc__, measure, seconds=12.0)
