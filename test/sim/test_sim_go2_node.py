"""The simulated Go2: a process that publishes over real DDS, its schedule and its parameters."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import simplejpeg
from domains import free_domain
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2
from shadowhound_sim.sim_go2_node import SimSettings, count, run, schedule

from shadowhound_data_logger.core.errors import SettingError

MODULE = 'shadowhound_sim.sim_go2_node'
COMMON = {
    'odom': 50, 'joint_states': 50, 'camera/image_raw': 30, 'camera/camera_info': 30, 'camera/compressed': 30, 'point_cloud2': 10,
}  # fmt: skip
GO2 = {'imu': 100, 'go2_states': 20, 'lowstate': 20}
RATES = {**COMMON, **GO2} if find_spec('go2_interfaces') else COMMON
BEST_EFFORT = {'camera/image_raw', 'camera/camera_info', 'point_cloud2'}
SECONDS = 5
"""Long enough for Fast DDS to find the publisher by its second announcement, 3 s after the first, if that was lost."""


def environment(domain: int, **more: str) -> dict[str, str]:
    return {**os.environ, 'ROS_DOMAIN_ID': str(domain), **more}


def command(*parameters: str) -> list[str]:
    """The robot as /tachi."""
    given = [word for parameter in parameters for word in ('-p', parameter)]
    return [sys.executable, '-m', MODULE, '--ros-args', '-r', '__ns:=/tachi', *given]


def published(output: str) -> dict[str, int]:
    """The one line on standard output."""
    lines = output.splitlines()
    assert len(lines) == 1, output
    counts: dict[str, int] = json.loads(lines[0])['published']
    return counts


def message_types() -> dict[str, Any]:
    types: dict[str, Any] = {
        'odom': Odometry, 'joint_states': JointState, 'camera/image_raw': Image, 'camera/camera_info': CameraInfo,
        'camera/compressed': CompressedImage, 'point_cloud2': PointCloud2,
    }  # fmt: skip
    if 'imu' in RATES:
        from go2_interfaces.msg import IMU, Go2State, LowState

        types |= {'imu': IMU, 'go2_states': Go2State, 'lowstate': LowState}
    return types


class Listener:
    """Polled raw subscriptions to all topics under ``/tachi``; ``taken`` holds what each one got, with its message info."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node('listener', namespace='/tachi', context=self._context, start_parameter_services=False)
        self.types = message_types()
        self.taken: dict[str, list[tuple[bytes, Any]]] = {name: [] for name in self.types}
        policy = QoSReliabilityPolicy
        self._subscriptions = {
            name: self.node.create_subscription(
                kind,
                name,
                lambda _message: None,
                QoSProfile(depth=200, reliability=policy.BEST_EFFORT if name in BEST_EFFORT else policy.RELIABLE),
            )
            for name, kind in self.types.items()
        }

    def poll(self) -> None:
        for name, subscription in self._subscriptions.items():
            with subscription.handle:
                while (taken := subscription.handle.take_message(self.types[name], True)) is not None:
                    self.taken[name].append((bytes(taken[0]), taken[1]))

    def last(self, name: str) -> Any:
        """The last message of a topic, deserialized."""
        return deserialize_message(self.taken[name][-1][0], self.types[name])

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class Run:
    """Some seconds of the simulated Go2 as /tachi: its output, what a listener received, and its endpoints in the graph."""

    def __init__(self, domain: int) -> None:
        listener = Listener(domain)
        try:
            process = subprocess.Popen(
                command(f'duration_s:={SECONDS}.0'),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=environment(domain),
            )
            self.endpoints: dict[str, Any] = {}
            end = time.monotonic() + 120
            while process.poll() is None and time.monotonic() < end:
                listener.poll()
                if len(self.endpoints) < len(RATES):
                    self._look(listener)
                time.sleep(0.02)
            output, self.errors = process.communicate(timeout=60)
            listener.poll()
        finally:
            process.kill()
            listener.close()
        self.ended_ns = time.time_ns()
        self.listener, self.published, self.returncode = listener, published(output), process.returncode

    def _look(self, listener: Listener) -> None:
        for name in RATES:
            found = listener.node.get_publishers_info_by_topic(f'/tachi/{name}')
            if found:
                self.endpoints[name] = found[0]


