"""Descriptions of bags whose sizes are false, whose metadata is too deep, or that contain SQL: an error in little memory."""

from __future__ import annotations

import json
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import pytest
from bags.real_bags import EVER, NAME, T0, messages_of, write_ours, write_rosbags
from mcap.opcode import Opcode
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from shadowhound_data_logger.bags.cut import Choice, cut_folder
from shadowhound_data_logger.bags.description import describe_metadata
from shadowhound_data_logger.bags.info import info_folder
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.format import CHUNK, MAGIC, record, text
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.stores.directory import DirectoryStore

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

LIMIT_BYTES = 2 << 30
HUGE = 3 << 30


def zeros(compression: str) -> bytes:
    """Three gigabytes of zeros, as one frame of some kilobytes or megabytes: blocks that are alike follow each other."""
    if compression == 'zstd':  # RFC 8878: no content size, a window of 1 MB, blocks of one byte that is repeated
        block, last = (struct.pack('<I', 128 << 13 | 1 << 1 | is_last)[:3] + bytes(1) for is_last in (0, 1))
        return bytes.fromhex('28b52ffd0050') + block * (HUGE // (128 << 10) - 1) + last
    with lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB, block_linked=False, auto_flush=True) as press:
        return bytes(press.begin() + press.compress(bytes(4 << 20)) * (HUGE >> 22) + press.flush())


def mcap(chunk: bytes, compression: str, claim: int) -> bytes:
    """A file without an index, and in it a chunk that says that it unpacks to so many bytes."""
    head = CHUNK.pack(T0, T0, claim, 0)
    body = record(Opcode.CHUNK, head, text(compression), struct.pack('<Q', len(chunk)), chunk)
    footer = record(Opcode.FOOTER, struct.pack('<QQI', 0, 0, 0))
    return MAGIC + record(Opcode.HEADER, text('ros2'), text('evil')) + body + record(Opcode.DATA_END, bytes(4)) + footer + MAGIC


@pytest.mark.parametrize('compression', ['zstd', pytest.param('lz4', marks=pytest.mark.long('as for zstd'))])
def test_a_chunk_with_a_false_size_is_damaged(tmp_path: Path, compression: str) -> None:
    """In a tenth of the memory that it would take, whether it says too little or the truth."""
    chunk, claims = zeros(compression), (100, 1 << 20, HUGE, (1 << 63) - 1)
    for claim in claims:
        path = tmp_path / f'{claim}.mcap'
        path.write_bytes(mcap(chunk, compression, claim))
        with pytest.raises(BagDamaged, match='cannot be unpacked'):
            list(messages_of([path]))
    ran = in_2_gb('bag', 'verify', '--deep', str(tmp_path), '--json')
    assert (ran.returncode, 'Traceback' in ran.stderr) == (1, False), ran.stderr
    findings = [check['finding'] for check in json.loads(ran.stdout)['checks']]
    assert [finding for finding in findings if 'cannot be unpacked' in finding] == findings
    assert len(findings) == len(claims)


def in_2_gb(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *arguments]
    return subprocess.run(
        command, env={**os.environ, 'AWS_ENDPOINT_URL': ''}, capture_output=True, text=True, check=False, timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES)),
    )  # fmt: skip


@pytest.mark.long('a second of CPU or more')
def test_a_file_with_one_huge_record_is_not_loaded(tmp_path: Path) -> None:
    """A sparse file of three gigabytes whose only record, or whose summary, is all of it."""
    for name, summary in (('record', 0), ('summary', len(MAGIC))):
        path = tmp_path / name / 'evil.mcap'
        path.parent.mkdir()
        with path.open('wb') as file:
            tail = record(Opcode.FOOTER, struct.pack('<QQI', summary, 0, 0)) + MAGIC
            file.write(MAGIC + struct.pack('<BQ', Opcode.MESSAGE, HUGE - len(MAGIC) - 9 - len(tail)))
            file.seek(HUGE - len(tail))
            file.write(tail)
        ran = in_2_gb('bag', 'verify', '--deep', str(path.parent))
        assert (ran.returncode, 'Traceback' in ran.stderr) == (1, False), ran.stderr


