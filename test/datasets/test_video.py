"""One file for each episode's video or one for all of them: the same frames, with the same results of adding and dropping."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from datasets.recorded import House, Mission
from datasets.test_export import Killed, contents, dying

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.export import drop, export, resumed
from shadowhound_data_logger.datasets.features import AV1, H264, SHARED, ExportOptions
from shadowhound_data_logger.datasets.lerobot import DATA, Lerobot
from shadowhound_data_logger.datasets.mobile import SET
from shadowhound_data_logger.datasets.transfer import DatasetPlace, fetch_dataset, upload
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.datasets.video import Clip, count_frames, frames_of, join
from shadowhound_data_logger.stores.directory import DirectoryStore

KEY = 'observation.images.front'
VIDEO = f'videos/{KEY}/chunk-000/file-000.mp4'
SECONDS = (1.0, 2.0, 1.5)
"""At 10 frames per second these are 11, 21 and 16 frames: the first of an episode is at an odd position, too."""


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number, seconds in enumerate(SECONDS):
        made.record(Mission(f'm{number}', begin_s=100 * number, seconds=seconds, sensors=('camera', 'odom')))
    return made


def exported(house: House, folder: Path, *missions: str, layout: str = SHARED, codec: str = AV1) -> Lerobot:
    for mission in missions or ('m',):
        found = export(folder, house.source, {'mission': mission}, ExportOptions(layout=layout, codec=codec))
        assert found.refused == {}
    return Lerobot(folder)


def assert_same_frames(one: Lerobot, other: Lerobot) -> None:
    """For each mission of the first one, in sequence and out of order."""
    for row in one.rows:
        mine = list(one.images(row, KEY))
        (theirs,) = [each for each in other.rows if each['shadowhound/mission_id'] == row['shadowhound/mission_id']]
        wanted = list(other.images(theirs, KEY))
        assert len(mine) == len(wanted) == row['length']
        assert all(np.array_equal(*pair) for pair in zip(mine, wanted, strict=True))
        some = list(one.images_at(row, KEY, (1, 6, row['length'] - 1)))
        assert all(np.array_equal(*pair) for pair in zip(some, (wanted[1], wanted[6], wanted[-1]), strict=True))


@pytest.fixture(scope='module')
def plain(house: House) -> Lerobot:
    return exported(house, house.folder / 'plain', layout='episode')


@pytest.mark.parametrize('codec', [AV1, pytest.param(H264, marks=pytest.mark.long('the same with another codec'))])
def test_one_video_has_the_frames_of_all_episodes(house: House, tmp_path: Path, codec: str) -> None:
    """As encoded: the position in the file is the frame's number in the dataset, which lerobot streams by."""
    made = exported(house, tmp_path / 'set', codec=codec)
    own = exported(house, tmp_path / 'own', layout='episode', codec=codec)
    assert [path.name for path in sorted((tmp_path / 'set').rglob('*.mp4'))] == ['file-000.mp4']
    assert count_frames(tmp_path / 'set' / VIDEO) == sum(row['length'] for row in made.rows) == 11 + 21 + 16
    for row in made.rows:
        assert row[f'videos/{KEY}/from_timestamp'] == row['dataset_from_index'] / 10
        assert row[f'videos/{KEY}/to_timestamp'] == row['dataset_to_index'] / 10
    assert_same_frames(made, own)
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None).wrong == []


def test_episodes_added_later_give_the_same_bytes(house: House, tmp_path: Path, plain: Lerobot) -> None:
    """Three together or one after the other: the same bytes; and existing ones keep their positions."""
    exported(house, tmp_path / 'once')
    first = exported(house, tmp_path / 'then', 'm0')
    rows = list(first.rows)
    made = exported(house, tmp_path / 'then', 'm1', 'm2')
    assert made.rows[:1] == rows
    assert_same_frames(made, plain)
    once, then = contents(tmp_path / 'once'), contents(tmp_path / 'then')
    assert [name for name in once if once[name] != then[name]] == ['meta/shadowhound_digests.json', 'meta/shadowhound_files.json']


def test_a_dropped_episode_leaves_the_bytes_of_a_dataset_that_never_had_it(house: House, tmp_path: Path, plain: Lerobot) -> None:
    """Its frames are gone from the file, and the others are unchanged, with the bytes of a dataset that never had it."""
    exported(house, tmp_path / 'set')
    drop(tmp_path / 'set', 'm1')
    made = Lerobot(tmp_path / 'set')
    assert_same_frames(made, plain)
    others = ['m0', 'm2']
    without = exported(house, tmp_path / 'without', *others)
    assert made.mission_ids == without.mission_ids == others
    assert (tmp_path / 'set' / VIDEO).read_bytes() == (tmp_path / 'without' / VIDEO).read_bytes()
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None).wrong == []
    for each in others:
        drop(tmp_path / 'set', each)
    assert not list((tmp_path / 'set').rglob('*.mp4'))


def test_a_dataset_keeps_its_layout(house: House, tmp_path: Path) -> None:
    exported(house, tmp_path / 'set', 'm0')
    with pytest.raises(LakeError, match='was created with layout shared'):
        exported(house, tmp_path / 'set', 'm1', layout='episode')
    exported(house, tmp_path / 'own', 'm0', layout='episode')
    with pytest.raises(LakeError, match='was created with layout episode'):
        exported(house, tmp_path / 'own', 'm1')


