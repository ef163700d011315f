"""Writes a dataset in LeRobot's layout (lerobot.py): adds and drops episodes, and rewrites the files about all of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shadowhound_data_logger.core.config import DEFAULT_ROBOT
from shadowhound_data_logger.core.durable_files import fingerprint, replacing, sync
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.episodes import (
    EPISODE,
    GAP_SCHEMA,
    GAPS,
    LABEL_SCHEMA,
    LABELS,
    PICTURE,
    ROWS,
    SOURCE_SCHEMA,
    SOURCES,
)
from shadowhound_data_logger.datasets.features import (
    ARM_ACTION,
    ARM_COMMANDS,
    ARM_STATE,
    COMMAND,
    DERIVED,
    JOINT_STATE,
    LABEL_FEATURE,
    SHARED,
    ExportOptions,
    StatePart,
)
from shadowhound_data_logger.datasets.lerobot import (
    DATA,
    DIGESTS,
    EPISODES,
    FILES,
    GAP_TABLE,
    OURS,
    REPORT,
    SOURCE_TABLE,
    STATS,
    TASKS,
    VIDEO,
    EpisodeRow,
    Lerobot,
    matrix,
    read_json,
)
from shadowhound_data_logger.datasets.video import Clip, count_frames, feature_info, join
from shadowhound_data_logger.lake.training import INFO, LABEL_TABLE, digest_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

VERSION: Final = 'v3.0'
ANY_SIZE_MB: Final = 1_000_000
"""Makes lerobot's own writer put everything it adds into the one file, too."""
CHUNK: Final = 1000
"""Files per folder."""
QUANTILES: Final = {'q01': 0.01, 'q10': 0.10, 'q50': 0.50, 'q90': 0.90, 'q99': 0.99}
_COUNTERS: Final = {
    'timestamp': 'float32',
    'frame_index': 'int64',
    'episode_index': 'int64',
    'index': 'int64',
    'task_index': 'int64',
}


