"""If space for kept objects runs short, their rate is reduced first, then their time span; the ledger has each message."""

from __future__ import annotations

import random
import tarfile
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import orjson
import pytest
from spool.conftest import Moments
from spool.making import NOON_NS, FakeClock, assert_whole, make, receive, rows

from shadowhound_data_logger.bags.naming import BUCKET as BAGS
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import CatalogSettings, KeepSettings, SpoolSettings
from shadowhound_data_logger.core.model import DataObject, FileBody
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar, pack_zip
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.node.encoding.halver import Halver
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.thinning import Thinner, may_halve
from shadowhound_data_logger.spool.files import description_of
from shadowhound_data_logger.spool.ledger import read as read_ledger
from shadowhound_data_logger.spool.spool import Spool

KIB = 1 << 10
SHIP = {meta.ROBOT: 'thor', meta.SHIP: meta.ON_REQUEST}
CAMERA = Channel('/camera', COMPRESSED_IMAGE, '', '', '', '')
IMU = Channel('/imu', 'sensor_msgs/msg/Imu', '', '', '', '')


class Robot:
    """A spool with kept objects, and its thinning."""

    def __init__(self, root: Path, max_bytes: int, min_hz: float = 1.0) -> None:
        self.root = root
        self.clock = FakeClock()
        self.max_bytes, self.min_hz = max_bytes, min_hz
        self.random = random.Random(0)
        self.open()

    def open(self) -> None:
        keep = KeepSettings(max_bytes=self.max_bytes, thin_to_hz=self.min_hz)
        self.spool = Spool(self.root, SpoolSettings(min_free_bytes=0), self.clock, 'thor', keep)
        self.spool.open()
        self.thinner = Thinner(self.spool, self.min_hz, Halver(self.root.parent / 'home', 'thor', self.min_hz))

    def keep(self, *items: DataObject, topics: Sequence[str] = ('/camera',)) -> None:
        for item in items:
            for topic in topics:
                count = item.counts.get(topic, 0) if item.counts else item.samples
                receive(self.spool, count, topic)
        self.spool.commit(items)
        self.told()

    def told(self) -> None:
        """Mark everything as reported to the store."""
        with self.spool._connections.writing.transaction():  # as when a part of the catalog is spooled
            self.spool._connections.writing._db.execute('DELETE FROM unreported')

    def thin(self) -> int:
        """Thin until there is room, or nothing is left to thin; returns the number of steps."""
        count = 0
        while self.thinner.step():
            count += 1
            assert count < 10_000
            self.told()
        return count

    def kept(self) -> list[dict[str, object]]:
        return [row for row in rows(self.root) if row['state'] == 'kept']

    def body(self, size: int = KIB) -> bytes:
        return self.random.randbytes(size)


@pytest.fixture
def make_robot(tmp_path: Path) -> Iterator[Callable[..., Robot]]:
    made: list[Robot] = []

    def build(max_bytes: int, min_hz: float = 1.0) -> Robot:
        made.append(Robot(tmp_path / 'spool', max_bytes, min_hz))
        return made[-1]

    yield build
    for robot in made:
        robot.spool.close()


def frame(robot: Robot, number: int, hz: float = 10.0) -> DataObject:
    stamp_ns = NOON_NS + round(number * SECOND / hz)
    return make(f'thor/camera/20251018/{number:06d}.jpg', robot.body(), t_start_ns=stamp_ns, t_end_ns=stamp_ns, metadata=SHIP)


