"""Reading, the same for every store: ranges, pieces, resumed downloads."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import pytest
from stores.memory import MemoryStore
from stores.spooled import Spool

from shadowhound_data_logger.core.errors import ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.stores.base import Content, ObjectStore
from shadowhound_data_logger.stores.content import CHUNK_BYTES
from shadowhound_data_logger.stores.download import TRIES, download

CONTENT = os.urandom(2 * CHUNK_BYTES + 17)
KEY = 'thor/rosbags/patrol/patrol_0.mcap'


def test_a_range_is_a_slice(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """It has the bytes of a slice of the content: fewer at the end, none beyond it."""
    store.put(spool(KEY, CONTENT))
    end = len(CONTENT)
    for start, length in ((0, 1), (0, 10), (5, 1000), (CHUNK_BYTES - 1, CHUNK_BYTES + 2), (end - 3, 3), (end - 3, 100),
                          (end, 1), (end + 5, 1), (7, 0)):  # fmt: skip
        assert store.ranges(bucket, KEY, [(start, start + length)])[0] == CONTENT[start : start + length], (start, length)


def test_ranges_arrive_in_the_requested_order(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Several at the same time, some beyond the end, some empty."""
    store.put(spool(KEY, CONTENT))
    end = len(CONTENT)
    spans = [(100, 200), (0, 10), (end - 5, end + 5), (end, end + 5), (7, 7), (CHUNK_BYTES, CHUNK_BYTES + 1)]
    assert [bytes(each) for each in store.ranges(bucket, KEY, spans)] == [CONTENT[begin:stop] for begin, stop in spans]


