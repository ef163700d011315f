"""Prints by how much the spool's index grows an hour while the default profile is logged and delivered at once.

Run it as ``python bench/index_growth.py [--hours 6] [--day] [--folder F] [--json]``. Time is simulated: each second of the robot
is one commit of the objects that ``launch_configs/go2.yaml`` makes of it, with the metadata that a node in a mission gives them,
one delivery of all of them, and one part of the catalog a minute. The first three hours are left out. ``--day`` goes on for a
day and a half with ``remember_days: 1``, for how large the file becomes in the end. Of the longest commit the CPU time is told.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from time import thread_time
from typing import Any

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import CatalogSettings, SpoolSettings
from shadowhound_data_logger.core.model import DataObject, Outcome, State
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool.spool import Spool

START_NS = 1_760_774_400 * SECOND
HOUR_S = 3600
MEMORY = Path('/dev/shm') if Path('/dev/shm').is_dir() else None  # noqa: S108 - a folder of its own in it
"""On a disk most of the time goes into its syncs."""
OLD_BYTES_AN_OBJECT = 906.0
"""With full rows for as long as keys are remembered (this file, three hours)."""
BAR = 0.1
SENSORS = {
    # sensor: (topic, type, messages an object, seconds an object, ending, facts of the content)
    'camera': ('/camera/compressed', 'sensor_msgs/msg/CompressedImage', 1, 1, 'front.jpg', {'width': '640', 'height': '480'}),
    'lidar': ('/point_cloud2', 'sensor_msgs/msg/PointCloud2', 1, 1, 'scan.pcd', {'points': '20000', 'frame_id': 'odom'}),
    'imu': ('/imu', 'go2_interfaces/msg/IMU', 50, 1, 'imu.json', {}),
    'odom': ('/odom', 'nav_msgs/msg/Odometry', 1, 1, 'odom.json', {}),
    'states': ('/go2_states', 'go2_interfaces/msg/Go2State', 20, 1, 'states.json', {}),
    'joints': ('/joint_states', 'sensor_msgs/msg/JointState', 50, 1, 'joints.json', {}),
    'lowstate': ('/lowstate', 'unitree_go/msg/LowState', 500, 10, 'lowstate.json', {}),
}


class SimulatedClock:
    """Time that passes when told to."""

    boot_id = '5a6f3c0e-7a52-4f0e-9c58-6d0b6f0f1b11'
    now_ns = START_NS

    def wall_ns(self) -> int:
        return self.now_ns

    def boot_ns(self) -> int:
        return self.now_ns - START_NS + 100 * SECOND


def made(second: int) -> Iterator[DataObject]:
    """What a second of the default profile becomes."""
    end_ns = START_NS + second * SECOND + 123_456_789
    for sensor, (topic, kind, samples, period_s, ending, facts) in SENSORS.items():
        if second % period_s:
            continue
        start_ns = end_ns - (period_s * SECOND if samples > 1 else 0)
        metadata = {
            **facts, 'robot': 'thor', 'sensor': sensor, 'topic': topic, 'type': kind, 'count': str(samples),
            't_start_ns': str(start_ns), 't_end_ns': str(end_ns), 'mission_id': 'patrol_20251018_080000_1f3c',
            'mission_type': 'patrol', 'run_id': '0123456789abcdef0123456789abcdef',
            'pose': f'{second / 7:.3f} -1.502 0.7854 odom',
            'battery_pct': '81.0',
        }  # fmt: skip
        yield DataObject(
            bucket='sensor-data', key=f'thor/{sensor}/{utc(start_ns):%Y%m%d/%H%M%S}_{ending}',
            body=f'{sensor} {second}'.encode(),
            content_type='application/json' if ending.endswith('json') else 'image/jpeg', sensor=sensor, topic=topic, type=kind,
            samples=samples, t_start_ns=start_ns, t_end_ns=end_ns, metadata=metadata,
        )  # fmt: skip


class Robot:
    """Logs and delivers, second by second."""

    def __init__(self, root: Path, remember_days: float) -> None:
        self.clock = SimulatedClock()
        self.spool = Spool(root, SpoolSettings(min_free_bytes=0, remember_days=remember_days), self.clock, 'thor')
        self.spool.open()
        self._catalog = CatalogWriter(root, CatalogSettings(), 'thor', self.clock, lambda: self.clock.boot_ns() / SECOND)
        self._second = 0
        self.slowest_s = 0.0
        """CPU time of the longest commit."""

    def run(self, seconds: int) -> int:
        """Returns how many objects were delivered."""
        delivered = 0
        for _ in range(seconds):
            self.clock.now_ns += SECOND
            objects = [*made(self._second), *(self._catalog.due() if self._second % 10 == 0 else ())]
            self._second += 1
            for item in objects:
                if item.topic is not None:
                    with self.spool.accounts.entry(item.topic) as account:
                        account.received += item.samples
            begin_s = thread_time()
            ready = self.spool.commit(objects)
            middle_s = thread_time()
            self.spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in ready])
            self.slowest_s = max(self.slowest_s, middle_s - begin_s, thread_time() - middle_s)
            delivered += len(ready)
        return delivered


def pages(root: Path) -> tuple[int, int]:
    """Bytes in use and of the file."""
    with closing(sqlite3.connect(root / 'index.db')) as db:
        size, count, free = (db.execute(f'PRAGMA {name}').fetchone()[0] for name in ('page_size', 'page_count', 'freelist_count'))
    return (count - free) * size, count * size


def tables(root: Path) -> dict[str, int]:
    """Bytes of each table and index; {} where SQLite was built without dbstat."""
    with closing(sqlite3.connect(root / 'index.db')) as db:
        try:
            found = db.execute('SELECT name, sum(pgsize) FROM dbstat GROUP BY name HAVING sum(pgsize) > 65536 ORDER BY 2 DESC')
            return dict(found.fetchall())
        except sqlite3.OperationalError:
            return {}


def measure(root: Path, hours: int, remember_days: float) -> dict[str, Any]:
    """Bytes by the hour, and what is in them at the end."""
    robot = Robot(root, remember_days)
    delivered = robot.run(3 * HOUR_S)
    first, used = pages(root)[0], [pages(root)[0]]
    files = [pages(root)[1]]
    count = 0
    for _ in range(hours - 3):
        count += robot.run(HOUR_S)
        in_use, size = pages(root)
        used.append(in_use)
        files.append(size)
    grown = used[-1] - first
    found = {
        'objects': delivered + count, 'bytes_an_hour': grown / (hours - 3), 'bytes_an_object': grown / count,
        'to_full_rows': grown / count / OLD_BYTES_AN_OBJECT, 'in_use_by_hour': used, 'file_by_hour': files,
        'tables': tables(root), 'slowest_commit_ms': robot.slowest_s * 1e3,
    }  # fmt: skip
    robot.spool.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--hours', type=int, default=6)
    parser.add_argument('--day', action='store_true', help='a day and a half, with remember_days 1')
    parser.add_argument('--folder', type=Path, default=MEMORY, help='where the spool lies meanwhile (default in memory)')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        found = measure(Path(folder, 'spool'), 36 if options.day else options.hours, 1.0 if options.day else 3.0)
    bar = {
        'what': 'growth of the index, to full rows all the time', 'bar': f'at most {BAR:g}', 'value': found['to_full_rows'],
        'unit': 'of the bytes', 'holds': found['to_full_rows'] <= BAR, 'rounds': [],
    }  # fmt: skip
    print(json.dumps({'bars': [bar], 'figures': found}, indent=None if options.json else 1))


if __name__ == '__main__':
    main()
