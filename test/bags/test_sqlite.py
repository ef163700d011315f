"""SQLite bags of every version of rosbag2, as its own storage makes the tables, and every version of metadata.yaml."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import zstandard
from bags.real_bags import T0
from bags.reference import CDR, read

from shadowhound_data_logger.bags.cut import Choice, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.remote import find_bag, read_manifest
from shadowhound_data_logger.bags.upload import plan_upload, upload_now
from shadowhound_data_logger.bags.upload_plan import read_finished
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.stores.directory import DirectoryStore

QOS = '- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2'
TOPICS = (
    (1, '/chat', 'std_msgs/msg/String', 'cdr', QOS, 'RIHS01_0'), (2, 'count', 'std_msgs/msg/Int32', 'cdr', '', ''),
    (3, '/mine', 'mine_msgs/msg/Mine', 'cdr', '', ''), (4, '/silent', 'std_msgs/msg/String', 'cdr', '', ''),
)  # fmt: skip
DEFINED = {'std_msgs/msg/String': ('ros2msg', 'string data\n'), 'mine_msgs/msg/Mine': ('unknown', '')}
"""rosbag2 writes an encoding of this name where it finds no definition."""
MESSAGES = tuple((1 + n % 3, T0 + n * 10**9, CDR + bytes([n])) for n in range(9))
FOXY, HUMBLE, IRON = range(3)


def storage(path: Path, version: int, messages: Sequence[tuple[int, int, bytes]] = MESSAGES, *, packs: bool = False) -> Path:
    """The tables of Foxy and older, of Humble, or of Iron and newer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ('id', 'name', 'type', 'serialization_format', 'offered_qos_profiles', 'type_description_hash')
    columns = names[: (4, 5, 6)[version]]
    database = sqlite3.connect(path)
    database.execute(f'CREATE TABLE topics({", ".join(columns)}, PRIMARY KEY(id))')
    database.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)')
    database.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
    if version >= HUMBLE:
        database.execute('CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)')
        database.execute('CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)')
        database.execute('INSERT INTO schema VALUES (?, ?)', (3 if version == HUMBLE else 4, 'humble'))
    if version >= IRON:
        database.execute('CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, '
                         'encoded_message_definition TEXT, type_description_hash TEXT)')  # fmt: skip
        defined = [(kind, *definition) for kind, definition in DEFINED.items()]
        database.executemany("INSERT INTO message_definitions VALUES (NULL, ?, ?, ?, '')", defined)
    marks = ', '.join('?' * len(columns))
    database.executemany(f'INSERT INTO topics VALUES ({marks})', [topic[: len(columns)] for topic in TOPICS])  # noqa: S608
    rows = [(number, at, zstandard.compress(data) if packs else data) for number, at, data in messages]
    database.executemany('INSERT INTO messages VALUES (NULL, ?, ?, ?)', rows)
    database.commit()
    database.close()
    return path


def metadata(folder: Path, files: Sequence[str], version: int, **changed: Any) -> None:
    """What each version of the format has."""
    told: dict[str, Any] = {
        'version': version, 'storage_identifier': 'sqlite3', 'relative_file_paths': list(files), 'message_count': len(MESSAGES),
        'duration': {'nanoseconds': 8 * 10**9}, 'starting_time': {'nanoseconds_since_epoch': T0},
        'topics_with_message_count': [
            {'topic_metadata': {'name': name, 'type': kind, 'serialization_format': encoding,
                                **({'offered_qos_profiles': qos if version < 9 else []} if version >= 4 else {}),
                                **({'type_description_hash': type_hash} if version >= 7 else {})},
             'message_count': sum(each[0] == number for each in MESSAGES)}
            for number, name, kind, encoding, qos, type_hash in TOPICS
        ],
    }  # fmt: skip
    told |= {'compression_format': '', 'compression_mode': ''} if version >= 3 else {}
    told |= {'custom_data': None} if version >= 6 else {}
    told |= {'ros_distro': 'jazzy'} if version >= 8 else {}
    if version >= 5:
        told['files'] = [
            {'path': name, 'starting_time': {'nanoseconds_since_epoch': T0}, 'duration': {'nanoseconds': 8 * 10**9},
             'message_count': len(MESSAGES)} for name in files
        ]  # fmt: skip
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': {**told, **changed}}))