class LerobotWriter(Lerobot):
    """Adds episodes to a dataset and removes them. One process at a time (``export.py`` holds the lock)."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._joined: dict[Path, list[Clip]] = {}
        """Shared video -> the clips that it must consist of."""
        self._is_changed = False
        """Whether earlier episodes changed."""

    # -- adding ----------------------------------------------------------------------------------------------------

    def add(self, episode: Mapping[str, Any], made: Path, options: ExportOptions, split: str) -> None:
        """Append one episode from the folder ``made``. It becomes part of the dataset with ``commit``.

        Raises LakeError if it does not match the earlier episodes.
        """
        features = features_of(episode, options)
        if self.info is None:
            self.info = _empty_info(episode, features, options)
        if (other := different(self.info['features'], features)) or self.info['fps'] != episode['fps']:
            raise LakeError(f'its {other or "frames per second"} differ from those of the episodes before it')
        number = int(self.rows[-1]['data/file_index'] + CHUNK * self.rows[-1]['data/chunk_index'] + 1) if self.rows else 0
        begin = int(self.rows[-1]['dataset_to_index']) if self.rows else 0
        place = {'chunk_index': number // CHUNK, 'file_index': number % CHUNK}
        row: EpisodeRow = {
            'episode_index': len(self.rows), 'tasks': [episode['task']], 'length': episode['frames'],
            **{f'data/{name}': value for name, value in place.items()},
            'dataset_from_index': begin, 'dataset_to_index': begin + episode['frames'],
        }  # fmt: skip
        is_shared = options.layout == SHARED
        for key, feature in features.items():
            if feature['dtype'] == 'video':
                row |= {f'videos/{key}/{name}': 0 if is_shared else value for name, value in place.items()}
                row |= _times(key, begin if is_shared else 0, episode['frames'], episode['fps'])
        self.rows.append(row)
        target = self.path(DATA, row, 'data')
        values = _write_data(made / ROWS, target, row, self._tasks().index(episode['task']), features)
        stats = {key: vector_stats(column) for key, column in values.items()}
        for name, histogram in episode['histograms'].items():
            stats[f'observation.{name}'] = image_stats(np.array(histogram), episode['frames'])
            row[f'{OURS}histogram/observation.{name}'] = np.array(histogram).ravel().tolist()
            if not options.is_lossless:
                video = self.path(VIDEO, row, f'videos/observation.{name}', video_key=f'observation.{name}')
                if is_shared:
                    before = [Clip(video, 0, begin)] if begin else []
                    self._joined.setdefault(video, before).append(Clip(made / f'{name}.mp4', 0, episode['frames']))
                else:
                    _take(made / f'{name}.mp4', video)
        row |= {f'stats/{key}/{name}': value for key, each in stats.items() for name, value in each.items()}
        row |= {f'meta/episodes/{name}': value for name, value in place.items()}
        row |= _shadowhound_columns(episode, split)
        row |= {f'{OURS}labels': json.dumps(episode['labels'])} if options.labels else {}
        self._write_row(row)

    def _write_row(self, row: EpisodeRow) -> None:
        arrays = {name: pa.array([value], _arrow_type(name, value)) for name, value in row.items()}
        _write(self.path(EPISODES, row, 'meta/episodes'), pa.table(arrays))

    def _tasks(self) -> list[str]:
        """In order of first appearance."""
        return list(dict.fromkeys(task for row in self.rows for task in row['tasks']))

    def join_videos(self) -> None:
        """Write the shared videos of the added episodes; earlier ones keep their position. Raises LakeError."""
        for path, clips in self._joined.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path, is_synced=True) as file:
                join(clips, self.fps, file)
        self._joined.clear()

    # -- files about all episodes ----------------------------------------------------------------------------------

    def commit(self, report: Mapping[str, Any], made: Mapping[str, Path]) -> str:
        """Write the files about all episodes, ``info.json`` last; returns the digest. ``made``: folders of new episodes."""
        assert self.info is not None
        assert not self._joined, 'join_videos comes first'
        tasks = self._tasks()
        self.info |= {
            'total_episodes': len(self.rows), 'total_frames': sum(row['length'] for row in self.rows), 'total_tasks': len(tasks),
            'splits': {'train': f'0:{len(self.rows)}'},
        }  # fmt: skip
        (self.folder / 'meta').mkdir(exist_ok=True)
        _write(self.folder / TASKS, _task_table(tasks))
        _put_json(self.folder / STATS, self._stats())
        self._write_parts(self.folder / SOURCE_TABLE, SOURCES, made, SOURCE_SCHEMA)
        self._write_parts(self.folder / GAP_TABLE, GAPS, made, GAP_SCHEMA)
        if LABEL_FEATURE in self.info['features']:
            self._write_parts(self.folder / LABEL_TABLE, LABELS, made, LABEL_SCHEMA)
        _put_json(self.folder / REPORT, dict(report))
        info = _dump(self.info)
        digest = digest_of(self.folder, info)
        self._note_digest(digest)
        self._write_files(info, is_changed=self._is_changed)
        with replacing(self.folder / INFO, is_synced=True) as file:
            file.write(info)
        sync(self.folder / 'meta')
        return digest

    def _stats(self) -> dict[str, Any]:
        """Statistics over all frames, not combined per episode; empty if all were dropped."""
        assert self.info is not None
        if not self.rows:
            return {}
        numeric = [key for key, feature in self.info['features'].items() if feature['dtype'] not in {'video', 'image', 'string'}]
        columns: dict[str, list[NDArray[Any]]] = {key: [] for key in numeric}
        for row in self.rows:
            table = pq.read_table(self.path(DATA, row, 'data'), columns=numeric)
            for key in numeric:
                columns[key].append(matrix(table[key]))
        stats = {key: vector_stats(np.concatenate(found)) for key, found in columns.items()}
        for key in self.image_keys():
            histogram = sum(np.array(row[f'{OURS}histogram/{key}'], np.int64).reshape(3, 256) for row in self.rows)
            stats[key] = image_stats(np.asarray(histogram), sum(row['length'] for row in self.rows))
        return stats

    def _write_parts(self, path: Path, name: str, made: Mapping[str, Path], schema: pa.Schema) -> None:
        """One row group per episode, in order: new ones from their folders, others from the previous file."""
        before: dict[str, pa.Table] = {}
        if path.is_file():
            file = pq.ParquetFile(path)
            for index in range(file.num_row_groups):
                table = file.read_row_group(index)
                before[table[EPISODE][0].as_py()] = table
        with replacing(path, is_synced=True) as out, pq.ParquetWriter(out, schema, compression='zstd') as writer:
            for mission in self.mission_ids:
                table = pq.read_table(made[mission] / name) if mission not in before and mission in made else before.get(mission)
                if table is not None and len(table):
                    writer.write_table(table.select(schema.names).cast(schema), row_group_size=max(len(table), 1))

    def _note_digest(self, digest: str) -> None:
        """Record the missions of this digest: a dataset grows, and a model was trained on an earlier state."""
        history = read_json(self.folder / DIGESTS) or {'digests': []}
        if not history['digests'] or history['digests'][-1]['digest'] != digest:
            history['digests'].append({'digest': digest, 'missions': self.mission_ids})
        _put_json(self.folder / DIGESTS, history)

    def _write_files(self, info: bytes, *, is_changed: bool) -> None:
        """Size and SHA-256 of every file but this one; those of earlier episodes are known, unless they were changed."""
        before = {} if is_changed else (read_json(self.folder / FILES) or {}).get('files') or {}
        known = {name: each for name, each in before.items() if name.startswith(('data/', 'videos/', 'meta/episodes/'))}
        found = {}
        for path in self.paths():
            name = path.relative_to(self.folder).as_posix()
            if name in known and path.stat().st_size == known[name]['bytes']:
                found[name] = known[name]
            else:
                size, sha256 = fingerprint(path)
                found[name] = {'bytes': size, 'sha256': sha256}
        found[INFO] = {'bytes': len(info), 'sha256': hashlib.sha256(info).hexdigest()}
        _put_json(self.folder / FILES, {'files': dict(sorted(found.items()))})

    # -- removing --------------------------------------------------------------------------------------------------

    def drop(self, mission_id: str) -> None:
        """Delete an episode and renumber the later ones. ``commit`` must be called afterwards."""
        assert self.info is not None
        self._is_changed = True
        (self.folder / INFO).unlink(missing_ok=True)  # it is incomplete until then
        gone = [row for row in self.rows if row[f'{OURS}mission_id'] == mission_id]
        shared = self._cut_videos(mission_id)
        self.rows = [row for row in self.rows if row[f'{OURS}mission_id'] != mission_id]
        tasks, begin = self._tasks(), 0
        self.dropped.append(hashlib.sha256(mission_id.encode()).hexdigest())
        for number, row in enumerate(self.rows):
            path = self.path(DATA, row, 'data')
            table = pq.read_table(path)
            count = len(table)
            wanted = {'episode_index': [number] * count, 'index': range(begin, begin + count),
                      'task_index': [tasks.index(row['tasks'][0])] * count}  # fmt: skip
            new = table
            for name, values in wanted.items():
                new = new.set_column(new.column_names.index(name), new.schema.field(name), pa.array(values, pa.int64()))
            if not new.equals(table):
                _write(path, new)
            known = dict(row)
            row |= {'episode_index': number, 'dataset_from_index': begin, 'dataset_to_index': begin + count}
            row.update((name, value) for key in shared for name, value in _times(key, begin, count, self.fps).items())
            for name in wanted:
                row |= {f'stats/{name}/{each}': value for each, value in vector_stats(matrix(new[name])).items()}
            if row != known:  # also if a kill happened between its rows and this
                self._write_row(row)
            begin += count
        used = {path for row in self.rows for path in self.episode_files(row)}
        for path in (path for row in gone for path in self.episode_files(row) if path not in used):
            path.unlink(missing_ok=True)
        kept = (read_json(self.folder / DIGESTS) or {'digests': []})['digests']
        _put_json(self.folder / DIGESTS, {'digests': [
            {**each, 'missions': [name for name in each['missions'] if name != mission_id]} for each in kept]})  # fmt: skip

    def _cut_videos(self, mission_id: str) -> list[str]:
        """Remove the frames of a mission from the shared videos; returns their cameras. Idempotent."""
        if self.settings is None or self.settings['layout'] != SHARED:
            return []
        lengths = [row['length'] for row in self.rows]
        begins = np.cumsum([0, *lengths[:-1]]).tolist() if lengths else []  # not from the rows: some may be renumbered already
        for key in self.video_keys():
            for path in {self.path(VIDEO, row, f'videos/{key}', video_key=key) for row in self.rows}:
                kept = [Clip(path, begin, row['length']) for row, begin in zip(self.rows, begins, strict=True)
                        if row[f'{OURS}mission_id'] != mission_id]  # fmt: skip
                if kept and count_frames(path) != sum(clip.frames for clip in kept):
                    with replacing(path, is_synced=True) as file:
                        join(kept, self.fps, file)
        return self.video_keys()


def features_of(episode: Mapping[str, Any], options: ExportOptions) -> dict[str, Any]:
    """The features of ``info.json`` for this episode."""
    streams: Mapping[str, Any] = episode['streams']
    features: dict[str, Any] = {}
    for name, size in episode['sizes'].items():
        shape, names = [*size, 3], ['height', 'width', 'channels']
        if options.is_lossless:
            features[f'observation.{name}'] = {'dtype': 'image', 'shape': shape, 'names': names}
        else:
            info = feature_info(options.codec, episode['fps'], (size[0], size[1]))
            features[f'observation.{name}'] = {'dtype': 'video', 'shape': shape, 'names': names, 'info': info}
    state: list[str] = []
    units: list[str] = []
    origins: list[str] = []
    arm = {ARM_STATE.name: ARM_STATE} if options.arm else {}
    for word, part in {**arm, **{part.name: part for part in options.state_parts}}.items():
        names = streams[f'state.{word}']['names']
        state += names
        units += _units(part, names, streams[f'state.{word}'])
        origins += [f'{part.sensor}, derived' if part.is_derived else part.sensor] * len(names)
    features['observation.state'] = _vector(state, units=units, source=origins)
    features['action'] = _action_feature(streams, options)
    features['shadowhound.stale'] = _vector(list(streams), about='1 if the newest message is older than allowed')
    features['shadowhound.age_s'] = _vector(list(streams), about='seconds since the newest message')
    features['shadowhound.cause'] = {'dtype': 'string', 'shape': [1], 'names': None}
    features |= {LABEL_FEATURE: {'dtype': 'string', 'shape': [1], 'names': None}} if options.labels else {}
    features['shadowhound.stamp_ns'] = {'dtype': 'int64', 'shape': [1], 'names': None}
    features |= {name: {'dtype': kind, 'shape': [1], 'names': None} for name, kind in _COUNTERS.items()}
    return features


def _action_feature(streams: Mapping[str, Any], options: ExportOptions) -> dict[str, Any]:
    """The arm's numbers first; ``derived`` if one of them was not commanded."""
    base = streams['action']['sensor'] == COMMAND.sensor
    names, units = list(COMMAND.names), list(COMMAND.units)
    sources, is_derived = [COMMAND.sensor if base else f'{DERIVED.sensor}, derived'], not base
    if not isinstance(options.action, str):
        names = list(streams['action']['names'])
        units = list(_units(options.action, names, streams['action']))
        sources, is_derived = [options.action.sensor], False
    if ARM_ACTION in streams:
        of_arm = streams[ARM_ACTION]
        commanded = of_arm['sensor'] == ARM_COMMANDS
        names, units = [*of_arm['names'], *names], [*_units(ARM_STATE, of_arm['names'], of_arm), *units]
        sources, is_derived = (
            [of_arm['topic'] if commanded else f'{of_arm["topic"]}, derived', *sources],
            is_derived or not commanded,
        )
    return _vector(names, units=units, source=', '.join(sources), derived=is_derived)


