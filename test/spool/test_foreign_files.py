"""Files that the spool did not write: adopted where they can be objects, never followed, overwritten or lost."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from spool.conftest import Open
from spool.making import BUCKET, KEY, READY, files, reopened, rows

from shadowhound_data_logger.spool.files import ATTRIBUTE, Tree


def test_links_are_not_followed(opened: Open, root: Path, used: dict[str, bytes], tmp_path: Path) -> None:
    """Links to files and folders are neither adopted nor read, also in an object's place, and are left alone."""
    outside = tmp_path / 'outside'
    outside.mkdir()
    (outside / 'secret').write_bytes(b'2')
    (root / READY / 'thor/a/2.jpg').unlink()
    (root / READY / 'thor/a/2.jpg').symlink_to(outside / 'secret')
    (root / READY / 'thor/link.jpg').symlink_to(outside / 'secret')
    (root / READY / 'thor/folder').symlink_to(outside)
    (root / READY / 'thor/dangling').symlink_to('nowhere')
    (root / 'incoming/77.part').symlink_to(outside / 'secret')
    assert reopened(opened, root) == {'files missing': 1}
    assert (outside / 'secret').read_bytes() == b'2'
    assert (root / READY / 'thor/link.jpg').is_symlink()


@pytest.mark.parametrize('name', [
    f'{READY}/a b.jpg'.encode(), f'{READY}/\xff\xfe.jpg'.encode('latin-1'), f'{READY}/new\nline'.encode(),
    f'{READY}/{"x" * 230}'.encode(), f'{READY}/ü.jpg'.encode(), b'ready/..bucket/a', b'ready/ bucket/a',
    f'held/clock/{BUCKET}/$(rm)'.encode(), f'quarantine/x/{BUCKET}/%00'.encode(),
])  # fmt: skip
def test_names_that_cannot_be_keys(opened: Open, root: Path, used: dict[str, bytes], name: bytes) -> None:
    """A file that cannot be an object is set aside, not deleted, and over nothing."""
    for content in (b'first', b'second'):
        path = Path(os.fsdecode(os.fsencode(root) + b'/' + name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        assert reopened(opened, root) == {'foreign files set aside': 1}
    assert {b'first', b'second'} <= set(files(root).values())


def test_files_outside_the_buckets_are_left_alone(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """What lies beside the buckets, in incoming under a foreign name or is not a file is nobody's object."""
    (root / 'ready/README').write_text('mine')
    (root / 'held/clock.txt').write_text('mine')
    (root / 'incoming/notes.txt').write_text('mine')
    (root / 'incoming' / f'{"9" * 40}.part').write_text('mine')
    (root / 'incoming/5.part').mkdir()
    os.mkfifo(root / READY / 'pipe')
    spool = opened()
    assert not spool.recovery.found_anything
    assert (root / 'incoming/notes.txt').exists()
    assert (root / 'ready/README').exists()


def test_a_file_copied_in_by_hand(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A file without a description is adopted as an object of no topic, and shipped."""
    (root / READY / 'thor/copied.bin').write_bytes(b'copied')
    assert reopened(opened, root) == {'files adopted': 1}
    spool = opened()
    (item,) = (item for item in spool.pending(99) if item.key == 'thor/copied.bin')
    assert item.path.read_bytes() == b'copied'


@pytest.mark.parametrize('attribute', [
    b'\xff\xfe', b'[]', b'{', b'[' * 50_000, b'{"topic": ["a"], "samples": "many", "metadata": 5}',
    b'{"sha256": ["a"], "priority": 99999999999999999999, "samples": -1}',
    b'{"t_start_ns": 1e999, "samples": 1e3, "protected": "yes", "sensor": null, "metadata": {"a": {}}}',
    b'{"type": "\\ud800", "topic": "/a\\u0000"}',
])  # fmt: skip
def test_a_description_that_makes_no_sense(opened: Open, root: Path, used: dict[str, bytes], attribute: bytes) -> None:
    """Of what a file says of itself only what makes sense is believed."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'odd')
    try:
        os.setxattr(path, ATTRIBUTE, attribute)
    except OSError:
        os.setxattr(path, ATTRIBUTE, attribute[:3000])
    assert reopened(opened, root) == {'files adopted': 1}
    (row,) = (row for row in rows(root) if row['key'] == 'thor/odd.bin')
    assert (row['samples'], row['topic'], row['protected'], row['priority'] <= 9) == (0, None, 0, True)


def test_a_file_with_foreign_content(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Content that differs from its own description is not adopted as if it were whole."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'changed')
    os.setxattr(path, ATTRIBUTE, json.dumps({'sha256': '0' * 64}).encode())
    assert reopened(opened, root) == {'foreign files set aside': 1}


def test_a_file_that_may_not_be_read(opened: Open, root: Path, used: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's unreadable file is left where it is."""
    path = root / READY / 'thor/theirs.bin'
    path.write_bytes(b'x')
    open_file = Path.open

    def refuse(file: Path, *arguments: object, **more: object) -> object:
        if file == path:
            raise PermissionError(errno.EACCES, 'Permission denied')
        return open_file(file, *arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(Path, 'open', refuse)
        spool = opened()
    assert dict(spool.recovery.counts) == {'unreadable files left alone': 1}
    assert path.exists()


def test_a_place_never_overwrites_in_foreign(root: Path) -> None:
    """Setting the same path aside again keeps both files."""
    tree = Tree(root)
    tree.create()
    for content in (b'1', b'2', b'3'):
        path = root / 'ready' / BUCKET / KEY
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        tree.set_aside(path)
    assert set(files(root).values()) == {b'1', b'2', b'3'}
