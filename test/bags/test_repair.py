"""``bag repair``: complete bags and single files, of this package and of others, copied or in place."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bags.real_bags import NAME, write_ours, write_rosbags
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from shadowhound_data_logger.bags.cut import Choice, cut_folder
from shadowhound_data_logger.bags.repair import BagRepair, repair_bag
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.core.errors import BagDamaged, BagError


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob('*')) if path.is_file()}


def count(path: Path) -> int:
    """The number of messages according to another reader."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def tear(path: Path, count: int) -> None:
    os.truncate(path, path.stat().st_size - count)


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    write_ours(tmp_path / NAME)
    return tmp_path / NAME


def test_a_bag_without_damage_is_left_alone(ours: Path) -> None:
    """Nothing is written, neither a new file nor in place."""
    before = content(ours)
    for in_place in (False, True):
        found = repair_bag(ours, in_place=in_place)
        assert (found.is_damaged, found.out) == (False, None)
    assert content(ours) == before
    assert [path.name for path in ours.parent.iterdir()] == [NAME]


def test_torn_slices_are_repaired_and_the_losses_are_in_the_manifest(ours: Path, tmp_path: Path) -> None:
    """Two of three slices: the copy is a bag that verifies, its manifest lists the losses, and the original is unchanged."""
    tear(ours / f'{NAME}_0.mcap', 200_000)
    tear(ours / f'{NAME}_2.mcap', 10)
    (ours / 'notes.txt').write_text('kept')
    before = content(ours)
    found = repair_bag(ours)
    out = tmp_path / f'{NAME}_repaired'
    assert found.out == out
    assert content(ours) == before
    assert [(each.name, each.is_damaged) for each in found.files] == [
        (f'{NAME}_0.mcap', True), (f'{NAME}_1.mcap', False), (f'{NAME}_2.mcap', True),
    ]  # fmt: skip
    first, _, last = found.files
    assert first.messages is not None
    assert (first.lost_messages, last.messages, last.lost_messages) == (550 - first.messages, 550, 0)
    assert 0 < first.messages < 550
    assert content(out)[f'{NAME}_1.mcap'] == before[f'{NAME}_1.mcap']
    assert content(out)['notes.txt'] == b'kept'
    checked = verify_folder(out, deep=True)
    assert (checked.findings, checked.state) == ((), 'recovered')
    assert [each.messages for each in checked.missing] == [550 - first.messages]
    assert count(out) == first.messages + 1100
    with Reader(out) as reader:
        assert reader.message_count == first.messages + 1100
    with pytest.raises(BagError, match='already exists'):
        repair_bag(ours)


def test_a_bag_is_repaired_in_place(ours: Path) -> None:
    """The same at the bag's location; a second repair finds nothing."""
    tear(ours / f'{NAME}_1.mcap', 5000)
    found = repair_bag(ours, in_place=True)
    assert found.out == ours
    assert not verify_folder(ours, deep=True).findings
    assert sorted(content(ours)) == ['manifest.json', 'metadata.yaml', *(f'{NAME}_{number}.mcap' for number in range(3))]
    assert (ours / f'{NAME}_1.mcap').stat().st_mode & 0o777 == 0o600
    assert not repair_bag(ours).is_damaged


@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_missing_or_wrong_metadata_is_rebuilt(tmp_path: Path, plugin: StoragePlugin) -> None:
    """It is rebuilt from the files, as by `ros2 bag reindex`, and other readers open the bag."""
    bag = tmp_path / 'bag'
    write_rosbags(bag, plugin, CompressionMode.NONE)
    with Reader(bag) as reader:
        before = (reader.message_count, reader.start_time, reader.duration, {each.topic for each in reader.connections})
    for damage in (None, b'', b'rosbag2_bagfile_information: {version: 5}', (bag / 'metadata.yaml').read_bytes()):
        if damage is None:
            (bag / 'metadata.yaml').unlink()
        else:
            (bag / 'metadata.yaml').write_bytes(damage.replace(b'message_count: 300', b'message_count: 7'))
        found = repair_bag(bag, in_place=True)
        assert found.metadata
        assert not any(each.is_damaged for each in found.files)
        with Reader(bag) as reader:
            after = (reader.message_count, reader.start_time, reader.duration, {each.topic for each in reader.connections})
        assert after == before
        assert not repair_bag(bag).is_damaged


