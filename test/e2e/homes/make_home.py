"""Makes ``version_N.tar.xz``: a home as a version of the package leaves it when node and agent are killed half-way.

Run it with the code of that version: ``PYTHONPATH=CHECKOUT:CHECKOUT/test scripts/with-env python make_home.py version_N.tar.xz``.
In the home are objects that were delivered and objects that wait, a bag with one slice in the spool and one open, the numbers of
publishers, a mission that ended and one that goes on, with nothing sent to MLflow. Extended attributes are kept. ``ledger.json``,
beside the home's own files, is what that version told of it.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import tarfile
import tempfile
import time
from pathlib import Path

from domains import free_domain
from e2e.processes import Node, Process, Processes, Publisher, until
from go2_interfaces.msg import IMU
from nav_msgs.msg import Odometry
from PIL import Image
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage

from shadowhound_data_logger import MissionDataLogger

ROBOT = 'thor'
LEDGER = 'ledger.json'
AWAY = {
    'AWS_ENDPOINT_URL': 'http://127.0.0.1:9', 'AWS_ACCESS_KEY_ID': 'nobody', 'AWS_SECRET_ACCESS_KEY': 'nothing',
    'MLFLOW_TRACKING_URI': 'http://127.0.0.1:9',
}  # fmt: skip
PARAMETERS = {'bag.record': 'always', 'bag.slice_s': 2.0}


def picture() -> bytes:
    body = io.BytesIO()
    Image.new('RGB', (16, 12), (90, 120, 30)).save(body, 'JPEG')
    return body.getvalue()


def message(kind: str, number: int) -> bytes:
    now_ns = time.time_ns()
    made = {'imu': IMU, 'odom': Odometry, 'camera': CompressedImage}[kind]()
    if kind != 'imu':
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(now_ns, 10**9)
        made.header.frame_id = 'odom'
    if kind == 'odom':
        made.child_frame_id = 'base_link'
        made.pose.pose.position.x = number / 100
        made.pose.pose.orientation.w = 1.0
    if kind == 'camera':
        made.format, made.data = 'jpeg', picture()
    return bytes(serialize_message(made))


TOPICS = {'imu': '/imu', 'odom': '/odom', 'camera': '/camera/compressed'}
TYPES = {'imu': 'go2_interfaces/msg/IMU', 'odom': 'nav_msgs/msg/Odometry', 'camera': 'sensor_msgs/msg/CompressedImage'}


def walk(robot: Publisher, seconds: float) -> None:
    """Twenty of each a second."""
    end, number = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for kind, topic in TOPICS.items():
            robot.publish(topic, [message(kind, number)], 0.0)
        number += 1
        time.sleep(0.05)


def agent(home: str, *, ends: bool) -> None:
    """Its own process: begins a mission, says so, and goes on until it is killed."""
    os.environ |= AWAY
    logger = MissionDataLogger(home=Path(home), robot=ROBOT, replay=False, start_timeout_s=0.0)
    logger.start_mission('patrol', 'go round')
    logger.log_trajectory('stamp_ns,x,y\n0,0.0,0.0\n1,1.0,0.0\n')
    number = 0
    while True:
        logger.log_robot_state(90.0 - number / 10, 40.0, number)
        logger.log_camera_frame(picture(), number)
        number += 1
        if number == 5:
            if ends:
                logger.end_mission(True, 5.0, 1.0)
            sys.stdout.write('goes on\n')
            sys.stdout.flush()
        time.sleep(0.1)


def start_agent(processes: Processes, home: Path, *, ends: bool) -> None:
    command = [sys.executable, __file__, 'agent', str(home), *(['ends'] if ends else [])]
    process = Process('agent', command, processes.folder / f'agent-{ends}.log', processes.environ)
    processes.started.append(process)
    process.said('goes on')
    if ends:
        process.kill()


def waits(node: Node, at_least: int) -> None:
    until(lambda: node.ledger()['objects']['pending'] >= at_least, lambda: f'objects wait: {node.ledger()["objects"]}')


def make(out: Path) -> None:
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        processes = Processes(Path(folder), domain, ROBOT)
        try:
            node = processes.node({'MLFLOW_TRACKING_URI': AWAY['MLFLOW_TRACKING_URI']}, {**PARAMETERS, 'bag.record': 'service'})
            robot = processes.publisher()
            for kind, topic in TOPICS.items():
                robot.create(topic, TYPES[kind])
                robot.heard(topic, node, message(kind, 0))
            start_agent(processes, node.home, ends=True)
            walk(robot, 3.0)
            node.delivered(3)
            walk(robot, 1.5)
            node.signal(signal.SIGKILL)
            node.wait()
            node = processes.node(AWAY, PARAMETERS)
            for kind, topic in TOPICS.items():
                robot.heard(topic, node, message(kind, 0))
            start_agent(processes, node.home, ends=False)
            walk(robot, 4.5)
            waits(node, 6)
            until(
                lambda: list(node.home.rglob('*.mcap')) and list(node.home.rglob('*.mcap.open')), 'one slice is closed, one open'
            )
            walk(robot, 1.2)
            for process in reversed(processes.started):
                process.kill()
            with tarfile.open(out, 'w:xz', format=tarfile.PAX_FORMAT) as tar:
                for path in sorted(node.home.rglob('*')):
                    if not path.is_socket():
                        add(tar, path, node.home)
                (node.home / LEDGER).write_text(json.dumps(node.ledger()))
                add(tar, node.home / LEDGER, node.home)
        finally:
            processes.end()


def add(tar: tarfile.TarFile, path: Path, home: Path) -> None:
    """With its extended attributes, as GNU tar and bsdtar write them."""
    entry = tar.gettarinfo(path, str(path.relative_to(home)))
    entry.uid, entry.gid, entry.uname, entry.gname = 0, 0, '', ''
    entry.pax_headers = {
        f'SCHILY.xattr.{name}': os.getxattr(path, name).decode('utf-8', 'surrogateescape')
        for name in os.listxattr(path) if name.startswith('user.')
    }  # fmt: skip
    if entry.isreg():
        with path.open('rb') as file:
            tar.addfile(entry, file)
    else:
        tar.addfile(entry)


if __name__ == '__main__':
    if sys.argv[1] == 'agent':
        agent(sys.argv[2], ends='ends' in sys.argv)
    else:
        make(Path(sys.argv[1]))
