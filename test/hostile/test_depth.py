"""Documents whose lists and objects lie in one another more often than Python's stack is deep."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from shadowhound_data_logger.core.errors import DataLoggerError, LakeError
from shadowhound_data_logger.core.mailbox import RequestRefused, decode_inbox
from shadowhound_data_logger.core.untrusted import MAX_JSON_DEPTH, from_json, from_strict_json
from shadowhound_data_logger.datasets.transfer import _digests
from shadowhound_data_logger.lake.decode import members, records

DEPTHS = (MAX_JSON_DEPTH + 1, 500, 990, 1000, 5000, 200_000)


def lists(depth: int) -> bytes:
    return b'[' * depth + b']' * depth


def objects(depth: int) -> bytes:
    return b'{"a":' * depth + b'1' + b'}' * depth


@pytest.mark.parametrize('depth', DEPTHS)
@pytest.mark.parametrize('made', [lists, objects])
@pytest.mark.parametrize('read', [from_json, lambda body: from_strict_json(body, 1 << 24)])
def test_a_document_that_is_too_deep_is_refused(read: Callable[[bytes], Any], made: Callable[[int], bytes], depth: int) -> None:
    """With a sentence, however deep it is: no reader goes into it by recursion then."""
    with pytest.raises(ValueError, match='nested deeper than 64'):
        read(made(depth))


def test_what_people_write_is_read() -> None:
    """A document with as much nesting as is allowed, and one that is wide."""
    for body in (
        lists(MAX_JSON_DEPTH),
        objects(MAX_JSON_DEPTH),
        json.dumps([{'a': [n]} for n in range(10_000)]).encode(),
        b'1',
    ):
        assert from_json(body) == from_strict_json(body, 1 << 24) == json.loads(body)


@pytest.mark.parametrize('depth', [500, 1000, 200_000])
def test_samples_that_are_too_deep_are_no_samples(depth: int) -> None:
    """Of a robot's batch, of its single documents, and beside the messages of an archive; the error is the one of bad content."""
    sample = b'{"stamp_ns":1,"a":%b}' % objects(depth)
    for body in (sample, b'{"type":"x/msg/Y","samples":[%b]}' % sample):
        with pytest.raises(LakeError, match="not a sensor's JSON"):
            records(body)
    with pytest.raises(LakeError, match='the tar cannot be read'):
        members(tar_of(a_json=sample, a_bin=b'1'), 'tar')


@pytest.mark.parametrize('depth', [500, 200_000])
def test_documents_of_others_are_refused_as_other_bad_ones(depth: int) -> None:
    """The digests of a data set, and a robot's mailbox."""
    for read in (_digests, decode_inbox):
        with pytest.raises((DataLoggerError, RequestRefused)):
            read(b'{"format":1,"entries":%b}' % lists(depth))


def tar_of(**files: bytes) -> bytes:
    packed = BytesIO()
    with tarfile.open(fileobj=packed, mode='w') as archive:
        for name, body in files.items():
            member = tarfile.TarInfo(name.replace('_', '.'))
            member.size = len(body)
            archive.addfile(member, BytesIO(body))
    return packed.getvalue()


@pytest.mark.parametrize('kind', [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_links_and_devices_in_an_archive_are_nothing(tmp_path: Path, kind: bytes) -> None:
    """What an archive names beside its own bytes is not opened, wherever it points; its messages are read."""
    secret = tmp_path / 'secret.jpg'
    secret.write_bytes(b'the key')
    packed = BytesIO()
    with tarfile.open(fileobj=packed, mode='w') as archive:
        for name, target in (('b.jpg', str(secret)), ('../c.jpg', '../secret.jpg'), ('d.jpg', 'a.jpg')):
            member = tarfile.TarInfo(name)
            member.type, member.linkname = kind, target
            archive.addfile(member)
        for name, body in (('a.jpg', b'picture'), ('a.json', b'{"stamp_ns":1}')):
            member = tarfile.TarInfo(name)
            member.size = len(body)
            archive.addfile(member, BytesIO(body))
    found = members(packed.getvalue(), 'tar')
    assert [each.body for each in found] == [b'picture']
