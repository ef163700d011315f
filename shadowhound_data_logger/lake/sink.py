"""Sends objects, gaps, missions, events and labels as documents to Elasticsearch or OpenSearch.

Requests are plain HTTP, because each product's client rejects the other's servers: ``PUT _index_template``, ``PUT INDEX`` and
``POST _bulk`` are the same in both.
https://www.elastic.co/docs/api/doc/elasticsearch/operation/operation-bulk
https://docs.opensearch.org/latest/api-reference/document-apis/bulk/

The ``_id`` of a document is a hash of its identity, so sending it repeatedly does not duplicate it. Documents of objects never
change and are only created; those of gaps and labels are replaced by newer ones (external versions), in any order. A file
records up to which version of each table the server has confirmed the rows, so that the next run continues after a kill.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import random
import re
import sqlite3
import ssl
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import pyarrow as pa
import pyarrow.compute as pc
import urllib3

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import LakeError, SettingError, SinkUnavailable
from shadowhound_data_logger.core.retry import backoff, with_retries
from shadowhound_data_logger.core.untrusted import from_json, visible
from shadowhound_data_logger.formats.rows.catalog import FORGOTTEN, OBJECTS, TableSchema
from shadowhound_data_logger.formats.rows.gaps import GAPS, WITHDRAWN
from shadowhound_data_logger.formats.rows.labels import LABELS, REMOVED
from shadowhound_data_logger.lake import search
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import Scope, robots
from shadowhound_data_logger.lake.tables import TABLES, Tables, TableVersion
from shadowhound_data_logger.lake.views import current

if TYPE_CHECKING:
    from typing_extensions import Self

WHICH: Final = 'check that the URL is that of an Elasticsearch or OpenSearch server'
BULK_BYTES: Final = 4 << 20
"""Per request; both servers accept 100 MB by default (``http.max_content_length``)."""
BULK_DOCUMENTS: Final = 4_000
MISSIONS_AT_A_TIME: Final = 180
"""Recorded together: after a kill, at most this many are sent again."""
TRIES: Final = 8
"""Attempts per request without ``--follow``: about a minute."""
CAP_S: Final = 30.0
ANSWER_S: Final = 60.0
MAX_ANSWER_BYTES: Final = 64 << 20
MAX_REASON: Final = 200
_NAME: Final = re.compile(r'[a-z0-9][a-z0-9_.-]{0,99}', re.ASCII)
_RETRIED: Final = (429, 502, 503, 504)
_GOOD: Final = range(200, 300)
CONFLICT: Final = 409
TOO_LARGE: Final = 413
_rng: Final = random.Random()
_Answer = TypeVar('_Answer')
_KEYWORD: Final = {'type': 'keyword', 'ignore_above': 8191}
_DATE: Final = {'type': 'date_nanos'}
_WORDS: Final = {'type': 'text', 'fields': {'keyword': {'type': 'keyword', 'ignore_above': 256}}}
_OF_TYPE: Final = (
    (_KEYWORD, 'robot sensor topic type bucket key sha256 mission_id run_id mission_type pose_frame clock content_type policy'),
    (_KEYWORD, 'what id sink publisher kind cause grade label by result rule'),
    (_DATE, 'time t_start t_end t_from t_to since until made started ended forgotten'),
    ({'type': 'long'}, 'bytes t_start_ns t_end_ns count clock_offset_ns revision session from_ns to_ns merged received skipped'),
    ({'type': 'long'}, 'received_from_ns received_to_ns since_ns until_ns made_ns received_start_ns received_end_ns by_arrival'),
    ({'type': 'double'}, 'x y yaw latitude longitude altitude battery_pct width height distance_m duration_s'),
    ({'type': 'double'}, 'battery_consumed_pct'),
    ({'type': 'geo_point'}, 'location'),
    (_WORDS, 'command title text note'),
    ({'type': 'boolean'}, 'success'),
)  # fmt: skip
_FIELDS: Final = {name: mapping for mapping, names in _OF_TYPE for name in names.split()}
"""Field -> its mapping. ``x y`` are meters in the frame of the pose; the place on Earth is ``location``."""
_SUMMARY: Final = ('mission_type', 'result', 'success', 'distance_m', 'duration_s', 'battery_consumed_pct', 'policy')
ROWS, GAP_ROWS, MISSIONS, EVENTS, LABEL_ROWS = 'objects', 'gaps', 'missions', 'events', 'labels'
INDEXES: Final = (ROWS, GAP_ROWS, MISSIONS, EVENTS, LABEL_ROWS)
"""Each is an index, ``NAME-objects`` and so on."""
FORGOTTEN_ROWS: Final = 'forgotten'
"""Updates of documents in ``objects``."""


class SinkDocument(NamedTuple):
    """A document to send."""

    kind: str
    """One of ``INDEXES``."""
    id: str
    fields: Mapping[str, Any]
    version: int | None = None
    """None: create the document if it does not exist. Otherwise replace documents with a lower version."""
    is_update: bool = False
    """Whether these fields are added to an existing document."""


@dataclass(slots=True)
class SinkTally:
    """The result of a run, in documents."""

    added: int = 0
    """Created or replaced documents."""
    present: int = 0
    """Documents that already existed, in the same or a newer version."""
    refused: Counter[str] = field(default_factory=Counter)
    """Rejected documents by the server's reason; the position's file lists them."""
    restarted: list[str] = field(default_factory=list)
    """Indexes that were recreated since the last run: everything was sent again."""

    def __iadd__(self, other: SinkTally) -> Self:
        self.added += other.added
        self.present += other.present
        self.refused.update(other.refused)
        self.restarted += other.restarted
        return self


# -- the server ----------------------------------------------------------------------------------------------------------------


class SearchServer:
    """A client of one Elasticsearch (7.8 or later) or OpenSearch server. Its repr shows no secret.

    ``authorization`` is the value of the HTTP header (see the function of this name). Raises SettingError for an invalid URL,
    SinkUnavailable if the server does not answer or is overloaded, LakeError if it rejects a request.
    """

    def __init__(self, url: str, authorization: str = '', ca: Path | None = None) -> None:
        try:
            parsed = urllib3.util.parse_url(url)
        except urllib3.exceptions.LocationParseError as error:
            raise SettingError('URL', url[:200], 'http://HOST:9200 or https://HOST:9200') from error
        if parsed.auth:
            raise SettingError(
                'URL',
                'with a password',
                'a URL without a password: set ELASTIC_USERNAME and ELASTIC_PASSWORD, or ELASTIC_API_KEY',
            )
        if parsed.scheme not in {'http', 'https'} or not parsed.host or parsed.query or parsed.fragment:
            raise SettingError('URL', url[:200], 'http://HOST:9200 or https://HOST:9200')
        self.url = f'{parsed.scheme}://{parsed.netloc}{(parsed.path or "").rstrip("/")}'
        trust = ssl.create_default_context(cafile=None if ca is None else str(ca)) if parsed.scheme == 'https' else None
        self._pool = urllib3.PoolManager(1, maxsize=1, retries=False, timeout=urllib3.Timeout(5.0, ANSWER_S), ssl_context=trust)
        self._headers = {'User-Agent': 'shadowhound-data', **({'Authorization': authorization} if authorization else {})}

    def close(self) -> None:
        self._pool.clear()

    def ask(self, method: str, path: str, body: bytes | None = None, kind: str = 'application/json',
            allowed: Sequence[int] = ()) -> tuple[int, Any]:  # fmt: skip
        """Send a request; returns status and JSON of the response. Statuses other than 2xx and the allowed ones are errors."""
        try:
            answer = self._pool.request(method, f'{self.url}/{path}', body=body, redirect=False, preload_content=False,
                                        enforce_content_length=True, headers={**self._headers, 'Content-Type': kind})  # fmt: skip
            try:
                content = answer.read(MAX_ANSWER_BYTES + 1, decode_content=False)
                if len(content) > MAX_ANSWER_BYTES:
                    raise LakeError(f'{self.url} responded with more than {MAX_ANSWER_BYTES:,} bytes', remedy=WHICH)
                answer.read()  # raises if the body is incomplete
            finally:
                answer.close()
        except urllib3.exceptions.HTTPError as error:
            raise SinkUnavailable(f'{self.url} does not answer: {_cause(error)}') from error
        if answer.status in _RETRIED:
            raise SinkUnavailable(f'{self.url} is overloaded or unavailable ({answer.status})')
        try:
            document = from_json(content, MAX_ANSWER_BYTES) if content else {}
        except ValueError as error:
            raise LakeError(f'{self.url} did not respond with JSON ({answer.status})', remedy=WHICH) from error
        if answer.status not in _GOOD and answer.status not in allowed:
            remedies = {
                401: 'set ELASTIC_API_KEY, or ELASTIC_USERNAME and ELASTIC_PASSWORD',
                403: 'give this user the permissions in docs/elastic.md',
            }
            raise LakeError(f'{self.url} refused {method} /{path} ({answer.status}): {_reason(document)}',
                            remedy=remedies.get(answer.status, 'see docs/elastic.md'), status=answer.status)  # fmt: skip
        return answer.status, document

    def prepare(self, name: str) -> dict[str, str]:
        """Upload the template and create missing indexes; returns the UUID of each index."""
        _, info = self.ask('GET', '')
        version = info.get('version') if isinstance(info, dict) else None
        if not isinstance(version, dict) or 'number' not in version:
            raise LakeError(f'{self.url} is neither an Elasticsearch nor an OpenSearch server', remedy=WHICH)
        made = template(name, is_opensearch=version.get('distribution') == 'opensearch')
        self.ask('PUT', f'_index_template/{name}', _dump(made))
        for index in INDEXES:
            self.ask('PUT', f'{name}-{index}', b'{}', allowed=(400,))  # 400: it exists; the next request fails if it does not
        names = ','.join(f'{name}-{index}' for index in INDEXES)
        _, settings = self.ask('GET', f'{names}/_settings')
        try:
            return {index: str(settings[f'{name}-{index}']['settings']['index']['uuid']) for index in INDEXES}
        except (KeyError, TypeError) as error:
            raise LakeError(
                f'{self.url} does not return the UUIDs of {name}-*', remedy='permit this user to read their settings'
            ) from error

    def bulk(self, documents: Sequence[bytes]) -> list[tuple[int, str]]:
        """Send documents encoded by ``encoded``; returns status and error of each."""
        _, result = self.ask('POST', '_bulk', b''.join(documents), 'application/x-ndjson')
        try:
            items = [next(iter(item.values())) for item in result['items']]
            found = [(int(item['status']), _reason(item)) for item in items]
        except (KeyError, TypeError, AttributeError, ValueError, StopIteration) as error:
            raise LakeError(f'{self.url} does not respond to _bulk as documented', remedy=WHICH) from error
        if len(found) != len(documents):
            raise LakeError(
                f'{self.url} confirmed {len(found)} of {len(documents)} documents', remedy='check for a proxy in front of it'
            )
        return found


def authorization(environ: Mapping[str, str]) -> str:
    """The header for ``ELASTIC_API_KEY``, otherwise for ``ELASTIC_USERNAME`` and ``ELASTIC_PASSWORD``. Raises SettingError."""
    key, user = environ.get('ELASTIC_API_KEY', ''), environ.get('ELASTIC_USERNAME', '')
    found = f'ApiKey {key}' if key else ''
    if user and not key:
        found = 'Basic ' + base64.b64encode(f'{user}:{environ.get("ELASTIC_PASSWORD", "")}'.encode()).decode()
    if not found.isascii() or not found.isprintable():
        raise SettingError('ELASTIC_API_KEY', '...', 'printable ASCII characters without line breaks')
    return found


def template(name: str, *, is_opensearch: bool) -> dict[str, Any]:
    """The index template with the types of the fields; other fields are stored but cannot be searched."""
    position = {'position': {'type': 'xy_point' if is_opensearch else 'point'}}
    return {
        'index_patterns': [f'{name}-{index}' for index in INDEXES],
        'priority': 200,
        'template': {'mappings': {'dynamic': False, 'properties': {**_FIELDS, **position}}},
        '_meta': {'by': 'shadowhound-data lake sink', 'version': 1},
    }


def _cause(error: BaseException) -> str:
    reason = getattr(error, 'reason', None)
    return visible(str(reason if isinstance(reason, BaseException) else error))[:MAX_REASON]


def _reason(answer: object) -> str:
    """The error in a response, on one line; '' without an error."""
    error = answer.get('error') if isinstance(answer, dict) else None
    if isinstance(error, dict):
        error = ': '.join(str(error[word]) for word in ('type', 'reason') if word in error)
    return visible(str(error))[:MAX_REASON] if error else ''


# -- documents -----------------------------------------------------------------------------------------------------------------


def of_object(row: Mapping[str, Any]) -> SinkDocument:
    """The document of an object. Its ``_id`` is the SHA-256 of bucket, key and ``t_start_ns``, separated by line breaks."""
    found = {name: value for name, value in row.items() if name not in {'format_version', 't_start', 't_end'}}
    if row['t_start'] is not None:
        found |= {'time': _iso(row['t_start_ns']), 't_start': _iso(row['t_start_ns']), 't_end': _iso(row['t_end_ns'])}
    if row['x'] is not None and row['y'] is not None:
        found['position'] = {'x': row['x'], 'y': row['y']}
    if row['latitude'] is not None and row['longitude'] is not None:
        found['location'] = {'lat': row['latitude'], 'lon': row['longitude']}
    return SinkDocument(ROWS, _digest(row['bucket'], row['key'], row['t_start_ns']), found)


def of_forgotten(row: Mapping[str, Any]) -> SinkDocument:
    """The update for an object that ``lake prune`` deleted: adds the time and the rule to its document, which is kept."""
    document = of_object({**row, 'x': None, 'y': None, 'latitude': None, 'longitude': None})
    unknown = {'x', 'y', 'latitude', 'longitude', 'forgotten_ns'}
    fields = {name: value for name, value in document.fields.items() if name not in unknown}
    return document._replace(fields={**fields, 'forgotten': _iso(row['forgotten_ns'])}, is_update=True)


def of_statement(row: Mapping[str, Any]) -> SinkDocument:
    """The document of a statement of the gap journal; the newest statement about each gap is kept."""
    found = {name: value for name, value in row.items() if name not in {'format_version', 't_from', 't_to'}}
    for stamp, name in (('from_ns', 't_from'), ('to_ns', 't_to')):
        found[name] = None if row[name] is None else _iso(row[stamp])
    found['time'] = found['t_from'] or found['t_to']
    return SinkDocument(
        GAP_ROWS, _digest(row['robot'], row['id']), found, _version(row['revision'], is_later=row['what'] != WITHDRAWN)
    )


def of_label(row: Mapping[str, Any]) -> SinkDocument:
    """The document of a row about a label; the newest row is kept. Its field ``what`` is whether it adds or removes the label."""
    found = {name: value for name, value in row.items() if name not in {'format_version', 'made'}}
    found |= {
        'time': _iso(row['since_ns']),
        'since': _iso(row['since_ns']),
        'until': _iso(row['until_ns']),
        'made': _iso(row['made_ns']),
    }
    return SinkDocument(
        LABEL_ROWS, _digest(row['robot'], row['id']), found, _version(row['made_ns'], is_later=row['what'] == REMOVED)
    )


def _version(number: int, *, is_later: bool) -> int:
    """The version of a document: the highest number is kept; of two equal ones, the one that is later. At most 63 bits.

    A server rejects the whole request if one version is larger, and a hostile robot can write any number.
    """
    return 2 * min(max(number, 0), (1 << 62) - 1) + is_later


def of_mission(robot: str, run_id: str, content: Mapping[str, Any]) -> Iterator[SinkDocument]:
    """The documents of a mission, its events and its errors, from its ``summary.json``."""
    for number, each in enumerate(search.of_mission(robot, run_id, content)):
        found: dict[str, Any] = {
            'robot': robot, 'run_id': run_id, 'mission_id': each.mission_id, 'mission_type': each.mission_type,
            'success': each.success, 'time': None if each.since_ns is None else _iso(each.since_ns), 'text': each.text,
        }  # fmt: skip
        if each.kind == search.MISSION:
            scalars = {name: content[name] for name in _SUMMARY if isinstance(content.get(name), (str, int, float))}
            found |= scalars | {
                'command': each.title, 'bucket': each.bucket, 'key': each.key, 'started': found['time'],
                'ended': None if each.until_ns is None else _iso(each.until_ns),
            }  # fmt: skip
            yield SinkDocument(MISSIONS, _digest(robot, run_id), found)
        else:
            yield SinkDocument(EVENTS, _digest(robot, run_id, number), {**found, 'kind': each.kind, 'title': each.title})


def encoded(name: str, document: SinkDocument) -> bytes:
    """Encode a document as two lines of a bulk request; numbers that JSON cannot represent become null."""
    action: dict[str, Any] = {'_index': f'{name}-{document.kind}', '_id': document.id}
    if document.is_update:
        return _dump({'update': action}) + b'\n' + _dump({'doc': document.fields, 'doc_as_upsert': True}) + b'\n'
    if document.version is None:
        return _dump({'create': action}) + b'\n' + _dump(document.fields) + b'\n'
    action |= {'version': document.version, 'version_type': 'external'}
    return _dump({'index': action}) + b'\n' + _dump(document.fields) + b'\n'


def _dump(value: Any) -> bytes:
    try:
        return json.dumps(value, allow_nan=False, separators=(',', ':')).encode('ascii')
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, separators=(',', ':')).encode('ascii')


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _digest(*parts: object) -> str:
    return hashlib.sha256('\n'.join(map(str, parts)).encode(errors='replace')).hexdigest()


def _iso(stamp_ns: int | None) -> str | None:
    """A time with nanoseconds: both servers support times until the year 2262, like int64."""
    if stamp_ns is None:
        return None
    seconds, rest = divmod(stamp_ns, SECOND)
    return f'{time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))}.{rest:09}Z'


# -- where it is ---------------------------------------------------------------------------------------------------------------

_SCHEMA: Final = """
CREATE TABLE indexes (name TEXT PRIMARY KEY, uuid TEXT NOT NULL);
CREATE TABLE versions (name TEXT, robot TEXT, id TEXT NOT NULL, number INTEGER NOT NULL, PRIMARY KEY (name, robot)) WITHOUT ROWID;
CREATE TABLE missions (robot TEXT, run TEXT, PRIMARY KEY (robot, run)) WITHOUT ROWID;
CREATE TABLE refused (name TEXT, id TEXT, status INTEGER, reason TEXT, PRIMARY KEY (name, id)) WITHOUT ROWID;
PRAGMA user_version = 1;
"""


class Position:
    """Records in a SQLite file what one server has: the version of each table, the missions, and the rejected documents."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._db = sqlite3.connect(path, timeout=30.0)
            path.chmod(0o600)
            if not self._db.execute("SELECT count(*) FROM sqlite_master WHERE type = 'table'").fetchone()[0]:
                self._db.executescript(_SCHEMA)
            elif self._db.execute('PRAGMA user_version').fetchone() != (1,):
                raise sqlite3.DatabaseError('it is of another version')
        except sqlite3.Error as error:
            raise LakeError(
                f'{path} is not the position of a sink: {error}', remedy='remove it: everything is sent again, without duplicates'
            ) from error

    def close(self) -> None:
        self._db.close()

    def is_same(self, name: str, uuid: str) -> bool:
        """Record an index; returns False if it was recreated since the last run."""
        known = self._db.execute('SELECT uuid FROM indexes WHERE name = ?', (name,)).fetchone()
        with self._db:
            self._db.execute('INSERT OR REPLACE INTO indexes VALUES (?,?)', (name, uuid))
        return known in {None, (uuid,)}

    def forget(self, name: str) -> None:
        """Record that an index is empty."""
        with self._db:
            self._db.execute('DELETE FROM versions WHERE name = ?', (name,))
            self._db.execute('DELETE FROM refused WHERE name = ?', (name,))
            if name == MISSIONS:
                self._db.execute('DELETE FROM missions')

    def version(self, name: str, robot: str | None) -> TableVersion | None:
        """The version of its table up to which an index has the rows of one robot, or of all."""
        found = self._db.execute('SELECT id, number FROM versions WHERE name = ? AND robot = ?', (name, robot or '')).fetchone()
        return None if found is None else TableVersion(*found)

    def missions(self, robot: str) -> set[str]:
        return {run for (run,) in self._db.execute('SELECT run FROM missions WHERE robot = ?', (robot,))}

    def take(self, name: str, robot: str | None, version: TableVersion, refused: Iterable[tuple[str, int, str]]) -> None:
        """Record what the server has, and (id, status, reason) of what it rejected; durable on return."""
        with self._db:
            self._db.execute('INSERT OR REPLACE INTO versions VALUES (?,?,?,?)', (name, robot or '', *version))
            self._db.executemany('INSERT OR REPLACE INTO refused VALUES (?,?,?,?)', ((name, *each) for each in refused))

    def take_missions(self, robot: str, runs: Iterable[str], refused: Iterable[tuple[str, int, str]]) -> None:
        with self._db:
            self._db.executemany('INSERT OR IGNORE INTO missions VALUES (?,?)', ((robot, run) for run in runs))
            self._db.executemany('INSERT OR REPLACE INTO refused VALUES (?,?,?,?)', ((MISSIONS, *each) for each in refused))

    def refused(self) -> list[tuple[str, str, int, str]]:
        """Index, id, status and reason of each document that the server rejected."""
        return list(self._db.execute('SELECT name, id, status, reason FROM refused ORDER BY name, id'))


