"""Noise that depends on nothing but seed, stream and time: the same run can be made again, sample by sample."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

SIZE: Final = 1 << 16


class Noise:
    """A table of standard normal numbers, read from a place that each (stream, time) owns."""

    def __init__(self, seed: int) -> None:
        self.table: NDArray[np.float32] = np.random.default_rng(seed).standard_normal(SIZE).astype(np.float32)

    def at(self, stream: int, t: float, count: int) -> list[float]:
        """``count`` normal numbers for one sample of ``stream``, as Python floats."""
        return self.array(stream, t, count).tolist()  # type: ignore[no-any-return]

    def array(self, stream: int, t: float, count: int) -> NDArray[np.float32]:
        """``count`` (at most SIZE) normal numbers for one sample of ``stream``."""
        start = (round(t * 1000) * 7919 + stream * 104_729) % SIZE
        if start + count <= SIZE:
            return self.table[start : start + count]
        return np.concatenate((self.table[start:], self.table[: start + count - SIZE]))
