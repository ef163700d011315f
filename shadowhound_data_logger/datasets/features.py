"""The features of a dataset: the numbers of state and action, with their sensors, names and units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP, CLOCKS
from shadowhound_data_logger.lake import decode

_POSE: Final = decode.ODOMETRY[:7]
_TWIST: Final = decode.ODOMETRY[7:]


@dataclass(frozen=True, slots=True)
class StatePart:
    """A group of numbers of one sensor."""

    name: str
    sensor: str
    """Or a topic, which starts with a slash."""
    fields: tuple[str, ...]
    """Paths in a message; empty: the lake's defaults for the type."""
    names: tuple[str, ...]
    """Names of the numbers; empty if the message contains them (joints)."""
    units: tuple[str, ...]
    turns: tuple[slice, ...] = ()
    """Slices with quaternions x y z w."""
    is_derived: bool = False
    """Derived from two poses of odometry instead of read from a message."""

    def as_json(self) -> dict[str, Any]:
        """The part as written in a file."""
        return {'topic': self.sensor, 'fields': list(self.fields), 'names': list(self.names), 'units': list(self.units)}


STATE_PARTS: Final[Mapping[str, StatePart]] = {
    part.name: part
    for part in (
        StatePart('pose', 'odom', _POSE, tuple(f'pose.{axis}' for axis in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')),
                  ('m',) * 3 + ('1',) * 4, (slice(3, 7),)),
        StatePart('twist', 'odom', _TWIST, tuple(f'twist.{axis}' for axis in ('vx', 'vy', 'vz', 'wx', 'wy', 'wz')),
                  ('m/s',) * 3 + ('rad/s',) * 3),
        StatePart('velocity', 'odom', _POSE, ('x.vel', 'y.vel', 'theta.vel'), ('m/s', 'm/s', 'rad/s'), is_derived=True),
        StatePart('imu', 'imu', (), tuple(f'imu.{axis}' for axis in ('wx', 'wy', 'wz', 'ax', 'ay', 'az', 'qw', 'qx', 'qy', 'qz')),
                  ('rad/s',) * 3 + ('m/s^2',) * 3 + ('1',) * 4),
        StatePart('joints', 'joints', ('position',), (), ('rad',)),
        StatePart('battery', 'lowstate', ('bms_state.soc',), ('battery_pct',), ('%',)),
    )
}  # fmt: skip
"""By the keyword in ``state``."""
COMMAND: Final = StatePart(
    'cmd_vel', 'cmd_vel', ('linear.x', 'linear.y', 'angular.z'), ('x.vel', 'y.vel', 'theta.vel'), ('m/s', 'm/s', 'rad/s')
)
DERIVED: Final = StatePart('odometry', 'odom', _POSE, COMMAND.names, COMMAND.units, is_derived=True)
ACTIONS: Final[Mapping[str, StatePart]] = {part.name: part for part in (COMMAND, DERIVED)}
AUTO: Final = 'auto'
"""Instead of one of ``ACTIONS``: the commands if the first mission of a dataset has them, otherwise measured odometry."""
MAPPED: Final = 'fields'
"""The action of a dataset that takes it from fields of a topic."""
ARM_JOINTS, ARM_COMMANDS, ARM_CLOCK = 'arm_joints', 'arm_commands', 'arm_clock'
"""Names of an arm's sensors in datasets, whatever their names in the recording: they are found by topic."""
ARM_TOPICS: Final = {ARM_JOINTS: 'joint_states', ARM_COMMANDS: 'joint_commands', ARM_CLOCK: 'clock'}
"""Below the arm's namespace: sensor_msgs/JointState twice, sensor_msgs/TimeReference."""
JOINT_STATE: Final = 'sensor_msgs/msg/JointState'
"""Positions in radians; a recording that was imported without a unit has another type."""
ARM_STATE: Final = StatePart('arm', ARM_JOINTS, ('position',), (), ('rad',))
ARM_COMMAND: Final = StatePart('arm', ARM_COMMANDS, ('position',), (), ('rad',))
ARM_ACTION: Final = 'action.arm'
"""The stream of the arm's part of the action."""
LABEL_FEATURE: Final = 'shadowhound.labels'
"""The column with the labels of a frame, a JSON list."""
HOLD, LINEAR = 'hold', 'linear'
AV1, H264 = 'av1', 'h264'
OWN_FILES, SHARED = 'episode', 'shared'
"""Layouts of the videos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """How missions become episodes; the same for a complete dataset."""

    fps: int | None = None
    """None: the rate of the slowest camera."""
    state: tuple[str | StatePart, ...] = ('pose',)
    """From ``STATE_PARTS``, or fields of a topic."""
    action: str | StatePart = AUTO
    """From ``ACTIONS``, or fields of a topic."""
    images: Mapping[str, str] = field(default_factory=lambda: {'front': 'camera'})
    """Name of a feature -> sensor or topic with its images."""
    codec: str = AV1
    is_lossless: bool = False
    layout: str = OWN_FILES
    """``episode``: separate video files for each episode; ``shared``: one file per camera for all episodes."""
    resample: Mapping[str, str] = field(default_factory=dict)
    """Sensor or topic -> ``hold`` or ``linear``; default: hold."""
    max_age_s: Mapping[str, float] = field(default_factory=dict)
    """Sensor or topic -> seconds; default: ``ticks.LATE`` periods of the stream or of the ticks."""
    by: str = BY_STAMP
    """Which of a message's two times is used for the ticks."""
    max_gap_s: float = 5.0
    max_stale: float = 0.05
    allow_gaps: bool = False
    validation: float = 0.0
    robot_type: str = ''
    """``robot_type`` of the dataset; empty: ``go2`` for the robot ``thor``, otherwise the name of its first robot."""
    arm: str = ''
    """The namespace of an arm's topics, and the robot name of its recordings if it has a separate machine."""
    labels: bool = False
    """Whether frames have a column with their labels."""
    validation_label: str = ''
    """Episodes with this label in a frame are marked as validation."""
    clock_pairs: tuple[tuple[int, int], ...] = ()
    """(ns of the robot, ns of the arm) of events that both timed, in addition to the recorded ones."""

    def __post_init__(self) -> None:
        """Raises SettingError."""
        self._check_features()
        self._check_values()

    def _check_features(self) -> None:
        for word in self.state:
            if isinstance(word, str) and word not in STATE_PARTS:
                raise SettingError('state', word, f'{", ".join(STATE_PARTS)}, or fields of a topic')
        names = [part.name for part in self.state_parts]
        if not names or len(set(names)) != len(names):
            raise SettingError('state', ', '.join(names), 'one or more different words or topics')
        if isinstance(self.action, str) and self.action not in {AUTO, *ACTIONS}:
            raise SettingError('action', self.action, f'{", ".join((AUTO, *ACTIONS))}, or fields of a topic')
        if not self.images:
            raise SettingError('images', '', 'at least one sensor or topic with images')

    def _check_values(self) -> None:
        for name, value, allowed in (('codec', self.codec, (AV1, H264)), ('layout', self.layout, (OWN_FILES, SHARED)),
                                     ('by', self.by, CLOCKS)):  # fmt: skip
            if value not in allowed:
                raise SettingError(name, value, ' or '.join(allowed))
        for sensor, how in self.resample.items():
            if how not in {HOLD, LINEAR}:
                raise SettingError(f'resample of {sensor}', how, f'{HOLD} or {LINEAR}')
        if self.by == BY_RECEIVED and self.arm:
            raise SettingError('by', self.by, f'{BY_STAMP}: with arm, times are converted between two clocks')
        for name, number, most in (('max_stale', self.max_stale, 1.0), ('validation', self.validation, 0.9),
                                   ('max_gap_s', self.max_gap_s, math.inf)):  # fmt: skip
            if not 0 <= number <= most:
                raise SettingError(name, number, f'0 to {most:g}')
        if self.fps is not None and self.fps < 1:
            raise SettingError('fps', self.fps, 'auto, or a whole number of frames per second')

    @property
    def state_parts(self) -> tuple[StatePart, ...]:
        """In the order of ``observation.state``."""
        return tuple(STATE_PARTS[each] if isinstance(each, str) else each for each in self.state)

    @property
    def action_word(self) -> str:
        """``auto``, one of ``ACTIONS``, or ``fields``."""
        return self.action if isinstance(self.action, str) else MAPPED

    def actions(self, word: str) -> list[StatePart]:
        """Possible sources of the action, best first; ``word`` as in ``action_word``."""
        if not isinstance(self.action, str):
            return [self.action]
        return [COMMAND, DERIVED] if word == AUTO else [ACTIONS[word]]

    def as_json(self) -> dict[str, Any]:
        """The options that determine the bytes of an episode; frames per second and action are chosen later."""
        return {
            'state': [each if isinstance(each, str) else each.as_json() for each in self.state],
            **({} if isinstance(self.action, str) else {'action_from': self.action.as_json()}),
            'images': dict(self.images), 'codec': self.codec, 'lossless': self.is_lossless,
            'resample': dict(sorted(self.resample.items())), 'max_age_s': dict(sorted(self.max_age_s.items())),
            'max_gap_s': self.max_gap_s, **({'arm': self.arm} if self.arm else {}),
            'layout': self.layout, **({'labels': True} if self.labels else {}),
            **({'by': self.by} if self.by != BY_STAMP else {}),
        }  # fmt: skip
