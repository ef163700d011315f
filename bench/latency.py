"""From the capture of a message until it is durable on disk, and until the S3 server has confirmed it, both unbatched.

A topic of which each message is an object of its own (``rate_hz: 0``, ``batch_s: 0``), 20 messages a second, beside the
default profile of a simulated Go2. Capture is the stamp in the message's header, set as it is published. Durable is when the
group commit returned, confirmed when the put did (timed_node.py); what the index itself says is given beside it.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import time
from contextlib import closing
from typing import Any

from _report import Bar, Report, main, percentile, progress
from _world import World, until

from shadowhound_data_logger.options import DEFAULT_SENSORS

RATE_HZ = 20
ROUNDS = 4
TOPIC = '/probe'
PARAMETERS = {
    'sensors': [*DEFAULT_SENSORS, 'probe'], 'probe.topics': [TOPIC], 'probe.types': ['sensor_msgs/msg/Imu'],
    'probe.rate_hz': 0.0, 'probe.batch_s': 0.0,
}  # fmt: skip
WARM_S = 3.0
LIMITS_MS = {'durable': 400.0, 'confirmed': 1000.0}
WORDS = {'durable': 'capture to durable on disk', 'confirmed': 'capture to confirmed in the store (loopback)'}
CURVE = (*range(100), 99.5, 99.9, 100)


def objects(world: World) -> list[tuple[int, int, int, int | None]]:
    """Of each message: the object's id, its stamp, and the index's created_ns and settled_ns."""
    query = 'SELECT id, t_start_ns, created_ns, settled_ns FROM objects WHERE topic = ? ORDER BY id'
    with closing(sqlite3.connect(f'{(world.spool / "index.db").as_uri()}?mode=ro', uri=True)) as db:
        return db.execute(query, (TOPIC,)).fetchall()


def run(options: argparse.Namespace) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Milliseconds of each message by what was waited for; and the ledger's row of the topic."""
    count = round(RATE_HZ * options.seconds)
    with World(options.folder) as world:
        node = world.node(PARAMETERS, program=('timed_node.py',))
        sim = world.sim()
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        publisher.ask(subscribers=1)
        until(lambda: len(world.ledger()['topics']) > 1, 'the node to hear the robot', node, sim)
        warm = publisher.ask(count=round(RATE_HZ * WARM_S), rate_hz=RATE_HZ)['published']
        publisher.ask(count=count, rate_hz=RATE_HZ)

        def done() -> bool:
            row = world.topic(TOPIC)
            return bool(row and row['stored_in']['delivered'] >= count)

        until(done, 'everything to be delivered', node)
        sim.stop()
        row = world.topic(TOPIC)
        told = json.loads(node.stop().splitlines()[-1])
        found = objects(world)[-count:]
    times: dict[str, list[float]] = {'durable': [], 'confirmed': [], 'created_ns': [], 'settled_ns': []}
    for number, stamp_ns, created_ns, settled_ns in found:
        instants = {'durable': told['durable'][str(number)], 'confirmed': told['confirmed'][str(number)],
                    'created_ns': created_ns, 'settled_ns': settled_ns}  # fmt: skip
        for name, instant_ns in instants.items():
            times[name].append((instant_ns - stamp_ns) / 1e6)
    return times, {'published': warm + count, 'received': row['received'], 'missed': row['missed']}


def measure(options: argparse.Namespace) -> Report:
    progress(f'latency at {RATE_HZ} unbatched messages a second, {options.seconds:g} s')
    began = time.monotonic()
    times, row = run(options)
    figures: dict[str, Any] = {'rate_hz': RATE_HZ, 'messages': len(times['durable']), **row, 'took_s': time.monotonic() - began}
    figures['ms'] = {
        name: {f'p{percent}': percentile(values, percent) for percent in (50, 90, 99)} | {'max': max(values)}
        for name, values in times.items()
    }
    figures['curve'] = {'percent': CURVE, **{name: [percentile(times[name], percent) for percent in CURVE] for name in WORDS}}
    bars = []
    for name, words in WORDS.items():
        values = times[name]
        size = len(values) // ROUNDS
        rounds = tuple(percentile(values[place * size : (place + 1) * size], 99) for place in range(ROUNDS))
        value = percentile(values, 99)
        what = f'{words}, unbatched, p99 of {len(values)} messages'
        bars.append(Bar(what, f'under {LIMITS_MS[name]:g}', value, 'ms', value < LIMITS_MS[name], rounds))
    return Report(tuple(bars), figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=30.0)
