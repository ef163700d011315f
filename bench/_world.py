"""The environment of a measurement: a folder, a ROS domain, an S3 server, and programs; all of them stop with it."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

import _proc
import boto3
from shadowhound_sim.demo_processes import PR_SET_PDEATHSIG, environment, free_domain
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool import ledger

if TYPE_CHECKING:
    from typing_extensions import Self

HERE: Final = Path(__file__).resolve().parent
ROBOT: Final = 'thor'
BUCKET: Final = 'sensor-data'
NODE: Final = ('-m', 'shadowhound_data_logger.node.sensor_logger_node')
SIM: Final = ('-m', 'shadowhound_sim.sim_go2_node')
START_S: Final = 60.0
STOP_S: Final = 40.0
TAIL_LINES: Final = 15


class Failed(SystemExit):
    """The measurement failed; the text has the reason."""


class Program:
    """A running program. Programs of this folder take a request per line on standard input, and answer with a line of JSON."""

    def __init__(self, name: str, command: Sequence[str], environ: Mapping[str, str], log: Path) -> None:
        self.name, self.log = name, log
        self._libc = ctypes.CDLL(None)
        with log.open('wb') as file:
            self._popen = subprocess.Popen(
                [*command], env=dict(environ), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file,
                text=True, start_new_session=True,
                # Safe here: a bench has one thread when it starts its programs, and that thread runs until they exit.
                preexec_fn=self._die_with_the_bench,  # noqa: PLW1509
            )  # fmt: skip

    @property
    def pid(self) -> int:
        return self._popen.pid

    def cpu_s(self) -> float:
        """CPU seconds of it and its descendants. Raises Failed if it has exited."""
        self.check()
        return _proc.cpu_s(self.pid)

    def check(self) -> None:
        if self._popen.poll() is not None:
            raise self.failed(f'exited with code {self._popen.returncode}')

    def ask(self, **order: object) -> dict[str, Any]:
        """Send a request; returns the answer."""
        self.check()
        assert self._popen.stdin is not None
        self._popen.stdin.write(json.dumps(order) + '\n')
        self._popen.stdin.flush()
        return self.line()

    def line(self) -> dict[str, Any]:
        """The next line of its standard output."""
        assert self._popen.stdout is not None
        text = self._popen.stdout.readline()
        if not text:
            self._popen.wait(STOP_S)
            raise self.failed(f'wrote nothing and exited with code {self._popen.returncode}')
        answer: dict[str, Any] = json.loads(text)
        return answer

    def stop(self) -> str:
        """SIGINT, then SIGKILL if needed; returns its remaining output. Idempotent."""
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGINT)
        try:
            return str(self._popen.communicate(timeout=STOP_S)[0] or '')
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.communicate()
            raise self.failed(f'did not exit within {STOP_S:g} s') from None
        except ValueError:  # its streams are closed: it was stopped before
            return ''

    def failed(self, what: str) -> Failed:
        lines = self.log.read_text(encoding='utf-8', errors='replace').splitlines()[-TAIL_LINES:]
        return Failed('\n'.join([f'{self.name} {what}; the end of {self.log.name}:', *lines]))

    def _die_with_the_bench(self) -> None:
        self._libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


class World:
    """``with World(folder) as world:`` everything is below ``folder`` and deleted at the end.

    The folder should be on the disk that a spool would be on: on a memory file system, syncs cost nothing.
    """

    def __init__(self, folder: Path, *, store: bool = True) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._temporary = tempfile.TemporaryDirectory(dir=folder, prefix='bench-', ignore_cleanup_errors=True)
        self.folder = Path(self._temporary.name)
        self.tower = Tower(self.folder / 'tower') if store else None
        self._programs: list[Program] = []
        self._environ: dict[str, str] = {}

    def __enter__(self) -> Self:
        for name in ('NO_PROXY', 'no_proxy'):
            os.environ[name] = ','.join(filter(None, (os.environ.get(name), '127.0.0.1')))
        if self.tower is not None:
            self.tower.start()
            make_bucket(self.tower)
        store = self.tower.environment() if self.tower is not None else {}
        self._environ = environment(self.folder / 'home', store, free_domain()) | {'ROS_LOG_DIR': str(self.folder / 'ros')}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            for program in reversed(self._programs):
                program.stop()
        finally:
            if self.tower is not None:
                self.tower.stop()
            self._temporary.cleanup()

    @property
    def spool(self) -> Path:
        return self.folder / 'home' / 'spool'

    def program(self, name: str, *arguments: str, environ: Mapping[str, str] | None = None) -> Program:
        """A program of this folder, such as ``imu_publisher.py``, or one that ``-m`` names."""
        first, *rest = arguments
        return self.command(name, sys.executable, first if first.startswith('-') else str(HERE / first), *rest, environ=environ)

    def command(self, name: str, *words: str, environ: Mapping[str, str] | None = None) -> Program:
        """Any other command, in this environment plus ``environ``."""
        log = self.folder / f'{len(self._programs)}-{name}.log'
        program = Program(name, words, {**self._environ, **(environ or {})}, log)
        self._programs.append(program)
        return program

    def node(self, parameters: Mapping[str, Any] | None = None, file: Path | None = None,
             program: Sequence[str] = NODE, environ: Mapping[str, str] | None = None) -> Program:  # fmt: skip
        """A ``sensor_logger_node``, once it is ready: flat parameters override the file's, ``environ`` as in ``command``."""
        own = self.folder / f'{len(self._programs)}-node.yaml'
        own.write_text(json.dumps({'/**': {'ros__parameters': dict(parameters or {})}}), encoding='utf-8')
        files = [str(path) for path in (file, own) if path is not None]
        given = ['--ros-args', *(word for path in files for word in ('--params-file', path))]
        node = self.program('sensor_logger_node', *program, *given, environ=environ)
        until(lambda: 'logging ' in node.log.read_text(encoding='utf-8', errors='replace'), 'the node to start', node)
        return node

    def sim(self, *parameters: str) -> Program:
        """A simulated Go2; when it exits it reports what it published."""
        given = [word for parameter in parameters for word in ('-p', parameter)]
        return self.program('sim_go2_node', *SIM, *(['--ros-args', *given] if given else []))

    def ledger(self) -> Mapping[str, Any]:
        """The current ledger; without topics while there is none."""
        try:
            return ledger.read(self.spool, ROBOT)
        except SpoolError:
            return {'topics': {}, 'objects': {}, 'bytes': {}, 'balanced': True}

    def topic(self, name: str) -> dict[str, Any]:
        """The topic's row of the ledger; empty before there is one."""
        row: dict[str, Any] = self.ledger()['topics'].get(name, {})
        return row

    def received(self, name: str) -> int:
        """Messages of a topic that are durably accounted for."""
        return int(self.topic(name).get('received', 0))


def lost(rows: Iterable[Mapping[str, Any]]) -> int:
    """Missed and dropped messages of a ledger's topics. Raises Failed if the missed ones are unknown."""
    total = 0
    for row in rows:
        if row['missed'] is None:
            raise Failed(f'the missed messages of {row["type"]} are unknown: {row["accounting"]}')
        total += row['missed'] + sum(row['dropped'].values())
    return total


def make_bucket(tower: Tower) -> None:
    """The node creates its buckets itself; a plain node and bare puts need them beforehand."""
    settings = tower.store_settings()
    client = boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                          aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip
    client.create_bucket(Bucket=BUCKET)
    client.close()


def until(condition: Callable[[], object], what: str, *programs: Program, seconds: float = START_S) -> None:
    """Wait for a condition while the programs run; raises Failed if that takes too long."""
    end = time.monotonic() + seconds
    while not condition():
        for program in programs:
            program.check()
        if time.monotonic() > end:
            raise Failed(f'timed out after {seconds:g} s waiting for {what}')
        time.sleep(0.05)
