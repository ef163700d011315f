"""The size of the code, and how much of it a reader opens to follow something: the tables of docs/evidence/development.md.

``python bench/code.py [CHECKOUT]`` counts the package of a checkout, this one by default. ``--trails`` also runs its node and its
MissionDataLogger with a profiler, in an environment with ROS: a module is on a trail if one of its functions is called more often
during the event than in an equal time without it.
"""

from __future__ import annotations

import ast
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

PACKAGE = 'shadowhound_data_logger'
WINDOW_S = 6.0
SHORT = 60
PROFILER = """
import collections, json, os, pathlib, sys, threading, time
counts, orders = collections.Counter(), pathlib.Path(os.environ['TRAILS'])
def note(frame, event, _):
    if event == 'call' and '/shadowhound_data_logger/' in frame.f_code.co_filename:
        counts[frame.f_code.co_filename + ':' + frame.f_code.co_name] += 1
def serve():
    while True:
        for order in orders.glob('*.begin'):
            counts.clear()
            order.unlink()
        for order in orders.glob('*.end'):
            order.with_suffix('.part').write_text(json.dumps(dict(counts.copy())))
            order.with_suffix('.part').rename(order.with_suffix('.json'))
            order.unlink()
        time.sleep(0.02)
threading.Thread(target=serve, daemon=True).start()
threading.setprofile(note)
sys.setprofile(note)
"""


def count(root: Path) -> dict[str, int]:
    """Counts by kind; a class name is public if it has no underscore and is at the top level of a module."""
    paths = {name_of(path, root): path for path in root.rglob('*.py')}
    importers: dict[str, set[str]] = defaultdict(set)
    names: Counter[str] = Counter()
    classes = lines = 0
    size: dict[str, int] = {}
    for module, path in paths.items():
        text = path.read_text(encoding='utf-8')
        tree = ast.parse(text)
        size[module] = len(text.splitlines())
        lines += size[module]
        classes += sum(isinstance(node, ast.ClassDef) for node in ast.walk(tree))
        names.update(node.name for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith('_'))
        for found in imported(tree):
            if found in paths and found not in {module, PACKAGE}:
                importers[found].add(module)
    once = [module for module, by in importers.items() if len(by) == 1]
    return {
        'lines': lines, 'modules': len(paths), 'classes': classes, 'modules with one importer': len(once),
        f'modules of {SHORT} lines or less': sum(lines <= SHORT for lines in size.values()),
        'public class names used twice': sum(uses > 1 for uses in names.values()),
    }  # fmt: skip


def name_of(path: Path, root: Path) -> str:
    return '.'.join(path.relative_to(root.parent).with_suffix('').parts).removesuffix('.__init__')


def imported(tree: ast.Module) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f'{node.module}.{name.name}' for name in node.names)}
    return found


def modules(counts: dict[str, int], without: dict[str, int]) -> set[str]:
    """Modules with a function that was called more often, by half and by at least three calls."""
    more = {name: max(1.5 * calls, calls + 3) for name, calls in without.items()}
    return {name.rpartition(':')[0] for name, calls in counts.items() if calls >= more.get(name, 3)}


def trails() -> dict[str, int]:
    """Run by the measured code: its package and its tests are first on the path."""
    from domains import free_domain  # noqa: PLC0415 - of the tests
    from e2e.processes import Processes  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as name, free_domain() as domain:
        folder = Path(name)
        (folder / 'sitecustomize.py').write_text(PROFILER, encoding='utf-8')
        processes = Processes(folder, domain, 'thor')
        processes.environ['TRAILS'] = str(folder)
        try:
            plain = processes.environ['PYTHONPATH']
            processes.environ['PYTHONPATH'] = f'{folder}{os.pathsep}{plain}'
            node = processes.node(None, {'bag.record': 'service'})
            processes.environ['PYTHONPATH'] = plain
            return {**followed(processes, node, folder), 'a log call, to the journal': logged(folder / 'agent')}
        finally:
            processes.end()


def picture() -> bytes:
    from PIL import Image  # noqa: PLC0415

    body = io.BytesIO()
    Image.new('RGB', (16, 12), (90, 120, 30)).save(body, 'JPEG')
    return body.getvalue()


