"""Imports an arm's recordings by other programs into the store, with hashes and catalog rows like our own.

LeRobotDataset v2.1 and v3.0 (https://github.com/huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx) and HDF5 as written by
ACT and ALOHA (https://github.com/tonyzhaozh/aloha, record_episodes.py). Joints and commands become objects of the arm, with the
episode's identity in key and metadata; images are not imported.

The identity is the SHA-256 of the imported part of an episode (``identity_of``), not of a file: LeRobot v3 has many episodes in
one file, and rewrites it when the dataset grows.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
import tempfile
import time
from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, iso, utc
from shadowhound_data_logger.core.errors import ForeignObject, LakeError, SettingError
from shadowhound_data_logger.core.keys import dated
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.core.untrusted import csv_rows
from shadowhound_data_logger.datasets.features import ARM_COMMANDS, ARM_JOINTS, ARM_TOPICS, JOINT_STATE
from shadowhound_data_logger.datasets.lerobot import matrix
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake.bucket import put_part
from shadowhound_data_logger.lake.training import INFO
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from numpy.typing import NDArray

AS_RECORDED: Final = 'lerobot/joints'
"""Positions in the unit of the recording: LeRobot does not record it."""
GRID_S: Final = 1e-4
"""lerobot's tolerance between a time and its frame's time (``tolerance_s``)."""
DIGITS: Final = 16
"""Digits of an identity in a key."""
MS: Final = 1_000_000
PART: Final = 3000
"""Samples per object."""
COLUMNS: Final = ('episode', 'begin_ns')


@dataclass(frozen=True, slots=True)
class Demonstration:
    """One episode of an arm, by its own clock."""

    stamps_ns: NDArray[np.int64]
    names: tuple[str, ...]
    positions: NDArray[np.float64]
    """(samples, joints)."""
    commands: NDArray[np.float64] | None
    type: str
    number: int
    """Its number in the dataset."""
    identity: str
    """``identity_of`` the recording."""

    @property
    def begin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def name(self) -> str:
        return f'episode {self.number} ({iso(self.begin_ns)})'


@dataclass(slots=True)
class Imported:
    """The result of an import."""

    episodes: int = 0
    """New ones."""
    unchanged: int = 0
    """Episodes that were imported before."""
    samples: int = 0
    """In the new episodes."""
    objects: int = 0
    """New ones."""
    present: int = 0
    """Objects that were in the store already."""
    refused: dict[str, str] = field(default_factory=dict)
    """Episode -> reason."""
    absent: list[str] = field(default_factory=list)
    """Episodes of this arm that were imported before and are not in this dataset; they stay in the store."""


def identity_of(stamps_ns: NDArray[np.int64], names: Sequence[str], positions: NDArray[Any], commands: NDArray[Any] | None,
                unit: str) -> str:  # fmt: skip
    """SHA-256 in hex of an episode as recorded: joints, unit, the time of each sample since the first, all numbers.

    The numbers are hashed as float64, little endian, row by row, before units are converted. So it does not depend on the file,
    on the episode's number, or on the width of a column with the same values.
    """
    header = {'names': list(names), 'unit': unit, 'samples': len(positions), 'has_commands': commands is not None}
    whole = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    whole.update(np.ascontiguousarray(stamps_ns - stamps_ns[0], '<i8').tobytes())
    for values in (each for each in (positions, commands) if each is not None):
        numbers = np.ascontiguousarray(values, '<f8') + 0.0  # -0.0 is 0.0
        whole.update(np.where(np.isnan(numbers), np.nan, numbers).tobytes())
    return whole.hexdigest()


def read_times(path: Path) -> dict[int, int]:
    """Episode -> its start by the arm's clock, from a CSV file with ``episode,begin_ns``. Raises SettingError."""
    try:
        found = {int(row['episode']): int(row['begin_ns']) for row in csv_rows(path.read_bytes())}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise SettingError('--times', path, f'a CSV file with the columns {",".join(COLUMNS)} ({error})') from error
    if any(not EARLIEST_SANE_NS <= begin < 1 << 62 for begin in found.values()):
        raise SettingError('--times', path, 'times in ns since 1970')
    return found


