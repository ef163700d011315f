"""Bags of other recorders in MCAP and SQLite: their files count, and data that is not decoded is copied verbatim."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import zstandard
from bags.real_bags import T0
from bags.reference import BARE, CDR, INT, STRING, S, metadata_yaml, read, ten, topics, write
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from shadowhound_data_logger.bags.cut import Choice, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.naming import safe_bag
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.remote import find_bag, read_manifest
from shadowhound_data_logger.bags.upload import plan_upload, upload_now
from shadowhound_data_logger.bags.upload_plan import read_finished
from shadowhound_data_logger.bags.verify import verify_folder, verify_remote
from shadowhound_data_logger.cli.bag import bag
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.formats.mcap.index import read_index, read_summary
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.stores.directory import DirectoryStore


@pytest.mark.parametrize('options', [
    BARE, {**BARE, 'use_chunking': False}, {'use_statistics': False}, {'repeat_channels': False, 'repeat_schemas': False},
    {'repeat_schemas': False}, {'use_chunking': False}, {'use_chunking': False, 'use_statistics': False},
    {'index_types': IndexType.ALL & ~IndexType.MESSAGE}, {'index_types': IndexType.MESSAGE}, {'enable_crcs': False},
    {'compression': CompressionType.LZ4, 'chunk_size': 60},
], ids=lambda options: ' '.join(options) or 'all')  # fmt: skip
def test_every_part_of_a_summary_is_optional(tmp_path: Path, options: dict[str, Any]) -> None:
    """Missing parts are replaced by counting, by channel."""
    folder = write(tmp_path / 'b' / 'b_0.mcap', ten, **options)
    found = info_folder(folder).description
    assert (found.messages, found.t_start_ns, found.t_end_ns) == (10, T0, T0 + 9 * S)
    assert topics(folder) == {('/chat', STRING[0]): 5, ('/talk', STRING[0]): 5}
    assert verify_folder(folder, deep=True).is_intact
    cut = cut_folder(folder, tmp_path / 'piece', Choice('2', '7', topics=('/chat',)))
    assert cut.messages == 3
    assert [one[4] for one in read(tmp_path / 'piece' / 'piece_0.mcap')] == [T0 + n * S for n in (2, 4, 6)]


def test_a_complete_summary_is_enough(tmp_path: Path) -> None:
    """Then nothing else of the file is read; without one ``read_summary`` returns None."""
    folder = write(tmp_path / 'b' / 'b_0.mcap', ten)
    assert read_summary(LocalFile(folder / 'b_0.mcap')) == read_index(LocalFile(folder / 'b_0.mcap'))
    folder = write(tmp_path / 'c' / 'c_0.mcap', ten, **BARE)
    assert read_summary(LocalFile(folder / 'c_0.mcap')) is None


ENCODINGS = {
    'ros1': ('ros1', ('std_msgs/String', 'ros1msg', b'string data\n'), b'\1\0\0\0a', {'callerid': '/talker', 'latching': '1'}),
    'json': ('json', ('Chat', 'jsonschema', b'{"type": "object"}'), b'{"a": 1}', {}),
    'protobuf': ('protobuf', ('demo.Image', 'protobuf', bytes([10, 200, 1, 10, 255, 254, 0])), b'\x08\x01\xff', {'k': 'v\n'}),
    'cdr idl': (
        'cdr',
        ('a/msg/B', 'ros2idl', 'module ä {};'.encode()),
        CDR,
        {'offered_qos_profiles': '', 'topic_type_hash': 'RIHS01_0'},
    ),
    'text': ('text', None, b'\xff\xfe', {}),
}


@pytest.mark.parametrize('name', ENCODINGS)
@pytest.mark.parametrize('is_chunked', [True, False])
def test_undecoded_messages_are_copied_verbatim(tmp_path: Path, name: str, is_chunked: bool) -> None:
    """Encoding, schema and its bytes, the channel's metadata, both times, the sequence number, the profile."""
    encoding, schema, data, metadata = ENCODINGS[name]

    def fill(writer: Writer) -> None:
        number = writer.register_schema(*schema) if schema is not None else 0
        channel = writer.register_channel('/x', encoding, number, metadata)
        writer.add_message(channel, T0, data, 0, 7)
        writer.add_message(channel, T0 + 1, data * 2, T0 - 1, 1)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill, profile=name, use_chunking=is_chunked)
    cut_folder(folder, tmp_path / 'piece', Choice())
    piece = tmp_path / 'piece' / 'piece_0.mcap'
    assert read(piece) == read(folder / 'b_0.mcap')
    with piece.open('rb') as file:
        assert make_reader(file).get_header().profile == name
    cut_folder(tmp_path / 'piece', tmp_path / 'again', Choice())
    assert (tmp_path / 'again' / 'again_0.mcap').read_bytes() == piece.read_bytes().replace(b'piece_0', b'again_0')