def _units(part: StatePart, names: Sequence[str], stream: Mapping[str, Any]) -> Sequence[str]:
    if part is ARM_STATE and stream['type'] != JOINT_STATE:
        return ['as recorded'] * len(names)
    return part.units if len(part.units) == len(names) else part.units[:1] * len(names)


def _vector(names: list[str], **info: Any) -> dict[str, Any]:
    return {'dtype': 'float32', 'shape': [len(names)], 'names': names, 'info': info}


def different(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Which features differ, or empty."""
    plain = json.loads(json.dumps(other))
    return ', '.join(sorted(key for key in {*one, *plain} if one.get(key) != plain.get(key)))


def _times(key: str, first: int, frames: int, fps: int) -> EpisodeRow:
    """Where the frames of an episode are in their video, s."""
    return {f'videos/{key}/from_timestamp': first / fps, f'videos/{key}/to_timestamp': (first + frames) / fps}


def _empty_info(episode: Mapping[str, Any], features: Mapping[str, Any], options: ExportOptions) -> dict[str, Any]:
    robot_type = options.robot_type or ('go2' if episode['robot'] == DEFAULT_ROBOT else episode['robot'])
    has_video = any(feature['dtype'] == 'video' for feature in features.values())
    return {
        'codebase_version': VERSION, 'fps': episode['fps'], 'features': json.loads(json.dumps(features)), 'total_episodes': 0,
        'total_frames': 0, 'total_tasks': 0, 'chunks_size': CHUNK, 'data_files_size_in_mb': 100,
        'video_files_size_in_mb': ANY_SIZE_MB if options.layout == SHARED else 200,
        'data_path': DATA, 'video_path': VIDEO if has_video else None, 'robot_type': robot_type, 'splits': {},
    }  # fmt: skip


def _shadowhound_columns(episode: Mapping[str, Any], split: str) -> EpisodeRow:
    named = ('mission_id', 'run_id', 'robot', 'mission_type', 'first_tick_ns', 'last_tick_ns', 'begins_late_s')
    row: EpisodeRow = {f'{OURS}{name}': episode[name] for name in named}
    row[f'{OURS}split'] = split
    row |= {f'{OURS}clock/{name}': value for name, value in episode.get('clock', {}).items()}
    for stream, each in episode['streams'].items():
        row |= {
            f'{OURS}{stream}/{name}': each[name] for name in ('from', 'topic', 'stale_share', 'longest_gap_s', 'offset_changed')
        }
        row[f'{OURS}{stream}/causes'] = json.dumps(each['causes'])
    return row


def _arrow_type(name: str, value: Any) -> pa.DataType:
    """As lerobot's writer has them: 64 bits, and lists of any depth."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        inner = _arrow_type(name, value[0]) if value else pa.string()
        return pa.list_(inner)
    return {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}[type(value)]


def _write_data(source: Path, target: Path, row: EpisodeRow, task: int, features: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """The rows of an episode with their numbers; returns the columns of numbers."""
    target.parent.mkdir(parents=True, exist_ok=True)
    order = [key for key, feature in features.items() if feature['dtype'] != 'video']
    found: dict[str, list[NDArray[Any]]] = {}
    file, begin = pq.ParquetFile(source), 0
    with replacing(target, is_synced=True) as out:
        writer: pq.ParquetWriter | None = None
        for index in range(file.num_row_groups):
            table = file.read_row_group(index)
            count, first = len(table), int(row['dataset_from_index']) + begin
            table = table.append_column('episode_index', pa.array([row['episode_index']] * count, pa.int64()))
            table = table.append_column('index', pa.array(range(first, first + count), pa.int64()))
            table = table.append_column('task_index', pa.array([task] * count, pa.int64())).select(order)
            table = table.replace_schema_metadata(_column_types(features))
            writer = writer or pq.ParquetWriter(out, table.schema, compression='snappy')
            writer.write_table(table)
            begin += count
            for key in order:
                if table.schema.field(key).type not in (PICTURE, pa.string()):
                    found.setdefault(key, []).append(matrix(table[key]))
        assert writer is not None
        writer.close()
    return {key: np.concatenate(parts) for key, parts in found.items()}


def _column_types(features: Mapping[str, Any]) -> dict[str, str] | None:
    """Column types for the ``datasets`` library when it streams: otherwise images are plain bytes."""
    images = {key: {'_type': 'Image'} for key, feature in features.items() if feature['dtype'] == 'image'}
    return {'huggingface': json.dumps({'info': {'features': images}})} if images else None


def vector_stats(values: NDArray[Any]) -> dict[str, Any]:
    """Statistics of (frames, numbers) over the frames; ``count`` is the number of frames."""
    found = {'min': values.min(axis=0), 'max': values.max(axis=0), 'mean': values.mean(axis=0, dtype=np.float64),
             'std': values.std(axis=0, dtype=np.float64)}  # fmt: skip
    made = dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values()), axis=0), strict=True))
    lists = {name: np.asarray(each, np.float64).tolist() for name, each in {**found, **made}.items()}
    return {
        **{name: lists[name] for name in ('min', 'max', 'mean', 'std')},
        'count': [len(values)],
        **{q: lists[q] for q in QUANTILES},
    }


