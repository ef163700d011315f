"""The agent's handle on the missions' sender: a child process that it starts, wakes, restarts after an exit, and releases."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import sysconfig
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.config import endpoint_url, store_settings
from shadowhound_data_logger.missions.folder import MISSIONS

log = logging.getLogger(__name__)

RESTART_PAUSE_S: Final = 5.0
MAX_RESTART_PAUSE_S: Final = 60.0
"""The longest pause before a sender that exited is restarted."""
MAX_LOG_BYTES: Final = 1 << 20
_released: list[subprocess.Popen[bytes]] = []
"""Senders that keep running after their logger was closed; polled, so that none becomes a zombie."""
PACKAGE: Final = str(Path(__file__).resolve().parents[2])
UNUSABLE: Final = 78
"""The exit code (EX_CONFIG) of an interpreter that cannot import the sender."""
NICE: Final = 5
LOAD_DELAY_S: Final = 1.0
"""How long the sender waits to be woken, or for the agent to exit, before it loads MLflow: loading keeps a core busy for seconds,
which would delay the first mission's request for a run."""
PROGRAM: Final = f"""\
import os, sys
if sys.path[:1] == ['']:
    del sys.path[0]
from select import select
os.nice({NICE})
select([0], [], [], float(sys.argv.pop(1)))
try:
    from shadowhound_data_logger.missions.replay import main
except ImportError as error:
    print(error, file=sys.stderr)
    sys.exit({UNUSABLE})
sys.exit(main())
"""  # noqa: S608 - not SQL
"""The sender. It imports no modules from the agent's working directory: a ``queue.py`` there would replace Python's."""
_PYTHON: Final = re.compile(r'(?:python|pypy)(\d+(?:\.\d+)?)?[a-z]*')
"""File names of interpreters, with their version."""
REMEDY: Final = 'send them with `shadowhound-data missions resume`, from a Python that has this package'