pytest.importorskip('rclpy')


@pytest.fixture(scope='module')
def some_seconds() -> Iterator[Run]:
    with free_domain() as domain:
        yield Run(domain)


def finished(domain: int, *parameters: str, **more: str) -> subprocess.CompletedProcess[str]:
    """A run of the robot to its end."""
    own = environment(domain, **more)
    return subprocess.run(command(*parameters), capture_output=True, text=True, timeout=100, check=False, env=own)


@pytest.mark.ros
@pytest.mark.long('a second of CPU or more')
def test_it_publishes_exactly_rate_times_duration(some_seconds: Run) -> None:
    """The line of JSON has every resolved topic with the exact number, and the exit code is 0."""
    assert some_seconds.returncode == 0
    assert some_seconds.published == {f'/tachi/{name}': SECONDS * rate for name, rate in RATES.items()}


@pytest.mark.ros
@pytest.mark.long('a robot at full rate')
@pytest.mark.parametrize('name', sorted(set(RATES) - BEST_EFFORT))
def test_reliable_topics_arrive_without_a_gap(some_seconds: Run, name: str) -> None:
    """No message is missing from the first one taken to the last one published."""
    taken, published = some_seconds.listener.taken[name], some_seconds.published[f'/tachi/{name}']
    assert taken
    numbers = [info.get('publication_sequence_number') for _, info in taken]
    if numbers[0] is not None:  # Jazzy and later number what they publish
        assert numbers == list(range(numbers[0], published + 1))


@pytest.mark.ros
@pytest.mark.parametrize('name', sorted(RATES))
def test_the_qos_is_the_drivers(some_seconds: Run, name: str) -> None:
    """BEST_EFFORT for the topics of the real driver that use it, otherwise RELIABLE; always VOLATILE."""
    profile = some_seconds.endpoints[name].qos_profile
    assert profile.reliability.name == ('BEST_EFFORT' if name in BEST_EFFORT else 'RELIABLE')
    assert profile.durability.name == 'VOLATILE'


@pytest.mark.ros
def test_image_and_jpeg_are_one_frame(some_seconds: Run) -> None:
    """Both have the same stamp, and the JPEG decodes to the image."""
    listener = some_seconds.listener
    jpeg = listener.last('camera/compressed')
    assert jpeg.format == 'bgr8; jpeg compressed bgr8'
    decoded = simplejpeg.decode_jpeg(bytes(jpeg.data), 'BGR').astype(int)
    assert decoded.shape == (480, 640, 3)
    if not listener.taken['camera/image_raw']:
        pytest.skip('no image arrived: Fast DDS without a large shared-memory segment')
    images = [deserialize_message(cdr, listener.types['camera/image_raw']) for cdr, _ in listener.taken['camera/image_raw'][-20:]]
    jpegs = [
        deserialize_message(cdr, listener.types['camera/compressed']) for cdr, _ in listener.taken['camera/compressed'][-20:]
    ]
    pairs = [(image, jpeg) for image in images for jpeg in jpegs if image.header.stamp == jpeg.header.stamp]
    assert pairs
    for image, jpeg in pairs:
        assert (image.encoding, image.height, image.width, image.step) == ('bgr8', 480, 640, 1920)
        pixels = np.frombuffer(image.data, np.uint8).reshape(480, 640, 3)
        assert np.abs(simplejpeg.decode_jpeg(bytes(jpeg.data), 'BGR').astype(int) - pixels).mean() < 6


@pytest.mark.ros
def test_stamps_are_the_time_of_the_sample_in_utc(some_seconds: Run) -> None:
    """Odometry is stamped every 20 ms until the end."""
    listener = some_seconds.listener
    odometry = [deserialize_message(cdr, listener.types['odom']).header.stamp for cdr, _ in listener.taken['odom']]
    stamps = [stamp.sec * 10**9 + stamp.nanosec for stamp in odometry]
    assert np.abs(np.diff(stamps) - 20_000_000).max() <= 1
    assert 0 < some_seconds.ended_ns - stamps[-1] < 60 * 10**9


