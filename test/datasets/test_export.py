"""A dataset has the recordings of each mission, as known at each tick, records gaps and sources, and survives kills."""

from __future__ import annotations

import json
import math
import os
import platform
import signal
import socket
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from datasets.recorded import House, Mission, kill_this_process, lost, video_frames, x_of
from PIL import Image, ImageColor

from shadowhound_data_logger.cli import export as verb
from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.datasets import cluster, report
from shadowhound_data_logger.datasets.export import Exported, drop, export, resumed, split_of
from shadowhound_data_logger.datasets.features import AV1, H264, ExportOptions
from shadowhound_data_logger.datasets.lerobot import DATA, OURS, SOURCE_TABLE, Lerobot, matrix
from shadowhound_data_logger.datasets.transfer import DatasetPlace, datasets_in, fetch_dataset, upload
from shadowhound_data_logger.datasets.verify import use_in_folder, use_in_store, verify
from shadowhound_data_logger.datasets.video import VideoWriter, frames_at
from shadowhound_data_logger.lake import labels, query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.labels import Label
from shadowhound_data_logger.lake.training import INFO, LABEL_TABLE, digest_of
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

PATROLS = {'mission_type': 'patrol'}


def jittered(sensor: str, number: int) -> int:
    """Each message is delayed individually, up to 8 ms."""
    return (number * 7919 + len(sensor) * 104729) % 8 * 1_000_000


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    """Three missions: a jittered one, one with gaps, one with incomplete reports from the robot."""
    made = House(tmp_path_factory.mktemp('house'))
    made.record(Mission('whole', seconds=3, jitter_ns=jittered))
    gappy = Mission('gappy', begin_s=100, seconds=4)
    gappy.has['camera'] = lambda _, stamp: not gappy.begin_ns + 1.05 * SECOND < stamp < gappy.begin_ns + 1.75 * SECOND
    gappy.has['odom'] = lambda _, stamp: not gappy.begin_ns + 2.51 * SECOND < stamp < gappy.begin_ns + 2.89 * SECOND
    gappy.gaps = (lost(gappy, 'camera', 1.0, 1.8),)
    made.record(gappy)
    made.record(Mission('fresh', begin_s=200, seconds=3, told_until_s=-3))
    return made


def rows_of(made: Lerobot, mission: str, *columns: str) -> list[np.ndarray[Any, Any]]:
    row = made.rows[made.mission_ids.index(mission)]
    table = pq.read_table(made.path(DATA, row, 'data'))
    return [matrix(table[name]) for name in columns]


@pytest.fixture(scope='module')
def exported(house: House) -> Exported:
    options = ExportOptions(state=('pose', 'imu', 'joints'), allow_gaps=False, max_stale=0.2)
    return export(house.folder / 'set', house.source, PATROLS, options)


def test_a_mission_becomes_an_episode_once_its_gaps_are_known(exported: Exported) -> None:
    """The one with incomplete reports waits, and the reason is reported."""
    assert [each['mission_id'] for each in exported.added] == ['whole', 'gappy']
    assert list(exported.waiting) == ['fresh']
    assert '3.0 s before its end so far' in exported.waiting['fresh']
    assert (exported.fps, exported.action, exported.refused) == (10, 'odometry', {})


def test_no_value_of_a_tick_comes_from_its_future(house: House, exported: Exported) -> None:
    """Each message has an individual delay: every number is still the newest one at or before its tick."""
    made = Lerobot(exported.folder)
    mission = Mission('whole', seconds=3, jitter_ns=jittered)
    stamps, state, age = rows_of(made, 'whole', 'shadowhound.stamp_ns', 'observation.state', 'shadowhound.age_s')
    names = made.info['features']['observation.state']['names'] if made.info else []
    streams = made.info['features']['shadowhound.age_s']['names'] if made.info else []
    for sensor, stream, column in (
        ('odom', 'state.pose', 'pose.x'),
        ('imu', 'state.imu', 'imu.wx'),
        ('joints', 'state.joints', 'leg3.pos'),
    ):
        published = np.array(mission.stamps(sensor))
        newest = published[np.searchsorted(published, stamps[:, 0], 'right') - 1]
        assert (newest <= stamps[:, 0]).all()
        assert state[:, names.index(column)] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
        assert age[:, streams.index(stream)] == pytest.approx((stamps[:, 0] - newest) / SECOND, abs=1e-6)
    assert state.shape == (len(stamps), 7 + 10 + 12)


