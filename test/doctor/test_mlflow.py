"""Findings about an MLflow server, with that of a Tower."""

from __future__ import annotations

import base64
import json
import sqlite3
import threading
import urllib.request
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from doctor.scene import Scene, assert_finding
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.doctor import mlflow
from shadowhound_data_logger.doctor.model import Result, Severity

pytestmark = pytest.mark.seaweedfs


def rest(tower: Tower, path: str, **body: Any) -> Any:
    """One request to MLflow."""
    url = f'{tower.tracking_uri}/api/2.0/mlflow/{path}'
    password = tower.tracking('tower')['MLFLOW_TRACKING_PASSWORD']
    login = 'Basic ' + base64.b64encode(f'tower:{password}'.encode()).decode()
    headers = {'Content-Type': 'application/json', 'Authorization': login}
    request = urllib.request.Request(url, json.dumps(body).encode(), headers)  # noqa: S310 - ours
    with urllib.request.urlopen(request, timeout=60.0) as answer:  # noqa: S310
        return json.loads(answer.read())


class _Open(BaseHTTPRequestHandler):
    """An MLflow server without users, up to the first write."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'OK')

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers['Content-Length']))
        self.do_GET()

    def log_message(self, *_: object) -> None:
        pass


def test_an_mlflow_without_authentication_is_named(with_tower: Scene) -> None:
    """An open server is named, with the consequences."""
    server = ThreadingHTTPServer(('127.0.0.1', 0), _Open)
    serving = threading.Thread(target=server.serve_forever)
    serving.start()
    with_tower.stack.callback(serving.join)
    with_tower.stack.callback(server.server_close)
    with_tower.stack.callback(server.shutdown)
    with_tower.environ['MLFLOW_TRACKING_URI'] = f'http://127.0.0.1:{server.server_port}'
    found = {result.check: result for result in with_tower.findings('mlflow')}
    assert found['mlflow.open'].severity is Severity.WARNING
    assert 'make tower-secrets' in found['mlflow.open'].remedy


def test_the_login_of_mlflows_own_file_is_used(with_tower: Scene, servers: Tower) -> None:
    """~/.mlflow/credentials counts if the environment has none, as for MLflow's clients; an incomplete login is found."""
    user, password = (with_tower.environ.pop(name) for name in ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'))
    file = Path(with_tower.environ['HOME']) / '.mlflow/credentials'
    file.parent.mkdir()
    file.write_text(f'[mlflow]\nmlflow_tracking_username = {user}\n')
    file.chmod(0o600)
    assert_finding(with_tower.findings('environment'), 'environment.login', 'MLFLOW_TRACKING_PASSWORD')
    file.write_text(f'[mlflow]\nmlflow_tracking_username = {user}\nmlflow_tracking_password = {password}\n')
    assert with_tower.findings('environment', 'mlflow') == []


def test_artifacts_that_do_not_reach_their_store_are_a_finding(with_tower: Scene, servers: Tower) -> None:
    """MLflow responds and accepts experiments; only the artifact itself shows it."""
    artifacts = servers._folder / 'mlflow/artifacts'
    away = artifacts.with_name('away')
    if artifacts.exists():
        artifacts.rename(away)
    artifacts.write_text('a disk that is not mounted')
    try:
        assert_finding(with_tower.findings('mlflow'), 'mlflow.artifacts', 'docker logs', 'MLFLOW_S3')
    finally:
        artifacts.unlink()
        if away.exists():
            away.rename(artifacts)


def test_artifacts_that_stay_on_the_robot_are_a_finding(with_tower: Scene, servers: Tower, tmp_path: Path) -> None:
    """The guide's last problem: the run succeeds, and its artifacts are not in any store."""
    experiment = rest(servers, 'experiments/search', filter="name = 'thor_missions'", max_results=1)['experiments'][0]
    number = experiment['experiment_id']
    with closing(sqlite3.connect(servers._folder / 'mlflow/mlflow.db')) as database:  # as an older server created it
        move = 'update experiments set artifact_location = ? where experiment_id = ?'
        with database:
            database.execute(move, (f'file://{tmp_path}', number))
        try:
            assert_finding(with_tower.findings('mlflow'), 'mlflow.artifacts', '--artifacts-destination s3://mlflow')
        finally:
            with database:
                database.execute(move, (experiment['artifact_location'], number))
    rest(servers, 'experiments/delete', experiment_id=number)
    try:
        assert_finding(with_tower.findings('mlflow'), 'mlflow.missions', f'mlflow experiments restore -x {number}')
    finally:
        rest(servers, 'experiments/restore', experiment_id=number)


def test_artifacts_that_are_sent_to_s3_directly_need_credentials(with_tower: Scene, servers: Tower) -> None:
    """Then the robot's keys and MLFLOW_S3_ENDPOINT_URL are used."""
    assert_finding(_direct(with_tower, 's3://mlflow/9'), 'mlflow.artifacts', 's3:PutObject', 'mlflow')
    with_tower.environ |= servers.environment('tower')
    assert [result.severity for result in _direct(with_tower, 's3://mlflow/9')] == [Severity.OK]


def _direct(scene: Scene, location: str) -> list[Result]:
    return list(mlflow._direct(location, scene.context()))