def test_channels_are_counted_not_topics(tmp_path: Path) -> None:
    """Two channels of one topic, of one type or of two, and with different QoS: also in a cut of the bag."""

    def fill(writer: Writer) -> None:
        qos = [{'offered_qos_profiles': f'- history: {n}\n  depth: 1', 'topic_type_hash': ''} for n in (1, 2)]
        strings = [writer.register_channel('/tf', 'cdr', writer.register_schema(*STRING), each) for each in qos]
        number = writer.register_channel('/tf', 'cdr', writer.register_schema(*INT))
        for n in range(11):
            writer.add_message(number if n == 0 else strings[n % 2], T0 + n, CDR, T0 + n)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill)
    cut_folder(folder, tmp_path / 'piece', Choice())
    for each in (folder, tmp_path / 'piece'):
        assert topics(each) == {('/tf', INT[0]): 1, ('/tf', STRING[0]): 10}
        (text,) = (topic for topic in info_folder(each).description.topics if topic.type == STRING[0])
        assert {profile['history'] for profile in text.qos} == {1, 2}
    assert len({str(one[2]) for one in read(tmp_path / 'piece' / 'piece_0.mcap') if one[3][0] == STRING[0]}) == 2  # type: ignore[index]


@pytest.mark.parametrize('start', [T0, T0 + 20 * S], ids=['Humble', 'Galactic'])
def test_the_files_count_not_the_totals_of_a_split_bag(tmp_path: Path, start: int) -> None:
    """Humble records start and duration of the first file, Galactic of the last: info, cut and verify report it once."""
    folder = tmp_path / 'b'
    for part in range(3):

        def fill(writer: Writer, part: int = part) -> None:
            channel = writer.register_channel('/chat', 'cdr', writer.register_schema(*STRING))
            for n in range(10):
                writer.add_message(channel, T0 + (10 * part + n) * S, CDR, 0)

        write(folder / f'b_{part}.mcap', fill)
    topic = {'topic_metadata': {'name': '/chat', 'type': STRING[0], 'serialization_format': 'cdr'}, 'message_count': 30}
    metadata_yaml(folder, starting_time={'nanoseconds_since_epoch': start}, message_count=30, topics_with_message_count=[topic])
    found = info_folder(folder).description
    assert (found.messages, found.t_start_ns, found.t_end_ns) == (30, T0, T0 + 29 * S)
    cut = cut_folder(folder, tmp_path / 'piece', Choice())
    assert (cut.messages, cut.t_start_ns, cut.t_end_ns) == (30, T0, T0 + 29 * S)
    assert cut_folder(folder, tmp_path / 'later', Choice('12', '13')).messages == 1
    (remark,) = cut.remarks
    assert remark.startswith('metadata.yaml claims the time 2025-10-18T12:00:')
    assert found.remarks == verify_folder(folder).remarks == cut.remarks
    store = DirectoryStore(tmp_path / 'store')
    with plan_upload(folder, 'thor', 'b', tmp_path / 'home', is_archive=False) as sent:
        upload_now(store, sent, deadline_s=60)
    described = info_of(store, 'thor', 'b', tmp_path / 'home').description
    assert (described.messages, described.t_start_ns, described.t_end_ns, described.remarks) == (30, T0, T0 + 29 * S, cut.remarks)
    assert cut_remote(store, find_bag(store, 'thor', 'b'), tmp_path / 'remote', Choice()).messages == 30
    for verb in (['info'], ['verify'], ['cut', '--to', str(tmp_path / 'cli')]):
        ran = CliRunner().invoke(bag, [*verb, f'{folder}/'], standalone_mode=False)
        assert ran.return_value == 0, ran.output
        assert ran.output.count('metadata.yaml claims') == 1