@pytest.mark.parametrize('part', [0.3, 0.7, 0.97])
def test_the_readable_rows_of_a_torn_database_are_kept(tmp_path: Path, part: float) -> None:
    """The readable rows of SQLite are kept; the metadata has the number of lost ones."""
    bag = tmp_path / 'bag'
    write_rosbags(bag, StoragePlugin.SQLITE3, CompressionMode.NONE)
    with AnyReader([bag]) as reader:
        written = {bytes(cdr) for _, _, cdr in reader.messages()}
    os.truncate(bag / 'bag.db3', int((bag / 'bag.db3').stat().st_size * part))
    found = repair_bag(bag)
    (file,) = found.files
    assert file.messages is not None
    assert 0 < file.messages < 300
    assert file.lost_messages == 300 - file.messages
    assert found.out is not None
    assert not verify_folder(found.out, deep=True).findings
    with AnyReader([found.out]) as reader:
        kept = [bytes(cdr) for _, _, cdr in reader.messages()]
    assert len(kept) == file.messages
    assert set(kept) <= written


def test_a_damaged_page_costs_only_its_rows(tmp_path: Path) -> None:
    """Only its rows are lost."""
    bag = tmp_path / 'bag'
    write_rosbags(bag, StoragePlugin.SQLITE3, CompressionMode.NONE)
    path = bag / 'bag.db3'
    damaged = bytearray(path.read_bytes())
    damaged[20 * 4096 : 21 * 4096] = b'\xff' * 4096
    path.write_bytes(damaged)
    (file,) = repair_bag(bag).files
    assert file.messages is not None
    assert 250 < file.messages < 300


WAL = """
import os, sqlite3, sys
database = sqlite3.connect(sys.argv[1])
database.execute('PRAGMA journal_mode = WAL')
database.execute('PRAGMA wal_autocheckpoint = 0')
database.execute('INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 1, data FROM messages')
database.commit()
database.execute('INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 2, data FROM messages')
os._exit(0)
"""


@pytest.mark.parametrize('in_place', [False, True])
def test_a_database_that_was_not_closed_is_completed(tmp_path: Path, *, in_place: bool) -> None:
    """Data that its recorder had committed to the write-ahead log is in the result, and the log is gone."""
    bag = tmp_path / 'bag'
    write_rosbags(bag, StoragePlugin.SQLITE3, CompressionMode.NONE)
    subprocess.run([sys.executable, '-c', WAL, str(bag / 'bag.db3')], check=True)
    assert (bag / 'bag.db3-wal').stat().st_size > 1000
    found = repair_bag(bag, in_place=in_place)
    assert found.out is not None
    assert (found.files[0].messages, found.files[0].lost_messages, found.files[0].losses) == (600, 0, ())
    assert count(found.out) == 600
    assert sorted(content(found.out)) == ['bag.db3', 'metadata.yaml']
    assert not repair_bag(found.out).is_damaged


def test_a_single_file_is_repaired(tmp_path: Path, ours: Path) -> None:
    """Next to it, at the requested path, or in place; an open slice is renamed."""
    path = ours / f'{NAME}_1.mcap'
    tear(path, 300_000)
    found = repair_bag(path)
    assert found.out == ours / f'{NAME}_1_repaired.mcap'
    kept = count(found.out)
    assert found.files[0].messages == kept > 0
    repair_bag(path, tmp_path / 'other.mcap')
    shutil.copy(path, tmp_path / 'open_0.mcap.open')
    opened = repair_bag(tmp_path / 'open_0.mcap.open', in_place=True)
    assert (opened.out, count(tmp_path / 'open_0.mcap')) == (tmp_path / 'open_0.mcap', kept)
    assert not (tmp_path / 'open_0.mcap.open').exists()
    assert repair_bag(path, in_place=True).out == path
    assert count(path) == kept
    assert not repair_bag(path).is_damaged


