"""The folder of a mobile manipulation task: the recordings of robot and arm, and both in one training set.

``TASK/go2/MISSION/`` has ``odometry.mcap``, ``camera_front.mp4`` and ``joint_states.csv``, ``TASK/soarm/MISSION/`` the arm's
``joint_states.csv`` and ``joint_commands.csv``, all messages at their own rates; ``TASK/synchronized/`` has ``lerobot/`` (the
training set), ``timestamps.csv`` (the messages of each frame) and, if any were logged, ``detections.json``.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.keys import is_name, printable
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.datasets.clocks import ClockOffset
from shadowhound_data_logger.datasets.episodes import EPISODE
from shadowhound_data_logger.datasets.features import ARM_COMMANDS, ARM_JOINTS, ARM_TOPICS
from shadowhound_data_logger.datasets.lerobot import OURS, SOURCE_TABLE, EpisodeRow, Lerobot
from shadowhound_data_logger.datasets.plan import EpisodePlan
from shadowhound_data_logger.datasets.series import Recordings, Series
from shadowhound_data_logger.datasets.video import join
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from numpy.typing import NDArray

SET: Final = 'synchronized/lerobot'
"""The training set, in the folder of a task."""
GO2, ARM = 'go2', 'soarm'
TIMESTAMPS, DETECTIONS = 'synchronized/timestamps.csv', 'synchronized/detections.json'
ODOMETRY: Final = 'nav_msgs/msg/Odometry'
FRAMES: Final = 'odom', 'base_link'
"""Of the Go2's driver."""
MAX_DETECTIONS: Final = 64 << 20
"""Maximum size of an object with detections."""


def task_of(folder: Path) -> Path | None:
    """The task's folder that contains a training set; None if it is elsewhere."""
    return folder.parent.parent if (folder.parent.name, folder.name) == tuple(SET.split('/')) else None


def write_recordings(task: Path, plan: EpisodePlan, settings: StoreSettings, work: Path) -> None:
    """Write the recordings of robot and arm in a mission. Raises StoreError, LakeError, BagDamaged, OSError."""
    place, store = Place(settings), open_store(settings, UploadSettings())
    name, begin = plan.mission.mission_id, plan.mission.begin_ns
    try:
        of_robot = Recordings(place, store, plan.tracks, plan.topics, (begin, plan.mission.end_ns), plan.bags, work)
        with of_robot as recordings:
            folder = _fresh(_folder(task, GO2, name))
            if (odometry := recordings.best('odom')) is not None:
                _write_odometry(folder / 'odometry.mcap', recordings.series(odometry, decode.ODOMETRY))
            if (joints := recordings.best('joints')) is not None:
                _write_joints(folder / 'joint_states.csv', recordings.series(joints, ('position',)), None)
        if seen := list(_detections(plan, place)):
            _write_json(folder / 'detections.json', seen)
        if plan.arm is None or plan.arm.clock is None:
            return
        own = tuple(int(each) for each in plan.arm.clock.other_ns(np.array([begin, plan.mission.end_ns])))
        with Recordings(place, store, plan.arm.tracks, plan.arm.topics, (own[0], own[1]), plan.bags, work) as recordings:
            folder = _fresh(_folder(task, ARM, name))
            for sensor in (ARM_JOINTS, ARM_COMMANDS):
                if (recording := recordings.best(sensor)) is not None:
                    series = recordings.series(recording, ('position',))
                    _write_joints(folder / f'{ARM_TOPICS[sensor]}.csv', series, plan.arm.clock)
    finally:
        store.close()


def synchronize(task: Path) -> list[str]:
    """Write the files about all episodes. Returns what is missing, for the screen."""
    made = Lerobot(task / SET)
    for row in made.rows:
        for key in made.video_keys():
            target = _folder(task, GO2, row[f'{OURS}mission_id']) / f'camera_{key.rpartition(".")[2]}.mp4'
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.is_file():
                with replacing(target) as file:
                    join([made.clip(row, key)], made.fps, file)
    with replacing(task / TIMESTAMPS) as file:
        text = io.TextIOWrapper(file, 'utf-8', newline='')
        _write_timestamps(made, text)
        text.detach()  # which flushes
    found = {
        row[f'{OURS}mission_id']: _read_json(_folder(task, GO2, row[f'{OURS}mission_id']) / 'detections.json')
        for row in made.rows
    }
    if any(found.values()):
        episodes = [{'episode_index': row['episode_index'], 'mission_id': row[f'{OURS}mission_id'],
                 'detections': found[row[f'{OURS}mission_id']]} for row in made.rows]  # fmt: skip
        _write_json(task / DETECTIONS, {'episodes': episodes})
        return []
    (task / DETECTIONS).unlink(missing_ok=True)
    return [f'No detections were logged: there is no {DETECTIONS}.']


def forget(task: Path, mission_id: str) -> None:
    """Remove the recordings of a mission."""
    for part in (GO2, ARM):
        rmtree(_folder(task, part, mission_id), ignore_errors=True)


def _folder(task: Path, part: str, mission_id: str) -> Path:
    """The folder of a mission. Raises LakeError for an id (from a store) that would be outside of the task's folder."""
    if not is_name(mission_id):
        raise LakeError(f'the mission {printable(mission_id)!r} has a name that is invalid for a folder')
    return task / part / mission_id


