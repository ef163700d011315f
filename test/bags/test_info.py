"""Every variant of MCAP files, of the conformance tests and assembled by hand, through info, cut, verify, upload and fetch."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import pytest
import zstandard
from bags.conformance import DATA, Recorded, variants
from bags.reference import CDR, STRING, metadata_yaml, read, topics, write
from click.testing import CliRunner
from lz4.frame import compress as lz4_compress
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, Message, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC, Writer

from shadowhound_data_logger.bags.cut import Choice, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.naming import natural_key
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.remote import find_bag, read_manifest
from shadowhound_data_logger.bags.upload import plan_upload, upload_now
from shadowhound_data_logger.bags.verify import verify_folder, verify_remote
from shadowhound_data_logger.cli.bag import bag
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.stores.directory import DirectoryStore

FOUND = tuple(sorted(variants(), key=lambda each: natural_key(f'{each[0]}.mcap')))
FILLED = [each for each in FOUND if each[1].messages]
BAG = 'conformance'


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All variants as the files of one bag."""
    made = tmp_path_factory.mktemp('bags') / BAG
    made.mkdir()
    for name, _, content in FOUND:
        (made / f'{name}.mcap').write_bytes(content)
    topics = [
        {'topic_metadata': {'name': 'example', 'type': kind, 'serialization_format': encoding, 'offered_qos_profiles': ''},
         'message_count': sum(len(recorded.messages) for _, recorded, _ in FOUND if bool(recorded.schema) == bool(kind))}
        for kind, encoding in (('Example', 'a'), ('', 'text'))
    ]  # fmt: skip
    metadata_yaml(
        made, starting_time={'nanoseconds_since_epoch': 0}, duration={'nanoseconds': 9},
        message_count=sum(len(recorded.messages) for _, recorded, _ in FOUND), topics_with_message_count=topics,
        relative_file_paths=[f'{name}.mcap' for name, _, _ in FOUND],
    )  # fmt: skip
    return made


