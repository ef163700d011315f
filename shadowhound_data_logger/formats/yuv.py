"""YUV images of cameras as planes of Y, U and V, at the camera's resolution.

A JPEG (JFIF) contains such planes directly, in ITU-R BT.601 colors and the full range of values. Cameras and OpenCV
(``cv_bridge``) use BT.601 with the limited range, 16 to 235 for Y: this module converts only the range, never the colors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Plane = NDArray[np.uint8]


class Planes(NamedTuple):
    """The planes of an image. U and V are smaller where pixels share them; their sizes are rounded up."""

    y: Plane
    u: Plane
    v: Plane


class _Packed(NamedTuple):
    """Two pixels in four bytes: the position of the first Y, and of U and V."""

    y: int
    u: int
    v: int


class _SemiPlanar(NamedTuple):
    """The Y plane, then alternating U and V."""

    columns: int
    """Pixels in a row that share U and V."""
    rows: int
    """Rows that share U and V."""
    u: int
    """The position of U in each pair: 0 or 1."""


_LAYOUTS: Final[dict[str, _Packed | _SemiPlanar]] = {
    'yuv422': _Packed(1, 0, 2),  # sensor_msgs/image_encodings.hpp: this is UYVY
    'uyvy': _Packed(1, 0, 2),
    'yuv422_yuy2': _Packed(0, 1, 3),
    'yuyv': _Packed(0, 1, 3),
    'yuy2': _Packed(0, 1, 3),
    'nv12': _SemiPlanar(2, 2, 0),
    'nv21': _SemiPlanar(2, 2, 1),
    'nv16': _SemiPlanar(2, 1, 0),
    'nv61': _SemiPlanar(2, 1, 1),
    'nv24': _SemiPlanar(1, 1, 0),
    'nv42': _SemiPlanar(1, 1, 1),
}
"""Layouts by ROS encoding in lower case; also by the names that V4L2 and drivers use."""


def _full_range(low: int, high: int, middle: int, new_middle: int) -> bytes:
    """A table from limited-range to full-range values."""
    values = (np.arange(256) - middle) * (255 / (high - low)) + new_middle
    return bytes(np.clip(np.rint(values), 0, 255).astype(np.uint8))


_LUMA: Final = _full_range(16, 235, 16, 0)
_CHROMA: Final = _full_range(16, 240, 128, 128)


def is_yuv(encoding: str) -> bool:
    """Whether images of a ROS encoding have planes."""
    return encoding.lower() in _LAYOUTS


def read_planes(message: Any) -> Planes | None:
    """The full-range planes of a sensor_msgs/msg/Image with a YUV encoding; None if the size of its data is wrong."""
    layout = _LAYOUTS[message.encoding.lower()]
    found = _packed(message, layout) if isinstance(layout, _Packed) else _semi_planar(message, layout)
    if found is None:
        return None
    y, u, v = found
    return Planes(_apply_table(y, _LUMA), _apply_table(u, _CHROMA), _apply_table(v, _CHROMA))


def _apply_table(part: Plane, table: bytes) -> Plane:
    # bytes.translate takes a sixth of the time of numpy indexing.
    return np.frombuffer(part.tobytes().translate(table), np.uint8).reshape(part.shape)


def upsample_chroma(planes: Planes) -> Planes:
    """The planes with a U and a V for each pixel."""
    height, width = planes.y.shape

    def full(part: Plane) -> Plane:
        rows, columns = -(-height // len(part)), -(-width // part.shape[1])
        return np.repeat(np.repeat(part, rows, 0), columns, 1)[:height, :width]

    return Planes(planes.y, full(planes.u), full(planes.v))


def _packed(message: Any, layout: _Packed) -> tuple[Any, Any, Any] | None:
    width, height, step = message.width, message.height, message.step
    pairs = -(-width // 2)
    if step < 2 * width or message.data.size != step * height:
        return None
    rows = message.data.reshape(height, step)[:, : 4 * pairs]
    if rows.shape[1] < 4 * pairs:  # odd width without the second half of the last pair: use that of the previous pair
        half = rows[:, -4:-2] if width > 1 else np.full((height, 2), 128, np.uint8)
        rows = np.concatenate((rows[:, : 2 * width], half), axis=1)
    quads = rows.reshape(height, pairs, 4)
    return quads[:, :, layout.y :: 2].reshape(height, 2 * pairs)[:, :width], quads[:, :, layout.u], quads[:, :, layout.v]


def _semi_planar(message: Any, layout: _SemiPlanar) -> tuple[Any, Any, Any] | None:
    """``step`` should be the step of Y; also accepts publishers that set it to the data size divided by the height."""
    width, height, data = message.width, message.height, message.data
    columns, rows = -(-width // layout.columns), -(-height // layout.rows)
    for step in (message.step, width, 2 * columns):
        of_chroma = max(2 * columns, step * 2 // layout.columns)
        if step >= width and data.size == step * height + of_chroma * rows:
            y = data[: step * height].reshape(height, step)[:, :width]
            pairs = data[step * height :].reshape(rows, of_chroma)[:, : 2 * columns].reshape(rows, columns, 2)
            return y, pairs[:, :, layout.u], pairs[:, :, 1 - layout.u]
    return None
