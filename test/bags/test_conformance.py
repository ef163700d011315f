"""Every variant of the MCAP project's conformance tests through every verb that reads a bag: info, cut, verify, upload, fetch."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from bags.conformance import DATA, Recorded, variants
from bags.reference import metadata_yaml, read
from mcap.reader import NonSeekingReader

from shadowhound_data_logger.bags.cut import Choice, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.naming import natural_key
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.remote import find_bag, read_manifest
from shadowhound_data_logger.bags.upload import plan_upload, upload_now
from shadowhound_data_logger.bags.verify import verify_folder, verify_remote
from shadowhound_data_logger.core.errors import BagError
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
    """With that bag, uploaded."""
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


def test_info(folder: Path) -> None:
    """Messages and times of each file, and the topics of the bag; nothing is at odds with its metadata."""
    found = info_folder(folder).description
    parts = {part.name: (part.messages, part.t_start_ns, part.t_end_ns) for part in found.parts}
    assert parts == {f'{name}.mcap': facts(recorded) for name, recorded, _ in FOUND}
    assert {(topic.name, topic.type): topic.messages for topic in found.topics} == {
        ('example', 'Example'): 11 * 154, ('example', ''): 74,
    }  # fmt: skip
    assert (found.messages, found.t_start_ns, found.t_end_ns, found.remarks, found.damaged) == (11 * 154 + 74, 0, 9, (), {})


def test_cut(folder: Path, tmp_path: Path) -> None:
    """All messages of each file, and those of a shorter time: with encoding, schema, metadata, times, sequence and bytes."""
    cut_folder(folder, tmp_path / 'all', Choice())
    assert list(read(tmp_path / 'all' / 'all_0.mcap')) == [one for each in FILLED for one in copied(each[1], 0, 9)]
    cut_folder(folder, tmp_path / 'some', Choice('0.000000002', '0.000000005', topics=('/example',)))
    assert list(read(tmp_path / 'some' / 'some_0.mcap')) == [one for each in FILLED for one in copied(each[1], 2, 4)]


def copied(recorded: Recorded, first_ns: int, last_ns: int) -> Iterator[tuple[object, ...]]:
    """What a cut has of it."""
    assert recorded.channel
    topic, encoding, metadata = recorded.channel
    for log_ns, publish_ns, sequence in recorded.messages:
        if first_ns <= log_ns <= last_ns:
            yield topic, encoding, metadata, recorded.schema, log_ns, publish_ns, sequence, DATA


def test_cut_of_one_file(folder: Path, tmp_path: Path) -> None:
    """A file alone is a bag as well: with the most features of each kind, and with none."""
    for name, recorded, _ in FILLED:
        if name == recorded.name or 'ch-chx-mx-pad-rch' in name:
            cut_folder(folder / f'{name}.mcap', tmp_path / name, Choice())
            assert read(tmp_path / name / f'{name}_0.mcap') == list(copied(recorded, 0, 9)), name


def test_cut_of_nothing(folder: Path, tmp_path: Path) -> None:
    """A file without messages has none to copy."""
    for name, recorded, _ in FOUND:
        if not recorded.messages:
            with pytest.raises(BagError, match='has no messages'):
                cut_folder(folder / f'{name}.mcap', tmp_path / name, Choice())


@pytest.mark.parametrize('deep', [False, True])
def test_verify(folder: Path, store: DirectoryStore, deep: bool) -> None:
    """Each file is sound: in a folder, and in a store."""
    for found in (verify_folder(folder, deep=deep), verify_remote(store, find_bag(store, 'thor', BAG), deep=deep)):
        assert [(check.name, check.finding) for check in found.findings] == []
        assert {check.name for check in found.checks} == {f'{name}.mcap' for name, _, _ in FOUND}
        assert found.remarks == ()


def test_upload(store: DirectoryStore, tmp_path: Path) -> None:
    """The manifest has of each file what is in it, and so have the commands that read the bag in the store."""
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


def test_fetch(store: DirectoryStore, tmp_path: Path) -> None:
    """Each file arrives unchanged."""
    found = fetch(store, find_bag(store, 'thor', BAG), tmp_path)
    assert found.is_complete
    assert not found.unverified
    assert {path.name: path.read_bytes() for path in found.folder.glob('*.mcap')} == {
        f'{name}.mcap': content for name, _, content in FOUND
    }
