"""Single requests to an S3 server through botocore's client, also to hostile servers."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from stores.asking import settings_for
from stores.fake_s3 import refused, resetting
from stores.memory import MemoryStore

from shadowhound_data_logger.core.errors import ObjectRefused, SettingError, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.stores import open_reader
from shadowhound_data_logger.stores.base import Content
from shadowhound_data_logger.stores.content import CHUNK_BYTES
from shadowhound_data_logger.stores.download import download
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_obstore import ObstoreStore


def test_botocore_does_not_import_pyopenssl() -> None:
    """It would if the extra of the live page has installed it, and works without it."""
    pytest.importorskip('OpenSSL')
    program = (
        'import sys\n'
        'from shadowhound_data_logger.core.options import StoreSettings, UploadSettings\n'
        'from shadowhound_data_logger.stores import open_store\n'
        "open_store(StoreSettings(endpoint_url='http://127.0.0.1:9'), UploadSettings()).close()\n"
        "print('botocore.httpsession' in sys.modules, 'cryptography' in sys.modules)\n"
        'import OpenSSL.SSL\n'
    )
    environ = {**os.environ, 'AWS_ACCESS_KEY_ID': 'key', 'AWS_SECRET_ACCESS_KEY': 'secret'}
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, env=environ, check=False)
    assert (done.stdout.split(), done.returncode) == (['True', 'False'], 0), done.stderr


MORE = 5 * CHUNK_BYTES
PAGE = 100
UPLOAD = UploadSettings()


def answer(status: str, told: str, size: int) -> bytes:
    """A response that declares ``told`` and has ``size`` bytes."""
    headers = f'HTTP/1.1 {status}\r\nETag: "x"\r\nContent-Range: {told}\r\nContent-Length: {size}\r\n'
    return f'{headers}Last-Modified: Sat, 21 Nov 2026 12:00:00 GMT\r\nConnection: close\r\n\r\n'.encode() + bytes(size)


def test_a_range_reads_at_most_the_requested_bytes(opened: Callable[..., S3Store]) -> None:
    """A server that sends megabytes for ten bytes is refused."""
    sent = answer('206 Partial Content', 'bytes 0-9/100', MORE)
    with resetting(sent, reset=False) as url, pytest.raises(ObjectRefused, match='more than 10 bytes') as caught:
        opened(url).ranges('camera', 'a', [(0, 10)])
    assert caught.value.data['reason'] == 'size'


def test_an_object_reads_at_most_its_size(opened: Callable[..., S3Store]) -> None:
    """It declares ten bytes, and sends megabytes."""
    sent = answer('200 OK', 'bytes 0-9/10', MORE)
    with resetting(sent, reset=False) as url, pytest.raises(ObjectRefused, match='more than 10 bytes'):
        opened(url).get('camera', 'a', 10)


def test_the_rest_of_an_object_comes_in_bounded_pieces() -> None:
    """Also if the server sends more than the declared rest."""
    with resetting(answer('206 Partial Content', 'bytes 4-9/10', MORE), reset=False) as url:
        content = open_reader(settings_for(url)).content('camera', 'a', 4)
        assert all(len(piece) <= 2 * CHUNK_BYTES for piece in content)


def test_a_download_stops_at_the_announced_size(tmp_path: Path) -> None:
    """A store that sends endlessly fills no disk."""

    class Endless(MemoryStore):
        sent = 0

        def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
            def pieces() -> Iterator[bytes]:
                while self.sent < 10:
                    self.sent += 1
                    yield b'0123'

            return Content(ObjectInfo(bucket, key, 10, None), pieces())

    store, report = Endless(), list[int]()
    with pytest.raises(ObjectRefused) as caught:
        download(store, ObjectInfo('b', 'k', 10, None), tmp_path / 'file', on_progress=report.append)
    assert caught.value.data['why'] == 'it has more than 10 bytes'
    assert (store.sent, sum(report), list(tmp_path.iterdir())) == (6, 0, [])


class Pages(ThreadingHTTPServer):
    """A bucket of three pages of objects; each page but the first fails ``fails`` times."""

    daemon_threads = True

    def __init__(self, fails: int) -> None:
        super().__init__(('127.0.0.1', 0), _Page)
        self.asked: list[int] = []
        self.fails = fails


class _Page(BaseHTTPRequestHandler):
    server: Pages

    def do_GET(self) -> None:
        query = parse_qs(urlsplit(self.path).query)
        after = (query.get('continuation-token') or query.get('start-after') or ['robot/-1'])[0]
        page = (int(after.rpartition('/')[2]) + 1) // PAGE
        self.server.asked.append(page)
        if page and self.server.asked.count(page) <= self.server.fails:
            self.send_error(503)
            return
        keys = [f'robot/{number:05}' for number in range(page * PAGE, (page + 1) * PAGE)]
        entries = ''.join(f'<Contents><Key>{key}</Key><LastModified>2026-11-21T12:00:00.000Z</LastModified><ETag>"x"</ETag>'
                          '<Size>1</Size></Contents>' for key in keys)  # fmt: skip
        more = f'<NextContinuationToken>{keys[-1]}</NextContinuationToken>' if page < 2 else ''
        body = (f'<?xml version="1.0"?><ListBucketResult><Name>b</Name><IsTruncated>{str(page < 2).lower()}</IsTruncated>{more}'
                f'{entries}</ListBucketResult>').encode()  # fmt: skip
        self.send_response(200)
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def pages(fails: int) -> Iterator[tuple[Pages, StoreSettings]]:
    server = Pages(fails)
    thread = threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    try:
        yield server, settings_for(f'http://127.0.0.1:{server.server_port}')
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_listing_resumes_at_the_failed_page() -> None:
    """Over a bad link a long listing would never finish if it restarted each time."""
    with pages(fails=1) as (server, settings):
        found = Bucket(settings, 'camera').list('robot/')
    assert [entry.key for entry in found] == [f'robot/{number:05}' for number in range(3 * PAGE)]
    assert server.asked == [0, 1, 1, 2, 2]


@pytest.mark.parametrize('url', ['nonsense', 'http://', 'http://127.0.0.1:1:2', 'ftp://tower', 'http://[::1', 'http://a b', ''])
def test_an_unusable_endpoint_is_an_invalid_setting(url: str) -> None:
    """Instead of a panic in the library."""
    with pytest.raises(SettingError, match='AWS_ENDPOINT_URL'):
        ObstoreStore(StoreSettings(endpoint_url=url, access_key_id='x', secret_access_key='y'), UPLOAD).open()


@pytest.mark.parametrize('url', ['http://tower:9000', 'https://s3.example.org', 'http://[fe80::1]:9000', 'http://10.0.0.2/s3/'])
def test_a_usable_endpoint_is_accepted(url: str) -> None:
    """A host name or an address, with or without a port and a path."""
    ObstoreStore(settings_for(url), UPLOAD).open()


def test_a_password_in_the_endpoint_is_not_shown() -> None:
    """Neither by the reader nor by one of its buckets."""
    with refused() as url:
        settings = settings_for(url.replace('http://', 'http://user:hunter2@'))
        reader = open_reader(settings)
        with pytest.raises(StoreUnavailable) as caught:
            reader.head('camera', 'a')
    bucket = Bucket(settings, 'camera')
    for text in (reader.describe(), repr(reader), bucket.describe(), repr(bucket), str(caught.value)):
        assert 'hunter2' not in text


def test_the_memory_of_many_buckets_is_bounded() -> None:
    """Buckets are named by rows of a catalog, which any writer may have added."""
    with refused() as url:
        store = ObstoreStore(settings_for(url), UPLOAD)
        for number in range(40):
            with pytest.raises(StoreUnavailable):
                store.head(f'bucket-{number}', 'a')
    assert len(store._clients) <= 16
