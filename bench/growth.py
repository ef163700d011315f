"""How CPU, memory and loss of the node grow with the number of topics, the rate of images, and the rate of a bag.

Topics: Imu at 10 Hz on each, all stored, in an object per topic and second. Images: one camera, received at 1 to 30 MB/s and
stored once a second, as by default. Bags: the same camera recorded completely. A SeaweedFS server and the publisher share the
machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any

import _proc
from _report import Bar, Report, main, progress
from _world import World

TOPICS = (1, 10, 50, 200)
TOPIC_HZ = 10.0
IMAGE_BYTES = 1_000_000
IMAGE_MB_S = (1, 3, 10, 30)
BAG_MB_S = (30, 60, 120)
BAG_IMAGE_BYTES = 4_000_000
SETTLE_S = 20.0
KEPT_UP = 0.98
"""Share of the ordered rate that the publisher must reach; points below it do not count for the bar."""


def grow(options: argparse.Namespace, parameters: Mapping[str, Any], arguments: tuple[str, ...], rate_hz: float,
         *, sink: str = 'topics') -> dict[str, Any]:  # fmt: skip
    """One point of a curve."""
    with World(options.folder) as world:
        node = world.node({'capture.topics': 'all', 'robot': 'thor', **parameters})
        publisher = world.program('many_publisher', 'many_publisher.py', *arguments)
        publisher.ask(subscribers=1)
        publisher.ask(seconds=3.0, rate_hz=rate_hz)  # objects, history depth and connections settle
        time.sleep(1.0)
        cpu, busy, start = node.cpu_s(), _proc.busy_s(), time.monotonic()
        sent = publisher.ask(seconds=options.seconds, rate_hz=rate_hz)
        took = time.monotonic() - start
        cpu, busy = node.cpu_s() - cpu, _proc.busy_s() - busy
        memory = _proc.memory(node.pid)
        behind_s = settle(world, sink)
        node.stop()
        found = world.ledger()
    rows = [row for topic, row in found[sink].items() if topic.startswith('/grown/')]
    received, missed = sum(row['received'] for row in rows), sum(row['missed'] or 0 for row in rows)
    dropped = sum(sum(row['dropped'].values()) for row in rows)
    return {
        'cpu': 100 * cpu / took, 'busy': busy / took, 'memory_mb': memory.resident, 'received': received,
        'lost': missed + dropped, 'reached': sent['published'] / sent['seconds'] / max(1, len(rows)) / rate_hz,
        'behind_s': behind_s, 'us': 1e6 * cpu / sent['published'], 'topics': len(rows), 'balanced': found['balanced'],
    }  # fmt: skip


def settle(world: World, sink: str) -> float:
    """Seconds until no message waits in the node any more; ``SETTLE_S`` if some still do."""
    start = time.monotonic()
    while (waited := time.monotonic() - start) < SETTLE_S:
        time.sleep(0.2)
        rows = [row for topic, row in world.ledger()[sink].items() if topic.startswith('/grown/')]
        if rows and not any(row['open'] for row in rows):
            return waited
    return SETTLE_S


def measure(options: argparse.Namespace) -> Report:
    figures: dict[str, Any] = {'topics': {}, 'images': {}, 'bags': {}}
    for count in TOPICS:
        progress(f'{count} topics')
        figures['topics'][count] = grow(options, {}, ('--topics', str(count)), TOPIC_HZ)
    for rate in IMAGE_MB_S:
        progress(f'images, {rate} MB/s')
        arguments = ('--image-bytes', str(IMAGE_BYTES))
        figures['images'][rate] = grow(options, {}, arguments, rate * 1e6 / IMAGE_BYTES)
    for rate in BAG_MB_S:
        progress(f'a bag, {rate} MB/s')
        parameters = {'bag.record': 'always', 'bag.regex': '/grown/.*', 'capture.topics': 'sensors'}
        arguments = ('--image-bytes', str(BAG_IMAGE_BYTES))
        figures['bags'][rate] = grow(options, parameters, arguments, rate * 1e6 / BAG_IMAGE_BYTES, sink='bags')
    kept_up = [each for curve in figures.values() for each in curve.values() if each['reached'] >= KEPT_UP]
    lost = sum(each['lost'] for each in kept_up)
    bar = Bar('lost where the publisher kept up, over all points', 'none', float(lost), 'messages',
              holds=lost == 0 and all(each['balanced'] for each in kept_up))  # fmt: skip
    return Report((bar,), figures)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=10.0)
