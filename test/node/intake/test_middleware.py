"""The RMW of the node, chosen from an environment, and the reported reason."""

from __future__ import annotations

import socket
import stat
from pathlib import Path

import pytest

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.node.intake.middleware import (
    FROM_PROFILE,
    MAX_BUFFER,
    choose,
    possible_buffer,
    requested_rmw,
    sockets,
)

KILTED = {'rmw_fastrtps_cpp': '9.3.3', 'rmw_cyclonedds_cpp': '4.0.2'}
CYCLONE = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}


@pytest.fixture
def installed(tmp_path: Path) -> dict[str, str]:
    """The prefix of a ROS installation with these RMWs."""
    return prefix(tmp_path, KILTED)


def prefix(folder: Path, versions: dict[str, str]) -> dict[str, str]:
    index = folder / 'share/ament_index/resource_index/rmw_typesupport'
    index.mkdir(parents=True, exist_ok=True)
    for name, version in versions.items():
        (index / name).touch()
        (folder / 'share' / name).mkdir(exist_ok=True)
        (folder / 'share' / name / 'package.xml').write_text(f'<package><version>{version}</version></package>')
    (index / 'rmw_implementation').touch()
    return {'AMENT_PREFIX_PATH': f'/nowhere:{folder}'}


def test_a_robot_with_cyclone_dds_is_received_through_fast_dds(installed: dict[str, str]) -> None:
    """The profile replaces the variables that Fast DDS reads differently from Cyclone DDS."""
    robot = {**installed, **CYCLONE, 'ROS_LOCALHOST_ONLY': '1', 'ROS_STATIC_PEERS': '10.0.0.9'}
    found = choose('auto', robot)
    assert (found.rmw, found.robot, found.is_foreign) == ('rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp', True)
    assert found.has_robot
    environ = dict(robot)
    found.enter(environ)
    assert environ == {**installed, 'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
                       FROM_PROFILE: '1'}  # fmt: skip
    with found.profiled(environ):
        file = Path(environ['FASTDDS_DEFAULT_PROFILES_FILE'])
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert '<receiveBufferSize>' in file.read_text()
        assert 'SHM' not in file.read_text(), 'memory of another user would be offered, and nothing come through it'
    assert not file.exists()
    assert 'FASTDDS_DEFAULT_PROFILES_FILE' not in environ


def test_the_rmw_of_the_robot_may_be_missing_here(tmp_path: Path) -> None:
    """Its topics are received anyway, but no front can use the RMW."""
    found = choose('auto', {**prefix(tmp_path, {'rmw_fastrtps_cpp': '9.3.3'}), **CYCLONE})
    assert (found.is_foreign, found.has_robot) == (True, False)


@pytest.mark.parametrize('rmw', ['', 'rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp'])
def test_a_fast_dds_robot_keeps_its_own(installed: dict[str, str], rmw: str) -> None:
    """Only the profile changes: it is that of the drivers with larger buffers; a profile set in the shell is restored."""
    shipped = {'FASTDDS_DEFAULT_PROFILES_FILE': '/share/fastdds_shm.xml'}
    environ = {**installed, **shipped, 'RMW_IMPLEMENTATION': rmw, 'ROS_LOCALHOST_ONLY': '1'}
    before = dict(environ)
    found = choose('auto', environ)
    assert (found.rmw, found.is_foreign) == (rmw or 'rmw_fastrtps_cpp', False)
    found.enter(environ)
    with found.profiled(environ):
        text = Path(environ['FASTDDS_DEFAULT_PROFILES_FILE']).read_text()
        assert '<segment_size>' in text
        assert '<receiveBufferSize>' in text
        assert 'interfaceWhiteList' not in text
    assert environ == before | {FROM_PROFILE: '1'}


@pytest.mark.parametrize(
    ('name', 'value'), [('FASTDDS_DEFAULT_PROFILES_FILE', '/mine.xml'), ('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')]
)
@pytest.mark.parametrize('robot', [{}, CYCLONE])
def test_the_operators_fast_dds_settings_are_kept(
    installed: dict[str, str], name: str, value: str, robot: dict[str, str]
) -> None:
    """The operator's profile, transports and discovery range, on either robot."""
    environ = {**installed, **robot, name: value, 'ROS_LOCALHOST_ONLY': '1'}
    found = choose('auto', environ)
    found.enter(environ)
    with found.profiled(environ):
        assert environ[name] == value
        assert environ['ROS_LOCALHOST_ONLY'] == '1'
        assert environ.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp') == 'rmw_fastrtps_cpp'


