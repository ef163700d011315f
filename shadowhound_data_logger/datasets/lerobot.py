"""A dataset in LeRobot's format v3.0, as read by lerobot 0.6.1, in a folder: complete if it has ``meta/info.json``.

https://github.com/huggingface/lerobot, src/lerobot/datasets: utils.py has the paths, dataset_metadata.py and io_utils.py the
readers. Each episode has a data file, a video per camera and an episodes file, which are never rewritten, except that with the
layout ``shared`` there is one video per camera (docs/decisions/0022). Files about all episodes are rewritten, ``info.json`` last.
The columns ``shadowhound/...`` of the episodes and the files ``meta/shadowhound_*`` are additions, which lerobot keeps and
ignores.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.video import Clip, frames_at, frames_of
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.training import DIGEST_FILES, INFO, LABEL_TABLE, digest_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

DATA: Final = 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
VIDEO: Final = 'videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4'
EPISODES: Final = 'meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
STATS, TASKS = 'meta/stats.json', 'meta/tasks.parquet'
SOURCE_TABLE, GAP_TABLE = DIGEST_FILES[1:]
REPORT, FILES, DIGESTS = 'meta/shadowhound_report.json', 'meta/shadowhound_files.json', 'meta/shadowhound_digests.json'
OURS: Final = 'shadowhound/'
"""The prefix of our columns in ``meta/episodes``."""
EpisodeRow = dict[str, Any]
"""Column of ``meta/episodes`` -> value."""


class Lerobot:
    """Reads one dataset in LeRobot's layout."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info: dict[str, Any] | None = read_json(folder / INFO)
        report = read_json(folder / REPORT) or {}
        self.settings: dict[str, Any] | None = report.get('settings') if self.info else None
        """The settings of its episodes."""
        self.dropped: list[str] = report.get('dropped', [])
        """SHA-256 of the ids of missions that must not be added again."""
        self.rows: list[EpisodeRow] = list(self._rows()) if self.info else []

    @property
    def mission_ids(self) -> list[str]:
        return [str(row[f'{OURS}mission_id']) for row in self.rows]

    @property
    def digest(self) -> str:
        return digest_of(self.folder)

    def path(self, pattern: str, row: Mapping[str, Any], what: str, **names: str) -> Path:
        """Path of a file of an episode; ``what`` is ``data``, ``meta/episodes`` or ``videos/KEY``."""
        place = {each: row[f'{what}/{each}'] for each in ('chunk_index', 'file_index')}
        return self.folder / pattern.format(**place, **names)

    @property
    def fps(self) -> int:
        assert self.info is not None
        return int(self.info['fps'])

    def clip(self, row: EpisodeRow, key: str) -> Clip:
        """The frames of an episode in their video."""
        path = self.path(VIDEO, row, f'videos/{key}', video_key=key)
        return Clip(path, round(row[f'videos/{key}/from_timestamp'] * self.fps), row['length'])

    def video_keys(self) -> list[str]:
        return [key for key, feature in (self.info or {}).get('features', {}).items() if feature['dtype'] == 'video']

    def image_keys(self) -> list[str]:
        return [key for key, feature in (self.info or {}).get('features', {}).items() if feature['dtype'] in {'video', 'image'}]

    def numbers(self, row: EpisodeRow, key: str) -> NDArray[Any]:
        """(frames, numbers) of a feature of an episode."""
        return matrix(pq.read_table(self.path(DATA, row, 'data'), columns=[key])[key])

    def images(self, row: EpisodeRow, key: str) -> Iterator[NDArray[np.uint8]]:
        """(height, width, 3) RGB of each frame of an episode. Raises LakeError."""
        if key in self.video_keys():
            yield from frames_of(self.clip(row, key), self.fps)
        else:
            yield from (decode.image(body) for body in self.bodies(row, key))

    def images_at(self, row: EpisodeRow, key: str, numbers: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """The frames with these numbers, counted from 0 in the episode, in ascending order. Raises LakeError."""
        if key in self.video_keys():
            clip = self.clip(row, key)
            yield from frames_at(clip.path, self.fps, [clip.first + number for number in numbers])
        else:
            yield from (decode.image(body) for number, body in enumerate(self.bodies(row, key)) if number in numbers)

    def bodies(self, row: EpisodeRow, key: str) -> Iterator[bytes]:
        """The images of a lossless dataset, as published."""
        for batch in pq.ParquetFile(self.path(DATA, row, 'data')).iter_batches(batch_size=64, columns=[key]):
            yield from (value.as_py()['bytes'] for value in batch.column(0))

    def _rows(self) -> Iterator[EpisodeRow]:
        assert self.info is not None
        for index, path in enumerate(sorted((self.folder / 'meta/episodes').glob('*/*.parquet'))):
            if index >= self.info['total_episodes']:
                return  # from a run that was killed before it updated info.json
            yield pq.read_table(path).to_pylist()[0]

    def paths(self) -> Iterator[Path]:
        """The files that belong to it, except ``info.json`` and this list."""
        yield from dict.fromkeys(path for row in self.rows for path in self.episode_files(row))
        optional = ('meta/report.png', LABEL_TABLE)
        yield from (self.folder / name for name in (STATS, TASKS, SOURCE_TABLE, GAP_TABLE, REPORT, DIGESTS))
        yield from (self.folder / name for name in optional if (self.folder / name).is_file())

    def episode_files(self, row: EpisodeRow) -> Iterator[Path]:
        """The files of an episode; the one that records its existence is last."""
        yield self.path(DATA, row, 'data')
        for key in self.video_keys():
            yield self.path(VIDEO, row, f'videos/{key}', video_key=key)
        yield self.path(EPISODES, row, 'meta/episodes')


def matrix(column: pa.ChunkedArray) -> NDArray[Any]:
    """(rows, numbers) of a column of numbers or of lists of equal length."""
    flat = column.combine_chunks()
    if isinstance(flat, pa.ChunkedArray):  # pyarrow's form of an empty column
        flat = flat.chunk(0) if flat.num_chunks else pa.array([], column.type)
    count = len(flat)
    values = flat.flatten() if pa.types.is_nested(flat.type) else flat
    return np.asarray(values.to_numpy(zero_copy_only=False)).reshape(count, -1)


def read_json(path: Path) -> dict[str, Any] | None:
    """None if missing. Raises LakeError if it cannot be read."""
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise LakeError(f'{path} cannot be read: {error}', remedy='fetch or export the dataset again') from error
    return found if isinstance(found, dict) else None
