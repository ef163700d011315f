"""Faults of the robot's machine, one at a time: its shell, its secrets, its kernel, its disk and its spool."""

from __future__ import annotations

import fcntl
import json
import os
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from doctor.scene import Scene, assert_finding
from spool.making import make, put, settle

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.doctor import disk, environment
from shadowhound_data_logger.doctor.checks import CHECKS
from shadowhound_data_logger.doctor.context import make as make_context
from shadowhound_data_logger.doctor.model import Result, Role
from shadowhound_data_logger.doctor.run import fix
from shadowhound_data_logger.missions.overview import MissionBrief
from shadowhound_data_logger.ros.fast_dds_profile import PROFILE_FILES, SHIPPED

SECRET = 'AWS_SECRET_ACCESS_KEY = kept-from-others\n'
MEBI = 1 << 20
PROFILE = Path(__file__).parents[2] / 'launch_configs' / SHIPPED
Inject = Callable[[Scene], None]
ASKED = ('versions', 'environment', 'secrets', 'network.s3', 'ros.environment', 'sockets', 'disk', 'spool', 'missions', 'tower')


@pytest.fixture
def robot(scene: Scene) -> Scene:
    """A healthy robot: a node with a spool with one delivered object, and the Tower's address is set."""
    scene.environ |= {'AWS_ENDPOINT_URL': 'http://127.0.0.1:1', 'AWS_ACCESS_KEY_ID': 'a', 'AWS_SECRET_ACCESS_KEY': 'b',
                      'MLFLOW_TRACKING_URI': 'http://127.0.0.1:1'}  # fmt: skip
    spool = scene.open_spool()
    settle(spool, put(spool, make())[0], State.DELIVERED)
    scene.run_node()
    return scene


def wrong(name: str, value: str, **more: str) -> Inject:
    """A variable of the shell, and others that determine the fault."""
    return lambda scene: scene.environ.update({name: value, **more})


def without(*names: str) -> Inject:
    return lambda scene: [scene.environ.pop(name, None) for name in names] and None


def readable_by_all(scene: Scene) -> None:
    path = scene.root / 'etc/shadowhound/logger.env'
    path.write_text(SECRET)
    path.chmod(0o644)


def keys_readable_by_all(scene: Scene) -> None:
    path = scene.root / 'etc/shadowhound/credentials'
    path.write_text(f'[default]\n{SECRET.lower()}')
    path.chmod(0o644)


def small_buffers(scene: Scene) -> None:
    scene.environ['RMW_IMPLEMENTATION'] = 'rmw_cyclonedds_cpp'
    scene.environ['CYCLONEDDS_URI'] = '<CycloneDDS><SocketReceiveBufferSize min="default" max="10MB"/></CycloneDDS>'
    scene.environ['AMENT_PREFIX_PATH'] = ''
    (scene.root / 'proc/sys/net/core/rmem_max').write_text('212992\n')


def small_buffers_of_fast_dds(scene: Scene) -> None:
    """The robot uses Cyclone DDS, with its defaults; the node would subscribe through Fast DDS."""
    scene.environ['RMW_IMPLEMENTATION'] = 'rmw_cyclonedds_cpp'
    (scene.root / 'proc/sys/net/core/rmem_max').write_text('212992\n')


def small_buffers_of_the_node(scene: Scene) -> None:
    """The kernel would allow more by now."""
    scene.environ['RMW_IMPLEMENTATION'] = 'rmw_cyclonedds_cpp'
    scene.run_node(middleware=beside(receive_bytes=212_992, dropped_datagrams=17))


def refused_middleware(scene: Scene) -> None:
    scene.parameters['capture.rmw'] = 'fastrtps'
    scene.environ.update(RMW_IMPLEMENTATION='rmw_connextdds', AMENT_PREFIX_PATH='')


def greedy_buffers(scene: Scene) -> None:
    small_buffers(scene)
    (scene.root / 'proc/sys/net/core/rmem_max').write_text(f'{8 * MEBI}\n')
    scene.environ['CYCLONEDDS_URI'] = '<CycloneDDS><SocketReceiveBufferSize max="32MB" min=\'17 MB\'/></CycloneDDS>'