def archive(
    robot: Robot, number: int, *, count: int = 30, pack: Callable[..., bytes] = pack_tar, repeats: bool = False
) -> DataObject:
    """A second of a camera; with ``repeats`` each third image repeats the one before it."""
    members, first_ns, file = [], NOON_NS + number * SECOND, ''
    stamps = [first_ns + place * SECOND // count for place in range(count)]
    for place, stamp_ns in enumerate(stamps):
        fields: dict[str, object] = {'stamp_ns': stamp_ns, 'topic': '/camera'}
        if repeats and place % 3 == 2:
            fields['repeat_of'] = file
        else:
            file = f'{stamp_ns:019d}.jpg'
            members.append(ArchiveFile(file, stamp_ns, robot.body()))
        members.append(ArchiveFile(f'{stamp_ns:019d}.json', stamp_ns, orjson.dumps(fields)))
    kind = 'application/x-tar' if pack is pack_tar else 'application/zip'
    return make(f'thor/camera/20251018/{number:06d}.{"tar" if pack is pack_tar else "zip"}', pack(members), content_type=kind,
                samples=count, t_start_ns=stamps[0], t_end_ns=stamps[-1], metadata=SHIP)  # fmt: skip


def bag_slice(robot: Robot, folder: Path, number: int) -> DataObject:
    """Five seconds: 30 images per second and 100 IMU messages."""
    folder.mkdir(exist_ok=True)
    writer = SliceWriter(folder / f'patrol_{number}.mcap')
    begin_ns = NOON_NS + 5 * number * SECOND
    stamps = sorted(
        [
            *((begin_ns + place * SECOND // 30, 0) for place in range(150)),
            *((begin_ns + place * SECOND // 100, 1) for place in range(500)),
        ]
    )
    for sequence, (stamp_ns, which) in enumerate(stamps):
        writer.write((CAMERA, IMU)[which], stamp_ns, stamp_ns, sequence, robot.body((KIB, 64)[which]))
    info = writer.close()
    counts = {f'bag:{topic}': count for topic, count in info.counts.items()}
    return DataObject(
        bucket=BAGS, key=f'thor/patrol/bags/patrol_{number}.mcap', body=FileBody(info.path, info.bytes, info.sha256),
        content_type='application/octet-stream', sensor='bag', topic=None, type='', samples=info.messages,
        t_start_ns=info.t_start_ns, t_end_ns=info.t_end_ns, priority=5,
        protected=False, metadata={**SHIP, meta.MESSAGES: str(info.messages)}, counts=counts,
    )  # fmt: skip


def messages_of(body: bytes, content_type: str) -> dict[int, bytes]:
    """The contents of an archive by time, repeats as the image they repeat."""
    if content_type == 'application/zip':
        with zipfile.ZipFile(BytesIO(body)) as packed:
            files = {name: packed.read(name) for name in packed.namelist()}
    else:
        with tarfile.open(fileobj=BytesIO(body)) as unpacked:
            files = {each.name: file.read() for each in unpacked if (file := unpacked.extractfile(each))}
    data = [orjson.loads(content) for name, content in files.items() if name.endswith('.json')]
    return {one['stamp_ns']: files[one.get('repeat_of', f'{one["stamp_ns"]:019d}.jpg')] for one in data}


@pytest.mark.parametrize(('count', 'seconds', 'min_hz', 'expected'), [
    (2, 2.0, 0.5, True), (2, 2.0, 1.0, False), (2, 1.0, 1.0, True), (1, 0.0, 0.1, False), (30, 1.0, 1.0, True),
    (30, 1.0, 15.0, True), (30, 1.0, 16.0, False), (5, 0.0, 1000.0, True),
])  # fmt: skip
def test_thinning_respects_the_minimum_rate(count: int, seconds: float, min_hz: float, expected: bool) -> None:
    """The remaining half is at least at the minimum rate."""
    assert may_halve(count, seconds * SECOND, min_hz) is expected


def test_frames_are_thinned_before_the_oldest_are_evicted(make_robot: Callable[..., Robot]) -> None:
    """Each second of the hour keeps an image; removed ones are reported as thinned, with their time, and the ledger balances."""
    robot = make_robot(1 << 20)
    for number in range(0, 1000, 50):
        robot.keep(*(frame(robot, each) for each in range(number, number + 50)))
        robot.thin()
    kept = robot.kept()
    stamps = sorted(int(str(row['t_start_ns'])) for row in kept)
    assert stamps[0] == NOON_NS
    assert max(late - early for early, late in pairwise(stamps)) <= SECOND
    found = assert_whole(robot.root)
    assert found['objects']['kept'] == len(kept)
    assert found['objects']['evicted'] == 1000 - len(kept)
    reasons = Counter(row['reason'] for row in rows(robot.root) if row['state'] == 'evicted')
    assert set(reasons) == {'thinned'}
    gaps = [gap for gap in robot.spool.gaps_after(0, 10_000, {})[0] if gap.cause == 'thinned']
    assert sum(gap.count for gap in gaps) == reasons['thinned']


@pytest.mark.parametrize('pack', [pack_tar, pytest.param(pack_zip, marks=pytest.mark.long('as for tar'))])
@pytest.mark.parametrize('repeats', [True, pytest.param(False, marks=pytest.mark.long('without repeats'))])
def test_an_archive_loses_every_second_image(make_robot: Callable[..., Robot], pack: Callable[..., bytes], repeats: bool) -> None:
    """The remaining ones are byte-identical, repeats included; rows, files, descriptions and the ledger agree."""
    robot = make_robot(500 * KIB)
    items = [archive(robot, number, pack=pack, repeats=repeats) for number in range(40)]
    whole = {item.key: messages_of(bytes(item.body), item.content_type) for item in items if isinstance(item.body, bytes)}
    for item in items:
        robot.keep(item)
        robot.thin()
    kept = robot.kept()
    assert len(kept) == len(items), 'no second is gone'
    thinned = 0
    for row in kept:
        path = robot.root / 'kept' / str(row['bucket']) / str(row['key'])
        left, was = messages_of(path.read_bytes(), str(row['content_type'])), whole[str(row['key'])]
        metadata = orjson.loads(str(row['metadata']))
        step = int(metadata.get(meta.THINNED, 1))
        thinned += step > 1
        expected = list(was.items())
        for _ in range(step.bit_length() - 1):
            expected = expected[::2]
        assert left == dict(expected)
        assert (row['samples'], int(metadata[meta.COUNT])) == (len(left), len(left))
        assert description_of(path)['samples'] == len(left)
    assert thinned > len(items) / 2
    found = assert_whole(robot.root)
    camera = found['topics']['/camera']
    lost = sum(int(str(row['samples'])) for row in rows(robot.root) if row['state'] == 'evicted')
    assert camera['stored'] == 30 * len(items)
    assert sum(int(str(row['samples'])) for row in kept) + lost == 30 * len(items)


def test_a_slice_loses_only_images(make_robot: Callable[..., Robot], tmp_path: Path) -> None:
    """All small messages stay; the loss is reported by topic."""
    robot = make_robot(1 << 20)
    for number in range(8):
        robot.keep(bag_slice(robot, tmp_path / 'bag', number), topics=('bag:/camera', 'bag:/imu'))
        robot.thin()
    kept = robot.kept()
    assert len(kept) == 8
    counts = []
    for row in kept:
        source = LocalFile(robot.root / 'kept' / str(row['bucket']) / str(row['key']))
        found = Counter(
            message.channel.topic
            for message in read_messages(source, read_index(source), MessageFilter(0, 1 << 63, lambda _: True))
        )
        assert found['/imu'] == 500
        assert found['/camera'] >= 5
        assert found.total() == row['samples'] == int(orjson.loads(str(row['metadata']))[meta.MESSAGES])
        counts.append(found['/camera'])
    assert counts[0] < 150
    ledger = read_ledger(robot.root, 'thor')
    assert ledger['balanced']
    assert_whole(robot.root)
    lost = [row for row in rows(robot.root) if row['state'] == 'evicted']
    assert {row['reason'] for row in lost} == {'thinned'}
    assert sum(int(str(row['samples'])) for row in lost) == 8 * 150 - sum(counts)


def test_requested_and_protected_objects_are_not_thinned(make_robot: Callable[..., Robot]) -> None:
    """Thinning only changes objects that are not requested."""
    robot = make_robot(1 << 20)
    robot.keep(archive(robot, 0), archive(robot, 1), archive(robot, 2))
    with robot.spool._connections.writing.transaction():
        robot.spool._connections.writing.states.protect('sensor-data', 'thor/camera/20251018/000000.tar')
        number = robot.kept()[1]['id']
        robot.spool._connections.writing._db.execute("INSERT INTO requested VALUES ('r', ?, 1, 'kept')", (number,))
    robot.max_bytes = 70 * KIB
    robot.spool.close()
    robot.open()
    robot.thin()
    assert [row['samples'] for row in robot.kept()] == [30, 30, 2], 'one frame takes a tar of the same size'


@pytest.mark.long('a second of CPU or more')
def test_an_hour_of_thinning_is_one_gap_row(make_robot: Callable[..., Robot], caplog: pytest.LogCaptureFixture) -> None:
    """If space is always short, new objects are thinned every few seconds, without a log message each time."""
    caplog.set_level('INFO', 'shadowhound_data_logger')
    robot = make_robot(1 << 18)
    for hour in range(2):
        for number in range(hour * 36_000, hour * 36_000 + 400, 40):
            robot.keep(*(frame(robot, each) for each in range(number, number + 40)))
            robot.thin()
    assert [line.getMessage().partition(' of the hour from ')[2][:16] for line in caplog.records if 'short' in line.msg] == [
        '2025-10-18T12:00', '2025-10-18T13:00',
    ]  # fmt: skip


@pytest.mark.long('thousands of pictures')
def test_at_the_minimum_rate_the_oldest_is_evicted(make_robot: Callable[..., Robot]) -> None:
    """The rate is reduced first, then the time span, from its beginning."""
    robot = make_robot(1 << 20)
    for number in range(0, 4000, 40):
        robot.keep(*(frame(robot, each) for each in range(number, number + 40)))
        robot.thin()
    reasons = Counter(row['reason'] for row in rows(robot.root) if row['state'] == 'evicted')
    assert set(reasons) <= {'thinned', 'keep_limit'}
    assert_whole(robot.root)


def test_each_thinning_step_is_cataloged(make_robot: Callable[..., Robot]) -> None:
    """Also an object already reported by a part: it is reported again, with its remaining messages."""
    robot, now_s = make_robot(1 << 20), [0.0]
    catalog = CatalogWriter(robot.root, CatalogSettings(), 'thor', robot.clock, lambda: now_s[0], keeps=True)

    def told() -> list[int]:
        """The messages in each row of the part that is spooled now."""
        now_s[0] += 3600.0
        made = catalog.due()
        robot.spool.commit(made)
        return [item.samples for item in made] and [
            count
            for part in made
            if part.reports
            for count in [row['count'] for row in read_rows(bytes(part.body), 'thor').rows['_kept']]  # type: ignore[arg-type]
        ]

    item = archive(robot, 0)
    receive(robot.spool, 30)
    robot.spool.commit([item])
    assert told() == [30]
    assert told() == []
    robot.spool.close()
    robot.max_bytes = 4 * KIB
    robot.open()
    for left in (15, 8, 4):
        assert robot.thinner.step()
        assert left in told()
        assert told() == []
        assert robot.kept()[0]['samples'] == left


def test_thinning_is_off_at_0(make_robot: Callable[..., Robot]) -> None:
    """The oldest is evicted completely."""
    robot = make_robot(1 << 20, 0.0)
    for number in range(40):
        robot.keep(archive(robot, number, count=60))
        assert robot.thin() == 0
    assert {row['reason'] for row in rows(robot.root) if row['state'] == 'evicted'} == {'keep_limit'}


@pytest.mark.long('a death after each step')
def test_a_kill_at_any_moment_of_thinning_loses_nothing(root: Path, moments: Moments) -> None:
    """An object is unchanged, or thinned with its loss reported once; after the next start there are no other files."""
    robot = Robot(root, 1 << 20)
    robot.keep(archive(robot, 0), archive(robot, 1))
    robot.spool.close()

    def work() -> None:
        again = Robot(root, 66 * KIB)
        again.thin()
        again.spool.close()

    seen = []
    for copy in moments(work):
        found = Robot(copy, 1 << 20)
        assert_whole(copy)
        kept = found.kept()
        lost = sum(int(str(row['samples'])) for row in rows(copy) if row['state'] == 'evicted')
        assert sum(int(str(row['samples'])) for row in kept) + lost == 60
        for row in kept:
            path = copy / 'kept' / str(row['bucket']) / str(row['key'])
            assert len(messages_of(path.read_bytes(), str(row['content_type']))) == row['samples']
        seen.append(lost)
        found.spool.close()
    assert seen == sorted(seen)
    assert (seen[0], seen[-1] > 0) == (0, True)