def test_a_gap_is_flagged_exactly_at_its_ticks(exported: Exported) -> None:
    """With the cause in the journal, or as not published if there is none."""
    made = Lerobot(exported.folder)
    mission = Mission('gappy', begin_s=100, seconds=4)
    stamps, stale = rows_of(made, 'gappy', 'shadowhound.stamp_ns', 'shadowhound.stale')
    streams = made.info['features']['shadowhound.stale']['names'] if made.info else []
    causes = pq.read_table(made.path(DATA, made.rows[1], 'data'))['shadowhound.cause'].to_pylist()
    away = (stamps[:, 0] - mission.begin_ns) / SECOND
    camera = (away > 1.0 + 0.15) & (away < 1.8)
    odom = (away > 2.5 + 0.15) & (away < 2.9)
    assert np.array_equal(stale[:, streams.index('images.front')] == 1, camera)
    assert np.array_equal(stale[:, streams.index('state.pose')] == 1, odom)
    assert not stale[:, streams.index('state.joints')].any()
    assert camera.sum() == 6
    assert odom.sum() == 2
    for tick, cause in enumerate(causes):
        fields = dict(pair.split('=') for pair in cause.split(';') if pair)
        assert fields.get('images.front') == ('transport' if camera[tick] else None)
        assert fields.get('state.pose') == ('not_published' if odom[tick] else None)
    row = made.rows[1]
    assert json.loads(row[f'{OURS}images.front/causes']) == {'transport': 6}
    assert row[f'{OURS}images.front/stale_share'] == pytest.approx(6 / len(stamps), abs=1e-6)


def seeded_gaps(seed: int) -> tuple[Mission, dict[str, list[tuple[float, float, str]]]]:
    """A mission that loses messages of every sensor eight times; with the start, end and cause of each loss."""
    rng = np.random.default_rng(seed)
    mission = Mission(f'lossy{seed}', begin_s=1000 + 100 * seed, seconds=30)
    injected: dict[str, list[tuple[float, float, str]]] = {}
    for sensor in mission.sensors:
        begins = 1.5 + 3.5 * np.arange(8) + rng.uniform(0, 1.2, 8)
        causes = rng.choice(['transport', 'restart', ''], 8)
        ends = begins + rng.uniform(0.1, 2.0, 8)
        injected[sensor] = list(zip(begins.tolist(), ends.tolist(), causes.tolist(), strict=True))
        mission.has[sensor] = lambda _, stamp, gaps=injected[sensor]: not any(
            first < (stamp - mission.begin_ns) / SECOND < last for first, last, _ in gaps
        )  # fmt: skip
    reports = [(sensor, *gap) for sensor, gaps in injected.items() for gap in gaps if gap[2]]
    mission.gaps = [lost(mission, sensor, first, last, cause) for sensor, first, last, cause in reports]
    return mission, injected


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('seed', range(3))
def test_injected_gaps_are_flagged_at_exactly_their_ticks(tmp_path: Path, seed: int) -> None:
    """For every stream, with the cause of the gap that covers the tick, and no other ticks are flagged."""
    place = House(tmp_path)
    mission, injected = seeded_gaps(seed)
    place.record(mission)
    options = ExportOptions(state=('pose', 'imu', 'joints'), allow_gaps=True)
    export(tmp_path / 'set', place.source, PATROLS, options)
    made = Lerobot(tmp_path / 'set')
    (ticks,), (stale,) = (rows_of(made, mission.name, name) for name in ('shadowhound.stamp_ns', 'shadowhound.stale'))
    streams = made.info['features']['shadowhound.stale']['names'] if made.info else []
    causes = pq.read_table(made.path(DATA, made.rows[0], 'data'))['shadowhound.cause'].to_pylist()
    reports = [dict(pair.split('=') for pair in cause.split(';') if pair) for cause in causes]
    flagged = 0
    for sensor, stream in (('camera', 'images.front'), ('odom', 'state.pose'), ('imu', 'state.imu'), ('joints', 'state.joints')):
        published = np.array(mission.stamps(sensor))
        newest = published[np.searchsorted(published, ticks[:, 0], 'right') - 1]
        expected = ticks[:, 0] - newest > 1.5 * SECOND / 10
        assert np.array_equal(stale[:, streams.index(stream)] == 1, expected), stream
        flagged += int(expected.sum())
        for number, tick in enumerate(ticks[:, 0]):
            if not expected[number]:
                assert stream not in reports[number]
                continue
            at = (int(tick) - mission.begin_ns) / SECOND
            (cause,) = (cause for first, last, cause in injected[sensor] if first < at < last + 0.1)
            assert reports[number][stream] == (cause or 'not_published'), (stream, at)
    assert flagged > 100


def test_a_mission_with_too_large_gaps_is_refused(house: House, tmp_path: Path) -> None:
    """With the reason, on the screen and in the report; ``allow_gaps`` accepts it with its flags."""
    options = ExportOptions(max_stale=0.05)
    found = export(tmp_path / 'set', house.source, {'mission': 'gappy'}, options)
    assert list(found.refused) == ['gappy']
    assert 'images.front is stale in 1' in found.refused['gappy']
    assert 'transport 6' in found.refused['gappy']
    found = export(tmp_path / 'set', house.source, {'mission': 'gappy'}, ExportOptions(max_stale=0.05, allow_gaps=True))
    assert [each['mission_id'] for each in found.added] == ['gappy']


