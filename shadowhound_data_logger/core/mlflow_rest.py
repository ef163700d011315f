"""The few requests to an MLflow server that do without MLflow's own client, which takes seconds to import.

https://mlflow.org/docs/latest/api_reference/rest-api.html
"""

from __future__ import annotations

import base64
import configparser
import http.client
import json
import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlencode
from urllib.request import HTTPRedirectHandler, HTTPSHandler, Request, build_opener

from shadowhound_data_logger.core.errors import TrackingError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.core.untrusted import from_json

LOGIN: Final = ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD')
BUNDLES: Final = ('MLFLOW_TRACKING_SERVER_CERT_PATH', 'REQUESTS_CA_BUNDLE', 'CURL_CA_BUNDLE')
"""Variables that name the trusted authorities; the first that is set counts."""
TEXT: Final = 300
"""Maximum characters of a response in an error."""
TIMEOUT_S: Final = 4.0
"""A Tower that needs longer for a response is unusable; the sum of all waits must fit into the run."""
MAX_RESPONSE_BYTES: Final = 1 << 20


class _NoRedirects(HTTPRedirectHandler):
    """Refuses redirects: the target would receive the password."""

    def redirect_request(self, *_: Any) -> None:
        return None


class MlflowRest:
    """Client of one MLflow server's REST API.

    Raises TrackingUnavailable without a response, TrackingRefused (data: status, code, text) for an error.
    """

    def __init__(self, url: str, environ: Mapping[str, str], home: Path) -> None:
        """``url`` has no user, password or trailing slash.

        ``home`` is the user's home, where MLflow's clients look for a user and password that are not in the environment.
        """
        self._url = url
        self.user, password = login(environ, home)
        self._headers = {'Content-Type': 'application/json', 'User-Agent': 'shadowhound-data'}
        self._authorization = _authorization(self.user, password, environ.get('MLFLOW_TRACKING_TOKEN', ''))
        self._trust: ssl.SSLContext | None = None
        if url.startswith('https:'):
            bundle = next(filter(None, map(environ.get, BUNDLES)), None)
            is_folder = bundle is not None and Path(bundle).is_dir()
            self._trust = ssl.create_default_context(cafile=None if is_folder else bundle, capath=bundle if is_folder else None)
            if client := environ.get('MLFLOW_TRACKING_CLIENT_CERT_PATH'):
                self._trust.load_cert_chain(client)
            if environ.get('MLFLOW_TRACKING_INSECURE_TLS', '').lower() == 'true':
                self._trust.check_hostname, self._trust.verify_mode = False, ssl.CERT_NONE
        self._opener = build_opener(_NoRedirects, HTTPSHandler(context=self._trust))

    def experiment(self, name: str) -> dict[str, Any] | None:
        """An experiment by its name, including deleted ones."""
        try:
            answer = self.json('GET', 'experiments/get-by-name?' + urlencode({'experiment_name': name}))
        except TrackingRefused as error:
            if error.data['code'] == 'RESOURCE_DOES_NOT_EXIST':
                return None
            raise
        found: dict[str, Any] = answer['experiment']
        return found

    def is_open(self) -> bool:
        """Whether it shows its experiments without a password."""
        try:
            self.send('POST', f'{self._url}/api/2.0/mlflow/experiments/search', b'{"max_results": 1}', anonymous=True)
        except TrackingRefused:
            return False
        return True

    def create(self, name: str) -> None:
        self.json('POST', 'experiments/create', {'name': name})

    def restore(self, experiment_id: str) -> None:
        self.json('POST', 'experiments/restore', {'experiment_id': experiment_id})

    def tag(self, experiment_id: str, name: str, value: str) -> None:
        self.json('POST', 'experiments/set-experiment-tag', {'experiment_id': experiment_id, 'key': name, 'value': value})

    def artifact_url(self, path: str) -> str:
        """The URL of the server's artifact proxy."""
        return f'{self._url}/api/2.0/mlflow-artifacts/artifacts/{quote(path)}'

    def get(self, path: str) -> str:
        """A page of the server, such as ``/health``."""
        return self.send('GET', f'{self._url}{path}').decode(errors='replace').strip()

    def json(self, method: str, path: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """One request to the REST API, such as ``runs/get``, and its response."""
        data = json.dumps(body).encode() if body is not None else None
        answer = self.send(method, f'{self._url}/api/2.0/mlflow/{path}', data)
        try:
            found = from_json(answer)
        except ValueError as error:
            raise TrackingUnavailable(f'{self._url} does not answer like an MLflow server', code='') from error
        if not isinstance(found, dict):
            raise TrackingUnavailable(f'{self._url} does not answer like an MLflow server', code='')
        return found

    def send(self, method: str, url: str, data: bytes | None = None, *, anonymous: bool = False) -> bytes:
        """Send one request."""
        try:
            headers = self._headers if anonymous else {**self._headers, **self._authorization}
            request = Request(url, data, headers, method=method)  # noqa: S310 - http(s), see services
            with self._opener.open(request, timeout=TIMEOUT_S) as answer:
                content: bytes = answer.read(MAX_RESPONSE_BYTES + 1)
        except HTTPError as error:
            raise _refused(self._url, error) from error
        except (URLError, OSError, http.client.HTTPException, ValueError) as error:
            reason = getattr(error, 'reason', error)
            what = (
                f'gives no answer within {TIMEOUT_S:g} s' if isinstance(reason, TimeoutError) else f'cannot be reached: {reason}'
            )
            raise TrackingUnavailable(f'{self._url} {what}', code='') from error
        if len(content) > MAX_RESPONSE_BYTES:
            raise TrackingUnavailable(f'{self._url} answers with more than {MAX_RESPONSE_BYTES:,} bytes', code='')
        return content


def _refused(url: str, error: HTTPError) -> TrackingError:
    try:
        with error:
            text = error.read(MAX_RESPONSE_BYTES).decode(errors='replace')
    except (OSError, http.client.HTTPException, ValueError):  # the connection breaks off
        text = ''
    try:
        body = from_json(text.encode())
        code, message = str(body['error_code']), str(body.get('message', ''))
    except (ValueError, KeyError, TypeError):
        code, message = '', ' '.join(text.split())
    return TrackingRefused(f'{url} answers {error.code} {code}: {message[:TEXT]}', status=error.code, code=code, text=message)


def login(environ: Mapping[str, str], home: Path) -> tuple[str, str]:
    """User and password as MLflow's clients find them, empty if missing: variables, then ~/.mlflow/credentials."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string((home / '.mlflow/credentials').read_text(encoding='utf-8'))
    except (OSError, ValueError, configparser.Error):
        parser.clear()
    user, password = (environ.get(name) or parser.get('mlflow', name.lower(), fallback=None) or '' for name in LOGIN)
    return user, password


def _authorization(user: str, password: str, token: str) -> dict[str, str]:
    if user:
        return {'Authorization': 'Basic ' + base64.b64encode(f'{user}:{password}'.encode()).decode('ascii')}
    return {'Authorization': f'Bearer {token}'} if token else {}
