"""Attacks on a real MLflow server of a Tower: by a stranger, with a robot's password and with Spark's, and on its pages."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest
import urllib3
from shadowhound_tower import mlflow_access
from shadowhound_tower.embedded import Tower

pytestmark = pytest.mark.seaweedfs
API = ('/api/2.0/mlflow', '/api/2.0/preview/mlflow', '/ajax-api/2.0/mlflow', '/ajax-api/2.0/preview/mlflow')
"""Prefixes of the same API in current and older versions of MLflow."""


@dataclass
class User:
    """A client of MLflow; ``name`` is empty for a stranger."""

    tower: Tower
    name: str = ''
    http: urllib3.PoolManager = field(default_factory=urllib3.PoolManager)
    password: str | None = None

    def send(self, method: str, path: str, body: Any = None) -> urllib3.BaseHTTPResponse:
        headers = {'Content-Type': 'application/json'}
        if self.name:
            headers['Authorization'] = self.authorization()
        content = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        return self.http.request(
            method, self.tower.tracking_uri + path, body=content, headers=headers, redirect=False, timeout=60
        )

    def authorization(self) -> str:
        password = self.password or self.tower.tracking(self.name)['MLFLOW_TRACKING_PASSWORD']
        return 'Basic ' + base64.b64encode(f'{self.name}:{password}'.encode()).decode()

    def status(self, method: str, path: str, body: Any = None) -> int:
        return int(self.send(method, path, body).status)

    def call(self, method: str, path: str, body: Any = None) -> dict[str, Any]:
        """A request that must succeed."""
        answer = self.send(method, f'/api/2.0/mlflow/{path}', body)
        assert answer.status == 200, answer.data
        found: dict[str, Any] = answer.json()
        return found

    def experiment(self, name: str) -> str:
        return str(
            self.call('GET', 'experiments/get-by-name?' + urlencode({'experiment_name': name}))['experiment']['experiment_id']
        )

    def run(self, experiment: str) -> dict[str, Any]:
        return dict(self.call('POST', 'runs/create', {'experiment_id': experiment})['run']['info'])


@pytest.fixture(scope='module')
def users(tower: Tower) -> Iterator[dict[str, User]]:
    http = urllib3.PoolManager()
    yield {name: User(tower, name, http) for name in ('', 'tower', 'spark', 'thor', 'tachi')}
    http.clear()


@pytest.fixture(scope='module')
def run(users: dict[str, User]) -> dict[str, Any]:
    """A run of thor's, with an artifact."""
    made = users['thor'].run(users['thor'].experiment('thor_missions'))
    assert users['thor'].status('PUT', _artifact(made), b'frame') == 200
    return made


def _artifact(run: dict[str, Any], name: str = 'a.txt') -> str:
    return f'/api/2.0/mlflow-artifacts/artifacts/{run["experiment_id"]}/{run["run_id"]}/artifacts/{name}'


DOORS = [
    *((method, f'{api}/{path}') for api in API for method, path in (
        ('POST', 'experiments/create'), ('POST', 'experiments/search'),
        ('GET', 'experiments/get-by-name?experiment_name=Default'),
        ('POST', 'experiments/delete'), ('POST', 'experiments/update'), ('POST', 'runs/create'), ('POST', 'runs/search'),
        ('POST', 'runs/delete'), ('POST', 'runs/log-batch'), ('POST', 'registered-models/create'),
        ('POST', 'model-versions/create'),
        ('POST', 'users/create'), ('GET', 'users/list'), ('POST', 'traces'), ('POST', 'webhooks'), ('POST', 'logged-models'),
        ('POST', 'upload-artifact'), ('POST', 'gateway-proxy'),
    )),
    *((method, f'{api}/{path}') for api in ('/api/3.0/mlflow', '/ajax-api/3.0/mlflow') for method, path in (
        ('POST', 'traces'), ('POST', 'traces/search'), ('POST', 'gateway/secrets/create'), ('POST', 'gateway/endpoints/create'),
        ('POST', 'users/permissions/grant'), ('POST', 'roles/create'), ('POST', 'datasets/create'), ('POST', 'scorers/register'),
        ('POST', 'assistant/message'), ('GET', 'assistant/config'), ('POST', 'demo/generate'), ('POST', 'scorer/invoke'),
    )),
    *((method, f'{api}/mlflow-artifacts/artifacts/1/x/artifacts/a') for api in ('/api/2.0', '/ajax-api/2.0')
      for method in ('GET', 'PUT', 'DELETE')),
    ('POST', '/api/2.0/mlflow-artifacts/mpu/create/1/x'), ('GET', '/api/2.0/mlflow-artifacts/presigned/1/x'),
    ('GET', '/api/2.0/mlflow-artifacts/artifacts?path=1'), ('POST', '/graphql'), ('POST', '/v1/traces'), ('POST', '/v1/metrics'),
    ('GET', '/'), ('GET', '/signup'), ('GET', '/get-artifact?path=a&run_uuid=1'), ('GET', '/model-versions/get-artifact'),
    ('POST', '/gateway/x/mlflow/invocations'), ('POST', '/gateway/openai/v1/chat/completions'), ('GET', '/gateway/proxy'),
    ('POST', '/ajax-api/3.0/jobs'), ('POST', '/ajax-api/3.0/jobs/search'), ('GET', '/nowhere'), ('GET', '/docs'),
    ('GET', '/metrics'),
]  # fmt: skip