@pytest.mark.long('a second of CPU or more')
def test_it_waits_for_the_robots_gap_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And accepts the mission then; after some time without reports it gives up, and reports the reason."""
    place = House(tmp_path)
    mission = place.record(Mission('late', seconds=2, sensors=('camera', 'odom'), told_until_s=-3))
    looked: list[float] = []

    def sleep(seconds: float) -> None:
        looked.append(seconds)
        if len(looked) == 3:
            place.tell(mission, 1)

    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions(), wait=True, sleep=sleep)
    assert (len(looked), [each['mission_id'] for each in found.added]) == (3, ['late'])
    place.record(Mission('never', begin_s=50, seconds=2, sensors=('camera', 'odom'), told_until_s=-3))
    monkeypatch.setattr('shadowhound_data_logger.datasets.export.PATIENCE_S', 20.0)
    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions(), wait=True, sleep=looked.append)
    assert list(found.waiting) == ['never']
    assert sum(looked[3:]) == 20


def test_it_does_not_wait_for_gaps_that_cannot_be_reported(tmp_path: Path) -> None:
    """A topic that only counts received messages never has a watermark: the mission is refused, with the reason."""
    place = House(tmp_path)
    place.record(Mission('blind', seconds=2, sensors=('camera', 'odom'), uncounted=('odom',)))
    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions(), wait=True, sleep=pytest.fail)
    assert found.waiting == {}
    assert found.refused['blind'].startswith('the gaps of /odom are reported for no part of it')
    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions(allow_gaps=True))
    assert [each['mission_id'] for each in found.added] == ['blind']


def test_stale_ticks_without_a_gap_have_a_cause(tmp_path: Path) -> None:
    """Messages skipped by the settings were not sampled; without reports from the robot the cause is unknown."""
    place = House(tmp_path)
    thin = Mission('thin', seconds=2, sensors=('camera', 'odom'), skipped=7)
    thin.has['odom'] = lambda number, _: number % 10 == 0
    place.record(thin)
    open_ = Mission('open', begin_s=50, seconds=2, sensors=('camera', 'odom'), told_until_s=-3)
    open_.has['odom'] = thin.has['odom']
    place.record(open_)
    options = ExportOptions(max_age_s={'odom': 0.05}, allow_gaps=True, max_gap_s=9.0)
    export(tmp_path / 'set', place.source, PATROLS, options)
    made = Lerobot(tmp_path / 'set')
    for row, cause in zip(made.rows, ('not_sampled', 'unknown'), strict=True):
        age, stale = rows_of(made, row[f'{OURS}mission_id'], 'shadowhound.age_s', 'shadowhound.stale')
        assert np.array_equal(stale[:, 1] == 1, age[:, 1] > np.float32(0.05))
        assert 0 < stale[:, 1].sum() < len(stale)
        assert json.loads(row[f'{OURS}state.pose/causes']) == {cause: int(stale[:, 1].sum())}


def test_values_are_interpolated_between_two_messages(house: House, tmp_path: Path) -> None:
    """With linear, one period late: exactly the robot's position then, and a normalized quaternion."""
    options = ExportOptions(resample={'odom': 'linear'}, validation=0.5)
    export(tmp_path / 'set', house.source, {'mission': 'whole'}, options)
    made = Lerobot(tmp_path / 'set')
    stamps, state = rows_of(made, 'whole', 'shadowhound.stamp_ns', 'observation.state')
    stamps, state = stamps[2:], state[2:]  # x restarts with the mission
    assert state[:, 0] == pytest.approx([x_of(int(stamp)) - 0.02 for stamp in stamps[:, 0]], abs=5e-3)
    assert np.linalg.norm(state[:, 3:7], axis=1) == pytest.approx(1, abs=1e-6)
    yaw = 2 * np.arctan2(state[:, 5], state[:, 6])
    assert yaw == pytest.approx(np.sin(state[:, 0].astype(float)), abs=1e-3)


LATE_NS, LATER_NS = 146 * SECOND, 149 * SECOND


def late(mission: Mission, sensor: str, stamp: int) -> int:
    """The delay of a message: odometry is three seconds later in the second half of a mission."""
    return LATER_NS if sensor == 'odom' and stamp >= mission.begin_ns + 3 * SECOND else LATE_NS


def test_every_source_has_both_times_and_a_changed_offset_is_flagged(tmp_path: Path) -> None:
    """For images, poses and both poses of a velocity; a mission with a constant delay is not flagged."""
    house = House(tmp_path)
    changed, steady = Mission('changed', seconds=6), Mission('steady', begin_s=60, seconds=6)
    changed.late_ns = lambda sensor, stamp: late(changed, sensor, stamp)
    steady.late_ns = lambda _sensor, _stamp: LATE_NS
    for mission in (changed, steady):
        house.record(mission)
    options = ExportOptions(state=('pose', 'velocity', 'joints'))
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, options)
    assert (found.refused, found.waiting) == ({}, {})
    rows = pq.read_table(tmp_path / 'set' / SOURCE_TABLE).to_pylist()
    assert {row['stream'] for row in rows} == {'images.front', 'state.pose', 'state.velocity', 'state.joints', 'action'}
    for row in rows:
        sensor = {'images.front': 'camera', 'state.joints': 'joints'}.get(row['stream'], 'odom')
        mission = changed if row['episode_mission'] == 'changed' else steady
        assert mission.late_ns is not None
        assert row['received_ns'] - row['stamp_ns'] == mission.late_ns(sensor, row['stamp_ns'])
    fields = {each['mission_id']: each['streams'] for each in found.added}
    flagged = {(name, stream) for name, streams in fields.items() for stream, each in streams.items() if each['offset_changed']}
    assert flagged == {('changed', 'state.pose'), ('changed', 'state.velocity'), ('changed', 'action')}
    assert [fields['changed']['state.pose'][name] for name in ('offset_min_s', 'offset_max_s')] == [146.0, 149.0]
    made = Lerobot(tmp_path / 'set')
    columns = {row[f'{OURS}mission_id']: row[f'{OURS}state.pose/offset_changed'] for row in made.rows}
    assert columns == {'changed': True, 'steady': False}
    lines = [line.plain for line in verb._report(found, 'set', is_dry=False)]
    assert '    state.pose: the offset between stamps and arrivals changed, from 146.0 to 149.0 s' in lines
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None).wrong == []


