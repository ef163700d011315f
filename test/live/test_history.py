"""The past: the timeline of a period and the data of a time, from the spool, from the store, from bags."""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simplejpeg
from click.testing import CliRunner, Result
from lake.gap_parts import lost, mark, tell
from lake.making import NOON_NS, add, add_part, folder_store
from lake.test_pull import Field
from live.test_kinds import cdr, header, new
from spool.making import FakeClock, make, new_spool, put, settle

from shadowhound_data_logger.bags.manifest import COMPLETE, EventOf, Manifest, MissionOf, SliceEntry, TriggerOf
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, UploadSettings
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.catalog import BUCKET, Row, row_of
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.live import history as module
from shadowhound_data_logger.live import kept as kept_module
from shadowhound_data_logger.live.history import LabelRefused, PastReader, PullRefused, commands
from shadowhound_data_logger.live.history_process import HistoryProcess, PastUnavailable
from shadowhound_data_logger.live.kept import SpoolKept, StoreKept
from shadowhound_data_logger.live.past import SpoolPast, StorePast
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

IMU = 'sensor_msgs/msg/Imu'
ODOMETRY = 'nav_msgs/msg/Odometry'
HOSTILE = '<img src=x onerror=alert(1)>$(reboot)\x1b[31m'
MISSION = '$(touch attacked)\'";<img src=x onerror=alert(1)>'


def jpeg(shade: int) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((48, 64, 3), shade, np.uint8), 75, 'RGB'))


def items(body: bytes) -> dict[str, tuple[dict[str, Any], bytes]]:
    """By topic, decoded as on the page."""
    found = {}
    while body:
        size, head_size = int.from_bytes(body[:4], 'little'), int.from_bytes(body[4:8], 'little')
        head = json.loads(body[8 : 8 + head_size])
        found[head['topic']], body = (head, body[8 + head_size : 4 + size]), body[4 + size :]
    return found


def object_row(at_s: float, sensor: str, topic: str, kind: str, extension: str, **more: str) -> Row:
    """The row of an object this many seconds after noon."""
    at_ns = NOON_NS + round(at_s * SECOND)
    metadata = {'robot': 'thor', 'sensor': sensor, 'topic': topic, 'type': kind, 'count': '1', 't_start_ns': str(at_ns),
                't_end_ns': str(at_ns), 'pose': f'{at_s:.3f} 1.000 0.5000 odom', 'battery_pct': '80', **more}  # fmt: skip
    return row_of(BUCKET, f'thor/{sensor}/{utc(at_ns):%Y%m%d/%H%M%S}_x.{extension}', 10, 'image/jpeg', metadata)


