"""Access control of a Tower's MLflow server: it requires a password, and limits each user to its purpose.

MLflow's own app ``basic-auth`` controls access to experiments and runs; this module adds the rest. The server loads it to check
the password of each request (``authenticate``), so that a user can have two during a change, and to reject requests that a user
does not need before MLflow handles them: without a rule here, only ``tower`` is allowed. No user can choose where artifacts are
stored, not even ``tower``.

It uses only the standard library and MLflow's dependencies: the container of compose.yaml has only this file, and runs ``main``.
"""

from __future__ import annotations

import argparse
import hashlib
import hmac
import ipaddress
import json
import os
import re
import secrets
import signal
import ssl
import subprocess
import sys
import time
from base64 import b64encode
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request as Question
from urllib.request import urlopen

if TYPE_CHECKING:
    from asyncio import Protocol

    from flask import Request, Response
    from werkzeug.datastructures import Authorization

    Message = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[Message]]
    Send = Callable[[Message], Awaitable[None]]
    Served = Callable[[Message, Receive, Send], Awaitable[None]]

ADMIN: Final = 'tower'
READER: Final = 'spark'
USERS: Final = 'SHADOWHOUND_MLFLOW_USERS'
"""The server's variable with the path of its users file: JSON, user -> SHA-256 of each password, in hex."""
APP: Final = ('--app-name', 'basic-auth')
"""Required arguments of ``mlflow server``."""
SOURCES: Final = r'\A((runs|models|mlflow-artifacts):/|s3://lerobot/policies/)[^\r\n]*\Z'
"""Allowed sources of a model's files: the server's own storage, and the policies, for which it has no keys."""
BODY_BYTES: Final = 32 << 20
"""Maximum size of a request body that MLflow keeps in memory; the inputs of a run may have 17 MB. Artifacts are streamed.
"""
MAX_WRONG, WRONG_S = 10, 60.0
"""After this many wrong passwords within this time an address must wait."""
MAX_ADDRESSES: Final = 1000
"""Maximum number of addresses with wrong passwords; beyond it the one with the oldest failure is dropped."""
LOOPBACK: Final = frozenset({'', '127.0.0.1', '::1'})
"""Addresses that never wait: programs of this machine, such as a reverse proxy in front of all clients."""
SILENT_S: Final = 20.0
"""A connection without a request is closed after at most twice this time."""
NO_USER: Final = 'MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD are not a user of this Tower'
ANSWER_S: Final = 30.0
START_S: Final = 180.0
POLL_S: Final = 0.5

_API: Final = r'/(?:ajax-)?api/[23]\.0/(?:preview/)?mlflow/'
_ARTIFACTS: Final = r'/(?:ajax-)?api/2\.0/mlflow-artifacts/artifacts(?:/.*)?'
_ALIAS: Final = _API + r'registered-models/alias'
_ROBOT: Final = (
    ('GET', _ALIAS),
    ('GET', _API + r'(?:experiments/get-by-name|experiments/get|runs/get|artifacts/list|metrics/get-history|users/current)'),
    ('POST', _API + r'runs/(?:create|update|search|log-batch|log-metric|log-parameter|set-tag|delete-tag)'),
    ('POST', _API + r'(?:experiments/set-experiment-tag|logged-models/search)'),  # the latter is part of listing artifacts
    ('GET', _ARTIFACTS),
    ('PUT', _ARTIFACTS),
    ('GET', r'/version'),
)
"""What a robot needs: to log missions. It creates no experiment and deletes nothing."""
_READER: Final = (
    *_ROBOT,
    *((method, _API + r'(?:experiments|runs|metrics|artifacts|logged-models|registered-models|model-versions)/(?!permissions).*')
      for method in ('GET', 'POST', 'PATCH', 'DELETE')),
    ('POST', _API + r'(?:upload-artifact|traces/search)'),
    ('DELETE', _ARTIFACTS),
    ('POST', r'/(?:ajax-api/2\.0/mlflow/)?graphql'),
    ('GET', r'/(?:(?:model-versions/)?get-artifact)?'),
)  # fmt: skip
"""For training, in addition: its own experiments and models, and the pages."""
_FREE_BODY: Final = r'/(?:ajax-api/2\.0/mlflow/)?graphql|' + _API + r'upload-artifact|' + _ARTIFACTS
"""Requests whose bodies are not protocol messages."""