def position_path(home: Path, url: str, name: str) -> Path:
    """The file for one prefix of indexes on one server, in the sender's home."""
    return home / 'sink' / f'{hashlib.sha256(f"{url} {name}".encode()).hexdigest()[:16]}.db'


@contextmanager
def opened(server: SearchServer, name: str, home: Path) -> Iterator[Position]:
    """Open the position, in one process at a time. Raises SettingError, LakeError."""
    if not _NAME.fullmatch(name):
        raise SettingError('--prefix', name[:100], 'small letters, digits, "-", "_" and ".", beginning with a letter or digit')
    path = position_path(home, server.url, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    with flock(path.with_suffix('.lock'), wait=False) as had:
        if not had:
            raise LakeError(f'another process is sending to {name} at {server.url}', remedy='wait for it, or stop it')
        with closing(Position(path)) as position:
            yield position


# -- sending -------------------------------------------------------------------------------------------------------------------


_TABLES: Final[Sequence[tuple[str, TableSchema, Callable[[Mapping[str, Any]], SinkDocument]]]] = (
    (ROWS, OBJECTS, of_object),
    (FORGOTTEN_ROWS, FORGOTTEN, of_forgotten),
    (GAP_ROWS, GAPS, of_statement),
    (LABEL_ROWS, LABELS, of_label),
)


@dataclass(slots=True)
class Sink:
    """Sends the documents that a server does not have yet, some megabytes per request, until each is accepted or rejected.

    A request is tried ``tries`` times if the server does not answer or is overloaded.
    """

    source: Bucket
    server: SearchServer
    name: str
    position: Position
    findings: Findings
    tries: float = TRIES
    tell: Callable[[str], object] = lambda _: None
    pause: Callable[[float], object] = time.sleep
    _sent: SinkTally = field(default_factory=SinkTally)
    _refused: list[tuple[str, int, str]] = field(default_factory=list)

    def send(self, robot: str | None = None) -> SinkTally:
        """Send the rows of one robot or of all. Raises StoreError, SinkUnavailable, LakeError, after recording what was sent."""
        self._sent = SinkTally()
        for kind, uuid in self._patiently(lambda: self.server.prepare(self.name)).items():
            if not self.position.is_same(kind, uuid):
                self._sent.restarted.append(f'{self.name}-{kind}')
                self.position.forget(MISSIONS if kind == EVENTS else kind)
                if kind == ROWS:
                    self.position.forget(FORGOTTEN_ROWS)
        tables = current(self.source, Scope(robot=robot), self.findings)
        for kind, of, make in _TABLES:
            self._send_rows(tables, robot, kind, of, make)
        for each in [robot] if robot else robots(self.source):
            self._send_missions(each)
        return self._sent

    def _send_rows(self, tables: Tables, robot: str | None, kind: str, of: TableSchema,
                   make: Callable[[Mapping[str, Any]], SinkDocument]) -> None:  # fmt: skip
        for batch, version in tables.added(TABLES[of.folder], self.position.version(kind, robot)):
            if batch is None:
                self.position.take(kind, robot, version, self._refused)
                self._refused = []
            else:
                rows = batch if robot is None else batch.filter(pc.equal(batch['robot'], robot))
                self._send(map(make, _rows(rows.select(list(of.columns)))))

    def _send_missions(self, robot: str) -> None:
        known = self.position.missions(robot)
        new = [run for run in self.source.folders(f'{robot}/missions/') if run not in known]
        for start in range(0, len(new), MISSIONS_AT_A_TIME):
            some = new[start : start + MISSIONS_AT_A_TIME]
            with ThreadPoolExecutor(THREADS, 'lake-sink') as pool:
                summaries = list(pool.map(lambda run: search.summary(self.source, robot, run, self.findings), some))
            ended = [(run, content) for run, content in zip(some, summaries, strict=True) if content is not None]
            self._send(document for run, content in ended for document in of_mission(robot, run, content))
            self.position.take_missions(robot, (run for run, _ in ended), self._refused)
            self._refused = []

    def _send(self, documents: Iterable[SinkDocument]) -> None:
        batch: list[tuple[str, bytes]] = []
        size = 0
        for document in documents:
            body = encoded(self.name, document)
            if batch and (size + len(body) > BULK_BYTES or len(batch) >= BULK_DOCUMENTS):
                self._send_batch(batch)
                batch, size = [], 0
            batch.append((document.id, body))
            size += len(body)
        self._send_batch(batch)

    def _send_batch(self, batch: Sequence[tuple[str, bytes]]) -> None:
        """Raises SinkUnavailable if the server accepted nothing in ``tries`` requests."""
        failures = 0
        while batch:
            some = batch
            found = self._patiently(lambda: self._bulk(some))  # noqa: B023 - called at once
            if found is None:
                self._send_batch(batch[: len(batch) // 2])
                batch = batch[len(batch) // 2 :]
                continue
            left = self._settled(batch, found)
            failures = 0 if len(left) < len(batch) else failures + 1
            if failures >= self.tries:
                raise SinkUnavailable(f'{self.server.url} accepts no documents: {found[0][1]}')
            if left:
                self.pause(backoff(failures + 1, CAP_S, _rng))
            batch = left
            self.tell(f'{self.name}: {self._sent.added:,} sent, {self._sent.present:,} already present')

    def _bulk(self, batch: Sequence[tuple[str, bytes]]) -> list[tuple[int, str]] | None:
        """Send a batch; returns the result of each document, or None if the request is too large."""
        try:
            return self.server.bulk([body for _, body in batch])
        except LakeError as error:
            if error.data.get('status') != TOO_LARGE:
                raise
            return None if len(batch) > 1 else [(TOO_LARGE, 'the server does not accept a document of this size')]

    def _settled(self, batch: Sequence[tuple[str, bytes]], found: Sequence[tuple[int, str]]) -> list[tuple[str, bytes]]:
        """Count the results; returns the documents that must be sent again."""
        left = []
        for each, (status, reason) in zip(batch, found, strict=True):
            if status in _RETRIED:
                left.append(each)
            elif status == CONFLICT:
                self._sent.present += 1
            elif status in _GOOD:
                self._sent.added += 1
            else:
                self._sent.refused[reason or str(status)] += 1
                self._refused.append((each[0], status, reason))
        return left

    def _patiently(self, ask: Callable[[], _Answer]) -> _Answer:
        """Try a request up to ``tries`` times. Raises the error of the last attempt."""
        return with_retries(ask, tries=self.tries, cap_s=CAP_S, pause=self.pause, unavailable=SinkUnavailable,
                        on_failure=lambda error: self.tell(f'{error.what}; trying again'))  # fmt: skip


def _rows(table: pa.RecordBatch) -> Iterator[dict[str, Any]]:
    """The rows, with times in microseconds."""
    columns = [column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column for column in table.columns]
    for values in zip(*(column.to_pylist() for column in columns), strict=True):
        yield dict(zip(table.column_names, values, strict=True))
