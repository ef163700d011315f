"""What every store does alike when something is read: ranges, pieces, downloads that are taken up again."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from stores.spooled import Spool

from shadowhound_data_logger.errors import ObjectRefused, StoreUnavailable
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.content import CHUNK_BYTES
from shadowhound_data_logger.stores.download import download

CONTENT = os.urandom(2 * CHUNK_BYTES + 17)
KEY = 'thor/rosbags/patrol/patrol_0.mcap'


@pytest.mark.parametrize(('start', 'length'), [
    (0, 1), (0, 10), (5, 1000), (CHUNK_BYTES - 1, CHUNK_BYTES + 2), (len(CONTENT) - 3, 3), (len(CONTENT) - 3, 100),
    (len(CONTENT), 1), (len(CONTENT) + 5, 1), (7, 0),
])  # fmt: skip
def test_a_range_is_a_slice(store: ObjectStore, spool: Spool, bucket: str, start: int, length: int) -> None:
    """It has the bytes that a slice of the content has: fewer at its end, none behind it."""
    store.put(spool(KEY, CONTENT))
    assert store.get_range(bucket, KEY, start, length) == CONTENT[start : start + length]


def test_a_range_of_nothing_is_refused(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A missing key is named in the error, also where it is read in pieces."""
    store.put(spool('a', b'x'))
    with pytest.raises(ObjectRefused, match=f'there is no {bucket}/b'):
        store.get_range(bucket, 'b', 0, 5)
    with pytest.raises(ObjectRefused, match=f'there is no {bucket}/b'):
        next(store.content(bucket, 'b'))


@pytest.mark.parametrize('start', [0, 1, CHUNK_BYTES, len(CONTENT)])
def test_content_comes_in_bounded_pieces(store: ObjectStore, spool: Spool, bucket: str, start: int) -> None:
    """From any byte on, in order, and no piece is larger than a megabyte."""
    store.put(spool(KEY, CONTENT))
    pieces = list(store.content(bucket, KEY, start))
    assert b''.join(pieces) == CONTENT[start:]
    assert all(0 < len(piece) <= CHUNK_BYTES for piece in pieces)


def test_a_download_is_the_object(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """The file has the content, what arrived was told, and nothing else is left."""
    store.put(spool(KEY, CONTENT))
    told: list[int] = []
    path = tmp_path / 'out' / 'a.mcap'
    info = download(store, bucket, KEY, path, tell=told.append)
    assert path.read_bytes() == CONTENT
    assert (info.size, info.sha256) == (len(CONTENT), hashlib.sha256(CONTENT).hexdigest())
    assert sum(told) == len(CONTENT)
    assert list(path.parent.iterdir()) == [path]


def test_a_download_goes_on_where_it_broke_off(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """What lies there is not fetched again."""
    store.put(spool(KEY, CONTENT))
    (tmp_path / 'a.mcap.part').write_bytes(CONTENT[: CHUNK_BYTES + 5])
    told: list[int] = []
    download(store, bucket, KEY, tmp_path / 'a.mcap', tell=told.append)
    assert sum(told) == len(CONTENT) - CHUNK_BYTES - 5
    assert (tmp_path / 'a.mcap').read_bytes() == CONTENT


def test_a_download_of_wrong_bytes_is_begun_anew(store: ObjectStore, spool: Spool, bucket: str, tmp_path: Path) -> None:
    """What does not fit is refused and thrown away, so that the next try works; so is a part that is too long."""
    store.put(spool(KEY, CONTENT))
    (tmp_path / 'a.mcap.part').write_bytes(b'wrong')
    with pytest.raises(ObjectRefused, match='has not the content') as caught:
        download(store, bucket, KEY, tmp_path / 'a.mcap')
    assert caught.value.data['reason'] == 'damaged'
    assert not (tmp_path / 'a.mcap').exists()
    (tmp_path / 'a.mcap.part').write_bytes(CONTENT + b'more')
    download(store, bucket, KEY, tmp_path / 'a.mcap')
    assert (tmp_path / 'a.mcap').read_bytes() == CONTENT


def test_a_download_that_ends_early_is_no_file(tmp_path: Path) -> None:
    """The store ends the content before its size: what came is kept for the next try."""

    class Short:
        def head(self, bucket: str, key: str) -> ObjectInfo:
            return ObjectInfo(bucket, key, 10, None)

        def content(self, _bucket: str, _key: str, start: int = 0) -> Iterator[bytes]:
            yield b'0123456789'[start : start + 4]

    with pytest.raises(StoreUnavailable, match='ended after 4 of 10 bytes'):
        download(Short(), 'b', 'k', tmp_path / 'file')
    with pytest.raises(StoreUnavailable, match='ended after 8 of 10 bytes'):
        download(Short(), 'b', 'k', tmp_path / 'file')
    assert replace(download(Short(), 'b', 'k', tmp_path / 'file'), key='k').size == 10
    assert (tmp_path / 'file').read_bytes() == b'0123456789'
