"""Distances on Earth, against known ones and at its edges."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.earth import is_place, is_within

DEGREE_M = 111_195.08
"""Length of a great circle on the sphere."""


@pytest.mark.parametrize(
    ('one', 'other', 'meters'),
    [
        ((48.1374, 11.5755), (52.5163, 13.3777), 503_395.5),  # Munich to Berlin
        ((0.0, 179.9995), (0.0, -179.9995), 0.001 * DEGREE_M),  # across the antimeridian
        ((89.9995, 0.0), (89.9995, 180.0), 0.001 * DEGREE_M),  # across the pole
        ((90.0, 12.0), (90.0, -150.0), 0.0),  # the pole has every longitude
        ((60.0, 10.0), (60.0, 10.001), 0.0005 * DEGREE_M),
        ((0.0, 0.0), (0.0, 180.0), 180 * DEGREE_M),
    ],
)
def test_distances_on_earth_are_exact(one: tuple[float, float], other: tuple[float, float], meters: float) -> None:
    """A position is within slightly more than its distance, and not within slightly less."""
    assert is_within(*one, *other, meters * 1.001 + 0.1)
    assert is_within(*other, *one, meters * 1.001 + 0.1)
    assert meters == 0.0 or not is_within(*one, *other, meters * 0.999 - 0.1)


def test_a_radius_beyond_the_antipodes_includes_every_place() -> None:
    """Nothing on Earth is further away."""
    assert is_within(-10.0, -170.0, 10.0, 10.0, 1e9)


def test_an_invalid_position_is_refused() -> None:
    """Degrees beyond the poles, and NaN."""
    assert is_place(-90.0, 180.0)
    assert not any(is_place(*each) for each in ((90.1, 0.0), (0.0, -180.1), (float('nan'), 0.0), (0.0, float('nan'))))