def driver_elsewhere(scene: Scene) -> None:
    scene.process(77, 'python3', '/opt/go2_driver_node', ROS_DOMAIN_ID='5', FASTRTPS_DEFAULT_PROFILES_FILE='x')


def driver_with_small_memory(**environ: str) -> Inject:
    return lambda scene: scene.process(77, 'python3', '/opt/go2_driver_node', HOME='/root', **environ)


def backlog(scene: Scene) -> None:
    """A pending object from an hour ago."""
    put(scene.open_spool(), make('thor/late.jpg'))
    with sqlite3.connect(scene.spool / 'index.db') as index:
        index.execute('UPDATE objects SET created_ns = ?', (time.time_ns() - 3600 * SECOND,))
    index.close()


def quarantined(scene: Scene) -> None:
    spool = scene.open_spool()
    settle(spool, put(spool, make('thor/odd.jpg'))[0], State.QUARANTINED, 'name')


def unbalanced(scene: Scene) -> None:
    with sqlite3.connect(scene.spool / 'index.db') as index:
        index.execute("UPDATE tally SET objects = objects + 1 WHERE state = 'spooled'")
    index.close()


def damaged(scene: Scene) -> None:
    """Pages of the index that a bad disk corrupted."""
    scene.stack.close()  # the spool is closed, so that everything is in the file
    path = scene.spool / 'index.db'
    body = bytearray(path.read_bytes())
    body[4096:-4096] = os.urandom(len(body) - 8192)
    path.write_bytes(body)


