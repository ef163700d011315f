"""Settings, frozen and validated once. Only this module reads ROS parameters and environment variables.

``Settings.load(parameters, environ)`` takes flat, dotted ROS parameter names (``camera.rate_hz``). The defaults are in
``options``; ``launch_configs/go2.yaml`` spells them out (a test compares the two).
"""

from __future__ import annotations

import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import NameRefused, SettingError
from shadowhound_data_logger.core.expression import conditions
from shadowhound_data_logger.core.keys import KeyTemplate, check_name
from shadowhound_data_logger.core.options import (
    ARCHIVES,
    AUTO,
    BATCHED,
    DEFAULT_SENSORS,
    FORMATS,
    GROUPS,
    NAMED,
    BagSettings,
    CaptureSettings,
    CatalogSettings,
    ClockSettings,
    EventSettings,
    KeepSettings,
    MissionSettings,
    QueueSettings,
    SensorSettings,
    ShutdownSettings,
    SpoolSettings,
    StoreSettings,
    UploadSettings,
)
from shadowhound_data_logger.core.rules import read_rule

__all__ = [
    'DEFAULT_SENSORS',
    'FORMATS',
    'NOT_SETTINGS',
    'BagSettings',
    'CaptureSettings',
    'CatalogSettings',
    'ClockSettings',
    'EventSettings',
    'KeepSettings',
    'MissionSettings',
    'QueueSettings',
    'SensorSettings',
    'Settings',
    'ShutdownSettings',
    'SpoolSettings',
    'StoreSettings',
    'UploadSettings',
    'default_parameters',
    'default_robot',
    'endpoint_url',
    'has_go2_messages',
    'home',
    'store_settings',
]  # fmt: skip

DEFAULT_ROBOT: Final = 'thor'
"""The name of a Go2 in the documentation, and of its folder in the bucket."""
GO2_PACKAGES: Final = ('go2_interfaces', 'unitree_go')
"""Message packages of a Go2's driver, and of the robot itself."""
MIN_RATE_HZ: Final = 1e-4
"""A message every three hours."""
MAX_INT: Final = (1 << 63) - 1
"""The maximum of a ROS integer parameter."""
_FIELD: Final = re.compile(r'[^:\s]+:[A-Za-z]\w*(\.\w+)*', re.ASCII)
"""A number in the field's path is an array index: lowstate:motor_state.0.temperature."""
_TYPE: Final = re.compile(r'[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*', re.ASCII)
_BUCKET: Final = re.compile(r'[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]')
"""https://docs.aws.amazon.com/AmazonS3/latest/userguide/bucketnamingrules.html"""
ENDPOINTS: Final = ('AWS_ENDPOINT_URL_S3', 'AWS_ENDPOINT_URL')
"""The first that is set, as in botocore (https://docs.aws.amazon.com/sdkref/latest/guide/feature-ss-endpoints.html)."""
NOT_SHOWN: Final = '(not shown: it may hold a secret)'
MAX_PORT: Final = 65_535
_ENDPOINT: Final = re.compile(
    r'https?://([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(:(?P<port>[0-9]{1,5}))?(/[A-Za-z0-9._~%/-]*)?', re.IGNORECASE
)
_REGION: Final = re.compile(r'[A-Za-z0-9_-]+')
_VISIBLE: Final = re.compile(r'[!-~]*')
NOT_SETTINGS: Final = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
"""Parameters that rclpy itself declares; they are ignored here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All settings, validated."""

    robot: str
    home: Path
    sensors: tuple[SensorSettings, ...]
    assumed: frozenset[str]
    """Sensors that no parameter mentions: the default ones, which are those of a Unitree."""
    store: StoreSettings
    capture: CaptureSettings
    queue: QueueSettings
    spool: SpoolSettings
    keep: KeepSettings
    upload: UploadSettings
    shutdown: ShutdownSettings
    clock: ClockSettings
    mission: MissionSettings
    bag: BagSettings
    events: EventSettings
    catalog: CatalogSettings

    @property
    def spool_path(self) -> Path:
        return self.home / 'spool'

    @classmethod
    def load(cls, parameters: Mapping[str, Any], environ: Mapping[str, str], namespace: str = '/') -> Settings:
        """Raises SettingError for an unknown or invalid parameter or variable."""
        given = {name: value for name, value in parameters.items() if name.split('.')[0] not in NOT_SETTINGS}
        robot = _robot(given.pop('robot', ''), environ, namespace)
        is_listed = 'sensors' in given
        assumed = frozenset() if is_listed else DEFAULT_SENSORS.keys() - {name.partition('.')[0] for name in given}
        sensors = _sensors(given, robot)
        groups: dict[str, Any] = {name: _fill(kind, name, given) for name, kind in GROUPS.items()}
        if groups['capture'].topics == AUTO and is_listed:
            groups['capture'] = replace(groups['capture'], topics=NAMED)
        _check_fields(groups['mission'])
        _check_expressions('bag', groups['bag'], ('regex', 'exclude'))
        _check_events(groups['events'])
        for name in ('upload', 'keep', 'events'):
            read_rule(groups[name].when, f'{name}.when')
        if given:
            name, value = next(iter(given.items()))
            raise SettingError(name, value, f'only a known name: {_suggestions(name, sensors)}')
        folder = home(environ)
        return cls(
            robot=robot, home=folder, sensors=sensors, assumed=frozenset(assumed), store=store_settings(environ, folder), **groups
        )


