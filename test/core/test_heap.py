"""Whether the process keeps freed blocks: page faults of child processes, since the options affect a whole process."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

ROUNDS, BLOCKS, BLOCK = 20, 3, 4 << 20
PROGRAM = f"""
import resource, sys
from shadowhound_data_logger.core import heap

def take():
    blocks = [bytearray({BLOCK}) for _ in range({BLOCKS})]
    for block in blocks:
        for place in range(0, {BLOCK}, 4096):
            block[place] = 1

getattr(heap, sys.argv[1])()
take()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({ROUNDS}):
    take()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(option: str) -> int:
    return int(subprocess.run([sys.executable, '-c', PROGRAM, option], capture_output=True, text=True, check=True).stdout)


def test_kept_blocks_are_not_requested_from_the_system_again() -> None:
    if not hasattr(ctypes.CDLL(None), 'mallopt'):
        pytest.skip('this C library has no such options')
    pages = BLOCKS * BLOCK // 4096
    assert faults('keep_free_blocks') < pages
    assert faults('limit_arenas') >= ROUNDS * pages // 2, 'large blocks are returned each time'
