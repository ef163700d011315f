"""Settings of this process's heap, by mallopt(3) of glibc; other C libraries ignore them."""

from __future__ import annotations

import ctypes
from typing import Final

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENAS = -1, -3, -8
_FEW_ARENAS: Final = {ARENAS: 2, MMAP_THRESHOLD: 1 << 20}
_KEEP_FREE: Final = {TRIM_THRESHOLD: 16 << 20, MMAP_THRESHOLD: 16 << 20}


def limit_arenas() -> None:
    """Share a few arenas among all threads, and return large blocks to the system when they are freed.

    Call it before the first thread starts. At full rate it saves the node 35 of 128 MB (docs/performance.md).
    """
    _set(_FEW_ARENAS)


def keep_free_blocks() -> None:
    """Allocate blocks of up to 16 MB from the heap, and keep up to 16 MB free at its end for the next message.

    Otherwise the blocks of each cloud may come from the system each time: the live page then had 260 to 1,900 page faults per
    second, which took 0.25 to 0.75 % of a core.
    """
    _set(_KEEP_FREE)


def trim() -> None:
    """Return free memory within the heap to the system, which glibc does not do automatically. It takes some milliseconds."""
    malloc_trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if malloc_trim is not None:
        malloc_trim(0)


def _set(options: dict[int, int]) -> None:
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        for option in options.items():
            mallopt(*option)