def test_a_folder_that_is_not_a_bag_is_refused(tmp_path: Path) -> None:
    """A clear error, and nothing is written."""
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'noise.mcap').write_bytes(b'no bag at all' * 50)
    for path, error in ((tmp_path / 'empty', BagError), (tmp_path / 'noise.mcap', BagDamaged)):
        with pytest.raises(error):
            repair_bag(path)
    (tmp_path / 'bag').mkdir()
    shutil.copy(tmp_path / 'noise.mcap', tmp_path / 'bag' / 'bag_0.mcap')
    with pytest.raises(BagError, match='inside the bag'):
        repair_bag(tmp_path / 'bag', tmp_path / 'bag' / 'inner')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['bag', 'empty', 'noise.mcap']


def test_an_unreadable_file_of_a_bag_does_not_stop_the_repair(ours: Path) -> None:
    """The others are repaired, and it is reported; in place, it is unchanged."""
    (ours / f'{NAME}_0.mcap').write_bytes(b'no bag at all' * 50)
    tear(ours / f'{NAME}_1.mcap', 5000)
    found = repair_bag(ours)
    assert [bool(each.failed) for each in found.files] == [True, False, False]
    assert found.out is not None
    assert f'{NAME}_0.mcap' not in content(found.out)
    assert count(found.out) == sum(each.messages or 0 for each in found.files)
    repair_bag(ours, in_place=True)
    assert (ours / f'{NAME}_0.mcap').read_bytes() == b'no bag at all' * 50


def test_the_intact_files_of_a_torn_bag_can_be_cut(ours: Path, tmp_path: Path) -> None:
    """`cut` copies them, `verify` names the torn one, and both explain how to repair it."""
    tear(ours / f'{NAME}_1.mcap', 5000)
    found = cut_folder(ours, tmp_path / 'piece', Choice())
    assert list(found.damaged) == [f'{NAME}_1.mcap']
    assert found.messages == 1100
    (ours / 'manifest.json').unlink()
    (check,) = verify_folder(ours).findings
    assert check.name == f'{NAME}_1.mcap'


PROGRAM = """
import sys
from pathlib import Path
from shadowhound_data_logger.bags.repair import repair_bag
print('ready', flush=True)
repair_bag(Path(sys.argv[1]), in_place=True)
"""


@pytest.mark.parametrize(
    'after_s', [0.02, *(pytest.param(0.01 * more, marks=pytest.mark.long('kills')) for more in (0, 10, *range(20, 60, 2)))]
)
def test_a_kill_during_a_repair_in_place_loses_nothing(tmp_path: Path, after_s: float) -> None:
    """Each file is the old or the new one, and the next repair completes the rest."""
    bag = tmp_path / NAME
    write_ours(bag)
    for number in range(3):
        tear(bag / f'{NAME}_{number}.mcap', 5000)
    whole = tmp_path / 'whole'
    shutil.copytree(bag, whole)
    repair_bag(whole, in_place=True)
    before, after = content(bag), content(whole)
    with subprocess.Popen([sys.executable, '-c', PROGRAM, str(bag)], stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        program.stdout.readline()
        try:
            program.wait(after_s)
        except subprocess.TimeoutExpired:
            program.send_signal(signal.SIGKILL)
    for name, found in content(bag).items():
        if name.endswith('.mcap'):
            assert found in {before[name], after[name]}
    repair_bag(bag, in_place=True)
    assert content(bag) == after
    assert not repair_bag(bag).is_damaged
    assert not verify_folder(bag, deep=True).findings


def test_the_report_is_plain_data() -> None:
    """For --json."""
    assert BagRepair(Path('a'), None, ()).is_damaged is False
