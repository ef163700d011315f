"""The bag or the objects that an episode is made from: within the mission's time, its own bags first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from datasets.recorded import TOPICS, House, Mission, cdr_of, x_of
from lake.gap_parts import tell
from lake.making import NOON_NS, add
from lake.training import COMPRESSED, ODOMETRY
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.bags.manifest import COMPLETE, EventOf, Manifest, MissionOf, SliceEntry, topics_of
from shadowhound_data_logger.bags.naming import slice_file
from shadowhound_data_logger.cli import export as verb
from shadowhound_data_logger.cli.common import ExitCode
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.datasets import series
from shadowhound_data_logger.datasets.export import Exported, export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import DATA, SOURCE_TABLE, Lerobot, matrix
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.gaps import complete
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

LATE_NS = 2_000_000
"""The delay from a message's stamp to its arrival."""
EVENT = EventOf('fall', 30.0, 30.0, 10.0, ())


class Yard(House):
    """A store with missions whose objects have two images per second, and with bags."""

    def mission(self, name: str, begin_s: float, seconds: float = 4.0, **more: Any) -> Mission:
        """Its objects cover its time, and a second before and after it."""
        rates = {'camera_hz': 2.0, 'odom_hz': 4.0, **more}
        made = self.record(Mission(name, begin_s=begin_s, seconds=seconds, sensors=('camera', 'odom'), **rates))
        tell(self.settings, self.folder, *(
            complete('thor', 'j', 99, sink='bags', topic=TOPICS[sensor], session=1, grade='exact', received=1, skipped=0,
                     from_ns=made.begin_ns - 20 * SECOND, to_ns=made.end_ns + SECOND) for sensor in ('camera', 'odom')
        ), name=f'bags-{name}')  # fmt: skip
        return made

    def bag(self, name: str, *times_s: tuple[float, float], hz: float = 10.0, mission: MissionOf | None = None,
            event: EventOf | None = None, has_manifest: bool = True) -> str:  # fmt: skip
        """One slice for each of these times, seconds after noon; returns the prefix of their keys."""
        infos = []
        for number, (first_s, last_s) in enumerate(times_s):
            path = self.folder / slice_file(name, number)
            writer = SliceWriter(path)
            stamps = [NOON_NS + round((first_s + step / hz) * SECOND) for step in range(round((last_s - first_s) * hz) + 1)]
            for sensor, kind in (('camera', COMPRESSED), ('odom', ODOMETRY)):
                channel = Channel(TOPICS[sensor], kind, *describe(kind), '')
                for sequence, stamp in enumerate(stamps):
                    writer.write(channel, stamp + LATE_NS, stamp, sequence, cdr_of(self.drive._ros, sensor, stamp))
            infos.append(writer.close())
        prefix = f'thor/rosbags/{name}/'
        entries = tuple(SliceEntry.of(info, prefix + info.path.name) for info in infos)
        manifest = Manifest(name, 'thor', mission, COMPLETE, (), topics_of(infos), entries, event=event)
        with closing(open_store(self.settings, UploadSettings())) as store:
            for info in infos:
                add(store, self.folder / 'tmp', prefix + info.path.name, info.path.read_bytes())
            if has_manifest:
                add(store, self.folder / 'tmp', f'{prefix}manifest.json', manifest.to_json())
        return prefix

    def export(self, name: str = 'set', **how: Any) -> Exported:
        return export(self.folder / name, self.source, {'mission_type': 'patrol'}, ExportOptions(**how))

    def sources(self, mission: str, stream: str = 'images.front', name: str = 'set') -> dict[str, list[int]]:
        """Key -> the stamps of its messages in the episode."""
        found: dict[str, set[int]] = {}
        for row in pq.read_table(self.folder / name / SOURCE_TABLE).to_pylist():
            if (row['episode_mission'], row['stream']) == (mission, stream):
                found.setdefault(row['key'], set()).add(row['stamp_ns'])
        return {key: sorted(stamps) for key, stamps in sorted(found.items())}


@pytest.fixture
def yard(tmp_path: Path) -> Yard:
    return Yard(tmp_path)


def of(mission: str) -> MissionOf:
    return MissionOf('patrol', mission, f'run{mission}')


def stream_of(found: Exported, mission: str, stream: str = 'images.front') -> dict[str, Any]:
    (mine,) = [each for each in found.added if each['mission_id'] == mission]
    return dict(mine['streams'][stream])


