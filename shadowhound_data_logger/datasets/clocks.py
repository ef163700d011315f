"""The offset of another machine's clock from the robot's, and its uncertainty, from events that both machines timed.

Such an event is a pair of times: ``sensor_msgs/TimeReference`` (``header.stamp`` by the robot's clock, ``time_ref`` by the
other), or a line of a file. Between pairs the other clock has a constant drift of at most ``MAX_DRIFT``.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.untrusted import csv_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_DRIFT: Final = 200e-6
"""Of two quartz clocks: each is within 100 ppm of its rate, most are within 30."""
NEAR_NS: Final = 600 * SECOND
"""Pairs farther from an episode are not used."""
MIN_SPAN_NS: Final = 5 * SECOND
"""Minimum span of pairs for computing a drift: over less, 0.1 ms of noise would be 20 ppm."""
MIN_PAIRS: Final = 5
SHARE: Final = 95
"""Percent of the pairs within the uncertainty."""
COLUMNS: Final = ('robot_ns', 'arm_ns')


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The other clock is ``offset_ns + drift * (t - at_ns)`` ahead of the robot's at the robot's time ``t`` (ns since 1970)."""

    at_ns: int
    offset_ns: int
    drift: float
    uncertainty_ns: int
    """At the worst tick of the episode."""
    pairs: int

    def robot_ns(self, other_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert times of the other clock to the robot's."""
        away = other_ns - self.at_ns - self.offset_ns
        return np.asarray(other_ns - self.offset_ns - np.rint(away * (self.drift / (1 + self.drift))).astype(np.int64))

    def other_ns(self, robot_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert times of the robot's clock to the other's."""
        return np.asarray(robot_ns + self.offset_ns + np.rint((robot_ns - self.at_ns) * self.drift).astype(np.int64))

    def as_json(self) -> dict[str, Any]:
        """For ``meta/episodes``."""
        return asdict(self)


def measured(pairs: NDArray[np.int64], begin_ns: int, end_ns: int) -> ClockOffset:
    """The offset in an episode; ``pairs`` is (n, 2), the robot's and the other's time of each event. Raises LakeError if unknown.

    The uncertainty is the distance of 95 % of the pairs from the line through them, plus ``MAX_DRIFT`` times the time from the
    nearest pair to the end of the episode; with too few or too close pairs for a line, from all of them. A delay that is equal
    in both directions of a network is included; a delay in one direction cannot be seen in pairs.
    """
    robot = pairs[:, 0]
    near = pairs[(robot >= begin_ns - NEAR_NS) & (robot <= end_ns + NEAR_NS)]
    if not len(near):
        raise LakeError("the offset of the arm's clock is unknown: no event was timed by both machines")
    near = near[np.argsort(near[:, 0], kind='stable')]
    at = int(near[len(near) // 2, 0])
    times, ahead = (near[:, 0] - at).astype(np.float64), near[:, 1] - near[:, 0]
    middle = int(np.median(ahead))
    rest = (ahead - middle).astype(np.float64)
    drift = offset = 0.0
    is_line = len(near) >= MIN_PAIRS and times[-1] - times[0] >= MIN_SPAN_NS
    if is_line:
        drift, offset = np.polyfit(times, rest, 1)
        if abs(drift) > MAX_DRIFT:
            raise LakeError(
                f"the arm's clock is unknown: it would run {drift * 1e6:.0f} ppm too fast, or it was set during that time"
            )
    spread = float(np.percentile(np.abs(rest - offset - drift * times), SHARE))
    if is_line:
        beyond = max(0, int(near[0, 0]) - begin_ns, end_ns - int(near[-1, 0]))
    else:  # no line: the clock may have drifted since the farthest of them
        beyond = max(abs(int(near[0, 0]) - end_ns), abs(begin_ns - int(near[-1, 0])))
    return ClockOffset(at, middle + round(float(offset)), float(drift), round(spread + MAX_DRIFT * beyond), len(near))


def read_pairs(path: Path) -> NDArray[np.int64]:
    """(n, 2) from a CSV file with the columns ``robot_ns`` and ``arm_ns``, ns since 1970. Raises SettingError."""
    try:
        found = [tuple(int(row[name]) for name in COLUMNS) for row in csv_rows(path.read_bytes())]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise SettingError('arm_clock', path, f'a CSV file with the columns {",".join(COLUMNS)} ({error})') from error
    return _sane(found, path)


def _sane(found: Sequence[tuple[int, ...]], path: Path) -> NDArray[np.int64]:
    if any(not EARLIEST_SANE_NS <= value < 1 << 62 for pair in found for value in pair):
        raise SettingError('arm_clock', path, 'times in ns since 1970')
    return np.array(found, np.int64).reshape(-1, 2)