@pytest.mark.ros
def test_messages_look_like_the_drivers(some_seconds: Run) -> None:
    """Frames, field layout and joint names are those of go2_ros2_sdk; odometry has no twist, joints only positions."""
    listener = some_seconds.listener
    cloud, odom, joints, info = (listener.last(name) for name in ('point_cloud2', 'odom', 'joint_states', 'camera/camera_info'))
    assert cloud.header.frame_id == 'odom'
    assert [(field.name, field.offset, field.datatype) for field in cloud.fields] == [
        ('x', 0, 7), ('y', 4, 7), ('z', 8, 7), ('intensity', 12, 7),
    ]  # fmt: skip
    assert len(cloud.data) == cloud.row_step == cloud.width * 16 > 240_000
    assert (odom.header.frame_id, odom.child_frame_id) == ('odom', 'base_link')
    assert odom.twist.twist.linear.x == 0.0
    assert joints.name[:4] == ['FL_hip_joint', 'FL_thigh_joint', 'FL_calf_joint', 'FR_hip_joint']
    assert (len(joints.name), len(joints.position), len(joints.velocity), len(joints.effort)) == (12, 12, 0, 0)
    assert (info.width, info.height, info.header.frame_id) == (640, 480, 'front_camera')


@pytest.mark.ros
@pytest.mark.skipif('imu' not in RATES, reason='needs go2_interfaces')
def test_the_go2_messages_belong_together(some_seconds: Run) -> None:
    """The battery is almost full, motors are in the robot's order, and the velocity is walking speed."""
    listener = some_seconds.listener
    low, state, imu, joints = (listener.last(name) for name in ('lowstate', 'go2_states', 'imu', 'joint_states'))
    assert low.bms_state.soc == 99
    assert np.hypot(*state.velocity[:2]) == pytest.approx(0.6, abs=1e-5)
    assert np.linalg.norm(imu.quaternion) == pytest.approx(1, abs=1e-5)
    assert 5 < imu.accelerometer[2] < 15
    front_right = joints.position[joints.name.index('FR_calf_joint')]
    assert [motor.q for motor in low.motor_state[12:]] == [0.0] * 8
    assert -2.8 < low.motor_state[2].q < -0.8
    assert -2.8 < front_right < -0.8


@pytest.mark.ros
@pytest.mark.parametrize('number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long('a robot of its own'))])
def test_a_signal_ends_it_with_its_account(number: signal.Signals, domain: int) -> None:
    """SIGINT and SIGTERM both lead to the line of JSON and exit code 0, soon."""
    process = subprocess.Popen(
        command('image_raw:=false', 'compressed:=false', 'rate_scale:=0.5'),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(domain),
    )  # fmt: skip
    try:
        assert _wait_for_publisher(process, domain), 'it never published'
        process.send_signal(number)
        output, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    counts = published(output)
    assert '/tachi/camera/image_raw' not in counts
    assert '/tachi/camera/compressed' not in counts
    assert counts['/tachi/odom'] > counts['/tachi/point_cloud2'] >= 3


def _wait_for_publisher(process: subprocess.Popen[str], domain: int) -> bool:
    """Whether three point clouds arrive within a minute."""
    listener = Listener(domain)
    try:
        end = time.monotonic() + 60
        while time.monotonic() < end and process.poll() is None:
            listener.poll()
            if len(listener.taken['point_cloud2']) >= 3:
                return True
            time.sleep(0.02)
    finally:
        listener.close()
    return False


@pytest.mark.ros
@pytest.mark.long('a robot of its own')
def test_without_go2_interfaces_it_runs_with_the_rest(tmp_path: Path, domain: int) -> None:
    """Only the topics of go2_interfaces are missing, which one line on stderr reports."""
    missing = tmp_path / 'go2_interfaces'
    missing.mkdir()
    (missing / '__init__.py').write_text('raise ImportError("not installed here")')
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get('PYTHONPATH'))))
    done = finished(domain, 'duration_s:=0.2', PYTHONPATH=path)
    assert set(published(done.stdout)) == {f'/tachi/{name}' for name in COMMON}
    assert sum('go2_interfaces' in line for line in done.stderr.splitlines()) == 1