@pytest.mark.parametrize('name', ['', 'nobody', 'mlflow', 'thor'])
def test_without_a_password_nothing_is_accessible(users: dict[str, User], tower: Tower, name: str) -> None:
    """A stranger, an unknown user and a user with a wrong password get 401 or 403 for everything except the health check."""
    user = User(tower, name, users[''].http, password='guess')
    opened = {(method, path): status for method, path in DOORS
              if (status := user.status(method, path, b'{}' if method != 'GET' else None)) not in {401, 403}}  # fmt: skip
    assert opened == {}
    assert {user.status('GET', '/health'), user.status('GET', '/api/3.0/mlflow/server-info')} == {200}
    assert user.send('GET', '/').headers['WWW-Authenticate'] == 'Basic realm="Tower"'


@pytest.mark.parametrize(
    'method', ['Bearer x', 'Basic', 'Basic !!!', 'Basic ' + base64.b64encode(b'tower').decode(), 'Digest username=tower']
)
def test_an_incomplete_login_is_rejected(tower: Tower, users: dict[str, User], method: str) -> None:
    """Whatever else is in the header."""
    for path in ('/api/2.0/mlflow/experiments/search', '/api/2.0/mlflow-artifacts/artifacts/1/a', '/ajax-api/3.0/jobs/search'):
        answer = users[''].http.request('GET', tower.tracking_uri + path, headers={'Authorization': method}, timeout=60)
        assert answer.status == 401, path


@pytest.mark.parametrize('told', [('Content-Length', str(1 << 40)), ('Transfer-Encoding', 'chunked')])
@pytest.mark.parametrize('path', ['/api/2.0/mlflow/runs/create', '/health', '/', '/static-files/x', '/nowhere', '/v1/traces',
                                  '/api/2.0/mlflow-artifacts/artifacts/1/x'])  # fmt: skip
def test_the_body_of_a_stranger_is_not_read(tower: Tower, path: str, told: tuple[str, str]) -> None:
    """It would fill the memory of the server: the response is sent before any of the body."""
    for method in ('POST', 'PUT'):
        answer = _without_body(tower, method, path, dict([told]))
        assert (answer.status, answer.headers['WWW-Authenticate']) == (401, 'Basic realm="Tower"'), method


def test_the_body_of_a_user_has_a_bound(users: dict[str, User], run: dict[str, Any], tower: Tower) -> None:
    """Except for artifacts, which are streamed."""
    login = {'Authorization': users['thor'].authorization()}
    path = '/api/2.0/mlflow/runs/log-batch'
    long = {'Content-Length': str(mlflow_access.BODY_BYTES + 1)}
    assert _without_body(tower, 'POST', path, login | long).status == 413
    assert _without_body(tower, 'POST', path, login | {'Transfer-Encoding': 'chunked'}).status == 411
    assert _without_body(tower, 'PUT', _artifact(run, 'a\n').replace('\n', '%0A'), login | long).status == 413
    sent = users['thor'].http.request(
        'PUT', tower.tracking_uri + _artifact(run, 'streamed'), body=iter([b'fra', b'me']), headers=login, timeout=60
    )
    assert sent.status == 200
    assert users['thor'].send('GET', _artifact(run, 'streamed')).data == b'frame'


def _without_body(tower: Tower, method: str, path: str, headers: dict[str, str]) -> HTTPResponse:
    """The response to a request that announces a body, before it sends any."""
    asked = HTTPConnection(tower.tracking_uri.removeprefix('http://'), timeout=60)
    try:
        asked.putrequest(method, path)
        for name, value in headers.items():
            asked.putheader(name, value)
        asked.endheaders()
        answer = asked.getresponse()
        answer.read()
        return answer
    finally:
        asked.close()


def test_a_robot_logs_its_own_missions(users: dict[str, User], run: dict[str, Any]) -> None:
    """All requests of the missions' sender."""
    thor = users['thor']
    run_id = run['run_id']
    thor.call('POST', 'runs/log-batch', {'run_id': run_id, 'metrics': [{'key': 'a', 'value': 1, 'timestamp': 1, 'step': 0}]})
    thor.call('POST', 'runs/set-tag', {'run_id': run_id, 'key': 'a', 'value': 'b'})
    thor.call('POST', 'runs/update', {'run_id': run_id, 'status': 'FINISHED'})
    found = thor.call('POST', 'runs/search', {'experiment_ids': [run['experiment_id']]})['runs']
    assert run_id in [one['info']['run_id'] for one in found]
    assert thor.send('GET', _artifact(run)).data == b'frame'


