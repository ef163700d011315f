"""Shared memory that killed processes leave in /dev/shm: Fast DDS keeps there 35 MB (with our profile) for each of them.

The owner of a segment ``fastdds_X`` (Fast DDS 3) or ``fastrtps_X`` (Fast DDS 2), where X is 16 random hex digits, holds a flock
on the file ``..._X_el`` beside it for as long as it lives, in whatever container; a segment whose lock can be had has no owner.
Source: RobustExclusiveLock.hpp and SharedMemManager.hpp of Fast DDS 2.6, 2.14 and 3.6. Not freed are ``fast_datasharing_...``,
of which nothing tells whether somebody lives, and ``..._portN``, which are small and taken over by the next process of the same
domain. That one may hear nothing of processes that wrote to the dead one: they go on with the segment that it replaced. Fast DDS
mends that within a second, but not where the listener died between waiting for a message and processing it (SharedMemGlobal.hpp,
``update_status_all_listeners``; Fast-DDS pull request 4737). ``dead_ports_avoided`` is for that. What is worse, a listener that
died while it processed a message can stop who writes to it: ``port_guard`` and ``PortGuard`` are for that.
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
"""A process that starts has its file before it has its lock."""
MAX_DEAD_PORTS: Final = 50
"""Fast DDS tries a hundred."""
_PORT: Final = re.compile(r'((?:fastdds|fastrtps)_port(\d{4,5}))_el')
_LOCK: Final = re.compile(r'(?:fastdds|fastrtps)_[0-9a-f]{16}_el')


@dataclass(frozen=True, slots=True)
class Orphan:
    """A segment of this user whose owner is dead."""

    name: str
    bytes: int


def orphans(folder: Path = FOLDER, *, is_freed: bool = False) -> list[Orphan]:
    """Those that there are; with ``is_freed`` they are removed. Segments of other users are never touched."""
    found = []
    for path in _locks(folder):
        with _owned(path) as has_no_owner:
            if has_no_owner:
                segment = path.with_name(path.name.removesuffix('_el'))
                size = _size(segment)
                if is_freed:
                    for each in (segment, path):
                        with suppress(OSError):
                            each.unlink()
                if size is not None:
                    found.append(Orphan(segment.name, size))
    return found


@contextmanager
def dead_ports_avoided(domain: int, folder: Path = FOLDER, processes: Path = Path('/proc')) -> Iterator[list[str]]:
    """Participants that are made meanwhile take other ports than those of killed ones; yields the names of these.

    Only where a living process may still write to their segment; the others can be taken over. Fast DDS passes over a port whose
    lock somebody has. What may stop those who write to dead ports is settled first: it cannot be once a port is taken over.
    """
    if settled := settle(folder):
        log.warning('what killed processes left in shared memory could have stopped others: settled %s', ', '.join(settled))
    first = 7400 + 250 * domain  # RTPS 2.2, 9.6.1.1; from 7000 on are readers with a network flow of their own, of any domain
    ours = (*range(7000, 7400), *range(first, first + 250))
    dead = {}
    for path in _entries(folder):
        if (found := _PORT.fullmatch(path.name)) is not None and int(found[2]) in ours:
            with suppress(OSError):  # a lock without a segment is of no use to Fast DDS
                dead[found[1]] = path.with_name(found[1]).lstat().st_mtime_ns
    written = sorted(_mapped(processes, dead), key=lambda name: (-dead[name], name))  # those that died last first
    with ExitStack() as held:
        yield [name for name in written[:MAX_DEAD_PORTS] if _has_lock(folder / f'{name}_el', held)]


class PortGuard:
    """A process that keeps running for a moment after this one was killed, to repair its ports; none if it has no ports.


    Life: New once the participants are made; ``close`` when they are gone. Until then it is ``flock`` (1.8 MB), which waits for a
    lock that this process has and nobody can take over, and then becomes ``port_guard``.
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
                start_new_session=True,  # Ctrl-C in a terminal, and what is sent to our whole group, is not for it
            )
        except OSError as error:
            os.close(self._locked)
            log.warning('no process looks after our shared memory should we be killed (util-linux has flock): %s', error)

    def close(self) -> None:
        """Idempotent."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            os.close(self._locked)


def _has_ports() -> bool:
    """Whether this process listens through shared memory: it holds the lock of a port then."""
    for descriptor in Path('/proc/self/fd').iterdir():
        with suppress(OSError):  # closed meanwhile
            if _PORT.fullmatch(descriptor.readlink().name):
                return True
    return False


def _has_lock(path: Path, held: ExitStack) -> bool:
    """Whether the lock was to be had; it is let go with the stack."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # gone meanwhile, or not for us
        return False
    held.callback(os.close, descriptor)
    return lock(descriptor, wait=False)  # else its owner lives


def _mapped(processes: Path, ports: Iterable[str]) -> set[str]:
    """Those of them that a process has in its memory; all of them where one cannot be looked at."""
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
    """Hold the lock of a segment that has no other owner; whether that is so."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # gone meanwhile, or not for us
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
    """Of its memory; None where there is none of this user's."""
    try:
        found = segment.lstat()
    except OSError:
        return None
    return found.st_blocks * 512 if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() else None