@pytest.fixture(scope='module')
def store(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> DirectoryStore:
    """A store with that bag, uploaded."""
    home = tmp_path_factory.mktemp('home')
    found = DirectoryStore(home / 'store')
    with plan_upload(folder, 'thor', BAG, home, is_archive=False) as sent:
        assert upload_now(found, sent, deadline_s=60).is_delivered
        assert not sent.remarks
        assert not sent.damaged
    return found


def facts(recorded: Recorded) -> tuple[int, int | None, int | None]:
    """Messages, first and last log time."""
    times = [log_ns for log_ns, _, _ in recorded.messages]
    return len(times), min(times, default=None), max(times, default=None)


def test_the_matrix_is_complete() -> None:
    """As many variants as the project has of each input. The reference reader reads each whose records are not padded: in chunks
    it does not skip the extra bytes.
    """
    counts: dict[str, int] = {}
    for name, recorded, content in FOUND:
        counts[recorded.name] = counts.get(recorded.name, 0) + 1
        if 'pad' in name:
            continue
        found = list(NonSeekingReader(io.BytesIO(content)).iter_messages(log_time_order=False))
        assert [(one.log_time, one.publish_time, one.sequence) for _, _, one in found] == list(recorded.messages)
    assert counts == {
        'NoData': 6, 'OneAttachment': 14, 'OneMetadata': 14, 'OneMessage': 154, 'OneSchemalessMessage': 74, 'TenMessages': 154,
    }  # fmt: skip


def test_info_agrees_with_every_variant(folder: Path) -> None:
    """Messages and times of each file, and the topics of the bag; without a contradiction to its metadata."""
    found = info_folder(folder).description
    parts = {part.name: (part.messages, part.t_start_ns, part.t_end_ns) for part in found.parts}
    assert parts == {f'{name}.mcap': facts(recorded) for name, recorded, _ in FOUND}
    assert {(topic.name, topic.type): topic.messages for topic in found.topics} == {
        ('example', 'Example'): 11 * 154, ('example', ''): 74,
    }  # fmt: skip
    assert (found.messages, found.t_start_ns, found.t_end_ns, found.remarks, found.damaged) == (11 * 154 + 74, 0, 9, (), {})


def test_a_cut_copies_every_variant_verbatim(folder: Path, tmp_path: Path) -> None:
    """All messages of each file, and those of a shorter time: with encoding, schema, metadata, times, sequence and bytes."""
    cut_folder(folder, tmp_path / 'all', Choice())
    assert list(read(tmp_path / 'all' / 'all_0.mcap')) == [one for each in FILLED for one in copied(each[1], 0, 9)]
    cut_folder(folder, tmp_path / 'some', Choice('0.000000002', '0.000000005', topics=('/example',)))
    assert list(read(tmp_path / 'some' / 'some_0.mcap')) == [one for each in FILLED for one in copied(each[1], 2, 4)]


def copied(recorded: Recorded, first_ns: int, last_ns: int) -> Iterator[tuple[object, ...]]:
    """The messages in a cut of it."""
    assert recorded.channel
    topic, encoding, metadata = recorded.channel
    for log_ns, publish_ns, sequence in recorded.messages:
        if first_ns <= log_ns <= last_ns:
            yield topic, encoding, metadata, recorded.schema, log_ns, publish_ns, sequence, DATA


def test_a_single_file_can_be_cut(folder: Path, tmp_path: Path) -> None:
    """A file alone is a bag as well: with the most features of each kind, and with none."""
    for name, recorded, _ in FILLED:
        if name == recorded.name or 'ch-chx-mx-pad-rch' in name:
            cut_folder(folder / f'{name}.mcap', tmp_path / name, Choice())
            assert read(tmp_path / name / f'{name}_0.mcap') == list(copied(recorded, 0, 9)), name


def test_a_cut_of_a_file_without_messages_is_an_error(folder: Path, tmp_path: Path) -> None:
    """A file without messages has none to copy."""
    for name, recorded, _ in FOUND:
        if not recorded.messages:
            with pytest.raises(BagError, match='has no messages'):
                cut_folder(folder / f'{name}.mcap', tmp_path / name, Choice())


@pytest.mark.parametrize('deep', [False, True])
def test_every_variant_passes_verification(folder: Path, store: DirectoryStore, deep: bool) -> None:
    """Each file is intact: in a folder, and in a store."""
    for found in (verify_folder(folder, deep=deep), verify_remote(store, find_bag(store, 'thor', BAG), deep=deep)):
        assert [(check.name, check.finding) for check in found.findings] == []
        assert {check.name for check in found.checks} == {f'{name}.mcap' for name, _, _ in FOUND}
        assert found.remarks == ()


def test_every_variant_is_uploaded_and_listed(store: DirectoryStore, tmp_path: Path) -> None:
    """The manifest has the contents of each file, and so do the commands that read the bag in the store."""
    bag = find_bag(store, 'thor', BAG)
    manifest = read_manifest(store, bag)
    assert manifest is not None
    assert {each.file: (each.messages, dict(each.counts)) for each in manifest.slices} == {
        f'{name}.mcap': (len(recorded.messages), {'example': len(recorded.messages)} if recorded.channel else {})
        for name, recorded, _ in FOUND
    }
    described = info_of(store, 'thor', BAG, tmp_path / 'home').description
    (row,) = bag_overview(store, 'thor', tmp_path / 'home')
    for found in (described, row):
        assert (found.messages, found.t_start_ns, found.t_end_ns) == (11 * 154 + 74, 0, 9)
    cut = cut_remote(store, bag, tmp_path / 'piece', Choice('0.000000002', '0.000000003'))
    assert cut.messages == 154 + 154 + 74
    assert {one[4] for one in read(cut.folder / 'piece_0.mcap')} == {2}


def test_every_variant_is_fetched_unchanged(store: DirectoryStore, tmp_path: Path) -> None:
    """Each file arrives unchanged."""
    found = fetch(store, find_bag(store, 'thor', BAG), tmp_path)
    assert found.is_complete
    assert not found.unverified
    assert {path.name: path.read_bytes() for path in found.folder.glob('*.mcap')} == {
        f'{name}.mcap': content for name, _, content in FOUND
    }


SCHEMA, CHANNEL = Schema(1, STRING[2], STRING[1], STRING[0]), Channel(1, '/x', 'cdr', {}, 1)
OTHER = Channel(2, '/y', 'cdr', {'k': 'v'}, 1)


class Record(Protocol):
    """One of ``mcap.records``."""

    def write(self, stream: RecordBuilder) -> None: ...


def packed(*records: Record | bytes) -> bytes:
    """Records in order, with verbatim bytes."""
    builder = RecordBuilder()
    for record in records:
        if isinstance(record, bytes):
            builder.write(record)
        else:
            record.write(builder)
    return bytes(builder.end())


def message(log_ns: int, channel: int = 1) -> Message:
    return Message(channel, log_ns, CDR, log_ns, log_ns & 0xFF)


def chunk(*records: Record | bytes, compression: str = '', crc: int | None = None) -> Chunk:
    content = packed(*records)
    data = {'': bytes, 'zstd': zstandard.compress, 'lz4': lz4_compress}[compression](content)
    times = [record.log_time for record in records if isinstance(record, Message)] or [0]
    return Chunk(compression, data, max(times), min(times), zlib.crc32(content) if crc is None else crc, len(content))


def raw(op: int, content: bytes = b'') -> bytes:
    return struct.pack('<BQ', op, len(content)) + content


def assembled(folder: Path, *records: Record | bytes, summary: bytes = b'') -> Path:
    """A bag of one file with these records."""
    folder.mkdir(parents=True)
    data = MCAP0_MAGIC + packed(Header('ros2', 'other'), *records, DataEnd(0))
    footer = packed(Footer(summary_start=len(data) if summary else 0, summary_offset_start=0, summary_crc=0))
    (folder / 'b_0.mcap').write_bytes(data + summary + footer + MCAP0_MAGIC)
    return folder


def check(folder: Path, out: Path, wanted: list[tuple[str, int]]) -> None:
    """Info, verify and cut agree on the messages: topic and log time of each, in the order of the file."""
    found = info_folder(folder).description
    times = [log_ns for _, log_ns in wanted]
    assert (found.messages, found.t_start_ns, found.t_end_ns) == (len(wanted), min(times), max(times))
    assert verify_folder(folder, deep=True).is_intact
    cut_folder(folder, out, Choice())
    assert [(one[0], one[4]) for one in read(out / f'{out.name}_0.mcap')] == wanted


@pytest.mark.parametrize('records', [
    [SCHEMA, CHANNEL, message(1), OTHER, chunk(message(2), message(3, 2)), message(4)],
    [chunk(SCHEMA, CHANNEL, message(1)), chunk(SCHEMA, CHANNEL, OTHER, message(2), message(3, 2)), message(4)],
    [chunk(SCHEMA, CHANNEL, message(1), compression='zstd'), chunk(message(2), OTHER, message(3, 2), compression='lz4'),
     chunk(message(4))],
    [chunk(SCHEMA, CHANNEL, message(1), crc=0), chunk(OTHER, message(2), message(3, 2), message(4), crc=0, compression='zstd')],
    [raw(0x80, b'x' * 99), chunk(SCHEMA, raw(0xFF), CHANNEL, OTHER, message(1), raw(0x90, b'private')), raw(0x81),
     chunk(message(2), message(3, 2)), raw(0x7F, b'of a later version'), message(4)],
    [SCHEMA, CHANNEL, OTHER, message(1), message(2), Attachment(1, 1, 'a', 'b', CDR), Metadata('n', {}), message(3, 2),
     message(4)],
    [SCHEMA, CHANNEL, OTHER, message(1), chunk(), chunk(SCHEMA, CHANNEL), message(2), message(3, 2), message(4)],
], ids=['messages in and outside of chunks', 'definitions repeated', 'compressions mixed', 'no CRC', 'private records',
        'attachment and metadata between', 'empty chunks'])  # fmt: skip
def test_whatever_the_format_allows_is_read(tmp_path: Path, records: list[Any]) -> None:
    """Without a summary: every message is found, in the order of the file."""
    folder = assembled(tmp_path / 'b', *records)
    check(folder, tmp_path / 'piece', [('/x', 1), ('/x', 2), ('/y', 3), ('/x', 4)])


def test_extra_bytes_at_the_end_of_records(tmp_path: Path) -> None:
    """Belong to a later version of the format, also in the summary and in chunks; those of a message are its data."""

    def padded(record: Record) -> bytes:
        content = packed(record)
        return raw(content[0], content[9:] + b'later')

    inside = (padded(SCHEMA), padded(CHANNEL), message(1), message(2))
    summary = b''.join(map(padded, (SCHEMA, CHANNEL, Statistics(0, 1, {1: 2}, 1, 2, 2, 1, 0, 1))))
    folder = assembled(tmp_path / 'b', padded(Header('x', 'y')), padded(chunk(*inside)), summary=summary)
    check(folder, tmp_path / 'piece', [('/x', 1), ('/x', 2)])


DAMAGED = {
    'channel redefined': ([SCHEMA, CHANNEL, message(1), Channel(1, '/other', 'cdr', {}, 1)], 'defined twice'),
    'schema redefined': ([SCHEMA, CHANNEL, message(1), Schema(1, b'int32 data', STRING[1], STRING[0])], 'defined twice'),
    'schema 0': ([Schema(0, b'', '', '')], 'schema 0'),
    'no schema': ([CHANNEL, message(1)], 'without their schema|before the definition'),
    'no channel': ([SCHEMA, message(1)], 'before the definition'),
    'channel after its message': ([SCHEMA, message(1), CHANNEL], 'before the definition'),
    'wrong CRC': ([chunk(SCHEMA, CHANNEL, message(1), crc=7)], 'CRC-32'),
    'unknown compression': ([Chunk('br', b'x', 1, 1, 0, 9)], "'br'"),
    'short message': ([SCHEMA, CHANNEL, raw(Opcode.MESSAGE, b'1234')], 'message of 4 bytes'),
    'zeros': ([SCHEMA, CHANNEL, message(1), bytes(18)], 'zeros'),
    'torn record': ([SCHEMA, CHANNEL, message(1), struct.pack('<BQ', 5, 1 << 40)], 'truncated record'),
}


@pytest.mark.parametrize('name', DAMAGED)
def test_whatever_the_format_forbids_is_damage(tmp_path: Path, name: str) -> None:
    """They are damage: no message appears on the wrong topic, and none is lost silently."""
    records, says = DAMAGED[name]
    folder = assembled(tmp_path / 'b', *records)  # type: ignore[misc]
    for attempt in (lambda: info_folder(folder), lambda: cut_folder(folder, tmp_path / 'piece', Choice())):
        with pytest.raises(BagDamaged, match=says):
            attempt()
    (finding,) = verify_folder(folder).findings
    assert str(folder) not in finding.finding


def test_verification_finds_a_summary_that_contradicts_the_data(tmp_path: Path) -> None:
    """``verify --deep`` finds it: other counts, other times, another channel."""
    content = chunk(SCHEMA, CHANNEL, message(1), message(2))
    for place, (channel, count, end) in enumerate(((CHANNEL, 3, 2), (CHANNEL, 2, 9), (Channel(1, '/z', 'cdr', {}, 1), 2, 2))):
        statistics = Statistics(0, 1, {1: count}, 1, count, end, 1, 0, 1)
        folder = assembled(tmp_path / str(place), content, summary=packed(SCHEMA, channel, statistics))
        assert verify_folder(folder).is_intact
        (finding,) = verify_folder(folder, deep=True).findings
        assert 'messages' in finding.finding


def test_attachments_are_not_read(tmp_path: Path) -> None:
    """Of any size, by any command: 3 GB of a sparse file, with messages before and after."""
    folder, size = tmp_path / 'b', 3 << 30
    folder.mkdir()
    with (folder / 'b_0.mcap').open('wb') as file:
        file.write(MCAP0_MAGIC + packed(Header('ros2', 'other'), SCHEMA, CHANNEL, message(1)))
        for op in (Opcode.ATTACHMENT, Opcode.METADATA):
            file.write(struct.pack('<BQ', op, size))
            file.seek(size, os.SEEK_CUR)
        file.write(packed(message(2), DataEnd(0), Footer(0, 0, 0)) + MCAP0_MAGIC)
    found = info_folder(folder)
    assert (found.description.messages, found.read_bytes < 20 << 20) == (2, True)
    cut = cut_folder(folder, tmp_path / 'piece', Choice())
    assert (cut.messages, cut.extras) == (2, 2)
    assert verify_folder(folder).is_intact


def test_attachments_alone_are_a_bag_without_messages(tmp_path: Path) -> None:
    """They are a bag without messages; a cut of others reports how many it omits."""
    alone = write(tmp_path / 'alone' / 'b_0.mcap', lambda writer: writer.add_attachment(1, 1, 'map.png', 'image/png', b'x' * 999))
    found = info_folder(alone).description
    assert (found.messages, found.topics, found.t_start_ns) == (0, (), None)
    assert verify_folder(alone, deep=True).is_intact
    with pytest.raises(BagError, match='no messages'):
        cut_folder(alone, tmp_path / 'piece', Choice())

    def fill(writer: Writer) -> None:
        channel = writer.register_channel('/x', 'cdr', writer.register_schema(*STRING))
        writer.register_channel('/silent', 'cdr', 1)
        writer.add_message(channel, 1, CDR, 1)
        writer.add_attachment(1, 1, 'a', 'b', b'c')
        writer.add_metadata('rosbag2', {'serialized_metadata': ''})
        writer.add_metadata('calibration', {'fx': '1'})

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill)
    assert topics(folder) == {('/x', STRING[0]): 1, ('/silent', STRING[0]): 0}
    ran = CliRunner().invoke(bag, ['cut', f'{folder}/b_0.mcap', '--to', str(tmp_path / 'piece')], standalone_mode=False)
    assert 'Not copied: 2 attachments or metadata records.' in ran.output
    assert '1 message on 1 topic' in ran.output
    assert 'Read ' not in ran.output