def home(environ: Mapping[str, str]) -> Path:
    """The folder of the spool and, without a server, of the store: SHADOWHOUND_HOME, otherwise ``~/.shadowhound``.

    Raises SettingError if it names the home of an unknown user.
    """
    given = environ.get('SHADOWHOUND_HOME') or '~/.shadowhound'
    try:
        return Path(given).expanduser().absolute()
    except RuntimeError as error:
        raise SettingError('SHADOWHOUND_HOME', given, 'a folder, not the home of an unknown user') from error


def store_settings(environ: Mapping[str, str], folder: Path) -> StoreSettings:
    """The store that the environment names. Raises SettingError for a value that no S3 client can use."""
    endpoint, s3_endpoint = environ.get('AWS_ENDPOINT_URL'), environ.get('AWS_ENDPOINT_URL_S3')
    region, other_region = environ.get('AWS_REGION'), environ.get('AWS_DEFAULT_REGION')
    for name, value in (('AWS_REGION', region), ('AWS_DEFAULT_REGION', other_region)):
        if value and not _REGION.fullmatch(value):
            raise SettingError(name, value, 'the name of a region, such as us-east-1, without blanks')
    return StoreSettings(
        endpoint_url=endpoint_url(s3_endpoint, ENDPOINTS[0]) if s3_endpoint else endpoint_url(endpoint) if endpoint else None,
        access_key_id=_key('AWS_ACCESS_KEY_ID', environ.get('AWS_ACCESS_KEY_ID')),
        secret_access_key=_key('AWS_SECRET_ACCESS_KEY', environ.get('AWS_SECRET_ACCESS_KEY')),
        session_token=_key('AWS_SESSION_TOKEN', environ.get('AWS_SESSION_TOKEN')),
        region=region or other_region or 'us-east-1',
        directory=folder / 'store',
    )


def _key(name: str, value: str | None) -> str | None:
    """Raises SettingError for a blank: it would make the signature wrong, or is not allowed in a header."""
    if not _VISIBLE.fullmatch(value or ''):
        raise SettingError(name, NOT_SHOWN, 'ASCII without blanks; does the line in the file of variables end with one?')
    return value or None


def endpoint_url(given: str, name: str = ENDPOINTS[1]) -> str:
    """The URL of an S3 server, without trailing slashes. Raises SettingError for a URL that not all S3 clients can use.

    Clients differ in how they handle a blank, a query or a user name: botocore refuses some, obstore panics.
    """
    match = _ENDPOINT.fullmatch(given)
    if match is None or int(match['port'] or 0) > MAX_PORT:
        shown = given if '@' not in given else NOT_SHOWN
        raise SettingError(name, shown, 'a URL such as http://SERVER:9000, without blanks, user, password and query')
    return given.rstrip('/')


def default_parameters() -> dict[str, Any]:
    """Every parameter with its default, as flat ROS names; sequences as lists."""
    flat: dict[str, Any] = {'robot': '', 'sensors': list(DEFAULT_SENSORS)}
    for name, kind in GROUPS.items():
        flat |= {f'{name}.{spec.name}': _listed(spec.default) for spec in fields(kind) if spec.metadata}
    for sensor in _sensors({}, 'thor'):
        flat |= {f'{sensor.name}.{spec.name}': _listed(getattr(sensor, spec.name)) for spec in fields(sensor) if spec.metadata}
    return flat