def test_missions_that_are_four_seconds_apart_are_separate(yard: Yard) -> None:
    """Each is made from its own bag, at that bag's rate, though the earlier one has far more messages."""
    yard.mission('one', 0)
    yard.mission('two', 8)
    bags = {'one': yard.bag('b1', (0, 4), hz=40, mission=of('one')), 'two': yard.bag('b2', (8, 12), mission=of('two'))}
    found = yard.export()
    assert (found.refused, found.waiting, found.fps) == ({}, {}, 10)
    for mission, prefix in bags.items():
        assert list(yard.sources(mission)) == [f'{prefix}{prefix.split("/")[2]}_0.mcap']
    assert stream_of(found, 'two')['messages'] == 41
    assert stream_of(found, 'two')['rate_hz'] == pytest.approx(10, rel=0.05)
    assert verify(yard.folder / 'set', DirectoryStore(yard.settings.directory), frames=None).wrong == []


def test_the_missions_bag_takes_precedence_over_another_one(yard: Yard) -> None:
    """By the mission's id: a denser bag of no mission, of another one, and of an event in it are ignored."""
    yard.mission('one', 20)
    own = yard.bag('own', (20, 24), mission=of('one'))
    yard.bag('always', (0, 40), hz=40)
    yard.bag('another', (19, 25), hz=40, mission=of('zero'))
    yard.bag('event', (0, 25), hz=40, mission=of('one'), event=EVENT)
    assert stream_of(yard.export(), 'one')['from'] == 'bags'
    assert list(yard.sources('one')) == list(yard.sources('one', 'state.pose')) == [f'{own}own_0.mcap']


def test_a_bag_with_only_the_run_id_belongs_to_its_mission(yard: Yard) -> None:
    """While a mission is unknown to MLflow its bag may have only the id of the run."""
    yard.mission('one', 20)
    own = yard.bag('own', (20, 24), mission=MissionOf('patrol', None, 'runone'))
    yard.bag('always', (0, 40), hz=40)
    yard.export()
    assert list(yard.sources('one')) == [f'{own}own_0.mcap']


def test_each_mission_gets_its_slices_of_a_shared_bag(yard: Yard) -> None:
    """Each is made from the slices of its time, whichever mission was active when the bag started."""
    yard.mission('one', 3)
    yard.mission('two', 13)
    prefix = yard.bag('service', (0, 5), (5.1, 10), (10.1, 15), (15.1, 20), mission=of('one'))
    found = yard.export()
    assert (found.refused, found.fps) == ({}, 10)
    for mission, slices in (('one', (0, 1)), ('two', (2, 3))):
        assert list(yard.sources(mission)) == [f'{prefix}service_{number}.mcap' for number in slices]
        assert stream_of(found, mission)['from'] == 'bags'


def test_a_mission_without_a_bag_uses_the_bag_of_its_neighbor_where_it_has_more(yard: Yard) -> None:
    """The other bag extends a second into it, with more images than all of its objects: these are used."""
    yard.mission('one', 0)
    yard.mission('two', 5)
    yard.bag('b1', (0, 6), hz=40, mission=of('one'))
    found = yard.export()
    assert (stream_of(found, 'one')['from'], stream_of(found, 'two')['from']) == ('bags', 'objects')
    assert found.refused == {}
    assert all('/camera/' in key for key in yard.sources('two'))


def test_an_excerpt_does_not_represent_a_mission(yard: Yard) -> None:
    """An event's bag, and a requested part of the mission's own one, have more images of less of it."""
    yard.mission('one', 20, 6)
    yard.mission('two', 60, 6)
    yard.bag('event', (18, 24), hz=40, mission=of('one'), event=EVENT)
    yard.bag('part', (61, 63.5), hz=40, mission=of('two'))
    found = yard.export()
    assert {stream_of(found, each)['from'] for each in ('one', 'two')} == {'objects'}
    assert found.refused == {}


def test_a_mission_may_be_in_two_bags(yard: Yard) -> None:
    """The node was restarted: the episode has the messages of both, and ticks without any bag are stale."""
    yard.mission('one', 0, 8)
    parts = [yard.bag('first', (0, 4), mission=of('one')), yard.bag('then', (5, 8), mission=of('one'))]
    found = yard.export(max_stale=0.5)
    assert found.refused == {}
    assert list(yard.sources('one')) == [f'{parts[0]}first_0.mcap', f'{parts[1]}then_0.mcap']
    assert stream_of(found, 'one')['messages'] == 41 + 31
    assert stream_of(found, 'one')['longest_gap_s'] == pytest.approx(0.9, abs=0.06)


