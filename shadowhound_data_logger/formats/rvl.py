"""Depth images in RVL, which compressed_depth_image_transport publishes as an alternative to PNG.

Source of the format: A. D. Wilson, "Fast Lossless Depth Image Compression", ISS 2017. Runs of zeros and of nonzero pixels
alternate. Nonzero pixels are zigzag-encoded differences to the previous one. All numbers are groups of 3 bits, lowest first, each
in a nibble whose highest bit is set if another nibble follows. Nibbles fill 32-bit words from the top.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SIZE: Final = struct.Struct('<II')
"""Columns and rows; they precede the words."""
_MAX_NIBBLES: Final = 10
"""Maximum nibbles of a number: 30 bits."""
_SHIFTS: Final = np.arange(28, -4, -4, dtype=np.uint32)
_MAX_SMALL: Final = 640 * 480
_MAX_TIMES: Final = 16
"""An image may have ``_MAX_SMALL`` pixels, or ``_MAX_TIMES`` for each byte if that is more: decoding takes six bytes per pixel.
A black image takes 16 bytes; most images take a byte for one or two pixels."""


def decode_rvl(data: bytes | memoryview) -> NDArray[np.uint16]:
    """The image, rows x columns. Raises ValueError if the data is invalid or claims an absurd size."""
    if len(data) < _SIZE.size:
        raise ValueError(f'RVL of {len(data)} bytes')
    width, height = _SIZE.unpack_from(data)
    if not 0 < width * height <= max(_MAX_SMALL, _MAX_TIMES * len(data)):
        raise ValueError(f'RVL of {len(data)} bytes with {width} x {height} pixels')
    values = _numbers(data[_SIZE.size :])
    runs = _runs(values, width * height)
    is_pixel = np.repeat(np.tile([False, True], len(runs) // 2), runs)
    lengths = np.column_stack((np.full(len(runs) // 2, 2), runs[1::2])).reshape(-1)
    deltas = values[: lengths.sum()][np.repeat(np.tile([False, True], len(runs) // 2), lengths)]
    pixels = np.zeros(width * height, np.uint16)
    pixels[is_pixel] = np.cumsum((deltas >> 1) ^ -(deltas & 1), dtype=np.int64) & 0xFFFF
    return pixels.reshape(height, width)


def _numbers(data: bytes | memoryview) -> NDArray[np.int64]:
    """The numbers in the words."""
    words = np.frombuffer(data, '<u4', len(data) // 4)
    nibbles = ((words[:, np.newaxis] >> _SHIFTS) & 0xF).astype(np.uint8).reshape(-1)
    ends = np.flatnonzero(nibbles < 8) + 1
    if not len(ends):
        raise ValueError('RVL without numbers')
    starts = np.concatenate(([0], ends[:-1]))
    sizes = ends - starts
    place = np.arange(ends[-1]) - np.repeat(starts, sizes)
    if place.max() >= _MAX_NIBBLES:
        raise ValueError('RVL with a number of more than 30 bits')
    parts = (nibbles[: ends[-1]] & 7).astype(np.int64) << 3 * place
    return np.add.reduceat(parts, starts)


def _runs(values: NDArray[np.int64], pixels: int) -> NDArray[np.int64]:
    """The alternating run lengths, zeros first; their sum is ``pixels``."""
    runs: list[int] = []
    at = done = 0
    while done < pixels:
        if at + 2 > len(values):
            raise ValueError(f'RVL ends at pixel {done} of {pixels}')
        zeros, others = int(values[at]), int(values[at + 1])
        runs += (zeros, others)
        at, done = at + 2 + others, done + zeros + others
    if done > pixels or at > len(values):
        raise ValueError(f'RVL with runs of {done} pixels instead of {pixels}')
    return np.array(runs, np.int64)