class NotPrepared(Exception):
    """MLflow's users could not be set up; the text has the reason, without a password."""


def digest(password: str) -> str:
    """The form in the users file. A random password of 256 bits needs no slow hash: it cannot be guessed."""
    return hashlib.sha256(password.encode()).hexdigest()


def may(user: str, method: str, path: str) -> bool:
    """Whether a user needs this request at all; access to the experiment is decided by MLflow afterwards."""
    if user == ADMIN:
        return True
    rules = _READER if user == READER else _ROBOT
    return any(method == allowed and re.fullmatch(pattern, path, re.DOTALL) for allowed, pattern in rules)


def authenticate() -> Authorization | Response:
    """MLflow's ``authorization_function``: called in the server, with Flask's request, before it is handled."""
    from flask import request  # noqa: PLC0415 - those who only start the server do not need it

    given = request.authorization
    user = _user(given)
    if given is None or not user:
        return _refusal(401, 'UNAUTHENTICATED', NO_USER)
    if not may(user, request.method, request.path):
        return _refusal(403, 'PERMISSION_DENIED', f'the user {user} may not do this on this Tower')
    if user != ADMIN and request.get_data() and not re.fullmatch(_FREE_BODY, request.path) and not _is_plain(request):
        return _refusal(400, 'INVALID_PARAMETER_VALUE', 'a body must be a JSON object with names such as run_id, not runId')
    if request.method == 'GET' and re.fullmatch(_ALIAS, request.path):
        return type(given)('basic', {'username': ADMIN, 'password': ''})  # every user may see which version has an alias
    return given


def _is_plain(request: Request) -> bool:
    """Whether MLflow's check and MLflow's handler read the same from a body.

    The check ignores the names of protobuf's JSON (runId), JSON in a string, and JSON in a DELETE or PATCH with another content
    type.
    The handler accepts all of these: a request could be checked for one run, and change another.
    """
    body = request.get_json(silent=True) if request.mimetype == 'application/json' else None
    return isinstance(body, dict) and not any(name != name.lower() for name in _names(body))


def _names(value: Any) -> Iterator[str]:
    """Of all fields in a JSON value."""
    if isinstance(value, dict):
        yield from value
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _names(one)


def _user(given: Authorization | None) -> str:
    """The user of this login; empty if it is invalid."""
    user, password = (given.username or '', given.password or '') if given and given.type == 'basic' else ('', '')
    with open(os.environ[USERS], encoding='utf-8') as file:  # noqa: PTH123 - each time: a change counts at once
        known: list[str] = json.load(file).get(user, [])
    told = digest(password)
    return user if any(hmac.compare_digest(told, one) for one in known) else ''


