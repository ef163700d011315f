"""Notifications to systemd, over a socket like systemd's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from shadowhound_data_logger.node.node import SystemdService


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    """The receiving end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / 'notify'))
        receiver.settimeout(5.0)
        yield receiver


def _environ(receiver: socket.socket, **more: str) -> dict[str, str]:
    return {'NOTIFY_SOCKET': str(receiver.getsockname()), **more}


def test_systemd_is_notified_of_ready_and_stopping(systemd: socket.socket) -> None:
    """Readiness includes what is logged, and the stop is announced."""
    service = SystemdService(_environ(systemd))
    service.ready('logging /odom')
    assert systemd.recv(1000) == b'READY=1\nSTATUS=logging /odom'
    service.stopping()
    assert systemd.recv(1000).startswith(b'STOPPING=1\n')


def test_the_watchdog_is_pinged_several_times_per_interval(systemd: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Running the loop fifty times in two thirds of the interval pings three times."""
    now = 100.0
    monkeypatch.setattr('shadowhound_data_logger.node.node.time.monotonic', lambda: now)
    service = SystemdService(_environ(systemd, WATCHDOG_USEC='30000000', WATCHDOG_PID=str(os.getpid())))
    for _ in range(50):
        service.alive()
        now += 0.42
    reports = [systemd.recv(1000) for _ in range(3)]
    assert reports == [b'WATCHDOG=1'] * 3
    systemd.setblocking(False)
    with pytest.raises(BlockingIOError):
        systemd.recv(1000)


@pytest.mark.parametrize('more', [{}, {'WATCHDOG_USEC': '30000000', 'WATCHDOG_PID': '1'}, {'WATCHDOG_USEC': 'soon'}])
def test_without_a_watchdog_nothing_is_sent(systemd: socket.socket, more: dict[str, str]) -> None:
    """Nor with a watchdog of another process."""
    service = SystemdService(_environ(systemd, **more))
    service.alive()
    systemd.setblocking(False)
    with pytest.raises(BlockingIOError):
        systemd.recv(1000)


def test_child_processes_do_not_notify_systemd(systemd: socket.socket) -> None:
    """The variables are removed from the environment that children inherit."""
    environ = _environ(systemd, WATCHDOG_USEC='1000000', WATCHDOG_PID=str(os.getpid()), HOME='/root')
    SystemdService(environ)
    assert environ == {'HOME': '/root'}


def test_an_unreachable_systemd_is_not_a_failure(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A missing socket is logged once, and the node continues; without systemd nothing is logged."""
    service = SystemdService({'NOTIFY_SOCKET': str(tmp_path / 'gone')})
    service.ready('x')
    service.stopping()
    assert [record.message for record in caplog.records if 'systemd' in record.message] != []
    assert len(caplog.records) == 1
    SystemdService({}).ready('x')
    assert len(caplog.records) == 1
