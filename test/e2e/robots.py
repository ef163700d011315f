"""Robots of other vendors with visible content, and the logger and its page next to them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import simplejpeg
from e2e.processes import COMMANDS, Node, Processes, Publisher, until
from live.browsing import fits, holds, opened
from missions.server import complete
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.node.intake.dds_network import profile, robot_network
from shadowhound_data_logger.node.intake.middleware import possible_buffer

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROUNDS = 40
ROUND_S = 0.1
STORE = get_typestore(Stores.LATEST)
UNITREE = Path(__file__).parents[2] / 'interfaces' / 'unitree_go' / 'msg'
for path in UNITREE.glob('*.msg'):
    STORE.register(get_types_from_msg(path.read_text(), f'unitree_go/msg/{path.stem}'))


class Sent(NamedTuple):
    """A topic of a robot."""

    type: str
    fields: Mapping[str, Any] | Callable[[int], Mapping[str, Any]] = MappingProxyType({})
    """Fields of each message, or of a round's; its frame is in ``header.frame_id``."""
    every: int = 1
    """Rounds between two messages; 0: once, latched."""
    sensor: str = ''
    """The logger's sensor; empty if the topic is not logged."""


def message(type_name: str, fields: Mapping[str, Any]) -> Any:
    """A message with these fields, by path; all others are zero or empty."""
    made = _zero(type_name)
    for path, value in fields.items():
        *owners, last = path.split('.')
        owner = made
        for name in owners:
            owner = getattr(owner, name)
        object.__setattr__(owner, last, value)
    return made


def stamp(made: Any, now_ns: int) -> None:
    """Set the stamps that a message has."""
    for each in (made, *getattr(made, 'transforms', ())):
        if hasattr(each, 'header'):
            each.header.stamp.sec, each.header.stamp.nanosec = divmod(now_ns, 10**9)


def _zero(type_name: str) -> Any:
    values = []
    for _, (kind, what) in STORE.fielddefs[type_name][1]:
        if kind.name == 'BASE':
            values.append('' if what[0] == 'string' else False if what[0] == 'bool' else 0)
        elif kind.name == 'NAME':
            values.append(_zero(what))
        else:
            (inner, of), count = what
            if inner.name == 'BASE' and of[0] != 'string':
                dtype = {'byte': 'u1', 'octet': 'u1', 'char': 'u1'}.get(of[0], of[0])
                values.append(np.zeros(count or 0, dtype))
            else:
                values.append([_zero(of) if inner.name == 'NAME' else '' for _ in range(count or 0)])
    return STORE.types[type_name](*values)