def test_a_robot_creates_and_deletes_nothing(users: dict[str, User], run: dict[str, Any]) -> None:
    """It can create and delete no experiment, run, model, artifact, user or trace, by any path; not even its own."""
    thor, experiment, run_id = users['thor'], run['experiment_id'], run['run_id']
    tried = [
        *(('POST', f'{api}/{path}', body) for api in API for path, body in (
            ('experiments/create', {'name': 'mine'}), ('experiments/delete', {'experiment_id': experiment}),
            ('experiments/update', {'experiment_id': experiment, 'new_name': 'x'}), ('experiments/search', {'max_results': 5}),
            ('runs/delete', {'run_id': run_id}), ('runs/restore', {'run_id': run_id}),
            ('registered-models/create', {'name': 'mine'}),
            ('users/create', {'username': 'mallory', 'password': 'x' * 20}),
            ('model-versions/create', {'name': 'm', 'source': 's'}),
            ('registered-models/alias', {'name': 'm', 'alias': 'champion', 'version': '1'}),
            ('model-versions/set-tag', {'name': 'm', 'version': '1', 'key': 'shadowhound.robots', 'value': 'thor'}),
            ('registered-models/set-tag', {'name': 'm', 'key': 'a', 'value': 'b'}),
        )),
        *(('DELETE', f'{api}/registered-models/{what}?name=m&alias=champion', None) for api in API
          for what in ('alias', 'delete')),
        *(('PATCH', f'{api}/model-versions/update', {'name': 'm', 'version': '1', 'description': 'x'}) for api in API),
        *(('GET', f'{api}/{what}', None) for api in API
          for what in ('registered-models/get?name=m', 'registered-models/search', 'model-versions/search')),
        ('DELETE', _artifact(run), None),
        ('PATCH', '/api/2.0/mlflow/users/update-password', {'username': 'thor', 'password': 'x' * 20}),
        ('PATCH', '/api/2.0/mlflow/users/update-admin', {'username': 'thor', 'is_admin': True}),
        ('POST', '/api/3.0/mlflow/users/permissions/grant',
         {'username': 'thor', 'resource_type': 'experiment', 'resource_id': '0', 'permission': 'MANAGE'}),
        ('POST', '/graphql', {'query': f'query{{mlflowGetRun(input:{{runId:"{run_id}"}}){{run{{info{{runId}}}}}}}}'}),
        ('POST', '/v1/traces', b''), ('POST', '/ajax-api/3.0/jobs/search', {}), ('GET', '/', None),
        ('POST', '/api/2.0/mlflow-artifacts/mpu/create/1/x', {}),
    ]  # fmt: skip
    done = {path: status for method, path, body in tried if (status := thor.status(method, path, body)) != 403}
    assert done == {}
    assert users['tower'].call('GET', f'runs/get?run_id={run_id}')['run']['info']['lifecycle_stage'] == 'active'


def test_a_robot_has_no_access_to_anothers_experiment(users: dict[str, User], run: dict[str, Any]) -> None:
    """It can neither read nor write there, nor by a path that escapes its artifacts."""
    tachi, experiment, run_id = users['tachi'], run['experiment_id'], run['run_id']
    own = tachi.experiment('tachi_missions')
    metric = {'key': 'a', 'value': 9, 'timestamp': 1, 'step': 0}
    tried = [
        ('GET', f'/api/2.0/mlflow/experiments/get?experiment_id={experiment}', None),
        ('GET', '/api/2.0/mlflow/experiments/get-by-name?experiment_name=thor_missions', None),
        ('GET', f'/api/2.0/mlflow/runs/get?run_id={run_id}', None),
        ('GET', f'/api/2.0/mlflow/metrics/get-history?run_id={run_id}&metric_key=a', None),
        ('GET', f'/api/2.0/mlflow/artifacts/list?run_id={run_id}', None),
        *((method, f'{api}/{path}', body) for api in API[::2] for method, path, body in (
            ('POST', 'runs/create', {'experiment_id': experiment}), ('POST', 'runs/create', {'experimentId': experiment}),
            ('POST', 'runs/log-batch', {'run_id': run_id, 'metrics': [metric]}),
            ('POST', 'runs/log-metric', {'run_id': run_id, **metric}),
            ('POST', 'runs/log-batch', {'runId': run_id, 'metrics': [metric]}),
            ('POST', 'runs/set-tag', {'run_id': run_id, 'key': 'a', 'value': 'b'}),
            ('POST', 'runs/update', {'run_id': run_id, 'status': 'FAILED'}),
            ('POST', 'runs/update', {'run_uuid': run_id, 'status': 'FAILED'}),
            ('POST', 'experiments/set-experiment-tag', {'experiment_id': experiment, 'key': 'a', 'value': 'b'}),
        )),
        ('GET', _artifact(run), None), ('PUT', _artifact(run), b'x'),
        ('PUT', f'/api/2.0/mlflow-artifacts/artifacts/{own}/../{experiment}/x', b'x'),
        ('PUT', f'/api/2.0/mlflow-artifacts/artifacts/{own}/%2e%2e/{experiment}/x', b'x'),
        ('PUT', f'/api/2.0/mlflow-artifacts/artifacts/{own}%2f..%2f{experiment}%2fx', b'x'),
        ('PUT', '/api/2.0/mlflow-artifacts/artifacts/x', b'x'), ('PUT', '/api/2.0/mlflow-artifacts/artifacts//etc/x', b'x'),
        ('GET', f'/api/2.0/mlflow-artifacts/artifacts?path={experiment}', None),
        ('GET', '/api/2.0/mlflow-artifacts/artifacts', None),
        ('GET', f'/api/2.0/mlflow-artifacts/artifacts?path={own}/../{experiment}', None),
    ]  # fmt: skip
    done = {(method, path): answer.data for method, path, body in tried
            if (answer := tachi.send(method, path, body)).status not in {400, 403, 404}}  # fmt: skip
    assert done == {}
    assert tachi.call('POST', 'runs/search', {'experiment_ids': [experiment, own]}).get('runs', []) == []
    found = users['tower'].call('GET', f'runs/get?run_id={run_id}')['run']
    assert [one['value'] for one in found['data'].get('metrics', [])] in ([], [1])
    assert users['thor'].send('GET', _artifact(run)).data == b'frame'


