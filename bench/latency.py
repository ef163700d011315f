"""The delay from the capture of a message until it is durable on disk, and until the S3 server has confirmed it, both unbatched.

A topic with one object per message (``rate_hz: 0``, ``batch_s: 0``), 20 messages per second, next to the default profile of a
simulated Go2. Capture is the stamp in the message's header, set when it is published. Durable is when the group commit returned,
confirmed when the put did (timed_node.py); the index's own times are listed as well.

Once more while a backlog drains: the S3 server is down for ``--away`` seconds, during which the same is published, and messages
of the first seconds after its return are measured until they are durable.
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

from shadowhound_data_logger.core.options import DEFAULT_SENSORS

RATE_HZ = 20
ROUNDS = 4
TOPIC = '/probe'
PARAMETERS = {
    'sensors': [*DEFAULT_SENSORS, 'probe'], 'probe.topics': [TOPIC], 'probe.types': ['sensor_msgs/msg/Imu'],
    'probe.rate_hz': 0.0, 'probe.batch_s': 0.0,
}  # fmt: skip
WARM_S = 3.0
AWAY_S = 80.0
BACK_S = 10.0
"""A backlog of AWAY_S drains in about this time."""
LIMITS_MS = {'durable': 400.0, 'confirmed': 1000.0}
WORDS = {'durable': 'capture to durable on disk', 'confirmed': 'capture to confirmed in the store (loopback)'}
CURVE = (*range(100), 99.5, 99.9, 100)


def objects(world: World) -> list[tuple[int, int, int, int | None]]:
    """Of each message: the object's id, its stamp, and the index's created_ns and settled_ns."""
    query = 'SELECT id, t_start_ns, created_ns, settled_ns FROM objects WHERE topic = ? ORDER BY id'
    with closing(sqlite3.connect(f'{(world.spool / "index.db").as_uri()}?mode=ro', uri=True)) as db:
        return db.execute(query, (TOPIC,)).fetchall()


def run(options: argparse.Namespace, seconds: float, away_s: float = 0.0) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Milliseconds of each message by what was waited for; and the ledger's row of the topic.

    If the store was down before, also the number of waiting objects when publishing starts and ends.
    """
    count = round(RATE_HZ * seconds)
    with World(options.folder) as world:
        node = world.node({**PARAMETERS, 'upload.max_backoff_s': 1.0}, program=('timed_node.py',))
        sim = world.sim()
        publisher = world.program('imu_publisher', 'imu_publisher.py', '--topic', TOPIC)
        publisher.ask(subscribers=1)
        until(lambda: len(world.ledger()['topics']) > 1, 'the node to hear the robot', node, sim)
        before = publisher.ask(count=round(RATE_HZ * WARM_S), rate_hz=RATE_HZ)['published']

        def delivered() -> int:
            return int(world.topic(TOPIC).get('stored_in', {}).get('delivered', 0))

        waiting = []
        if away_s:
            until(lambda: delivered() == before, 'everything to be delivered', node)
            assert world.tower is not None
            world.tower.stop_s3()
            before += publisher.ask(count=round(RATE_HZ * away_s), rate_hz=RATE_HZ)['published']
            known = delivered()
            world.tower.start_s3()
            until(lambda: delivered() > known, 'the backlog to leave', node)
            waiting.append(world.ledger()['objects']['pending'])
        publisher.ask(count=count, rate_hz=RATE_HZ)
        if away_s:
            waiting.append(world.ledger()['objects']['pending'])
        until(lambda: delivered() == before + count, 'everything to be delivered', node)
        sim.stop()
        row = world.topic(TOPIC)
        instants_ns = json.loads(node.stop().splitlines()[-1])
        found = objects(world)[-count:]
    times: dict[str, list[float]] = {'durable': [], 'confirmed': [], 'created_ns': [], 'settled_ns': []}
    for number, stamp_ns, created_ns, settled_ns in found:
        instants = {'durable': instants_ns['durable'][str(number)], 'confirmed': instants_ns['confirmed'][str(number)],
                    'created_ns': created_ns, 'settled_ns': settled_ns}  # fmt: skip
        for name, instant_ns in instants.items():
            times[name].append((instant_ns - stamp_ns) / 1e6)
    report = {'published': before + count, 'received': row['received'], 'missed': row['missed']}
    return times, {**report, **({'waiting': waiting} if away_s else {})}


def measure(options: argparse.Namespace) -> Report:
    progress(f'latency at {RATE_HZ} unbatched messages a second, {options.seconds:g} s')
    began = time.monotonic()
    times, row = run(options, options.seconds)
    figures: dict[str, Any] = {'rate_hz': RATE_HZ, 'messages': len(times['durable']), **row, 'took_s': time.monotonic() - began}
    figures['ms'] = {name: summary(values) for name, values in times.items()}
    figures['curve'] = {'percent': CURVE, **{name: [percentile(times[name], percent) for percent in CURVE] for name in WORDS}}
    bars = []
    for name, words in WORDS.items():
        values = times[name]
        size = len(values) // ROUNDS
        rounds = tuple(percentile(values[place * size : (place + 1) * size], 99) for place in range(ROUNDS))
        value = percentile(values, 99)
        what = f'{words}, unbatched, p99 of {len(values)} messages'
        bars.append(Bar(what, f'under {LIMITS_MS[name]:g}', value, 'ms', value < LIMITS_MS[name], rounds))
    if options.away:
        progress(f'the same while a backlog leaves: the store is away for {options.away:g} s')
        times, row = run(options, BACK_S, options.away)
        figures['leaving'] = {**row, 'ms': summary(times['durable'])}
        value = percentile(times['durable'], 99)
        what = f'{WORDS["durable"]}, unbatched, while a backlog of {row["waiting"][0]} objects leaves, p99'
        bars.append(Bar(what, f'under {LIMITS_MS["durable"]:g}', value, 'ms', value < LIMITS_MS['durable']))
    return Report(tuple(bars), figures)


def summary(values: list[float]) -> dict[str, float]:
    return {f'p{percent}': percentile(values, percent) for percent in (50, 90, 99)} | {'max': max(values)}


def _more(parser: argparse.ArgumentParser) -> None:
    what = f'how long the store is away before a backlog leaves (default {AWAY_S:g}; 0: leave that out)'
    parser.add_argument('--away', type=float, default=AWAY_S, metavar='S', help=what)


if __name__ == '__main__':
    main(__doc__, measure, seconds=30.0, more=_more)
