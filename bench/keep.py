"""Keep everything, send what is asked for: what that costs the node, how soon rows and previews arrive, and what is asked for.

The same simulated Go2 twice, uploads capped at 3 Mbit/s: first with the default settings (1 Hz, all uploaded), then with every
picture and cloud kept on the robot. Then half a minute of the camera is asked for. Node, robot and server share the machine.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from _report import Bar, Report, main, progress
from _world import BUCKET, ROBOT, Program, World, until

from shadowhound_data_logger.catalogue.schema import KEPT
from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.lake import pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.reading import tables
from shadowhound_data_logger.mailbox import KeptFilter
from shadowhound_data_logger.stores.s3 import S3Store

FULL_RATE = Path(__file__).resolve().parents[1] / 'launch_configs' / 'go2_full_rate.yaml'
LINK = {'upload.max_mbps': 3.0}
KEEP = {'camera.ship': 'on_request', 'lidar.ship': 'on_request'}
WARM_S = 4.0
ASKED_S = 30
MOST_RATIO, MOST_LATE_S, MOST_BEGIN_S = 1.3, 15.0, 20.0


def measure(options: argparse.Namespace) -> Report:
    with World(options.folder) as world:
        progress(f'1 Hz, {options.seconds:g} s')
        node, sim = _started(world, LINK, None)
        cores = {'1 Hz': _cores(node, options.seconds)}
        sim.stop()
        node.stop()
    with World(options.folder) as world:
        progress(f'all kept, {options.seconds:g} s')
        node, sim = _started(world, LINK | KEEP, FULL_RATE)
        assert world.tower is not None
        source = Bucket(world.tower.store_settings(), BUCKET)
        late: dict[str, float] = {}
        cores['kept'] = _cores(node, options.seconds, lambda: _look(source, late))
        begin_s = _pull(world, source)
        found = world.ledger()
        sim.stop()
        node.stop()
    ratio = cores['kept'] / cores['1 Hz']
    kinds = {
        name: max((value for key, value in late.items() if name in key), default=float('nan')) for name in ('_previews', '_kept')
    }
    bars = (
        Bar('CPU of the node with all kept, of that with 1 Hz uploaded', f'at most {MOST_RATIO}', ratio, '', ratio <= MOST_RATIO),
        *(Bar(f'from the message to the store, at worst: {name}', f'at most {MOST_LATE_S:g}', value, 's', value <= MOST_LATE_S)
          for name, value in kinds.items()),
        Bar(f'from asking for {ASKED_S} s of the camera to its first second', f'at most {MOST_BEGIN_S:g}', begin_s, 's',
            begin_s <= MOST_BEGIN_S),
    )  # fmt: skip
    return Report(bars, {'cores': cores, 'looked at': len(late), 'bytes': found['bytes'], 'balanced': found['balanced']})


def _started(world: World, parameters: dict[str, Any], file: Path | None) -> tuple[Program, Program]:
    node = world.node(parameters, file=file)
    sim = world.sim()
    until(lambda: len(world.ledger()['topics']) > 3, 'the node to hear the robot', node, sim)
    time.sleep(WARM_S)
    return node, sim


def _cores(node: Program, seconds: float, look: Any = lambda: None) -> float:
    begin_s, before = time.monotonic(), node.cpu_s()
    while (left := begin_s + seconds - time.monotonic()) > 0:
        look()
        time.sleep(min(1.0, left))
    return (node.cpu_s() - before) / (time.monotonic() - begin_s)


def _look(source: Bucket, late: dict[str, float]) -> None:
    """How old the oldest message was of each preview and of each part of rows when it was in the store."""
    new = [info for folder in ('_previews', KEPT.folder) for info in source.list(f'{ROBOT}/{folder}/') if info.key not in late]
    for info in new:
        if KEPT.folder in info.key:
            rows = [row for table in tables(source, [info], ('key', 't_start_ns'), Findings(lambda _: None), of=KEPT)
                    for row in table.to_pylist()]  # fmt: skip
            first_ns = min(row['t_start_ns'] for row in rows)
        else:
            head = source.head(info.key)
            first_ns = int(head.metadata['t_start_ns']) if head else 0
        assert info.modified is not None
        late[info.key] = info.modified.timestamp() - first_ns / SECOND


def _pull(world: World, source: Bucket) -> float:
    """Seconds from asking to the first object in the store."""
    assert world.tower is not None
    store = S3Store(world.tower.store_settings(), UploadSettings())
    store.open()
    now_ns = time.time_ns()
    want = KeptFilter(sensor='camera', since_ns=now_ns - ASKED_S * SECOND, until_ns=now_ns)
    began_s = time.monotonic()
    pull.ask(store, source, ROBOT, want, by='bench')
    until(lambda: source.list(f'{ROBOT}/camera/'), 'the first picture')
    took_s = time.monotonic() - began_s
    store.close()
    return took_s


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=40.0)
