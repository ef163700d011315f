"""A 5x7 pixel font for captions in camera frames, without a font library."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

SCALE: Final = 2
HEIGHT: Final = 7 * SCALE
ADVANCE: Final = 6 * SCALE
"""Pixels from one character to the next."""

# Each character is its five columns from left to right; the lowest bit of a column is the top row.
_COLUMNS: Final = {
    ' ': '0000000000', '#': '147f147f14', '-': '0808080808', '.': '0060600000', ':': '0036360000', '/': '2010080402',
    '0': '3e5149453e', '1': '00427f4000', '2': '4261514946', '3': '2141454b31', '4': '1814127f10', '5': '2745454539',
    '6': '3c4a494930', '7': '0171090503', '8': '3649494936', '9': '064949291e', 'A': '7e1111117e', 'B': '7f49494936',
    'C': '3e41414122', 'D': '7f4141221c', 'E': '7f49494941', 'F': '7f09090901', 'G': '3e4149497a', 'H': '7f0808087f',
    'I': '00417f4100', 'J': '2040413f01', 'K': '7f08142241', 'L': '7f40404040', 'M': '7f020c027f', 'N': '7f0408107f',
    'O': '3e4141413e', 'P': '7f09090906', 'Q': '3e4151215e', 'R': '7f09192946', 'S': '4649494931', 'T': '01017f0101',
    'U': '3f4040403f', 'V': '1f2040201f', 'W': '3f4038403f', 'X': '6314081463', 'Y': '0708700807', 'Z': '6151494543',
}  # fmt: skip


@lru_cache(maxsize=64)
def glyph(character: str) -> NDArray[np.bool_]:
    """(HEIGHT, ADVANCE) mask of one character; unknown ones are blank."""
    columns = np.frombuffer(bytes.fromhex(_COLUMNS.get(character.upper(), _COLUMNS[' '])), np.uint8)
    rows = (columns[None, :] >> np.arange(7)[:, None]) & 1
    return np.pad(np.kron(rows, np.ones((SCALE, SCALE))), ((0, 0), (0, SCALE))).astype(bool)


def write(image: NDArray[np.uint8], text: str, left: int, top: int, color: tuple[int, int, int]) -> None:
    """Draws one line of text into an (h, w, 3) image; text that does not fit is cut off."""
    room = (image.shape[1] - left) // ADVANCE
    shown = text[: max(room, 0)]
    if shown:
        mask = np.concatenate([glyph(character) for character in shown], axis=1)
        image[top : top + HEIGHT, left : left + mask.shape[1]][mask] = color