class Robot:
    """A robot with some topics, and the logger next to it."""

    def __init__(
        self,
        processes: Processes,
        topics: Mapping[str, Sent],
        *arguments: str,
        robot: str,
        mission: str = '',
        cyclone: bool = False,
    ) -> None:
        """``mission``: the robot's name in the mission that it walks; empty: no mission."""
        self._processes, self._is_cyclone = processes, cyclone
        self.name = robot or mission
        self.topics = topics if cyclone else {topic: sent for topic, sent in topics.items() if find_spec(sent.type.split('/')[0])}
        self._publisher: Publisher = processes.publisher(cyclone=cyclone)
        for topic, sent in self.topics.items():
            self._publisher.create(topic, sent.type, latched=not sent.every)
        environ = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'} if cyclone else {}
        self.node: Node = processes.node(None, None, *arguments, robot=robot, environ=environ)
        for topic, sent in self.topics.items():
            if sent.sensor:
                self._publisher.matched(topic)
        self.sent = dict.fromkeys(self.topics, 0)
        self._round = 0
        if mission:
            with closing(MissionDataLogger(home=self.node.home, robot=mission)) as logger:
                logger.start_mission('walk', 'around the block')
                self._walk()
                logger.end_mission(True, 0.0, 0.0)
                until(lambda: complete(self.node.home), lambda: f'the mission is sent: {logger.flush(0.0)}')
        else:
            self._walk()

    def _walk(self, rounds: int = ROUNDS) -> None:
        for _ in range(rounds):
            start, number = time.monotonic(), self._round
            for topic, each in self.topics.items():
                if number % each.every == 0 if each.every else not number:
                    made = message(each.type, each.fields(number) if callable(each.fields) else each.fields)
                    stamp(made, time.time_ns())
                    self._publisher.publish(topic, [bytes(STORE.serialize_cdr(made, each.type))], 0.0)
                    self.sent[topic] += 1
            self._round += 1
            time.sleep(max(0.0, start + ROUND_S - time.monotonic()))

    @contextmanager
    def walking(self) -> Iterator[None]:
        """Continue walking."""
        ended = threading.Event()

        def walk() -> None:
            while not ended.is_set():
                self._walk(1)

        walker = threading.Thread(target=walk)
        walker.start()
        try:
            yield
        finally:
            ended.set()
            walker.join()

    def page(self) -> str:
        """The address of its live page. If it does not use the robot's Cyclone DDS it has the same peers."""
        environ: dict[str, str] = {}
        if self._is_cyclone:
            path, variables = self.node.home / 'fastdds.xml', self._processes.environ
            domain = int(variables['ROS_DOMAIN_ID'])
            path.write_text(profile(possible_buffer(), robot_network(variables, domain, has_range=True), domain))
            environ = dict.fromkeys(('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'), str(path))
        return self._processes.page(self.node, environ=environ)[1]

    def shown(self, browser: Browser, *panels: str, drawn: Iterable[str]) -> Page:
        """Its live page, checked for completeness: each topic in the table, and drawable data in these panels.

        ``drawn`` are the kinds of items that the page received. The browser reports no errors, and everything fits on a phone.
        """
        page = opened(browser, self.page())
        page.locator('table.topics').evaluate('table => table.scrollIntoView({behavior: "instant"})')
        for topic, each in self.topics.items():
            cells = {name: f'td[data-topic="{topic}"][data-field="{name}"]' for name in ('rate', 'size', 'age')}
            until(lambda topic=topic: page.locator(f'[data-inspect="{topic}"]').count(), f'{topic} is in the table')  # type: ignore[misc]
            row = page.locator('tr', has=page.locator(f'[data-inspect="{topic}"]'))
            until(lambda row=row, each=each: each.type.split('/')[-1] in row.inner_text(), f'the type of {topic}')  # type: ignore[misc]
            for name, cell in cells.items():
                if each.every or name != 'rate':
                    until(lambda cell=cell: page.locator(cell).inner_text() not in {'', '–'}, f'the {name} of {topic}')  # type: ignore[misc]
        for kind in drawn:
            holds(page, f'(shadowhound.count[{json.dumps(kind)}] ?? 0) > 0')

        def found() -> list[str]:
            return list(page.locator('section.view').evaluate_all('all => all.map(one => one.ariaLabel)'))

        until(lambda: found() == list(panels), lambda: f'the panels are {found()}', 30.0)
        for width in (1440, 390):
            fits(page, width)
        assert page.evaluate('shadowhound.wrong') == 0
        assert page.wrong == []  # type: ignore[attr-defined]
        return page

    def fetched(self, folder: Path) -> None:
        """Each object from ``query`` is a file of ``fetch``, and there is at least one of each sensor."""
        flags = ('--robot', self.name)
        rows = self.ask('query', *flags)
        self.ask('fetch', *flags, '--to', str(folder))
        files = {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob('*') if path.is_file()}
        assert {row['key'] for row in rows} <= files.keys()
        assert all(files[row['key']] == row['bytes'] for row in rows)
        assert {row['sensor'] for row in rows} >= {each.sensor for each in self.topics.values() if each.sensor}

    def finish(self) -> dict[str, Any]:
        """The ledger, once everything that is logged was received and the node has stopped."""
        for topic, each in self.topics.items():
            if each.sensor:
                until(lambda topic=topic: self.node.topic(topic).get('received') == self.sent[topic], f'{topic} is received')  # type: ignore[misc]
        ledger = self.node.stop()
        assert ledger['balanced']
        for topic, each in self.topics.items():
            if each.sensor:
                account = ledger['topics'][topic]
                assert (account['received'], account['rejected'], account['dropped']) == (self.sent[topic], {}, {}), topic
                assert account['stored'] > 0, topic
                assert account['received'] == account['stored'] + account['skipped'], topic
        return ledger

    def export(self, folder: Path, config: Mapping[str, Any] | Path) -> dict[str, Any]:
        """The features of a dataset of the mission, in ``folder``; it has a frame for each period of its duration."""
        path = config if isinstance(config, Path) else folder.with_suffix('.yaml')
        if not isinstance(config, Path):
            path.write_text(json.dumps(config))
        answer = self.ask('export', 'lerobot', folder.name, '--to', str(folder), '--config', str(path), '--mission-type', 'walk')
        info: dict[str, Any] = json.loads((folder / 'meta/info.json').read_bytes())
        assert info['total_episodes'] == 1, answer
        assert abs(info['total_frames'] / info['fps'] - ROUNDS * ROUND_S) < 2.0, answer
        return dict(info['features'])

    def refused(self, *arguments: str) -> str:
        """The output of a command that fails."""
        ran = self._run(*arguments)
        assert ran.returncode, ran.stdout
        return ran.stdout + ran.stderr

    def ask(self, *arguments: str) -> Any:
        """The JSON output of a command, with the folder as the store."""
        ran = self._run(*arguments, '--json')
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return json.loads(ran.stdout)

    def _run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environ = {**self._processes.environ, 'SHADOWHOUND_HOME': str(self.node.home), 'SHADOWHOUND_ROBOT': self.name}
        command = [sys.executable, '-m', COMMANDS, *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=environ, timeout=120, check=False)


