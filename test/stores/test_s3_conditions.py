"""An S3 store never overwrites, whatever its server makes of If-None-Match."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import pytest
from stores.asking import error_of
from stores.fake_s3 import FakeS3, served
from stores.spooled import Spool

from shadowhound_data_logger.core.errors import AccessDenied, ForeignObject, StoreError
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.stores.s3 import S3Store


@pytest.mark.parametrize(('condition', 'words'), [('not implemented', 'does not implement'), ('ignored', 'ignores')])
def test_a_server_without_conditional_puts(
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


def test_the_first_put_of_all_never_overwrites_either(opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
    """A server that ignores If-None-Match is found out without a loss."""
    with served(FakeS3(condition='ignored')) as server:
        server.objects[f'/{bucket}/a'] = (b'theirs', {})
        error_of(ForeignObject, lambda: opened(server.url).put(spool('a', b'ours..')))
        assert server.objects[f'/{bucket}/a'][0] == b'theirs'


def test_a_proved_server_costs_one_request_a_put(opened: Callable[..., S3Store], spool: Spool) -> None:
    """The proof costs two requests once."""
    with served(FakeS3()) as server:
        store = opened(server.url)
        for key in ('a', 'b', 'c'):
            store.put(spool(key, key.encode()))
        assert server.requests == ['HEAD', 'PUT', 'PUT', 'PUT', 'PUT']


@pytest.mark.parametrize('condition', ['honoured', 'ignored'])
def test_who_loses_a_race_knows(condition: str, opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
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


def test_credentials_that_may_only_write(opened: Callable[..., S3Store], spool: Spool) -> None:
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
