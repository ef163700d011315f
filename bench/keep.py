"""Keep everything, upload on request: the cost for the node, and the delay of rows, previews and requested data.

Two nodes receive from the same simulated Go2 at the same time, each with its own link to one server, shaped to 3 Mbit/s: one with
the default settings (1 Hz, all uploaded), the other with every image in archives and every message of the other sensors in a bag,
both kept on the robot. Near the end a minute of 30 Hz video is requested. It needs permission to create a network namespace.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from statistics import median
from typing import Any, Final

import _proc
from _link import ShapedLinks, in_own_network
from _report import Bar, Report, main, percentile, progress, ratio
from _world import BUCKET, ROBOT, Program, World, until

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.mailbox import KeptFilter
from shadowhound_data_logger.formats.rows.catalog import KEPT
from shadowhound_data_logger.lake import pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import RowFile, read
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.stores.s3 import S3Store

KEPT_SETTINGS: Final = {
    'camera.rate_hz': 0.0, 'camera.batch_s': 1.0, 'camera.format': 'tar', 'camera.ship': 'on_request', 'lidar.enabled': False,
    'bag.record': 'always', 'bag.topics': ['imu', 'odom', 'joint_states', 'go2_states', 'lowstate', 'point_cloud2'],
    'bag.slice_s': 5.0, 'bag.compression': 'none', 'bag.ship': 'on_request',
}  # fmt: skip
"""As in docs/keep.md: every image in archives of a second, all other topics in the slices of a bag."""
OTHER: Final = 'once'
"""Name of the robot in the node that uploads 1 Hz."""
MBPS: Final = 3.0
WARM_S: Final = 10.0
ROUNDS: Final = 6
ASKED_S: Final = 60
LAST: Final = 0.75
"""Share of the time before the video is requested."""
THIRDS: Final = 3
"""Parts of the time before the video is requested, to detect growth of memory or delays."""
MAX_RATIO, MAX_LATE_S, MAX_BEGIN_S = 1.3, 15.0, 20.0


class Arrivals:
    """Age of the oldest message in each preview and each part of rows when the store had it, in seconds."""

    def __init__(self, source: Bucket) -> None:
        self._source = source
        self.late: dict[str, dict[str, tuple[float, float] | None]] = {'_previews': {}, KEPT.folder: {}}
        """Folder -> key -> arrival, and delay; None for objects that existed before."""
        self._find(lambda _key, _at: None)

    def poll(self) -> None:
        self._find(lambda key, at: (at, at - self._first_ns(key) / SECOND))

    def _find(self, late: Any) -> None:
        for folder, found in self.late.items():
            for info in self._source.list(f'{ROBOT}/{folder}/'):
                if info.key not in found:
                    assert info.modified is not None
                    found[info.key] = late(info.key, info.modified.timestamp())

    def _first_ns(self, key: str) -> int:
        if KEPT.folder not in key:
            head = self._source.head(key)
            return int(head.metadata['t_start_ns']) if head else 0
        info = next(info for info in self._source.list(key))
        (found,) = read(self._source, [RowFile(KEPT, ROBOT, '', info)], Findings(lambda _: None))
        return min(row['t_start_ns'] for row in found.rows)

    def seconds(self, folder: str, begin: float = 0.0, end: float = float('inf')) -> list[float]:
        """Delays of the objects that arrived between these times, in the order of their keys."""
        return [late for at, late in filter(None, self.late[folder].values()) if begin <= at < end]


def measure(options: argparse.Namespace) -> Report:
    in_own_network()
    with World(options.folder) as world:
        assert world.tower is not None
        source = Bucket(world.tower.store_settings(), BUCKET)
        with ShapedLinks(world.tower.endpoint_url, [MBPS, MBPS]) as links:
            nodes = {
                'kept': world.node(KEPT_SETTINGS, environ={'AWS_ENDPOINT_URL': links.urls[0]}),
                '1 Hz': world.node(environ={'AWS_ENDPOINT_URL': links.urls[1], 'SHADOWHOUND_ROBOT': OTHER,
                                            'SHADOWHOUND_HOME': str(world.folder / OTHER)}),
            }  # fmt: skip
            sim = world.sim()
            until(lambda: len(world.ledger()['topics']) > 3, 'the node to hear the robot', *nodes.values(), sim)
            time.sleep(WARM_S)
            progress(f'two nodes, {options.seconds:g} s')
            arrivals = Arrivals(source)
            load, began = _proc.load(), time.time()
            used, memory = _watch(nodes, arrivals, options.seconds * LAST)
            length = (time.time() - began) / THIRDS
            progress(f'{ASKED_S} s of the camera are asked for')
            begin_s, arrived_s = _pull(source, arrivals, options.seconds * (1.0 - LAST))
            found = world.ledger()
            other = ledger.read(world.folder / OTHER / 'spool', OTHER)
            sim.stop()
    value, rounds = ratio(used['kept'], used['1 Hz'])
    late = {folder: arrivals.seconds(folder) for folder in arrivals.late}
    figures = {
        'cores': {name: sum(each) / options.seconds / LAST for name, each in used.items()}, 'ratio': value, 'ratios': rounds,
        'late_s': {folder: {'count': len(each), 'p50': percentile(each, 50), 'p95': percentile(each, 95), 'max': max(each)}
                   for folder, each in late.items()},
        'late_p95_s': {folder: [percentile(arrivals.seconds(folder, began + part * length, began + (part + 1) * length), 95)
                                for part in range(THIRDS)] for folder in late},
        'memory_mb': {name: [median(each[part * len(each) // THIRDS : (part + 1) * len(each) // THIRDS])
                             for part in range(THIRDS)] for name, each in memory.items()},
        'load': [load, _proc.load()],
        'begin_s': begin_s, 'arrived_s': arrived_s, 'seconds': options.seconds, 'mbps': MBPS,
        'bytes': {'kept': found['bytes'], '1 Hz': other['bytes']}, 'balanced': found['balanced'] and other['balanced'],
        'missed': sum(row['missed'] or 0 for row in found['topics'].values()),
    }  # fmt: skip
    return Report(_bars(figures, late, rounds), figures)


def _bars(figures: dict[str, Any], late: dict[str, list[float]], rounds: Sequence[float]) -> tuple[Bar, ...]:
    words = {'_previews': 'preview', KEPT.folder: 'catalog row'}
    shaped = f'link of {MBPS:g} Mbit/s, {figures["seconds"]:g} s'
    return (
        Bar('CPU of the node that keeps all at full rate, against one beside it that uploads 1 Hz', f'at most {MAX_RATIO}',
            figures['ratio'], 'of it', figures['ratio'] <= MAX_RATIO, tuple(rounds)),
        *(Bar(f'{words[folder]} of what is kept in the store after the message, {shaped}: worst of {len(each)}',
              f'at most {MAX_LATE_S:g}', max(each), 's', max(each) <= MAX_LATE_S)
          for folder, each in late.items()),
        Bar(f'from asking for {ASKED_S} s of 30 Hz video to its first second in the store, the same link',
            f'at most {MAX_BEGIN_S:g}', figures['begin_s'], 's', figures['begin_s'] <= MAX_BEGIN_S),
    )  # fmt: skip


def _watch(nodes: dict[str, Program], arrivals: Arrivals,
           seconds: float) -> tuple[dict[str, list[float]], dict[str, list[float]]]:  # fmt: skip
    """CPU seconds of each node in each round, and its private memory in MB every two seconds."""
    used, memory = ({name: list[float]() for name in nodes} for _ in range(2))
    for _ in range(ROUNDS):
        before, end_s = {name: node.cpu_s() for name, node in nodes.items()}, time.monotonic() + seconds / ROUNDS
        while (left := end_s - time.monotonic()) > 0:
            arrivals.poll()
            for name, node in nodes.items():
                memory[name].append(_proc.memory(node.pid).anon)
            time.sleep(min(2.0, max(left, 0.0)))
        for name, node in nodes.items():
            used[name].append(node.cpu_s() - before[name])
    return used, memory


def _pull(source: Bucket, arrivals: Arrivals, seconds: float) -> tuple[float, float | None]:
    """Seconds from the request to the first object in the store, and to the last answer; None on timeout."""
    store = S3Store(source.settings, UploadSettings())
    store.open()
    now_ns = time.time_ns()
    want = KeptFilter(sensor='camera', since_ns=now_ns - ASKED_S * SECOND, until_ns=now_ns)
    began_s = time.monotonic()
    request = pull.put_request(store, source, ROBOT, want, by='bench')
    until(lambda: source.list(f'{ROBOT}/camera/'), 'the first second of the video', seconds=300.0)
    begin_s, arrived_s = time.monotonic() - began_s, None
    while time.monotonic() - began_s < seconds and arrived_s is None:
        arrivals.poll()
        answer = pull.newest_answer(source, ROBOT, request.id)
        if answer is not None and answer.state in pull.FINAL:
            arrived_s = time.monotonic() - began_s
        time.sleep(1.0)
    store.close()
    return begin_s, arrived_s


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=600.0)
