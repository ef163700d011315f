"""Cutting a bag: exactly the messages of the range, reading little more than their chunks from a store."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from bags.real_bags import IMU, NAME, STEP_NS, T0, by_rosbags, messages_of, put_item, stored, write_ours, write_rosbags
from click.testing import CliRunner
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from ruamel.yaml import YAML
from shadowhound_tower.embedded import Tower
from stores.memory import MemoryStore
from stores.spooled import QUICK

from shadowhound_data_logger.bags.cut import Choice, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of
from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.cli.bag import bag
from shadowhound_data_logger.core.errors import BagDamaged, BagError, SettingError
from shadowhound_data_logger.formats.mcap.messages import RecordedMessage
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

KINDS = [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.STORAGE),
    (StoragePlugin.MCAP, CompressionMode.FILE), (StoragePlugin.SQLITE3, CompressionMode.NONE),
    (StoragePlugin.SQLITE3, CompressionMode.FILE), (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
]  # fmt: skip


@pytest.fixture(scope='module')
def origin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of three slices of 5 s."""
    folder = tmp_path_factory.mktemp('robot') / NAME
    write_ours(folder)
    return folder


@pytest.fixture(scope='module')
def store(origin: Path) -> MemoryStore:
    found = MemoryStore()
    stored(found, origin)
    return found


def source(origin: Path, wanted: Callable[[RecordedMessage], bool]) -> list[RecordedMessage]:
    return [one for one in messages_of([origin / f'{NAME}_{number}.mcap' for number in range(3)]) if wanted(one)]


@pytest.mark.parametrize(('choice', 'first', 'last', 'topics'), [
    (Choice(), 0, 1500, {'/imu', '/camera/blob'}),
    (Choice('4.5', '6.25'), 450, 625, {'/imu', '/camera/blob'}),
    (Choice('-1'), 1399, 1500, {'/imu', '/camera/blob'}),
    (Choice('2025-10-18T12:00:04.990Z', '2025-10-18 12:00:05.01'), 499, 501, {'/imu', '/camera/blob'}),
    (Choice(f'{T0 // 10**9 + 3}.5', '4', topics=('imu',)), 350, 400, {'/imu'}),
    (Choice('0', '2', regex='^/cam'), 0, 200, {'/camera/blob'}),
])  # fmt: skip
def test_a_cut_has_the_messages_of_its_time_and_no_others(
    origin: Path, store: MemoryStore, tmp_path: Path, choice: Choice, first: int, last: int, topics: set[str]
) -> None:
    """Topic, both stamps, sequence number and bytes of each message are copied in order; the source is unchanged."""
    found = cut_remote(store, find_bag(store, 'thor', NAME), tmp_path / 'piece', choice)
    start_ns, end_ns = T0 + first * STEP_NS, T0 + last * STEP_NS
    wanted = source(origin, lambda one: start_ns <= one.log_ns < end_ns and one.channel.topic in topics)
    assert list(messages_of([found.folder / 'piece_0.mcap'])) == wanted
    assert found.messages == len(wanted) > 0
    assert sorted(by_rosbags(found.folder)) == sorted((one.channel.topic, one.log_ns, one.cdr) for one in wanted)
    assert list(messages_of([cut_folder(origin, tmp_path / 'again', choice).folder / 'again_0.mcap'])) == wanted