def test_a_name_that_cannot_be_part_of_a_key_is_replaced(tmp_path: Path) -> None:
    """A bag in a folder with spaces, its files, and notes next to them: stored under the nearest names, and complete."""
    folder = write(tmp_path / '-my bäg' / 'my bäg_0.mcap', ten)
    (folder / 'my_b_g_0.mcap').write_bytes((folder / 'my bäg_0.mcap').read_bytes())
    (folder / 'field notes.txt').write_text('wet floor')
    (folder / ('long ' * 45)).write_text('')
    metadata_yaml(folder, relative_file_paths=['my_b_g_0.mcap', 'my bäg_0.mcap'], message_count=20, version=4, files=None)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    store = DirectoryStore(tmp_path / 'store')
    with plan_upload(folder, 'thor', safe_bag(folder.name), tmp_path / 'home', is_archive=False) as sent:
        assert sent.bag == 'my_b_g'
        assert sent.renamed['field notes.txt'] == 'field_notes.txt'
        assert sent.renamed['my bäg_0.mcap'] == 'my_b_g_0_1.mcap'
        upload_now(store, sent, deadline_s=60)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert verify_remote(store, find_bag(store, 'thor', 'my_b_g'), deep=True).is_intact
    found = fetch(store, find_bag(store, 'thor', 'my_b_g'), tmp_path / 'fetched')
    assert found.is_complete
    described = info_folder(found.folder).description
    assert (described.messages, described.absent, [part.name for part in described.parts]) == (
        20, (), ['my_b_g_0.mcap', 'my_b_g_0_1.mcap'],
    )  # fmt: skip


@pytest.mark.parametrize('name', ['a bag', '-x', 'ä', '..', '.hidden', 'x..y', '_', 'x' * 300])
def test_every_folder_has_a_name_in_the_store(name: str) -> None:
    """Also one whose name has no valid character."""
    assert check_name(safe_bag(name), 'the bag', MAX_BAG_BYTES)


def test_a_torn_file_of_a_split_bag_hides_no_other_file(tmp_path: Path) -> None:
    """The others are shown, cut, verified and uploaded, and each command reports the truncated one, which is stored unchanged."""
    for part in range(3):
        write(tmp_path / 'b' / f'b_{part}.mcap', ten)
    folder = tmp_path / 'b'
    metadata_yaml(folder, message_count=30)
    (folder / 'b_1.mcap').write_bytes((folder / 'b_1.mcap').read_bytes()[:-20])
    described = info_folder(folder).description
    assert (described.messages, list(described.damaged), described.remarks) == (20, ['b_1.mcap'], ())
    cut = cut_folder(folder, tmp_path / 'piece', Choice())
    assert (cut.messages, list(cut.damaged)) == (20, ['b_1.mcap'])
    assert [check.name for check in verify_folder(folder, deep=True).findings] == ['b_1.mcap']
    store = DirectoryStore(tmp_path / 'store')
    with plan_upload(folder, 'thor', 'b', tmp_path / 'home', is_archive=False) as sent:
        assert list(sent.damaged) == ['b_1.mcap']
        upload_now(store, sent, deadline_s=60)
    remote = find_bag(store, 'thor', 'b')
    manifest = read_manifest(store, remote)
    assert manifest is not None
    assert (manifest.state, [each.file for each in manifest.slices], [each.file for each in manifest.missing]) == (
        'gaps', ['b_0.mcap', 'b_2.mcap'], ['b_1.mcap'],
    )  # fmt: skip
    assert [check.name for check in verify_remote(store, remote).findings] == ['b_1.mcap']
    assert cut_remote(store, remote, tmp_path / 'remote', Choice()).messages == 20
    for verb in (['info'], ['verify'], ['cut', '--to', str(tmp_path / 'cli')]):
        ran = CliRunner().invoke(bag, [*verb, f'{folder}/'], standalone_mode=False)
        assert (ran.return_value, 'b_1.mcap' in ran.output) == (1, True)
        assert ' '.join(ran.output.split()).count('b_1.mcap is truncated: the end of the MCAP file is missing') == 1


