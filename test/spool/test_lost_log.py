"""A process that died in a commit, and the write-ahead log of the index that is gone as well or is not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from spool.child import started
from spool.conftest import Open
from spool.making import assert_whole, make, put, reopened, rows, settle

from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.files import ATTRIBUTE


def died(root: Path, moment: str) -> None:
    with started('die', root, moment) as child:
        assert child.wait(60) < 0
    assert len(list((root / 'incoming').iterdir())) == 2


def lose_log(root: Path) -> None:
    for suffix in ('-wal', '-shm'):
        (root / f'index.db{suffix}').unlink()


@pytest.mark.parametrize('before', ['nothing', 'a session'])
@pytest.mark.parametrize('moment', ['committed', 'checkpointed'])
def test_what_was_committed_outlives_the_log(opened: Open, root: Path, before: str, moment: str) -> None:
    """Died before the files of a commit had their names: they are adopted, whatever else the index still knows."""
    if before == 'a session':
        spool = opened()
        settle(spool, put(spool, make('thor/before.jpg'))[0], State.DELIVERED)
        spool.close()
    died(root, moment)
    lose_log(root)
    done = reopened(opened, root)
    assert done['files adopted'] == (2 if moment == 'checkpointed' else 3)
    found = {row['key']: (row['state'], row['reason']) for row in rows(root) if row['state'] != 'delivered'}
    assert found == {'thor/whole.jpg': ('pending', None), 'thor/a.jpg': ('pending', None), 'thor/b.jpg': ('held', 'clock')}
    assert not list((root / 'sessions').iterdir())


def test_a_file_that_was_not_committed_is_removed(opened: Open, root: Path) -> None:
    """With its log the index knows all that was promised; what was not is lost at the restart, and said to be."""
    died(root, 'uncommitted')
    done = reopened(opened, root)
    assert done['files not committed'] == 2
    assert [row['key'] for row in rows(root) if row['state'] == 'pending'] == ['thor/whole.jpg']


def test_an_incomplete_part_is_not_adopted(opened: Open, root: Path) -> None:
    """A cut one is removed, log or not, and the other one of its commit is kept."""
    died(root, 'committed')
    part = min((root / 'incoming').iterdir())
    part.write_bytes(part.read_bytes()[:-1])
    lose_log(root)
    done = reopened(opened, root)
    assert (done['files adopted'], done['uncommitted parts removed']) == (2, 1)
    assert_whole(root)


def test_a_part_has_its_first_name_again_after_a_power_cut(opened: Open, root: Path) -> None:
    """The commit is durable, the names that it gave are not: the content is found by its checksum, also without attributes."""
    died(root, 'committed')
    parts = sorted((root / 'incoming').iterdir())
    assert len(parts) == 2
    (session,) = (int(path.name) for path in (root / 'sessions').iterdir())
    for number, part in enumerate(parts):
        os.removexattr(part, ATTRIBUTE)
        part.rename(part.with_name(f'{session}-{number:032x}.body'))
    done = reopened(opened, root)
    assert done == {'renames completed': 2}
    assert {row['key']: row['state'] for row in rows(root) if row['state'] != 'delivered'} == {
        'thor/whole.jpg': 'pending', 'thor/a.jpg': 'pending', 'thor/b.jpg': 'held'}  # fmt: skip
    assert not list((root / 'incoming').iterdir())
    assert_whole(root)