def locked(scene: Scene) -> None:
    """Locked by a process that is not a node."""
    path = scene.spool / 'drain.lock'
    path.touch()
    program = 'import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); sys.stdin.read()'
    child = subprocess.Popen([sys.executable, '-c', program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    scene.stack.callback(child.wait)
    scene.stack.callback(child.terminate)
    for stream in (child.stdin, child.stdout):
        assert stream
        scene.stack.callback(stream.close)
    assert child.stdout
    child.stdout.readline()
    with pytest.raises(BlockingIOError), path.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    scene.root = Path('/')


def not_running(scene: Scene) -> None:
    scene.run_node(ended=True)


def no_delivery(scene: Scene) -> None:
    scene.run_node(store={'target': 'a server', 'state': 'store_down', 'last_error': 'Tower refused the connection'})


def other_shell(scene: Scene) -> None:
    """The node has other keys than this shell."""
    scene.process(os.getpid(), 'sensor_logger_node', **{**scene.environ, 'AWS_SECRET_ACCESS_KEY': 'older'})


def deaf_tower(scene: Scene) -> None:
    scene.role = Role.SERVER
    scene.environ['AWS_ENDPOINT_URL'] = scene.environ['MLFLOW_TRACKING_URI'] = 'http://127.0.0.1:9000'
    scene.listen('0100007F:2328')


def unfinished_port(scene: Scene) -> None:
    """A port left by a process that was killed while it created it."""
    port = scene.root / 'dev/shm/fastdds_port7411'
    port.touch()
    os.utime(port, (0, 0))


def left_segment(scene: Scene) -> None:
    """With its lock, which no process holds."""
    segment = scene.root / 'dev/shm/fastrtps_0123456789abcdef'
    segment.write_bytes(bytes(2_000_000))
    lock = segment.with_name(f'{segment.name}_el')
    lock.touch()
    os.utime(lock, (0, 0))


def patched(target: str, value: object) -> Inject:
    """Replace something in the doctor's modules during the test."""

    def inject(scene: Scene) -> None:
        scene.stack.enter_context(pytest.MonkeyPatch.context()).setattr(f'shadowhound_data_logger.doctor.{target}', value)

    return inject


def stuck_mission(_: Path) -> list[MissionBrief]:
    return [
        MissionBrief(
            mission_id='m', run_id=None, type='patrol', command='', robot='thor', started='', ended=None, duration_s=1.0,
            result='FINISHED', errors=(), distance_m=None, battery_consumed_pct=None, complete=False, unsent={},
            refused_by_server=0, last_error='http://tower:5001 cannot be asked', remedy='is MLFLOW_TRACKING_URI right?',
            folder='',
        )
    ]  # fmt: skip


def beside(**middleware: object) -> dict[str, object]:
    """The middleware of a node that uses Fast DDS on a robot with Cyclone DDS."""
    return {'rmw': 'rmw_fastrtps_cpp', 'robot': 'rmw_cyclonedds_cpp', **middleware}


def undiscovered(scene: Scene) -> None:
    rows = {'/imu': {'publishers': 2, 'nodes': ['/go2_driver'], 'seconds': 41, 'text': '/imu is not all heard'}}
    scene.run_node(middleware=beside(undiscovered=rows), workers={'front': {}})


def endpoint_of_the_node(scene: Scene) -> None:
    without('AWS_ENDPOINT_URL')(scene)
    scene.run_node(store={'target': 'the S3 server at http://tower:9000', 'state': 'idle'})


def failing_front(scene: Scene) -> None:
    scene.run_node(
        middleware=beside(), workers={'front': {'failing': True, 'failures': 3, 'last_error': 'it exited by signal 9'}}
    )


FAULTS: dict[str, tuple[Inject, str, str, tuple[str, ...]]] = {
    'no endpoint': (without('AWS_ENDPOINT_URL'), 'environment', 'environment.endpoint', ('export AWS_ENDPOINT_URL=http://',)),
    'an endpoint of the node alone': (endpoint_of_the_node, 'environment', 'environment.endpoint', ('shadowhound/logger.env',)),
    'no keys': (without('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY'), 'environment', 'environment.credentials',
                ('export AWS_ACCESS_KEY_ID=', 'aws configure')),
    'half a pair': (without('AWS_SECRET_ACCESS_KEY'), 'environment', 'environment.credentials', ('AWS_SECRET_ACCESS_KEY=',)),
    'no MLflow': (without('MLFLOW_TRACKING_URI'), 'environment', 'environment.tracking', ('export MLFLOW_TRACKING_URI=http://',)),
    'MLflow without http://': (wrong('MLFLOW_TRACKING_URI', 'tower:5001'), 'environment', 'environment.tracking',
                               ('export MLFLOW_TRACKING_URI=http://tower:5001',)),
    'pasted as it was': (wrong('MLFLOW_TRACKING_URI', 'http://SERVER:5001'), 'environment', 'environment.placeholder',
                         ('export MLFLOW_TRACKING_URI=',)),
    'a blank after the store for artifacts': (wrong('MLFLOW_S3_ENDPOINT_URL', 'http://127.0.0.1:1 '), 'environment',
                                              'environment.artifacts', ('without blanks',)),
    'another store for artifacts': (wrong('MLFLOW_S3_ENDPOINT_URL', 'http://old:9000'), 'environment', 'environment.artifacts',
                                    ('export MLFLOW_S3_ENDPOINT_URL=$AWS_ENDPOINT_URL',)),
    'a proxy': (wrong('HTTP_PROXY', 'http://proxy:3128'), 'environment', 'environment.proxy', ('NO_PROXY',)),
    'a setting that is none': (lambda scene: scene.parameters.update({'camera.rate': 3.0}), 'environment', 'environment.settings',
                               ()),
    'other keys than the node': (other_shell, 'environment', 'environment.node', ('restart shadowhound-data-logger',)),
    'secret for all to read': (readable_by_all, 'secrets', 'secrets.mode', ('chmod 600', 'logger.env')),
    'password in a URL': (wrong('MLFLOW_TRACKING_URI', 'http://me:word@tower:5001'), 'secrets', 'secrets.url',
                          ('MLFLOW_TRACKING_USERNAME',)),
    'keys of a file for all to read': (keys_readable_by_all, 'secrets', 'secrets.mode', ('chmod 600', 'credentials')),
    'default secret': (wrong('AWS_SECRET_ACCESS_KEY', 'minioadmin'), 'secrets', 'secrets.default', ('make tower-secrets',)),
    'wrong domain': (wrong('ROS_DOMAIN_ID', '300'), 'ros.environment', 'ros.domain_id', ('export ROS_DOMAIN_ID=',)),
    'discovery off': (wrong('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF', ROS_DISTRO='jazzy'), 'ros.environment', 'ros.discovery',
                      ('=SUBNET',)),
    'middleware not installed': (wrong('RMW_IMPLEMENTATION', 'rmw_zenoh_cpp'), 'ros.environment', 'ros.middleware',
                                 ('apt install', 'rmw-zenoh-cpp')),
    'driver in another domain': (driver_elsewhere, 'ros.environment', 'ros.driver', ('export ROS_DOMAIN_ID=5',)),
    'discovery in a word that is not of Humble': (wrong('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST', ROS_DISTRO='humble'),
                                                  'ros.environment', 'ros.discovery',
                                                  ('unset ROS_AUTOMATIC', 'export ROS_LOCALHOST_ONLY=1')),
    'Cyclone DDS that does not start': (greedy_buffers, 'sockets', 'sockets.cyclone', ('rmem_max', 'min="default" max="10MB"')),
    'small socket buffers': (small_buffers, 'sockets', 'sockets.buffer', ('net.core.rmem_max', 'sysctl')),
    'small socket buffers of Fast DDS': (small_buffers_of_fast_dds, 'sockets', 'sockets.buffer', ('net.core.rmem_max', 'sysctl')),
    'small socket buffers of the node': (small_buffers_of_the_node, 'sockets', 'sockets.buffer', ('systemctl restart',)),
    'a middleware that the node refuses': (refused_middleware, 'ros.environment', 'ros.listener', ()),
    'small default shared memory': (without(*PROFILE_FILES), 'sockets', 'sockets.profile', ('fastdds_shm.xml',)),
    **{
        f'the profile that Fast DDS reads on {distribution} is not there, the other one is': (
            wrong(read, '/nowhere.xml', **{other: str(PROFILE)}, ROS_DISTRO=distribution), 'sockets', 'sockets.profile',
            (f'export {read}=',))
        for distribution, read, other in (('humble', *PROFILE_FILES), ('kilted', *reversed(PROFILE_FILES)))
    },
    'small shared memory of the driver': (driver_with_small_memory(), 'sockets', 'sockets.driver',
                                          ('restart the driver', 'export FASTDDS_DEFAULT')),
    'small shared memory of a driver with Fast DDS 2': (driver_with_small_memory(ROS_DISTRO='humble'), 'sockets',
                                                        'sockets.driver', ('export FASTRTPS_DEFAULT',)),
    'shared memory that a killed process has left': (left_segment, 'sockets', 'sockets.orphans', ('--fix', 'when it starts')),
    'a port that a killed process has left': (unfinished_port, 'sockets', 'sockets.ports', ('--fix', 'then continues')),
    'node not running': (not_running, 'spool', 'node.running', ('sensor_logger_node',)),
    'node that is paused': (lambda scene: scene.run_node(paused=True), 'spool', 'node.status', ('/pause ', '{data: false}')),
    'publishers that the node does not hear': (
        undiscovered, 'spool', 'node.undiscovered', ('capture.rmw: robot', 'CYCLONEDDS_URI')),
    'a front that fails': (failing_front, 'spool', 'node.front', ('journalctl', 'shadowhound-data node')),
    'no front': (lambda scene: scene.run_node(middleware=beside()), 'spool', 'node.front', ('rmw-cyclonedds-cpp',)),
    'node that does not deliver': (no_delivery, 'spool', 'node.delivery', ('doctor --only s3',)),
    'node of another version': (lambda scene: scene.run_node(version='0.0.1'), 'versions', 'versions.node', ('restart',)),
    'clock that was never set': (patched('clock.EARLIEST_SANE_NS', 1 << 62), 'clock', 'clock.set', ('timedatectl',)),
    'mission that is not sent': (patched('missions.overviews', stuck_mission), 'missions', 'missions.sent',
                                 ('MLFLOW_TRACKING_URI',)),
    'backlog': (backlog, 'spool', 'spool.backlog', ('doctor --only s3',)),
    'no address': (wrong('MLFLOW_TRACKING_URI', 'http://[tower'), 'environment', 'environment.tracking',
                   ('export MLFLOW_TRACKING_URI=http://',)),
    'quarantine': (quarantined, 'spool', 'spool.quarantine', ('quarantine',)),
    'unbalanced ledger': (unbalanced, 'spool', 'spool.ledger', ('shadowhound-data ledger --json',)),
    'damaged index': (damaged, 'spool', 'spool.index', ('start the node',)),
    "another process's lock": (locked, 'spool', 'spool.lock', ('kill ',)),
    'servers for Tower itself only': (deaf_tower, 'tower', 'tower.listen', ('0.0.0.0', 'ufw allow')),
}  # fmt: skip


@pytest.mark.parametrize(('inject', 'asked', 'name', 'words'), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_found_and_named(robot: Scene, inject: Inject, asked: str, name: str, words: tuple[str, ...]) -> None:
    """By exactly one finding, with the correct remedy."""
    inject(robot)
    found = robot.findings(asked)
    if name == 'tower.listen':
        found = found[:1]  # both addresses use the same port here
    assert_finding(found, name, *words)


def test_shared_memory_of_killed_processes_is_freed(robot: Scene) -> None:
    """By ``--fix``, which reports the amount."""
    left_segment(robot)
    done = [what for _, what in fix(robot.findings('sockets'), robot.context())]
    assert done == [f'freed 2 MB in {robot.root / "dev/shm"}']
    assert list((robot.root / 'dev/shm').glob('fastrtps_0*')) == []
    assert robot.findings('sockets') == []


def test_a_robot_with_cyclone_dds_is_checked_through_the_nodes_rmw(robot: Scene) -> None:
    """Through Fast DDS, with the maximum buffer of the kernel, whatever Cyclone DDS would request."""
    robot.environ['RMW_IMPLEMENTATION'] = 'rmw_cyclonedds_cpp'
    assert robot.findings('sockets') == []
    (report,) = (result for result in robot.ask('ros.environment') if result.check == 'ros.listener')
    assert report.seen.startswith(
        "the node would listen with rmw_fastrtps_cpp (the robot's is rmw_cyclonedds_cpp: Fast DDS reports"
    )
    robot.run_node(middleware=beside(rmw='rmw_cyclonedds_cpp', why="the robot's own", asked='robot', receive_bytes=MEBI))
    (report,) = (result for result in robot.ask('ros.environment') if result.check == 'ros.listener')
    assert report.seen == "the node listens with rmw_cyclonedds_cpp (the robot's own); capture.rmw is robot"
    assert [result.check for result in robot.findings('sockets')] == ['sockets.cyclone']


@pytest.mark.parametrize(
    ('distro', 'told'),
    [('jazzy', []), ('lyrical', ['the package is made for it too, but tested are humble, jazzy, kilted']),
     ('foxy', ['tested are humble, jazzy, kilted'])],
)  # fmt: skip
def test_an_untested_distribution_is_reported(robot: Scene, distro: str, told: list[str]) -> None:
    """Not as a finding, and for Lyrical differently than for an unknown one."""
    robot.environ['ROS_DISTRO'] = distro
    results = robot.ask('versions')
    assert [result.cause for result in results if result.check == 'versions.ros'] == told
    assert not any(result.is_finding for result in results)


def test_a_parameter_file_for_another_node_is_a_finding(robot: Scene, tmp_path: Path) -> None:
    """A misspelled section is not an error to ROS: the node runs with its defaults, and only this check reports it."""
    path = tmp_path / 'mine.yaml'
    path.write_text('sensor_loger_node:\n  ros__parameters: {camera: {rate_hz: 2.0}}\n')
    context = make_context(robot.environ, role=robot.role, parameter_file=path, root=robot.root)
    assert_finding([each for each in environment.check(context) if each.is_finding], 'environment.parameters', '/**:')


def test_every_check_is_on_the_page() -> None:
    """docs/doctor.md has a line with what it checks and what it finds."""
    page = (Path(__file__).parents[2] / 'docs' / 'doctor.md').read_text(encoding='utf-8')
    lines = ' '.join(re.findall(r'^- (`.*?) \(', page.partition('## The checks')[2], re.MULTILINE))
    assert [check.name for check in CHECKS if f'`{check.name}`' not in lines] == []


def test_a_healthy_robot_gives_no_finding(robot: Scene) -> None:
    """In all checks that need no network."""
    asked = [name for name in ASKED if not name.startswith('network')]
    results = robot.ask(*asked)
    assert but_speed(results) == []
    assert len(results) > 15


def but_speed(results: list[Result]) -> list[Result]:
    """The findings except the speed of the test's disk."""
    return [result for result in results if result.is_finding and result.check not in {'disk.speed', 'disk.sync'}]


def test_the_default_domain_is_that_of_a_shell_without_one(robot: Scene) -> None:
    """A node with domain 0 is in the same domain as a shell without one."""
    robot.process(os.getpid(), 'sensor_logger_node', **{**robot.environ, 'ROS_DOMAIN_ID': '0'})
    assert robot.findings('environment') == []


@pytest.mark.parametrize(('name', 'url'), [
    ('MLFLOW_TRACKING_URI', 'postgresql://me:hunter2@tower/mlflow'), ('MLFLOW_TRACKING_URI', 'http://me:hunter2@tower:99999'),
    ('MLFLOW_TRACKING_URI', 'http://[me:hunter2@tower'), ('MLFLOW_TRACKING_URI', 'http://me:hun/ter2@127.0.0.1:1'),
    ('MLFLOW_S3_ENDPOINT_URL', 'http://me:hunter2@tower:9000'), ('AWS_ENDPOINT_URL', 'http://me:hunter2@127.0.0.1:1'),
])  # fmt: skip
def test_no_password_is_shown(robot: Scene, name: str, url: str) -> None:
    """The password of a URL: neither a database's nor a mistyped one's."""
    robot.environ[name] = url
    report = json.dumps(
        [result.as_dict() for result in robot.ask('environment', 'secrets', 'network.s3', 'network.mlflow', 'mlflow')]
    )
    assert 'ter2' not in report
    assert 'crash' not in report
    assert f'{name} contains a user and a password' in report


def test_a_slow_disk_is_named_within_its_deadline(robot: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """An SD card that takes a second for a sync and another for each megabyte: found before the timeout."""
    now_s, waiting = [0.0], [0]

    def sync(number: int) -> None:
        size = os.fstat(number).st_size
        now_s[0] += 1.0 + (size - waiting[0]) / MEBI
        waiting[0] = size

    monkeypatch.setattr(disk.os, 'fsync', sync)
    monkeypatch.setattr(disk.time, 'perf_counter', lambda: now_s[0])
    found = [result.check for result in disk.check(robot.context()) if result.is_finding]
    assert found == ['disk.sync', 'disk.speed']
    assert now_s[0] < next(check.deadline_s for check in CHECKS if check.name == 'disk')


@pytest.fixture
def small_disk(scene: Scene) -> Path:
    """A separate file system under the home."""
    scene.home.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={16 * MEBI}', 'none', str(scene.home)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip('this user may not mount a file system')
    scene.stack.callback(subprocess.run, ['umount', '--lazy', str(scene.home)], check=True)
    return scene.home


@pytest.mark.long('a disk of its own')
def test_a_full_disk_is_a_finding(scene: Scene, small_disk: Path) -> None:
    """It is reported before the node must evict, and when no space is free at all."""
    scene.parameters['spool.min_free_bytes'] = 4 * MEBI
    assert but_speed(scene.ask('disk')) == []
    with (small_disk / 'filler').open('wb', buffering=0) as file:
        while os.statvfs(small_disk).f_bavail:
            file.write(bytes(4096))
    assert_finding(scene.findings('disk'), 'disk.space', f'df -h {small_disk}')
    scene.parameters['spool.min_free_bytes'] = 0
    assert_finding(scene.findings('disk'), 'disk.space', f'df -h {small_disk}')


def test_a_read_only_spool_is_a_finding(scene: Scene, small_disk: Path) -> None:
    """With the command that makes it writable again."""
    subprocess.run(['mount', '-o', 'remount,ro', str(small_disk)], check=True)
    assert_finding(scene.findings('disk'), 'disk.readonly', f'remount,rw {small_disk}')
