"""Ports of killed listeners: the changes to them, the exceptions, and that publishers continue."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from domains import free_domain
from ros.ports import CONDITION, DEAD, HEAD, LISTENERS, MUTEX, OTHER_MUTEX, SETTLED, ports_of, seem_to_process

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.ros import port_guard
from shadowhound_data_logger.ros.port_guard import IN_USE, MAKING_S, PROCESSING, WAITING, settle
from shadowhound_data_logger.ros.shared_memory import PortGuard

HERE = Path(__file__).parent
PORT = 'fastrtps_port7411'
WAIT_S = 60.0


def segment(
    *listeners: int, name: str = PORT, mutex: int = MUTEX, is_ok: bool = True, is_exclusive: bool = True, number: int = 0,
    counted: int | None = None, periods: tuple[int, int] = (1000, 333), abi: bytes = b'port_node_abi5',
) -> bytes:  # fmt: skip
    """A port as Fast DDS creates it, with the flags of its first listeners."""
    domain, port = name.split('_port')
    node = bytearray(CONDITION + 2 * mutex + 20 * LISTENERS + 24)
    struct.pack_into(
        '=8IB', node, 8, 2, 0, 0, number or int(port), len(listeners) if counted is None else counted, *periods, 512, 0
    )
    node[44] = is_ok | is_exclusive << 1 | 4
    for place, flags in enumerate(listeners):
        node[CONDITION + 2 * mutex + 20 * place] = flags
    at = CONDITION + 2 * mutex + 20 * LISTENERS
    node[at : at + len(domain)] = domain.encode()
    size = (at + 17 + 7) & ~7
    return struct.pack('=I', 2).ljust(HEAD, b'\1') + bytes(node[:size].ljust(size, b'\0')) + abi + bytes(11000)


def first(path: Path, mutex: int = MUTEX) -> int:
    """The flags of the first listener."""
    return path.read_bytes()[HEAD + CONDITION + 2 * mutex]


@pytest.fixture
def shm(tmp_path: Path) -> Path:
    return tmp_path


def leave(shm: Path, *listeners: int, name: str = PORT, has_lock: bool = True, **more: object) -> Path:
    """A port without an owner."""
    path = shm / name
    path.write_bytes(segment(*listeners, name=name, **more))  # type: ignore[arg-type]
    if has_lock:
        (shm / f'{name}_el').touch()
    return path


@pytest.mark.parametrize(('name', 'mutex'), [(PORT, MUTEX), ('fastdds_port17411', OTHER_MUTEX)])
@pytest.mark.parametrize('flags', [DEAD, IN_USE, DEAD | WAITING])
def test_a_dead_listener_is_marked_as_waiting(shm: Path, name: str, mutex: int, flags: int) -> None:
    """Exactly one byte changes, once, and only on request; on both machines, for both names."""
    path = leave(shm, flags, name=name, mutex=mutex)
    before = path.read_bytes()
    assert settle(shm, dry_run=True) == [name]
    assert path.read_bytes() == before
    assert settle(shm) == [name]
    assert first(path, mutex) == SETTLED
    assert sum(old != new for old, new in zip(before, path.read_bytes(), strict=True)) == 1
    assert settle(shm) == []


def test_running_listeners_are_left_alone(shm: Path) -> None:
    """However busy it is, and also if Fast DDS has marked its port."""
    for is_ok in (True, False):
        path = leave(shm, DEAD, is_ok=is_ok)
        with flock(shm / f'{PORT}_el'):
            assert settle(shm) == []
        assert first(path) == DEAD


def test_without_a_lock_only_marked_ports_are_changed(shm: Path) -> None:
    """A blocked publisher has removed the lock's file before."""
    path = leave(shm, DEAD, has_lock=False)
    assert settle(shm) == []
    path.write_bytes(segment(IN_USE, is_ok=False))
    assert settle(shm) == []
    path.write_bytes(segment(DEAD, is_ok=False))
    assert settle(shm) == [PORT]
    assert not first(path) & PROCESSING


@pytest.mark.parametrize(
    'data',
    [
        segment(DEAD, number=7413), segment(DEAD, counted=2), segment(DEAD, periods=(1000, 300)),
        segment(DEAD, is_exclusive=False), segment(DEAD, abi=b'port_node_abi6'), segment(DEAD, name='fastdds_port7411'),
        segment(DEAD, mutex=56), segment(DEAD) + segment(DEAD), b'\2\0\0\0' + segment(DEAD)[20000:], segment(SETTLED),
        segment(PROCESSING), b'x', b'\2\0\0\0', segment(DEAD).ljust(5 << 20, b'\0'),
    ],
)  # fmt: skip
def test_an_unexpected_layout_is_left_alone(shm: Path, data: bytes) -> None:
    """Another ABI, another architecture, inconsistent numbers, half a port, two of them: not a byte is written."""
    path = leave(shm)
    path.write_bytes(data)
    os.utime(path, (0, 0))
    assert settle(shm) == []
    assert path.read_bytes() == data


