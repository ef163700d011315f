"""Frozen settings, validated once. ROS parameters and environment variables end here: nobody else reads either.

``Settings.load(parameters, environ)`` takes flat, dotted ROS parameter names (``camera.rate_hz``). The defaults of this
module are what the node does with nothing set; ``launch_configs/go2.yaml`` spells them out (a test compares the two).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.errors import NameRefused, SettingError
from shadowhound_data_logger.keys import KeyTemplate, check_name

MEBI: Final = 1 << 20
GIBI: Final = 1 << 30
MIN_RATE_HZ: Final = 1e-4
"""A message every three hours."""
_BUCKET: Final = re.compile(r'[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]')
"""https://docs.aws.amazon.com/AmazonS3/latest/userguide/bucketnamingrules.html"""
FORMATS: Final = ('jpeg', 'pcd', 'json')
COMPRESSED_IMAGE: Final = 'sensor_msgs/msg/CompressedImage'
IMAGE: Final = 'sensor_msgs/msg/Image'
POINT_CLOUD: Final = 'sensor_msgs/msg/PointCloud2'


def _setting(default: Any, text: str, *, low: float | None = None, high: float | None = None,
             choices: Sequence[str] = ()) -> Any:  # fmt: skip
    """A dataclass field that knows its help text and what values it allows."""
    metadata = {'help': text, 'low': low, 'high': high, 'choices': tuple(choices)}
    if isinstance(default, (tuple, list)):
        return field(default_factory=lambda: tuple(default), metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSettings:
    """One sensor: the topic it is taken from, what is kept of it, and what becomes of that."""

    name: str
    enabled: bool = _setting(True, 'Log this sensor.')
    topics: tuple[str, ...] = _setting((), 'Topics it can come from, the preferred one first; relative to the namespace.')
    types: tuple[str, ...] = _setting((), 'Expected type of each topic; a publisher that exists overrides it.')
    rate_hz: float = _setting(1.0, 'Keep the first message of each whole period; 0 keeps every message.', low=0.0, high=1e6)
    on_change: bool = _setting(False, 'Keep a message only when its content (but its stamp) differs from the last one kept.')
    batch_s: float = _setting(0.0, 'Seconds of messages an object; 0 makes one object of each message.', low=0.0, high=3600.0)
    format: str = _setting('json', 'What an object is encoded as.', choices=FORMATS)
    quality: int = _setting(85, 'JPEG quality where an image has to be encoded.', low=1, high=100)
    bucket: str = _setting('sensor-data', 'Bucket of its objects.')
    key: str = _setting('{robot}/{sensor}/{date}/{time}_{sensor}.{ext}', 'Key of an object; {date} and {time} are UTC.')
    priority: int = _setting(5, '0 ships first and is dropped or evicted last, 9 the other way round.', low=0, high=9)

    @property
    def period_ns(self) -> int:
        """The time between two objects as far as their names go, ns; 0 where every message is one."""
        if self.batch_s:
            return round(self.batch_s * 1e9)
        if self.on_change:
            return SECOND
        return round(1e9 / self.rate_hz) if self.rate_hz else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class IntakeSettings:
    """The polled reader (D1)."""

    poll_s: float = _setting(0.05, 'Seconds between two drains of the subscriptions.', low=0.005, high=1.0)
    history_bytes: int = _setting(32 * MEBI, 'Most bytes one subscription may hold between two drains.', low=MEBI)
    max_rate_hz: float = _setting(2000.0, 'Rate for which the history of small messages is sized.', low=1.0, high=1e5)


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueSettings:
    """The bounded queue between intake and the encode pool."""

    max_bytes: int = _setting(64 * MEBI, 'Most bytes waiting for an encoder; beyond it the lowest priority is dropped.', low=MEBI)
    max_messages: int = _setting(50_000, 'Most messages waiting for an encoder.', low=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeSettings:
    """The encode pool."""

    threads: int = _setting(2, 'Encoder threads.', low=1, high=32)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpoolSettings:
    """The durable spool (D5, D9)."""

    commit_s: float = _setting(0.25, 'Longest time between an encoded object and its group commit.', low=0.01, high=10.0)
    max_bytes: int = _setting(20 * GIBI, 'Most bytes of payload in the spool; beyond it the least important is evicted.', low=MEBI)
    min_free_bytes: int = _setting(2 * GIBI, 'Free space of the file system that is never used.', low=0)
    remember_days: float = _setting(3.0, 'Days for which delivered keys are remembered.', low=1.0, high=3650.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class UploadSettings:
    """Delivery (D7, D8)."""

    threads: int = _setting(4, 'Upload threads.', low=1, high=64)
    connect_timeout_s: float = _setting(5.0, 'Seconds to wait for a connection.', low=0.1, high=60.0)
    read_timeout_s: float = _setting(30.0, 'Seconds to wait for an answer.', low=0.1, high=600.0)
    backoff_s: float = _setting(60.0, 'Longest pause between two tries while the store is away.', low=0.1, high=3600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutdownSettings:
    """What a SIGINT or SIGTERM may take."""

    drain_s: float = _setting(3.0, 'Seconds to go on delivering after the open batches are closed.', low=0.0, high=600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreSettings:
    """Where objects go: an S3 server, or without an endpoint a folder of the same layout (D13)."""

    endpoint_url: str | None = None
    access_key_id: str | None = field(default=None, repr=False)
    secret_access_key: str | None = field(default=None, repr=False)
    session_token: str | None = field(default=None, repr=False)
    region: str = 'us-east-1'
    directory: Path = Path('store')


_GROUPS: Final[dict[str, type]] = {
    'intake': IntakeSettings,
    'queue': QueueSettings,
    'encode': EncodeSettings,
    'spool': SpoolSettings,
    'upload': UploadSettings,
    'shutdown': ShutdownSettings,
}
FOREIGN: Final = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
"""Parameters that rclpy itself declares; they are not ours to judge."""

DEFAULT_SENSORS: Final[dict[str, dict[str, Any]]] = {
    'camera': {
        'topics': ('camera/compressed', 'camera/image_raw'), 'types': (COMPRESSED_IMAGE, IMAGE), 'format': 'jpeg',
        'key': '{robot}/camera/{date}/{time}_front.{ext}', 'priority': 6,
    },
    'camera_info': {
        'topics': ('camera/camera_info',), 'types': ('sensor_msgs/msg/CameraInfo',), 'rate_hz': 0.0, 'on_change': True,
        'key': '{robot}/camera_info/{date}/{time}_front.{ext}', 'priority': 2,
    },
    'lidar': {
        'topics': ('point_cloud2',), 'types': (POINT_CLOUD,), 'format': 'pcd',
        'key': '{robot}/lidar/{date}/{time}_scan.{ext}', 'priority': 7,
    },
    'imu': {'topics': ('imu',), 'types': ('go2_interfaces/msg/IMU',), 'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 4},
    'odom': {'topics': ('odom',), 'types': ('nav_msgs/msg/Odometry',), 'priority': 3},
    'states': {'topics': ('go2_states',), 'types': ('go2_interfaces/msg/Go2State',), 'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 3},
    'joints': {'topics': ('joint_states',), 'types': ('sensor_msgs/msg/JointState',), 'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 4},
    'lowstate': {'topics': ('lowstate',), 'types': ('go2_interfaces/msg/LowState',), 'batch_s': 10.0, 'priority': 3},
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything that can be set, once it has been checked."""

    robot: str
    home: Path
    sensors: tuple[SensorSettings, ...]
    store: StoreSettings
    intake: IntakeSettings = IntakeSettings()
    queue: QueueSettings = QueueSettings()
    encode: EncodeSettings = EncodeSettings()
    spool: SpoolSettings = SpoolSettings()
    upload: UploadSettings = UploadSettings()
    shutdown: ShutdownSettings = ShutdownSettings()

    @property
    def spool_path(self) -> Path:
        return self.home / 'spool'

    @classmethod
    def load(cls, parameters: Mapping[str, Any], environ: Mapping[str, str], namespace: str = '/') -> Settings:
        """Raises SettingError (unknown or wrong parameter or variable) naming it, its value and what is allowed."""
        given = {name: value for name, value in parameters.items() if name.split('.')[0] not in FOREIGN}
        robot = _robot(given.pop('robot', ''), environ, namespace)
        sensors = _sensors(given, robot)
        groups = {name: _fill(kind, name, given) for name, kind in _GROUPS.items()}
        if given:
            name, value = next(iter(given.items()))
            known = sorted({'robot', 'sensors', *_GROUPS, *(sensor.name for sensor in sensors)})
            raise SettingError(name, value, f'only a known name: {_near(name, sensors, known)}')
        folder = home(environ)
        return cls(robot=robot, home=folder, sensors=sensors, store=store_settings(environ, folder), **groups)


def home(environ: Mapping[str, str]) -> Path:
    """The folder of the spool and, without a server, of the store: SHADOWHOUND_HOME, else ``~/.shadowhound``."""
    return Path(environ.get('SHADOWHOUND_HOME') or '~/.shadowhound').expanduser().absolute()


def store_settings(environ: Mapping[str, str], folder: Path) -> StoreSettings:
    """The store the environment names; raises SettingError for an endpoint that is no http(s) URL."""
    endpoint = environ.get('AWS_ENDPOINT_URL') or None
    if endpoint and (not endpoint.startswith(('http://', 'https://')) or '@' in endpoint):
        shown = endpoint if '@' not in endpoint else '(not shown: it may hold a password)'
        raise SettingError('AWS_ENDPOINT_URL', shown, 'a URL such as http://TOWER_IP:9000, without user and password')
    return StoreSettings(
        endpoint_url=endpoint,
        access_key_id=environ.get('AWS_ACCESS_KEY_ID') or None,
        secret_access_key=environ.get('AWS_SECRET_ACCESS_KEY') or None,
        session_token=environ.get('AWS_SESSION_TOKEN') or None,
        region=environ.get('AWS_REGION') or environ.get('AWS_DEFAULT_REGION') or 'us-east-1',
        directory=folder / 'store',
    )


def default_parameters() -> dict[str, Any]:
    """Every parameter with its default, as flat ROS names; sequences as lists."""
    flat: dict[str, Any] = {'robot': '', 'sensors': list(DEFAULT_SENSORS)}
    for name, kind in _GROUPS.items():
        flat |= {f'{name}.{spec.name}': spec.default for spec in fields(kind)}
    for sensor in _sensors({}, 'thor'):
        for spec in fields(sensor)[1:]:
            value = getattr(sensor, spec.name)
            flat[f'{sensor.name}.{spec.name}'] = list(value) if isinstance(value, tuple) else value
    return flat


def _robot(given: object, environ: Mapping[str, str], namespace: str) -> str:
    """The parameter, else SHADOWHOUND_ROBOT, else the node's namespace, else ``thor``."""
    if not isinstance(given, str):
        raise SettingError('robot', given, 'a string')
    name = given or environ.get('SHADOWHOUND_ROBOT') or namespace.strip('/').replace('/', '_') or 'thor'
    try:
        return check_name(name, 'the robot name')
    except NameRefused as error:
        raise SettingError('robot', name, error.remedy) from error


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
                raise SettingError(f'{sensor.name}.topics', list(sensor.topics), f'a topic that is not {owners[topic]}.topics already')
            owners[topic] = sensor.name
    return sensors


def _sensor(name: str, given: dict[str, Any], robot: str) -> SensorSettings:
    if name in {'robot', 'sensors', *_GROUPS, *FOREIGN}:
        raise SettingError('sensors', name, 'names that are not those of other parameters')
    try:
        check_name(name, 'the sensor name')
    except NameRefused as error:
        raise SettingError('sensors', name, error.remedy) from error
    sensor: SensorSettings = _fill(SensorSettings, name, given, {'name': name, **DEFAULT_SENSORS.get(name, {})})
    if not sensor.topics or not all(sensor.topics):
        raise SettingError(f'{name}.topics', list(sensor.topics), 'at least one topic')
    if len(sensor.types) > len(sensor.topics):
        raise SettingError(f'{name}.types', list(sensor.types), 'at most one type for each topic')
    if sensor.batch_s and sensor.format != 'json':
        raise SettingError(f'{name}.batch_s', sensor.batch_s, f'0 with format {sensor.format!r}: only json objects hold several messages')
    if 0 < sensor.rate_hz < MIN_RATE_HZ:
        raise SettingError(f'{name}.rate_hz', sensor.rate_hz, f'0, or at least {MIN_RATE_HZ}')
    try:
        KeyTemplate.parse(sensor.key, f'{name}.key').render(robot=robot, sensor=name, stamp_ns=0, period_ns=0, ext='json')
    except NameRefused as error:
        raise SettingError(f'{name}.key', sensor.key, f'a key of safe length ({error})') from error
    if not _BUCKET.fullmatch(sensor.bucket) or '..' in sensor.bucket:
        raise SettingError(f'{name}.bucket', sensor.bucket, 'a bucket name: 3 to 63 lower-case letters, digits, "-" and "."')
    return sensor


def _fill(kind: type, prefix: str, given: dict[str, Any], defaults: Mapping[str, Any] | None = None) -> Any:
    """An instance of a settings class from ``prefix.field`` entries, which it takes out of ``given``."""
    values = dict(defaults or {})
    for spec in fields(kind):
        name = f'{prefix}.{spec.name}'
        if spec.name != 'name' and name in given:
            default = spec.default if spec.default is not MISSING else ()
            values[spec.name] = _check(name, given.pop(name), default, spec.metadata)
    return kind(**values)


def _check(name: str, value: Any, default: Any, metadata: Mapping[str, Any]) -> Any:
    """The value in the field's own type; raises SettingError."""
    low, high, choices = metadata['low'], metadata['high'], metadata['choices']
    if isinstance(default, tuple):
        if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(part, str) for part in value):
            raise SettingError(name, value, 'a list of strings')
        return tuple(value)
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


def _near(name: str, sensors: Sequence[SensorSettings], known: list[str]) -> str:
    """The names that could have been meant: those of the same group, else the groups."""
    prefix = name.split('.')[0]
    kind = _GROUPS.get(prefix) or (SensorSettings if prefix in {sensor.name for sensor in sensors} else None)
    if kind is None:
        return ', '.join(known)
    return ', '.join(f'{prefix}.{spec.name}' for spec in fields(kind) if spec.name != 'name')
