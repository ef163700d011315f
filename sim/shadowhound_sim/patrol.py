"""The path of the simulated Go2: a closed polyline with rounded corners at constant speed, exact at any time."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

SPEED: Final = 0.6
"""Walking speed, m/s: a calm trot."""
RADIUS: Final = 0.4
"""Radius of the rounded corners, m."""
COMMAND_S: Final = 0.5
"""How long the last command applies."""
DRIVEN_SPEED, DRIVEN_TURN = 2.0, 3.0
"""Maximum velocities, m/s and rad/s."""


class Motion(NamedTuple):
    """Position of the body in ``odom`` and its velocity; SI units, angles in radians, yaw within (-pi, pi]."""

    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    yaw_rate: float


class _Piece(NamedTuple):
    """A straight (curvature 0) or an arc, with its start and initial heading."""

    x: float
    y: float
    heading: float
    curvature: float
    length: float


@dataclass(frozen=True, slots=True)
class Patrol:
    """A closed path, walked forever; ``at`` depends only on the time."""

    pieces: tuple[_Piece, ...]
    starts: tuple[float, ...]
    """Arc length at the start of each piece."""
    length: float
    offset: float
    """Arc length at time 0."""

    @classmethod
    def through(cls, corners: Sequence[tuple[float, float]], radius: float = RADIUS) -> Patrol:
        """The path around ``corners`` that is nearest to the origin at time 0; raises ValueError if a side is too short."""
        n = len(corners)
        turns = [_turn(corners[i - 1], corners[i], corners[(i + 1) % n]) for i in range(n)]
        pieces: list[_Piece] = []
        for i in range(n):
            (x0, y0), (x1, y1) = corners[i], corners[(i + 1) % n]
            cut, next_cut = (radius * math.tan(abs(turn) / 2) for turn in (turns[i], turns[(i + 1) % n]))
            straight = math.hypot(x1 - x0, y1 - y0) - cut - next_cut
            if straight < 0:
                raise ValueError(f'the side from {corners[i]} is too short for corners of radius {radius} m')
            heading = math.atan2(y1 - y0, x1 - x0)
            pieces.append(_Piece(x0 + cut * math.cos(heading), y0 + cut * math.sin(heading), heading, 0.0, straight))
            turn = turns[(i + 1) % n]
            if turn:
                x, y = x1 - next_cut * math.cos(heading), y1 - next_cut * math.sin(heading)
                pieces.append(_Piece(x, y, heading, math.copysign(1 / radius, turn), radius * abs(turn)))
        starts, total = [], 0.0
        for piece in pieces:
            starts.append(total)
            total += piece.length
        path = cls(tuple(pieces), tuple(starts), total, 0.0)
        return cls(path.pieces, path.starts, total, path._nearest(0.0, 0.0))

    def at(self, t: float) -> Motion:
        """The motion ``t`` seconds after the start."""
        s = (self.offset + SPEED * t) % self.length
        index = bisect_right(self.starts, s) - 1
        piece = self.pieces[index]
        return _along(piece, s - self.starts[index])

    def _nearest(self, x: float, y: float) -> float:
        """The arc length of the point on a straight that is nearest to (x, y)."""
        best = (math.inf, 0.0)
        for piece, start in zip(self.pieces, self.starts, strict=True):
            if not piece.curvature:
                along = (x - piece.x) * math.cos(piece.heading) + (y - piece.y) * math.sin(piece.heading)
                along = min(max(along, 0.0), piece.length)
                motion = _along(piece, along)
                best = min(best, (math.hypot(motion.x - x, motion.y - y), start + along))
        return best[1]


class Driven:
    """A body that follows commands: it keeps the velocity of the last command for half a second, then it stands.

    Times are seconds since the start, and must not decrease: an earlier one is treated as the latest. Owned by one thread.
    """

    def __init__(self) -> None:
        self._t = 0.0
        self._x = self._y = self._yaw = 0.0
        self._command = (0.0, 0.0, 0.0)
        self._until = 0.0

    def command(self, t: float, forward: float, left: float, yaw_rate: float) -> None:
        """Velocities in the frame of the body (REP-103), m/s and rad/s, clipped to what a Go2 can do."""
        self._move(t)
        top = (DRIVEN_SPEED, DRIVEN_SPEED, DRIVEN_TURN)
        self._command = tuple(  # type: ignore[assignment]
            min(max(value, -most), most) if math.isfinite(value) else 0.0
            for value, most in zip((forward, left, yaw_rate), top, strict=True)
        )
        self._until = self._t + COMMAND_S

    def at(self, t: float) -> Motion:
        """The motion at that time."""
        self._move(t)
        forward, left, yaw_rate = self._command if self._t < self._until else (0.0, 0.0, 0.0)
        cos, sin = math.cos(self._yaw), math.sin(self._yaw)
        return Motion(self._x, self._y, wrapped(self._yaw), forward * cos - left * sin, forward * sin + left * cos, yaw_rate)

    def _move(self, t: float) -> None:
        """Move along the arc of the command until it ends."""
        seconds = max(min(t, self._until) - self._t, 0.0)
        forward, left, yaw_rate = self._command
        turned = yaw_rate * seconds
        half = turned / 2
        chord = math.sin(half) / half if half else 1.0
        cos, sin = math.cos(self._yaw + half), math.sin(self._yaw + half)
        self._x += chord * seconds * (forward * cos - left * sin)
        self._y += chord * seconds * (forward * sin + left * cos)
        self._yaw += turned
        self._t = max(self._t, t)


def _turn(before: tuple[float, float], at: tuple[float, float], after: tuple[float, float]) -> float:
    """The signed change of heading at a corner, within (-pi, pi]."""
    first = math.atan2(at[1] - before[1], at[0] - before[0])
    second = math.atan2(after[1] - at[1], after[0] - at[0])
    return wrapped(second - first)


def _along(piece: _Piece, s: float) -> Motion:
    heading = piece.heading + piece.curvature * s
    if piece.curvature:
        x = piece.x + (math.sin(heading) - math.sin(piece.heading)) / piece.curvature
        y = piece.y - (math.cos(heading) - math.cos(piece.heading)) / piece.curvature
    else:
        x = piece.x + s * math.cos(heading)
        y = piece.y + s * math.sin(heading)
    return Motion(x, y, wrapped(heading), SPEED * math.cos(heading), SPEED * math.sin(heading), SPEED * piece.curvature)


def wrapped(angle: float) -> float:
    """The same angle within (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau
