"""The heap of this process, by mallopt(3) of glibc; other C libraries know none of these options."""

from __future__ import annotations

import ctypes
from typing import Final

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENAS = -1, -3, -8
_BOUND: Final = {ARENAS: 2, MMAP_THRESHOLD: 1 << 20}
_KEPT: Final = {TRIM_THRESHOLD: 16 << 20, MMAP_THRESHOLD: 16 << 20}


def bound() -> None:
    """Share few heaps among all threads, and return large blocks to the system when they are freed.

    Call it before the first thread is started.
    At full rate it saves the node 35 of 128 MB (docs/performance.md).
    """
    _set(_BOUND)


def keep() -> None:
    """Take blocks of up to 16 MB from the heap, and keep up to 16 MB that are free at its end, for the next message.

    When each cloud's blocks were taken from the system anew, as happened in some starts, the live page had 260 to 1,900 page
    faults a second, which cost a quarter to three quarters of a point of a core.
    """
    _set(_KEPT)


def give_back() -> None:
    """Return to the system what was freed in the midst of the heap, which glibc does not do by itself: some milliseconds."""
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)


def _set(options: dict[int, int]) -> None:
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        for option in options.items():
            mallopt(*option)