def _listed(value: Any) -> Any:
    """The value as in a parameter file."""
    return list(value) if isinstance(value, tuple) else value


def has_go2_messages(environ: Mapping[str, str]) -> bool:
    """Whether a message package of a Go2 is sourced."""
    shares = [Path(prefix) / 'share' for prefix in environ.get('AMENT_PREFIX_PATH', '').split(':') if prefix]
    return any((share / package).is_dir() for share in shares for package in GO2_PACKAGES)


def default_robot(environ: Mapping[str, str], namespace: str = '/') -> str:
    """The default name of the robot: the namespace, ``thor`` if the messages of a Go2 are installed, otherwise the host name."""
    if name := namespace.strip('/').replace('/', '_'):
        return name
    if has_go2_messages(environ):
        return DEFAULT_ROBOT
    return re.sub(r'[^A-Za-z0-9_-]', '_', socket.gethostname()).strip('_-') or 'robot'


def _robot(given: object, environ: Mapping[str, str], namespace: str) -> str:
    """The parameter, otherwise SHADOWHOUND_ROBOT, otherwise ``default_robot``."""
    if not isinstance(given, str):
        raise SettingError('robot', given, 'a string')
    variable = environ.get('SHADOWHOUND_ROBOT')
    name = given or variable or default_robot(environ, namespace)
    try:
        return check_name(name, 'the robot name')
    except NameRefused as error:
        setting = 'SHADOWHOUND_ROBOT' if variable and not given else 'robot'
        raise SettingError(setting, name, f'a name: {error.remedy}') from error


def _sensors(given: dict[str, Any], robot: str) -> tuple[SensorSettings, ...]:
    names = given.pop('sensors', list(DEFAULT_SENSORS))
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise SettingError('sensors', names, 'a list of names')
    if len(set(names)) != len(names):
        raise SettingError('sensors', names, 'a list of names, each once')
    sensors = tuple(_sensor(name, given, robot) for name in names)
    owners: dict[str, str] = {}
    for sensor in sensors:
        for topic in sensor.topics:
            if topic in owners:
                text = f'a topic that is not in {owners[topic]}.topics already'
                raise SettingError(f'{sensor.name}.topics', list(sensor.topics), text)
            owners[topic] = sensor.name
    return sensors


def _sensor(name: str, given: dict[str, Any], robot: str) -> SensorSettings:
    if name in {'robot', 'sensors', *GROUPS, *NOT_SETTINGS}:
        raise SettingError('sensors', name, 'names that are not those of other parameters')
    try:
        check_name(name, 'the sensor name')
    except NameRefused as error:
        raise SettingError('sensors', name, f'a name: {error.remedy}') from error
    names_types = f'{name}.types' in given
    sensor: SensorSettings = _fill(SensorSettings, name, given, {'name': name, **DEFAULT_SENSORS.get(name, {})})
    if not names_types:  # the types of the default topics; the settings may name fewer topics
        sensor = replace(sensor, types=sensor.types[: len(sensor.topics)])
    if not sensor.topics or not all(sensor.topics):
        raise SettingError(f'{name}.topics', list(sensor.topics), 'at least one topic')
    if len(sensor.types) > len(sensor.topics):
        raise SettingError(f'{name}.types', list(sensor.types), 'at most one type for each topic')
    _check_batches(sensor)
    if 0 < sensor.rate_hz < MIN_RATE_HZ:
        raise SettingError(f'{name}.rate_hz', sensor.rate_hz, f'0, or at least {MIN_RATE_HZ}')
    try:
        KeyTemplate.parse(sensor.key, f'{name}.key').render(robot=robot, sensor=name, stamp_ns=0, period_ns=0, ext='json')
    except NameRefused as error:
        raise SettingError(f'{name}.key', sensor.key, f'a key of safe length ({error})') from error
    if not _BUCKET.fullmatch(sensor.bucket) or '..' in sensor.bucket:
        raise SettingError(f'{name}.bucket', sensor.bucket, 'a bucket name: 3 to 63 lower-case letters, digits, "-" and "."')
    return sensor


