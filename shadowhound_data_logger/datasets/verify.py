"""Verifies a dataset: its files are complete, its sources are unchanged in the store, its images match their sources.

Also finds the datasets and models that used an object.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused
from shadowhound_data_logger.core.untrusted import from_json, is_path
from shadowhound_data_logger.datasets.episodes import EPISODE, SOURCES
from shadowhound_data_logger.datasets.lerobot import DIGESTS, FILES, OURS, SOURCE_TABLE, EpisodeRow, Lerobot
from shadowhound_data_logger.datasets.series import read_images
from shadowhound_data_logger.datasets.transfer import DatasetPlace
from shadowhound_data_logger.datasets.video import ssim
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.training import INFO
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.verify import CHECKSUM, FOREIGN, MISSING, check_object

THREADS: Final = 16
FRAMES: Final = 5
"""Frames of each camera in each episode, by default."""
ALIKE: Final = 0.8
"""Minimum similarity (SSIM) of a video frame to its source; AV1 at crf 30 keeps more than 0.9 for camera images."""
MAX_TABLE_BYTES: Final = 1 << 30


@dataclass(slots=True)
class VerifyResult:
    """What was checked, and what is wrong."""

    episodes: int = 0
    files: int = 0
    sources: int = 0
    frames: int = 0
    least_ssim: float = 1.0
    wrong: list[str] = field(default_factory=list)


def verify(folder: Path, store: ObjectStore, *, frames: int | None = FRAMES, is_read: bool = False,
           forgotten: Callable[[], Mapping[tuple[str, str], str]] = dict,
           say: Callable[[str], None] = lambda _: None) -> VerifyResult:  # fmt: skip
    """``frames`` is how many of each camera and episode are compared, None for all; ``is_read`` reads every source again.

    ``forgotten`` is called for missing sources: (bucket, key) -> the date on which `lake prune` deleted it.

    Raises LakeError for a dataset of another program, StoreError.
    """
    made = Lerobot(folder)
    if made.info is None:
        raise LakeError(f'{folder} is not a dataset: it has no {INFO}', remedy='name a folder that export lerobot wrote')
    found = VerifyResult(episodes=len(made.rows))
    _files(made, found)
    try:
        table = pq.read_table(folder / SOURCE_TABLE)
    except (pa.ArrowException, OSError) as error:
        found.wrong.append(f'{SOURCE_TABLE} cannot be read: {error}')
        return found
    say('sources')
    _sources(table, store, found, forgotten, is_read=is_read)
    for row in made.rows:
        say(f'episode {row["episode_index"] + 1} of {len(made.rows)}')
        mine = table.filter(pc.equal(table[EPISODE], row[f'{OURS}mission_id']))
        for key in made.image_keys():
            try:
                _frames(made, row, key, mine, store, frames, found)
            except (LakeError, ObjectRefused) as error:
                found.wrong.append(f'episode {row["episode_index"]}, {key}: {error.what}')
            except (pa.ArrowException, OSError) as error:
                found.wrong.append(f'episode {row["episode_index"]}, {key}: {error}')
    return found


def _files(made: Lerobot, found: VerifyResult) -> None:
    listed = json.loads((made.folder / FILES).read_text(encoding='utf-8'))['files'] if (made.folder / FILES).is_file() else {}
    for name in sorted({*listed, *(path.relative_to(made.folder).as_posix() for path in made.paths())}):
        path = made.folder / name
        if not is_path(name) or not path.is_file():
            found.wrong.append(f'{name} is missing')
        elif name not in listed:
            found.wrong.append(f'{name} is not in {FILES}')
        elif fingerprint(path) != (listed[name]['bytes'], listed[name]['sha256']):
            found.wrong.append(f'{name} differs from what was written')
        found.files += 1


def _sources(table: pa.Table, store: ObjectStore, found: VerifyResult, forgotten: Callable[[], Mapping[tuple[str, str], str]], *,
             is_read: bool) -> None:  # fmt: skip
    gone: list[tuple[str, str]] = []
    rows = table.group_by(['bucket', 'key', 'sha256']).aggregate([]).sort_by('key').to_pylist()

    def wrong(row: dict[str, str]) -> str:
        name = f'{row["bucket"]}/{row["key"]}'
        finding = check_object(store, row['bucket'], row['key'], None, row['sha256'] or None, deep=is_read)
        if finding is None:
            return ''
        if finding.kind == MISSING:
            gone.append((row['bucket'], row['key']))
            return ''
        is_changed = finding.kind in {CHECKSUM, FOREIGN}
        return f'the source {name} has changed' if is_changed else f'the source {name}: {finding.detail}'

    with ThreadPoolExecutor(THREADS, 'export-verify') as pool:
        found.wrong += [given for given in pool.map(wrong, rows) if given]
    dates = forgotten() if gone else {}
    for bucket, key in sorted(gone):
        given = f'was deleted on {dates[bucket, key]} (lake prune)' if (bucket, key) in dates else 'is gone'
        found.wrong.append(f'the source {bucket}/{key} {given}')
    found.sources = len(rows)


def _frames(made: Lerobot, row: EpisodeRow, key: str, sources: pa.Table, store: ObjectStore, most: int | None,
            found: VerifyResult) -> None:  # fmt: skip
    stream, length = key.removeprefix('observation.'), int(row['length'])
    wanted = range(length) if most is None else sorted({round(at) for at in np.linspace(0, length - 1, min(most, length))})
    mine = sources.filter(pc.and_(pc.equal(sources['stream'], stream), pc.is_in(sources['frame'], pa.array(wanted, pa.int64()))))
    by_frame = {each['frame']: each for each in mine.to_pylist()}
    if sorted(by_frame) != list(wanted):
        found.wrong.append(f'episode {row["episode_index"]}: frames of {key} have no source')
        return
    with TemporaryDirectory() as work:
        requested = {(each['bucket'], each['key'], each['stamp_ns'], each['sha256']) for each in by_frame.values()}
        images = read_images(store, requested, row[f'{OURS}{stream}/topic'], Path(work))
    count = 0
    shown: Iterator[Any] = made.images(row, key) if key in made.video_keys() else made.bodies(row, key)
    for number, content in enumerate(shown):
        count += 1
        if number not in by_frame:
            continue
        body = images.get((by_frame[number]['key'], by_frame[number]['stamp_ns']))
        if body is None:
            found.wrong.append(
                f'episode {row["episode_index"]}, frame {number}: its source {by_frame[number]["key"]} has no such image'
            )
            continue
        found.frames += 1
        if isinstance(content, bytes):
            if content != body:
                found.wrong.append(f'episode {row["episode_index"]}, frame {number} of {key} differs from its source')
            continue
        alike = ssim(content, decode.image(body))
        found.least_ssim = min(found.least_ssim, alike)
        if alike < ALIKE:
            found.wrong.append(
                f'episode {row["episode_index"]}, frame {number} of {key} does not look like its source (SSIM {alike:.2f})'
            )
    if count != length:
        found.wrong.append(f'episode {row["episode_index"]}: {key} has {count} frames, the episode {length}')


# -- which datasets used an object --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DatasetUse:
    """A dataset with values of an object."""

    where: str
    missions: tuple[str, ...]
    frames: int
    digests: tuple[str, ...]
    """The digests of all its states with these values."""


def use_in_folder(folder: Path, key: str) -> DatasetUse | None:
    """Raises LakeError for a folder of another program."""
    try:
        return _use(str(folder), pq.read_table(folder / SOURCE_TABLE), from_json((folder / DIGESTS).read_bytes()), key)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise LakeError(f'{folder} is not a dataset of this program: {error}') from error


def use_in_store(source: Bucket, place: DatasetPlace, key: str) -> DatasetUse | None:
    """Raises StoreError, LakeError."""
    try:
        body = source.get(place.prefix + SOURCE_TABLE, MAX_TABLE_BYTES)
        digests = from_json(source.get(place.prefix + DIGESTS, MAX_TABLE_BYTES))
        return _use(str(place), pq.read_table(io.BytesIO(body)), digests, key)
    except (ValueError, pa.ArrowException) as error:
        raise LakeError(f'{place} is not a dataset of this program: {error}') from error


def _use(where: str, table: pa.Table, digests: Any, key: str) -> DatasetUse | None:
    bucket, _, rest = key.partition('/')
    mine = table.filter(
        pc.or_(pc.equal(table['key'], key), pc.and_(pc.equal(table['bucket'], bucket), pc.equal(table['key'], rest)))
    )
    if not len(mine):
        return None
    missions = tuple(sorted(set(mine[EPISODE].to_pylist())))
    frames = len(mine.group_by([EPISODE, 'frame']).aggregate([]))
    digests = tuple(each['digest'] for each in digests['digests'] if {*missions} & {*each['missions']})
    return DatasetUse(where, missions, frames, digests)


def sources_in_folder(folder: Path) -> set[tuple[str, str]]:
    """(bucket, key) of all objects with values in a dataset, or that a running export to it reads. Raises LakeError."""
    found: set[tuple[str, str]] = set()
    try:
        for path in (folder / SOURCE_TABLE, *folder.glob(f'.shadowhound/*/{SOURCES}')):
            found |= _named(pq.read_table(path))
    except (OSError, ValueError, pa.ArrowException, LookupError) as error:
        raise LakeError(f'the dataset {folder} cannot be read: {error}', remedy='repair it, or move it away') from error
    return found


def sources_in_store(source: Bucket, place: DatasetPlace) -> set[tuple[str, str]]:
    """The same for a dataset in a store. Raises StoreError, LakeError."""
    try:
        return _named(pq.read_table(io.BytesIO(source.get(place.prefix + SOURCE_TABLE, MAX_TABLE_BYTES))))
    except (ObjectRefused, ValueError, pa.ArrowException, LookupError) as error:
        raise LakeError(f'the dataset {place} cannot be read: {error}', remedy='repair it, or delete it') from error


def _named(table: pa.Table) -> set[tuple[str, str]]:
    named = table.group_by(['bucket', 'key']).aggregate([])
    return set(zip(named['bucket'].to_pylist(), named['key'].to_pylist(), strict=True))
