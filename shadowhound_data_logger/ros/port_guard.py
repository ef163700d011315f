"""Prevents a killed listener from blocking its publishers, if Fast DDS uses shared memory.

A listener marks in its port that it processes a message. If it is killed at that moment, the mark stays. Fast DDS notices this
within seconds and flags the port. A publisher that meets the flag during a message tries to clear the mark, waits for a mutex
that it holds itself, times out after a second and tries again, endlessly: its ``publish`` never returns (Fast DDS 2.6 to 3.6:
SharedMemManager.hpp, ``recover_blocked_processing``; SharedMemGlobal.hpp, ``get_and_remove_blocked_processing``; Fast-DDS
issue 6484, pull request 6497).

``settle`` clears the mark: one byte then states that the listener waits, and because it never wakes up, Fast DDS abandons the
port within seconds. That also ends such a loop, as long as the port has not been replaced, and also works for a listener that was
killed between waiting and processing (pull request 4737).

A process that is killed while it creates a port leaves an unfinished one, and every process that opens it waits forever
(managed_open_or_create_impl.hpp of boost interprocess). ``settle`` marks it as damaged, and the next process creates it again.

    flock --no-fork FILE python -I -S port_guard.py PID

As a program, which ``flock`` executes once its parent has released the lock, it settles what the parent left. It imports nothing
from the package.

This is the only module that writes into files of another library. ``SHADOWHOUND_PORT_GUARD=off`` turns it off
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
"""Creating a port takes less than a millisecond."""
_MOST_BYTES: Final = 4 << 20
"""A port of 512 messages, the default, has 52 KB."""
_ENDING_S: Final = 5.0
"""Wait for a parent that has released the lock but not exited: it releases its other locks at exit."""

# The first word of a segment of boost interprocess, as managed_open_or_create_impl.hpp numbers them.
_WORD: Final = struct.Struct('=I')
_UNINITIALIZED, _INITIALIZING, _CORRUPTED = 0, 1, 3

# struct PortNode of SharedMemGlobal.hpp, ABI 5: the same in 2.6.10, 2.14.5, 3.2.3, 3.6.1 and later until August 2026.
# Its name follows it; between its head and the listeners are 512 semaphores and two mutexes of the C library.
_NAME: Final = b'port_node_abi5\0'
_HEAD: Final = struct.Struct('=8xI8xIIIIIII')
"""References, number of the port, listeners, two periods in ms, capacity, number of waiting listeners, flags."""
_IS_OK, _IS_EXCLUSIVE = 1, 2
_MUTEXES: Final = (40, 48)
"""sizeof(pthread_mutex_t) on x86-64 and on aarch64."""
_FIRST: Final = 56 + 512 * 40 + 2 * 8
"""Offset of the listeners without the two mutexes."""
_LISTENERS, _LISTENER = 1024, 20
_DOMAIN: Final = 17
IN_USE, WAITING, PROCESSING = 1, 2, 4
"""Flags in the first byte of a listener, which only it writes."""


def is_enabled() -> bool:
    """Whether the guard is enabled."""
    return os.environ.get('SHADOWHOUND_PORT_GUARD', 'on').lower() not in {'off', '0', 'false', 'no'}


def settle(folder: Path = FOLDER, *, dry_run: bool = False) -> list[str]:
    """Ports of this user that are marked as in use by a dead listener, or that were never finished.

    With ``dry_run`` they are only listed. A listener is dead if the lock of its port can be acquired. If a publisher has
    removed the lock's file, only a port that Fast DDS has flagged is settled: a live listener leaves such a port on its own and
    clears its mark, too.
    """
    if not is_enabled():
        return []
    try:
        found = sorted(folder.iterdir())
    except OSError:
        return []
    return [path.name for path in found if _PORT.fullmatch(path.name) and _settle(path, dry_run=dry_run)]


def _settle(path: Path, *, dry_run: bool) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # removed since, or no permission
        return False
    try:
        file = os.fstat(descriptor)
        if not stat.S_ISREG(file.st_mode) or file.st_uid != os.geteuid() or file.st_size > _MOST_BYTES:
            return False
        data = os.pread(descriptor, file.st_size, 0)
        if _is_unfinished(data):
            is_left = time.time() - file.st_mtime >= MAKING_S
            if is_left and not dry_run:
                _give_up(descriptor, path, file.st_size)
            return is_left
        if not _busy_listeners(path.name, data, has_lock=True):
            return False
        with _abandoned(path.with_name(f'{path.name}_el')) as has_lock:
            if has_lock is None:
                return False
            found = _busy_listeners(path.name, os.pread(descriptor, file.st_size, 0), has_lock=has_lock)
            for offset, flags in () if dry_run else found:
                os.pwrite(descriptor, bytes((flags & ~PROCESSING | WAITING,)), offset)
            return bool(found)
    except OSError:
        return False
    finally:
        os.close(descriptor)


def _is_unfinished(data: bytes) -> bool:
    return not data or (len(data) >= _WORD.size and _WORD.unpack_from(data)[0] in {_UNINITIALIZED, _INITIALIZING})


def _give_up(descriptor: int, path: Path, size: int) -> None:
    """Mark it as failed for waiting processes, as boost does."""
    path.unlink()
    if size:
        os.pwrite(descriptor, _WORD.pack(_CORRUPTED), 0)
    else:
        os.ftruncate(descriptor, 1)


def _busy_listeners(name: str, data: bytes, *, has_lock: bool) -> list[tuple[int, int]]:
    """(offset, flags) of the listeners to be settled; empty if anything is not as expected."""
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
    """Hold the lock of a port whose listener is dead: True. False if it has no lock; None if its listener is alive."""
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
    """True if it was acquired and still belongs to the path."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True if path.stat().st_ino == os.fstat(descriptor).st_ino else None
    except OSError:
        return None


def main(parent: int) -> None:
    """Wait until the parent has exited; then settle."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):  # SIGTERM to the complete service arrives too early
        signal.signal(number, signal.SIG_IGN)
    end_s = time.monotonic() + _ENDING_S
    while os.getppid() == parent and time.monotonic() < end_s:
        time.sleep(0.01)
    settle()


if __name__ == '__main__':
    main(int(sys.argv[1]))
