"""Messages that are JSON as a table of numbers: which fields of which type, and how they are called.

A field is a path such as ``pose.pose.position.x``; one that is a list, or lies in the elements of one, becomes several columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shadowhound_data_logger.errors import LakeError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_POSE: Final = (*(f'position.{axis}' for axis in 'xyz'), *(f'orientation.{axis}' for axis in 'xyzw'))
_TWIST: Final = ('linear', 'angular')
ODOMETRY: Final = (*_POSE, *(f'{kind}_velocity.{axis}' for kind in _TWIST for axis in 'xyz'))
"""13: metres, quaternion, m/s, rad/s; of the short document, which names them so, and of the whole message alike."""
_WHOLE_ODOMETRY: Final = (
    *(f'pose.pose.{name}' for name in _POSE),
    *(f'twist.twist.{kind}.{axis}' for kind in _TWIST for axis in 'xyz'),
)
FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    'go2_interfaces/msg/IMU': ('gyroscope', 'accelerometer', 'quaternion'),
    'sensor_msgs/msg/Imu': (
        *(f'angular_velocity.{axis}' for axis in 'xyz'), *(f'linear_acceleration.{axis}' for axis in 'xyz'),
        *(f'orientation.{axis}' for axis in 'wxyz'),
    ),
    'sensor_msgs/msg/JointState': ('position',),
    'go2_interfaces/msg/LowState': ('bms_state.soc', 'power_v', 'power_a'),
}  # fmt: skip
"""Type -> fields where none are asked for; of other types all numbers. An IMU is rad/s, m/s^2 and the quaternion w x y z."""


@dataclass(frozen=True, slots=True)
class Table:
    """Messages of one object in the order of their times."""

    stamps: NDArray[np.int64]
    """ns since 1970."""
    values: NDArray[np.float64]
    """(messages, columns); null is NaN."""

    @property
    def nbytes(self) -> int:
        return self.stamps.nbytes + self.values.nbytes


def table(samples: Sequence[Mapping[str, Any]], kind: str, fields: Sequence[str], offset_ns: int) -> Table:
    """The numbers of these messages of a type. Raises LakeError where one does not have a field, or it is no number."""
    asked = tuple(fields)
    stamps = np.array([sample['stamp_ns'] for sample in samples], np.int64) + offset_ns
    try:
        asked = asked or _of_type(samples, kind)
        columns = [_column(samples, name) for name in asked]
        values = np.hstack(columns) if columns else np.empty((len(samples), 0))
    except (LookupError, TypeError, ValueError, RecursionError, ArithmeticError, MemoryError) as error:
        raise LakeError(f'messages of {kind} have no numbers {", ".join(asked)}: {error}') from error
    order = np.argsort(stamps, kind='stable')
    return Table(stamps[order], values[order])


def _of_type(samples: Sequence[Mapping[str, Any]], kind: str) -> tuple[str, ...]:
    if kind == 'nav_msgs/msg/Odometry':
        return _WHOLE_ODOMETRY if samples and 'pose' in samples[0] else ODOMETRY
    return FIELDS.get(kind) or (tuple(_numbers('', samples[0])) if samples else ())


def _numbers(path: str, value: Any) -> Iterator[str]:
    """The paths of all numbers of a message, in its order; of texts, and of lists that are no numbers, none."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if not (path or name not in {'stamp_ns', 'header', 'robot', 'non_finite'}):
                continue
            yield from _numbers(f'{path}.{name}' if path else name, inner)
    elif isinstance(value, list):
        if value and isinstance(value[0], Mapping):
            yield from _numbers(path, value[0])
        elif value and all(item is None or isinstance(item, (int, float)) for item in value):
            yield path
    elif value is None or isinstance(value, (int, float)):
        yield path


def _column(samples: Sequence[Mapping[str, Any]], name: str) -> NDArray[np.float64]:
    path = name.split('.')
    found = np.array([_at(sample, path) for sample in samples], np.float64)
    return found.reshape(len(samples), -1)


def _at(value: Any, path: Sequence[str]) -> Any:
    for number, name in enumerate(path):
        if isinstance(value, list):
            return [_at(item, path[number:]) for item in value]
        value = value[name]
    return value
