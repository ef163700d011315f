"""CPU time and memory of processes, read from /proc: each process includes its descendants (proc(5))."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, NamedTuple

TICK_S: Final = 1.0 / os.sysconf('SC_CLK_TCK')
MEGA: Final = 1_000_000
_KINDS: Final = {'RssAnon': 'anon', 'RssFile': 'file', 'RssShmem': 'shmem'}


class _Stat(NamedTuple):
    parent: int
    ticks: int
    """utime + stime of the process, and of its children that have exited and were waited for."""


class Memory(NamedTuple):
    """Resident memory of a process tree, MB (1e6 bytes): ``anon`` is private, ``file`` and ``shmem`` may be shared."""

    anon: float
    file: float
    shmem: float

    @property
    def resident(self) -> float:
        return self.anon + self.file + self.shmem


def cpu_s(pid: int) -> float:
    """CPU seconds, user and system, of a process and all its descendants, including those that exited."""
    stats = _stats()
    return sum(stats[number].ticks for number in _tree(pid, stats)) * TICK_S


def threads(pid: int) -> dict[str, float]:
    """CPU seconds of the threads of a process by name, as shown by ``top -H``; threads of equal name are added.

    The main thread, which has the name of the program, is ``main``.
    """
    used: dict[str, float] = {}
    for entry in Path(f'/proc/{pid}/task').iterdir():
        try:
            name = 'main' if entry.name == str(pid) else (entry / 'comm').read_text(encoding='utf-8').strip()
            nanoseconds = int((entry / 'schedstat').read_text(encoding='ascii').split()[0])
        except OSError:  # it has ended since
            continue
        used[name] = used.get(name, 0.0) + nanoseconds / 1e9
    return used


def memory(pid: int) -> Memory:
    """The current memory of a process and its descendants."""
    total = dict.fromkeys(Memory._fields, 0.0)
    for number in _tree(pid, _stats()):
        try:
            lines = Path(f'/proc/{number}/status').read_text(encoding='utf-8').splitlines()
        except OSError:  # it has ended since
            continue
        for line in lines:
            name, _, value = line.partition(':')
            if name in _KINDS:
                total[_KINDS[name]] += int(value.split()[0]) * 1024 / MEGA
    return Memory(**total)


def load() -> float:
    """Load average of the last minute: other work on this machine."""
    return os.getloadavg()[0]


def busy_s() -> float:
    """CPU seconds that this machine has used since boot, on all cores."""
    fields = Path('/proc/stat').read_text(encoding='ascii').split('\n', 1)[0].split()[1:]
    user, nice, system, _idle, _iowait, irq, softirq, *_ = (int(field) for field in fields)
    return (user + nice + system + irq + softirq) * TICK_S


def _stats() -> dict[int, _Stat]:
    found: dict[int, _Stat] = {}
    for entry in Path('/proc').iterdir():
        if entry.name.isdecimal():
            try:
                text = (entry / 'stat').read_text(encoding='utf-8', errors='replace')
            except OSError:  # it has ended since
                continue
            fields = text.rpartition(')')[2].split()
            found[int(entry.name)] = _Stat(int(fields[1]), sum(int(field) for field in fields[11:15]))
    return found


def _tree(pid: int, stats: dict[int, _Stat]) -> list[int]:
    """The process and its descendants; empty if it has exited."""
    children: dict[int, list[int]] = {}
    for number, stat in stats.items():
        children.setdefault(stat.parent, []).append(number)
    found = [pid] if pid in stats else []
    for number in found:
        found += children.get(number, [])
    return found
