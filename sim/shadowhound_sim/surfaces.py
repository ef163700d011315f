"""The look of the building: textures of floors, ceilings, walls and furniture, and the camera's atlas of them.

The textures are drawn with numpy, float RGB from 0 to 255. The atlas is a flat array of packed BGR pixels, with a copy of every
texture for each shade level: the camera only computes one index per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shadowhound_sim.floor_plan import CEILING, DEPTH, FURNITURE, REFLECTIVITY, ROOMS, WIDTH, FloorPlan

Picture = NDArray[np.float32]
Color = tuple[int, int, int]

WALLS: Final[dict[str, tuple[Color, Color, Color]]] = {
    'dock': ((186, 190, 196), (120, 128, 138), (245, 166, 35)),
    'office': ((196, 214, 228), (110, 142, 168), (58, 84, 110)),
    'lab': ((206, 226, 210), (112, 160, 128), (40, 96, 70)),
    'corridor': ((238, 230, 214), (196, 176, 146), (178, 52, 44)),
    'kitchen': ((250, 226, 160), (240, 240, 232), (214, 120, 50)),
    'meeting': ((222, 178, 158), (150, 84, 76), (96, 40, 48)),
}
"""Upper wall, lower wall and accent of each room."""
FLOORS: Final[dict[str, tuple[Color, Color]]] = {
    'dock': ((150, 150, 152), (142, 142, 145)),
    'office': ((96, 112, 132), (88, 103, 122)),
    'lab': ((188, 194, 190), (180, 187, 183)),
    'corridor': ((176, 126, 78), (160, 112, 68)),
    'kitchen': ((232, 222, 202), (176, 92, 66)),
    'meeting': ((104, 66, 76), (96, 60, 70)),
}

LEVELS: Final = 14
DIMMING: Final = 0.043
"""How much darker each level of shade is."""
WALL_SCALE: Final = 80.0
"""Pixels per meter on walls."""
WALL_ROWS: Final = round(CEILING * WALL_SCALE)
WALL_COLUMNS: Final = 320
"""A wall's texture repeats after this many pixels: 4 m."""
MAP_SCALE: Final = 62.5
"""Pixels per meter on floor and ceiling."""
MAP_ROWS: Final = round(DEPTH * MAP_SCALE)
MAP_COLUMNS: Final = round(WIDTH * MAP_SCALE)
FACE: Final = 64
"""Pixels along each side of a material's texture, which is stretched over the face of its box."""


