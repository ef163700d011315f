"""Shared memory that killed processes leave in /dev/shm: Fast DDS keeps 35 MB (with our profile) for each of them.

The owner of a segment ``fastdds_X`` (Fast DDS 3) or ``fastrtps_X`` (Fast DDS 2), where X is 16 random hex digits, holds a flock
on the file ``..._X_el`` in the same folder for as long as it runs, in any container; a segment whose lock can be acquired has
no owner. Source: RobustExclusiveLock.hpp and SharedMemManager.hpp of Fast DDS 2.6, 2.14 and 3.6. Two kinds are not freed:
``fast_datasharing_...``, whose owner cannot be determined, and ``..._portN``, which are small and reused by the next process of
the same domain. That process may miss messages of publishers that wrote to the dead one: they keep using the segment that it
replaced. Fast DDS repairs that within a second, unless the listener was killed between waiting for a message and processing it
(SharedMemGlobal.hpp, ``update_status_all_listeners``; Fast-DDS pull request 4737); ``dead_ports_avoided`` handles that case.
Worse, a listener killed while it processed a message can block its publishers: ``port_guard`` and ``PortGuard`` handle that.
"""

from __future__ import annotations

import logging
import os
import re
import stat
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.ros import port_guard
from shadowhound_data_logger.ros.port_guard import FOLDER, settle

log = logging.getLogger(__name__)
STARTING_S: Final = 5.0
"""A starting process has its file before it has its lock."""
MAX_DEAD_PORTS: Final = 50
"""Fast DDS tries a hundred."""
_PORT: Final = re.compile(r'((?:fastdds|fastrtps)_port(\d{4,5}))_el')
_LOCK: Final = re.compile(r'(?:fastdds|fastrtps)_[0-9a-f]{16}_el')


@dataclass(frozen=True, slots=True)
class Orphan:
    """A segment of this user whose owner is dead."""

    name: str
    bytes: int


def orphans(folder: Path = FOLDER, *, free: bool = False) -> list[Orphan]:
    """List them; with ``free`` they are removed. Segments of other users are never touched."""
    found = []
    for path in _locks(folder):
        with _owned(path) as has_no_owner:
            if has_no_owner:
                segment = path.with_name(path.name.removesuffix('_el'))
                size = _size(segment)
                if free:
                    for each in (segment, path):
                        with suppress(OSError):
                            each.unlink()
                if size is not None:
                    found.append(Orphan(segment.name, size))
    return found


@contextmanager
def dead_ports_avoided(domain: int, folder: Path = FOLDER, processes: Path = Path('/proc')) -> Iterator[list[str]]:
    """Makes participants created within it avoid the ports of killed ones; yields the names of these ports.

    Only if a running process may still write to their segments; the others can be reused. Fast DDS skips a port whose lock is
    held.
    Ports that could block other processes are settled first: that is impossible once a port is reused.
    """
    if settled := settle(folder):
        log.warning('leftovers of killed processes in shared memory could have blocked others: settled %s', ', '.join(settled))
    first = 7400 + 250 * domain  # RTPS 2.2, 9.6.1.1; from 7000 on are readers with a separate network flow, of any domain
    ours = (*range(7000, 7400), *range(first, first + 250))
    dead = {}
    for path in _entries(folder):
        if (found := _PORT.fullmatch(path.name)) is not None and int(found[2]) in ours:
            with suppress(OSError):  # Fast DDS ignores a lock without a segment
                dead[found[1]] = path.with_name(found[1]).lstat().st_mtime_ns
    written = sorted(_mapped(processes, dead), key=lambda name: (-dead[name], name))  # the most recently killed first
    with ExitStack() as held:
        yield [name for name in written[:MAX_DEAD_PORTS] if _has_lock(folder / f'{name}_el', held)]


class PortGuard:
    """A process that runs briefly after this one was killed, to repair its ports; none if it has no ports.

    Lifecycle: New once the participants exist; ``close`` after they are destroyed. Until then it is ``flock`` (1.8 MB), which
    waits for a lock held by this process, and then executes ``port_guard``.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if not port_guard.is_enabled() or not _has_ports():
            return
        self._locked = os.memfd_create('port_guard')
        lock(self._locked)
        program = [sys.executable, '-I', '-S', port_guard.__file__, str(os.getpid())]
        environ = {name: os.environ[name] for name in ('PATH', 'LD_LIBRARY_PATH') if name in os.environ}  # no credentials
        try:
            self._process = subprocess.Popen(
                ['flock', '--no-fork', f'/proc/{os.getpid()}/fd/{self._locked}', *program],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environ,
                start_new_session=True,  # Ctrl-C in a terminal and signals to our process group must not reach it
            )
        except OSError as error:
            os.close(self._locked)
            log.warning('no process repairs our shared memory if this process is killed (util-linux has flock): %s', error)

    def close(self) -> None:
        """Idempotent."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            os.close(self._locked)


def _has_ports() -> bool:
    """Whether this process listens through shared memory: it then holds the lock of a port."""
    for descriptor in Path('/proc/self/fd').iterdir():
        with suppress(OSError):  # closed since
            if _PORT.fullmatch(descriptor.readlink().name):
                return True
    return False


def _has_lock(path: Path, held: ExitStack) -> bool:
    """Whether the lock was acquired; it is released with the stack."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # removed since, or no permission
        return False
    held.callback(os.close, descriptor)
    return lock(descriptor, wait=False)  # otherwise its owner is alive


def _mapped(processes: Path, ports: Iterable[str]) -> set[str]:
    """The ports that a process has mapped; all of them if one process cannot be inspected."""
    ports = set(ports)
    found = set[str]()
    for process in processes.glob('[0-9]*/maps') if ports else ():
        try:
            maps = process.read_text(errors='replace')
        except PermissionError:
            return ports
        except OSError:  # it ended
            continue
        found |= {name for name in ports - found if f'/{name}\n' in maps or f'/{name} (deleted)' in maps}
    return found


def _locks(folder: Path) -> Iterator[Path]:
    return (path for path in _entries(folder) if _LOCK.fullmatch(path.name))


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


@contextmanager
def _owned(path: Path) -> Iterator[bool]:
    """Hold the lock of a segment without an owner; yields whether it was acquired."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # removed since, or no permission
        yield False
        return
    try:
        found = os.fstat(descriptor)
        is_ours = stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid()
        is_old = time.time() - found.st_mtime >= STARTING_S
        yield is_ours and is_old and lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _size(segment: Path) -> int | None:
    """Size of its memory; None if it has none that belongs to this user."""
    try:
        found = segment.lstat()
    except OSError:
        return None
    return found.st_blocks * 512 if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() else None
