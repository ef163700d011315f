"""The requests to MLflow: the only file that imports it. Uses explicit run ids, never the fluent API.

Every method blocks until the request times out at the latest (``ENVIRONMENT``), and raises TrackingUnavailable or
TrackingRefused. Each can be repeated: a run is looked up by its mission's id before it is created, and points, params and
artifacts that already exist stay unchanged. (Only ``file:`` stores duplicate a point that is sent twice.)
"""

from __future__ import annotations

import errno
import os
import posixpath
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

from shadowhound_data_logger.core.config import ENDPOINTS
from shadowhound_data_logger.core.errors import TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.tls import causes, certificate_problem
from shadowhound_data_logger.missions.folder import Run
from shadowhound_data_logger.missions.state import Point

MISSION_TAG: Final = 'shadowhound.mission_id'
DUPLICATE_TAG: Final = 'shadowhound.duplicate_of'
ENVIRONMENT: Final = {
    'MLFLOW_HTTP_REQUEST_TIMEOUT': '10',
    'MLFLOW_HTTP_REQUEST_MAX_RETRIES': '0',
    'MLFLOW_ALLOW_HTTP_REDIRECTS': 'false',
    'MLFLOW_DISABLE_TELEMETRY': 'true',
    'MLFLOW_ALLOW_FILE_STORE': 'true',
    'MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR': 'false',
    'MLFLOW_ENABLE_ASYNC_LOGGING': 'false',
    'MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT': 'true',
    'GIT_PYTHON_REFRESH': 'quiet',
    'AWS_MAX_ATTEMPTS': '2',
}
"""Defaults that are set before MLflow is imported. No retries: the sender retries with backoff."""
REFUSALS: Final = frozenset({
    'INVALID_PARAMETER_VALUE', 'BAD_REQUEST', 'MALFORMED_REQUEST', 'RESOURCE_DOES_NOT_EXIST', 'INVALID_STATE',
    'RESOURCE_CONFLICT', 'NOT_IMPLEMENTED',
})  # fmt: skip
"""MLflow's error codes that are permanent: a retry would fail, too."""
LOGIN_CODES: Final = frozenset({'PERMISSION_DENIED', 'UNAUTHENTICATED', 'CUSTOMER_UNAUTHORIZED'})
STATUS_CODES: Final = {401: 'UNAUTHENTICATED', 403: 'PERMISSION_DENIED'}
"""HTTP status -> error code, for responses without a code, such as those of the artifact proxy."""
TOO_LARGE: Final = 413
"""The HTTP status of a proxy that permanently refuses a file because of its size."""
OF_OBJECT: Final = frozenset({400, 404, 406, 409, 410, 412, 414, 422, 431, 451})
"""HTTP statuses whose cause may be the object: it is, if the server accepts other objects."""
OF_PATH: Final = frozenset({errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ, errno.EISDIR, errno.ENOTDIR, errno.EEXIST})
"""The same for artifacts in a folder."""
RUN_GONE: Final = 'RUN_GONE'
"""``data['code']`` of TrackingRefused if the run was deleted."""
MAX_POINTS: Final = 1000
"""MLflow's limit for a batch."""
_Batch = tuple[Sequence[Point], Mapping[str, str], Mapping[str, str]]
"""Points, params and tags."""
S3_REMEDY: Final = 'set MLFLOW_S3_ENDPOINT_URL to the S3 server, such as http://SERVER:9000'
_USER: Final = re.compile(r'//[^/\s]*@')