def test_several_times_become_one_bag(origin: Path, store: MemoryStore, tmp_path: Path) -> None:
    """Messages between the requested start and end are copied in order."""
    spans = (
        (T0 - STEP_NS, T0 + 3 * STEP_NS),
        (T0 + 700 * STEP_NS, T0 + 705 * STEP_NS),
        (T0 + 1400 * STEP_NS, T0 + 9999 * STEP_NS),
    )
    found = cut_remote(store, find_bag(store, 'thor', NAME), tmp_path / 'piece', Choice('0.01', '10', spans=spans))
    times = [(one.log_ns - T0) // STEP_NS for one in messages_of([found.folder / 'piece_0.mcap']) if one.channel.topic == '/imu']
    assert times == [1, 2, *range(700, 705)]
    with pytest.raises(BagError, match='no such message'):
        cut_folder(origin, tmp_path / 'none', Choice(spans=()))


def test_little_more_is_read_than_its_chunks(store: MemoryStore, tmp_path: Path) -> None:
    """For one second of fifteen, less than a fifth of the bag is read; for a topic in every fifth chunk, only those chunks."""
    bag = find_bag(store, 'thor', NAME)
    found = cut_remote(store, bag, tmp_path / 'second', Choice('7', '8'))
    assert found.read_bytes < bag.size / 5
    assert found.read_requests <= 3


def test_a_cut_from_an_s3_server_is_the_same(seaweed: Tower, origin: Path, tmp_path: Path) -> None:
    """Ranged reads over S3 give the same cut."""
    s3 = open_store(seaweed.store_settings(), QUICK)
    try:
        stored(s3, origin)
        found = cut_remote(s3, find_bag(s3, 'thor', NAME), tmp_path / 'piece', Choice('7', '8'))
    finally:
        s3.close()
    start_ns = T0 + 700 * STEP_NS
    assert list(messages_of([found.folder / 'piece_0.mcap'])) == source(origin, lambda one: 0 <= one.log_ns - start_ns < 10**9)
    assert found.read_bytes < found.bag_bytes / 5


@pytest.mark.parametrize(('plugin', 'mode'), KINDS, ids=lambda value: value.name)
@pytest.mark.parametrize('is_remote', [False, True], ids=['folder', 'store'])
def test_a_cut_of_any_rosbag2_bag_is_an_mcap_bag(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode, is_remote: bool
) -> None:
    """Any bag of rosbag2 becomes a plain MCAP bag with the same messages."""
    folder = tmp_path / 'store' / BUCKET / 'thor' / 'rosbags' / 'theirs'
    write_rosbags(folder, plugin, mode)
    choice = Choice('1', '2', topics=('/imu',))
    if is_remote:
        store = DirectoryStore(tmp_path / 'store')
        found = cut_remote(store, find_bag(store, 'thor', 'theirs'), tmp_path / 'piece', choice)
    else:
        found = cut_folder(folder, tmp_path / 'piece', choice)
    wanted = [one for one in by_rosbags(folder) if T0 + 10**9 <= one[1] < T0 + 2 * 10**9 and one[0] == '/imu']
    assert len(wanted) == 50
    assert by_rosbags(found.folder) == wanted
    channel = next(messages_of([found.folder / 'piece_0.mcap'])).channel
    assert (channel.type, channel.encoding) == ('sensor_msgs/msg/Imu', 'ros2msg')
    assert 'float64[9] orientation_covariance' in channel.definition


def test_a_cut_has_qos_in_humbles_format(tmp_path: Path) -> None:
    """Jazzy and Kilted record it as text, at which Humble's player exits."""
    folder = tmp_path / 'kilted'
    folder.mkdir()
    writer = SliceWriter(folder / 'kilted_0.mcap')
    words = '- history: unknown\n  depth: 0\n  reliability: best_effort\n  durability: volatile\n  liveliness: automatic'
    writer.write(replace(IMU, qos=words), T0, T0, 0, b'data')
    writer.close()
    found = cut_folder(folder, tmp_path / 'piece', Choice())
    numbers = '- history: 3\n  depth: 0\n  reliability: 2\n  durability: 2\n  liveliness: 1'
    assert next(messages_of([found.folder / 'piece_0.mcap'])).channel.qos == numbers
    report = YAML(typ='safe').load(found.folder / 'metadata.yaml')['rosbag2_bagfile_information']
    assert report['topics_with_message_count'][0]['topic_metadata']['offered_qos_profiles'] == numbers


@pytest.mark.parametrize('clock', [
    {'clock': 'set_later', 'boot_id': 'b', 'clock_offset_ns': '1760788778000000000'}, {'clock': 'unset', 'boot_id': 'b'},
])  # fmt: skip
def test_the_clock_of_a_bag_is_that_of_its_piece(tmp_path: Path, clock: dict[str, str]) -> None:
    """Also for a cut of a cut; ``bag info`` shows it."""
    infos = write_ours(tmp_path / 'early', slices=1, each=20, is_ended=False)
    (tmp_path / 'early' / 'metadata.yaml').write_bytes(metadata_yaml(infos, ros_distro='humble', custom_data=clock))
    cut_folder(tmp_path / 'early', tmp_path / 'piece', Choice('0.05'))
    cut_folder(tmp_path / 'piece', tmp_path / 'smaller', Choice('0.05'))
    assert info_folder(tmp_path / 'smaller').description.clock == clock
    text = CliRunner().invoke(bag, ['info', str(tmp_path / 'smaller')], standalone_mode=False).stdout
    assert ('was not set yet' if 'clock_offset_ns' in clock else 'was never set in boot b') in text


@pytest.mark.parametrize('clock', [
    {'clock': 'set_later', 'boot_id': 'b', 'clock_offset_ns': '1760788778000000000'}, {'clock': 'unset', 'boot_id': 'b'}, {},
])  # fmt: skip
@pytest.mark.parametrize('without', ['metadata', 'm'], ids=['without metadata.yaml', 'without manifest.json as well'])
def test_slices_in_a_store_give_the_clock_of_an_incomplete_bag(tmp_path: Path, clock: dict[str, str], without: str) -> None:
    """Its metadata.yaml has not arrived yet: for cut, info and fetch."""
    store, folder = MemoryStore(), tmp_path / 'early'
    write_ours(folder, slices=2, each=20)
    for place, path in enumerate(sorted(folder.iterdir())):
        if not path.name.startswith(without):
            item = put_item(path, f'{prefix_of("thor", "early")}{path.name}', 'early', place)
            store.put(replace(item, metadata={**item.metadata, **clock}))
    bag = find_bag(store, 'thor', 'early')
    cut_remote(store, bag, tmp_path / 'piece', Choice('0.05'))
    fetch(store, bag, tmp_path / 'fetched')
    for found in (
        info_of(store, 'thor', 'early', tmp_path / 'home'),
        *map(info_folder, (tmp_path / 'piece', tmp_path / 'fetched' / 'early')),
    ):
        assert found.description.clock == clock


@pytest.mark.parametrize('custom', [
    {'clock': 'set_later', 'boot_id': 'b'}, {'clock': 'set_later', 'boot_id': 'b', 'clock_offset_ns': '9' * 5000},
    {'clock': 'set_later', 'boot_id': 'b' * 5000, 'clock_offset_ns': '1'}, {'clock': 'unset'}, {'clock': 'set'},
])  # fmt: skip
def test_a_missing_clock_is_none(tmp_path: Path, custom: dict[str, str]) -> None:
    """Custom data of other recorders is ignored."""
    infos = write_ours(tmp_path / 'early', slices=1, each=2, is_ended=False)
    (tmp_path / 'early' / 'metadata.yaml').write_bytes(metadata_yaml(infos, ros_distro='humble', custom_data=custom))
    assert info_folder(tmp_path / 'early').description.clock == {}


@pytest.mark.parametrize(('choice', 'error', 'text'), [
    (Choice(topics=('/imv',)), BagError, 'did you mean /imu?'),
    (Choice(topics=('/nothing/of/it',)), BagError, 'it has /camera/blob, /imu'),
    (Choice('1000'), BagError, 'from 2025-10-18T12:16:40.000000Z on .the bag is from'),
    (Choice(regex='nothing'), BagError, 'no topic of the bag matches'),
    (Choice('100', '101'), BagError, 'the bag is from 2025-10-18T12:00:00.000000Z'),
    (Choice('5', '4'), SettingError, 'a time after --start'),
    (Choice('noon'), SettingError, '--start'),
    (Choice(regex='('), SettingError, '--regex'),
])  # fmt: skip
def test_an_empty_cut_leaves_no_files(
    store: MemoryStore, tmp_path: Path, choice: Choice, error: type[Exception], text: str
) -> None:
    """The error has the available range."""
    with pytest.raises(error, match=text):
        cut_remote(store, find_bag(store, 'thor', NAME), tmp_path / 'piece', choice)
    assert list(tmp_path.iterdir()) == []


def test_a_piece_has_the_usual_file_permissions(origin: Path, tmp_path: Path) -> None:
    """Its slice is not a private file of a spool: only the umask decides."""
    before = os.umask(0o027)
    try:
        found = cut_folder(origin, tmp_path / 'piece', Choice('1', '2'))
    finally:
        os.umask(before)
    assert {path.name: oct(path.stat().st_mode & 0o777) for path in found.folder.iterdir()} == {
        'piece_0.mcap': '0o640', 'metadata.yaml': '0o640'
    }  # fmt: skip


def test_a_missing_bag_is_reported(origin: Path, tmp_path: Path) -> None:
    """A topic that the bag does not have; a slice that has not arrived: its time is neither invented nor called empty."""
    store = MemoryStore()
    stored(store, origin, without='_1.mcap')
    bag = find_bag(store, 'thor', NAME)
    found = cut_remote(store, bag, tmp_path / 'piece', Choice('4', '6', topics=('/imu', '/nowhere')))
    assert (found.absent, found.missing) == (('/nowhere',), (f'{NAME}_1.mcap',))
    assert found.messages == 100
    assert cut_remote(store, bag, tmp_path / 'first', Choice('1', '2')).missing == ()
    with pytest.raises(BagError, match=f'are in {NAME}_1.mcap, which is missing'):
        cut_remote(store, bag, tmp_path / 'gone', Choice('6', '7'))
    assert not (tmp_path / 'gone').exists()


def test_a_piece_does_not_become_a_part_of_its_bag(origin: Path) -> None:
    """A folder inside the bag is refused, and nothing is created."""
    before = sorted(origin.rglob('*'))
    for out in (origin / 'piece', origin / 'a' / 'b', origin / '..' / NAME / 'c'):
        with pytest.raises(BagError, match='inside the bag'):
            cut_folder(origin, out, Choice())
    assert sorted(origin.rglob('*')) == before


def test_an_existing_folder_is_left_alone(store: MemoryStore, tmp_path: Path) -> None:
    """Nothing is overwritten."""
    (tmp_path / 'piece').mkdir()
    with pytest.raises(BagError, match='already exists'):
        cut_remote(store, find_bag(store, 'thor', NAME), tmp_path / 'piece', Choice())


def test_a_damaged_chunk_is_not_copied(origin: Path, tmp_path: Path) -> None:
    """Its CRC-32 reveals it, and the cut leaves nothing behind."""
    folder = tmp_path / NAME
    folder.mkdir()
    content = bytearray((origin / f'{NAME}_0.mcap').read_bytes())
    content[20_000] ^= 1
    (folder / f'{NAME}_0.mcap').write_bytes(content)
    with pytest.raises(BagDamaged, match='chunk'):
        cut_folder(folder, tmp_path / 'piece', Choice())
    assert not (tmp_path / 'piece').exists()


QOS = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
STATIC = Channel('/tf_static', 'tf2_msgs/msg/TFMessage', 'ros2msg', 'x', '', QOS)
MAP = Channel('/map', 'nav_msgs/msg/OccupancyGrid', 'ros2msg', 'x', '', QOS)


def write_latched(folder: Path, *, repeats: bool) -> None:
    """Three slices of a second: two transforms and a map in the first, another map in the second; with or without repeats."""
    folder.mkdir()
    infos, latched = [], list[tuple[Channel, bytes]]()
    for number in range(3):
        writer = SliceWriter(folder / f'{folder.name}_{number}.mcap')
        for channel, content in latched if repeats else ():
            writer.write(replace(channel, repeated=True), T0 + number * 10**9, T0, 7, content)
        new = {0: [(STATIC, b'left'), (STATIC, b'right'), (MAP, b'old')], 1: [(MAP, b'new')], 2: []}[number]
        for channel, content in new:
            writer.write(channel, T0 + number * 10**9 + 5, T0, 7, content)
        latched = [*(each for each in latched if not new or each[0] is not MAP), *new]
        for place in range(100):
            at = T0 + number * 10**9 + place * STEP_NS
            writer.write(IMU, at, at, place, b'imu')
        infos.append(writer.close())
    (folder / 'metadata.yaml').write_bytes(metadata_yaml(infos, ros_distro=''))


@pytest.mark.parametrize('repeats', [True, False], ids=['ours', 'another recorder'])
def test_a_piece_begins_with_what_is_latched(tmp_path: Path, *, repeats: bool) -> None:
    """All transforms, the last map, with their publish time, and each once, wherever the cut starts and however long it is."""
    bag = tmp_path / 'bag'
    write_latched(bag, repeats=repeats)
    for start, end, early, late in (
        ('0.5', '0.9', [b'left', b'right', b'old'], []), ('0.5', '', [b'left', b'right', b'old'], [b'new']),
        ('1.5', '', [b'left', b'right', b'new'], []), ('2.5', '2.9', [b'left', b'right', b'new'], []),
        ('', '', [], [b'left', b'right', b'old', b'new']),
    ):  # fmt: skip
        piece = tmp_path / f'piece{start}{end}'
        found = cut_folder(bag, piece, Choice(start, end))
        messages = [one for one in messages_of([piece / f'{piece.name}_0.mcap']) if one.channel.topic != '/imu']
        assert [one.cdr for one in messages if one.channel.repeated] == early
        assert [one.cdr for one in messages if not one.channel.repeated] == late
        assert found.latched == len(early)
        began_ns = T0 + round(float(start or 0) * 1e9)
        assert {(one.log_ns, one.publish_ns, one.sequence) for one in messages if one.channel.repeated} <= {(began_ns, T0, 7)}
        assert found.t_start_ns == (began_ns if start else T0)


def test_a_piece_of_other_topics_has_nothing_that_is_latched(tmp_path: Path) -> None:
    """It has the selected topics."""
    write_latched(tmp_path / 'bag', repeats=True)
    found = cut_folder(tmp_path / 'bag', tmp_path / 'piece', Choice('1.5', topics=['/imu']))
    assert (found.latched, found.topics) == (0, 1)


def test_one_slice_alone_keeps_what_it_repeats(tmp_path: Path) -> None:
    """There is nothing else that has it."""
    write_latched(tmp_path / 'bag', repeats=True)
    found = cut_folder(tmp_path / 'bag' / 'bag_2.mcap', tmp_path / 'piece', Choice())
    assert {one.cdr for one in messages_of([tmp_path / 'piece' / 'piece_0.mcap'])} == {b'imu', b'left', b'right', b'new'}
    assert found.latched == 0
