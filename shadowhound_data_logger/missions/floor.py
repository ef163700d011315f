"""The floor plan under a mission's path: where the lidar saw walls and furniture, from above."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from shadowhound_data_logger.disk import replacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

LOW_M, HIGH_M = 0.15, 1.5
"""Above the origin of odometry: neither ground nor ceiling."""
MOST_A_CLOUD: Final = 2000
MOST: Final = 400_000
"""Points: 3 MB."""


class Floor:
    """Points of a mission, evenly thinned out when there are too many. New; ``add`` and ``save`` on one thread."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.float32]] = []
        self._count = 0
        self._step = 1

    def load(self, path: Path) -> None:
        """Go on with what an earlier node saw; none is fine, and so is one that cannot be read."""
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return
        if found.ndim == 2 and found.shape[1] == 2:
            self._keep(found.astype(np.float32))

    def add(self, xyz: NDArray[np.float32]) -> None:
        """A cloud in the frame of odometry, metres, a row a point."""
        seen = xyz[(xyz[:, 2] > LOW_M) & (xyz[:, 2] < HIGH_M) & np.isfinite(xyz).all(axis=1), :2]
        self._keep(seen[:: self._step * max(1, -(-len(seen) // MOST_A_CLOUD))].copy())

    def save(self, path: Path) -> None:
        """Where anything was seen. Raises OSError."""
        if self._count:
            with replacing(path) as file:
                np.save(file, np.concatenate(self._parts))

    def _keep(self, xy: NDArray[np.float32]) -> None:
        self._parts.append(xy)
        self._count += len(xy)
        if self._count > MOST:
            thinned = np.concatenate(self._parts)[::2]
            self._parts, self._count, self._step = [thinned], len(thinned), 2 * self._step
