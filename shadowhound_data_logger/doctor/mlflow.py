"""MLflow: whether it answers, requires a password, accepts runs, and whether artifacts reach their store.

It leaves behind one tag and one artifact of 64 bytes in the experiment of the robot's missions; on Spark, which only reads
that experiment, and before it exists, in a separate one (``_doctor`` and the user's name).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final
from urllib.parse import urlsplit

from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.errors import StoreError, TrackingError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.doctor import s3_put, services
from shadowhound_data_logger.doctor.context import home_of
from shadowhound_data_logger.doctor.model import Context, Result, Role, error, from_error, info, ok, skipped, warning

NAME: Final = 'mlflow'
PROBE: Final = '_doctor'
LOGS: Final = 'on the server: docker logs --tail 50 mlflow || docker compose logs --tail 50 mlflow'
S3_OF_SERVER: Final = (
    "MLflow's own environment on the server lacks AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY or MLFLOW_S3_ENDPOINT_URL, "
    'the bucket is missing, or the S3 server cannot be reached'
)


def check(context: Context) -> Iterator[Result]:
    """Check the server, its login, the missions' experiment and its artifacts."""
    service = services.mlflow(context)
    if service is None:
        uri = services.without_login(context.environ.get('MLFLOW_TRACKING_URI', ''))
        yield info(NAME, f'no MLflow server is set: missions are logged to {uri or context.settings.home / "mlflow.db"}')
        return
    if failed := context.failed('network.mlflow'):
        yield skipped(NAME, failed)
        return
    try:
        rest = MlflowRest(service.url, context.environ, home_of(context))
        yield from _health(rest, service.url)
        if rest.is_open():
            yield warning(
                'mlflow.open',
                f'{service.url} requires no password',
                'anyone who can reach that port can read, change and delete missions, and administer the server',
                'on the server: make tower-secrets, and start MLflow as tower/compose.yaml does (docs/tower.md)',
            )
        missions = f'{context.settings.robot}_missions'
        found = rest.experiment(missions)
        yield from _missions(missions, found)
        if found is not None and found.get('lifecycle_stage') == 'deleted':
            return
        if found is None or context.role is Role.WORKSTATION:
            missions = f'{PROBE}_{rest.user}' if rest.user else PROBE
            found = _own(rest, missions)
        rest.tag(found['experiment_id'], 'shadowhound.doctor', iso(time.time_ns()))
        yield ok('mlflow.experiment', f'the experiment {missions} was written to')
        yield from _artifacts(rest, missions, str(found['artifact_location']), context)
    except TrackingError as problem:
        yield _failed(problem, service.variable, context.settings.robot)
    except OSError as problem:  # a certificate file; network.mlflow.tls has details
        yield error('mlflow.tls', f'the certificate of {service.url} cannot be verified: {problem}', '', 'see network.mlflow.tls')


def _health(rest: MlflowRest, url: str) -> Iterator[Result]:
    answer = rest.get('/health')
    if answer != 'OK':
        raise TrackingUnavailable(f'{url} does not answer like an MLflow server: /health returns {answer[:40]!r}', code='')
    version = rest.get('/version')
    yield ok('mlflow.health', f'MLflow {version} answers', version=version)


def _failed(problem: TrackingError, variable: str, robot: str) -> Result:
    status, text = problem.data.get('status', 0), problem.data.get('text', '')
    cause, remedy = 'the server hangs, or waits for its database', f'{LOGS} ; docker compose restart mlflow'
    if 'Host header' in text:
        cause, remedy = (
            'MLflow only accepts requests for its own host names',
            'on the server: mlflow server --allowed-hosts SERVER:5001,...',
        )
    elif status == 401 and not text.startswith('<'):
        return error(
            'mlflow.login',
            str(problem),
            'it requires a user and password, or different ones: they may have been changed',
            'export MLFLOW_TRACKING_USERNAME=... MLFLOW_TRACKING_PASSWORD=...  # of tower/secrets/NAME.env on the server, or '
            'its NAME.credentials as ~/.mlflow/credentials',
        )
    elif status == 403 and not text.startswith('<'):
        return error(
            'mlflow.login',
            str(problem),
            'this user has no permission: MLFLOW_TRACKING_USERNAME is that of another machine, or the server does not know '
            f'{robot} as a robot',
            f'on the server: make tower-secrets TOWER_ARGS="--robot {robot}", start MLflow again, and copy {robot}.env here',
        )
    elif 400 <= status < 500 or 'like an MLflow server' in str(problem):
        cause, remedy = 'something else listens on this port', f'export {variable}=http://SERVER:5001'
    elif status >= 500:
        cause, remedy = 'the server fails: its database cannot be reached, or has another version', f'{LOGS} ; docker compose ps'
    return error('mlflow.answer', str(problem), cause, remedy)