# -- what they publish -----------------------------------------------------------------------------------------------------------

ROOM = 6.0, 4.0
"""From its center to its walls, in meters."""


def made(type_name: str, **fields: Any) -> Any:
    """A nested message; ``__`` in a name is the dot of a path."""
    return message(type_name, {name.replace('__', '.'): value for name, value in fields.items()})


def _yaw(angle: float, prefix: str = 'pose.pose.orientation') -> dict[str, float]:
    return {f'{prefix}.z': math.sin(angle / 2), f'{prefix}.w': math.cos(angle / 2)}


def _place(number: int) -> tuple[float, float, float]:
    """On an ellipse: x, y and heading."""
    turn = number * 0.02
    return 3 * math.cos(turn), 2 * math.sin(turn), math.atan2(2 * math.cos(turn), -3 * math.sin(turn))


def _odometry(frame: str, height: float = 0.0) -> Callable[[int], Mapping[str, Any]]:
    def fields(number: int) -> Mapping[str, Any]:
        x, y, yaw = _place(number)
        return {'header.frame_id': frame, 'child_frame_id': 'base_link', 'pose.pose.position.x': x, 'pose.pose.position.y': y,
                'pose.pose.position.z': height, 'twist.twist.linear.x': 0.5, **_yaw(yaw)}  # fmt: skip

    return fields


def _imu(number: int) -> Mapping[str, Any]:
    return {'header.frame_id': 'imu_link', 'linear_acceleration.x': 0.3 * math.sin(number / 5), 'linear_acceleration.z': 9.81,
            **_yaw(_place(number)[2], 'orientation')}  # fmt: skip


def _scan(number: int) -> Mapping[str, Any]:
    x, y, yaw = _place(number)
    angles = yaw - math.pi + np.arange(360) * math.pi / 180
    with np.errstate(divide='ignore'):
        sides = np.where(np.cos(angles) > 0, ROOM[0] - x, -ROOM[0] - x) / np.cos(angles)
        ends = np.where(np.sin(angles) > 0, ROOM[1] - y, -ROOM[1] - y) / np.sin(angles)
    return {'header.frame_id': 'laser', 'angle_min': -math.pi, 'angle_max': math.pi, 'angle_increment': math.pi / 180,
            'range_min': 0.1, 'range_max': 20.0, 'ranges': np.minimum(sides, ends).astype('f4')}  # fmt: skip


def _cloud(frame: str) -> Callable[[int], Mapping[str, Any]]:
    random = np.random.default_rng(1)
    around = random.uniform(0, 2 * math.pi, 4000)
    points = np.stack([4 * np.cos(around), 4 * np.sin(around), random.uniform(0, 1.5, 4000)], axis=1).astype('<f4')

    def fields(_: int) -> Mapping[str, Any]:
        return {
            'header.frame_id': frame, 'height': 1, 'width': len(points), 'point_step': 12, 'row_step': 12 * len(points),
            'fields': [STORE.types['sensor_msgs/msg/PointField'](name, 4 * place, 7, 1) for place, name in enumerate('xyz')],
            'data': points.view('u1').ravel(), 'is_dense': True,
        }  # fmt: skip

    return fields


def _image(frame: str) -> Callable[[int], Mapping[str, Any]]:
    def fields(number: int) -> Mapping[str, Any]:
        pixels = np.zeros((120, 160, 3), 'u1')
        pixels[..., 0] = np.linspace(30, 220, 160)
        pixels[..., 1] = np.linspace(40, 160, 120)[:, None]
        pixels[40:80, number % 140 : number % 140 + 20] = 255
        return {'header.frame_id': frame, 'height': 120, 'width': 160, 'encoding': 'rgb8', 'step': 480, 'data': pixels.ravel()}

    return fields


def _jpeg(number: int) -> Mapping[str, Any]:
    pixels = _image('')(number)['data'].reshape(120, 160, 3)
    return {'header.frame_id': 'oakd', 'format': 'jpeg', 'data': np.frombuffer(simplejpeg.encode_jpeg(pixels), 'u1')}