@pytest.mark.parametrize('archives', [True, False])
def test_by_received_frames_have_what_had_arrived(tmp_path: Path, *, archives: bool) -> None:
    """The camera's stamps are 146 s behind: by arrival it is aligned with poses of its time, by stamps the mission has none."""
    house = House(tmp_path)
    mission = Mission('late', seconds=4, begin_s=200, sensors=('camera', 'odom'))
    late_by = {'camera': LATE_NS, 'odom': 0}
    mission.late_ns = lambda sensor, _stamp: late_by[sensor]
    every = mission.stamps
    mission.stamps = lambda sensor: [stamp - late_by[sensor] for stamp in every(sensor)]  # type: ignore[method-assign]
    house.record(mission, archives=archives)
    refused = export(tmp_path / 'by-stamp', house.source, {'mission_type': 'patrol'}, ExportOptions()).refused
    assert 'camera' in refused['late']
    options = ExportOptions(by='received')
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, options)
    assert (found.refused, found.waiting) == ({}, {})
    made = Lerobot(tmp_path / 'set')
    table = pq.read_table(made.path(DATA, made.rows[0], 'data'))
    ticks = table['shadowhound.stamp_ns'].to_numpy()
    assert mission.begin_ns <= ticks[0] <= ticks[-1] <= mission.end_ns
    assert matrix(table['observation.state'])[:, 0] == pytest.approx([x_of(int(tick)) for tick in ticks], abs=0.03)
    rows = pq.read_table(tmp_path / 'set' / SOURCE_TABLE).to_pylist()
    for row in rows:
        late_ns = late_by['camera' if row['stream'].startswith('images') else 'odom']
        assert row['received_ns'] - row['stamp_ns'] == late_ns
        assert row['received_ns'] == pytest.approx(ticks[row['frame']] - row['held_s'] * SECOND, abs=1000)
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None).wrong == []
    with pytest.raises(LakeError, match='was created with by received'):
        export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())


def test_arrivals_do_not_go_with_another_clock() -> None:
    """An arm's times are converted to the robot's; only one of the two clocks can be selected."""
    for by, arm in (('arrival', ''), ('received', 'soarm')):
        with pytest.raises(SettingError, match='by = '):
            ExportOptions(by=by, arm=arm)


def test_arrivals_that_are_unknown_are_null(tmp_path: Path) -> None:
    """Not 0; and no stream is flagged."""
    house = House(tmp_path)
    house.drive.has_arrivals = False
    house.record(Mission('old', seconds=2))
    (episode,) = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions()).added
    assert set(pq.read_table(tmp_path / 'set' / SOURCE_TABLE)['received_ns'].to_pylist()) == {None}
    assert {(each['offset_min_s'], each['offset_changed']) for each in episode['streams'].values()} == {(None, False)}


def test_a_share_of_the_missions_is_for_validation() -> None:
    """Chosen by the mission's id alone: about the share, and the same for any other missions."""
    names = [f'mission_{number}' for number in range(400)]
    held = [name for name in names if split_of(name, 0.25) == 'validation']
    assert 70 < len(held) < 130
    assert {*held} < {name for name in names if split_of(name, 0.5) == 'validation'}
    assert [name for name in names if split_of(name, 0.0) == 'validation'] == []