def test_a_message_at_time_0_is_counted_although_the_statistics_lack_it(tmp_path: Path) -> None:
    """The Go library writes such files for a bag with simulated time: its chunks have it."""

    def fill(writer: Writer) -> None:
        channel = writer.register_channel('/clock', 'cdr', writer.register_schema(*STRING))
        for n in range(3):
            writer.add_message(channel, n, CDR, n)

    for options in ({}, {'use_chunking': False}):
        folder = write(tmp_path / f'b{len(options)}' / 'b_0.mcap', fill, enable_crcs=False, **options)
        content = (folder / 'b_0.mcap').read_bytes()
        statistics = b'\0' * 8 + (2).to_bytes(8, 'little')
        assert content.count(statistics + b'\x0a\0\0\0\1\0') == 1
        content = content.replace(statistics + b'\x0a\0\0\0\1\0', (1).to_bytes(8, 'little') + statistics[8:] + b'\x0a\0\0\0\1\0')
        (folder / 'b_0.mcap').write_bytes(content)
        cut_folder(folder, tmp_path / f'piece{len(options)}', Choice())
        assert [one[4] for one in read(tmp_path / f'piece{len(options)}' / f'piece{len(options)}_0.mcap')] == [0, 1, 2]
    assert info_folder(tmp_path / 'b0').description.t_start_ns == 0
    assert verify_folder(tmp_path / 'b0', deep=True).is_intact


def test_times_use_all_64_bits(tmp_path: Path) -> None:
    """Near 0 and near 2^64: through a cut, a cut of that, an upload and a fetch; info shows them."""
    times = [0, 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]

    def fill(writer: Writer) -> None:
        channel = writer.register_channel('/x', 'cdr', writer.register_schema(*STRING))
        for n in times:
            writer.add_message(channel, n, CDR, (1 << 64) - 1 - n)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill)
    cut_folder(folder, tmp_path / 'piece', Choice())
    cut_folder(tmp_path / 'piece', tmp_path / 'again', Choice())
    assert read(tmp_path / 'again' / 'again_0.mcap') == read(folder / 'b_0.mcap')
    store = DirectoryStore(tmp_path / 'store')
    with plan_upload(tmp_path / 'again', 'thor', 'b', tmp_path / 'home', is_archive=False) as sent:
        upload_now(store, sent, deadline_s=60)
    fetched = fetch(store, find_bag(store, 'thor', 'b'), tmp_path / 'fetched').folder
    for found in (info_of(store, 'thor', 'b', tmp_path / 'home'), info_folder(fetched)):
        assert (found.description.t_start_ns, found.description.t_end_ns) == (0, (1 << 64) - 1)
    ran = CliRunner().invoke(bag, ['info', f'{fetched}/'], standalone_mode=False)
    assert '2554-07-21 23:34:33.709' in ran.output


def test_a_list_downloads_no_bag(tmp_path: Path) -> None:
    """Of a bag without a manifest whose summary is not enough, it shows what metadata.yaml claims; info counts."""
    root = tmp_path / 'store' / 'sensor-data' / 'thor' / 'rosbags'
    for name, options in (('whole', {}), ('bare', BARE)):
        metadata_yaml(write(root / name / f'{name}_0.mcap', ten, **options), message_count=7)
    store = DirectoryStore(tmp_path / 'store')
    rows = {row.bag: row for row in bag_overview(store, 'thor', tmp_path / 'home')}
    assert (rows['whole'].messages, rows['whole'].remark.startswith('metadata.yaml claims 7 messages')) == (10, True)
    assert (rows['bare'].messages, rows['bare'].remark) == (7, '')
    assert info_of(store, 'thor', 'bare', tmp_path / 'home').description.messages == 10
    assert verify_remote(store, find_bag(store, 'thor', 'bare')).is_intact


