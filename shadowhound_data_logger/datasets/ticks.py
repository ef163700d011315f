"""The known values at each tick: the latest message at or before it, never a later one, and its age.

Times are ns since 1970 (int64). A message with a stamp after the tick is never used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.lake.gaps import Known

if TYPE_CHECKING:
    from numpy.typing import NDArray

SLACK: Final = 1.02
"""A rate this close below a whole number counts as that number: 29.97 Hz are 30."""
LATE: Final = 1.5
"""By default, a message is stale after this many periods."""
PHASE: Final = 95
"""Percent of the images that arrive before their tick: ticks start this long after the first image."""
NOT_SAMPLED, NOT_PUBLISHED, UNKNOWN = 'not_sampled', 'not_published', 'unknown'
"""Causes in addition to those of the gap journal: skipped on purpose; not published; unknown."""


def whole_fps(rate_hz: float) -> int:
    """The frames per second that a source can fill; 0 if less than one."""
    return int(rate_hz * SLACK + 1e-9)


def ticks_of(first_ns: int, last_ns: int, fps: int) -> NDArray[np.int64]:
    """All ticks from the first to the last, both included: the n-th is n/fps seconds after the first, to the ns."""
    count = int((last_ns - first_ns) * fps // SECOND) + 1 if last_ns >= first_ns else 0
    return first_ns + np.arange(count, dtype=np.int64) * SECOND // fps


def phase_of(stamps: NDArray[np.int64], first_ns: int, fps: int) -> int:
    """How long after ``first_ns`` the ticks start, so that images with their usual jitter have arrived, ns."""
    period = SECOND // fps
    away = (stamps - first_ns) % period
    away = np.where(away > period // 2, away - period, away)
    return max(0, int(np.sort(away)[-(-PHASE * len(away) // 100) - 1])) if len(away) else 0


def latest(stamps: NDArray[np.int64], ticks: NDArray[np.int64]) -> NDArray[np.int64]:
    """The index of the last message at or before each tick; -1 if there is none. Of equal stamps, the last one."""
    return np.searchsorted(stamps, ticks, 'right').astype(np.int64) - 1


@dataclass(frozen=True, slots=True)
class Sampled:
    """One stream at each tick."""

    message: NDArray[np.int64]
    """The newest at or before the tick; never -1."""
    other: NDArray[np.int64]
    """The second message that a value was interpolated with, after ``message - 1`` or before it; -1 if it was held."""
    age_s: NDArray[np.float32]
    """Of the newest message."""
    stale: NDArray[np.bool_]


def sample(stamps: NDArray[np.int64], ticks: NDArray[np.int64], max_age_ns: int) -> Sampled:
    """Hold the newest message. Every tick must have one."""
    message = latest(stamps, ticks)
    age = ticks - stamps[message]
    return Sampled(message, np.full(len(ticks), -1, np.int64), (age / SECOND).astype(np.float32), age > max_age_ns)


def interpolated(stamps: NDArray[np.int64], values: NDArray[np.float64], ticks: NDArray[np.int64], max_gap_ns: int,
                 turns: Sequence[slice] = ()) -> tuple[NDArray[np.float64], NDArray[np.int64]]:  # fmt: skip
    """(values, the earlier of the two messages): linear between the last two messages, evaluated one period before the tick.

    Both have arrived by then: it is as causal as holding, and one period late. ``turns`` are quaternions among the columns (x y
    z w), which are interpolated by slerp. If two messages are more than ``max_gap_ns`` apart, or there are no two, the newest
    one is held (-1).
    """
    newest = latest(stamps, ticks)
    found, earlier = values[newest].copy(), np.full(len(ticks), -1, np.int64)
    if len(stamps) < 2:
        return found, earlier
    period = int(np.median(np.diff(stamps)))
    wanted = ticks - period
    before = latest(stamps, wanted)
    after = before + 1
    good = (before >= 0) & (after <= newest)
    first, second = np.maximum(before, 0), np.minimum(after, len(stamps) - 1)
    apart = stamps[second] - stamps[first]
    good &= (apart > 0) & (apart <= max_gap_ns)
    share = np.where(good, (wanted - stamps[first]) / np.maximum(apart, 1), 0.0)[:, None]
    line = values[first] * (1 - share) + values[second] * share
    for turn in turns:
        line[:, turn] = _slerp(values[first][:, turn], values[second][:, turn], share)
    found[good] = line[good]
    earlier[good] = first[good]
    return found, earlier


def _slerp(one: NDArray[np.float64], other: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """https://en.wikipedia.org/wiki/Slerp, the shorter way; linear for nearly equal quaternions."""
    dot = (one * other).sum(axis=1, keepdims=True)
    other, dot = np.where(dot < 0, -other, other), np.abs(dot).clip(0, 1)
    angle = np.arccos(dot)
    sine = np.sin(angle)
    near = sine < 1e-6
    divisor = np.where(near, 1.0, sine)
    made = np.where(near, one * (1 - share) + other * share,
                    (np.sin((1 - share) * angle) * one + np.sin(share * angle) * other) / divisor)  # fmt: skip
    length = np.linalg.norm(made, axis=1, keepdims=True)
    return np.asarray(made / np.where(length > 0, length, 1.0))


def motion(
    stamps: NDArray[np.int64], poses: NDArray[np.float64], max_gap_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(later message, (n, 3) forward m/s, left m/s, yaw rate rad/s) between consecutive messages, in the robot's frame.

    ``poses`` is (n, 7): x y z and the quaternion x y z w. Pairs more than ``max_gap_ns`` apart are skipped.
    """
    seconds = np.diff(stamps) / SECOND
    yaw = np.arctan2(2 * (poses[:, 6] * poses[:, 5] + poses[:, 3] * poses[:, 4]), 1 - 2 * (poses[:, 4] ** 2 + poses[:, 5] ** 2))
    turn = (np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi
    step, heading = np.diff(poses[:, :2], axis=0), yaw[:-1] + turn / 2
    good = np.flatnonzero((seconds > 0) & (seconds * SECOND <= max_gap_ns))
    cos, sin, by = np.cos(heading[good]), np.sin(heading[good]), seconds[good]
    x, y = step[good, 0], step[good, 1]
    return good + 1, np.column_stack([(x * cos + y * sin) / by, (y * cos - x * sin) / by, turn[good] / by])


def cause_of(known: Known, thinned: Sequence[tuple[int, int]], message_ns: int, tick_ns: int) -> str:
    """Why there is no newer message at a tick: the cause of the gap around it, otherwise of one since the newest message.

    ``thinned`` are times in which messages were dropped on purpose.
    """
    since = known.between(max(known.begin_ns, min(message_ns + 1, tick_ns)), min(known.end_ns, tick_ns + 1)).stretches
    for stretch in reversed(since):
        if stretch.causes:
            return '+'.join(stretch.causes)
    if not since or since[-1].is_open:
        return UNKNOWN
    return NOT_SAMPLED if any(begin <= tick_ns <= end for begin, end in thinned) else NOT_PUBLISHED