@pytest.mark.long('a second of CPU or more')
def test_labels_are_a_column_and_choose_validation(tmp_path: Path) -> None:
    """Each frame has those of its time and of its image; their authors are in a table, and the digest includes them."""
    place = House(tmp_path)
    mission = place.record(Mission('one', seconds=2, sensors=('camera', 'odom')))
    place.record(Mission('two', begin_s=50, seconds=2, sensors=('camera', 'odom')))
    stairs = Label(robot='thor', label='stairs; "up"', since_ns=mission.begin_ns + SECOND, until_ns=mission.begin_ns + 2 * SECOND)
    picture = query.objects(place.source, sensor='camera', mission='two').sort_by('t_start_ns').to_pylist()[-1]
    box = Label(robot='thor', label='person', since_ns=picture['t_start_ns'], until_ns=picture['t_end_ns'], bucket='sensor-data',
                key=picture['key'], x=1, y=2, width=3, height=4)  # fmt: skip
    with closing(open_store(place.settings, UploadSettings())) as store:
        labels.write(store, 'thor', [stairs, box, replace(box, label='gone')], by='ann')
        labels.write(store, 'thor', [replace(box, label='gone')], by='ben', is_removal=True)
    options = ExportOptions(labels=True, validation_label='person', allow_gaps=True)
    first = export(tmp_path / 'set', place.source, {'label': 'stairs; "up"', 'mission_type': 'patrol'}, options)
    assert [each['mission_id'] for each in first.added] == ['one']
    export(tmp_path / 'set', place.source, PATROLS, options)
    made = Lerobot(tmp_path / 'set')
    assert [row[f'{OURS}split'] for row in made.rows] == ['train', 'validation']
    assert [row[f'{OURS}labels'] for row in made.rows] == [json.dumps(['stairs; "up"']), json.dumps(['person'])]
    for row, label in zip(made.rows, (stairs, box), strict=True):
        table = pq.read_table(made.path(DATA, row, 'data'))
        for stamp, text in zip(table['shadowhound.stamp_ns'].to_pylist(), table['shadowhound.labels'].to_pylist(), strict=True):
            if label.key is None:
                assert json.loads(text) == ([label.label] if label.since_ns <= stamp <= label.until_ns else [])
        assert label.label in {name for text in table['shadowhound.labels'].to_pylist() for name in json.loads(text)}
    report = pq.read_table(made.folder / LABEL_TABLE).to_pylist()
    assert [(each['episode_mission'], each['label'], each['by'], each['width']) for each in report] == [
        ('one', 'stairs; "up"', 'ann', None), ('two', 'person', 'ann', 3.0),
    ]  # fmt: skip
    before = digest_of(made.folder)
    (made.folder / LABEL_TABLE).write_bytes(b'another')
    assert digest_of(made.folder) != before


def test_frames_in_the_video_are_the_rows(exported: Exported) -> None:
    """The same number, with their times, and similar to their sources."""
    made = Lerobot(exported.folder)
    for row in made.rows:
        path = made.folder / f'videos/observation.images.front/chunk-000/file-{row["episode_index"]:03d}.mp4'
        times = [time for time, _ in video_frames(path)]
        assert times == pytest.approx(np.arange(row['length']) / 10, abs=1e-9)


def test_an_export_passes_verification(house: House, exported: Exported) -> None:
    """And later changes, here or in the store, are found."""
    store = DirectoryStore(house.settings.directory)
    store.open()
    found = verify(exported.folder, store, frames=None, is_read=True)
    assert found.wrong == []
    assert (found.episodes, found.least_ssim > 0.9) == (2, True)
    assert found.frames == sum(row['length'] for row in Lerobot(exported.folder).rows)


def test_verification_finds_changes(house: House, tmp_path: Path) -> None:
    """A byte of a file, and a changed object."""
    place = House(tmp_path)
    place.record(Mission('only', seconds=2, sensors=('camera', 'odom')))
    export(tmp_path / 'set', place.source, PATROLS, ExportOptions(is_lossless=True))
    store = DirectoryStore(place.settings.directory)
    store.open()
    assert verify(tmp_path / 'set', store, frames=None).wrong == []
    picture = sorted((place.settings.directory / 'sensor-data/thor/camera').rglob('*.tar'))[1]
    body = picture.read_bytes()
    picture.write_bytes(body[:700] + bytes([body[700] ^ 1]) + body[701:])
    data = tmp_path / 'set/data/chunk-000/file-000.parquet'
    data.write_bytes(data.read_bytes() + b' ')
    wrong = verify(tmp_path / 'set', store, is_read=True).wrong
    assert any('data/chunk-000/file-000.parquet differs from what was written' in each for each in wrong)
    assert any(picture.name in each and 'has changed' in each for each in wrong)


def test_another_mission_rewrites_nothing_before_it(house: House, tmp_path: Path) -> None:
    """The files of earlier episodes are unchanged, byte for byte, and the digest changes."""
    first = export(tmp_path / 'set', house.source, {'mission': 'whole'}, ExportOptions())
    before = {path: path.read_bytes() for path in sorted((tmp_path / 'set').rglob('file-000.*'))}
    assert len(before) == 3
    second = export(tmp_path / 'set', house.source, {'mission': 'gappy'}, ExportOptions(allow_gaps=True))
    assert second.present == ['whole']
    assert {path: path.read_bytes() for path in before} == before
    assert first.digest != second.digest
    made = Lerobot(tmp_path / 'set')
    assert [row['dataset_from_index'] for row in made.rows] == [0, made.rows[0]['length']]


@pytest.mark.long('starts two processes that import Daft')
def test_two_workers_write_what_one_writes(house: House, exported: Exported, tmp_path: Path) -> None:
    """And so does an export from scratch."""
    options = ExportOptions(state=('pose', 'imu', 'joints'), max_stale=0.2)
    export(tmp_path / 'set', house.source, PATROLS, options, workers=2)
    assert contents(tmp_path / 'set') == contents(exported.folder)


