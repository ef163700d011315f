"""An S3 store never overwrites, however its server handles If-None-Match; how bodies are sent under a cap."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from shipping.fakes import until
from stores.asking import error_of
from stores.fake_s3 import FakeS3, error, etag, served
from stores.spooled import Spool

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, ForeignObject, StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.stores.bandwidth import BYTES_PER_MEGABIT, LATE_S, PIECE_S
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_puts import LOOK_FIRST_BYTES


@pytest.mark.parametrize(('condition', 'words'), [('not implemented', 'does not implement'), ('ignored', 'ignores')])
def test_a_server_without_conditional_puts_overwrites_nothing(
    condition: str, words: str, opened: Callable[..., S3Store], spool: Spool, bucket: str, caplog: pytest.LogCaptureFixture
) -> None:
    """If If-None-Match does not work, reported or not, each put checks first, with one warning."""
    with served(FakeS3(condition=condition)) as server, caplog.at_level(logging.WARNING):
        store = opened(server.url)
        assert store.put(spool('a', b'first')) is Put.CREATED
        assert store.put(spool('a', b'first')) is Put.IDENTICAL
        assert store.put(spool('b', b'first')) is Put.CREATED
        for key in ('a', 'b'):
            error_of(ForeignObject, lambda key=key: store.put(spool(key, b'other')))  # type: ignore[misc]
        assert store.get(bucket, 'a') == b'first'
    assert len(caplog.messages) == 1
    assert f'{words} If-None-Match' in caplog.text


def test_the_very_first_put_never_overwrites(opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
    """A server that ignores If-None-Match is detected without a loss."""
    with served(FakeS3(condition='ignored')) as server:
        server.objects[f'/{bucket}/a'] = (b'theirs', {})
        error_of(ForeignObject, lambda: opened(server.url).put(spool('a', b'ours..')))
        assert server.objects[f'/{bucket}/a'][0] == b'theirs'


def test_a_verified_server_costs_one_request_per_put(opened: Callable[..., S3Store], spool: Spool) -> None:
    """Verification takes two requests, once."""
    with served(FakeS3()) as server:
        store = opened(server.url)
        for key in ('a', 'b', 'c'):
            store.put(spool(key, key.encode()))
        assert server.requests == ['HEAD', 'PUT', 'PUT', 'PUT', 'PUT']


@pytest.mark.parametrize('condition', ['honoured', 'ignored'])
def test_the_loser_of_a_race_is_told(condition: str, opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
    """A server accepts two simultaneous creates with different content: the one whose content is stored has created it.

    The other gets ForeignObject, as it would if it came later. Each has met objects of the other before.
    """
    with served(FakeS3(condition=condition)) as server, ThreadPoolExecutor(2) as pool:
        ours, theirs = opened(server.url), opened(server.url)
        for number, (first, second) in enumerate(((ours, theirs), (theirs, ours))):
            first.put(spool(f'{number}', b'first'))
            error_of(ForeignObject, lambda: second.put(spool(f'{number}', b'other')))  # noqa: B023 - called at once
        server.races[f'/{bucket}/raced'] = threading.Barrier(2)
        contents = {b'ours': ours, b'theirs': theirs}
        items = {content: spool('raced', content) for content in contents}
        puts = {content: pool.submit(store.put, items[content]) for content, store in contents.items()}
        wait(puts.values(), 60.0)
        kept = server.objects[f'/{bucket}/raced'][0]
        (lost,) = set(contents) - {kept}
        assert puts[kept].result() is Put.CREATED
        assert isinstance(puts[lost].exception(), ForeignObject)
        assert items[lost].path.read_bytes() == lost


def test_credentials_that_can_only_write_suffice(opened: Callable[..., S3Store], spool: Spool) -> None:
    """With a server that supports the condition, and no other."""
    with served(FakeS3()) as server:
        server.forbid_head = True
        store = opened(server.url)
        assert store.put(spool('a', b'x')) is Put.CREATED
        error_of(AccessDenied, lambda: store.put(spool('a', b'y')))
    with served(FakeS3(condition='not implemented')) as server:
        server.forbid_head = True
        store = opened(server.url)
        for key in ('a', 'b'):
            error_of(AccessDenied, lambda key=key: store.put(spool(key, b'x')))  # type: ignore[misc]
        assert not server.objects


@pytest.mark.parametrize(('content', 'kind'), [(b'the same', None), (b'not same', ForeignObject)])
def test_an_object_without_our_metadata_is_compared_by_content(
    content: bytes, kind: type[StoreError] | None, opened: Callable[..., S3Store], spool: Spool, bucket: str
) -> None:
    """A copy made by hand is recognized, and foreign content stays."""
    with served(FakeS3()) as server:
        server.objects[f'/{bucket}/a'] = (content, {})
        store = opened(server.url)
        if kind is None:
            assert store.put(spool('a', b'the same')) is Put.IDENTICAL
        else:
            error_of(kind, lambda: store.put(spool('a', b'the same')))


class Wire(ThreadingHTTPServer):
    """An imitation of S3 that records when the bytes of a body arrive."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), _Handler)
        self.arrivals: list[tuple[float, int]] = []
        self.broken = 0
        self.answers: list[int] = []
        """Statuses of the next PUTs; then 200, or 412 for an existing key."""
        self.is_full = False
        """Whether it has other content under every key."""
        self.keys: set[str] = set()

    def handle_error(self, *_: object) -> None:
        """Ignore clients that disconnected."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = 'HTTP/1.1'
    server: Wire

    def do_PUT(self) -> None:
        left = int(self.headers['Content-Length'])
        while left:
            data = self.rfile.read1(min(left, 1 << 16))
            if not data:
                self.server.broken += 1
                self.close_connection = True
                return
            self.server.arrivals.append((time.monotonic(), len(data)))
            left -= len(data)
        status = self.server.answers.pop(0) if self.server.answers else 412 if self.path in self.server.keys else 200
        if status == 200:
            self.server.keys.add(self.path)
            self._answer(200, b'', etag(b''))
        else:
            self._answer(status, error('PreconditionFailed' if status == 412 else 'SlowDown'))

    def do_HEAD(self) -> None:
        if self.server.is_full:
            self._answer(200, b'', {**etag(b''), 'x-amz-meta-sha256': 'another'})
        else:
            self._answer(404, b'')

    def _answer(self, status: int, body: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {'Content-Length': str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != 'HEAD':
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def wire() -> Iterator[Wire]:
    server = Wire()
    thread = threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def opened(wire: Wire, max_mbps: float = 0.0, timeout_s: float = 5.0) -> S3Store:
    url = f'http://127.0.0.1:{wire.server_port}'
    upload = UploadSettings(connect_timeout_s=timeout_s, read_timeout_s=timeout_s, max_mbps=max_mbps)
    store = S3Store(StoreSettings(endpoint_url=url, access_key_id='a', secret_access_key='b'), upload)
    store.open()
    return store


@pytest.fixture
def proved(wire: Wire, spool: Spool) -> Iterator[S3Store]:
    """A store that has verified its server, with an empty record."""
    store = opened(wire)
    store.put(spool('first', b'first'))
    wire.arrivals.clear()
    yield store
    store.close()


def test_a_body_arrives_evenly_and_outlasts_every_timeout(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """Timeouts apply to single pieces; nothing arrives sooner than the cap allows, neither at the start nor after a pause."""
    proved.close()
    timeout_s, cap, size = 1.0, 1.0, 300_000
    rate = cap * BYTES_PER_MEGABIT
    store = opened(wire, cap, timeout_s)
    began = time.monotonic()
    store.put(spool('large', bytes(size)))
    store.close()
    arrived = 0
    for moment, count in wire.arrivals[: len(wire.arrivals) // 2]:  # the rest is the verification: the same again
        arrived += count
        assert arrived <= rate * (moment - began + LATE_S + PIECE_S)  # the first piece is sent immediately
    assert wire.arrivals[-1][0] - began > 2 * timeout_s
    assert store.pace.sent_bytes == 2 * size


def test_sent_bytes_are_counted_as_they_are_sent(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """Bodies of every try, but not reads for a checksum or a signature, nor data for an unreachable server."""
    counted = proved.pace.sent_bytes
    assert counted == 2 * len(b'first')  # the put, and the check that it cannot be repeated
    wire.answers = [503]
    item = spool('again', bytes(100_000))
    with pytest.raises(StoreUnavailable):
        proved.put(item)
    assert proved.put(item) is Put.CREATED
    assert proved.pace.sent_bytes - counted == sum(count for _, count in wire.arrivals) == 200_000
    away = S3Store(StoreSettings(endpoint_url='http://127.0.0.1:9', access_key_id='a', secret_access_key='b'), UploadSettings())
    away.open()
    with pytest.raises(StoreUnavailable):
        away.put(item)
    assert away.pace.sent_bytes == 0
    away.close()


@pytest.mark.parametrize('size', [0, 1, LOOK_FIRST_BYTES, LOOK_FIRST_BYTES + 1])
def test_a_body_of_any_size_arrives(wire: Wire, spool: Spool, proved: S3Store, size: int) -> None:
    """Complete, and counted once."""
    assert proved.put(spool(f'{size}', bytes(size))) is Put.CREATED
    assert sum(count for _, count in wire.arrivals) == size


@pytest.mark.parametrize('max_mbps', [0.0, 0.1])
def test_a_refused_large_body_is_not_sent(wire: Wire, spool: Spool, proved: S3Store, max_mbps: float) -> None:
    """The server refuses before any byte is sent, and nothing counts: it uses no time under a cap."""
    wire.is_full = True
    proved.pace.set(max_mbps)
    counted, began = proved.pace.sent_bytes, time.monotonic()
    with pytest.raises(ForeignObject):
        proved.put(spool('there', bytes(4 * LOOK_FIRST_BYTES)))
    assert wire.arrivals == []
    assert proved.pace.sent_bytes == counted
    assert time.monotonic() - began < 60.0  # at this cap it would take 84 s


def test_a_cancelled_put_ends_immediately(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """The server notices: no partial body can be mistaken for a complete one."""
    proved.pace.set(0.01)
    failed: list[Exception] = []

    def put() -> None:
        try:
            proved.put(spool('slow', bytes(200_000)))
        except StoreUnavailable as problem:
            failed.append(problem)

    thread = threading.Thread(target=put)
    thread.start()
    until(lambda: wire.arrivals)
    proved.close()
    thread.join(60)
    assert failed
    until(lambda: wire.broken)
    assert sum(count for _, count in wire.arrivals) < 100_000
    assert not any(key.endswith('slow') for key in wire.keys)


def test_a_new_cap_applies_to_the_current_body(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """When an operator lifts the cap it takes effect immediately."""
    proved.pace.set(0.01)
    thread = threading.Thread(target=proved.put, args=(spool('slow', bytes(500_000)),))
    thread.start()
    until(lambda: wire.arrivals)
    proved.pace.set(0.0)
    thread.join(60)
    assert not thread.is_alive()
    assert sum(count for _, count in wire.arrivals) == 500_000