YAML = """rosbag2_bagfile_information:
  version: 8
  storage_identifier: {storage}
  duration: {{nanoseconds: {duration}}}
  starting_time: {{nanoseconds_since_epoch: {start}}}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {{name: {name}, type: a/msg/A, serialization_format: cdr, offered_qos_profiles: {qos}}}
      message_count: 1
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [a.mcap]
"""
LAUGHS = '[&a [x, x], &b [*a, *a], &c [*b, *b], &d [*c, *c], &e [*d, *d]]'
FINE = {'storage': 'mcap', 'duration': '5', 'start': '7', 'name': '/a', 'qos': '""'}


@pytest.mark.parametrize(
    'changed',
    [
        {'name': LAUGHS}, {'qos': LAUGHS}, {'name': '[/a]'}, {'storage': '{a: b}'}, {'start': '1' * 5000}, {'start': '-1'},
        {'start': str(1 << 64)}, {'duration': '1e9'}, {'duration': '1' * 300}, {'name': 60 * '[' + 60 * ']'},
        {'name': 5000 * '['}, {'storage': '!!python/object/apply:os.getcwd []'}, {'start': '2001-01-01'},
    ],
    ids=range(13),
)  # fmt: skip
def test_invalid_metadata_is_damage(changed: dict[str, str]) -> None:
    """Aliases that expand beyond memory, depth, impossible dates, lists in place of strings."""
    assert describe_metadata(YAML.format(**FINE).encode(), 'x').messages == 1
    with pytest.raises(BagDamaged, match='metadata'):
        describe_metadata(YAML.format(**{**FINE, **changed}).encode(), 'x')


def test_invalid_qos_is_ignored() -> None:
    """Only of the topic that has it."""
    for qos in ("'[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[['", f"'{LAUGHS}'", '"' + 70_000 * 'a' + '"', '"- {a: 1"'):
        assert describe_metadata(YAML.format(**{**FINE, 'qos': qos}).encode(), 'x').topics[0].qos == ()


@pytest.mark.parametrize(
    'told', [b'[' * 100_000, b'{"version": ' + b'9' * 5000 + b'}', b'{"a": ' + b'[' * 900 + b']' * 900 + b'}', bytes(17 << 20)],
    ids=range(4),
)  # fmt: skip
def test_an_invalid_manifest_is_damage(told: bytes) -> None:
    with pytest.raises(BagDamaged):
        Manifest.from_json(told)


@pytest.mark.parametrize(
    ('name', 'value'),
    [('state', [[]] * 1000), ('bag', 10**400), ('missing', 7), ('event', {'name': 'x', 'triggers': [], 'pre_s': 10**400})],
)
def test_an_invalid_field_of_a_manifest_is_named(tmp_path: Path, name: str, value: object) -> None:
    """And its value is truncated in the message."""
    write_ours(tmp_path / NAME, slices=1)
    data = json.loads((tmp_path / NAME / 'manifest.json').read_bytes())
    sys.set_int_max_str_digits(0)
    try:
        content = json.dumps({**data, name: value}).encode()
        with pytest.raises(BagDamaged) as caught:
            Manifest.from_json(content)
    finally:
        sys.set_int_max_str_digits(4300)
    assert len(str(caught.value)) < 300


def test_one_bad_bag_does_not_end_the_list(tmp_path: Path) -> None:
    """``bag list`` and its times: the others are shown, the bad ones by name."""
    store = DirectoryStore(tmp_path / 'store')
    root = tmp_path / 'store' / 'sensor-data' / 'thor' / 'rosbags'
    for name, body in (
        ('deep', b'[' * 9999), ('late', YAML.format(**{**FINE, 'start': '9' * 30}).encode()), ('large', bytes(20 << 20)),
        ('fine', YAML.format(**FINE).encode()),
    ):  # fmt: skip
        (root / name).mkdir(parents=True)
        (root / name / 'metadata.yaml').write_bytes(body)
    writer = SliceWriter(root / 'fine' / 'a.mcap')
    writer.write(Channel('/a', 'a/msg/A', '', '', '', ''), 7, 7, 0, b'1234')
    writer.close()
    rows = {row.bag: row for row in bag_overview(store, 'thor', tmp_path / 'home')}
    assert {name: bool(row.finding) for name, row in rows.items()} == {'deep': True, 'late': True, 'large': True, 'fine': False}
    assert rows['fine'].messages == 1