def read_lerobot(folder: Path, times: Mapping[int, int], *, is_degrees: bool) -> Iterator[Demonstration]:
    """The episodes of a LeRobotDataset v2.1 or v3.0 with known start times.

    Start times are from ``times``, otherwise from the column ``shadowhound.stamp_ns``. Raises LakeError.
    """
    info = _info(folder)
    features = info['features']
    names, fps = tuple(_joint(name) for name in _names(features['observation.state'])), float(info['fps'])
    wanted = ['episode_index', 'frame_index', 'timestamp', 'observation.state']
    wanted += [name for name in ('action', 'shadowhound.stamp_ns') if name in features]
    has_action = 'action' in features and features['action']['shape'] == features['observation.state']['shape']
    parts: list[dict[str, NDArray[Any]]] = []
    for path in sorted((folder / 'data').rglob('*.parquet')):
        try:
            table = pq.read_table(path, columns=wanted)
            parts.append({name: matrix(table[name]) for name in wanted})
        except (pa.ArrowException, OSError, ValueError) as error:
            raise LakeError(f'{path} is not a data file of a LeRobotDataset: {error}') from error
        if any(parts[-1][name].dtype.kind not in 'iu' for name in ('episode_index', 'frame_index')):
            raise LakeError(f'{path} has an episode_index or frame_index that is not an integer')
        if any(parts[-1][name].shape[1] != len(names) for name in ('observation.state', 'action')[: 1 + has_action]):
            raise LakeError(f'{path} does not have the {len(names)} joints of {INFO}')
    if not sum(len(part['episode_index']) for part in parts):
        raise LakeError(f'{folder} has no episode', remedy='name the folder of a LeRobotDataset')
    columns = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
    order = np.lexsort((columns['frame_index'][:, 0], columns['episode_index'][:, 0]))
    numbers, begins = np.unique(columns['episode_index'][order, 0], return_index=True)
    for number, rows in zip(map(int, numbers), np.split(order, begins[1:]), strict=True):
        mine = {name: values[rows] for name, values in columns.items()}
        if len(np.unique(mine['frame_index'])) != len(rows):
            raise LakeError(f'episode {number} of {folder} has a frame twice', remedy='remove old files from data/')
        stamps = _stamps(number, mine, times, fps)
        values = [mine[name].astype(np.float64) for name in ('observation.state', 'action')[: 1 + has_action]]
        kind = JOINT_STATE if is_degrees else AS_RECORDED
        identity = identity_of(stamps, names, values[0], values[1] if has_action else None, 'degrees' if is_degrees else kind)
        values = [np.deg2rad(each) for each in values] if is_degrees else values
        yield Demonstration(stamps, names, values[0], values[1] if has_action else None, kind, number, identity)


def _info(folder: Path) -> dict[str, Any]:
    try:
        info = dict(json.loads((folder / INFO).read_bytes()))
        version = str(info['codebase_version'])
        state = info['features']['observation.state']
        if version not in {'v2.1', 'v3.0'} or len(state['shape']) != 1 or not float(info['fps']) > 0:
            raise LakeError(f'{folder} is a dataset of version {version} with {info["fps"]} frames per second',
                            remedy='v2.1 and v3.0 can be imported')  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise LakeError(f'{folder} is not a LeRobotDataset: {error}', remedy=f'it has {INFO} with observation.state') from error
    return info


def _names(feature: Mapping[str, Any]) -> list[str]:
    names = feature.get('names')
    while isinstance(names, dict) and names:  # {"motors": [...]} in older ones
        names = next(iter(names.values()))
    count = feature['shape'][0]
    return list(map(str, names)) if isinstance(names, list) and len(names) == count else [f'joint_{n}' for n in range(count)]


def _joint(name: str) -> str:
    return name.removesuffix('.pos').removeprefix('main_').removeprefix('arm_')


def _stamps(number: int, columns: Mapping[str, NDArray[Any]], times: Mapping[int, int], fps: float) -> NDArray[np.int64]:
    """LeRobot counts frames at a constant rate and rounds times to float32: if they agree, the frame numbers are exact."""
    if number not in times:
        if 'shadowhound.stamp_ns' in columns:
            return columns['shadowhound.stamp_ns'][:, 0].astype(np.int64)
        raise LakeError(f'the start time of episode {number} is unknown: LeRobot counts from 0 in each episode',
                        remedy=f'--times FILE, a CSV with {",".join(COLUMNS)}')  # fmt: skip
    seconds = columns['timestamp'][:, 0].astype(np.float64)
    if not np.isfinite(seconds).all() or np.abs(seconds).max(initial=0) > 1e6:
        raise LakeError(f'episode {number} has implausible times')
    frames = columns['frame_index'][:, 0]
    if (np.abs(seconds - frames / fps) <= GRID_S).all():
        seconds = frames / fps
    return times[number] + np.rint(seconds * SECOND).astype(np.int64)


