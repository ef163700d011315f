"""Brings recordings of an arm that others made into the store, where they are sources like ours: hashed, and in the catalogue.

LeRobotDataset v2.1 and v3.0 (https://github.com/huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx) and HDF5 as ACT and
ALOHA write it (https://github.com/tonyzhaozh/aloha, record_episodes.py). Joints and commands become objects of the arm, each
with the SHA-256 of the file that they came from; pictures stay where they are.
"""

from __future__ import annotations

import csv
import hashlib
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.catalogue import parts, schema
from shadowhound_data_logger.clock import EARLIEST_SANE_NS, SECOND, utc
from shadowhound_data_logger.datasets.features import ARM_COMMANDS, ARM_JOINTS, ARM_TOPICS, JOINT_STATE
from shadowhound_data_logger.datasets.lerobot import matrix
from shadowhound_data_logger.durable_files import fingerprint
from shadowhound_data_logger.errors import ForeignObject, LakeError, SettingError
from shadowhound_data_logger.keys import dated
from shadowhound_data_logger.lake.bucket import put_part
from shadowhound_data_logger.lake.training import INFO
from shadowhound_data_logger.model import Put, SpooledObject
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from numpy.typing import NDArray

AS_RECORDED: Final = 'lerobot/joints'
"""Positions in whatever they were recorded in: LeRobot writes down no unit."""
PART: Final = 3000
"""Samples of an object."""
COLUMNS: Final = ('episode', 'begin_ns')
_ARM: Final = ('waist', 'shoulder', 'elbow', 'forearm_roll', 'wrist_angle', 'wrist_rotate', 'gripper')
ALOHA: Final = tuple(f'{side}_{joint}' for side in ('left', 'right') for joint in _ARM)
"""Its fourteen joints, in the order of ``qpos``."""


@dataclass(frozen=True, slots=True)
class Demonstration:
    """One episode of an arm, by its own clock."""

    stamps_ns: NDArray[np.int64]
    names: tuple[str, ...]
    positions: NDArray[np.float64]
    """(samples, joints)."""
    commands: NDArray[np.float64] | None
    type: str
    source: str
    sha256: str
    """Of the file."""


@dataclass(slots=True)
class Imported:
    """What was brought in; what was there already is counted apart."""

    episodes: int = 0
    samples: int = 0
    objects: int = 0
    present: int = 0


