"""MLflow behind TLS: why its certificate is not believed; nothing goes to a server that is not, nor is a redirect followed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from stores.certificates import DAY, Authority
from stores.tls_front import behind_tls

from shadowhound_data_logger.core.errors import TrackingUnavailable
from shadowhound_data_logger.missions.tracking import ENVIRONMENT, MlflowTracking

WRONG: dict[str, tuple[str, dict[str, Any], str, str]] = {
    'unknown': ('stranger', {}, 'is not trusted', 'MLFLOW_TRACKING_SERVER_CERT_PATH'),
    'expired': ('authority', {'begins': -2 * DAY, 'ends': timedelta(hours=-1)}, 'has expired', 'renew it'),
    'host': ('authority', {'host': '10.0.0.1'}, 'is for another name', 'MLFLOW_TRACKING_URI'),
}


class Elsewhere(BaseHTTPRequestHandler):
    """Sends everybody to another server."""

    target = ''
    asked = 0

    def do_GET(self) -> None:
        type(self).asked += 1
        self.send_response(307)
        self.send_header('Location', self.target + self.path)
        self.send_header('Content-Length', '0')
        self.end_headers()

    def do_POST(self) -> None:
        self.do_GET()

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def serve() -> Iterator[Callable[[str], tuple[str, type[Elsewhere]]]]:
    """Starts servers that redirect; their URL, and what counts their requests."""
    running: list[tuple[ThreadingHTTPServer, Thread]] = []

    def start(target: str) -> tuple[str, type[Elsewhere]]:
        handler = type('Handler', (Elsewhere,), {'target': target, 'asked': 0})
        server = ThreadingHTTPServer(('127.0.0.1', 0), handler)
        thread = Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
        thread.start()
        running.append((server, thread))
        return f'http://127.0.0.1:{server.server_port}', handler

    yield start
    for server, thread in running:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def authorities(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Authority]:
    """One that MLflow's client is configured to trust, and an unknown one."""
    found = {name: Authority(tmp_path, name) for name in ('authority', 'stranger')}
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('MLFLOW_TRACKING_SERVER_CERT_PATH', str(found['authority'].path))
    return found


@pytest.mark.parametrize('kind', WRONG)
def test_a_certificate_that_is_not_believed(
    kind: str, authorities: dict[str, Authority], serve: Callable[[str], tuple[str, type[Elsewhere]]]
) -> None:
    """Each kind has its words and its remedy, and no request reaches the server."""
    signer, how, words, remedy = WRONG[kind]
    url, handler = serve('http://127.0.0.1:1')
    with behind_tls(url, authorities[signer].sign(kind, **how)) as tower:
        with pytest.raises(TrackingUnavailable) as caught:
            MlflowTracking(tower.url, 'missions').run_of('id', 'name', 0, {})
        assert tower.inside.heard == b''
    assert words in str(caught.value)
    assert remedy in str(caught.value)
    assert tower.url in str(caught.value)
    assert handler.asked == 0


def test_a_redirect_is_not_followed(
    authorities: dict[str, Authority], serve: Callable[[str], tuple[str, type[Elsewhere]]]
) -> None:  # fmt: skip
    """What a trusted server says does not lead to one that talks in clear."""
    plain, there = serve('http://127.0.0.1:1')
    url, here = serve(plain)
    with behind_tls(url, authorities['authority'].sign('good')) as tower, pytest.raises(TrackingUnavailable):
        MlflowTracking(tower.url, 'missions').run_of('id', 'name', 0, {})
    assert here.asked > 0
    assert there.asked == 0
