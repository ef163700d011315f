"""The demo's processes: the node and the simulated robot, isolated from other ROS nodes; none keeps running after the demo.

The demo stops them; if it is killed, the kernel signals them to stop.
"""

from __future__ import annotations

import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

from shadowhound_data_logger.core.errors import DataLoggerError, SpoolError
from shadowhound_data_logger.doctor.machine import domains
from shadowhound_data_logger.spool import ledger

if TYPE_CHECKING:
    from typing_extensions import Self

ROBOT: Final = 'thor'
READY_S: Final = 60.0
"""Time for a process to start on a busy machine."""
DRAIN_S: Final = 15.0
BACKOFF_S: Final = 4.0
"""Maximum pause between two tries while the S3 server is down: shorter than the default 60 s, so that the catch-up is visible."""
STOP_S: Final = 40.0
TAIL_LINES: Final = 15
FAILURES: Final = ('[ERROR]', '[FATAL]', 'Traceback (most recent call last)')
"""Marks of errors in a ROS log."""
PR_SET_PDEATHSIG: Final = 1
"""linux/prctl.h"""
DOMAINS: Final = range(1, 102)
"""Domains whose ports are below Linux's ephemeral ones; https://docs.ros.org/en/kilted/Concepts/Intermediate/About-Domain-
ID.html
"""
THIS_MACHINE: Final = (
    {'ROS_LOCALHOST_ONLY': '1'} if os.environ.get('ROS_DISTRO') == 'humble' else {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
)
"""Variables that restrict nodes to this machine: Humble does not support the second one."""
FOREIGN_VARIABLES: Final = ('AWS_', 'MLFLOW_', 'SHADOWHOUND_', 'ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY', 'ROS_NAMESPACE')
"""Variables, or prefixes, that could connect the demo to a real Tower or robot."""
OUR_VARIABLE: Final = 'SHADOWHOUND_ENVIRONMENT'
"""Set by scripts/with-env; independent of data."""


class DemoFailed(DataLoggerError):
    """The demo could not be completed."""


class Child:
    """A process of the demo. Its output is in files; Ctrl-C does not reach it; ``stop`` sends SIGINT, waits, and finally kills
    it.
    """

    def __init__(self, module: str, arguments: Iterable[str], environ: Mapping[str, str], log: Path) -> None:
        self.name = module.rpartition('.')[2]
        self.log = log
        self._libc = ctypes.CDLL(None)
        self._is_stopping = False
        with log.open('wb') as errors, log.with_suffix('.out').open('wb') as output:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], env=environ, stdin=subprocess.DEVNULL, stdout=output, stderr=errors,
                start_new_session=True,
                # Safe here: the demo has one thread when it starts its processes, and that thread runs until they exit.
                preexec_fn=self._die_with_the_demo,  # noqa: PLW1509
            )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop(STOP_S)

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    @property
    def output(self) -> str:
        return self.log.with_suffix('.out').read_text(encoding='utf-8')

    def check(self) -> None:
        """Raises DemoFailed if it has exited, unless it succeeded."""
        if self._process.poll():
            raise self.failed(f'exited with code {self._process.returncode}')

    def errors(self) -> list[str]:
        """Lines of its log with severity ERROR or above, or an unhandled exception."""
        lines = self.log.read_text(encoding='utf-8', errors='replace').splitlines()
        return [line for line in lines if any(mark in line for mark in FAILURES)]

    def ask_to_stop(self) -> None:
        """Send SIGINT once: a Python process that exits no longer catches it, and a second one would become its exit code."""
        if self.is_running and not self._is_stopping:
            self._is_stopping = True
            self._process.send_signal(signal.SIGINT)

    def wait(self) -> None:
        """Wait until it exits."""
        self._process.wait()

    def stop(self, timeout_s: float) -> None:
        """SIGINT, and SIGKILL after ``timeout_s``; idempotent."""
        self.ask_to_stop()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def failed(self, what: str) -> DemoFailed:
        lines = self.log.read_text(encoding='utf-8', errors='replace').splitlines()[-TAIL_LINES:]
        return DemoFailed('\n'.join([f'{self.name} {what}; the end of {self.log}:', *lines]))

    def _die_with_the_demo(self) -> None:
        self._libc.prctl(PR_SET_PDEATHSIG, signal.SIGINT)


def free_domain() -> int:
    """A ROS_DOMAIN_ID that is unused on this machine."""
    used = domains(Path('/'))
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        if domain not in used:
            return domain
    raise DemoFailed('there is no free ROS_DOMAIN_ID on this machine', remedy='stop some ROS nodes')


def environment(home: Path, tower: Mapping[str, str], domain: int) -> dict[str, str]:
    """This environment without foreign variables, with the demo's folder, Tower and domain."""
    kept = {name: value for name, value in os.environ.items() if name == OUR_VARIABLE or not name.startswith(FOREIGN_VARIABLES)}
    ours = {'SHADOWHOUND_HOME': str(home), 'SHADOWHOUND_ROBOT': ROBOT, 'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1'}
    return {**kept, **tower, **THIS_MACHINE, **ours}


def start_logger(folder: Path, environ: Mapping[str, str], *, arm: str = '') -> Child:
    """The node, once its spool can be read; its bag has the topics of an arm too. Raises DemoFailed if it does not start."""
    settings: tuple[str, ...] = (f'shutdown.drain_s:={DRAIN_S}', f'upload.max_backoff_s:={BACKOFF_S}', 'bag.record:=mission')
    settings += (f'bag.regex:=^/({arm}/.*|camera/compressed|odom|joint_states)$',) if arm else ()
    arguments = ['--ros-args', *(word for each in settings for word in ('-p', each))]
    node = Child('shadowhound_data_logger.node.sensor_logger_node', arguments, environ, folder / 'node.log')
    end = time.monotonic() + READY_S
    while True:
        try:
            ledger.read(folder / 'home' / 'spool', ROBOT)
            return node
        except SpoolError:
            if not node.is_running or time.monotonic() > end:
                node.stop(0.0)
                raise node.failed('did not start') from None
            time.sleep(0.1)


def start_page(folder: Path, environ: Mapping[str, str]) -> tuple[Child, str]:
    """The live page, and its address. Raises DemoFailed if it does not start."""
    page = Child('shadowhound_data_logger.cli.main', ['live', '--port', '0', '--json'], environ, folder / 'live.log')
    end = time.monotonic() + READY_S
    while True:
        with suppress(ValueError):  # its output is incomplete
            return page, str(json.loads(page.output)['url'])
        if not page.is_running or time.monotonic() > end:
            page.stop(0.0)
            raise page.failed('did not start the live page')
        time.sleep(0.1)