def test_a_later_setting_differs_from_that_of_the_dataset(house: House, tmp_path: Path) -> None:
    """A setting added later differs, and so does one that is no longer given."""
    exported(house, tmp_path / 'set', 'm0')
    with pytest.raises(LakeError, match='was created with labels none'):
        export(tmp_path / 'set', house.source, {'mission': 'm1'}, ExportOptions(layout=SHARED, labels=True))


def test_a_dataset_with_shared_videos_is_uploaded_and_fetched(house: House, tmp_path: Path, plain: Lerobot) -> None:
    """After an episode is added, only the shared video is uploaded again, completely."""
    store, place = DirectoryStore(house.settings.directory), DatasetPlace.of(f's3://lerobot/datasets/go2/{tmp_path.name}')
    exported(house, tmp_path / 'set', 'm0', 'm1')
    upload(tmp_path / 'set', place, store)
    exported(house, tmp_path / 'set', 'm2')
    moved = upload(tmp_path / 'set', place, store)
    assert moved.bytes > (tmp_path / 'set' / VIDEO).stat().st_size
    fetch_dataset(place, tmp_path / 'back', store)
    assert contents(tmp_path / 'back') == contents(tmp_path / 'set')
    assert_same_frames(Lerobot(tmp_path / 'back'), plain)


def test_a_task_has_a_video_of_each_mission(house: House, tmp_path: Path, plain: Lerobot) -> None:
    exported(house, tmp_path / SET)
    for row in plain.rows:
        path = tmp_path / 'go2' / row['shadowhound/mission_id'] / 'camera_front.mp4'
        found = list(frames_of(Clip(path, 0, 100), 10))
        assert all(np.array_equal(*pair) for pair in zip(found, plain.images(row, KEY), strict=True))


def test_kept_images_are_marked_as_images(house: House, tmp_path: Path) -> None:
    """Otherwise the ``datasets`` library takes them for bytes when it streams; also after a drop."""
    export(tmp_path / 'set', house.source, {'mission': 'm'}, ExportOptions(is_lossless=True))
    for _ in range(2):
        made = Lerobot(tmp_path / 'set')
        for row in made.rows:
            schema = pq.read_schema(made.path(DATA, row, 'data'))
            assert schema.metadata[b'huggingface'] == b'{"info": {"features": {"observation.images.front": {"_type": "Image"}}}}'
        drop(tmp_path / 'set', made.mission_ids[0])


def test_videos_that_cannot_be_joined_are_refused(house: House, tmp_path: Path, plain: Lerobot) -> None:
    """Videos with a different codec, and one with fewer frames than it should have."""
    other = exported(house, tmp_path / 'other', 'm1', layout='episode', codec=H264)
    clips = [plain.clip(plain.rows[0], KEY), other.clip(other.rows[0], KEY)]
    with (
        (tmp_path / 'out.mp4').open('wb') as file,
        pytest.raises(LakeError, match='by another version or in another way'),
    ):
        join(clips, 10, file)
    with (tmp_path / 'out.mp4').open('wb') as file, pytest.raises(LakeError, match='have 11 of 12 frames'):
        join([Clip(clips[0].path, 0, 12)], 10, file)
    (tmp_path / 'no.mp4').write_bytes(b'no video')
    with (tmp_path / 'out.mp4').open('wb') as file, pytest.raises(LakeError, match='cannot be joined'):
        join([Clip(tmp_path / 'no.mp4', 0, 12)], 10, file)


@pytest.mark.long('an export for each file that it writes')
@pytest.mark.parametrize('layout', [SHARED, 'episode'])
def test_a_killed_append_resumes(house: House, tmp_path: Path, layout: str) -> None:
    """At each file that adding an episode writes; and the earlier episodes can be read in between."""
    exported(house, tmp_path / 'whole', 'm0', 'm1', layout=layout)
    wanted = contents(tmp_path / 'whole')
    for at in range(1, 100):
        folder = tmp_path / f'set{at}'
        before = exported(house, folder, 'm0', layout=layout)
        frames = list(before.images(before.rows[0], KEY))
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                exported(house, folder, 'm1', layout=layout)
            except Killed:
                pass
            else:
                break
        between = Lerobot(folder)
        assert all(np.array_equal(*pair) for pair in zip(between.images(between.rows[0], KEY), frames, strict=True))
        exported(house, folder, 'm1', layout=layout)
        assert contents(folder) == wanted, at
    assert at > 10


@pytest.mark.long('a drop for each file that it writes')
@pytest.mark.parametrize('mission', ['m0', 'm1'])
def test_a_killed_drop_from_a_shared_video_is_completed(house: House, tmp_path: Path, mission: str) -> None:
    """The next process that opens the dataset completes it: the file has the frames of the others, once."""
    exported(house, tmp_path / 'whole')
    drop(tmp_path / 'whole', mission)
    wanted = contents(tmp_path / 'whole')
    for at in range(2, 100):
        folder = tmp_path / f'set{at}'
        exported(house, folder)
        with pytest.MonkeyPatch.context() as patch:
            dying(patch, at)
            try:
                drop(folder, mission)
            except Killed:
                pass
            else:
                break
        assert mission not in resumed(folder).mission_ids
        assert contents(folder) == wanted, at
    assert at > 5
