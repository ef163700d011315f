"""The context: the detected role of this machine, and the readable settings."""

from __future__ import annotations

from pathlib import Path

import pytest
from doctor.scene import Scene

from shadowhound_data_logger.core.ros_arguments import ParametersUnreadable, read_parameters
from shadowhound_data_logger.doctor import context, machine
from shadowhound_data_logger.doctor.context import make
from shadowhound_data_logger.doctor.model import Role


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder without a tower/."""
    monkeypatch.chdir(tmp_path)


def guessed(scene: Scene) -> Role:
    return make(scene.environ, root=scene.root).role


def test_ros_and_a_spool_make_the_role_robot(scene: Scene) -> None:
    """Also if a Tower is tried out on the robot."""
    scene.environ['ROS_DISTRO'] = 'humble'
    scene.spool.mkdir(parents=True)
    (scene.spool / 'index.db').touch()
    scene.listen('00000000:2328')
    assert guessed(scene) is Role.ROBOT


def test_servers_make_the_role_tower(scene: Scene, tmp_path: Path) -> None:
    """One that listens on a port of the guide or of the variables, or the files for starting it."""
    scene.listen('00000000:2328')
    assert guessed(scene) is Role.SERVER
    scene.listen('00000000:2329')
    assert guessed(scene) is not Role.SERVER
    scene.environ['AWS_ENDPOINT_URL'] = 'http://localhost:9001'
    assert guessed(scene) is Role.SERVER
    scene.listen()
    (tmp_path / 'tower').mkdir()
    (tmp_path / 'tower/.env').touch()
    assert guessed(scene) is Role.SERVER


def test_the_role_otherwise_depends_on_ros(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new robot, and a developer's desktop."""
    scene.environ['ROS_DISTRO'] = 'humble'
    assert guessed(scene) is Role.ROBOT
    del scene.environ['ROS_DISTRO']
    monkeypatch.setattr(context, 'find_spec', lambda _: None)
    assert guessed(scene) is Role.WORKSTATION


def test_invalid_settings_are_reported_and_dropped(scene: Scene) -> None:
    """One after the other, until the rest is accepted."""
    scene.environ |= {'AWS_ENDPOINT_URL': 'tower:9000', 'SHADOWHOUND_ROBOT': '../thor'}
    scene.parameters = {'camera.rate': 1.0, 'imu.batch_s': -1.0, 'odom.rate_hz': 2.0}
    made = scene.context()
    assert {error.data['name'] for error in made.refused} == {
        'AWS_ENDPOINT_URL', 'SHADOWHOUND_ROBOT', 'camera.rate', 'imu.batch_s'}  # fmt: skip
    assert made.settings.robot == 'thor'
    assert next(sensor.rate_hz for sensor in made.settings.sensors if sensor.name == 'odom') == 2.0


def test_contradicting_sensors_fall_back_to_the_defaults(scene: Scene) -> None:
    """If no single parameter is wrong, the defaults are used: it terminates."""
    scene.parameters = {'sensors': ['imu', 'imu'], 'imu.topics': ['a']}
    scene.environ['SHADOWHOUND_ROBOT'] = 'tachi'
    assert scene.context().refused[0].data['name'] == 'sensors'
    scene.parameters = {'camera.types': ['a', 'b', 'c'], 'robot': 5}
    assert {error.data['name'] for error in scene.context().refused} == {'camera.types', 'robot'}


def test_a_parameter_file_is_read_like_the_nodes(tmp_path: Path) -> None:
    """Those of our node and of all nodes, flat; other nodes' are ignored."""
    path = tmp_path / 'a.yaml'
    path.write_text('/**:\n  ros__parameters: {robot: tachi}\nsensor_logger_node:\n  ros__parameters:\n    imu: {batch_s: 2.0}\n'
                    'other:\n  ros__parameters: {x: 1}\n')  # fmt: skip
    assert read_parameters(path) == {'robot': 'tachi', 'imu.batch_s': 2.0}
    for section in ('/tachi/sensor_logger_node', '/tachi/**', '/**/sensor_logger_node', '/tachi:\n  sensor_logger_node'):
        depth = 2 * section.count('\n')
        path.write_text(f'{section}:\n{depth * " "}  ros__parameters: {{robot: tachi}}\n')
        assert read_parameters(path) == {'robot': 'tachi'}, section
    path.write_text('sensor_logger_node: {}')
    with pytest.raises(ParametersUnreadable, match='is not a parameter file'):
        read_parameters(path)


def test_a_parameter_file_of_two_robots_is_read_by_namespace(tmp_path: Path) -> None:
    """Each namespace has its parameters."""
    path = tmp_path / 'fleet.yaml'
    path.write_text(
        '/tachi/sensor_logger_node:\n  ros__parameters: {robot: tachi, imu.rate_hz: 10.0}\n'
        '/other/sensor_logger_node:\n  ros__parameters: {robot: other, imu.rate_hz: -1.0}\n'
    )
    for namespace in ('/tachi', '/tachi/'):
        made = make({}, parameter_file=path, namespace=namespace)
        assert (made.settings.robot, made.refused) == ('tachi', ())
    assert [error.data['name'] for error in make({}, parameter_file=path, namespace='/other').refused] == ['imu.rate_hz']


def test_listening_addresses_are_classified(scene: Scene) -> None:
    """IPv4 and IPv6, as the kernel writes them; connected sockets do not listen."""
    scene.listen('0100007F:1389', '00000000:2328', '0A01A8C0:0050')
    six = (
        '00000000000000000000000001000000:1F90',
        '0000000000000000FFFF00000100007F:1F91',
        '00000000000000000000000000000000:1F92',
    )
    lines = ['head', *(f'0: {each} 0:0 0A' for each in six), '0: 00000000000000000000000000000000:0016 0:0 01']
    (scene.root / 'proc/net/tcp6').write_text('\n'.join(lines))
    assert machine.listening(scene.root) == {
        (True, 5001), (False, 9000), (False, 80), (True, 8080), (True, 8081), (False, 8082),
    }  # fmt: skip


def test_domains_in_use_are_found(scene: Scene) -> None:
    """By the multicast port of a domain, or the port of the first participant without multicast; each domain once."""
    (scene.root / 'proc/net/udp').write_text(
        'head\n 1: 00000000:1CE8 0:0 07\n 2: 00000000:21CA 0:0 07\n 3: 00000000:1CF2 0:0 07\n 4: 0100007F:23C8 0:0 07\n'
    )
    assert machine.domains(scene.root) == [0, 5, 7]