class WrongPasswords:
    """Addresses that sent wrong passwords recently. For the event loop only; of bounded size.

    There is no limit across all addresses: it would let any host in the network lock out all others.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._failures: dict[str, deque[float]] = {}

    def wait_s(self, address: str) -> float:
        """How long the address must wait before its next password; 0 if it need not."""
        known = self._failures.get(_subnet(address))
        return max(0.0, known[0] + WRONG_S - self._now()) if known is not None and len(known) == MAX_WRONG else 0.0

    def add(self, address: str) -> None:
        network = _subnet(address)
        known = self._failures.pop(network, None) or deque(maxlen=MAX_WRONG)
        known.append(self._now())
        self._failures[network] = known  # the last one now
        if len(self._failures) > MAX_ADDRESSES:
            del self._failures[next(iter(self._failures))]


def _subnet(address: str) -> str:
    """The address, or for IPv6 its /64: a host there may use any address in it."""
    try:
        found = ipaddress.ip_address(address.partition('%')[0])
    except ValueError:
        return address
    found = getattr(found, 'ipv4_mapped', None) or found
    return str(found) if found.version == 4 else str(ipaddress.ip_network((found, 64), strict=False))


_WRONG: Final = WrongPasswords()


def connection(**given: Any) -> Protocol:
    """The protocol of uvicorn, whose app gets no body without authentication and none without a bound, and no request of an
    address that guesses passwords.

    MLflow's app reads each body into memory, and only then calls ``authenticate``. Artifacts are streamed, after it. uvicorn
    closes a connection that is idle after a request, but neither one that never sends a request nor one that never ends its
    headers.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol  # noqa: PLC0415 - see authenticate

    class Connection(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._requests_begun = self._running = 0
            self._served, self.app = self.app, self._serve
            self._timer = self.loop.call_later(SILENT_S, self._watch, 0)

        def connection_lost(self, exc: Exception | None) -> None:
            self._timer.cancel()
            super().connection_lost(exc)

        def _watch(self, requests_begun: int) -> None:
            """Close it if no request began since the last check, and none is being served."""
            if requests_begun == self._requests_begun and not self._running:
                self.transport.close()
            else:
                self._timer = self.loop.call_later(SILENT_S, self._watch, self._requests_begun)

        async def _serve(self, scope: Message, receive: Receive, send: Send) -> None:
            self._requests_begun += 1
            self._running += 1
            try:
                await _with_bound(self._served)(scope, receive, send)
            finally:
                self._running -= 1

    return Connection(**given)


def _with_bound(served: Served) -> Served:
    async def app(scope: Message, receive: Receive, send: Send) -> None:
        refused = (_wait(scope) or _body_refused(scope)) if scope['type'] == 'http' else None
        if refused is None:
            await served(scope, receive, send)
            return
        status, code, message = refused
        headers = [(b'content-type', b'application/json'), (b'connection', b'close')]
        headers += [(b'www-authenticate', b'Basic realm="Tower"')] if status == 401 else []
        headers += [(b'retry-after', str(round(WRONG_S)).encode())] if status == 429 else []
        await send({'type': 'http.response.start', 'status': status, 'headers': headers})
        await send({'type': 'http.response.body', 'body': json.dumps({'error_code': code, 'message': message}).encode()})

    return app


def _wait(scope: Mapping[str, Any]) -> tuple[int, str, str] | None:
    """Like ``_body_refused``, for an address that sent too many wrong passwords; another wrong one is counted."""
    from werkzeug.datastructures import Authorization  # noqa: PLC0415 - see authenticate

    given = next((value for name, value in scope['headers'] if name == b'authorization'), None)
    if given is None:
        return None
    address = scope['client'][0] if scope.get('client') else ''
    if address in LOOPBACK or not _WRONG.wait_s(address):
        if not _user(Authorization.from_header(given.decode('latin-1'))):
            _WRONG.add(address)
        return None  # the app reports the error
    return 429, 'RESOURCE_EXHAUSTED', 'too many wrong passwords from this address; wait a minute'


def _body_refused(scope: Mapping[str, Any]) -> tuple[int, str, str] | None:
    """Why the body of a request is not read: status, code and text; None if it is, or if there is none."""
    from werkzeug.datastructures import Authorization  # noqa: PLC0415 - see authenticate

    headers = {name: value.decode('latin-1') for name, value in scope['headers']}
    is_chunked, length = b'transfer-encoding' in headers, int(headers.get(b'content-length', 0))
    if not is_chunked and not length:
        return None
    if not _user(Authorization.from_header(headers.get(b'authorization'))):
        return 401, 'UNAUTHENTICATED', NO_USER
    if scope['method'] == 'PUT' and re.fullmatch(_ARTIFACTS, scope['path']):
        return None
    if is_chunked:
        return 411, 'BAD_REQUEST', 'a request with a body must have its length (Content-Length)'
    return (413, 'BAD_REQUEST', f'a body of more than {BODY_BYTES} bytes is not accepted') if length > BODY_BYTES else None


def _refusal(status: int, code: str, message: str) -> Response:
    from flask import jsonify  # noqa: PLC0415 - see authenticate

    made = jsonify(error_code=code, message=message)
    made.status_code = status
    if status == 401:
        made.headers['WWW-Authenticate'] = 'Basic realm="Tower"'
    return made


def environment(folder: Path, users: Path, database: str) -> dict[str, str]:
    """The variables of ``mlflow server`` with ``APP``. Writes its settings, including the address of the database.

    ``folder``, for the settings, belongs to the server's user only; ``database`` is an SQLAlchemy URI, the server's own or
    another.
    """
    package = __name__.rpartition('.')[0]
    here = Path(__file__).resolve()
    module = f'{package}.{here.stem}' if package else here.stem
    settings = {
        'default_permission': 'NO_PERMISSIONS', 'database_uri': database.replace('%', '%%'), 'admin_username': ADMIN,
        'authorization_function': f'{module}:{authenticate.__name__}', 'grant_default_workspace_access': 'false',
    }  # fmt: skip
    path = folder / 'auth.ini'
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w', encoding='utf-8') as file:
        file.write('[mlflow]\n' + ''.join(f'{name} = {value}\n' for name, value in settings.items()))
    root = here.parents[package.count('.') + 1] if package else here.parent
    return {
        USERS: str(users), 'MLFLOW_AUTH_CONFIG_PATH': str(path),
        'MLFLOW_AUTH_ADMIN_PASSWORD': secrets.token_urlsafe(32),  # for its own list of users, which is never used for logins
        'MLFLOW_FLASK_SERVER_SECRET_KEY': secrets.token_urlsafe(32),
        'MLFLOW_BASIC_AUTH_FAIL_CLOSED': 'true',
        'MLFLOW_ARTIFACT_LOCATION_MAX_LENGTH': '0',  # an experiment that names one is rejected
        'MLFLOW_CREATE_MODEL_VERSION_SOURCE_VALIDATION_REGEX': SOURCES,
        'MLFLOW_DISABLE_TELEMETRY': 'true', 'MLFLOW_SERVER_ENABLE_JOB_EXECUTION': 'false',
        'UVICORN_HTTP': f'{module}:{connection.__name__}',
        'PYTHONPATH': os.pathsep.join(filter(None, (str(root), os.environ.get('PYTHONPATH')))),
    }  # fmt: skip


def is_up(url: str, trust: ssl.SSLContext | None = None) -> bool:
    """Whether a server answers at all."""
    try:
        with urlopen(f'{url}/health', timeout=ANSWER_S, context=trust) as answer:  # noqa: S310 - http(s), by us
            return bool(answer.status == 200)
    except OSError:
        return False


def experiment_of(robot: str) -> str:
    """The experiment of a robot's missions."""
    return f'{robot}_missions'


def prepare(url: str, password: str, robots: Iterable[str], trust: ssl.SSLContext | None = None) -> list[str]:
    """Set up a server's users, each robot's experiment, and read access for ``spark``; can be run again at any time.

    ``password`` is that of ``tower``. Returns a sentence for each experiment whose artifacts are stored elsewhere. Raises
    NotPrepared.
    """
    server = _Server(url, password, trust)
    robots = list(robots)
    for user in (READER, *robots):
        server.ask('POST', '2.0/mlflow/users/create', {'username': user, 'password': secrets.token_urlsafe(32)})
    for robot in robots:
        name = experiment_of(robot)
        server.ask('POST', '2.0/mlflow/experiments/create', {'name': name})
        found = server.ask('GET', '2.0/mlflow/experiments/get-by-name?' + urlencode({'experiment_name': name}))['experiment']
        for user, permission in ((robot, 'EDIT'), (READER, 'READ')):
            grant = {'resource_type': 'experiment', 'resource_id': found['experiment_id'], 'permission': permission}
            server.ask('POST', '3.0/mlflow/users/permissions/grant', {'username': user, **grant})
    return [
        f'the experiment {one["name"]} keeps its artifacts in {one["artifact_location"]}: delete it, or find out who created it'
        for one in server.experiments() if not one['artifact_location'].startswith('mlflow-artifacts:')
    ]  # fmt: skip


class _Server:
    """Client of the MLflow server as ``tower``. Raises NotPrepared."""

    def __init__(self, url: str, password: str, trust: ssl.SSLContext | None) -> None:
        self._url = url
        self._headers = {
            'Content-Type': 'application/json', 'Authorization': 'Basic ' + b64encode(f'{ADMIN}:{password}'.encode()).decode(),
        }  # fmt: skip
        self._trust = trust

    def ask(self, method: str, path: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Send a request; if the object already exists, the result is empty."""
        data = json.dumps(body).encode() if body is not None else None
        try:
            request = Question(f'{self._url}/api/{path}', data, self._headers, method=method)  # noqa: S310 - http(s), by us
            with urlopen(request, timeout=ANSWER_S, context=self._trust) as answer:  # noqa: S310
                found: dict[str, Any] = json.loads(answer.read() or b'{}')
                return found
        except HTTPError as error:
            with error:
                reply = error.read().decode(errors='replace')[:300]
            if 'RESOURCE_ALREADY_EXISTS' in reply:
                return {}
            raise NotPrepared(f'{self._url} answers {error.code} to {path.partition("?")[0]}: {reply}') from error
        except (OSError, ValueError) as error:
            raise NotPrepared(f'{self._url} cannot be reached: {error}') from error

    def experiments(self) -> Iterable[dict[str, Any]]:
        page = ''
        while True:
            question = {'max_results': 1000, 'view_type': 'ALL', **({'page_token': page} if page else {})}
            found = self.ask('POST', '2.0/mlflow/experiments/search', question)
            yield from found.get('experiments', [])
            if not (page := found.get('next_page_token', '')):
                return


def parser() -> argparse.ArgumentParser:
    """The command line; the command of ``mlflow server`` follows ``--``."""
    made = argparse.ArgumentParser(description='Run mlflow server with the users of a Tower.')
    made.add_argument('--users', type=Path, required=True, help='the file of users and digests, from make_secrets.py')
    made.add_argument('--password', type=Path, required=True, metavar='FILE', help='the file with the password of tower')
    made.add_argument('--folder', type=Path, required=True, help="folder of the server's settings, readable by this user only")
    made.add_argument('command', nargs='+', help='mlflow server ...')
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a server and prepare it."""
    options = parser().parse_args(arguments)
    password = options.password.read_text(encoding='utf-8').strip()
    settings = environment(options.folder, options.users, os.environ['MLFLOW_BACKEND_STORE_URI'])
    is_tls = any('--ssl-certfile' in word for word in options.command)
    url = f'{"https" if is_tls else "http"}://127.0.0.1:{options.command[options.command.index("--port") + 1]}'
    trust = ssl._create_unverified_context() if is_tls else None  # noqa: S323 - ourselves, by the loopback
    with subprocess.Popen([*options.command, *APP], env={**os.environ, **settings}) as server:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: server.terminate())
        end_s = time.monotonic() + START_S
        while server.poll() is None and not is_up(url, trust) and time.monotonic() < end_s:
            time.sleep(POLL_S)
        try:
            robots = [name for name in json.loads(options.users.read_text(encoding='utf-8')) if name not in {ADMIN, READER}]
            for text in prepare(url, password, robots, trust) if server.poll() is None else ():
                print(text, file=sys.stderr, flush=True)
        except NotPrepared as error:
            print(f'mlflow: {error}', file=sys.stderr, flush=True)
            server.terminate()
            server.wait()
            return 1
        return server.wait()


if __name__ == '__main__':
    sys.exit(main())