def test_the_last_moment_of_a_mission_is_in_another_bag(yard: Yard) -> None:
    """The node was restarted right before the end: the mission's part is used however small it is."""
    yard.mission('one', 0, 6)
    yard.bag('first', (0, 5.3), mission=MissionOf('patrol', None, 'runone'))
    last = yard.bag('last', (5.5, 6), mission=of('one'))
    yard.bag('always', (5, 6), hz=100)
    found = yard.export(max_stale=0.5)
    assert found.refused == {}
    assert list(yard.sources('one')) == ['thor/rosbags/first/first_0.mcap', f'{last}last_0.mcap']


def test_an_always_on_bag_has_the_beginning(yard: Yard) -> None:
    """The mission's own bag starts two seconds late: before it the other one's messages are used, and none twice."""
    yard.mission('one', 10, 6)
    yard.bag('always', (0, 13), hz=10)
    own = yard.bag('own', (12, 16), mission=of('one'))
    found = yard.export()
    sources = yard.sources('one')
    assert list(sources) == ['thor/rosbags/always/always_0.mcap', f'{own}own_0.mcap']
    assert max(sources['thor/rosbags/always/always_0.mcap']) < min(sources[f'{own}own_0.mcap']) == NOON_NS + 12 * SECOND
    stamps = np.array(sorted(stamp for some in sources.values() for stamp in some))
    assert set(np.diff(stamps)) == {SECOND // 10}
    assert stream_of(found, 'one')['stale_share'] == 0


def test_two_bags_of_no_mission_have_each_message_once(yard: Yard) -> None:
    """Two recorders ran at the same time."""
    yard.mission('one', 10)
    yard.bag('this', (5, 20))
    yard.bag('that', (6, 19))
    found = yard.export()
    assert list(yard.sources('one')) == ['thor/rosbags/that/that_0.mcap']
    assert stream_of(found, 'one')['messages'] == len(range(6 * 10, 14 * 10 + 1))


@pytest.mark.parametrize('damage', [lambda _: None, lambda path: path.write_bytes(b'{"version": 1}')], ids=['none', 'damaged'])
def test_a_bag_without_a_manifest_is_not_used(yard: Yard, damage: Callable[[Path], object]) -> None:
    """Its mission and contents are unknown: the objects are used."""
    yard.mission('one', 10)
    prefix = yard.bag('foreign', (9, 15), hz=40, has_manifest=False)
    damage(yard.settings.directory / 'sensor-data' / prefix / 'manifest.json')
    found = yard.export()
    assert (stream_of(found, 'one')['from'], found.refused) == ('objects', {})


def test_objects_from_before_a_mission_do_not_count(yard: Yard) -> None:
    """A sensor had another topic, with more objects in the hour before; the bag has more of the mission."""
    old = [NOON_NS + round(step * SECOND / 2) for step in range(40)]
    made = [yard.drive.one(COMPRESSED, [stamp], [cdr_of(yard.drive._ros, 'camera', stamp)], rate_hz=1000.0) for stamp in old]
    yard.drive.store([replace(each, metadata={**each.metadata, 'topic': '/old'}) for each in made])
    yard.mission('one', 30)
    found = yard.export()
    assert found.refused == {}
    assert stream_of(found, 'one')['topic'] == TOPICS['camera']


def test_objects_are_used_where_they_have_more_of_the_mission(yard: Yard) -> None:
    """Its own bag has fewer messages in the mission than the objects, and more in the ten seconds before it."""
    yard.mission('one', 20, camera_hz=20.0, odom_hz=20.0)
    yard.bag('own', (10, 19.5), (20, 24), hz=15, mission=of('one'))
    found = yard.export()
    assert stream_of(found, 'one')['from'] == 'objects'
    assert found.fps == 20


# -- dry runs --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Yard:
    """A mission that can be exported; four that cannot, each for a different reason; one that waits."""
    made = Yard(tmp_path_factory.mktemp('mixed'))
    made.mission('good', 0)
    made.record(Mission('blind', begin_s=100, seconds=4, camera_hz=2, odom_hz=4, sensors=('camera', 'odom'), uncounted=('odom',)))
    made.record(Mission('deaf', begin_s=200, seconds=4, camera_hz=2, odom_hz=4, sensors=('camera',)))
    made.record(Mission('slow', begin_s=300, seconds=4, camera_hz=1, odom_hz=4, sensors=('camera', 'odom')))
    made.record(Mission('late', begin_s=400, seconds=4, camera_hz=2, odom_hz=4, sensors=('camera', 'odom'), told_until_s=-3))
    return made


def test_a_dry_run_counts_what_would_be_exported(mixed: Yard) -> None:
    """A mission refused without reading a message is refused in both, for the same reason, and counted once."""
    dry = export(mixed.folder / 'dry', mixed.source, {'mission_type': 'patrol'}, ExportOptions(fps=2), is_dry=True)
    real = mixed.export('real', fps=2)
    assert list(dry.streams) == [each['mission_id'] for each in real.added] == ['good']
    assert dry.refused == real.refused
    assert sorted(dry.refused) == ['blind', 'deaf', 'slow']
    assert (list(dry.waiting), list(real.waiting)) == (['late'], ['late'])
    assert real.present == []
    assert not (mixed.folder / 'dry').exists()


def asked(yard: Yard, home: Path, *more: str) -> tuple[int, str]:
    home.mkdir(exist_ok=True)
    (home / 'export.yaml').write_text('fps: 2')
    (home / 'store').symlink_to(yard.settings.directory) if not (home / 'store').exists() else None
    runner = CliRunner(env={'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': None, 'COLUMNS': '200'})
    arguments = ['lerobot', 'totals', '--to', str(home / 'totals'), '--mission-type', 'patrol',
                 '--config', str(home / 'export.yaml'), *more]  # fmt: skip
    ran = runner.invoke(verb.export, arguments, standalone_mode=False, catch_exceptions=False)
    return ran.return_value, ran.stdout


@pytest.mark.parametrize(('more', 'total'), [
    (('--dry-run',), '1 mission would be exported to'),
    ((), '1 episode added to'),
    (('--mission', 'slow', '--dry-run'), '0 missions would be exported to'),
    (('--mission', 'slow'), 'No mission was exported, 1 refused.'),
])  # fmt: skip
def test_the_command_counts_refused_missions(mixed: Yard, tmp_path: Path, more: Sequence[str], total: str) -> None:
    """Refused ones are counted as such, and the exit code is 1, in a dry run and in a real one."""
    code, output = asked(mixed, tmp_path / 'home', *more)
    assert code == ExitCode.FINDING
    assert total in output
    if '--mission' not in more:
        assert '3 refused, 1 waiting' in output
        assert '0 in it already' in output


def test_a_refused_mission_does_not_settle_the_rate(mixed: Yard) -> None:
    """``fps: auto`` is the rate of the slowest camera among the exported missions."""
    mixed.record(Mission('poor', begin_s=500, seconds=4, camera_hz=1, odom_hz=4, sensors=('camera', 'odom'), uncounted=('odom',)))
    flags = {'where': "mission_id in ('good', 'poor')"}
    found = export(mixed.folder / 'rate', mixed.source, flags, ExportOptions())
    assert (found.fps, list(found.refused), Lerobot(mixed.folder / 'rate').mission_ids) == (2, ['poor'], ['good'])


def test_spans_are_cut_out_of_each_other() -> None:
    """The rest of a time overlaps none of the others, and together with them it covers everything."""
    from shadowhound_data_logger.datasets.series import Interval

    rng = np.random.default_rng(5)
    for _ in range(200):
        first, *others = [Interval(*sorted(map(int, rng.integers(0, 30, 2)))) for _ in range(rng.integers(1, 6))]
        left = first.without(others)
        there = [step for one in left for step in range(one.first_ns, one.last_ns + 1)]
        assert there == [step for step in range(first.first_ns, first.last_ns + 1)
                         if not any(other.first_ns <= step <= other.last_ns for other in others)]  # fmt: skip
        assert all(one.last_ns < other.first_ns for one, other in pairwise(left))


def record_bag(house: House, tmp_path: Path, *, is_there: bool = True) -> tuple[Mission, str]:
    """A dense recording next to the objects, and the key of its slice, which a robot may keep."""
    dense = Mission('bagged', seconds=2, camera_hz=10.0, odom_hz=50.0)
    path = tmp_path / 'bagged_0.mcap'
    writer = SliceWriter(path)
    for sensor, kind in (('camera', COMPRESSED), ('odom', ODOMETRY)):
        channel = Channel(TOPICS[sensor], kind, *describe(kind), '')
        for number, stamp in enumerate(dense.stamps(sensor)):
            writer.write(channel, stamp + 2_000_000, stamp, number, cdr_of(house.drive._ros, sensor, stamp))
    info = writer.close()
    key = 'thor/rosbags/bagged/bagged_0.mcap'
    manifest = Manifest('bagged', 'thor', None, COMPLETE, (), topics_of([info]), (SliceEntry.of(info, key),))
    with closing(open_store(house.settings, UploadSettings())) as store:
        if is_there:
            add(store, tmp_path / 'tmp', key, path.read_bytes())
        add(store, tmp_path / 'tmp', 'thor/rosbags/bagged/manifest.json', manifest.to_json())
    return dense, key


def test_a_bag_is_taken_where_it_has_more(tmp_path: Path) -> None:
    """The camera at its full rate in a bag, its sources the slices, all of them verified."""
    house = House(tmp_path)
    mission = house.record(Mission('bagged', seconds=2, camera_hz=1.0, odom_hz=2.0, sensors=('camera', 'odom')))
    dense, key = record_bag(house, tmp_path)
    tell(house.settings, tmp_path, *(
        complete('thor', 'j', 99, sink='bags', topic=TOPICS[sensor], session=1, grade='exact', received=1, skipped=0,
                 from_ns=mission.begin_ns - 2 * SECOND, to_ns=mission.end_ns + SECOND,
                 received_from_ns=mission.begin_ns - 2 * SECOND, received_to_ns=mission.end_ns + SECOND)
        for sensor in ('camera', 'odom')
    ), name='bags')  # fmt: skip
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())
    assert (found.refused, found.waiting, found.fps) == ({}, {}, 10)
    assert {each['from'] for each in found.added[0]['streams'].values()} == {'bags'}
    made = Lerobot(tmp_path / 'set')
    table = pq.read_table(made.path(DATA, made.rows[0], 'data'))
    stamps, published = table['shadowhound.stamp_ns'].to_numpy(), np.array(dense.stamps('odom'))
    newest = published[np.searchsorted(published, stamps, 'right') - 1]
    assert matrix(table['observation.state'])[:, 0] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
    sources = pq.read_table(tmp_path / 'set/meta/shadowhound_sources.parquet')
    assert set(sources['key'].to_pylist()) == {key}
    assert set((sources['received_ns'].to_numpy() - sources['stamp_ns'].to_numpy()).tolist()) == {2_000_000}
    proved = verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None)
    assert (proved.wrong, proved.frames) == ([], len(table))
    by_received = export(tmp_path / 'received', house.source, {'mission_type': 'patrol'}, ExportOptions(by='received'))
    assert {each['from'] for each in by_received.added[0]['streams'].values()} == {'bags'}
    (row,) = Lerobot(tmp_path / 'received').rows
    ticks = pq.read_table(Lerobot(tmp_path / 'received').path(DATA, row, 'data'))['shadowhound.stamp_ns'].to_numpy()
    sources = pq.read_table(tmp_path / 'received/meta/shadowhound_sources.parquet')
    assert set((sources['received_ns'].to_numpy() - sources['stamp_ns'].to_numpy()).tolist()) == {2_000_000}
    age_ns = ticks[sources['frame'].to_numpy()] - sources['received_ns'].to_numpy()
    assert sources['held_s'].to_numpy() * SECOND == pytest.approx(age_ns, abs=1000)


