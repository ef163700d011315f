"""The images of a mission: created independently from the journals, in a process that does not block the sender."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from missions.fakes import FakeSpooler, FakeTracking, journalling
from missions.server import until
from missions.test_delivery import deliver
from PIL import Image

from shadowhound_data_logger.missions import pictures
from shadowhound_data_logger.missions.folder import MissionFolder, missions, read_json
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.pictures import NAMES, PictureProcess, make, picture_data, read_path

WIDTH = 800


def jpeg(shade: int) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((48, 64, 3), shade, np.uint8)))


def fly(home: Path, *, frames: int = 3, broken: int = 0, states: int = 5, rows: str = '') -> MissionFolder:
    """A mission on the disk."""
    home.mkdir(exist_ok=True)
    with journalling(home, frame_artifact_every_s=0.0) as logger:
        logger.start_mission('patrol', '')
        for number in range(frames):
            logger.log_camera_frame(jpeg(40 * number), number)
        for number in range(broken):
            logger.log_camera_frame(b'\xff\xd8 no picture', 100 + number)
        for number in range(states):
            logger.log_robot_state(90.0 - number, 40.0 + number, number)
        if rows:
            (home / 't.csv').write_text(rows)
            logger.log_trajectory(home / 't.csv')
        logger.end_mission(True, 1.0, 1.0)
    return next(missions(home))


def path(count: int = 50) -> str:
    return 'timestamp,x,y,yaw\n' + ''.join(f'{1e9 + n / 10},{n / 20},{n % 7 / 100},0\n' for n in range(count))


def test_a_mission_has_three_images(tmp_path: Path) -> None:
    """All with the same width, with a floor plan if available, and without notes."""
    folder = fly(tmp_path, frames=7, rows=path())
    np.save(folder.floor, np.random.default_rng(1).uniform(-3, 3, (500, 2)).astype(np.float32))
    assert make(folder, 'patrol_1') == dict.fromkeys(NAMES, '')
    for name in NAMES:
        with Image.open(folder.files / name) as image:
            image.load()
            assert image.width == WIDTH
            assert 200 < image.height < 1000
            assert len(set(image.convert('L').tobytes())) > 10


def test_an_image_that_cannot_be_drawn_costs_only_itself(tmp_path: Path) -> None:
    """The note contains the reason, and the other images exist."""
    folder = fly(tmp_path, frames=2, broken=1, rows='timestamp,x,y\n1,nan,2\nx,1,2\n')
    folder.floor.write_bytes(b'no array')
    notes = make(folder, 'patrol_1')
    assert notes == {
        'camera_summary.jpg': '1 of 3 frames are not images', 'trajectory.png': notes['trajectory.png'], 'battery.png': '',
    }  # fmt: skip
    assert notes['trajectory.png'].startswith('not made: ')
    assert sorted(path.name for path in folder.files.iterdir() if path.name in NAMES) == ['battery.png', 'camera_summary.jpg']


def test_an_empty_mission_has_no_images(tmp_path: Path) -> None:
    """Nothing is drawn without data, and the notes contain the reasons."""
    folder = fly(tmp_path, frames=0, states=1)
    assert make(folder, 'patrol_1') == {
        'camera_summary.jpg': 'not made: no camera frame was sampled', 'trajectory.png': 'not made: no trajectory was logged',
        'battery.png': 'not made: neither battery nor temperature was logged twice',
    }  # fmt: skip


def test_the_nodes_data_replace_missing_data(tmp_path: Path) -> None:
    """Values that the agent did not log are taken from the node, and only those."""
    folder = fly(tmp_path, frames=0, states=3)
    folder.node.files.mkdir(parents=True)
    (folder.node.files / 'a.jpg').write_bytes(jpeg(1))
    node = Journal(folder.node.journal)
    node.create()
    start_ns = picture_data(folder).start_ns
    node.append({'k': 'frame', 't': start_ns + 10**9, 'id': 4, 'file': 'a.jpg', 'artifact': True})
    node.append({'k': 'metrics', 't': start_ns + 10**9, 's': 0, 'm': {'battery_pct': 1.0, 'temperature_c': 2.0}})
    node.close()
    found = picture_data(folder)
    assert [frame[1:] for frame in found.frames] == [(4, folder.node.files / 'a.jpg')]
    assert [value for _, value in found.states['battery_pct']] == [90.0, 89.0, 88.0]


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('timestamp,x,y,yaw\n1,2,3,4\n', [(1.0, 2.0, 3.0)]),
        ('timestamp,x,y,yaw\n1760788800000000000,2,3,4\n', [(1760788800.0, 2.0, 3.0)]),
        ('timestamp,x,y\n2025-10-18T12:00:00Z,2,3\n2025-10-18T12:00:00,2,3\n', [(1760788800.0, 2.0, 3.0)] * 2),
        (' Y , X , Timestamp\n3,2,1\n', [(1.0, 2.0, 3.0)]),
        ('timestamp,x,y\n1,inf,3\n1,2\n\n\0\0\n4,5,6\n', [(4.0, 5.0, 6.0)]),
        ('timestamp,x,y\n', []),
    ],
)
def test_a_trajectory_is_read(tmp_path: Path, text: str, expected: list[tuple[float, float, float]]) -> None:
    """Seconds, nanoseconds and ISO times; columns in any order; lines without numbers are skipped."""
    (tmp_path / 't.csv').write_text(text)
    assert read_path(tmp_path / 't.csv') == expected


def test_a_speed_plot_has_no_noise() -> None:
    """Centimeters of noise at 20 Hz do not make a robot that walks at 0.5 m/s a runner; constant times give no speed."""
    from shadowhound_data_logger.missions.plots import _speed  # loads matplotlib, which only delays the worker that runs it

    time = np.arange(0, 20, 0.05)
    xy = np.stack([0.5 * time, np.zeros_like(time)], axis=1) + np.random.default_rng(1).normal(0, 0.01, (len(time), 2))
    assert np.abs(_speed(time, xy)[20:-20] - 0.5).max() < 0.08
    assert _speed(np.zeros(3), np.ones((3, 2))).tolist() == [0.0] * 3


@pytest.mark.long('a process that imports much')
def test_a_separate_process_draws(tmp_path: Path) -> None:
    """It blocks no process; its notes are kept, and a later sender does not draw again."""
    folder = fly(tmp_path, rows=path())
    here = PictureProcess()
    assert here.make(folder, 'patrol_1') is None
    assert here.busy
    assert until(lambda: here.make(folder, 'patrol_1'), 'the pictures are made') == dict.fromkeys(NAMES, '')
    assert not here.busy
    assert PictureProcess().make(folder, 'patrol_1') == dict.fromkeys(NAMES, '')
    assert all((folder.files / name).is_file() for name in NAMES)


@pytest.mark.parametrize('program', ['no_such_module', 'hang'])
def test_a_process_that_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """If it exits or hangs, the mission continues without images, and the next mission is drawn."""
    hanging = tmp_path / 'hang.py'
    hanging.write_text('import time\ntime.sleep(600)\n')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    monkeypatch.setattr(pictures, 'PROGRAM', program)
    now = [0.0]
    here = PictureProcess(monotonic=lambda: now[0])
    folder = fly(tmp_path / 'a', frames=0, states=0)
    assert here.make(folder, 'patrol_1') is None
    now[0] = pictures.DEADLINE_S + 1
    notes = until(lambda: here.make(folder, 'patrol_1'), 'it is given up')
    assert set(notes) == set(NAMES)
    assert 'the process that creates the pictures exited with' in notes['battery.png']
    assert not here.busy


def test_a_mission_waits_for_its_images(tmp_path: Path) -> None:
    """They are artifacts of its run, and the summary has their outcome, as artifact and as object."""
    folder = fly(tmp_path)
    answers = iter([None, None])

    def pictures(folder: MissionFolder, title: str) -> dict[str, str] | None:
        assert title == folder.mission_id.rpartition('_')[0]
        if next(answers, folder) is None:
            return None
        (folder.files / 'battery.png').write_bytes(b'a plot')
        return {'battery.png': '', 'trajectory.png': 'not made: nobody walked'}

    tracking, spooler = FakeTracking(), FakeSpooler()
    deliver(folder, tracking, spooler, pictures)
    assert tracking.artifacts['battery.png'] == b'a plot'
    assert 'trajectory.png' not in tracking.artifacts
    assert tracking.artifacts['summary.json'] == spooler.objects[-1].body
    summary = json.loads(spooler.objects[-1].body)
    assert summary['pictures'] == {'battery.png': '', 'trajectory.png': 'not made: nobody walked'}
    assert read_json(folder.summary) == summary
