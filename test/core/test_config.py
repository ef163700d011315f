"""Settings from any parameters and any environment: either they are refused by name, or they work as documented."""

from __future__ import annotations

import re
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import Settings, default_parameters
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.keys import KeyTemplate, check_key, check_name
from shadowhound_data_logger.core.options import GIBI


def load(environ: dict[str, str] | None = None, namespace: str = '/', **parameters: Any) -> Settings:
    """Settings from parameters as Python names: camera__rate_hz."""
    return Settings.load({name.replace('__', '.'): value for name, value in parameters.items()}, environ or {}, namespace)


def refused(**parameters: Any) -> SettingError:
    """The error that these parameters cause at startup."""
    with pytest.raises(SettingError) as caught:
        load(**parameters)
    return caught.value


def test_no_setting_is_required() -> None:
    """Without settings the robot has the name of its host, the store is a folder, and all sensors of the Go2 are logged."""
    settings = load()
    assert settings.robot == re.sub(r'[^A-Za-z0-9_-]', '_', socket.gethostname()).strip('_-')
    assert settings.home == Path('~/.shadowhound').expanduser()
    assert settings.spool_path == settings.home / 'spool'
    assert (settings.store.endpoint_url, settings.store.directory) == (None, settings.home / 'store')
    assert [sensor.name for sensor in settings.sensors] == [
        'camera', 'camera_info', 'lidar', 'imu', 'odom', 'states', 'joints', 'lowstate', 'cmd_vel', 'voxel_map',
    ]  # fmt: skip
    assert (settings.spool.max_bytes, settings.spool.min_free_bytes) == (20 * GIBI, 2 * GIBI)
    assert settings.shutdown.drain_s == 3.0


def test_the_defaults_can_be_spelled_out() -> None:
    """Setting every parameter to its default changes nothing, except that only listed sensors are logged."""
    given = default_parameters()
    spelled_out = Settings.load(given, {})
    assert spelled_out.capture.topics == 'sensors'
    assert replace(spelled_out, capture=load().capture, assumed=load().assumed) == load()
    del given['sensors']
    assert replace(Settings.load(given, {}), assumed=load().assumed) == load()


@pytest.mark.parametrize(('given', 'environ', 'namespace', 'robot'), [
    ('odin', {'SHADOWHOUND_ROBOT': 'loki'}, '/tachi', 'odin'), ('', {'SHADOWHOUND_ROBOT': 'loki'}, '/tachi', 'loki'),
    ('', {}, '/tachi', 'tachi'), ('', {'SHADOWHOUND_ROBOT': ''}, '/lab/robot0', 'lab_robot0'),
])  # fmt: skip
def test_the_robot_name_comes_from_parameter_environment_or_host(
    given: str, environ: dict[str, str], namespace: str, robot: str
) -> None:
    """The parameter takes precedence over the variable, and the variable over the namespace."""
    assert load(environ, namespace, robot=given).robot == robot