def test_ports_of_other_programs_are_left_alone(
    shm: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links, pipes, other names, and files of another user."""
    outside = tmp_path_factory.mktemp('outside') / PORT
    outside.write_bytes(segment(DEAD))
    (shm / PORT).symlink_to(outside)
    os.mkfifo(shm / 'fastrtps_port7413')
    other = shm / 'fastrtps_0123456789abcdef'
    other.write_bytes(segment(DEAD))
    assert settle(shm) == []
    assert [each.read_bytes() for each in (outside, other)] == [segment(DEAD)] * 2
    (shm / PORT).unlink()
    path, mine = leave(shm, DEAD), os.geteuid()
    monkeypatch.setattr(os, 'geteuid', lambda: mine + 1)
    assert settle(shm) == []
    assert path.read_bytes() == segment(DEAD)
    assert settle(shm / 'none') == []


@pytest.mark.parametrize(('data', 'told'), [(b'', b'\0'), (bytes(52400), b'\3\0\0\0'), (b'\1'.ljust(52400, b'\0'), b'\3\0\0\0')])
def test_an_unfinished_port_is_abandoned(shm: Path, data: bytes, told: bytes) -> None:
    """A waiting process finds that it is damaged, and the next one creates another."""
    path = leave(shm)
    path.write_bytes(data)
    assert settle(shm) == [], 'it may be in the making'
    os.utime(path, (time.time() - 2 * MAKING_S,) * 2)
    with path.open('rb') as waiting:
        assert settle(shm, dry_run=True) == [PORT]
        assert settle(shm) == [PORT]
        assert waiting.read()[:4] == told
    assert not path.exists()


def test_a_program_without_ports_has_no_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is started, and stopping it has no effect."""
    monkeypatch.setattr(subprocess, 'Popen', None)
    PortGuard().close()


def test_an_operator_can_turn_it_off(monkeypatch: pytest.MonkeyPatch, shm: Path) -> None:
    """No guard is started and no port is written to, even one that would otherwise be fixed."""
    (shm / PORT).touch()
    left = time.time() - MAKING_S - 1
    os.utime(shm / PORT, (left, left))
    monkeypatch.setenv('SHADOWHOUND_PORT_GUARD', 'off')
    assert settle(shm) == []
    monkeypatch.setattr('shadowhound_data_logger.ros.shared_memory._has_ports', lambda: True)
    with monkeypatch.context() as context:
        context.setattr(subprocess, 'Popen', None)
        PortGuard().close()
    monkeypatch.delenv('SHADOWHOUND_PORT_GUARD')
    assert settle(shm, dry_run=True) == [PORT]


def until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


class Pair:
    """A publisher, which counts its published messages in a file, and its subscriber."""

    def __init__(self, folder: Path, domain: int, *, is_guarded: bool) -> None:
        environ = {**os.environ, 'ROS_DOMAIN_ID': str(domain)}
        self._count = folder / 'count'
        program = str(HERE / 'publisher_and_listener.py')
        self.publisher = subprocess.Popen([sys.executable, program, 'publisher', str(self._count)], env=environ)
        received = folder / 'heard'
        who = 'guarded' if is_guarded else 'listener'
        self.listener = subprocess.Popen([sys.executable, program, who, str(received)], env=environ)
        until(received.exists, 'the listener hears')
        self.ports = ports_of(self.listener.pid)
        if not self.ports:
            pytest.skip('this middleware has no ports in shared memory')

    def kill_listener(self) -> None:
        """Make it look as if killed while it processes a message."""
        seem_to_process(self.listener.pid, self.ports)
        self.listener.kill()
        self.listener.wait()

    def publishes(self, within_s: float = WAIT_S, but: Callable[[], object] = lambda: None) -> bool:
        """``but`` undoes the changes of other tests' programs that start at the same time."""
        before, end = self._published(), time.monotonic() + within_s
        while time.monotonic() < end:
            but()
            if self._published() > before + 3:
                return True
            time.sleep(0.02)
        return False

    def end(self) -> None:
        for process in (self.listener, self.publisher):
            process.kill()
            process.wait()
        for port in self.ports:
            port.path.unlink(missing_ok=True)

    def _published(self) -> int:
        return self._count.stat().st_size


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Callable[[bool], Pair]]:
    pytest.importorskip('rclpy')
    made: list[Pair] = []

    def make(is_guarded: bool) -> Pair:
        made.append(Pair(tmp_path, domain, is_guarded=is_guarded))
        return made[-1]

    with free_domain() as domain:
        try:
            yield make
        finally:
            for each in made:
                each.end()


@pytest.mark.ros
@pytest.mark.long('a kill')
def test_a_blocked_publisher_continues(pair: Callable[[bool], Pair]) -> None:
    """Without the guard it is blocked; should that fail, Fast DDS has been fixed."""
    two = pair(False)
    two.kill_listener()
    for port in two.ports:
        port.seem_to_process()  # another test's program may have fixed it
        port.be_marked_in_the_middle()
    assert not two.publishes(5.0, but=lambda: [port.seem_to_process() for port in two.ports]), 'nothing stops it'
    settle()
    assert two.publishes()


@pytest.mark.ros
@pytest.mark.long('a kill')
def test_a_guard_acts_before_fast_dds_notices(pair: Callable[[bool], Pair]) -> None:
    """So the publisher is never blocked, at whatever moment Fast DDS marks the port."""
    two = pair(True)
    assert two.publishes()
    two.kill_listener()
    killed_s = time.monotonic()
    until(lambda: all(port.flags == SETTLED for port in two.ports), 'the guard settles the ports')
    print(f'settled {time.monotonic() - killed_s:.3f} s after the kill')  # noqa: T201 - pytest shows it with -s
    for port in two.ports:
        port.be_marked_in_the_middle()
    assert two.publishes()


def test_the_guard_imports_nothing_of_the_package() -> None:
    """It runs where Python finds no package."""
    command = [sys.executable, '-I', '-S', str(port_guard.__file__), '0']
    assert subprocess.run(command, check=False, capture_output=True).returncode == 0
