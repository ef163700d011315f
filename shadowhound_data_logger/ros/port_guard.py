"""Keeps a listener that is killed from stopping the publishers that wrote to it, where Fast DDS uses shared memory.

A listener says in its port that it processes a message. Killed at that moment, it says so forever. Fast DDS notices this within
seconds and marks the port. A publisher that meets the mark in the middle of a message tries to take that word back, waits for a
mutex that it holds itself, gives up after a second and tries again, without end: its ``publish`` never returns (Fast DDS 2.6 to
3.6: SharedMemManager.hpp, ``recover_blocked_processing``; SharedMemGlobal.hpp, ``get_and_remove_blocked_processing``; Fast-DDS
issue 6484, pull request 6497).

``settle`` takes the word back for it: one byte then says that the listener waits, and since it never wakes up again, Fast DDS
leaves the port within seconds. That ends such a loop as well, as long as nobody has replaced the port, and it does the same for a
listener that died between waiting and processing (pull request 4737).

A process that is killed while it makes a port leaves one that is never finished, and whoever opens that waits forever as well
(managed_open_or_create_impl.hpp of boost interprocess). ``settle`` marks it as damaged, and the next process makes it anew.

    flock --no-fork FILE python -I -S port_guard.py PID

As a program, which ``flock`` becomes when the lock of its parent is free, it settles what that one left. It imports nothing of
the package.

This is the only place that writes into files of another library. ``SHADOWHOUND_PORT_GUARD=off`` turns it off
(docs/decisions/0026).
"""

from __future__ import annotations

import fcntl
import os
import re
import signal
import stat
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

FOLDER: Final = Path('/dev/shm')  # noqa: S108 - where Fast DDS has its segments
_PORT: Final = re.compile(r'(fastdds|fastrtps)_port(\d{4,5})')
MAKING_S: Final = 5.0
"""A port is made within a millisecond."""
_MOST_BYTES: Final = 4 << 20
"""A port of 512 messages, as by default, has 52 KB."""
_ENDING_S: Final = 5.0
"""For a parent whose lock is free and that is not gone yet: its other locks go with it."""

# The first word of a segment of boost interprocess, as managed_open_or_create_impl.hpp numbers them.
_WORD: Final = struct.Struct('=I')
_UNINITIALIZED, _INITIALIZING, _CORRUPTED = 0, 1, 3

# struct PortNode of SharedMemGlobal.hpp, ABI 5: the same in 2.6.10, 2.14.5, 3.2.3, 3.6.1 and what followed until August 2026.
# Its name lies right behind it; between its head and the listeners are 512 semaphores and two mutexes of the C library.
_NAME: Final = b'port_node_abi5\0'
_HEAD: Final = struct.Struct('=8xI8xIIIIIII')
"""References, number of the port, listeners, two periods in ms, capacity, how many wait, flags."""
_IS_OK, _IS_EXCLUSIVE = 1, 2
_MUTEXES: Final = (40, 48)
"""Bytes of a pthread_mutex_t on x86-64 and on aarch64."""
_FIRST: Final = 56 + 512 * 40 + 2 * 8
"""Where the listeners would begin without the two mutexes."""
_LISTENERS, _LISTENER = 1024, 20
_DOMAIN: Final = 17
IN_USE, WAITING, PROCESSING = 1, 2, 4
"""Flags in the first byte of a listener, which it alone writes."""


def is_enabled() -> bool:
    """Whether the operator has not turned the guard off."""
    return os.environ.get('SHADOWHOUND_PORT_GUARD', 'on').lower() not in {'off', '0', 'false', 'no'}


def settle(folder: Path = FOLDER, *, is_done: bool = True) -> list[str]:
    """Ports of this user in which a dead listener is still said to be at work, or that nobody finishes.

    Without ``is_done`` they are only looked for. A listener is dead where the lock of its port can be had. Where a publisher has
    removed the lock's file, only a port that Fast DDS has marked is settled: a listener that lives leaves such a port by itself,
    and takes that word back, too.
    """
    if not is_enabled():
        return []
    try:
        found = sorted(folder.iterdir())
    except OSError:
        return []
    return [path.name for path in found if _PORT.fullmatch(path.name) and _settle(path, is_done=is_done)]