@pytest.mark.ros
def test_an_unknown_parameter_refuses_the_start(domain: int) -> None:
    """Exit code 2, the parameter's name and the known ones on stderr, nothing on stdout."""
    done = finished(domain, 'duration:=1.0')
    assert done.returncode == 2
    assert done.stdout == ''
    assert 'duration = 1.0' in done.stderr
    assert 'duration_s' in done.stderr


@pytest.mark.ros
@pytest.mark.long('a process of its own')
def test_a_stray_argument_refuses_the_start(domain: int) -> None:
    """A parameter given without --ros-args is not silently ignored."""
    done = subprocess.run(
        [sys.executable, '-m', MODULE, 'seed:=2'],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=environment(domain),
    )
    assert done.returncode == 2
    assert 'seed:=2' in done.stderr


@pytest.mark.parametrize(
    ('rate', 'duration', 'expected'),
    [(100.0, 60.0, 6000), (30.0, 0.1, 3), (0.1, 30.0, 3), (3.0, 1 / 3, 1), (30.0, 0.11, 4), (10.0, 0.05, 1)],
)
def test_the_number_of_samples_is_rate_times_duration(rate: float, duration: float, expected: int) -> None:
    """An integer product is exact in spite of floating point; a partial period counts as one."""
    assert count(rate, duration) == expected


@given(
    st.dictionaries(st.sampled_from('abcdef'), st.floats(0.2, 200), min_size=1),
    st.floats(0.01, 5),
)
def test_every_sample_comes_once_and_in_order(rates: dict[str, float], duration: float) -> None:
    """Times never decrease, stay below the duration, and are multiples of each period."""
    due = list(schedule(rates, duration))
    assert all(a[0] <= b[0] for a, b in pairwise(due))
    for name, rate in rates.items():
        times = [t for t, of in due if of == name]
        assert times == [k / rate for k in range(count(rate, duration))]


def test_without_a_duration_it_never_ends_and_never_drifts() -> None:
    """Sample 300,000 is due exactly at its time."""
    last = list(islice(schedule({'a': 30.0}, 0.0), 300_001))[-1]
    assert last == (10_000.0, 'a')


pytest.importorskip('rclpy')


@pytest.mark.ros
@pytest.mark.parametrize(
    ('name', 'value'),
    [('seed', -1), ('seed', 1.5), ('duration_s', 'long'), ('rate_scale', 0.0), ('rate_scale', float('nan')), ('image_raw', 1)],
)
def test_a_wrong_value_is_named(name: str, value: object) -> None:
    """The error has the name, the value and what is allowed."""
    with pytest.raises(SettingError) as caught:
        SimSettings.load({name: value})
    assert caught.value.data['name'] == name
    assert str(caught.value).startswith(f'{name} = {value!r} is refused; allowed is')


@pytest.mark.ros
def test_whole_numbers_and_the_parameters_of_rclpy_are_taken() -> None:
    """``duration_s:=5`` is five seconds, and parameters that rclpy declares are not errors."""
    settings = SimSettings.load({'duration_s': 5, 'use_sim_time': False, 'start_type_description_service': True})
    assert settings == SimSettings(duration_s=5.0)


class SlowRobot:
    """Takes 0.1 s for its first message, longer than all others together."""

    rates_hz = {'a': 1000.0}  # noqa: RUF012

    def __init__(self) -> None:
        self.samples: list[tuple[float, int]] = []

    def publish(self, name: str, t: float, stamp_ns: int) -> None:
        if not self.samples:
            time.sleep(0.1)
        self.samples.append((t, stamp_ns))


@pytest.mark.ros
def test_a_late_robot_catches_up_completely() -> None:
    """After a stall every due sample is published, with the time at which it was due."""
    robot = SlowRobot()
    run(robot, SimSettings(duration_s=0.05), lambda: False)  # type: ignore[arg-type]
    assert [t for t, _ in robot.samples] == [k / 1000 for k in range(50)]
    assert [stamp - robot.samples[0][1] for _, stamp in robot.samples] == [k * 1_000_000 for k in range(50)]


@pytest.mark.ros
def test_a_stop_takes_effect_before_the_next_message() -> None:
    """Nothing is published after a stop was requested."""
    robot = SlowRobot()
    run(robot, SimSettings(), lambda: len(robot.samples) == 3)  # type: ignore[arg-type]
    assert len(robot.samples) == 3
