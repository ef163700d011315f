"""All settings, with default, bounds and help text. Values only: ``config`` reads and checks them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND

MEBI: Final = 1 << 20
GIBI: Final = 1 << 30
FORMATS: Final = ('jpeg', 'png', 'pcd', 'json', 'cdr', 'zip', 'tar')
ARCHIVES: Final = ('zip', 'tar')
"""Formats with one file per message; they require batches."""
BATCHED: Final = ('json', *ARCHIVES)
"""Formats that can hold several messages."""
CAPTURES: Final = ('always', 'mission')
RECORDS: Final = ('service', 'mission', 'always')
ALWAYS, ON_REQUEST = 'always', 'on_request'
SHIPS: Final = (ALWAYS, ON_REQUEST)
COMPRESSIONS: Final = ('zstd', 'none')
RMW_AUTO, RMW_ROBOT, RMW_FASTRTPS = 'auto', 'robot', 'fastrtps'
AUTO, NAMED, ALL = 'auto', 'sensors', 'all'
"""Which topics are logged."""
COMPRESSED_IMAGE: Final = 'sensor_msgs/msg/CompressedImage'
IMAGE: Final = 'sensor_msgs/msg/Image'
POINT_CLOUD: Final = 'sensor_msgs/msg/PointCloud2'
BULK: Final = frozenset({COMPRESSED_IMAGE, IMAGE, POINT_CLOUD})
"""Types whose single message is as large as hundreds of others."""


def _setting(default: Any, text: str, *, low: float | None = None, high: float | None = None,
             choices: Sequence[str] = (), live: bool = False) -> Any:  # fmt: skip
    """A dataclass field with its help text, the values it allows, and whether it can be changed while the node runs."""
    metadata = {'help': text, 'low': low, 'high': high, 'choices': tuple(choices), 'live': live}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSettings:
    """One sensor: its topics, what is kept of them, and how that is stored."""

    name: str
    enabled: bool = _setting(True, 'Log this sensor.', live=True)
    topics: tuple[str, ...] = _setting((), 'Its topics, the preferred one first; relative to the namespace.')
    types: tuple[str, ...] = _setting(
        (),
        'Type of each topic, alternatives separated by |; others are not logged. Empty: the first that is published.',
    )
    rate_hz: float = _setting(
        1.0, 'Keep the first message of each whole period; 0 keeps every message.', low=0.0, high=1e6, live=True
    )
    on_change: bool = _setting(False, 'Keep only messages whose content, apart from the stamp, changed.')
    batch_s: float = _setting(0.0, 'Seconds of messages per object; 0: one message.', low=0.0, high=3600.0)
    format: str = _setting('json', 'File format of an object; zip and tar hold several messages.', choices=FORMATS)
    quality: int = _setting(85, 'JPEG quality if an image must be encoded.', low=1, high=100, live=True)
    bucket: str = _setting('sensor-data', 'Bucket of its objects.')
    key: str = _setting('{robot}/{sensor}/{date}/{time}_{sensor}.{ext}', 'Key of an object; {date} and {time} are UTC.')
    dedup: bool = _setting(False, 'Store content that repeats byte for byte once; repeats stay in the catalog.')
    priority: int = _setting(
        5, '0 is uploaded first and dropped or evicted last; 9 is uploaded last and evicted first.', low=0, high=9, live=True
    )
    expected_hz: float = _setting(
        0.0, 'Published rate, to estimate losses where messages have no numbers; 0 learns it.', low=0.0, high=1e5
    )
    ship: str = _setting(ALWAYS, 'Upload its objects always, or keep them until they are requested.', choices=SHIPS)
    counter: str = _setting('', 'Field that counts messages or milliseconds, such as tick, to estimate losses from.')

    statistics: tuple[str, ...] = _setting(
        ('',), 'Fields with statistics, such as bms_state.soc; empty: the first 64; "none": none.'
    )

    @property
    def period_ns(self) -> int:
        """Time between two objects as far as their names are concerned, ns; 0 if any distance is possible."""
        if self.batch_s:
            return round(self.batch_s * 1e9)
        if self.on_change:
            return SECOND
        return round(1e9 / self.rate_hz) if self.rate_hz else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureSettings:
    """How the node takes part in ROS."""

    rmw: str = _setting(
        RMW_AUTO,
        "RMW to listen with: the robot's own, fastrtps, or auto (fastrtps where that receives as much as Cyclone DDS).",
        choices=(RMW_AUTO, RMW_ROBOT, RMW_FASTRTPS),
    )
    topics: str = _setting(
        AUTO,
        'sensors: only their topics; all: also any topic whose type has a rule; auto: all, unless sensors are listed or the '
        'robot is a Unitree.',
        choices=(AUTO, NAMED, ALL),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueSettings:
    """The bounded queue between intake and the encode pool."""

    max_bytes: int = _setting(
        64 * MEBI, 'Memory for messages that wait for an encoder; beyond it those of the lowest priority are dropped.', low=MEBI
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpoolSettings:
    """The durable spool."""

    max_bytes: int = _setting(
        20 * GIBI, 'Maximum bytes of objects in the spool; beyond it the least important are evicted.', low=MEBI
    )
    min_free_bytes: int = _setting(2 * GIBI, 'Free space to leave on the disk.', low=0)
    remember_days: float = _setting(
        2.0,
        'Days to remember delivered objects, for ledger --verify and the live page: some 20 MB per hour of logging.',
        low=1.0,
        high=3650.0,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class KeepSettings:
    """Data kept on the robot until requested (``ship: on_request``)."""

    max_bytes: int = _setting(
        500 * GIBI, 'Maximum bytes to keep on the robot; beyond it the oldest objects are evicted.', low=MEBI
    )
    days: float = _setting(14.0, 'Days to keep them.', low=0.01, high=3650.0)
    thin_to_hz: float = _setting(
        1.0, 'Thin old images and clouds to this rate before any are evicted; 0: never.', low=0.0,
        high=1000.0
    )  # fmt: skip
    missions: tuple[str, ...] = _setting(('',), 'Types of missions that are always uploaded completely.')
    preview_s: float = _setting(
        1.0, 'Seconds between two previews of a camera, uploaded immediately; 0: none.', low=0.0, high=3600.0
    )
    poll_s: float = _setting(10.0, 'Seconds between two checks for requests.', low=0.5, high=3600.0)
    when: str = _setting('', 'Upload requested objects only while this rule is true; empty: always.')


@dataclass(frozen=True, slots=True, kw_only=True)
class UploadSettings:
    """Delivery."""

    threads: int = _setting(4, 'Objects uploaded at a time.', low=1, high=64)
    connect_timeout_s: float = 5.0
    """Not a parameter: set by the doctor and by tests."""
    read_timeout_s: float = _setting(30.0, 'Seconds to wait for an answer of the store.', low=0.1, high=600.0)
    max_backoff_s: float = _setting(
        60.0, 'Longest pause between two attempts while the store is unreachable.', low=0.1, high=3600.0
    )
    max_mbps: float = _setting(0.0, 'Maximum megabits per second to an S3 server; 0 is no limit.', low=0.0, high=1e5, live=True)
    when: str = _setting(
        '', 'Upload only while this rule is true: \'lowstate:bms_state.soc > 30 and wifi.ssid == "lab"\'; empty: always.'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutdownSettings:
    """How long SIGINT and SIGTERM may take."""

    drain_s: float = _setting(3.0, 'Seconds to continue uploading when the node is stopped.', low=0.0, high=600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockSettings:
    """Which times are trusted, and how objects from before the clock was set are handled."""

    max_offset_s: float = _setting(
        86_400.0,
        'Seconds that a stamp may differ from the arrival of its message; beyond that, the arrival dates it.',
        low=1.0,
        high=1e9,
    )

    hold_s: float = _setting(
        600.0,
        'Seconds to wait for the clock to be set; then objects are uploaded without a date, under _unsynced.',
        low=0.0,
        high=1e6,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionSettings:
    """What the node does while a mission of its robot is active."""

    capture: str = _setting('always', 'When sensor data is stored: always, or only while a mission is active.', choices=CAPTURES)
    join: bool = _setting(True, "Log the robot's state to the mission's run.")
    period_s: float = _setting(1.0, 'Seconds between two points of a metric.', low=0.01, high=3600.0)
    battery: str = _setting(
        'lowstate:bms_state.soc|battery_state:percentage|sensor_msgs/msg/BatteryState:percentage|unitree_hg/msg/BmsState:soc',
        'Topic or type, and field, of battery_pct; alternatives separated by | (the first published); empty: none.',
    )
    temperature: str = _setting(
        'go2_interfaces/msg/IMU:temperature|unitree_go/msg/LowState:imu_state.temperature|sensor_msgs/msg/Temperature:temperature',
        'The same of temperature_c.',
    )
    odometry: str = _setting(
        'odom|nav_msgs/msg/Odometry',
        'Topic or type of pose, trajectory and distance; alternatives separated by |; empty: none.',
    )
    frames: str = _setting(
        'camera|sensor_msgs/msg/CompressedImage|sensor_msgs/msg/Image',
        'Sensor or type of the images that become frames of the run; alternatives separated by |; empty: none.',
    )
    frame_every_s: float = _setting(5.0, 'Seconds between these frames.', low=0.0, high=1e6)


@dataclass(frozen=True, slots=True, kw_only=True)
class CatalogSettings:
    """The catalog of the store's objects, written after delivery."""

    enabled: bool = _setting(True, 'Write a row for each delivered object to the catalog.')
    period_s: float = _setting(60.0, 'Seconds between two files of the catalog.', low=1.0, high=86_400.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class BagSettings:
    """Recording at full rate, independent of the sensors."""

    record: str = _setting(
        'service', 'When: service (from bag start to bag stop), mission (in every mission as well) or always.', choices=RECORDS
    )
    topics: tuple[str, ...] = _setting(('',), 'Topics to record; with neither topics nor a regex, those of the sensors.')
    regex: str = _setting('', 'Record also topics whose name matches this regular expression; ".*|/_" includes hidden ones.')
    exclude: str = _setting('', 'Skip topics that match this, unless they are in topics.')
    slice_s: float = _setting(
        60.0, 'Seconds in one file of a bag; each is uploaded while the next one is recorded.', low=1.0, high=86_400.0
    )
    slice_bytes: int = _setting(256 * MEBI, 'Maximum bytes in one file of a bag.', low=MEBI)
    compression: str = _setting('zstd', 'Compression of the bag.', choices=COMPRESSIONS)
    priority: int = _setting(8, '0 is uploaded first and evicted last; 9 is uploaded last and evicted first.', low=0, high=9)
    ship: str = _setting(ALWAYS, 'Upload bags always, or keep their slices until they are requested.', choices=SHIPS)


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSettings:
    """A ring in memory with the last seconds of some topics; an event writes it to a bag. Off while no topic is named."""

    topics: tuple[str, ...] = _setting(('',), 'Topics to keep; with neither topics nor a regex, there are no events.')
    regex: str = _setting('', 'Keep also topics whose name matches this regular expression; ".*|/_" includes hidden ones.')
    exclude: str = _setting('', 'Skip topics that match this, unless they are in topics.')
    pre_s: float = _setting(30.0, 'Seconds to keep from before a trigger.', low=0.0, high=3600.0, live=True)
    post_s: float = _setting(
        10.0, 'Seconds to keep after it; another trigger in that time prolongs the event.', low=0.0, high=3600.0, live=True
    )
    max_s: float = _setting(
        120.0,
        'Maximum seconds from the first trigger to the end of an event.',
        low=1.0,
        high=1e5,
        live=True,
    )
    max_bytes: int = _setting(64 * MEBI, 'Memory for recent messages; beyond it the oldest are dropped.', low=MEBI, live=True)
    log_event: str = _setting(
        '.*', "An agent's log_event triggers an event where its name matches this regular expression; empty for none.", live=True
    )
    conditions: tuple[str, ...] = _setting(
        ('',),
        'What triggers an event: "low_battery: lowstate:bms_state.soc < 20 for 5" is name, topic:field, comparison, seconds.',
    )
    when: str = _setting('', 'Upload bags of events only while this rule is true, instead of upload.when; empty: always.')

    @property
    def enabled(self) -> bool:
        """Whether anything is kept."""
        return bool(self.regex or any(self.topics))


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreSettings:
    """Where objects are stored: an S3 server, or without an endpoint a folder with the same layout."""

    endpoint_url: str | None = None
    access_key_id: str | None = field(default=None, repr=False)
    secret_access_key: str | None = field(default=None, repr=False)
    session_token: str | None = field(default=None, repr=False)
    region: str = 'us-east-1'
    directory: Path = Path('store')


GROUPS: Final[dict[str, type]] = {
    'capture': CaptureSettings,
    'queue': QueueSettings,
    'spool': SpoolSettings,
    'keep': KeepSettings,
    'upload': UploadSettings,
    'shutdown': ShutdownSettings,
    'clock': ClockSettings,
    'mission': MissionSettings,
    'bag': BagSettings,
    'events': EventSettings,
    'catalog': CatalogSettings,
}
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
        'topics': ('point_cloud2', 'utlidar/cloud'), 'types': (POINT_CLOUD, POINT_CLOUD), 'format': 'pcd',
        'key': '{robot}/lidar/{date}/{time}_scan.{ext}', 'priority': 7,
    },
    'imu': {
        'topics': ('imu', 'utlidar/imu'), 'types': ('go2_interfaces/msg/IMU|sensor_msgs/msg/Imu', 'sensor_msgs/msg/Imu'),
        'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 4,
    },
    'odom': {
        'topics': ('odom', 'utlidar/robot_odom'), 'types': ('nav_msgs/msg/Odometry', 'nav_msgs/msg/Odometry'), 'priority': 3,
    },
    'states': {
        'topics': ('go2_states', 'sportmodestate'), 'types': ('go2_interfaces/msg/Go2State', 'unitree_go/msg/SportModeState'),
        'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 3,
    },
    'joints': {
        'topics': ('joint_states',), 'types': ('sensor_msgs/msg/JointState',), 'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 4,
    },
    'lowstate': {
        'topics': ('lowstate',), 'types': ('go2_interfaces/msg/LowState|unitree_go/msg/LowState|unitree_hg/msg/LowState',),
        'batch_s': 10.0, 'priority': 3,
        'statistics': ('imu_state', 'bms_state.soc', 'bms_state.current', 'foot_force', 'power_v', 'power_a', 'temperature_ntc1'),
    },
    'cmd_vel': {
        'enabled': False, 'topics': ('cmd_vel',), 'types': ('geometry_msgs/msg/Twist',), 'rate_hz': 0.0, 'batch_s': 1.0,
        'priority': 3,
    },
    'voxel_map': {
        'enabled': False, 'topics': ('utlidar/voxel_map_compressed',), 'types': ('go2_interfaces/msg/VoxelMapCompressed',),
        'format': 'cdr', 'priority': 8,
    },
}  # fmt: skip
