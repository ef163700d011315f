"""The values of a tick: never anything later, nothing across a gap, and velocities in the robot's frame."""

from __future__ import annotations

import numpy as np
import pytest

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.datasets.ticks import interpolated, motion, sample


def stream(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Irregular messages at 20 Hz, with two gaps; their numbers; ticks at 30 Hz."""
    rng = np.random.default_rng(seed)
    even = np.arange(400) * SECOND // 20 + rng.integers(0, SECOND // 30, 400)
    stamps = np.sort(even[(even < 4 * SECOND) | (even > 7 * SECOND)])
    stamps = stamps[(stamps < 11 * SECOND) | (stamps > 11.4 * SECOND)]
    return stamps, rng.normal(size=(len(stamps), 3)), int(stamps[0]) + np.arange(500) * SECOND // 30


@pytest.mark.parametrize('seed', range(5))
def test_a_value_does_not_depend_on_what_comes_later(seed: int) -> None:
    """Held or interpolated: without all later messages, it is the same."""
    stamps, values, ticks = stream(seed)
    held = sample(stamps, ticks, SECOND // 10)
    _, earlier = interpolated(stamps, values, ticks, SECOND)
    assert (earlier >= 0).mean() > 0.6
    for tick in range(0, len(ticks), 7):
        there = stamps <= ticks[tick]
        alone = sample(stamps[there], ticks[tick : tick + 1], SECOND // 10)
        assert stamps[held.message[tick]] == stamps[there][-1]
        assert (alone.age_s[0], alone.stale[0]) == (held.age_s[tick], held.stale[tick])
        if earlier[tick] >= 0:
            assert stamps[earlier[tick] + 1] <= ticks[tick]


def test_nothing_is_interpolated_across_a_gap() -> None:
    """Between messages farther apart than allowed the newest is held; elsewhere the line goes through both."""
    stamps, values, ticks = stream(1)
    for max_gap_ns, most in ((SECOND, 1.0), (SECOND // 5, 0.2)):
        found, earlier = interpolated(stamps, values, ticks, max_gap_ns)
        newest = np.searchsorted(stamps, ticks, 'right') - 1
        held = earlier < 0
        assert np.array_equal(found[held], values[newest[held]])
        line = earlier[~held]
        assert (np.diff(stamps)[line] <= most * SECOND).all()
        low, high = np.minimum(values[line], values[line + 1]), np.maximum(values[line], values[line + 1])
        assert ((found[~held] >= low - 1e-9) & (found[~held] <= high + 1e-9)).all()
        in_gap = (ticks > 4.3 * SECOND) & (ticks < 7 * SECOND)
        assert held[in_gap].all()
    assert held[(ticks > 11.1 * SECOND) & (ticks < 11.4 * SECOND)].all()


def test_velocities_are_those_of_a_circle() -> None:
    """Forward at constant speed, not sideways, turning evenly; across the wrap of an angle, and not across a gap."""
    speed, rate = 0.6, 0.8
    stamps = np.delete(np.arange(200) * SECOND // 20, slice(80, 120))
    yaw = rate * stamps / SECOND + 2.5
    poses = np.zeros((len(stamps), 7))
    poses[:, 0], poses[:, 1] = speed / rate * np.sin(yaw), -speed / rate * np.cos(yaw)
    poses[:, 5], poses[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    later, found = motion(stamps, poses, SECOND)
    assert later.tolist() == [number for number in range(1, len(stamps)) if number != 80]
    assert found == pytest.approx(np.tile([speed, 0.0, rate], (len(later), 1)), abs=1e-3)


def test_quaternions_are_interpolated_the_shorter_way() -> None:
    """Half way between two of opposite sign is their middle, of length one."""
    turned = np.array([[0, 0, np.sin(0.1), np.cos(0.1)], [0, 0, -np.sin(0.3), -np.cos(0.3)]])
    found, earlier = interpolated(np.array([0, 100]), turned, np.array([150]), SECOND, (slice(0, 4),))
    assert earlier.tolist() == [0]
    assert np.abs(found[0]) == pytest.approx([0, 0, np.sin(0.2), np.cos(0.2)])
