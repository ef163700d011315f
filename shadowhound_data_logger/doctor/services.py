"""The addresses of Tower's two services, from the environment."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit

from shadowhound_data_logger.doctor.model import Context

CONNECT_S: Final = 3.0
ANSWER_S: Final = 4.0
"""A Tower that needs longer for a response is unusable; the sum of all waits must fit into the run."""
LOCAL: Final = frozenset({'localhost', '127.0.0.1', '::1'})


@dataclass(frozen=True, slots=True)
class TowerService:
    """A server by its URL."""

    name: str
    """As in the names of checks: ``s3`` or ``mlflow``."""
    title: str
    variable: str
    url: str
    """Without user and password."""
    host: str
    port: int
    tls: bool
    usual_ports: tuple[int, ...]
    """Ports on which such a server often listens."""

    @property
    def is_local(self) -> bool:
        return self.host in LOCAL

    def at(self, port: int) -> str:
        """The URL with another port."""
        host = f'[{self.host}]' if ':' in self.host else self.host
        return f'{"https" if self.tls else "http"}://{host}:{port}'


def s3(context: Context) -> TowerService | None:
    """The S3 server; None if data is stored in a folder."""
    return _service('s3', 'the S3 server', 'AWS_ENDPOINT_URL', context.settings.store.endpoint_url or '', (9000, 8333))


def mlflow(context: Context) -> TowerService | None:
    """The MLflow server; None if there is none."""
    return _service('mlflow', 'MLflow', 'MLFLOW_TRACKING_URI', context.environ.get('MLFLOW_TRACKING_URI', ''), (5001, 5000))


def without_login(url: str) -> str:
    """A URL, which may be invalid, without user and password."""
    return re.sub('//.*@', '//', url)


def _service(name: str, title: str, variable: str, given: str, usual: tuple[int, ...]) -> TowerService | None:
    try:
        url = urlsplit(given)
        if url.scheme not in {'http', 'https'} or not url.hostname:
            return None
        port = url.port or (443 if url.scheme == 'https' else 80)
    except ValueError:
        return None
    return TowerService(name, title, variable, without_login(given).rstrip('/'), url.hostname, port, url.scheme == 'https', usual)