@pytest.mark.parametrize('name', ['tachi', 'spark'])
def test_no_other_spelling_of_a_run_passes(users: dict[str, User], run: dict[str, Any], name: str) -> None:
    """A request with a robot's run, and another one in a spelling that MLflow's check does not read, changes neither."""
    user, run_id = users[name], run['run_id']
    experiment = user.experiment('tachi_missions') if name == 'tachi' else str(
        user.call('POST', 'experiments/create', {'name': 'spelling'})['experiment_id'])  # fmt: skip
    mine = user.run(experiment)['run_id']
    before = users['tower'].call('GET', f'runs/get?run_id={run_id}')
    for path, more in (
        ('log-batch', {'metrics': [{'key': 'spelt', 'value': 9, 'timestamp': 1, 'step': 0}]}),
        ('set-tag', {'key': 'spelt', 'value': 'b'}), ('log-parameter', {'key': 'spelt', 'value': 'v'}),
        ('update', {'status': 'FAILED'}), ('delete', {}),
    ):  # fmt: skip
        for body in ({'run_uuid': mine, 'runId': run_id, **more}, json.dumps({'run_uuid': mine, 'runId': run_id, **more})):
            assert user.status('POST', f'/api/2.0/mlflow/runs/{path}', body) in {400, 403}, path
    assert users['tower'].call('GET', f'runs/get?run_id={run_id}') == before


def test_a_model_of_another_is_not_deleted_by_a_body_that_is_not_checked(users: dict[str, User]) -> None:
    """MLflow's check reads the URL of a DELETE with a body that is not declared as JSON; its handler reads the body."""
    spark, api = users['spark'], '/api/2.0/mlflow/registered-models'
    spark.send('POST', f'{api}/create', {'name': 'decoy'})
    users['tower'].send('POST', f'{api}/create', {'name': 'kept'})
    headers = {'Authorization': spark.authorization(), 'Content-Type': 'text/plain'}
    answer = spark.http.request(
        'DELETE', f'{spark.tower.tracking_uri}{api}/delete?name=decoy', body=b'{"name": "kept"}', headers=headers, timeout=60
    )
    assert answer.status == 400
    assert users['tower'].status('GET', f'{api}/get?name=kept') == 200


PLACES = ['file:///etc', '/etc', 'file:/etc', 'FILE:///etc', 'sftp://localhost/etc', 'http://localhost:1',
          's3://sensor-data/thor', 's3://mlflow/0', 'mlflow-artifacts:/0', 'mlflow-artifacts://elsewhere/0', 'runs:/1/a',
          '../..', ' file:///etc']  # fmt: skip


@pytest.mark.parametrize('user', ['spark', pytest.param('tower', marks=pytest.mark.long('as for spark'))])
def test_no_user_chooses_the_artifact_location(users: dict[str, User], user: str) -> None:
    """Neither by the field's protobuf name nor by its JSON name, on any path, and nothing is created."""
    bodies = [{'name': f'{user}-{number}', field: place} for number, place in enumerate(PLACES)
              for field in ('artifact_location', 'artifactLocation')]  # fmt: skip
    bodies += [{**bodies[0], 'artifactLocation': ''}, {**bodies[0], 'artifactLocation': 'file:///etc', 'artifact_location': ''}]
    kinds = [(api, json.dumps(body).encode(coding)) for api in API for body in bodies for coding in ('utf-8', 'utf-16')]
    taken = [(api, body) for api, body in kinds if users[user].status('POST', f'{api}/experiments/create', body) == 200]
    made = users['tower'].call('POST', 'experiments/search', {'max_results': 1000})['experiments']
    assert {one['artifact_location'] for one in made if not one['artifact_location'].startswith('mlflow-artifacts:/')} == set()
    assert taken == []


