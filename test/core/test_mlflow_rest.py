"""Requests to MLflow without its client: a hostile server gets no password and breaks nothing."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from shadowhound_data_logger.core.errors import TrackingError, TrackingRefused
from shadowhound_data_logger.core.mlflow_rest import MlflowRest

LOGIN = {'MLFLOW_TRACKING_USERNAME': 'thor', 'MLFLOW_TRACKING_PASSWORD': 'secret'}


@contextmanager
def answering(status: int, body: bytes = b'', headers: Mapping[str, str] | None = None) -> Iterator[tuple[str, list[str | None]]]:
    """A server with one response, and the passwords that it received."""
    shown: list[str | None] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            shown.append(self.headers.get('Authorization'))
            self.send_response(status)
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.send_header('Content-Length', str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield f'http://localhost:{server.server_port}', shown
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_a_redirect_is_not_followed(tmp_path: Path) -> None:
    """Its target does not receive the password, whatever else the request contains."""
    with answering(200, b'{}') as (other, shown), answering(302, headers={'Location': other}) as (url, _):
        with pytest.raises(TrackingRefused, match='302'):
            MlflowRest(url, LOGIN, tmp_path).json('GET', 'runs/get')
        assert shown == []


@pytest.mark.parametrize('status', [200, 400, 503])
@pytest.mark.parametrize('broken', [b'zz\r\n', b'5\r\n{', b'-5\r\n', b''])
def test_an_incomplete_answer_is_an_error(tmp_path: Path, status: int, broken: bytes) -> None:
    """It is one of our errors, whether or not the status is one."""
    chunked = {'Transfer-Encoding': 'chunked', 'Connection': 'close'}
    with answering(status, broken, chunked) as (url, _), pytest.raises(TrackingError):
        MlflowRest(url, LOGIN, tmp_path).json('GET', 'runs/get')


@pytest.mark.parametrize('body', [b'[' * 200_000, b'[]', b'\xff', b'{"error_code": 5}'])
def test_an_error_of_another_server_is_reported(tmp_path: Path, body: bytes) -> None:
    """It is one of our errors, whatever the body."""
    with answering(400, body) as (url, _), pytest.raises(TrackingRefused) as refused:
        MlflowRest(url, LOGIN, tmp_path).json('GET', 'runs/get')
    assert 'secret' not in str(refused.value)
