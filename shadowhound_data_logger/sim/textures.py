"""How the building looks: one flat atlas of packed BGR pixels with a copy of every surface for each level of shade.

The camera turns every pixel into one index into ``Atlas.pixels``; nothing is coloured or shaded after that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shadowhound_data_logger.sim.floor_plan import CEILING, DEPTH, REFLECTIVITY, ROOMS, WIDTH, FloorPlan
from shadowhound_data_logger.sim.surfaces import ceiling_map, floor_map, material, wall

LEVELS: Final = 14
DIMMING: Final = 0.043
"""How much darker each level of shade is."""
WALL_SCALE: Final = 80.0
"""Pixels a metre on walls."""
WALL_ROWS: Final = round(CEILING * WALL_SCALE)
WALL_COLUMNS: Final = 320
"""A wall's picture repeats after this many pixels: 4 m."""
MAP_SCALE: Final = 62.5
"""Pixels a metre on floor and ceiling."""
MAP_ROWS: Final = round(DEPTH * MAP_SCALE)
MAP_COLUMNS: Final = round(WIDTH * MAP_SCALE)
FACE: Final = 64
"""Pixels along each side of the picture of a material, which is stretched over the face of its box."""


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """All pixels, and where each surface begins: ``base + level * size of one picture``."""

    pixels: NDArray[np.uint32]
    floor: int
    ceiling: int
    walls: NDArray[np.int32]
    """For each of ROOMS."""
    faces: NDArray[np.int32]
    """For each box of the plan."""

    @classmethod
    def paint(cls, plan: FloorPlan) -> Atlas:
        names = list(REFLECTIVITY)
        pictures = [floor_map((MAP_ROWS, MAP_COLUMNS), MAP_SCALE), ceiling_map((MAP_ROWS, MAP_COLUMNS), MAP_SCALE)]
        pictures += [wall(room.name, (WALL_ROWS, WALL_COLUMNS), WALL_SCALE) for room in ROOMS]
        pictures += [material(name, FACE) for name in names]
        shaded = [_shaded(picture) for picture in pictures]
        bases = np.cumsum([0, *(levels.size for levels in shaded)])[:-1]
        faces = bases[2 + len(ROOMS) :]
        return cls(
            pixels=np.concatenate([levels.ravel() for levels in shaded]),
            floor=int(bases[0]),
            ceiling=int(bases[1]),
            walls=bases[2 : 2 + len(ROOMS)].astype(np.int32),
            faces=np.array([faces[names.index(box.material)] for box in plan.boxes], np.int32),
        )


def _shaded(picture: NDArray[np.float32]) -> NDArray[np.uint32]:
    """(LEVELS, rows, columns) packed pixels of an (rows, columns, 3) picture in RGB from 0 to 255."""
    packed = np.empty((LEVELS, *picture.shape[:2]), np.uint32)
    for level in range(LEVELS):
        rgb = np.clip(picture * np.float32(1.0 - DIMMING * level), 0, 255).astype(np.uint32)
        packed[level] = (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
    return packed
