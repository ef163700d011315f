"""Whatever happened to a spool's folder, a start works, ships nothing damaged, loses no whole file and says what it found."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import pytest
from profiles import examples
from spool import rotting
from spool.conftest import Open
from spool.making import READY, files, make, put, rows

from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.files import Tree

ROUNDS = examples(40)


@pytest.fixture(scope='module')
def base(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """The spool of a process that died, and the content of each of its objects."""
    root = tmp_path_factory.mktemp('base') / 'spool'
    return root, rotting.new_base(root)


@pytest.mark.sampled
@pytest.mark.parametrize('part', range(4))
def test_random_damage(base: tuple[Path, dict[str, bytes]], tmp_path: Path, part: int) -> None:
    """After any damage a start works, no damaged object is shipped, what is whole is kept, and the ledger closes or tells."""
    root, bodies = base
    for seed in range(part, ROUNDS, 4):
        rotten = rotting.rot(root, tmp_path / 'rotten', random.Random(seed))
        try:
            rotting.check(rotten, bodies)
        except Exception as error:
            raise AssertionError(f'seed {seed}: {rotten.done}') from error
        shutil.rmtree(rotten.root)


def test_damage_that_is_seen_at_the_put_only(opened: Open, root: Path) -> None:
    """A flipped bit in a file of the right size is found before it is sent: the object is quarantined as damaged."""
    spool = opened()
    put(spool, make('good', b'good'), make('bad', b'bad'))
    (root / READY / 'bad').write_bytes(b'bae')
    assert rotting.ship(spool) == {'good': b'good'}
    assert {row['key']: (row['state'], row['reason']) for row in rows(root)} == {
        'good': ('delivered', None), 'bad': ('quarantined', 'damaged'),
    }  # fmt: skip
    assert files(root) == {'quarantine/damaged/sensor-data/bad': b'bae'}


@pytest.mark.parametrize('held', [None, 'clock'])
def test_a_part_whose_index_is_lost(opened: Open, root: Path, held: str | None) -> None:
    """What was committed but not yet in its place survives the loss of the index, by what it says of itself."""
    spool = opened()
    put(spool, make('a/part', b'part', held=held))
    spool.close()
    (path,) = (root / name for name in files(root))
    os.replace(path, root / 'incoming/1.part')
    (root / 'incoming/2.part').write_bytes(b'of no description')
    (root / 'index.db').unlink()
    spool = opened()
    assert dict(spool.recovery.counts) == {'files adopted': 1, 'uncommitted parts removed': 1}
    (row,) = rows(root)
    assert (row['key'], row['state'], row['reason']) == ('a/part', 'held' if held else 'pending', held)
    assert list(files(root).values()) == [b'part']


def test_a_cut_part_whose_index_is_lost(opened: Open, root: Path) -> None:
    """A part that is not what it says of itself was not committed."""
    spool = opened()
    put(spool, make('a/part', b'part'))
    spool.close()
    os.replace(root / READY / 'a/part', root / 'incoming/1.part')
    os.truncate(root / 'incoming/1.part', 2)
    (root / 'index.db').unlink()
    assert dict(opened().recovery.counts) == {'uncommitted parts removed': 1}


def test_a_row_whose_text_is_damaged(opened: Open, root: Path) -> None:
    """Damage inside a row, which SQLite cannot see, does not stop the delivery of all others: the index is rebuilt."""
    spool = opened()
    put(spool, make('a'), make('b'))
    with spool._connections.writing.transaction():
        spool._connections.writing._db.execute("UPDATE objects SET metadata = '{\"sha' WHERE key = 'a'")
    spool.close()
    spool = opened()
    assert spool.recovery.counts['damaged index rebuilt'] == 1
    assert {item.key for item in spool.pending(9)} == {'a', 'b'}


def test_an_unbalanced_ledger_is_reported(opened: Open, root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A total that was damaged in the index is said at every start, and costs nothing else."""
    spool = opened()
    put(spool, make('a'))
    with spool._connections.writing.transaction():
        spool._connections.writing._db.execute("UPDATE tally SET samples = samples + 1 WHERE state = 'pending'")
    spool.close()
    spool = opened()
    assert dict(spool.recovery.counts) == {'sums of the ledger that do not balance': 1}
    assert 'stored 1, but in objects there are 2' in caplog.text
    assert [item.key for item in spool.pending(9)] == ['a']


@pytest.mark.parametrize('kind', ['file', 'folder', 'link'])
def test_something_in_the_way_of_a_part(opened: Open, root: Path, tmp_path: Path, kind: str) -> None:
    """What lies where the next part is to be written is set aside, not written over, and stops no commit."""
    outside = tmp_path / 'outside'
    outside.write_bytes(b'theirs')
    spool = opened()
    part = Tree(root).part(1)
    if kind == 'file':
        part.write_bytes(b'theirs')
    elif kind == 'folder':
        part.mkdir()
        (part / 'inner').write_bytes(b'theirs')
    else:
        part.symlink_to(outside)
    (item,) = put(spool, make('a', b'ours'))
    assert item.path.read_bytes() == b'ours'
    assert outside.read_bytes() == b'theirs'
    aside = root / 'foreign/incoming/1.part'
    assert (aside / 'inner' if kind == 'folder' else aside).read_bytes() == b'theirs'
    assert {row['state'] for row in rows(root)} == {State.PENDING.value}