def _grain(shape: tuple[int, ...], strength: float, seed: int) -> Picture:
    """Faint blotches, so that no surface is quite even."""
    random = np.random.default_rng(seed)
    coarse = random.standard_normal((shape[0] // 8 + 1, shape[1] // 8 + 1)).astype(np.float32)
    fine = random.standard_normal(shape[:2]).astype(np.float32)
    blotches = np.kron(coarse, np.ones((8, 8), np.float32))[: shape[0], : shape[1]]
    grain: Picture = np.float32(strength) * (np.float32(0.7) * blotches + np.float32(0.5) * fine)
    return grain[..., None]


def floor_map(shape: tuple[int, int], scale: float) -> Picture:
    """The floor of the complete building seen from above: row 0 is south, column 0 west; darker near walls and furniture."""
    image = np.zeros((*shape, 3), np.float32)
    y, x = np.indices(shape, np.float32) / np.float32(scale)
    for room in ROOMS:
        first, second = FLOORS[room.name]
        inside = (x >= room.x0) & (x < room.x1) & (y >= room.y0) & (y < room.y1)
        tile = {'kitchen': 0.4, 'office': 0.5, 'meeting': 0.5}.get(room.name, 0.8)
        if room.name == 'corridor':
            plank = np.floor(y / 0.14)
            odd = (plank + np.floor((x + 0.37 * plank) / 0.9)) % 2 == 0
            seam = (y % 0.14 < 0.014) | ((x + 0.37 * plank) % 0.9 < 0.014)
        else:
            odd = (np.floor(x / tile) + np.floor(y / tile)) % 2 == 0
            seam = (x % tile < 0.016) | (y % tile < 0.016)
        image[inside] = np.where(odd[..., None], first, second)[inside]
        image[inside & seam] *= 0.84
    _floor_marks(image, x, y)
    image += _grain(shape, 3.0, 11)
    return image * _contact_shadow(shape, scale)


def _floor_marks(image: Picture, x: Picture, y: Picture) -> None:
    """Hazard stripes around the dock, a safety line in the lab, a rug under the table, the corridor's runner."""
    pad = (x > 0.15) & (x < 2.35) & (y > 1.0) & (y < 2.4)
    core = (x > 0.25) & (x < 2.25) & (y > 1.1) & (y < 2.3)
    stripes = ((x + y) % 0.24 < 0.12)[..., None]
    image[pad & ~core] = np.where(stripes, (245, 190, 30), (40, 40, 42))[pad & ~core]
    line = (np.abs(x - 10.95) < 0.05) & (y > 0.2) & (y < 3.2)
    line |= (np.abs(y - 2.45) < 0.05) & (x > 8.15) & (x < 10.0)
    image[line] = (240, 196, 40)
    rug = (x > 7.55) & (x < 10.45) & (y > 5.75) & (y < 7.05)
    inner = (x > 7.65) & (x < 10.35) & (y > 5.85) & (y < 6.95)
    image[rug] = (206, 170, 110)
    image[inner] = (58, 84, 110)
    runner = (np.abs(y - 4.1) < 0.3) & (x > 0.9) & (x < 11.2)
    image[runner] = (150, 52, 48)
    image[runner & (np.abs(np.abs(y - 4.1) - 0.25) < 0.016)] = (226, 196, 140)


def _contact_shadow(shape: tuple[int, int], scale: float) -> Picture:
    """(rows, columns, 1): 1 in the open, down to about 0.6 near walls and objects on the floor."""
    solid = np.zeros(shape, np.float32)
    for room in ROOMS:
        x0, x1, y0, y1 = (round(v * scale) for v in (room.x0, room.x1, room.y0, room.y1))
        edge = round(0.06 * scale)
        solid[y0:y1, x0 : x0 + edge] = solid[y0:y1, x1 - edge : x1] = 1
        solid[y0 : y0 + edge, x0:x1] = solid[y1 - edge : y1, x0:x1] = 1
    for box in FURNITURE:
        if box.z0 < 0.9:
            depth = 1.0 if box.z0 < 0.2 else 0.6
            x0, x1, y0, y1 = (round(v * scale) for v in (box.x0, box.x1, box.y0, box.y1))
            solid[y0:y1, x0:x1] = np.maximum(solid[y0:y1, x0:x1], depth)
    reach = round(0.16 * scale)
    for axis in (0, 1, 0, 1):
        padded = np.pad(solid, [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)], mode='edge')
        sums = np.cumsum(padded, axis=axis, dtype=np.float64)
        size, width = shape[axis], 2 * reach + 1
        upper, lower = np.take(sums, range(width, width + size), axis), np.take(sums, range(size), axis)
        solid = ((upper - lower) / width).astype(np.float32)
    return (1.0 - 0.5 * np.clip(solid, 0, 1))[..., None]


def ceiling_map(shape: tuple[int, int], scale: float) -> Picture:
    """The ceiling, in the same frame as the floor: white panels with a lamp in every second one."""
    image = np.full((*shape, 3), (226, 226, 222), np.float32)
    y, x = np.indices(shape, np.float32) / np.float32(scale)
    image[(x % 0.6 < 0.02) | (y % 0.6 < 0.02)] = (190, 190, 188)
    image += _grain(shape, 2.0, 12)
    lamps = ((x % 2.4) > 0.62) & ((x % 2.4) < 1.78) & ((y % 1.8) > 0.62) & ((y % 1.8) < 1.18)
    image[lamps] = (400, 396, 380)
    return image


def wall(name: str, shape: tuple[int, int], scale: float) -> Picture:
    """Four meters of the walls of a room; row 0 is the ceiling."""
    upper, lower, accent = WALLS[name]
    image = np.empty((*shape, 3), np.float32)
    rows, columns = shape
    height = CEILING - np.arange(rows, dtype=np.float32) / np.float32(scale)
    along = np.arange(columns, dtype=np.float32) / np.float32(scale)
    z, u = np.broadcast_to(height[:, None], shape), np.broadcast_to(along[None, :], shape)
    image[:] = upper
    image[z < 0.95] = lower
    image *= (0.93 + 0.07 * np.clip(z / 1.5, 0, 1))[..., None]
    _ornament(name, image, z, u, accent)
    image[(z > 0.93) & (z < 0.98)] = accent
    image[z > 2.52] = (236, 234, 228)
    image[z < 0.10] = tuple(0.45 * c for c in lower)
    image[(z >= 0.10) & (z < 0.115)] = tuple(0.75 * c for c in lower)
    return image + _grain(shape, 2.5, len(name))


def _ornament(name: str, image: Picture, z: Picture, u: Picture, accent: Color) -> None:
    """Decorations on the walls of each room."""
    if name == 'kitchen':
        image[(z < 0.95) & ((z % 0.15 < 0.012) | (u % 0.15 < 0.012))] = (196, 196, 188)
        _frame(image, z, u, (2.0, 1.55, 0.5, 0.32), accent, ((250, 250, 240), (120, 170, 90)))
    elif name == 'office':
        _frame(image, z, u, (1.2, 1.6, 0.75, 0.45), (240, 240, 236), ((150, 200, 240), (220, 236, 248)))
        image[(np.abs(u - 1.2) < 0.02) & (np.abs(z - 1.6) < 0.45)] = (240, 240, 236)
        image[(z < 0.9) & (u % 0.5 < 0.015)] *= 0.85
    elif name == 'lab':
        stripe = ((u + z) % 0.2 < 0.1)[..., None]
        band = (z > 0.78) & (z < 0.93)
        image[band] = np.where(stripe, (245, 200, 40), (50, 50, 52))[band]
        _frame(image, z, u, (1.0, 1.6, 0.36, 0.42), (60, 60, 64), ((240, 240, 240), (60, 150, 110)))
        image[(np.hypot(u - 1.0, z - 1.65) < 0.2) & (np.hypot(u - 1.0, z - 1.65) > 0.13)] = accent
        image[(z > 0.98) & (u % 1.0 < 0.012)] *= 0.8
    elif name == 'corridor':
        image[(z > 1.36) & (z < 1.46)] = accent
        image[(z > 1.49) & (z < 1.52)] = accent
        image[(z < 0.9) & ((u % 0.8 < 0.03) | (np.abs(z - 0.2) < 0.012) | (np.abs(z - 0.82) < 0.012))] *= 0.86
    elif name == 'meeting':
        _frame(image, z, u, (0.9, 1.62, 0.55, 0.4), (70, 46, 30), ((236, 196, 120), (70, 110, 140)))
        _frame(image, z, u, (2.9, 1.62, 0.32, 0.45), (70, 46, 30), ((60, 80, 120), (220, 120, 80)))
        image[(z < 0.9) & (u % 0.25 < 0.014)] *= 0.82
    else:
        stripe = ((u - z) % 0.3 < 0.15)[..., None]
        band = (z > 0.62) & (z < 0.93)
        image[band] = np.where(stripe, (245, 180, 30), (48, 48, 50))[band]
        bricks = (z > 1.0) & ((z % 0.2 < 0.012) | ((u + 0.2 * (np.floor(z / 0.2) % 2)) % 0.4 < 0.012))
        image[bricks] *= 0.88


_Rectangle = tuple[float, float, float, float]


def _frame(image: Picture, z: Picture, u: Picture, at: _Rectangle, rim: Color, inner: tuple[Color, Color]) -> None:
    """A framed picture around (u, z) with half its width and height: ``inner`` is the sky above and the hills below."""
    u0, z0, half_width, half_height = at
    image[(np.abs(u - u0) < half_width + 0.05) & (np.abs(z - z0) < half_height + 0.05)] = rim
    inside = (np.abs(u - u0) < half_width) & (np.abs(z - z0) < half_height)
    hills = z < z0 - 0.05 + 0.3 * half_height * np.cos(5 * (u - u0)) * np.cos(11 * (u - u0))
    image[inside & ~hills] = inner[0]
    image[inside & hills] = inner[1]


_BASE: Final[dict[str, Color]] = {
    'wall': (200, 200, 200), 'frame': (246, 244, 238), 'wood': (186, 134, 82), 'steel': (172, 180, 188),
    'dark': (58, 60, 66), 'screen': (28, 34, 44), 'books': (120, 86, 56), 'plant': (58, 128, 62),
    'board': (246, 248, 250), 'orange': (226, 116, 44), 'crate': (176, 138, 84), 'red': (196, 44, 40),
    'white': (232, 234, 236), 'blue': (52, 96, 158), 'counter': (206, 188, 160),
}  # fmt: skip


def material(name: str, size: int) -> Picture:
    """The picture of one face of a box; row 0 is its upper edge."""
    image = np.full((size, size, 3), _BASE[name], np.float32)
    v, u = np.indices((size, size), np.float32) / np.float32(size)
    random = np.random.default_rng(sum(name.encode()))
    if name in ('wood', 'counter'):
        image *= (1 + 0.07 * np.sin(40 * v + 3 * np.sin(5 * u)))[..., None]
    if name == 'counter':
        image[(u % 0.25 < 0.02) | ((v > 0.06) & (v < 0.09))] *= 0.62
        image[(np.abs(u % 0.25 - 0.04) < 0.012) & (v > 0.3) & (v < 0.5)] = (90, 90, 92)
    elif name == 'books':
        image *= 0.55
        colors = random.integers(60, 230, (4, 16, 3)).astype(np.float32)
        shelf, book = np.minimum((v * 4).astype(int), 3), np.minimum((u * 16).astype(int), 15)
        tall = (v * 4 % 1) > 0.18 + 0.25 * random.random((4, 16))[shelf, book]
        image[tall] = colors[shelf, book][tall]
        image[(v * 4 % 1) > 0.93] = (120, 86, 56)
    elif name == 'plant':
        image *= (0.45 + 0.75 * random.random((size // 4, size // 4)).repeat(4, 0).repeat(4, 1))[..., None]
    elif name == 'screen':
        lines = (v % 0.1 < 0.05) & (u > 0.1) & (u < 0.25 + 0.6 * random.random(10)[np.minimum((v * 10).astype(int), 9)])
        image[lines & (v > 0.1) & (v < 0.9)] = (90, 210, 160)
    elif name == 'board':
        for row, (start, end) in enumerate(((0.1, 0.7), (0.1, 0.5), (0.1, 0.62), (0.15, 0.4))):
            image[(np.abs(v - 0.22 - 0.14 * row) < 0.012) & (u > start) & (u < end)] = (40, 70, 150)
        image[(np.abs(np.hypot(u - 0.8, v - 0.6) - 0.1) < 0.012)] = (190, 40, 40)
    elif name == 'crate':
        image[(v % 0.25 < 0.03)] *= 0.6
        image[(np.abs(u - v) < 0.05)] *= 0.8
    elif name == 'steel':
        image[(v % 0.333 < 0.03)] *= 0.7
        image[(np.abs(v % 0.333 - 0.16) < 0.02) & (np.abs(u - 0.5) < 0.12)] = (90, 94, 100)
    elif name == 'white':
        image[np.abs(v - 0.36) < 0.015] *= 0.6
        image[(np.abs(u - 0.12) < 0.02) & (np.abs(v - 0.36) < 0.22) & (np.abs(v - 0.36) > 0.05)] = (120, 124, 130)
    edge = (u < 0.025) | (u > 0.975) | (v < 0.03) | (v > 0.97)
    image[edge] *= 0.72
    return image + _grain((size, size), 3.0, 5)


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """All pixels, and the start of each surface: ``base + level * size of one texture``."""

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
    """(LEVELS, rows, columns) packed pixels of an (rows, columns, 3) texture in RGB from 0 to 255."""
    packed = np.empty((LEVELS, *picture.shape[:2]), np.uint32)
    for level in range(LEVELS):
        rgb = np.clip(picture * np.float32(1.0 - DIMMING * level), 0, 255).astype(np.uint32)
        packed[level] = (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
    return packed
