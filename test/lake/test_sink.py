"""A search server has each row, gap, mission, event and label once, whatever fails in between. The server is a fake in memory."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from lake import gap_parts
from lake.making import NOON_NS, add, add_part, fill, folder_store, merge, minutes, row

from shadowhound_data_logger.cli.common import ExitCode
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError, SettingError, SinkUnavailable
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import WITHDRAWN
from shadowhound_data_logger.lake import labels, sink
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.stores import open_store

osmem_server = pytest.importorskip('osmem_server')

SUMMARY = {
    'mission_id': 'm1', 'mission_type': 'patrol', 'mission_command': 'open the door', 'success': False, 'start_ns': NOON_NS,
    'end_ns': NOON_NS + 60 * SECOND, 'distance_m': 12.5, 'errors': [{'error': 'slipped'}],
    'events': [{'time': '2026-10-28T12:00:05Z', 'name': 'door', 'force_n': 3}],
}  # fmt: skip
LABEL = labels.Label(robot='thor', label='stairs', since_ns=NOON_NS, until_ns=NOON_NS + SECOND)
COUNTS = {'objects': 96, 'gaps': 3, 'missions': 3, 'events': 2, 'labels': 1}
"""The contents of the lake below."""


@pytest.fixture(scope='module')
def cluster() -> Iterator[Any]:
    with osmem_server.OsmemServer.start() as server:
        yield server
    for pipe in (server.process.stdin, server.process.stdout, server.process.stderr):
        if pipe is not None:
            pipe.close()


@pytest.fixture
def url(cluster: Any) -> Iterator[str]:
    """A separate, empty server."""
    with cluster.clone() as clone:
        yield clone.url


@pytest.fixture(scope='module')
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with rows of an hour, a gap, one that was withdrawn, a watermark, three missions and a label."""
    folder = tmp_path_factory.mktemp('sink')
    made = folder_store(folder)
    fill(made, folder, days=(0,), hours=(11,))
    with closing(open_store(made, UploadSettings())) as store:
        add(store, folder, 'thor/missions/run3/summary.json', json.dumps(SUMMARY).encode())
        labels.write(store, 'thor', [LABEL], by='ann')
    gap_parts.tell(made, folder, gap_parts.lost('a', 1, 2), gap_parts.lost('b', 3, 4, what=WITHDRAWN), gap_parts.mark(60))
    return folder / 'store'


@pytest.fixture
def settings(filled: Path, tmp_path: Path) -> StoreSettings:
    """A copy of it."""
    shutil.copytree(filled, tmp_path / 'store')
    return folder_store(tmp_path)


def ask(url: str, path: str, method: str = 'GET') -> Any:
    with closing(HTTPConnection(url.removeprefix('http://'), timeout=60)) as server:
        server.request(method, f'/{path}')
        return json.loads(server.getresponse().read())


def counts(url: str) -> dict[str, int]:
    ask(url, 'robots-*/_refresh', 'POST')
    return {kind: ask(url, f'robots-{kind}/_count')['count'] for kind in sink.INDEXES}


def send(url: str, settings: StoreSettings, home: Path, *, tries: float = 3, findings: Findings | None = None,
         server: type[sink.SearchServer] = sink.SearchServer) -> sink.SinkTally:  # fmt: skip
    """A run of ``lake sink``, without its pauses."""
    found = Findings(lambda _: None) if findings is None else findings
    with closing(server(url)) as opened, sink.opened(opened, 'robots', home) as position:
        return sink.Sink(Bucket(settings, 'sensor-data'), opened, 'robots', position, found, tries, pause=lambda _: None).send()