NAMES = {'/a': {'a': '/a', '/a': '/a', 'a/': '/a'}, 'b': {'b': 'b', '/b': 'b'}, '/c/': {'/c': '/c/', 'c': '/c/', '/c/': '/c/'},
         '/d/e': {'d/e': '/d/e', 'e': None}}  # fmt: skip


def test_topics_are_found_with_and_without_a_leading_slash(tmp_path: Path) -> None:
    """With or without it; if a bag has both, the one with the exact name."""

    def fill(writer: Writer) -> None:
        schema = writer.register_schema(*STRING)
        for topic in (*NAMES, 'f', '/f'):
            writer.add_message(writer.register_channel(topic, 'cdr', schema), 1, CDR, 1)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill)
    wanted = {asked: topic for names in NAMES.values() for asked, topic in names.items()} | {'f': 'f', '/f': '/f'}
    for place, (asked, topic) in enumerate(wanted.items()):
        if topic is None:
            with pytest.raises(BagError, match='no topic'):
                cut_folder(folder, tmp_path / str(place), Choice(topics=(asked,)))
        else:
            cut_folder(folder, tmp_path / str(place), Choice(topics=(asked,)))
            assert [one[0] for one in read(tmp_path / str(place) / f'{place}_0.mcap')] == [topic], asked