def test_statistics_of_unknown_channels_are_ignored(tmp_path: Path) -> None:
    """Statistics may count unknown channels: the rest is shown."""
    write_ours(tmp_path / NAME, slices=1)
    path = tmp_path / NAME / f'{NAME}_0.mcap'
    body = bytearray(path.read_bytes())
    place = body.index(struct.pack('<IHQ', 20, 1, 500)) + 4
    body[place : place + 2] = struct.pack('<H', 999)
    path.write_bytes(body)
    for name in ('manifest.json', 'metadata.yaml'):
        (path.parent / name).unlink()
    assert {topic.name for topic in info_folder(path.parent).description.topics} == {'/imu', '/camera/blob'}
    source = LocalFile(path)
    assert len(list(read_messages(source, read_index(source), EVER))) == 550


ENDLESS = """ALTER TABLE messages RENAME TO m;
    CREATE VIEW messages AS WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i FROM r)
    SELECT i AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(1000) AS data FROM r"""
COMPUTED = """ALTER TABLE messages RENAME COLUMN data TO old;
    ALTER TABLE messages ADD COLUMN data AS (zeroblob(1000000000))"""
PROGRAMS = {
    'a program for a table': (ENDLESS, 'other tables'),
    'a program for a column': (COMPUTED, 'computes'),
    'a number for content': ('UPDATE messages SET data = 1000000000000', 'no content'),
    'a text for a time': ("UPDATE messages SET timestamp = 'late'", 'cannot be read'),
    'bytes for a name': ("UPDATE topics SET name = X'80'", 'cannot be read'),
    'a number for QoS': ("UPDATE topics SET offered_qos_profiles = X'80'", 'cannot be read'),
}


@pytest.mark.parametrize(('sql', 'says'), PROGRAMS.values(), ids=PROGRAMS)
def test_a_sqlite_bag_runs_no_code(tmp_path: Path, sql: str, says: str) -> None:
    """Computed columns, and values of unexpected types."""
    write_rosbags(tmp_path / 'bag', StoragePlugin.SQLITE3, CompressionMode.NONE, count=20)
    database = sqlite3.connect(tmp_path / 'bag' / 'bag.db3')
    database.executescript(sql)
    database.commit()
    database.close()
    with pytest.raises(BagDamaged, match=says):
        cut_folder(tmp_path / 'bag', tmp_path / 'out', Choice())
    assert not (tmp_path / 'out').exists()
    verify_folder(tmp_path / 'bag', deep=True)


@pytest.mark.parametrize('plugin', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_externally_compressed_messages_are_cut_unchanged(tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode) -> None:
    """Both storages, both kinds of compression."""
    write_rosbags(tmp_path / 'bag', plugin, mode, count=20)
    found = cut_folder(tmp_path / 'bag', tmp_path / 'out', Choice(topics=['/text']))
    assert (found.messages, found.topics) == (10, 1)


def test_a_file_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path: Path) -> None:
    """Unpacking stops at a thousand times its size, and leaves no file."""
    write_rosbags(tmp_path / 'bag', StoragePlugin.SQLITE3, CompressionMode.FILE, count=20)
    path = next((tmp_path / 'bag').glob('*.zstd'))
    path.write_bytes(zeros('zstd'))
    with pytest.raises(BagDamaged, match='unpacks to more than'):
        cut_folder(tmp_path / 'bag', tmp_path / 'out', Choice())
    assert sorted(each.name for each in tmp_path.iterdir()) == ['bag']


def test_crcs_still_count(tmp_path: Path) -> None:
    """A chunk with the correct size and different content."""
    chunk = record(Opcode.MESSAGE, bytes(30))
    path = tmp_path / 'a.mcap'
    right, wrong = (CHUNK.pack(T0, T0, len(chunk), crc) for crc in (0, zlib.crc32(b'other')))
    path.write_bytes(mcap(zstd.compress(chunk), 'zstd', len(chunk)).replace(right, wrong))
    with pytest.raises(BagDamaged, match='CRC-32'):
        list(messages_of([path]))
