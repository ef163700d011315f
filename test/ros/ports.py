"""Ports of Fast DDS in shared memory (SharedMemGlobal.hpp), and the state that a killed listener leaves there."""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import signal
import struct
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import pytest

from shadowhound_data_logger.ros.port_guard import FOLDER, IN_USE, PROCESSING, WAITING

HEAD, MUTEX, LISTENERS = 256, 40, 1024
OTHER_MUTEX = 48
"""Of aarch64."""
CONDITION = 56 + 512 * 40 + 16
DEAD = IN_USE | PROCESSING
SETTLED = IN_USE | WAITING


class Port:
    """The memory of a port, in the layout of Fast DDS."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open('r+b') as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        node = self._memory.find(b'port_node_abi5\0')
        for mutex in (MUTEX, OTHER_MUTEX):
            start = node - ((CONDITION + 2 * mutex + 20 * LISTENERS + 17 + 7) & ~7)
            if self._memory[start + 20 : start + 24] == struct.pack('=I', int(path.name.rpartition('port')[2])):
                self._start, self._lock, self._first = start, start + CONDITION + mutex, start + CONDITION + 2 * mutex
                break
        else:
            pytest.skip('ports are of another kind here')
        self._libc = ctypes.CDLL(None)

    @property
    def flags(self) -> int:
        return self._memory[self._first]

    def seem_to_process(self) -> None:
        """As a listener that processes a message."""
        self._memory[self._first] = DEAD

    def be_marked_in_the_middle(self) -> None:
        """As Fast DDS marks it, while a publisher that found it healthy waits for its lock."""
        word = ctypes.c_char.from_buffer(self._memory, self._lock)
        assert self._libc.pthread_mutex_lock(ctypes.byref(word)) == 0
        time.sleep(0.3)
        self._memory[self._start + 44] &= ~1
        assert self._libc.pthread_mutex_unlock(ctypes.byref(word)) == 0


def ports_of(process: int) -> list[Port]:
    """The ports of a process: it holds their locks."""
    return [Port(path) for path in locked(process, r'port\d+')]


def locked(process: int, name: str) -> list[Path]:
    """Files of Fast DDS in shared memory with such a name and a lock held by the process."""
    lock = re.compile(rf'({FOLDER}/fast(?:dds|rtps)_{name})_el')
    found = []
    for each in Path(f'/proc/{process}/fd').iterdir():
        with suppress(FileNotFoundError):  # closed in the meantime
            found.append(lock.fullmatch(str(each.readlink())))
    return [Path(match[1]) for match in found if match]


def seem_to_process(process: int, ports: Iterable[Port]) -> None:
    """Stop it, and leave its ports as if it were killed while it processes a message."""
    os.kill(process, signal.SIGSTOP)
    time.sleep(0.1)
    for port in ports:
        port.seem_to_process()