@pytest.mark.parametrize('place', [*PLACES, 'mlflow-artifacts:/0/x\nfile:///etc', 'file:///etc#runs:/1'])
def test_no_model_comes_from_elsewhere(users: dict[str, User], run: dict[str, Any], place: str) -> None:
    """A model version with files from another location is refused."""
    spark = users['spark']
    spark.send('POST', '/api/2.0/mlflow/registered-models/create', {'name': 'policy'})
    prompt = {'tags': [{'key': 'mlflow.prompt.is_prompt', 'value': 'true'}]}
    for more in ({}, {'run_id': run['run_id']}, {'runId': run['run_id']}, prompt):
        assert spark.status('POST', '/api/2.0/mlflow/model-versions/create', {'name': 'policy', 'source': place, **more}) == 400


def test_spark_reads_missions_and_writes_its_own_runs(users: dict[str, User], run: dict[str, Any]) -> None:
    """It reads every robot's runs and changes none; it creates and deletes its own experiments and models."""
    spark = users['spark']
    read = spark.call('POST', 'runs/search', {'experiment_ids': [run['experiment_id']]})['runs']
    assert run['run_id'] in [one['info']['run_id'] for one in read]
    assert spark.send('GET', _artifact(run)).data == b'frame'
    assert spark.status('GET', '/') == 200
    for method, path, body in (
        ('PUT', _artifact(run), b'x'), ('DELETE', _artifact(run), None),
        ('POST', '/api/2.0/mlflow/runs/create', {'experiment_id': run['experiment_id']}),
        ('POST', '/api/2.0/mlflow/runs/delete', {'run_id': run['run_id']}),
        ('POST', '/api/2.0/mlflow/experiments/delete', {'experiment_id': run['experiment_id']}),
        ('POST', '/api/2.0/mlflow/experiments/set-experiment-tag',
         {'experiment_id': run['experiment_id'], 'key': 'a', 'value': 'b'}),
        ('POST', '/api/2.0/mlflow/users/create', {'username': 'mallory', 'password': 'x' * 20}),
        ('POST', '/api/2.0/mlflow/webhooks', {}), ('POST', '/api/3.0/mlflow/gateway/secrets/create', {}),
        ('POST', '/v1/traces', b''), ('POST', '/ajax-api/3.0/jobs', {}),
        ('POST', '/api/2.0/mlflow-artifacts/mpu/create/1/x', {}), ('GET', '/ajax-api/3.0/mlflow/assistant/config', None),
    ):  # fmt: skip
        assert spark.status(method, path, body) == 403, path
    own = str(spark.call('POST', 'experiments/create', {'name': 'training'})['experiment_id'])
    mine = spark.run(own)
    assert spark.status('PUT', _artifact(mine), b'weights') == 200
    assert users['thor'].status('GET', _artifact(mine)) == 403
    spark.send('POST', '/api/2.0/mlflow/registered-models/create', {'name': 'policy'})
    source = {'source': f'runs:/{mine["run_id"]}/a.txt', 'run_id': mine['run_id']}
    spark.call('POST', 'model-versions/create', {'name': 'policy', **source})
    spark.call('POST', 'experiments/delete', {'experiment_id': own})


def test_a_second_password_is_valid_immediately(users: dict[str, User], tower: Tower, tmp_path: Path) -> None:
    """And a retired one is invalid: the server reloads its users, without a restart and without an interruption."""
    old, new = 'the old one', 'the new one'
    file = next(tower._folder.glob('mlflow/users.json'))
    before = file.read_text()

    def put(content: str) -> None:
        (tmp_path / 'users.json').write_text(content)
        (tmp_path / 'users.json').chmod(0o600)
        os.replace(tmp_path / 'users.json', file)

    try:
        for known, works in (([new, old], {new, old}), ([new], {new})):
            put(json.dumps({**json.loads(before), 'tachi': [mlflow_access.digest(one) for one in known]}))
            asked = {word: User(tower, 'tachi', users['tachi'].http, word).status('GET', '/version') for word in (old, new)}
            assert {word for word, status in asked.items() if status == 200} == works
    finally:
        put(before)