def odometry(at_s: float) -> bytes:
    point = {'x': at_s, 'y': 1.0, 'z': 0.3}
    document = {'stamp_ns': NOON_NS + round(at_s * SECOND), 'position': point, 'orientation': {'x': 0, 'y': 0, 'z': 0, 'w': 1},
                'linear_velocity': point, 'angular_velocity': point}  # fmt: skip
    return json.dumps(document).encode()


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ObjectStore]:
    """The directory that is the default store."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as opened:
        yield opened


Opened = Callable[..., PastReader]


@pytest.fixture
def opened(store: ObjectStore) -> Iterator[Opened]:
    """Creates histories and closes them at the end."""
    with ExitStack() as stack:
        yield lambda source, kept=None: stack.enter_context(closing(PastReader(source, kept or StoreKept())))


def patrol(store: ObjectStore, folder: Path) -> None:
    """Ten seconds of camera and odometry of one mission, and the parts with their rows."""
    rows = []
    for second in range(10):
        for sensor, topic, kind, extension, body in (
            ('camera', '/camera', COMPRESSED_IMAGE, 'jpg', jpeg(20 * second)),
            ('odom', '/odom', ODOMETRY, 'json', odometry(second)),
        ):
            rows.append(object_row(second, sensor, topic, kind, extension, mission_id='m1', mission_type='patrol'))
            rows[-1]['bytes'] = len(body)
            add(store, folder / 'tmp', rows[-1]['key'], body)
    add_part(store, rows, 'a', folder / 'tmp')


LATE_S = 146


def late_patrol(store: ObjectStore, folder: Path) -> None:
    """Like ``patrol``, with cameras whose stamps are far behind, and a bag of them; its log times are arrival times."""
    rows = []
    for second in range(10):
        received = str(NOON_NS + (second + LATE_S) * SECOND)
        rows.append(
            object_row(second, 'camera', '/camera', COMPRESSED_IMAGE, 'jpg', received_start_ns=received, received_end_ns=received)
        )
        add(store, folder / 'tmp', rows[-1]['key'], jpeg(20 * second))
    add_part(store, [*rows, *bag(store, folder, 'late', 'bump', late_s=LATE_S)], 'a', folder / 'tmp')


def asked(history: PastReader, at_s: float, by: str = 'stamp') -> tuple[dict[str, Any], dict[str, tuple[dict[str, Any], bytes]]]:
    head, body = history.moment('thor', NOON_NS + round(at_s * SECOND), by)
    return head, items(body)


def test_the_past_of_a_store_is_shown(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """The recorded data, the gaps by cause, their watermark, the mission; and the data at a time."""
    patrol(store, tmp_path)
    settings = folder_store(tmp_path)
    tell(settings, tmp_path, lost('1', 3, 4, cause='transport', topic='/imu'), mark(8, topic='/imu'))
    history = opened(StorePast())
    assert history.answer({'do': 'robots'})[0] == {'robots': ['thor']}
    assert history.answer({'do': 'days', 'robot': 'thor'})[0] == {'days': [f'{utc(NOON_NS):%Y-%m-%d}']}
    noon = NOON_NS // 1_000_000
    found, _ = history.answer({'do': 'timeline', 'robot': 'thor', 'from': noon - 60_000, 'to': noon + 60_000})
    assert found['recorded'] == [['/camera', noon, noon + 9000], ['/odom', noon, noon + 9000]]
    assert found['marks'] == [['mission', 'm1', noon, noon + 9000, 'patrol']]
    assert found['battery'][0] == [noon, 80.0]
    assert len(found['battery']) == 20
    named = [dict(zip(found['columns'], row, strict=True)) for row in found['gaps']]
    assert [(gap['topic'], gap['cause'], gap['from'], gap['to']) for gap in named] == [
        ('/imu', 'transport', noon + 3000, noon + 4000)
    ]
    assert found['known'] == [['/imu', noon, noon + 8000]]
    head, shown = asked(history, 5.5)
    assert shown['/camera'][1] == jpeg(100)
    assert (head['mission'], shown['/camera'][0]['at']) == ('m1', noon + 5000)
    rows = np.frombuffer(shown['/odom'][1], '<f8', 6)
    assert rows.tolist() == [noon + 1000 * second for second in range(6)]
    places = np.frombuffer(shown[''][1], '<f4').reshape(-1, 3)
    assert places[-1].tolist() == [5.0, 1.0, 0.5]


def test_a_moment_is_of_the_clock_that_was_chosen(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Frames in objects and in bags with stamps 146 s behind: at the stamp or at the arrival, never both."""
    late_patrol(store, tmp_path)
    history = opened(StorePast())
    for at_s in (0.0, 3.5, 9.0):
        for by, late_s in (('stamp', 0), ('received', LATE_S)):
            head, shown = asked(history, at_s + late_s, by)
            assert shown['/camera'][1] == jpeg(20 * int(at_s))
            assert [(topic, before) for topic, _, before, _ in head['shown']] == [('/camera', 1000 * (at_s % 1))]
            assert '--by received' in dict(head['commands'])['query'] or by == 'stamp'
    assert asked(history, LATE_S + 3.5)[0]['shown'] == asked(history, 3.5, 'received')[0]['shown'] == []
    for by, late_s in (('stamp', 0), ('received', LATE_S)):
        head, shown = asked(history, 20.55 + late_s, by)
        assert shown['/bagged'][1] == jpeg(100)
        ages = {topic: before for topic, _, before, _ in head['shown']}
        assert ages['/bagged'] == pytest.approx(50)
        cut = shlex.split(dict(head['commands'])['bag cut'])
        start, end = cut[cut.index('--start') + 1], cut[cut.index('--end') + 1]
        assert start <= f'{utc(NOON_NS + round((20.55 + LATE_S) * SECOND)):%Y-%m-%dT%H:%M:%S.%f}' <= end


@pytest.mark.parametrize('by', ['stamp', 'received'])
def test_the_timeline_is_of_the_clock_that_was_chosen(store: ObjectStore, opened: Opened, tmp_path: Path, by: str) -> None:
    """Recorded data and losses are at the same position."""
    late_patrol(store, tmp_path)
    lost_late = {'received_from_ns': NOON_NS + (3 + LATE_S) * SECOND, 'received_to_ns': NOON_NS + (4 + LATE_S) * SECOND}
    tell(folder_store(tmp_path), tmp_path, lost('1', 3, 4, cause='transport', topic='/camera', **lost_late))
    noon = NOON_NS // 1_000_000
    span = {'from': noon - 60_000, 'to': noon + 300_000}
    found, _ = opened(StorePast()).answer({'do': 'timeline', 'robot': 'thor', 'by': by, **span})
    begin = noon + (1000 * LATE_S if by == 'received' else 0)
    assert found['recorded'] == [['/camera', begin, begin + 9000]]
    assert [row[4:6] for row in found['gaps']] == [[begin + 3000, begin + 4000]]
    with pytest.raises(ValueError, match='by is stamp or received'):
        opened(StorePast()).answer({'do': 'timeline', 'robot': 'thor', 'by': 'log', **span})