class Replayer:
    """Starts and wakes the process that sends missions.

    Lifecycle: New; start once; wake and supervise any number of times; release once. Only ``wake`` is thread-safe.

    The process runs in the directory that was the agent's working directory at construction, so that both resolve relative
    paths in the environment (MLFLOW_TRACKING_URI, AWS_CA_BUNDLE, PYTHONPATH, ...) in the same way.
    """

    def __init__(self, home: Path, experiment: str, environ: Mapping[str, str]) -> None:
        """Raises SettingError for an object or artifact store that the process could not use."""
        store_settings(environ, home)
        if artifacts := environ.get('MLFLOW_S3_ENDPOINT_URL'):
            endpoint_url(artifacts, 'MLFLOW_S3_ENDPOINT_URL')
        self._home = home
        self._experiment = experiment
        self._python = interpreter()
        self._environ = {**environ, 'PYTHONPATH': os.pathsep.join(_import_path(environ, self._python))}
        self._folder = _working_directory()
        self._is_usable = True
        self._process: subprocess.Popen[bytes] | None = None
        self._pause_s = RESTART_PAUSE_S
        self._next_s = 0.0

    def start(self) -> None:
        """Start the process, which loads MLflow when woken or after ``LOAD_DELAY_S``; ``supervise`` retries a failed start."""
        _released[:] = [process for process in _released if process.poll() is None]
        folder = self._home / MISSIONS
        if self._python is None:
            self._disable(f'no Python interpreter was found (sys.executable is {sys.executable!r})')
            return
        command = [self._python, '-c', PROGRAM, str(LOAD_DELAY_S), '--home', str(self._home), '--experiment', self._experiment]
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with os.fdopen(os.open(folder / 'replay.log', os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 'ab') as output:
                if output.tell() > MAX_LOG_BYTES:
                    output.truncate(0)
                self._process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=self._environ,
                    cwd=self._folder if self._folder and os.access(self._folder, os.X_OK) else folder, start_new_session=True,
                )  # fmt: skip
        except OSError as error:
            log.warning('missions are not sent: the sender cannot be started: %s', error)
        else:
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)

    def wake(self) -> None:
        """Make the sender read the journals now."""
        process = self._process
        if process is not None and process.stdin is not None:
            with suppress(OSError, ValueError):  # it has exited, was released, or its pipe is full
                os.write(process.stdin.fileno(), b'\n')

    def supervise(self) -> None:
        """Restart the sender if it has exited, after a pause that doubles."""
        if self._is_usable and self._process is not None and self._process.poll() == UNUSABLE:
            self._disable(f'{self._python} cannot import the sender: see {self._home / MISSIONS / "replay.log"}')
        if self._is_usable and (self._process is None or self._process.poll() is not None):
            if self._process is not None and self._next_s == 0.0:
                log.warning("the missions' sender exited with %s; restarting it", self._process.returncode)
            if self._next_s == 0.0:
                self._next_s = time.monotonic() + self._pause_s
            elif time.monotonic() >= self._next_s:
                self._pause_s, self._next_s = min(2 * self._pause_s, MAX_RESTART_PAUSE_S), 0.0
                self._close_pipe()
                self.start()

    def release(self) -> None:
        """Let the sender continue without the agent: it exits when it has sent everything."""
        self._close_pipe()
        process, self._process = self._process, None
        if process is not None:
            _released.append(process)

    def forget(self) -> None:
        """In a forked child: the process belongs to the parent."""
        self._close_pipe()
        if self._process is not None:
            self._process.returncode, self._process = 0, None

    def _disable(self, reason: str) -> None:
        """Stop sending, and log that once."""
        self._is_usable = False
        log.warning('missions are journaled in %s but not sent: %s; %s', self._home / MISSIONS, reason, REMEDY)

    def _close_pipe(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()


def interpreter() -> str | None:
    """The path of the Python that runs this program, or of the one that is installed next to its library.

    In a program that embeds Python or is frozen, ``sys.executable`` is None, empty or that program, which must not be started
    again: only a file with the name of an interpreter is used. None if there is no such file.
    """
    version = f'{sys.version_info.major}.{sys.version_info.minor}'
    own = () if getattr(sys, 'frozen', False) else (sys.executable, getattr(sys, '_base_executable', None))
    for path in own:
        if _is_python(path, version):
            return path
    prefixes = (sys.prefix, sys.exec_prefix, sys.base_prefix, sys.base_exec_prefix)
    folders = dict.fromkeys([*(os.path.join(prefix, 'bin') for prefix in prefixes), sysconfig.get_config_var('BINDIR') or ''])  # noqa: PTH118
    installed = (os.path.join(folder, f'python{version}{sys.abiflags}') for folder in folders if folder)  # noqa: PTH118
    return next((path for path in installed if _is_python(path, version)), None)


def _is_python(path: object, version: str) -> bool:
    if not isinstance(path, str) or not os.path.isabs(path) or not os.path.isfile(path) or not os.access(path, os.X_OK):  # noqa: PTH113, PTH117
        return False
    name = _PYTHON.fullmatch(Path(path).resolve().name)
    return name is not None and name[1] in {None, version, version.partition('.')[0]}


def _import_path(environ: Mapping[str, str], python: str | None) -> list[str]:
    """The agent's PYTHONPATH and this package; also the agent's packages if the interpreter is not the agent's."""
    given = []
    with suppress(OSError):  # the working directory was deleted
        given = [os.path.abspath(entry) for entry in environ.get('PYTHONPATH', '').split(os.pathsep) if entry]  # noqa: PTH100
    packages = [entry for entry in map(str, sys.path) if Path(entry).name in {'site-packages', 'dist-packages'}]
    return list(dict.fromkeys([*given, PACKAGE, *(packages if python != sys.executable else ())]))


def _working_directory() -> Path | None:
    """None if it was deleted."""
    try:
        return Path.cwd()
    except OSError:
        return None