def test_every_row_is_sent_once(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """And a second run, or one whose position is lost, adds nothing."""
    first = send(url, settings, tmp_path)
    assert (first.added, first.present, first.refused) == (sum(COUNTS.values()), 0, Counter())
    assert counts(url) == COUNTS
    again = send(url, settings, tmp_path)
    assert (again.added, again.present, again.restarted) == (0, 0, [])
    sink.position_path(tmp_path, url, 'robots').unlink()
    lost = send(url, settings, tmp_path)
    assert (lost.added, lost.present) == (0, sum(COUNTS.values()))
    assert counts(url) == COUNTS
    assert oct(sink.position_path(tmp_path, url, 'robots').stat().st_mode)[-3:] == '600'


def test_a_document_has_the_documented_fields(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """Times to the nanosecond, positions in meters, and a mission, its event and its error found by their words."""
    send(url, settings, tmp_path)
    ask(url, 'robots-*/_refresh', 'POST')
    (mission,) = ask(url, 'robots-missions/_search?q=command:door')['hits']['hits']
    assert mission['_source']['started'] == '2026-10-28T12:00:00.000000000Z'
    assert (mission['_source']['success'], mission['_source']['distance_m']) == (False, 12.5)
    kinds = [hit['_source']['kind'] for hit in ask(url, 'robots-events/_search')['hits']['hits']]
    assert sorted(kinds) == ['error', 'event']
    row = ask(url, 'robots-objects/_search?size=1')['hits']['hits'][0]['_source']
    assert row['position'] == {'x': row['x'], 'y': row['y']}
    assert sink.of_object({**row, 't_start': 1}).fields['time'] == row['time']
    known = sink.template('robots', is_opensearch=True)['template']['mappings']['properties']
    for kind in sink.INDEXES:
        for hit in ask(url, f'robots-{kind}/_search?size=100')['hits']['hits']:
            assert set(hit['_source']) <= set(known), kind


def test_the_newest_statement_stays(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """For a gap and a label, sent in any order."""
    send(url, settings, tmp_path)
    gap_parts.tell(settings, tmp_path, gap_parts.lost('a', 1, 2, revision=3, what=WITHDRAWN), name='c')
    gap_parts.tell(settings, tmp_path, gap_parts.lost('a', 1, 2, revision=2, count=9), name='b')
    with closing(open_store(settings, UploadSettings())) as store:
        labels.write(store, 'thor', [LABEL], by='ann', is_removal=True)
    newer = send(url, settings, tmp_path)
    assert newer.added >= 2
    ask(url, 'robots-*/_refresh', 'POST')
    report = Counter(hit['_source']['what'] for hit in ask(url, 'robots-gaps/_search')['hits']['hits'])
    assert report == {'withdrawn': 2, 'complete': 1}
    (label,) = ask(url, 'robots-labels/_search')['hits']['hits']
    assert (label['_source']['what'], label['_source']['label']) == ('removed', 'stairs')


def test_merged_files_of_tables_send_nothing_again(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """A merge changes no row."""
    send(url, settings, tmp_path)
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [row('camera', NOON_NS + 30 * 10**9)], 'more', tmp_path / 'tmp')
    assert send(url, settings, tmp_path).added == 1
    assert merge(settings) >= 2
    assert (send(url, settings, tmp_path).added, counts(url)['missions']) == (0, 3)


def test_an_index_that_was_deleted_is_filled_again(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """The position belongs to an index, by its UUID; the others are unchanged."""
    send(url, settings, tmp_path)
    whole = counts(url)
    for kind in ('objects', 'events'):
        ask(url, f'robots-{kind}', 'DELETE')
    again = send(url, settings, tmp_path)
    assert again.restarted == ['robots-objects', 'robots-events']
    assert counts(url) == whole
    assert again.added == whole['objects'] + whole['events']


def test_pruned_objects_are_marked(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """Its document keeps all fields, whenever the deletion is sent, and exists once."""
    with closing(open_store(settings, UploadSettings())) as store:
        row = fill_row()
        fields = {name: row[name] for name in catalog.FORGOTTEN.columns if name in row}
        fields |= {'rule': 'camera 90d', 'forgotten': NOON_NS // 1000, 'forgotten_ns': NOON_NS}
        key = catalog.FORGOTTEN.part_key('thor', catalog.date_of(row), 'x')
        add(store, tmp_path, key, parts.encode([fields], catalog.FORGOTTEN))
    send(url, settings, tmp_path)
    assert send(url, settings, tmp_path).added == 0
    assert counts(url) == COUNTS
    (hit,) = ask(url, 'robots-objects/_search?q=rule:camera*')['hits']['hits']
    report = hit['_source']
    assert (report['key'], report['forgotten']) == (row['key'], '2026-10-28T12:00:00.000000000Z')
    assert (report['sha256'], report['position']['x']) == (row['sha256'], row['x'])


def fill_row() -> catalog.Row:
    """A row of the lake, a frame."""
    _, rows = next(minutes(days=(0,), hours=(11,)))
    return rows[0]


class Death(BaseException):
    """The process was killed."""


def test_a_sink_may_be_killed_anywhere(
    url: str, settings: StoreSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before or after any request, repeatedly: in the end each document is there, once."""
    monkeypatch.setattr(sink, 'BULK_DOCUMENTS', 7)
    monkeypatch.setattr(sink, 'MISSIONS_AT_A_TIME', 2)
    requests = [0]

    class Dying(sink.SearchServer):
        def ask(self, *given: Any, **more: Any) -> Any:
            requests[0] += 1
            if requests[0] % 25 == 0:
                raise Death
            answer = super().ask(*given, **more)
            if requests[0] % 33 == 0:
                raise Death
            return answer

    sent = Counter[str]()
    for _ in range(200):
        try:
            send(url, settings, tmp_path, server=Dying)
            sent['whole'] += 1
            break
        except Death:
            sent['died'] += 1
    assert sent['whole'] == 1
    assert sent['died'] >= 2
    monkeypatch.undo()
    fresh = tmp_path / 'other'
    fresh.mkdir()
    assert send(url, settings, fresh).added == 0
    assert counts(url) == COUNTS


Answer = Callable[[int, bytes], 'tuple[int, bytes] | None']


@contextmanager
def between(url: str, answer: Answer) -> Iterator[tuple[str, list[Any]]]:
    """A proxy for a server: ``answer`` gets the number and body of each bulk request; None forwards it."""
    seen: list[Any] = []

    class Handler(BaseHTTPRequestHandler):
        def _serve(self) -> None:
            body = self.rfile.read(int(self.headers.get('Content-Length', 0)))
            own = None
            if self.path == '/_bulk':
                seen.append((dict(self.headers), body))
                own = answer(len(seen), body)
            if own is None:
                own = self._asked(body)
            status, content = own
            self.send_response(status)
            self.send_header('Content-Length', str(len(content) + (status == 299)))
            self.end_headers()
            self.wfile.write(content)
            self.close_connection = True

        def _asked(self, body: bytes) -> tuple[int, bytes]:
            with closing(HTTPConnection(url.removeprefix('http://'), timeout=60)) as inner:
                inner.request(self.command, self.path, body or None, {'Content-Type': self.headers['Content-Type']})
                answer = inner.getresponse()
                return answer.status, answer.read()

        do_GET = do_PUT = do_POST = _serve  # noqa: N815 - as the library calls them

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), name='between')
    thread.start()
    try:
        yield f'http://127.0.0.1:{server.server_port}', seen
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.mark.parametrize(
    'fault', [(429, b'{}'), (503, b'busy'), (299, b'{"items": [')], ids=['too many requests', 'unavailable', 'breaks off']
)
def test_transient_errors_are_retried(url: str, settings: StoreSettings, tmp_path: Path, fault: tuple[int, bytes]) -> None:
    """Half of all requests fail, and nothing is lost or there twice."""
    with between(url, lambda number, _: fault if number % 2 else None) as (proxy, _):
        assert send(proxy, settings, tmp_path).refused == Counter()
    assert send(url, settings, tmp_path).added == 0


def test_an_unreachable_server_ends_the_run(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """The error has a remedy, and documents accepted before it are recorded."""
    with between(url, lambda number, _: (429, b'{}') if number > 1 else None) as (proxy, _):
        with pytest.raises(SinkUnavailable, match='is overloaded or unavailable'):
            send(proxy, settings, tmp_path)
        assert SinkUnavailable.DEFAULT_REMEDY.startswith('run it again')


def test_rejected_documents_are_counted_and_the_others_sent(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """A deferred one is retried alone; a refused one is counted by reason and listed, and the others continue."""
    sizes: list[int] = []

    def answer(number: int, body: bytes) -> tuple[int, bytes] | None:
        sizes.append(body.count(b'\n') // 2)
        if number > 2:
            return None
        items: list[dict[str, Any]] = [{'create': {'status': 201}} for _ in range(sizes[-1])]
        items[0]['create'] = {'status': 429, 'error': {'type': 'es_rejected_execution_exception', 'reason': 'full'}}
        if number == 2:
            items[0]['create'] = {'status': 400, 'error': {'type': 'mapper_parsing_exception', 'reason': 'a\nbad\x1b[31m date'}}
        return 200, json.dumps({'errors': True, 'items': items}).encode()

    with between(url, answer) as (proxy, seen):
        found = send(proxy, settings, tmp_path)
        assert sizes[1] == 1
        assert list(found.refused.values()) == [1]
        (reason,) = found.refused
        assert reason.startswith('mapper_parsing_exception: a')
        assert '\x1b' not in reason
        with closing(sink.Position(sink.position_path(tmp_path, proxy, 'robots'))) as position:
            listed = position.refused()
    assert [(each[0], each[2]) for each in listed] == [('objects', 400)]
    for headers, body in seen:
        documented(headers, body)


def documented(headers: dict[str, str], body: bytes) -> None:
    """A bulk request as both servers document it: alternating actions and documents, one per line, all lines ended."""
    assert headers['Content-Type'] == 'application/x-ndjson'
    assert body.endswith(b'\n')
    lines = body.decode('ascii').splitlines()
    assert len(lines) % 2 == 0
    for action, document in zip(lines[::2], lines[1::2], strict=True):
        ((verb, target),) = json.loads(action).items()
        assert verb in {'create', 'index', 'update'}
        assert set(target) <= {'_index', '_id', 'version', 'version_type'}
        assert len(target['_id']) <= 512
        assert isinstance(json.loads(document, parse_constant=pytest.fail), dict)


@pytest.mark.long('many small requests')
def test_a_request_that_is_too_large_is_halved(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """Down to one document, which is then refused."""
    with between(url, lambda _, body: (413, b'{}') if body.count(b'\n') > 4 else None) as (proxy, _):
        assert send(proxy, settings, tmp_path).refused == Counter()
    assert send(url, settings, tmp_path).added == 0
    with between(url, lambda _, body: (413, b'{}') if b'thor/camera' in body else None) as (proxy, _):
        fresh = tmp_path / 'other'
        fresh.mkdir()
        assert list(send(proxy, settings, fresh).refused) == ['the server does not accept a document of this size']


@pytest.mark.parametrize('answer', [b'<html>', b'{"items": []}', b'{"items": [1]}'])
def test_an_invalid_answer_is_an_error(url: str, settings: StoreSettings, tmp_path: Path, answer: bytes) -> None:
    """Nothing counts as sent."""
    with between(url, lambda *_: (200, answer)) as (proxy, _), pytest.raises(LakeError):
        send(proxy, settings, tmp_path)
    assert send(url, settings, tmp_path).present == 0


def test_an_invalid_part_is_reported_each_time(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """And does not block others."""
    with closing(open_store(settings, UploadSettings())) as store:
        add(store, tmp_path, 'thor/_catalog/date=2026-10-28/thor_x.jsonl.zst', b'it is not')
    for _ in range(2):
        found = Findings(lambda _: None)
        send(url, settings, tmp_path, findings=found)
        assert [one.key for one in found] == ['thor/_catalog/date=2026-10-28/thor_x.jsonl.zst']


def test_the_user_agent_names_this_package(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """The secret is only in a header, never in a URL or a repr; a redirect to another server is not followed."""
    with pytest.raises(SettingError, match='URL') as refused:
        sink.SearchServer('http://me:secret@127.0.0.1:9200')
    assert 'secret' not in str(refused.value)
    report = sink.authorization({'ELASTIC_USERNAME': 'me', 'ELASTIC_PASSWORD': 'secret'})
    server = sink.SearchServer(url, report)
    assert 'secret' not in repr(server)
    assert report not in repr(server)
    server.close()
    assert sink.authorization({'ELASTIC_API_KEY': 'abc'}) == 'ApiKey abc'
    assert sink.authorization({}) == ''
    with pytest.raises(SettingError):
        sink.authorization({'ELASTIC_API_KEY': 'a\r\nHost: evil'})
    for wrong in ('ftp://h:9200', '127.0.0.1:9200', 'http://', 'http://h/?a=1'):
        with pytest.raises(SettingError):
            sink.SearchServer(wrong)
    with between(url, lambda *_: (302, b'{}')) as (proxy, seen), pytest.raises(LakeError, match='302'):
        send(proxy, settings, tmp_path)
    assert len(seen) == 1


def test_only_one_process_sends(url: str, tmp_path: Path) -> None:
    """The second one gets an error; an invalid prefix is refused."""
    with closing(sink.SearchServer(url)) as server, sink.opened(server, 'robots', tmp_path):
        with pytest.raises(LakeError, match='another process'), sink.opened(server, 'robots', tmp_path):
            pass
        with pytest.raises(SettingError), sink.opened(server, 'Robots/../x', tmp_path):
            pass


FOLDER = Path(__file__).parents[2] / 'docs' / 'elastic'


def fields(value: Any) -> Iterator[str]:
    """All names of document fields in the saved objects."""
    if isinstance(value, dict):
        for name, inner in value.items():
            if name in {'field', 'timeFieldName'}:
                yield inner
            elif name == 'columns':
                yield from inner
            elif name in {'visState', 'panelsJSON', 'searchSourceJSON'}:
                yield from fields(json.loads(inner))
            else:
                yield from fields(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from fields(inner)


@pytest.mark.parametrize('kind', sink.INDEXES)
def test_the_dashboards_use_existing_fields(kind: str) -> None:
    """As far as parsing shows: each reference is to an object of the file, each field exists in documents."""
    objects = [json.loads(line) for line in (FOLDER / f'{kind}.ndjson').read_text().splitlines()]
    there = {(each['type'], each['id']) for each in objects}
    assert {(one['type'], one['id']) for each in objects for one in each['references']} <= there
    assert ('dashboard', f'robots-{kind}') in there
    known = sink.template('robots', is_opensearch=False)['template']['mappings']['properties']
    assert {name for each in objects for name in fields(each)} <= set(known)


def test_the_command_reports_rejected_documents(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """In JSON as on the screen, with exit code 1; the second run has nothing to send."""
    home = {'SHADOWHOUND_HOME': str(tmp_path), 'AWS_ENDPOINT_URL': ''}

    def answer(number: int, body: bytes) -> tuple[int, bytes] | None:
        item = {'create': {'status': 400, 'error': {'type': 'mapper_parsing_exception', 'reason': 'no date'}}}
        return (200, json.dumps({'items': [item] * (body.count(b'\n') // 2)}).encode()) if number == 1 else None

    with between(url, answer) as (proxy, _):
        ran = CliRunner().invoke(cli, ['lake', 'sink', proxy, '--json'], env=home, standalone_mode=False)
        assert ran.return_value == ExitCode.FINDING
        assert json.loads(ran.stdout)['refused'] == {'mapper_parsing_exception: no date': COUNTS['objects']}
        shown = CliRunner().invoke(cli, ['lake', 'sink', proxy], env=home, standalone_mode=False)
        assert (shown.return_value, '0 documents sent' in shown.stdout) == (ExitCode.FINE, True)


@pytest.mark.long('processes that are killed')
def test_a_killed_run_resumes(url: str, settings: StoreSettings, tmp_path: Path) -> None:
    """The command, killed at its first, second, ... request; then it finishes, and everything is there once."""
    assert settings.directory is not None
    home = tmp_path / 'home'
    home.mkdir()
    settings.directory.rename(home / 'store')
    environ = {name: value for name, value in os.environ.items() if not name.startswith('AWS_')}
    environ |= {'SHADOWHOUND_HOME': str(home), 'PYTHONPATH': str(Path(__file__).parents[2])}
    running: list[subprocess.Popen[bytes]] = []

    def answer(number: int, _: bytes) -> None:
        if number in {1, 2, 4, 6}:
            running[-1].kill()

    with between(url, answer) as (proxy, seen):
        command = [sys.executable, '-c', RUN, 'lake', 'sink', proxy, '--json']
        for _ in range(10):
            running.append(subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL))
            report, _ = running[-1].communicate(timeout=120)
            if running[-1].returncode == 0:
                break
        assert len(running) >= 3
        assert json.loads(report)['refused'] == {}
        for headers, body in seen:
            documented(headers, body)
    moved = StoreSettings(directory=home / 'store')
    again = send(url, moved, tmp_path)
    assert (again.added, again.present) == (0, sum(counts(url).values()))


RUN = 'from shadowhound_data_logger.cli.main import main; main()'


@pytest.mark.parametrize('number', [0, 1, 1 << 40, (1 << 62) - 1, 1 << 62, (1 << 63) - 1, -1, -(1 << 63)])
def test_no_version_is_larger_than_a_server_reads(number: int) -> None:
    """Because of one row of a hostile robot the server would refuse all documents in the same request."""
    earlier, later = sink._version(number, is_later=False), sink._version(number, is_later=True)
    assert 0 <= earlier < later < 1 << 63
    assert number < 0 or number >= 1 << 62 or earlier == 2 * number
