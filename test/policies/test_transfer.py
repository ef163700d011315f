"""Policies over a bad link: 100 MB over a connection that is cut 20 times, and no faster than the cap."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from policies.models import Aliases, Scene, Spark, bucket_of, linear
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import PolicyRefused, StoreUnavailable
from shadowhound_data_logger.policies import sync
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import SANDBOX, SmokeRun
from shadowhound_data_logger.policies.trust import target_of
from shadowhound_data_logger.stores.base import Content
from shadowhound_data_logger.stores.directory import DirectoryStore
from shadowhound_data_logger.stores.download import TRIES
from shadowhound_data_logger.stores.s3 import S3Store

CUTS = 20


class CuttingFront:
    """Passes connections on to a server, and cuts all of them each time that so many bytes came back, ``CUTS`` times."""

    def __init__(self, to: int, every: int) -> None:
        self._to = to
        self._every = every
        self._lock = threading.Lock()
        self._listener = socket.create_server(('127.0.0.1', 0))
        self._threads: list[threading.Thread] = []
        self._sockets: list[socket.socket] = []
        self._is_over = False
        self._begin(self._serve)
        self.port: int = self._listener.getsockname()[1]
        self.passed = 0
        self.cuts = 0

    def close(self) -> None:
        self._is_over = True
        socket.create_connection(('127.0.0.1', self.port)).close()
        self._threads[0].join(60)
        self._listener.close()
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads[1:]:
            thread.join(60)

    def _begin(self, what: object, *arguments: socket.socket) -> None:
        thread = threading.Thread(target=what, args=arguments)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _serve(self) -> None:
        with suppress(OSError):
            while not self._is_over:
                client, _ = self._listener.accept()
                server = socket.create_connection(('127.0.0.1', self._to))
                self._sockets += client, server
                self._begin(self._pass, client, server)
                self._begin(self._pass_and_cut, server, client)

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while content := source.recv(1 << 16):
                target.sendall(content)
        self._end(source, target)

    def _pass_and_cut(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while content := source.recv(1 << 16):
                target.sendall(content)
                with self._lock:
                    self.passed += len(content)
                    is_cut = self.cuts < CUTS and self.passed >= self._every * (self.cuts + 1)
                    self.cuts += is_cut
                if is_cut:
                    break
        self._end(source, target)

    def _end(self, *both: socket.socket) -> None:
        for one in both:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@pytest.fixture
def spark(seaweed: Tower, tmp_path: Path) -> Iterator[Spark]:
    """Version 1 of 100 MB and version 2 of 10 MB, in the bucket."""
    spark = Spark(tmp_path / 'spark')
    client = bucket_of(seaweed)
    manifests = {}
    for version, floats in ((1, 25_000_000), (2, 2_500_000)):
        packed, _ = spark.packed(version, linear(0.1 * version, extra=floats))
        manifests[target_of('go2', 'go2_patrol', version)] = (packed / 'manifest.json').read_bytes()
        for path in packed.rglob('*'):
            if path.is_file():
                key = f'policies/go2/go2_patrol_v{version}/{path.relative_to(packed).as_posix()}'
                client.put_object(Bucket='lerobot', Key=key, Body=path.read_bytes())
    with closing(S3Store(seaweed.store_settings(), UploadSettings())) as store:
        store.open()
        spark.signing(store).publish(manifests)
    yield spark
    for entry in client.list_objects_v2(Bucket='lerobot', Prefix='policies/')['Contents']:
        client.delete_object(Bucket='lerobot', Key=entry['Key'])


def follow(seaweed: Tower, spark: Spark, home: Path, version: int, port: int | None = None, max_mbps: float = 0.0) -> None:
    """A robot takes a version, its smoke run aside."""
    folder = PolicyFolder(home)
    spark.trusted_by(folder)
    registry = Aliases()
    registry.say('champion', version)
    url = f'http://127.0.0.1:{port}' if port else seaweed.endpoint_url
    with closing(S3Store(replace(seaweed.store_settings(), endpoint_url=url), UploadSettings())) as store:
        store.open()
        settings = sync.PolicySettings(name='go2_patrol', robot='thor', min_free_bytes=0, max_mbps=max_mbps)
        pause = time.sleep if max_mbps else lambda _: None  # a cap waits; what waits after a cut need not here
        assert sync.PolicySync(folder, store, registry, settings, pause=pause).run().done == 'activated'


@pytest.mark.seaweedfs
@pytest.mark.long('100 MB, and seconds under a cap')
def test_a_link_that_is_cut_and_one_that_is_capped(
    seaweed: Tower, spark: Spark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty cuts cost at most a twentieth of the bytes; under a cap of 40 Mbit/s it is no faster."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    size = sum(path.stat().st_size for path in (spark.folder / 'packed_1').rglob('*') if path.is_file())
    with closing(CuttingFront(urlsplit(seaweed.endpoint_url).port or 0, size // (CUTS + 1))) as front:
        follow(seaweed, spark, tmp_path / 'cut', 1, front.port)
        assert front.cuts == CUTS
        assert size <= front.passed <= 1.05 * size, front.passed / size
    size = sum(path.stat().st_size for path in (spark.folder / 'packed_2').rglob('*') if path.is_file())
    begin = time.monotonic()
    follow(seaweed, spark, tmp_path / 'capped', 2, max_mbps=40.0)
    mbps = size * 8e-6 / (time.monotonic() - begin)
    assert mbps <= 44.0


class Line(DirectoryStore):
    """A store behind a line of so many Mbit/s and pieces of this size, which at times stands still; in virtual time."""

    def __init__(self, folder: Path, mbps: float, piece: int, stands_s: float) -> None:
        super().__init__(folder)
        self.mbps, self.piece, self.stands_s = mbps, piece, stands_s
        self.now = 1000.0
        self.arrived = 0

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        content = super().content(bucket, key, start, version)
        return replace(content, pieces=self._arriving(b''.join(content.pieces)))

    def _arriving(self, body: bytes) -> Iterator[bytes]:
        for place in range(0, len(body), self.piece):
            piece = body[place : place + self.piece]
            self.now += len(piece) * 8e-6 / self.mbps + (self.stands_s if place // self.piece % 20 == 19 else 0.0)
            self.arrived += len(piece)
            yield piece

    def pause(self, seconds: float) -> None:
        """It wakes late, as any sleep."""
        self.now += seconds + 0.001


@pytest.mark.parametrize(('cap', 'line', 'piece', 'stands_s'), [
    (0.8, 0.82, 20_000, 0.0), (0.8, 1.0, 20_000, 0.0), (0.8, 1.0, 40_000, 0.0), (0.8, 20.0, 20_000, 0.1),
    (0.04, 1.0, 20_000, 2.0), (4.0, 4.2, 1300, 0.0),
])  # fmt: skip
def test_a_cap_is_kept_and_made_use_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cap: float, line: float, piece: int, stands_s: float
) -> None:
    """No faster than the cap and at most a tenth slower, where the line carries more; also where that is hardly more."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    scene = Scene(tmp_path)
    scene.publish(1, linear(extra=100_000))
    scene.robot.store = store = Line(tmp_path / 'store', line, piece, stands_s)
    scene.robot.settings = replace(scene.robot.settings, max_mbps=cap)
    scene.robot.pause, scene.robot.monotonic = store.pause, lambda: store.now
    fetched = scene.robot.run().fetched_bytes
    assert fetched > store.arrived > 400_000
    mbps = fetched * 8e-6 / (store.now - 1000.0)
    assert 0.9 * cap <= mbps <= cap


class Liar(DirectoryStore):
    """Sends wrong content for every request of a model, and disconnects more often than a download retries."""

    asked = sent = 0
    breaks = True

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        content = super().content(bucket, key, start, version)
        return replace(content, pieces=self._lying(content.info.size - start)) if key.endswith('.onnx') else content

    def _lying(self, size: int) -> Iterator[bytes]:
        self.asked += 1
        for _ in range(0, size, 1000):
            self.sent += 1
            assert self.sent < 1000
            yield bytes(min(1000, size))
            if self.breaks and self.asked % (TRIES + 1):
                raise StoreUnavailable('cut')


@pytest.mark.parametrize(('breaks', 'error'), [(True, StoreUnavailable), (False, PolicyRefused)])
def test_a_lying_store_causes_a_bounded_transfer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, breaks: bool, error: type[Exception]
) -> None:
    """One that sends something else, and whenever it was found out breaks off before the second time."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
    scene = Scene(tmp_path)
    scene.publish(1, linear(extra=2_500))
    scene.robot.store = store = Liar(tmp_path / 'store')
    store.breaks = breaks
    with pytest.raises(error):
        scene.robot.run()
    assert store.sent <= 50