def _check_batches(sensor: SensorSettings) -> None:
    """Raises SettingError if format and batch length contradict each other."""
    text = f'0 with format {sensor.format!r}: only {", ".join(BATCHED)} objects hold several messages'
    if sensor.batch_s and sensor.format not in BATCHED:
        raise SettingError(f'{sensor.name}.batch_s', sensor.batch_s, text)
    if sensor.format in ARCHIVES and not sensor.batch_s:
        text = f'more than 0 with format {sensor.format!r}: an archive holds several messages'
        raise SettingError(f'{sensor.name}.batch_s', sensor.batch_s, text)


def _check_fields(mission: MissionSettings) -> None:
    """Raises SettingError for a value that is not a topic with a field."""
    for name in ('battery', 'temperature'):
        given = getattr(mission, name)
        if given and not all(map(_FIELD.fullmatch, given.split('|'))):
            raise SettingError(f'mission.{name}', given, "empty, or 'topic:field' such as lowstate:bms_state.soc")


def is_type(source: str) -> bool:
    """Whether an alternative in a mission's setting is a message type, which selects every topic of that type."""
    return _TYPE.fullmatch(source) is not None


def fields_of(given: str) -> list[tuple[str, list[str]]]:
    """(topic or type, path of the field) of each alternative in a mission's setting, the preferred one first."""
    pairs = (each.partition(':') for each in given.split('|') if each)
    return [(topic, field.split('.')) for topic, _, field in pairs]


def _check_expressions(prefix: str, group: BagSettings | EventSettings, names: Sequence[str]) -> None:
    """Raises SettingError for an invalid regular expression."""
    for name in names:
        given = getattr(group, name)
        try:
            re.compile(given)
        except re.error as error:
            raise SettingError(f'{prefix}.{name}', given, f'a regular expression ({error})') from error


def _check_events(events: EventSettings) -> None:
    """Raises SettingError for invalid conditions, or conditions that would trigger nothing."""
    _check_expressions('events', events, ('regex', 'exclude', 'log_event'))
    if conditions(events.conditions) and not events.enabled:
        allowed = 'an empty list while events.topics and events.regex name nothing'
        raise SettingError('events.conditions', list(events.conditions), allowed)
    if events.max_s < events.post_s:
        raise SettingError('events.max_s', events.max_s, f'at least events.post_s ({events.post_s:g})')


def _fill(kind: type, prefix: str, given: dict[str, Any], defaults: Mapping[str, Any] | None = None) -> Any:
    """An instance of a settings class from ``prefix.field`` entries, which it removes from ``given``."""
    values = dict(defaults or {})
    for spec in fields(kind):
        name = f'{prefix}.{spec.name}'
        if spec.metadata and name in given:
            default = spec.default if spec.default is not MISSING else ()
            values[spec.name] = _check(name, given.pop(name), default, spec.metadata)
    return kind(**values)


def _check(name: str, value: Any, default: Any, metadata: Mapping[str, Any]) -> Any:
    """The value in the type of its field; raises SettingError."""
    low, high, choices = metadata['low'], metadata['high'], metadata['choices']
    if isinstance(default, tuple):
        if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(part, str) for part in value):
            raise SettingError(name, value, 'a list of strings')
        return tuple(value)
    if isinstance(value, int) and abs(value) > MAX_INT:
        raise SettingError(name, value, 'a number of 64 bits')
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a string'}[type(default)]
        raise SettingError(name, value, kind)
    if choices and value not in choices:
        raise SettingError(name, value, 'one of ' + ', '.join(choices))
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        span = f'at least {low:g}' if high is None else f'{low:g} to {high:g}'
        raise SettingError(name, value, f'a number, {span}')
    return value


def _suggestions(name: str, sensors: Sequence[SensorSettings]) -> str:
    """Suggestions for an unknown name: the names in the same group, otherwise the groups, and how to add a sensor."""
    prefix, dot, last = name.partition('.')
    names = {sensor.name for sensor in sensors}
    kind = GROUPS.get(prefix) or (SensorSettings if prefix in names else None)
    if kind is None:
        known = ', '.join(sorted({'robot', 'sensors', *GROUPS, *names}))
        is_of_sensor = dot and last in {spec.name for spec in fields(SensorSettings) if spec.metadata}
        return f"{known}; if {prefix} is a sensor, add it to 'sensors'" if is_of_sensor else known
    return ', '.join(f'{prefix}.{spec.name}' for spec in fields(kind) if spec.metadata)