def image_stats(histogram: NDArray[np.int64], frames: int) -> dict[str, Any]:
    """Statistics over every pixel of every frame, by color, 0 to 1; each has shape (3, 1, 1). ``histogram`` is (3, 256)."""
    levels, total = np.arange(256) / 255, histogram.sum(axis=1)
    mean = (histogram * levels).sum(axis=1) / total
    spread = np.sqrt((histogram * (levels - mean[:, None]) ** 2).sum(axis=1) / total)
    upto = histogram.cumsum(axis=1)
    there = histogram > 0

    def quantile(share: float) -> list[float]:
        """The smallest value that at least this share of the pixels does not exceed."""
        return [float(levels[int(np.searchsorted(upto[color], share * total[color]))]) for color in range(3)]

    found = {
        'min': [float(levels[there[color].argmax()]) for color in range(3)],
        'max': [float(levels[255 - there[color][::-1].argmax()]) for color in range(3)],
        'mean': mean.tolist(), 'std': spread.tolist(),
    }  # fmt: skip
    statistics = {**found, **{name: quantile(share) for name, share in QUANTILES.items()}}
    shaped = {name: [[[value]] for value in values] for name, values in statistics.items()}
    return {**{name: shaped[name] for name in found}, 'count': [frames], **{name: shaped[name] for name in QUANTILES}}