def test_a_growing_bag_with_a_torn_file_is_fetched(tmp_path: Path) -> None:
    """Its metadata.yaml is generated from the readable files."""
    store = DirectoryStore(tmp_path / 'store')
    for part in range(2):
        write(tmp_path / 'store' / 'sensor-data' / 'thor' / 'rosbags' / 'b' / f'b_{part}.mcap', ten)
    torn = tmp_path / 'store' / 'sensor-data' / 'thor' / 'rosbags' / 'b' / 'b_1.mcap'
    torn.write_bytes(torn.read_bytes()[:-9])
    fetched = fetch(store, find_bag(store, 'thor', 'b'), tmp_path / 'here').folder
    found = info_folder(fetched).description
    assert (found.messages, list(found.damaged)) == (10, ['b_1.mcap'])
    assert 'b_1' not in (fetched / 'metadata.yaml').read_text()


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
    """The fields of each version of the format."""
    fields: dict[str, Any] = {
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
    fields |= {'compression_format': '', 'compression_mode': ''} if version >= 3 else {}
    fields |= {'custom_data': None} if version >= 6 else {}
    fields |= {'ros_distro': 'jazzy'} if version >= 8 else {}
    if version >= 5:
        fields['files'] = [
            {'path': name, 'starting_time': {'nanoseconds_since_epoch': T0}, 'duration': {'nanoseconds': 8 * 10**9},
             'message_count': len(MESSAGES)} for name in files
        ]  # fmt: skip
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': {**fields, **changed}}))


def check(folder: Path, out: Path) -> None:
    """Counts and times from the files, and a cut with every message."""
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
def test_every_version_of_rosbag2_is_read(tmp_path: Path, version: int, described: int) -> None:
    """Of the tables, and of metadata.yaml: also without one (0)."""
    folder = storage(tmp_path / 'b' / 'b_0.db3', version).parent
    if described:
        metadata(folder, ['b_0.db3'], described)
    check(folder, tmp_path / 'piece')


@pytest.mark.parametrize('mode', ['file', 'FILE', 'message'])
@pytest.mark.parametrize('is_described', [True, False])
def test_files_and_messages_compressed_by_rosbag2_are_read(tmp_path: Path, mode: str, is_described: bool) -> None:
    """Files by their name, messages by their first bytes: no CDR starts like zstd."""
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
def test_every_form_of_path_in_the_metadata_is_resolved(tmp_path: Path, name: str) -> None:
    """With the bag's folder in front (Foxy), absolute, or in the bag's folder if that has the file."""
    folder = tmp_path / 'b'
    storage(folder / name if name.startswith('part') else folder / 'b_0.db3', FOXY)
    metadata(folder, [name], 3)
    check(folder, tmp_path / 'piece')


def test_a_split_bag_has_the_totals_of_its_files(tmp_path: Path) -> None:
    """Totals of the first or the last file alone are ignored: in a folder, in the list of a store, in the manifest."""
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


def test_a_store_lists_sqlite_bags_without_reading_them(tmp_path: Path) -> None:
    """Without a manifest, info shows the claims of metadata.yaml, and marks them as such."""
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


def test_messages_without_a_topic_are_damage(tmp_path: Path) -> None:
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
def test_a_database_that_was_not_closed_is_read(tmp_path: Path, suffix: str) -> None:
    """With messages in its write-ahead log: they are included."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE)
    (path.parent / f'b_0.db3{suffix}').write_bytes(bytes(32))
    assert info_folder(path.parent).description.messages == 9
    (path.parent / f'b_0.db3{suffix}').write_bytes(bytes(4096))
    for attempt in (lambda: info_folder(path.parent), lambda: cut_folder(path.parent, tmp_path / 'piece', Choice())):
        with pytest.raises(BagDamaged, match='was not closed'):
            attempt()
    assert not verify_folder(path.parent).is_intact


@pytest.mark.parametrize('named', ['b_0.db3', 'b_0.db3.zstd', ''])
def test_a_file_that_is_also_there_packed_is_read_once(tmp_path: Path, named: str) -> None:
    """With and without compression, after a crash of the recorder: its messages count once."""
    path = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE)
    path.with_name('b_0.db3.zstd').write_bytes(zstandard.compress(path.read_bytes()))
    if named:
        metadata(path.parent, [named], 5)
    check(path.parent, tmp_path / 'piece')


@pytest.mark.parametrize('field', [
    'version', 'storage_identifier', 'relative_file_paths', 'message_count', 'duration', 'starting_time',
    'topics_with_message_count', 'files',
])  # fmt: skip
def test_a_missing_field_of_the_metadata_is_named(tmp_path: Path, field: str) -> None:
    """It is read from the files; a number that would be wrong without it is reported."""
    folder = storage(tmp_path / 'b' / 'b_0.db3', HUMBLE).parent
    metadata(folder, ['b_0.db3'], 5)
    data = json.loads((folder / 'metadata.yaml').read_text())
    del data['rosbag2_bagfile_information'][field]
    (folder / 'metadata.yaml').write_text(json.dumps(data))
    found = info_folder(folder).description
    assert (found.messages, found.t_start_ns, found.t_end_ns, found.storage) == (9, T0, T0 + 8 * 10**9, 'sqlite3')
    assert bool(found.remarks) == (field not in {'version', 'storage_identifier', 'files'})
    assert cut_folder(folder, tmp_path / 'piece', Choice()).messages == 9


def test_metadata_without_files_is_not_a_bag(tmp_path: Path) -> None:
    """It cannot be uploaded."""
    (tmp_path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    with pytest.raises(BagError, match='is not a bag'):
        read_finished(tmp_path)