def followed(processes: Any, node: Any, folder: Path) -> dict[str, int]:
    from e2e.station import Station  # noqa: PLC0415
    from go2_interfaces.msg import IMU  # noqa: PLC0415
    from rclpy.serialization import serialize_message  # noqa: PLC0415
    from sensor_msgs.msg import CompressedImage  # noqa: PLC0415

    robot, station = processes.publisher(), Station(processes.environ)
    topics = {
        '/imu': ('go2_interfaces/msg/IMU', IMU()),
        '/camera/compressed': ('sensor_msgs/msg/CompressedImage', CompressedImage(format='jpeg', data=picture())),
    }
    messages = {}
    for topic, (kind, message) in topics.items():
        messages[topic] = bytes(serialize_message(message))
        robot.create(topic, kind)
        robot.heard(topic, node, messages[topic])

    def window(*, topic: str = '') -> dict[str, int]:
        order = folder / f'{time.monotonic_ns()}.begin'
        order.touch()
        end = time.monotonic() + WINDOW_S
        while time.monotonic() < end:
            if topic:
                robot.publish(topic, [messages[topic]], 0.0)
            time.sleep(0.05)
        order.with_suffix('.end').touch()
        while not order.with_suffix('.json').exists():
            time.sleep(0.05)
        found: dict[str, int] = json.loads(order.with_suffix('.json').read_text())
        return found

    time.sleep(WINDOW_S)
    idle = window()
    imu = window(topic='/imu')
    frame = window(topic='/camera/compressed')
    begin = folder / 'bag.begin'
    begin.touch()
    station.bag('start')
    end = time.monotonic() + WINDOW_S
    while time.monotonic() < end:
        robot.publish('/imu', [messages['/imu']], 0.0)
        time.sleep(0.05)
    station.bag('stop')
    time.sleep(2.0)
    begin.with_suffix('.end').touch()
    while not begin.with_suffix('.json').exists():
        time.sleep(0.05)
    bag = json.loads(begin.with_suffix('.json').read_text())
    station.close()
    return {
        'an IMU message, from the subscription to the store': len(modules(imu, idle)),
        'a camera frame, the same way': len(modules(frame, idle)),
        'a slice, from the service to the store': len(modules(bag, imu)),
    }


def logged(home: Path) -> int:
    """The modules entered by calls of a mission's logger."""
    from shadowhound_data_logger import MissionDataLogger  # noqa: PLC0415

    found: set[str] = set()

    def note(frame: Any, event: str, _: object) -> None:
        if event == 'call' and f'/{PACKAGE}/' in frame.f_code.co_filename:
            found.add(frame.f_code.co_filename)

    logger = MissionDataLogger(home=home, robot='thor', replay=False, start_timeout_s=0.0)
    logger.start_mission('patrol', 'go round')
    sys.setprofile(note)
    logger.log_robot_state(90.0, 40.0, 1)
    logger.log_camera_frame(b'\xff\xd8\xff\xd9', 1)
    sys.setprofile(None)
    logger.close()
    return len(found)


def main() -> None:
    words = [word for word in sys.argv[1:] if not word.startswith('-')]
    checkout = Path(words[0] if words else Path(__file__).parents[1]).resolve()
    if '--trails-here' in sys.argv:
        rows = trails()
    else:
        rows = count(checkout / PACKAGE)
        if '--trails' in sys.argv:
            environ = {**os.environ, 'PYTHONPATH': os.pathsep.join((str(checkout), str(checkout / 'test')))}
            command = [sys.executable, __file__, '--trails-here']
            ran = subprocess.run(command, env=environ, cwd=checkout, capture_output=True, text=True, check=False)
            if ran.returncode:
                sys.exit(ran.stderr)
            rows |= json.loads(ran.stdout.splitlines()[-1])
    sys.stdout.write(json.dumps(rows) + '\n' if '--trails-here' in sys.argv else '')
    if '--trails-here' not in sys.argv:
        for name, value in rows.items():
            sys.stdout.write(f'| {name} | {value:,} |\n')


if __name__ == '__main__':
    main()