@pytest.mark.parametrize(('host', 'package', 'robot'), [
    ('turtle.local', None, 'turtle_local'), ('turtle', 'turtlebot4_msgs', 'turtle'), ('jetson', 'go2_interfaces', 'thor'),
    ('jetson', 'unitree_go', 'thor'), ('---', None, 'robot'),
])  # fmt: skip
def test_a_robot_without_a_name_gets_the_default(
    host: str, package: str | None, robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is called thor if the messages of a Go2 are installed, and like its host otherwise."""
    monkeypatch.setattr(socket, 'gethostname', lambda: host)
    if package is not None:
        (tmp_path / 'share' / package).mkdir(parents=True)
    assert load({'AMENT_PREFIX_PATH': f'/nowhere:{tmp_path}'}).robot == robot


@pytest.mark.parametrize('value', ['../thor', 'a b', 'x' * 65, 7])
def test_an_invalid_robot_name_is_refused(value: object) -> None:
    """The error contains the invalid name."""
    assert refused(robot=value).data['value'] == value


def test_an_invalid_robot_name_names_its_variable() -> None:
    """If SHADOWHOUND_ROBOT is set, the file has no parameter ``robot`` to fix."""
    with pytest.raises(SettingError, match="SHADOWHOUND_ROBOT = 'Thor 1' is refused; allowed is a name: use letters"):
        load({'SHADOWHOUND_ROBOT': 'Thor 1'})


@pytest.mark.parametrize(('name', 'value', 'allowed'), [
    ('camera.rate_hz', 'fast', 'a number'), ('camera.rate_hz', -1.0, '0 to'), ('camera.rate_hz', float('nan'), '0 to'),
    ('camera.rate_hz', True, 'a number'), ('camera.quality', 101, '1 to 100'), ('camera.quality', 80.0, 'a whole number'),
    ('camera.enabled', 1, 'true or false'), ('camera.format', 'gif', 'jpeg, png, pcd, json, cdr, zip, tar'),
    ('camera.topics', 'a', 'a list of strings'),
    ('camera.topics', [], 'at least one topic'), ('camera.topics', [''], 'at least one topic'), ('camera.topics', [5], 'a list'),
    ('imu.types', ['a', 'b', 'c'], 'at most one type'), ('camera.batch_s', 1.0, '0 with format'),
    ('voxel_map.batch_s', 1.0, '0 with format'),
    ('camera.bucket', '../x', 'letters'),
    ('camera.key', '{robot}/front.jpg', '{date} and {time}'), ('camera.priority', 10, '0 to 9'),
    ('spool.max_bytes', 5, 'at least'),
    ('spool.max_bytes', 1e10, 'a whole number'), ('upload.max_backoff_s', 0.0, '0.1 to 3600'), ('upload.threads', 0, '1 to 64'),
    ('shutdown.drain_s', float('inf'), '0 to 600'), ('sensors', 'camera', 'a list of names'),
    ('sensors', ['a', 'a'], 'each once'),
])  # fmt: skip
def test_a_wrong_value_stops_the_start(name: str, value: object, allowed: str) -> None:
    """The error names the parameter, the value and what is allowed, as text and as data."""
    error = refused(**{name: value})
    assert error.data['name'] == name
    assert repr(value) in str(error)
    assert allowed in error.data['allowed']
    assert name in str(error)


@pytest.mark.parametrize(('name', 'near'), [
    ('camera.rate', 'camera.rate_hz'), ('spool.max_byte', 'spool.max_bytes'), ('cammera.rate_hz', 'camera'), ('rate', 'sensors'),
    ('camera.name', 'camera.topics'), ('camera', 'camera.rate_hz'), ('thermal.topics', "add it to 'sensors'"),
])  # fmt: skip
def test_an_unknown_parameter_stops_the_start(name: str, near: str) -> None:
    """The error names the parameter, its value and similar valid ones."""
    error = refused(**{name: 4711})
    assert error.data['name'] == name
    assert '4711' in str(error)
    assert near in error.data['allowed']


@pytest.mark.parametrize('name', ['robot', 'spool', 'a/b', '', 'use_sim_time'])
def test_sensor_names_are_unique(name: str) -> None:
    """A sensor with the name of another parameter or a folder is refused."""
    assert refused(sensors=[name]).data['name'] == 'sensors'


def test_a_topic_has_one_sensor() -> None:
    """Two sensors of one topic would count its messages twice."""
    error = refused(sensors=['imu', 'second'], second__topics=['imu'])
    assert error.data['name'] == 'second.topics'
    assert 'imu.topics' in str(error)


def test_a_custom_sensor_takes_any_topic() -> None:
    """It is logged like a default sensor; integers are accepted for floats."""
    (sensor,) = load(sensors=['thermal'], thermal__topics=['thermal/raw'], thermal__rate_hz=2).sensors
    assert (sensor.name, sensor.topics, sensor.rate_hz, sensor.period_ns) == ('thermal', ('thermal/raw',), 2.0, 500_000_000)


def test_an_archive_needs_a_batch() -> None:
    """A zip or tar of single messages is refused."""
    error = refused(camera__format='zip')
    assert (error.data['name'], error.data['value']) == ('camera.batch_s', 0.0)
    assert load(camera__format='tar', camera__batch_s=1.0).sensors[0].batch_s == 1.0


def test_keys_are_as_fine_as_the_shortest_time_between_two_objects() -> None:
    """Keys have the resolution of the batch, or otherwise of the rate."""
    imu = {'imu__rate_hz': 0.0, 'imu__batch_s': 10.0}
    assert load(**imu).sensors[3].period_ns == 10_000_000_000
    assert load(imu__rate_hz=4.0, imu__batch_s=0.0).sensors[3].period_ns == 250_000_000
    assert load(imu__rate_hz=0.0, imu__batch_s=0.0).sensors[3].period_ns == 0


def test_parameters_of_ros_itself_are_not_ours() -> None:
    """Parameters that rclpy declares for every node are ignored."""
    assert load(use_sim_time=True, qos_overrides__imu__depth=5) == load()


ENVIRON = {
    'AWS_ENDPOINT_URL': 'http://tower:9000', 'AWS_ACCESS_KEY_ID': 'the-key-id', 'AWS_SECRET_ACCESS_KEY': 'the-secret',
    'AWS_SESSION_TOKEN': 'the-token', 'SHADOWHOUND_HOME': '/data/hound',
}  # fmt: skip


def test_the_environment_names_the_store() -> None:
    """Endpoint, credentials and folder."""
    settings = load(ENVIRON)
    assert settings.store.endpoint_url == 'http://tower:9000'
    assert (settings.store.access_key_id, settings.store.secret_access_key) == ('the-key-id', 'the-secret')
    assert settings.spool_path == Path('/data/hound/spool')


def test_secrets_are_not_shown() -> None:
    """No secret is in the text of the settings, which is logged."""
    for text in (repr(load(ENVIRON)), str(load(ENVIRON))):
        assert 'tower:9000' in text
        assert not any(secret in text for secret in ('the-key-id', 'the-secret', 'the-token'))


def test_an_endpoint_is_a_url() -> None:
    """An endpoint without a scheme is refused with its name."""
    with pytest.raises(SettingError, match=r"AWS_ENDPOINT_URL = 'tower:9000'.*http://SERVER:9000"):
        load({'AWS_ENDPOINT_URL': 'tower:9000'})


@pytest.mark.parametrize(
    'url',
    ['http://tower:9000 ', ' http://tower:9000', 'http://tower:9000\n', 'http://tower:9000?x=1', 'http://tower:9000/#a',
     'tower:9000', 'ftp://tower', 'http://', 'http://:9000', 'http://to wer', 'http://tower:99999', 'http://tower:1:2', 'http://[::1',
     'http://me:hunter2@tower'],
)  # fmt: skip
@pytest.mark.parametrize('name', ['AWS_ENDPOINT_URL', 'AWS_ENDPOINT_URL_S3'])
def test_an_endpoint_that_some_client_cannot_use_is_refused(name: str, url: str) -> None:
    """With the name of its variable, and without the password in it."""
    with pytest.raises(SettingError) as caught:
        load({name: url})
    assert caught.value.data['name'] == name
    assert 'hunter2' not in str(caught.value)


@pytest.mark.parametrize(
    ('environ', 'expected'),
    [({'AWS_ENDPOINT_URL': 'http://tower:9000/'}, 'http://tower:9000'),
     ({'AWS_ENDPOINT_URL': 'HTTPS://tower/s3//'}, 'HTTPS://tower/s3'),
     ({'AWS_ENDPOINT_URL': 'http://[fe80::1]:9000'}, 'http://[fe80::1]:9000'),
     ({'AWS_ENDPOINT_URL_S3': 'http://s3:9000'}, 'http://s3:9000'),
     ({'AWS_ENDPOINT_URL': 'http://all:1', 'AWS_ENDPOINT_URL_S3': 'http://s3:9000'}, 'http://s3:9000'),
     ({'AWS_ENDPOINT_URL': 'http://all:1', 'AWS_ENDPOINT_URL_S3': ''}, 'http://all:1'),
     ({'AWS_ENDPOINT_URL': '', 'AWS_ENDPOINT_URL_S3': ''}, None)],
)  # fmt: skip
def test_the_endpoint_is_chosen_by_precedence(environ: dict[str, str], expected: str | None) -> None:
    """AWS_ENDPOINT_URL_S3 before AWS_ENDPOINT_URL, as in botocore; trailing slashes are removed, an empty value is ignored."""
    assert load(environ).store.endpoint_url == expected


@pytest.mark.parametrize('value', ['the-secret ', 'the-secret\n', 'a b', 'se\u00fcret', '\u200bkey'])
@pytest.mark.parametrize('name', ['AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'AWS_SESSION_TOKEN'])
def test_a_key_with_a_blank_is_refused_and_not_shown(name: str, value: str) -> None:
    """It would be refused as a wrong signature, or be an invalid header."""
    with pytest.raises(SettingError, match='without blanks') as caught:
        load({**ENVIRON, name: value})
    assert caught.value.data['name'] == name
    assert value.strip() not in str(caught.value)


@pytest.mark.parametrize('name', ['AWS_REGION', 'AWS_DEFAULT_REGION'])
def test_a_region_with_a_blank_is_refused(name: str) -> None:
    """It is part of the signature."""
    with pytest.raises(SettingError, match=f"{name} = 'us-east-1 '"):
        load({name: 'us-east-1 '})
    assert load({name: 'eu-central-1'}).store.region == 'eu-central-1'


@pytest.mark.parametrize('given', ['lowstate', 'lowstate:', ':soc', 'lowstate:bms_state..soc', 'a b:c', 'a:b:c'])
def test_a_field_needs_a_topic_and_a_name(given: str) -> None:
    """The node reports at startup a field that cannot exist in a message."""
    error = refused(mission__battery=given)
    assert (error.data['name'], error.data['value']) == ('mission.battery', given)
    assert load(mission__battery='', mission__temperature='low/state:motor_state.0.temperature')


KNOWN = sorted(default_parameters())
CHOSEN = (
    '', '~nobody/x', '{robot}/{date}/{time}', '{robot[0]}/{date}/{time}', 'a/../b', '\0', '{robot}/{date!r}/{time:>9999999}',
    'json', 'camera', '\ud800', 'x' * 5000,
)  # fmt: skip
TEXT = st.one_of(st.text(max_size=30), st.sampled_from(CHOSEN))
NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([10**400, -(10**400), True, 2**63, -0.0]))
PLAIN = st.one_of(TEXT, NUMBERS, st.none(), st.binary(max_size=5))
VALUES = st.one_of(PLAIN, st.lists(PLAIN, max_size=4), st.lists(TEXT, max_size=4), st.dictionaries(TEXT, PLAIN, max_size=2))
NAMES = st.one_of(
    st.sampled_from(KNOWN),
    st.sampled_from(KNOWN).flatmap(lambda name: st.text(max_size=4).map(lambda tail: name + tail)),
    st.builds('{}.{}'.format, TEXT, st.sampled_from(['topics', 'key', 'rate_hz', ''])),
    TEXT,
)
VARIABLES = ('AWS_ENDPOINT_URL', 'AWS_REGION', 'AWS_SECRET_ACCESS_KEY', 'SHADOWHOUND_HOME', 'SHADOWHOUND_ROBOT')


def loaded(parameters: dict[str, Any], environ: dict[str, str], namespace: str = '/') -> Settings | None:
    """The settings; None if they were refused with the name of the invalid one, in printable text."""
    try:
        return Settings.load(parameters, environ, namespace)
    except SettingError as error:
        refusal = error
    assert 'name' in refusal.data
    assert refusal.data['allowed']
    assert str(refusal)
    return None


@settings(derandomize=True, deadline=None, max_examples=examples(400))
@given(st.dictionaries(NAMES, VALUES, max_size=4))
@example({'camera.rate_hz': 10**400})
@example({'spool.max_bytes': 10**400})
@example({'sensors': ['a'], 'a.topics': ['b'], 'a.key': '{robot}/{date}/{time}{sensor.name}'})
def test_any_accepted_parameters_work(parameters: dict[str, Any]) -> None:
    """Accepted parameters give safe keys at any time, and valid periods."""
    found = loaded(parameters, {})
    if found is None:
        return
    check_name(found.robot, 'the robot')
    for sensor in found.sensors:
        assert 0 <= sensor.period_ns <= 10**14
        for stamp_ns in (0, 1, 2**31 * SECOND, 2**32 * SECOND):
            key = KeyTemplate(sensor.key).render(robot=found.robot, sensor=sensor.name, stamp_ns=stamp_ns,
                                                 period_ns=sensor.period_ns, ext='json')  # fmt: skip
            assert check_key(key).startswith(f'{found.robot}/')


@settings(derandomize=True, deadline=None, max_examples=examples(200))
@given(st.dictionaries(st.sampled_from(VARIABLES), TEXT, max_size=5), TEXT)
@example({'SHADOWHOUND_HOME': '~nobody-of-this-name/x'}, '/')
def test_any_accepted_environment_works(environ: dict[str, str], namespace: str) -> None:
    """An accepted environment has an absolute folder and a valid robot name."""
    found = loaded({}, environ, namespace)
    if found is not None:
        assert found.spool_path.is_absolute()
        check_name(found.robot, 'the robot')


@settings(derandomize=True, deadline=None, max_examples=examples(600))
@given(name=st.sampled_from(KNOWN), value=VALUES)
def test_each_parameter_takes_a_value_or_refuses_it_by_name(name: str, value: Any) -> None:
    """The error names the parameter itself, or the one that depends on it."""
    found: Settings | SettingError
    try:
        found = Settings.load({name: value}, {}, '/')
    except SettingError as error:
        found = error
    groups = {name.partition('.')[0], 'sensors', *(map(str, value) if isinstance(value, list) else ())}
    assert isinstance(found, Settings) or str(found.data['name']).partition('.')[0] in groups