class Tracking(Protocol):
    """The requests that deliver a mission to a tracking server."""

    def run_of(self, mission_id: str, name: str, start_ms: int, tags: Mapping[str, str]) -> Run:
        """The mission's run, created if missing."""

    def log(self, run_id: str, points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        """Log a batch of at most 1,000 points, 100 params and 100 tags."""

    def artifact(self, run: Run, path: Path, folder: str) -> None:
        """Upload a file under its own name to a folder of the run's artifacts."""

    def finish(self, run_id: str, mission_id: str, status: str, end_ms: int) -> None:
        """Set the final state of the run, and close duplicates of it."""


class MlflowTracking:
    """Sends missions to MLflow.

    Lifecycle: New; open once, otherwise the first request does it. Not thread-safe.
    """

    def __init__(self, uri: str, experiment: str, artifact_root: Path | None = None) -> None:
        """A new experiment stores its artifacts in ``artifact_root``; if None, the server decides where."""
        self._uri = uri
        self._experiment = experiment
        self._artifact_root = artifact_root
        self._client: Any = None
        self._experiment_id = ''

    def __repr__(self) -> str:
        return f'MlflowTracking({self.where!r}, {self._experiment!r})'

    @property
    def where(self) -> str:
        """The tracking URI without user and password."""
        return _USER.sub('//', self._uri)

    def open(self) -> None:
        """Load MLflow, which takes seconds, and create the client; idempotent."""
        if self._client is not None:
            return
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        if endpoint := next(filter(None, map(os.environ.get, ENDPOINTS)), None):
            os.environ.setdefault('MLFLOW_S3_ENDPOINT_URL', endpoint)
        try:
            with _without('pandas'):  # saves a third of time and memory; mlflow-skinny also works without it
                from mlflow import MlflowClient  # noqa: PLC0415 - takes seconds and 80 MB, and is not installed everywhere
        except ImportError as error:
            remedy = 'install mlflow-skinny for a server, mlflow for sqlite: and file: stores'
            raise TrackingUnavailable(f'MLflow cannot be imported: {error}', remedy=remedy) from error
        try:
            with self._translated('cannot be used'):  # creates SQLite's tables
                self._client = MlflowClient(tracking_uri=self._uri)
        except TrackingRefused as error:  # nothing was sent yet: this MLflow does not support the address
            remedy = 'set MLFLOW_TRACKING_URI to a server, http://SERVER:5001; for sqlite: also install mlflow'
            raise TrackingUnavailable(f'{error}', remedy=remedy) from error

    def run_of(self, mission_id: str, name: str, start_ms: int, tags: Mapping[str, str]) -> Run:
        self.open()
        with self._translated(f'did not create a run for {mission_id}'):
            experiment = self._experiment_of()
            found = self._runs(experiment, mission_id)
            if found:
                run = found[0]
            else:
                all_tags = {**tags, MISSION_TAG: mission_id}
                run = self._client.create_run(experiment, start_time=start_ms, tags=all_tags, run_name=name)
            return Run(run.info.run_id, experiment, run.info.artifact_uri)

    def log(self, run_id: str, points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        self.open()
        from mlflow.entities import Metric, Param, RunTag  # noqa: PLC0415 - see open

        try:
            with self._translated(f'did not accept a batch of run {run_id}'):
                self._client.log_batch(
                    run_id, metrics=[Metric(point.key, point.value, point.time_ms, point.step) for point in points],
                    params=[Param(*item) for item in params.items()], tags=[RunTag(*item) for item in tags.items()],
                )  # fmt: skip
        except TrackingRefused as error:
            if self._is_gone(run_id):
                text = f'the run {run_id} was deleted from {self.where}'
                raise TrackingRefused(text, remedy='restore it: MlflowClient().restore_run', code=RUN_GONE) from error
            raise

    def artifact(self, run: Run, path: Path, folder: str) -> None:
        self.open()
        if run.artifact_uri.startswith('s3:') and not os.environ.get('MLFLOW_S3_ENDPOINT_URL'):
            text = (
                f'artifacts of run {run.run_id} are in {run.artifact_uri}, and MLFLOW_S3_ENDPOINT_URL does not name that server'
            )
            raise TrackingUnavailable(text, remedy=S3_REMEDY)
        what, remedy = f'did not accept the artifact {posixpath.join(folder, path.name)!r} of run {run.run_id}', ''
        if run.artifact_uri.startswith('s3:'):
            what, remedy = f'{what} for {run.artifact_uri}', S3_REMEDY
        with self._translated(what, remedy):
            self._client.log_artifact(run.run_id, str(path), folder or None)

    def finish(self, run_id: str, mission_id: str, status: str, end_ms: int) -> None:
        self.open()
        with self._translated(f'did not end run {run_id}'):
            for run in self._runs(self._experiment_of(), mission_id):
                if run.info.run_id != run_id:  # created by a request that seemed to fail
                    self._client.set_tag(run.info.run_id, DUPLICATE_TAG, run_id)
                    self._delete(run.info.run_id)
            self._client.set_terminated(run_id, status=status, end_time=end_ms)

    def tagged(self, tag: str, value: str) -> list[str]:
        """The ids of the runs with this tag, in all experiments."""
        self.open()
        with self._translated('did not list its runs'):
            experiments = [each.experiment_id for each in self._client.search_experiments()]
            found: list[str] = []
            for start in range(0, len(experiments), 100):
                some, token = experiments[start : start + 100], None
                while True:
                    page = self._client.search_runs(some, f"tags.`{tag}` = '{value}'", max_results=1000, page_token=token)
                    found += [run.info.run_id for run in page]
                    token = page.token
                    if not token:
                        break
            return sorted(found)

    def _delete(self, run_id: str) -> None:
        """Delete a duplicate. Without permission to delete, as on a Tower with passwords, only end it; it keeps its tag."""
        from mlflow.exceptions import MlflowException  # noqa: PLC0415 - see open

        try:
            self._client.delete_run(run_id)
        except MlflowException as error:
            if error.error_code != 'PERMISSION_DENIED':
                raise
            self._client.set_terminated(run_id, status='KILLED')

    def _is_gone(self, run_id: str) -> bool:
        try:
            with self._translated(f'did not describe run {run_id}'):
                return bool(self._client.get_run(run_id).info.lifecycle_stage != 'active')
        except TrackingRefused:
            return True

    def _experiment_of(self) -> str:
        """The id of the experiment, created if missing; another process may create it at the same time."""
        if not self._experiment_id:
            found = self._client.get_experiment_by_name(self._experiment)
            if found is None:
                found = self._new_experiment()
            if found.lifecycle_stage != 'active':
                raise TrackingUnavailable(f'the experiment {self._experiment} of {self.where} is deleted',
                                          remedy='restore it: mlflow experiments restore -x ' + found.experiment_id)  # fmt: skip
            self._experiment_id = found.experiment_id
        return self._experiment_id

    def _new_experiment(self) -> Any:
        from mlflow.exceptions import MlflowException  # noqa: PLC0415 - see open

        location = self._artifact_root.as_uri() if self._artifact_root else None
        try:
            return self._client.get_experiment(self._client.create_experiment(self._experiment, artifact_location=location))
        except MlflowException as error:
            if error.error_code == 'PERMISSION_DENIED':
                text = f'there is no experiment {self._experiment} in {self.where}, and this user may not create it'
                remedy = 'on the server: make tower-secrets TOWER_ARGS="--robot NAME", and start MLflow again'
                raise TrackingUnavailable(text, remedy=remedy, code=error.error_code) from error
            if error.error_code != 'RESOURCE_ALREADY_EXISTS':
                raise
            return self._client.get_experiment_by_name(self._experiment)

    def _runs(self, experiment: str, mission_id: str) -> list[Any]:
        """The runs of a mission that were not deleted, always in the same order."""
        found = self._client.search_runs([experiment], f"tags.`{MISSION_TAG}` = '{mission_id}'", max_results=10)
        ours = [run for run in found if DUPLICATE_TAG not in run.data.tags]
        return sorted(ours, key=lambda run: (run.info.start_time, run.info.run_id))

    @contextmanager
    def _translated(self, what: str, remedy: str = '') -> Iterator[None]:
        """Translate MLflow's exceptions; ``remedy`` is for failures without a response from MLflow."""
        from mlflow.exceptions import MlflowException, RestException  # noqa: PLC0415 - see open

        try:
            yield
        except TrackingUnavailable:
            raise
        except MlflowException as error:
            code, is_own = error.error_code, isinstance(error, RestException) or not self._uri.startswith('http')
            text = f'{self.where} {what}: {_USER.sub("//", str(error))[:500]}'
            if code in REFUSALS and is_own:
                raise TrackingRefused(text, code=code) from error
            self._raise_certificate_problem(error)
            of_object = code in REFUSALS or _is_of_object(error)
            raise TrackingUnavailable(text, remedy=remedy_for(code), code=code, of_object=of_object) from error
        except Exception as error:  # clients and artifact stores raise many types (a captive portal's page is not JSON)
            self._raise_certificate_problem(error)
            text = f'{self.where} {what}: {type(error).__name__}: {_USER.sub("//", str(error))[:500]}'
            status = _status(error)
            if status == TOO_LARGE:
                remedy = 'raise the limit for the size of requests in the proxy in front of MLflow'
                raise TrackingRefused(text, remedy=remedy, code='TOO_LARGE') from error
            code = STATUS_CODES.get(status, '')
            remedy = remedy_for(code) if code else remedy or remedy_for('')
            raise TrackingUnavailable(text, remedy=remedy, code=code, of_object=_is_of_object(error)) from error

    def _raise_certificate_problem(self, error: Exception) -> None:
        """Raises TrackingUnavailable if the certificate of the server or of the artifact store is not trusted."""
        bundle = 'MLFLOW_TRACKING_SERVER_CERT_PATH (AWS_CA_BUNDLE if artifacts are sent to the S3 server itself)'
        if found := certificate_problem(error, self.where, bundle=bundle, address='MLFLOW_TRACKING_URI'):
            raise TrackingUnavailable(found[0], remedy=found[1], code='CERTIFICATE') from error


def _status(error: BaseException) -> int:
    """The HTTP status of the response of MLflow or an S3 server; 0 without a response."""
    for cause in causes(error):
        response: Any = getattr(cause, 'response', None)
        if isinstance(response, dict):  # botocore's
            return int(response.get('ResponseMetadata', {}).get('HTTPStatusCode', 0))
        if response is not None:
            return int(getattr(response, 'status_code', 0))
    return 0


def _is_of_object(error: BaseException) -> bool:
    """Whether the cause may be the object: then other objects may be accepted."""
    errors = {cause.errno for cause in causes(error) if type(cause).__module__ == 'builtins' and isinstance(cause, OSError)}
    return _status(error) in OF_OBJECT or not errors.isdisjoint(OF_PATH)


@contextmanager
def _without(module: str) -> Iterator[None]:
    """Hide an optional dependency, unless it is already loaded."""
    if module in sys.modules:
        yield
        return
    sys.modules[module] = None  # type: ignore[assignment]  # documented for the import system
    try:
        yield
    finally:
        del sys.modules[module]


def send(tracking: Tracking, run_id: str, batch: _Batch, refused: Callable[[Exception], None]) -> None:
    """Send a batch. Items that the server refuses are found by bisection, passed to ``refused`` and skipped.

    Raises TrackingError.
    """
    points, params, tags = batch
    if not (points or params or tags):
        return
    try:
        tracking.log(run_id, points, params, tags)
    except TrackingRefused as error:
        if error.data.get('code') == RUN_GONE:
            raise
        parts = _parts(points, params, tags)
        for each in parts:
            send(tracking, run_id, each, refused)
        if not parts:
            refused(error)


def _parts(points: Sequence[Point], params: Mapping[str, str], tags: Mapping[str, str]) -> list[_Batch]:
    """Split a refused batch into smaller ones; empty for a single item."""
    if len(points) + len(params) + len(tags) <= 1:
        return []
    half = len(points) // 2
    halves: list[_Batch] = [(points[:half], {}, {}), (points[half:], {}, {})]
    singles: list[_Batch] = [([], {name: value}, {}) for name, value in params.items()]
    return [*halves, *singles, *(([], {}, {name: value}) for name, value in tags.items())]


def remedy_for(code: str) -> str:
    """What the operator can do about an error code of MLflow."""
    if code in LOGIN_CODES:
        return (
            'check MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD (or ~/.mlflow/credentials, which is read again '
            'automatically), or MLFLOW_TRACKING_TOKEN'
        )
    if code == 'ENDPOINT_NOT_FOUND':
        return 'check that MLFLOW_TRACKING_URI is the address of an MLflow server'
    return 'check MLFLOW_TRACKING_URI, and that the server is on; the request is retried automatically'