def _task_table(tasks: Sequence[str]) -> pa.Table:
    """The tasks as pandas writes a frame indexed by task: without its metadata, lerobot looks tasks up by number."""
    about = {
        'index_columns': ['task'],
        'column_indexes': [{'name': None, 'field_name': None, 'pandas_type': 'unicode', 'numpy_type': 'object',
                            'metadata': {'encoding': 'UTF-8'}}],
        'columns': [
            {'name': 'task_index', 'field_name': 'task_index', 'pandas_type': 'int64', 'numpy_type': 'int64', 'metadata': None},
            {'name': 'task', 'field_name': 'task', 'pandas_type': 'unicode', 'numpy_type': 'object', 'metadata': None},
        ],
        'creator': {'library': 'pyarrow', 'version': pa.__version__}, 'pandas_version': '2.2.0',
    }  # fmt: skip
    table = pa.table({'task_index': pa.array(range(len(tasks)), pa.int64()), 'task': pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({'pandas': json.dumps(about)})


# -- files ---------------------------------------------------------------------------------------------------------------------


def _write(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, is_synced=True) as file:
        pq.write_table(table, file, compression='snappy')


def _take(source: Path, target: Path) -> None:
    """Idempotent: after a kill the file may have been moved already."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_file():
        sync(source)
        with source.open('rb') as file, replacing(target, is_synced=True) as out:
            while piece := file.read(1 << 20):
                out.write(piece)


def _dump(value: Any) -> bytes:
    return json.dumps(value, indent=4, ensure_ascii=False).encode() + b'\n'


def _put_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, is_synced=True) as file:
        file.write(_dump(value))
