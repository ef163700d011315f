"""Creates the run of a new mission in the agent's process, with one request, before the sender has loaded MLflow.

This is a shortcut: if it fails, the sender looks for a run with the mission's id, creates one if missing, and reports errors.
During the request the mission's folder is locked (flock), so that the sender does not create a run; the lock ends with the
process. Stores without a server (``sqlite:``, ``file:``) and logins that only MLflow's client supports do not use it.
"""

from __future__ import annotations

import fcntl
import logging
import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit, urlunsplit

from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.errors import TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.mlflow_rest import LOGIN, MlflowRest
from shadowhound_data_logger.missions.folder import MissionFolder, Run
from shadowhound_data_logger.missions.state import run_request
from shadowhound_data_logger.missions.tracking import MISSION_TAG

log = logging.getLogger(__name__)

OTHER_LOGINS: Final = ('MLFLOW_TRACKING_AUTH', 'MLFLOW_TRACKING_AWS_SIGV4')
"""Environment variables of logins that only MLflow's client supports."""


class NewRun:
    """The run of one mission while it is being created.

    Lifecycle: New, before the mission's journal exists; ``settle`` once, from any thread. The folder is locked in between.
    """

    def __init__(self, folder: MissionFolder) -> None:
        """Raises OSError."""
        self.folder = folder
        self.run: Run | None = None
        self.is_unreachable = False
        """Whether no server answered, so that the sender cannot create a run either."""
        self.is_settled = threading.Event()
        self._descriptor = os.open(folder.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            lock(self._descriptor, wait=False)
        except OSError:
            os.close(self._descriptor)
            raise

    def settle(self, run: Run | None = None, *, is_unreachable: bool = False) -> None:
        """Save the run, if it was created, and unlock the folder."""
        self.run, self.is_unreachable = run, is_unreachable
        # The agent does not wait for the disk: the sender finds a run that was not saved by the mission's id.
        self.is_settled.set()
        try:
            if run is not None:
                self.folder.set_run(run)
        except OSError as error:
            log.warning('the run of mission %s cannot be saved: %s', self.folder.mission_id, error)
        finally:
            descriptor, self._descriptor = self._descriptor, -1
            if descriptor >= 0:
                with suppress(OSError):
                    fcntl.flock(descriptor, fcntl.LOCK_UN)  # also releases the lock of copies in forked processes
                os.close(descriptor)

    def forget(self) -> None:
        """In a forked child: only the parent creates the run."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


class RunRequests:
    """Creates runs on one MLflow server.

    Lifecycle: New; ``prepare`` once; ``create`` any number of times. Each request has its own thread.
    ``_lock`` guards the connection's settings and the experiment's id.
    """

    def __init__(self, environ: Mapping[str, str], experiment: str) -> None:
        self._environ = environ
        self._experiment = experiment
        self._lock = threading.Lock()
        self._rest: MlflowRest | None = None
        self._experiment_id = ''
        self._open: set[NewRun] = set()

    @staticmethod
    def is_supported(environ: Mapping[str, str]) -> bool:
        """Whether the environment names a server that can be used without MLflow's client."""
        is_server = environ.get('MLFLOW_TRACKING_URI', '').startswith(('http://', 'https://'))
        return is_server and not any(environ.get(name, '').lower() not in {'', 'false'} for name in OTHER_LOGINS)

    def prepare(self) -> None:
        """Look up the experiment in advance; returns immediately."""
        self._start_thread(self._prepare)

    def create(self, new: NewRun, start: Mapping[str, Any]) -> None:
        """Create the run of a mission, whose first record is ``start``; returns immediately."""
        self._open.add(new)
        if not self._start_thread(self._create, new, start):
            self._settle(new)

    def forget(self) -> None:
        """In a forked child."""
        for new in tuple(self._open):
            new.forget()

    # -- within ----------------------------------------------------------------------------------------------------

    def _start_thread(self, work: Any, *arguments: object) -> bool:
        try:
            threading.Thread(target=work, args=arguments, name='mission-run', daemon=True).start()
        except RuntimeError as error:  # no more threads
            log.warning('this process creates no run in MLflow: %s', error)
            return False
        return True

    def _prepare(self) -> None:
        with suppress(TrackingRefused, TrackingUnavailable, OSError, ValueError), self._lock:
            self._find(self._connected())

    def _create(self, new: NewRun, start: Mapping[str, Any]) -> None:
        try:
            self._settle(new, self._created(new.folder.mission_id, start))
        except TrackingUnavailable as error:
            log.info('mission %s has no run yet: %s', new.folder.mission_id, error)
            self._settle(new, is_unreachable=True)
        except Exception as error:  # noqa: BLE001 - of any kind: the sender tries again, and reports it
            log.info('mission %s has no run yet: %s', new.folder.mission_id, error)
            with self._lock:
                self._rest, self._experiment_id = None, ''  # password or experiment may have changed
            self._settle(new)

    def _settle(self, new: NewRun, run: Run | None = None, *, is_unreachable: bool = False) -> None:
        new.settle(run, is_unreachable=is_unreachable)
        self._open.discard(new)

    def _created(self, mission_id: str, start: Mapping[str, Any]) -> Run | None:
        with self._lock:
            rest = self._connected()
            experiment_id = self._experiment_id or self._find(rest) or self._new(rest)
        name, start_ms, tags = run_request(start)
        made = rest.json('POST', 'runs/create', {
            'experiment_id': experiment_id, 'user_id': start['robot'], 'run_name': name, 'start_time': start_ms,
            'tags': [{'key': key, 'value': value} for key, value in {**tags, MISSION_TAG: mission_id}.items()],
        })['run']['info']  # fmt: skip
        if not is_name(str(made['run_id'])):
            raise ValueError(f'the server returned a run id that cannot be part of a key: {made["run_id"]!r:.80}')
        return Run(str(made['run_id']), experiment_id, str(made['artifact_uri']))

    def _connected(self) -> MlflowRest:
        if self._rest is None:
            url, environ = _address(self._environ)
            self._rest = MlflowRest(url, environ, Path(environ.get('HOME') or '/'))
        return self._rest

    def _find(self, rest: MlflowRest) -> str:
        """The experiment's id; empty if it does not exist."""
        found = rest.experiment(self._experiment)
        if found is not None and found['lifecycle_stage'] != 'active':
            raise ValueError(f'the experiment {self._experiment} is deleted')
        self._experiment_id = str(found['experiment_id']) if found is not None else ''
        return self._experiment_id

    def _new(self, rest: MlflowRest) -> str:
        try:
            rest.create(self._experiment)
        except TrackingRefused as error:
            if error.data['code'] != 'RESOURCE_ALREADY_EXISTS':  # another process has just created it
                raise
        return self._find(rest)


def _address(environ: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The server's URL without user and password, and the environment with these added."""
    parts = urlsplit(environ['MLFLOW_TRACKING_URI'])
    login, _, server = parts.netloc.rpartition('@')
    user, _, password = login.partition(':')
    given = dict(zip(LOGIN, (unquote(user), unquote(password)), strict=True)) if user else {}
    return urlunsplit((parts.scheme, server, parts.path.rstrip('/'), '', '')), {**environ, **given}