def test_fast_dds_2_has_another_variable(tmp_path: Path) -> None:
    """That of Humble and Jazzy; on Humble the discovery range is unknown."""
    environ = {**prefix(tmp_path, {'rmw_fastrtps_cpp': '6.2.7'}), **CYCLONE, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    found = choose('fastrtps', environ)
    assert found.profile_variable == 'FASTRTPS_DEFAULT_PROFILES_FILE'
    assert found.network is not None
    assert found.network.multicast


def test_the_first_prefix_counts(tmp_path: Path) -> None:
    """As for everything in ROS: a workspace overlays the distribution."""
    over = prefix(tmp_path / 'over', {'rmw_fastrtps_cpp': '6.2.7'})['AMENT_PREFIX_PATH']
    under = prefix(tmp_path / 'under', KILTED)['AMENT_PREFIX_PATH']
    found = choose('fastrtps', {**CYCLONE, 'AMENT_PREFIX_PATH': f'{over}:{under}'})
    assert found.profile_variable == 'FASTRTPS_DEFAULT_PROFILES_FILE'


@pytest.mark.parametrize(
    ('versions', 'variables', 'why'),
    [
        ({'rmw_cyclonedds_cpp': '4.0.2'}, CYCLONE, 'is not installed'),
        ({'rmw_fastrtps_cpp': '99.1.0'}, CYCLONE, '99.1 has not been tested with it'),
        (KILTED, {'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp'}, 'does not interoperate with rmw_zenoh_cpp'),
        (KILTED, {**CYCLONE, 'ROS_SECURITY_ENABLE': 'true'}, 'ROS_SECURITY_ENABLE'),
        (KILTED, {**CYCLONE, 'CYCLONEDDS_URI': '<Discovery><Tag>x</Tag></Discovery>'}, 'Discovery/Tag'),
    ],
)  # fmt: skip
def test_the_robots_rmw_is_kept_where_fast_dds_would_be_worse(
    tmp_path: Path, versions: dict[str, str], variables: dict[str, str], why: str
) -> None:
    """With the reason in the first line; the environment is not changed."""
    environ = {**prefix(tmp_path, versions), **variables}
    found = choose('auto', environ)
    assert (found.rmw, found.is_foreign, found.variables) == (variables['RMW_IMPLEMENTATION'], False, {})
    assert why in found.describe()


def test_a_requested_rmw_is_used_or_rejected(installed: dict[str, str], tmp_path: Path) -> None:
    """The robot's RMW on request; Fast DDS also if it was not measured, but not if it cannot receive."""
    assert choose('robot', {**installed, **CYCLONE}).rmw == 'rmw_cyclonedds_cpp'
    new = prefix(tmp_path / 'new', {'rmw_fastrtps_cpp': '99.1.0'})
    found = choose('fastrtps', {**new, **CYCLONE})
    assert found.rmw == 'rmw_fastrtps_cpp'
    assert 'though' in found.why
    for environ in ({**installed, 'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp'}, {**prefix(tmp_path / 'none', {}), **CYCLONE}):
        with pytest.raises(SettingError, match='auto or robot here'):
            choose('fastrtps', environ)


def test_unreadable_settings_are_left_to_ros(tmp_path: Path) -> None:
    """As usual, rcl reports what is wrong with a file when the node starts."""
    assert requested_rmw(['--ros-args', '--params-file', str(tmp_path / 'none.yaml')]) == 'auto'
    assert requested_rmw(['--ros-args', '-p', 'capture.rmw:=robot']) == 'robot'


def test_the_buffer_is_read_back() -> None:
    """The buffer of this process's sockets: the size the kernel granted, and the packets dropped."""
    before = sockets()
    wanted = possible_buffer()
    assert 0 < wanted <= MAX_BUFFER
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)
        receiver.bind(('127.0.0.1', 0))
        assert sockets() == type(before)(max(wanted, before.receive_bytes), before.dropped)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(100):
            sender.sendto(bytes(1000), receiver.getsockname())
        assert sockets().dropped > before.dropped
