"""Whatever is in a bag's folder at startup: nothing outside is touched, the node starts, and other bags are completed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bags.recording import ROBOT, desk, manifest
from bags.slices import closed, fill, messages

from shadowhound_data_logger.formats.mcap.writer import SliceWriter

BAG = 'patrol_20251018_120000'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a bag that was cut off: a slice that is whole, and one that is open, each with ten messages."""
    made = tmp_path / 'home' / 'bags' / ROBOT / BAG
    made.mkdir(parents=True)
    closed(made / f'{BAG}_0.mcap', 10)
    writer = SliceWriter(made / f'{BAG}_1.mcap')
    fill(writer, messages(10))
    writer.sync()
    writer.abort()
    return made


def recovered(home: Path) -> dict[str, Path]:
    """What is in the spool after a start."""
    with desk(home) as it:
        it.recorder._recovery.worker.join(60)
        assert it.recorder._recovery.worker.failures == 0
        return dict(it.objects())


def counts(found: dict[str, Path], home: Path) -> dict[str, int]:
    """Slice -> messages, according to the manifest."""
    (path,) = home.glob(f'spool/ready/*/{ROBOT}/rosbags/{BAG}/manifest.json')
    return {entry['file'].removeprefix(f'{BAG}_'): entry['messages'] for entry in json.loads(path.read_bytes())['slices']}


WHOLE = {'0.mcap': 10, '1.mcap': 10}


def test_links_are_not_followed(folder: Path, tmp_path: Path) -> None:
    """For a slice, an open one and a bag: the target of a link is unchanged, and the link is set aside."""
    home, precious = tmp_path / 'home', tmp_path / 'precious.mcap.open'
    closed(tmp_path / 'other.mcap', 5)
    precious.write_bytes(b'precious')
    before = {path: path.read_bytes() for path in (precious, tmp_path / 'other.mcap')}
    (folder / f'{BAG}_2.mcap.open').symlink_to(precious)
    (folder / f'{BAG}_3.mcap').symlink_to(tmp_path / 'other.mcap')
    (folder.parent / 'linked_20251018_120000').symlink_to(tmp_path)
    assert counts(recovered(home), home) == WHOLE
    assert {path: path.read_bytes() for path in before} == before
    aside = home / 'bags' / f'{ROBOT}.damaged' / BAG
    assert sorted(path.name for path in aside.iterdir()) == [f'{BAG}_2.mcap.open', f'{BAG}_3.mcap']
    assert all(path.is_symlink() for path in aside.iterdir())


def test_what_is_no_slice_is_set_aside(folder: Path, tmp_path: Path) -> None:
    """A folder, a slice of another bag, a name without a number; twice of one name as well."""
    home = tmp_path / 'home'
    (folder / f'{BAG}_5.mcap').mkdir()
    (folder / 'other_20251018_120000_0.mcap').write_bytes(b'')
    (folder / 'x.mcap.open').write_bytes(b'x')
    aside = home / 'bags' / f'{ROBOT}.damaged' / BAG
    aside.mkdir(parents=True)
    (aside / 'x.mcap.open').write_bytes(b'before')
    assert counts(recovered(home), home) == WHOLE
    assert sorted(path.name for path in aside.iterdir()) == [
        'other_20251018_120000_0.mcap', f'{BAG}_5.mcap', 'x.mcap.open', 'x.mcap.open.1',
    ]  # fmt: skip
    assert (aside / 'x.mcap.open').read_bytes() == b'before'


def test_a_broken_bag_does_not_block_others(folder: Path, tmp_path: Path) -> None:
    """It is tried again; the bags after it are completed during that time, and the node records."""
    later = folder.with_name('patrol_20251018_130000')
    later.mkdir()
    closed(later / f'{later.name}_0.mcap', 7)
    (folder / f'{BAG}_1.mcap').write_bytes(b'in the way of the open slice')
    with desk(tmp_path / 'home') as it:
        for _ in range(200):
            if f'{later.name}/manifest.json' in it.objects():
                break
            it.recorder._recovery.worker.join(0.05)
        assert numbers_of(it.objects(), later.name) == 7
        assert it.recorder._recovery.is_busy
        assert it.recorder.start()[0]


def numbers_of(found: dict[str, Path], bag: str) -> int:
    return sum(entry['messages'] for entry in manifest(found, bag)['slices'])