def _depth(_: int) -> Mapping[str, Any]:
    pixels = np.tile(np.linspace(500, 3800, 160), (120, 1)).astype('<u2')
    return {'height': 120, 'width': 160, 'encoding': '16UC1', 'step': 320, 'data': pixels.view('u1').ravel()}


def _map() -> Mapping[str, Any]:
    width, height = round(ROOM[0] * 2 / 0.05), round(ROOM[1] * 2 / 0.05)
    cells = np.zeros((height, width), 'i1')
    cells[:2] = cells[-2:] = cells[:, :2] = cells[:, -2:] = 100
    cells[60:90, 180:200] = 100
    return {'header.frame_id': 'map', 'info.resolution': 0.05, 'info.width': width, 'info.height': height,
            'info.origin.position.x': -ROOM[0], 'info.origin.position.y': -ROOM[1], 'info.origin.orientation.w': 1.0,
            'data': cells.ravel()}  # fmt: skip


def _frames(*pairs: tuple[str, str]) -> Mapping[str, Any]:
    return {'transforms': [
        made('geometry_msgs/msg/TransformStamped', header__frame_id=parent, child_frame_id=child,
             transform__rotation__w=1.0, transform__translation__z=0.2 if child == 'laser' else 0.0)
        for parent, child in pairs
    ]}  # fmt: skip


def _moving(parent: str, child: str) -> Callable[[int], Mapping[str, Any]]:
    def fields(number: int) -> Mapping[str, Any]:
        x, y, yaw = _place(number)
        frame = made('geometry_msgs/msg/TransformStamped', header__frame_id=parent, child_frame_id=child)
        frame.transform.translation.x, frame.transform.translation.y = x, y
        frame.transform.rotation.z, frame.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        return {'transforms': [frame]}

    return fields


def _health(number: int) -> Mapping[str, Any]:
    rows = [('lidar', 0, '10 Hz'), ('wifi', 1, 'weak'), ('motor', 2 if number % 200 > 100 else 0, 'temperature')]
    return {'status': [
        made('diagnostic_msgs/msg/DiagnosticStatus', name=name, level=level, message=text, hardware_id='tb4')
        for name, level, text in rows
    ]}  # fmt: skip


WHEELED = """<robot name="base"><link name="base_link">
<visual><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.18" length="0.1"/></geometry></visual></link>
<joint name="left" type="continuous"><axis xyz="0 0 1"/><origin xyz="0 0.12 0.05" rpy="1.57 0 0"/>
<parent link="base_link"/><child link="left_wheel"/></joint>
<link name="left_wheel"><visual><geometry><cylinder radius="0.05" length="0.02"/></geometry></visual></link></robot>"""
ARM_JOINTS = 'shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3'


def _arm_model() -> str:
    shape = '<visual><origin xyz="0 0 0.05"/><geometry><cylinder radius="0.1" length="0.1"/></geometry></visual>'
    links = [f'<link name="base_link">{shape}</link>']
    for place, name in enumerate(ARM_JOINTS):
        axis = '0 0 1' if place in {0, 4} else '0 1 0'
        parent = f'link_{place}' if place else 'base_link'
        links.append(f"""<joint name="{name}" type="revolute"><axis xyz="{axis}"/><origin xyz="0 0 {0.1 if place < 2 else 0.3}"/>
<parent link="{parent}"/><child link="link_{place + 1}"/><limit lower="-3.14" upper="3.14" effort="1" velocity="1"/></joint>
<link name="link_{place + 1}"><visual><origin xyz="0 0 0.1"/><geometry><box size="0.06 0.06 0.2"/></geometry></visual></link>""")
    return f'<robot name="arm">{"".join(links)}</robot>'


def _joints(*names: str) -> Callable[[int], Mapping[str, Any]]:
    phases = np.arange(len(names))
    return lambda number: {'name': list(names), 'position': 0.6 * np.sin(number / 20 + phases)}


def _flight(number: int) -> Mapping[str, Any]:
    x, y, _ = _place(number)
    return {
        'latitude': LATITUDE + y * 9e-6,
        'longitude': LONGITUDE + x * 1.1e-5,
        'altitude': 120.0,
        'position_covariance_type': 1,
    }


