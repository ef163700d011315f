"""The building that the simulated Go2 patrols: rooms, and everything solid in them as axis-aligned boxes.

Lengths are meters. The constants are in the building's frame (corner of the outer wall at 0, 0; x east, y north);
``FloorPlan.build()`` converts everything to the robot's frame ``odom``, whose origin is the charging dock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

WIDTH: Final = 12.0
DEPTH: Final = 8.0
CEILING: Final = 2.6
DOOR_WIDTH: Final = 1.0
DOOR_HEIGHT: Final = 2.05
WALL: Final = 0.06
"""Half the thickness of a wall."""
ORIGIN: Final = (2.0, 1.7)
"""Position of the dock; the origin of ``odom``."""


class Room(NamedTuple):
    """One rectangular room with its name in the camera's caption."""

    name: str
    x0: float
    y0: float
    x1: float
    y1: float


ROOMS: Final = (
    Room('dock', 0.0, 0.0, 3.6, 3.4),
    Room('office', 3.6, 0.0, 8.0, 3.4),
    Room('lab', 8.0, 0.0, 12.0, 3.4),
    Room('corridor', 0.0, 3.4, 12.0, 4.8),
    Room('kitchen', 0.0, 4.8, 6.0, 8.0),
    Room('meeting', 6.0, 4.8, 12.0, 8.0),
)

PATROL: Final = (
    (1.4, 1.7), (4.6, 1.7), (6.6, 1.1), (10.4, 1.1), (10.4, 4.1), (7.2, 4.1),
    (7.2, 5.5), (10.9, 5.5), (10.9, 7.3), (6.9, 7.3), (6.9, 6.4), (1.4, 6.4),
)  # fmt: skip
"""Corners of the closed patrol; it visits every room and passes every door once."""

_Wall = tuple[float, float, float, tuple[float, ...]]
# Walls along x: (y, x from, x to, door centers); walls along y: (x, y from, y to, door centers).
_WALLS_X: Final[tuple[_Wall, ...]] = (
    (0.0, 0.0, WIDTH, ()),
    (3.4, 0.0, WIDTH, (1.4, 10.4)),
    (4.8, 0.0, WIDTH, (1.4, 7.2)),
    (DEPTH, 0.0, WIDTH, ()),
)
_WALLS_Y: Final[tuple[_Wall, ...]] = (
    (0.0, 0.0, DEPTH, ()),
    (3.6, 0.0, 3.4, (1.7,)),
    (8.0, 0.0, 3.4, (1.1,)),
    (6.0, 4.8, DEPTH, (6.4,)),
    (WIDTH, 0.0, DEPTH, ()),
)


class Box(NamedTuple):
    """A solid from (x0, y0, z0) to (x1, y1, z1); ``material`` determines its look and its reflectivity."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    z1: float
    material: str


REFLECTIVITY: Final[dict[str, float]] = {
    'wall': 0.75, 'frame': 0.85, 'wood': 0.55, 'steel': 0.9, 'dark': 0.12, 'screen': 0.08, 'books': 0.5, 'plant': 0.35,
    'board': 0.95, 'orange': 0.8, 'crate': 0.5, 'red': 0.6, 'white': 0.9, 'blue': 0.4, 'counter': 0.7,
}  # fmt: skip
"""Share of the laser's light that is reflected at normal incidence; its keys are all materials."""