def read_hdf5(
    paths: Sequence[Path], times: Mapping[int, int], *, fps: float, joints: Sequence[str] = ()
) -> Iterator[Demonstration]:
    """The n-th file is episode n: ``observations/qpos`` and ``action``, (samples, joints). Raises LakeError."""
    import h5py  # noqa: PLC0415 - of the extra; nothing else needs it

    for number, path in enumerate(paths):
        if number not in times:
            raise LakeError(f'the start time of episode {number} ({path.name}) is unknown',
                            remedy=f'--times FILE, a CSV with {",".join(COLUMNS)}')  # fmt: skip
        try:
            with h5py.File(path, 'r') as file:
                positions = np.asarray(file['observations/qpos'], np.float64)
                commands = np.asarray(file['action'], np.float64) if 'action' in file else None
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise LakeError(f'{path} is not a demonstration in the layout of ACT and ALOHA: {error}') from error
        if positions.ndim != 2 or not len(positions) or (commands is not None and commands.shape != positions.shape):
            raise LakeError(f'{path}: observations/qpos and action must have the same shape, (samples, joints)')
        width = positions.shape[1]
        names = tuple(joints) or tuple(f'joint_{n}' for n in range(width))
        if len(names) != width:
            raise LakeError(f'{path} has {width} joints, not {len(names)}', remedy='--joints names them in their order')
        stamps = times[number] + np.rint(np.arange(len(positions)) * (SECOND / fps)).astype(np.int64)
        identity = identity_of(stamps, names, positions, commands, JOINT_STATE)
        yield Demonstration(stamps, names, positions, commands, JOINT_STATE, number, identity)