def test_content_has_the_size_of_the_object(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """From any offset: the size and the metadata; it need not be read."""
    item = spool('a', b'0123456789', metadata={'topic': '/x'})
    store.put(item)
    for start in (0, 4, 10, 20):
        with store.content(bucket, 'a', start) as content:
            report = content.info
        assert (report.size, report.sha256, report.metadata['topic'], report.content_type) == (
            10,
            item.sha256,
            '/x',
            item.content_type,
        )


def test_a_range_of_a_missing_object_is_refused(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A missing key is named in the error, also when it is read in pieces."""
    store.put(spool('a', b'x'))
    with pytest.raises(ObjectRefused, match=f'there is no {bucket}/b'):
        store.ranges(bucket, 'b', [(0, 5)])
    with pytest.raises(ObjectRefused, match=f'there is no {bucket}/b'):
        next(store.content(bucket, 'b').pieces)


def test_content_comes_in_bounded_pieces(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """From any byte on, in order, and no piece is larger than two megabytes."""
    store.put(spool(KEY, CONTENT))
    for start in (0, 1, CHUNK_BYTES, len(CONTENT)):
        pieces = list(store.content(bucket, KEY, start))
        assert b''.join(pieces) == CONTENT[start:], start
        assert all(0 < len(piece) <= 2 * CHUNK_BYTES for piece in pieces), start


def wanted(bucket: str, size: int = len(CONTENT), sha256: str | None = None) -> ObjectInfo:
    return ObjectInfo(bucket, KEY, size, sha256)


def test_a_download_has_the_content_of_the_object(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """The file has the content, progress was reported, and nothing else is left."""
    store.put(spool(KEY, CONTENT))
    reports: list[int] = []
    path = tmp_path / 'out' / 'a.mcap'
    found = download(store, wanted(bucket), path, on_progress=reports.append)
    assert path.read_bytes() == CONTENT
    assert found.sha256 == found.info.sha256 == hashlib.sha256(CONTENT).hexdigest()
    assert found.is_verified
    assert sum(reports) == len(CONTENT)
    assert list(path.parent.iterdir()) == [path]


def test_an_interrupted_download_resumes(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """Existing bytes are not downloaded again."""
    store.put(spool(KEY, CONTENT))
    (tmp_path / 'a.mcap.part').write_bytes(CONTENT[: CHUNK_BYTES + 5])
    reports: list[int] = []
    download(store, wanted(bucket), tmp_path / 'a.mcap', on_progress=reports.append)
    assert sum(reports) == len(CONTENT) - CHUNK_BYTES - 5
    assert (tmp_path / 'a.mcap').read_bytes() == CONTENT


@pytest.mark.parametrize('there', [b'wrong', bytes(len(CONTENT)), CONTENT + b'more'])
def test_a_corrupt_download_restarts(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path, there: bytes) -> None:
    """Bytes that do not match are discarded, with a notice to the caller, and downloaded once more."""
    store.put(spool(KEY, CONTENT))
    (tmp_path / 'a.mcap.part').write_bytes(there)
    reports = [len(there)]
    download(store, wanted(bucket), tmp_path / 'a.mcap', on_progress=reports.append)
    assert (tmp_path / 'a.mcap').read_bytes() == CONTENT
    assert sum(reports) == len(CONTENT)


@pytest.mark.parametrize('how', [{'size': 5}, {'sha256': '0' * 64}])
def test_a_download_with_wrong_content_leaves_no_file(
    store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path, how: dict[str, Any]
) -> None:
    """With a size or content other than expected: refused the second time, and nothing stays."""
    store.put(spool(KEY, CONTENT))
    reports: list[int] = []
    with pytest.raises(ObjectRefused, match='does not match its metadata') as caught:
        download(store, wanted(bucket, **how), tmp_path / 'a.mcap', on_progress=reports.append)
    assert caught.value.data['reason'] == 'damaged'
    assert list(tmp_path.glob('*.mcap*')) == []
    assert sum(reports) == 0


def test_content_of_another_version_is_refused(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Each response has its version, and a request for a version gets that version or an error."""
    store.put(spool('a', b'0123456789'))
    with store.content(bucket, 'a') as content:
        before = content.info.etag
    assert b''.join(store.content(bucket, 'a', 4, before)) == b'456789'
    assert store.replace(bucket, 'a', b'9876543210', known(store, bucket, 'a'))
    for start in (0, 4):
        with pytest.raises(ObjectRefused) as caught:
            store.content(bucket, 'a', start, before)
        assert caught.value.data['reason'] == 'changed'
    with store.content(bucket, 'a') as content:
        after = content.info.etag
    assert b''.join(store.content(bucket, 'a', 4, after)) == b'543210'


def known(store: ObjectStore, bucket: str, key: str) -> str:
    """The version of an object, as for ``replace``."""
    found = store.changed(bucket, key, '"none"', 1 << 30)
    assert found is not None
    return found[1]


def test_a_download_of_a_changed_object_restarts(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """If a connection broke and the content has changed since, no byte of the old content stays."""
    store.put(spool(KEY, CONTENT))
    reports: list[int] = []
    after = os.urandom(len(CONTENT))

    def tell(size: int) -> None:
        reports.append(size)
        if len(reports) == 1:
            assert store.replace(bucket, KEY, after, known(store, bucket, KEY))
            raise StoreUnavailable('cut')

    download(store, wanted(bucket), tmp_path / 'a.mcap', on_progress=tell, pause=lambda _: None)
    assert (tmp_path / 'a.mcap').read_bytes() == after
    assert reports[0] == -reports[1] > 0
    assert sum(reports) == len(CONTENT)


class Short(MemoryStore):
    """Stops after four bytes each time."""

    asked = 0

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        self.asked += 1
        return Content(ObjectInfo(bucket, key, 10, None), iter([b'0123456789'[start : start + 4]]))


def test_a_truncated_download_resumes(tmp_path: Path) -> None:
    """The store ends the content early: the next try requests only the rest, after a pause."""
    store, pauses = Short(), list[float]()
    found = download(store, ObjectInfo('b', 'k', 10, None), tmp_path / 'file', pause=pauses.append)
    assert (tmp_path / 'file').read_bytes() == b'0123456789'
    assert (store.asked, len(pauses), found.is_verified) == (3, 2, False)


def test_a_partial_download_survives_an_outage(tmp_path: Path) -> None:
    """After several tries there is an error; the next call continues."""

    class Away(Short):
        def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
            if start:
                raise StoreUnavailable('away')
            return super().content(bucket, key, start, version)

    pauses: list[float] = []
    with pytest.raises(StoreUnavailable, match='away'):
        download(Away(), ObjectInfo('b', 'k', 10, None), tmp_path / 'file', pause=pauses.append)
    assert len(pauses) == TRIES - 1
    assert (tmp_path / 'file.part').read_bytes() == b'0123'
    download(Short(), ObjectInfo('b', 'k', 10, None), tmp_path / 'file', pause=pauses.append)
    assert (tmp_path / 'file').read_bytes() == b'0123456789'