def _fresh(folder: Path) -> Path:
    rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _write_odometry(path: Path, series: Series) -> None:
    """Poses and velocities as published; the catalog's objects contain no covariances."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    definition, hashed = types.generate_msgdef(ODOMETRY, ros_version=2)
    channel = Channel(series.recording.topic, ODOMETRY, 'ros2msg', definition, hashed, '')
    made: Any = types.types
    writer = SliceWriter(path)
    for number, (stamp, row) in enumerate(zip(series.stamps.tolist(), series.values.tolist(), strict=True)):
        point, turn = made['geometry_msgs/msg/Point'](*row[:3]), made['geometry_msgs/msg/Quaternion'](*row[3:7])
        pose = made['geometry_msgs/msg/PoseWithCovariance'](made['geometry_msgs/msg/Pose'](point, turn), np.zeros(36))
        vectors = (made['geometry_msgs/msg/Vector3'](*row[begin : begin + 3]) for begin in (7, 10))
        twist = made['geometry_msgs/msg/TwistWithCovariance'](made['geometry_msgs/msg/Twist'](*vectors), np.zeros(36))
        time = made['builtin_interfaces/msg/Time'](stamp // SECOND, stamp % SECOND)
        message = made[ODOMETRY](made['std_msgs/msg/Header'](time, FRAMES[0]), FRAMES[1], pose, twist)
        writer.write(channel, stamp, stamp, number, bytes(types.serialize_cdr(message, ODOMETRY)))
    writer.close()


def _write_joints(path: Path, series: Series, clock: ClockOffset | None) -> None:
    width = series.values.shape[1]
    names = series.names if len(series.names) == width else tuple(f'joint_{number}' for number in range(width))
    stamps = [series.stamps] if clock is None else [clock.robot_ns(series.stamps), series.stamps]
    with path.open('w', newline='', encoding='utf-8') as file:
        table = csv.writer(file)
        table.writerow([*(('stamp_ns',) if clock is None else ('robot_ns', 'arm_ns')), *names])
        table.writerows([*times, *values] for *times, values in zip(*(each.tolist() for each in stamps), series.values.tolist(),
                                                                    strict=True))  # fmt: skip


def _detections(plan: EpisodePlan, place: Place) -> Iterator[dict[str, Any]]:
    """The messages of the mission, as stored."""
    for track in plan.detections:
        for number in track.within(plan.mission.begin_ns, plan.mission.end_ns):
            wanted = track.object(int(number))
            for record in decode.records(place.read(wanted.bucket, wanted.key, MAX_DETECTIONS)):
                stamp = int(record['stamp_ns']) + int(track.offset_ns[number])
                if plan.mission.begin_ns <= stamp <= plan.mission.end_ns:
                    yield {
                        **record,
                        'stamp_ns': stamp,
                        'source': {'bucket': wanted.bucket, 'key': wanted.key, 'sha256': wanted.sha256},
                    }


def _write_timestamps(made: Lerobot, file: io.TextIOWrapper) -> None:
    """One row per frame: its tick, and for each stream its newest message, by the clock of the stream."""
    table = csv.writer(file)
    sources = pq.read_table(made.folder / SOURCE_TABLE, columns=[EPISODE, 'frame', 'stream', 'stamp_ns'])
    streams: Sequence[str] = made.info['features']['shadowhound.stale']['names'] if made.info else []
    table.writerow(['episode_index', 'mission_id', 'frame_index', 'tick_ns', *(f'{each}.stamp_ns' for each in streams),
                    'arm_offset_ns', 'arm_uncertainty_ns'])  # fmt: skip
    for row in made.rows:
        mine = sources.filter(pc.equal(sources[EPISODE], row[f'{OURS}mission_id']))
        ticks = made.numbers(row, 'shadowhound.stamp_ns')[:, 0]
        columns = [ticks.tolist(), *(_newest(mine, stream, row['length']).tolist() for stream in streams)]
        columns += _clock_columns(row, ticks)
        table.writerows(
            [row['episode_index'], row[f'{OURS}mission_id'], frame, *stamps]
            for frame, stamps in enumerate(zip(*columns, strict=True))
        )


def _newest(sources: Any, stream: str, frames: int) -> NDArray[np.int64]:
    found = np.zeros(frames, np.int64)
    mine = sources.filter(pc.equal(sources['stream'], stream))
    np.maximum.at(found, mine['frame'].to_numpy(), mine['stamp_ns'].to_numpy())
    return found


def _clock_columns(row: EpisodeRow, ticks: NDArray[np.int64]) -> list[list[Any]]:
    named = f'{OURS}clock/'
    if f'{named}at_ns' not in row:
        return [[''] * len(ticks)] * 2
    clock = ClockOffset(**{name: row[f'{named}{name}'] for name in ClockOffset.__slots__})
    return [(clock.other_ns(ticks) - ticks).tolist(), [clock.uncertainty_ns] * len(ticks)]


def _write_json(path: Path, value: Any) -> None:
    with replacing(path) as file:
        file.write(json.dumps(value, indent=1).encode())


def _read_json(path: Path) -> Sequence[Mapping[str, Any]]:
    return list(json.loads(path.read_bytes())) if path.is_file() else []
