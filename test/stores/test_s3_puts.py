"""An S3 store never overwrites, whatever its server makes of If-None-Match; how bodies are sent under a cap."""

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
    """Where If-None-Match does not work, be it admitted or not, each put looks first, and one warning says so."""
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
    """A server that ignores If-None-Match is found out without a loss."""
    with served(FakeS3(condition='ignored')) as server:
        server.objects[f'/{bucket}/a'] = (b'theirs', {})
        error_of(ForeignObject, lambda: opened(server.url).put(spool('a', b'ours..')))
        assert server.objects[f'/{bucket}/a'][0] == b'theirs'


def test_a_verified_server_costs_one_request_per_put(opened: Callable[..., S3Store], spool: Spool) -> None:
    """The proof costs two requests once."""
    with served(FakeS3()) as server:
        store = opened(server.url)
        for key in ('a', 'b', 'c'):
            store.put(spool(key, key.encode()))
        assert server.requests == ['HEAD', 'PUT', 'PUT', 'PUT', 'PUT']


@pytest.mark.parametrize('condition', ['honoured', 'ignored'])
def test_the_loser_of_a_race_is_told(condition: str, opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
    """A server lets two creates of one instant through, with different content: the one whose content is there has created it.

    The other finds a foreign object, as it does where it comes later. Each had met objects of the other before.
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
    """They can write to a server that honours the condition, and to no other."""
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
    """What somebody copied there by hand is recognized, and what is foreign stays."""
    with served(FakeS3()) as server:
        server.objects[f'/{bucket}/a'] = (content, {})
        store = opened(server.url)
        if kind is None:
            assert store.put(spool('a', b'the same')) is Put.IDENTICAL
        else:
            error_of(kind, lambda: store.put(spool('a', b'the same')))


class Wire(ThreadingHTTPServer):
    """An S3 look-alike that notes when how much of a body arrives."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), _Handler)
        self.arrivals: list[tuple[float, int]] = []
        self.broken = 0
        self.answers: list[int] = []
        """Statuses of the next PUTs; then 200, or 412 for a key that is there."""
        self.is_full = False
        """Whether it holds other content under every key."""
        self.keys: set[str] = set()

    def handle_error(self, *_: object) -> None:
        """A client that went away is not an error of ours."""


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
    """A store that knows its server, with nothing on record yet."""
    store = opened(wire)
    store.put(spool('first', b'first'))
    wire.arrivals.clear()
    yield store
    store.close()


def test_a_body_arrives_evenly_and_outlasts_every_timeout(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """Timeouts are over single pieces; nothing arrives sooner than the cap allows, neither at the beginning nor after a pause."""
    proved.close()
    timeout_s, cap, size = 1.0, 1.0, 300_000
    rate = cap * BYTES_PER_MEGABIT
    store = opened(wire, cap, timeout_s)
    began = time.monotonic()
    store.put(spool('large', bytes(size)))
    store.close()
    arrived = 0
    for moment, count in wire.arrivals[: len(wire.arrivals) // 2]:  # the rest is the proof: the same again
        arrived += count
        assert arrived <= rate * (moment - began + LATE_S + PIECE_S)  # the first piece leaves at once
    assert wire.arrivals[-1][0] - began > 2 * timeout_s
    assert store.pace.sent_bytes == 2 * size


def test_sent_bytes_are_counted_as_they_are_sent(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """Bodies of every try, no reading for a checksum or a signature, nothing of a server that was never reached."""
    counted = proved.pace.sent_bytes
    assert counted == 2 * len(b'first')  # the put, and the proof that it cannot be repeated
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
    """The server says so before anything of it left, and nothing of it counts: it takes none of the time under a cap."""
    wire.is_full = True
    proved.pace.set(max_mbps)
    counted, began = proved.pace.sent_bytes, time.monotonic()
    with pytest.raises(ForeignObject):
        proved.put(spool('there', bytes(4 * LOOK_FIRST_BYTES)))
    assert wire.arrivals == []
    assert proved.pace.sent_bytes == counted
    assert time.monotonic() - began < 60.0  # at this cap it would be 84 s


def test_a_cancelled_put_ends_immediately(wire: Wire, spool: Spool, proved: S3Store) -> None:
    """At once, and the server sees it: no half body can be taken for a whole one."""
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
    """An operator who gives the radio free sees it at once."""
    proved.pace.set(0.01)
    thread = threading.Thread(target=proved.put, args=(spool('slow', bytes(500_000)),))
    thread.start()
    until(lambda: wire.arrivals)
    proved.pace.set(0.0)
    thread.join(60)
    assert not thread.is_alive()
    assert sum(count for _, count in wire.arrivals) == 500_000