def import_episodes(demonstrations: Iterable[Demonstration], arm: str, store: ObjectStore) -> Imported:
    """Store the new episodes as recordings of the arm, with rows in the catalog; existing objects are not changed.

    An episode is rejected if the store has another recording of its time, or its recording with another time. Raises LakeError,
    StoreError.
    """
    every, found, stored = list(demonstrations), Imported(), _StoredEpisodes(store, arm)
    wanted = {each.begin_ns // MS: each.identity[:DIGITS] for each in every}
    for each in every:
        if why := stored.conflict(each, wanted):
            found.refused[each.name] = why
            continue
        is_new = not stored.has(each)
        rows: list[catalog.Row] = []
        for sensor, values in ((ARM_JOINTS, each.positions), (ARM_COMMANDS, each.commands)):
            if values is not None:
                pieces = range(-(-len(values) // PART))
                rows += [stored.put(each, sensor, number, values, found) for number in pieces]
        name = f'{utc(each.begin_ns):%Y%m%dT%H%M%S}_import_{each.identity[:DIGITS]}'
        for date in sorted({catalog.date_of(row) for row in rows}):
            mine = [row for row in rows if catalog.date_of(row) == date]
            put_part(store, catalog.OBJECTS.part_key(arm, date, name), arm, parts.encode(mine), len(mine))
        stored.add(each)
        found.episodes += is_new
        found.unchanged += not is_new
        found.samples += len(each.positions) if is_new else 0
    found.absent = stored.others(wanted)
    return found


class _StoredEpisodes:
    """The episodes of an arm that were imported, by the keys of their objects. One thread."""

    def __init__(self, store: ObjectStore, arm: str) -> None:
        """Raises StoreError."""
        self._store, self._arm = store, arm
        self._keys: set[str] = set()
        self._pieces: list[tuple[int, str, str]] = []
        """(start in ms, identity, key) of the objects with joints, sorted."""
        self._begins: dict[str, set[int]] = {}
        """Identity -> the starts, in ms, of the episodes with it."""
        for sensor in (ARM_JOINTS, ARM_COMMANDS):
            named = ARM_TOPICS[sensor]
            name = rf'(\d{{8}}/\d{{6}}_\d{{3}})_{named}_([0-9a-f]{{{DIGITS}}})_(\d+)\.json'
            pattern = re.compile(rf'{re.escape(arm)}/{named}/{name}', re.ASCII)
            for info in store.list(catalog.BUCKET, f'{arm}/{named}/'):
                if (match := pattern.fullmatch(info.key)) is None or (begin_ms := _parse_ms(match[1])) is None:
                    continue  # recorded by the arm's own machine
                self._keys.add(info.key)
                if sensor == ARM_JOINTS:
                    self._add(begin_ms, match[2], info.key, int(match[3]))

    def has(self, each: Demonstration) -> bool:
        return each.begin_ns // MS in self._begins.get(each.identity[:DIGITS], ())

    def add(self, each: Demonstration) -> None:
        """Remember a stored episode."""
        if not self.has(each):
            for number, stamp in enumerate(each.stamps_ns[::PART].tolist()):
                self._add(stamp // MS, each.identity[:DIGITS], self._key(each, ARM_JOINTS, number), number)

    def conflict(self, each: Demonstration, wanted: Mapping[int, str]) -> str:
        """Why it cannot be stored, or empty. ``wanted`` has start time, in ms, and identity of all imported episodes."""
        if self.has(each):
            return ''
        mine = each.identity[:DIGITS]
        for begin in sorted(self._begins.get(mine, ())):
            if wanted.get(begin) != mine:
                return f'its recording was imported with the start time {iso(begin * MS)}: it has another number or time now'
        if (other := self._overlapping(each)) is None:
            return ''
        begin, identity = other
        if begin == each.begin_ns // MS:
            return f'it changed: the recording with this start time was imported as {identity}, and is {mine} now'
        return f'the recording that was imported with the start time {iso(begin * MS)} overlaps it'

    def others(self, wanted: Mapping[int, str]) -> list[str]:
        """The episodes with other start times."""
        every = sorted((begin, identity) for identity, begins in self._begins.items() for begin in begins)
        return [f'{iso(begin * MS)} {identity}' for begin, identity in every if begin not in wanted]

    def put(self, each: Demonstration, sensor: str, number: int, values: NDArray[np.float64], found: Imported) -> catalog.Row:
        """Store the samples from ``number`` times ``PART`` on, if they are missing; returns the row. Raises LakeError,
        StoreError.
        """
        key = self._key(each, sensor, number)
        held = self._store.head(catalog.BUCKET, key) if key in self._keys else None
        if held is not None:
            if held.metadata.get(meta.IMPORTED_FROM) != each.identity:
                raise LakeError(f'{catalog.BUCKET}/{key} does not belong to {each.name}', remedy='import it as another --arm')
            found.present += 1
            return catalog.row_of(catalog.BUCKET, key, held.size, 'application/json', held.metadata)
        some = slice(number * PART, (number + 1) * PART)
        stamps, values = each.stamps_ns[some], values[some]
        names = list(each.names)
        samples = [
            {'stamp_ns': int(stamp), 'name': names, 'position': numbers} for stamp, numbers in zip(stamps, values, strict=True)
        ]
        body = orjson.dumps({'samples': samples, 'imported_from': each.identity}, option=orjson.OPT_SERIALIZE_NUMPY)
        named = ARM_TOPICS[sensor]
        sha256 = hashlib.sha256(body).hexdigest()
        metadata = {
            meta.ROBOT: self._arm, meta.SENSOR: named, meta.TOPIC: f'/{self._arm}/{named}', meta.TYPE: each.type,
            meta.SHA256: sha256, meta.T_START_NS: str(stamps[0]), meta.T_END_NS: str(stamps[-1]),
            meta.COUNT: str(len(stamps)), meta.IMPORTED_FROM: each.identity,
        }  # fmt: skip
        with tempfile.TemporaryDirectory(prefix='shadowhound-import-') as folder:
            path = Path(folder, 'body.json')
            path.write_bytes(body)
            item = SpooledObject(
                id=0, bucket=catalog.BUCKET, key=key, path=path, size=len(body), sha256=sha256, content_type='application/json',
                metadata=metadata, priority=5, created_ns=time.time_ns(),
            )  # fmt: skip
            try:
                is_new = self._store.put(item) is Put.CREATED
            except ForeignObject as error:
                raise LakeError(f'{catalog.BUCKET}/{key} exists, and is another recording of that time',
                                remedy='import it as another --arm, or with other --times') from error  # fmt: skip
        found.objects += is_new
        found.present += not is_new
        return catalog.row_of(catalog.BUCKET, key, len(body), 'application/json', metadata)

    def _key(self, each: Demonstration, sensor: str, number: int) -> str:
        named = ARM_TOPICS[sensor]
        pattern = f'{self._arm}/{named}/{{date}}/{{time}}_{{ms}}_{named}_{each.identity[:DIGITS]}_{number}.json'
        return dated(pattern, int(each.stamps_ns[number * PART]))

    def _add(self, begin_ms: int, identity: str, key: str, number: int) -> None:
        insort(self._pieces, (begin_ms, identity, key))
        if number == 0:
            self._begins.setdefault(identity, set()).add(begin_ms)

    def _overlapping(self, each: Demonstration) -> tuple[int, str] | None:
        """Start in ms and identity of an object of the same time."""
        place = bisect_left(self._pieces, (each.begin_ns // MS,))
        if place < len(self._pieces) and self._pieces[place][0] <= int(each.stamps_ns[-1]) // MS:
            return self._pieces[place][:2]
        if place:
            begin, identity, key = self._pieces[place - 1]
            held = self._store.head(catalog.BUCKET, key)
            if held is not None:
                row = catalog.row_of(catalog.BUCKET, key, held.size, 'application/json', held.metadata)
                if (row['t_end_ns'] or 0) >= each.begin_ns:
                    return begin, identity
        return None


def _parse_ms(text: str) -> int | None:
    """``YYYYMMDD/HHMMSS_mmm`` in a key as ms since 1970; None if it is not a time."""
    seconds, _, ms = text.rpartition('_')
    try:
        return int(datetime.strptime(f'{seconds}+0000', '%Y%m%d/%H%M%S%z').timestamp()) * 1000 + int(ms)
    except ValueError:
        return None