def test_the_report_shows_stale_ticks_in_red(exported: Exported) -> None:
    """On a timeline for each stream of each episode, and nowhere else on it."""
    made, picture = Lerobot(exported.folder), Image.open(exported.folder / 'meta/report.png').convert('RGB')
    assert picture.size == (report.WIDTH, len(made.rows) * (report.HEIGHT + report.GAP) + report.GAP)
    found = []
    for place, row in enumerate(made.rows):
        stale = made.numbers(row, 'shadowhound.stale')
        top, each = report.GAP + place * (report.HEIGHT + report.GAP) + report.HEIGHT - 30, max(2, 22 // stale.shape[1])
        for tick, stream in np.ndindex(*stale.shape):
            at = report.GAP + (report.WIDTH - 2 * report.GAP) * (tick + 0.5) / len(stale), top + stream * each + 1
            is_red = picture.getpixel((int(at[0]), at[1])) == ImageColor.getrgb(report.RED)
            assert is_red == bool(stale[tick, stream]), (place, tick, stream)
            found.append(is_red)
    assert 0 < sum(found) < len(found)


def test_nan_is_never_in_a_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message with NaN is ignored: the previous value is held until it is stale."""
    place = House(tmp_path)
    mission = Mission('odd', seconds=2, sensors=('camera', 'odom'))
    is_odd = lambda stamp: mission.begin_ns + SECOND <= stamp < mission.begin_ns + 1.4 * SECOND  # noqa: E731
    monkeypatch.setattr('datasets.recorded.x_of', lambda stamp: math.nan if is_odd(stamp) else x_of(stamp))
    place.record(mission)
    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions(allow_gaps=True))
    assert [each['mission_id'] for each in found.added] == ['odd']
    made = Lerobot(tmp_path / 'set')
    stamps, state, action, age, stale = rows_of(
        made, 'odd', 'shadowhound.stamp_ns', 'observation.state', 'action', 'shadowhound.age_s', 'shadowhound.stale'
    )
    assert all(np.isfinite(each).all() for each in (state, action, age))
    published = np.array([stamp for stamp in mission.stamps('odom') if not is_odd(stamp)])
    newest = published[np.searchsorted(published, stamps[:, 0], 'right') - 1]
    assert state[:, 0] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
    assert np.array_equal(stale[:, 1] == 1, stamps[:, 0] - newest > 0.15 * SECOND)
    assert 2 <= stale[:, 1].sum() <= 4


def test_statistics_are_those_of_all_frames(exported: Exported) -> None:
    """Of the numbers of all episodes together, with exact quantiles."""
    made = Lerobot(exported.folder)
    stats = json.loads((exported.folder / 'meta/stats.json').read_text())
    state = np.concatenate([rows_of(made, mission, 'observation.state')[0] for mission in made.mission_ids])
    assert stats['observation.state']['q50'] == pytest.approx(np.quantile(state, 0.5, axis=0).tolist(), abs=1e-6)
    assert stats['observation.state']['std'] == pytest.approx(state.std(axis=0).tolist(), abs=1e-5)
    assert stats['observation.state']['count'] == [len(state)]
    assert np.array(stats['observation.images.front']['mean']).shape == (3, 1, 1)


def test_commands_are_the_action_where_they_were_logged(tmp_path: Path) -> None:
    """The newest one at or before the tick, not marked as derived; a mission without commands is refused."""
    place = House(tmp_path)
    commanded = place.record(Mission('commanded', seconds=2, sensors=('camera', 'odom', 'cmd_vel')))
    place.record(Mission('silent', begin_s=50, seconds=2, sensors=('camera', 'odom')))
    found = export(tmp_path / 'set', place.source, PATROLS, ExportOptions())
    made = Lerobot(tmp_path / 'set')
    stamps, action = rows_of(made, 'commanded', 'shadowhound.stamp_ns', 'action')
    published = np.array(commanded.stamps('cmd_vel'))
    newest = published[np.searchsorted(published, stamps[:, 0], 'right') - 1]
    assert action[:, 0] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
    assert made.info is not None
    assert made.info['features']['action']['info'] == {'units': ['m/s', 'm/s', 'rad/s'], 'source': 'cmd_vel', 'derived': False}
    assert found.refused == {'silent': 'the store has no data of cmd_vel in it'}


def test_other_settings_need_another_dataset(house: House, exported: Exported, tmp_path: Path) -> None:
    """The settings of its creation hold for all of it; unknown names are refused, and the valid ones are listed."""
    with pytest.raises(LakeError, match='was created with codec av1'):
        export(exported.folder, house.source, PATROLS, ExportOptions(state=('pose', 'imu', 'joints'), codec='h264'))
    found = export(tmp_path / 'set', house.source, {'mission': 'whole'}, ExportOptions(fps=30))
    assert found.refused == {'whole': '/camera has 10 Hz in the objects, less than 30 frames per second'}
    with pytest.raises(SettingError, match='state = '):
        ExportOptions(state=('mood',))


@pytest.mark.long('a second of CPU or more')
def test_an_episode_is_taken_out(house: House, exported: Exported, tmp_path: Path) -> None:
    """Everywhere in the dataset, permanently; the others get the numbers that they would have without it."""
    options = ExportOptions(max_stale=0.3)
    export(tmp_path / 'set', house.source, PATROLS, options)
    key = pq.read_table(tmp_path / 'set' / SOURCE_TABLE)['key'][0].as_py()
    seen = use_in_folder(tmp_path / 'set', key)
    assert seen is not None
    assert seen.missions == ('whole',)
    drop(tmp_path / 'set', 'whole')
    made = resumed(tmp_path / 'set')
    assert made.mission_ids == ['gappy']
    text = b''.join(contents(tmp_path / 'set').values())
    assert b'"whole"' not in text
    table = pq.read_table(made.path(DATA, made.rows[0], 'data'))
    assert table['index'].to_pylist() == list(range(len(table)))
    assert set(table['episode_index'].to_pylist()) == {0}
    assert use_in_folder(tmp_path / 'set', key) is None
    assert export(tmp_path / 'set', house.source, PATROLS, options).added == []
    store = DirectoryStore(house.settings.directory)
    store.open()
    assert verify(tmp_path / 'set', store).wrong == []


def test_a_dataset_is_uploaded_and_fetched_unchanged(house: House, exported: Exported, tmp_path: Path) -> None:
    """Verified, the second time without a transfer, and an object leads to its datasets."""
    store = DirectoryStore(house.settings.directory)
    store.open()
    place = DatasetPlace.of('s3://lerobot/datasets/go2/patrol')
    moved = upload(exported.folder, place, store)
    assert moved.files == len(contents(exported.folder))
    assert upload(exported.folder, place, store).files == 0
    assert list(datasets_in(store)) == [place]
    fetch_dataset(place, tmp_path / 'back', store)
    assert contents(tmp_path / 'back') == contents(exported.folder)
    (tmp_path / 'back/data/chunk-000/file-777.parquet').write_bytes(b'stray')
    assert fetch_dataset(place, tmp_path / 'back', store).removed == 1
    sources = pq.read_table(exported.folder / 'meta/shadowhound_sources.parquet')
    key = sources['key'][0].as_py()
    seen = use_in_store(Bucket(house.settings, 'lerobot'), place, f'sensor-data/{key}')
    assert seen is not None
    assert seen.missions == ('whole',)
    assert seen.digests == (exported.digest,)
    assert use_in_folder(exported.folder, 'thor/nothing.jpg') is None


def test_lerobot_doctor_finds_nothing_wrong(exported: Exported) -> None:
    """An independent reader: all of its format checks pass."""
    from lerobot_doctor.dataset_loader import load_dataset
    from lerobot_doctor.runner import Severity, run_checks

    results = run_checks(load_dataset(str(exported.folder)))
    assert len(results.results) >= 8
    assert [
        (each.name, message.message) for each in results.results for message in each.messages if message.severity is Severity.FAIL
    ] == []


def test_videos_are_encoded_without_real_time_limits(tmp_path: Path) -> None:
    """As root, SVT-AV1 would get real-time priority over everything else on the machine; this is prevented."""
    before = os.sched_getscheduler(0)
    with VideoWriter(tmp_path / 'a.mp4', 10, (64, 64), AV1) as video:
        video.add(np.zeros((64, 64, 3), np.uint8))
        assert {os.sched_getscheduler(int(thread.name)) for thread in Path('/proc/self/task').iterdir()} == {before}


@pytest.mark.parametrize('codec', [AV1, H264])
def test_single_frames_of_a_video_are_those_of_all(tmp_path: Path, codec: str) -> None:
    path = tmp_path / 'a.mp4'
    with VideoWriter(path, 10, (64, 64), codec) as video:
        for number in range(21):
            video.add(np.full((64, 64, 3), 10 * number, np.uint8))
    every = [pixels for _, pixels in video_frames(path)]
    wanted = [0, 1, 7, 12, 20]
    for number, pixels in zip(wanted, frames_at(path, 10, wanted), strict=True):
        assert np.array_equal(pixels, every[number]), number
    with pytest.raises(LakeError, match='has the frames 3, 21'):
        list(frames_at(path, 10, [3, 21]))


def test_a_missing_ray_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the store is read."""
    monkeypatch.setitem(sys.modules, 'ray', None)
    with pytest.raises(BadUsage) as refused:
        CliRunner().invoke(verb.export, ['lerobot', 'patrols', '--ray', 'auto'], standalone_mode=False, catch_exceptions=False)
    assert refused.value.message == 'ray is not installed'
    assert "pip install 'daft[ray]'" in refused.value.remedy


def test_an_unreachable_address_is_reported_immediately(tmp_path: Path) -> None:
    """Also if ray is not installed."""
    job: Any = (None, None, 0, None, tmp_path)
    with closing(socket.socket()) as taken:
        taken.bind(('127.0.0.1', 0))  # and does not listen
        port = taken.getsockname()[1]
        for address in (f'127.0.0.1:{port}', f'ray://127.0.0.1:{port}', 'ray://127.0.0.1:99999'):
            with pytest.raises(LakeError, match=f'no Ray cluster at {address}'):
                cluster.Cluster(address).built([job], None, print)


def test_a_worker_with_other_libraries_is_refused(tmp_path: Path) -> None:
    """Its episodes would differ in bytes; the error names the difference, and the worker."""
    wanted = {**cluster.library_versions(), 'av': '1.0', 'architecture': 'riscv64'}
    with pytest.raises(LakeError, match=rf'has architecture {platform.machine()} instead of riscv64, av .* instead of 1\.0'):
        cluster.Builder().build((), wanted)  # type: ignore[arg-type]


DYING = """
import os, signal, sys
from pathlib import Path
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.core.options import StoreSettings

folder, store, at, real, done = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), os.replace, 0
def replace(*arguments, **more):
    global done
    done += 1
    if done == at:
        os.kill(os.getpid(), signal.SIGKILL)
    real(*arguments, **more)
os.replace = replace
export(folder, Bucket(StoreSettings(directory=store), BUCKET), {'mission_type': 'patrol'}, ExportOptions())
"""


class Killed(BaseException):
    """An exception without a handler: as after a kill, no cleanup follows."""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for part in ('data', 'meta', 'videos')
            for path in sorted((folder / part).rglob('*')) if path.is_file() and path.suffix != '.part'}  # fmt: skip