def test_messages_of_a_batch_are_shown_when_they_arrived(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """A batch with a stuck stamp, and one delayed in a queue: their offsets from the arrival change inside them."""
    rows = []
    for begin_s, stamps_s, arrival in ((0, [0] * 5, (1, 5)), (20, [20, 21, 22, 23, 24], (31, 31.004))):
        samples = [json.loads(odometry(at_s)) for at_s in stamps_s]
        for number, sample in enumerate(samples):
            sample['position']['x'] = begin_s + number
        start, end = (str(NOON_NS + round(at_s * SECOND)) for at_s in arrival)
        ends = str(NOON_NS + stamps_s[-1] * SECOND)
        rows.append(object_row(begin_s, 'odom', '/odom', ODOMETRY, 'json', count='5', t_end_ns=ends, received_start_ns=start,
                         received_end_ns=end))  # fmt: skip
        add(store, tmp_path / 'tmp', rows[-1]['key'], json.dumps({'type': ODOMETRY, 'samples': samples}).encode())
    add_part(store, rows, 'a', tmp_path / 'tmp')
    history = opened(StorePast())
    for at_s, shown_x, age_s in ((3.5, 2, 0.5), (5.5, 4, 0.5), (31.5, 24, 0.496)):
        head, shown = asked(history, at_s, 'received')
        (_, _, before_ms, _) = next(row for row in head['shown'] if row[0] == '/odom')
        told_head, body = shown['/odom']
        rows_shown = np.frombuffer(body, '<f4', offset=8 * told_head['rows']).reshape(told_head['rows'], -1)
        assert rows_shown[-1][told_head['names'].index('x')] == shown_x
        assert before_ms == pytest.approx(1000 * age_s, abs=0.2)


def test_a_spool_is_shown_by_arrival(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Also data that arrived on another day than its stamp."""
    clock = FakeClock()
    spool = new_spool(tmp_path / 'spool', clock)
    spool.open()
    late_ns = 13 * 3600 * SECOND
    try:
        metadata = {'received_start_ns': str(NOON_NS_OF_SPOOL + late_ns), 'received_end_ns': str(NOON_NS_OF_SPOOL + late_ns)}
        (item,) = put(spool, make('thor/camera/20251018/120000_front.jpg', jpeg(60), t_start_ns=NOON_NS_OF_SPOOL,
                                  t_end_ns=NOON_NS_OF_SPOOL, topic='/camera', metadata=metadata))  # fmt: skip
        add(store, tmp_path / 'tmp', item.key, item.path.read_bytes())
        settle(spool, item, State.DELIVERED)
    finally:
        spool.close()
    history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
    for by, at_ns in (('stamp', NOON_NS_OF_SPOOL), ('received', NOON_NS_OF_SPOOL + late_ns)):
        head, _ = history.moment('thor', at_ns + SECOND, by)
        assert [shown[1:3] for shown in head['shown']] == [['camera', 1000.0]]
        other, _ = history.moment('thor', at_ns + SECOND, 'stamp' if by == 'received' else 'received')
        assert other['shown'] == []


def test_the_past_of_a_spool_is_shown(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Pending objects are read from the spool, delivered ones from the store."""
    clock = FakeClock()
    spool = new_spool(tmp_path / 'spool', clock)
    spool.open()
    try:
        made = []
        for second in range(3):
            at_ns = NOON_NS_OF_SPOOL + second * SECOND
            key = f'thor/camera/20251018/12000{second}_front.jpg'
            made += put(spool, make(key, jpeg(60 * second), t_start_ns=at_ns, t_end_ns=at_ns, topic='/camera'))
        for item in made[:2]:
            add(store, tmp_path / 'tmp', item.key, item.path.read_bytes())
            settle(spool, item, State.DELIVERED)
    finally:
        spool.close()
    history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
    assert history.answer({'do': 'days', 'robot': 'thor'})[0] == {'days': ['2025-10-18']}
    for second, where in enumerate(('the store', 'the store', 'the spool')):
        head, body = history.moment('thor', NOON_NS_OF_SPOOL + second * SECOND + 1)
        (topic, kind, before, told_where), *_ = head['shown']
        assert (kind, before, told_where.partition(':')[0]) == ('camera', 0.0, where)
        assert items(body)[topic][1] == jpeg(60 * second)


NOON_NS_OF_SPOOL = 1_760_788_800 * SECOND


def recorded(path: Path, begin_s: float, seconds: int = 1, late_s: float = 0) -> Any:
    """A slice with ten frames and a hundred IMU samples per second, in chunks of 64 KiB."""
    camera, imu = (Channel(topic, kind, 'ros2msg', '', '', '') for topic, kind in (('/bagged', COMPRESSED_IMAGE), ('/imu', IMU)))
    vector, turn = (
        new('geometry_msgs/msg/Vector3', x=1.0, y=2.0, z=3.0),
        new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
    )
    unknown = {f'{name}_covariance': np.zeros(9) for name in ('orientation', 'angular_velocity', 'linear_acceleration')}
    sample = new(IMU, header=header(), orientation=turn, angular_velocity=vector, linear_acceleration=vector, **unknown)
    writer = SliceWriter(path, compression='none', chunk_bytes=64 << 10)
    still = cdr(sample, IMU)
    for number in range(100 * seconds):
        at_ns = NOON_NS + round((begin_s + number / 100) * SECOND)
        log_ns = at_ns + round(late_s * SECOND)
        writer.write(imu, log_ns, at_ns, number, still)
        if number % 10 == 0:
            shade = jpeg(2 * (number % 100))
            frame = new(COMPRESSED_IMAGE, header=header(), format='jpeg', data=np.frombuffer(shade, np.uint8))
            writer.write(camera, log_ns, at_ns, number, cdr(frame, COMPRESSED_IMAGE))
    return writer.close()


def bag(store: ObjectStore, folder: Path, name: str, event: str, seconds: int = 1, late_s: float = 0) -> list[Row]:
    """A complete bag of one slice in the store; returns the rows of its files."""
    (folder / 'tmp').mkdir(exist_ok=True)
    info = recorded(folder / 'tmp' / f'{name}_0.mcap', 20.0, seconds, late_s)
    key = f'thor/rosbags/{name}/{name}_0.mcap'
    trigger = TriggerOf(event, 'service', NOON_NS + 20 * SECOND, HOSTILE)
    manifest = Manifest(name, 'thor', MissionOf('patrol', 'm1', None), COMPLETE, (), (), (SliceEntry.of(info, key),),
                        EventOf(event, 5.0, 5.0, 5.0, (trigger,)))  # fmt: skip
    bodies = {key: info.path.read_bytes(), f'thor/rosbags/{name}/manifest.json': manifest.to_json()}
    rows = []
    for each, body in bodies.items():
        add(store, folder / 'tmp', each, body)
        times = {'t_start_ns': str(info.t_start_ns), 't_end_ns': str(info.t_end_ns)}
        rows.append(row_of(BUCKET, each, len(body), '', {'robot': 'thor', 'sensor': 'bag', 'bag': name, **times}))
    return rows


def test_a_bag_is_read_by_ranges(store: ObjectStore, opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame of the time and the series before it come from the bag; its event is a mark, its cut a command.

    For a bag of a minute the store sends the data near the time and the index: less than a fifth of it.
    """
    name = f'bump_{utc(NOON_NS + 20 * SECOND):%Y%m%d_%H%M%S}'
    rows = bag(store, tmp_path, name, 'bump', seconds=60)
    add_part(store, rows, 'a', tmp_path / 'tmp')
    history = opened(StorePast())
    got: list[str] = []
    sent: list[int] = []
    for method in ('get', 'content'):
        whole = getattr(type(store), method)
        monkeypatch.setattr(type(store), method, lambda self, bucket, key, *more, whole=whole, **named:
                            got.append(key) or whole(self, bucket, key, *more, **named))  # fmt: skip
    ranges = type(store).ranges

    def counted(self: Any, bucket: str, key: str, spans: Any) -> Any:
        found = ranges(self, bucket, key, spans)
        sent.extend(len(each) for each in found)
        return found

    monkeypatch.setattr(type(store), 'ranges', counted)
    head, shown = asked(history, 50.55)
    assert shown['/bagged'][1] == jpeg(100)
    assert shown['/imu'][0]['rows'] >= 151
    assert [key for key in got if key.endswith('.mcap')] == []
    assert 0 < sum(sent) < max(row['bytes'] for row in rows) / 5
    cut = dict(head['commands'])['bag cut']
    assert shlex.split(cut)[:4] == ['shadowhound-data', 'bag', 'cut', name]
    noon = NOON_NS // 1_000_000
    found, _ = history.answer({'do': 'timeline', 'robot': 'thor', 'from': noon, 'to': noon + 60_000})
    assert [(kind, name) for kind, name, *_ in found['marks']] == [('bag', name), ('event', 'bump')]
    assert [begin for kind, _, begin, *_ in found['marks'] if kind == 'event'] == [noon + 20_000]
    assert '\x1b' not in json.dumps(found)


def test_a_hostile_store_is_answered_without_what_is_wrong(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Keys with ``..``, invalid images and documents, names with code: the valid data is shown."""
    patrol(store, tmp_path)
    (tmp_path / 'secret.jpg').write_bytes(jpeg(7))
    joints, points = 'sensor_msgs/msg/JointState', 'sensor_msgs/msg/PointCloud2'
    rows = [
        object_row(5.2, 'camera', '/climbs', COMPRESSED_IMAGE, 'jpg'), object_row(5.2, 'odom', '/no-json', ODOMETRY, 'json'),
        object_row(5.2, 'camera', '/bomb', COMPRESSED_IMAGE, 'jpg'), object_row(5.2, 'odom', '/deep', ODOMETRY, 'json'),
        object_row(5.2, 'x', HOSTILE, HOSTILE, 'jpg', mission_id=HOSTILE), object_row(5.2, 'joints', '/names', joints, 'json'),
        object_row(5.2, 'lidar', '/cloud', points, 'pcd'),
    ]  # fmt: skip
    for place, row in enumerate(rows):
        row['key'] = f'thor/hostile/{place}.{row["key"].rpartition(".")[2]}'
    rows[0]['key'] = 'thor/../../../secret.jpg'
    bomb = bytearray(jpeg(1))
    frame = bomb.index(b'\xff\xc0')
    bomb[frame + 5 : frame + 9] = b'\xff\xdc\xff\xdc'
    names = {'stamp_ns': NOON_NS, 'name': [[HOSTILE]], 'position': [1e400]}
    bodies = [
        b'{"samples": [{"stamp_ns": "now"}]}', bytes(bomb), b'{"samples":' + b'[' * 900, jpeg(1),
        json.dumps({'samples': [names]}).encode(), b'VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nPOINTS 4000000\nDATA binary\n',
    ]  # fmt: skip
    for row, body in zip(rows[1:], bodies, strict=True):
        add(store, tmp_path / 'tmp', row['key'], body)
    add_part(store, rows, 'hostile', tmp_path / 'tmp')
    history = opened(StorePast())
    head, shown = asked(history, 5.5)
    assert {topic for topic, *_ in head['shown']} == {'/camera', '/odom', HOSTILE.replace('\x1b', '\\x1b')}
    assert shown['/camera'][1] == jpeg(100)
    noon = NOON_NS // 1_000_000
    found, _ = history.answer({'do': 'timeline', 'robot': 'thor', 'from': noon, 'to': noon + 60_000})
    assert '\x1b' not in json.dumps([found, head], ensure_ascii=False)
    assert commands('thor', 0, SECOND, ['a; reboot', '$(reboot)', '../x']) == commands('thor', 0, SECOND, [])


def test_labels_are_marks_and_an_operator_adds_them(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Those in the store are on the timeline, with their authors; ``label list`` reads a new one."""
    patrol(store, tmp_path)
    history = opened(StorePast())
    noon = NOON_NS // 1_000_000
    timeline = {'do': 'timeline', 'robot': 'thor', 'from': noon, 'to': noon + 60_000}

    def labelled() -> list[Any]:
        while (found := history.answer(timeline)[0])['labels']:
            assert not found['problem']
        return [mark for mark in found['marks'] if mark[0] == 'label']

    assert labelled() == []
    given = {'do': 'label', 'robot': 'thor', 'note': HOSTILE, 'by': 'operator at ::1', 'from': noon + 1000, 'to': noon + 2500}
    added, _ = history.answer({**given, 'label': 'stairs'})
    (mark,) = labelled()
    assert mark[:4] == ['label', 'stairs', noon + 1000, noon + 2500]
    assert mark[4].endswith('by operator at ::1')
    assert '\x1b' not in mark[4]
    (found,) = labels.read(Bucket(folder_store(tmp_path), BUCKET), 'thor')
    assert (found.id, found.label, found.since_ns, found.by) == (added['id'], 'stairs', NOON_NS + SECOND, 'operator at ::1')
    for wrong in ({'label': HOSTILE}, {'label': ' '}, {'label': 'x', 'to': noon}, {'label': 'x', 'robot': 'nobody'}):
        with pytest.raises(LabelRefused):
            history.answer({**given, **wrong})


def test_kept_data_is_shown_and_requested(store: ObjectStore, opened: Opened, tmp_path: Path,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """For a store: how much of a time is only on the robot, a request for it, its states, and its cancellation."""
    monkeypatch.setattr(kept_module, 'FRESH_S', -1.0)
    with closing(Field(tmp_path)) as field:
        field.records(*range(6))
        history = opened(StorePast())
        noon = NOON_NS_OF_SPOOL // 1_000_000
        span = {'robot': 'thor', 'from': noon + 2000, 'to': noon + 4500}

        def asked(do: str, **more: Any) -> dict[str, Any]:
            return history.answer({'do': do, **span, **more})[0]

        assert asked('timeline')['kept'] == [['/camera', noon + 2000, noon + 4000]]
        found = asked('kept')['kept']
        assert (list(found), found['camera']['objects'], found['camera']['bytes']) == (['camera'], 3, 3000)
        for wrong in ({'sensor': 'lidar'}, {'sensor': HOSTILE}, {'sensor': 'camera', 'to': noon + 2000}, {'robot': 'nobody'}):
            with pytest.raises((PullRefused, ValueError, KeyError)):
                asked('pull', by='operator_::1', **wrong)
        name = asked('pull', sensor='camera', by='operator_::1')['id']
        (one,) = asked('requests')['requests']
        assert (one['id'], one['state'], one['by'], one['sensor'], one['from']) == (
            name, 'asked', 'operator___1', 'camera', noon + 2000
        )  # fmt: skip
        field.passes()
        field.passes()
        (one,) = asked('requests')['requests']
        assert (one['state'], one['objects'], one['sent'], one['sent_bytes']) == ('done', 3, 3, 3000)
        assert asked('timeline')['kept'] == []
        assert asked('kept', **{'from': noon})['kept']['camera']['objects'] == 2
        again = asked('pull', sensor='camera', by='viewer', **{'from': noon})['id']
        asked('pull', cancel=again, by='viewer')
        field.passes()
        field.passes()
        assert [one['state'] for one in asked('requests')['requests'] if one['id'] == again] == ['cancelled']
        with pytest.raises(PullRefused):
            asked('pull', cancel='0' * 32, by='viewer')


def test_data_kept_in_a_spool_is_requested_from_its_node(store: ObjectStore, opened: Opened, tmp_path: Path,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """On the robot the index has the size; the request is sent to the node, and is handled like any other."""
    with closing(Field(tmp_path)) as field:
        field.records(*range(6))

        def ask(do: str, want: dict[str, Any], by: str) -> dict[str, Any]:
            return {'ok': do == 'pull', 'id': field.server.ask(want, by)}

        monkeypatch.setattr(kept_module, 'connect', lambda *_: SimpleNamespace(ask=ask, close=lambda: None))
        history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
        noon = NOON_NS_OF_SPOOL // 1_000_000
        span = {'robot': 'thor', 'from': noon + 2000, 'to': noon + 4500}
        assert history.answer({'do': 'kept', **span})[0]['kept']['camera']['objects'] == 3
        name = history.answer({'do': 'pull', 'sensor': 'camera', 'by': 'operator', **span})[0]['id']
        field.passes()
        field.passes()
        (one,) = history.answer({'do': 'requests', 'robot': 'thor'})[0]['requests']
        assert (one['id'], one['state'], one['objects'], one['sent']) == (name, 'done', 3, 3)
        assert field.kept() == [0, 1, 5]
        assert history.answer({'do': 'kept', **span})[0]['kept'] == {}


def test_an_unreachable_store_delays_no_timeline(opened: Opened, store: ObjectStore, tmp_path: Path,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """The rest is shown, with a note that the labels are still being read."""
    patrol(store, tmp_path)
    answers = threading.Event()
    monkeypatch.setattr(module, 'LABELS_S', 0.01)
    monkeypatch.setattr(module, '_read_labels', lambda _: answers.wait(60) and [])
    noon = NOON_NS // 1_000_000
    try:
        found, _ = opened(StorePast()).answer({'do': 'timeline', 'robot': 'thor', 'from': noon, 'to': noon + 60_000})
    finally:
        answers.set()
    assert [kind for kind, *_ in found['marks']] == ['mission']
    assert (found['labels'], found['problem']) == ('reading', '')


@pytest.mark.parametrize('question', [
    {'do': 'days', 'robot': '../x'}, {'do': 'timeline', 'robot': 'thor', 'from': 0, 'to': 10**14},
    {'do': 'read', 'robot': 'thor'}, {'do': 'moment', 'robot': 'thor', 'at': 10**14 * 9}, {},
])  # fmt: skip
def test_an_invalid_question_is_refused(opened: Opened, question: dict[str, Any]) -> None:
    """It gets an error, and the process continues."""
    with pytest.raises((ValueError, OverflowError)):
        opened(StorePast()).answer(question)


@pytest.mark.long('processes that read the past')
def test_the_idle_process_exits_and_restarts(store: ObjectStore, tmp_path: Path) -> None:
    """When idle, after a kill, and after a request that took too long."""
    patrol(store, tmp_path)

    async def gone(pid: int) -> None:
        while Path(f'/proc/{pid}').exists():
            await asyncio.sleep(0.02)

    async def run() -> None:
        past = HistoryProcess([], idle_s=0.3)
        assert past.pid is None
        assert (await past.ask({'do': 'robots'}))[0] == {'robots': ['thor']}
        pid = past.pid or 0
        await asyncio.wait_for(gone(pid), 60)
        assert past.pid is None
        past = HistoryProcess([])
        both = await asyncio.gather(past.ask({'do': 'robots'}), past.ask({'do': 'days', 'robot': '..'}))
        assert both[1][0]['is_wrong']
        os.kill(past.pid or 0, signal.SIGKILL)
        with pytest.raises(PastUnavailable):
            await past.ask({'do': 'robots'})
        assert (await past.ask({'do': 'robots'}))[0] == {'robots': ['thor']}
        await past.close()
        slow = HistoryProcess([], answer_s=0.01)
        with pytest.raises(PastUnavailable, match='TimeoutError'):
            await slow.ask({'do': 'robots'})
        assert slow.pid is None
        await slow.close()

    asyncio.run(run())


def pauses(found: list[list[Any]], topic: str) -> list[tuple[int, int]]:
    """Start and end of each recorded period of a topic, in seconds after noon."""
    noon = NOON_NS_OF_SPOOL // 1_000_000
    return [(round(begin - noon) // 1000, round(end - noon) // 1000) for name, begin, end in found if name == topic]


@pytest.mark.parametrize('by', ['stamp', 'received'])
def test_a_timeline_of_a_spool_has_every_pause(store: ObjectStore, opened: Opened, tmp_path: Path, by: str) -> None:
    """Though only the first and the last object of each step are read; housekeeping is not data; ``fit`` opens at the data."""
    clock = FakeClock()
    spool = new_spool(tmp_path / 'spool', clock)
    spool.open()
    late_s = 100 if by == 'received' else 0
    seconds = [*range(20), *range(40, 50), 60, *range(80, 83)]
    try:
        for sensor, topic in (('camera', '/camera'), ('_ledger', '/ledger')):
            for second in seconds:
                at_ns = NOON_NS_OF_SPOOL + second * SECOND
                arrived = str(at_ns + late_s * SECOND)
                key = f'thor/{sensor}/20251018/12{second // 60:02}{second % 60:02}_front.jpg'
                (item,) = put(spool, make(key, b'x', sensor=sensor, topic=topic, t_start_ns=at_ns, t_end_ns=at_ns,
                                          metadata={'received_start_ns': arrived, 'received_end_ns': arrived}))  # fmt: skip
                settle(spool, item, State.DELIVERED)
    finally:
        spool.close()
    history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
    noon = NOON_NS_OF_SPOOL // 1_000_000
    day = {'do': 'timeline', 'robot': 'thor', 'from': noon - 3_600_000, 'to': noon + 3_600_000, 'by': by}
    found, _ = history.answer({**day, 'fit': 1})
    assert noon + 1000 * (late_s - 20) <= found['from'] < noon + 1000 * late_s
    assert noon + 1000 * (late_s + 82) < found['to'] <= noon + 1000 * (late_s + 102)
    topic = '/camera'
    expected = [(begin + late_s, end + late_s) for begin, end in ((0, 19), (40, 49), (60, 60), (80, 82))]
    assert pauses(found['recorded'], topic) == expected
    assert {name for name, *_ in found['recorded']} == {topic}
    part, _ = history.answer({**day, 'from': noon + 1000 * (late_s + 45), 'to': noon + 1000 * (late_s + 81) + 500})
    assert pauses(part['recorded'], topic) == [(late_s + 45, late_s + 49), (late_s + 60, late_s + 60), (late_s + 80, late_s + 81)]


def test_late_and_waiting_objects_are_listed(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """For an outage of the store from 10 s on that lasted two minutes: how long they waited; and pending objects."""
    clock = FakeClock()
    spool = new_spool(tmp_path / 'spool', clock)
    spool.open()
    try:
        made = []
        for second in range(40):
            at_ns = NOON_NS_OF_SPOOL + second * SECOND
            made += put(spool, make(f'thor/camera/20251018/1200{second:02}_f.jpg', b'x', t_start_ns=at_ns, t_end_ns=at_ns))
        for begin, end, settled_s in ((0, 10, 11), (10, 30, 150)):
            clock.now_ns = NOON_NS_OF_SPOOL + settled_s * SECOND
            for item in made[begin:end]:
                settle(spool, item, State.DELIVERED)
    finally:
        spool.close()
    noon = NOON_NS_OF_SPOOL // 1_000_000
    history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
    found, _ = history.answer({'do': 'timeline', 'robot': 'thor', 'from': noon, 'to': noon + 60_000})
    (late, waits) = found['deliveries']
    assert late[2] == noon + 150_000
    assert noon + 6000 <= late[0] <= noon + 10_000
    assert waits[2] is None
    assert noon + 27_000 <= waits[0] <= noon + 30_000
    assert waits[1] == noon + 39_000


def ran(command: str, folder: Path) -> Result:
    """Run a command line of the page in a folder."""
    words = shlex.split(command)
    assert words[0] == 'shadowhound-data'
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        result = CliRunner().invoke(cli, words[1:], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result


def test_the_commands_for_a_time_run(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Query finds the data, fetch and bag cut create files, export names the mission."""
    patrol(store, tmp_path)
    name = f'bump_{utc(NOON_NS + 20 * SECOND):%Y%m%d_%H%M%S}'
    add_part(store, bag(store, tmp_path, name, 'bump', seconds=3), 'b', tmp_path / 'tmp')
    history = opened(StorePast())
    noon = NOON_NS // 1_000_000
    found, _ = history.answer({'do': 'range', 'robot': 'thor', 'from': noon + 2000, 'to': noon + 22_000})
    assert [each[0] for each in found['bags']] == [name]
    lines = dict(found['commands'])
    assert list(lines) == ['query', 'fetch', 'bag cut', 'export']
    (tmp_path / 'there').mkdir()
    assert len(json.loads(ran(f'{lines["query"]} --json', tmp_path / 'there').stdout)) >= 16
    for what, made in (('fetch', 'data'), ('bag cut', 'cut')):
        assert ran(lines[what], tmp_path / 'there').return_value == 0
        assert any(path.is_file() for path in (tmp_path / 'there' / made).rglob('*'))
    exported = ran(f'{lines["export"]} --dry-run', tmp_path / 'there')
    assert exported.return_value in {0, 1}
    assert 'm1' in exported.output


@pytest.mark.parametrize('mission', ['-rf', "it's <b>", MISSION, '日本 $HOME `id`', 'a;b|c&d>e'])
def test_the_export_of_a_mission_of_any_name(store: ObjectStore, opened: Opened, tmp_path: Path, mission: str) -> None:
    """Its name is quoted: a shell runs no part of it, and the command finds the mission."""
    add_part(store, [object_row(1, 'camera', '/camera', COMPRESSED_IMAGE, 'jpg', mission_id=mission)], 'a', tmp_path / 'tmp')
    noon = NOON_NS // 1_000_000
    found = opened(StorePast()).answer({'do': 'range', 'robot': 'thor', 'from': noon, 'to': noon + 5000})[0]
    line = dict(found['commands'])['export']
    command = f'shadowhound-data() {{ printf "%s\\0" "$@"; }}; {line}'
    typed = subprocess.run(['bash', '-c', command], capture_output=True, text=True, check=True, cwd=tmp_path, timeout=60)
    assert typed.stderr == ''
    words = typed.stdout.split('\0')[:-1]
    assert words[words.index('--mission') + 1] == mission
    assert not (tmp_path / 'attacked').exists()
    exported = ran(f'{line} --dry-run', tmp_path)
    assert exported.return_value in {0, 1}
    assert '1 waiting' in exported.output, exported.output


def test_no_command_has_a_name_that_cannot_be_read() -> None:
    """Text that changes lines, direction or is truncated on the page is not offered to be pasted into a shell."""
    hidden = ['a\nb', 'a\x1b[2Kb', 'a\u202eb', 'm' * 10_000, '']
    assert commands('thor', 0, SECOND, [], missions=hidden) == commands('thor', 0, SECOND, [])


def test_the_command_pulls_kept_data(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """It is shown only if some data of the time is on the robot."""
    with closing(Field(tmp_path)) as field:
        field.records(*range(6))
        history = opened(StorePast())
        noon = NOON_NS_OF_SPOOL // 1_000_000
        lines = dict(history.answer({'do': 'range', 'robot': 'thor', 'from': noon, 'to': noon + 2500})[0]['commands'])
        pulled = ran(f'{lines["pull"]} --dry-run --json', tmp_path)
        assert pulled.return_value == 0
        assert '"objects": 3' in pulled.stdout, pulled.stdout
        later = history.answer({'do': 'range', 'robot': 'thor', 'from': noon + 60_000, 'to': noon + 70_000})[0]
        assert 'pull' not in dict(later['commands'])


def test_a_plot_keeps_its_range_where_a_bag_covers_the_moment(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Earlier data from objects is in the same series as the data read from the bag."""
    rows = [object_row(second, 'imu', '/imu', IMU, 'json') for second in range(12, 21)]
    vector, turn = {'x': 1.0, 'y': 2.0, 'z': 3.0}, {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
    for second, row in zip(range(12, 21), rows, strict=True):
        unknown = {f'{each}_covariance': [0.0] * 9 for each in ('orientation', 'angular_velocity', 'linear_acceleration')}
        sample = {'stamp_ns': NOON_NS + second * SECOND, 'orientation': turn, 'angular_velocity': vector,
                  'linear_acceleration': vector, **unknown}  # fmt: skip
        add(store, tmp_path / 'tmp', row['key'], json.dumps({'type': IMU, 'samples': [sample]}).encode())
    name = f'bump_{utc(NOON_NS + 20 * SECOND):%Y%m%d_%H%M%S}'
    add_part(store, [*rows, *bag(store, tmp_path, name, 'bump', seconds=5)], 'a', tmp_path / 'tmp')
    head, body = asked(opened(StorePast()), 21.505)[1]['/imu']
    times = np.frombuffer(body, '<f8', head['rows'])
    noon = NOON_NS // 1_000_000
    assert times[0] == noon + 12_000
    assert times[-1] == noon + 21_500
    assert (np.diff(times) > 0).all()
    assert len(times) > 150
    figures = np.frombuffer(body, '<f4', offset=8 * head['rows']).reshape(head['rows'], -1)
    assert (figures == figures[0]).all()


def test_the_live_view_starts_with_recorded_values(store: ObjectStore, opened: Opened, tmp_path: Path) -> None:
    """Series, path and battery from the spool, with times as in live items: by a clock that only this machine has."""
    spool = new_spool(tmp_path / 'spool', FakeClock())
    spool.open()
    now_ns = time.time_ns()
    try:
        for second in range(5):
            at_ns = now_ns - (5 - second) * SECOND
            document = json.loads(odometry(second)) | {'stamp_ns': at_ns}
            metadata = {'received_start_ns': str(at_ns), 'received_end_ns': str(at_ns), 'pose': f'{second}.0 1.0 0.5 odom',
                        'battery_pct': f'{80 - second}'}  # fmt: skip
            body = json.dumps({'type': ODOMETRY, 'samples': [document]}).encode()
            put(spool, make(f'thor/odom/{utc(at_ns):%Y%m%d/%H%M%S}_odom.json', body, sensor='odom', topic='/odom', type=ODOMETRY,
                            t_start_ns=at_ns, t_end_ns=at_ns, metadata=metadata))  # fmt: skip
    finally:
        spool.close()
    history = opened(SpoolPast(tmp_path / 'spool', 'thor'), SpoolKept(tmp_path / 'spool', 'thor'))
    _, body = history.recent('thor', now_ns)
    found = items(body)
    head, rows = found['/odom']
    ages_s = time.monotonic() - np.frombuffer(rows, '<f8', head['rows']) / 1e3
    elapsed_s = (time.time_ns() - now_ns) / SECOND
    assert ages_s - elapsed_s == pytest.approx([5, 4, 3, 2, 1], abs=0.5)
    assert np.frombuffer(found[''][1], '<f4').reshape(-1, 3)[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    timeline, _ = history.answer(
        {'do': 'timeline', 'robot': 'thor', 'from': now_ns // 1_000_000 - 60_000, 'to': now_ns // 1_000_000}
    )
    assert {percent for _, percent in timeline['battery']} >= {80.0, 76.0}
