"""Distances on Earth as a sphere: within 0.6 % of the WGS 84 ellipsoid."""

from __future__ import annotations

import math
from typing import Final

RADIUS_M: Final = 6_371_008.8
"""The mean radius of the Earth (IUGG), meters."""
MAX_LATITUDE, MAX_LONGITUDE = 90.0, 180.0
TOLERANCE: Final = 1e-18
"""Rounding tolerance of a haversine: 13 mm."""


def is_place(latitude: float, longitude: float) -> bool:
    """Whether these are degrees of a place on Earth; NaN is not."""
    return abs(latitude) <= MAX_LATITUDE and abs(longitude) <= MAX_LONGITUDE


def haversine(angle: float) -> float:
    """The haversine of an angle in radians, at most pi."""
    return math.sin(min(angle, math.pi) / 2) ** 2


def is_within(latitude: float, longitude: float, of_latitude: float, of_longitude: float, radius_m: float) -> bool:
    """Whether two places, in degrees, are at most this many meters apart; correct at the poles and across the antimeridian."""
    north, east = math.radians(latitude - of_latitude), math.radians(longitude - of_longitude)
    parallel = math.cos(math.radians(latitude)) * math.cos(math.radians(of_latitude))
    return math.sin(north / 2) ** 2 + parallel * math.sin(east / 2) ** 2 <= haversine(radius_m / RADIUS_M) + TOLERANCE