def _settle(path: Path, *, is_done: bool) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # gone meanwhile, or not for us
        return False
    try:
        file = os.fstat(descriptor)
        if not stat.S_ISREG(file.st_mode) or file.st_uid != os.geteuid() or file.st_size > _MOST_BYTES:
            return False
        data = os.pread(descriptor, file.st_size, 0)
        if _is_unfinished(data):
            is_left = time.time() - file.st_mtime >= MAKING_S
            if is_left and is_done:
                _give_up(descriptor, path, file.st_size)
            return is_left
        if not _at_work(path.name, data, has_lock=True):
            return False
        with _abandoned(path.with_name(f'{path.name}_el')) as has_lock:
            if has_lock is None:
                return False
            found = _at_work(path.name, os.pread(descriptor, file.st_size, 0), has_lock=has_lock)
            for offset, flags in found if is_done else ():
                os.pwrite(descriptor, bytes((flags & ~PROCESSING | WAITING,)), offset)
            return bool(found)
    except OSError:
        return False
    finally:
        os.close(descriptor)


def _is_unfinished(data: bytes) -> bool:
    return not data or (len(data) >= _WORD.size and _WORD.unpack_from(data)[0] in {_UNINITIALIZED, _INITIALIZING})


def _give_up(descriptor: int, path: Path, size: int) -> None:
    """Tell those who wait for it, as boost does where making it fails."""
    path.unlink()
    if size:
        os.pwrite(descriptor, _WORD.pack(_CORRUPTED), 0)
    else:
        os.ftruncate(descriptor, 1)


def _at_work(name: str, data: bytes, *, has_lock: bool) -> list[tuple[int, int]]:
    """(offset, flags) of the listeners that are to be settled; none where anything is not as expected."""
    match = _PORT.fullmatch(name)
    end = data.find(_NAME)
    if match is None or data.find(_NAME, end + 1) >= 0:
        return []
    for mutex in _MUTEXES:
        size = (_FIRST + 2 * mutex + _LISTENERS * _LISTENER + _DOMAIN + 7) & ~7
        start = end - size
        first = start + _FIRST + 2 * mutex
        domain = first + _LISTENERS * _LISTENER
        if start < 0 or data[domain : domain + _DOMAIN] != match[1].encode().ljust(_DOMAIN, b'\0'):
            continue
        _, number, listeners, check_ms, wait_ms, _, _, flags = _HEAD.unpack_from(data, start)
        used = [(at, data[at]) for at in range(first, domain, _LISTENER) if data[at] & IN_USE]
        if number != int(match[2]) or listeners != len(used) or wait_ms != check_ms // 3 or not flags & _IS_EXCLUSIVE:
            continue
        if has_lock:
            return [each for each in used if each[1] & (WAITING | PROCESSING) != WAITING]
        return [each for each in used if each[1] & PROCESSING and not flags & _IS_OK]
    return []


@contextmanager
def _abandoned(path: Path) -> Iterator[bool | None]:
    """Hold the lock of a port whose listener is dead: True. False where it has no lock; None where its listener lives."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        yield False
        return
    except OSError:
        yield None
        return
    try:
        yield _lock(descriptor, path)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> bool | None:
    """True where it was had, and is that of the path still."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True if path.stat().st_ino == os.fstat(descriptor).st_ino else None
    except OSError:
        return None


def main(parent: int) -> None:
    """Wait until the parent is gone; then settle."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):  # who ends all that a service has left comes too early
        signal.signal(number, signal.SIG_IGN)
    end_s = time.monotonic() + _ENDING_S
    while os.getppid() == parent and time.monotonic() < end_s:
        time.sleep(0.01)
    settle()


if __name__ == '__main__':
    main(int(sys.argv[1]))