LATITUDE, LONGITUDE = -36.8485, 174.7633
BASE: Mapping[str, Sent] = {
    '/scan': Sent('sensor_msgs/msg/LaserScan', _scan, 1, 'scan'),
    '/odom': Sent('nav_msgs/msg/Odometry', _odometry('odom'), 1, 'odom'),
    '/imu': Sent('sensor_msgs/msg/Imu', _imu, 1, 'imu'),
    '/joint_states': Sent('sensor_msgs/msg/JointState', _joints('left', 'right'), 1, 'joints'),
    '/battery_state': Sent('sensor_msgs/msg/BatteryState', {'percentage': 0.78, 'voltage': 15.8, 'temperature': 31.0}, 10,
                           'battery_state'),
    '/oakd/rgb/preview/image_raw/compressed': Sent('sensor_msgs/msg/CompressedImage', _jpeg, 2,
                                                   'oakd_rgb_preview_image_raw_compressed'),
    '/oakd/stereo/image_raw': Sent('sensor_msgs/msg/Image', _depth, 5, 'oakd_stereo_image_raw'),
    '/cmd_vel': Sent('geometry_msgs/msg/Twist', {'linear.x': 0.5}, 1, 'cmd_vel'),
    '/health': Sent('diagnostic_msgs/msg/DiagnosticArray', _health, 10, 'health'),
    '/tf': Sent('tf2_msgs/msg/TFMessage', _moving('odom', 'base_link'), 1, 'tf'),
    '/tf_static': Sent('tf2_msgs/msg/TFMessage', _frames(('map', 'odom'), ('base_link', 'laser')), 0, 'tf_static'),
    '/map': Sent('nav_msgs/msg/OccupancyGrid', _map(), 0, 'map'),
    '/robot_description': Sent('std_msgs/msg/String', {'data': WHEELED}, 0, 'robot_description'),
    '/hazard_detection': Sent('std_msgs/msg/ColorRGBA', {}, 5),
}  # fmt: skip
"""Like a TurtleBot 4."""
DRONE: Mapping[str, Sent] = {
    '/drone1/global_position/fix': Sent('sensor_msgs/msg/NavSatFix', _flight, 2, 'drone1_global_position_fix'),
    '/drone1/local_position/odom': Sent('nav_msgs/msg/Odometry', _odometry('map', 4.0), 1, 'drone1_local_position_odom'),
    '/drone1/imu/data': Sent('sensor_msgs/msg/Imu', _imu, 1, 'drone1_imu_data'),
    '/drone1/battery': Sent('sensor_msgs/msg/BatteryState', {'percentage': 0.5, 'voltage': 22.2, 'temperature': math.nan}, 10,
                            'drone1_battery'),
    '/drone1/camera/image': Sent('sensor_msgs/msg/Image', _image('down'), 5, 'drone1_camera_image'),
    '/drone1/rangefinder': Sent('sensor_msgs/msg/Range', {'range': 3.0}, 1, 'drone1_rangefinder'),
}  # fmt: skip
ARM: Mapping[str, Sent] = {
    '/joint_states': Sent('sensor_msgs/msg/JointState', _joints(*ARM_JOINTS), 1, 'joints'),
    '/wrist/image_raw': Sent('sensor_msgs/msg/Image', _image('wrist'), 2, 'wrist_image_raw'),
    '/wrist/camera_info': Sent('sensor_msgs/msg/CameraInfo', {'width': 160, 'height': 120}, 2, 'wrist_camera_info'),
    '/wrench': Sent('geometry_msgs/msg/WrenchStamped', {'wrench.force.z': -2.5}, 1, 'wrench'),
    '/robot_description': Sent('std_msgs/msg/String', {'data': _arm_model()}, 0, 'robot_description'),
    '/gripper/grasped': Sent('std_msgs/msg/Bool', {'data': True}, 5, 'gripper_grasped'),
    '/colors': Sent('std_msgs/msg/ColorRGBA', {}, 1),
}  # fmt: skip


UNITREE_TOPICS: Mapping[str, Sent] = {
    '/utlidar/cloud': Sent('sensor_msgs/msg/PointCloud2', _cloud('odom'), 1, 'lidar'),
    '/utlidar/imu': Sent('sensor_msgs/msg/Imu', _imu, 1, 'imu'),
    '/utlidar/robot_odom': Sent('nav_msgs/msg/Odometry', _odometry('odom', 0.32), 1, 'odom'),
    '/lowstate': Sent('unitree_go/msg/LowState', {'bms_state.soc': 77, 'power_v': 29.5}, 1, 'lowstate'),
    '/sportmodestate': Sent('unitree_go/msg/SportModeState', {'body_height': 0.3}, 1, 'states'),
    '/wirelesscontroller': Sent('unitree_go/msg/WirelessController', {'lx': 0.5}, 1, 'wirelesscontroller'),
    '/frontvideostream': Sent('unitree_go/msg/Go2FrontVideoData', {'video720p': np.arange(9, dtype='u1')}, 1, 'frontvideostream'),
}  # fmt: skip
