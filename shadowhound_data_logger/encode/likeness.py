"""How alike two pictures look: a difference hash of 64 bits, most of which are the same in pictures of the same scene.

Of a grey picture of 9 x 8 cells, each bit says whether a cell is darker than the one to its right (dHash: N. Krawetz, "Kind of
Like That", 2013). Noise and compression change a few of them, another scene about half.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import simplejpeg

if TYPE_CHECKING:
    from numpy.typing import NDArray

_ROWS: Final = 8
_COLUMNS: Final = 9
_CONTRAST: Final = 4.0
"""Grey levels between the darkest cell and the brightest: below it noise sets the bits, or none is set, of black as of white."""


def difference_hash(jpeg: bytes) -> int | None:
    """64 bits, the top left one the highest; None of what is no JPEG, too small, or without contrast."""
    try:
        grey = simplejpeg.decode_jpeg(
            jpeg, 'GRAY', fastdct=True, min_height=_ROWS, min_width=_COLUMNS, min_factor=8, strict=False
        )
    except ValueError:
        return None
    height, width = grey.shape[:2]
    if height < _ROWS or width < _COLUMNS:
        return None
    cells = _means(_means(grey[:, :, 0].astype(np.float32), _ROWS, 0), _COLUMNS, 1)
    if np.ptp(cells) < _CONTRAST:
        return None
    return int.from_bytes(np.packbits(cells[:, :-1] < cells[:, 1:]).tobytes(), 'big')


def _means(values: NDArray[Any], count: int, axis: int) -> NDArray[Any]:
    """The means of so many stretches of an axis, as equal as they can be."""
    edges = [place * values.shape[axis] // count for place in range(count + 1)]
    return np.stack([values.take(range(start, end), axis).mean(axis) for start, end in pairwise(edges)], axis)