def test_slices_that_a_robot_keeps_are_not_missed(tmp_path: Path) -> None:
    """The store only has the manifest of the bag: the dataset is made from the objects."""
    house = House(tmp_path)
    house.record(Mission('bagged', seconds=2, camera_hz=5.0, odom_hz=5.0, sensors=('camera', 'odom')))
    record_bag(house, tmp_path, is_there=False)
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())
    assert (found.refused, found.waiting) == ({}, {})
    assert {each['from'] for each in found.added[0]['streams'].values()} == {'objects'}


def test_what_an_imu_marks_as_unknown_is_nan_in_a_bag_as_well() -> None:
    """As in an object: an orientation that the IMU does not measure is not used."""
    types = get_typestore(Stores.ROS2_HUMBLE).types
    vector, covariance = types['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0), np.zeros(9)
    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](1, 0), '')
    turn = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    for mark in (-1.0, 0.0):
        unknown = np.array([mark, *[0.0] * 8])
        message = types['sensor_msgs/msg/Imu'](header, turn, unknown, vector, covariance, vector, covariance)
        values = series._values(message, 'sensor_msgs/msg/Imu', ())
        assert values[:6].tolist() == [1.0, 2.0, 3.0] * 2
        assert np.isnan(values[6:]).all() == (mark == -1.0)
