"""Where rays in the plane enter and leave the boxes of the building; camera, lidar and range sensors stand on it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Crossings(NamedTuple):
    """For n boxes and m rays, each array is (n, m); distances count in lengths of the ray's direction vector."""

    near: NDArray[np.float32]
    """Where the ray enters; infinite where it misses the box or starts behind its front."""
    far: NDArray[np.float32]
    """Where the ray leaves; of no meaning where it misses."""
    through_x: NDArray[np.bool_]
    """Whether it enters through a face that is perpendicular to x."""


def cross(bounds: NDArray[np.float32], x: float, y: float, dx: NDArray[Any], dy: NDArray[Any]) -> Crossings:
    """The slab test of rays from (x, y) along (dx, dy), each (m,), with boxes ``bounds`` (x0, x1, y0, y1, ...; n)."""
    tiny = np.float32(1e-9)
    by_x = np.float32(1.0) / np.where(np.abs(dx) < tiny, tiny, dx).astype(np.float32)
    by_y = np.float32(1.0) / np.where(np.abs(dy) < tiny, tiny, dy).astype(np.float32)
    x0, x1 = (bounds[0] - np.float32(x))[:, None] * by_x, (bounds[1] - np.float32(x))[:, None] * by_x
    y0, y1 = (bounds[2] - np.float32(y))[:, None] * by_y, (bounds[3] - np.float32(y))[:, None] * by_y
    enter_x, enter_y = np.minimum(x0, x1), np.minimum(y0, y1)
    near = np.maximum(enter_x, enter_y)
    far = np.minimum(np.maximum(x0, x1), np.maximum(y0, y1))
    near[(near >= far) | (near <= 0)] = np.inf
    return Crossings(near, far, enter_x > enter_y)