@pytest.fixture(scope='module')
def two_missions(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(2):
        made.record(Mission(f'm{number}', begin_s=100 * number, seconds=2, sensors=('camera', 'odom')))
    return made


def dying(patch: pytest.MonkeyPatch, at: int) -> None:
    """The process is killed at its ``at``-th rename."""
    real, done = os.replace, 0

    def replace(*arguments: Any, **more: Any) -> None:
        nonlocal done
        done += 1
        if done == at:
            raise Killed
        real(*arguments, **more)

    patch.setattr(os, 'replace', replace)


@pytest.mark.long('an export for each file that it writes')
def test_a_killed_export_resumes(two_missions: House, tmp_path: Path) -> None:
    """At every file that it writes: of an episode, of the dataset, the last one."""
    export(tmp_path / 'whole', two_missions.source, PATROLS, ExportOptions())
    wanted = contents(tmp_path / 'whole')
    for at in range(1, 100):
        folder = tmp_path / f'set{at}'
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                export(folder, two_missions.source, PATROLS, ExportOptions())
            except Killed:
                pass
            else:
                break
        export(folder, two_missions.source, PATROLS, ExportOptions())
        assert contents(folder) == wanted, at
    assert at > 15


@pytest.mark.long('an export for each file that it writes')
def test_after_a_kill_another_process_continues_the_export(two_missions: House, tmp_path: Path) -> None:
    """After SIGKILL, in an episode and while the dataset is written."""
    export(tmp_path / 'whole', two_missions.source, PATROLS, ExportOptions())
    wanted = contents(tmp_path / 'whole')
    for at in (1, 4, 12):
        folder = tmp_path / f'set{at}'
        arguments = [sys.executable, '-c', DYING, str(folder), str(two_missions.settings.directory), str(at)]
        environ = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
        assert subprocess.run(arguments, env=environ, check=False, timeout=120).returncode == -signal.SIGKILL
        export(folder, two_missions.source, PATROLS, ExportOptions())
        assert contents(folder) == wanted, at


@pytest.mark.long('an export for each file that it writes')
def test_a_killed_worker_is_reported(two_missions: House, tmp_path: Path) -> None:
    """Nothing was added; the next run gives the same files."""
    export(tmp_path / 'whole', two_missions.source, PATROLS, ExportOptions())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('shadowhound_data_logger.datasets.export.build', kill_this_process)
        with pytest.raises(LakeError, match='a process was killed while building episodes; m0 is not finished'):
            export(tmp_path / 'set', two_missions.source, PATROLS, ExportOptions(), workers=2)
    assert not (tmp_path / 'set' / INFO).exists()
    export(tmp_path / 'set', two_missions.source, PATROLS, ExportOptions(), workers=2)
    assert contents(tmp_path / 'set') == contents(tmp_path / 'whole')


@pytest.mark.long('an export for each file that it writes')
def test_a_killed_drop_is_completed(two_missions: House, tmp_path: Path) -> None:
    """The next process that opens the dataset completes it: nothing of the mission is left."""
    export(tmp_path / 'whole', two_missions.source, PATROLS, ExportOptions())
    drop(tmp_path / 'whole', 'm0')
    wanted = contents(tmp_path / 'whole')
    for at in range(1, 100):
        folder = tmp_path / f'set{at}'
        export(folder, two_missions.source, PATROLS, ExportOptions())
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                drop(folder, 'm0')
            except Killed:
                pass
            else:
                break
        made = resumed(folder)
        if 'm0' in made.mission_ids:  # before the intent was recorded
            assert at == 1
            continue
        assert contents(folder) == wanted, at
    assert at > 5
