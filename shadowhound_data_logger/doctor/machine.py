"""The kernel's view of this machine: processes and their variables, sockets, locks. All from ``/proc``, see proc(5)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

LISTEN: Final = '0A'
"""State of a TCP socket, ``TCP_LISTEN`` of include/net/tcp_states.h."""
DISCOVERY_PORTS: Final = (7400, 7410)
DOMAIN_GAIN: Final = 250
"""Plus 250 * domain: the port of every participant with multicast, and of the first one without (DDSI-RTPS 2.2, 9.6.1.1)."""
MAX_DOMAIN: Final = 232


@dataclass(frozen=True, slots=True)
class Process:
    """A process of this machine; ``environ`` is empty if it belongs to another user."""

    pid: int
    command: str
    uid: int
    environ: dict[str, str] = field(default_factory=dict, repr=False)


def processes(root: Path, *names: str) -> list[Process]:
    """Processes whose program or script contains one of the names."""
    found = []
    for folder in (root / 'proc').glob('[0-9]*'):
        try:
            words = (folder / 'cmdline').read_bytes().decode(errors='replace').split('\0')
            if int(folder.name) != os.getpid() and any(name in word for word in words[:3] for name in names):
                command = ' '.join(words).strip()
                found.append(Process(int(folder.name), command, folder.stat().st_uid, variables(root, int(folder.name))))
        except OSError:  # it has ended since
            continue
    return sorted(found, key=lambda process: process.pid)


def variables(root: Path, pid: int) -> dict[str, str]:
    """The variables that a process was started with; empty if they may not be read."""
    try:
        text = (root / 'proc' / str(pid) / 'environ').read_bytes().decode(errors='replace')
    except OSError:
        return {}
    return dict(line.split('=', 1) for line in text.split('\0') if '=' in line)


def command(root: Path, pid: int) -> str:
    """The command line of a process, as in ``ps``."""
    try:
        text = (root / 'proc' / str(pid) / 'cmdline').read_bytes().decode(errors='replace')
    except OSError:
        return ''
    return text.replace('\0', ' ').strip()


def listening(root: Path) -> set[tuple[bool, int]]:
    """(whether it is bound to loopback, port) of each listening TCP socket."""
    found = set()
    for name in ('tcp', 'tcp6'):
        for address, state in _sockets(root, name):
            host, _, port = address.rpartition(':')
            if state == LISTEN:
                found.add((_is_loopback(host), int(port, 16)))
    return found


def domains(root: Path) -> list[int]:
    """ROS domains with a participant on this machine."""
    ports = {int(address.rpartition(':')[2], 16) for name in ('udp', 'udp6') for address, _ in _sockets(root, name)}
    numbers = ((port - base) / DOMAIN_GAIN for port in ports for base in DISCOVERY_PORTS)
    return sorted({int(number) for number in numbers if number.is_integer() and 0 <= number <= MAX_DOMAIN})


def lock_holder(root: Path, path: Path) -> int | None:
    """The process that holds a flock on this file; None if there is none. It does not take the lock, so it disturbs nothing."""
    try:
        status = path.stat()
        lines = (root / 'proc/locks').read_text(encoding='ascii').splitlines()
    except OSError:
        return None
    wanted = f'{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}'
    for line in lines:
        fields = line.split()
        if fields[1] == 'FLOCK' and fields[5] == wanted:
            return int(fields[4])
    return None


def number(path: Path) -> int | None:
    """The value of a kernel file that contains one number."""
    try:
        return int(path.read_text(encoding='ascii'))
    except (OSError, ValueError):
        return None


def _sockets(root: Path, name: str) -> Iterator[tuple[str, str]]:
    """(local address, state) in the format of ``/proc/net/tcp``."""
    try:
        lines = (root / 'proc/net' / name).read_text(encoding='ascii').splitlines()[1:]
    except OSError:
        return
    for line in lines:
        fields = line.split()
        if len(fields) > 3:
            yield fields[1], fields[3]


def _is_loopback(host: str) -> bool:
    """Whether a hexadecimal address is loopback; each 32-bit word has the machine's byte order."""
    if len(host) == 8:
        return host.endswith('7F')
    return host == '00000000000000000000000001000000' or (host[16:24] == 'FFFF0000' and host.endswith('7F'))