def times_of(path: Path) -> dict[int, int]:
    """Episode -> when it began by the arm's clock, of a CSV file with ``episode,begin_ns``. Raises SettingError."""
    try:
        with path.open(newline='', encoding='utf-8') as file:
            found = {int(row['episode']): int(row['begin_ns']) for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SettingError('--times', path, f'a CSV file with the columns {",".join(COLUMNS)} ({error})') from error
    if any(not EARLIEST_SANE_NS <= begin < 1 << 62 for begin in found.values()):
        raise SettingError('--times', path, 'times in ns since 1970')
    return found


def of_lerobot(folder: Path, times: Mapping[int, int], *, is_degrees: bool) -> Iterator[Demonstration]:
    """The episodes of a LeRobotDataset v2.1 or v3.0 of which it is known when they began.

    That is what ``times`` say, else its column ``shadowhound.stamp_ns``. Raises LakeError.
    """
    info = _info(folder)
    features = info['features']
    names = tuple(_joint(name) for name in _names(features['observation.state']))
    wanted = ['episode_index', 'timestamp', 'observation.state']
    wanted += [name for name in ('action', 'shadowhound.stamp_ns') if name in features]
    has_action = 'action' in features and features['action']['shape'] == features['observation.state']['shape']
    count = 0
    for path in sorted((folder / 'data').rglob('*.parquet')):
        try:
            table = pq.read_table(path, columns=wanted)
            columns = {name: matrix(table[name]) for name in wanted}
        except (pa.ArrowException, OSError, ValueError) as error:
            raise LakeError(f'{path} is no data of a LeRobotDataset: {error}') from error
        sha256 = fingerprint(path)[1]
        for number in np.unique(columns['episode_index']):
            rows = columns['episode_index'][:, 0] == number
            stamps = _stamps(int(number), {name: values[rows] for name, values in columns.items()}, times)
            values = [columns[name][rows].astype(np.float64) for name in ('observation.state', 'action')[: 1 + has_action]]
            if any(each.shape[1] != len(names) for each in values):
                raise LakeError(f'{path} has not the {len(names)} joints that {INFO} says')
            values = [np.deg2rad(each) for each in values] if is_degrees else values
            count += 1
            kind, source = JOINT_STATE if is_degrees else AS_RECORDED, path.relative_to(folder).as_posix()
            yield Demonstration(stamps, names, values[0], values[1] if has_action else None, kind, source, sha256)
    if not count:
        raise LakeError(f'{folder} has no episode', remedy='name the folder of a LeRobotDataset')


def _info(folder: Path) -> dict[str, Any]:
    try:
        info = dict(json.loads((folder / INFO).read_bytes()))
        version = str(info['codebase_version'])
        state = info['features']['observation.state']
        if version not in {'v2.1', 'v3.0'} or len(state['shape']) != 1:
            raise LakeError(f'{folder} is a data set of version {version}', remedy='v2.1 and v3.0 can be imported')
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise LakeError(f'{folder} is no LeRobotDataset: {error}', remedy=f'it has {INFO} with observation.state') from error
    return info


def _names(feature: Mapping[str, Any]) -> list[str]:
    names = feature.get('names')
    while isinstance(names, dict) and names:  # {"motors": [...]} in older ones
        names = next(iter(names.values()))
    count = feature['shape'][0]
    return list(map(str, names)) if isinstance(names, list) and len(names) == count else [f'joint_{n}' for n in range(count)]


def _joint(name: str) -> str:
    return name.removesuffix('.pos').removeprefix('main_').removeprefix('arm_')


def _stamps(number: int, columns: Mapping[str, NDArray[Any]], times: Mapping[int, int]) -> NDArray[np.int64]:
    if number not in times:
        if 'shadowhound.stamp_ns' in columns:
            return columns['shadowhound.stamp_ns'][:, 0].astype(np.int64)
        raise LakeError(f'nobody knows when episode {number} began: LeRobot counts from 0 in each of them',
                        remedy=f'--times FILE, a CSV with {",".join(COLUMNS)}')  # fmt: skip
    seconds = columns['timestamp'][:, 0].astype(np.float64)
    if not np.isfinite(seconds).all() or np.abs(seconds).max(initial=0) > 1e6:
        raise LakeError(f'episode {number} has times that make no sense')
    return times[number] + np.rint(seconds * SECOND).astype(np.int64)


def of_hdf5(
    paths: Sequence[Path], times: Mapping[int, int], *, fps: float, joints: Sequence[str] = ()
) -> Iterator[Demonstration]:
    """The n-th file is episode n: ``observations/qpos`` and ``action``, (samples, joints). Raises LakeError."""
    import h5py  # noqa: PLC0415 - of the extra; nothing else needs it

    for number, path in enumerate(paths):
        if number not in times:
            raise LakeError(f'nobody knows when episode {number} ({path.name}) began',
                            remedy=f'--times FILE, a CSV with {",".join(COLUMNS)}')  # fmt: skip
        try:
            with h5py.File(path, 'r') as file:
                positions = np.asarray(file['observations/qpos'], np.float64)
                commands = np.asarray(file['action'], np.float64) if 'action' in file else None
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise LakeError(f'{path} is no demonstration in the layout of ACT and ALOHA: {error}') from error
        if positions.ndim != 2 or not len(positions) or (commands is not None and commands.shape != positions.shape):
            raise LakeError(f'{path}: observations/qpos and action are not of one shape, (samples, joints)')
        width = positions.shape[1]
        names = tuple(joints) or (ALOHA if width == len(ALOHA) else tuple(f'joint_{n}' for n in range(width)))
        if len(names) != width:
            raise LakeError(f'{path} has {width} joints, not {len(names)}', remedy='--joints names them in their order')
        stamps = times[number] + np.rint(np.arange(len(positions)) * (SECOND / fps)).astype(np.int64)
        yield Demonstration(stamps, names, positions, commands, JOINT_STATE, path.name, fingerprint(path)[1])


def bring(demonstrations: Iterator[Demonstration], arm: str, store: ObjectStore) -> Imported:
    """Store them as what the arm recorded, and tell the catalogue. Again, it changes nothing. Raises LakeError, StoreError."""
    found = Imported()
    for each in demonstrations:
        rows: list[schema.Row] = []
        for sensor, values in ((ARM_JOINTS, each.positions), (ARM_COMMANDS, each.commands)):
            if values is None:
                continue
            for begin in range(0, len(values), PART):
                some = slice(begin, begin + PART)
                rows.append(_store(each, sensor, arm, store, (each.stamps_ns[some], values[some]), found))
        name = f'{utc(int(each.stamps_ns[0])):%Y%m%dT%H%M%S}_import_{each.sha256[:12]}'
        for date in sorted({schema.date_of(row) for row in rows}):
            mine = [row for row in rows if schema.date_of(row) == date]
            put_part(store, schema.OBJECTS.part_key(arm, date, name), arm, parts.encode(mine), len(mine))
        found.episodes += 1
        found.samples += len(each.positions)
    return found


def _store(each: Demonstration, sensor: str, arm: str, store: ObjectStore, some: tuple[NDArray[np.int64], NDArray[np.float64]],
           found: Imported) -> schema.Row:  # fmt: skip
    stamps, values = some
    names = list(each.names)
    samples = [
        {'stamp_ns': int(stamp), 'name': names, 'position': numbers} for stamp, numbers in zip(stamps, values, strict=True)
    ]
    body = orjson.dumps(
        {'samples': samples, 'imported_from': each.source, 'sha256': each.sha256}, option=orjson.OPT_SERIALIZE_NUMPY
    )
    named = ARM_TOPICS[sensor]
    key = dated(f'{arm}/{named}/{{date}}/{{time}}_{{ms}}_{named}.json', int(stamps[0]))
    sha256 = hashlib.sha256(body).hexdigest()
    metadata = {
        words.ROBOT: arm, words.SENSOR: named, words.TOPIC: f'/{arm}/{named}', words.TYPE: each.type, words.SHA256: sha256,
        words.T_START_NS: str(stamps[0]), words.T_END_NS: str(stamps[-1]), words.COUNT: str(len(stamps)),
        words.IMPORTED_FROM: each.sha256,
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix='shadowhound-import-') as folder:
        path = Path(folder, 'body.json')
        path.write_bytes(body)
        item = SpooledObject(
            id=0, bucket=schema.BUCKET, key=key, path=path, size=len(body), sha256=sha256, content_type='application/json',
            metadata=metadata, priority=5, created_ns=time.time_ns(),
        )  # fmt: skip
        try:
            is_new = store.put(item) is Put.CREATED
        except ForeignObject as error:
            raise LakeError(f'{schema.BUCKET}/{key} is there, and is another recording of that time',
                            remedy='name another arm, or right times') from error  # fmt: skip
    found.objects += is_new
    found.present += not is_new
    return schema.row_of(schema.BUCKET, key, len(body), 'application/json', metadata)