@pytest.mark.parametrize('name', ['my bag', '-x', 'späti', "it's", 'x.mcap'])
def test_a_folder_may_have_any_name(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders are read by a path with a slash; one file by its name alone."""
    write(tmp_path / name / f'{name}_0.mcap', lambda writer: writer.add_message(
        writer.register_channel('/x', 'cdr', writer.register_schema(*STRING)), 1, CDR, 1))  # fmt: skip
    monkeypatch.chdir(tmp_path)
    for verb in (['info'], ['verify'], ['cut', '--to', 'piece']):
        ran = CliRunner().invoke(bag, [*verb, f'./{name}'], standalone_mode=False)
        assert ran.return_value == 0, (verb, ran.output, ran.exception)
    monkeypatch.chdir(tmp_path / name)
    if not name.startswith('-'):
        ran = CliRunner().invoke(bag, ['info', f'{name}_0.mcap'], standalone_mode=False)
        assert '1 on 1 topic' in ran.output


@pytest.mark.parametrize('is_chunked', [True, False])
def test_every_checksum_of_a_file_is_checked(tmp_path: Path, is_chunked: bool) -> None:
    """By ``verify --deep``: a flipped bit anywhere except in the length of a record or the magic is found."""

    def fill(writer: Writer) -> None:
        channel = writer.register_channel('/x', 'cdr', writer.register_schema(*STRING))
        writer.add_message(channel, 1, CDR * 9, 1)
        writer.add_attachment(1, 1, 'a', 'b', b'c' * 99)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill, use_chunking=is_chunked, enable_data_crcs=True)
    content = (folder / 'b_0.mcap').read_bytes()
    assert verify_folder(folder, deep=True).is_intact
    for place in range(8, len(content) - 8, 3):
        (folder / 'b_0.mcap').write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        assert not verify_folder(folder, deep=True).is_intact, place


def test_schemas_that_share_a_name_are_distinguished(tmp_path: Path) -> None:
    """On one topic or on two."""

    def fill(writer: Writer) -> None:
        schemas = [writer.register_schema(STRING[0], STRING[1], text) for text in (b'string data', b'string other', b'')]
        for topic, number in (('/a', 0), ('/a', 1), ('/b', 1), ('/b', 2)):
            writer.add_message(writer.register_channel(topic, 'cdr', schemas[number]), number, CDR, 1)

    folder = write(tmp_path / 'b' / 'b_0.mcap', fill)
    assert topics(folder) == {('/a', STRING[0]): 2, ('/b', STRING[0]): 2}
    cut_folder(folder, tmp_path / 'piece', Choice())
    assert read(tmp_path / 'piece' / 'piece_0.mcap') == read(folder / 'b_0.mcap')