def check(folder: Path, out: Path) -> None:
    """Counts and times by the files, and a cut with every message."""
    found = info_folder(folder).description
    assert (found.messages, found.t_start_ns, found.t_end_ns) == (9, T0, T0 + 8 * 10**9)
    assert {topic.name: topic.messages for topic in found.topics} == {'/chat': 3, 'count': 3, '/mine': 3, '/silent': 0}
    assert not found.remarks
    assert verify_folder(folder, deep=True).is_intact
    cut_folder(folder, out, Choice())
    names = {number: (name, kind) for number, name, kind, *_ in TOPICS}
    piece = read(out / f'{out.name}_0.mcap')
    assert [(one[0], one[3][0], one[4], one[5], one[7]) for one in piece] == [  # type: ignore[index]
        (*names[number], at, at, data) for number, at, data in MESSAGES
    ]
    (schema,) = {one[3] for one in piece if one[0] == '/chat'}
    assert isinstance(schema, tuple)
    assert (schema[1], schema[2].endswith(b'string data\n')) == ('ros2msg', True)


@pytest.mark.parametrize('version', [FOXY, HUMBLE, IRON])
@pytest.mark.parametrize('described', [0, *range(1, 10)])
def test_every_version(tmp_path: Path, version: int, described: int) -> None:
    """Of the tables, and of metadata.yaml: also without one (0)."""
    folder = storage(tmp_path / 'b' / 'b_0.db3', version).parent
    if described:
        metadata(folder, ['b_0.db3'], described)
    check(folder, tmp_path / 'piece')


@pytest.mark.parametrize('mode', ['file', 'FILE', 'message'])
@pytest.mark.parametrize('is_described', [True, False])
def test_compressed_outside_the_storage(tmp_path: Path, mode: str, is_described: bool) -> None:
    """Files by their name, messages by how they begin: no CDR begins as zstd does."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE, packs=mode == 'message')
    if mode.lower() == 'file':
        packed = path.with_name('b_0.db3.zstd')
        packed.write_bytes(zstandard.compress(path.read_bytes()))
        path.unlink()
        path = packed
    if is_described:
        metadata(path.parent, [path.name], 5, compression_format='zstd', compression_mode=mode)
    check(path.parent, tmp_path / 'piece')


@pytest.mark.parametrize('name', ['b/b_0.db3', '/home/robot/bags/b/b_0.db3', './b_0.db3', 'part/b_0.db3'])
def test_paths_in_the_metadata(tmp_path: Path, name: str) -> None:
    """With the folder of the bag in front (Foxy), absolute, or of a folder in it where that has the file."""
    folder = tmp_path / 'b'
    storage(folder / name if name.startswith('part') else folder / 'b_0.db3', FOXY)
    metadata(folder, [name], 3)
    check(folder, tmp_path / 'piece')


def test_a_split_bag_by_its_files(tmp_path: Path) -> None:
    """Totals of the first or the last file alone are not believed: in a folder, in the list of a store, in the manifest."""
    folder = tmp_path / 'b'
    for part in range(3):
        storage(folder / f'b_{part}.db3', FOXY, MESSAGES[3 * part : 3 * part + 3])
    metadata(folder, [f'b_{part}.db3' for part in range(3)], 4, duration={'nanoseconds': 2 * 10**9})
    assert cut_folder(folder, tmp_path / 'piece', Choice()).messages == 9
    store = DirectoryStore(tmp_path / 'store')
    with plan_upload(folder, 'thor', 'b', tmp_path / 'home', is_archive=False) as sent:
        (remark,) = sent.remarks
        assert remark.startswith('metadata.yaml claims the time')
        upload_now(store, sent, deadline_s=60)
    remote = find_bag(store, 'thor', 'b')
    manifest = read_manifest(store, remote)
    assert manifest is not None
    assert [(each.messages, each.t_start_ns, dict(each.counts)) for each in manifest.slices] == [
        (3, T0 + 3 * part * 10**9, {'/chat': 1, 'count': 1, '/mine': 1, '/silent': 0}) for part in range(3)
    ]
    described = info_of(store, 'thor', 'b', tmp_path / 'home').description
    assert (described.messages, described.t_end_ns, described.remarks) == (9, T0 + 8 * 10**9, (remark,))
    (row,) = bag_overview(store, 'thor', tmp_path / 'home')
    assert (row.messages, row.t_start_ns, row.t_end_ns) == (9, T0, T0 + 8 * 10**9)
    assert cut_remote(store, remote, tmp_path / 'remote', Choice('2', '7')).messages == 5
    check_fetched = info_folder(fetch(store, remote, tmp_path / 'fetched').folder).description
    assert check_fetched.t_end_ns == T0 + 8 * 10**9


def test_a_store_does_not_read_them(tmp_path: Path) -> None:
    """Without a manifest, info shows what metadata.yaml claims, and says so."""
    folder = storage(tmp_path / 'store' / 'sensor-data' / 'thor' / 'rosbags' / 'b' / 'b_0.db3', HUMBLE).parent
    metadata(folder, ['b_0.db3'], 5, message_count=7)
    found = info_of(DirectoryStore(tmp_path / 'store'), 'thor', 'b', tmp_path / 'home').description
    assert (found.messages, found.remarks[0].startswith('these figures are from metadata.yaml alone')) == (7, True)


def test_other_encodings_keep_their_name(tmp_path: Path) -> None:
    """Nothing is relabeled as CDR."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE)
    database = sqlite3.connect(path)
    database.execute("UPDATE topics SET serialization_format = 'ros1' WHERE name = '/chat'")
    database.commit()
    database.close()
    cut_folder(path, tmp_path / 'piece', Choice())
    assert {one[0]: one[1] for one in read(tmp_path / 'piece' / 'piece_0.mcap')} == {
        '/chat': 'ros1', 'count': 'cdr', '/mine': 'cdr'
    }  # fmt: skip


