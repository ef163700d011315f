"""Measures how fast the live page shows the past of a spool of eight hours: the first moment, later ones, and playing.

Run it as ``python bench/past.py [--objects 500000] [--delivered 0.5] [--program DIR ...] [--json]``. It creates the index of a
spool whose objects are evenly spread over eight hours, the older part of them delivered, with files for the last minutes. Then
it sends the requests of the page to the process that reads the past (``live/history.py``): days, the timeline, a moment,
consecutive moments, jumps within those minutes, and a timeline of an hour. With ``--program`` it alternates between the
packages in these folders, so that two versions can be compared on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import os
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.spool.index import Index

HOURS = 8
MINUTES_OF_FILES = 5
START_NS = 1_760_774_400 * SECOND
SENSORS = {
    # sensor: (topic, type, share of the objects, ending)
    'camera': ('/camera/compressed', 'sensor_msgs/msg/CompressedImage', 10, 'jpg'),
    'odom': ('/odom', 'nav_msgs/msg/Odometry', 3, 'json'),
    'front': ('/front/compressed', 'sensor_msgs/msg/CompressedImage', 3, 'jpg'),
    'depth': ('/depth/compressed', 'sensor_msgs/msg/CompressedImage', 1, 'jpg'),
}


def objects(count: int) -> Iterator[tuple[int, str, str, str, str]]:
    """(stamp, sensor, topic, type, ending) in order of time."""
    turns = [(sensor, *of) for sensor, of in SENSORS.items() for _ in range(of[2])]
    step_ns = HOURS * 3600 * SECOND // count
    for number in range(count):
        sensor, topic, kind, _, ending = turns[number * 7 % len(turns)]
        yield START_NS + number * step_ns, sensor, topic, kind, ending


def make(folder: Path, count: int, delivered: float) -> int:
    """Create the spool; returns the start of its last object."""
    picture = bytes(simplejpeg.encode_jpeg(np.random.default_rng(1).integers(0, 255, (240, 320, 3), np.uint8), 60, 'RGB'))
    with closing(Index(folder / 'index.db')) as index:
        index.open()
    db = sqlite3.connect(folder / 'index.db')
    db.execute('PRAGMA synchronous = OFF')
    for trigger in ('object_counted', 'object_moved'):
        db.execute(f'DROP TRIGGER {trigger}')
    rows = []
    last_ns = START_NS + HOURS * 3600 * SECOND
    for number, (at_ns, sensor, topic, kind, ending) in enumerate(objects(count)):
        path = f'thor/{sensor}/{utc(at_ns):%Y%m%d}/'
        name = f'{utc(at_ns):%H%M%S}_{at_ns // 1_000_000 % 1000:03}_{number}.{ending}'
        settled = ('delivered', at_ns + 5 * SECOND) if number < count * delivered else ('pending', None)
        metadata = {'robot': 'thor', 'sensor': sensor, 'topic': topic, 'type': kind, 'count': '1', 't_start_ns': str(at_ns),
                    't_end_ns': str(at_ns), 'sha256': '0' * 64, 'pose': f'{number % 900 / 90:.3f} 1.000 0.5000 odom',
                    'battery_pct': '80.0', 'mission_id': 'm1', 'mission_type': 'patrol', 'received_start_ns': str(at_ns + 1000),
                    'received_end_ns': str(at_ns + 1000), 'session': 'x' * 32, 'format_version': '1'}  # fmt: skip
        rows.append((path + name, sensor, topic, kind, len(picture), json.dumps(metadata), at_ns, at_ns, at_ns, *settled))
        if at_ns > last_ns - MINUTES_OF_FILES * 60 * SECOND:
            file = folder / 'ready' / 'sensor-data' / path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            place, turn = {'x': 1.0, 'y': 1.0, 'z': 0.3}, {'x': 0, 'y': 0, 'z': 0, 'w': 1}
            sample = {'stamp_ns': at_ns, 'position': place, 'orientation': turn}
            file.write_bytes(picture if ending == 'jpg' else json.dumps({'type': kind, 'samples': [sample]}).encode())
    db.executemany(
        'INSERT INTO objects (bucket, key, priority, protected, waits_for, on_request, event, mission, sensor, topic,'
        ' type, samples, bytes, sha256, content_type, metadata, t_start_ns, t_end_ns, created_ns, state, settled_ns)'
        " VALUES ('sensor-data',?,5,0,'',0,0,'m1',?,?,?,1,?,'','',?,?,?,?,?,?)", rows)  # fmt: skip
    db.commit()
    db.close()
    return last_ns


class Child:
    """The process of one version of the package."""

    def __init__(self, program: Path, spool: Path) -> None:
        environ = {**os.environ, 'PYTHONPATH': str(program), 'SHADOWHOUND_HOME': str(spool.parent)}
        command = [sys.executable, '-m', 'shadowhound_data_logger.live.history', str(spool), 'thor']
        self.popen = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environ, cwd=program)

    def ask(self, do: str, **more: Any) -> tuple[float, dict[str, Any]]:
        """Duration of the request, and the head of the answer."""
        assert self.popen.stdin is not None
        assert self.popen.stdout is not None
        began_s = time.monotonic()
        self.popen.stdin.write(json.dumps({'do': do, 'robot': 'thor', **more}).encode() + b'\n')
        self.popen.stdin.flush()
        sizes = self.popen.stdout.read(8)
        head = self.popen.stdout.read(int.from_bytes(sizes[:4], 'little'))
        self.popen.stdout.read(int.from_bytes(sizes[4:], 'little'))
        return time.monotonic() - began_s, json.loads(head)

    def close(self) -> None:
        self.popen.kill()
        self.popen.wait()
        for pipe in (self.popen.stdin, self.popen.stdout):
            if pipe is not None:
                pipe.close()


def measured(program: Path, spool: Path, last_ns: int) -> dict[str, float]:
    """Seconds, and moments per second."""
    last_ms = last_ns // 1_000_000
    with closing(Child(program, spool)) as child:
        robots_s, _ = child.ask('robots')
        days_s, days = child.ask('days')
        timeline_s, timeline = child.ask('timeline', **{'from': last_ms - HOURS * 3_600_000, 'to': last_ms})
        first_s, first = child.ask('moment', at=last_ms - 60_000)
        assert days['days']
        assert timeline.get('recorded'), timeline
        assert len(first.get('shown', ())) == len(SENSORS), first
        later = [child.ask('moment', at=last_ms - 60_000 + 160 * step)[0] for step in range(60)]
        jumps = [child.ask('moment', at=last_ms - 200_000 + 61_000 * step % 190_000)[0] for step in range(20)]
        hour_s, _ = child.ask('timeline', **{'from': last_ms - 3_600_000, 'to': last_ms})
        kilobytes = int(Path(f'/proc/{child.popen.pid}/statm').read_text().split()[1]) * 4
    return {
        'first_s': robots_s + days_s + timeline_s + first_s, 'start_s': robots_s, 'timeline_s': timeline_s, 'moment_s': first_s,
        'later_p50_s': statistics.median(later), 'later_p95_s': sorted(later)[56], 'jump_p95_s': sorted(jumps)[18],
        'hour_s': hour_s, 'moments_hz': len(later) / sum(later), 'memory_mb': kilobytes / 1024,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--objects', type=int, default=500_000)
    parser.add_argument('--delivered', type=float, default=0.5, help='the share that was delivered more than an hour ago')
    parser.add_argument('--program', type=Path, action='append', help='a folder with the package; may be repeated')
    parser.add_argument('--rounds', type=int, default=1)
    parser.add_argument('--folder', type=Path, help='where to make the spool')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    programs = options.program or [Path(__file__).resolve().parent.parent]
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        spool = Path(folder) / 'spool'
        spool.mkdir()
        last_ns = make(spool, options.objects, options.delivered)
        found = [(str(program), measured(program, spool, last_ns)) for _ in range(options.rounds) for program in programs]
    if options.json:
        print(json.dumps(found))
        return
    for program, figures in found:
        print(program)
        for name, value in figures.items():
            print(f'  {name:12} {value:9.3f}')


if __name__ == '__main__':
    main()