def _own(rest: MlflowRest, name: str) -> dict[str, Any]:
    """The doctor's own experiment, created or restored if needed."""
    found = rest.experiment(name)
    if found is None:
        try:
            rest.create(name)
        except TrackingRefused as problem:
            if problem.data['code'] != 'RESOURCE_ALREADY_EXISTS':  # created by another doctor
                raise
        found = rest.experiment(name)
    if found is None:
        raise TrackingUnavailable(f'the experiment {name} was created but does not exist', code='')
    if found.get('lifecycle_stage') == 'deleted':
        rest.restore(found['experiment_id'])
    return found


def _missions(name: str, found: Mapping[str, Any] | None) -> Iterator[Result]:
    """The experiment of the missions, if it exists: its artifact location is fixed when it is created."""
    if found is None:
        yield info('mlflow.missions', f'there is no experiment {name} yet: no mission has been logged')
        return
    where = str(found['artifact_location'])
    if found.get('lifecycle_stage') == 'deleted':
        yield error(
            'mlflow.missions',
            f'the experiment {name} is deleted',
            'missions wait until it is restored',
            f'on the server: mlflow experiments restore -x {found["experiment_id"]}',
        )
    elif not _is_folder(where):
        yield ok('mlflow.missions', f'the experiment {name} keeps its artifacts in {where}')


def _is_folder(location: str) -> bool:
    return urlsplit(location).scheme in {'', 'file'}


def _local(who: str, location: str) -> Result:
    return error(
        'mlflow.artifacts',
        f'{who} keeps its artifacts in {location}, a folder',
        'the server was started with a folder as artifact root and does not serve artifacts: each client writes to its own '
        'disk, so they reach neither the server nor its store',
        'on the server: mlflow server --artifacts-destination s3://mlflow ...  (and a new experiment: where artifacts go '
        'is fixed when it is created)',
    )


def _artifacts(rest: MlflowRest, name: str, location: str, context: Context) -> Iterator[Result]:
    """Upload one artifact the way this server's clients do, and read it back."""
    scheme = urlsplit(location).scheme
    if scheme == 'mlflow-artifacts':
        yield _proxied(rest, urlsplit(location).path.strip('/'))
    elif scheme == 's3':
        yield from _direct(location, context)
    elif _is_folder(location):
        yield _local(f'the experiment {name}', location)
    else:
        yield info('mlflow.artifacts', f'artifacts are stored in {location}, which is not checked')


def _proxied(rest: MlflowRest, folder: str) -> Result:
    url = rest.artifact_url(f'{folder}/_doctor/probe.txt')
    try:
        rest.send('PUT', url, s3_put.BODY)
        body = rest.send('GET', url)
    except TrackingRefused as problem:
        return error(
            'mlflow.artifacts',
            f'MLflow does not accept artifacts: {problem}',
            S3_OF_SERVER,
            f'{LOGS} ; docker exec mlflow env | grep -E "AWS_|MLFLOW_S3" | cut -d= -f1  # only the names',
        )
    except TrackingUnavailable as problem:
        return error(
            'mlflow.artifacts',
            f'MLflow does not accept artifacts: {problem}',
            'it waits for its artifact store, which does not answer',
            f'{LOGS} ; curl -i $AWS_ENDPOINT_URL',
        )
    if body != s3_put.BODY:
        return error('mlflow.artifacts', 'an artifact reads back differently', 'its store damages content', LOGS)
    return ok('mlflow.artifacts', 'an artifact was written through MLflow to its store and read back')


def _direct(location: str, context: Context) -> Iterator[Result]:
    """Check an artifact store that the client writes to directly."""
    url, endpoint = urlsplit(location), context.environ.get('MLFLOW_S3_ENDPOINT_URL') or context.settings.store.endpoint_url
    if not endpoint:
        yield error(
            'mlflow.artifacts',
            f'artifacts are stored in {location}, and MLFLOW_S3_ENDPOINT_URL does not name its server',
            'MLflow then uses Amazon',
            'export MLFLOW_S3_ENDPOINT_URL=http://SERVER:9000',
        )
        return
    settings = replace(context.settings.store, endpoint_url=endpoint)
    key = f'{url.path.strip("/")}/_doctor/probe.txt'.lstrip('/')
    try:
        with s3_put.single_requests(settings) as requests:
            item = s3_put.probe(url.netloc, key)
            requests.put(item, s3_put.BODY, conditional=False)
            b''.join(requests.content(url.netloc, key))
    except StoreError as problem:
        whose = 'this robot' if context.role is Role.ROBOT else 'this machine'
        result = from_error('mlflow.artifacts', problem, f'{whose} writes the artifacts of missions directly to {location}')
        yield replace(result, remedy=result.remedy or f'aws --endpoint-url {endpoint} s3 ls s3://{url.netloc}/')
        return
    yield ok('mlflow.artifacts', f'an artifact was written to {location} and read back')