def test_messages_of_no_topic(tmp_path: Path) -> None:
    """They are damage, as is a file with an invalid page; no messages are an error only for a cut."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE, [*MESSAGES, (99, T0, CDR)])
    with pytest.raises(BagDamaged, match='topic 99'):
        info_folder(path.parent)
    path = storage(tmp_path / 'c' / 'c_0.db3', HUMBLE, [*MESSAGES, *((1, T0, bytes(9000)) for _ in range(9))])
    content = bytearray(path.read_bytes())
    content[-40_000:-30_000] = bytes(range(250)) * 40
    path.write_bytes(content)
    assert not verify_folder(path.parent).is_intact
    path = storage(tmp_path / 'd' / 'd_0.db3', HUMBLE, [])
    assert info_folder(path.parent).description.messages == 0
    with pytest.raises(BagError, match='no messages'):
        cut_folder(path.parent, tmp_path / 'none', Choice())


@pytest.mark.parametrize('suffix', ['-wal', '-journal'])
def test_a_file_that_was_not_closed(tmp_path: Path, suffix: str) -> None:
    """Has messages in another file: it is not read as if these were not there."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE)
    (path.parent / f'b_0.db3{suffix}').write_bytes(bytes(32))
    assert info_folder(path.parent).description.messages == 9
    (path.parent / f'b_0.db3{suffix}').write_bytes(bytes(4096))
    for attempt in (lambda: info_folder(path.parent), lambda: cut_folder(path.parent, tmp_path / 'piece', Choice())):
        with pytest.raises(BagDamaged, match='was not closed'):
            attempt()
    assert not verify_folder(path.parent).is_intact


@pytest.mark.parametrize('named', ['b_0.db3', 'b_0.db3.zstd', ''])
def test_a_file_that_is_there_twice(tmp_path: Path, named: str) -> None:
    """Packed and not, after a crash of the recorder: its messages are not."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE)
    path.with_name('b_0.db3.zstd').write_bytes(zstandard.compress(path.read_bytes()))
    if named:
        metadata(path.parent, [named], 5)
    check(path.parent, tmp_path / 'piece')


@pytest.mark.parametrize('field', [
    'version', 'storage_identifier', 'relative_file_paths', 'message_count', 'duration', 'starting_time',
    'topics_with_message_count', 'files',
])  # fmt: skip
def test_a_field_that_metadata_lacks(tmp_path: Path, field: str) -> None:
    """Is read from the files; a number that would be wrong without it is reported."""
    folder = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE).parent
    metadata(folder, ['b_0.db3'], 5)
    told = json.loads((folder / 'metadata.yaml').read_text())
    del told['rosbag2_bagfile_information'][field]
    (folder / 'metadata.yaml').write_text(json.dumps(told))
    found = info_folder(folder).description
    assert (found.messages, found.t_start_ns, found.t_end_ns, found.storage) == (9, T0, T0 + 8 * 10**9, 'sqlite3')
    assert bool(found.remarks) == (field not in {'version', 'storage_identifier', 'files'})
    assert cut_folder(folder, tmp_path / 'piece', Choice()).messages == 9


def test_metadata_of_nothing(tmp_path: Path) -> None:
    """Is no bag that could be uploaded."""
    (tmp_path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    with pytest.raises(BagError, match='is not a bag'):
        read_finished(tmp_path)