def test_the_files_contain_no_password(tower: Tower) -> None:
    """Neither files, logs nor command lines; and files with addresses are readable by their owner alone."""
    folder = tower._folder
    words = {tower.tracking(name)['MLFLOW_TRACKING_PASSWORD'].encode() for name in ('tower', 'spark', 'thor', 'tachi')}
    for path in (folder / 'mlflow').glob('*'):
        if path.is_file():
            assert not [word for word in words if word in path.read_bytes()], path
    assert not [word for word in words if word in (folder / 'mlflow.log').read_bytes()]
    assert {(folder / 'mlflow' / name).stat().st_mode & 0o777 for name in ('auth.ini', 'users.json')} == {0o600}
    for entry in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            assert not [word for word in words if word in entry.read_bytes()]
        except OSError:
            continue
    assert not [word for word in words if word.decode() in repr(tower)]


class Neighbor:
    """A host of the network, imitated by another loopback address; the server's address is never blocked."""

    def __init__(self, tower: Tower, address: str) -> None:
        self._place = urllib3.util.parse_url(tower.tracking_uri)
        self.address = address

    def status(self, user: str, password: str) -> tuple[int, str | None]:
        """The status of a request with this login, and how long to wait."""
        connection = HTTPConnection(str(self._place.host), self._place.port, timeout=60, source_address=(self.address, 0))
        login = base64.b64encode(f'{user}:{password}'.encode()).decode()
        try:
            connection.request('GET', '/version', headers={'Authorization': f'Basic {login}'})
            answer = connection.getresponse()
            return answer.status, answer.headers['Retry-After']
        finally:
            connection.close()


def test_only_an_address_that_guesses_must_wait(tower: Tower) -> None:
    """After some wrong passwords an address is refused even with the correct one; other addresses are not."""
    password = tower.tracking('spark')['MLFLOW_TRACKING_PASSWORD']
    guesser, other = Neighbor(tower, '127.0.9.1'), Neighbor(tower, '127.0.9.2')
    wrong = [guesser.status('spark', f'guess {number}')[0] for number in range(mlflow_access.MAX_WRONG + 2)]
    assert wrong == [401] * mlflow_access.MAX_WRONG + [429] * 2
    assert guesser.status('spark', password) == (429, '60')
    assert other.status('spark', password) == (200, None)
    assert Neighbor(tower, '127.0.0.1').status('spark', password) == (200, None)


def test_the_memory_of_wrong_passwords_is_bounded() -> None:
    """Any number of addresses may guess; current ones are remembered, and a wait ends."""
    now = [0.0]
    wrong = mlflow_access.WrongPasswords(lambda: now[0])
    for number in range(3 * mlflow_access.MAX_ADDRESSES):
        wrong.add(f'10.0.{number >> 8}.{number & 255}')
    assert len(wrong._failures) == mlflow_access.MAX_ADDRESSES
    for number in range(3 * mlflow_access.MAX_WRONG):
        assert bool(wrong.wait_s('fd00::1')) is (number >= mlflow_access.MAX_WRONG)
        wrong.add(f'fd00::{number:x}')
    assert len(wrong._failures['fd00::/64']) == mlflow_access.MAX_WRONG
    assert (wrong.wait_s('fd00:0:0:1::'), wrong.wait_s('10.9.9.9')) == (0.0, 0.0)
    now[0] += mlflow_access.WRONG_S
    assert wrong.wait_s('fd00::1') == 0.0