FURNITURE: Final = (
    # dock: the charging pad, shelves, crates
    Box(0.12, 0.80, 1.35, 2.05, 0.0, 0.06, 'orange'), Box(0.07, 0.22, 1.45, 1.95, 0.06, 0.75, 'dark'),
    Box(2.30, 3.50, 0.07, 0.45, 0.0, 1.90, 'books'), Box(0.20, 0.80, 2.55, 3.15, 0.0, 0.55, 'crate'),
    Box(0.28, 0.72, 2.62, 3.08, 0.55, 0.95, 'crate'), Box(2.75, 3.30, 2.75, 3.30, 0.0, 0.70, 'blue'),
    # office: two desks, their chairs, a cabinet, a plant
    Box(4.30, 5.90, 2.58, 3.32, 0.70, 0.75, 'wood'), Box(4.34, 4.40, 2.64, 3.30, 0.0, 0.70, 'steel'),
    Box(5.80, 5.86, 2.64, 3.30, 0.0, 0.70, 'steel'), Box(4.75, 5.35, 3.12, 3.18, 0.85, 1.22, 'screen'),
    Box(4.85, 5.30, 2.16, 2.56, 0.40, 0.48, 'blue'), Box(4.85, 5.30, 2.12, 2.17, 0.48, 0.95, 'blue'),
    Box(5.04, 5.11, 2.33, 2.40, 0.0, 0.40, 'dark'),
    Box(6.30, 7.50, 2.58, 3.32, 0.70, 0.75, 'wood'), Box(6.34, 6.40, 2.64, 3.30, 0.0, 0.70, 'steel'),
    Box(7.00, 7.44, 2.70, 3.28, 0.0, 0.70, 'white'), Box(6.60, 7.20, 3.12, 3.18, 0.85, 1.22, 'screen'),
    Box(4.50, 5.70, 0.07, 0.40, 0.0, 1.30, 'books'), Box(7.55, 7.85, 2.85, 3.15, 0.0, 0.35, 'orange'),
    Box(7.50, 7.90, 2.80, 3.20, 0.35, 1.25, 'plant'), Box(3.75, 4.05, 0.12, 0.42, 0.0, 0.55, 'dark'),
    # lab: the bench with instruments, a rack, crates
    Box(11.20, 11.93, 0.40, 2.90, 0.0, 0.90, 'steel'), Box(11.40, 11.80, 0.70, 1.20, 0.90, 1.30, 'dark'),
    Box(11.40, 11.85, 1.70, 2.40, 0.90, 1.20, 'screen'), Box(8.15, 8.85, 2.62, 3.32, 0.0, 1.95, 'dark'),
    Box(9.00, 9.55, 2.70, 3.25, 0.0, 0.50, 'crate'), Box(9.05, 9.45, 2.76, 3.18, 0.50, 0.85, 'orange'),
    Box(8.60, 9.40, 0.07, 0.42, 0.0, 0.45, 'crate'), Box(9.60, 10.60, 0.07, 0.40, 0.0, 1.60, 'steel'),
    # corridor: a bench, a bin, the fire extinguisher, a plant
    Box(3.20, 4.60, 4.42, 4.73, 0.40, 0.46, 'wood'), Box(3.26, 3.32, 4.45, 4.71, 0.0, 0.40, 'dark'),
    Box(4.48, 4.54, 4.45, 4.71, 0.0, 0.40, 'dark'), Box(11.45, 11.80, 3.95, 4.30, 0.0, 0.60, 'steel'),
    Box(5.60, 5.78, 3.47, 3.62, 0.55, 1.10, 'red'), Box(0.15, 0.45, 3.95, 4.25, 0.0, 0.35, 'orange'),
    Box(0.10, 0.50, 3.90, 4.30, 0.35, 1.15, 'plant'),
    # meeting room: the table and six chairs, the board, a plant
    Box(7.90, 10.10, 6.05, 6.75, 0.70, 0.75, 'wood'), Box(8.00, 8.08, 6.15, 6.65, 0.0, 0.70, 'dark'),
    Box(9.92, 10.00, 6.15, 6.65, 0.0, 0.70, 'dark'), Box(11.88, 11.93, 5.50, 7.10, 0.80, 1.80, 'board'),
    Box(8.25, 8.60, 5.93, 5.98, 0.10, 0.90, 'red'), Box(9.35, 9.70, 5.93, 5.98, 0.10, 0.90, 'red'),
    Box(8.25, 8.60, 6.82, 6.87, 0.10, 0.90, 'red'), Box(9.35, 9.70, 6.82, 6.87, 0.10, 0.90, 'red'),
    Box(11.45, 11.75, 7.50, 7.80, 0.0, 0.35, 'orange'), Box(11.40, 11.80, 7.45, 7.85, 0.35, 1.35, 'plant'),
    Box(6.10, 6.55, 4.95, 5.80, 0.0, 0.85, 'white'),
    # kitchen: the counter with stove and sink wall, a fridge, a table with two chairs
    Box(0.20, 4.40, 7.38, 7.93, 0.0, 0.88, 'counter'), Box(0.20, 4.40, 7.34, 7.93, 0.88, 0.93, 'dark'),
    Box(1.30, 1.90, 7.33, 7.38, 0.15, 0.80, 'screen'), Box(4.55, 5.25, 7.25, 7.93, 0.0, 1.85, 'white'),
    Box(0.80, 3.80, 7.60, 7.93, 1.45, 2.15, 'counter'), Box(2.60, 4.00, 5.15, 5.75, 0.70, 0.75, 'wood'),
    Box(2.68, 2.76, 5.22, 5.68, 0.0, 0.70, 'wood'), Box(3.84, 3.92, 5.22, 5.68, 0.0, 0.70, 'wood'),
    Box(2.10, 2.15, 5.25, 5.65, 0.0, 0.90, 'orange'), Box(4.45, 4.50, 5.25, 5.65, 0.0, 0.90, 'orange'),
    Box(5.30, 5.70, 5.00, 5.40, 0.0, 0.60, 'dark'),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """The building in the frame ``odom``, as arrays for the ray casters."""

    rooms: tuple[Room, ...]
    patrol: tuple[tuple[float, float], ...]
    boxes: tuple[Box, ...]
    bounds: NDArray[np.float32]
    """(6, n): x0, x1, y0, y1, z0, z1 of each box."""
    is_full: NDArray[np.bool_]
    """(n,): whether the box reaches from floor to ceiling, and so hides everything behind it."""

    @classmethod
    def build(cls) -> FloorPlan:
        ox, oy = ORIGIN
        boxes = tuple(
            box._replace(x0=box.x0 - ox, x1=box.x1 - ox, y0=box.y0 - oy, y1=box.y1 - oy) for box in (*_walls(), *FURNITURE)
        )
        bounds = np.array([box[:6] for box in boxes], np.float32).T.copy()
        return cls(
            rooms=tuple(Room(room.name, room.x0 - ox, room.y0 - oy, room.x1 - ox, room.y1 - oy) for room in ROOMS),
            patrol=tuple((x - ox, y - oy) for x, y in PATROL),
            boxes=boxes,
            bounds=bounds,
            is_full=(bounds[4] <= 0.0) & (bounds[5] >= np.float32(CEILING)),
        )

    @property
    def corner(self) -> tuple[float, float]:
        """The building's south-west corner in ``odom``."""
        return -ORIGIN[0], -ORIGIN[1]

    def room_at(self, x: float, y: float) -> str:
        """The name of the room at a point, ``outside`` if there is none."""
        for room in self.rooms:
            if room.x0 <= x < room.x1 and room.y0 <= y < room.y1:
                return room.name
        return 'outside'


def _walls() -> list[Box]:
    """Every wall, split at its doors, with lintels and door frames."""
    boxes: list[Box] = []
    for y, start, end, doors in _WALLS_X:
        for low, high, z0, z1, half, material in _along(start, end, doors):
            boxes.append(Box(low, high, y - half, y + half, z0, z1, material))
    for x, start, end, doors in _WALLS_Y:
        for low, high, z0, z1, half, material in _along(start, end, doors):
            boxes.append(Box(x - half, x + half, low, high, z0, z1, material))
    return boxes


def _along(start: float, end: float, doors: tuple[float, ...]) -> list[tuple[float, float, float, float, float, str]]:
    """The pieces of one wall: (from, to, z0, z1, half the thickness, material)."""
    pieces = []
    trim = 0.07
    half = WALL + 0.02
    at = start - WALL
    for door in doors:
        left, right = door - DOOR_WIDTH / 2, door + DOOR_WIDTH / 2
        pieces += [
            (at, left, 0.0, CEILING, WALL, 'wall'),
            (left, right, DOOR_HEIGHT, CEILING, WALL, 'wall'),
            (left - trim, left, 0.0, DOOR_HEIGHT + trim, half, 'frame'),
            (right, right + trim, 0.0, DOOR_HEIGHT + trim, half, 'frame'),
            (left, right, DOOR_HEIGHT - 0.02, DOOR_HEIGHT + trim, half, 'frame'),
        ]
        at = right
    return [*pieces, (at, end + WALL, 0.0, CEILING, WALL, 'wall')]


class Crossings(NamedTuple):
    """For n boxes and m rays, each array is (n, m); distances are in lengths of the ray's direction vector."""

    near: NDArray[np.float32]
    """Where the ray enters; infinite if it misses the box or starts behind its front."""
    far: NDArray[np.float32]
    """Where the ray leaves; meaningless if it misses."""
    through_x: NDArray[np.bool_]
    """Whether it enters through a face that is perpendicular to x."""


def cross(bounds: NDArray[np.float32], x: float, y: float, dx: NDArray[Any], dy: NDArray[Any]) -> Crossings:
    """Slab test of rays from (x, y) along (dx, dy), each (m,), with boxes ``bounds`` (x0, x1, y0, y1, ...; n)."""
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