@pytest.mark.long('connections that are silent for half a minute')
@pytest.mark.parametrize('said', [b'', b'GET / HT', b'GET /version HTTP/1.1\r\nHost: x\r\nX-Slow: ', b'two'])
def test_a_silent_connection_is_closed(tower: Tower, said: bytes) -> None:
    """A client without a complete request is disconnected, also after a first one, and while it sends occasional bytes."""
    place = urllib3.util.parse_url(tower.tracking_uri)
    with socket.create_connection((str(place.host), int(place.port or 0)), timeout=1.0) as one:
        if said == b'two':
            one.sendall(b'GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
            assert one.recv(1 << 16).startswith(b'HTTP/1.1 200')
            said = b'GET /version HTTP/1.1\r\nX: '
        one.sendall(said)
        end_s = time.monotonic() + 2 * mlflow_access.SILENT_S + 5.0
        while True:
            assert time.monotonic() < end_s
            try:
                if said.startswith(b'GET /version'):
                    one.sendall(b'x')
                if one.recv(1 << 16) == b'':
                    break
            except TimeoutError:
                continue
            except OSError:
                break


def _asgi_routes() -> list[tuple[str, str]]:
    """Method and path of each route that MLflow serves outside Flask, which Flask's check does not cover."""
    program = """
import json
from mlflow.server import app, fastapi_app
for one in fastapi_app.create_fastapi_app(app).routes:
    router = getattr(one, 'original_router', None)
    for route in router.routes if router is not None else ():
        for method in getattr(route, 'methods', None) or ['WEBSOCKET']:
            print(json.dumps([method, one.include_context.prefix + route.path]))
"""
    with tempfile.TemporaryDirectory() as folder:
        environ = {name: value for name, value in os.environ.items() if not name.startswith(('MLFLOW_', '_MLFLOW_'))}
        environ['_MLFLOW_SERVER_FILE_STORE'] = f'sqlite:///{folder}/a.db'
        done = subprocess.run([sys.executable, '-c', program], env=environ, check=True, capture_output=True, text=True).stdout
    return [(str(method), str(path)) for method, path in map(json.loads, done.splitlines())]


@pytest.mark.long('imports all of MLflow')
def test_routes_outside_flask_are_closed(users: dict[str, User]) -> None:
    """Each route of this version is refused to strangers, robots and Spark, however a robot spells its path."""
    routes = _asgi_routes()
    assert {'/v1/traces', '/gateway/proxy/{endpoint_name}/{path:path}'} < {path for _, path in routes}
    assert len(routes) > 60
    assert 'WEBSOCKET' not in {method for method, _ in routes}
    public = {'/health', '/ajax-api/3.0/mlflow/server-info', '/api/3.0/mlflow/server-info'}
    opened = []
    for method, route in routes:
        path = re.sub(r'\{[^}]*\}', 'x', route)
        if route in public:
            continue
        spellings = [path, f'/{path}', f'{path}/', path.replace('/', '//', 2)[1:], f'/x/..{path}', path.replace('/', '/%2e/', 1),
                     path.replace('gateway', 'Gateway').replace('api', '%61pi')]  # fmt: skip
        for name in ('', 'thor', 'spark'):
            for spelling in spellings if name == 'thor' else [path]:
                status = users[name].status(method, spelling, None if method == 'GET' else b'{}')
                if status < 400:
                    opened.append((name, method, spelling, status))
    assert opened == []


@pytest.mark.parametrize('name', ['', 'thor', 'spark'])
def test_no_user_can_make_the_server_fetch_a_url(users: dict[str, User], name: str) -> None:
    """No webhook, no gateway secret or endpoint, no scorer: every feature that makes the server send a request is refused."""
    url = 'http://169.254.169.254/latest/meta-data/'
    asked = [
        ('POST', '/api/2.0/mlflow/webhooks', {'name': 'x', 'url': url, 'events': [{'entity': 'RUN', 'action': 'CREATED'}]}),
        ('POST', '/api/2.0/mlflow/webhooks/test', {'webhook_id': '1'}),
        ('POST', '/api/3.0/mlflow/gateway/secrets/create', {'secret_name': 'x', 'secret_value': {'api_base': url}}),
        ('POST', '/ajax-api/3.0/mlflow/gateway/endpoints/create', {'name': 'x'}),
        ('POST', '/ajax-api/3.0/mlflow/scorer/invoke', {'experiment_id': '1', 'serialized_scorer': '{}'}),
        ('POST', '/ajax-api/2.0/mlflow/gateway-proxy', {'gateway_path': url}),
        ('GET', f'/ajax-api/2.0/mlflow/gateway-proxy?gateway_path={url}', None),
        ('PUT', '/ajax-api/3.0/mlflow/assistant/config', {'providers': {'x': {'base_url': url}}}),
    ]  # fmt: skip
    for method, path, body in asked:
        assert users[name].status(method, path, body) in {401, 403}, path


CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
EVIL = (
    '<img src=x onerror="window.top.pwned=1"><script>window.pwned=1</script>"\'><svg onload="window.pwned=1">'
    '[x](javascript:pwned=1)'
)
NOTE = (
    f'{EVIL}\n\n<iframe src="javascript:top.pwned=1"></iframe>\n\n[click](javascript:alert(1)) '
    '<a href="javascript:alert(1)">here</a>'
)
TAGS = {
    'mlflow.note.content': NOTE, 'mlflow.runName': EVIL, 'mlflow.user': EVIL, 'mlflow.source.name': 'javascript:alert(1)',
    'mlflow.source.type': 'PROJECT', 'mlflow.source.git.repoURL': 'javascript:alert(1)', 'mlflow.source.git.commit': EVIL,
    'mlflow.source.git.branch': EVIL, 'mlflow.project.entryPoint': EVIL, 'mlflow.gitRepoURL': 'javascript:alert(1)',
    'mlflow.databricks.notebookURL': 'javascript:alert(1)', 'mlflow.datasets': EVIL, 'policy': EVIL,
    'mlflow.loggedArtifacts': json.dumps([{'path': EVIL, 'type': 'table'}]),
    'mlflow.log-model.history': json.dumps([{'artifact_path': EVIL, 'run_id': 'x', 'flavors': {EVIL: {}}, 'model_uuid': EVIL}]),
}  # fmt: skip
SANDBOXES = 'all => all.map(one => one.getAttribute("sandbox"))'
LOOK_MS = 1500
"""Time for scripts on a page, after it is shown."""
PAGE = b"""<html><body><script>
try { window.top.pwned = 1 } catch (error) {}
fetch('/ajax-api/2.0/mlflow/users/current').then(answer => { document.title = 'read ' + answer.status; alert('read') })
</script></body></html>"""
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"><script>window.top.pwned=1;alert(1)</script></svg>'
ARTIFACTS = {
    'a.html': PAGE, 'a.htm': PAGE, 'a.svg': SVG, 'a.md': NOTE.encode(), 'a.txt': NOTE.encode(), 'a.csv': EVIL.encode(),
    'a.json': json.dumps({EVIL: EVIL}).encode(), 'table.json': json.dumps({'columns': [EVIL], 'data': [[EVIL]]}).encode(),
    'a.xhtml': b'<html xmlns="http://www.w3.org/1999/xhtml"><script>window.top.pwned=1</script></html>',
    'a.jpg': PAGE, 'none': PAGE,
    'a.geojson': json.dumps({'type': 'Feature', 'properties': {'popupContent': EVIL},
                             'geometry': {'type': 'Point', 'coordinates': [1, 1]}}).encode(),
}  # fmt: skip


@pytest.fixture(scope='module')
def browse(tower: Tower) -> Iterator[dict[str, Any]]:
    """A run of thor's, with everything that a robot can write."""
    thor = User(tower, 'thor')
    experiment = thor.experiment('thor_missions')
    made = thor.run(experiment)
    for key, value in TAGS.items():
        thor.call('POST', 'runs/set-tag', {'run_id': made['run_id'], 'key': key, 'value': value})
    note = {'experiment_id': experiment, 'key': 'mlflow.note.content', 'value': NOTE}
    thor.call('POST', 'experiments/set-experiment-tag', note)
    thor.call('POST', 'runs/log-batch', {'run_id': made['run_id'], 'params': [{'key': 'p', 'value': EVIL}]})
    for name, body in ARTIFACTS.items():
        assert thor.status('PUT', _artifact(made, name), body) == 200
    yield made
    thor.http.clear()


@pytest.mark.parametrize('name', ARTIFACTS)
def test_no_artifact_is_shown_as_a_page_of_the_server(tower: Tower, browse: dict[str, Any], name: str) -> None:
    """Browsers download a robot's artifact from any URL, and do not sniff its type."""
    spark = User(tower, 'spark')
    places = [_artifact(browse, name), _artifact(browse, name).replace('/api/', '/ajax-api/', 1)]
    for path in (*places, f'/get-artifact?path={name}&run_uuid={browse["run_id"]}'):
        answer = spark.send('GET', path)
        assert answer.status == 200
        assert answer.headers['Content-Disposition'].startswith('attachment')
        assert answer.headers['X-Content-Type-Options'] == 'nosniff'
    spark.http.clear()


@pytest.mark.long('a browser that looks at a dozen pages')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_no_script_of_a_robot_runs_in_mlflows_pages(tower: Tower, browse: dict[str, Any]) -> None:
    """Tags, notes, params and artifacts are shown: none opens a dialog, is an active link, or gets access to the page."""
    password = tower.tracking('spark')['MLFLOW_TRACKING_PASSWORD']
    place = f'/#/experiments/{browse["experiment_id"]}'
    pages = [place, f'{place}/runs', f'{place}/runs/{browse["run_id"]}',
             *(f'{place}/runs/{browse["run_id"]}/artifacts/{name}' for name in ARTIFACTS)]  # fmt: skip

    expected = {path: path.rpartition('/')[2] if '/artifacts/' in path else 'Model training' for path in pages}

    async def poll() -> dict[str, Any]:
        from playwright.async_api import async_playwright

        found: dict[str, Any] = {}
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            context = await browser.new_context(http_credentials={'username': 'spark', 'password': password})
            for path in pages:
                page, dialogs = await context.new_page(), list[str]()
                page.on('dialog', lambda dialog, dialogs=dialogs: (dialogs.append(dialog.message), dialog.dismiss())[1])
                await page.goto(tower.tracking_uri + path)
                await page.wait_for_function('expected => document.body.innerText.includes(expected)', arg=expected[path])
                if path.endswith('.html'):
                    await page.locator('iframe[src^="blob:"]').wait_for(state='attached')
                await page.wait_for_timeout(LOOK_MS)
                found[path] = {
                    'dialogs': dialogs, 'pwned': await page.evaluate('window.pwned'),
                    'links': await page.locator('a[href^="javascript:" i], iframe[src^="javascript:" i]').count(),
                    'frames': await page.eval_on_selector_all('iframe[src]', SANDBOXES),
                }  # fmt: skip
                await page.close()
            await browser.close()
        return found

    found = asyncio.run(poll())
    assert len(found) == len(pages)
    assert {path: each for path, each in found.items() if each['dialogs'] or each['pwned'] or each['links']} == {}
    frames = [sandbox for each in found.values() for sandbox in each['frames']]
    assert 'allow-scripts' in frames  # the HTML page, in a separate origin
    assert set(frames) <= {'allow-scripts'}
